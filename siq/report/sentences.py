"""What do all runs of a study say together, in words? Made from its tables."""

from __future__ import annotations

import pandas as pd

from siq.numerics.measured_text import value_text
from siq.numerics.number_text import number_text
from siq.report.certificate_text import share_text
from siq.report.formatting import term_text
from siq.steps.outcomes import Method, Status

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
