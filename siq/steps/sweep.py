"""Control parameters: the landscape of equations against one parameter, or two.

Points (`siq.steps.sweep_points`) become tables here: equilibria are joined to branches by continuation
(`siq.dynamics.continuation`), a well is a stable stretch of a branch, and its times and weights follow for a
noise (`siq.steps.sweep_rows`).
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
from siq.errors import InputError, suggestion
from siq.landscape.options import LandscapeOptions
from siq.steps.settings import STRICT
from siq.steps.sweep_maps import curve_notes, curve_rows, curves_of_map
from siq.steps.sweep_points import PointSettings, SweptPoint, check_noise, point_at
from siq.steps.sweep_rows import way_rows, well_rows
from siq.steps.sweep_wells import Wells, bifurcation_rows
from siq.study.sweep import SweepOptions
from siq.study.tables import as_table, write_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_PARAMETERS = 2


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
        rows += well_rows(point, number, noise)
        ways += way_rows(point, number)
    units = dict(zip(system.states, system.units, strict=True)) | {"t": system.time_unit}
    units |= {each.name: each.unit for each in system.parameters if each.name in names}
    return Sweep(
        names, system.states, as_table("sweep", rows), as_table("sweep_ways", ways),
        as_table("branches", [] if branches is None else wells.branch_rows()),
        as_table("bifurcations", [] if branches is None else bifurcation_rows(branches)),
        tuple(dict.fromkeys(notes)), units, as_table("bifurcation_curves", curve_rows(curves)),
    )  # fmt: skip
