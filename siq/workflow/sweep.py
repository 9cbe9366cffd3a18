"""Landscapes of equations along one control parameter, or over two.

A point of a sweep is the landscape at one value, without formulas of U. It knows of no noise and of no other
point, so that a change of the range, or of the noise, leaves those that there are. Of one parameter
equilibria are joined to branches by continuation (`siq.systems.continuation`), and a well is a stable stretch
of a branch that does not turn back: it ends at a fold, at a Hopf point, and where branches meet. Of two,
folds and Hopf points along rows and columns of the map are points of curves, which are followed through the
plane. Limit cycles are followed from Hopf points, and from where they were found. Times and weights follow
from barriers and prefactors for a noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import sympy
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass as pydantic_dataclass

from siq.errors import InputError, NumericalFailure, suggestion
from siq.numerics.files import read_document, validate
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.invariant_density import shares_by_rates
from siq.quasipotential.landscape import NoLandscape
from siq.quasipotential.landscape_assembly import EquationSettings, landscape_from_equations, usable_system
from siq.quasipotential.rates import EscapeRate, NoiseStrength, mean_residence_time
from siq.remarks import Remark, sentence
from siq.systems.cards import ParameterEntry, SystemCard, build_system, load_system
from siq.systems.continuation import Bifurcation, Branch, follow_branches, follow_curves
from siq.systems.cycles import Cycle
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import all_equilibria
from siq.systems.phase_portrait import MOST_SEARCHED, UNSETTLED
from siq.workflow.tables import as_table

PLAIN = ConfigDict(extra="forbid", ser_json_inf_nan="constants")


@pydantic_dataclass(frozen=True, config=PLAIN)
class _SweptWell:
    """An attractor at a point: its state, the slowest rate at which f leads back to it, a cycle's period."""

    state: tuple[float, ...]
    relaxation: float
    period: float | None = None


@pydantic_dataclass(frozen=True, config=PLAIN)
class _SweptWay:
    """A way out: wells by their place, `end` None where it leads out of the domain; barrier and prefactor."""

    start: int
    end: int | None
    barrier: float | None
    prefactor: float | None
    note: str = ""
    power: float = 0.0
    phases: tuple[tuple[float, ...], ...] | None = None

    def as_exit(self) -> EscapeRate:
        """What its time follows from."""
        barrier, prefactor = (np.nan if one is None else one for one in (self.barrier, self.prefactor))
        phases = None if self.phases is None else np.array(self.phases)
        return EscapeRate(barrier, prefactor, power=self.power, phases=phases)


@pydantic_dataclass(frozen=True, config=PLAIN)
class SweptPoint:
    """The landscape at one value of the parameters."""

    values: tuple[float, ...]  #: of the parameters, in their order
    equilibria: tuple[tuple[float, ...], ...]  #: all that were found, the unstable ones too
    wells: tuple[_SweptWell, ...] = ()  #: attractors
    ways: tuple[_SweptWay, ...] = ()  #: the ways out of them
    settled: float = 0.0  #: share of the states of the domain from which f leads to one of the wells
    reason: str = ""  #: why there is no landscape, in words; empty where there is one
    notes: tuple[str, ...] = ()  #: what could not be done, in words


def _with_parameters(
    system: str | Path | Dynamics, names: Sequence[str], values: Sequence[float]
) -> Dynamics:
    """A system with other values of some parameters, those in D included."""
    changed = dict(zip(names, map(float, values), strict=True))
    if not isinstance(system, Dynamics):
        document = read_document(system)
        card = validate(document, SystemCard)
        entries = {
            name: ParameterEntry(value=changed.get(name, entry.value), unit=entry.unit, fixed=entry.fixed)
            for name, entry in card.parameters.items()
        }
        return usable_system(build_system(document, card.model_copy(update={"parameters": entries})))
    replaced = np.array([changed.get(each.name, each.value) for each in system.parameters], dtype=float)
    at_values = system.with_values(replaced)
    for name, formula in zip(system.states, at_values.formulas, strict=True):
        if formula.has(sympy.zoo, sympy.nan, sympy.oo):
            raise InputError(
                system.name or "the system", f"equations.{name}", f"the equation of {name} has no value",
                "leave this value of the parameter out",
            )  # fmt: skip
    return usable_system(at_values)


