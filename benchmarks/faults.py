"""What an interruption costs: ``siq`` or its Snakemake is ended at random moments, and the study given again.

    python -m benchmarks.faults --moments 50 --log faults.jsonl

Each moment is a seed: it chooses the signal (SIGTERM, SIGINT, SIGKILL), the process that gets it, and when.
Then no process of the workflow may outlive it by half a minute, the same command given again has to end well,
nothing may be told as damaged, and all tables and formulas have to be those of a run that was left in peace,
bit by bit. Moments in the log are not made again. Processes are found by a mark in their environment, under
/proc: Linux alone.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from siq.workflow.answers import Provenance

ROOT = Path(__file__).resolve().parents[1]
MARK = "SIQ_FAULTS_MARK"
SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGKILL)
PATIENCE = 30.0  # seconds in which every process has to end, on a machine that is busy otherwise
FINISHING = 120.0  # seconds that Snakemake may take to end its jobs when it is asked to end
OF_THE_TIME = ("timings", "summary")  # tables with processor times


def recordings(path: Path, *, samples: int = 1500) -> None:
    """A state that relaxes, with noise: the shortest study that has a formula, a page and a certificate."""
    draw, x = np.random.default_rng(0), np.zeros(samples)
    for place in range(1, samples):
        x[place] = 0.95 * x[place - 1] + 0.1 * draw.normal()
    rows = [f"{0.05 * place:.6g},{value:.6f}" for place, value in enumerate(x)]
    path.write_text("t,x\n" + "\n".join(rows) + "\n", encoding="utf-8")


def start(folder: Path, mark: str) -> subprocess.Popen[str]:
    """``siq run`` of the recordings in a folder, in a group of its own."""
    paths = [str(ROOT), str(ROOT / "workflow" / "plugins"), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {MARK: mark, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    return subprocess.Popen(
        [sys.executable, "-m", "siq", "run", "--cores", "2", "record.csv"],
        cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True,
    )  # fmt: skip


def processes(mark: str) -> dict[int, str]:
    """The processes of a workflow, by their numbers; those that have ended and wait to be reaped are none."""
    found = {}
    for place in Path("/proc").glob("[0-9]*"):
        try:
            if f"{MARK}={mark}".encode() in (place / "environ").read_bytes().split(b"\0"):
                command = (place / "cmdline").read_bytes().replace(b"\0", b" ").decode("utf-8", "replace")
                if command:
                    found[int(place.name)] = command
        except OSError:
            continue
    return found


def contents(folder: Path) -> dict[str, str | None]:
    """Digests of all that has to be the same after an interruption."""
    place = folder / "results" / "record"
    files = [*place.rglob("*.parquet"), *place.rglob("*.csv"), *place.rglob("runs/*/*.json")]
    files += [place / "overview.json", place / "answer.json"]
    return {
        str(file.relative_to(place)): Provenance.digest_of(file)
        for file in files if not file.stem.startswith(OF_THE_TIME)
    }  # fmt: skip


def one_moment(seed: int, reference: dict[str, str | None], seconds: float, folder: Path) -> dict[str, Any]:
    """End a run at a moment of its time, give it again, and say what was wrong."""
    draw = np.random.default_rng(seed)
    number, moment = SIGNALS[seed % 3], float(draw.uniform(0, seconds))
    at_snakemake, mark = bool(draw.integers(2)), f"{seed}-{os.getpid()}"
    faults: list[str] = []
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    recordings(folder / "record.csv")
    process = start(folder, mark)
    time.sleep(moment)
    there = processes(mark)
    snakemake = [one for one, command in there.items() if " -m snakemake " in command]
    target = snakemake[0] if at_snakemake and snakemake else process.pid
    try:
        os.kill(target, number)
    except ProcessLookupError:
        moment = -moment  # it had ended
    deadline = time.monotonic() + FINISHING
    while target in processes(mark) and time.monotonic() < deadline:
        time.sleep(0.1)
    deadline = time.monotonic() + PATIENCE
    while (left := processes(mark)) and time.monotonic() < deadline:
        time.sleep(0.1)
    if left:
        faults.append(f"{len(left)} processes are left: {next(iter(left.values()))[:120]}")
        for one in left:
            os.kill(one, signal.SIGKILL)
    said = process.communicate()[0]
    if "Traceback" in said:
        faults.append(f"a traceback: {said[-300:]}")
    again = start(folder, f"{mark}-again")
    said = again.communicate()[0]
    if again.returncode:
        faults.append(f"the same command ended with {again.returncode}: {said[-400:]}")
    if "not as it was written" in said:
        faults.append(f"something was told as damaged: {said[-400:]}")
    if (found := contents(folder)) != reference:
        other = [name for name in {*found, *reference} if found.get(name) != reference.get(name)]
        faults.append(f"these differ: {other}")
    if halves := [str(file) for file in (folder / "results").rglob(".partial-*")]:
        faults.append(f"half a file: {halves}")
    name = "snakemake" if target != process.pid else "siq"
    return {"seed": seed, "signal": number.name, "to": name, "at": round(moment, 2), "faults": faults}


def run(seeds: list[int], log: Path) -> list[dict[str, Any]]:
    """End runs at moments that are not in the log; what came of all of them."""
    done = [json.loads(line) for line in log.read_text().splitlines()] if log.is_file() else []
    seeds = [seed for seed in seeds if seed not in {one["seed"] for one in done}]
    with tempfile.TemporaryDirectory(prefix="siq-faults-") as place:
        quiet = Path(place, "quiet")
        quiet.mkdir()
        recordings(quiet / "record.csv")
        began = time.monotonic()
        process = start(quiet, "quiet")
        said = process.communicate()[0]
        seconds = time.monotonic() - began
        if process.returncode:
            raise SystemExit(f"the run that was left in peace ended with {process.returncode}: {said}")
        reference = contents(quiet)
        for seed in seeds:
            done.append(one_moment(seed, reference, seconds, Path(place, f"moment-{seed}")))
            with log.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps(done[-1]) + "\n")
            shutil.rmtree(Path(place, f"moment-{seed}"), ignore_errors=True)
    return done


def main() -> None:
    """End runs at so many moments, and say what came of them."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.faults", description=__doc__)
    parser.add_argument("--moments", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--log", type=Path, default=Path("faults.jsonl"))
    given = parser.parse_args()
    told = run(list(range(given.first, given.first + given.moments)), given.log)
    wrong = [one for one in told if one["faults"]]
    print(f"{len(told)} moments, {len(wrong)} with a fault")
    for one in wrong:
        print(one)
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
