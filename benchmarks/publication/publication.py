"""What a publication has, place by place, and ours beside its numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import scipy.optimize
import scipy.special
import sympy
from pydantic import BaseModel, ConfigDict

from siq.inference.library import linear_combination
from siq.numerics.files import read_document, validate
from siq.numerics.text import number_text
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.formulas import parse_formula
from siq.workflow.tables import as_table
from workflow.published import PublishedFigure, published_formula
from workflow.scoring import summary_row

REPRODUCED_METHODS = ("refined", "regression")
SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
HEADINGS = ("ours", "regression")  # what these are called on a page
COLUMNS = (
    "quantity", "published", "published ±", "exact", "refined", "refined ±", "refined − published",
    "regression", "regression ±", "regression − published", "runs", "source",
)  # fmt: skip
DEGREES = ("regression.potential_degree", "regression.circulatory_degree")
Tables = Literal[
    "own_equations", "invariant", "well_shares", "equilibria", "transitions", "landscape_errors", "escape",
    "parameters", "timings",
]  # fmt: skip


class Place(BaseModel):
    """A table, a figure, an equation or a number of a publication.

    Attributes
    ----------
    place
        What it is called there.
    says
        What it shows.
    study
        The study that has ours.
    quantities
        Patterns of the published figures that belong here.
    figures, tables
        Ours.
    remark
        What is to be said of ours.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    place: str
    says: str
    study: str | None = None
    quantities: tuple[str, ...] = ()
    figures: tuple[str, ...] = ()
    tables: tuple[Tables, ...] = ()
    remark: str = ""


class Contents(BaseModel):
    """Everything that a publication has, in its order."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    places: tuple[Place, ...]


class ParameterRow(BaseModel):
    """A parameter that a publication states, for each of its examples; `key` is that of a study."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    parameter: str
    key: str
    archetype: float | str
    resonator: float | str


