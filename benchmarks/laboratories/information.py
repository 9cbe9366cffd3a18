"""How much does a record say of the parameters, at best?

The likelihood of a record is that of its innovations e, with variances C, which a Kalman filter linearised at
its own predictions gives. Its Fisher information at the true parameters, those of f, of q and the sensor's
variances, is

    G = Σ ∂eᵀ C⁻¹ ∂e + ½ tr(C⁻¹ ∂C C⁻¹ ∂C),

every derivative complete, that of the gain included. The mean moves with the mean of f, ``f + ½ f″:P``.
Without the second part, which is that of a truncated second-order filter, the score of the archetype has 2.3
times the variance that it should have; with it the right one. What is averaged over a step is one more state,
the running integral of the states, which every sample sets to zero. Without sensor noise and blur G is

    G = Σ h Θᵀ (εD)⁻¹ Θ    for f, and    Σ ½ d ∂(log q)²    for q.

References
----------
A. H. Jazwinski, Stochastic Processes and Filtering Theory (1970), section 9.3: the second-order filter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import scipy.linalg

from benchmarks.laboratories.models import Laboratory
from benchmarks.laboratories.polynomials import (
    Polynomials,
    bend,
    drift,
    intensity,
    jacobian,
    monomial,
    polynomials,
    slope,
)


@dataclass(frozen=True)
class Information:
    """Of records, about the coefficients of f, those of q, and the variance of each state's sensor noise.

    Attributes
    ----------
    matrix
        G, shape ``(p, p)``; without sensor noise there are no rows for its variances.
    score
        The derivative of the log-likelihood at the true parameters: zero in the mean, with the covariance G.
    """

    matrix: np.ndarray
    score: np.ndarray


def information(laboratory: Laboratory, seen: np.ndarray, *, substeps: int | None = None) -> Information:
    """Of records ``(records, samples, d)``, at the laboratory's own parameters.

    Parameters
    ----------
    laboratory
        That made them.
    seen
        What it recorded.
    substeps
        Of the filter between two samples; by default those of the simulation.
    """
    system, noisy = polynomials(laboratory), bool((laboratory.sensor > 0).any())
    count = len(system.component) + len(system.noise_coefficients) + noisy * laboratory.dimension
    matrix, score = np.zeros((count, count)), np.zeros(count)
    for one in seen:
        _filtered(
            system, one, laboratory.step, substeps or laboratory.within, laboratory.sensor**2,
            laboratory.averaged, noisy, matrix, score,
        )  # fmt: skip
    return Information(matrix, score)


def information_of_states(laboratory: Laboratory, seen: np.ndarray) -> np.ndarray:
    """G where the instrument shows the states themselves, shape ``(p, p)``."""
    system = polynomials(laboratory)
    x = seen[:, :-1].reshape(-1, laboratory.dimension)
    theta, chi = (
        np.stack([np.prod(x**each, axis=1) for each in powers], axis=1)
        for powers in (system.powers, system.noise_powers)
    )
    noise = chi @ system.noise_coefficients
    same = system.component[:, None] == system.component
    drift_part = same * laboratory.step * (theta.T @ (theta / noise[:, None]))
    noise_part = laboratory.dimension / 2 * (chi.T @ (chi / noise[:, None] ** 2))
    return np.asarray(scipy.linalg.block_diag(drift_part, noise_part))


@numba.njit(cache=True)
def _changes(
    system: Polynomials,
    x: np.ndarray,
    bends: np.ndarray,
    moved: np.ndarray,
    spread: np.ndarray,
    term: int,
) -> tuple[np.ndarray, np.ndarray, float]:
    """What a unit of a parameter changes of the mean of f, of its Jacobian, and of q; the mean has moved."""
    d, terms = len(x), len(system.component)
    own, turned, noise = np.zeros(d), np.zeros((d, d)), 0.0
    for i in range(d):
        for j in range(d):
            for k in range(d):
                turned[i, j] += bends[i, j, k] * moved[k]
    if term < terms:
        place = system.component[term]
        own[place] = monomial(system.powers[term], x)
        for by in range(d):
            turned[place, by] += slope(system.powers[term], x, by)
            for other in range(d):
                own[place] += bend(system.powers[term], x, by, other) * spread[by, other] / 2
    elif term < terms + len(system.noise_coefficients):
        noise = monomial(system.noise_powers[term - terms], x)
    for one in range(len(system.noise_coefficients)):
        for by in range(d):
            noise += system.noise_coefficients[one] * slope(system.noise_powers[one], x, by) * moved[by]
    return own, turned, noise


@numba.njit(cache=True)
def _second(system: Polynomials, x: np.ndarray) -> np.ndarray:
    d = len(x)
    bends = np.zeros((d, d, d))
    for term in range(len(system.component)):
        for j in range(d):
            for k in range(d):
                bends[system.component[term], j, k] += system.coefficients[term] * bend(
                    system.powers[term], x, j, k
                )
    return bends


@numba.njit(cache=True)
def _step(
    system: Polynomials,
    mean: np.ndarray,
    spread: np.ndarray,
    means: np.ndarray,
    spreads: np.ndarray,
    time: float,
    averaged: bool,
) -> None:
    """Mean and covariance, and their derivatives by every parameter, over a substep; in place."""
    n, d = len(mean), system.powers.shape[1]
    x = mean[:d].copy()
    rates, strength, bends = jacobian(system, x), intensity(system, x), _second(system, x)
    forward = np.eye(n)
    forward[:d, :d] += time * rates
    both = time * np.eye(n)
    if averaged:  # ∫ W dt has the variance t³/3, and t²/2 together with W
        forward[d:, :d] = time * (np.eye(d) + forward[:d, :d]) / 2
        for place in range(d):
            both[d + place, d + place] = time**3 / 3
            both[d + place, place] = both[place, d + place] = time**2 / 2
        mean[d:] += time * (x + time * drift(system, x) / 2)
    mean[:d] += time * drift(system, x)
    for place in range(d):
        mean[place] += time / 2 * (bends[place] * spread[:d, :d]).sum()
    for term in range(len(means)):
        own, turned, noise = _changes(system, x, bends, means[term, :d].copy(), spread[:d, :d], term)
        change = np.zeros((n, n))
        change[:d, :d] = time * turned
        if averaged:
            change[d:, :d] = time * change[:d, :d] / 2
        one = change @ spread @ forward.T
        for place in range(d):
            own[place] += (bends[place] * spreads[term, :d, :d]).sum() / 2
        spreads[term] = forward @ spreads[term] @ forward.T + one + one.T + noise * both
        means[term] = forward @ means[term]
        means[term, :d] += time * own
        if averaged:
            means[term, d:] += time * time * own / 2
    spread[:] = forward @ spread @ forward.T + strength * both


@numba.njit(cache=True)
def _filtered(
    system: Polynomials,
    seen: np.ndarray,
    time: float,
    substeps: int,
    sensor: np.ndarray,
    averaged: bool,
    noisy: bool,
    matrix: np.ndarray,
    score: np.ndarray,
) -> None:
    d, count = seen.shape[1], len(score)
    n = 2 * d if averaged else d
    mean, spread = np.zeros(n), np.zeros((n, n))
    mean[:d] = seen[0]
    spread[:d, :d] = np.diag(sensor)
    if averaged:  # the state is about half a step ahead of what was seen
        for place in range(d):
            spread[place, place] += intensity(system, seen[0]) * time / 2
    means, spreads = np.zeros((count, n)), np.zeros((count, n, n))
    view = np.zeros((d, n))
    for place in range(d):
        view[place, d + place if averaged else place] = 1.0 / time if averaged else 1.0
    for sample in range(1, len(seen)):
        for _ in range(substeps):
            _step(system, mean, spread, means, spreads, time / substeps, averaged)
        surprise = seen[sample] - view @ mean
        weight = np.linalg.inv(view @ spread @ view.T + np.diag(sensor))
        shares, gain = np.zeros((count, d, d)), spread @ view.T @ weight
        foreseen = means @ view.T
        for term in range(count):
            varied = view @ spreads[term] @ view.T
            if noisy and term >= count - d:
                varied[term - count + d, term - count + d] += 1.0
            shares[term] = weight @ varied
            score[term] += foreseen[term] @ weight @ surprise
            score[term] += ((shares[term] @ weight @ surprise) @ surprise - np.trace(shares[term])) / 2
            for other in range(term + 1):
                more = foreseen[term] @ weight @ foreseen[other]
                for i in range(d):
                    for j in range(d):
                        more += shares[term, i, j] * shares[other, j, i] / 2
                matrix[term, other] += more
                if other < term:
                    matrix[other, term] += more
        kept = np.eye(n) - gain @ view
        for term in range(count):
            turned = spreads[term] @ view.T @ weight - gain @ shares[term].T
            means[term] = kept @ means[term] + turned @ surprise
            spreads[term] = kept @ spreads[term] - turned @ view @ spread
            spreads[term] = (spreads[term] + spreads[term].T) / 2
        mean += gain @ surprise
        spread[:] = kept @ spread
        spread[:] = (spread + spread.T) / 2
        if averaged:
            mean[d:] = 0.0
            spread[d:, :] = 0.0
            spread[:, d:] = 0.0
            means[:, d:] = 0.0
            spreads[:, d:, :] = 0.0
            spreads[:, :, d:] = 0.0
