"""The invariant density ``p ~ exp(-U/ε)`` of one well or several, and long simulations to hold it against.

States that occur in one term together form a *block*; the integrand is the product over the blocks. A state
by itself is integrated adaptively, two or three on a tensor product of Gauss–Legendre nodes.

For ``dx = f dt + sqrt(ε) D^(1/2) dW`` with ``f = -D∇V + g``, ``∇V·g = 0`` and U = 2V, the stationary
Fokker–Planck equation leaves of ``exp(-U/ε)`` only ``-div g · exp(-U/ε)``. Where div g = 0, as for the
paper's archetypal systems, this is therefore the exact invariant density for every ε. Elsewhere it is the
leading order as ε → 0: the density has a prefactor that depends on the state, and Z is wrong by a factor of
order 1 (paper, Eq. eq:invariant_dist).

Integrals over a box are those of `siq.quasipotential.invariant_density`. A landscape, which is known in part,
has `siq.quasipotential.invariant_density`.

U over all wells (`siq.quasipotential.landscape`) says NaN where no formula is believed. Z is then the
integral over the cells of a box at whose middles U is known, as far as they hang together with the
attractor, and what the other cells can add to it is bounded. If no attractor lies among them, U is nowhere
below either of two levels in them:

- the lowest U along the rim of the unknown part, since whatever leads into it from an attractor crosses the
  rim, and U does not fall on a path of least action from its attractor;
- U where f, followed from the state, enters the known region, since U does not rise along f.

Both are told to within the width of a cell. Like the density, they are the leading order as ε → 0: the
prefactor of exp(-U/ε), which varies with the state where div g ≠ 0 or D is not the same everywhere, counts
as 1. Of one state it is known, 1/D(x), and the density is exact.

At small ε a walker stays in its well for longer than anyone can simulate. Walkers therefore start with the
wells' shares that the density itself says. Then the comparison tests the density within each well, and the
shares only as far as walkers change wells; how many do is counted.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.integrate
import scipy.interpolate
import scipy.ndimage
import scipy.optimize
import scipy.special
import sympy

from siq.errors import NumericalFailure
from siq.numerics.integration import heun_step, runge_kutta_step
from siq.quasipotential.landscape import GlobalQuasipotential
from siq.systems.dynamics import Dynamics
from siq.systems.formulas import compile_formulas
from siq.systems.simulation import noise_source

GROUPS = 100  # of walkers, among which the sampling error is estimated
BINS = 40  # along each of the states


@dataclass(frozen=True)
class MarginalDensity:
    """The invariant density on a plane of two states, the others integrated out; or of a single state.

    Attributes
    ----------
    plane
        Indices of the two states, or of the only one.
    intensity
        ε.
    x1, x2
        The grid, shapes ``(n,)`` and ``(m,)``, evenly spaced: from edge to edge of the box, or, of a
        landscape, in the middles of its cells. With one state `x2` is empty.
    values
        Shape ``(m, n)``, ``(1, n)`` with one state: density per unit of the first state and unit of the
        second; its integral over the box is 1. NaN where it is not known.
    """

    plane: tuple[int, ...]
    intensity: float
    x1: np.ndarray
    x2: np.ndarray
    values: np.ndarray


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
    x1_edges, x2_edges
        Edges of the bins, shapes ``(n + 1,)`` and ``(m + 1,)``; with one state the latter is empty.
    histogram
        Shape ``(m, n)``, ``(1, n)`` with one state: the samples' density, in the marginal density's unit.
    """

    total_variation: float
    sampling_floor: float
    outside: float
    x1_edges: np.ndarray
    x2_edges: np.ndarray
    histogram: np.ndarray


@dataclass(frozen=True)
class ComparedDensity:
    """The density for one ε, with Z and a long simulation beside it.

    Attributes
    ----------
    density
        The density on a plane of two states, or of the only one.
    normalisation
        Z, None where it is not to be written.
    comparison
        A long simulation beside it, None where there is none.
    unknown
        The share of all probability that lies where the density is not known, at most; None where it is
        known everywhere.
    """

    density: MarginalDensity
    normalisation: float | None = None
    comparison: DensityComparison | None = None
    unknown: float | None = None


