"""Studies by the published route, run by run in one process each, without the workflow.

    .venv/bin/python -m benchmarks.by_networks run archetype3d-noise 0 15
    .venv/bin/python -m benchmarks.by_networks table archetype3d-noise

`run` makes the runs from the first number up to the last, which is left out, as the workflow makes them:
trajectories, f, networks, their regression, the refined V, certificates and scores. Each leaves a file in
``results/by-networks/STUDY``, or in the folder ``$OUT``, and one that is there is not made again. `table`
counts verdicts, and compares every coefficient with the exact one, which nothing before the scores knows.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from siq.systems.cards import load_system
from siq.workflow.pipeline import draw_run, identify_run, refine_run, regress_run
from siq.workflow.study import load_study, settings_of
from siq.workflow.tables import Method
from siq.workflow.training import train_block
from workflow.scoring import exact_answer, score_run

ROOT = Path(__file__).parents[1]


def folder_of(study: str) -> Path:
    """Where the runs of a study leave their files."""
    return Path(os.environ.get("OUT", ROOT / "results" / "by-networks")) / study


def made(name: str, number: int) -> dict[str, Any]:
    """One run of a study: seconds, verdicts and errors, and its coefficients, as plain data."""
    study = load_study(ROOT / "config" / "studies" / f"{name}.yaml")
    card = ROOT / "config" / "systems" / f"{study.system}.yaml"
    system = load_system(card)
    settings, spent = settings_of(study, system), [time.process_time()]
    recordings = draw_run(settings, system, number=number).result
    identified = identify_run(settings, recordings, number=number)
    spent.append(time.process_time())
    trained = train_block(settings, {number: (recordings, identified.result)}, device="cpu")[0][number]
    spent.append(time.process_time())
    regressed = regress_run(settings, recordings, trained).result
    spent.append(time.process_time())
    refined = refine_run(settings, recordings, identified, trained, regressed)
    spent.append(time.process_time())
    scores = score_run(
        settings,
        {str(method): found for method, found in refined.formulas.items()},
        {str(method): told for method, told in refined.certificates.items()},
        trained.result, number=number, system=system, exact=exact_answer(card),
    )  # fmt: skip
    steps = ("identify", "train", "regress", "refine", "score")
    return {
        "run": number,
        "seconds": dict(zip(steps, np.diff([*spent, time.process_time()]).round(2).tolist(), strict=True)),
        "training": trained.outcome.reason,
        "refined": refined.outcome.reason,
        "certificates": {str(method): told for method, told in refined.certificates.items()},
        "errors": json.loads(scores["rrmse"].to_json(orient="records")),
        "prediction": scores["prediction"].groupby("method")["error"].mean().to_dict(),
        "coefficients": json.loads(scores["coefficients"].to_json(orient="records")),
    }


def run(name: str, first: int, last: int) -> None:
    """Make the runs that are not there yet."""
    torch.set_num_threads(1)
    folder = folder_of(name)
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(first, last):
        path = folder / f"{number:03d}.json"
        if not path.exists():
            told = made(name, number)
            path.write_text(json.dumps(told))
            print(number, told["seconds"], flush=True)


def table(name: str) -> None:
    """Print what the runs come to."""
    runs = [json.loads(path.read_text()) for path in sorted(folder_of(name).glob("*.json"))]
    agreements = [one["certificates"]["refined"]["tests"]["agreement"] for one in runs]
    controls = [one["certificates"][str(Method.CONTROL)]["tests"] for one in runs]
    compared = [each for each in agreements if each["passed"]]
    print(f"{len(runs)} runs, the networks' U agrees in {len(compared)}")
    for each in agreements:
        print(f"  difference {each['value']}, explained {each['limit']:.3f} {each['reason']}")
    refused = sum(not one["agreement"]["passed"] for one in controls if one)
    print(f"the control is refused in {refused} of {len(controls)}")
    for key in runs[0]["seconds"]:
        print(f"{key}: {np.mean([one['seconds'][key] for one in runs]):.1f} CPU s")
    errors = pd.DataFrame([row for one in runs for row in one["errors"]])
    columns = ["rrmse", "network_error", "stated_error", "support_correct", "certified"]
    print(errors.groupby("method")[columns].agg(["mean", "max"]).T.to_string())
    rows = pd.DataFrame([row for one in runs for row in one["coefficients"]])
    rows = rows[rows["component"].str.match("U|g_")]
    exact = rows[rows["exact"].fillna(0) != 0]
    exact = exact.assign(off=(exact["estimate"] / exact["exact"] - 1).abs())
    groups = exact.groupby(["method", "component", "term"], sort=False)["off"]
    told = groups.agg(rms=lambda off: np.sqrt((off**2).mean()), worst="max")
    print((100 * told).round(2).to_string())
    right = (rows["estimate"] != 0) == (rows["exact"] != 0)
    right |= (rows["component"] == "U") & (rows["term"] == "1")  # which follows from the others
    by_run = right.groupby([rows["method"], rows["component"].str[0], rows["run"]]).all()
    print(by_run.groupby(level=[0, 1]).agg(["sum", "size"]).to_string())


if __name__ == "__main__":
    if sys.argv[1] == "run":
        run(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
    else:
        table(sys.argv[2])
