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

import itertools
from contextlib import suppress
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
SEPARATRIX_OFFSET = 1e-3  # of the domain: from where f leads on, beside what parts two basins


@dataclass(frozen=True, eq=False, repr=False)
class Cycle:
    """A periodic orbit of f.

    Its multipliers are by what a small displacement across the orbit has been multiplied after one period.
    The multiplier 1 of a displacement along it is left out.
    """

    points: np.ndarray  #: (n, d): states at equal distances in time, the first one not repeated
    period: float  #: in units of time
    multipliers: np.ndarray  #: (d - 1,), by falling size

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
    """The periodic orbit next to a guess of its states ``(n, d)`` and its period, stable or not.

    The states have equal distances in time, and the first one is not repeated. The scale ``(d,)`` is the size
    of what is looked at, as the width of a domain. Raises NumericalFailure when Newton's method ends at no
    orbit, or at an equilibrium.
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
            (np.repeat(rows.ravel(), d), np.repeat(rows, d, axis=0), flows),
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
    product, rows = np.eye(d - 1), _across(flow)
    for one in np.roll(rows, -1, axis=0) @ flows @ rows.transpose(0, 2, 1):
        product = one @ product
    multipliers = np.linalg.eigvals(product)
    return Cycle(x, time, multipliers[np.argsort(-np.abs(multipliers), kind="stable")])


def hessians_along(dynamics: Dynamics, cycle: Cycle, *, reaching: bool = False) -> np.ndarray:
    """The Hessian of V along a stable cycle, or of what it costs to reach an unstable one, if `reaching`.

    Shape ``(n, d, d)``, at the points of the cycle; ``H f = 0``. Of an unstable cycle half the Hessian of the
    least action of a path that ends on it is taken, as V is half of U. It is zero for displacements that f
    brings back by itself. Raises NumericalFailure when the cycle is not of this kind, or noise does not
    spread states across it.
    """
    if reaching == (cycle.unstable == 0) or (not reaching and not cycle.stable):
        raise NumericalFailure(f"the cycle of period {cycle.period:.6g} has no curvature of V of this kind")
    scale = np.ptp(cycle.points, axis=0)
    scale = np.where(scale > 1e-6 * scale.max(), scale, scale.max())  # a state may rest
    _, flows, noises = _parts(dynamics, cycle.points, cycle.period / len(cycle.points), scale)
    rows = _across(dynamics.drift(cycle.points) / scale)
    if reaching:
        rows = _unstable_rows(rows, flows, cycle.unstable)
    after = np.roll(rows, -1, axis=0)
    steps = after @ flows @ rows.transpose(0, 2, 1)
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


def _unstable_direction(dynamics: Dynamics, cycle: Cycle, place: int = 0, *, scale: np.ndarray) -> np.ndarray:
    """At one of the points of an unstable cycle, a displacement that grows: shape ``(d,)``, of one scale."""
    _, flows, _ = _parts(dynamics, cycle.points, cycle.period / len(cycle.points), scale)
    rows = _across(dynamics.drift(cycle.points) / scale)
    return np.asarray(_unstable_rows(rows, flows, cycle.unstable)[place, 0] * scale)


def states_on_both_sides(
    dynamics: Dynamics, over: np.ndarray | Cycle, *, width: np.ndarray, place: int = 0
) -> np.ndarray:
    """States on both sides of a saddle along its k unstable directions, or of a point of an unstable cycle.

    Shape ``(2k, d)``; they are off by `SEPARATRIX_OFFSET` of the widths.
    """
    if isinstance(over, Cycle):
        position, unstable = over.points[place], _unstable_direction(dynamics, over, place, scale=width)[None]
    else:
        values, vectors = np.linalg.eig(dynamics.jacobian(over[None])[0])
        position, unstable = over, vectors[:, values.real > 0].real.T
    steps = SEPARATRIX_OFFSET * unstable / np.abs(unstable / width).max(axis=1, keepdims=True)
    return np.asarray(position + np.stack([steps, -steps], axis=1).reshape(-1, len(width)))


def _across(flow: np.ndarray) -> np.ndarray:
    """Orthonormal rows across f, shape ``(n, d - 1, d)``."""
    return np.linalg.svd(flow[:, None, :])[2][:, 1:]


def _unstable_rows(across: np.ndarray, flows: np.ndarray, count: int) -> np.ndarray:
    """Rows that see unstable displacements alone, shape ``(n, count, d)``: backwards others fade."""
    last = across[0, :count]
    for _ in range(MAX_POWER_ITERATIONS):
        rows, current = np.empty((len(flows), count, across.shape[2])), last
        for k in range(len(flows) - 1, -1, -1):
            current = np.linalg.qr((current @ flows[k] @ across[k].T).T)[0].T @ across[k]
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
    """After a time: states ``(n, d)``; in units of the scale, slopes ``∂φ/∂x`` and covariances of noise."""
    n, d = x.shape
    unit = np.concatenate([scale, np.ones(d * d), np.outer(scale, scale).ravel()])

    def parted(flat: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        at, flow, spread = np.split(flat.reshape(n, -1) * unit, [d, d + d * d], axis=1)
        return at, flow.reshape(n, d, d), spread.reshape(n, d, d)

    def rates(_: float, flat: np.ndarray) -> np.ndarray:
        at, flow, spread = parted(flat)
        jacobian = dynamics.jacobian(at)
        turned = jacobian @ spread
        grown = turned + turned.transpose(0, 2, 1) + 2 * dynamics.diffusion.at(at)
        parts = [dynamics.drift(at), (jacobian @ flow).reshape(n, -1), grown.reshape(n, -1)]
        return np.asarray((np.concatenate(parts, axis=1) / unit).ravel())

    begin = np.concatenate([x, np.tile(np.eye(d).ravel(), (n, 1)), np.zeros((n, d * d))], axis=1) / unit
    way = solve_ivp(rates, (0.0, time), begin.ravel(), method="DOP853", rtol=1e-11, atol=1e-13)
    if not way.success or not np.isfinite(way.y[:, -1]).all():
        raise NumericalFailure("f cannot be followed around the orbit")
    end, flows, noises = parted(way.y[:, -1])
    return end, flows * scale / scale[:, None], noises / np.outer(scale, scale)


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

    ``cycle``: it ends on a limit cycle. ``chaos``: it returns, never to the same place, and small differences
    grow, at a mean rate that is the largest Lyapunov exponent. ``aperiodic``: it returns, and neither can be
    said. ``none``: it does not return.
    """

    kind: Kind
    exponent: float = float("nan")  #: per unit of time; NaN where it was not asked for
    cycle: Cycle | None = field(default=None, compare=False)  #: None of anything else


