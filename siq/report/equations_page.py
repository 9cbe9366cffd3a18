"""The page of a study of equations, with its sweeps."""

from __future__ import annotations

import ast
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from markupsafe import Markup
from matplotlib.figure import Figure

from siq.numerics.text import unit_text
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.quasipotential.landscape_files import StoredLandscape
from siq.report.answers import Answer
from siq.report.formatting import formula_matrix_mathml, matrix_mathml
from siq.report.formula_sections import formula_rows
from siq.report.landscape_answer import certificate_badge, headline, remarks, tests_table, wells_table
from siq.report.landscape_summary import DrawnLandscape, drawn_data, well_name
from siq.report.landscape_tables import invariant_tables, landscape_tables
from siq.report.page import FormulaRow, ReportContent, ReportFigure, ReportSection, ReportTable
from siq.report.plots.errors import plot_degrees
from siq.report.plots.quasipotential import quasipotential_figure
from siq.report.plots.sweep import plot_sweep
from siq.report.study_figures import OF_EQUATIONS, OF_ONE_EQUATION, Part, figure_of, figures_of
from siq.systems.dynamics import Dynamics
from siq.workflow.outcomes import Method, Status
from siq.workflow.study import Study, SweepOptions
from siq.workflow.sweep_step import curve_name

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


LEAD = "quasipotential"
DENSITY = "invariant"
PRINTED = (
    "name",
    "title",
    "system",
    "from",
    "seed",
    "refinement",
    "certificate",
    "landscape",
    "invariant",
    "sweep",
)
"""Keys of the study that equations have a use for."""

METHOD = (
    "Nothing was recorded or learned. Equilibria were sought by Newton's method over the whole"
    " domain; the paths of least action lead from each stable state to the saddles next to it, and give the"
    " barriers."
    " U about each stable state solves the Hamilton–Jacobi equation of f, in powers up to the degree that its"
    " residual asked for, and has to pass the tests of the certificate. A simulation serves"
    " for comparison with the invariant distribution alone, where this was asked for."
)


@dataclass(frozen=True)
class EquationsResults:
    """What a study of equations left behind.

    Attributes
    ----------
    system
        f and D.
    stored
        The landscape, None where there is none.
    tables
        ``landscape``, ``degrees``, ``certificates`` and ``outcomes``; those of a sweep where there is one.
    folder
        Where they are.
    images, vectors
        The figures by name, as PNG and as SVG.
    interactive
        A view of U that can be turned, None where there is none.
    """

    system: Dynamics
    stored: StoredLandscape | None
    tables: Mapping[str, pd.DataFrame]
    folder: Path
    images: Mapping[str, bytes]
    vectors: Mapping[str, bytes]
    interactive: Markup | None = None

    @property
    def data(self) -> Mapping[str, Any] | None:
        """The landscape as plain data."""
        return None if self.stored is None else self.stored.data

    @property
    def certificate(self) -> Mapping[str, Any] | None:
        """That of the formulas; None where there are none."""
        return None if self.data is None else self.data.get("certificate")

    @property
    def formulas(self) -> int:
        """Wells with a formula."""
        return 0 if self.stored is None else sum(well is not None for well in self.stored.wells)


def drawn_of(system: Dynamics, stored: StoredLandscape) -> DrawnLandscape:
    """What is drawn of a landscape of equations."""
    return drawn_data(stored.data, wells=stored.wells, dynamics=system)


def equations_figures(
    system: Dynamics, stored: StoredLandscape | None, tables: Mapping[str, pd.DataFrame], study: Study
) -> dict[str, Figure | None]:
    """The figures of the page by name, None for one that has nothing to show."""
    lead = None if stored is None else quasipotential_figure(drawn_of(system, stored))
    degrees = tables["degrees"]
    return {
        LEAD: lead,
        "degrees": plot_degrees(degrees) if len(degrees) else None,
        FIGURE: None if study.sweep is None else sweep_figure(system, study.sweep, tables),
    }


def equations_page(
    study: Study, results: EquationsResults, *, command: str, versions: Mapping[str, str]
) -> ReportContent:
    """All that the page says.

    Parameters
    ----------
    study
        What was asked.
    results
        What came of it.
    command
        How to make the page again.
    versions
        Of the programs that took part, by name.
    """
    data = results.data
    table = figure = None
    if data is not None and data["wells"]:
        shown, numbers = wells_table(data)
        table = ReportTable("Stable states, barriers and times.", shown, data=numbers, rows_named=True)
    if LEAD in results.images:
        caption = OF_ONE_EQUATION if results.system.dimension == 1 else OF_EQUATIONS
        figure = figure_of(LEAD, results.images, results.vectors, beside_paper=False)
        figure = replace(figure, caption=caption, alternative=caption)
    sections = [
        _formulas(results),
        _evidence(results),
        _landscape(study, results),
        _sweep(study, results),
        _workings(results),
        ReportSection("How to run it again", listing=command),
        _provenance(study, versions),
    ]
    return ReportContent(
        title=study.title or results.system.title or study.name,
        answer=answer_lines(results),
        badge=certificate_badge(
            results.certificate if results.formulas else None,
            certified=int(_certified(results)), runs=1, refusals={}, given=True,
        ),
        figure=figure,
        table=table,
        interactive=results.interactive,
        sections=[one for one in sections if one is not None],
    )  # fmt: skip