def point_at(
    system: str | Path | Dynamics, names: Sequence[str], values: tuple[float, ...], *, seed: int = 0
) -> SweptPoint:
    """The landscape at values of the parameters; where there is none, or f has no value, the reason."""
    try:
        system = _with_parameters(system, names, values)
    except InputError as error:
        return SweptPoint(values, (), reason=f"{error.fault}; {error.remedy}")
    try:
        found = landscape_from_equations(system, EquationSettings(seed=seed), formulas=False)
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        reason = error.reason if isinstance(error, NoLandscape) else str(error)
        resting: tuple[tuple[float, ...], ...] = ()  # a branch may pass through them all the same
        with suppress(NumericalFailure, np.linalg.LinAlgError):
            if system.dimension <= MOST_SEARCHED:
                known, _ = all_equilibria(system, generator=generator(seed, Purpose.LANDSCAPE))
                resting = tuple(tuple(map(float, one.position)) for one in known)
        return SweptPoint(values, resting, reason=reason)
    return SweptPoint(
        values,
        tuple(tuple(map(float, one.position)) for one in found.equilibria),
        tuple(
            _SweptWell(
                tuple(map(float, one.position)),
                float(-one.eigenvalues.real.max()),
                one.period if isinstance(one, Cycle) else None,
            )
            for one in found.attractors
        ),
        tuple(
            _SweptWay(
                way.start,
                way.end,
                float(way.barrier) if np.isfinite(way.barrier) else None,
                None if way.rate is None else float(way.rate.prefactor),
                "; ".join(way.notes),
                way.exit.power,
                None if way.exit.phases is None else tuple(map(tuple, way.exit.phases.tolist())),
            )
            for way in found.transitions
        ),
        settled=float(found.basins.sum()),
        notes=found.notes,
    )


DIGITS = 10  # of positions in tables


def _wells_along(branches: Sequence[Branch]) -> list[np.ndarray]:
    """For each branch the well of each of its points, -1 where it is unstable; in the order of the states."""
    stretches = []
    for index, branch in enumerate(branches):
        rises = branch.tangents[:, branch.states.shape[1]] > 0
        kind = np.where(branch.unstable == 0, np.where(rises, 1, -1), 0)
        ends = [*(np.flatnonzero(np.diff(kind)) + 1), len(kind)]
        starts = [0, *ends[:-1]]
        stretches += [
            (index, first, last) for first, last in zip(starts, ends, strict=True) if kind[first] != 0
        ]

    def place(stretch: tuple[int, int, int]) -> tuple[float, ...]:
        index, first, last = stretch
        branch = branches[index]
        return tuple(np.round(branch.states[np.argmin(branch.values[first:last]) + first], 6))

    number = [np.full(len(branch.values), -1) for branch in branches]
    for well, (index, first, last) in enumerate(sorted(stretches, key=place)):
        number[index][first:last] = well
    return number


def _well_of(
    branches: Sequence[Branch], numbers: Sequence[np.ndarray], well: _SweptWell, value: float
) -> int:
    """Which well an attractor is at a value; -1 for one that is on no branch."""
    for branch, number in zip(branches, numbers, strict=True):
        place = None
        if branch.kind == "cycle" and well.period is not None:
            place = branch.index_of_cycle(np.array(well.state), value)
        elif branch.kind != "cycle" and well.period is None:
            place = branch.index_of(np.array(well.state), value)
        if place is not None:
            # Next to a fold the nearest point of the branch may lie behind it.
            neighbours = number[max(place - 1, 0) : place + 2]
            return int(number[place]) if number[place] >= 0 else int(neighbours.max())
    return -1


