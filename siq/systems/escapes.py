"""Mean escape times by simulation of ``dx = f dt + sqrt(ε) D^(1/2) dW``: directly, and by splitting.

Walkers start in one well and are followed until they reach the neighbourhood of another attractor. Nothing is
assumed about V: this is what the laws of `siq.quasipotential.rates` are held against. Directly it takes a
time proportional to exp(ΔU/ε), and so is for moderate barriers, ΔU/ε of ten and less.

The rule is that of Heun for additive noise ξ, ``x̂ = x + f(x) h + ξ``, ``x ← x + (f(x) + f(x̂)) h/2 + ξ``, of
weak order two. States are held components first, ``(d, walkers)``.

**Splitting** takes a time proportional to ΔU/ε. Let A be a neighbourhood of the attractor, B those of the
others, and Σ where a coordinate of progress ξ first exceeds some level. One who leaves Σ comes back by way of
A, or reaches B with a small probability p. If one who has reached B begins anew at the attractor, this goes
on for ever, and for any A and Σ

    E[τ] = (mean time from Σ to the next Σ)/p

exactly, from the states at Σ as they are then (T. Hill's relation). That time and these states come from
direct simulation, p from adaptive multilevel splitting: n walkers have each gone on from Σ until A or B. The
k with the lowest maxima of ξ become copies of others at the place where these first exceeded that level, and
go on from there by noise of their own. It ends when fewer than k are not in B. p is the product of all
``1 - k/n``, times the share that is in B; ties are replaced together. Its mean is p whatever ξ is. How much
it spreads depends on ξ, is least for the committor, and shows in independent runs.

References
----------
F. Cérou and A. Guyader, Stoch. Anal. Appl. 25 (2007) 417.
C.-E. Bréhier et al., Ann. Appl. Probab. 26 (2016) 3559: the mean is p.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import special
from scipy.spatial import cKDTree

from siq.errors import NumericalFailure
from siq.numerics.integration import Field, heun_step, runge_kutta_step
from siq.systems.cycles import Cycle
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at
from siq.systems.simulation import noise_source

STEP = 0.1  # of the shortest time of the linearised equations
SETTLED = 0.1  # of the level of a neighbourhood: without noise, one who has escaped gets so far down
LONGEST_SETTLING = 30.0  # in units of the slowest relaxation time

RUNS = 16  # of splitting: their spread is then known to a fifth
WALKERS = 300  # in all runs together, for each factor e of p: thrice what a relative variance of 1 % takes
LEAST_WALKERS = 100  # in each run
ASKED_ERROR, AIMED_ERROR = 0.1, 0.075  # relative, of E[τ]: at most, and what more walkers are to bring
MOST_MORE = 10.0  # times as many walkers
REPLACED = 0.1  # of the walkers of a run in one turn
FINENESS = 0.1  # of ln p between two levels of progress
MOST_LEVELS = 250
CYCLES = 2  # from Σ to Σ that count of each walker, and as many before
# Walkers, relaxation times, and the share of these that have been at Σ by then. One who comes from Σ has then
# forgotten from which side: where Σ is close to A, states there are correlated over many returns.
PILOTS, PILOT_TIME, PILOT_SHARE = 400, 2.0, 0.2
STEP_ERROR = 0.0025  # of the mean time, by the step
HEUN = 0.25  # ln E[τ] is off by this times ΔU/ε (h/τ)², as the variance of a linear system is


@dataclass(frozen=True)
class Neighbourhood:
    """An ellipsoid about an attractor: ``½ (x - center)·hessian (x - center) ≤ level``.

    With the Hessian of V (`siq.systems.equilibria.hessian_at`) it approximates a level set of V. About a
    cycle it is a tube, by the Hessian at the nearest of its points.
    """

    center: np.ndarray  #: shape (d,)
    hessian: np.ndarray  #: shape (d, d)
    level: float  #: in the unit of V, not of U = 2V; it should be well below that of the saddles
    cycle: Cycle | None = None  #: about which it lies, center being one of its states
    hessians: np.ndarray | None = None  #: shape (n, d, d), at the states of the cycle

    @classmethod
    def about(cls, dynamics: Dynamics, attractor: np.ndarray, *, level: float) -> Neighbourhood:
        """The ellipsoid on which V, to second order, has a level (of V, not of U = 2V)."""
        return cls(np.asarray(attractor, dtype=float), hessian_at(dynamics, attractor), level)

    def moved(self, shift: np.ndarray) -> Neighbourhood:
        """The neighbourhood, moved by a displacement ``(d,)``."""
        cycle = None if self.cycle is None else replace(self.cycle, points=self.cycle.points + shift)
        return replace(self, center=self.center + shift, cycle=cycle)

    def evenly(self, count: int) -> np.ndarray:
        """So many states of the attractor, evenly spread in time along a cycle: shape ``(d, count)``."""
        states = self.center[None] if self.cycle is None else self.cycle.points
        return states[np.arange(count) * len(states) // count].T.copy()

    @cached_property
    def _nearest(self) -> Callable[[np.ndarray], np.ndarray]:
        assert self.cycle is not None
        width = np.ptp(self.cycle.points, axis=0)
        tree = cKDTree(self.cycle.points / width)
        return lambda x: np.asarray(tree.query(x / width)[1])

    def height(self, x: np.ndarray) -> np.ndarray:
        """The quadratic form in units of the level: components ``(d, n)`` to ``(n,)``."""
        if self.cycle is not None and self.hessians is not None:
            near = self._nearest(x.T)
            away = x.T - self.cycle.points[near]
            return np.einsum("ni,nij,nj->n", away, self.hessians[near], away) / (2 * self.level)
        y = x - self.center[:, None]
        return np.sum(y * (self.hessian @ y), axis=0) / (2 * self.level)


@dataclass(frozen=True)
class _EscapeTimes:
    """Simulated times of escape, which at weak noise are distributed exponentially."""

    times: np.ndarray  #: of those who escaped, ascending, shape (escapes,)
    targets: np.ndarray  #: index of the neighbourhood that each of them reached
    censored: int  #: number of walkers that had not escaped when the simulation ended
    longest: float  #: how long these were followed, in time units

    @property
    def escapes(self) -> int:
        """Number of walkers that escaped."""
        return len(self.times)

    @property
    def mean(self) -> float:
        """The maximum likelihood estimate, all time spent divided by the number of escapes; inf without any.

        Who has not escaped counts with the time that he was followed. To leave out the censored would
        underestimate the mean.
        """
        spent = float(self.times.sum()) + self.censored * self.longest
        return spent / self.escapes if self.escapes else np.inf

    @property
    def standard_error(self) -> float:
        """Of the mean: ``mean / sqrt(escapes)``."""
        return self.mean / np.sqrt(self.escapes) if self.escapes else np.inf


def simulate_escapes(
    dynamics: Dynamics, start: np.ndarray, targets: Sequence[Neighbourhood], *, intensity: float,
    longest: float, generator: np.random.Generator, walkers: int = 1000, step: float | None = None,
) -> _EscapeTimes:  # fmt: skip
    """Follow walkers until they reach one of some neighbourhoods, from which f leads on to its attractor.

    Parameters
    ----------
    dynamics, intensity
        f and D, and ε, in the unit of U.
    start, targets
        Shape ``(d,)``, mostly an attractor, or a start for each walker; and neighbourhoods of the others.
    longest
        Time after which those who are left count as censored; a few of the expected mean times.
    generator, walkers
        Source of the noise, and how many there are.
    step
        Step h; by default a tenth of the shortest time of f at the start and the targets.

    Raises
    ------
    ValueError
        When there is no target, or a number is not positive.
    NumericalFailure
        When walkers run to infinity.
    """
    if not targets or min(walkers, longest, intensity) <= 0:
        raise ValueError("escapes need a target, walkers, and a positive intensity and time")
    starts = np.broadcast_to(np.asarray(start, dtype=float), (walkers, dynamics.dimension))
    centers = np.stack([starts[0], *(one.center for one in targets)])
    if step is None:
        step = STEP / float(np.abs(np.linalg.eigvals(dynamics.jacobian(centers))).max())
    function = dynamics.drift_of_components
    draw = noise_source(dynamics, intensity=intensity, step=step, generator=generator)
    slowest = [np.abs(np.linalg.eigvals(one).real).min() for one in dynamics.jacobian(centers[1:])]
    settling = [int(np.ceil(LONGEST_SETTLING / one / step)) for one in slowest]
    x = starts.T.copy()
    steps = int(np.ceil(longest / step))
    times, reached = [np.zeros(0)], [np.zeros(0, dtype=int)]
    with np.errstate(over="ignore", invalid="ignore"):  # told below
        for index in range(1, steps + 1):
            x = heun_step(function, x, step, draw(x))
            staying = np.ones(x.shape[1], dtype=bool)
            for number, target in enumerate(targets):
                inside = np.flatnonzero(target.height(x) <= 1)
                if len(inside):
                    there, settled = x[:, inside], np.zeros(len(inside), dtype=bool)
                    for _ in range(settling[number]):  # f leads on to its middle
                        there = runge_kutta_step(function, there, step)
                        settled |= target.height(there) <= SETTLED
                        if settled.all():
                            break
                    arrived = inside[settled]
                    staying[arrived] = False
                    times.append(np.full(len(arrived), index * step))
                    reached.append(np.full(len(arrived), number))
            if not staying.all():
                x = x[:, staying]
            if not x.shape[1]:
                break
    lost = int((~np.isfinite(x).all(axis=0)).sum())  # what once is not finite stays so
    if lost:
        raise NumericalFailure(f"{lost} of {walkers} walkers run to infinity; take a smaller step")
    return _EscapeTimes(np.concatenate(times), np.concatenate(reached), x.shape[1], steps * step)


class _SplitTime(NamedTuple):
    """A mean time by splitting, its relative standard error, its 95 % interval, and of what it was made.

    `cycles` and `chances` are, for each run, the mean time from Σ to Σ and p.
    """

    value: float
    relative_error: float
    lower: float
    upper: float
    cycles: np.ndarray
    chances: np.ndarray

    @classmethod
    def of(cls, cycles: np.ndarray, chances: np.ndarray) -> _SplitTime:
        """Of all runs together; NumericalFailure where none has reached another neighbourhood."""
        if not chances.any():
            raise NumericalFailure(
                "no walker reaches another neighbourhood; another coordinate may lead there"
            )
        of_cycle, of_chance = (
            float(one.std(ddof=1) / one.mean() / np.sqrt(len(one))) for one in (cycles, chances)
        )
        error = float(np.hypot(of_cycle, of_chance))
        # The mean of 1/p is above 1 over the mean of p.
        value = float(cycles.mean() / chances.mean() / (1 + of_chance**2))
        reach = float(np.exp(special.stdtrit(len(chances) - 1, 0.975) * error))
        return cls(value, error, value / reach, value * reach, cycles, chances)


def split_escapes(
    dynamics: Dynamics, start: Neighbourhood, targets: Sequence[Neighbourhood], *, intensity: float,
    progress: Callable[[np.ndarray], np.ndarray], generator: np.random.Generator, runs: int = RUNS,
) -> _SplitTime:  # fmt: skip
    """The mean time from the middle of one neighbourhood until one of some others is reached, by splitting.

    Parameters
    ----------
    dynamics, intensity
        f and D, and ε, in the unit of U.
    start, targets
        A, which should be well within its well, and B.
    progress
        ξ of components ``(d, n)``, shape ``(n,)``; best is the logarithm of the probability to reach B before
        A. Any other one that rises from A to B leaves the mean as it is. It is in units in which that
        logarithm changes by about 1, or the number of walkers is not what it should be.
    generator
        Source of the noise.
    runs
        Independent ones, whose spread tells the error.

    Raises
    ------
    NumericalFailure
        When no walker reaches a target, or all run to infinity.
    """
    centers = np.stack([start.center, *(one.center for one in targets)])
    around = [one.cycle.points for one in (start, *targets) if one.cycle is not None]
    rates = np.linalg.eigvals(dynamics.jacobian(np.concatenate([centers, *around])))
    slowest = float(np.abs((rates[0] if start.cycle is None else start.cycle.eigenvalues).real).min())
    along = progress(centers.T)
    lowest, top = float(along[0]), float(along[1:].max())
    # E[τ] is off by 0.3 % where noise is additive. Elsewhere Heun's rule is of order one.
    step = min(STEP, np.sqrt(STEP_ERROR / (HEUN * max(top - lowest, 1.0)))) / float(np.abs(rates).max())
    function = dynamics.drift_of_components
    draw = noise_source(dynamics, intensity=intensity, step=step, generator=generator)

    def advance(x: np.ndarray) -> np.ndarray:
        x = heun_step(function, x, step, draw(x))
        if not np.isfinite(x).all():
            raise NumericalFailure("walkers run to infinity; take a smaller step")
        return x

    def heights(x: np.ndarray) -> np.ndarray:
        """ξ, -∞ in A and ∞ in B."""
        found = np.where(start.height(x) <= 1, -np.inf, progress(x))
        return np.where(np.any([one.height(x) <= 1 for one in targets], axis=0), np.inf, found)

    # Σ lies where few walkers have been after a short time.
    x = start.evenly(PILOTS)
    highest = np.full(PILOTS, -np.inf)
    longest = max(1 / slowest, 0.0 if start.cycle is None else start.cycle.period)
    for _ in range(int(np.ceil(PILOT_TIME * longest / step))):
        x = advance(x)
        highest = np.maximum(highest, heights(x))
    first = min(float(np.quantile(highest, 1 - PILOT_SHARE, method="nearest")), top - 1.0)
    if not np.isfinite(first):
        raise NumericalFailure("walkers hardly leave where they start; take a smaller neighbourhood")
    count = int(np.clip(np.ceil((top - first) / FINENESS), 1, MOST_LEVELS))

    def levels(x: np.ndarray) -> np.ndarray:
        """Progress in so many levels, that of B; -1 below Σ, -2 in A."""
        found = heights(x)
        inner = np.floor((np.clip(found, first, top) - first) / (top - first) * count)
        inner = np.where(found >= first, np.minimum(inner, count - 1), -1)
        return np.where(np.isinf(found), np.where(found > 0, count, -2), inner).astype(int)

    walkers = max(int(np.ceil(WALKERS * (top - first) / RUNS)), LEAST_WALKERS)

    def result(walkers: int) -> _SplitTime:
        x, cycles = _at_sigma(advance, levels, start.evenly(runs * walkers), count)
        chances = _split(advance, levels, x, count, walkers, generator)
        return _SplitTime.of(step * cycles.reshape(runs, -1).mean(axis=1), chances)

    found = result(walkers)
    if found.relative_error <= ASKED_ERROR:
        return found
    # Once more with as many as this asks for; were the first kept, chance would decide what counts.
    return result(int(walkers * min((found.relative_error / AIMED_ERROR) ** 2, MOST_MORE)))


def _at_sigma(advance: Field, levels: Field, center: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """States at Σ, ``(d, walkers)``, and how many steps each has made from one Σ to the next.

    They begin at states of the attractor, of the same shape.
    """
    x, walkers = center.copy(), center.shape[1]
    states, begun, ended = np.empty_like(x), np.zeros(walkers), np.zeros(walkers)
    who, away, visits = np.arange(walkers), np.zeros(walkers, dtype=bool), np.zeros(walkers, dtype=int)
    step = 0
    while len(who):
        step += 1
        x = advance(x)
        level = levels(x)
        arrived = ~away & (level >= 0) & (level < count)
        visits[arrived] += 1
        begun[who[arrived & (visits == CYCLES)]] = step
        away = (away | arrived) & (level > -2) & (level < count)
        x[:, level == count] = center[:, who[level == count]]
        done = arrived & (visits == 2 * CYCLES)
        if done.any():
            states[:, who[done]], ended[who[done]] = x[:, done], step
            x, who, away, visits = x[:, ~done], who[~done], away[~done], visits[~done]
    return states, (ended - begun) / CYCLES


def _split(
    advance: Field, levels: Field, x: np.ndarray, count: int, walkers: int, generator: np.random.Generator
) -> np.ndarray:
    """p of each run of splitting, whose walkers stand one run after another: shape ``(runs,)``."""
    total = x.shape[1]
    best, entries = np.full(total, -1), np.empty((count + 1, *x.shape))

    def go_on(who: np.ndarray, x: np.ndarray) -> None:
        """Follow walkers until A or B, and keep where each first was at every level or above."""
        level = levels(x)
        while len(who):
            higher = level > best[who]
            while higher.any():
                best[who[higher]] += 1
                entries[best[who[higher]], :, who[higher]] = x[:, higher].T
                higher = level > best[who]
            going = (level > -2) & (level < count)
            x, who = x[:, going], who[going]
            if len(who):
                x = advance(x)
                level = levels(x)

    go_on(np.arange(total), x)
    chances = np.ones(total // walkers)
    number = max(round(REPLACED * walkers), 1)
    while True:
        own = best.reshape(-1, walkers)
        least = np.partition(own, number - 1, axis=1)[:, number - 1]
        lost = (own <= least[:, None]) & (least < count)[:, None]
        lost[chances == 0] = False
        if not lost.any():
            return np.asarray(chances * (best.reshape(-1, walkers) == count).mean(axis=1))
        chances *= 1 - lost.mean(axis=1)
        children, parents = [], []
        for run in np.flatnonzero(lost.any(axis=1) & (chances > 0)):
            there = run * walkers + np.flatnonzero(lost[run])
            others = run * walkers + np.flatnonzero(~lost[run])
            children.append(there)
            parents.append(generator.choice(others, len(there)))
        if not children:
            continue
        child, parent = np.concatenate(children), np.concatenate(parents)
        entries[:, :, child] = entries[:, :, parent]
        from_level = least[child // walkers] + 1
        best[child] = from_level
        go_on(child, np.ascontiguousarray(entries[from_level, :, child].T))
