"""What made neighbouring residuals correlated: sensor noise, an exposure, or random forces with a memory?

A state that white forces drive moves by independent increments, so that its mean square displacement grows as
``M(k) = σ²h k`` over k steps. It grows otherwise where

- the sensor errs: ``M(k) = σ²h k + 2R``;
- a sample is the mean over an exposure of u steps: ``M(k) = σ²h (k - u/3)`` for ``k ≥ u``, and
  ``σ²h (k²/u - k³/3u²)`` before;
- the forces are an Ornstein–Uhlenbeck process of the memory u, or the sensor is a low-pass filter of that
  time: ``M(k) = σ²h (k - u (1 - e^(-k/u)))``. The two cannot be told apart.

Covariances of increments are ``C(k) = (M(k+1) - 2M(k) + M(k-1))/2``. Each kind is fitted to those of the
residuals, by generalised least squares, and the best is named where the others are clearly worse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.linalg
import scipy.optimize

Shape = Literal["white", "sensor", "blur", "coloured", "either"]

CLEARLY = 6.0  # in χ²: the other is e³ = 20 times less likely, or a further number worth its while
GRID = 40  # memories tried, before the best is refined
FLOOR = 1e-9  # of the largest eigenvalue, so that a covariance can be inverted


@dataclass(frozen=True)
class FittedShape:
    """The kind of noise that fits covariances of residuals over lags.

    Attributes
    ----------
    shape
        ``either`` where an exposure fits about as well as forces with a memory.
    memory
        Exposure, or memory, in steps; 0 of white noise and of sensor noise.
    sensor
        Variance of the sensor's error.
    misfit
        χ² of what is left, and ...
    freedom
        ... the number that it has in the mean where the kind is right.
    departure
        The largest difference of a correlation from that of the kind: large where it is of none of these.
    """

    shape: Shape
    memory: float
    sensor: float
    misfit: float
    freedom: int
    departure: float = 0.0


def exposure_displacement(lags: np.ndarray, exposure: float) -> np.ndarray:
    """M(k)/σ²h of means over an exposure of so many steps."""
    k = np.abs(np.asarray(lags, dtype=float))
    if exposure <= 0:
        return k
    return np.where(k >= exposure, k - exposure / 3, k**2 / exposure - k**3 / (3 * exposure**2))


def coloured_displacement(lags: np.ndarray, memory: float) -> np.ndarray:
    """M(k)/σ²h of forces with a memory of so many steps."""
    k = np.abs(np.asarray(lags, dtype=float))
    return k if memory <= 0 else k + memory * np.expm1(-k / memory)


def increment_covariances(displacement: np.ndarray) -> np.ndarray:
    """C(k), k = 0 ... K, from M(0) ... M(K + 1)."""
    before = np.concatenate([displacement[1:2], displacement[:-2]])
    return np.asarray((displacement[1:] - 2 * displacement[:-1] + before) / 2)


def fitted_shape(covariances: np.ndarray, count: float, *, seen: int) -> FittedShape:
    """The simplest kind of noise that explains covariances of residuals.

    Parameters
    ----------
    covariances
        Shape ``(K + 1,)``: of residuals k steps apart.
    count
        Number of residuals.
    seen
        The lag from which on none is told from zero.

    Notes
    -----
    By Bartlett's formula the covariances have themselves the covariance
    ``Σ_m (C_m C_(m+j-k) + C_(m+j) C_(m-k)) / n``.
    """
    lags = np.arange(len(covariances) + 1)
    root = _whitening(covariances, count, seen)
    goal = root @ covariances
    error = root @ increment_covariances(np.where(lags > 0, 2.0, 0.0))
    size = len(covariances)

    def own(memory: float, kind: Shape) -> np.ndarray:
        move = exposure_displacement if kind == "blur" else coloured_displacement
        return increment_covariances(move(lags, memory))

    def misfit(memory: float, kind: Shape, *, sensor: bool) -> tuple[float, np.ndarray]:
        design = np.stack([root @ own(memory, kind), error], axis=1)
        design = design if sensor else design[:, :1]
        scale = np.linalg.norm(design, axis=0)
        values, left = scipy.optimize.nnls(design / scale, goal)
        return float(left**2), np.append(values / scale, 0.0)[:2]

    tried = np.geomspace(0.1, 1.5 * max(seen, 1), GRID)
    shapes: tuple[Shape, Shape] = ("white", "sensor")
    kinds: tuple[Shape, Shape] = ("blur", "coloured")

    def best(kind: Shape, sensor: bool) -> FittedShape:
        place = int(np.argmin([misfit(u, kind, sensor=sensor)[0] for u in tried]))
        found = scipy.optimize.minimize_scalar(
            lambda u: misfit(u, kind, sensor=sensor)[0], method="bounded",
            bounds=(tried[max(place - 1, 0)], tried[min(place + 1, GRID - 1)]),
        )  # fmt: skip
        left, values = misfit(float(found.x), kind, sensor=sensor)
        return FittedShape(kind, float(found.x), float(values[1]), left, size - 2 - sensor)

    simple = []
    for shape in shapes:
        left, values = misfit(0.0, "coloured", sensor=shape == "sensor")
        simple.append(FittedShape(shape, 0.0, float(values[1]), left, size - 1 - (shape == "sensor")))
    with_memory = [min((best(kind, False), best(kind, True)), key=_cost) for kind in kinds]
    first, second = sorted(with_memory, key=_cost)
    either = second.misfit - first.misfit < CLEARLY
    chosen = min((*simple, first), key=_cost)
    _, values = misfit(chosen.memory, chosen.shape, sensor=chosen.sensor > 0)
    left = covariances - values[0] * own(chosen.memory, chosen.shape)
    left -= values[1] * increment_covariances(np.where(lags > 0, 2.0, 0.0))
    departure = float(np.abs(left).max() / covariances[0])
    shape = "either" if either and chosen is first else chosen.shape
    return replace(chosen, shape=shape, departure=departure)


def _cost(fit: FittedShape) -> float:
    """What is left, and what each further number has to explain to be worth it."""
    return fit.misfit - CLEARLY * fit.freedom


def _whitening(covariances: np.ndarray, count: float, seen: int) -> np.ndarray:
    """The inverse root of the covariance of estimated covariances, by Bartlett's formula."""
    size = len(covariances)
    known = np.where(np.arange(size) <= seen, covariances, 0.0)
    reach = 3 * size
    even = np.zeros(2 * reach + 1)
    even[reach : reach + size], even[reach - size + 1 : reach + 1] = known, known[::-1]
    # Σ_m C_m C_(m+j-k) depends on j-k, Σ_m C_(m+j) C_(m-k) on j+k: correlations of C with itself.
    auto = np.correlate(even, even, mode="full")[len(even) - 1 :]
    j = np.arange(size)
    bartlett = auto[np.abs(j[:, None] - j[None])] + auto[j[:, None] + j[None]]
    values, vectors = np.linalg.eigh(bartlett / count)
    values = np.maximum(values, FLOOR * values.max())
    return np.asarray((vectors / np.sqrt(values)) @ vectors.T)
