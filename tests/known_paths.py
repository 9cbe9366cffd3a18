"""Systems whose paths of least action are known, and the same systems in other states."""

from __future__ import annotations

from typing import Any

import numpy as np
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    potential_gradient,
    uniform_points,
)
from scipy.integrate import solve_ivp

from siq.quasipotential.path_chains import MinimumActionPath
from siq.quasipotential.paths import minimum_action_path
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import find_equilibria, hessian_at


def path_of(known: KnownSystem, end: np.ndarray, *, which: int = 0, **options: Any) -> MinimumActionPath:
    return minimum_action_path(known.dynamics, known.attractors[which], end, **options)


def transformed(known: KnownSystem, matrix: np.ndarray, *, speed: float = 1.0) -> KnownSystem:
    """The same system in other states ``matrix x`` and another unit of time, D carried along."""
    back = np.linalg.inv(matrix) @ sympy.Matrix(known.dynamics.symbols)
    inner = dict(zip(known.dynamics.symbols, list(back), strict=True))
    equations = sympy.Matrix(known.dynamics.formulas).subs(inner, simultaneous=True)
    return KnownSystem(
        Dynamics.of(
            known.dynamics.symbols,
            tuple(speed * (sympy.Matrix(matrix) * equations)),
            diffusion=speed * matrix @ known.diffusion @ matrix.T,
        ),
        None if known.potential is None else known.potential.subs(inner, simultaneous=True),
        known.attractors @ matrix.T,
        known.domain,
    )


def rotating(dimension: int, rotation: float) -> KnownSystem:
    """The archetypal V with a circulation that is stronger by some factor."""
    plain = archetype(dimension)
    assert plain.potential is not None
    gradient = [plain.potential.diff(symbol) for symbol in plain.dynamics.symbols]
    equations = [f + rotation * (f + v) for f, v in zip(plain.dynamics.formulas, gradient, strict=True)]
    return plain._replace(dynamics=Dynamics.of(plain.dynamics.symbols, tuple(map(sympy.expand, equations))))


def resonator() -> tuple[KnownSystem, np.ndarray]:
    """The paper's driven resonator, slowly varying amplitudes P and Q, and its saddle."""
    p, q = sympy.symbols("P Q", real=True)
    own, drive, loss, cubic, force = 1.0, 1.0018, 0.00045, 33.0, 1.4e-5
    detuning, bend = (own**2 - drive**2) / (2 * drive), 3 * cubic / (8 * drive) * (p**2 + q**2)
    equations = (
        detuning * q - loss * p + bend * q,
        -detuning * p - loss * q - bend * p - force / (2 * drive),
    )
    dynamics = Dynamics.of((p, q), equations)
    found = find_equilibria(dynamics, np.random.default_rng(0).uniform(-0.02, 0.02, size=(200, 2)))
    attractors = np.array([one.position for one in found if one.kind == "attractor"])
    saddle = next(one.position for one in found if one.kind == "saddle")
    domain = np.array([[-0.02, 0.02], [-0.02, 0.02]])
    return KnownSystem(dynamics, None, attractors, domain), saddle


def pairs(known: KnownSystem) -> list[tuple[int, np.ndarray]]:
    """Attractors with the saddles to which a path leads from them, by the known V.

    Backwards along ``ẋ = f + 2D∇V`` from a saddle one comes to the attractors from which it is reached.
    """

    def arrives(_: float, x: np.ndarray, __: KnownSystem) -> float:
        return float(np.linalg.norm(known.attractors - x, axis=1).min() - 0.05)

    arrives.terminal = True  # type: ignore[attr-defined]
    found = []
    for one in find_equilibria(known.dynamics, uniform_points(known, 200)):
        if one.kind != "saddle" or one.unstable != 1:
            continue
        push = 2 * known.diffusion @ hessian_at(known.dynamics, one.position)
        rates, modes = np.linalg.eig(known.dynamics.jacobian(one.position[None])[0] + push)
        for side in (1, -1):
            start = one.position + side * 1e-3 * modes[:, np.argmin(rates.real)].real
            way = solve_ivp(_backwards, [0, 60], start, args=(known,), rtol=1e-6, atol=1e-8, events=arrives)
            if way.status == 1:
                near = np.linalg.norm(known.attractors - way.y[:, -1], axis=1)
                found.append((int(near.argmin()), one.position))
    return found


def _backwards(_: float, x: np.ndarray, known: KnownSystem) -> np.ndarray:
    slope = potential_gradient(known, x[None])[0]
    return -known.dynamics.drift(x[None])[0] - 2 * known.diffusion @ slope


MATRICES = {
    "units": np.diag([1e-2, 1e2]),
    "rotation": np.array([[0.8, -0.6], [0.6, 0.8]]),
    "both": np.array([[1e-3, 2e-3], [-30.0, 50.0]]),
}
