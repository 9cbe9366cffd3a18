"""The summary of a landscape: what the page of a study, `siq.Landscape.report`, the terminal and plots read.

A landscape in memory and its file give the same summary. Wells have letters, positions with errors, depths
ΔU with errors, mean residence times and, where it was compared, how long visits to them last; exits have
barriers and paths. U is a function of points, known where a formula about a well holds, and over all wells
where their heights are known: ``U(x) = min_i (W_i + 2 V_i(x))``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from scipy.integrate import cumulative_trapezoid

from siq.data.recordings import Recordings
from siq.numerics.text import place_text, squared
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.quasipotential.landscape import Landscape, least_over_wells
from siq.quasipotential.landscape_files import landscape_data
from siq.quasipotential.rates import (
    EnergyLossPerCycle,
    EscapeRate,
    MeanTime,
    NoiseStrength,
    mean_residence_time,
)
from siq.quasipotential.wells import Well
from siq.remarks import Remark
from siq.report.remarks import sentence
from siq.systems.cycles import Cycle
from siq.systems.dynamics import Dynamics, symbol
from siq.systems.formulas import compile_formulas

ZERO_POSITION = 1e-6  # of the size of a state
MARGIN = 0.05  # of what is shown: left free around it
BLOCK_OF_POINTS = 20_000  # evaluated at once: each has some hundred powers


def well_name(index: int) -> str:
    """A, B, … Z, A1, B1, … by the place of the attractor.

    Examples
    --------
    >>> [well_name(index) for index in (0, 1, 26)]
    ['A', 'B', 'A1']
    """
    letter, round_ = chr(ord("A") + index % 26), index // 26
    return letter + (str(round_) if round_ else "")


def energy_unit(units: Sequence[str], time_unit: str) -> str:
    """Unit of U and of ε.

    D is read as a matrix of ratios, so that U is in the states' unit squared per time. Of states of different
    units D carries the units, and U is a number.
    """
    if len(set(units)) > 1:
        return ""
    length, time = squared(units[0]), "" if time_unit == "1" else time_unit
    if not length:
        return f"{time}^-1" if time else ""
    return f"{length}/{time}" if time else length


@dataclass(frozen=True)
class VisitSummary:
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
class EquilibriumSummary:
    """An equilibrium that is no well, such as a saddle; U there is as high as the lowest exit over it.

    Attributes
    ----------
    kind
        ``attractor``, ``saddle``, ``repeller`` or ``degenerate``.
    position
        Shape ``(d,)``.
    height
        U there, NaN where it is not known.
    eigenvalues
        Of the Jacobian.
    label
        The letter of a well; empty for others.
    """

    kind: str
    position: np.ndarray
    height: float
    eigenvalues: tuple[complex, ...] = ()
    label: str = ""


@dataclass(frozen=True)
class WellSummary:
    """A stable state.

    Attributes
    ----------
    label
        A, B, and so on, in the order of the attractors.
    position, position_errors
        Of the attractor, with standard errors, NaN where not known.
    height
        U at the attractor, zero where that of all wells is not known.
    basin
        Share of the recorded states that lead there.
    depth, depth_error
        The lowest barrier of U out of it, NaN where none is known.
    beyond
        The name of the well behind that barrier, None where it leads out of the recorded region.
    known_up_to
        U up to which the formula holds, NaN where there is none.
    exits
        What mean times follow from, in the order of the exits.
    leverage
        Relative standard error of ΔU/ε from an estimated D over that of ε.
    visits
        How long visits to it last, None where this was not compared.
    cycle
        The limit cycle, None of a point.
    """

    label: str
    position: np.ndarray
    position_errors: np.ndarray
    height: float
    basin: float
    depth: float
    depth_error: float
    beyond: str | None
    known_up_to: float
    exits: tuple[EscapeRate, ...]
    leverage: float = 1.0
    visits: VisitSummary | None = None
    cycle: Cycle | None = None

    @property
    def kind(self) -> str:
        """``attractor`` or ``cycle``."""
        return "attractor" if self.cycle is None else "cycle"

    def time(self, noise: NoiseStrength | None) -> MeanTime | None:
        """The mean residence time under some noise, None where it is not known."""
        return mean_residence_time(self.exits, noise)

    def relative_depth(self, noise: NoiseStrength | None) -> tuple[float, float]:
        """ΔU/ε with its standard error, NaN where no noise is known."""
        if noise is None or not math.isfinite(self.depth):
            return math.nan, math.nan
        ratio = self.depth / noise.intensity
        parts = (self.depth_error / self.depth, self.leverage * noise.standard_error / noise.intensity)
        return ratio, abs(ratio) * float(np.sqrt(np.nansum(np.square(parts))))


@dataclass(frozen=True)
class ExitSummary:
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
    law
        What its mean time follows from.
    minimum_action
        That of the path alone, None where there is no path.
    remarks
        What has to be known of it.
    no_time_reason
        Why there is no law of its mean time; empty where there is one.
    period
        Of the unstable cycle that takes the place of the saddle, NaN of a saddle.
    """

    start: int
    end: int | None
    saddle: np.ndarray
    barrier: float
    standard_error: float
    uphill: np.ndarray
    downhill: np.ndarray
    law: EscapeRate
    minimum_action: float | None = None
    remarks: tuple[str, ...] = ()
    no_time_reason: str = ""
    period: float = math.nan


