"""The flow over the step of a pair: what a vector field makes of X0 by the time of Xh.

A vector field is held against pairs over their whole step, not against a difference quotient, whose error is
O(h). Two maps are known: the flow of the differential equation, and that of an Euler–Maruyama simulation,
whose increments are h f exactly and which differs from the continuous process by O(h).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from siq.dynamics.simulation import runge_kutta_step

Field = Callable[[np.ndarray], np.ndarray]
"""f, mapping components ``(d, n)`` to components ``(d, n)``."""

LARGEST_REFINEMENT = 64  # Runge–Kutta steps within one pair


@dataclass(frozen=True)
class FlowMap:
    """How a state is carried over the step of a pair.

    Attributes
    ----------
    steps
        Steps of the integrator within every pair.
    euler
        Euler's rule, for pairs that an Euler–Maruyama simulation made with as many steps; otherwise the
        classical Runge–Kutta rule, for everything that is continuous in time.
    """

    steps: int = 1
    euler: bool = False

    def __call__(self, field: Field, x0: np.ndarray, h: np.ndarray) -> np.ndarray:
        """The state after h without noise: components ``(d, n)`` and steps ``(n,)`` to ``(d, n)``."""
        step = h / self.steps
        x = x0
        with np.errstate(over="ignore", invalid="ignore"):  # a trial f may run away
            for _ in range(self.steps):
                x = x + step * field(x) if self.euler else runge_kutta_step(field, x, step)
        return x

    @property
    def curvature_weight(self) -> float:
        """Share of h²/4 by which noise shifts the mean: ``E Xh - Φ(X0) = w h²/4 ΣD_jk ∂²f/∂x_j∂x_k ε``.

        The variance grows from zero within the pair; Euler's rule sees it only after each step.
        """
        return 1 - 1 / self.steps if self.euler else 1.0


def flow_map(
    field: Field, x0: np.ndarray, h: np.ndarray, *, integrator_step: float | None, tolerance: float
) -> FlowMap:
    """The map that fits the data: as many steps as the accuracy needs, or as the simulation made.

    Parameters
    ----------
    field
        An estimate of f.
    x0
        Some of the states, shape ``(d, n)``, and ...
    h
        ... the steps of their pairs, shape ``(n,)``.
    integrator_step
        Step of the Euler–Maruyama simulation that made the data; None for everything else.
    tolerance
        Accuracy of the increments wanted, relative to their root mean square, state by state.
    """
    if integrator_step is not None:
        return FlowMap(steps=max(round(float(np.median(h)) / integrator_step), 1), euler=True)
    steps = 1
    coarse = FlowMap(steps)(field, x0, h)
    while steps < LARGEST_REFINEMENT:
        fine = FlowMap(2 * steps)(field, x0, h)
        with np.errstate(over="ignore", invalid="ignore"):  # as above
            size = np.sqrt(((fine - x0) ** 2).mean(axis=1))
            error = np.sqrt(((fine - coarse) ** 2).mean(axis=1))
        # The error of the coarse result; that of the fine one is sixteen times smaller.
        if not (error > tolerance * size).any():
            break
        steps, coarse = 2 * steps, fine
    return FlowMap(steps)
