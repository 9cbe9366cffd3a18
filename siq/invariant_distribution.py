"""The invariant distribution that follows from a quasipotential, ``p = Z⁻¹ exp(-U/ε)``.

For ``dx = f dt + sqrt(ε) D^(1/2) dW`` with ``f = -D∇V + g``, ``∇V·g = 0`` and U = 2V, the stationary
Fokker–Planck equation leaves of ``exp(-U/ε)`` only ``-div g · exp(-U/ε)``. Where div g = 0, as for the
paper's archetypal systems, this is therefore the exact invariant density for every ε. Elsewhere it is the
leading order as ε → 0: the density has a prefactor that depends on the state, and Z is wrong by a factor of
order 1 (paper, Eq. eq:invariant_dist).

Integrals over a box are those of `siq.block_quadrature`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.interpolate
import scipy.special
import sympy

from siq.block_quadrature import split_into_blocks

GROUPS = 100  # of walkers, among which the sampling error is estimated


@dataclass(frozen=True)
class MarginalDensity:
    """The invariant density on a plane of two states, the others integrated out.

    Attributes
    ----------
    plane
        Indices of the two states.
    intensity
        ε.
    x1, x2
        The grid, shapes ``(n,)`` and ``(m,)``, evenly spaced from edge to edge of the box.
    values
        Shape ``(m, n)``: density per unit of the first state and unit of the second; its integral over the
        box is 1.
    """

    plane: tuple[int, int]
    intensity: float
    x1: np.ndarray
    x2: np.ndarray
    values: np.ndarray


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
    plane: tuple[int, int] = (0, 1),
    points: int = 201,
    nodes: int = 128,
) -> MarginalDensity:
    """The density on a plane of two states, ``∫ Z⁻¹ exp(-U/ε)`` over the others within a box.

    Parameters
    ----------
    quasipotential, symbols, intensity, box, nodes
        As for `normalisation_quadrature`.
    plane
        Indices of the two states.
    points
        Grid points along each.

    Raises
    ------
    ValueError
        When ε is not positive, or `plane` does not name two of the states.
    NumericalFailure
        As `normalisation_quadrature`.
    """
    if len(set(plane)) != 2 or not set(plane) <= set(range(len(symbols))):
        raise ValueError(f"{plane} are not two of {len(symbols)} states")
    _check_intensity(intensity)
    _, blocks = split_into_blocks(quasipotential, symbols, intensity=intensity, box=box, nodes=nodes)
    axes = {state: np.linspace(box[state][0], box[state][1], points) for state in plane}
    values = np.ones((points, points))
    for block in blocks:
        kept = [state for state in plane if state in block.states]
        density = block.marginal({state: axes[state] for state in kept})
        if len(kept) == 2:
            values = values * density.T
        elif kept:
            values = values * (density[None, :] if kept[0] == plane[0] else density[:, None])
    return MarginalDensity(plane, intensity, axes[plane[0]], axes[plane[1]], values)


@dataclass(frozen=True)
class DensityComparison:
    """The histogram of a long simulation beside a marginal density.

    Attributes
    ----------
    total_variation
        ``½ Σ |P_b - Q_b|`` over the bins, Q the samples' shares and P the density's probabilities: from 0
        to 1, the largest difference in the probability of any union of bins.
    sampling_floor
        What total variation to expect of these samples if the density were exact, from the spread among
        the walkers; NaN with one walker.
    outside
        Share of the samples outside the box; it counts as a further bin, of probability 0.
    x1_edges, x2_edges
        Edges of the bins, shapes ``(n + 1,)`` and ``(m + 1,)``.
    histogram
        Shape ``(m, n)``: the samples' density, in the unit of the marginal density.
    """

    total_variation: float
    sampling_floor: float
    outside: float
    x1_edges: np.ndarray
    x2_edges: np.ndarray
    histogram: np.ndarray


def total_variation(density: MarginalDensity, samples: np.ndarray, *, bins: int = 40) -> DensityComparison:
    """Compare a marginal density with samples of a long stochastic simulation.

    Parameters
    ----------
    density
        The marginal density on a plane.
    samples
        Shape ``(d, ..., walkers)``, all d states: what `siq.simulate.simulate_stationary` returns. Walkers
        count as independent of each other, the samples of one walker do not. Where walkers never leave
        their well, the floor includes a scatter between wells that the choice of initial states avoids.
    bins
        Bins along each of the two states, over the box of the density.
    """
    edges = [np.linspace(axis[0], axis[-1], bins + 1) for axis in (density.x1, density.x2)]
    walkers = samples.shape[-1]
    groups = min(GROUPS, walkers)
    chosen = samples[list(density.plane)].reshape(2, -1, walkers)
    places = [np.searchsorted(edge, x, side="right") - 1 for edge, x in zip(edges, chosen, strict=True)]
    inside = np.logical_and.reduce([(place >= 0) & (place < bins) for place in places])
    bin_of = np.where(inside, places[1] * bins + places[0], bins**2)
    group_of = np.broadcast_to(np.arange(walkers) * groups // walkers, bin_of.shape)
    width = bins**2 + 1
    counts = np.bincount((group_of * width + bin_of).ravel(), minlength=groups * width)
    shares = counts.reshape(groups, width) / np.bincount(group_of.ravel())[:, None]
    observed = np.bincount(bin_of.ravel(), minlength=width) / bin_of.size
    expected = np.append(_bin_probabilities(density, edges), 0.0)
    # The mean of |x| for a normal x is sqrt(2/π) times its standard deviation.
    errors = shares.std(axis=0, ddof=1) / math.sqrt(groups) if groups > 1 else np.full(width, np.nan)
    area = (edges[0][1] - edges[0][0]) * (edges[1][1] - edges[1][0])
    return DensityComparison(
        total_variation=float(np.abs(observed - expected).sum() / 2),
        sampling_floor=float(math.sqrt(2 / math.pi) * errors.sum() / 2),
        outside=float(observed[-1]),
        x1_edges=edges[0],
        x2_edges=edges[1],
        histogram=observed[:-1].reshape(bins, bins) / area,
    )


def _bin_probabilities(density: MarginalDensity, edges: Sequence[np.ndarray]) -> np.ndarray:
    """Integrals of the density over the bins, the second state's bins by row, as one flat array."""
    surface = scipy.interpolate.RectBivariateSpline(density.x1, density.x2, density.values.T)
    return np.array(
        [
            surface.integral(left, right, low, high)
            for low, high in itertools.pairwise(edges[1])
            for left, right in itertools.pairwise(edges[0])
        ]
    )


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
