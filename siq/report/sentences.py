"""The answer in words: sentences that a report opens with, made from the tables."""

from __future__ import annotations

import pandas as pd

from siq.steps.outcomes import Method, Status

SAME = "same_as_refined"  # the row of a control that compares it with the refined V


def answer_sentences(
    rrmse: pd.DataFrame, outcomes: pd.DataFrame, summary: pd.DataFrame, *, runs: int, method: str
) -> list[str]:
    """Say what came out: how many runs, how far they agree, how exact they are, and what to make of it.

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
    """
    mine = rrmse[rrmse["method"] == method]
    terms = summary[(summary["method"] == method) & summary["quantity"].str.startswith("U:")]
    failed = outcomes[outcomes["status"] == Status.FAILED]["run"].nunique()
    sentences = [f"{runs - failed} of {runs} independent runs ended with formulas."]
    if failed:
        sentences.append(f"{failed} failed; they are listed below and count in no mean.")
    found = terms[(terms["inclusion_frequency"] >= 0.5) & (terms["quantity"] != "U:1")]
    if len(found):
        listed = ", ".join(
            f"{str(row['quantity']).removeprefix('U:')} ({_mean_text(row)})" for _, row in found.iterrows()
        )
        sentences.append(f"The quasipotential U has, in most runs, the terms {listed}.")
        rare = terms[(terms["inclusion_frequency"] > 0) & (terms["inclusion_frequency"] < 0.5)]
        if len(rare):
            names = ", ".join(quantity.removeprefix("U:") for quantity in rare["quantity"])
            sentences.append(f"Found in some runs only, and not to be relied on: {names}.")
    errors = mine["rrmse"].dropna()
    if len(errors):
        correct = int(mine["support_correct"].fillna(False).sum())
        sentences.append(
            f"Against the exact U the relative root mean square error of the coefficients is"
            f" {_with_spread(errors)} (median {errors.median():.2e}, worst run {errors.max():.2e});"
            f" {correct} of {len(errors)} runs found exactly the right terms."
        )
        published = summary[(summary["method"] == method) & (summary["quantity"] == "rrmse")]
        if len(published) and pd.notna(published["published"].iloc[0]):
            value = published["published"].iloc[0]
            sentences.append(
                f"The published figure is {value:.2e}, so ours is {errors.mean() / value:.3g} times that."
            )
    else:
        sentences.append(
            "No exact answer is known for these data: the errors stated are those that certificates bound."
        )
    networks = mine["network_error"].dropna()
    if len(networks):
        sentences.append(
            f"The networks' U, before any formula, is off by {_with_spread(networks)} (relative L2 over the"
            " domain, which reaches beyond the recorded points)."
        )
    certified = int(mine["certified"].sum())
    stated = mine[mine["certified"]]["stated_error"].dropna()
    if certified:
        within = f", to within {stated.max():.1e} of V at worst" if len(stated) else ""
        sentences.append(f"{certified} of {runs} runs are certified{within}.")
    if certified < runs:
        sentences.append(
            f"{runs - certified} of {runs} runs are not certified. A formula that is not certified may"
            " belong to a false decomposition that fits just as well: do not build on it without an"
            " independent test."
        )
    predicted = summary[(summary["method"] == method) & (summary["quantity"] == "prediction_error")]
    if len(predicted):
        row = predicted.iloc[0]
        sentences.append(
            f"f predicts unseen trajectories with a relative error of {row['mean']:.2e} in the mean"
            f" (median {row['median']:.2e})."
        )
    return sentences


def _mean_text(row: pd.Series) -> str:
    text = f"{row['mean']:.4g}"
    if pd.notna(row["standard_deviation"]):
        text += f" ± {row['standard_deviation']:.1g}"
    return text


def _with_spread(values: pd.Series) -> str:
    return f"{values.mean():.2e}" + (f" ± {values.std():.1e}" if len(values) > 1 else "")


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
        "The control, a network with its weights in random order that was refined and tested as the real one,"
        f" was refused in {int((~certified).sum())} of {runs} runs"
    )
    if (certified & same).any():
        sentence += f"; in {int((certified & same).sum())} refinement led from it to the same V all the same"
    false = int((certified & ~same).sum())
    if false:
        sentence += f"; in {false} ANOTHER V than the refined one was certified: believe neither"
    return [sentence + "."]
