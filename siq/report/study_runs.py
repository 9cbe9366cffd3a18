"""Which tables tell what several runs say together?"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from siq.report.formatting import term_text
from siq.report.page import ReportTable

SUMMARY_COLUMNS = (
    "method",
    "quantity",
    "exact",
    "mean",
    "standard_deviation",
    "median",
    "inclusion_frequency",
    "published",
    "published_standard_deviation",
    "runs",
)
SUMMARY_HELP = {
    "quantity": "component and term, for coefficients; those of V = U/2 and of f are in the file",
    "inclusion frequency": "share of runs in which the term was found",
    "runs": "runs that have a value",
    "published": "the published figure, with its source",
}


def method_tables(
    tables: Mapping[str, pd.DataFrame], folder: Path, methods: tuple[str, ...], *, beside_paper: bool
) -> list[ReportTable]:
    """Figures over the runs, tests passed, and errors by run, of some methods.

    Parameters
    ----------
    tables
        Of the study, by name.
    folder
        Where they are.
    methods
        The methods.
    beside_paper
        Whether published figures stand beside them.
    """
    chosen = {
        name: tables[name][tables[name]["method"].isin(methods)]
        for name in ("summary", "certificates", "rrmse")
    }
    counted = (
        chosen["certificates"]
        .groupby(["method", "test"], sort=False)
        .agg(
            passed=("passed", "sum"),
            runs=("passed", "size"),
            median=("value", "median"),
            worst=("value", "max"),
        )
        .reset_index()
    )
    counted["test"] = [str(name).replace("_", " ") for name in counted["test"]]
    caption = "Every figure over the runs" + (", beside the published one." if beside_paper else ".")
    tested = "How many runs passed each test of the certificate."
    summary = _summary_shown(chosen["summary"])
    found = [
        ReportTable(caption, summary, SUMMARY_HELP, f"{folder}/summary.csv", 40, data=chosen["summary"]),
        ReportTable(tested, counted, {}, f"{folder}/certificates.csv", 40),
        ReportTable("Errors by run.", _words(chosen["rrmse"]), {}, f"{folder}/rrmse.csv", 50),
    ]
    return [one for one in found if len(one.frame)]


def _summary_shown(summary: pd.DataFrame) -> pd.DataFrame:
    """Errors, U and g; the headings in words, so that they wrap."""
    shown = summary[~summary["quantity"].str.match("V:|f_")]
    if shown["method"].nunique() == 1:
        shown = shown.drop(columns="method")
    columns = [name for name in SUMMARY_COLUMNS if name in shown and shown[name].notna().any()]
    return _words(shown[columns].assign(quantity=[_quantity(str(name)) for name in shown["quantity"]]))


def _quantity(name: str) -> str:
    """``U:x**2`` as ``U: x²``; errors by their names in words."""
    component, colon, term = name.partition(":")
    return f"{component.replace('_', ', ')}: {term_text(term)}" if colon else name.replace("_", " ")


def _words(table: pd.DataFrame) -> pd.DataFrame:
    return table.rename(columns=lambda name: name.replace("_", " "))
