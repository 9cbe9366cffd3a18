"""The Fokker–Planck operator on cells: density, committors, reactive currents, mean times, dissipation.

For ``dx = f dt + √ε σ dW`` in one to three states, ``L u = f·∇u + (ε/2) D:∇∇u`` on a box that nothing leaves
becomes a Markov jump process between cells. The flux between neighbours is Scharfetter and Gummel's,

    J = (a/h) [B(-z) p_left - B(z) p_right],    a = (ε/2) D,  z = (f - a') h/a,  B(z) = z/(eᶻ - 1),

which is exact for constant coefficients, keeps densities positive, and knows no smallness of ε. It is done in
coordinates in which the D in the middle is diagonal. Where D has mixed terms elsewhere, diagonal neighbours
take them (Kushner), in two states.

All the rest are solutions with this one L. With the invariant density π, two sets A and B and ``L q = 0``
between them, q⁺ = 0 in A and 1 in B, is the *committor*, the probability to reach B before A; q⁻, of the
reversed process ``π L`` and 1 in A, is that of having come from A last. Of all that goes from A to B

    density π q⁺ q⁻,    current of i to j ``π_i q⁻_i L_ij q⁺_j`` less that of j to i,    rate F/∫ π q⁻,

F being the current that leaves A (E. Vanden-Eijnden, Lect. Notes Phys. 703 (2006) 453). A mean time τ to B
solves ``L τ = -1`` outside of B.

The *dissipation*, the production of entropy per unit of time in units of Boltzmann's constant, is

    Σ̇ = (2/ε) ∫ u·D⁻¹u π dx,    u = J/π = f - (ε/2) ∇·(Dπ)/π,

J being the stationary current. As ε → 0, u is the g of ``f = -D∇V + g``; where ∇·g = 0 it is g for any ε. It
vanishes where there is detailed balance, and there only (U. Seifert, Rep. Prog. Phys. 75 (2012) 126001).

**Periodic states.** A box of one period has no walls there, and its last cells are next to the first ones. A
state x that counts its turns moves as ``⟨x⟩ = v t`` and ``var x = 2 D_eff t``. In one state, with the period
ℓ, a = (ε/2) D, Ψ = ∫ f/a dx and

    I(x) = e^(-Ψ(x)) ∫_(x-ℓ)^x e^Ψ/a dx',    J(x) = e^(Ψ(x)) ∫_x^(x+ℓ) e^(-Ψ) dx',
    v = ℓ (1 - e^(Ψ(x) - Ψ(x+ℓ))) / ∫ I dx,    D_eff = ℓ² ∫ I² J dx / (∫ I dx)³,

the integrals being over a period (R. L. Stratonovich 1958; P. Reimann et al., Phys. Rev. Lett. 87 (2001)
010602; H. Risken, *The Fokker–Planck Equation*, chapter 11). In two and three states, where a jump from cell
i to j moves x by d_ij,

    v = Σ π_i L_ij d_ij,    2 D_eff = Σ π_i L_ij (d_ij + χ_j - χ_i)²,    Σ_j L_ij (d_ij + χ_j - χ_i) = v,

so that ``x + χ - v t`` is a martingale.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import ndimage, sparse, special
from scipy.sparse.linalg import splu

from siq.data.recordings import Recordings
from siq.data.stationarity import runs_of
from siq.errors import Fault, NumericalFailure
from siq.numerics.randomness import positive
from siq.quasipotential.characteristics import Function, ScaledSystem
from siq.systems.cycles import Cycle, hessians_along
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import Equilibrium, hessian_at
from siq.systems.escapes import Neighbourhood

# Along each state: visits of a double well are then good to 1e-4 and 1e-2; of three states as is affordable.
CELLS = {1: 2000, 2: 120, 3: 28}
COARSE = 1.0  # z between neighbours, in the mean over the density: beyond, wells are narrower than cells
RESTART_RATE = 1e-9  # of the fastest rate
LEAST_NOISE = 1e-9  # numerical: of the strongest noise; where it is weaker it is none
STEEP = 700.0  # of z: beyond, exp overflows, and B has its limits
CORE_SHARE = 0.5  # of U at the next saddle: a core lies well within its well
COARSER = 0.5  # as many cells along each state: enough for how much a number changes
MOST_ROUNDING = 0.1  # of a time times the fastest rate, in 1/rounding: a third was off by 1 %, 18 by a third
MOST_AT_WALLS = 1e-3  # share of the time that is spent in cells at walls, some thousandths of the box wide
WIDER = 0.75  # as many cells: by which the error of those is told, where three states leave no coarser ones
FEWEST_PARTS, MOST_PARTS = 256, 4096  # of a period: in each Ψ changes by less than one half
NODES = 8  # of Gauss and Legendre in each part: to rounding
PIECES = 100  # of a record: D_eff is then known to 14 %
TENTHS = 10  # of the committor, that are counted apart
NO_CURRENT = 1e-12  # numerical: of what Σ̇ would be if all of f were a current
QUANTILES = (0.025, 0.975)  # of an interval


class ReactiveFlow(NamedTuple):
    """What goes from a set A to a set B, in the cells of `process`."""

    process: CellProcess  #: the cells: their middles are `process.points`, shape ``(n, d)``.
    committor: np.ndarray  #: probability to reach B before A, shape ``(n,)``
    #: Of states on their way from A to B, per unit of the states, shape ``(n,)``: its integral is the share
    #: of time spent so.
    density: np.ndarray
    #: Net current of what is on its way, ``(n, d)``: per unit of time and of what is across.
    current: np.ndarray
    rate: float  #: of transitions per unit of time that A was the last of both
    sets: tuple[Neighbourhood, ...] = ()  #: A, and the parts of B

    def counted(self, recordings: Recordings) -> pd.DataFrame:
        """How often a record went to B before A, beside the committor.

        Returns
        -------
        pandas.DataFrame
            A row for each tenth of the committor, columns ``committor counted standard_error excursions``:
            the means over samples between the sets of q and of whether B came next. Samples of one excursion,
            from set to set, are not independent: its sums are what the error is of, and there are so many.
        """
        x = recordings.values.T
        if self.process.dynamics.periodic:
            x = self.process.dynamics.wrapped(recordings.values).T
        inside = [
            np.any([p.height(x + s[:, None]) <= 1 for s in self.process.shifts], axis=0) for p in self.sets
        ]
        met = np.where(inside[0], 0.0, np.where(np.any(inside[1:], axis=0), 1.0, np.nan))
        following, number = np.full(len(met), np.nan), np.cumsum(~np.isnan(met))
        for run in runs_of(recordings):
            following[run], number[run] = pd.Series(met[run]).bfill().to_numpy(), number[run] + run.start
        between = np.isnan(met) & ~np.isnan(following)
        q, number = self.process.interpolated(self.committor)(x[:, between]), number[between]
        table = pd.DataFrame({"bin": np.minimum((q * TENTHS).astype(int), TENTHS - 1), "number": number})
        table["q"], table["hit"], table["size"] = q, following[between], 1.0
        rows = []
        for _, part in table.groupby("bin"):
            own = part.groupby("number")[["q", "hit", "size"]].sum()
            count, n = float(own["size"].sum()), len(own)
            share = float(own["hit"].sum()) / count
            spread = float(((own["hit"] - share * own["size"]) ** 2).sum()) * n / max(n - 1, 1)
            rows.append((float(own["q"].sum()) / count, share, np.sqrt(spread) / count, n))
        return pd.DataFrame(rows, columns=["committor", "counted", "standard_error", "excursions"])

    @property
    def mean_time(self) -> float:
        """Mean time from entering A, after B, until B is entered."""
        return 1 / self.rate if self.rate > 0 else np.inf

    @property
    def progress(self) -> Callable[[np.ndarray], np.ndarray]:
        """The logarithm of the committor, of components ``(d, ...)``; in A as low as where it is lowest."""
        lowest = self.committor[self.committor > 0].min()
        return self.process.interpolated(np.log(np.maximum(self.committor, lowest)))


class Dissipation(NamedTuple):
    """Production of entropy per unit of time, in units of Boltzmann's constant."""

    #: Σ̇, and its 95 % interval: by the uncertainty of f and ε where these were estimated, and of given ones
    #: the error of the cells. Not a number stands above where the terms of an estimated f leave no current,
    #: whatever their coefficients are: then nothing is known of other terms.
    value: float
    lower: float
    upper: float
    #: Middles of the cells, ``(n, d)``, and where in them it is made, per unit of the states, ``(n,)``.
    points: np.ndarray
    density: np.ndarray

    @classmethod
    def of(
        cls, dynamics: Dynamics, intensity: float, box: np.ndarray, *,
        draws: Sequence[tuple[Dynamics, float]] = (), cells: int | None = None,
    ) -> Dissipation:  # fmt: skip
        """Σ̇ in a box.

        Parameters
        ----------
        dynamics, intensity, box, cells
            As `CellProcess` takes them.
        draws
            f, D and ε drawn from the distribution of their estimates. An error of f is taken for a current,
            and adds to Σ̇ in the mean. The draws say by how much: their distribution about the estimate
            mirrors that of the estimate about the truth (the basic bootstrap).
        """
        process = CellProcess(dynamics, intensity, box, cells=cells)
        density = process.dissipation()
        value = float(density.sum() * process.volume)
        count = round(WIDER * (cells or CELLS[dynamics.dimension]))
        others = [(dynamics, intensity), *draws]
        coarse, *drawn = (
            one.dissipation().sum() * one.volume
            for one in (CellProcess(each, strength, box, cells=count) for each, strength in others)
        )
        if not drawn:
            # The error is of second order in the width of cells, for narrow ones: twice what that says.
            error = 2 * abs(value - coarse) / (WIDER**-2 - 1)
            return cls(value, max(value - error, 0.0), value + error, process.points, density)
        low, high = np.quantile(drawn, QUANTILES)
        mean, lower, upper = (max(value - one + coarse, 0.0) for one in (np.mean(drawn), high, low))
        # Terms of f that leave no current whatever their coefficients are say nothing of others.
        f = dynamics.diffusion.squared_speed(process.points, dynamics.drift(process.points))
        if max(drawn) < NO_CURRENT * 2 / intensity * float(process.density @ f):
            mean, lower, upper = 0.0, 0.0, np.nan
        share = mean / value if value > 0 else 1.0
        return cls(mean, lower, upper, process.points, share * density)