def answer_lines(results: EquationsResults) -> list[str]:
    """The sentence, and what has to be known of it."""
    if results.data is None:
        reasons = [str(reason) for reason in results.tables["outcomes"]["reason"] if reason]
        return [f"No landscape was found: {reasons[0] if reasons else 'there is no stable state'}."]
    return [headline(results.data), *remarks(results.data)]


def answer_of_equations(page: ReportContent, results: EquationsResults) -> Answer:
    """The answer as plain data: a landscape by paths alone is one, too."""
    failed = int((results.tables["outcomes"]["status"] == Status.FAILED).sum())
    found = int(results.data is not None and bool(results.data["wells"]))
    return Answer(page.title, page.answer[0], "all" if _certified(results) else "none", found, 1, failed)


def _certified(results: EquationsResults) -> bool:
    return results.certificate is not None and bool(results.certificate["certified"])


def _formulas(results: EquationsResults) -> ReportSection:
    system, stored = results.system, results.stored
    wells = () if stored is None else tuple(well for well in stored.wells if well is not None)
    places = [] if stored is None else [np.array(one["attractor"]) for one in stored.data["wells"]]
    found = SymbolicDecomposition(system.symbols, None, (), system.formulas, wells)
    rows = formula_rows(found, None, places=places)
    rows[-1] = FormulaRow(
        rows[-1].quantity, rows[-1].formula, "The vector field dx/dt without noise, as given."
    )
    noise = system.diffusion
    typeset = (
        matrix_mathml(noise.matrix.tolist()) if noise.constant else formula_matrix_mathml(noise.formulas)
    )
    rows.append(FormulaRow("D", typeset, "As given."))
    return ReportSection("Formulas", formulas=rows)


def _evidence(results: EquationsResults) -> ReportSection | None:
    tests = tests_table(results.tables["certificates"], 0, Method.REFINED)
    tables = []
    if len(tests):
        file = f"{results.folder}/certificates.csv"
        tables = [ReportTable("The tests of the certificate.", tests, {}, file, rows_named=True)]
    notes = (
        [] if results.data is None else [f"{note[0].upper()}{note[1:]}." for note in results.data["notes"]]
    )
    if not tables and not notes:
        return None
    return ReportSection("How far it can be trusted", tables=tables, notes=notes)


def _landscape(study: Study, results: EquationsResults) -> ReportSection | None:
    noises = () if study.landscape is None else study.landscape.noise_intensities
    tables, folder = results.tables, results.folder
    found = landscape_tables(results.data, tables["landscape"], noises=noises, folder=folder)
    figures: list[ReportFigure] = []
    notes = []
    if "invariant" in tables:
        found += invariant_tables(tables["invariant"], tables["well_shares"], folder)
        images = {name: image for name, image in results.images.items() if name == DENSITY}
        figures = figures_of(Part.LANDSCAPE, images, results.vectors, beside_paper=False)
        if tables["invariant"].empty:
            notes = [
                "The invariant distribution was asked for, and U is not known as a formula in enough of the"
                " domain to say it. Higher degrees under refinement, or a narrower domain, may tell it."
            ]
    return (
        ReportSection("The landscape in full", tables=found, figures=figures, notes=notes) if found else None
    )


def _sweep(study: Study, results: EquationsResults) -> ReportSection | None:
    if study.sweep is None:
        return None
    return sweep_section(
        results.system, study.sweep, results.tables, folder=results.folder, images=results.images,
        vectors=results.vectors,
    )  # fmt: skip


def _workings(results: EquationsResults) -> ReportSection:
    images = {name: image for name, image in results.images.items() if name not in (LEAD, DENSITY)}
    figures = figures_of(Part.WORKINGS, images, results.vectors, beside_paper=False)
    return ReportSection("The workings", [METHOD], figures=figures, folded=True)


def _provenance(study: Study, versions: Mapping[str, str]) -> ReportSection:
    named = ", ".join(f"{name} {version}" for name, version in versions.items())
    machine = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    data = study.model_dump(mode="json", by_alias=True)
    printed = yaml.safe_dump({key: data[key] for key in PRINTED}, sort_keys=False, allow_unicode=True)
    text = [f"{named}; {machine}, {os.cpu_count()} cores."]
    return ReportSection("The study and the versions", text, listing=printed, folded=True)
