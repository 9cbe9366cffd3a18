"""What do other methods say of a record?

Each gives polynomials f and q; wells and barriers follow from these as the true ones do, without a formula of
V. None of them certifies anything, and their intervals are not asked for.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.laboratories.answers import Answer
from benchmarks.laboratories.models import Laboratory, Monomial
from benchmarks.laboratories.polynomials import drift, jacobian, polynomials
from benchmarks.laboratories.truths import Truth, barrier, rest_near
from siq.errors import NumericalFailure

DEGREE = 3  # of f: that of every laboratory, which these methods are told
BINS = 30  # of each state, for conditional averages
FEWEST = 20  # increments in a bin whose mean is used
CONTRIBUTES = (
    0.05  # share of the drift's size below which PySINDy drops a term; its own default is 0.1 outright
)
SFI_PYTHON = "SFI_PYTHON"  # environment variable: a Python that has StochasticForceInference
PATIENCE = 1800.0  # seconds that it is given


def exponents(laboratory: Laboratory, degree: int) -> list[Monomial]:
    """Of all monomials up to a degree."""
    every = itertools.product(range(degree + 1), repeat=laboratory.dimension)
    return [each for each in every if sum(each) <= degree]


def noise_exponents(laboratory: Laboratory) -> list[Monomial]:
    """Monomials in which q is sought: a constant where it is one."""
    return exponents(laboratory, max(map(sum, laboratory.intensity)))


def values(powers: list[Monomial], x: np.ndarray) -> np.ndarray:
    """Of monomials at points ``(n, d)``: shape ``(n, terms)``."""
    return np.stack([np.prod(x ** np.array(each), axis=1) for each in powers], axis=1)


def increments(laboratory: Laboratory, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States, and how fast they change until the next sample."""
    d = laboratory.dimension
    return seen[:, :-1].reshape(-1, d), np.diff(seen, axis=1).reshape(-1, d) / laboratory.step


def least_squares(terms: np.ndarray, wanted: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Coefficients, of columns whose sizes differ much."""
    size = np.sqrt((terms**2).mean(axis=0))
    root = np.ones(len(terms)) if weights is None else np.sqrt(weights)
    scaled = root[:, None] * terms / size
    return np.linalg.lstsq(scaled, root[:, None] * wanted, rcond=None)[0] / size[:, None]


def kramers_moyal(laboratory: Laboratory, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances of the increments in bins of the states, with polynomials fitted through them."""
    x, rates = increments(laboratory, seen)
    low, high = np.quantile(x, [0.001, 0.999], axis=0)
    edges = np.linspace(low, high, BINS + 1, axis=1)
    places = [
        np.clip(np.searchsorted(edge, each), 1, BINS) - 1 for edge, each in zip(edges, x.T, strict=True)
    ]
    cell = np.ravel_multi_index(places, (BINS,) * laboratory.dimension)
    _, cell, count = np.unique(cell, return_inverse=True, return_counts=True)

    def mean(of: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(cell, each) / count for each in of.T], axis=1)

    center, velocity, square = mean(x), mean(rates), mean(rates**2)
    used = count >= FEWEST
    variance = (square - velocity**2) * laboratory.step
    fits = [
        least_squares(values(powers, center[used]), wanted[used], count[used])
        for powers, wanted in (
            (exponents(laboratory, DEGREE), velocity),
            (noise_exponents(laboratory), variance),
        )
    ]
    return fits[0], fits[1]


