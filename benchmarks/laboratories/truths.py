"""Which wells and barriers does a laboratory have, and how do barriers follow the parameters?

In one state both follow from an integral, ``U/ε = -∫ 2f/q dx``. In more states q is constant, and U for D = 1
is the action of the path of least action, which changes with the coefficients of f by

    ∂U/∂θ = -2 ∫ p·∂f/∂θ dt    (p = 0 at both ends, so that their motion does not matter).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import sympy
from scipy.integrate import quad
from scipy.optimize import root

from benchmarks.laboratories.models import Laboratory
from benchmarks.laboratories.polynomials import drift, intensity, jacobian, monomial, polynomials
from siq.errors import NumericalFailure
from siq.quasipotential.path_chains import MinimumActionPath
from siq.quasipotential.paths import minimum_action_path
from siq.systems.dynamics import Dynamics

TOLERANCE = 1e-6  # of an action: far below what a record can say


@dataclass(frozen=True)
class Truth:
    """What is true of a laboratory.

    Attributes
    ----------
    attractors
        Shape ``(k, d)``.
    saddles
        The saddle on the way out of each, shape ``(k, d)``.
    curvatures
        The Hessian of V at each attractor for D = 1 (in one state: D = q/q(attractor)), shape ``(k, d, d)``.
    barriers
        Of U, or of U/ε where D is not given, shape ``(k,)``.
    slopes
        Their derivatives by the parameters of f and q, shape ``(k, p)``.
    """

    attractors: np.ndarray
    saddles: np.ndarray
    curvatures: np.ndarray
    barriers: np.ndarray
    slopes: np.ndarray


def rest_near(force: Callable[[np.ndarray], np.ndarray], start: np.ndarray, unit: float) -> np.ndarray:
    """Where f = 0, from a place nearby, in units in which the states are of order one.

    Raises
    ------
    NumericalFailure
        Where none is found.
    """
    size = max(float(np.linalg.norm(force(start + unit / 10))), np.finfo(float).tiny)
    found = root(lambda y: force(unit * y) / size, start / unit, tol=1e-13)
    if not found.success and np.abs(found.fun).max() > 1e-9:
        raise NumericalFailure("f has no rest there")
    return np.asarray(found.x * unit)


def truth(laboratory: Laboratory) -> Truth:
    """Wells, barriers and their derivatives.

    Raises
    ------
    NotImplementedError
        When the noise depends on more states than one.
    """
    system = polynomials(laboratory)
    unit = float(np.abs(laboratory.attractors).max())
    attractors, saddles = (
        np.array([rest_near(lambda x: drift(system, x), np.array(one), unit) for one in places])
        for places in (laboratory.attractors, laboratory.saddles)
    )
    nearest = np.linalg.norm(attractors[:, None] - saddles, axis=2).argmin(axis=1)
    found = [
        _way_out(laboratory, one, saddle) for one, saddle in zip(attractors, saddles[nearest], strict=True)
    ]
    curvatures = [
        np.linalg.inv(
            scipy.linalg.solve_continuous_lyapunov(jacobian(system, one), -2 * np.eye(laboratory.dimension))
        )
        for one in attractors
    ]
    return Truth(
        attractors, saddles[nearest], np.array(curvatures),
        np.array([barrier for barrier, _ in found]), np.array([slope for _, slope in found]),
    )  # fmt: skip


def barrier(laboratory: Laboratory, attractor: np.ndarray, saddle: np.ndarray) -> float:
    """Of U, or of U/ε where D is not given, between two rests."""
    return _way_out(laboratory, attractor, saddle)[0]


def _way_out(laboratory: Laboratory, attractor: np.ndarray, saddle: np.ndarray) -> tuple[float, np.ndarray]:
    if laboratory.dimension == 1:
        return _by_quadrature(laboratory, float(attractor[0]), float(saddle[0]))
    if not laboratory.diffusion_given or any(map(any, laboratory.intensity)):
        raise NotImplementedError("in more than one state D is constant, and given")
    path = least_action(laboratory, attractor, saddle)
    return path.action, np.append(_slopes(laboratory, path), np.zeros(len(laboratory.intensity)))


def _by_quadrature(laboratory: Laboratory, attractor: float, saddle: float) -> tuple[float, np.ndarray]:
    system = polynomials(laboratory)

    def force(x: float) -> float:
        return float(drift(system, np.array([x]))[0])

    def noise(x: float) -> float:
        return intensity(system, np.array([x]))

    def integral(of: Callable[[float], float]) -> float:
        return float(quad(of, attractor, saddle, epsabs=0, epsrel=1e-11)[0])

    scale = float(laboratory.intensities[0]) if laboratory.diffusion_given else 1.0

    def slope(powers: np.ndarray, of: Callable[[float], float]) -> float:
        return integral(lambda x: monomial(powers, np.array([x])) * of(x))

    by_force = [slope(each, lambda x: -2 / noise(x)) for each in system.powers]
    by_noise = [slope(each, lambda x: 2 * force(x) / noise(x) ** 2) for each in system.noise_powers]
    if laboratory.diffusion_given:  # U for D = 1 knows nothing of a constant q
        by_noise = [0.0] * len(by_noise)
    return scale * integral(lambda x: -2 * force(x) / noise(x)), scale * np.array([*by_force, *by_noise])


def dynamics_of(laboratory: Laboratory) -> Dynamics:
    """F as formulas, with D = 1."""
    symbols = [sympy.Symbol(name, real=True) for name in laboratory.states]
    equations = [
        sum(
            value * sympy.prod([each**power for each, power in zip(symbols, powers, strict=True)])
            for powers, value in row.items()
        )
        for row in laboratory.drift
    ]
    return Dynamics.of(symbols, equations)


def least_action(laboratory: Laboratory, attractor: np.ndarray, saddle: np.ndarray) -> MinimumActionPath:
    """The path of least action out of a well."""
    path = minimum_action_path(dynamics_of(laboratory), attractor, saddle, tolerance=TOLERANCE)
    if not path.converged:
        raise NumericalFailure("the path of least action is not converged")
    return path


def _slopes(laboratory: Laboratory, path: MinimumActionPath) -> np.ndarray:
    """``-2 ∫ p·∂f/∂θ dt`` along a path, whose speed is that of f."""
    system = polynomials(laboratory)
    middle = (path.points[1:] + path.points[:-1]) / 2
    momentum = (path.momenta[1:] + path.momenta[:-1]) / 2
    length = np.linalg.norm(np.diff(path.points, axis=0), axis=1)
    speed = np.array([np.linalg.norm(drift(system, one)) for one in middle])
    time = length / np.where(speed > 0, speed, np.inf)
    return np.array(
        [
            -2 * sum(time * momentum[:, place] * [monomial(powers, one) for one in middle])
            for place, powers in zip(system.component, system.powers, strict=True)
        ]
    )
