"""A landscape as it is told and drawn: wells by letters, units, errors and times.

Figures and the interactive view start from here, whether the landscape is in memory, in a file, or known as
one formula alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.integrate import cumulative_trapezoid

from siq.numerics.text import squared
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.quasipotential.landscape import Landscape, least_over_wells
from siq.quasipotential.landscape_files import exits_of, landscape_data
from siq.quasipotential.rates import Exit, MeanTime, NoiseStrength, dwell_time
from siq.quasipotential.wells import Well
from siq.systems.dynamics import Dynamics, symbol
from siq.systems.formulas import compile_formulas

NOTHING = 1e-6  # of the size of a state


@dataclass(frozen=True)
class SaidVisits:
    """How long visits to a well last, in the unit of time.

    Attributes
    ----------
    count
        How many were seen to end on the recordings.
    counted, lowest, highest
        Their mean with its interval of 95 %; NaN where it is not known.
    predicted, error
        The same mean as f and D say, with its standard error.
    method
        ``operator`` of Fokker and Planck, or ``law`` of Eyring and Kramers.
    """

    count: int
    counted: float
    lowest: float
    highest: float
    predicted: float
    error: float
    method: str


@dataclass(frozen=True)
class SaidWell:
    """A stable state as it is told.

    Attributes
    ----------
    name
        A, B, and so on, in the order of the attractors.
    position, position_errors
        Of the attractor, with standard errors, NaN where not known.
    basin
        Share of the recorded states that lead there.
    depth, depth_error
        The lowest barrier of U out of it, NaN where none is known.
    beyond
        The name of the well behind that barrier, None where it leads out of the recorded region.
    known_up_to
        U up to which the formula holds, NaN where there is none.
    time
        How long the well lasts, None where not known.
    leverage
        Relative standard error of ΔU/ε from an estimated D over that of ε.
    visits
        How long visits to it last, None where this was not compared.
    cycle
        Of a limit cycle, its states, shape ``(n, d)``; None of a point.
    period
        Of a limit cycle, NaN of a point.
    multipliers
        Its Floquet multipliers.
    """

    name: str
    position: np.ndarray
    position_errors: np.ndarray
    basin: float
    depth: float
    depth_error: float
    beyond: str | None
    known_up_to: float
    time: MeanTime | None
    leverage: float = 1.0
    visits: SaidVisits | None = None
    cycle: np.ndarray | None = None
    period: float = math.nan
    multipliers: tuple[complex, ...] = ()


@dataclass(frozen=True)
class SaidLandscape:
    """A landscape as it is told, from plain data."""

    data: Mapping[str, Any]

    @property
    def states(self) -> list[str]:
        """Names of the states."""
        return list(self.data["states"])

    @property
    def units(self) -> list[str]:
        """Of each state, ``1`` where nobody said."""
        return list(self.data.get("units") or ["1"] * len(self.states))

    @property
    def time_unit(self) -> str:
        """Of the recordings, ``1`` where nobody said."""
        return str(self.data.get("time_unit") or "1")

    @property
    def energy_unit(self) -> str:
        """Unit of U and of ε.

        D is read as a matrix of ratios, so that U is in the states' unit squared per time. Of states of
        different units D carries the units, and U is a number.
        """
        if len(set(self.units)) > 1:
            return ""
        length, time = squared(self.units[0]), "" if self.time_unit == "1" else self.time_unit
        if not length:
            return f"{time}^-1" if time else ""
        return f"{length}/{time}" if time else length

    @property
    def given(self) -> bool:
        """Whether f was given as equations, and not identified from recordings."""
        return bool(self.data.get("given"))

    @property
    def region(self) -> str:
        """What the landscape is of: where states were recorded, or the domain of the equations."""
        return "domain" if self.given else "recorded region"

    @property
    def noise(self) -> NoiseStrength | None:
        """That drives the system, None where nobody knows it."""
        noise = self.data.get("noise")
        return None if noise is None else NoiseStrength(**noise)

    @cached_property
    def size(self) -> np.ndarray:
        """How large each state becomes, shape ``(d,)``: what is 10⁻⁶ of it, with its error, reads as zero."""
        places = [one["position"] for one in self.data["equilibria"]]
        places += [one["attractor"] for one in self.data["wells"]]
        places += [place for one in self.data["wells"] if "cycle" in one for place in one["cycle"]["points"]]
        for one in self.data["wells"]:
            places += (one.get("V") or {}).get("points", [])
        return np.abs(np.array(places, dtype=float).reshape(-1, len(self.states))).max(axis=0, initial=0.0)

    def settled(self, position: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A position without what rounding left of zero, and its errors."""
        # In units of the largest state where all states have the same, or a state that is zero has no size.
        size = self.size if len(set(self.units)) > 1 else np.full(len(self.states), self.size.max())
        nothing = np.hypot(position, np.nan_to_num(errors)) < NOTHING * size
        return np.where(nothing, 0.0, position), np.where(nothing, 0.0, errors)

    @cached_property
    def wells(self) -> list[SaidWell]:
        """Every stable state."""
        return [self._well(index, one) for index, one in enumerate(self.data["wells"])]

    def exits(self, well: int) -> list[Exit]:
        """What the times out of a well follow from; of a barrier that nobody knows, NaN."""
        return exits_of(self.data, well)

    def dwell_time(self, well: int, noise: NoiseStrength | None) -> MeanTime | None:
        """How long a well lasts under some noise."""
        return dwell_time(self.exits(well), noise)

    def _well(self, index: int, one: Mapping[str, Any]) -> SaidWell:
        ways = [
            way for way in self.data["transitions"] if way["start"] == index and way["barrier"] is not None
        ]
        lowest = min(ways, key=lambda way: way["barrier"], default=None)
        place = np.array(one["attractor"], dtype=float)
        errors = one.get("standard_errors")
        known = np.full(len(place), np.nan) if errors is None else np.array([_float(each) for each in errors])
        place, known = self.settled(place, known)
        formula, cycle = one.get("V"), one.get("cycle")
        return SaidWell(
            well_name(index),
            place,
            known,
            float(one["basin"]),
            math.nan if lowest is None else lowest["barrier"],
            math.nan if lowest is None else _float(lowest.get("error", lowest["standard_error"])),
            None if lowest is None or lowest["end"] is None else well_name(lowest["end"]),
            math.nan if formula is None else 2 * float(formula.get("depth") or formula["level"]),
            self.dwell_time(index, self.noise),
            1.0 if lowest is None else lowest.get("noise_leverage", 1.0),
            self._visits(index),
            None if cycle is None else np.array(cycle["points"]),
            math.nan if cycle is None else float(cycle["period"]),
            () if cycle is None else tuple(complex(*value) for value in cycle["multipliers"]),
        )

    def _visits(self, well: int) -> SaidVisits | None:
        one = next((each for each in self.data.get("visits") or [] if each["well"] == well), None)
        if one is None:
            return None
        return SaidVisits(
            int(one["visits"]), _float(one["counted"]), _float(one["lowest"]), _float(one["highest"]),
            _float(one["predicted"]), _float(one["error"]), str(one["method"]),
        )  # fmt: skip

    def relative_depth(self, well: SaidWell) -> tuple[float, float]:
        """ΔU/ε with its standard error, NaN where no noise is known."""
        if self.noise is None or not math.isfinite(well.depth):
            return math.nan, math.nan
        ratio = well.depth / self.noise.intensity
        of_noise = well.leverage * self.noise.standard_error / self.noise.intensity
        parts = (well.depth_error / well.depth, of_noise)
        return ratio, abs(ratio) * float(np.sqrt(np.nansum(np.square(parts))))


def _float(value: float | None) -> float:
    return math.nan if value is None else float(value)


def well_name(index: int) -> str:
    """A, B, … Z, A1, B1, … by the place of the attractor.

    Examples
    --------
    >>> [well_name(index) for index in (0, 1, 26)]
    ['A', 'B', 'A1']
    """
    letter, round_ = chr(ord("A") + index % 26), index // 26
    return letter + (str(round_) if round_ else "")


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
        Plain data, see `siq.quasipotential.landscape_files.landscape_data`.
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
