"""Somebody new, in an empty folder, with a wheel and recordings of their own: how long until the answer.

    make newcomer

makes the wheel and runs this: a fresh environment, `pip install` of the wheel with its workflow, `siq run`
of a CSV file without any study, `siq diagnose` of a card and a CSV file. Ends with exit code 1 where an
answer is wrong or comes later than promised.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import laboratories
import pandas as pd

ROOT = Path(__file__).parents[1]
BARRIER_WITHIN, VERDICT_WITHIN = 300.0, 120.0  # seconds that the README promises on two cores
TRUE_BARRIER = 1 / 16  # of U, see laboratories.double_well


def main() -> int:
    """Be new; say what came, and when."""
    (wheel,) = (ROOT / "dist").glob("quasipotential-*.whl")
    failed = []
    with tempfile.TemporaryDirectory(prefix="newcomer-") as name:
        folder = Path(name)
        laboratories.write_studies(folder / "given")
        laboratories.write_cases(folder / "cases")
        began = time.perf_counter()
        programs = install(wheel, folder / "environment")
        installed = time.perf_counter() - began
        print(f"installed after {installed:.0f} s, {megabytes(folder / 'environment'):.0f} MB")

        (folder / "beads.csv").write_bytes((folder / "given" / "two-states.csv").read_bytes())
        seconds = timed([programs / "siq", "run", "beads.csv"], folder)
        certified, barriers = landscape_of(folder / "results" / "beads")
        print(f"siq run beads.csv: {seconds:.0f} s; certified {certified}, barriers {barriers}")
        if installed + seconds > BARRIER_WITHIN:
            failed.append(f"the barrier came after {installed + seconds:.0f} s")
        if certified != "all" or not barriers or max(abs(b - TRUE_BARRIER) for b in barriers) > 1e-3:
            failed.append(f"the barriers are {barriers}, certified {certified}; {TRUE_BARRIER} is true")

        seconds = timed([programs / "siq", "diagnose", "cases/missing-friction"], folder)
        verdict = json.loads(
            (folder / "results" / "mismatch" / "missing-friction" / "verdict.json").read_text("utf-8")
        )
        print(f"siq diagnose cases/missing-friction: {seconds:.0f} s; {verdict['verdict']}")
        if seconds > VERDICT_WITHIN:
            failed.append(f"the verdict came after {seconds:.0f} s")
        if "friction" not in json.dumps(verdict["mechanisms"]):
            failed.append("the verdict does not name friction")
    print("\n".join(failed) or "as promised")
    return int(bool(failed))


def install(wheel: Path, environment: Path) -> Path:
    """A fresh environment with the wheel and its workflow; where its programs are."""
    subprocess.run([sys.executable, "-m", "venv", environment], check=True)
    pinned = ROOT / "requirements" / "pinned.txt"
    subprocess.run(
        [environment / "bin" / "python", "-m", "pip", "install", "--quiet", "--constraint", pinned,
         f"quasipotential[workflow] @ {wheel.as_uri()}"],
        check=True,
    )  # fmt: skip
    return environment / "bin"


def timed(command: list[str | Path], folder: Path) -> float:
    """Run a command there, as somebody who has nothing of ours in the environment; its seconds."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    began = time.perf_counter()
    code = subprocess.run(command, cwd=folder, env=environment, check=False).returncode
    if code:
        print(f"{command[1:]} ended with exit code {code}")
    return time.perf_counter() - began


def landscape_of(results: Path) -> tuple[str, list[float]]:
    """Whether the formulas are certified, and the heights of the barriers of U."""
    answer = json.loads((results / "answer.json").read_text("utf-8"))
    table = pd.read_parquet(results / "tables" / "landscape.parquet")
    return answer["certified"], [float(value) for value in table["barrier"].dropna()]


def megabytes(folder: Path) -> float:
    """What a folder takes."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6


if __name__ == "__main__":
    sys.exit(main())