class Rotation(NamedTuple):
    """How a periodic state moves on in the long run, by ``⟨x⟩ = v t`` and ``var x = 2 D_eff t``."""

    state: str  #: its name
    #: v, in its unit per unit of time, and D_eff, in the square of its unit.
    velocity: float
    diffusion: float
    #: Standard errors by the uncertainty of f and ε where these were estimated, or from counting; of given
    #: ones the error of the cells, none in one state.
    velocity_error: float = 0.0
    diffusion_error: float = 0.0

    @classmethod
    def of(
        cls, dynamics: Dynamics, intensity: float, state: str | None = None, *,
        box: np.ndarray | None = None, draws: Sequence[tuple[Dynamics, float]] = (),
    ) -> Rotation:  # fmt: skip
        """By the formulas of the module, for any ε, with wells or without.

        Parameters
        ----------
        dynamics, intensity
            f and D, with periodic states, and ε.
        state
            Which of these; may be left out where there is but one.
        box
            Shape ``(d, 2)``, which holds all of the density; by default the domain.
        draws
            f, D and ε drawn from the distribution of their estimates.

        Raises
        ------
        ValueError
            Where the state is not periodic.
        NumericalFailure
            When there are more than three states, noise does not reach every state directly, or it is too
            weak for cells.

        Examples
        --------
        >>> import sympy
        >>> phi = sympy.Symbol("phi", real=True)
        >>> washboard = Dynamics.of(
        ...     [phi], [sympy.Float("0.5") - sympy.sin(phi)], domain=[(0, 2 * np.pi)], periodic=["phi"]
        ... )
        >>> found = Rotation.of(washboard, 1.0)
        >>> round(found.velocity, 6), round(found.diffusion, 6)
        (0.175593, 0.423589)
        """
        known = dynamics.periodic if state is None else (state,)
        if len(known) != 1 or known[0] not in dynamics.periodic:
            periodic = " and ".join(dynamics.periodic) or "no state"
            raise Fault(f"{periodic} is periodic, of which rotation is asked", "name one periodic state")
        place = dynamics.states.index(known[0])
        limits = dynamics.box if box is None else box

        def numbers(system: Dynamics, strength: float, share: float = 1.0) -> np.ndarray:
            if system.dimension == 1:
                return np.array(_ring_integrals(system, strength))
            cells = round(share * CELLS[system.dimension]) if system.dimension in CELLS else None
            return np.array(CellProcess(system, strength, limits, cells=cells).rotation(place))

        value, error = numbers(dynamics, intensity), np.zeros(2)
        if dynamics.dimension > 1:  # to cells of no width, of which the error is the square
            added = (value - numbers(dynamics, intensity, WIDER)) / (WIDER**-2 - 1)
            value, error = value + added, np.abs(added)
        if draws:
            error = np.hypot(error, np.std([numbers(*one, WIDER) for one in draws], axis=0, ddof=1))
        return cls(known[0], *map(float, value), *map(float, error))

    @classmethod
    def counted(cls, recordings: Recordings, state: str) -> Rotation:
        """As a recording shows it that counts turns (`siq.Recordings.unwrapped`), without any formula.

        v is the displacement in all runs by their time. D_eff is that of pieces of a run, `PIECES` in all,
        which have to be longer than what the motion remembers: several times 1/rate of a hop. Its relative
        error is ``√(2/n)`` of n pieces.

        Raises
        ------
        ValueError
            For a state that is not recorded.
        """
        if state not in recordings.names:
            raise Fault(f"'{state}' is not recorded", f"name one of {', '.join(recordings.names)}")
        x, t = recordings.values[:, recordings.names.index(state)], recordings.t
        ends = [(run.start, run.stop - 1) for run in runs_of(recordings) if run.stop - run.start > 1]
        total = sum(float(t[last] - t[first]) for first, last in ends)
        counts = [max(round(PIECES * float(t[last] - t[first]) / total), 1) for first, last in ends]
        cuts = [np.linspace(*both, 1 + count) for both, count in zip(ends, counts, strict=True)]
        moved, passed = (np.concatenate([np.diff(one[c.astype(int)]) for c in cuts]) for one in (x, t))
        velocity = float(moved.sum() / passed.sum())
        rest = (moved - velocity * passed) ** 2 / (2 * passed)
        diffusion = float(rest.sum() / (len(rest) - len(cuts) / len(rest)))
        errors = np.sqrt([2 * diffusion / passed.sum(), 2 * diffusion**2 / len(rest)])
        return cls(state, velocity, diffusion, *map(float, errors))


