"""What of a landscape is drawn? Wells by letters, saddles, ways out, recorded states, and U as a function.

Figures and the interactive view start from here, whether the landscape is in memory, in a file, or known as
one formula alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import cumulative_trapezoid

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import compile_formulas
from siq.dynamics.parametric import symbol
from siq.landscape.global_quasipotential import least_over_wells
from siq.landscape.landscape import Landscape
from siq.landscape.storage import landscape_data
from siq.potential.symbolic import SymbolicDecomposition
from siq.potential.well import Well
from siq.report.said_landscape import SaidLandscape, well_name

Potential = Callable[[np.ndarray], np.ndarray]
"""U at points ``(n, d)``, NaN where it is not known: shape ``(n,)``."""

MARGIN = 0.05  # of what is shown: left free around it
BLOCK_OF_POINTS = 20_000  # evaluated at once: each has some hundred powers
PARTS = ("uphill", "downhill")


@dataclass(frozen=True)
class DrawnPoint:
    """An equilibrium: its kind, where it lies, and U there, NaN where that is not known.

    Attributes
    ----------
    kind
        ``attractor``, ``cycle``, ``saddle``, ``repeller`` or ``degenerate``.
    position
        Shape ``(d,)``.
    height
        U there.
    label
        The letter of a well; empty for others.
    """

    kind: str
    position: np.ndarray
    height: float
    label: str = ""


@dataclass(frozen=True)
class DrawnWay:
    """The way out of a well over a saddle.

    Attributes
    ----------
    start, end
        Places of the wells; the end is None where the way leads out of the recorded region.
    saddle
        Shape ``(d,)``.
    barrier, standard_error
        ΔU and its error, NaN where not known.
    uphill, downhill
        The path of least action and the way down without noise, shape ``(n, d)``; empty where there is none.
    """

    start: int
    end: int | None
    saddle: np.ndarray
    barrier: float
    standard_error: float
    uphill: np.ndarray
    downhill: np.ndarray


@dataclass(frozen=True)
class DrawnLandscape:
    """What is drawn of a landscape.

    Main attributes
    ---------------
    names, units
        Of the states.
    potential
        U as a function of points.
    wells
        The attractors in the order of the tables, as A, B, C and so on.
    others
        The other equilibria.
    ways
        The ways out of the wells.
    box
        Shape ``(d, 2)``: what is shown.

    Other attributes
    ----------------
    energy_unit
        Unit of U; empty where it is that of ε and has no other name.
    points
        Recorded states, shape ``(n, d)``; there may be none.
    formulas
        V about each attractor, None where there is none.
    dynamics
        f and D.
    matched
        Whether U is known over all wells; otherwise each well is drawn from its own bottom.
    cycles
        Stable limit cycles, each of shape ``(n, d)`` and closed.
    parting
        Unstable ones, likewise.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    potential: Potential
    wells: tuple[DrawnPoint, ...]
    others: tuple[DrawnPoint, ...]
    ways: tuple[DrawnWay, ...]
    box: np.ndarray
    energy_unit: str = ""
    points: np.ndarray | None = None
    formulas: tuple[Well | None, ...] = ()
    dynamics: Dynamics | None = None
    matched: bool = True
    cycles: tuple[np.ndarray, ...] = ()
    parting: tuple[np.ndarray, ...] = ()

    @property
    def saddles(self) -> tuple[DrawnPoint, ...]:
        """The passes between the wells."""
        return tuple(one for one in self.others if one.kind == "saddle")

    @property
    def top(self) -> float | None:
        """U at the highest pass out of a well, None where none is known."""
        tops = [self.wells[way.start].height + way.barrier for way in self.ways]
        tops += [one.height for one in self.saddles] if not tops else []
        known = [top for top in tops if np.isfinite(top)]
        return max(known) if known else None

    def along(self, place: int, count: int) -> np.ndarray:
        """So many values of a state, evenly over what is shown."""
        low, high = self.box[place].tolist()
        return np.linspace(low, high, count)

    @property
    def lowest_pass(self) -> np.ndarray:
        """Where the lowest pass lies; the deepest well where there is none."""
        known = [way for way in self.ways if np.isfinite(self.wells[way.start].height + way.barrier)]
        if known:
            return min(known, key=lambda way: self.wells[way.start].height + way.barrier).saddle
        places = self.saddles or self.wells or self.others
        heights = [np.inf if np.isnan(one.height) else one.height for one in places]
        return places[int(np.argmin(heights))].position

    def standard_error(self, x: np.ndarray) -> np.ndarray | None:
        """Standard error of U of one state at ``(n,)``, against the deepest well; None where not known."""
        if self.dynamics is None or len(self.names) > 1 or not self.wells or not self.matched:
            return None
        deepest = min(self.wells, key=lambda one: np.nan_to_num(one.height, nan=np.inf))
        return _error_of_one_state(self.dynamics, x, float(deepest.position[0]))


