"""Forty concealed cases, every method asked about each, then scores, the table and the figure.

    python -m benchmarks.discrepancies [--folder results/discrepancies] [--seconds 60] [--methods NAME ...]

Each answer is a file of its own: an interrupted run goes on where it was. Keys are made again when all have
answered. Remove the folder, or the answers of one method, when that method has changed.

Others enter by files (docs/blind-test.md): ``--conceal`` makes the cases and stops there, ``--schema`` says
what an answer may hold, and ``--entries NAME`` scores the answers that somebody put beside the others.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.discrepancies import figure, summary
from benchmarks.discrepancies.answers import Answer, answer_file
from benchmarks.discrepancies.asking import ask
from benchmarks.discrepancies.cases import conceal, known_cases, open_keys, read_sets
from benchmarks.discrepancies.methods import METHODS
from benchmarks.discrepancies.scores import scored_case, write_scores

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def main(arguments: Sequence[str] | None = None) -> None:
    """Ask what has not been asked, and say what came out."""
    parser = argparse.ArgumentParser(
        prog="benchmarks.discrepancies", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--settings", type=Path, default=Path("config/discrepancies.yaml"))
    parser.add_argument("--folder", type=Path, default=Path("results/discrepancies"))
    parser.add_argument("--seconds", type=float, default=60.0, help="of a core, for each case and method")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS), metavar="NAME")
    parser.add_argument(
        "--cases", type=int, default=None, help="only the first so many cases are asked about"
    )
    parser.add_argument("--entries", nargs="+", default=[], metavar="NAME", help="whose answers are there")
    parser.add_argument("--conceal", action="store_true", help="only make the cases, and say where they are")
    parser.add_argument("--schema", action="store_true", help="only print the schema of an answer")
    parser.add_argument("--table", action="store_true", help="only the table of the scores that are there")
    chosen = parser.parse_args(arguments)
    if chosen.schema:
        print(json.dumps(Answer.model_json_schema(), indent=1))
        return
    if chosen.conceal:
        for case in conceal(read_sets(chosen.settings), chosen.folder):
            print(case.folder, "→", answer_file(chosen.folder, case.generator, case.name, "NAME"))
        return
    if any(os.environ.get(name) != "1" for name in THREADS):
        parser.error(f"every method is to have one core: set {', '.join(THREADS)} to 1")
    table = chosen.folder / "scores.parquet"
    if not chosen.table:
        sets = read_sets(chosen.settings)
        conceal(sets, chosen.folder)
        ask(
            list(known_cases(chosen.folder))[: chosen.cases],
            chosen.folder,
            chosen.methods,
            seconds=chosen.seconds,
        )
        with TemporaryDirectory() as keys:
            open_keys(sets, chosen.folder, Path(keys))
            rows = [
                row
                for case in list(known_cases(chosen.folder))[: chosen.cases]
                for row in scored_case(case, chosen.folder, Path(keys), [*chosen.methods, *chosen.entries])
            ]
        write_scores(rows, table)
    found = summary.summarised(table)
    summary.write(found, chosen.folder / "summary.parquet")
    print(summary.text(found))
    figure.draw(table, chosen.folder / "discrepancies.png")


if __name__ == "__main__":
    main()