def _ring_integrals(dynamics: Dynamics, intensity: float) -> tuple[float, float]:
    """v and D_eff of one state, by quadrature: exact but for rounding."""
    (low, high), period = dynamics.box[0], float(dynamics.periods[0])

    def slope(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """f/a and a at points of any shape."""
        at = x.reshape(-1, 1)
        spread = intensity / 2 * dynamics.diffusion.at(at)[:, 0, 0]
        return (dynamics.drift(at)[:, 0] / spread).reshape(x.shape), spread.reshape(x.shape)

    steepest = np.abs(slope(np.linspace(low, high, FEWEST_PARTS))[0]).max()
    count = max(FEWEST_PARTS, int(np.ceil(2 * steepest * period)))
    if not count <= MOST_PARTS:
        raise NumericalFailure("the noise is too weak for the integrals over a period; use the escape times")
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    nodes, weights = (nodes + 1) / 2, weights / 2
    h, places = period / count, low + period * np.arange(count) / count
    inner = places[:, None] + h * nodes
    # Ψ from the start of each part to each node, and to its end.
    rise = h * nodes * (slope(places[:, None, None] + h * nodes[:, None] * nodes)[0] @ weights)
    whole = h * slope(inner)[0] @ weights
    ahead = np.log(h * (np.exp(rise) / slope(inner)[1]) @ weights)  # of e^Ψ/a, and of e^-Ψ
    behind = np.log(h * np.exp(-rise) @ weights)
    rising = np.concatenate([[0.0], np.cumsum(np.tile(whole, 2))])  # over two periods
    window = np.arange(count)[:, None] + np.arange(count)
    begin, end = rising[:count], rising[count : 2 * count]
    logs = special.logsumexp(rising[window] + ahead[window % count], axis=1) - end
    others = begin + special.logsumexp(behind[window % count] - rising[window], axis=1)
    total = special.logsumexp(logs) + np.log(h)
    tilt = float(rising[count]) if abs(rising[count]) > np.finfo(float).eps * np.abs(whole).sum() else 0.0
    one_way = -np.expm1(-abs(tilt)) * np.exp(max(-tilt, 0.0) - total)
    velocity = period * np.sign(tilt) * one_way
    spread = period**2 * np.exp(special.logsumexp(2 * logs + others) + np.log(h) - 3 * total)
    return float(velocity), float(spread)


class CellProcess:
    """The Markov jump process between the cells of a box, of one to three states, that nothing leaves.

    Parameters
    ----------
    dynamics, intensity
        f and D, and ε, in the unit of U.
    box
        Shape ``(d, 2)``; it should hold all of the density.
    cells
        Along each state.

    Attributes
    ----------
    points
        Middles of the n cells, shape ``(n, d)``.
    volume
        Of a cell, in the product of the states' units.
    density
        Invariant probabilities, shape ``(n,)``, 1 in total.
    rates
        L, shape ``(n, n)``.
    shifts
        What leads from a state to its images in the next periods, shape ``(m, d)``, zero among them.

    Raises
    ------
    NumericalFailure
        When there are more than three states, noise does not reach every state, or it is too weak for cells.
    """

    def __init__(
        self, dynamics: Dynamics, intensity: float, box: np.ndarray, *, cells: int | None = None
    ) -> None:
        dimension = dynamics.dimension
        if dimension not in CELLS:
            raise NumericalFailure("the Fokker–Planck operator is solved for three states at most")
        count = cells or CELLS[dimension]
        # A unit lower triangular change of states after which D has no mixed terms in the middle. With mixed
        # terms it is the parallelogram's hull that is covered. A D(x) that was learned may be no covariance
        # far from recordings: cells where that is so are left out.
        shear, matrix = np.eye(dimension), dynamics.diffusion.at(box.mean(axis=1)[None])[0]
        unit = np.sqrt(positive(np.diag(matrix)))
        if np.abs(np.tril(matrix / np.outer(unit, unit), -1)).max() > 1e-12:
            root = np.linalg.cholesky(matrix)
            shear = root / np.diag(root)
        # Around a box of one period there is no wall.
        turning = np.isclose(np.ptp(box, axis=1), dynamics.periods) & (dynamics.periods > 0)
        if np.tril(shear, -1)[:, turning].any():
            raise NumericalFailure("the noise of a periodic state is correlated with that of others")
        self._periods = np.where(turning, dynamics.periods, 0.0)
        self.shifts = np.unique(np.where(turning, dynamics.shifts, 0.0), axis=0)
        system = ScaledSystem(dynamics, np.zeros(dimension), shear, unit=1.0)
        corners = system.scaled(np.array(list(product(*box))))
        sides = np.stack([corners.min(axis=0), corners.max(axis=0)], axis=1)
        axes = [low + (high - low) * (np.arange(count) + 0.5) / count for low, high in sides]
        steps = (sides[:, 1] - sides[:, 0]) / count
        y = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dimension)
        matrices = system.noise.at(y)
        strengths = np.linalg.eigvalsh(matrices)
        floor = LEAST_NOISE * float(strengths.max())
        off = matrices[:, *np.triu_indices(dimension, 1)]
        if dimension > 2 and np.abs(off).max() > 1e-9 * strengths.max():
            raise NumericalFailure("of three states, D has to be of one form everywhere for cells")

        def noise(points: np.ndarray) -> np.ndarray:
            matrices = system.noise.at(points)
            levels, vectors = np.linalg.eigh(matrices)
            if not (levels >= floor).all():  # nothing is weaker than the floor
                matrices = np.einsum("nik,nk,njk->nij", vectors, np.maximum(levels, floor), vectors)
            return 0.5 * intensity * matrices

        places = np.flatnonzero(strengths[:, 0] > floor)
        if not len(places):
            raise NumericalFailure(
                "the noise does not reach every state: no Fokker–Planck operator is solved"
            )
        # The generator of the largest set of usable cells that are connected.
        inner = _rates(system.force, noise, y, steps, count, turning)[places][:, places]
        _, piece = sparse.csgraph.connected_components(inner, directed=True, connection="strong")
        largest = piece == np.argmax(np.bincount(piece))
        places, inner = places[largest], inner[largest][:, largest]
        self.rates = (inner - sparse.diags(np.asarray(inner.sum(axis=1)).ravel())).tocsr()
        y, self.density = y[places], _invariant_density(self.rates, dimension)
        tensor, drift = np.diagonal(noise(y), axis1=1, axis2=2), system.force(y)
        if float((self.density[:, None] * np.abs(drift) * steps / tensor).sum(axis=0).max()) > COARSE:
            raise NumericalFailure("the noise is too weak for a grid: the wells are narrower than its cells")
        self.dynamics, self.intensity = dynamics, intensity
        self.points, self.volume = system.points(y), float(steps.prod())
        self._system, self._places, self._shape = system, places, (count,) * dimension
        self._box, self._corner, self._steps, self._turning = box, sides[:, 0], steps, turning

    def mean_time(self, start: Neighbourhood, ends: Sequence[Neighbourhood]) -> tuple[float, float]:
        """Mean time from the middle of one neighbourhood until one of some others is reached, and its error.

        ln τ is extrapolated to cells of no width, from these and wider ones: it is off by the square of that.
        The error, a relative one, is the square of what this adds, as the next power of the width is. Neither
        is told where rounding is a part of so long a time, or noise carries states to walls of the box.
        """
        wide = CellProcess(self.dynamics, self.intensity, self._box, cells=round(WIDER * self._shape[0]))
        own, other = (
            float(one.interpolated(one.mean_times(ends))(start.center[:, None])[0]) for one in (self, wide)
        )
        if not (other > 0 and 0 < own < MOST_ROUNDING / np.finfo(float).eps / -self.rates.diagonal().min()):
            raise NumericalFailure("the time is lost in rounding: take a larger ε, or simulate")
        edges = np.stack(np.unravel_index(wide._places, wide._shape)) % (wide._shape[0] - 1) == 0
        spent = wide.mean_times(ends, during=(edges & ~self._turning[:, None]).any(axis=0))
        if wide.interpolated(spent)(start.center[:, None])[0] > MOST_AT_WALLS * other:
            raise NumericalFailure("the noise carries states to the edge of the domain: give a wider one")
        added = np.log(own / other) / (WIDER**-2 - 1)
        return float(own * np.exp(added)), float(added**2)

    def inside(self, part: Neighbourhood) -> np.ndarray:
        """Mask of the cells in a neighbourhood, shape ``(n,)``; NumericalFailure where there is none."""
        images = [self.points + shift for shift in self.shifts]
        found = np.any([part.height(one.T) <= 1 for one in images], axis=0)
        if not found.any():
            raise NumericalFailure("the core of a well is smaller than a cell of the grid")
        return np.asarray(found)

    def solved(
        self, given: np.ndarray, *, source: float | np.ndarray = 0.0, backwards: bool = False
    ) -> np.ndarray:
        """u with ``L u = -source`` in the cells in which none is given, NaN: shape ``(n,)``.

        `backwards` takes the reversed process, of which u has no source.
        """
        free, found = np.flatnonzero(np.isnan(given)), np.nan_to_num(given, nan=0.0)
        operator = self.rates
        if backwards:  # of the reversed process only ratios count: π_j L_ji, row by row
            operator = (sparse.diags(np.maximum(self.density, np.finfo(float).tiny)) @ operator).T.tocsr()
        inner = operator[free][:, free]
        scale = 1 / np.maximum(-inner.diagonal(), np.finfo(float).tiny)
        into = -(operator[free] @ found) - np.broadcast_to(source, len(found))[free]
        found[free] = _factorised((sparse.diags(scale) @ inner).tocsc(), len(self._shape))(scale * into)
        return found

    def between(self, start: Neighbourhood, ends: Sequence[Neighbourhood]) -> ReactiveFlow:
        """All that goes from one neighbourhood to one of some others, which are disjoint from it."""
        first, last = self.inside(start), np.any([self.inside(one) for one in ends], axis=0)
        if (first & last).any():
            raise NumericalFailure("the two sets have cells in common")
        given = np.where(last, 1.0, np.where(first, 0.0, np.nan))
        forward = np.clip(self.solved(given), 0.0, 1.0)
        back = np.clip(self.solved(1 - given, backwards=True), 0.0, 1.0)
        flows = sparse.diags(self.density * back) @ self.rates @ sparse.diags(forward)
        spent = float(self.density @ back)
        leaving = float((self.density * first) @ (self.rates @ forward))
        density = self.density * forward * back / self.volume
        return ReactiveFlow(self, forward, density, self._current(flows), leaving / spent, (start, *ends))

    def mean_times(self, ends: Sequence[Neighbourhood], *, during: np.ndarray | float = 1.0) -> np.ndarray:
        """Mean time in cells where `during` is 1 until one of `ends` is reached, from each: ``(n,)``."""
        reached = np.any([self.inside(one) for one in ends], axis=0)
        return self.solved(np.where(reached, 0.0, np.nan), source=during)

    def dissipation(self) -> np.ndarray:
        """Where entropy is produced, per unit of time and of the states: shape ``(n,)``."""
        current = self._current(sparse.diags(self.density) @ self.rates)
        known = self.density > np.finfo(float).eps * self.density.max()  # the others are rounding
        speed = np.where(known, self.volume / np.where(known, self.density, 1.0), 0.0)[:, None] * current
        squares = self.dynamics.diffusion.squared_speed(self.points, speed)
        return np.asarray(2 / self.intensity * squares * self.density / self.volume)

    def rotation(self, state: int) -> tuple[float, float]:
        """v and D_eff of a periodic state by its place, as its turns count."""
        jumps = self.rates.tocoo()
        moved = self._moved(jumps)[:, state]
        start, end, rate = jumps.row, jumps.col, np.where(jumps.row == jumps.col, 0.0, jumps.data)
        drift = np.bincount(start, rate * moved, minlength=len(self.density))
        velocity = float(self.density @ drift)
        given = np.full(len(self.density), np.nan)
        given[np.argmax(self.density)] = 0.0
        change = self.solved(given, source=drift - velocity)
        square = (moved + change[end] - change[start]) ** 2
        return velocity, float(self.density[start] @ (rate * square)) / 2

    def _moved(self, jumps: sparse.coo_matrix) -> np.ndarray:
        """By how much each entry of a matrix of cells moves the states, ``(m, d)``: the shortest way."""
        moved = self.points[jumps.col] - self.points[jumps.row]
        period = self._periods
        return np.asarray(moved - period * np.round(moved / np.where(period > 0, period, np.inf)))

    def _current(self, flows: sparse.spmatrix) -> np.ndarray:
        """The current in the middle of cells, of flows from cell to cell: shape ``(n, d)``."""
        net = (flows - flows.T).tocoo()  # each cell takes half of what passes its faces
        passed = (net.data[:, None] * self._moved(net)).T
        summed = [np.bincount(net.row, each, minlength=len(self.points)) for each in passed]
        return np.asarray(np.stack(summed, axis=1) / (2 * self.volume))

    def interpolated(self, values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """A function of components ``(d, ...)`` that has these values ``(n,)`` in the cells, linear between.

        Outside of the box, and in cells that are left out, it has the value of the nearest cell.
        """
        whole = np.full(self._shape, np.nan).ravel()
        whole[self._places] = values
        whole = whole.reshape(self._shape)
        if np.isnan(whole).any():
            nearest = ndimage.distance_transform_edt(
                np.isnan(whole), return_distances=False, return_indices=True
            )
            whole = whole[tuple(nearest)]
        inverse, steps, corner = self._system.inverse, self._steps, self._corner
        turning, count = self._turning, self._shape[0]
        whole = np.pad(whole, [(int(turn), int(turn)) for turn in turning], mode="wrap")

        def function(x: np.ndarray) -> np.ndarray:
            y = (inverse @ x.reshape(len(x), -1)).reshape(x.shape)
            wide = (slice(None), *(None,) * (x.ndim - 1))
            index = (y - corner[wide]) / steps[wide] - 0.5
            index[turning] = (index[turning] + 0.5) % count + 0.5
            return np.asarray(ndimage.map_coordinates(whole, index, order=1, mode="nearest"))

        return function


def _rates(
    force: Function, noise: Function, y: np.ndarray, steps: np.ndarray, count: int, turning: np.ndarray
) -> sparse.csr_matrix:
    """Rates between neighbouring cells, without those that lead out of a cell on the diagonal.

    Along a `turning` direction the first cells follow on the last ones.
    """
    pairs: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    dimension = y.shape[1]
    cells = np.arange(len(y)).reshape((count,) * dimension)
    index = np.pad(cells, [(0, int(turn)) for turn in turning], mode="wrap")
    for axis in range(dimension):
        along = np.moveaxis(cells, axis, 0)
        left = along[: count - 1 + turning[axis]].ravel()
        right = np.roll(along, -1, axis=0)[: count - 1 + turning[axis]].ravel()
        h = steps[axis]
        face = y[left] + h / 2 * np.eye(dimension)[axis]
        tensor = noise(face)
        spread = tensor[:, axis, axis]
        beyond = y[left] + h * np.eye(dimension)[axis]
        slope = (noise(beyond)[:, axis, axis] - noise(y[left])[:, axis, axis]) / h
        drift = force(face)[:, axis] - slope
        if dimension == 2:
            other, move = 1 - axis, np.zeros(2)
            move[other] = steps[other] / 2
            # What the other direction's mixed term carries along this one: ∂(a_xy)/∂y.
            drift = drift - (noise(face + move) - noise(face - move))[:, 0, 1] / steps[other]
            spread = spread - np.abs(tensor[:, 0, 1]) * h / steps[other]
        spread = np.maximum(spread, 1e-9 * tensor[:, axis, axis])
        forth, back = exchange_rates(drift * h / spread, spread / h**2)
        pairs += [(left, right, forth), (right, left, back)]
    if dimension == 2:
        for sign in (1, -1):
            low = index[:-1, :-1] if sign > 0 else index[:-1, 1:]
            high = index[1:, 1:] if sign > 0 else index[1:, :-1]
            start, end = low.ravel(), high.ravel()
            middle = y[start] + steps / 2 * np.array([1, sign])
            mixed = np.maximum(sign * noise(middle)[:, 0, 1], 0) / np.prod(steps)
            used = mixed > 0
            pairs += [(start[used], end[used], mixed[used]), (end[used], start[used], mixed[used])]
    rows, columns, values = (np.concatenate(part) for part in zip(*pairs, strict=True))
    return sparse.csr_matrix((values, (rows, columns)), shape=(len(y), len(y)))


def exchange_rates(z: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rates ``(a/h²) B(-z)`` to the next cell and ``(a/h²) B(z)`` back, with `spread` for a/h²."""
    z = np.clip(z, -STEEP, STEEP)
    return spread / special.exprel(-z), spread / special.exprel(z)  # B = 1/exprel


def _factorised(matrix: sparse.csc_matrix, dimension: int) -> Callable[[np.ndarray], np.ndarray]:
    """The solution for right sides; of three states in an order that keeps factors of neighbours small."""
    if dimension < 3:
        return splu(matrix).solve
    return splu(
        matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    ).solve


def _invariant_density(rates: sparse.csr_matrix, dimension: int) -> np.ndarray:
    """Probabilities with ``π L = 0``: that of a busy cell set to one, the others follow from it."""
    transposed = rates.T.tocsc()
    size = transposed.shape[0]
    # A process that rarely starts anew, anywhere, says which cell is busy; of one that is not, the ratio of
    # all others to it would have to be found.
    anew = RESTART_RATE * float(-rates.diagonal().min())
    renewed = (transposed - anew * sparse.identity(size)).tocsc()
    fixed = int(np.argmax(_factorised(renewed, dimension)(np.full(size, -anew / size))))
    free = np.delete(np.arange(size), fixed)
    right = -np.asarray(transposed[free][:, [fixed]].todense()).ravel()
    found = np.ones(size)
    found[free] = _factorised(transposed[free][:, free].tocsc(), dimension)(right)
    if not np.isfinite(found).all() or found.min() < -1e-6 * found.max():
        raise NumericalFailure(
            "the invariant density was not found: the noise is too weak for this box; use the barriers"
        )
    found = np.maximum(found, 0.0)
    return np.asarray(found / found.sum())


def cores_about(
    dynamics: Dynamics, attractors: Sequence[Equilibrium | Cycle],
    saddles: Sequence[Sequence[Equilibrium | Cycle]], intensity: float,
) -> list[Neighbourhood]:  # fmt: skip
    """The core of each attractor: U below ε, or below half of what it is at the next saddle or attractor.

    `saddles` are those about each of them.
    """
    cores = []
    for place, one in enumerate(attractors):
        others = [
            other.points if isinstance(other, Cycle) else other.position[None]
            for other in (*attractors, *saddles[place])
            if other is not one
        ]
        if isinstance(one, Cycle):
            hessians = hessians_along(dynamics, one)
            core = Neighbourhood(one.position, hessians[0], 0.5, one, hessians)
        else:
            core = Neighbourhood(one.position, hessian_at(dynamics, one.position), 0.5)
        away = np.concatenate([np.zeros((0, dynamics.dimension)), *others])
        lowest = float(core.height(away.T).min(initial=np.inf)) if len(away) else np.inf
        cores.append(replace(core, level=min(intensity, CORE_SHARE * lowest) / 2))
    return cores
