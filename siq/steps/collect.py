"""Collect: what do all runs of a study say together, beside the published figures?"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import pandas as pd

from siq.steps.outcomes import Outcome, Step
from siq.study.published_figures import PublishedFigure
from siq.study.scoring import summary_table
from siq.study.tables import as_table, concatenate

OF_RUNS = (
    "coefficients", "rrmse", "prediction", "certificates", "record", "record_density", "landscape", "degrees",
    "training",
)  # fmt: skip
"""Tables that every run, or every block of runs, has a part of."""


def run(
    parts: Mapping[str, Sequence[pd.DataFrame]],
    outcomes: Sequence[Outcome],
    published: Mapping[str, PublishedFigure],
    *,
    benchmarks: Path,
) -> dict[str, pd.DataFrame]:
    """The tables of a study by name.

    Parameters
    ----------
    parts
        The parts of each of the tables `OF_RUNS`.
    outcomes
        Of every step of every run.
    published
        Figures to be set beside ours.
    benchmarks
        Folder of the times that the workflow measured.
    """
    tables = {name: concatenate(name, list(parts[name])) for name in OF_RUNS}
    order = list(Step)
    entries = sorted(outcomes, key=lambda one: (one.run, order.index(one.step)))
    tables["outcomes"] = as_table(
        "outcomes",
        [
            {"run": one.run, "step": str(one.step), "status": str(one.status), "reason": one.reason}
            for one in entries
        ],
    )
    tables["timings"] = timings(benchmarks, {one.run for one in entries}, drawing=str(entries[0].step))
    tables["summary"] = summary_table(
        tables["coefficients"], tables["rrmse"], tables["prediction"], published
    )
    return tables


def timings(folder: Path, runs: Iterable[int], *, drawing: str) -> pd.DataFrame:
    """Seconds of every step of every run; runs that trained side by side share their time evenly.

    `drawing` is what the outcomes call the step that draws trajectories.
    """
    known, rows = set(runs), []
    for path in sorted(folder.glob("*/*.tsv")):
        first, _, last = path.parent.name.partition("-")
        together = [run for run in range(int(first), int(last or first) + 1) if run in known]
        seconds = float(pd.read_csv(path, sep="\t")["s"].iloc[0])
        rows += [
            {
                "run": run,
                "step": drawing if path.stem == "draw" else path.stem,
                "seconds": seconds / len(together),
            }
            for run in together
        ]
    return as_table("timings", rows).sort_values(["run", "step"], ignore_index=True)
