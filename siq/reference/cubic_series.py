"""V to its third powers about an attractor, in as many states as there are.

With ``V = ½ yᵀMy + ⅙ T(y, y, y)``, y = x - A, the third powers of the Hamilton–Jacobi equation say

    T(y, y, By) = -(My)·F(y, y) - 2 (My)ᵀ(∂D·y)(My),    B = J + 2DM,

F being the second derivatives of f. In Schur's form of B, which is triangular, each T_i follows from those
before it by Sylvester's equation. So it takes d⁴ operations, where a power series of degree 3 as in
`siq.reference.power_series` solves equations with d³/6 unknowns. Eigenvectors would do, too, but those of a
long chain that turns are all but parallel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import hessian_at


@dataclass(frozen=True)
class CubicSeries:
    """``½ yᵀMy + ⅙ T(y, y, y)``: M of the shape ``(d, d)``, T of ``(d, d, d)``."""

    center: np.ndarray
    square: np.ndarray
    cube: np.ndarray

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """First derivatives at points: ``(n, d)`` to ``(n, d)``."""
        y = x - self.center
        return np.asarray(y @ self.square + np.einsum("ijk,nj,nk->ni", self.cube, y, y, optimize=True) / 2)

    def hessian(self, x: np.ndarray) -> np.ndarray:
        """Second derivatives at points: ``(n, d)`` to ``(n, d, d)``."""
        return np.asarray(self.square + np.einsum("ijk,nk->nij", self.cube, x - self.center))


def cubic_series(dynamics: Dynamics, attractor: np.ndarray) -> CubicSeries:
    """V about an attractor, shape ``(d,)``, to its third powers."""
    place = attractor[None]
    square, noise = hessian_at(dynamics, attractor), dynamics.diffusion
    flow = dynamics.jacobian(place)[0] + 2 * noise.at(place)[0] @ square
    known = np.einsum("ai,ijk->ajk", square, dynamics.hessian(place)[0])
    if not noise.constant:
        known = known + 2 * np.einsum("ai,ijk,jb->abk", square, noise.derivatives(place)[0], square)
    orders = [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)]
    symmetric = sum(known.transpose(order) for order in orders) / 6
    triangle, unitary = scipy.linalg.schur(flow, output="complex")
    turned = -3 * np.einsum("abc,ai,bj,ck->ijk", symmetric, unitary, unitary, unitary, optimize=True)
    one = np.eye(len(flow))
    cube = np.zeros_like(turned)
    for i in range(len(flow)):
        rest = turned[i] - np.einsum("m,mjk->jk", triangle[:i, i], cube[:i])
        cube[i] = scipy.linalg.solve_sylvester(triangle.T + triangle[i, i] * one, triangle, rest)
    back = unitary.conj()
    whole = np.einsum("ijk,ai,bj,ck->abc", cube, back, back, back, optimize=True)
    return CubicSeries(attractor, square, np.ascontiguousarray(whole.real))