def pysindy(laboratory: Laboratory, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Its sequentially thresholded least squares, of the increments; the noise is what is left."""
    import pysindy as ps

    x, rates = increments(laboratory, seen)
    size = x.std(axis=0)
    rate_size = (x / size).std()  # one: states are scaled, times are left
    powers = exponents(laboratory, DEGREE)
    full = least_squares(values(powers, x / size), rates / size)
    drift_size = (values(powers, x / size) @ full).std()
    model = ps.SINDy(
        optimizer=ps.STLSQ(threshold=CONTRIBUTES * drift_size / rate_size, alpha=0.0),
        feature_library=ps.PolynomialLibrary(degree=DEGREE),
    )
    model.fit(x / size, t=laboratory.step, x_dot=rates / size)
    found = np.asarray(model.coefficients()).T
    names = ps.PolynomialLibrary(degree=DEGREE).fit(x[:2]).powers_
    order = [[tuple(int(one) for one in each) for each in names].index(each) for each in powers]
    found = found[order] * size / np.prod(size ** np.array(powers), axis=1)[:, None]
    left = rates - values(powers, x) @ found
    return found, least_squares(values(noise_exponents(laboratory), x), left**2 * laboratory.step)


def stochastic_force_inference(laboratory: Laboratory, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """By `fit_by_sfi`, in the environment that ``SFI_PYTHON`` names."""
    noise_degree = max(map(sum, laboratory.intensity))
    with tempfile.TemporaryDirectory() as name:
        record, answer = Path(name) / "record.npz", Path(name) / "answer.json"
        np.savez(record, seen=seen, step=laboratory.step, degree=DEGREE, noise_degree=noise_degree)
        script = Path(__file__).with_name("fit_by_sfi.py")
        command = [os.environ[SFI_PYTHON], str(script), str(record), str(answer)]
        subprocess.run(command, check=True, timeout=PATIENCE, capture_output=True)
        found = json.loads(answer.read_text("utf-8"))
    return np.array(found["drift"]), np.array(found["intensity"])


def judged(
    fit: Callable[[Laboratory, np.ndarray], tuple[np.ndarray, np.ndarray]],
) -> Callable[[Laboratory, np.ndarray, Truth], Answer]:
    """A method with the barriers that follow from its f and q."""

    def answer(laboratory: Laboratory, seen: np.ndarray, known: Truth) -> Answer:
        began = time.perf_counter()
        try:
            force, noise = fit(laboratory, seen)
        except (subprocess.SubprocessError, np.linalg.LinAlgError) as error:
            nothing = [float("nan")] * len(known.attractors)
            return Answer(barriers=nothing, said=str(error))
        seconds = time.perf_counter() - began
        found = _with_polynomials(laboratory, force, noise)
        heights = [
            _barrier_near(found, laboratory, known.attractors[place], known.saddles[place])
            for place in range(len(known.attractors))
        ]
        return Answer(barriers=heights, path_barriers=heights, terms=int((force != 0).sum()), seconds=seconds)

    return answer


def _with_polynomials(laboratory: Laboratory, force: np.ndarray, noise: np.ndarray) -> Laboratory:
    powers, its = exponents(laboratory, DEGREE), noise_exponents(laboratory)
    rows = tuple(dict(zip(powers, map(float, column), strict=True)) for column in force.T)
    return replace(
        laboratory, drift=rows, intensity=dict(zip(its, map(float, noise.mean(axis=1)), strict=True))
    )


def _barrier_near(
    found: Laboratory, laboratory: Laboratory, attractor: np.ndarray, saddle: np.ndarray
) -> float:
    """Out of the well nearby, over the saddle nearby; NaN where there is none."""
    system, unit = polynomials(found), float(np.abs(laboratory.attractors).max())
    try:
        places = [rest_near(lambda x: drift(system, x), one, unit) for one in (attractor, saddle)]
        apart = np.linalg.norm(attractor - saddle)
        if any(np.linalg.norm(p - t) > apart / 2 for p, t in zip(places, (attractor, saddle), strict=True)):
            return float("nan")
        unstable = [int((np.linalg.eigvals(jacobian(system, one)).real > 0).sum()) for one in places]
        return barrier(found, *places) if unstable == [0, 1] else float("nan")
    except (NumericalFailure, ValueError, ArithmeticError):
        return float("nan")


OTHERS: dict[str, Callable[[Laboratory, np.ndarray, Truth], Answer]] = {
    "Kramers–Moyal": judged(kramers_moyal),
    "PySINDy": judged(pysindy),
    "StochasticForceInference": judged(stochastic_force_inference),
}
