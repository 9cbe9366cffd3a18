"""Where does a system rest, and how is V curved there?

Equilibria of an identified f are sought from the recorded points alone; nobody says how many there are, or
where.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.linalg

from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure

EquilibriumKind = Literal["attractor", "saddle", "repeller", "degenerate"]

NEWTON_STEPS = 60
MARGIN = 0.05  # of the recorded box, by which an equilibrium may lie outside
SAME = 1e-6  # of the recorded box: closer equilibria are one
MARGINAL = 1e-6  # of the fastest rate: multiple roots are only found to the root of rounding
UNREACHED = 1e-12  # numerical, of the largest eigenvalue of W in units of its diagonal: rounding


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """A state at which f vanishes.

    Attributes
    ----------
    position
        Shape ``(d,)``.
    eigenvalues
        Of the Jacobian, by falling real part.
    kind
        ``attractor``: all real parts are negative. ``saddle``: some of each, or of one state the positive
        one: the top between two wells is the pass between them. ``repeller``: all positive, of several
        states. ``degenerate``: a real part is zero to rounding, and the linearisation decides nothing.
    """

    position: np.ndarray
    eigenvalues: np.ndarray
    kind: EquilibriumKind

    @property
    def unstable(self) -> int:
        """Number of unstable directions."""
        return int((self.eigenvalues.real > 0).sum())


def find_equilibria(dynamics: Dynamics, points: np.ndarray) -> list[Equilibrium]:
    """All equilibria in the box of some points that Newton's method finds from these.

    Parameters
    ----------
    dynamics
        f.
    points
        Shape ``(n, d)``: recorded states, from all over the recorded region.

    Returns
    -------
    list of Equilibrium
        By their position along the first state. Only roots of f that are isolated are found.
    """
    box = np.stack([points.min(axis=0), points.max(axis=0)], axis=1)
    found = distinct_roots(dynamics, points, box=box, margin=MARGIN)
    return classified(dynamics, found, box=box, rate=rate_of(dynamics, points))


def distinct_roots(
    dynamics: Dynamics,
    starts: np.ndarray,
    *,
    box: np.ndarray,
    margin: float,
    known: Sequence[np.ndarray] = (),
) -> list[np.ndarray]:
    """Where f vanishes, as far as Newton's method comes there from some starts; each root once.

    Parameters
    ----------
    dynamics
        f.
    starts
        Shape ``(n, d)``.
    box
        Shape ``(d, 2)``: the region of interest.
    margin
        Share of the box by which a root may lie outside.
    known
        Roots that are deflated: f is multiplied by ``Π (1 + 1/∣x - r∣²)``, so that Newton's method is kept
        away from them and comes to others. They are not given again.

    References
    ----------
    P. E. Farrell, Á. Birkisson, S. W. Funke, SIAM J. Sci. Comput. 37 (2015) A2026: deflation.
    """
    low, high = box.T
    width = np.where(high > low, high - low, 1.0)
    x = _newton(dynamics, starts, low, width, known)
    if known:
        x = _newton(dynamics, x, low, width, ())
    if not len(x):
        return []
    inside = ((x >= low - margin * width) & (x <= high + margin * width)).all(axis=1)
    with np.errstate(all="ignore"):
        # Few starts may all be at rest: then it is the slopes of f that tell what is small.
        speed = np.nanmedian(np.linalg.norm(dynamics.drift(starts) / width, axis=1))
        rate = np.nanmedian(np.linalg.norm(dynamics.jacobian(x[:1]), axis=(1, 2)))
        small = max(1e-9 * speed, 1e-12 * rate)
        converged = np.linalg.norm(dynamics.drift(x) / width, axis=1) < small
    found = list(known)
    # Zero but for what is left of Newton's last step reads better as zero.
    x = np.where(np.abs(x) < np.finfo(float).eps * width, 0.0, x)
    for candidate in x[inside & converged]:
        if all(np.abs((candidate - other) / width).max() > SAME for other in found):
            found.append(candidate)
    return found[len(known) :]


def _newton(
    dynamics: Dynamics, starts: np.ndarray, low: np.ndarray, width: np.ndarray, known: Sequence[np.ndarray]
) -> np.ndarray:
    """Where Newton's method has come from some starts; what has run away is left out."""
    x = starts.copy()
    for _ in range(NEWTON_STEPS):
        if not len(x):
            break
        # In shares of the box, or states in very different units would damp each other.
        value, jacobian = dynamics.drift(x) / width, dynamics.jacobian(x) * width / width[:, None]
        size = np.linalg.norm(jacobian, axis=(1, 2))[:, None, None] + 1e-100  # its square counts
        # A little damping keeps singular Jacobians harmless and does not spoil convergence to rounding.
        normal = np.einsum("nji,njk->nik", jacobian, jacobian) + 1e-14 * size**2 * np.eye(x.shape[1])
        step = -np.linalg.solve(normal, np.einsum("nji,nj->ni", jacobian, value)[..., None])[..., 0]
        if known:
            step *= _deflation((x[:, None] - np.array(known)) / width, step)
        longest = np.abs(step).max(axis=1, keepdims=True)
        x = x + width * step * np.minimum(1.0, 0.2 / np.maximum(longest, 1e-300))
        x = x[np.isfinite(x).all(axis=1) & (np.abs((x - low) / width - 0.5) < 2.0).all(axis=1)]
    return x


