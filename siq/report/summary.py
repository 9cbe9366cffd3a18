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
from siq.data.states import DwellCount
from siq.numerics.text import place_text, squared
from siq.quasipotential.certificate_tests import STATED_SIGMAS
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.occupancy import VisitTest
from siq.quasipotential.rates import EscapeRate, MeanTime, NoiseStrength, mean_residence_time
from siq.quasipotential.transitions import Transition
from siq.quasipotential.wells import Well
from siq.remarks import sentence
from siq.systems.cycles import Cycle
from siq.systems.dynamics import Dynamics, symbol
from siq.systems.formulas import compile_formulas

ZERO_POSITION = 1e-6  # of the size of a state
ROOM = 0.3  # of the height of the highest saddle: shown above it
MARGIN = 0.05  # of what is shown: left free around it
BLOCK_OF_POINTS = 20_000  # evaluated at once: each has some hundred powers
NO_ESCAPE_TIME = "quasipotential.no_escape_time"


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
class _EquilibriumSummary:
    """An equilibrium that is no well, such as a saddle; U there is as high as the lowest exit over it."""

    kind: str  #: attractor, saddle, repeller or degenerate
    position: np.ndarray  #: shape (d,)
    height: float  #: U there, NaN where it is not known
    eigenvalues: tuple[complex, ...] = ()  #: of the Jacobian
    label: str = ""  #: the letter of a well; empty for others


