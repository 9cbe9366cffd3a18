"""The test against recorded motion: V falls along held-out recordings, as fast as it has to.

It asks what the recordings did from one sample to the next, and not what the identified f says of it.
"""

from __future__ import annotations

import numpy as np
import scipy.special

from siq.certificate.tests import STANDARD_ERRORS, Candidate, CertificateOptions, Verdict
from siq.data.recordings import SnapshotPairs
from siq.identify.identified_field import IdentifiedField

MOST_PAIRS = 10_000  # evenly taken: memory, not accuracy
FEWEST = 30  # pairs, of a bin too: so many increments have a mean that is normal enough
BINS = 8  # in V, of equally many pairs; a choice, by which the limit is made stricter
LOWEST = 1e-3  # of the range of V: closer to its minimum a fall cannot be told from rounding
ROUNDING = 1e-12  # of the largest V: that of formulas of many terms
BELOW = 0.02  # of the range of V: so far below the attractors nothing may lie
FLAT = "V does not vary on the held-out points"
RISES = "V does not fall along the recordings"


def check_descent(
    candidate: Candidate,
    found: IdentifiedField,
    pairs: SnapshotPairs,
    *,
    options: CertificateOptions,
    error: float = 0.0,
) -> Verdict:
    """Whether V falls along recordings that no fit saw.

    Parameters
    ----------
    candidate
        V, and the points on which it may lie nowhere below the attractors.
    found
        Says whether recordings carry noise, and how much.
    pairs
        Consecutive samples whose first one lies where the candidate claims to hold.
    options
        `descent`, the share of pairs that may rise, without noise; `false_alarms` with it.
    error
        Relative error of V that its certificate states.

    Notes
    -----
    Without noise a pair rises where ``V(x_h) - V(x_0)`` is more than the residuals of f over such a pair, and
    rounding, explain. With noise the mean of ``∇V(X)·ΔX/h`` at the left point (Itô) is ``-∇V·D∇V``, as g is
    orthogonal to ∇V; the standard error of its mean over a bin in V is known, as increments are independent
    given the state from which they start. Largest of the bins' deviations, in standard errors, and the limit
    that all of them keep by chance except with probability `false_alarms`. Two things are allowed for: of a V
    with the relative error e the term ``∇V·D∇V`` is off by 2e; and over a pair of length h the drift
    differs from f by ``(h/2) Lf`` with ``Lf = Jf + ½ Σ:∇²f``, Σ being the noise per unit of time.
    """
    rows = np.unique(np.linspace(0, max(len(pairs.h) - 1, 0), MOST_PAIRS).astype(int))[: len(pairs.h)]
    x0, xh, h = pairs.x0[rows], pairs.xh[rows], pairs.h[rows]
    if len(h) < FEWEST:
        reason = f"only {len(h)} pairs of held-out samples start where V claims to hold: record more there"
        return Verdict(1.0, 0.0, False, reason)
    values = candidate.values(x0)
    bottoms = [float(candidate.values(one.position[None])[0]) for one in candidate.attractors]
    lowest, size = min(bottoms, default=float(values.min())), float(np.ptp(values))
    if not size > 0:
        return Verdict(1.0, 0.0, False, FLAT)
    below = (candidate.values(candidate.points) < lowest - BELOW * size).mean() if bottoms else 0.0
    if below > options.descent:
        return Verdict(float(below), options.descent, False, RISES)
    slope = candidate.gradients(x0)
    if found.noise_rate.any() and not found.noise_free:
        return _in_the_mean(found, x0, xh, h, values, slope, options, error)
    counts = values - lowest > LOWEST * size
    if not counts.any():
        return Verdict(1.0, options.descent, False, FLAT)
    unexplained = np.sqrt(np.einsum("ni,ij,nj->n", slope, found.noise_rate, slope) * h)
    allowed = STANDARD_ERRORS * unexplained + ROUNDING * np.abs(values).max()
    share = max(float((candidate.values(xh) - values > allowed)[counts].mean()), float(below))
    passed = share <= options.descent
    return Verdict(share, options.descent, passed, "" if passed else RISES)


def _in_the_mean(
    found: IdentifiedField,
    x0: np.ndarray,
    xh: np.ndarray,
    h: np.ndarray,
    values: np.ndarray,
    slope: np.ndarray,
    options: CertificateOptions,
    error: float,
) -> Verdict:
    """Whether ∇V·ΔX/h has the mean -∇V·D∇V, in bins of V."""
    claimed = found.diffusion.steepness(x0, slope)
    excess = (slope * (xh - x0)).sum(axis=1) / h + claimed
    forces = np.broadcast_to(found.noise_rate, (len(h), *found.noise_rate.shape))
    if found.noise is not None:  # each increment has the noise of the state where it starts
        forces = found.intensity * found.diffusion.at(x0)
    variance = np.einsum("ni,nij,nj->n", slope, forces, slope) / h
    dynamics = found.dynamics
    change = np.einsum("nij,nj->ni", dynamics.jacobian(x0), dynamics.drift(x0))
    change += 0.5 * np.einsum("nkij,nij->nk", dynamics.hessian(x0), forces)
    curved = (slope * change).sum(axis=1) * h / 2
    bins = np.array_split(np.argsort(values), max(min(BINS, len(h) // FEWEST), 1))
    limit = float(-scipy.special.ndtri(options.false_alarms / (2 * len(bins))))
    worst = 0.0
    for rows in bins:
        explained = 2 * min(error, options.error) * claimed[rows].mean() + abs(curved[rows].mean())
        spread = float(np.sqrt(variance[rows].sum())) / len(rows)
        beyond = max(abs(float(excess[rows].mean())) - explained, 0.0)
        worst = max(worst, beyond / spread if spread > 0 else np.inf)
    if not claimed.max() > 0:
        return Verdict(np.inf, limit, False, FLAT)
    worst = float(worst)
    passed = bool(worst <= limit)
    reason = "" if passed else "in the mean over its noise V does not fall along the recordings as it has to"
    return Verdict(worst, limit, passed, reason)
