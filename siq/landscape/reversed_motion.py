"""What is the way up of particles, nearly, where the way down is known?

A particle whose friction and noise balance everywhere goes up as it comes down, with its velocity reversed:
``x(-t), -v(-t)`` is the path of least action itself. Where they balance nearly, it is a first guess of the
whole path. It winds about the attractor as often as the path does, which no curve to the saddle tells at weak
damping.

Along a motion whose positions have the velocities v, the noise has to push by ``2 D p_v = v̇ - f_v``, and
Hamilton's equation of p_v, ``ṗ_v = -p_x - J_vvᵀ p_v`` where D is constant along v, gives the momenta of x.
"""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp

from siq.dynamics.dynamics import Dynamics
from siq.landscape.followed_solutions import SPIRAL, START
from siq.landscape.hamiltonian_problem import APPROACH, MOST_NODES, HamiltonianProblem, Solution, interpolated

ACCURACY = 1e-9  # of the way down, relative: it winds often
PACE = 3  # times as many points as a first guess has: momenta are differences of it


def reversed_motion(problem: HamiltonianProblem, beside: np.ndarray | None) -> Solution | None:
    """A first guess of the path to a saddle: the way down, with velocities reversed.

    Parameters
    ----------
    problem
        From an attractor to a saddle.
    beside
        A trajectory of f from the saddle to the attractor, shape ``(k, d)``.

    Returns
    -------
    Solution or None
        It ends before the saddle. None where states are not positions and their velocities, noise acts on
        others than velocities, or the way down is not known.
    """
    dynamics, flow = problem.flow.dynamics, problem.flow
    places = velocities_of(dynamics)
    if places is None or beside is None or problem.unstable is None:
        return None
    positions, velocities = places
    down = _way_down(problem, beside)
    if down is None:
        return None
    step = SPIRAL / problem.fastest / PACE
    x = down.copy()
    x[:, velocities] *= -1
    noise = dynamics.diffusion.at(x)[:, velocities[:, None], velocities]
    # On the way down velocities change by f_v at their own sign; reversed, they change by the same.
    missing = (dynamics.drift(down) - dynamics.drift(x))[:, velocities]
    momenta = np.zeros_like(x)
    try:
        pushed = np.linalg.solve(2 * noise, missing[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        return None
    momenta[:, velocities] = pushed
    turned = dynamics.jacobian(x)[:, velocities[:, None], velocities]
    pulled = np.gradient(pushed, step, axis=0) + (turned.transpose(0, 2, 1) @ pushed[:, :, None])[:, :, 0]
    momenta[:, positions] = -pulled
    y = (x - flow.center) @ flow.inverse.T
    q = momenta @ flow.units / (2 * flow.level)
    times = step * np.arange(1 - len(x), 1)
    guess = interpolated(times, np.concatenate([y, q], axis=1))
    return Solution(guess.at, times[::-PACE][::-1])


def velocities_of(dynamics: Dynamics) -> tuple[np.ndarray, np.ndarray] | None:
    """The places of positions and of their velocities, in the same order; None where there are other states.

    Noise acts on velocities alone.
    """
    symbols = list(dynamics.symbols)
    defined = [
        (place, symbols.index(formula))
        for place, formula in enumerate(dynamics.formulas)
        if formula in symbols
    ]
    positions, velocities = np.array(defined, dtype=int).reshape(-1, 2).T
    if not np.array_equal(np.sort(np.r_[positions, velocities]), np.arange(len(symbols))):
        return None
    noise = dynamics.diffusion.formulas
    return None if any(noise[place][place] != 0 for place in positions) else (positions, velocities)


def _way_down(problem: HamiltonianProblem, beside: np.ndarray) -> np.ndarray | None:
    """The way down in reverse, from close to A to before the saddle: states at even times, ``(n, d)``."""
    dynamics, flow = problem.flow.dynamics, problem.flow
    y = (beside - flow.center) @ flow.inverse.T
    far = np.flatnonzero(np.linalg.norm(y - problem.end, axis=1) >= APPROACH)
    if not len(far):
        return None

    def arrives(_: float, x: np.ndarray) -> float:
        return float(np.linalg.norm(flow.inverse @ (x - flow.center))) - START

    arrives.terminal = True  # type: ignore[attr-defined]
    step = SPIRAL / problem.fastest / PACE
    motion = solve_ivp(
        lambda _, x: dynamics.drift(x[None])[0],
        (0.0, step * MOST_NODES),
        beside[far[0]],
        events=arrives,
        method="DOP853",
        rtol=ACCURACY,
        atol=ACCURACY * np.abs(beside - flow.center).max(axis=0),
        dense_output=True,
    )
    if motion.status != 1:  # it does not come to A
        return None
    times = np.arange(0.0, motion.t[-1], step)
    return np.asarray(motion.sol(times[::-1]).T)
