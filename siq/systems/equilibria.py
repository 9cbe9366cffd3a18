"""Equilibria: all of them in a domain, their stability, and the Hessian of V there.

Equilibria of an identified f are sought from the recorded points alone; nobody says how many there are, or
where.

Noise that acts on velocities alone moves positions, too: dx/dt = v. It *reaches* a state if it acts
on it, or on a state that stands in its equation, or on one that stands in the equation of that one, and so
on. About an equilibrium with Jacobian J this is Kalman's condition: the linear dynamics can be steered
everywhere by D = σσᵀ if ``(σ, Jσ, J²σ, …)`` has full rank, and then, and only then, W of ``J W + W Jᵀ =
-2D`` is regular (`hessian_at`).

Newton's method starts from a low-discrepancy sequence over the domain, more and more densely until nothing
new is found; then again with the known roots deflated, which leads to roots with a small neighbourhood of
their own. In one and two dimensions the topological degree of f on the boundary of the domain is the sum of
the indices ``sign det J`` of all roots within: where this fails a root was missed, and that is said. No
search in more dimensions proves that nothing was missed.

References
----------
J. Zabczyk, SIAM J. Control Optim. 23 (1985) 278: exit problems where noise acts on some states only.
P. E. Farrell, Á. Birkisson, S. W. Funke, SIAM J. Sci. Comput. 37 (2015) A2026: deflation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import scipy.linalg

from siq.errors import NumericalFailure
from siq.numerics.randomness import positive
from siq.remarks import Remark
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics

EquilibriumKind = Literal["attractor", "saddle", "repeller", "degenerate"]

NEWTON_STEPS = 60
BOX_MARGIN = 0.05  # of the recorded box, by which an equilibrium may lie outside
EQUILIBRIUM_MERGE_TOLERANCE = 1e-6  # of the recorded box: closer equilibria are one
MARGINAL = 1e-6  # of the fastest rate: multiple roots are only found to the root of rounding
UNREACHED = 1e-12  # numerical, of the largest eigenvalue of W in units of its diagonal: rounding


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """A state at which f vanishes.

    ``attractor``: all real parts of eigenvalues are negative. ``saddle``: some of each, or of one state the
    positive one: the top between two wells is the saddle between them. ``repeller``: all positive, of several
    states. ``degenerate``: a real part is zero to rounding, and the linearisation decides nothing.
    """

    position: np.ndarray  #: (d,)
    eigenvalues: np.ndarray  #: of the Jacobian, by falling real part
    kind: EquilibriumKind

    @property
    def unstable(self) -> int:
        """Number of unstable directions."""
        return int((self.eigenvalues.real > 0).sum())


class _VectorField(Protocol):
    """f and its Jacobian: dynamics, or f that is linear in some functions."""

    def drift(self, x: np.ndarray, /) -> np.ndarray: ...

    def jacobian(self, x: np.ndarray, /) -> np.ndarray: ...


def find_equilibria(
    dynamics: _VectorField, points: np.ndarray, *, box: np.ndarray | None = None,
    margin: float = BOX_MARGIN, rate: float | None = None,
) -> list[Equilibrium]:  # fmt: skip
    """All isolated equilibria that Newton's method finds from points ``(n, d)``, by their first state.

    Parameters
    ----------
    box, margin
        Shape ``(d, 2)``: by default that of the points; and the share of it by which one may lie outside.
    rate
        At which f crosses the box, see `classify`; by default its median over the points.
    """
    box = np.stack([points.min(axis=0), points.max(axis=0)], axis=1) if box is None else box
    found = distinct_roots(dynamics, points, box=box, margin=margin)
    rate = crossing_rate(dynamics, points, np.ptp(points, axis=0)) if rate is None else rate
    return _classified(dynamics, found, box, rate)


def distinct_roots(
    dynamics: _VectorField, starts: np.ndarray, *, box: np.ndarray, margin: float,
    known: Sequence[np.ndarray] = (),
) -> list[np.ndarray]:  # fmt: skip
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
    width = positive(high - low)
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
        converged = np.linalg.norm(dynamics.drift(x) / width, axis=1) < max(1e-9 * speed, 1e-12 * rate)
    found = list(known)
    # Zero but for what is left of Newton's last step reads better as zero.
    x = np.where(np.abs(x) < np.finfo(float).eps * width, 0.0, x)
    for candidate in x[inside & converged]:
        if all(np.abs((candidate - other) / width).max() > EQUILIBRIUM_MERGE_TOLERANCE for other in found):
            found.append(candidate)
    return found[len(known) :]


def _newton(
    dynamics: _VectorField, starts: np.ndarray, low: np.ndarray, width: np.ndarray,
    known: Sequence[np.ndarray],
) -> np.ndarray:  # fmt: skip
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
            # With m f in the place of f, Newton's step s becomes s/(1 - s·∇m/m).
            offset = (x[:, None] - np.array(known)) / width
            square = np.maximum((offset**2).sum(axis=2), 1e-24)
            slope = (-2 * offset / (square * (square + 1))[:, :, None]).sum(axis=1)
            step *= (1 / (1 - (slope * step).sum(axis=1) + 1e-12))[:, None]
        longest = np.abs(step).max(axis=1, keepdims=True)
        x = x + width * step * np.minimum(1.0, 0.2 / np.maximum(longest, 1e-300))
        x = x[np.isfinite(x).all(axis=1) & (np.abs((x - low) / width - 0.5) < 2.0).all(axis=1)]
    return x


def _classified(
    dynamics: _VectorField, positions: Sequence[np.ndarray], box: np.ndarray, rate: float
) -> list[Equilibrium]:
    """Equilibria at positions, by these along the first state."""
    width = positive(np.ptp(box, axis=1))
    ordered = sorted(positions, key=lambda position: tuple(np.round(position / width, 6)))
    return [classify(dynamics, position, rate=rate) for position in ordered]


def crossing_rate(dynamics: _VectorField, points: np.ndarray, width: np.ndarray) -> float:
    """At which f crosses a box of a width, per unit of time: the median over points ``(n, d)``."""
    return float(np.median(np.linalg.norm(dynamics.drift(points) / positive(width), axis=1)))


def classify(dynamics: _VectorField, position: np.ndarray, *, rate: float = 0.0) -> Equilibrium:
    """The equilibrium at a position ``(d,)``, by the eigenvalues of the Jacobian there.

    An eigenvalue counts as zero by the rate at which f crosses the region of interest, per unit of time, or
    by the largest eigenvalue if that is faster: one alone can only be told from zero by another rate.
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
    solutions of the Hamilton–Jacobi equation. D may be singular, if the noise reaches every state through J;
    where it does not, W is singular, and NumericalFailure is raised.
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