def total_variation(density: MarginalDensity, samples: np.ndarray, *, bins: int = BINS) -> DensityComparison:
    """Compare a marginal density with samples of a long stochastic simulation.

    Parameters
    ----------
    density
        The marginal density on a plane, from edge to edge of the box.
    samples
        Shape ``(d, ..., walkers)``, all d states: what `siq.systems.simulation.simulate_stationary`
        returns. Walkers count as independent of each other, the samples of one walker do not. Where walkers
        never leave their well, the floor includes a scatter between wells that the choice of initial states
        avoids.
    bins
        Bins along each of the states, over the box of the density.
    """
    axes = (density.x1, density.x2)[: len(density.plane)]
    edges = [np.linspace(axis[0], axis[-1], bins + 1) for axis in axes]
    chosen = samples[list(density.plane)].reshape(len(axes), -1, samples.shape[-1])
    places = [np.searchsorted(edge, x, side="right") - 1 for edge, x in zip(edges, chosen, strict=True)]
    inside = np.logical_and.reduce([(place >= 0) & (place < bins) for place in places])
    row_and_column = sum(place * bins**power for power, place in enumerate(places))
    bin_of = np.where(inside, row_and_column, bins ** len(places))
    return compare_shares(bin_of, np.append(_bin_probabilities(density, edges), 0.0), edges)


