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

Notes
-----
A trajectory that comes to rest nowhere is followed from return to return through a section, the plane across
f at its start; from a close return Newton's method seeks the periodic orbit. Chaos has periodic orbits too,
but unstable ones; small differences grow in it from return to return, at the rate of the largest Lyapunov
exponent.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import scipy.linalg
import scipy.sparse
from scipy.integrate import solve_ivp
from scipy.sparse.linalg import spsolve

from siq.errors import NumericalFailure
from siq.systems.dynamics import Dynamics

PARTS = 256  # of the period: splines through as many points are exact to about 1e-8
NEWTON_STEPS = 20
CLOSURE_TOLERANCE = 1e-9  # of the scale: by so much an orbit may fail to close, with integrals to 1e-11
LONGEST_STEP = 0.1  # of the scale, of one step of Newton's method
NEUTRAL_MULTIPLIER_MARGIN = 1e-6  # of 1: closer to it a multiplier is not told from 1 by these integrals
MAX_POWER_ITERATIONS = 100  # numerical: of the power iteration for unstable directions
POWER_ITERATION_TOLERANCE = 1e-9  # numerical: its accuracy, of integrals to 1e-11


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
        return int((np.abs(self.multipliers) > 1 + NEUTRAL_MULTIPLIER_MARGIN).sum())

    @property
    def stable(self) -> bool:
        """Whether what is near ends on it."""
        return bool((np.abs(self.multipliers) < 1 - NEUTRAL_MULTIPLIER_MARGIN).all())

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
    rows = np.arange(n * d).reshape(n, d)  # of the Jacobian: unknowns are all states, and the period
    for _ in range(NEWTON_STEPS):
        ends, flows, _ = _parts(dynamics, x, time / n, scale)
        gap = (ends - np.roll(x, -1, axis=0)) / scale
        along = dynamics.drift(guess[:1])[0] / scale
        phase = along @ ((x[0] - guess[0]) / scale)
        closed = max(np.abs(gap).max(), abs(phase) / np.linalg.norm(along)) < CLOSURE_TOLERANCE
        entries = [
            (np.repeat(rows.ravel(), d), np.repeat(rows, d, axis=0), flows * scale / scale[:, None]),
            (rows, np.roll(rows, -1, axis=0), -np.ones((n, d))),
            (rows, np.full((n, d), n * d), dynamics.drift(ends) / scale / n),
            (np.full(d, n * d), np.arange(d), along),
        ]
        row, column, value = (np.concatenate([np.ravel(one[k]) for one in entries]) for k in range(3))
        matrix = scipy.sparse.csc_matrix((value, (row, column)), shape=(n * d + 1,) * 2)
        step = spsolve(matrix, -np.append(gap, phase))
        step *= min(1.0, LONGEST_STEP / max(float(np.abs(step[:-1]).max()), np.finfo(float).tiny))
        x, time = x + step[:-1].reshape(n, d) * scale, time + float(step[-1])
        if closed:  # and one step further, as an error across the orbit shows in the gap only in part
            break
        if not (np.isfinite(x).all() and 0.2 * period < time < 5 * period):
            raise NumericalFailure("Newton's method came to no periodic orbit")
    else:
        raise NumericalFailure("Newton's method came to no periodic orbit")
    flow = dynamics.drift(x) / scale
    if not np.linalg.norm(flow, axis=1).min() * time > CLOSURE_TOLERANCE**0.5:
        raise NumericalFailure("the orbit has shrunk to an equilibrium")
    _, flows, _ = _parts(dynamics, x, time / n, scale)
    product = np.eye(d - 1)
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
    for _ in range(MAX_POWER_ITERATIONS):
        rows, current = np.empty((len(flows), count, across.shape[2])), last
        for k in range(len(flows) - 1, -1, -1):
            moved = current @ flows[k] @ across[k].T
            current = np.linalg.qr(moved.T)[0].T @ across[k]
            rows[k] = current
        turned = np.linalg.norm(current.T @ current - last.T @ last)
        last = current
        if turned < POWER_ITERATION_TOLERANCE:
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


