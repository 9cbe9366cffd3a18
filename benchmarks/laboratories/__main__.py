"""Many records: laboratories × seeds × methods, two at a time, then the table and the figure.

    python -m benchmarks.laboratories [--seeds 100] [--only NAME ...] [--others 10] [--cores 2]

Each record is a file of its own below ``results/laboratories``: an interrupted run goes on where it was, and
more seeds add to those that are there. Remove the folder when the method has changed. A record that takes
longer than it may is said to have no answer.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from benchmarks.laboratories import figure, summary
from benchmarks.laboratories.models import LABORATORIES
from benchmarks.laboratories.one import MADE_BY, answers_of, file_of, write
from benchmarks.laboratories.others import OTHERS, SFI_PYTHON

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")  # one each: records run side by side
LONGEST = 1800.0  # seconds of one record with one method, on a machine that does other things, too


@dataclass(frozen=True)
class Task:
    """What is to be asked about one record."""

    laboratory: str
    seed: int
    method: str


def tasks(names: Sequence[str], seeds: int, others: int) -> list[Task]:
    """Seed by seed, so that a run that is stopped early knows a little of every laboratory."""
    methods = [name for name in OTHERS if name != "StochasticForceInference" or SFI_PYTHON in os.environ]
    return [
        Task(name, seed, method)
        for seed in range(seeds)
        for name in names
        for method in (["siq", *methods] if seed < others else ["siq"])
    ]


def run(task: Task, folder: Path) -> str:
    """Ask in a process of its own, which takes no other along when it fails; what went wrong, if anything."""
    file = file_of(folder, task.laboratory, task.seed)
    laboratory = LABORATORIES[task.laboratory]
    if task.method in answers_of(file, laboratory):
        return ""
    command = [
        sys.executable,
        "-m",
        "benchmarks.laboratories.one",
        task.laboratory,
        str(task.seed),
        str(folder),
    ]
    environment = {**os.environ, **dict.fromkeys(THREADS, "1")}
    try:
        done = subprocess.run(
            [*command, task.method], env=environment, capture_output=True, text=True, timeout=LONGEST,
            check=False,
        )  # fmt: skip
        fault = done.stderr.strip().splitlines()[-1] if done.returncode and done.stderr.strip() else ""
        fault = fault or (f"exit code {done.returncode}" if done.returncode else "")
    except subprocess.TimeoutExpired:
        fault = f"no answer within {LONGEST:.0f} s"
    if fault:
        none = {"certified": False, "barriers": [], "fault": fault}
        write(file, {MADE_BY: repr(laboratory), **answers_of(file, laboratory), task.method: none})
    return fault


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is missing, and say what came out."""
    parser = argparse.ArgumentParser(
        prog="benchmarks.laboratories", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--seeds", type=int, default=100, help="records of each laboratory")
    parser.add_argument(
        "--others", type=int, default=10, help="of these, how many other methods are asked about"
    )
    parser.add_argument(
        "--only", nargs="+", default=list(LABORATORIES), choices=list(LABORATORIES), metavar="NAME"
    )
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=Path("results/laboratories"))
    parser.add_argument("--table", action="store_true", help="only the table of what is there")
    chosen = parser.parse_args(arguments)
    if not chosen.table:
        wanted = tasks(chosen.only, chosen.seeds, chosen.others)
        # Two methods of one record write one file: they go one behind the other.
        groups: dict[tuple[str, int], list[Task]] = {}
        for task in wanted:
            groups.setdefault((task.laboratory, task.seed), []).append(task)

        def answered(group: list[Task]) -> list[tuple[Task, str]]:
            return [(each, run(each, chosen.folder)) for each in group]

        began, done = time.perf_counter(), 0
        with ThreadPoolExecutor(chosen.cores) as pool:
            running = [pool.submit(answered, group) for group in groups.values()]
            for finished in as_completed(running):
                done += 1
                for task, fault in finished.result():
                    if fault:
                        print(f"\n{task.laboratory} {task.seed}, {task.method}: {fault}", flush=True)
                minutes = (time.perf_counter() - began) / 60
                print(f"\r{done} of {len(groups)} records, {minutes:.0f} min", end="", flush=True)
        print()
    rows = summary.summarised(chosen.folder, chosen.only)
    print(summary.text(rows))
    figure.draw(rows, chosen.folder / "laboratories.png")


if __name__ == "__main__":
    main()
