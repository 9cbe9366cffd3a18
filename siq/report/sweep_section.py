"""What the page of equations says of a sweep: where wells begin and end, and what was not found."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from siq.dynamics.dynamics import Dynamics
from siq.numerics.measured_text import unit_text
from siq.report.page import ReportSection, ReportTable
from siq.report.plots.sweep import plot_sweep
from siq.report.said_landscape import well_name
from siq.report.study_captions import figure_of
from siq.steps.sweep_maps import curve_name
from siq.study.sweep import SweepOptions

FIGURE = "sweep"
TABLES = ("sweep", "branches", "bifurcations", "bifurcation_curves")


def sweep_figure(system: Dynamics, options: SweepOptions, tables: Mapping[str, pd.DataFrame]) -> Figure:
    """The figure of a sweep, with the units of the card."""
    units = dict(zip(system.states, system.units, strict=True)) | {"t": system.time_unit}
    units |= {each.name: each.unit for each in system.parameters}
    return plot_sweep(
        tables["sweep"], tables["branches"], tables["bifurcations"], parameters=options.names,
        states=system.states, units=units, curves=tables["bifurcation_curves"],
    )  # fmt: skip


def sweep_section(
    system: Dynamics,
    options: SweepOptions,
    tables: Mapping[str, pd.DataFrame],
    *,
    folder: Path,
    images: Mapping[str, bytes],
    vectors: Mapping[str, bytes],
) -> ReportSection:
    """The section of a sweep.

    Parameters
    ----------
    system
        The system, for units.
    options
        What was asked.
    tables
        Those of `TABLES`.
    folder
        Where they lie.
    images, vectors
        The figures by name.
    """
    named = " and ".join(options.names)
    shown = [_bifurcations(system, tables["bifurcations"], options, folder)]
    figures = [figure_of(FIGURE, images, vectors, beside_paper=False)] if FIGURE in images else []
    return ReportSection(
        f"Against {named}",
        _sentences(options, tables),
        tables=[one for one in shown if one is not None],
        figures=figures,
        notes=_notes(tables["sweep"], options, folder),
    )


def _sentences(options: SweepOptions, tables: Mapping[str, pd.DataFrame]) -> list[str]:
    count = len(options.points)
    first = options.numbers
    said = [f"{options.parameter} has {len(first)} values from {first[0]:g} to {first[-1]:g}"]
    if options.second is not None:
        other = options.second.numbers
        said.append(f"{options.second.parameter} {len(other)} from {other[0]:g} to {other[-1]:g}")
    text = f"{' and '.join(said)}: {count} landscape{'s' if count > 1 else ''}, by the paths of least action."
    if options.second is not None:
        return [text, *_curves(options, tables["bifurcation_curves"])]
    found = tables["bifurcations"]
    ends = [f"{one.kind} at {options.parameter} = {one.value:.6g}" for one in found.itertuples()]
    if ends:
        return [text, f"Stable states begin, end or lose their stability here: {'; '.join(ends)}."]
    return [text, "No stable state begins, ends or loses its stability within this range."]


def _curves(options: SweepOptions, found: pd.DataFrame) -> list[str]:
    """How many curves of which kind there are, and over which ranges they reach."""
    if found.empty:
        return ["No row and no column of the map has a fold or a Hopf point."]
    said = []
    for kind, some in found.groupby("kind", sort=False):
        count = some["curve"].nunique()
        ranges = " and ".join(
            f"{name} = {some[column].min():.5g} to {some[column].max():.5g}"
            for name, column in zip(options.names, ("value", "second_value"), strict=True)
        )
        said.append(
            f"{curve_name(str(kind)).capitalize()} lie on {count} curve{'s' if count > 1 else ''} of the"
            f" plane, within {ranges}; they are drawn in the map."
        )
    return said


def _bifurcations(
    system: Dynamics, found: pd.DataFrame, options: SweepOptions, folder: Path
) -> ReportTable | None:
    if found.empty:
        return None
    unit = unit_text(next(each.unit for each in system.parameters if each.name == options.parameter))
    value = options.parameter + (f" ({unit})" if unit else "")
    rows = []
    for one in found.itertuples():
        states = ast.literal_eval(str(one.position))
        place = ", ".join(f"{name} = {x:.5g}" for name, x in zip(system.states, states, strict=True))
        turning = "" if one.kind != "Hopf" else f"{one.frequency:.6g}"
        rows.append({"what": one.kind, value: f"{one.value:.10g}", "state": place, "frequency": turning})
    help_ = {"frequency": "of the oscillation that begins there, in radian per unit of time"}
    caption = "Where equilibria meet and vanish, begin to oscillate, or cross."
    return ReportTable(
        caption, pd.DataFrame(rows), help_, f"{folder}/bifurcations.csv", data=found, rows_named=True
    )


def _notes(table: pd.DataFrame, options: SweepOptions, folder: Path) -> list[str]:
    """Values without an answer, and where all numbers are."""
    notes = []
    for reason, rows in table[table["well"] < 0].groupby("note"):
        at = [f"{value:g}" for value in sorted(set(rows["value"]))]
        places = ", ".join(at[:5]) + (f" and {len(at) - 5} further values" if len(at) > 5 else "")
        notes.append(f"No landscape at {options.parameter} = {places}: {reason}.")
    wells = [well_name(int(well)) for well in sorted(set(table["well"])) if well >= 0]
    if wells and options.second is None:
        notes.append(
            f"{', '.join(wells)} are named along their branches here, and need not be those of the"
            " quasipotential above."
        )
    files = ["sweep", "sweep_ways", *([] if options.second is None else ["bifurcation_curves"])]
    return [*notes, f"All numbers: {' and '.join(f'{folder}/{name}.csv' for name in files)}."]
