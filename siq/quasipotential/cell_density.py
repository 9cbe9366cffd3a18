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
from siq.numerics.integration import runge_kutta_step
from siq.quasipotential.invariant_density import (
    BINS,
    WALKER_GROUPS,
    DensityComparison,
    StationaryDensity,
)
from siq.quasipotential.landscape import GlobalQuasipotential
from siq.systems.dynamics import Dynamics

CELLS = {1: 4000, 2: 400, 3: 80}  # along each state, by the number of states; multiples of the bins
CELL_TOLERANCE = 0.02  # relative: by how much Z may change if cells are twice as wide
STRIDE = 3.0  # cells: longest step along f
LONGEST_STEP = 0.5  # of the shortest time of f: the same
MOST_STEPS = 2000  # along f
BOX_MARGIN = 0.5  # of the box, by which f may lead out of it on the way


@dataclass(frozen=True)
class SampledPotential:
    """U over all wells in the middles of the cells of a box.

    Attributes
    ----------
    box, values, well
        Shape ``(d, 2)``; U, one axis for each state, NaN where it is not known; and the index of the well
        whose formula gives it, -1 where none does.
    wells
        Their number, k.
    prefactor
        Of exp(-U/ε): of one state, D at the first attractor over D, of the shape of `values`; elsewhere 1.
    """

    box: np.ndarray
    values: np.ndarray
    well: np.ndarray
    wells: int
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
        unknown = np.pad(~known, 1, constant_values=True)
        part, parts = scipy.ndimage.label(unknown, around)
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
        least = scipy.ndimage.minimum_filter(lowest, footprint=around, mode="nearest")
        return np.where(known, np.inf, least)

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
    """``exp(-U/ε)/Z`` where U is known, and how much of all probability lies elsewhere at most.

    Attributes
    ----------
    potential, intensity
        U on the cells, and ε.
    normalisation, change
        Z over the cells in which U is known, in the product of the states' units; and by how much it changes,
        relatively, if cells are twice as wide.
    unknown
        The share of all probability in the box that the other cells can hold at most.
    probabilities, shares
        Of the cells, of the shape of `SampledPotential.values`, 1 in total, zero where U is not known; and
        the wells' shares of it, shape ``(k,)``.
    """

    potential: SampledPotential
    intensity: float
    normalisation: float
    change: float
    unknown: float
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
