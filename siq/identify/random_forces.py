"""How strong are the random forces behind residuals of a whole step?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from siq.data.recordings import SnapshotPairs
from siq.identify.identified_field import IdentifiedField

PAIRS = 500  # to average over: the mean of a smooth function of the state, to a few per cent of a small term
LONGEST = 2.0  # rates of J times h: beyond that a residual hardly knows how its step began
TERMS = 24  # of the exponential series, which then is exact to ten digits


def with_random_forces(found: IdentifiedField, pairs: SnapshotPairs) -> IdentifiedField:
    """The same field, its `noise_rate` that of the random forces and no longer that of the residuals.

    Along a step the system forgets a part of what kicked it: a residual has the covariance
    ``∫₀ʰ e^{Js} εD e^{Jᵀs} ds`` with the Jacobian J of f, and not hεD. Per time that is less than εD, by the
    share hλ for relaxation at the rate λ: by four per cent where λ = 2/s is sampled every 0.02 s. The mean of
    that map over the pairs is inverted. What is left is of second order in the step, where the noise moves J
    itself. An Euler–Maruyama simulation forgets in steps of its own, and nothing within one.

    Parameters
    ----------
    found
        f with the covariance of its residuals per time.
    pairs
        The pairs that it was fitted to.
    """
    if found.noise_free or not len(pairs.h):
        return found
    every = max(len(pairs.h) // PAIRS, 1)
    jacobian = found.dynamics.jacobian(pairs.x0[::every])
    step = jacobian * pairs.h[::every, None, None]
    if not np.isfinite(step).all() or np.abs(np.linalg.eigvals(step)).max() > LONGEST:
        return found
    seen = (_forgotten_by_euler(step, found.flow.steps) if found.flow.euler else _forgotten(step)).mean(
        axis=0
    )
    d = len(found.noise_rate)
    try:
        rate = np.linalg.solve(seen, found.noise_rate.ravel()).reshape(d, d)
    except np.linalg.LinAlgError:
        return found
    rate = (rate + rate.T) / 2
    if np.linalg.eigvalsh(rate)[0] < 0:
        return found  # of forces on a part of the states the residuals have rounding, too
    return replace(found, noise_rate=rate)


def _forgotten(step: np.ndarray) -> np.ndarray:
    """``∫₀¹ e^{As} ⊗ e^{As} ds`` for ``A = hJ``: from ``(n, d, d)`` to ``(n, d², d²)``."""
    n, d, _ = step.shape
    unit = np.eye(d)
    # e^{As} ⊗ e^{As} = e^{(A ⊗ 1 + 1 ⊗ A) s}
    generator = np.einsum("nij,kl->nikjl", step, unit) + np.einsum("ij,nkl->nikjl", unit, step)
    generator = generator.reshape(n, d * d, d * d)
    term = np.broadcast_to(np.eye(d * d), generator.shape)
    total = term.copy()
    for order in range(1, TERMS):
        term = term @ generator / order
        total += term / (order + 1)
    return total


def _forgotten_by_euler(step: np.ndarray, steps: int) -> np.ndarray:
    """The mean of ``M^k ⊗ M^k`` for the steps k of a simulation, ``M = 1 + hJ/steps``."""
    n, d, _ = step.shape
    forward = np.eye(d) + step / steps
    both = np.einsum("nij,nkl->nikjl", forward, forward).reshape(n, d * d, d * d)
    term = np.broadcast_to(np.eye(d * d), both.shape)
    total = np.zeros_like(both)
    for _ in range(steps):
        total += term / steps
        term = term @ both
    return total
