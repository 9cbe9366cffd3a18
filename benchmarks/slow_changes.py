"""How small a drift or a slow swing the claim *unchanged* notices, and how weak a gate *state_complete*.

    python -m benchmarks.slow_changes [SEEDS]

Double wells of `benchmarks.hostile`, 20,000 samples in one recording or in four, with a tilt, a curvature or
a noise that drifts from -a to a of its size in each recording, or a tilt that swings so many times; gates and
hidden variables of a strength; and the drift that the claim on the honest record says it would have shown in
four of five. The terms 1, x and x³ are given, and their coefficients fitted. Prints in how many records the
claims are refused at a certificate's rate.
"""

from __future__ import annotations

import re
import sys

import numpy as np

from benchmarks.hostile.catalogue import KINDS
from benchmarks.hostile.records import Record, Scene, Series, double_wells
from siq.data.recordings import Recordings, snapshot_pairs
from siq.inference.checks import PredictionLimits
from siq.inference.claims import check_claims
from siq.inference.field_estimate import FieldEstimate, Verdict
from siq.inference.library import IdentificationOptions, field_library
from siq.inference.regression import refit
from siq.numerics.integration import FlowMap
from siq.systems.diffusion import Diffusion

LIBRARY = field_library(["x"], IdentificationOptions(degree=3))
LIMIT = PredictionLimits().each
CHANGES = (
    ("tilt", 0.0, 0), ("tilt", 0.05, 0), ("tilt", 0.1, 0), ("curvature", 0.1, 0), ("noise", 0.05, 0),
    ("noise", 0.1, 0), ("tilt", 0.1, 1), ("tilt", 0.1, 2), ("tilt", 0.1, 3),
)  # fmt: skip
HIDDEN = (("gate", 0.3), ("gate", 0.5), ("hidden_slow_variable", 0.3), ("hidden_slow_variable", 0.6))


def changing(what: str, size: float, swings: int, seed: int, recordings: int) -> Record:
    """A double well of which something drifts, or swings so many times in each recording."""
    draw = np.random.default_rng([seed, 5])
    scene = Scene.drawn(np.random.default_rng(seed), recordings=(recordings,))
    phase = draw.uniform(0, 2 * np.pi)

    def change(t: np.ndarray, _: object) -> np.ndarray:
        course = np.sin(2 * np.pi * swings * t / t[-1] + phase) if swings else 2 * t / t[-1] - 1
        return np.asarray(size * course + (what != "tilt"))

    names = {"tilt": "push", "curvature": "curvature", "noise": "power"}
    flaw: dict[str, Series] = {names[what]: change}
    return Record.sampled(scene, double_wells(draw, scene, 1, **flaw))


def claimed(record: Record) -> dict[str, Verdict]:
    """The claims of a record, dimensionless as it is."""
    values = [one[:, None] for one in record.seen]
    recordings = Recordings.from_arrays(record.times, values, names=["x"])
    support = np.array([[0, LIBRARY.names.index(name)] for name in ("1", "x", "x**3")])
    intensity = np.array([[record.scene.intensity]])
    guess = FieldEstimate.on_support(
        LIBRARY, support, np.array([0.0, 1.0, -1.0]), np.eye(3), intensity, 0.1, FlowMap(1),
        Diffusion.identity(1),
    )  # fmt: skip
    found = refit(guess, snapshot_pairs(recordings))
    return check_claims(found, recordings, recordings, false_alarms=LIMIT)


def main(seeds: int) -> None:
    """Print the tables."""
    for recordings in (1, 4):
        for what, size, swings in CHANGES:
            found = [claimed(changing(what, size, swings, seed, recordings)) for seed in range(seeds)]
            counts = {name: sum(not one[name].passed for one in found) for name in found[0]}
            how = f"swings {swings} times" if swings else "drifts"
            print(f"{recordings} of {what:9s} {size:4.2f} {how:14s} of {seeds}: {counts}", flush=True)
        seen, made = 0, 0
        for seed in range(700, 700 + seeds):
            honest = changing("tilt", 0.0, 0, seed, recordings)
            stated = re.search(r"by ([0-9.]+) or more", claimed(honest)["unchanged"].reason)
            if stated is not None:
                width = float(np.concatenate(honest.seen).std())
                size = float(stated[1]) * honest.scene.intensity / (4 * width)
                made += 1
                seen += not claimed(changing("tilt", size, 0, seed, recordings))["unchanged"].passed
        print(f"{recordings} of a drift as stated: {seen} of {made}", flush=True)
    for name, strength in HIDDEN:
        found = [claimed(KINDS[name].record(seed, strength)) for seed in range(seeds)]
        print(name, strength, sum(not one["state_complete"].passed for one in found), "of", seeds, flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 16)
