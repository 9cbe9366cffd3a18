"""The stationary density ``p ~ exp(-U/ε)`` of a formula of U, and its comparison with a long simulation.

For ``dx = f dt + sqrt(ε) D^(1/2) dW`` with ``f = -D∇V + g``, ``∇V·g = 0`` and U = 2V, the stationary
Fokker–Planck equation leaves of ``exp(-U/ε)`` only ``-div g · exp(-U/ε)``. Where div g = 0, as for the
paper's archetypal systems, this is therefore the exact density for every ε. Elsewhere it is the leading order
as ε → 0: the density has a prefactor that depends on the state, and Z is wrong by a factor of order 1 (paper,
Eq. eq:invariant_dist).

States that occur in one term together form a block, and the integrand is the product over the blocks. A state
by itself is integrated panel by panel, two or three on a tensor product of Gauss–Legendre nodes.

**Of wells**, each with a formula of its own, U is NaN where no formula is believed. Z is the integral over
the cells of a box at whose middles U is known, as far as they are connected with the attractor, and what
the other cells can add to it is bounded. If no attractor lies among them, U is nowhere below either of two
levels in them: the lowest U along the rim of the unknown part, since U does not fall on a path of least
action from its attractor; and U where f, followed from the state, enters the known region, since U does not
rise along f. Both are told to within the width of a cell. The density is the leading order as ε → 0; of one
state its prefactor is known, 1/D(x), and the density is exact.

At small ε a walker stays in its well for longer than anyone can simulate. Walkers therefore start with the
wells' shares of the density itself. Then the comparison tests the density within each well, and the shares
only as far as walkers change wells; how many do is counted.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.interpolate
import scipy.ndimage
import scipy.special
import sympy

from siq.errors import NumericalFailure
from siq.numerics.integration import runge_kutta_step
from siq.quasipotential.global_formula import GlobalQuasipotential
from siq.systems.dynamics import Dynamics
from siq.systems.formulas import compile_formulas

WALKER_GROUPS = 100  # among which the sampling error is estimated
BINS = 40  # along each of the states
LARGEST_BLOCK = 3  # states; beyond, a tensor product of nodes is out of reach
PANELS = 200  # of the integral over a single state: U may be known to vary within a thousandth of the box
CELLS = {1: 4000, 2: 400, 3: 80}  # along each state, by the number of states; multiples of the bins
CELL_TOLERANCE = 0.02  # relative: by how much Z may change if cells are twice as wide
STRIDE = 3.0  # cells: longest step along f
LONGEST_STEP = 0.5  # of the shortest time of f: the same
MOST_STEPS = 2000  # along f
BOX_MARGIN = 0.5  # of the box, by which f may lead out of it on the way
QUADRATURE_TOLERANCE = 1e-6  # relative: what a quadrature's own estimate of its error may be


@dataclass(frozen=True)
class DensityComparison:
    """The histogram of a long simulation beside a marginal density."""

    #: ``½ Σ |P_b - Q_b|`` over the bins, Q the samples' shares and P the density's probabilities: from 0 to
    #: 1, the largest difference in the probability of any union of bins.
    total_variation: float
    #: What total variation to expect of these samples if the density were exact, from the spread among the
    #: walkers; NaN with one walker.
    sampling_floor: float
    #: Share of the samples outside the box, which counts as a further bin, of probability 0. Of a landscape:
    #: share of the samples where U is not known, which are left out.
    outside: float
    #: Edges of the bins, shapes ``(n + 1,)`` and ``(m + 1,)``, the latter empty with one state; and the
    #: samples' density, ``(m, n)`` or ``(1, n)``, in the marginal density's unit.
    x1_edges: np.ndarray
    x2_edges: np.ndarray
    histogram: np.ndarray

    @classmethod
    def of_samples(
        cls, samples: np.ndarray, edges: Sequence[np.ndarray], expected: Sequence[float] | np.ndarray, *,
        counted: np.ndarray | None = None,
    ) -> DensityComparison:  # fmt: skip
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
    """The density on a plane of two states, the others integrated out; or of a single state."""

    #: Indices of the two states, or of the only one; and ε.
    plane: tuple[int, ...]
    intensity: float
    #: The grid, shapes ``(n,)`` and ``(m,)``, evenly spaced: from edge to edge of the box, or, of wells, in
    #: the middles of its cells. With one state `x2` is empty.
    x1: np.ndarray
    x2: np.ndarray
    #: Shape ``(m, n)``, ``(1, n)`` with one state: density per unit of the first state and unit of the
    #: second; its integral over the box is 1. NaN where it is not known.
    values: np.ndarray
    #: Z, None where it is not to be written; and a long simulation beside it.
    normalisation: float | None = None
    comparison: DensityComparison | None = None
    #: The share of all probability that lies where the density is not known, at most; None where it is known
    #: everywhere.
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


def marginal_density(
    quasipotential: sympy.Expr, symbols: Sequence[sympy.Symbol], *, intensity: float, box: np.ndarray,
    points: int = 201, nodes: int = 128,
) -> StationaryDensity:  # fmt: skip
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


@dataclass(frozen=True)
class SampledPotential:
    """U over all wells in the middles of the cells of a box."""

    #: Shape ``(d, 2)``; U, one axis for each state, NaN where it is not known; and the index of the well
    #: whose formula gives it, -1 where none does.
    box: np.ndarray
    values: np.ndarray
    well: np.ndarray
    wells: int  #: their number, k
    #: Of exp(-U/ε): of one state, D at the first attractor over D, of the shape of `values`; elsewhere 1.
    prefactor: np.ndarray | float = 1.0

    @classmethod
    def of(
        cls, potential: GlobalQuasipotential, box: np.ndarray, *, cells: int | None = None
    ) -> SampledPotential:
        """U over all wells in a box ``(d, 2)``, by default of as many cells as are affordable.

        Raises
        ------
        NumericalFailure
            When there are more than three states.
        """
        box = np.asarray(box, dtype=float)
        if len(box) not in CELLS:
            raise NumericalFailure(
                f"densities over wells are for three states at most, and these are {len(box)}"
            )
        shape = (cells or CELLS[len(box)],) * len(box)
        empty = cls(box, np.full(shape, np.nan), np.full(shape, -1), len(potential.wells))
        by_well = potential.by_well(empty.middles(np.ones(shape, dtype=bool)).T).reshape(-1, *shape)
        values = np.where(np.isfinite(by_well), by_well, np.inf)
        for own, one in zip(values, potential.wells, strict=True):
            # An island, which places part from the attractor at which the formula is known to be wrong.
            parts, _ = scipy.ndimage.label(np.isfinite(own))
            own[parts != parts[tuple(empty.places(one.attractor)[0])]] = np.inf
        least = values.min(axis=0)
        known = np.isfinite(least)
        # Of one state the prefactor of exp(-U/ε) is 1/D. Where that of D is not positive no state can be.
        prefactor: np.ndarray | float = 1.0
        if len(box) == 1 and not (noise := potential.wells[0].dynamics.diffusion).constant:
            own = noise.at(np.stack([potential.wells[0].attractor, *empty.axes[0][:, None]]))[:, 0, 0]
            prefactor = own[0] / np.where(own[1:] > 0, own[1:], np.inf)
        least, well = np.where(known, least, np.nan), np.where(known, values.argmin(axis=0), -1)
        return cls(box, least, well, len(potential.wells), prefactor)

    @property
    def widths(self) -> np.ndarray:
        """Of a cell, shape ``(d,)``."""
        return np.asarray(np.ptp(self.box, axis=1) / self.values.shape)

    @property
    def axes(self) -> list[np.ndarray]:
        """The middles of the cells along each state."""
        sides = zip(self.box[:, 0], self.values.shape, self.widths, strict=True)
        return [low + (np.arange(count) + 0.5) * width for low, count, width in sides]

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

    def lowest_possible(self, dynamics: Dynamics) -> np.ndarray:
        """What U cannot be below in the cells in which it is not known, infinite in the others."""
        known = self.known
        values = np.where(known, self.values, np.inf)
        around = np.ones((3,) * values.ndim)
        # What is outside the box is not known either, and whatever is in it may have come from there.
        part, parts = scipy.ndimage.label(np.pad(~known, 1, constant_values=True), around)
        # Two cells wide, as U varies between the middle of a cell and the rim.
        near = scipy.ndimage.minimum_filter(np.pad(values, 1, constant_values=np.inf), 5, mode="nearest")
        rims = np.array([-np.inf, *np.atleast_1d(scipy.ndimage.minimum(near, part, np.arange(1, parts + 1)))])
        lowest = np.where(known, np.inf, rims[part][(slice(1, -1),) * values.ndim])
        # U where f enters the known region from each unknown cell, -∞ where it does not.
        low = scipy.ndimage.minimum_filter(values, 3, mode="nearest")
        x = self.middles(~known)
        levels = np.full(x.shape[1], -np.inf)
        function = dynamics.drift_of_components
        widths = self.widths[:, None]
        fastest = np.linalg.norm(dynamics.jacobian(x.T), axis=(1, 2)).max(initial=0.0)
        longest = LONGEST_STEP / fastest if fastest > 0 else np.inf
        wide = self.box + BOX_MARGIN * np.ptp(self.box, axis=1)[:, None] * np.array([-1.0, 1.0])
        running = np.arange(x.shape[1])
        for _ in range(MOST_STEPS):
            speed = np.abs(function(x) / widths).max(axis=0)
            with np.errstate(divide="ignore"):
                step = np.minimum(STRIDE / speed, longest)
            x = runge_kutta_step(function, x, np.where(np.isfinite(step), step, 0.0))
            index, inside = self.places(x)
            arrived = inside & known[tuple(index)]
            levels[running[arrived]] = low[tuple(index)][arrived]
            going = ~arrived & ((x > wide[:, :1]) & (x < wide[:, 1:])).all(axis=0)
            x, running = x[:, going], running[going]
            if not running.size:
                break
        lowest[~known] = np.maximum(lowest[~known], levels)
        # A cell is where f leads from its middle, or from the middle of a cell beside it.
        return np.where(known, np.inf, scipy.ndimage.minimum_filter(lowest, footprint=around, mode="nearest"))

    def density(self, coarse: SampledPotential, lowest: np.ndarray, *, intensity: float) -> _KnownDensity:
        """The density for one ε, in the unit of U.

        U on cells twice as wide tells how accurate the integral is; `lowest` has what it cannot be below in
        those of them in which it is not known. Refused are an ε that is not positive (`ValueError`), a U that
        is known nowhere, and cells that are too wide for ε (`NumericalFailure`).
        """
        if not 0 < intensity < np.inf:
            raise ValueError(f"the noise intensity ({intensity}) must be positive")
        if not self.known.any():
            raise NumericalFailure("U is known nowhere in the box")
        bottom = float(np.nanmin(self.values))  # taken out of the exponents, which would run out of range
        weights, wide, above = (
            np.exp(-(np.where(np.isnan(u), np.inf, u) - bottom) / intensity) * one.prefactor
            for one, u in ((self, self.values), (coarse, coarse.values), (coarse, lowest))
        )
        total, rough = (weights.sum() * self.widths.prod(), wide.sum() * coarse.widths.prod())
        change = float(abs(rough / total - 1))
        if not change <= CELL_TOLERANCE:
            raise NumericalFailure(
                f"the integral of exp(-U/ε) changes by {change:.1%} if cells are twice as wide; the wells are"
                " too narrow for the box"
            )
        elsewhere = float(above.sum() * coarse.widths.prod())
        shares = np.bincount(self.well[self.known], weights[self.known], minlength=self.wells)
        normalisation = float(total * np.exp(-bottom / intensity))
        unknown = elsewhere / (elsewhere + float(total))
        return _KnownDensity(
            self, intensity, normalisation, change, unknown, weights / weights.sum(), shares / shares.sum()
        )

    def simulated_shares(self, start: np.ndarray, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The wells' shares of samples at which U is known, and of each well the walkers that have left it.

        Walkers start at ``(d, walkers)``, and samples have the shape ``(d, times, walkers)``. Both are of the
        shape ``(k,)``; the second is the share of those that start in a well and are in another at the end.
        """

        def wells_of(x: np.ndarray) -> np.ndarray:
            index, inside = self.places(x)
            return np.where(inside, self.well[tuple(index)], -1)

        count, where = self.wells, wells_of(samples)
        first, last = wells_of(start), where[-1]
        known = (first >= 0) & (last >= 0)
        counted, changed, began = (
            np.bincount(one, minlength=count)
            for one in (where[where >= 0], first[known & (first != last)], first[known])
        )
        with np.errstate(invalid="ignore"):  # no walker started in a well of no probability
            return counted / counted.sum(), changed / began


