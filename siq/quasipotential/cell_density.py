"""The stationary density ``p ~ exp(-U/ε)`` of wells: on the cells of a box, where U is known.

U over all wells is NaN where no formula is believed. Z is the integral over the cells of a box at whose
middles U is known, as far as they are connected with the attractor, and what the other cells can add to it is
bounded. If no attractor lies among them, U is nowhere below either of two levels in them: the lowest U along
the rim of the unknown part, since U does not fall on a path of least action from its attractor; and U where
f, followed from the state, enters the known region, since U does not rise along f. Both are told to within
the width of a cell. The density is the leading order as ε → 0 (`siq.quasipotential.invariant_density`); of
one state its prefactor is known, 1/D(x), and the density is exact.

At small ε a walker stays in its well for longer than anyone can simulate. Walkers therefore start with the
wells' shares of the density itself. Then the comparison tests the density within each well, and the shares
only as far as walkers change wells; how many do is counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.ndimage

from siq.errors import NumericalFailure
from siq.numerics.integration import heun_step, runge_kutta_step
from siq.quasipotential.invariant_density import (
    BINS,
    WALKER_GROUPS,
    DensityComparison,
    StationaryDensity,
    compare_shares,
)
from siq.quasipotential.landscape import GlobalQuasipotential
from siq.systems.dynamics import Dynamics
from siq.systems.simulation import simulate_stationary

CELLS = {1: 4000, 2: 400, 3: 80}  # along each state, by the number of states; multiples of the bins
CELL_TOLERANCE = 0.02  # relative: by how much Z may change if cells are twice as wide
STRIDE = 3.0  # cells: longest step along f
LONGEST_STEP = 0.5  # of the shortest time of f: the same
MOST_STEPS = 2000  # along f
BOX_MARGIN = 0.5  # of the box, by which f may lead out of it on the way
WALK_STEP = 0.1  # of the shortest time of f where the walkers are


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

    def simulated_shares(self, start: np.ndarray, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The wells' shares of samples at which U is known, and of each well the walkers that have left it.

        Parameters
        ----------
        start
            Of the walkers, shape ``(d, walkers)``.
        samples
            Shape ``(d, times, walkers)``.

        Returns
        -------
        tuple of numpy.ndarray
            Shapes ``(k,)``; the second one is the share of those that start in a well and are in another at
            the end.
        """

        def wells_of(x: np.ndarray) -> np.ndarray:
            index, inside = self.places(x)
            return np.where(inside, self.well[tuple(index)], -1)

        count, where = self.wells, wells_of(samples)
        counted = np.bincount(where[where >= 0], minlength=count)
        first, last = wells_of(start), where[-1]
        known = (first >= 0) & (last >= 0)
        with np.errstate(invalid="ignore"):  # no walker started in a well of no probability
            changed = np.bincount(first[known & (first != last)], minlength=count) / np.bincount(
                first[known], minlength=count
            )
            return counted / counted.sum(), changed


