"""Which formulas does the page of a study show, with their coefficients and errors?"""

from __future__ import annotations

from siq.identify.diffusion import DiffusionSource
from siq.report.formatting import formula_matrix_mathml, matrix_mathml, vector_mathml
from siq.report.page import FormulaRow, ReportSection, ReportTable
from siq.report.said_landscape import SaidLandscape
from siq.report.study_formulas import coefficient_table, formula_rows
from siq.report.study_results import ShownStudy
from siq.steps.outcomes import Method

SOURCES = {
    DiffusionSource.GIVEN: "As given.",
    DiffusionSource.ESTIMATED: "Estimated from the noise in the recordings, since none was given, and"
    " scaled to the determinant 1, so that ε is the size of the noise.",
    DiffusionSource.OF_VELOCITIES: "Estimated from the recorded positions. Its part that acts on the"
    " velocities, the only one there is, is scaled to the determinant 1, so that ε is the size of the random"
    " forces.",
    DiffusionSource.UNIT_OF_VELOCITIES: "Taken as the unit matrix of the velocities: the recordings show no"
    " random forces. U and the barriers follow from it.",
    DiffusionSource.UNIT: "Taken as the unit matrix: none was given, and the recordings show no noise that"
    " would tell. U and the barriers follow from it.",
}

BY_STATE = "It depends on the state, in the sense of Itô: the noise is not the same everywhere."

ROUNDING = 1e-12  # of the largest coefficient of U: a constant so small is left of zero

SHOWN = "U$|f_"
"""Components whose coefficients are shown; those of g follow from them, and can be downloaded."""

DECOMPOSITION = (
    "f is split as f = −D∇V + g with ∇V·g = 0, and U = 2V. For the noise √ε σ dW with D = σσᵀ the density"
    " of states is"
    " exp(−U/ε) to leading order."
)


def formula_section(page: ShownStudy) -> ReportSection | None:
    """What was found, typeset, with coefficients and their errors."""
    results, shown = page.results, page.results.shown
    rows = formulas_by(page, page.method)
    record = results.record
    if record is not None and not rows:
        field = vector_mathml(record.found.dynamics.formulas)
        rows.append(FormulaRow("f", field, "The vector field dx/dt without noise, as identified."))
    if record is not None:
        note = SOURCES[record.diffusion_source]
        noise = record.found.diffusion
        if noise.constant:
            rows.append(FormulaRow("D", matrix_mathml(noise.matrix.tolist()), note))
        else:
            rows.append(FormulaRow("D", formula_matrix_mathml(noise.formulas), f"{note} {BY_STATE}"))
    if not rows:
        return None
    text = []
    if page.study.runs > 1 and shown.run is not None:
        known = results.tables["rrmse"]["rrmse"].notna().any()
        text.append(
            f"The formulas are those of run {shown.run}"
            + (", the median of the runs by error." if known else ".")
        )
    if page.method == Method.REGRESSION and shown.run is not None:
        text.append("They are those of the published method: no refined formula was found.")
    return ReportSection("Formulas", text, formulas=rows, tables=_coefficients(page), notes=[DECOMPOSITION])


def formulas_by(page: ShownStudy, method: Method) -> list[FormulaRow]:
    """The formulas of the run that is shown, as a method found them; none where it found none."""
    shown = page.results.shown
    found = {} if shown.run is None else page.results.models.formulas(shown.run)
    if method not in found:
        return []
    overview = page.results.overview or {"wells": [], "transitions": []}
    depths = [way["barrier"] for way in overview["transitions"] if way["barrier"] is not None]
    return formula_rows(
        found[method], page.results.exact,
        places=[one["attractor"] for one in overview["wells"]], depth=max(depths, default=0.0),
    )  # fmt: skip


def _coefficients(page: ShownStudy) -> list[ReportTable]:
    coefficients, shown = page.results.tables["coefficients"], page.results.shown
    mine = coefficients[(coefficients["run"] == shown.run) & (coefficients["method"] == str(shown.method))]
    units: dict[str, str] = {}
    if page.results.overview is not None:
        said = SaidLandscape(page.results.overview)
        units = dict(zip(said.states, said.units, strict=True)) | {"t": said.time_unit}
    largest = mine[mine["component"] == "U"]["estimate"].abs().max()
    nothing = (
        (mine["term"] == "1") & (mine["component"] == "U") & (mine["estimate"].abs() < ROUNDING * largest)
    )
    mine = mine[~nothing]
    table = coefficient_table(mine, units=units, components=SHOWN)
    if table is None:
        return []
    chosen = mine[mine["component"].str.match("U$|g_|f_") & (mine["estimate"] != 0)]
    caption = "Coefficients with their standard errors; those without ± are exact to the digits shown."
    file = f"{page.results.folder}/coefficients.csv"
    return [ReportTable(caption, table, {}, file, 30, data=chosen.drop(columns=["run", "method"]))]
