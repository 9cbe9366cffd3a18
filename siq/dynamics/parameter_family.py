"""What is f against one of its parameters, and how is a point found at which it vanishes?

All lengths are shares of the domain of each state and of the range of the parameter λ. A point of a branch
``f(x(s), λ(s)) = 0`` is found by Newton's method across a tangent, which passes folds as well as anything.

References
----------
H. B. Keller, in Applications of Bifurcation Theory (1977) 359: pseudo-arclength continuation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import exact_number
from siq.dynamics.parametric import symbol

NEWTON_STEPS = 12
CONVERGED = 1e-12  # last step of Newton's method, numerical


class ParameterFamily:
    """f against one of its parameters, in shares of the domain and of the range.

    Parameters
    ----------
    dynamics
        f with its domain and parameters.
    parameter
        Name of the parameter.
    limits
        The range of its values, lower before upper.

    Raises
    ------
    ValueError
        When there is no such parameter, or no domain.
    """

    def __init__(self, dynamics: Dynamics, parameter: str, limits: tuple[float, float]) -> None:
        if parameter not in (each.name for each in dynamics.parameters):
            raise ValueError(f"there is no parameter '{parameter}'")
        low, high = limits
        others = {
            symbol(each.name): exact_number(each.value)
            for each in dynamics.parameters
            if each.name != parameter
        }
        formulas = [each.xreplace(others) for each in dynamics.equations]
        box = np.vstack([dynamics.box, [low, high]])
        self.d = dynamics.dimension
        self.low, self.width = box[:, 0], np.ptp(box, axis=1)
        # The parameter as a state that stays where it is: all derivatives are those of Dynamics.
        self._of_both = Dynamics.of(
            (*dynamics.symbols, symbol(parameter)), (*formulas, 0), diffusion=Diffusion.identity(self.d + 1)
        )

    def shares(self, states: np.ndarray, values: np.ndarray) -> np.ndarray:
        """States ``(n, d)`` and values ``(n,)`` as shares, ``(n, d + 1)``."""
        return (np.column_stack([states, values]) - self.low) / self.width

    def natural(self, z: np.ndarray) -> np.ndarray:
        """Shares as states and, last, the value."""
        return np.asarray(self.low + z * self.width)

    def flow(self, z: np.ndarray) -> np.ndarray:
        """F in shares of the domain per unit of time, at one point ``(d + 1,)``: shape ``(d,)``."""
        with np.errstate(all="ignore"):
            return np.asarray(self._of_both.drift(self.natural(z)[None])[0, : self.d] / self.width[: self.d])

    def slopes(self, z: np.ndarray) -> np.ndarray:
        """Its derivatives by states and parameter, shape ``(d, d + 1)``."""
        with np.errstate(all="ignore"):
            found = self._of_both.jacobian(self.natural(z)[None])[0, : self.d]
        return np.asarray(found * self.width / self.width[: self.d, None])

    def bends(self, z: np.ndarray) -> np.ndarray:
        """Its second derivatives, shape ``(d, d + 1, d + 1)``."""
        with np.errstate(all="ignore"):
            found = self._of_both.hessian(self.natural(z)[None])[0, : self.d]
        return np.asarray(found * self.width[:, None] * self.width / self.width[: self.d, None, None])


@dataclass(frozen=True, eq=False)
class BranchPoint:
    """A point of a branch: where it is in shares, its tangent, and the eigenvalues of ∂f/∂x."""

    z: np.ndarray
    tangent: np.ndarray
    eigenvalues: np.ndarray

    @property
    def unstable(self) -> int:
        """Number of unstable directions."""
        return int((self.eigenvalues.real > 0).sum())


def point_on(family: ParameterFamily, z: np.ndarray, ahead: np.ndarray) -> BranchPoint:
    """A point with its tangent to the side of a direction."""
    slopes = family.slopes(z)
    tangent = np.linalg.svd(slopes)[2][-1]
    values = np.linalg.eigvals(slopes[:, :-1])
    return BranchPoint(z, tangent if tangent @ ahead >= 0 else -tangent, values[np.argsort(-values.real)])


def solved(
    residual: Callable[[np.ndarray], np.ndarray],
    slope: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
) -> np.ndarray | None:
    """Newton's method; None where it does not converge. A singular slope is taken by least squares."""
    x, last = start.copy(), np.inf
    for _ in range(NEWTON_STEPS):
        value, matrix = residual(x), slope(x)
        if not (np.isfinite(value).all() and np.isfinite(matrix).all()):
            return None
        step = np.linalg.lstsq(matrix, -value, rcond=None)[0]
        x, size = x + step, float(np.abs(step).max())
        if size < CONVERGED * max(1.0, float(np.abs(x).max())):
            return x
        # Rounding may keep the last steps from falling further.
        if size < 1e3 * CONVERGED and size >= last:
            return x
        last = size
    return None


def corrected(family: ParameterFamily, guess: np.ndarray, tangent: np.ndarray) -> np.ndarray | None:
    """The point of a branch in the plane across a tangent."""
    return solved(
        lambda z: np.append(family.flow(z), tangent @ (z - guess)),
        lambda z: np.vstack([family.slopes(z), tangent]),
        guess,
    )


def pinned(family: ParameterFamily, guess: np.ndarray, index: int) -> np.ndarray | None:
    """The point of a branch next to a guess at which one component has the value that it has there."""
    return corrected(family, guess, np.eye(len(guess))[index])
