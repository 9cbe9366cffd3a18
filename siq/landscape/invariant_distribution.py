"""The invariant distribution that follows from a quasipotential, ``p = Z⁻¹ exp(-U/ε)``.

For ``dx = f dt + sqrt(ε) D^(1/2) dW`` with ``f = -D∇V + g``, ``∇V·g = 0`` and U = 2V, the stationary
Fokker–Planck equation leaves of ``exp(-U/ε)`` only ``-div g · exp(-U/ε)``. Where div g = 0, as for the
paper's archetypal systems, this is therefore the exact invariant density for every ε. Elsewhere it is the
leading order as ε → 0: the density has a prefactor that depends on the state, and Z is wrong by a factor of
order 1 (paper, Eq. eq:invariant_dist).

Integrals over a box are those of `siq.landscape.block_quadrature`. A landscape, which is known in part, has
`siq.landscape.density_of_wells`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy.special
import sympy

from siq.landscape.block_quadrature import split_into_blocks
from siq.numerics.density_comparison import MarginalDensity


def normalisation_bessel(
    quasipotential: sympy.Expr, symbols: Sequence[sympy.Symbol], *, intensity: float
) -> float | None:
    """Z over all of space in closed form, for one quartic state and any number of quadratic ones.

    For ``U = a₁x⁴ - a₂x² + a₃ + Σ b_k y_k²`` it is, with ``s = a₂²/(8 a₁ ε)``, the paper's Appendix C,
    ``Z = π sqrt(a₂/(8a₁)) exp(s - a₃/ε) [I_{1/4}(s) + I_{-1/4}(s)] Π sqrt(πε/b_k)``; a₂ < 0 (one well)
    changes the sign of I_{1/4}, and a₂ = 0 leaves a Gamma function.

    Parameters
    ----------
    quasipotential
        U.
    symbols
        The d states.
    intensity
        ε, in the unit of U.

    Returns
    -------
    float or None
        Z, in the product of the states' units; None where U has another form, or is not bounded below.

    Raises
    ------
    ValueError
        When ε is not positive.
    """
    _check_intensity(intensity)
    if not quasipotential.is_polynomial(*symbols):
        return None
    quartic, quadratic, constant = [], [], 0.0
    for state, coefficients in _pure_powers(quasipotential, symbols).items():
        if state is None:
            constant = coefficients[0]
        elif set(coefficients) <= {2, 4} and 4 in coefficients:
            quartic.append((coefficients[4], -coefficients.get(2, 0.0)))
        elif set(coefficients) == {2}:
            quadratic.append(coefficients[2])
        else:
            return None
    if len(quartic) != 1 or len(quadratic) != len(symbols) - 1 or min([quartic[0][0], *quadratic]) <= 0:
        return None
    a1, a2 = quartic[0]
    s = a2**2 / (8 * a1 * intensity)
    # ive and kve carry a factor exp(-s), exp(s): what remains in the exponent is -min U/ε.
    exponent = -constant / intensity
    if a2 > 0:
        exponent += 2 * s
        along = math.pi * math.sqrt(a2 / (8 * a1)) * sum(scipy.special.ive((0.25, -0.25), s))
    elif a2 < 0:  # π (I_{-1/4} - I_{1/4}) = sqrt(2) K_{1/4}
        along = math.sqrt(-a2 / (4 * a1)) * scipy.special.kve(0.25, s)
    else:
        along = 2 * math.gamma(1.25) * (intensity / a1) ** 0.25
    across = math.prod(math.sqrt(math.pi * intensity / b) for b in quadratic)
    return float(along * across * np.exp(exponent))


def normalisation_quadrature(
    quasipotential: sympy.Expr,
    symbols: Sequence[sympy.Symbol],
    *,
    intensity: float,
    box: np.ndarray,
    nodes: int = 128,
) -> float:
    """Z over a box by quadrature, ``∫ exp(-U/ε) dx``.

    Parameters
    ----------
    quasipotential
        U, any formula.
    symbols
        The d states.
    intensity
        ε, in the unit of U.
    box
        Shape ``(d, 2)``, in the states' units. For Z over all of space it must hold all of the density.
    nodes
        Gauss–Legendre nodes along each state of a block of two or three; a state by itself is integrated
        adaptively.

    Returns
    -------
    float
        Z, in the product of the states' units.

    Raises
    ------
    ValueError
        When ε is not positive.
    NumericalFailure
        When more than three states are coupled, U is not finite in the box or lowest at its rim, or the
        quadrature has not converged.
    """
    _check_intensity(intensity)
    constant, blocks = split_into_blocks(quasipotential, symbols, intensity=intensity, box=box, nodes=nodes)
    return float(np.exp(sum(block.log_integral for block in blocks) - constant / intensity))


def marginal_density(
    quasipotential: sympy.Expr,
    symbols: Sequence[sympy.Symbol],
    *,
    intensity: float,
    box: np.ndarray,
    plane: tuple[int, ...] | None = None,
    points: int = 201,
    nodes: int = 128,
) -> MarginalDensity:
    """The density on a plane of two states, ``∫ Z⁻¹ exp(-U/ε)`` over the others within a box, or of one.

    Parameters
    ----------
    quasipotential, symbols, intensity, box, nodes
        As for `normalisation_quadrature`.
    plane
        Indices of the two states, by default of the first two; of a single state there is but ``(0,)``.
    points
        Grid points along each.

    Raises
    ------
    ValueError
        When ε is not positive, or `plane` does not name two of the states.
    NumericalFailure
        As `normalisation_quadrature`.
    """
    shown = min(len(symbols), 2)
    plane = tuple(range(shown)) if plane is None else plane
    if len(set(plane)) != shown or not set(plane) <= set(range(len(symbols))):
        raise ValueError(f"{plane} are not two of {len(symbols)} states")
    _check_intensity(intensity)
    _, blocks = split_into_blocks(quasipotential, symbols, intensity=intensity, box=box, nodes=nodes)
    axes = {state: np.linspace(box[state][0], box[state][1], points) for state in plane}
    if shown == 1:
        return MarginalDensity(plane, intensity, axes[0], np.zeros(0), blocks[0].marginal(axes)[None])
    values = np.ones((points, points))
    for block in blocks:
        kept = [state for state in plane if state in block.states]
        density = block.marginal({state: axes[state] for state in kept})
        if len(kept) == 2:
            values = values * density.T
        elif kept:
            values = values * (density[None, :] if kept[0] == plane[0] else density[:, None])
    return MarginalDensity(plane, intensity, axes[plane[0]], axes[plane[1]], values)


def _pure_powers(
    quasipotential: sympy.Expr, symbols: Sequence[sympy.Symbol]
) -> dict[int | None, dict[int, float]]:
    """Coefficients by state and power; a mixed term stands as power -1, which no form has."""
    found: dict[int | None, dict[int, float]] = {}
    for exponents, coefficient in sympy.Poly(quasipotential, *symbols).terms():
        present = [(index, power) for index, power in enumerate(exponents) if power]
        if coefficient == 0:
            continue
        if not present:
            found.setdefault(None, {})[0] = float(coefficient)
        for index, power in present:
            found.setdefault(index, {})[power if len(present) == 1 else -1] = float(coefficient)
    return found


def _check_intensity(intensity: float) -> None:
    if not 0 < intensity < math.inf:
        raise ValueError(f"the noise intensity ({intensity}) must be positive")