RETURNS = 40  # through the section, within which chaos has to have lost what was known at the start
SEARCHED_RETURNS = (4, 12, RETURNS)  # after which a cycle is sought: most are found long before chaos can
CLOSE_RETURN_RATIO = 2.0  # to the closest return: one as close may be earlier, and the period shorter
RETURN_TOLERANCE = 1e-6  # of the box: returns as close are at one place; chaos tears them a box apart
MAX_STARTS = 3  # trajectories that are followed until one returns
LONGEST_RETURN = 50.0  # crossings of the box, in which there has to be a return
MAX_EVALUATIONS = 1_000_000  # of f: some ten times what the equations of Lorenz and Rössler need
ESCAPE_DISTANCE = 1.5  # of the box from its middle: what comes so far has escaped, as in `follow`
MAX_RETURNS_OF_PERIOD = 12  # of longer cycles only those of twice doubled periods are looked for
SECTION_DISTANCE = 1e-8  # of the box: from the section, so that its start is not taken for a return
CYCLE_DISTANCE = 0.25  # of the box: so close to a return its cycle passes
RESTING_SPEED = 1e-4  # of the rate: a trajectory so slow at its end is coming to rest

Kind = Literal["cycle", "chaos", "aperiodic", "none"]


@dataclass(frozen=True)
class Recurrence:
    """The long-term behaviour of a trajectory that comes to rest nowhere.

    Attributes
    ----------
    kind
        ``cycle``: it ends on a limit cycle. ``chaos``: it returns, never to the same place, and small
        differences grow. ``aperiodic``: it returns, and neither can be said. ``none``: it does not return.
    exponent
        Mean rate at which small differences grow, per unit of time: the largest Lyapunov exponent. NaN where
        it was not asked for.
    cycle
        The cycle; None of anything else.
    """

    kind: Kind
    exponent: float = float("nan")
    cycle: Cycle | None = field(default=None, compare=False)


def recurrence_of(dynamics: Dynamics, starts: np.ndarray, *, box: np.ndarray, rate: float) -> Recurrence:
    """The long-term behaviour of the first of some trajectories that returns.

    Parameters
    ----------
    dynamics
        f.
    starts
        Shape ``(n, d)``, n ≥ 1: where trajectories are that have come to rest for a long time nowhere.
    box
        Shape ``(d, 2)``: the recorded region.
    rate
        At which f crosses it, per unit of time. What is far slower is coming to rest.
    """
    chosen = np.linspace(0, len(starts) - 1, min(MAX_STARTS, len(starts))).astype(int)
    found = Recurrence("none")
    for start in starts[chosen]:
        try:
            found = _Motion(dynamics, start, box, rate).recurrence()
        except _TooLongError:
            found = Recurrence("none")
        if found.kind != "none":
            break
    return found


class _TooLongError(Exception):
    """f was evaluated so often that the trajectory is given up: it may be too stiff to be followed so."""