class Parameters(BaseModel):
    """The parameters that a publication states, and the studies that stand beside each example."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    studies: Mapping[str, tuple[str, ...]]
    rows: tuple[ParameterRow, ...]


def load_contents(path: str | Path) -> Contents:
    """Read and check what a publication has; raises `siq.errors.InputError` with the line at fault."""
    return validate(read_document(path), Contents)


def load_parameters(path: str | Path) -> Parameters:
    """Read and check the parameters of a publication; raises `siq.errors.InputError` likewise."""
    return validate(read_document(path), Parameters)


def gradient_coefficients(coefficients: pd.DataFrame, states: Sequence[str]) -> pd.DataFrame:
    """Coefficients of ∇V from those of V, in the columns of the table, the components being ``dV_x``.

    Parameters
    ----------
    coefficients
        The table, of which the component ``V`` is used.
    states
        Names of the d states.
    """
    symbols = {name: sympy.Symbol(name, real=True) for name in states}
    potential = coefficients[coefficients["component"] == "V"]
    parts = pd.DataFrame(
        [
            {"term": term, "component": f"dV_{name}", "new": str(function), "factor": factor}
            for term in potential["term"].unique()
            for name, symbol in symbols.items()
            for function, factor in linear_combination(parse_formula(term, symbols).diff(symbol)).items()
        ],
        columns=["term", "component", "new", "factor"],
    )
    found = potential.drop(columns="component").merge(parts, on="term")
    for column in ("estimate", "exact"):
        found[column] *= found["factor"]
    found["standard_error"] *= found["factor"].abs()
    # A term of ∇V comes from one term of V, unless V holds functions that are no monomials.
    keys = ["run", "method", "component", "new"]
    summed = found.groupby(keys, sort=False, as_index=False)[["estimate", "exact"]].sum(min_count=1)
    return as_table("coefficients", summed.rename(columns={"new": "term"}))


def attractor_rows(
    figures: Mapping[str, PublishedFigure],
    fields: Sequence[Dynamics],
    exact: Dynamics | None,
) -> list[dict[str, object]]:
    """Where the identified f of every run vanishes, next to each published attractor.

    Parameters
    ----------
    figures
        The published figures; those of attractors are named ``attractor A:x``.
    fields
        The identified f of every run.
    exact
        The exact one, where it is known.
    """
    rows: list[dict[str, object]] = []
    names = dict.fromkeys(key.split(":")[0] for key in figures if key.startswith("attractor "))
    for name in names if fields else ():
        states = [symbol.name for symbol in fields[0].symbols]
        start = np.array([figures[f"{name}:{state}"].mean for state in states])
        found = np.array([_root(one, start) for one in fields])
        truth = np.full(len(states), np.nan) if exact is None else _root(exact, start)
        for state, values, true in zip(states, found.T, truth, strict=True):
            row = summary_row(REPRODUCED_METHODS[0], f"{name}:{state}", pd.Series(values), figures)
            rows.append(row | {"exact": true})
    return rows


def _root(dynamics: Dynamics, start: np.ndarray) -> np.ndarray:
    """The state next to another at which f vanishes, NaN where none is found."""
    found = scipy.optimize.root(
        lambda x: dynamics.drift(x[None])[0],
        start,
        jac=lambda x: dynamics.jacobian(x[None])[0],
        options={"xtol": 1e-13},
    )
    # The solver may say that it makes no progress, where it is at the root to rounding.
    value = np.linalg.norm(dynamics.drift(found.x[None])[0])
    small = 1e-9 * float(np.linalg.norm(dynamics.jacobian(start[None])[0]) * np.linalg.norm(start))
    return np.asarray(found.x) if value <= small else np.full(len(start), np.nan)


def published_decomposition(
    figures: Mapping[str, PublishedFigure], symbols: Sequence[sympy.Symbol], diffusion: Diffusion
) -> SymbolicDecomposition | None:
    """The published V = U/2 and g, with f = -D∇V + g; None unless U and all of g were published."""
    quasipotential = published_formula(figures, "U", symbols)
    circulatory = [published_formula(figures, f"g_{symbol}", symbols) for symbol in symbols]
    if quasipotential is None or any(one is None for one in circulatory):
        return None
    potential = sympy.expand(quasipotential / 2)
    gradient = sympy.Matrix([potential.diff(symbol) for symbol in symbols])
    downhill = sympy.Matrix(diffusion.formulas) * gradient
    return SymbolicDecomposition(
        symbols=tuple(symbols),
        potential=potential,
        circulatory=tuple(circulatory),
        vector_field=tuple(sympy.expand(g - d) for g, d in zip(circulatory, downhill, strict=True)),
    )


def own_equations(one: SymbolicDecomposition, x: np.ndarray, vector_field: np.ndarray) -> dict[str, float]:
    """How far a decomposition is from what it should fulfil, rms over points.

    Parameters
    ----------
    one
        V, g and f = -D∇V + g.
    x
        Shape ``(n, d)``.
    vector_field
        The true f there, shape ``(n, d)``.

    Returns
    -------
    dict
        ``orthogonality``: ∣∇V·g∣ over ∣∇V∣∣g∣; ``vector_field``: ∣-D∇V + g - f∣ over ∣f∣.
    """
    components = np.ascontiguousarray(x.T)
    gradient, values = one.evaluate_gradient(components), one.evaluate(components)
    d = x.shape[1]
    circulatory, own = values[1 : 1 + d], values[1 + d :]
    cosine = (gradient * circulatory).sum(axis=0)
    sizes = np.linalg.norm(gradient, axis=0) * np.linalg.norm(circulatory, axis=0)
    away = own - vector_field.T

    def rms(values: np.ndarray) -> float:
        return float(np.sqrt((values**2).mean()))

    return {
        "orthogonality": rms(cosine) / rms(sizes),
        "vector_field": rms(np.linalg.norm(away, axis=0)) / rms(np.linalg.norm(vector_field, axis=1)),
    }


def numbers(summary: pd.DataFrame, patterns: Sequence[str]) -> pd.DataFrame:
    """Published figures of some quantities, with ours by either method, and the differences.

    Parameters
    ----------
    summary
        In the columns of the table `summary`; rows without a published figure are left out.
    patterns
        Of the quantities, such as ``U:*``.

    Returns
    -------
    pandas.DataFrame
        One row a quantity, in the order of the patterns; columns that nothing is known of are left out.
    """
    rows = summary[summary["published"].notna() & summary["method"].isin(REPRODUCED_METHODS)]
    order = [q for one in patterns for q in rows["quantity"].unique() if fnmatchcase(q, one)]
    found = []
    for quantity in dict.fromkeys(order):
        mine = rows[rows["quantity"] == quantity].set_index("method")
        one: dict[str, object] = {
            "quantity": quantity,
            "published": mine["published"].iloc[0],
            "published ±": mine["published_standard_deviation"].iloc[0],
            "exact": mine["exact"].dropna().iloc[0] if mine["exact"].notna().any() else np.nan,
            "runs": int(mine["runs"].max()),
            "source": mine["source"].iloc[0],
        }
        for method in mine.index:
            one[method] = mine.loc[method, "mean"]
            one[f"{method} ±"] = mine.loc[method, "standard_deviation"]
            one[f"{method} − published"] = mine.loc[method, "mean"] - mine["published"].iloc[0]
        found.append(one)
    table = pd.DataFrame(found, columns=list(COLUMNS))
    said = [name for name in COLUMNS if table[name].notna().any()]
    return table[said]


def shown(table: pd.DataFrame) -> pd.DataFrame:
    """A table of `numbers` for a page: means with their deviations in one column, without the sources."""
    columns = {"quantity": table["quantity"].map(_typeset)}
    for name, heading in (("published", "published"), *zip(REPRODUCED_METHODS, HEADINGS, strict=True)):
        if name not in table:
            continue
        spread = table.get(f"{name} ±", pd.Series(np.nan, index=table.index))
        columns[heading] = pd.Series(
            [
                _brief(mean) + (f" ± {_brief(deviation, digits=2)}" if np.isfinite(deviation) else "")
                for mean, deviation in zip(table[name].astype(float), spread.astype(float), strict=True)
            ],
            index=table.index,
        )
        if name == "published" and "exact" in table:
            columns["exact"] = table["exact"]
        if f"{name} − published" in table:
            columns[f"{heading} − published"] = table[f"{name} − published"]
    return pd.DataFrame(columns)


def _typeset(quantity: str) -> str:
    """A quantity as people write it: ``∇V_x: x³`` for ``dV_x:x**3``."""
    text = re.sub(r"\*\*(\d+)", lambda power: power[1].translate(SUPERSCRIPTS), quantity)
    return re.sub("^dV_", "∇V_", text).replace("*", " ").replace(":", ": ")


def _brief(value: float, *, digits: int = 4) -> str:
    """A number with so many digits that count, which does not break within a cell."""
    plain = 1e-3 <= abs(value) < 1e5 or value == 0
    text = f"{value:.{digits}g}".replace("-", "−") if plain else number_text(value, decimals=digits - 1)
    return text.replace(" × ", "\u00a0×\u00a0")


def parameter_table(parameters: Parameters, studies: Mapping[str, object]) -> pd.DataFrame:
    """The stated parameters of each example beside those of our studies, as text.

    Parameters
    ----------
    parameters
        What is stated.
    studies
        The settings of each study, with what the keys of the rows name as attributes.
    """
    rows = []
    for row in parameters.rows:
        found: dict[str, object] = {"parameter": row.parameter}
        for example, names in parameters.studies.items():
            found[f"published, {example}"] = _text(getattr(row, example))
            found |= {name: _text(_looked_up(studies[name], row.key)) for name in names}
        rows.append(found)
    return pd.DataFrame(rows)


def _looked_up(study: object, key: str) -> object:
    """An attribute of an attribute: ``training.steps``."""
    value = attrgetter(key)(study)
    if value is None and key in DEGREES:  # the degree of V or g is that of the library unless it is said
        return attrgetter("regression.degree")(study)
    return value


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        if value and isinstance(value[0], list | tuple):
            return " × ".join(f"[{low:g}, {high:g}]" for low, high in value)
        return "-".join(str(one) for one in value)
    return f"{value:g}" if isinstance(value, float) else "—" if value is None else str(value)


def normalisation_bessel(
    quasipotential: sympy.Expr, symbols: Sequence[sympy.Symbol], *, intensity: float
) -> float | None:
    """Z over all of space in closed form, for one quartic state and any number of quadratic ones.

    For ``U = a₁x⁴ - a₂x² + a₃ + Σ b_k y_k²`` it is, with ``s = a₂²/(8 a₁ ε)``, the paper's Appendix C,
    ``Z = π sqrt(a₂/(8a₁)) exp(s - a₃/ε) [I_{1/4}(s) + I_{-1/4}(s)] Π sqrt(πε/b_k)``; a₂ < 0 (one well)
    changes the sign of I_{1/4}, and a₂ = 0 leaves a Gamma function.

    Z is in the product of the states' units, and ε in the unit of U, positive (`ValueError`). None where U
    has another form, or is not bounded below.
    """
    if not 0 < intensity < math.inf:
        raise ValueError(f"the noise intensity ({intensity}) must be positive")
    if not quasipotential.is_polynomial(*symbols):
        return None
    constant, powers = 0.0, [dict[int, float]() for _ in symbols]
    for exponents, coefficient in sympy.Poly(quasipotential, *symbols).terms():
        present = [(index, power) for index, power in enumerate(exponents) if power]
        if len(present) > 1:
            return None
        for index, power in present:
            powers[index][power] = float(coefficient)
        constant += 0.0 if present else float(coefficient)
    quartic = [(own[4], -own.get(2, 0.0)) for own in powers if own.keys() in ({4}, {2, 4})]
    quadratic = [own[2] for own in powers if own.keys() == {2}]
    if len(quartic) != 1 or len(quadratic) != len(symbols) - 1 or min([quartic[0][0], *quadratic]) <= 0:
        return None
    a1, a2 = quartic[0]
    s = a2**2 / (8 * a1 * intensity)
    # ive and kve carry a factor exp(-s), exp(s): what remains in the exponent is -min U/ε.
    exponent = -constant / intensity
    if a2 > 0:
        exponent += 2 * s
        along = math.pi * math.sqrt(a2 / (8 * a1)) * sum(scipy.special.ive((0.25, -0.25), s))
    elif a2 < 0:  # π (I_{-1/4} - I_{1/4}) = sqrt(2) K_{1/4}
        along = math.sqrt(-a2 / (4 * a1)) * scipy.special.kve(0.25, s)
    else:
        along = 2 * math.gamma(1.25) * (intensity / a1) ** 0.25
    across = math.prod(math.sqrt(math.pi * intensity / b) for b in quadratic)
    return float(along * across * np.exp(exponent))
