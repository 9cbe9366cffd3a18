"""Systems whose noise depends on the state and whose V is known: f = -D(x)∇V + A(x)∇V, A antisymmetric."""

from __future__ import annotations

import numpy as np
import sympy
from known_systems import KnownSystem
from scipy.integrate import quad

from siq.systems.dynamics import Dynamics

NAMES = "xyzw"


def multiplicative(dimension: int) -> KnownSystem:
    """Two wells in so many states, in which the noise is not the same, nor that of one state its own."""
    states = tuple(sympy.Symbol(name, real=True) for name in NAMES[:dimension])
    x, others = states[0], states[1:]
    potential = (x**2 - 1) ** 2 / 4 + sum(((y - x / 4) ** 2 for y in others), sympy.S.Zero) / 2
    diffusion = sympy.eye(dimension) + sympy.diag(x / 2 + x**2 / 4, *(y**2 / 4 for y in others))
    turning = sympy.zeros(dimension)
    for index, y in enumerate(others, start=1):
        diffusion[0, index] = diffusion[index, 0] = x * y / 8
        turning[0, index], turning[index, 0] = -1 - y / 4, 1 + y / 4
    slope = sympy.Matrix([potential.diff(state) for state in states])
    drift = [sympy.expand(part) for part in (turning - diffusion) * slope]
    attractors = np.tile([[-1.0], [1.0]], dimension)
    attractors[:, 1:] /= 4
    return KnownSystem(
        Dynamics.of(states, drift, diffusion=diffusion.tolist()),
        sympy.expand(potential),
        attractors,
        np.array([[-1.8, 1.8]] + [[-1.2, 1.2]] * (dimension - 1)),
    )


def one_state() -> KnownSystem:
    """A particle in a double well that shakes more to the right: ``f = x - x³``, ``D = 1 + 0.6x + 0.3x²``."""
    x = sympy.Symbol("x", real=True)
    diffusion = 1 + sympy.Rational(3, 5) * x + sympy.Rational(3, 10) * x**2
    return KnownSystem(
        Dynamics.of((x,), (x - x**3,), diffusion=((diffusion,),)),
        None,
        np.array([[-1.0], [1.0]]),
        np.array([[-1.6, 1.6]]),
    )


def potential_of_one_state(known: KnownSystem, start: float, end: float) -> float:
    """``V(end) - V(start) = -∫ f/D dx``."""

    def slope(x: float) -> float:
        point = np.array([[x]])
        return float(-known.dynamics.drift(point)[0, 0] / known.dynamics.diffusion.at(point)[0, 0, 0])

    return float(quad(slope, start, end, epsabs=1e-13, epsrel=1e-13)[0])


def exit_time(known: KnownSystem, start: float, end: float, *, intensity: float, wall: float) -> float:
    """Mean time of one state from `start` to `end` > `start`, with a reflecting wall far to the left.

    ``E[τ] = ∫ dy exp(U(y)/ε) ∫_wall^y dz 2/(εD(z)) exp(-U(z)/ε)``, exact for Itô's noise.
    """
    z = np.linspace(wall, end, 200_001)
    drift = known.dynamics.drift(z[:, None])[:, 0]
    noise = known.dynamics.diffusion.at(z[:, None])[:, 0, 0]
    h = z[1] - z[0]
    slope = -2 * drift / noise
    height = np.r_[0.0, np.cumsum((slope[1:] + slope[:-1]) / 2) * h] / intensity
    height -= height[np.searchsorted(z, start)]
    inner = 2 / (intensity * noise) * np.exp(-height)
    mass = np.r_[0.0, np.cumsum((inner[1:] + inner[:-1]) / 2) * h]
    outer = np.exp(height) * mass
    outer[z < start] = 0.0
    return float(((outer[1:] + outer[:-1]) / 2).sum() * h)
