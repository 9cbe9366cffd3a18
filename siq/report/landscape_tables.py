"""What the page of a study says of its landscape."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from siq.report.page import ReportFigure, ReportTable
from siq.steps.outcomes import Status, Step

CAPTIONS = {
    "landscape": "The quasipotential U over all wells, where its formulas are believed, with attractors,"
    " saddles and paths of least action (solid: uphill, dashed: downhill).",
    "landscape_errors": "U by every source, and its difference from characteristics of the exact vector field"
    " (the paper: fig2b, c to e, and Appendix E).",
    "landscape_published": "What was published of U, its formula as printed and, where SIQ_RESOURCES has it,"
    " its mesh, and its difference from characteristics of the exact vector field.",
    "degrees": "Accuracy of the formula about each attractor on points that took no part in the fit, against"
    " its number of terms.",
    "escape": "Mean escape times: the law from what was identified, and direct simulations of the card.",
}


def landscape_sentences(landscape: pd.DataFrame, outcomes: pd.DataFrame) -> list[str]:
    """Why there is no landscape, where f was followed and led to no attractor.

    Parameters
    ----------
    landscape, outcomes
        The tables of these names.
    """
    asked = outcomes[
        (outcomes["step"] == Step.LANDSCAPE) & outcomes["status"].isin([Status.WARNING, Status.FAILED])
    ]
    without = asked[~asked["run"].isin(landscape[landscape["kind"] == "attractor"]["run"])]
    if without.empty:
        return []
    which = (
        ""
        if len(without) == outcomes["run"].nunique()
        else f" of {len(without)} of {outcomes['run'].nunique()} runs"
    )
    return [f"There is no landscape{which}: {without['reason'].iloc[0]}."]


def landscape_tables(
    landscape: pd.DataFrame, errors: pd.DataFrame | None, escape: pd.DataFrame | None, folder: Path
) -> list[ReportTable]:
    """Equilibria, transitions, errors and escape times, where the study asked for a landscape.

    Parameters
    ----------
    landscape, errors, escape
        The tables `landscape`, `landscape_errors` and `escape`; the latter two with a card only.
    folder
        Where the whole tables are.
    """
    if landscape.empty:
        return []
    first = landscape[landscape["run"] == landscape["run"].min()].drop(columns="run")
    ways = landscape[landscape["kind"] == "transition"]
    tables = [
        ReportTable(
            f"Landscape of run {landscape['run'].min()}: equilibria, and the ways out of each well.",
            first.dropna(axis=1, how="all").rename(columns=lambda name: name.replace("_", " ")),
            {
                "U": "above its lowest attractor",
                "basin": "share of the recorded states that f leads there",
                "barrier": "of U, by the formula of the well and the end of the path of least action",
                "standard error": "of the barrier, from the uncertainty of f",
                "formula share": "share of the barrier that the formula accounts for",
                "minimum action": "the same barrier by the path alone, without any formula",
                "prefactor": "of the mean escape time prefactor · exp(barrier/ε)",
            },
            f"{folder}/landscape.csv",
            30,
        ),
        ReportTable(
            "Barriers of U over all runs.",
            ways.groupby("item", sort=False)
            .agg(
                runs=("barrier", "size"), mean=("barrier", "mean"), lowest=("barrier", "min"),
                highest=("barrier", "max"), minimum_action=("minimum_action", "mean"),
                prefactor=("prefactor", "mean"),
            )
            .reset_index()
            .rename(columns=lambda name: name.replace("_", " ")),
            {},
            f"{folder}/landscape.csv",
            30,
        ),
    ]  # fmt: skip
    if errors is not None:
        tables.append(errors_table(errors, folder))
    if escape is not None:
        tables.append(
            ReportTable(
                "Mean escape times, in the time unit of the card: the law, and simulations with their"
                " standard error.",
                escape.rename(columns=lambda name: name.replace("_", " ")),
                {},
                f"{folder}/escape.csv",
                30,
            )
        )
    return tables


def errors_table(errors: pd.DataFrame, folder: Path) -> ReportTable:
    """Relative L2 errors of U over the runs, by source and region."""
    counted = (
        errors.groupby(["source", "region"], sort=False)
        .agg(
            runs=("error", "size"), mean_error=("error", "mean"), worst_error=("error", "max"),
            least_covered=("covered", "min"), worst_everywhere=("error_everywhere", "max"),
        )
        .reset_index()
        .rename(columns=lambda name: name.replace("_", " "))
    )  # fmt: skip
    return ReportTable(
        "Relative L2 error of U against characteristics of the exact vector field; of barriers, against the"
        " minimum action.",
        counted,
        {
            "least covered": "smallest share of the region at which a source says anything",
            "worst everywhere": "of the formulas at every point of the region, believed or not",
            "source": "networks and regression are ours, by the published method; what was published is only"
            " scored. The digits of its formula that are not printed were drawn 100 times: one run each",
        },
        f"{folder}/landscape_errors.csv",
        40,
    )


def landscape_figures(images: Mapping[str, bytes]) -> list[ReportFigure]:
    """The figures of the landscape, none where none was asked for; `images` by their names."""
    return [
        ReportFigure(caption, caption, images[name], "png")
        for name, caption in CAPTIONS.items()
        if name in images
    ]