def chosen_states(landscape: DrawnLandscape, states: Sequence[str] | None) -> tuple[int, int]:
    """Places of the two states that make the plane; by default those along which the wells lie apart.

    Raises
    ------
    ValueError
        When they are not two states of the landscape.
    """
    names = landscape.names
    if states is not None:
        if len(set(states)) != 2 or not set(states) <= set(names):
            raise ValueError(f"states is {list(states)}; name two of {', '.join(names)}")
        return names.index(states[0]), names.index(states[1])
    if len(names) == 2:
        return 0, 1
    width = np.ptp(landscape.box, axis=1)
    places = np.array([one.position for one in (*landscape.wells, *landscape.saddles)])
    apart = np.ptp(places, axis=0) / width if len(places) else np.zeros(len(names))
    # Where wells differ along one state only, the first of the others is as good as any.
    first, second = np.sort(np.argsort(-np.round(apart, 2), kind="stable")[:2])
    return int(first), int(second)


def drawn(landscape: Landscape, *, points: np.ndarray | None = None) -> DrawnLandscape:
    """What is drawn of a landscape in memory.

    Parameters
    ----------
    landscape
        The landscape.
    points
        Recorded states, shape ``(n, d)``; by default those to which its formulas were fitted.
    """
    dynamics = landscape.dynamics
    if points is None:
        fitted = [well.points for well in landscape.wells if well is not None]
        points = np.concatenate([np.zeros((0, dynamics.dimension)), *fitted])
    data = landscape_data(landscape, dynamics=dynamics)
    return drawn_data(data, wells=landscape.wells, dynamics=dynamics, points=points)


def drawn_data(
    data: Mapping[str, Any],
    *,
    wells: Sequence[Well | None],
    dynamics: Dynamics,
    points: np.ndarray | None = None,
    formula: SymbolicDecomposition | None = None,
) -> DrawnLandscape:
    """What is drawn of a landscape from a file.

    Parameters
    ----------
    data
        Plain data, see `siq.landscape.storage.landscape_data`.
    wells
        V about each attractor, None where there is none.
    dynamics
        f and D.
    points
        Recorded states, shape ``(n, d)``.
    formula
        With one V that holds over all wells: it is drawn in the box of the recorded states where no well
        has a formula of its own.
    """
    attractors = [np.array(one["attractor"], dtype=float) for one in data["wells"]]
    heights = np.array([_number(one["height"]) for one in data["wells"]])
    single = None if any(well is not None for well in wells) else _everywhere(formula, points)
    if single is not None and attractors:
        heights = single(np.array(attractors))
        heights = heights - np.nanmin(heights, initial=np.inf) if np.isfinite(heights).all() else heights
    matched = bool(len(heights)) and bool(np.isfinite(heights).all())
    lifts = heights if matched else np.zeros(len(attractors))
    known = [(lift, well) for lift, well in zip(lifts, wells, strict=True) if well is not None]

    def of_wells(x: np.ndarray) -> np.ndarray:
        if not known:
            return np.full(len(x), np.nan)
        return least_over_wells(np.stack([lift + 2 * well.known_values(x) for lift, well in known]))

    ways = tuple(_way(one, dynamics.dimension) for one in data["transitions"])
    cycles = tuple(_closed(one["cycle"]) for one in data["wells"] if "cycle" in one)
    parting = tuple(_closed(one) for one in data.get("parting", []))
    seen = [
        np.array(attractors),
        *cycles,
        *parting,
        *(way.uphill for way in ways if cycles or parting),  # such ways wind, and leave their wells
        *(way.saddle[None] for way in ways),
        *(well.points for _, well in known),
    ]
    if points is not None and (single is not None or not any(map(len, seen))):
        seen.append(points)
    if not any(map(len, seen)):
        seen += [np.array([one["position"]]) for one in data["equilibria"]]
    units = tuple(data.get("units") or ("1",) * dynamics.dimension)
    return DrawnLandscape(
        names=tuple(data["states"]),
        units=units,
        potential=of_wells if single is None else single,
        wells=tuple(
            DrawnPoint("cycle" if "cycle" in one else "attractor", place, float(lift), well_name(index))
            for index, (place, lift, one) in enumerate(zip(attractors, lifts, data["wells"], strict=True))
        ),
        others=_others(data, ways, lifts),
        ways=ways,
        box=_limits(
            np.concatenate([np.reshape(one, (-1, dynamics.dimension)) for one in seen]),
            margin=MARGIN if single is None else 0.0,  # which is known up to the rim
        ),
        energy_unit=SaidLandscape(data).energy_unit,
        points=points,
        formulas=tuple(wells),
        dynamics=dynamics,
        matched=matched,
        cycles=cycles,
        parting=parting,
    )


