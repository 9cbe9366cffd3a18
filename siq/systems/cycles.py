"""Periodic orbits: exact to rounding, with their Floquet multipliers and the curvature of V across them.

An orbit is closed by multiple shooting: with `φ_h` for the flow over one of n equal parts h of the period,

    φ_h(x_k) = x_{k+1},    x_n = x_0,    f(x_0)·(x_0 - guess) = 0,

is solved by Newton's method for all x_k and the period, which works for unstable orbits as for stable ones.

V is zero along a stable cycle, and so is ∇V. Across it noise spreads states as the linearised flow tells.
Let the rows of `L_k` span what is across f at x_k, `P_k = ∂φ_h/∂x`, `R_k = L_{k+1} P_k L_kᵀ`, and W_k the
covariance that noise adds in one part. Displacements `ξ = L (x - x_k)` then have the periodic covariance

    C_{k+1} = R_k C_k R_kᵀ + L_{k+1} W_k L_{k+1}ᵀ,    C_n = C_0,

the periodic equation of Lyapunov in discrete time, and the Hessian of V is `L_kᵀ C_k⁻¹ L_k`. Of an unstable
cycle the same backwards in time, over its unstable directions, is the Hessian of what it costs to reach the
cycle.

References
----------
R. Graham, T. Tél, Phys. Rev. A 31 (1985) 1109: V in the limit of weak noise, limit cycles among its
attractors. S. Bittanti, P. Colaneri, Periodic Systems, Springer 2009, chapter 4: the periodic equation of
Lyapunov.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse
from scipy.integrate import solve_ivp
from scipy.sparse.linalg import spsolve

from siq.errors import NumericalFailure
from siq.systems.dynamics import Dynamics

PARTS = 256  # of the period: splines through as many points are exact to about 1e-8
NEWTON_STEPS = 20
CLOSED = 1e-9  # of the scale: by so much an orbit may fail to close, with integrals to 1e-11
LONGEST_STEP = 0.1  # of the scale, of one step of Newton's method
NEUTRAL = 1e-6  # of 1: closer to it a multiplier is not told from 1 by these integrals
MOST_ROUNDS = 100  # numerical: of the power iteration for unstable directions
SETTLED = 1e-9  # numerical: its accuracy, of integrals to 1e-11


@dataclass(frozen=True, eq=False, repr=False)
class Cycle:
    """A periodic orbit of f.

    Attributes
    ----------
    points
        Shape ``(n, d)``: states at equal distances in time, the first one not repeated.
    period
        In units of time.
    multipliers
        Shape ``(d - 1,)``, by falling size: by what a small displacement across the orbit has been
        multiplied after one period. The multiplier 1 of a displacement along it is left out.
    """

    points: np.ndarray
    period: float
    multipliers: np.ndarray

    def __repr__(self) -> str:
        """One line: its points are some hundred numbers."""
        return f"<Cycle of period {self.period:.6g}, multipliers {self.multipliers.round(4).tolist()}>"

    @property
    def unstable(self) -> int:
        """Number of unstable directions."""
        return int((np.abs(self.multipliers) > 1 + NEUTRAL).sum())

    @property
    def stable(self) -> bool:
        """Whether what is near ends on it."""
        return bool((np.abs(self.multipliers) < 1 - NEUTRAL).all())

    @property
    def kind(self) -> str:
        """``cycle`` if it is stable, ``unstable cycle`` otherwise."""
        return "cycle" if self.stable else "unstable cycle"

    @property
    def position(self) -> np.ndarray:
        """One of its states, shape ``(d,)``."""
        return np.asarray(self.points[0])

    @property
    def eigenvalues(self) -> np.ndarray:
        """Floquet exponents ``ln μ / T`` of the multipliers, shape ``(d - 1,)``, by falling real part."""
        tiny = np.finfo(float).tiny
        return np.asarray(np.log(np.where(self.multipliers == 0, tiny, self.multipliers) + 0j) / self.period)

    def distances(self, x: np.ndarray, *, scale: np.ndarray) -> np.ndarray:
        """Distance of points ``(n, d)`` from the orbit, in units of a scale ``(d,)``: shape ``(n,)``."""
        begin = self.points / scale
        along = np.roll(begin, -1, axis=0) - begin
        offset = x[:, None] / scale - begin
        share = np.clip(np.einsum("nkd,kd->nk", offset, along) / (along**2).sum(axis=1), 0, 1)
        return np.asarray(np.linalg.norm(offset - share[:, :, None] * along, axis=2).min(axis=1))


def closed_orbit(dynamics: Dynamics, guess: np.ndarray, period: float, *, scale: np.ndarray) -> Cycle:
    """The periodic orbit next to a guess, stable or not.

    Parameters
    ----------
    dynamics
        f and D.
    guess
        Shape ``(n, d)``: states of about one period, at equal distances in time, the first one not repeated.
    period
        About that of the orbit.
    scale
        Shape ``(d,)``: the size of what is looked at, as the width of a domain.

    Raises
    ------
    NumericalFailure
        When Newton's method ends at no orbit, or at an equilibrium.
    """
    x, time = guess.copy(), period
    n, d = x.shape
    for _ in range(NEWTON_STEPS):
        ends, flows, _ = _parts(dynamics, x, time / n, scale)
        gap = (ends - np.roll(x, -1, axis=0)) / scale
        along = dynamics.drift(guess[:1])[0] / scale
        phase = along @ ((x[0] - guess[0]) / scale)
        closed = max(np.abs(gap).max(), abs(phase) / np.linalg.norm(along)) < CLOSED
        step = _newton_step(
            flows * scale / scale[:, None], dynamics.drift(ends) / scale / n, along, gap, phase
        )
        step *= min(1.0, LONGEST_STEP / max(float(np.abs(step[:-1]).max()), np.finfo(float).tiny))
        x, time = x + step[:-1].reshape(n, d) * scale, time + float(step[-1])
        if closed:  # and one step further, as an error across the orbit shows in the gap only in part
            return _classified(dynamics, x, time, scale)
        if not (np.isfinite(x).all() and 0.2 * period < time < 5 * period):
            break
    raise NumericalFailure("Newton's method came to no periodic orbit")


def _newton_step(
    flows: np.ndarray, drift: np.ndarray, along: np.ndarray, gap: np.ndarray, phase: float
) -> np.ndarray:
    """Changes of all states, one after another, and of the period."""
    n, d = drift.shape
    rows = np.arange(n * d).reshape(n, d)
    after = np.roll(rows, -1, axis=0)
    entries = [
        (
            np.broadcast_to(rows[:, :, None], flows.shape),
            np.broadcast_to(rows[:, None, :], flows.shape),
            flows,
        ),
        (rows, after, -np.ones((n, d))),
        (rows, np.full((n, d), n * d), drift),
        (np.full(d, n * d), np.arange(d), along),
    ]
    row, column, value = (np.concatenate([np.ravel(one[k]) for one in entries]) for k in range(3))
    matrix = scipy.sparse.csc_matrix((value, (row, column)), shape=(n * d + 1,) * 2)
    return np.asarray(spsolve(matrix, -np.append(gap, phase)))


def _classified(dynamics: Dynamics, x: np.ndarray, time: float, scale: np.ndarray) -> Cycle:
    flow = dynamics.drift(x) / scale
    if not np.linalg.norm(flow, axis=1).min() * time > CLOSED**0.5:
        raise NumericalFailure("the orbit has shrunk to an equilibrium")
    _, flows, _ = _parts(dynamics, x, time / len(x), scale)
    product = np.eye(x.shape[1] - 1)
    for one in _reduced(_across(flow), flows * scale / scale[:, None]):
        product = one @ product
    multipliers = np.linalg.eigvals(product)
    return Cycle(x, time, multipliers[np.argsort(-np.abs(multipliers), kind="stable")])


def hessians_along(dynamics: Dynamics, cycle: Cycle, *, reaching: bool = False) -> np.ndarray:
    """The Hessian of V along a stable cycle, or of what it costs to reach an unstable one.

    Parameters
    ----------
    dynamics
        f and D; noise has to reach every state.
    cycle
        The orbit.
    reaching
        Of an unstable cycle: half the Hessian of the least action of a path that ends on it is taken, as V
        is half of U. It is zero for displacements that f brings back by itself.

    Returns
    -------
    numpy.ndarray
        Shape ``(n, d, d)``, at the points of the cycle; ``H f = 0``.

    Raises
    ------
    NumericalFailure
        When the cycle is not stable, or noise does not spread states across it.
    """
    if reaching == (cycle.unstable == 0) or (not reaching and not cycle.stable):
        raise NumericalFailure(f"the cycle of period {cycle.period:.6g} has no curvature of V of this kind")
    scale = np.ptp(cycle.points, axis=0)
    scale = np.where(scale > 1e-6 * scale.max(), scale, scale.max())  # a state may rest
    _, flows, noises = _parts(dynamics, cycle.points, cycle.period / len(cycle.points), scale)
    flows, noises = flows * scale / scale[:, None], noises / np.outer(scale, scale)
    rows = _across(dynamics.drift(cycle.points) / scale)
    if reaching:
        rows = _unstable_rows(rows, flows, cycle.unstable)
    after = np.roll(rows, -1, axis=0)
    steps = _reduced(rows, flows)
    spread = after @ noises @ after.transpose(0, 2, 1)
    if reaching:  # from each point back to the one before it
        back = np.linalg.inv(steps)
        covariances = _periodic(back[::-1], (back @ spread @ back.transpose(0, 2, 1))[::-1])
        covariances = np.roll(covariances[::-1], 1, axis=0)
    else:
        covariances = _periodic(steps, spread)
    if not (np.linalg.eigvalsh(covariances) > 0).all():
        raise NumericalFailure("noise does not spread states across the cycle: V has no curvature there")
    return np.asarray(rows.transpose(0, 2, 1) @ np.linalg.inv(covariances) @ rows) / np.outer(scale, scale)


def unstable_direction(dynamics: Dynamics, cycle: Cycle, place: int = 0, *, scale: np.ndarray) -> np.ndarray:
    """At one of the points of an unstable cycle, a displacement that grows: shape ``(d,)``, of one scale."""
    _, flows, _ = _parts(dynamics, cycle.points, cycle.period / len(cycle.points), scale)
    rows = _across(dynamics.drift(cycle.points) / scale)
    return np.asarray(_unstable_rows(rows, flows * scale / scale[:, None], cycle.unstable)[place, 0] * scale)


def _across(flow: np.ndarray) -> np.ndarray:
    """Orthonormal rows across f, shape ``(n, d - 1, d)``."""
    return np.linalg.svd(flow[:, None, :])[2][:, 1:]


def _reduced(rows: np.ndarray, flows: np.ndarray) -> np.ndarray:
    return np.asarray(np.roll(rows, -1, axis=0) @ flows @ rows.transpose(0, 2, 1))


def _unstable_rows(across: np.ndarray, flows: np.ndarray, count: int) -> np.ndarray:
    """Rows that see unstable displacements alone, shape ``(n, count, d)``: backwards others fade."""
    last = across[0, :count]
    for _ in range(MOST_ROUNDS):
        rows, current = np.empty((len(flows), count, across.shape[2])), last
        for k in range(len(flows) - 1, -1, -1):
            moved = current @ flows[k] @ across[k].T
            current = np.linalg.qr(moved.T)[0].T @ across[k]
            rows[k] = current
        turned = np.linalg.norm(current.T @ current - last.T @ last)
        last = current
        if turned < SETTLED:
            return rows
    raise NumericalFailure("the unstable directions of the cycle cannot be told apart from the others")


def _periodic(steps: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """The periodic solution of ``C_{k+1} = R_k C_k R_kᵀ + S_k``."""
    whole, once = np.eye(steps.shape[1]), np.zeros(steps.shape[1:])
    for step, added in zip(steps, spread, strict=True):
        whole, once = step @ whole, step @ once @ step.T + added
    current = scipy.linalg.solve_discrete_lyapunov(whole, once)
    found = np.empty_like(steps)
    for k, (step, added) in enumerate(zip(steps, spread, strict=True)):
        found[k] = (current + current.T) / 2
        current = step @ current @ step.T + added
    return found


def _parts(
    dynamics: Dynamics, x: np.ndarray, time: float, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """After a time: states ``(n, d)``, their slopes ``∂φ/∂x``, the covariance of noise ``(n, d, d)``."""
    n, d = x.shape
    unit = np.concatenate([scale, np.ones(d * d), np.outer(scale, scale).ravel()])

    def rates(_: float, flat: np.ndarray) -> np.ndarray:
        z = flat.reshape(n, -1) * unit
        at, flow, spread = z[:, :d], z[:, d : d + d * d].reshape(n, d, d), z[:, d + d * d :].reshape(n, d, d)
        jacobian = dynamics.jacobian(at)
        turned = jacobian @ spread
        grown = turned + turned.transpose(0, 2, 1) + 2 * dynamics.diffusion.at(at)
        parts = [dynamics.drift(at), (jacobian @ flow).reshape(n, -1), grown.reshape(n, -1)]
        return np.asarray((np.concatenate(parts, axis=1) / unit).ravel())

    begin = np.concatenate([x, np.tile(np.eye(d).ravel(), (n, 1)), np.zeros((n, d * d))], axis=1) / unit
    way = solve_ivp(rates, (0.0, time), begin.ravel(), method="DOP853", rtol=1e-11, atol=1e-13)
    if not way.success or not np.isfinite(way.y[:, -1]).all():
        raise NumericalFailure("f cannot be followed around the orbit")
    end = way.y[:, -1].reshape(n, -1) * unit
    return end[:, :d], end[:, d : d + d * d].reshape(n, d, d), end[:, d + d * d :].reshape(n, d, d)