def unreached_states(dynamics: Dynamics) -> tuple[str, ...]:
    """The states that no noise reaches, directly or through the equations; none of them if all is well.

    Examples
    --------
    >>> import sympy
    >>> x, v, w = sympy.symbols("x v w", real=True)
    >>> pushed = [[0, 0, 0], [0, 1, 0], [0, 0, 0]]
    >>> unreached_states(Dynamics.of((x, v, w), (v, -x - v + w, -w), diffusion=pushed))
    ('w',)
    """
    symbols, rows = dynamics.symbols, dynamics.diffusion.formulas
    reached = {own for own, row in zip(symbols, rows, strict=True) if any(entry != 0 for entry in row)}
    for _ in symbols:
        moved = zip(symbols, dynamics.formulas, strict=True)
        reached |= {own for own, formula in moved if formula.free_symbols & reached}
    return tuple(own.name for own in symbols if own not in reached)


def measure_at(dynamics: Dynamics, attractor: np.ndarray) -> Diffusion:
    """In which metric speeds and slopes are measured about an attractor: D, or what stands in for it.

    Where D has no inverse, ``|f|² = f·D⁻¹f`` has no meaning. In its place stands ``K = -(tr J / d) W``: the
    mean rate of relaxation times the spread of states per noise. For ``f = -D∇V`` with relaxation as fast in
    every direction it is D. Raises NumericalFailure when noise does not reach every state about the
    attractor, or it is none.
    """
    if dynamics.diffusion.regular:
        return dynamics.diffusion
    if classify(dynamics, attractor).kind != "attractor":
        raise NumericalFailure(
            f"{attractor.tolist()} is no stable equilibrium; where noise acts on some states only, speeds"
            " have a measure about stable equilibria alone"
        )
    relaxation = -float(np.trace(dynamics.jacobian(attractor[None])[0])) / dynamics.dimension
    return Diffusion(relaxation * np.linalg.inv(hessian_at(dynamics, attractor)))


