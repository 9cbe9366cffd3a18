"""Official tests of all benchmarks: one table, and a figure of each."""

from workflow.warm import run_warm

run_warm()

from pathlib import Path
from typing import Any

import pandas as pd

from siq.data.public_recordings import BENCHMARKS
from siq.numerics.files import whole_file
from siq.report.plots.style import save_figure
from siq.systems.cards import load_system
from siq.workflow.tables import read_table, write_table
from step import job, read_json
from workflow.reproduction.official_tests import official_page, official_rows
from workflow.reproduction.plots import plot_official_tests


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    source, folder = snakemake.input, Path(snakemake.output.figures)
    folder.mkdir(parents=True, exist_ok=True)
    rows, verdicts = [], {}
    for name, table, runs, verdict, card in zip(
        snakemake.params.benchmarks, source.tables, source.runs, source.verdicts, source.cards, strict=True
    ):
        verdicts[name] = read_json(verdict)
        rows.append(official_rows(name, read_table(table)))
        system = load_system(card)
        unit = BENCHMARKS[name].unit if BENCHMARKS[name].factor == 1 else system.units[0]
        figure = plot_official_tests(read_table(runs), unit=unit, time_unit=system.time_unit)
        if figure is not None:
            save_figure(figure, folder / name)
    table = pd.concat(rows, ignore_index=True)
    write_table(snakemake.output.table, table)
    with whole_file(snakemake.output.page) as partial:
        partial.write_text(official_page(table, verdicts), encoding="utf-8")


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
