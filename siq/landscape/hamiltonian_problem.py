"""Which boundary conditions has a path of least action, and how are Hamilton's equations solved with them?

The path is that of `siq.landscape.hamiltonian_paths`: it leaves an attractor as the power series of V says,
and ends at a given state, or as it comes to a saddle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from scipy.integrate import solve_bvp
from scipy.interpolate import Akima1DInterpolator

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import classify, hessian_at
from siq.errors import NumericalFailure
from siq.reference.cubic_series import cubic_series
from siq.reference.hamiltonian import HamiltonianFlow
from siq.reference.power_series import quasipotential_series

MOST_STATES = 8  # for a series of degree 4; beyond, of degree 3
APPROACH = 0.1  # of the distance from A to S, in the metric of M: how far from S the end is at first
MOST_NODES = 50_000  # numerical, a guard on memory
FINER, ENOUGH = 6, 1000  # times the nodes of its guess, or so many: a mesh that needs more has no solution
REST = 1e-5  # |f| at an equilibrium, in units of the flow


@dataclass(frozen=True, eq=False)
class Solution:
    """A solution over backward times, from -T to 0: positions and momenta, and its mesh."""

    at: Callable[[np.ndarray], np.ndarray]
    times: np.ndarray


class HamiltonianProblem:
    """Hamilton's equations in units in which M is the unit matrix and the end is at the distance one."""

    def __init__(self, dynamics: Dynamics, attractor: np.ndarray, end: np.ndarray) -> None:
        offset = end - attractor
        level = 0.5 * float(offset @ hessian_at(dynamics, attractor) @ offset)
        if not level > 0:
            raise ValueError(f"the path is to end where it starts, at {attractor.tolist()}")
        self.flow = HamiltonianFlow(dynamics, attractor, level)
        self.dimension = dynamics.dimension
        self.end = self.flow.inverse @ offset
        many = self.dimension > MOST_STATES
        self.series = (
            cubic_series(dynamics, attractor)
            if many
            else quasipotential_series(dynamics, attractor, degree=4)
        )
        self.growth = self.flow.jacobian + 2 * self.flow.diffusion[0]  # of what leaves A: ẏ = (J + 2DM) y
        self.fastest = float(np.abs(np.linalg.eigvals(self.growth)).max())
        self.unstable: float | None = None
        speed = np.abs(self.flow.inverse @ dynamics.drift(end[None])[0]).max()
        kind = classify(dynamics, end)
        if speed < REST * np.linalg.norm(self.flow.jacobian) and kind.kind == "saddle" and kind.unstable == 1:
            self._about_saddle(end)

    def _about_saddle(self, end: np.ndarray) -> None:
        jacobian = self.flow.inverse @ self.flow.dynamics.jacobian(end[None])[0] @ self.flow.units
        values, left, right = scipy.linalg.eig(jacobian, left=True)
        place = int(np.argmax(values.real))
        self.unstable, self.left = float(values[place].real), left[:, place].real
        self.jacobian, self.right = jacobian, right[:, place].real / (self.left @ right[:, place].real)
        self.noise = self.flow.at(self.end[None])[0]
        self.push = float(self.left @ self.noise @ self.left)
        if not self.push > 0:
            raise NumericalFailure(f"the noise does not move states across the saddle {end.tolist()}")
        # Where paths come from: ẏ = J (y - S) + 2Dq with q = -λ/(w·Dw) w e^(-λt). What other directions
        # gather meanwhile is ∫ e^((J + λ)t) dt of what q gives them: since ever, where that is finite, or
        # since the path was far from S, where they decay about as fast as q.
        d = self.dimension
        given = -2 * self.unstable / self.push * self.noise @ self.left
        given -= self.right * (self.left @ given)
        block = np.zeros((d + 1, d + 1))
        block[:d, :d], block[:d, d] = jacobian + self.unstable * np.eye(d), given
        since_ever = self.right - np.linalg.lstsq(block[:d, :d], given, rcond=None)[0]
        lately = self.right + scipy.linalg.expm(-np.log(APPROACH) / self.unstable * block)[:d, d]
        self.arrivals = [since_ever, lately]

    def rates(self, z: np.ndarray) -> np.ndarray:
        """Velocities of (y, q), ``(2d, n)`` to ``(2d, n)``."""
        y, q, _ = self.flow.velocities(z[: self.dimension].T, z[self.dimension :].T)
        return np.concatenate([y, q], axis=1).T

    def matrices(self, z: np.ndarray) -> np.ndarray:
        """Their derivatives, ``(2d, n)`` to ``(2d, 2d, n)``."""
        turned, noise, bend = self.flow.linear(z[: self.dimension].T, z[self.dimension :].T)
        top = np.concatenate([turned, 2 * noise], axis=2)
        return np.concatenate(
            [top, np.concatenate([-bend, -turned.transpose(0, 2, 1)], axis=2)], axis=1
        ).transpose(1, 2, 0)

    def slope(self, y: np.ndarray) -> np.ndarray:
        """Q of the power series at points, ``(n, d)``."""
        return np.asarray(self.series.gradient(self.flow.points(y)) @ self.flow.units / (2 * self.flow.level))

    def curvature(self, y: np.ndarray) -> np.ndarray:
        """∂q/∂y of the power series at points, ``(n, d, d)``."""
        hessians = self.series.hessian(self.flow.points(y))
        return np.asarray(self.flow.units.T @ hessians @ self.flow.units / (2 * self.flow.level))

    def fixed(self, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The condition that y ends at a point, as a matrix before (y, q) and what it gives."""
        return np.eye(self.dimension, 2 * self.dimension), last

    def at_saddle(self, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
        """The conditions at the saddle, as close to it as a solution ends: one more than unknowns."""
        d, rate = self.dimension, self.unstable
        assert rate is not None
        matrix = np.zeros((d + 1, 2 * d))
        matrix[0, :d] = self.left
        matrix[1:, d:] = np.eye(d)
        matrix[1:, :d] = rate / self.push * np.outer(self.left, self.left)
        right = matrix[:, :d] @ self.end
        right[0] = self.left @ solution.at(np.zeros(1))[:d, 0]
        return matrix, right

    def solved(
        self, guess: Solution, last: tuple[np.ndarray, np.ndarray], tolerance: float
    ) -> Solution | None:
        """The solution with a condition at its end, None where Newton's method does not come to one.

        As H is conserved, a condition at the saddle is one too many. A further unknown k makes up for it,
        ``ż = F + k ∇H``, along which H would grow: it comes out as zero.
        """
        d, (matrix, right) = self.dimension, last
        further = len(matrix) - d

        def rates(_: np.ndarray, z: np.ndarray, k: np.ndarray | None = None) -> np.ndarray:
            own = self.rates(z)
            return own if k is None else own + k[0] * np.concatenate([-own[d:], own[:d]])

        def derivatives(_: np.ndarray, z: np.ndarray, k: np.ndarray | None = None) -> object:
            own = self.matrices(z)
            if k is None:
                return own
            velocity = self.rates(z)
            return own + k[0] * np.concatenate([-own[d:], own[:d]]), np.concatenate(
                [-velocity[d:], velocity[:d]]
            )[:, None]

        def ends(first: np.ndarray, final: np.ndarray, _: np.ndarray | None = None) -> np.ndarray:
            return np.concatenate([first[d:] - self.slope(first[None, :d])[0], matrix @ final - right])

        def slopes(first: np.ndarray, _: np.ndarray, k: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
            own = np.concatenate([-self.curvature(first[None, :d])[0], np.eye(d)], axis=1)
            begin = np.concatenate([own, np.zeros((d + further, 2 * d))])
            final = np.concatenate([np.zeros((d, 2 * d)), matrix])
            return (begin, final) if k is None else (begin, final, np.zeros((2 * d + 1, 1)))

        with np.errstate(all="ignore"):
            try:
                found = solve_bvp(
                    rates, ends, guess.times, guess.at(guess.times), p=np.zeros(1) if further else None,
                    fun_jac=derivatives, bc_jac=slopes, tol=tolerance, bc_tol=min(tolerance, 1e-6),
                    max_nodes=min(max(FINER * len(guess.times), ENOUGH), MOST_NODES),
                )  # fmt: skip
            except (ValueError, np.linalg.LinAlgError):  # not finite, where a trial has run away
                return None
        return Solution(found.sol, found.x) if found.success else None


def interpolated(times: np.ndarray, states: np.ndarray) -> Solution:
    """States ``(n, 2d)`` at times, as a first guess."""
    curve = Akima1DInterpolator(times, states)
    return Solution(lambda t: np.asarray(curve(t)).T, times)
