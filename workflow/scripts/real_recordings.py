"""How far simulations of a public benchmark are off on its held-out recordings, in its own units."""

from workflow.warm import run_warm

run_warm()

from typing import Any

import pandas as pd

from siq.data.public_recordings import BENCHMARKS
from siq.dynamics.cards import load_system
from siq.mismatch.case import read_case
from siq.mismatch.scores import root_mean_square
from siq.study.tables import read_table, write_table
from step import job


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    source, one = snakemake.input, BENCHMARKS[snakemake.params.benchmark]
    kept = read_case(source.card, source.recordings, source.get("study") or None).kept
    noise = read_table(source.noise)
    rows = []
    for simulation, card in (("recalibrated", source.recalibrated), ("augmented", source.system)):
        model = load_system(card)
        own = noise[(noise["stage"] == "recalibrated") & (noise["kind"] == "measurement")]
        for score, window in one.score.items():
            errors = root_mean_square(model, kept, variance=own["variance"].to_numpy(float), window=window)
            rows += [
                {
                    "simulation": simulation, "score": score, "output": name, "rms": one.factor * error,
                    "unit": one.unit, "published": one.published.get(score, ""),
                }
                for name, error in zip(model.output_names, errors, strict=True)
            ]  # fmt: skip
    write_table(snakemake.output.table, pd.DataFrame(rows))


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
