"""Mean escape times by other means than ours: quadrature, and the backward equation on a mesh."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import sympy
from known_systems import (
    KnownSystem,
    potential_values,
)
from scipy.interpolate import RegularGridInterpolator

from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at


def compressible(slope: float, rotation: float = 0.0) -> KnownSystem:
    """``V = (x² - 1)²/2 + y²/2`` and ``g = (slope y + rotation)(-V_y, V_x)``, whose divergence is slope V_x.

    Without rotation the path keeps to the axis, where ẋ = V_x: the integral of ∇·g dt is that of slope dx.
    """
    x, y = sympy.symbols("x y", real=True)
    potential = sympy.expand((x**2 - 1) ** 2 / 2 + y**2 / 2)
    turn, (by_x, by_y) = slope * y + rotation, (potential.diff(x), potential.diff(y))
    equations = (sympy.expand(-by_x - turn * by_y), sympy.expand(-by_y + turn * by_x))
    wells, domain = np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[-2.0, 2.0], [-2.0, 2.0]])
    return KnownSystem(Dynamics.of((x, y), equations), potential, wells, domain)


def exit_time(known: KnownSystem, intensity: float, *, which: int, level: float, nodes: int) -> float:
    """Mean time from an attractor of a plane to the other one's neighbourhood, with no path and no formula.

    From the backward equation ``(ε/2) Σ D_i ∂_i² τ + f·∇τ = -1`` by finite volumes that are exact in one
    dimension (Scharfetter and Gummel), D being diagonal; the box reflects.
    """
    axes = [np.linspace(low, high, nodes) for low, high in known.domain]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    index = np.arange(nodes**2).reshape(nodes, nodes)
    rows, columns, rates = [], [], []
    for state, axis in enumerate(axes):
        width, spread = axis[1] - axis[0], intensity * known.diffusion[state, state]
        lower, upper = (
            np.take(index, part, axis=state).ravel() for part in (range(nodes - 1), range(1, nodes))
        )
        drift = known.dynamics.drift((points[lower] + points[upper]) / 2)[:, state]
        for begin, end, sign in ((lower, upper, 1), (upper, lower, -1)):
            peclet = 2 * sign * drift * width / spread + 1e-12
            rows.append(begin)
            columns.append(end)
            rates.append(spread / (2 * width**2) * peclet / -np.expm1(-peclet))
    row, column, rate = np.concatenate(rows), np.concatenate(columns), np.concatenate(rates)
    matrix = scipy.sparse.csr_matrix((rate, (row, column)), shape=(nodes**2,) * 2)
    matrix -= scipy.sparse.diags(np.asarray(matrix.sum(axis=1)).ravel())
    target = known.attractors[1 - which]
    offset = points - target
    bend = hessian_at(known.dynamics, target)
    outside = np.einsum("ni,ij,nj->n", offset, bend, offset) / 2 > level
    times = np.zeros(nodes**2)
    inner = matrix.tocsr()[outside][:, outside].tocsc()
    times[outside] = scipy.sparse.linalg.spsolve(inner, -np.ones(outside.sum()))
    return float(RegularGridInterpolator(axes, times.reshape(nodes, nodes))(known.attractors[which])[0])


def line_exit_time(known: KnownSystem, intensity: float) -> float:
    """The same with one state, from the left attractor to the right one, by quadrature."""
    x = np.linspace(known.domain[0, 0] - 1, known.attractors[1, 0], 20_001)
    exponent = 2 * potential_values(known, x[:, None]) / intensity
    step = x[1] - x[0]
    inner = np.cumsum(np.exp(-exponent)) * step
    within = x >= known.attractors[0, 0]
    spread = intensity * known.diffusion[0, 0]
    return float(2 / spread * np.sum(np.exp(exponent[within]) * inner[within]) * step)
