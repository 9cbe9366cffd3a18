"""The formulas that a page shows, with their coefficients and errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import sympy
from markupsafe import Markup

from siq.inference.field_estimate import DiffusionSource
from siq.numerics.text import unit_text, value_text
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.quasipotential.wells import Well
from siq.report.formatting import (
    formula_mathml,
    formula_matrix_mathml,
    matrix_mathml,
    term_text,
    vector_mathml,
)
from siq.report.landscape_summary import SaidLandscape, well_name
from siq.report.page import FormulaRow, ReportSection, ReportTable
from siq.report.study_results import ShownStudy
from siq.workflow.outcomes import Method

SMALL = 1e-3  # of the depth: a term that contributes less everywhere is left to the whole formula
NOTHING = 1e-9  # of the depth
SHORT = 8  # terms that are read at a glance: so short a formula is shown as it is


def formula_rows(
    found: SymbolicDecomposition,
    exact: SymbolicDecomposition | None,
    *,
    places: Sequence[np.ndarray] = (),
    depth: float = 0.0,
) -> list[FormulaRow]:
    """U, g and f of one method; U about each well where no single formula holds.

    Parameters
    ----------
    found
        The formulas.
    exact
        The exact ones, where they are known.
    places
        The attractors in the order of their letters; by default that of the wells.
    depth
        Of the deepest well: a constant far below it is what rounding left of zero.
    """
    truths: Mapping[str, Markup] = {} if exact is None else _typeset(exact)
    rows = [
        FormulaRow(name, formula, NOTES.get(name, ""), truths.get(name))
        for name, formula in _typeset(found, depth=depth).items()
    ]
    wells = [] if found.potential is not None else [_well_row(well, places) for well in found.wells]
    return [*wells, *rows]


NOTES = {
    "U": "The quasipotential, zero at its lowest point. exp(−U/ε) is the density of states, to leading"
    " order.",
    "g": "The circulatory part: it moves the state without changing U.",
    "f": "The vector field dx/dt without noise, as identified.",
}


def _typeset(one: SymbolicDecomposition, *, depth: float = 0.0) -> dict[str, Markup]:
    formulas = {}
    if one.potential is not None:
        whole = one.quasipotential
        constant, rest = whole.as_coeff_Add()
        shown = rest if rest != 0 and abs(float(constant)) < NOTHING * depth else whole
        formulas = {"U": formula_mathml(shown), "g": vector_mathml(one.circulatory)}
    return formulas | {"f": vector_mathml(one.vector_field)}


def _well_row(well: Well, places: Sequence[np.ndarray]) -> FormulaRow:
    """U about one attractor in offsets from it: the terms that count, and the whole formula."""
    name = _letter(well, places)
    kept, left_out = _counting(well)
    offsets = ", ".join(
        f"Δ{symbol} = {symbol}" + ("" if abs(value) < 1e-12 * size else _offset(value))
        for symbol, value, size in zip(
            well.basis.symbols, well.basis.center, np.maximum(well.basis.scale, 1e-300), strict=True
        )
    )
    note = f"Holds up to U = {value_text(2 * well.level)} above {name}; {offsets}."
    if left_out:
        terms = "one term is" if left_out == 1 else f"{left_out} terms are"
        note += f" Here {terms} left out that nowhere add more than {SMALL:.1%} of the depth.".replace(
            ".0%", "%"
        )
    return FormulaRow(
        f"U about {name}",
        formula_mathml(_in_offsets(well, kept)),
        note,
        whole=formula_mathml(_in_offsets(well, np.ones(len(kept), dtype=bool))) if left_out else None,
    )


def _offset(value: float) -> str:
    return f" {'−' if value > 0 else '+'} {value_text(abs(value))}"


def _letter(well: Well, places: Sequence[np.ndarray]) -> str:
    if not len(places):
        return "(" + ", ".join(value_text(value) for value in well.attractor) + ")"
    away = [float(np.abs((np.asarray(place) - well.attractor) / well.basis.scale).max()) for place in places]
    return well_name(int(np.argmin(away)))


def _counting(well: Well) -> tuple[np.ndarray, int]:
    """Which terms contribute more than a small share of the depth somewhere, and how many do not."""
    size = np.abs(well.coefficients)
    if len(well.points):
        size = size * np.abs(well.basis.values(well.points)).max(axis=0)
    kept = size > SMALL * well.level
    if kept.sum() == 0 or len(kept) <= SHORT:
        kept = well.coefficients != 0
    return kept, int(((well.coefficients != 0) & ~kept).sum())


def _in_offsets(well: Well, kept: np.ndarray) -> sympy.Expr:
    basis = well.basis
    offsets = [sympy.Symbol(f"Δ{symbol}", real=True) for symbol in basis.symbols]
    terms = []
    for exponents, coefficient in zip(basis.exponents[kept], well.coefficients[kept], strict=True):
        value = 2 * float(coefficient) / float(np.prod(basis.scale**exponents))
        powers = [offset ** int(n) for offset, n in zip(offsets, exponents, strict=True) if n]
        if value:
            terms.append(sympy.Mul(sympy.Float(value), *powers))
    return sympy.Add(*terms)


def coefficient_table(
    coefficients: pd.DataFrame, *, units: Mapping[str, str], components: str
) -> pd.DataFrame | None:
    """Coefficients with their standard errors, for a reader; None where there are none.

    Parameters
    ----------
    coefficients
        Of one run and one method.
    units
        Of the states and of the time.
    components
        Which components, as a regular expression.
    """
    chosen = coefficients[coefficients["component"].str.match(components) & (coefficients["estimate"] != 0)]
    if chosen.empty:
        return None
    return pd.DataFrame(
        {
            "in": [component_text(str(name), units) for name in chosen["component"]],
            "term": [term_text(str(name)) for name in chosen["term"]],
            "coefficient": [
                value_text(value, error)
                for value, error in zip(chosen["estimate"], chosen["standard_error"], strict=True)
            ],
            "exact": chosen["exact"].to_numpy(),
        }
    )


def component_text(component: str, units: Mapping[str, str]) -> str:
    """``f_x`` as ``dx/dt``, ``g_x`` as it stands."""
    kind, _, state = component.partition("_")
    if kind != "f":
        return f"{kind}, {state}" if state else kind
    unit = _rate(units.get(state, ""), units.get("t", ""))
    return f"d{state}/dt" + (f" ({unit})" if unit else "")


def _rate(state: str, time: str) -> str:
    state, time = unit_text(state), unit_text(time)
    if not time:
        return state
    return f"{state or '1'}/{time}"


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
