"""What is f against some of its parameters, and how is a point found at which it vanishes?

All lengths are shares of the domain of each state and of the range of each parameter λ. A point of a branch
``f(x(s), λ(s)) = 0`` is found by Newton's method across a tangent, which passes folds as well as anything.

References
----------
H. B. Keller, in Applications of Bifurcation Theory (1977) 359: pseudo-arclength continuation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import exact_number
from siq.dynamics.parametric import symbol

NEWTON_STEPS = 12
CONVERGED = 1e-12  # last step of Newton's method, numerical
EDGE = 1e-6  # by which a branch may run outside the domain: as equilibria are sought


class ParameterFamily:
    """f against some of its parameters, in shares of the domain and of their ranges.

    Parameters
    ----------
    dynamics
        f with its domain and parameters; those that are not named have their values.
    limits
        For each parameter by its name the range of its values, lower before upper.

    Raises
    ------
    ValueError
        When there is no such parameter, or no domain.
    """

    def __init__(self, dynamics: Dynamics, limits: Mapping[str, tuple[float, float]]) -> None:
        known = [each.name for each in dynamics.parameters]
        for name in limits:
            if name not in known:
                raise ValueError(f"there is no parameter '{name}'")
        others = {
            symbol(each.name): exact_number(each.value)
            for each in dynamics.parameters
            if each.name not in limits
        }
        formulas = [each.xreplace(others) for each in dynamics.equations]
        box = np.vstack([dynamics.box, *limits.values()])
        self.d = dynamics.dimension
        self.low, self.width = box[:, 0], np.ptp(box, axis=1)
        # Parameters as states that stay where they are: all derivatives are those of Dynamics.
        self._of_both = Dynamics.of(
            (*dynamics.symbols, *map(symbol, limits)), (*formulas, *[0] * len(limits)),
            diffusion=Diffusion.identity(self.d + len(limits)),
        )  # fmt: skip

    def shares(self, states: np.ndarray, values: np.ndarray) -> np.ndarray:
        """States ``(n, d)`` and values, ``(n,)`` or ``(n, p)``, as shares, ``(n, d + p)``."""
        return (np.column_stack([states, values]) - self.low) / self.width

    def natural(self, z: np.ndarray) -> np.ndarray:
        """Shares as states and, last, the values."""
        return np.asarray(self.low + z * self.width)

    def flow(self, z: np.ndarray) -> np.ndarray:
        """F in shares of the domain per unit of time, at one point ``(d + p,)``: shape ``(d,)``."""
        with np.errstate(all="ignore"):
            return np.asarray(self._of_both.drift(self.natural(z)[None])[0, : self.d] / self.width[: self.d])

    def slopes(self, z: np.ndarray) -> np.ndarray:
        """Its derivatives by states and parameters, shape ``(d, d + p)``."""
        with np.errstate(all="ignore"):
            found = self._of_both.jacobian(self.natural(z)[None])[0, : self.d]
        return np.asarray(found * self.width / self.width[: self.d, None])

    def bends(self, z: np.ndarray) -> np.ndarray:
        """Its second derivatives, shape ``(d, d + p, d + p)``."""
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


def outside(z: np.ndarray) -> int | None:
    """Which component of a point in shares lies furthest outside its range, None where none does."""
    beyond = np.abs(z - 0.5) - 0.5
    worst = int(beyond.argmax())
    return worst if beyond[worst] > EDGE else None


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
