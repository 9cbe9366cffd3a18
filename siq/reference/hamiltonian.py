"""The Hamiltonian flow whose trajectories are characteristics, in units that suit an attractor.

Positions x, momenta p, the value V along the way, and the tangents (X, P) that tell how neighbouring
trajectories lie. The equations stand in `siq.reference.characteristics`; here they are evaluated for many
rows at once.
"""

from __future__ import annotations

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import hessian_at


class HamiltonianFlow:
    """The equations in units in which M is the unit matrix and the level the unit sphere.

    A row of a state is ``y, q, v, X, P``, of length ``2d + 1 + 2d²``, with ``x = A + units y``, ``units =
    (2 level)^½ L⁻¹``, ``M = LᵀL``, ``p = (2 level)^½ Lᵀ q`` and ``V = level v``; X and P are derivatives of y
    and q. Tolerances then mean the same for states of any size.

    Parameters
    ----------
    dynamics
        f, twice differentiable.
    center
        The attractor A, shape ``(d,)``.
    level
        The value of V, not of U = 2V, that becomes 1.
    """

    def __init__(self, dynamics: Dynamics, center: np.ndarray, level: float) -> None:
        self.dynamics, self.center, self.level = dynamics, center, level
        self.dimension = dynamics.dimension
        self.hessian = hessian_at(dynamics, center)
        upper = np.linalg.cholesky(self.hessian).T
        self.units = np.sqrt(2 * level) * np.linalg.inv(upper)
        self.inverse = upper / np.sqrt(2 * level)
        self.noise = dynamics.diffusion.in_units(center, self.units, 2 * level)
        self.constant = dynamics.diffusion.constant
        self.diffusion = self.noise.at(np.zeros((1, self.dimension)))
        self.jacobian = self.inverse @ dynamics.jacobian(center[None])[0] @ self.units

    def parts(self, state: np.ndarray) -> tuple[np.ndarray, ...]:
        """y, q, v, X, P of rows."""
        d = self.dimension
        tangents = state[:, 2 * d + 1 :].reshape(len(state), 2, d, d)
        return state[:, :d], state[:, d : 2 * d], state[:, 2 * d], tangents[:, 0], tangents[:, 1]

    def rates(self, state: np.ndarray) -> np.ndarray:
        """Time derivative of rows."""
        y, q, _, x_tangents, p_tangents = self.parts(state)
        turned, diffusion, bend = self.linear(y, q)
        new = np.empty_like(state)
        y_rate, q_rate, v_rate, x_rate, p_rate = self.parts(new)
        y_rate[...], q_rate[...], v_rate[...] = self.velocities(y, q, turned)
        x_rate[...] = turned @ x_tangents + 2 * diffusion @ p_tangents
        p_rate[...] = -turned.transpose(0, 2, 1) @ p_tangents - bend @ x_tangents
        return new

    def velocities(
        self, y: np.ndarray, q: np.ndarray, turned: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """ẏ, q̇ and v̇ at positions and momenta ``(n, d)``; `turned` is that of `linear`, where it is known."""
        force = self.dynamics.drift(self.points(y)) @ self.inverse.T
        push = (self.at(y) @ q[:, :, None])[:, :, 0]
        if turned is None:
            turned = self.inverse @ self.dynamics.jacobian(self.points(y)) @ self.units
            turned = turned if self.constant else turned + 2 * self.noise.turn(y, q)
        pulled = -(turned.transpose(0, 2, 1) @ q[:, :, None])[:, :, 0]
        if not self.constant:  # of which the turn has twice as much
            pulled += self.noise.pull(y, q)
        return force + 2 * push, pulled, 2 * np.sum(q * push, axis=1)

    def linear(self, y: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """G, D and the matrix before X in Ṗ, at positions and momenta: ``(n, d, d)`` each."""
        x, p = self.points(y), 2 * self.level * q @ self.inverse
        turned = self.inverse @ self.dynamics.jacobian(x) @ self.units
        bend = self.units.T @ self.dynamics.bend(x, p) @ self.units / (2 * self.level)
        if self.constant:
            return turned, self.at(y), bend
        return turned + 2 * self.noise.turn(y, q), self.at(y), bend + self.noise.bend(y, q)

    def at(self, y: np.ndarray) -> np.ndarray:
        """D at positions, ``(n, d, d)``."""
        if self.constant:
            return np.broadcast_to(self.diffusion, (len(y), self.dimension, self.dimension))
        return self.noise.at(y)

    def points(self, y: np.ndarray) -> np.ndarray:
        """Points in the states' units."""
        return self.center + y @ self.units.T

    def pack(self, x: np.ndarray, p: np.ndarray, values: np.ndarray, hessians: np.ndarray) -> np.ndarray:
        """States that start at points with given V and derivatives."""
        tangents = np.broadcast_to(np.eye(self.dimension), hessians.shape)
        bends = self.units.T @ hessians @ self.units / (2 * self.level)
        rows = [(x - self.center) @ self.inverse.T, p @ self.units / (2 * self.level)]
        rows += [values[:, None] / self.level, tangents.reshape(len(x), -1), bends.reshape(len(x), -1)]
        return self.orthonormal(np.concatenate(rows, axis=1))

    def unpack(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Points, momenta, V and its Hessians, in the units of the states."""
        y, q, v, x_tangents, p_tangents = self.parts(state)
        # A pseudoinverse, because at a caustic itself X is singular; that Hessian is not handed on.
        bends = 2 * self.level * self.inverse.T @ (p_tangents @ np.linalg.pinv(x_tangents)) @ self.inverse
        bends = (bends + bends.transpose(0, 2, 1)) / 2
        return self.points(y), 2 * self.level * q @ self.inverse, self.level * v, bends

    def orthonormal(self, state: np.ndarray) -> np.ndarray:
        """The same planes of tangents with orthonormal columns, which neither grow nor collapse."""
        y, q, v, x_tangents, p_tangents = self.parts(state)
        frames, upper = np.linalg.qr(np.concatenate([x_tangents, p_tangents], axis=1))
        frames = frames * np.sign(np.diagonal(upper, axis1=1, axis2=2))[:, None, :]  # det X keeps its sign
        flat = frames.reshape(len(state), 2 * self.dimension**2)
        return np.concatenate([y, q, v[:, None], flat], axis=1)
