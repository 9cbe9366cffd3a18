"""Barriers that are known: from a formula of U, or computed by two methods that share no equation.

The two are Newton's method on the geometric action of a chain of points (`siq.landscape.paths`), and
collocation of Hamilton's equations (`siq.landscape.hamiltonian_paths`). The error is their difference, or one
in the last figure given.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import compile_formulas

TWO_METHODS = "least action of a chain of points, and Hamilton's equations"


@dataclass(frozen=True, eq=False)
class KnownBarrier:
    """How high U rises between two attractors, and how long it takes to leave the first.

    Attributes
    ----------
    start, saddle, end
        Shape ``(d,)``: the attractor, the pass, and the attractor behind it.
    value, error
        ``ΔU = U(saddle) - U(start)``, and by how much it may be wrong.
    prefactor
        Of the law ``E[τ] = prefactor · exp(ΔU/ε)`` for small ε; NaN where it is not known.
    how
        How it is known.
    """

    start: np.ndarray
    saddle: np.ndarray
    end: np.ndarray
    value: float
    error: float
    prefactor: float
    how: str


def barrier_of(
    dynamics: Dynamics, quasipotential: sympy.Expr, start: np.ndarray, saddle: np.ndarray, end: np.ndarray
) -> KnownBarrier:
    """The barrier of a system whose U is a formula, with the law of Eyring and Kramers.

    ``(2π/λ) √(|det H_S| / det H_A)`` with the unstable eigenvalue λ at the saddle and the Hessians of U,
    where the circulatory component has no divergence; in one state with D(x), times ``D_S/D_A`` (Bouchet and
    Reygner, Annales Henri Poincaré 17, 3499 (2016)). Elsewhere the prefactor is NaN.

    Parameters
    ----------
    dynamics
        The system.
    quasipotential
        U.
    start, saddle, end
        Equilibria, shape ``(d,)``.
    """
    symbols = dynamics.symbols
    places = np.stack([start, saddle])
    levels = compile_formulas([quasipotential], symbols)(places.T)[0]
    second = [quasipotential.diff(a, b) for a in symbols for b in symbols]
    curvatures = compile_formulas(second, symbols)(places.T).T.reshape(2, len(symbols), len(symbols))
    bottom, top = np.abs(np.linalg.det(curvatures))
    unstable = float(np.linalg.eigvals(dynamics.jacobian(saddle[None])[0]).real.max())
    noise = dynamics.diffusion.at(places)
    share = (
        noise[1, 0, 0] / noise[0, 0, 0]
        if len(symbols) == 1
        else 1.0
        if _divergence_free(dynamics, quasipotential)
        else np.nan
    )
    prefactor = 2 * np.pi / unstable * np.sqrt(top / bottom) * share
    return KnownBarrier(start, saddle, end, float(levels[1] - levels[0]), 0.0, float(prefactor), "exact")


def _divergence_free(dynamics: Dynamics, quasipotential: sympy.Expr) -> bool:
    """Whether ``g = f + ½D∇U`` has no divergence, D being constant."""
    if not dynamics.diffusion.constant:
        return False
    slope = sympy.Matrix([quasipotential.diff(each) for each in dynamics.symbols])
    circulation = sympy.Matrix(dynamics.formulas) + sympy.Matrix(dynamics.diffusion.matrix) * slope / 2
    divergence = sum(
        (g.diff(each) for g, each in zip(circulation, dynamics.symbols, strict=True)), sympy.S.Zero
    )
    return bool(sympy.nsimplify(sympy.expand(divergence), rational=True) == 0)


def _computed(
    start: tuple[float, float],
    saddle: tuple[float, float],
    end: tuple[float, float],
    value: float,
    error: float,
) -> KnownBarrier:
    return KnownBarrier(
        np.array(start), np.array(saddle), np.array(end), value, error, float("nan"), TWO_METHODS
    )


_LOW, _PASS, _HIGH = (1.40491203, 2.80807973), (4.20080731, 4.00388242), (4.90395384, 4.06187119)
_ON, _OFF, _EVEN = (2.61803399, 0.38196601), (0.38196601, 2.61803399), (1.21341166, 1.21341166)
_UP, _DOWN = (0.81649658, 0.27216553), (-0.81649658, -0.27216553)
DOUBLY_COMPUTED: Mapping[str, tuple[KnownBarrier, ...]] = {
    "maier-stein-5": (_computed((-1.0, 0.0), (0.0, 0.0), (1.0, 0.0), 0.4830697094, 1e-9),),
    "maier-stein-10": (_computed((-1.0, 0.0), (0.0, 0.0), (1.0, 0.0), 0.3400414034, 1e-9),),
    "consumer-resource": (
        _computed(_LOW, _PASS, _HIGH, 0.0122596486, 1e-9),
        _computed(_HIGH, _PASS, _LOW, 0.0018932179, 1e-9),
    ),
    "fitzhugh-nagumo": (
        _computed(_UP, (0.0, 0.0), _DOWN, 0.1788869290, 1e-9),
        _computed(_DOWN, (0.0, 0.0), _UP, 0.1788869290, 1e-9),
    ),
    "toggle": (
        _computed(_ON, _EVEN, _OFF, 0.1767588206, 1e-9),
        _computed(_OFF, _EVEN, _ON, 0.1767588206, 1e-9),
    ),
}
"""By name of the system. Saddles and attractors are given to 1e-8."""
