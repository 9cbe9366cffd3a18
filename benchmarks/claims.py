"""How weak a flaw the claims of a certificate notice, and how often they refuse honest records.

    python -m benchmarks.claims [SEEDS]

Records of ``dx = (x - x³) dt + √0.25 dW``, 40,000 samples 0.05 apart, about fifty hops, with one flaw each,
of several strengths. The terms x and x³ are given, and their coefficients fitted; what is tested is
`siq.inference.claims.check_claims` at a certificate's rate of 5 %. Prints for each flaw and strength in how
many of the records each claim is refused.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator

import numpy as np

from siq.data.recordings import Recordings, snapshot_pairs
from siq.inference.checks import PredictionLimits
from siq.inference.claims import check_claims
from siq.inference.field_estimate import FieldEstimate, Verdict
from siq.inference.library import IdentificationOptions, field_library
from siq.inference.regression import refit
from siq.numerics.integration import FlowMap
from siq.systems.diffusion import Diffusion

STEP, WITHIN, SAMPLES, INTENSITY = 0.05, 4, 40_000, 0.25
LIBRARY = field_library(["x"], IdentificationOptions(degree=3))
LIMIT = PredictionLimits().each
Flaw = Callable[[np.ndarray, float, dict[str, np.ndarray], np.random.Generator, float], np.ndarray]


def _swing(
    x: np.ndarray, time: float, hidden: dict[str, np.ndarray], draw: object, size: float
) -> np.ndarray:
    return np.full_like(x, size * np.cos(2 * np.pi * time / 10))


def _drift(
    x: np.ndarray, time: float, hidden: dict[str, np.ndarray], draw: object, size: float
) -> np.ndarray:
    return np.full_like(x, size * (2 * time / (SAMPLES * STEP) - 1))


def _slow_variable(
    x: np.ndarray, time: float, hidden: dict[str, np.ndarray], draw: np.random.Generator, size: float
) -> np.ndarray:
    h, memory = STEP / WITHIN, 15.0
    before = hidden.setdefault("y", draw.standard_normal(len(x)))
    hidden["y"] = before * (1 - h / memory) + np.sqrt(2 * h / memory) * draw.standard_normal(len(x))
    return size * hidden["y"]


def _gate(
    x: np.ndarray, time: float, hidden: dict[str, np.ndarray], draw: np.random.Generator, size: float
) -> np.ndarray:
    before = hidden.setdefault("gate", np.ones(len(x)))
    hidden["gate"] = np.where(draw.random(len(x)) < STEP / WITHIN / 30.0, -before, before)
    return size * hidden["gate"]


def _memory(
    x: np.ndarray, time: float, hidden: dict[str, np.ndarray], draw: object, size: float
) -> np.ndarray:
    mean = hidden.setdefault("mean", np.zeros(len(x)))
    hidden["mean"] = mean + (x - mean) * STEP / WITHIN / 5.0
    return -size * hidden["mean"]


def _jumps(
    x: np.ndarray, time: float, hidden: dict[str, np.ndarray], draw: np.random.Generator, size: float
) -> np.ndarray:
    h = STEP / WITHIN  # one in ten units of time
    return np.where(draw.random(len(x)) < 0.1 * h, size * draw.choice([-1, 1], len(x)) / h, 0.0)


def _offset(
    x: np.ndarray, time: float, hidden: dict[str, np.ndarray], draw: object, size: float
) -> np.ndarray:
    return np.zeros_like(x)


FLAWS: dict[Flaw, tuple[float, ...]] = {
    _swing: (0.0, 0.05, 0.1, 0.15),
    _drift: (0.1, 0.15, 0.2),
    _slow_variable: (0.1, 0.15, 0.2),
    _gate: (0.1, 0.15, 0.2),
    _memory: (0.05, 0.1, 0.2),
    _jumps: (0.3, 0.5, 0.7),
    _offset: (0.1, 0.2, 0.3),
}


def simulated(flaw: Flaw, size: float, seeds: int) -> np.ndarray:
    """Records of a flaw of some size: shape ``(seeds, samples)``."""
    draw, h, hidden = np.random.default_rng(7), STEP / WITHIN, dict[str, np.ndarray]()
    x, seen = np.sign(draw.standard_normal(seeds)), np.empty((seeds, SAMPLES))
    for k in range(SAMPLES):
        seen[:, k] = x
        for part in range(WITHIN):
            force = x - x**3 + flaw(x, k * STEP + part * h, hidden, draw, size)
            x = x + h * force + np.sqrt(INTENSITY * h) * draw.standard_normal(seeds)
    return seen


def tested(flaw: Flaw, size: float, seeds: int) -> Iterator[dict[str, Verdict]]:
    """The claims of each record; of an offset, of eight recordings of which one has it."""
    support = np.array([[0, LIBRARY.names.index(name)] for name in ("x", "x**3")])
    guess = FieldEstimate.on_support(
        LIBRARY, support, np.array([1.0, -1.0]), np.eye(2), np.array([[INTENSITY]]), 0.1, FlowMap(1),
        Diffusion.identity(1),
    )  # fmt: skip
    for record in simulated(flaw, size, seeds):
        parts = record.reshape(8, -1, 1) if flaw is _offset else record.reshape(1, -1, 1)
        parts = parts + (size * (np.arange(len(parts)) == 3)[:, None, None] if flaw is _offset else 0.0)
        recordings = Recordings.from_arrays(STEP * np.arange(parts.shape[1]), parts, names=["x"])
        found = refit(guess, snapshot_pairs(recordings))
        yield check_claims(found, recordings, recordings, false_alarms=LIMIT)


def main(seeds: int) -> None:
    """Print the tables."""
    for flaw, sizes in FLAWS.items():
        for size in sizes:
            found = list(tested(flaw, size, seeds))
            counts = {name: sum(not one[name].passed for one in found) for name in found[0]}
            whole = sum(not all(verdict.passed for verdict in one.values()) for one in found)
            print(f"{flaw.__name__:14s} {size:5.2f}  any {whole:3d} of {seeds}  {counts}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 40)
