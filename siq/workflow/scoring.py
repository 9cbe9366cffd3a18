"""Scores: how close the formulas come to exact answers, where these are known.

Nothing here feeds back into a method. A run without formulas has no coefficients and no error; it stays in
the tables with missing values.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from siq.quasipotential.formulas import SymbolicDecomposition, exact_decomposition, term_coefficients
from siq.systems.cards import load_exact, load_system
from siq.systems.formulas import compile_formulas
from siq.workflow.published import PublishedFigure
from siq.workflow.tables import as_table

GRID_POINTS = 1_000_000  # the paper's grid has 100 points along each of three axes


def exact_answer(card: str | Path) -> SymbolicDecomposition | None:
    """The exact decomposition of the system of a card, None where the card does not know U.

    Raises
    ------
    InputError
        As `siq.systems.cards.load_system`.
    """
    quasipotential = load_exact(card)
    return None if quasipotential is None else exact_decomposition(load_system(card), quasipotential)


def exact_values(exact: SymbolicDecomposition, components: np.ndarray) -> np.ndarray:
    """The exact U at points, components ``(d, ...)`` to ``(...)``."""
    return compile_formulas([exact.quasipotential], exact.symbols)(components)[0]


def coefficient_table(
    run: int,
    method: str,
    identified: SymbolicDecomposition,
    exact: SymbolicDecomposition | None,
    *,
    terms: tuple[str, ...],
) -> pd.DataFrame:
    """Every coefficient of U, V, f and g beside the exact one.

    Parameters
    ----------
    run, method
        Whose formulas these are.
    identified, exact
        The formulas, and the exact ones where known.
    terms
        Terms of the library, of which all are listed, zeros included.

    Returns
    -------
    pandas.DataFrame
        Columns ``run method component term estimate exact standard_error``; `exact` and
        `standard_error` are missing where nothing is known.
    """
    rows: list[dict[str, object]] = []
    known = exact.components() if exact is not None else {}
    for component, formula in identified.components().items():
        estimates = term_coefficients(formula)
        truths = term_coefficients(known[component]) if component in known else None
        listed = dict.fromkeys([*terms, *estimates, *(truths or {})])
        for term in listed:
            rows.append(
                {
                    "run": run,
                    "method": method,
                    "component": component,
                    "term": term,
                    "estimate": estimates.get(term, 0.0),
                    "exact": np.nan if truths is None else truths.get(term, 0.0),
                    "standard_error": identified.standard_errors.get(component, {}).get(term, np.nan),
                }
            )
    return as_table("coefficients", rows)


def relative_root_mean_square_error(coefficients: pd.DataFrame) -> float:
    """‖ξ - ξ*‖/‖ξ*‖ over the non-trivial terms of U, those whose exact coefficient is not zero.

    This is the paper's measure (section 3.1). It does not see false terms: see `support_is_correct`.
    """
    quasipotential = coefficients[coefficients["component"] == "U"]
    nontrivial = quasipotential[quasipotential["exact"].fillna(0.0) != 0]
    if nontrivial.empty:
        return float("nan")
    difference = nontrivial["estimate"] - nontrivial["exact"]
    return float(np.linalg.norm(difference) / np.linalg.norm(nontrivial["exact"]))


def support_is_correct(coefficients: pd.DataFrame) -> bool | None:
    """Whether U has exactly the terms of the exact one; None where that is not known.

    The constant is left out: it follows from U being zero at its minimum.
    """
    quasipotential = coefficients[(coefficients["component"] == "U") & (coefficients["term"] != "1")]
    if quasipotential["exact"].isna().any() or quasipotential.empty:
        return None
    return bool(((quasipotential["estimate"] != 0) == (quasipotential["exact"] != 0)).all())


def domain_grid(domain: np.ndarray, *, points: int = GRID_POINTS) -> np.ndarray:
    """A regular grid over the domain Ω, as components ``(d, n)`` with n about `points`."""
    along = max(round(points ** (1 / len(domain))), 2)
    axes = [np.linspace(lower, upper, along) for lower, upper in domain]
    return np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")])


def relative_error(estimate: np.ndarray, exact: np.ndarray) -> float:
    """Relative L2 error of U on a grid, after each is shifted to be zero at its minimum."""
    estimate, exact = estimate - estimate.min(), exact - exact.min()
    return float(np.linalg.norm(estimate - exact) / np.linalg.norm(exact))


def summary_table(
    coefficients: pd.DataFrame,
    rrmse: pd.DataFrame,
    prediction: pd.DataFrame,
    published: Mapping[str, PublishedFigure],
) -> pd.DataFrame:
    """Every figure over the runs, beside the exact and the published one.

    Quantities are ``rrmse``, ``support_correct``, ``certified``, ``network_error``, ``stated_error``,
    ``prediction_error`` (over all trajectories of all runs) and every coefficient that is not
    zero in some run, exactly or in print, as ``U:x**2``. A run that has no value is not counted in `runs`,
    and therefore shows there.
    """
    rows: list[dict[str, object]] = []
    for method, errors in rrmse.groupby("method", sort=False):
        for quantity in ("rrmse", "network_error", "stated_error", "support_correct", "certified"):
            rows.append(summary_row(str(method), quantity, errors[quantity].astype("float64"), published))
        predicted = prediction[prediction["method"] == method]["error"]
        if len(predicted):
            rows.append(summary_row(str(method), "prediction_error", predicted, published))
        chosen = coefficients[coefficients["method"] == method].dropna(subset="estimate")
        runs = chosen["run"].unique()
        for (component, term), group in chosen.groupby(["component", "term"], sort=False):
            quantity = f"{component}:{term}"
            # A run with formulas that does not list a term has it with coefficient zero.
            estimates = group.set_index("run")["estimate"].reindex(runs, fill_value=0.0)
            exact = group["exact"].iloc[0]
            if (estimates != 0).any() or (pd.notna(exact) and exact != 0) or quantity in published:
                row = summary_row(str(method), quantity, estimates, published)
                row["exact"] = exact
                row["inclusion_frequency"] = float((estimates != 0).mean())
                rows.append(row)
    return as_table("summary", rows)


def summary_row(
    method: str, quantity: str, values: pd.Series, published: Mapping[str, PublishedFigure]
) -> dict[str, object]:
    """A figure over the runs, in the columns of the table `summary`, beside the published one."""
    values = values.dropna()
    figure = published.get(quantity)
    return {
        "method": method,
        "quantity": quantity,
        "exact": np.nan,
        "mean": values.mean(),
        "standard_deviation": values.std() if len(values) > 1 else np.nan,
        "median": values.median(),
        "inclusion_frequency": np.nan,
        "runs": len(values),
        "published": figure.mean if figure else np.nan,
        "published_standard_deviation": figure.standard_deviation if figure else np.nan,
        "source": figure.source if figure else "",
    }
