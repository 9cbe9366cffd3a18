"""The stationary density ``p ~ exp(-U/ε)`` of a formula of U, and its comparison with a long simulation.

For ``dx = f dt + sqrt(ε) D^(1/2) dW`` with ``f = -D∇V + g``, ``∇V·g = 0`` and U = 2V, the stationary
Fokker–Planck equation leaves of ``exp(-U/ε)`` only ``-div g · exp(-U/ε)``. Where div g = 0, as for the
paper's archetypal systems, this is therefore the exact density for every ε. Elsewhere it is the leading order
as ε → 0: the density has a prefactor that depends on the state, and Z is wrong by a factor of order 1 (paper,
Eq. eq:invariant_dist).

States that occur in one term together form a block, and the integrand is the product over the blocks. A state
by itself is integrated panel by panel, two or three on a tensor product of Gauss–Legendre nodes. The density
of wells, each with a formula of its own, is that of `siq.quasipotential.cell_density`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.interpolate
import scipy.special
import sympy

from siq.errors import NumericalFailure
from siq.systems.formulas import compile_formulas

WALKER_GROUPS = 100  # among which the sampling error is estimated
BINS = 40  # along each of the states
LARGEST_BLOCK = 3  # states; beyond, a tensor product of nodes is out of reach
PANELS = 200  # of the integral over a single state: U may be known to vary within a thousandth of the box
QUADRATURE_TOLERANCE = 1e-6  # relative: what a quadrature's own estimate of its error may be


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
        Share of the samples outside the box, which counts as a further bin, of probability 0. Of a
        landscape: share of the samples where U is not known, which are left out.
    x1_edges, x2_edges, histogram
        Edges of the bins, shapes ``(n + 1,)`` and ``(m + 1,)``, the latter empty with one state; and the
        samples' density, ``(m, n)`` or ``(1, n)``, in the marginal density's unit.
    """

    total_variation: float
    sampling_floor: float
    outside: float
    x1_edges: np.ndarray
    x2_edges: np.ndarray
    histogram: np.ndarray

    @classmethod
    def of_samples(
        cls,
        samples: np.ndarray,
        edges: Sequence[np.ndarray],
        expected: Sequence[float] | np.ndarray,
        *,
        counted: np.ndarray | None = None,
    ) -> DensityComparison:
        """Of samples ``(1 or 2, times, walkers)`` and probabilities of bins, row by row of the second state.

        A further bin is what lies outside the box. `counted` masks the samples that count; by default all.
        """
        bins, expected = len(edges[0]) - 1, np.append(expected, 0.0)
        places = [np.searchsorted(edge, x, side="right") - 1 for edge, x in zip(edges, samples, strict=True)]
        inside = np.logical_and.reduce([(place >= 0) & (place < bins) for place in places])
        rows_and_columns = sum(place * bins**power for power, place in enumerate(places))
        bin_of = np.where(inside, rows_and_columns, bins ** len(places))
        walkers, width = bin_of.shape[-1], len(expected)
        groups = min(WALKER_GROUPS, walkers)
        group_of = np.broadcast_to(np.arange(walkers) * groups // walkers, bin_of.shape)
        label = group_of * width + bin_of
        counts = np.bincount(label.ravel() if counted is None else label[counted], minlength=groups * width)
        counts = counts.reshape(groups, width)
        observed = counts.sum(axis=0) / max(counts.sum(), 1)
        shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        # The mean of |x| for a normal x is sqrt(2/π) times its standard deviation.
        errors = shares.std(axis=0, ddof=1) / math.sqrt(groups) if groups > 1 else np.full(width, np.nan)
        area = math.prod(one[1] - one[0] for one in edges)
        return cls(
            total_variation=float(np.abs(observed - expected).sum() / 2),
            sampling_floor=float(math.sqrt(2 / math.pi) * errors.sum() / 2),
            outside=float(observed[-1]) if counted is None else 1 - float(counted.mean()),
            x1_edges=edges[0],
            x2_edges=edges[1] if len(edges) > 1 else np.zeros(0),
            histogram=observed[:-1].reshape(-1, len(edges[0]) - 1) / area,
        )


@dataclass(frozen=True)
class StationaryDensity:
    """The density on a plane of two states, the others integrated out; or of a single state.

    Attributes
    ----------
    plane, intensity
        Indices of the two states, or of the only one; and ε.
    x1, x2
        The grid, shapes ``(n,)`` and ``(m,)``, evenly spaced: from edge to edge of the box, or, of wells, in
        the middles of its cells. With one state `x2` is empty.
    values
        Shape ``(m, n)``, ``(1, n)`` with one state: density per unit of the first state and unit of the
        second; its integral over the box is 1. NaN where it is not known.
    normalisation, comparison
        Z, None where it is not to be written; and a long simulation beside it.
    unknown
        The share of all probability that lies where the density is not known, at most; None where it is
        known everywhere.
    """

    plane: tuple[int, ...]
    intensity: float
    x1: np.ndarray
    x2: np.ndarray
    values: np.ndarray
    normalisation: float | None = None
    comparison: DensityComparison | None = None
    unknown: float | None = None

    def compare(self, samples: np.ndarray, *, bins: int = BINS) -> DensityComparison:
        """Compare the density of a formula with samples of a long stochastic simulation.

        Samples of all d states, ``(d, ..., walkers)``, are what `siq.systems.simulation.simulate_stationary`
        returns, and there are so many bins along each state of the plane. Walkers count as independent of
        each other, the samples of one walker do not. Where walkers never leave their well, the floor includes
        a scatter between wells that the choice of initial states avoids.
        """
        axes = (self.x1, self.x2)[: len(self.plane)]
        edges = [np.linspace(axis[0], axis[-1], bins + 1) for axis in axes]
        if len(edges) == 1:
            curve = scipy.interpolate.InterpolatedUnivariateSpline(self.x1, self.values[0])
            expected = [curve.integral(left, right) for left, right in itertools.pairwise(edges[0])]
        else:
            surface = scipy.interpolate.RectBivariateSpline(self.x1, self.x2, self.values.T)
            expected = [
                surface.integral(left, right, low, high)
                for low, high in itertools.pairwise(edges[1])
                for left, right in itertools.pairwise(edges[0])
            ]
        chosen = samples[list(self.plane)].reshape(len(axes), -1, samples.shape[-1])
        return DensityComparison.of_samples(chosen, edges, expected)


class _Block:
    """The terms of U that couple some states, in the unit of ε, over these states' part of the box."""

    def __init__(
        self, u: sympy.Expr, states: list[int], symbols: Sequence[sympy.Symbol], box: np.ndarray, nodes: int
    ) -> None:
        self.states, self.box, self.nodes = states, box[states], nodes
        self.function = compile_formulas([u], [symbols[state] for state in states])
        self.log_integral, coarse = (self._log_integral(count) for count in (nodes, 3 * nodes // 4))
        if not abs(self.log_integral - coarse) <= QUADRATURE_TOLERANCE:
            raise NumericalFailure(
                "the integral of exp(-U/ε) has not converged (relative error"
                f" {abs(self.log_integral - coarse):.1e}); take more nodes or a smaller box"
            )

    def exponent(self, axes: Iterable[np.ndarray]) -> np.ndarray:
        """U/ε of the block on a grid."""
        with np.errstate(all="ignore"):
            values = self.function(np.stack(np.meshgrid(*axes, indexing="ij")))[0]
        if not np.isfinite(values).all():
            raise NumericalFailure("the quasipotential is not finite everywhere in the box")
        return values

    def _log_integral(self, count: int) -> float:
        # A narrow well of a single state must not fall between the nodes.
        panels = PANELS if len(self.states) == 1 else 1
        rules = [_gauss_legendre(bounds, count, panels) for bounds in self.box]
        values = self.exponent(nodes for nodes, _ in rules)
        lowest = float(values.min())
        if values[(slice(1, -1),) * values.ndim].min() > lowest:
            raise NumericalFailure(
                "the quasipotential is lowest at the rim of the box; exp(-U/ε) peaks there"
            )
        density = np.exp(lowest - values)
        for _, weights in reversed(rules):
            density = density @ weights
        return float(np.log(density) - lowest)

    def marginal(self, axes: dict[int, np.ndarray]) -> np.ndarray:
        """Density of the states of `axes` on a grid, an axis for each; the other ones are integrated out."""
        rules = [_gauss_legendre(bounds, self.nodes) for bounds in self.box]
        nodes = (axes.get(state, rule[0]) for state, rule in zip(self.states, rules, strict=True))
        density = np.exp(-self.exponent(nodes) - self.log_integral)
        for place, state in reversed(list(enumerate(self.states))):
            if state not in axes:
                density = np.moveaxis(density, place, -1) @ rules[place][1]
        return density


def _gauss_legendre(bounds: np.ndarray, count: int, panels: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights, so many in each of some equal panels."""
    nodes, weights = scipy.special.roots_legendre(count)
    edges = np.linspace(bounds[0], bounds[1], panels + 1)
    half = (edges[1] - edges[0]) / 2
    return (edges[:-1, None] + half * (nodes + 1)).ravel(), np.tile(half * weights, panels)


def normalisation_bessel(
    quasipotential: sympy.Expr, symbols: Sequence[sympy.Symbol], *, intensity: float
) -> float | None:
    """Z over all of space in closed form, for one quartic state and any number of quadratic ones.

    For ``U = a₁x⁴ - a₂x² + a₃ + Σ b_k y_k²`` it is, with ``s = a₂²/(8 a₁ ε)``, the paper's Appendix C,
    ``Z = π sqrt(a₂/(8a₁)) exp(s - a₃/ε) [I_{1/4}(s) + I_{-1/4}(s)] Π sqrt(πε/b_k)``; a₂ < 0 (one well)
    changes the sign of I_{1/4}, and a₂ = 0 leaves a Gamma function.

    Z is in the product of the states' units, and ε in the unit of U, positive (`ValueError`). None where U
    has another form, or is not bounded below.
    """
    if not 0 < intensity < math.inf:
        raise ValueError(f"the noise intensity ({intensity}) must be positive")
    if not quasipotential.is_polynomial(*symbols):
        return None
    constant, powers = 0.0, [dict[int, float]() for _ in symbols]
    for exponents, coefficient in sympy.Poly(quasipotential, *symbols).terms():
        present = [(index, power) for index, power in enumerate(exponents) if power]
        if len(present) > 1:
            return None
        for index, power in present:
            powers[index][power] = float(coefficient)
        constant += 0.0 if present else float(coefficient)
    quartic = [(own[4], -own.get(2, 0.0)) for own in powers if own.keys() in ({4}, {2, 4})]
    quadratic = [own[2] for own in powers if own.keys() == {2}]
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


def marginal_density(
    quasipotential: sympy.Expr,
    symbols: Sequence[sympy.Symbol],
    *,
    intensity: float,
    box: np.ndarray,
    points: int = 201,
    nodes: int = 128,
) -> StationaryDensity:
    """The density of the first two states, or of the only one, the others integrated out; with Z of all.

    Parameters
    ----------
    quasipotential, symbols
        U, any formula, and the d states.
    intensity
        ε, in the unit of U.
    box
        Shape ``(d, 2)``, in the states' units. For Z over all of space it must hold all of the density.
    points, nodes
        Grid points along each of the two; and Gauss–Legendre nodes along each state of a block of two or
        three, and in each of the panels of a state by itself.

    Raises
    ------
    ValueError
        When ε is not positive.
    NumericalFailure
        When more than three states are coupled, U is not finite in the box or lowest at its rim, or the
        quadrature has not converged.
    """
    if not 0 < intensity < math.inf:
        raise ValueError(f"the noise intensity ({intensity}) must be positive")
    # U is a constant and blocks without common states; a state that is not in U is a block.
    constant, groups = 0.0, [({symbol}, sympy.S.Zero) for symbol in symbols]
    for part in sympy.Add.make_args(sympy.expand(quasipotential)):
        if not part.free_symbols:
            constant += float(part)
            continue
        coupled = [group for group in groups if group[0] & part.free_symbols]
        groups = [group for group in groups if not group[0] & part.free_symbols]
        groups.append((set().union(*(group[0] for group in coupled)), part + sum(e for _, e in coupled)))
    blocks = []
    for members, expression in groups:
        states = [index for index, symbol in enumerate(symbols) if symbol in members]
        if len(states) > LARGEST_BLOCK:
            names = ", ".join(str(symbols[state]) for state in states)
            raise NumericalFailure(
                f"the quasipotential couples {len(states)} states ({names}), of which at most"
                f" {LARGEST_BLOCK} can be integrated together"
            )
        scaled = expression / sympy.Float(intensity, 17)
        blocks.append(_Block(scaled, states, symbols, np.asarray(box, dtype=float), nodes))
    total = float(np.exp(sum(block.log_integral for block in blocks) - constant / intensity))
    plane = tuple(range(min(len(symbols), 2)))
    axes = {state: np.linspace(box[state][0], box[state][1], points) for state in plane}
    values = np.ones((1, 1))
    for block in blocks:
        kept = {state: axes[state] for state in plane if state in block.states}
        if kept:
            shape = [points if state in kept else 1 for state in (1, 0)]
            values = values * block.marginal(kept).T.reshape(shape)
    return StationaryDensity(plane, intensity, axes[0], axes.get(1, np.zeros(0)), values, total)