def _closed(cycle: Mapping[str, Any]) -> np.ndarray:
    points = np.array(cycle["points"], dtype=float)
    return np.vstack([points, points[:1]])


def _everywhere(formula: SymbolicDecomposition | None, points: np.ndarray | None) -> Potential | None:
    """U by one formula, within the box of the recorded states."""
    if formula is None or formula.potential is None or points is None or not len(points):
        return None
    low, high = points.min(axis=0), points.max(axis=0)

    def potential(x: np.ndarray) -> np.ndarray:
        inside = ((x >= low) & (x <= high)).all(axis=1)
        return np.where(inside, 2 * formula.evaluate(np.ascontiguousarray(x.T))[0], np.nan)

    return potential


def _way(data: Mapping[str, Any], dimension: int) -> DrawnWay:
    paths = (np.reshape(np.array(data[part] or [], dtype=float), (-1, dimension)) for part in PARTS)
    error = data.get("error", data["standard_error"])
    return DrawnWay(
        data["start"], data["end"], np.array(data["saddle"]), _number(data["barrier"]), _number(error), *paths
    )


def _others(data: Mapping[str, Any], ways: Sequence[DrawnWay], lifts: np.ndarray) -> tuple[DrawnPoint, ...]:
    """Equilibria other than the wells; a pass is as high as the lowest way over it."""
    tops: dict[tuple[float, ...], float] = {}
    for way in ways:
        key, top = tuple(way.saddle.tolist()), float(lifts[way.start] + way.barrier)
        tops[key] = top if np.isnan(tops.get(key, np.nan)) else min(top, tops[key])
    stable = {tuple(one["attractor"]) for one in data["wells"]}
    return tuple(
        DrawnPoint(one["kind"], np.array(one["position"]), tops.get(tuple(one["position"]), np.nan))
        for one in data["equilibria"]
        if tuple(one["position"]) not in stable
    )


def _limits(points: np.ndarray, *, margin: float) -> np.ndarray:
    if not len(points):
        raise ValueError("the landscape has neither wells nor equilibria: there is nothing to draw")
    low, high = points.min(axis=0), points.max(axis=0)
    room = np.where(high > low, margin * (high - low), MARGIN)
    return np.stack([low - room, high + room], axis=1)


def _number(value: float | None) -> float:
    return np.nan if value is None else float(value)


def _error_of_one_state(dynamics: Dynamics, x: np.ndarray, start: float) -> np.ndarray | None:
    """Standard error of ``U(x) - U(start) = -2 ∫ f/D dx``, to first order in the parameters of f."""
    covariance, noise = dynamics.covariance, dynamics.diffusion
    if covariance is None or len(covariance) != len(dynamics.parameters) or not noise.regular:
        return None
    values = {symbol(each.name): each.value for each in dynamics.parameters}
    slopes = [dynamics.equations[0].diff(symbol(each.name)).xreplace(values) for each in dynamics.parameters]
    if not slopes or not np.isfinite(covariance).all() or not covariance.any():
        return None
    rates = compile_formulas(slopes, dynamics.symbols)(x[None]) / noise.at(x[:, None])[:, 0, 0]
    change = -2 * cumulative_trapezoid(rates, x, axis=1, initial=0.0)
    change -= np.array([np.interp(start, x, row) for row in change])[:, None]
    return np.sqrt(np.maximum(np.einsum("pn,pq,qn->n", change, covariance, change), 0.0))
