"""Whether mean times by splitting are right: repetitions against a quadrature in one state.

``python benchmarks/splitting.py RATIO FIRST LAST FILE`` writes 20 rows for each seed from FIRST to before
LAST at ΔU/ε = RATIO; ``python benchmarks/splitting.py FILE ...`` says what such rows come to. The system is
``dx = (x - x³ + 0.1) dt + √ε dW``; the exact time is that of the backward equation, from the left state until
the core of the right one is entered.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import sympy
from scipy.integrate import cumulative_trapezoid

from siq.quasipotential.fokker_planck import CellProcess, cores_about
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import find_equilibria
from siq.systems.escapes import RUNS, Neighbourhood, split_escapes

BOX = np.array([[-2.0, 2.0]])
AT_ONCE = 20  # repetitions
POINTS = 400_001  # of the quadrature


def prepared(ratio: float) -> tuple[Dynamics, float, list[Neighbourhood], float]:
    """The system, ε, both cores, and the exact mean time."""
    x = sympy.Symbol("x", real=True)
    dynamics = Dynamics.of((x,), (x - x**3 + sympy.Rational(1, 10),), domain=BOX)
    found = sorted(
        find_equilibria(dynamics, np.linspace(-2, 2, 41)[:, None]), key=lambda one: one.position[0]
    )
    left, saddle, right = found

    def potential(place: np.ndarray) -> np.ndarray:
        return place**4 / 4 - place**2 / 2 - place / 10

    intensity = 2 * float(potential(saddle.position)[0] - potential(left.position)[0]) / ratio
    cores = cores_about(dynamics, [left, right], [[saddle], [saddle]], intensity)
    end = cores[1].center[0] - np.sqrt(2 * cores[1].level / cores[1].hessian[0, 0])
    grid = np.linspace(BOX[0, 0] - 0.5, end, POINTS)
    exponent = 2 * potential(grid) / intensity
    exponent -= exponent.min()
    inner = cumulative_trapezoid(np.exp(-exponent), grid, initial=0)
    within = grid >= left.position[0]
    exact = 2 / intensity * np.trapezoid(np.exp(exponent[within]) * inner[within], grid[within])
    return dynamics, intensity, cores, float(exact)


def repeated(ratio: float, seed: int) -> pd.DataFrame:
    """A row for each of some repetitions, made at once: runs of splitting know nothing of each other.

    What would be repeated with more walkers, as its error is above 10 %, counts as it is.
    """
    dynamics, intensity, cores, exact = prepared(ratio)
    progress = CellProcess(dynamics, intensity, BOX).between(cores[0], cores[1:]).progress
    begin = time.process_time()
    found = split_escapes(
        dynamics, cores[0], cores[1:], intensity=intensity, progress=progress,
        generator=np.random.default_rng(seed), runs=RUNS * AT_ONCE,
    )  # fmt: skip
    spent = (time.process_time() - begin) / AT_ONCE
    rows = []
    for own in np.arange(RUNS * AT_ONCE).reshape(AT_ONCE, RUNS):
        one = type(found).of(found.cycles[own], found.chances[own])
        rows.append(
            {
                "ratio": ratio, "seed": seed, "exact": exact, "value": one.value,
                "relative_error": one.relative_error, "lower": one.lower, "upper": one.upper,
                "seconds": spent,
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def summary(rows: pd.DataFrame) -> str:
    """Bias in its standard errors, spread, covering and seconds, for each ΔU/ε."""
    lines = []
    for ratio, some in rows.groupby("ratio"):
        share = some["value"] / some["exact"]
        bias, error = share.mean() - 1, share.std(ddof=1) / np.sqrt(len(some))
        covered = ((some["lower"] <= some["exact"]) & (some["exact"] <= some["upper"])).mean()
        lines.append(
            f"ΔU/ε = {ratio:g}: {len(some)} repetitions, bias {bias:+.4f} ± {error:.4f}, spread"
            f" {share.std(ddof=1):.3f}, stated {some['relative_error'].mean():.3f} (largest"
            f" {some['relative_error'].max():.3f}), 95 % intervals hold {covered:.1%},"
            f" {some['seconds'].mean():.1f} CPU s each"
        )
    return "\n".join(lines)


def main(arguments: list[str]) -> None:
    """Repeat, or sum up."""
    if Path(arguments[0]).suffix == ".csv":
        print(summary(pd.concat([pd.read_csv(one) for one in arguments])))
        return
    ratio, first, last, file = float(arguments[0]), int(arguments[1]), int(arguments[2]), Path(arguments[3])
    file.parent.mkdir(parents=True, exist_ok=True)
    for seed in range(first, last):
        repeated(ratio, seed).to_csv(file, mode="a", header=seed == first, index=False)


if __name__ == "__main__":
    main(sys.argv[1:])
