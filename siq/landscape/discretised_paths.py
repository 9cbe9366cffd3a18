"""What is the action of a chain of points?

Everything is in units in which the distance of both ends, D and the derivatives of f are of size one. What
the chains are for is said in `siq.landscape.paths`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.dynamics.cycles import Cycle, hessians_along
from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import classify, hessian_at
from siq.errors import NumericalFailure
from siq.landscape.tubes import Bowl, Tube

AT_REST = 1e-5  # |f| at a state that counts as an equilibrium, in units of the Jacobian and the distance
FLAT = 1e-3  # of the upper bound of S: numerical, above the error of tubes, below what parts two minima
NO_ACTION = 1e-7  # of ∫|f||φ'|ds: less is a path without noise


@dataclass(frozen=True)
class DiscretisedPath:
    """Points ``(n, d)`` in the units of a problem, their action, and whether it is a minimum."""

    points: np.ndarray
    action: float
    minimum: bool


@dataclass(frozen=True)
class Segments:
    """f of the middles, the differences and the sizes of both: ``(n - 1, d)`` and ``(n - 1,)``.

    `whitening` is that of the middles, ``(n - 1, d, d)``, and `turn` is the difference of both directions.
    """

    middles: np.ndarray
    force: np.ndarray
    forward: np.ndarray
    whitening: np.ndarray
    speed: np.ndarray
    length: np.ndarray
    turn: np.ndarray

    @property
    def actions(self) -> np.ndarray:
        """``|f||Δ| - f·Δ``, written so that nothing cancels where f and Δ are parallel."""
        return 0.5 * self.speed * self.length * np.sum(self.turn**2, axis=1)

    @property
    def metric(self) -> np.ndarray:
        """D⁻¹ of the middles, ``(n - 1, d, d)``."""
        return self.whitening.transpose(0, 2, 1) @ self.whitening


class PathProblem:
    """Chains between two states, in units in which D at the start, their distance and ∂f/∂x are of size one.

    ``x = start + units y``. M is the Hessian of V at the start, None where that is no attractor; then the
    first point of a chain is as fixed as the last. Where D has no inverse a `measure` stands in for it, and
    there is no action of chains.

    The start may be a stable cycle, and the end an unstable one: a chain begins and ends on thin tubes then.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        start: np.ndarray | Cycle,
        end: np.ndarray | Cycle,
        *,
        measure: Diffusion | None = None,
    ) -> None:
        around, onto = (one if isinstance(one, Cycle) else None for one in (start, end))
        start, end = _closest_states(start, end)
        noise = dynamics.diffusion.frozen(start) if measure is None else measure
        distance = float(np.linalg.norm(noise.whitening @ (end - start)))
        if not distance > 0:
            raise ValueError(f"the path is to end where it starts, at {start.tolist()}")
        self.dynamics, self.start, self.units = dynamics, start, distance * noise.root
        self.inverse = noise.whitening / distance
        self.constant = dynamics.diffusion.constant
        self.noise = dynamics.diffusion.in_units(start, self.units, distance**2)
        jacobians = self.inverse @ dynamics.jacobian(np.stack([start, end])) @ self.units
        self.rate = float(np.linalg.norm(jacobians, axis=(1, 2)).max())
        self.unit = distance**2 * self.rate  # of the action
        self.end = self.inverse @ (end - start)
        self.hessian: np.ndarray | None = None
        self.begin: Bowl | Tube | None = None
        self.finish: Tube | None = None
        if onto is not None:
            self.finish = self._tube(onto, hessians_along(dynamics, onto, reaching=True))
        if around is not None:
            self.begin = self._tube(around, hessians_along(dynamics, around))
            return
        resting = np.linalg.norm(self.force(np.zeros((1, len(start))))) < AT_REST
        if resting and classify(dynamics, start).kind == "attractor":
            hessian = hessian_at(dynamics, start)
            self.hessian = self.units.T @ hessian @ self.units / self.unit
            self.begin = Bowl(self.hessian)

    def _tube(self, cycle: Cycle, hessians: np.ndarray) -> Tube:
        points = (cycle.points - self.start) @ self.inverse.T
        return Tube(points, self.units.T @ hessians @ self.units / self.unit, cycle.period * self.rate)

    @property
    def flat(self) -> float:
        """By how much of the upper bound S may fail to curve upwards at a minimum.

        About cycles any phase may be as good as any other.
        """
        return FLAT if isinstance(self.begin, Tube) or self.finish is not None else 0.0

    def scaled(self, x: np.ndarray) -> np.ndarray:
        """Points in the units of the problem, from its start to its end."""
        y = (x - self.start) @ self.inverse.T
        if not isinstance(self.begin, Tube):
            y[0] = 0.0
        if self.finish is None:
            y[-1] = self.end
        return np.asarray(y)

    def unscaled(self, y: np.ndarray) -> np.ndarray:
        """Points in the states' units."""
        return self.start + y @ self.units.T

    def force(self, y: np.ndarray) -> np.ndarray:
        """F, ``(n, d)``."""
        return self.dynamics.drift(self.unscaled(y)) @ self.inverse.T / self.rate

    def jacobian(self, y: np.ndarray) -> np.ndarray:
        """∂f/∂y, ``(n, d, d)``."""
        return self.inverse @ self.dynamics.jacobian(self.unscaled(y)) @ self.units / self.rate

    def bend(self, y: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """``Σ_k weights_k ∂²f_k``, ``(n, d, d)``."""
        second = self.dynamics.bend(self.unscaled(y), weights @ self.inverse / self.rate)
        return np.asarray(self.units.T @ second @ self.units)

    def segments(self, y: np.ndarray) -> Segments:
        """What the action of a chain is made of."""
        middles, forward = (y[1:] + y[:-1]) / 2, np.diff(y, axis=0)
        force = self.force(middles)
        own_force, own_forward = force, forward
        if self.constant:
            whitening = np.broadcast_to(np.eye(y.shape[1]), (len(middles), y.shape[1], y.shape[1]))
        else:
            whitening = self.noise.whitening_at(middles)
            own_force, own_forward = products(whitening, force), products(whitening, forward)
        speed, length = (
            np.linalg.norm(part, axis=1) + np.finfo(float).tiny for part in (own_force, own_forward)
        )
        turn = own_forward / length[:, None] - own_force / speed[:, None]
        return Segments(middles, force, forward, whitening, speed, length, turn)

    def level(self, y: np.ndarray) -> np.ndarray:
        """The action from the start to points close to it, ``y·My``; zero without M."""
        return np.zeros(len(y)) if self.begin is None else self.begin.level(y)

    def remaining(self, y: np.ndarray) -> float:
        """The action from a point close to the end to that."""
        return 0.0 if self.finish is None else float(self.finish.level(y[None])[0])

    def action(self, y: np.ndarray) -> float:
        """S of a chain; infinite where it leads through states at which D is not positive."""
        with np.errstate(all="ignore"):  # a trial may run away
            try:
                inner = float(self.segments(y).actions.sum())
                return float(self.level(y[:1])[0]) + inner + self.remaining(y[-1])
            except NumericalFailure:
                return np.inf

    def effort(self, y: np.ndarray) -> float:
        """The integral ``∫ |f| |φ'| ds``, with which an action is compared that may be zero."""
        parts = self.segments(y)
        return float(np.sum(parts.speed * parts.length))


def _closest_states(start: np.ndarray | Cycle, end: np.ndarray | Cycle) -> tuple[np.ndarray, np.ndarray]:
    """Of two states or cycles, the two states that are closest to each other."""
    one, two = (each.points if isinstance(each, Cycle) else each[None] for each in (start, end))
    away = np.linalg.norm(one[:, None] - two, axis=2)
    row, column = np.unravel_index(int(np.argmin(away)), away.shape)
    return one[row], two[column]


def products(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Of each matrix with its vector: ``(n, d, d)`` and ``(n, d)`` to ``(n, d)``."""
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])