def compare_shares(
    bin_of: np.ndarray,
    expected: np.ndarray,
    edges: Sequence[np.ndarray],
    *,
    counted: np.ndarray | None = None,
) -> DensityComparison:
    """Compare the shares of samples in bins with their probabilities.

    Parameters
    ----------
    bin_of
        The bin of every sample, shape ``(times, walkers)``: row of the second state times the bins of the
        first, plus the column; the last bin is what lies outside the box.
    expected
        Probability of every bin, shape ``(bins + 1,)``.
    edges
        Of the bins along the first state and the second, if there is one.
    counted
        The samples that count, of the shape of `bin_of`; by default all.
    """
    walkers, width = bin_of.shape[-1], len(expected)
    groups = min(GROUPS, walkers)
    group_of = np.broadcast_to(np.arange(walkers) * groups // walkers, bin_of.shape)
    label = group_of * width + bin_of
    counts = np.bincount(label.ravel() if counted is None else label[counted], minlength=groups * width)
    counts = counts.reshape(groups, width)
    observed = counts.sum(axis=0) / max(counts.sum(), 1)
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    # The mean of |x| for a normal x is sqrt(2/π) times its standard deviation.
    errors = shares.std(axis=0, ddof=1) / math.sqrt(groups) if groups > 1 else np.full(width, np.nan)
    area = math.prod(one[1] - one[0] for one in edges)
    return DensityComparison(
        total_variation=float(np.abs(observed - expected).sum() / 2),
        sampling_floor=float(math.sqrt(2 / math.pi) * errors.sum() / 2),
        outside=float(observed[-1]) if counted is None else 1 - float(counted.mean()),
        x1_edges=edges[0],
        x2_edges=edges[1] if len(edges) > 1 else np.zeros(0),
        histogram=observed[:-1].reshape(-1, len(edges[0]) - 1) / area,
    )


def _bin_probabilities(density: MarginalDensity, edges: Sequence[np.ndarray]) -> np.ndarray:
    """Integrals of the density over the bins, the second state's bins by row, as one flat array."""
    if len(edges) == 1:
        curve = scipy.interpolate.InterpolatedUnivariateSpline(density.x1, density.values[0])
        return np.array([curve.integral(left, right) for left, right in itertools.pairwise(edges[0])])
    surface = scipy.interpolate.RectBivariateSpline(density.x1, density.x2, density.values.T)
    return np.array(
        [
            surface.integral(left, right, low, high)
            for low, high in itertools.pairwise(edges[1])
            for left, right in itertools.pairwise(edges[0])
        ]
    )


LARGEST_BLOCK = 3  # states; beyond, a tensor product of nodes is out of reach
SCAN_POINTS = 2001  # where the wells of a one-dimensional integral are looked for
MOST_WELLS = 50  # of them
TOLERANCE = 1e-6  # relative: what a quadrature's own estimate of its error may be


@dataclass(frozen=True)
class CoupledTerms:
    """The terms of U that couple some states, over these states' part of the box.

    Attributes
    ----------
    expression
        The terms, in the unit of ε.
    states, symbols
        Indices and symbols of the k states, in the order of the state vector.
    box
        Shape ``(k, 2)``, in the states' units.
    intensity
        ε.
    nodes
        Gauss–Legendre nodes along each state.
    """

    expression: sympy.Expr
    states: tuple[int, ...]
    symbols: tuple[sympy.Symbol, ...]
    box: np.ndarray
    intensity: float
    nodes: int

    @cached_property
    def exponent(self) -> Callable[[np.ndarray], np.ndarray]:
        """U/ε of the block, components ``(k, ...)`` to ``(...)``."""
        function = compile_formulas([self.expression / sympy.Float(self.intensity, 17)], self.symbols)

        def evaluate(components: np.ndarray) -> np.ndarray:
            with np.errstate(all="ignore"):
                values = function(components)[0]
            if not np.isfinite(values).all():
                raise NumericalFailure("the quasipotential is not finite everywhere in the box")
            return values

        return evaluate

    @cached_property
    def log_integral(self) -> float:
        """Log ∫ exp(-U/ε) over the block's part of the box."""
        if len(self.states) == 1:
            return self._log_integral_adaptive()
        fine, coarse = (self._log_integral_tensor(count) for count in (self.nodes, 3 * self.nodes // 4))
        _check_convergence(abs(fine - coarse))
        return fine

    def _log_integral_adaptive(self) -> float:
        def value(x: float) -> float:
            return float(self.exponent(np.array([[x]]))[0])

        lower, upper = self.box[0]
        grid = np.linspace(lower, upper, SCAN_POINTS)
        values = self.exponent(grid[None])
        lowest = _lowest_inside(values)
        # A narrow well between the nodes of the first rule would be overlooked: tell where the wells are.
        inside = np.flatnonzero((values[1:-1] <= values[:-2]) & (values[1:-1] < values[2:])) + 1
        wells = []
        for index in inside[np.argsort(values[inside])[:MOST_WELLS]]:
            between = (grid[index - 1], grid[index + 1])
            found = scipy.optimize.minimize_scalar(value, bounds=between, options={"xatol": 1e-12})
            wells.append(float(found.x))
            lowest = min(lowest, float(found.fun))
        total, error = scipy.integrate.quad(
            lambda x: math.exp(lowest - value(x)), lower, upper,
            points=wells or None, limit=500, epsabs=0.0, epsrel=1e-12, full_output=1,
        )[:2]  # fmt: skip
        _check_convergence(error / total if total > 0 else math.inf)
        return math.log(total) - lowest

    def _log_integral_tensor(self, count: int) -> float:
        rules = [_gauss_legendre(bounds, count) for bounds in self.box]
        values = self.exponent(np.stack(np.meshgrid(*(rule[0] for rule in rules), indexing="ij")))
        lowest = _lowest_inside(values)
        density = np.exp(lowest - values)
        for _, weights in reversed(rules):
            density = density @ weights
        return float(np.log(density) - lowest)

    def marginal(self, axes: dict[int, np.ndarray]) -> np.ndarray:
        """Density of some of the block's states on a grid, the other ones integrated out.

        The result has one axis for each state of `axes`, in the order given there.
        """
        if not axes:
            return np.ones(())
        rest = [state for state in self.states if state not in axes]
        rules = {state: _gauss_legendre(self.box[self.states.index(state)], self.nodes) for state in rest}
        coordinates = axes | {state: rule[0] for state, rule in rules.items()}
        mesh = dict(zip(coordinates, np.meshgrid(*coordinates.values(), indexing="ij"), strict=True))
        density = np.exp(-self.exponent(np.stack([mesh[state] for state in self.states])) - self.log_integral)
        for state in reversed(rest):
            density = density @ rules[state][1]
        return density


def split_into_blocks(
    quasipotential: sympy.Expr,
    symbols: Sequence[sympy.Symbol],
    *,
    intensity: float,
    box: np.ndarray,
    nodes: int,
) -> tuple[float, list[CoupledTerms]]:
    """Split U into a constant and blocks that have no state in common.

    Parameters
    ----------
    quasipotential
        U, any formula.
    symbols
        The d states.
    intensity
        ε, in the unit of U.
    box
        Shape ``(d, 2)``, in the states' units.
    nodes
        Gauss–Legendre nodes along each state of a block of two or three.

    Returns
    -------
    tuple of float and list of CoupledTerms
        The constant, in the unit of ε, and the blocks; a state that U does not hold is a block by itself.

    Raises
    ------
    NumericalFailure
        When a block has more than `LARGEST_BLOCK` states.
    """
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
        states = tuple(index for index, symbol in enumerate(symbols) if symbol in members)
        if len(states) > LARGEST_BLOCK:
            names = ", ".join(str(symbols[state]) for state in states)
            raise NumericalFailure(
                f"the quasipotential couples {len(states)} states ({names}), of which at most"
                f" {LARGEST_BLOCK} can be integrated together"
            )
        blocks.append(
            CoupledTerms(
                expression=expression,
                states=states,
                symbols=tuple(symbols[state] for state in states),
                box=np.asarray(box, dtype=float)[list(states)],
                intensity=intensity,
                nodes=nodes,
            )
        )
    return constant, blocks


def _gauss_legendre(bounds: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    nodes, weights = scipy.special.roots_legendre(count)
    half = (bounds[1] - bounds[0]) / 2
    return bounds[0] + half * (nodes + 1), half * weights


def _lowest_inside(values: np.ndarray) -> float:
    """Smallest value; refused where it lies at the rim, as for a formula that falls towards -∞ there."""
    lowest = float(values.min())
    if values[(slice(1, -1),) * values.ndim].min() > lowest:
        raise NumericalFailure("the quasipotential is lowest at the rim of the box; exp(-U/ε) peaks there")
    return lowest


def _check_convergence(error: float) -> None:
    if not error <= TOLERANCE:
        raise NumericalFailure(
            f"the integral of exp(-U/ε) has not converged (relative error {error:.1e}); take more nodes or"
            " a smaller box"
        )


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


CELLS = {1: 4000, 2: 400, 3: 80}  # along each state, by the number of states; multiples of the bins
DENSITY_OF_WELLS_TOLERANCE = 0.02  # relative: by how much Z may change if cells are twice as wide
STRIDE = 3.0  # cells: longest step along f
LONGEST = 0.5  # of the shortest time of f: the same
MOST_STEPS = 2000  # along f
WIDER = 0.5  # of the box, by which f may lead out of it on the way


@dataclass(frozen=True)
class SampledPotential:
    """U over all wells in the middles of the cells of a box.

    Attributes
    ----------
    box
        Shape ``(d, 2)``.
    values
        U, one axis for each state, NaN where it is not known.
    well
        Index of the well whose formula gives U, of the same shape; -1 where none does.
    wells
        Their number, k.
    prefactor
        Of exp(-U/ε), where it is known and not one: of one state, D at the first attractor over D, of the
        shape of `values`.
    """

    box: np.ndarray
    values: np.ndarray
    well: np.ndarray
    wells: int
    prefactor: np.ndarray | None = None

    @property
    def widths(self) -> np.ndarray:
        """Of a cell, shape ``(d,)``."""
        widths: np.ndarray = np.ptp(self.box, axis=1) / self.values.shape
        return widths

    @property
    def axes(self) -> list[np.ndarray]:
        """The middles of the cells along each state."""
        return [
            low + (np.arange(count) + 0.5) * width
            for (low, _), count, width in zip(self.box, self.values.shape, self.widths, strict=True)
        ]

    @property
    def known(self) -> np.ndarray:
        """Where U is known, of the shape of `values`."""
        return np.isfinite(self.values)

    def middles(self, chosen: np.ndarray) -> np.ndarray:
        """Middles of chosen cells, a mask of the shape of `values`: components ``(d, n)``."""
        return np.stack([axis[index] for axis, index in zip(self.axes, np.nonzero(chosen), strict=True)])

    def places(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The cells in which states lie, components ``(d, ...)``: indices of this shape, and what is inside.

        The index of a state outside the box is that of a cell at its rim.
        """
        wide = (slice(None), *(None,) * (x.ndim - 1))
        index = np.floor((x - self.box[:, 0][wide]) / self.widths[wide])
        last = np.array(self.values.shape)[wide] - 1
        inside = ((index >= 0) & (index <= last)).all(axis=0)
        return np.clip(np.nan_to_num(index), 0, last).astype(int), inside


@dataclass(frozen=True)
class KnownDensity:
    """``exp(-U/ε)/Z`` where U is known, and how much of all probability lies elsewhere at most.

    Attributes
    ----------
    intensity
        ε.
    normalisation
        Z over the cells in which U is known, in the product of the states' units.
    change
        By how much Z changes, relatively, if cells are twice as wide.
    unknown
        The share of all probability in the box that the other cells can hold at most.
    lowest_unknown
        The level that U is above in all of them; infinite where there are none.
    probabilities
        Of the cells, of the shape of `SampledPotential.values`, 1 in total; zero where U is not known.
    shares
        The wells' shares of it, shape ``(k,)``.
    """

    intensity: float
    normalisation: float
    change: float
    unknown: float
    lowest_unknown: float
    probabilities: np.ndarray
    shares: np.ndarray


def sample_potential(
    potential: GlobalQuasipotential, box: np.ndarray, *, cells: int | None = None
) -> SampledPotential:
    """U over all wells in the middles of the cells of a box.

    Parameters
    ----------
    potential
        U.
    box
        Shape ``(d, 2)``.
    cells
        Along each state; by default as many as are affordable.

    Raises
    ------
    NumericalFailure
        When there are more than three states.
    """
    box = np.asarray(box, dtype=float)
    if len(box) not in CELLS:
        raise NumericalFailure(f"densities over wells are for three states at most, and these are {len(box)}")
    shape = (cells or CELLS[len(box)],) * len(box)
    empty = SampledPotential(box, np.full(shape, np.nan), np.full(shape, -1), len(potential.wells))
    by_well = potential.by_well(empty.middles(np.ones(shape, dtype=bool)).T).reshape(-1, *shape)
    values = np.where(np.isfinite(by_well), by_well, np.inf)
    for own, one in zip(values, potential.wells, strict=True):
        # An island, which places part from the attractor at which the formula is known to be wrong.
        parts, _ = scipy.ndimage.label(np.isfinite(own))
        own[parts != parts[tuple(empty.places(one.attractor)[0])]] = np.inf
    least = values.min(axis=0)
    known = np.isfinite(least)
    return SampledPotential(
        box,
        np.where(known, least, np.nan),
        np.where(known, values.argmin(axis=0), -1),
        len(potential.wells),
        _prefactor(potential, empty),
    )


def _prefactor(potential: GlobalQuasipotential, sampled: SampledPotential) -> np.ndarray | None:
    if sampled.values.ndim > 1:
        return None
    first = potential.wells[0]
    noise = first.dynamics.diffusion
    if noise.constant:
        return None
    own = noise.at(np.stack([first.attractor, *sampled.axes[0][:, None]]))[:, 0, 0]
    # Where a formula of D is not positive no state can be, and none is known.
    return np.asarray(own[0] / np.where(own[1:] > 0, own[1:], np.inf))


def lowest_possible(sampled: SampledPotential, dynamics: Dynamics) -> np.ndarray:
    """What U cannot be below in the cells in which it is not known, infinite in the others.

    Parameters
    ----------
    sampled
        U.
    dynamics
        The identified f.

    Returns
    -------
    numpy.ndarray
        Of the shape of `SampledPotential.values`.
    """
    known = sampled.known
    values = np.where(known, sampled.values, np.inf)
    around = np.ones((3,) * values.ndim)
    # What is outside the box is not known either, and whatever is in it may have come from there.
    unknown = np.pad(~known, 1, constant_values=True)
    part, parts = scipy.ndimage.label(unknown, around)
    # Two cells wide, as U varies between the middle of a cell and the rim.
    near = scipy.ndimage.minimum_filter(np.pad(values, 1, constant_values=np.inf), 5, mode="nearest")
    rims = np.array([-np.inf, *np.atleast_1d(scipy.ndimage.minimum(near, part, np.arange(1, parts + 1)))])
    inside = (slice(1, -1),) * values.ndim
    lowest = np.where(known, np.inf, rims[part][inside])
    lowest[~known] = np.maximum(lowest[~known], _entered(sampled, dynamics))
    # A cell is where f leads from its middle, or from the middle of a cell beside it.
    least: np.ndarray = scipy.ndimage.minimum_filter(lowest, footprint=around, mode="nearest")
    return np.where(known, np.inf, least)


def _entered(sampled: SampledPotential, dynamics: Dynamics) -> np.ndarray:
    """U where f enters the known region from each unknown cell, -∞ where it does not."""
    low = scipy.ndimage.minimum_filter(np.where(sampled.known, sampled.values, np.inf), 3, mode="nearest")
    x = sampled.middles(~sampled.known)
    levels = np.full(x.shape[1], -np.inf)
    function = dynamics.drift_of_components
    widths = sampled.widths[:, None]
    fastest = np.linalg.norm(dynamics.jacobian(x.T), axis=(1, 2)).max(initial=0.0)
    longest = LONGEST / fastest if fastest > 0 else np.inf
    wide = sampled.box + WIDER * np.ptp(sampled.box, axis=1)[:, None] * np.array([-1.0, 1.0])
    running = np.arange(x.shape[1])
    for _ in range(MOST_STEPS):
        speed = np.abs(function(x) / widths).max(axis=0)
        with np.errstate(divide="ignore"):
            step = np.minimum(STRIDE / speed, longest)
        x = runge_kutta_step(function, x, np.where(np.isfinite(step), step, 0.0))
        index, inside = sampled.places(x)
        arrived = inside & sampled.known[tuple(index)]
        levels[running[arrived]] = low[tuple(index)][arrived]
        going = ~arrived & ((x > wide[:, :1]) & (x < wide[:, 1:])).all(axis=0)
        x, running = x[:, going], running[going]
        if not running.size:
            break
    return levels


def known_density(
    fine: SampledPotential, coarse: SampledPotential, lowest: np.ndarray, *, intensity: float
) -> KnownDensity:
    """The density for one ε.

    Parameters
    ----------
    fine, coarse
        U on cells, and on cells twice as wide, which tell how accurate the integral is.
    lowest
        What U cannot be below in the other of the wider cells; see `lowest_possible`.
    intensity
        ε, in the unit of U.

    Raises
    ------
    ValueError
        When ε is not positive.
    NumericalFailure
        When U is known nowhere, or the cells are too wide for ε.
    """
    if not 0 < intensity < np.inf:
        raise ValueError(f"the noise intensity ({intensity}) must be positive")
    if not fine.known.any():
        raise NumericalFailure("U is known nowhere in the box")
    bottom = float(np.nanmin(fine.values))  # taken out of the exponents, which would run out of range
    weights, wide = (
        np.exp(-(np.nan_to_num(one.values, nan=np.inf) - bottom) / intensity)
        * (1.0 if one.prefactor is None else one.prefactor)
        for one in (fine, coarse)
    )
    total, rough = (weights.sum() * fine.widths.prod(), wide.sum() * coarse.widths.prod())
    change = float(abs(rough / total - 1))
    if not change <= DENSITY_OF_WELLS_TOLERANCE:
        raise NumericalFailure(
            f"the integral of exp(-U/ε) changes by {change:.1%} if cells are twice as wide; the wells are too"
            " narrow for the box"
        )
    above = np.exp(-(lowest - bottom) / intensity) * (1.0 if coarse.prefactor is None else coarse.prefactor)
    elsewhere = float(above.sum() * coarse.widths.prod())
    shares = np.bincount(fine.well[fine.known], weights[fine.known], minlength=fine.wells)
    return KnownDensity(
        intensity=intensity,
        normalisation=float(total * np.exp(-bottom / intensity)),
        change=change,
        unknown=elsewhere / (elsewhere + float(total)),
        lowest_unknown=float(lowest.min()),
        probabilities=weights / weights.sum(),
        shares=shares / shares.sum(),
    )


def marginal_of(
    density: KnownDensity, sampled: SampledPotential, *, plane: tuple[int, ...] | None = None
) -> MarginalDensity:
    """The density on a plane of two states, or of the only one, within the known region; elsewhere NaN."""
    plane = _plane(sampled) if plane is None else plane
    values = _onto(density.probabilities, plane) / sampled.widths[list(plane)].prod()
    seen = _onto(sampled.known, plane)
    first, second = ([sampled.axes[state] for state in plane] + [np.zeros(0)])[:2]
    return MarginalDensity(plane, density.intensity, first, second, np.where(seen > 0, values, np.nan))


def _plane(sampled: SampledPotential) -> tuple[int, ...]:
    """The states that are shown: the first two, or the only one."""
    return tuple(range(min(sampled.values.ndim, 2)))


def compare_with_samples(
    density: KnownDensity,
    sampled: SampledPotential,
    samples: np.ndarray,
    *,
    plane: tuple[int, ...] | None = None,
    bins: int = BINS,
) -> DensityComparison:
    """Compare the density with a simulation, both within the region where U is known.

    Parameters
    ----------
    density, sampled
        The density and U.
    samples
        Shape ``(d, times, walkers)``.
    plane
        Indices of the two states that are compared, by default of the first two, or of the only one.
    bins
        Along each of them, a divisor of the number of cells.
    """
    plane = _plane(sampled) if plane is None else plane
    index, inside = sampled.places(samples)
    counted = inside & sampled.known[tuple(index)]
    per_bin = [sampled.values.shape[state] // bins for state in plane]
    bin_of = sum(index[state] // size * bins**power
                 for power, (state, size) in enumerate(zip(plane, per_bin, strict=True)))  # fmt: skip
    onto = _onto(density.probabilities, plane)
    rows = bins if len(plane) > 1 else 1
    expected = onto.reshape(rows, len(onto) // rows, bins, per_bin[0]).sum(axis=(1, 3))
    edges = [np.linspace(low, high, bins + 1) for low, high in sampled.box[list(plane)]]
    return compare_shares(bin_of, np.append(expected, 0.0), edges, counted=counted)


def _onto(values: np.ndarray, plane: Sequence[int]) -> np.ndarray:
    """Values of cells summed onto a plane, the second state's cells by row; a single state has one row."""
    others = tuple(state for state in range(values.ndim) if state not in plane)
    summed = values.sum(axis=others)
    if len(plane) == 1:
        return np.asarray(summed[None])
    return np.asarray(summed.T if plane[0] < plane[1] else summed)


STEP = 0.1  # of the shortest time of f where the walkers are


def starting_states(
    density: KnownDensity, sampled: SampledPotential, count: int, *, generator: np.random.Generator
) -> np.ndarray:
    """States drawn from the density, the share of every well exact to one walker: shape ``(d, count)``.

    The walkers are ordered such that groups of neighbours, among which sampling errors are estimated, have
    the wells' shares too.
    """
    flat = density.probabilities.ravel()
    order = np.argsort(sampled.well.ravel(), kind="stable")
    # One draw in each of so many equal parts of the whole probability, well after well.
    quantiles = (np.arange(count) + generator.uniform(size=count)) / count
    cumulative = np.cumsum(flat[order])
    place = np.searchsorted(cumulative / cumulative[-1], quantiles, side="right")
    cells = order[np.minimum(place, flat.size - 1)]
    cells = np.concatenate([cells[group::GROUPS] for group in range(min(GROUPS, count))])
    index = np.stack(np.unravel_index(cells, sampled.values.shape))
    within = generator.uniform(size=index.shape)
    states: np.ndarray = sampled.box[:, :1] + (index + within) * sampled.widths[:, None]
    return states


def walk(
    dynamics: Dynamics,
    start: np.ndarray,
    *,
    intensity: float,
    burn_in: int,
    steps: int,
    thin: int,
    generator: np.random.Generator,
) -> np.ndarray:
    """Walkers in ``dx = f dt + sqrt(ε) D^(1/2) dW`` by Heun's rule, of weak order two where D is constant.

    f turns many times while it descends, and the rule of Euler and Maruyama would take part of the damping
    away.

    Parameters
    ----------
    dynamics
        f and D.
    start
        Shape ``(d, walkers)``.
    intensity
        ε.
    burn_in, steps, thin
        Steps before the first sample, steps from then on, and every how many a sample is kept.
    generator
        Source of the noise.

    Returns
    -------
    numpy.ndarray
        Shape ``(d, steps // thin, walkers)``.

    Raises
    ------
    NumericalFailure
        When walkers run to infinity.
    """
    rate = np.linalg.norm(dynamics.jacobian(start.T), axis=(1, 2))
    step = STEP / float(np.median(rate))
    function = dynamics.drift_of_components
    noise = noise_source(dynamics.diffusion, intensity=intensity, step=step, generator=generator)
    x = np.array(start, dtype=float)
    samples = np.empty((len(x), steps // thin, x.shape[1]))
    with np.errstate(over="ignore", invalid="ignore"):  # told below
        for index in range(1 - burn_in, samples.shape[1] * thin + 1):
            x = heun_step(function, x, step, noise(x))
            if index > 0 and index % thin == 0:
                samples[:, index // thin - 1] = x
    lost = int((~np.isfinite(x).all(axis=0)).sum())  # what once is not finite stays so
    if lost:
        raise NumericalFailure(f"{lost} of {x.shape[1]} walkers run to infinity; take a smaller step")
    return samples


@dataclass(frozen=True)
class WellShares:
    """Where walkers are, by well.

    Attributes
    ----------
    simulated
        The wells' shares of the samples at which U is known, shape ``(k,)``.
    changed
        Of the walkers that start in each well, the share that is in another at the end, shape ``(k,)``.
    """

    simulated: np.ndarray
    changed: np.ndarray


def simulated_shares(sampled: SampledPotential, start: np.ndarray, samples: np.ndarray) -> WellShares:
    """The wells in which walkers are: `start` of shape ``(d, walkers)``, samples ``(d, times, walkers)``."""

    def wells_of(x: np.ndarray) -> np.ndarray:
        index, inside = sampled.places(x)
        return np.where(inside, sampled.well[tuple(index)], -1)

    count = sampled.wells
    where = wells_of(samples)
    counted = np.bincount(where[where >= 0], minlength=count)
    first, last = wells_of(start), where[-1]
    told = (first >= 0) & (last >= 0)
    with np.errstate(invalid="ignore"):  # no walker started in a well of no probability
        changed = np.bincount(first[told & (first != last)], minlength=count) / np.bincount(
            first[told], minlength=count
        )
        return WellShares(counted / counted.sum(), changed)


def shares_by_rates(
    ways: Sequence[tuple[int, int | None, float | None, float | None]], count: int, *, intensity: float
) -> np.ndarray:
    """The wells' shares that the mean escape times imply, prefactors included; NaN where one is not known.

    Unlike the integral of exp(-U/ε) over a well this has the prefactor of the density in it.

    Parameters
    ----------
    ways
        Start, end, barrier and prefactor of every way out, these NaN or None where not known; ways that end
        at no well (None) do not count.
    count
        Number of wells, k.
    intensity
        ε.
    """
    table = np.array([way for way in ways if way[1] is not None], dtype=float).reshape(-1, 4)
    if not np.isfinite(table).all():
        return np.full(count, np.nan)
    rates = np.zeros((count, count))
    lowest = table[:, 2].min(initial=np.inf)  # or all rates would be zero at a small ε
    for start, end, barrier, prefactor in table:
        rates[int(start), int(end)] += np.exp((lowest - barrier) / intensity) / prefactor
    np.fill_diagonal(rates, 0.0)
    # Grassmann, Taksar and Heyman's elimination: nothing is subtracted from rates, so that tiny ones count.
    for k in range(count - 1, 0, -1):
        leaving = rates[k, :k].sum()
        if not leaving > 0:
            return np.full(count, np.nan)
        rates[:k, k] /= leaving
        rates[:k, :k] += np.outer(rates[:k, k], rates[k, :k])
        np.fill_diagonal(rates, 0.0)
    shares = np.ones(count)
    for k in range(1, count):
        shares[k] = shares[:k] @ rates[:k, k]
    return np.asarray(shares / shares.sum())
