"""What is U on a plane of two states, when there are more?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from siq.report.drawn_landscape import BLOCK_OF_POINTS, DrawnLandscape, Potential, chosen_states

View = Literal["projection", "section"]

POINTS = 141  # along each axis, of two states
POINTS_OF_MORE = 61  # of a projection, which asks for many points behind each of these
BEHIND = 40  # states in the other directions that a projection tries at each point
SWEEPS = 3  # after which the lowest of them moves by less than a pixel


@dataclass(frozen=True)
class Plane:
    """U on a plane of two states.

    Attributes
    ----------
    shown
        Places of the two states.
    x1, x2
        The grid, shapes ``(n,)`` and ``(m,)``.
    values
        U, shape ``(n, m)``, NaN where it is not known.
    sentence
        What the plane is, where there are more states; otherwise empty.
    """

    shown: tuple[int, int]
    x1: np.ndarray
    x2: np.ndarray
    values: np.ndarray
    sentence: str


def plane_of(
    landscape: DrawnLandscape, *, states: Sequence[str] | None = None, view: View = "projection"
) -> Plane:
    """U on the plane of two states.

    Parameters
    ----------
    landscape
        What is drawn, of two states at least.
    states
        Names of the two.
    view
        Of more states: ``projection``, the lowest U that the others allow, which keeps wells and passes at
        their heights; or ``section``, the others held at the lowest pass.
    """
    if view not in ("projection", "section"):
        raise ValueError(f"view is '{view}'; it is 'projection' or 'section'")
    shown = chosen_states(landscape, states)
    rest = [place for place in range(len(landscape.names)) if place not in shown]
    count = POINTS_OF_MORE if rest and view == "projection" else POINTS
    x1, x2 = (landscape.along(place, count) for place in shown)
    at = landscape.lowest_pass
    grid = np.tile(at, (count * count, 1))
    grid[:, shown] = np.stack(np.meshgrid(x1, x2, indexing="ij"), axis=-1).reshape(-1, 2)
    if not rest:
        values, sentence = in_blocks(landscape.potential, grid), ""
    elif view == "section":
        values = in_blocks(landscape.potential, grid)
        held = ", ".join(f"{landscape.names[place]} = {at[place]:.3g}" for place in rest)
        sentence = f"section at {held}, through the lowest pass"
    else:
        values = _lowest_behind(landscape, grid, rest)
        sentence = f"projection: the lowest $U$ over {', '.join(landscape.names[place] for place in rest)}"
    return Plane(shown, x1, x2, values.reshape(count, count), sentence)


def in_blocks(potential: Potential, x: np.ndarray) -> np.ndarray:
    """A potential at many points, some at a time."""
    parts = [potential(x[start : start + BLOCK_OF_POINTS]) for start in range(0, len(x), BLOCK_OF_POINTS)]
    return np.concatenate(parts) if parts else np.zeros(0)


def _lowest_behind(landscape: DrawnLandscape, grid: np.ndarray, rest: list[int]) -> np.ndarray:
    """The lowest U over the other states at each point of a plane.

    The best of some states seen anywhere is followed down, one direction after another, by parabolas.
    """
    seen = [np.stack([one.position for one in (*landscape.wells, *landscape.saddles)])] if (
        landscape.wells or landscape.saddles
    ) else []  # fmt: skip
    seen += [way.uphill for way in landscape.ways if len(way.uphill)]
    places = np.concatenate([*seen, _points(landscape)])[:, rest]
    width = np.ptp(landscape.box, axis=1)[rest]
    behind = _far_apart(places / width, BEHIND) * width
    best, lowest = grid.copy(), np.full(len(grid), np.inf)
    for one in behind:
        tried = grid.copy()
        tried[:, rest] = one
        values = np.nan_to_num(in_blocks(landscape.potential, tried), nan=np.inf)
        better = values < lowest
        best[better], lowest[better] = tried[better], values[better]
    known = np.flatnonzero(np.isfinite(lowest))
    step = 0.5 * width / max(len(behind), 1) ** (1 / len(rest))
    for _ in range(SWEEPS):
        for place, size in zip(rest, step, strict=True):
            _descend(landscape.potential, best, lowest, known, place, float(size))
        step = step / 3
    return np.where(np.isfinite(lowest), lowest, np.nan)


def _descend(
    potential: Potential, best: np.ndarray, lowest: np.ndarray, known: np.ndarray, place: int, size: float
) -> None:
    """Move points along one state to the lowest place of a parabola, where U really is lower there."""
    middle, centre = lowest[known].copy(), best[known].copy()
    sides = []
    for sign in (-1, 1):
        moved = centre.copy()
        moved[:, place] += sign * size
        sides.append(in_blocks(potential, moved))
        _take(best, lowest, known, moved, sides[-1])
    left, right = sides
    with np.errstate(invalid="ignore", divide="ignore"):
        shift = 0.5 * size * (left - right) / (left + right - 2 * middle)
    moved = centre
    moved[:, place] += np.clip(np.nan_to_num(shift, nan=0.0, posinf=0.0, neginf=0.0), -size, size)
    _take(best, lowest, known, moved, in_blocks(potential, moved))


def _take(
    best: np.ndarray, lowest: np.ndarray, known: np.ndarray, moved: np.ndarray, values: np.ndarray
) -> None:
    better = np.nan_to_num(values, nan=np.inf) < lowest[known]
    best[known[better]], lowest[known[better]] = moved[better], values[better]


def _points(landscape: DrawnLandscape) -> np.ndarray:
    points = landscape.points
    fitted = [well.points for well in landscape.formulas if well is not None]
    together = np.concatenate([np.zeros((0, len(landscape.names))), *fitted])
    if not len(together) and points is not None:
        together = points
    return together[:: max(len(together) // 2000, 1)]


def _far_apart(points: np.ndarray, count: int) -> np.ndarray:
    """So many of the points, each as far as possible from those before it."""
    chosen = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(count, len(points)) and distance.max() > 0:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]
