"""Collect the tables of all runs of a study, and sum them up beside the published figures."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pandas as pd

from siq.scoring import summary_table
from siq.study import load_published
from siq.tables import as_table, concatenate, read_table, write_table
from step import job, read_outcomes

STEPS = ("simulate", "resample", "identify", "train", "regress", "refine", "score", "landscape")


def timings(folder: Path, runs: Iterable[int], *, drawing: str) -> pd.DataFrame:
    """Seconds of every step of every run; runs that trained side by side share their time evenly.

    `drawing` is what the outcomes call the step that draws trajectories.
    """
    rows = []
    for path in sorted(folder.glob("*/*.tsv")):
        first, _, last = path.parent.name.partition("-")
        together = [run for run in range(int(first), int(last or first) + 1) if run in runs]
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


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    source, target = snakemake.input, snakemake.output
    coefficients = concatenate("coefficients", [read_table(path) for path in source.coefficients])
    rrmse = concatenate("rrmse", [read_table(path) for path in source.rrmse])
    training = concatenate("training", [read_table(path) for path in source.histories])
    entries = [entry for path in source.outcomes for entry in read_outcomes(path)]
    order = {step: place for place, step in enumerate(STEPS)}
    entries.sort(key=lambda entry: (entry["run"], order[entry["step"]]))
    columns = ("run", "step", "status", "reason")
    outcomes = as_table("outcomes", [{key: entry[key] for key in columns} for entry in entries])
    prediction = concatenate("prediction", [read_table(path) for path in source.prediction])
    certificates = concatenate("certificates", [read_table(path) for path in source.certificates])
    for name, paths, path in (
        ("landscape", source.landscapes, target.landscape),
        ("degrees", source.degrees, target.degrees),
    ):
        write_table(path, concatenate(name, [read_table(one) for one in paths]))
    published = load_published(source.published).figures if source.get("published") else {}
    write_table(target.coefficients, coefficients)
    write_table(target.rrmse, rrmse)
    write_table(target.prediction, prediction)
    write_table(target.certificates, certificates)
    write_table(target.training, training)
    write_table(target.outcomes, outcomes)
    write_table(
        target.timings,
        timings(Path(snakemake.params.benchmarks), set(outcomes["run"]), drawing=entries[0]["step"]),
    )
    write_table(target.summary, summary_table(coefficients, rrmse, prediction, published))


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
