"""Control parameters: the landscape of equations against one parameter, or two.

Points (`siq.steps.sweep_points`) become tables here: equilibria are joined to branches by continuation
(`siq.dynamics.continuation`), a well is a stable stretch of a branch, and its times and weights follow for a
noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass as plain_dataclass
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from pydantic.dataclasses import dataclass

from siq.dynamics.bifurcation_curves import BifurcationCurve
from siq.dynamics.cards import load_system
from siq.dynamics.continuation import Branches, follow_branches
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.parameter_family import ParameterFamily
from siq.dynamics.phase_portrait import UNSETTLED
from siq.errors import InputError, suggestion
from siq.landscape.dwell_times import NoiseStrength, dwell_time
from siq.landscape.ensembles import shares_by_rates
from siq.landscape.options import LandscapeOptions
from siq.steps.settings import STRICT
from siq.steps.sweep_maps import curve_notes, curve_rows, curves_of_map
from siq.steps.sweep_points import PointSettings, SweptPoint, check_noise, point_at
from siq.steps.sweep_wells import Wells, bifurcation_rows, position_text
from siq.study.sweep import SweepOptions
from siq.study.tables import as_table, write_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_PARAMETERS = 2
ALONE = "it is the only stable state, and no way leads out of it"
UNKNOWN = "no way out was found"


@dataclass(frozen=True, config=STRICT)
class SweepSettings:
    """What the tables of a sweep depend on, beside its points."""

    sweep: SweepOptions
    landscape: LandscapeOptions

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters."""
        return self.sweep.names

    @property
    def noise(self) -> float | None:
        """ε, the first of those that the study gives."""
        return next(iter(self.landscape.noise_intensities), None)


@plain_dataclass(frozen=True, eq=False, repr=False)
class Sweep:
    """A landscape against one parameter, or two.

    Attributes
    ----------
    parameters, states
        Their names.
    table
        One row for every value and well: see ``sweep`` in `siq.study.tables`.
    ways
        One row for every value and way out of a well, barrier and prefactor; what
        `siq.probability_of_tipping` reads.
    branches
        Equilibria along their branches, stable or not; empty for two parameters.
    bifurcations
        Folds, Hopf points and branch points; empty for two parameters.
    notes
        What could not be done, in words.
    units
        Of the states, by name; of the time as ``t``, and of the parameters by their names.
    curves
        Of two parameters, the curves of folds and of Hopf points in their plane, a row for each point; empty
        for one.
    """

    parameters: tuple[str, ...]
    states: tuple[str, ...]
    table: pd.DataFrame
    ways: pd.DataFrame
    branches: pd.DataFrame
    bifurcations: pd.DataFrame
    notes: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
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
    system: str | Path | Dynamics,
    parameter: str,
    values: Sequence[float] | np.ndarray,
    *,
    second: tuple[str, Sequence[float] | np.ndarray] | None = None,
    noise: float | None = None,
    seed: int = 0,
) -> Sweep:
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
    4    0.5     1      NaN  <NA>
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
    check_names(base, named)
    if isinstance(system, Dynamics):
        check_noise(system, named)
    grid = np.stack(np.meshgrid(*named.values(), indexing="ij"), axis=-1).reshape(-1, len(named))
    names, settings = tuple(named), PointSettings(seed)
    points = [point_at(system, names, tuple(map(float, one)), settings) for one in grid]
    return collected(base, names, points, noise=noise)


def check_names(system: Dynamics, names: Iterable[str]) -> None:
    """Refuse parameters that a system has not.

    Raises
    ------
    InputError
        With those that it has.
    """
    known = [each.name for each in system.parameters]
    for name in names:
        if name not in known:
            otherwise = f"use one of {', '.join(known)}" if known else "make the number a parameter"
            raise InputError(
                system.name or "the system", "parameters", f"there is no parameter '{name}'",
                suggestion(name, known, otherwise=otherwise),
            )  # fmt: skip


def write_tables(found: Sweep, files: Mapping[str, str | Path]) -> None:
    """Write ``sweep``, ``sweep_ways``, ``branches``, ``bifurcations`` and ``bifurcation_curves``."""
    tables = {
        "sweep": found.table, "sweep_ways": found.ways, "branches": found.branches,
        "bifurcations": found.bifurcations, "bifurcation_curves": found.curves,
    }  # fmt: skip
    for name, path in files.items():
        write_table(path, tables[name])


