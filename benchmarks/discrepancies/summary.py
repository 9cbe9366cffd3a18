"""What came out: one row for each method and generator."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.discrepancies.scores import CARD, CONCEALING
from benchmarks.proof.scoring import NOISE, NOTHING_CONCEALED
from workflow.files import read_table, write_table

GENERATORS = {"concealment": "named physics", "foreign": "drawn functions"}


def summarised(path: Path) -> pd.DataFrame:
    """Read the scores, and count."""
    return summary_of(read_table(path))


def summary_of(scores: pd.DataFrame) -> pd.DataFrame:
    """Counts, quartiles and times by generator and method.

    Errors are those of cases that conceal a function: of all of them, and a simulation that runs away counts
    as infinitely wrong.
    """
    found = []
    for (generator, method), rows in scores.groupby(["generator", "method"], sort=False):
        concealing, knowable = rows["kind"].isin(CONCEALING), rows["knowable"]
        nameable = rows["nameable"] & (knowable | (rows["kind"] == NOISE))
        low, middle, high = quartiles(rows.loc[concealing, "error_ratio"].to_numpy(float))
        found.append(
            {
                "generator": generator,
                "method": method,
                "cases": len(rows),
                "quiet": int(rows["kind"].isin(NOTHING_CONCEALED).sum()),
                "false_alarms": int(rows["false_alarm"].sum()),
                "knowable": int(knowable.sum()),
                "detected": int((rows["detected"] & knowable).sum()),
                "equations_right": int((rows["equation_right"] & knowable).sum()),
                "places_right": int((rows["place_right"] & knowable).sum()),
                "nameable": int(nameable.sum()),
                "names_right": int((rows["name_right"] & nameable).sum()),
                "names_wrong": int(rows["name_wrong"].sum()),
                "concealing": int(concealing.sum()),
                "error_ratio_low": low,
                "error_ratio": middle,
                "error_ratio_high": high,
                "ran_away": int(np.isinf(rows["error"]).sum()),
                "no_answer": int((~rows["answered"] & rows["applied"]).sum()),
                "not_applied": int((~rows["applied"]).sum()),
                "seconds": float(rows["seconds"].median()),
            }
        )
    return pd.DataFrame(found)


def quartiles(values: np.ndarray) -> tuple[float, float, float]:
    """Quartiles of values some of which may be infinite."""
    known = values[~np.isnan(values)]
    if not len(known):
        return np.nan, np.nan, np.nan
    low, middle, high = (float(np.quantile(known, each, method="inverted_cdf")) for each in (0.25, 0.5, 0.75))
    return low, middle, high


def write(found: pd.DataFrame, path: Path) -> None:
    """Write the summary, with a CSV beside it."""
    write_table(path, found)


HEAD = (
    "| cases | method | false alarms | detected | equation right | place right | name right | wrong names"
    " | error over the oracle’s, median (quartiles) | ran away | no answer | cannot be applied"
    " | seconds, median |"
)


def text(found: pd.DataFrame) -> str:
    """As a table in Markdown."""
    lines = [HEAD, "|" + "---|" * (HEAD.count("|") - 1)]
    one: Any
    for one in found.itertuples():
        label = GENERATORS[str(one.generator)]
        error = f"{number(one.error_ratio)} ({number(one.error_ratio_low)} to {number(one.error_ratio_high)})"
        if one.method == CARD:
            cells = [label, CARD, *["–"] * 6, error, str(one.ran_away), *["–"] * 3]
        else:
            names = f"{one.names_right} of {one.nameable}" if one.nameable else "–"
            cells = [
                label, str(one.method), f"{one.false_alarms} of {one.quiet}",
                f"{one.detected} of {one.knowable}", f"{one.equations_right} of {one.knowable}",
                f"{one.places_right} of {one.knowable}", names, str(one.names_wrong), error,
                str(one.ran_away), str(one.no_answer), str(one.not_applied), f"{one.seconds:.0f}",
            ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def number(value: float) -> str:
    """A ratio with three digits at most."""
    if np.isinf(value):
        return "∞"
    return f"{value:.2f}" if value < 10 else f"{value:.0f}"