@dataclass(frozen=True)
class KnownDensity:
    """``exp(-U/ε)/Z`` where U is known, and how much of all probability lies elsewhere at most.

    Attributes
    ----------
    potential
        U on the cells.
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

    potential: SampledPotential
    intensity: float
    normalisation: float
    change: float
    unknown: float
    lowest_unknown: float
    probabilities: np.ndarray
    shares: np.ndarray

    @property
    def _first_plane(self) -> tuple[int, ...]:
        """The first two states, or the only one."""
        return tuple(range(min(self.potential.values.ndim, 2)))

    def marginal(self, *, plane: tuple[int, ...] | None = None) -> StationaryDensity:
        """The density on a plane of two states, or of the only one, within the known region; elsewhere NaN.

        By default the plane is that of the first two states.
        """
        plane, potential = self._first_plane if plane is None else plane, self.potential
        values = _onto(self.probabilities, plane) / potential.widths[list(plane)].prod()
        seen = _onto(potential.known, plane)
        first, second = ([potential.axes[state] for state in plane] + [np.zeros(0)])[:2]
        return StationaryDensity(
            plane, self.intensity, first, second, np.where(seen > 0, values, np.nan), self.normalisation,
            unknown=self.unknown,
        )  # fmt: skip

    def compare(
        self, samples: np.ndarray, *, plane: tuple[int, ...] | None = None, bins: int = BINS
    ) -> DensityComparison:
        """Compare the density with a simulation, both within the region where U is known.

        Parameters
        ----------
        samples
            Shape ``(d, times, walkers)``.
        plane
            Indices of the two states that are compared, by default of the first two, or of the only one.
        bins
            Along each of them, a divisor of the number of cells.
        """
        plane, potential = self._first_plane if plane is None else plane, self.potential
        index, inside = potential.places(samples)
        counted = inside & potential.known[tuple(index)]
        per_bin = [potential.values.shape[state] // bins for state in plane]
        bin_of = sum(index[state] // size * bins**power
                     for power, (state, size) in enumerate(zip(plane, per_bin, strict=True)))  # fmt: skip
        onto = _onto(self.probabilities, plane)
        rows = bins if len(plane) > 1 else 1
        expected = onto.reshape(rows, len(onto) // rows, bins, per_bin[0]).sum(axis=(1, 3))
        edges = [np.linspace(low, high, bins + 1) for low, high in potential.box[list(plane)]]
        return compare_shares(bin_of, np.append(expected, 0.0), edges, counted=counted)

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
        groups = range(min(WALKER_GROUPS, count))
        cells = np.concatenate([cells[group::WALKER_GROUPS] for group in groups])
        index = np.stack(np.unravel_index(cells, potential.values.shape))
        within = generator.uniform(size=index.shape)
        return np.asarray(potential.box[:, :1] + (index + within) * potential.widths[:, None])


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
    # Of one state the prefactor of exp(-U/ε) is 1/D. Where a formula of D is not positive no state can be.
    prefactor = None
    if len(box) == 1 and not (noise := potential.wells[0].dynamics.diffusion).constant:
        own = noise.at(np.stack([potential.wells[0].attractor, *empty.axes[0][:, None]]))[:, 0, 0]
        prefactor = own[0] / np.where(own[1:] > 0, own[1:], np.inf)
    return SampledPotential(
        box,
        np.where(known, least, np.nan),
        np.where(known, values.argmin(axis=0), -1),
        len(potential.wells),
        prefactor,
    )


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
    longest = LONGEST_STEP / fastest if fastest > 0 else np.inf
    wide = sampled.box + BOX_MARGIN * np.ptp(sampled.box, axis=1)[:, None] * np.array([-1.0, 1.0])
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
    if not change <= CELL_TOLERANCE:
        raise NumericalFailure(
            f"the integral of exp(-U/ε) changes by {change:.1%} if cells are twice as wide; the wells are too"
            " narrow for the box"
        )
    above = np.exp(-(lowest - bottom) / intensity) * (1.0 if coarse.prefactor is None else coarse.prefactor)
    elsewhere = float(above.sum() * coarse.widths.prod())
    shares = np.bincount(fine.well[fine.known], weights[fine.known], minlength=fine.wells)
    return KnownDensity(
        potential=fine,
        intensity=intensity,
        normalisation=float(total * np.exp(-bottom / intensity)),
        change=change,
        unknown=elsewhere / (elsewhere + float(total)),
        lowest_unknown=float(lowest.min()),
        probabilities=weights / weights.sum(),
        shares=shares / shares.sum(),
    )


def _onto(values: np.ndarray, plane: Sequence[int]) -> np.ndarray:
    """Values of cells summed onto a plane, the second state's cells by row; a single state has one row."""
    others = tuple(state for state in range(values.ndim) if state not in plane)
    summed = values.sum(axis=others)
    if len(plane) == 1:
        return np.asarray(summed[None])
    return np.asarray(summed.T if plane[0] < plane[1] else summed)


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
    return simulate_stationary(
        dynamics, intensity=intensity, start=start, step=WALK_STEP / float(np.median(rate)),
        burn_in=burn_in, steps=steps, thin=thin, generator=generator, rule=heun_step,
    )  # fmt: skip


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