@dataclass(frozen=True)
class LandscapeSummary:
    """Wells, exits and U of a landscape.

    Main attributes
    ---------------
    names, units
        Of the states, ``1`` where nobody said.
    time_unit
        Of the recordings, likewise.
    wells
        The attractors in the order of the tables, as A, B, C and so on.
    ways
        The ways out of the wells.
    others
        The equilibria that are no wells.
    noise
        That drives the system, None where nobody knows it.

    Other attributes
    ----------------
    given
        Whether f was given as equations, and not identified from recordings.
    run
        The run of a study whose landscape it is.
    remarks
        What has to be known of it.
    unstable_cycles
        Which part basins.
    formulas
        V about each attractor, None where there is none.
    points
        Recorded states, shape ``(n, d)``; there may be none.
    dynamics
        f and D, where a plot needs their errors.
    matched
        Whether U is known over all wells; otherwise each well is drawn from its own bottom.
    formula
        One V over all wells, within the box of the recorded states; None where wells have their own.
    equilibria
        All of them, in the order in which they were found.
    size
        How large each state becomes, shape ``(d,)``; of states of one unit, how large any does.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    time_unit: str
    wells: tuple[WellSummary, ...]
    ways: tuple[ExitSummary, ...]
    others: tuple[EquilibriumSummary, ...]
    noise: NoiseStrength | None
    given: bool = False
    run: int = 0
    remarks: tuple[str, ...] = ()
    unstable_cycles: tuple[Cycle, ...] = ()
    formulas: tuple[Well | None, ...] = ()
    points: np.ndarray | None = None
    dynamics: Dynamics | None = None
    matched: bool = True
    formula: SymbolicDecomposition | None = None
    equilibria: tuple[EquilibriumSummary, ...] = ()
    size: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def energy_unit(self) -> str:
        """Unit of U and of ε; empty where it has no name."""
        return energy_unit(self.units, self.time_unit)

    @property
    def region(self) -> str:
        """The region that the landscape is of."""
        return "domain" if self.given else "recorded region"

    @property
    def has_times(self) -> bool:
        """Whether some exit has a law of its mean time."""
        return any(math.isfinite(way.law.prefactor) for way in self.ways)

    @property
    def no_time_reason(self) -> str:
        """Why an exit has no law of its mean time, as far as that is known."""
        return next((way.no_time_reason for way in self.ways if way.no_time_reason), "")

    @property
    def cycles(self) -> tuple[np.ndarray, ...]:
        """Stable limit cycles, each of shape ``(n, d)`` and closed."""
        return tuple(_closed(well.cycle) for well in self.wells if well.cycle is not None)

    @property
    def parting(self) -> tuple[np.ndarray, ...]:
        """Unstable cycles, likewise."""
        return tuple(_closed(cycle) for cycle in self.unstable_cycles)

    def potential(self, x: np.ndarray) -> np.ndarray:
        """U at points ``(n, d)``, NaN where it is not known: shape ``(n,)``."""
        if self.formula is not None and self.points is not None:
            low, high = self.points.min(axis=0), self.points.max(axis=0)
            inside = ((x >= low) & (x <= high)).all(axis=1)
            return np.where(inside, 2 * self.formula.evaluate(np.ascontiguousarray(x.T))[0], np.nan)
        known = [(w.height, v) for w, v in zip(self.wells, self.formulas, strict=False) if v is not None]
        if not known:
            return np.full(len(x), np.nan)
        return least_over_wells(np.stack([height + 2 * v.known_values(x) for height, v in known]))

    @cached_property
    def box(self) -> np.ndarray:
        """Limits of what is drawn, shape ``(d, 2)``.

        Raises
        ------
        ValueError
            When there are neither wells nor equilibria.
        """
        winding = bool(self.cycles or self.parting)  # exits wind then, and leave their wells
        seen = [
            *(well.position[None] for well in self.wells), *self.cycles, *self.parting,
            *(way.uphill for way in self.ways if winding), *(way.saddle[None] for way in self.ways),
            *(well.points for well in self.formulas if well is not None),
        ]  # fmt: skip
        if self.points is not None and (self.formula is not None or not any(map(len, seen))):
            seen.append(self.points)
        if not any(map(len, seen)):
            seen += [one.position[None] for one in self.others]
        if not any(map(len, seen)):
            raise ValueError("the landscape has neither wells nor equilibria: there is nothing to draw")
        points = np.concatenate([one for one in seen if len(one)])
        low, high = points.min(axis=0), points.max(axis=0)
        margin = MARGIN if self.formula is None else 0.0  # one formula is known up to the rim
        room = np.where(high > low, margin * (high - low), MARGIN)
        return np.stack([low - room, high + room], axis=1)

    @property
    def saddles(self) -> tuple[EquilibriumSummary, ...]:
        """Those between the wells."""
        return tuple(one for one in self.others if one.kind == "saddle")

    @property
    def marks(self) -> tuple[WellSummary | EquilibriumSummary, ...]:
        """Wells and saddles."""
        return (*self.wells, *self.saddles)

    @property
    def top(self) -> float | None:
        """U at the highest saddle out of a well, None where none is known."""
        tops = [self.wells[way.start].height + way.barrier for way in self.ways]
        tops += [one.height for one in self.saddles] if not tops else []
        known = [top for top in tops if np.isfinite(top)]
        return max(known) if known else None

    def along(self, place: int, count: int) -> np.ndarray:
        """So many values of a state, evenly over what is drawn."""
        low, high = self.box[place].tolist()
        return np.linspace(low, high, count)

    @property
    def lowest_pass(self) -> np.ndarray:
        """Where the lowest saddle lies; the deepest well where there is none."""
        known = [way for way in self.ways if np.isfinite(self.wells[way.start].height + way.barrier)]
        if known:
            return min(known, key=lambda way: self.wells[way.start].height + way.barrier).saddle
        places = self.saddles or self.marks or self.others
        heights = [np.inf if np.isnan(one.height) else one.height for one in places]
        return places[int(np.argmin(heights))].position

    def standard_error(self, x: np.ndarray) -> np.ndarray | None:
        """Standard error of U of one state at ``(n,)``, against the deepest well; None where not known.

        It is that of ``U(x) - U(start) = -2 ∫ f/D dx``, to first order in the parameters of f.
        """
        dynamics = self.dynamics
        if dynamics is None or len(self.names) > 1 or not self.wells or not self.matched:
            return None
        covariance, noise = dynamics.covariance, dynamics.diffusion
        if covariance is None or len(covariance) != len(dynamics.parameters) or not noise.regular:
            return None
        values = {symbol(each.name): each.value for each in dynamics.parameters}
        slopes = [dynamics.equations[0].diff(name).xreplace(values) for name in values]
        if not slopes or not np.isfinite(covariance).all() or not covariance.any():
            return None
        start = min(self.wells, key=lambda one: np.nan_to_num(one.height, nan=np.inf)).position[0]
        rates = compile_formulas(slopes, dynamics.symbols)(x[None]) / noise.at(x[:, None])[:, 0, 0]
        change = -2 * cumulative_trapezoid(rates, x, axis=1, initial=0.0)
        change -= np.array([np.interp(float(start), x, row) for row in change])[:, None]
        return np.sqrt(np.maximum(np.einsum("pn,pq,qn->n", change, covariance, change), 0.0))


def chosen_states(landscape: LandscapeSummary, states: Sequence[str] | None) -> tuple[int, int]:
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
    places = np.array([one.position for one in landscape.marks])
    apart = np.ptp(places, axis=0) / width if len(places) else np.zeros(len(names))
    # Where wells differ along one state only, the first of the others is as good as any.
    first, second = np.sort(np.argsort(-np.round(apart, 2), kind="stable")[:2])
    return int(first), int(second)


def summarise(
    landscape: Landscape | Mapping[str, Any] | None,
    recordings: Recordings | np.ndarray | None = None,
    *,
    dynamics: Dynamics | None = None,
    formula: SymbolicDecomposition | None = None,
    record: pd.DataFrame | None = None,
) -> LandscapeSummary:
    """The summary of a landscape in memory, of its file, or of its plain data.

    Parameters
    ----------
    landscape
        The landscape, or the content of its file alone, without formulas; None where recordings led to none.
    recordings
        Recorded states, or an array ``(n, d)`` of them; by default those that a landscape was fitted to.
    dynamics
        f and D, of a landscape from a file.
    formula
        With one V that holds over all wells: it counts in the box of the recorded states where no well has a
        formula of its own.
    record
        Visits to the wells by run, the table of that name.
    """
    points = recordings.values if isinstance(recordings, Recordings) else recordings
    wells: tuple[Well | None, ...] = ()
    if isinstance(landscape, Landscape):
        dynamics, wells = landscape.dynamics, landscape.wells
        if points is None:
            fitted = [well.points for well in wells if well is not None]
            points = np.concatenate([np.zeros((0, dynamics.dimension)), *fitted])
        data: Mapping[str, Any] = landscape_data(landscape)
    elif landscape is None:
        assert isinstance(recordings, Recordings)  # which have names and units
        data = {"states": recordings.names, "units": [unit or "1" for unit in recordings.units]}
        data |= {"time_unit": recordings.time_unit, "wells": [], "equilibria": [], "transitions": []}
    else:
        data = landscape
    if any(well is not None for well in wells) or (formula is not None and formula.potential is None):
        formula = None
    if points is None or not len(points):
        formula = None
    names = tuple(data["states"])
    units = tuple(data.get("units") or ("1",) * len(names))
    attractors = [np.array(one["attractor"], dtype=float) for one in data["wells"]]
    heights = np.array([_number(one.get("height")) for one in data["wells"]])
    if formula is not None and attractors:
        heights = 2 * formula.evaluate(np.ascontiguousarray(np.array(attractors).T))[0]
        assert points is not None  # or there is no formula
        low, high = points.min(axis=0), points.max(axis=0)
        outside = [bool((place < low).any() or (place > high).any()) for place in attractors]
        heights = np.where(outside, np.nan, heights)
        heights = heights - heights.min() if np.isfinite(heights).all() else heights
    matched = bool(len(heights)) and bool(np.isfinite(heights).all())
    heights = heights if matched else np.zeros(len(attractors))
    ways = _ways(data, len(names))
    places = [one["position"] for one in data["equilibria"]]
    for one in data["wells"]:
        cycle, of_fit = one.get("cycle") or {}, one.get("V") or {}
        places += [one["attractor"], *cycle.get("points", ()), *of_fit.get("points", ())]
    size = np.abs(np.array(places, dtype=float).reshape(-1, len(names))).max(axis=0, initial=0.0)
    # In units of the largest state where all have the same, or a state that is zero has no size.
    size = size if len(set(units)) > 1 else np.full(len(names), size.max())
    tops: dict[tuple[float, ...], float] = {}
    for way in ways:
        key, top = tuple(way.saddle.tolist()), float(heights[way.start] + way.barrier)
        tops[key] = top if np.isnan(tops.get(key, np.nan)) else min(top, tops[key])
    letters = {tuple(one["attractor"]): well_name(index) for index, one in enumerate(data["wells"])}
    equilibria = tuple(
        EquilibriumSummary(
            one["kind"], np.array(one["position"], dtype=float), tops.get(tuple(one["position"]), np.nan),
            tuple(complex(*value) for value in one.get("eigenvalues", ())),
            letters.get(tuple(one["position"]), ""),
        )
        for one in data["equilibria"]
    )  # fmt: skip
    noise = data.get("noise")
    return LandscapeSummary(
        names=names,
        units=units,
        time_unit=str(data.get("time_unit") or "1"),
        wells=tuple(
            _well(data, index, float(height), [way for way in ways if way.start == index], size, record)
            for index, height in enumerate(heights)
        ),
        ways=ways,
        others=tuple(one for one in equilibria if not one.label),
        noise=None if noise is None else NoiseStrength(**noise),
        given=bool(data.get("given")),
        run=int(data.get("run", 0)),
        remarks=_sentences(data.get("remarks", ())),
        unstable_cycles=tuple(_cycle(one) for one in data.get("parting", ())),
        formulas=tuple(wells),
        points=points,
        dynamics=dynamics,
        matched=matched,
        formula=formula,
        equilibria=equilibria,
        size=size,
    )


def _well(
    data: Mapping[str, Any],
    index: int,
    height: float,
    ways: Sequence[ExitSummary],
    size: np.ndarray,
    record: pd.DataFrame | None,
) -> WellSummary:
    one = data["wells"][index]
    lowest = min((w for w in ways if math.isfinite(w.barrier)), key=lambda way: way.barrier, default=None)
    errors, formula = one.get("standard_errors"), one.get("V")
    known = np.full(len(size), np.nan) if errors is None else np.array([_number(each) for each in errors])
    place, known = settled(one["attractor"], known, size)
    seen = next((each for each in data.get("visits") or () if each["well"] == index), None)
    if record is not None:
        mine = record[
            (record["run"] == data["run"]) & (record["attractor"] == place_text(one["attractor"]))
        ].to_dict("records")
        seen = {str(key): value for key, value in mine[-1].items()} if mine else None
        seen = None if seen is None else seen | {"error": seen["predicted_error"]}
    return WellSummary(
        label=well_name(index),
        position=place,
        position_errors=known,
        height=height,
        basin=float(one["basin"]),
        depth=math.nan if lowest is None else lowest.barrier,
        depth_error=math.nan if lowest is None else lowest.standard_error,
        beyond=None if lowest is None or lowest.end is None else well_name(lowest.end),
        known_up_to=math.nan if formula is None else 2 * float(formula.get("depth") or formula["level"]),
        exits=tuple(way.law for way in ways),
        leverage=1.0 if lowest is None else lowest.law.leverage,
        visits=None
        if seen is None
        else VisitSummary(
            count=int(seen["visits"]),
            counted=_number(seen["counted"]),
            lowest=_number(seen["lowest"]),
            highest=_number(seen["highest"]),
            predicted=_number(seen["predicted"]),
            error=_number(seen["error"]),
            method=str(seen["method"]),
        ),
        cycle=_cycle(one["cycle"]) if "cycle" in one else None,
    )


def _ways(data: Mapping[str, Any], dimension: int) -> tuple[ExitSummary, ...]:
    def path(points: Any) -> np.ndarray:
        return np.reshape(np.array(points or [], dtype=float), (-1, dimension))

    return tuple(
        ExitSummary(
            start=one["start"],
            end=one["end"],
            saddle=np.array(one["saddle"], dtype=float),
            barrier=_number(one["barrier"]),
            standard_error=_number(one.get("error", one["standard_error"])),
            uphill=path(one.get("uphill")),
            downhill=path(one.get("downhill")),
            law=EscapeRate(
                _number(one["barrier"]),
                _number(one["prefactor"]),
                turn=EnergyLossPerCycle(**one["turn"]) if one.get("turn") else None,
                standard_error=_number(one.get("error", one["standard_error"])),
                prefactor_error=one.get("prefactor_error"),
                covariance=one.get("prefactor_covariance", 0.0),
                leverage=one.get("noise_leverage", 1.0),
            ),
            minimum_action=one["minimum_action"],
            remarks=_sentences(one["remarks"]),
            no_time_reason="".join(
                each["values"]["reason"]
                for each in one["remarks"]
                if each["code"] == "quasipotential.no_escape_time"
            ),
            period=_number(one.get("over_cycle")),
        )
        for one in data["transitions"]
    )


def settled(position: Any, errors: Any, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A position without what rounding left of zero, and its errors; `size` is that of each state."""
    position, errors = np.array(position, dtype=float), np.broadcast_to(errors, np.shape(position))
    nothing = np.hypot(position, np.nan_to_num(errors)) < ZERO_POSITION * size
    return np.where(nothing, 0.0, position), np.where(nothing, 0.0, errors)


def _cycle(data: Mapping[str, Any]) -> Cycle:
    multipliers = np.array([complex(*value) for value in data["multipliers"]])
    return Cycle(np.array(data["points"], dtype=float), float(data["period"]), multipliers)


def _sentences(remarks: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    return tuple(sentence(Remark.from_data(one)) for one in remarks)


def _closed(cycle: Cycle) -> np.ndarray:
    return np.vstack([cycle.points, cycle.points[:1]])


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