FIRST_STARTS = 128  # starts of the first round, times the number of states
MAX_ROUNDS = 5  # of search, each with twice as many starts, ...
QUIET_ROUNDS = 2  # ... until as many in a row found nothing new
DEFLATION_STARTS = 256  # starts of each round with deflation
MAX_DEFLATIONS = 8
BOUNDARY_TOLERANCE = 1e-6  # of the domain, by which a root on its boundary may be off: double ones are
BOUNDARY_POINTS = 4096  # points on the boundary, for its degree
LARGEST_TURN = 2.0  # radian: f that turns by more from one of them to the next is not followed
BOUNDARY_DISTANCE = 1e-3  # of the domain: so close to the boundary a root leaves the degree undefined


def spread_evenly(box: np.ndarray, count: int, *, generator: np.random.Generator) -> np.ndarray:
    """Points of a scrambled Sobol sequence in a box ``(d, 2)``: shape ``(n, d)``, n not below `count`."""
    # scipy imports this when it is first named: plans of workflows do without.
    sequence = scipy.stats.qmc.Sobol(len(box), scramble=True, seed=generator)
    share = sequence.random_base2(max(int(np.ceil(np.log2(count))), 1))
    return np.asarray(box[:, 0] + share * (box[:, 1] - box[:, 0]))


def all_equilibria(
    dynamics: Dynamics, *, generator: np.random.Generator
) -> tuple[tuple[Equilibrium, ...], list[Remark]]:
    """Equilibria in the domain of a system, by their first state; and what speaks against their being all."""
    box, d = dynamics.box, dynamics.dimension
    width = np.ptp(box, axis=1)
    found: list[np.ndarray] = []
    quiet, count, starts = 0, FIRST_STARTS * d, np.zeros((0, d))
    for _ in range(MAX_ROUNDS):
        starts = spread_evenly(box, count, generator=generator)
        new = [
            one
            for one in distinct_roots(dynamics, starts, box=box, margin=BOUNDARY_TOLERANCE)
            if all(np.abs((one - other) / width).max() > BOUNDARY_TOLERANCE for other in found)
        ]
        found, quiet, count = [*found, *new], 0 if new else quiet + 1, 2 * count
        if quiet == QUIET_ROUNDS:
            break
    for _ in range(MAX_DEFLATIONS if found else 0):
        some = spread_evenly(box, DEFLATION_STARTS, generator=generator)
        new = distinct_roots(dynamics, some, box=box, margin=BOUNDARY_TOLERANCE, known=found)
        if not new:
            break
        found += new
    equilibria = tuple(_classified(dynamics, found, box, crossing_rate(dynamics, starts, width)))
    degree = _boundary_degree(dynamics, equilibria)
    indices = [np.sign(np.linalg.det(dynamics.jacobian(one.position[None])[0])) for one in equilibria]
    if degree is None or degree == int(sum(indices)):
        return equilibria, []
    return equilibria, [Remark("systems.equilibrium_missed", {"degree": degree, "count": len(equilibria)})]


def _boundary_degree(dynamics: Dynamics, equilibria: tuple[Equilibrium, ...]) -> int | None:
    """How often f turns along the boundary of the domain: the sum of the indices of all roots within.

    None in more than two dimensions, and where a root on the boundary, or a degenerate one, leaves it open.
    """
    box, d = dynamics.box, dynamics.dimension
    width = np.ptp(box, axis=1)
    places = np.array([one.position for one in equilibria]).reshape(-1, d)
    near = (np.minimum(places - box[:, 0], box[:, 1] - places) / width < BOUNDARY_DISTANCE).any()
    if d > 2 or near or any(one.kind == "degenerate" for one in equilibria):
        return None
    if d == 1:
        low, high = np.sign(dynamics.drift(box.T)[:, 0])
        return round(float(high - low) / 2)
    share = np.linspace(0, 1, BOUNDARY_POINTS // 4, endpoint=False)
    zero, one = np.zeros_like(share), np.ones_like(share)
    around = np.concatenate([share, one, 1 - share, zero, zero, share, one, 1 - share]).reshape(2, -1).T
    flow = dynamics.drift(box[:, 0] + around * width) / width
    angle = np.arctan2(flow[:, 1], flow[:, 0])
    turn = np.diff(np.append(angle, angle[0]))
    turn -= 2 * np.pi * np.round(turn / (2 * np.pi))
    if not np.abs(turn).max() < LARGEST_TURN:  # also where f is not finite
        return None
    return int(np.round(turn.sum() / (2 * np.pi)))