def recurrence_of(dynamics: Dynamics, starts: np.ndarray, *, box: np.ndarray, rate: float) -> Recurrence:
    """The long-term behaviour of the first of some trajectories that returns.

    The starts ``(n, d)`` are states that have come to rest for a long time nowhere; f crosses the recorded
    box ``(d, 2)`` at the rate, and what is far slower is coming to rest.
    """
    chosen = np.linspace(0, len(starts) - 1, min(MAX_STARTS, len(starts))).astype(int)
    for start in starts[chosen]:
        with suppress(_TooLongError):
            if (found := _recurrence_from(dynamics, start, box, rate)).kind != "none":
                return found
    return Recurrence("none")


class _TooLongError(Exception):
    """f was evaluated so often that the trajectory is given up: it may be too stiff to be followed so."""


def _recurrence_from(dynamics: Dynamics, start: np.ndarray, box: np.ndarray, rate: float) -> Recurrence:
    """One trajectory from return to return, in units of the box, so that states of any size count alike."""
    d, width = len(start), np.ptp(box, axis=1)
    start, middle = start / width, box.mean(axis=1) / width
    evaluations = itertools.count(1)

    def drift(y: np.ndarray) -> np.ndarray:
        return np.asarray(dynamics.drift((y * width)[None])[0] / width)

    def linearised(_: float, z: np.ndarray) -> np.ndarray:
        """Time derivative of a state and of a tangent, one after the other."""
        if next(evaluations) > MAX_EVALUATIONS:
            raise _TooLongError
        jacobian = dynamics.jacobian((z[:d] * width)[None])[0] * width / width[:, None]
        return np.concatenate([drift(z[:d]), jacobian @ z[d:]])

    across = drift(start)
    speed = float(np.linalg.norm(across))

    def returns(_: float, z: np.ndarray) -> float:
        return float(across @ (z[:d] - start))

    def escapes(_: float, z: np.ndarray) -> float:
        return float(ESCAPE_DISTANCE - np.abs(z[:d] - middle).max())

    returns.terminal, returns.direction = True, 1.0  # type: ignore[attr-defined]
    escapes.terminal = True  # type: ignore[attr-defined]

    def stable_cycle(base: np.ndarray, period: float) -> Cycle | None:
        """A stable cycle that passes close by, None where there is none."""
        around = solve_ivp(
            lambda _, y: drift(y), (0.0, period), base, method="DOP853", rtol=1e-9, atol=1e-11,
            t_eval=np.linspace(0, period, PARTS, endpoint=False),
        )  # fmt: skip
        if not around.success:
            return None
        try:
            cycle = closed_orbit(dynamics, around.y.T * width, period, scale=width)
        except NumericalFailure:
            return None
        near = cycle.distances((base * width)[None], scale=width)[0] < CYCLE_DISTANCE
        return cycle if cycle.stable and near and cycle.period < 2 * period else None

    if not speed > RESTING_SPEED * rate:
        return Recurrence("none")
    # Any direction grows as the fastest does.
    state, tangent = start, np.random.default_rng(0).standard_normal(d)
    tangent /= np.linalg.norm(tangent)
    growth, times, places = [], [], []
    for _ in range(RETURNS):
        # Away from the section first, on which it begins: what is zero there would be taken for a return.
        away = SECTION_DISTANCE / speed
        way = solve_ivp(
            linearised, (0.0, LONGEST_RETURN / rate), np.append(state + away * drift(state), tangent),
            method="DOP853", rtol=1e-8, atol=1e-10, events=[returns, escapes],
        )  # fmt: skip
        if not len(way.t_events[0]):
            break
        state, tangent = np.split(way.y_events[0][0], 2)
        size = float(np.linalg.norm(tangent))
        tangent = tangent / size
        growth.append(np.log(size))
        times.append(float(way.t_events[0][0]) + away)
        places.append(state)
        if len(places) in SEARCHED_RETURNS:
            # Backwards from the last place, where a trajectory is closest to the cycle on which it ends.
            past = places[-2 : -2 - MAX_RETURNS_OF_PERIOD : -1]
            distances = np.array([np.linalg.norm(place - state) for place in past])
            close = distances <= max(CLOSE_RETURN_RATIO * distances.min(), RETURN_TOLERANCE)
            passed = np.cumsum(times)
            period = float(passed[-1] - passed[-2 - int(np.flatnonzero(close)[0])])
            if (cycle := stable_cycle(state, period)) is not None:
                return Recurrence("cycle", cycle=cycle)
    if not places:
        return Recurrence("none")
    # Regular motion tears two states apart in proportion to the time, forty returns by some forty times.
    chaotic = np.sum(growth) > -np.log(RETURN_TOLERANCE)
    return Recurrence("chaos" if chaotic else "aperiodic", exponent=float(np.sum(growth) / np.sum(times)))