def _deflation(offset: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Factor of Newton's step, ``(n, 1)``, that deflation makes, from offsets to known roots ``(n, k, d)``.

    With ``m f`` in the place of f, Newton's step s becomes ``s/(1 - s·∇m/m)``.
    """
    square = np.maximum((offset**2).sum(axis=2), 1e-24)
    slope = (-2 * offset / (square * (square + 1))[:, :, None]).sum(axis=1)
    return np.asarray(1 / (1 - (slope * step).sum(axis=1) + 1e-12))[:, None]


def classified(
    dynamics: Dynamics, positions: Sequence[np.ndarray], *, box: np.ndarray, rate: float
) -> list[Equilibrium]:
    """Equilibria at positions, by these along the first state; see `classify` for the rate."""
    width = np.where(box[:, 1] > box[:, 0], box[:, 1] - box[:, 0], 1.0)
    ordered = sorted(positions, key=lambda position: tuple(np.round(position / width, 6)))
    return [classify(dynamics, position, rate=rate) for position in ordered]


def rate_of(dynamics: Dynamics, points: np.ndarray) -> float:
    """At which f crosses the box of some points ``(n, d)``, per unit of time: the median over them."""
    width = np.ptp(points, axis=0)
    speed = np.linalg.norm(dynamics.drift(points) / np.where(width > 0, width, 1.0), axis=1)
    return float(np.median(speed))


def classify(dynamics: Dynamics, position: np.ndarray, *, rate: float = 0.0) -> Equilibrium:
    """The equilibrium at a position, by the eigenvalues of the Jacobian there.

    Parameters
    ----------
    dynamics
        f.
    position
        Where it vanishes, shape ``(d,)``.
    rate
        At which f crosses the region of interest, per unit of time. An eigenvalue counts as zero by it, or by
        the largest eigenvalue if that is faster: a single eigenvalue can only be told from zero by another
        rate.
    """
    eigenvalues = np.linalg.eigvals(dynamics.jacobian(position[None])[0])
    eigenvalues = eigenvalues[np.argsort(-eigenvalues.real)]
    kind: EquilibriumKind = "saddle"
    if np.abs(eigenvalues.real).min() <= MARGINAL * max(np.abs(eigenvalues).max(), rate):
        kind = "degenerate"
    elif eigenvalues.real.max() < 0:
        kind = "attractor"
    elif eigenvalues.real.min() > 0 and len(eigenvalues) > 1:
        kind = "repeller"
    return Equilibrium(position, eigenvalues, kind)


def hessian_at(dynamics: Dynamics, equilibrium: np.ndarray) -> np.ndarray:
    """M, the Hessian of V at an equilibrium: ``M = W⁻¹`` with ``J W + W Jᵀ = -2D``, shape ``(d, d)``.

    It follows from f near the equilibrium alone, and at an attractor is what tells the true V from false
    solutions of the Hamilton–Jacobi equation. D may be singular, if the noise reaches every state through J.

    Raises
    ------
    NumericalFailure
        Where it does not: W is singular then.
    """
    # In units of the noise: where the states' units differ much, rounding would swallow the smaller ones.
    diffusion = dynamics.diffusion.frozen(equilibrium)  # p vanishes here, and with it what D's change does
    jacobian, scale = dynamics.jacobian(equilibrium[None])[0], diffusion.scale
    if not diffusion.regular:  # the noise has no unit for a state that it does not act on, and f has one
        pushed = np.diag(diffusion.matrix) > 0
        own = scipy.linalg.matrix_balance(jacobian, permute=False, separate=True)[1][0]
        if pushed.any():
            scale = np.where(pushed, scale, own * np.exp(np.log(scale / own)[pushed].mean()))
    covariance = _covariance(jacobian, diffusion.matrix, scale)
    if not diffusion.regular:
        spread = np.sqrt(np.abs(np.diag(covariance)))
        scale = np.where(spread > 0, spread, scale)
        covariance = _covariance(jacobian, diffusion.matrix, scale)
        values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
        least = int(np.argmin(np.abs(values)))
        if not abs(values[least]) > UNREACHED * np.abs(values).max():
            still = np.abs(vectors[:, least])
            named = [
                name for name, size in zip(dynamics.states, still, strict=True) if size > 0.1 * still.max()
            ]
            raise NumericalFailure(
                f"the noise does not reach {' and '.join(named)} about the equilibrium"
                f" {equilibrium.round(4).tolist()}: no quasipotential is finite there; give a diffusion that"
                f" acts on {named[0]}, or leave out what no noise moves"
            )
    hessian = np.linalg.inv(covariance / np.outer(scale, scale)) / np.outer(scale, scale)
    return (hessian + hessian.T) / 2


def _covariance(jacobian: np.ndarray, diffusion: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """W of ``J W + W Jᵀ = -2D``, solved in units of the scales."""
    own = np.outer(scale, scale)
    found = scipy.linalg.solve_continuous_lyapunov(jacobian * scale / scale[:, None], -2 * diffusion / own)
    return np.asarray((found + found.T) / 2 * own)