@dataclass(frozen=True)
class _KnownDensity:
    """``exp(-U/ε)/Z`` where U is known, and how much of all probability lies elsewhere at most."""

    #: U on the cells, and ε.
    potential: SampledPotential
    intensity: float
    #: Z over the cells in which U is known, in the product of the states' units; and by how much it changes,
    #: relatively, if cells are twice as wide.
    normalisation: float
    change: float
    unknown: float  #: the share of all probability in the box that the other cells can hold at most
    #: Of the cells, of the shape of `SampledPotential.values`, 1 in total, zero where U is not known; and
    #: the wells' shares of it, shape ``(k,)``.
    probabilities: np.ndarray
    shares: np.ndarray

    def marginal(self) -> StationaryDensity:
        """The density of the first two states, or of the only one, within the known region; elsewhere NaN."""
        potential = self.potential
        plane = tuple(range(min(potential.values.ndim, 2)))
        values = _onto_plane(self.probabilities) / potential.widths[list(plane)].prod()
        first, second = [*potential.axes[:2], np.zeros(0)][:2]
        seen = _onto_plane(potential.known)
        return StationaryDensity(
            plane, self.intensity, first, second, np.where(seen > 0, values, np.nan), self.normalisation,
            unknown=self.unknown,
        )  # fmt: skip

    def compare(self, samples: np.ndarray, *, bins: int = BINS) -> DensityComparison:
        """Compare the marginal density with samples ``(d, times, walkers)``, both where U is known.

        The number of bins along each state is a divisor of the number of cells.
        """
        potential = self.potential
        shape = potential.values.shape[:2]
        index, inside = potential.places(samples)
        counted = inside & potential.known[tuple(index)]
        onto = _onto_plane(self.probabilities)
        rows = bins if len(shape) > 1 else 1
        expected = onto.reshape(rows, len(onto) // rows, bins, shape[0] // bins).sum(axis=(1, 3))
        edges = [np.linspace(low, high, bins + 1) for low, high in potential.box[: len(shape)]]
        return DensityComparison.of_samples(samples[: len(shape)], edges, expected, counted=counted)

    def starting_states(self, count: int, *, generator: np.random.Generator) -> np.ndarray:
        """States drawn from the density, the share of every well exact to one walker: shape ``(d, count)``.

        The walkers are ordered such that groups of neighbours, among which sampling errors are estimated,
        have the wells' shares too.
        """
        flat, potential = self.probabilities.ravel(), self.potential
        order = np.argsort(potential.well.ravel(), kind="stable")
        # One draw in each of so many equal parts of the whole probability, well after well.
        quantiles = (np.arange(count) + generator.uniform(size=count)) / count
        cumulative = np.cumsum(flat[order])
        place = np.searchsorted(cumulative / cumulative[-1], quantiles, side="right")
        cells = order[np.minimum(place, flat.size - 1)]
        cells = np.concatenate([cells[group::WALKER_GROUPS] for group in range(min(WALKER_GROUPS, count))])
        index = np.stack(np.unravel_index(cells, potential.values.shape))
        within = generator.uniform(size=index.shape)
        return np.asarray(potential.box[:, :1] + (index + within) * potential.widths[:, None])


def _onto_plane(values: np.ndarray) -> np.ndarray:
    """Values of cells summed onto the first two states, the second one's by row; one state has one row."""
    summed = values.sum(axis=tuple(range(2, values.ndim)))
    return np.asarray(summed[None] if values.ndim == 1 else summed.T)


def shares_by_rates(
    ways: Sequence[tuple[int, int | None, float | None, float | None]], count: int, *, intensity: float
) -> np.ndarray:
    """The wells' shares that the mean escape times imply, prefactors included; NaN where one is not known.

    Unlike the integral of exp(-U/ε) over a well this has the prefactor of the density in it.

    `ways` are start, end, barrier and prefactor of every way out, these NaN or None where not known; those
    that end at no well (None) do not count. There are `count` wells.
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