def collected(
    system: Dynamics, names: tuple[str, ...], points: Sequence[SweptPoint], *, noise: float | None = None
) -> Sweep:
    """Tables of all points.

    Parameters
    ----------
    system
        The system at any of the points.
    names
        Of the one or two parameters.
    points
        In any order.
    noise
        ε; None for neither times nor weights.
    """
    points = sorted(points, key=lambda point: point.values)
    notes: list[str] = []
    branches: Branches | None = None
    curves: list[BifurcationCurve] = []
    values = [point.values[0] for point in points]
    if len(names) == 1 and min(values) < max(values):
        limits = (min(values), max(values))
        seeds = [(point.values[0], np.array(one)) for point in points for one in point.equilibria]
        branches = follow_branches(system, names[0], limits, seeds)
        notes += branches.notes
        wells = Wells.along(ParameterFamily(system, {names[0]: limits}), branches)
        numbers = [wells.numbers(point) for point in points]
    else:
        numbers = [tuple(range(len(point.wells))) for point in points]
    if len(names) == MOST_PARAMETERS:
        curves = curves_of_map(system, names, points)
        notes += curve_notes(names, curves)
    rows, ways = [], []
    for point, number in zip(points, numbers, strict=True):
        rows += _rows(point, number, noise)
        ways += _way_rows(point, number)
    units = dict(zip(system.states, system.units, strict=True)) | {"t": system.time_unit}
    units |= {each.name: each.unit for each in system.parameters if each.name in names}
    return Sweep(
        names, system.states, as_table("sweep", rows), as_table("sweep_ways", ways),
        as_table("branches", [] if branches is None else wells.branch_rows()),
        as_table("bifurcations", [] if branches is None else bifurcation_rows(branches)),
        tuple(dict.fromkeys(notes)), units, as_table("bifurcation_curves", curve_rows(curves)),
    )  # fmt: skip


def _place(point: SweptPoint) -> dict[str, object]:
    first, second = (*point.values, np.nan)[:MOST_PARAMETERS]
    return {"value": first, "second_value": second}


def _rows(point: SweptPoint, number: Sequence[int], noise: float | None) -> list[dict[str, object]]:
    """One row for every well of a point; one that says why where there is none."""
    if not point.wells:
        return [_place(point) | {"well": -1, "noise": noise, "note": point.reason or "; ".join(point.notes)}]
    weights = _weights(point, noise)
    return [
        _place(point)
        | {"well": number[index], "attractor": position_text(well.state), "relaxation": well.relaxation}
        | _exits(point, index, number, noise)
        | {"noise": noise, "weight": weights[index]}
        for index, well in enumerate(point.wells)
    ]


def _weights(point: SweptPoint, noise: float | None) -> np.ndarray:
    """Shares of time in the long run; NaN where a rate is not known, or the noise is not below a barrier."""
    count = len(point.wells)
    between = [way for way in point.ways if way.end is not None]
    known = noise is not None and all(way.barrier is not None and noise < way.barrier for way in between)
    # What leads elsewhere has a share of the time, too.
    if noise is None or not known or point.settled < 1 - UNSETTLED:
        return np.full(count, np.nan)
    if count == 1:
        return np.ones(1)
    listed = [
        {"start": way.start, "end": way.end, "barrier": way.barrier, "prefactor": way.prefactor}
        for way in between
    ]
    return shares_by_rates(listed, count, intensity=noise)


def _exits(point: SweptPoint, index: int, number: Sequence[int], noise: float | None) -> dict[str, object]:
    """The lowest way out of a well, and its time over all ways."""
    mine = [way for way in point.ways if way.start == index]
    known = [way for way in mine if way.barrier is not None]
    if not known:
        # Beside a limit cycle, or another well, it can be left although nobody knows how.
        alone = len(point.wells) == 1 and not point.notes and not mine
        told = "; ".join(dict.fromkeys(way.note for way in mine if way.note))
        return {"note": ALONE if alone else told or "; ".join(point.notes) or UNKNOWN}
    lowest = min(known, key=lambda way: np.inf if way.barrier is None else way.barrier)
    notes = [way.note for way in mine if way.note]
    time = dwell_time([way.as_exit() for way in mine], None if noise is None else NoiseStrength(noise))
    if noise is not None and time is None:
        notes.append(f"no time: the noise {noise:g} is not below the barrier, or the law has no prefactor")
    if time is not None and not time.complete:
        notes.append("a way out has no rate: the well lasts no longer than this")
    return {
        "barrier": lowest.barrier,
        "exit": None if lowest.end is None else number[lowest.end],
        "mean_time": np.nan if time is None else time.value,
        "law_error": np.nan if time is None else time.law_error,
        "note": "; ".join(dict.fromkeys(notes)),
    }


def _way_rows(point: SweptPoint, number: Sequence[int]) -> list[dict[str, object]]:
    return [
        _place(point)
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
