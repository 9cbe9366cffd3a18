"""Fans of characteristics: where to start them, and which of their points may be believed.

Curves leave an attractor at rates that differ by direction, so that evenly spread starts end in a few bundles
along the fastest directions. New curves are therefore put between neighbours that end far apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from siq.dynamics.dynamics import Dynamics
from siq.reference.characteristics import Fan, characteristics, join

CLOSEST = 1e-12  # of directions: what cannot be told apart is not divided further
CHUNK = 2048  # numerical: curves followed together, as fit into the cache
MOST_PARTS = 8  # into which a gap is divided at once
BENT = 0.03  # of the level: a larger term of second order is no correction


@dataclass(frozen=True)
class Caustic:
    """Where the quasipotential of a fan first has no derivative for lack of a single direction.

    Attributes
    ----------
    position
        Shape ``(d,)``.
    value
        V there, not U.
    """

    position: np.ndarray
    value: float


def even_directions(dimension: int, count: int, *, generator: np.random.Generator) -> np.ndarray:
    """Unit vectors, shape ``(count, d)``: even in the plane, the first along the first axis; else random."""
    if dimension == 1:
        return np.array([[1.0], [-1.0]])
    if dimension == 2:
        angles = 2 * np.pi * np.arange(count) / count
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)
    directions = generator.normal(size=(count, dimension))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def adapted_fan(
    dynamics: Dynamics,
    attractor: np.ndarray,
    *,
    level: float,
    box: np.ndarray,
    generator: np.random.Generator,
    count: int = 64,
    most: int = 512,
    rounds: int = 5,
    gap: float = 0.1,
    **options: Any,
) -> Fan:
    """A fan whose curves end close together, as far as a number of curves allows.

    Parameters
    ----------
    dynamics, attractor, level, box, **options
        As for `siq.reference.characteristics.characteristics`.
    generator
        Draws the first directions where there are more than two states.
    count, most
        Number of curves at first, and at most.
    rounds
        How often curves are put in between, up to seven into every gap.
    gap
        Distance between the ends of neighbours that is close enough; the level is at about 1.

    Returns
    -------
    Fan
        In the order in which the curves were added. Where a saddle or a caustic parts neighbours, a gap stays
        however many curves are put into it. In four and more dimensions `most` is what limits the spread.
    """
    directions = even_directions(dynamics.dimension, count, generator=generator)

    def follow(starts: np.ndarray) -> Fan:
        return characteristics(dynamics, attractor, level=level, box=box, directions=starts, **options)

    fan = follow(directions)
    for _ in range(rounds):
        between = _between(fan, gap)[: most - len(fan.directions)]
        if not len(between):
            break
        fan = join(fan, follow(between))
    return fan


def first_caustic(fan: Fan) -> Caustic | None:
    """The lowest caustic that a curve of the fan meets, or None.

    V is the value along the curve. The lowest sheet may have ended before; and curves between those of the
    fan may meet the caustic a little lower.
    """
    if not len(fan.caustic_values):
        return None
    lowest = int(np.argmin(fan.caustic_values))
    return Caustic(fan.caustic_points[lowest], float(fan.caustic_values[lowest]))


def lowest_sheet(fan: Fan, *, distance: float = 0.06, margin: float = 2e-3) -> np.ndarray:
    """Which points may be taken as values of V: no neighbour says that less action would do.

    A neighbour within `distance` says what V should be at a point by its own V, gradient and curvature. Where
    this is lower than the point's V by more than the margin, the point lies on an upper sheet: another curve
    gets there with less action. It then drops out with all that follows on its curve, for what is not
    optimal once never becomes so again.

    Parameters
    ----------
    fan
        Curves about one attractor.
    distance
        In the metric in which the level is at about 1. Should exceed the gaps of the fan.
    margin
        As a share of the level.

    Returns
    -------
    numpy.ndarray
        Shape ``(n,)``, a mask of the fan's points.

    Notes
    -----
    Limits: an upper sheet is only seen where the fan has curves of the lower sheet within `distance`, not
    in its gaps, nor where those curves ended at a box or at a caustic; and close to a kink of V, where
    the sheets differ by less than the margin, points of both are kept, too high by at most the margin.
    """
    scaled = (fan.points - fan.attractor) @ fan.metric.T
    eigenvalues, vectors = np.linalg.eigh(fan.hessians)
    # Towards a caustic the curvature falls without bound and would predict any depth; it counts as none.
    bends = np.einsum("nij,nj,nkj->nik", vectors, np.maximum(eigenvalues, 0), vectors)
    upper = np.zeros(len(scaled), dtype=bool)
    # So close to the attractor V is smooth, and all curves are neighbours of each other.
    asked = np.flatnonzero(np.linalg.norm(scaled, axis=1) > 2 * distance)
    if not len(asked):
        return ~upper
    tree = cKDTree(scaled[asked])
    for block in np.array_split(asked, max(len(asked) // CHUNK, 1)):
        near = tree.query_ball_point(scaled[block], distance)
        at = np.repeat(block, [len(others) for others in near])
        neighbour = asked[np.concatenate([np.asarray(others, dtype=int) for others in near])]
        offset = fan.points[at] - fan.points[neighbour]
        predicted = fan.values[neighbour] + np.sum(offset * fan.momenta[neighbour], axis=1)
        predicted += np.einsum("ni,nij,nj->n", offset, bends[neighbour], offset) / 2
        upper[at[predicted < fan.values[at] - margin * fan.level]] = True
    # Points are sorted along curves: whatever follows an upper point on its curve is upper too.
    count = np.cumsum(upper)
    before_curve = np.r_[0, count][np.searchsorted(fan.curve, fan.curve)]
    return count == before_curve


def value_near(fan: Fan, x: np.ndarray, *, sheet: np.ndarray, distance: float = 0.1) -> np.ndarray:
    """V at points, to second order from the nearest point of a fan: ``(m, d)`` to ``(m,)``.

    Parameters
    ----------
    fan
        Curves about one attractor.
    x
        Where V is wanted.
    sheet
        Which points of the fan may be used, shape ``(n,)``; see `lowest_sheet`.
    distance
        Beyond it, in the metric in which the level is at about 1, the value is NaN; so it is where the second
        order is no small correction, close to a caustic. The error is of third order in the distance, but
        where V has a kink between x and the nearest point, of first.
    """
    points = fan.points[sheet]
    found, nearest = cKDTree((points - fan.attractor) @ fan.metric.T).query(
        (x - fan.attractor) @ fan.metric.T
    )
    offset = x - points[nearest]
    values = fan.values[sheet][nearest] + np.sum(offset * fan.momenta[sheet][nearest], axis=1)
    bend = np.einsum("ni,nij,nj->n", offset, fan.hessians[sheet][nearest], offset) / 2
    # Towards a caustic ∇²V grows without bound, and two terms no longer tell V.
    known = (found <= distance) & (np.abs(bend) <= BENT * fan.level)
    return np.where(known, values + bend, np.nan)


def _between(fan: Fan, gap: float) -> np.ndarray:
    """Directions between neighbours that end further apart than the gap, widest first."""
    pairs = _neighbours(fan.directions)
    ends = (fan.points[fan.last] - fan.attractor) @ fan.metric.T
    width = np.linalg.norm(ends[pairs[:, 0]] - ends[pairs[:, 1]], axis=1)
    apart = np.linalg.norm(fan.directions[pairs[:, 0]] - fan.directions[pairs[:, 1]], axis=1)
    wide = np.flatnonzero((width > gap) & (apart > CLOSEST))
    wide = wide[np.argsort(-width[wide], kind="stable")]
    # Several at once in a very wide gap: a pass takes as long for one curve as for a hundred.
    parts = np.clip(np.ceil(width[wide] / gap), 2, MOST_PARTS).astype(int)
    first, second = (np.repeat(fan.directions[pairs[wide, side]], parts - 1, axis=0) for side in (0, 1))
    share = np.concatenate([np.arange(1, number) / number for number in parts] or [np.zeros(0)])[:, None]
    middle = (1 - share) * first + share * second
    return middle / np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), CLOSEST)


def _neighbours(directions: np.ndarray) -> np.ndarray:
    """Pairs of neighbours on the sphere of directions, shape ``(k, 2)``."""
    if directions.shape[1] == 1:
        return np.zeros((0, 2), dtype=int)
    if directions.shape[1] == 2:
        order = np.argsort(np.arctan2(directions[:, 1], directions[:, 0]))
        return np.stack([order, np.roll(order, -1)], axis=1)
    facets = ConvexHull(directions).simplices
    size = facets.shape[1]
    edges = np.concatenate([facets[:, [a, b]] for a in range(size) for b in range(a)])
    return np.unique(np.sort(edges, axis=1), axis=0)