@dataclass(frozen=True)
class WellSummary:
    """A stable state."""

    label: str  #: A, B, and so on, in the order of the attractors
    position: np.ndarray  #: of the attractor
    position_errors: np.ndarray  #: standard errors, NaN where not known
    height: float  #: U at the attractor, zero where that of all wells is not known
    basin: float  #: share of the recorded states that lead there
    depth: float  #: the lowest barrier of U out of it, NaN where none is known
    depth_error: float  #: its standard error
    beyond: str | None  #: the well behind that barrier, None where it leads out of the recorded region
    known_up_to: float  #: U up to which the formula holds, NaN where there is none
    exits: tuple[EscapeRate, ...]  #: what mean times follow from, in the order of the exits
    leverage: float = 1.0  #: relative standard error of ΔU/ε from an estimated D over that of ε
    visits: VisitTest | None = None  #: how long visits to it last, None where this was not compared
    cycle: Cycle | None = None  #: the limit cycle, None of a point

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
class LandscapeSummary:
    """Wells, exits and U of a landscape."""

    names: tuple[str, ...]  #: of the states
    units: tuple[str, ...]  #: of the states, 1 where unknown
    time_unit: str  #: of the recordings, 1 where unknown
    wells: tuple[WellSummary, ...]  #: the attractors in the order of the tables, as A, B, C and so on
    ways: tuple[Transition, ...]  #: the ways out of the wells
    noise: NoiseStrength | None  #: that drives the system, None where it is unknown
    given: bool = False  #: whether f was given as equations, and not identified from recordings
    run: int = 0  #: the run of a study whose landscape it is
    remarks: tuple[str, ...] = ()  #: what has to be known of it
    unstable_cycles: tuple[Cycle, ...] = ()  #: which part basins
    formulas: tuple[Well | None, ...] = ()  #: V about each attractor, None where there is none
    points: np.ndarray | None = None  #: recorded states, shape (n, d); there may be none
    dynamics: Dynamics | None = None  #: f and D, where a plot needs their errors
    matched: bool = True  #: whether U is known over all wells; if not, each is drawn from its own bottom
    formula: SymbolicDecomposition | None = None  #: one V over all wells, in the box of the recorded states
    equilibria: tuple[_EquilibriumSummary, ...] = ()  #: all of them, in the order in which they were found
    #: How large each state becomes, shape (d,); of states of one unit, how large any does.
    size: np.ndarray = field(default_factory=lambda: np.zeros(0))
    checked_times: pd.DataFrame | None = None  #: `siq.Landscape.verify_times` for each ε, where asked for

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
        return any(way.exit.phases is not None or math.isfinite(way.exit.prefactor) for way in self.ways)

    @property
    def no_time_reason(self) -> str:
        """Why an exit has no law of its mean time, as far as that is known."""
        remarks = (remark for way in self.ways for remark in way.remarks)
        return next((str(each.values["reason"]) for each in remarks if each.code == NO_ESCAPE_TIME), "")

    @property
    def cycles(self) -> tuple[np.ndarray, ...]:
        """Stable limit cycles, each of shape ``(n, d)`` and closed."""
        known = (well.cycle.points for well in self.wells if well.cycle is not None)
        return tuple(np.vstack([points, points[:1]]) for points in known)

    @property
    def parting(self) -> tuple[np.ndarray, ...]:
        """Unstable cycles, each of shape ``(n, d)`` and closed."""
        return tuple(np.vstack([cycle.points, cycle.points[:1]]) for cycle in self.unstable_cycles)

    def potential(self, x: np.ndarray) -> np.ndarray:
        """U at points ``(n, d)``, NaN where it is not known: shape ``(n,)``."""
        starts = range(0, max(len(x), 1), BLOCK_OF_POINTS)
        return np.concatenate([self._potential(x[start : start + BLOCK_OF_POINTS]) for start in starts])

    def _potential(self, x: np.ndarray) -> np.ndarray:
        if self.formula is not None and self.points is not None:
            low, high = self.points.min(axis=0), self.points.max(axis=0)
            return np.where(((x >= low) & (x <= high)).all(axis=1), 2 * self.formula.values(x), np.nan)
        known = [(w.height, v) for w, v in zip(self.wells, self.formulas, strict=False) if v is not None]
        if not known:
            return np.full(len(x), np.nan)
        return np.fmin.reduce(np.stack([height + 2 * v.known_values(x) for height, v in known]))

    @cached_property
    def box(self) -> np.ndarray:
        """Limits of what is drawn, shape ``(d, 2)``; a `ValueError` without wells and equilibria."""
        winding = bool(self.cycles or self.parting)  # exits wind then, and leave their wells
        seen = [
            *(well.position[None] for well in self.wells), *self.cycles, *self.parting,
            *(way.uphill for way in self.ways if winding), *(way.place[None] for way in self.ways),
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
    def others(self) -> tuple[_EquilibriumSummary, ...]:
        """The equilibria that are no wells."""
        return tuple(one for one in self.equilibria if not one.label)

    @property
    def saddles(self) -> tuple[_EquilibriumSummary, ...]:
        """Those between the wells."""
        return tuple(one for one in self.others if one.kind == "saddle")

    @property
    def marks(self) -> tuple[WellSummary | _EquilibriumSummary, ...]:
        """Wells and saddles."""
        return (*self.wells, *self.saddles)

    @property
    def top(self) -> float | None:
        """U at the highest saddle out of a well, None where none is known."""
        tops = [self.wells[way.start].height + way.barrier for way in self.ways]
        tops += [one.height for one in self.saddles] if not tops else []
        known = [top for top in tops if np.isfinite(top)]
        return max(known) if known else None

    def highest_shown(self, values: np.ndarray) -> float:
        """U up to which colours differ, or an axis reaches: somewhat above the highest saddle."""
        known = values[np.isfinite(values)]
        lowest = float(known.min()) if len(known) else 0.0
        if self.top is None or not self.top > lowest:
            return float(known.max()) if len(known) else 1.0
        return self.top + ROOM * (self.top - lowest)

    def plane(self, states: Sequence[str] | None = None) -> tuple[int, int]:
        """Places of the two states that make the plane; by default those along which the wells lie apart."""
        names = self.names
        if states is not None:
            if len(set(states)) != 2 or not set(states) <= set(names):
                raise ValueError(f"states is {list(states)}; name two of {', '.join(names)}")
            return names.index(states[0]), names.index(states[1])
        if len(names) == 2:
            return 0, 1
        width = np.ptp(self.box, axis=1)
        places = np.array([one.position for one in self.marks])
        apart = np.ptp(places, axis=0) / width if len(places) else np.zeros(len(names))
        # Where wells differ along one state only, the first of the others is as good as any.
        first, second = np.sort(np.argsort(-np.round(apart, 2), kind="stable")[:2])
        return int(first), int(second)

    def along(self, place: int, count: int) -> np.ndarray:
        """So many values of a state, evenly over what is drawn."""
        low, high = self.box[place].tolist()
        return np.linspace(low, high, count)

    def stating(self, certificate: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
        """A certificate that states no smaller error of U than barriers have, by their 95 % intervals."""
        if certificate is None or certificate["stated_error"] is None:
            return certificate
        errors = [STATED_SIGMAS * way.error / abs(way.barrier) for way in self.ways if way.barrier]
        known = [one for one in errors if math.isfinite(one)]
        return {**certificate, "stated_error": max([certificate["stated_error"], *known])}

    @property
    def lowest_saddle(self) -> np.ndarray:
        """Where the lowest saddle lies; the deepest well where there is none, or the middle."""
        known = [way for way in self.ways if np.isfinite(self.wells[way.start].height + way.barrier)]
        if known:
            return min(known, key=lambda way: self.wells[way.start].height + way.barrier).place
        places = self.saddles or self.marks or self.others
        heights = [np.inf if np.isnan(one.height) else one.height for one in places]
        return places[int(np.argmin(heights))].position if places else self.box.mean(axis=1)

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


def summarise(
    landscape: Landscape | LandscapeSummary | None, recordings: Recordings | np.ndarray | None = None, *,
    dynamics: Dynamics | None = None, formula: SymbolicDecomposition | None = None,
    record: pd.DataFrame | None = None, run: int = 0,
) -> LandscapeSummary:  # fmt: skip
    """The summary of a landscape, be it in memory or read from its file; one of a summary is itself.

    Parameters
    ----------
    landscape
        None where recordings led to none.
    recordings
        Recorded states, or an array ``(n, d)`` of them; by default those that the landscape was fitted to.
    dynamics
        f and D, where there is no landscape.
    formula
        With one V over all wells: it counts in the box of the recorded states where no well has its own.
    record, run
        Visits to the wells by run, the table of that name, and the run of the landscape.
    """
    if isinstance(landscape, LandscapeSummary):
        return landscape
    points = recordings.values if isinstance(recordings, Recordings) else recordings
    if landscape is None:
        assert isinstance(recordings, Recordings)  # which have names and units
        units, time_unit = tuple(unit or "1" for unit in recordings.units), recordings.time_unit or "1"
        return LandscapeSummary(
            tuple(recordings.names), units, time_unit, (), (), None, points=points, dynamics=dynamics,
            matched=False, formula=None if formula is None or formula.potential is None else formula,
        )  # fmt: skip
    dynamics = landscape.dynamics
    if isinstance(recordings, Recordings) and recordings.names != dynamics.states:
        raise ValueError(
            f"the recordings have the states {', '.join(recordings.names)}, and the landscape has"
            f" {', '.join(dynamics.states)}"
        )
    fitted = [well.points for well in landscape.wells if well is not None]
    if points is None:
        points = np.concatenate([np.zeros((0, dynamics.dimension)), *fitted])
    if fitted or not len(points) or (formula is not None and formula.potential is None):
        formula = None
    units, attractors = tuple(dynamics.units), landscape.attractors
    heights = landscape.heights
    if formula is not None and attractors:
        places = np.array([one.position for one in attractors])
        low, high = points.min(axis=0), points.max(axis=0)
        inside = ((places >= low) & (places <= high)).all(axis=1)
        heights = np.where(inside, 2 * formula.values(places), np.nan)
        heights = heights - heights.min() if np.isfinite(heights).all() else heights
    matched = bool(len(heights)) and bool(np.isfinite(heights).all())
    heights = heights if matched else np.zeros(len(attractors))
    ways = landscape.transitions
    extent = [one.position[None] for one in (*landscape.equilibria, *attractors)]
    extent += [one.points for one in attractors if isinstance(one, Cycle)]
    size = np.abs(np.concatenate([*extent, *fitted, np.zeros((1, dynamics.dimension))])).max(axis=0)
    # In units of the largest state where all have the same, or a state that is zero has no size.
    size = size if len(set(units)) > 1 else np.full(dynamics.dimension, size.max())
    tops: dict[tuple[float, ...], float] = {}
    for way in ways:
        key, top = tuple(way.place.tolist()), float(heights[way.start] + way.barrier)
        tops[key] = top if np.isnan(tops.get(key, np.nan)) else min(top, tops[key])
    letters = {tuple(one.position.tolist()): well_name(index) for index, one in enumerate(attractors)}
    equilibria = tuple(
        _EquilibriumSummary(
            one.kind, one.position, tops.get(place, np.nan), tuple(one.eigenvalues.tolist()),
            letters.get(place, ""),
        )
        for one in landscape.equilibria
        for place in [tuple(one.position.tolist())]
    )  # fmt: skip
    visits = {one.well: one for one in landscape.visits}
    if record is not None:  # the table of a study
        rows = {str(row["attractor"]): row for row in record[record["run"] == run].to_dict("records")}
        texts = (place_text(one.position) for one in attractors)
        visits = {index: visits_of(rows[place]) for index, place in enumerate(texts) if place in rows}
    return LandscapeSummary(
        names=tuple(symbol.name for symbol in dynamics.symbols), units=units, time_unit=dynamics.time_unit,
        wells=tuple(
            _well(landscape, index, float(heights[index]), size, visits.get(index))
            for index in range(len(attractors))
        ),
        ways=ways, noise=landscape.noise, given=landscape.given, checked_times=landscape.checked_times,
        run=run, remarks=tuple(map(sentence, landscape.remarks)), unstable_cycles=landscape.parting,
        formulas=landscape.wells, points=points, dynamics=dynamics, matched=matched, formula=formula,
        equilibria=equilibria, size=size,
    )  # fmt: skip


def visits_of(row: Mapping[Any, Any]) -> VisitTest:
    """Visits to a well from a row of the table ``record``."""
    return VisitTest(
        -1, DwellCount(int(row["held_out_visits"]), row["held_out_time"]),
        DwellCount(int(row["visits"]), row["time"]), row["predicted"],
        row["predicted_error"] / row["predicted"], str(row["method"]), row["probability"],
    )  # fmt: skip


def _well(
    landscape: Landscape, index: int, height: float, size: np.ndarray, visits: VisitTest | None
) -> WellSummary:
    attractor, formula = landscape.attractors[index], landscape.wells[index]
    errors = landscape.position_errors
    ways = [way for way in landscape.transitions if way.start == index and math.isfinite(way.barrier)]
    lowest = min(ways, key=lambda way: way.barrier, default=None)
    place, known = settled(attractor.position, np.nan if errors is None else errors[index], size)
    return WellSummary(
        label=well_name(index), position=place, position_errors=known, height=height,
        basin=float(landscape.basins[index]), depth=math.nan if lowest is None else lowest.barrier,
        depth_error=math.nan if lowest is None else lowest.error,
        beyond=None if lowest is None or lowest.end is None else well_name(lowest.end),
        known_up_to=math.nan if formula is None else 2 * formula.level, exits=tuple(landscape.exits(index)),
        leverage=1.0 if lowest is None else lowest.leverage, visits=visits,
        cycle=attractor if isinstance(attractor, Cycle) else None,
    )  # fmt: skip


def settled(position: Any, errors: Any, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A position without what rounding left of zero, and its errors; `size` is that of each state."""
    position, errors = np.array(position, dtype=float), np.broadcast_to(errors, np.shape(position))
    nothing = np.hypot(position, np.nan_to_num(errors)) < ZERO_POSITION * size
    return np.where(nothing, 0.0, position), np.where(nothing, 0.0, errors)
