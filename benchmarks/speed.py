"""How long does what people wait for take, as a time series, and is anything slower than it was?

    make speed                                # measures, compares, and appends to benchmarks/speed.csv
    python -m benchmarks.speed --only plan

Each task runs in a process of its own, `REPEATS` times; the least processor time counts. Beside it stands
that of a fixed calculation, measured just before and after, since machines differ and are shared. Compared is
the ratio of both, with the median of the last `EARLIER` rows of the same task. What is slower by more than a
fifth is said, and the exit code counts it.
"""

from __future__ import annotations

import argparse
import csv
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median

ROOT = Path(__file__).parents[1]
SERIES = ROOT / "benchmarks" / "speed.csv"
COLUMNS = ("day", "commit", "python", "task", "seconds", "reference")
REPEATS, EARLIER = 3, 5
ALLOWED = 1.2  # of what it was

# About a second of Python objects, small arrays and linear algebra, which the tasks are made of.
REFERENCE = """
import numpy as np
square = np.random.default_rng(0).standard_normal((200, 200))
for _ in range(60):
    np.linalg.eigvals(square)
    for number in range(20_000):
        np.sqrt(1.0 * number), {number: str(number)}
"""
TASKS = {
    "import": "import siq; siq.Landscape; siq.diagnose",
    "equations": """
from siq.quasipotential.landscape_assembly import landscape_from_equations
from siq.systems.cards import load_system
assert landscape_from_equations(load_system("config/systems/maier-stein.yaml")).transitions
""",
    "recordings": """
from pathlib import Path
import siq
from siq.workflow.examples import double_well_recordings
Path(folder, "example.csv").write_text(double_well_recordings())
assert siq.Landscape.from_recordings(siq.read_recordings(Path(folder, "example.csv"))).transitions
""",
    "plan": """
import subprocess
from pathlib import Path
study = Path(folder, "many.yaml")
study.write_text("{name: many, system: archetype3d, runs: 1000}")
options = ["-s", "Snakefile", "-d", folder, "--cores", "1", "-n", "--quiet", "all", "--configfile", study]
subprocess.run([sys.executable, "-m", "snakemake", *options, "--", "results/many/report.html"], check=True)
""",
}
"""What is measured, as scripts that run in the root of the repository and may write in a `folder`."""


def seconds(script: str) -> float:
    """The least processor time of a script and all that it starts."""
    taken = []
    for _ in range(REPEATS):
        with tempfile.TemporaryDirectory() as folder:
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            whole = f"import sys\nfolder = {folder!r}\n{script}"
            subprocess.run([sys.executable, "-c", whole], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
        taken.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(taken)


def slower(rows: Sequence[dict[str, str]], new: dict[str, str]) -> float | None:
    """How much slower than before a new row is, as a ratio; None where it is not, or is the first."""
    earlier = [_ratio(row) for row in rows if row["task"] == new["task"]][-EARLIER:]
    ratio = _ratio(new) / median(earlier) if earlier else 1.0
    return ratio if ratio > ALLOWED else None


def _ratio(row: dict[str, str]) -> float:
    return float(row["seconds"]) / float(row["reference"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, compare and append; the exit code is the number of tasks that are slower."""
    parser = argparse.ArgumentParser(prog="benchmarks.speed", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", default=list(TASKS), choices=list(TASKS), metavar="TASK")
    parser.add_argument("--series", type=Path, default=SERIES, help="the file of all that was measured")
    chosen = parser.parse_args(arguments)
    rows: list[dict[str, str]] = []
    if chosen.series.is_file():
        with chosen.series.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    describe = ["git", "describe", "--always", "--dirty"]
    commit = subprocess.run(describe, cwd=ROOT, capture_output=True, text=True).stdout.strip()
    faults = 0
    for task in chosen.only:
        before = seconds(REFERENCE)
        taken = seconds(TASKS[task])
        reference = (before + seconds(REFERENCE)) / 2
        values = (time.strftime("%Y-%m-%d"), commit, platform.python_version(), task)
        new = dict(zip(COLUMNS, (*values, f"{taken:.2f}", f"{reference:.2f}"), strict=True))
        ratio = slower(rows, new)
        faults += ratio is not None
        print(f"{task}: {taken:.2f} s" + (f", {ratio:.2f} times what it was" if ratio else ""), flush=True)
        begun = chosen.series.is_file()
        with chosen.series.open("a", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            if not begun:
                writer.writeheader()
            writer.writerow(new)
    return faults


if __name__ == "__main__":
    sys.exit(main())
