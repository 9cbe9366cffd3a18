"""What a study left behind, and what all of its runs say together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from markupsafe import Markup

from siq.data.two_states import RecordStates
from siq.inference.identification import FieldRecord
from siq.numerics.text import number_text, value_text
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.report.formatting import term_text
from siq.report.landscape_answer import share_text
from siq.report.page import ReportFigure, ReportTable
from siq.report.study_figures import Part, figures_of
from siq.workflow.collection_steps import ModelFiles, Shown
from siq.workflow.outcomes import Method, Status
from siq.workflow.study import Study


@dataclass(frozen=True)
class StudyResults:
    """What a study left behind.

    Attributes
    ----------
    tables
        By name, see `siq.workflow.tables.COLUMNS`; `landscape_errors` and `escape` with a card only,
        and `beside_equations` where the study asks for it.
    folder
        Where the whole tables are.
    models
        The formulas of all runs.
    shown
        The run whose formulas are printed.
    exact
        The exact ones, where they are known.
    images, vectors
        The figures that there are by name, as PNG and as SVG.
    overview
        The landscape that the page opens with, as plain data; None where there is none.
    record
        f and D of the run that is shown, None where there is none.
    interactive
        A view of U that can be turned, None where there is none.
    inspection
        What is in the recordings, line by line; None where they were simulated.
    seen
        The two states that they show by themselves; None where nothing is known of that.
    """

    tables: Mapping[str, pd.DataFrame]
    folder: Path
    models: ModelFiles
    shown: Shown
    exact: SymbolicDecomposition | None
    images: Mapping[str, bytes]
    vectors: Mapping[str, bytes]
    overview: Mapping[str, Any] | None = None
    record: FieldRecord | None = None
    interactive: Markup | None = None
    inspection: Sequence[str] | None = None
    seen: RecordStates | None = None


@dataclass(frozen=True)
class ShownStudy:
    """A study as its page shows it; `images` are the figures that are shown, with the `lead`."""

    study: Study
    results: StudyResults
    images: Mapping[str, bytes]
    lead: str | None
    beside_paper: bool

    def figures(self, part: Part) -> list[ReportFigure]:
        """Those that stand in a part of the page, but for the one that it opens with."""
        images = {name: image for name, image in self.images.items() if name != self.lead}
        return figures_of(part, images, self.results.vectors, beside_paper=self.beside_paper)

    @property
    def method(self) -> Method:
        """Whose formulas are shown."""
        return self.results.shown.method

    def certificate(self) -> Mapping[str, Any] | None:
        """Of the formulas that are shown; None where there are none."""
        shown = self.results.shown
        if shown.run is None:
            return None
        found: Mapping[str, Any] | None = self.results.models.certificates(shown.run).get(str(shown.method))
        return found


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


SAME = "same_as_refined"  # the row of a control that compares it with the refined V


def run_sentences(
    rrmse: pd.DataFrame, outcomes: pd.DataFrame, summary: pd.DataFrame, *, runs: int, method: str
) -> list[str]:
    """What all runs say together: how many ended with formulas, how far they agree, how exact they are.

    Parameters
    ----------
    rrmse, outcomes, summary
        The tables of the study.
    runs
        Number of runs that the study asked for.
    method
        The method to speak of.

    Returns
    -------
    list of str
        Of one run only what is known of its errors.
    """
    mine = rrmse[rrmse["method"] == method]
    sentences = _several(mine, outcomes, summary, runs=runs, method=method) if runs > 1 else []
    sentences += _against_exact(mine["rrmse"].dropna(), mine, summary, method=method, runs=runs)
    networks = mine["network_error"].dropna()
    if len(networks):
        sentences.append(
            f"The U of the networks, before any formula, is off by {_with_spread(networks)} (relative L2"
            f" over the"
            " domain, which reaches beyond the recorded states)."
        )
    predicted = summary[(summary["method"] == method) & (summary["quantity"] == "prediction_error")]
    if len(predicted):
        row = predicted.iloc[0]
        median = f" (median {number_text(row['median'], decimals=1)})" if runs > 1 else ""
        sentences.append(
            f"f predicts unseen trajectories with a relative error of"
            f" {number_text(row['mean'], decimals=1)} in the"
            f" mean{median}."
        )
    return sentences


def _several(
    mine: pd.DataFrame, outcomes: pd.DataFrame, summary: pd.DataFrame, *, runs: int, method: str
) -> list[str]:
    """How many of several runs ended with formulas, with which, and how many are certified."""
    failed = outcomes[outcomes["status"] == Status.FAILED]["run"].nunique()
    sentences = [f"{runs - failed} of {runs} independent runs ended with formulas."]
    if failed:
        sentences.append(f"{failed} failed; they are listed below and count in no mean.")
    terms = summary[(summary["method"] == method) & summary["quantity"].str.startswith("U:")]
    found = terms[(terms["inclusion_frequency"] >= 0.5) & (terms["quantity"] != "U:1")]
    if len(found):
        listed = ", ".join(
            f"{term_text(str(row['quantity']).removeprefix('U:'))} ({_mean_text(row)})"
            for _, row in found.iterrows()
        )
        sentences.append(f"In most runs U has the terms {listed}.")
        rare = terms[(terms["inclusion_frequency"] > 0) & (terms["inclusion_frequency"] < 0.5)]
        if len(rare):
            names = ", ".join(term_text(quantity.removeprefix("U:")) for quantity in rare["quantity"])
            sentences.append(f"Found in some runs only, and not to be relied on: {names}.")
    certified = int(mine["certified"].sum())
    stated = mine[mine["certified"]]["stated_error"].dropna()
    if certified:
        within = (
            f"; the largest error that a certificate states is {share_text(stated.max())}"
            if len(stated)
            else ""
        )
        sentences.append(f"{certified} of {runs} runs are certified{within}.")
    if certified < runs:
        sentences.append(
            f"{runs - certified} of {runs} runs are not certified. A formula that is not certified may"
            f" belong to"
            " another landscape that fits just as well: do not build on it before you have checked it in"
            " another"
            " way."
        )
    return sentences


def _against_exact(
    errors: pd.Series, mine: pd.DataFrame, summary: pd.DataFrame, *, method: str, runs: int
) -> list[str]:
    """How far the formulas are from the exact ones, where these are known, and from what was published."""
    if not len(errors):
        return []
    correct = int(mine["support_correct"].fillna(False).sum())
    if runs == 1:
        right = "with exactly the right terms" if correct else "with wrong terms among them"
        return [
            f"Against the exact U the coefficients are off by {share_text(errors.iloc[0])} (relative root"
            f" mean"
            f" square), {right}."
        ]
    sentences = [
        f"Against the exact U the relative root mean square error of the coefficients is"
        f" {_with_spread(errors)}"
        f" (median {number_text(errors.median(), decimals=2)}, worst run"
        f" {number_text(errors.max(), decimals=2)}); {correct} of {len(errors)} runs found exactly the"
        f" right terms."
    ]
    published = summary[(summary["method"] == method) & (summary["quantity"] == "rrmse")]
    if len(published) and pd.notna(published["published"].iloc[0]):
        value = published["published"].iloc[0]
        sentences.append(
            f"The published figure is {number_text(value, decimals=2)}; ours is"
            f" {number_text(errors.mean() / value, decimals=2)} times that."
        )
    return sentences


def _mean_text(row: pd.Series) -> str:
    return value_text(float(row["mean"]), float(row["standard_deviation"]))


def _with_spread(values: pd.Series) -> str:
    return value_text(float(values.mean()), float(values.std()) if len(values) > 1 else float("nan"))


def control_sentences(certificates: pd.DataFrame) -> list[str]:
    """What became of the control, a network with its weights in random order; none where there is none.

    Parameters
    ----------
    certificates
        The table of that name. `same_as_refined` is no test of the control but a comparison.
    """
    mine = certificates[certificates["method"] == Method.CONTROL]
    if not len(mine):
        return []
    compared = mine["test"] == SAME
    certified = mine[~compared].groupby("run")["passed"].all()
    same = mine[compared].set_index("run")["passed"].reindex(certified.index, fill_value=False).astype(bool)
    runs = len(certified)
    sentence = (
        "As a control, a network with its weights in random order was refined and tested in the same way."
        " It was"
        f" refused in {int((~certified).sum())} of {runs} runs"
    )
    if (certified & same).any():
        sentence += f"; in {int((certified & same).sum())} refinement led from it to the same U all the same"
    false = int((certified & ~same).sum())
    if false:
        sentence += f"; in {false} ANOTHER U than the refined one was certified: believe neither"
    return [sentence + "."]