def _branch_rows(branches: Sequence[Branch], numbers: Sequence[np.ndarray]) -> list[dict[str, object]]:
    """The table of branches."""
    return [
        {
            "branch": index,
            "kind": branch.kind,
            "well": int(number[k]),
            "value": branch.values[k],
            "position": _position_text(branch.states[k]),
            "unstable": int(branch.unstable[k]),
            "growth": branch.eigenvalues[k, 0].real,
            "frequency": branch.frequencies[k] or abs(branch.eigenvalues[k, 0].imag),
            "least": _position_text(branch.extents[0, k]),
            "largest": _position_text(branch.extents[1, k]),
        }
        for index, (branch, number) in enumerate(zip(branches, numbers, strict=True))
        for k in range(len(branch.values))
    ]


def _position_text(state: np.ndarray | Sequence[float]) -> str:
    """A state as tables have it."""
    return str([float(f"{one:.{DIGITS}g}") for one in state])


def _seeds(
    system: Dynamics, names: tuple[str, ...], points: Sequence[SweptPoint], limits: tuple[float, float],
    along: int,
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:  # fmt: skip
    """Folds and Hopf points on all lines along one parameter."""
    other = 1 - along
    for value in sorted({point.values[other] for point in points}):
        known = [
            (point.values[along], np.array(one))
            for point in points
            if point.values[other] == value
            for one in point.equilibria
        ]
        changed = [value if each.name == names[other] else each.value for each in system.parameters]
        line = system.with_values(np.array(changed, dtype=float))
        for one in follow_branches(line, names[along], limits, known)[1]:
            if one.kind != "branch point":
                yield one.kind, np.array([one.value, value] if along == 0 else [value, one.value]), one.state


def _curve_rows(curves: Sequence[Branch]) -> list[dict[str, object]]:
    """The table of curves, a row for each of their points."""
    return [
        {
            "curve": index,
            "kind": curve.kind,
            "value": value,
            "second_value": second,
            "position": _position_text(state),
            "frequency": frequency,
        }
        for index, curve in enumerate(curves)
        for (value, second), state, frequency in zip(
            curve.values, curve.states, curve.frequencies, strict=True
        )
    ]


def _weights(point: SweptPoint, noise: float | None) -> np.ndarray:
    """Shares of time in the long run; NaN where a rate is not known, or the noise is not below a barrier."""
    count, between = len(point.wells), [way for way in point.ways if way.end is not None]
    known = noise is not None and all(way.barrier is not None and noise < way.barrier for way in between)
    # What leads elsewhere has a share of the time, too.
    if noise is None or not known or point.settled < 1 - UNSETTLED:
        return np.full(count, np.nan)
    if count == 1:
        return np.ones(1)
    listed = [(way.start, way.end, way.barrier, way.as_exit().prefactor_at(noise)) for way in between]
    return shares_by_rates(listed, count, intensity=noise)


def _exits(point: SweptPoint, index: int, number: Sequence[int], noise: float | None) -> dict[str, object]:
    """The lowest way out of a well, and its time over all ways; an infinite barrier where there is none."""
    mine = [way for way in point.ways if way.start == index]
    known = [way for way in mine if way.barrier is not None]
    if not known:
        # Beside a limit cycle, or another well, it can be left in an unknown way.
        if len(point.wells) == 1 and not point.notes and not mine:
            return {"barrier": np.inf, "note": sentence(Remark("workflow.only_stable_state"))}
        told = "; ".join(dict.fromkeys(way.note for way in mine if way.note)) or "; ".join(point.notes)
        return {"note": told or sentence(Remark("workflow.no_way_out"))}
    lowest = min(known, key=lambda way: np.inf if way.barrier is None else way.barrier)
    notes = [way.note for way in mine if way.note]
    time = mean_residence_time(
        [way.as_exit() for way in mine], None if noise is None else NoiseStrength(noise)
    )
    if noise is not None and time is None:
        notes.append(sentence(Remark("workflow.no_time_in_noise", {"noise": noise})))
    if time is not None and not time.complete:
        notes.append(sentence(Remark("workflow.exit_without_rate")))
    return {
        "barrier": lowest.barrier, "exit": None if lowest.end is None else number[lowest.end],
        "mean_time": np.nan if time is None else time.value,
        "law_error": np.nan if time is None else time.law_error, "note": "; ".join(dict.fromkeys(notes)),
    }  # fmt: skip


if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_PARAMETERS = 2


@dataclass(frozen=True, eq=False, repr=False)
class Sweep:
    """A landscape against one parameter, or two."""

    #: Their names
    parameters: tuple[str, ...]
    states: tuple[str, ...]
    #: One row for every value and well: see ``sweep`` in `siq.workflow.tables`
    table: pd.DataFrame
    #: One row for every value and way out of a well, barrier and prefactor; what `siq.probability_of_tipping`
    #: reads
    ways: pd.DataFrame
    #: Equilibria and limit cycles along their branches, stable or not; empty for two parameters
    branches: pd.DataFrame
    #: Folds, also of cycles, Hopf points and branch points; empty for two parameters
    bifurcations: pd.DataFrame
    #: What could not be done, in words
    notes: tuple[str, ...] = ()
    #: Of the states, by name; of the time as ``t``, and of the parameters by their names
    units: Mapping[str, str] = field(default_factory=dict)
    #: Of two parameters, the curves of folds and of Hopf points in their plane, a row for each point; empty
    #: for one
    curves: pd.DataFrame = field(default_factory=lambda: as_table("bifurcation_curves", []))

    def plot(self) -> Figure:
        """Equilibria, barriers and times against the parameter; of two, a map with its curves."""
        from siq.report.plots.sweep import plot_sweep

        return plot_sweep(
            self.table, self.branches, self.bifurcations, parameters=self.parameters, states=self.states,
            units=self.units, curves=self.curves,
        )  # fmt: skip

    def __repr__(self) -> str:
        """One line."""
        return f"<Sweep of {', '.join(self.parameters)}: {len(self.table.drop_duplicates('value'))} values>"


def sweep(
    system: str | Path | Dynamics, parameter: str, values: Sequence[float] | np.ndarray, *,
    second: tuple[str, Sequence[float] | np.ndarray] | None = None, noise: float | None = None, seed: int = 0,
) -> Sweep:  # fmt: skip
    """The landscape of equations against a parameter: equilibria, barriers, escape times and weights.

    Parameters
    ----------
    system
        A system card, or `siq.Dynamics` with its domain and parameters.
    parameter
        Name of the parameter.
    values
        Which values it takes, shape ``(n,)``.
    second
        Name and values of a second parameter, for a map.
    noise
        ε, in the unit of U; without it there are no times and no weights.
    seed
        Of the sequences of states that stand for the domain.

    Returns
    -------
    Sweep
        A value at which nothing was found has a row that says why.

    Raises
    ------
    InputError
        For a card that cannot be read, a system that has no landscape, and a parameter that is not there.

    Examples
    --------
    >>> import sympy
    >>> h, x = sympy.symbols("h x", real=True)
    >>> cusp = Dynamics.of((x,), (h + x - x**3,), domain=[(-2, 2)], parameters={h: 0.0})
    >>> found = sweep(cusp, "h", [0.0, 0.2, 0.5])
    >>> found.table[["value", "well", "barrier", "exit"]].round(4)
       value  well  barrier  exit
    0    0.0     0   0.5000     1
    1    0.0     1   0.5000     0
    2    0.2     0   0.1634     1
    3    0.2     1   0.9592     0
    4    0.5     1      inf  <NA>
    >>> found.bifurcations[["kind", "value"]].round(6)
       kind   value
    0  fold  0.3849
    """
    named = {parameter: np.asarray(values, dtype=float)}
    if second is not None:
        named[second[0]] = np.asarray(second[1], dtype=float)
    for name, given in named.items():
        if given.ndim != 1 or not len(given) or not np.isfinite(given).all():
            raise ValueError(f"the values of {name} have to be finite numbers, at least one")
    base = system if isinstance(system, Dynamics) else load_system(system)
    known, who = [each.name for each in base.parameters], base.name or "the system"
    for name in named:
        if name not in known:
            otherwise = f"use one of {', '.join(known)}" if known else "make the number a parameter"
            remedy = suggestion(name, known, otherwise=otherwise)
            raise InputError(who, "parameters", f"there is no parameter '{name}'", remedy)
    # Parameters in D have their values inserted.
    of_noise = sorted(set(named) & set(base.parameters_of_noise)) if isinstance(system, Dynamics) else []
    if of_noise:
        fault = f"D depends on {', '.join(of_noise)}, and was made with the value of the card"
        raise InputError(who, "diffusion", fault, "give the card instead of the dynamics")
    grid = np.stack(np.meshgrid(*named.values(), indexing="ij"), axis=-1).reshape(-1, len(named))
    names = tuple(named)
    points = [point_at(system, names, tuple(map(float, one)), seed=seed) for one in grid]
    return collected(base, names, points, noise=noise)


def collected(
    system: Dynamics, names: tuple[str, ...], points: Sequence[SweptPoint], *, noise: float | None = None
) -> Sweep:
    """Tables of all points, in any order, of one or two parameters; the system is that of any of them.

    Without noise ε there are neither times nor weights.
    """
    points = sorted(points, key=lambda point: point.values)
    remarks: list[Remark] = []
    branches: Sequence[Branch] = ()
    stretches: list[np.ndarray] = []
    bifurcations: list[Bifurcation] = []
    curves: list[Branch] = []
    values = [point.values[0] for point in points]
    if len(names) == 1 and min(values) < max(values):
        limits = (min(values), max(values))
        seeds = [(point.values[0], np.array(one)) for point in points for one in point.equilibria]
        known = [
            (point.values[0], np.array(well.state), well.period)
            for point in points
            for well in point.wells
            if well.period is not None
        ]
        branches, bifurcations, remarks = follow_branches(system, names[0], limits, seeds, cycles=known)
        stretches = _wells_along(branches)
        numbers = [
            [_well_of(branches, stretches, well, point.values[0]) for well in point.wells] for point in points
        ]
    else:
        numbers = [list(range(len(point.wells))) for point in points]
    if len(names) == MOST_PARAMETERS:
        # Curves of folds and of Hopf points that a row or a column of the map crosses, unless it is a line.
        swept = np.array([point.values for point in points])
        sides = list(zip(swept.min(axis=0).tolist(), swept.max(axis=0).tolist(), strict=True))
        if all(low < high for low, high in sides):
            begun = [one for k in range(len(names)) for one in _seeds(system, names, points, sides[k], k)]
            curves, remarks = follow_curves(system, dict(zip(names, sides, strict=True)), begun)
    notes = tuple(dict.fromkeys(map(sentence, remarks)))
    rows, ways = [], []
    for point, number in zip(points, numbers, strict=True):
        first, second = (*point.values, np.nan)[:2]
        place: dict[str, object] = {"value": first, "second_value": second}
        if not point.wells:
            note = point.reason or "; ".join(point.notes)
            rows.append(place | {"well": -1, "noise": noise, "note": note})
        weights = _weights(point, noise)
        rows += [
            place
            | {"well": number[index], "attractor": _position_text(well.state), "relaxation": well.relaxation}
            | _exits(point, index, number, noise)
            | {"noise": noise, "weight": weights[index]}
            for index, well in enumerate(point.wells)
        ]
        ways += [
            place
            | {
                "well": number[way.start],
                "exit": None if way.end is None else number[way.end],
                "barrier": way.barrier,
                "prefactor": way.prefactor,
                "relaxation": point.wells[way.start].relaxation,
                "note": way.note,
            }
            for way in point.ways
        ]
    units = dict(zip(system.states, system.units, strict=True)) | {"t": system.time_unit}
    units |= {each.name: each.unit for each in system.parameters if each.name in names}
    found = [
        {name: value for name, value in vars(one).items() if name != "state"}
        | {"position": _position_text(one.state)}
        for one in bifurcations
    ]
    return Sweep(
        names, system.states, as_table("sweep", rows), as_table("sweep_ways", ways),
        as_table("branches", _branch_rows(branches, stretches)), as_table("bifurcations", found),
        notes, units, as_table("bifurcation_curves", _curve_rows(curves)),
    )  # fmt: skip
