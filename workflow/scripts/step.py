"""What every script shares: its log, how it fails, and the outcome of a run that it leaves behind."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd

from siq.errors import InputError
from siq.files import whole_file
from siq.recordings import Recordings, read_recordings

METHODS = ("regression", "refined")
"""The paper's formulas, and ours, in the order of the tables."""

CONTROL = "randomised network"
"""What must never be certified: the U of a network with its weights in random order."""


@contextmanager
def job(snakemake: Any) -> Iterator[None]:
    """Run the body of a script: log to the rule's file, tell bad input in one sentence.

    An `InputError` ends the script with exit code 1 and its sentence, without a traceback. Any other
    exception is a fault of ours and shows where it happened.
    """
    log = Path(snakemake.log[0])
    log.parent.mkdir(parents=True, exist_ok=True)
    logging.basicConfig(
        filename=log, filemode="w", level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s"
    )
    logging.captureWarnings(True)
    try:
        yield
    except InputError as error:
        logging.error("%s", error)
        print(error, file=sys.stderr)
        sys.exit(1)
    except BaseException:
        logging.exception("the step stopped")
        raise


def outcome(run: int, step: str, status: str = "ok", reason: str = "", **details: Any) -> dict[str, Any]:
    """What became of one step of one run.

    `status` is ``ok``, ``warning`` (a result, with a reservation), ``failed`` (no result) or ``skipped``
    (a step before it failed).
    """
    if status != "ok":
        logging.warning("run %d, %s: %s, %s", run, step, status, reason)
    return {"run": run, "step": step, "status": status, "reason": reason, **details}


def write_outcomes(path: str | Path, outcomes: Sequence[dict[str, Any]]) -> None:
    """Write outcomes whole or not at all."""
    with whole_file(path) as partial:
        partial.write_text(json.dumps(list(outcomes), indent=1) + "\n", encoding="utf-8")


def read_outcomes(path: str | Path) -> list[dict[str, Any]]:
    """Read what `write_outcomes` wrote."""
    return json.loads(Path(path).read_text(encoding="utf-8"))


def read_json(path: str | Path) -> Any:
    """A JSON file's content, None where the file is empty since there was nothing to write."""
    text = Path(path).read_text(encoding="utf-8")
    return json.loads(text) if text else None


def position_of(run: int, training: str | Path) -> tuple[int | None, str]:
    """Where a run stands among the networks of its block, or None and the reason."""
    mine = next(entry for entry in read_outcomes(training) if entry["run"] == run)
    usable = mine["status"] in ("ok", "warning")
    return (mine["position"], "") if usable else (None, mine["reason"])


def pair_step(study: dict[str, Any]) -> float | None:
    """Largest time between the two samples of a pair: what the simulation had, or the study says."""
    if study["recordings"] is None:
        return study["simulation"]["pair_step"]
    return study["recordings"]["pair_step"]


def integrator_step(study: dict[str, Any]) -> float | None:
    """Step of the Euler–Maruyama simulation that made the recordings, None where none did."""
    if study["recordings"] is not None:
        return study["recordings"]["integrator_step"]
    simulation = study["simulation"]
    return simulation["pair_step"] / simulation["substeps"] if simulation["noise_intensity"] > 0 else None


def read_run(path: str | Path) -> Recordings | None:
    """The trajectories of a run, or None where drawing them failed and left an empty file."""
    return read_recordings(path) if Path(path).stat().st_size else None


def shown_formula(rrmse: pd.DataFrame, models: Sequence[str]) -> tuple[int | None, str]:
    """The run and the method whose formula is shown: refined where any run has one, otherwise as published.

    Of the runs with such a formula it is the median by error where errors are known, otherwise the first.
    """
    for method in reversed(METHODS):
        with_formula = [
            place
            for place, path in enumerate(models)
            if json.loads(Path(path).read_text(encoding="utf-8"))["methods"].get(method, {}).get("V")
        ]
        if with_formula:
            mine = rrmse[(rrmse["method"] == method) & rrmse["run"].isin(with_formula)]
            ranked = mine.dropna(subset="rrmse").sort_values("rrmse")
            if len(ranked):
                return int(ranked["run"].iloc[(len(ranked) - 1) // 2]), method
            return with_formula[0], method
    return None, METHODS[0]
