"""How far V may be from the true quasipotential, from its own Hamilton–Jacobi residual.

With ``R = ∇V·(f + D∇V)``, and V* the true one, both zero at an attractor:

- following ``dx/dt = f + 2D∇V`` up to x costs the action ``V(x) - ∫R dt``, so that V*(x) is not more;
- along the true minimum action path, Young's inequality gives ``V*(x) ≥ V(x) - ∫R dt``.

The first integral can be computed. Where residuals are small the two paths are close, and the integral of
∣R∣ over the first, with a factor for safety, bounds the error; no independent solution is needed.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from siq.dynamics.dynamics import Dynamics

SAFETY = 2.0
STEPS = 400
RELAXATIONS = 12.0
RUNAWAY = 3.0  # of the box's width from its middle: a path so far out does not come back to its attractor


def residual_integral(
    gradient: Callable[[np.ndarray], np.ndarray],
    dynamics: Dynamics,
    x: np.ndarray,
    *,
    box: np.ndarray,
    slowest: float,
    fastest: float,
) -> np.ndarray:
    """∫∣∇V·(f + D∇V)∣ dt along the ascending paths that end at points.

    Parameters
    ----------
    gradient
        ∇V, points ``(n, d)`` to ``(n, d)``.
    dynamics
        f and D.
    x
        Where the paths end, shape ``(n, d)``.
    box
        Shape ``(d, 2)``: of the states where V is asked for, and of its attractors. A path that leaves it by
        `RUNAWAY` times its width in any state has run away, whatever the units.
    slowest, fastest
        Rates that set how long, and how finely, the paths are followed back.

    Returns
    -------
    numpy.ndarray
        Shape ``(n,)``; infinite where a path runs away instead of coming from the attractor.
    """
    steps = int(np.clip(RELAXATIONS / slowest * fastest / 0.3, STEPS, 4000))
    step = RELAXATIONS / slowest / steps
    total = np.zeros(len(x))
    width = box[:, 1] - box[:, 0]
    middle, far = box.mean(axis=1), RUNAWAY * np.where(width > 0, width, 1.0)

    def rate(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope, flow = gradient(points), dynamics.drift(points)
        push = dynamics.diffusion.push(points, slope)
        return -(flow + 2 * push), np.abs((slope * (flow + push)).sum(axis=1))

    with np.errstate(over="ignore", invalid="ignore"):
        velocity, residual = rate(x)
        for _ in range(steps):  # Heun's rule: the integrand is a bound, not a result
            ahead, _later = rate(x + step * velocity)
            moved = x + step / 2 * (velocity + ahead)
            lost = ~(np.abs(moved - middle) < far).all(axis=1)
            x = np.where(lost[:, None], x, moved)
            velocity, following = rate(x)
            total += step / 2 * (residual + following)
            total[lost] = np.inf
            residual = following
    return total