class _Motion:
    """One trajectory, in units of the box, so that states of any size count alike."""

    def __init__(self, dynamics: Dynamics, start: np.ndarray, box: np.ndarray, rate: float) -> None:
        self.dynamics, self.dimension = dynamics, len(start)
        self.width = box[:, 1] - box[:, 0]
        self.middle = box.mean(axis=1) / self.width
        self.start = start / self.width
        self.across = self.drift(self.start)
        self.speed, self.rate, self.evaluations = float(np.linalg.norm(self.across)), rate, 0

    def drift(self, y: np.ndarray) -> np.ndarray:
        return np.asarray(self.dynamics.drift((y * self.width)[None])[0] / self.width)

    def linearised(self, z: np.ndarray) -> np.ndarray:
        """Time derivative of a state and of some tangents, one after another."""
        self.evaluations += 1
        if self.evaluations > MAX_EVALUATIONS:
            raise _TooLongError
        d = self.dimension
        jacobian = self.dynamics.jacobian((z[:d] * self.width)[None])[0] * self.width / self.width[:, None]
        return np.concatenate([self.drift(z[:d]), (jacobian @ z[d:].reshape(d, -1)).ravel()])

    def recurrence(self) -> Recurrence:
        """From return to return, until there are enough of them."""
        if not self.speed > RESTING_SPEED * self.rate:
            return Recurrence("none")
        # Any direction grows as the fastest does.
        state, tangent = self.start, np.random.default_rng(0).standard_normal(self.dimension)
        tangent /= np.linalg.norm(tangent)
        growth, times, places = [], [], []
        for _ in range(RETURNS):
            step = self._next(state, tangent)
            if step is None:
                break
            state, grown, time = step
            size = float(np.linalg.norm(grown))
            tangent = grown / size
            growth.append(np.log(size))
            times.append(time)
            places.append(state)
            if len(places) in SEARCHED_RETURNS:
                # Backwards from the last place, where a trajectory is closest to the cycle on which it ends.
                past = places[-2 : -2 - MAX_RETURNS_OF_PERIOD : -1]
                away = np.array([np.linalg.norm(place - state) for place in past])
                close = away <= max(CLOSE_RETURN_RATIO * away.min(), RETURN_TOLERANCE)
                passed = np.cumsum(times)
                period = float(passed[-1] - passed[-2 - int(np.flatnonzero(close)[0])])
                if (cycle := self._stable_cycle(state, period)) is not None:
                    return Recurrence("cycle", cycle=cycle)
        if not places:
            return Recurrence("none")
        exponent = float(np.sum(growth) / np.sum(times))
        # Regular motion tears two states apart in proportion to the time, forty returns by some forty times.
        chaotic = np.sum(growth) > -np.log(RETURN_TOLERANCE)
        return Recurrence("chaos" if chaotic else "aperiodic", exponent=exponent)

    def _next(self, state: np.ndarray, tangent: np.ndarray) -> tuple[np.ndarray, np.ndarray, float] | None:
        """State, tangent and time at the next return through the section; None where there is none."""
        d = self.dimension

        def returns(_: float, z: np.ndarray) -> float:
            return float(self.across @ (z[:d] - self.start))

        def escapes(_: float, z: np.ndarray) -> float:
            return float(ESCAPE_DISTANCE - np.abs(z[:d] - self.middle).max())

        returns.terminal, returns.direction = True, 1.0  # type: ignore[attr-defined]
        escapes.terminal = True  # type: ignore[attr-defined]
        # Away from the section first, on which it begins: what is zero there would be taken for a return.
        away = SECTION_DISTANCE / self.speed
        begin = np.concatenate([state + away * self.drift(state), tangent])
        way = solve_ivp(
            lambda _, z: self.linearised(z), (0.0, LONGEST_RETURN / self.rate), begin, method="DOP853",
            rtol=1e-8, atol=1e-10, events=[returns, escapes],
        )  # fmt: skip
        if not len(way.t_events[0]):
            return None
        end = way.y_events[0][0]
        return end[:d], end[d:], float(way.t_events[0][0]) + away

    def _stable_cycle(self, base: np.ndarray, period: float) -> Cycle | None:
        """A stable cycle that passes close by, None where there is none."""
        around = solve_ivp(
            lambda _, y: self.drift(y), (0.0, period), base, method="DOP853", rtol=1e-9, atol=1e-11,
            t_eval=np.linspace(0, period, PARTS, endpoint=False),
        )  # fmt: skip
        if not around.success:
            return None
        try:
            cycle = closed_orbit(self.dynamics, around.y.T * self.width, period, scale=self.width)
        except NumericalFailure:
            return None
        near = cycle.distances((base * self.width)[None], scale=self.width)[0] < CYCLE_DISTANCE
        return cycle if cycle.stable and near and cycle.period < 2 * period else None
