"""Two states of a record: whether it supports two, their levels, hops and residence times.

Nothing is identified here: this is what the numbers say before any f is known, and it holds where none is
found or certified.

*Levels.* A hidden Markov model of two normal distributions finds the levels, and what both have in common is
the background (`siq.data.stationarity.background_of`); each in turn.

*Hops* are counted with two thresholds, the levels of the two states: a visit begins where the record reaches
the level of a state, and lasts until it reaches the level of the other one. The mean residence time is the
time of all visits, those that the record cuts at its ends included, over the number of visits whose end was
seen: the best estimate for exponential times, with a relative error of ``1/√n``.

*Two tests.* A histogram with two peaks is no evidence: a slow background makes one of a single state. Two
states have a place between them from which the record is pushed away to both sides. The first test regresses
increments over a lag on polynomials of the state in stretches of forty local relaxation times, each with a
level of its own, which takes with it whatever drifts slowly. With the polynomial of the state,
``E[x(t + 2l) - x(t + l) | x(t)] = l·f(x(t))``, every difference f(b) - f(a) with a < b would be negative if a
single state attracted. The largest of them in standard errors counts, with Scheffé's bound for having looked
at all pairs. The second test asks for a valley of the histogram, deeper than in surrogates of the record with
the same spectrum and random phases, which are what a linear system could have shown; it is not asked where
the first one is beyond doubt. Two states are supported if one of the tests says so, and a hop was seen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import special

from siq.data.correlation import markov_lag
from siq.data.recordings import Recordings
from siq.data.stationarity import (
    MOST_STRETCHES,
    background_of,
    relaxation_samples,
    runs_of,
    stretches_of,
)
from siq.numerics.integration import machine_code
from siq.remarks import Remark, sentence

if TYPE_CHECKING:
    import pandas as pd

AVERAGING_TIME = 0.5  # of the local relaxation time: of samples for the hidden Markov model
MOST_ITERATIONS = 200  # of its estimation, at most


def _two_levels(
    recordings: Recordings, values: np.ndarray, runs: list[slice], relaxation: float
) -> tuple[np.ndarray, tuple[float, float]]:
    """Two levels over a common background: each in turn, until neither changes."""
    width = max(int(AVERAGING_TIME * relaxation), 1)
    background, half_periods = np.zeros(len(values)), 0
    levels = (0.0, 0.0)
    for _ in range(5):
        flat = values - background
        begins = stretches_of(runs, width)
        means = flat[begins[:, None] + np.arange(width)].mean(axis=1)
        first = np.append(True, np.diff(begins) != width)
        centre, spread, weights = _two_normals(means, first)
        low, high = np.argsort(centre)
        levels = (float(centre[low]), float(centre[high]))
        known = (begins[:, None] + np.arange(width)).ravel()
        share = np.interp(np.arange(len(values)), known, np.repeat(weights[:, high], width))
        found, number = background_of(recordings, values - (1 - share) * levels[0] - share * levels[1])
        unchanged = number == half_periods and np.abs(found - background).max() <= 0.01 * spread.min()
        background, half_periods = found, number
        if unchanged:
            break
    return background, levels


def _two_normals(series: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, ...]:
    """A hidden Markov model of two normal distributions: centres, spreads, and weights ``(n, 2)``."""
    centre = np.quantile(series, [0.1, 0.9])
    if not centre[1] > centre[0]:
        centre = np.array([series.min(), series.max()])
    spread = np.full(2, max(np.ptp(centre) / 4, 1e-12))
    transition = np.array([[0.95, 0.05], [0.05, 0.95]])
    smallest = 1e-3 * max(float(series.std()), 1e-300)  # a level of a single repeated value has no spread
    before = -np.inf
    weights = np.full((len(series), 2), 0.5)
    for _ in range(MOST_ITERATIONS):
        logs = -0.5 * ((series[:, None] - centre) / spread) ** 2 - np.log(spread)
        highest = logs.max(axis=1, keepdims=True)
        weights, pairs, likelihood = _forward_backward(np.exp(logs - highest), transition, first)
        likelihood += float(highest.sum())
        total = weights.sum(axis=0) + 1e-12
        centre = weights.T @ series / total
        spread = np.sqrt(np.maximum((weights * (series[:, None] - centre) ** 2).sum(axis=0) / total, 0))
        spread = np.maximum(spread, smallest)
        transition = (pairs + 1e-6) / (pairs + 1e-6).sum(axis=1, keepdims=True)
        if likelihood - before < 1e-6 * len(series) ** 0.5:
            break
        before = likelihood
    return centre, spread, weights


@machine_code
def _forward_backward(
    density: np.ndarray, transition: np.ndarray, first: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Probabilities of the two states at each time, expected transitions, and the log-likelihood."""
    count = len(density)
    forward = np.empty((count, 2))
    scale = np.empty(count)
    weights = np.empty((count, 2))
    pairs = np.zeros((2, 2))
    likelihood = 0.0
    for k in range(count):
        for j in range(2):
            if first[k]:
                prior = 0.5
            else:
                prior = forward[k - 1, 0] * transition[0, j] + forward[k - 1, 1] * transition[1, j]
            forward[k, j] = prior * density[k, j]
        scale[k] = max(forward[k, 0] + forward[k, 1], 1e-300)
        forward[k, 0] /= scale[k]
        forward[k, 1] /= scale[k]
        likelihood += np.log(scale[k])
    after = np.ones(2)
    for k in range(count - 1, -1, -1):
        if k + 1 == count or first[k + 1]:
            after[0], after[1] = 1.0, 1.0
        else:
            low = density[k + 1, 0] * after[0] / scale[k + 1]
            high = density[k + 1, 1] * after[1] / scale[k + 1]
            for i in range(2):
                pairs[i, 0] += forward[k, i] * transition[i, 0] * low
                pairs[i, 1] += forward[k, i] * transition[i, 1] * high
            one = transition[0, 0] * low + transition[0, 1] * high
            two = transition[1, 0] * low + transition[1, 1] * high
            after[0], after[1] = one, two
        weights[k, 0] = forward[k, 0] * after[0]
        weights[k, 1] = forward[k, 1] * after[1]
    return weights, pairs, likelihood


CONFIDENCE = 0.95  # of the intervals of mean dwell times


@dataclass(frozen=True)
class DwellCount:
    """How long a state lasts, as counted."""

    visits: int  #: seen to end, each by a hop
    time: float  #: spent in the state by all visits, in the unit of time

    @classmethod
    def of_visits(
        cls, t: np.ndarray, visits: np.ndarray, runs: list[slice], *, states: int = 2
    ) -> tuple[DwellCount, ...]:
        """Time spent in each state, and visits that ended in another, from the state at each sample.

        The first and the last visit of a run count with the time that was seen of them; only the last has no
        end.
        """
        spent, ended = np.zeros(states), np.zeros(states, dtype=int)
        for run in runs:
            inside, gaps = visits[run], np.diff(t[run])
            before, known = inside[:-1], inside[:-1] >= 0
            spent += np.bincount(before[known], weights=gaps[known], minlength=states)
            hops = known & (inside[1:] != before)
            ended += np.bincount(before[hops], minlength=states)
        return tuple(cls(int(n), float(time)) for n, time in zip(ended, spent, strict=True))

    @property
    def mean(self) -> float:
        """Mean dwell time; NaN where no visit ended."""
        return self.time / self.visits if self.visits else float("nan")

    @property
    def relative_error(self) -> float:
        """``1/√n``; infinite where no visit ended."""
        return float(1 / np.sqrt(self.visits)) if self.visits else float("inf")

    @property
    def limits(self) -> tuple[float, float]:
        """Interval of 95 % for exponential times; the upper end is infinite where no visit ended.

        The number of hops in a given time is Poisson's, so that ``2T/τ`` lies between quantiles of χ².
        """
        tail = (1 - CONFIDENCE) / 2
        upper = 2 * special.gammaincinv(self.visits + 1, 1 - tail)
        lower = 2 * special.gammaincinv(self.visits, tail) if self.visits else 0.0
        return float(2 * self.time / upper), float(2 * self.time / lower) if lower > 0 else float("inf")


def _counted_visits(values: np.ndarray, runs: list[slice], levels: tuple[float, float]) -> np.ndarray:
    """0 from where the lower level is reached, 1 from where the upper one is, -1 before: shape ``(n,)``."""
    return continued_visits(np.select([values >= levels[1], values <= levels[0]], [1, 0], -1), runs)


def continued_visits(core: np.ndarray, runs: list[slice]) -> np.ndarray:
    """Which core was entered last, at every sample of a run; a core ``(n,)`` is -1 where there is none."""
    visits = np.full(len(core), -1)
    for run in runs:
        part = core[run]
        last = np.maximum.accumulate(np.where(part >= 0, np.arange(len(part)), -1))
        visits[run] = np.where(last >= 0, part[np.maximum(last, 0)], -1)
    return visits


SURROGATES = 999  # for each state that is looked at: fewer could not be rare enough for all of them
ENOUGH_DEEPER = 20  # as deep as the record: the probability is then known to a fifth
MOST_POINTS = 8192  # of a series that surrogates are made of
BINS = 40  # of a histogram with a valley
DEGREE = 5  # of f in the test: two attractors that differ in depth and width need more than a cubic
STRETCH_TIMES = 40  # local relaxation times: shorter ones bias f towards one state, longer ones let drifts in
FEWEST_STRETCHES, SHORTEST_TIMES = 6, 10  # for so many stretches they may be as short as ten of these
LAG_SHARE = 0.1  # of the local relaxation time: over it a state hardly changes what pushes it
PLACES_COMPARED = 25  # at which f is compared with itself, between the quantiles
INNER_QUANTILE = 0.02  # the quantile from which on f is known well enough


def _pushed_apart(values: np.ndarray, runs: list[slice], relaxation: float) -> tuple[float, float] | None:
    """The largest ``(f(b) - f(a)) / error`` with a < b, and its probability where a single state attracts.

    `relaxation` is the local relaxation time in samples; None where there are too few stretches.
    """
    lag = max(int(LAG_SHARE * relaxation), 1)
    longest = sum(run.stop - run.start for run in runs) / (lag * FEWEST_STRETCHES) - 2
    rows = int(min(np.ceil(STRETCH_TIMES * relaxation / lag), longest))
    low, high = np.quantile(values, [0.001, 0.999])
    if rows * lag < SHORTEST_TIMES * relaxation or not high > low:
        return None
    begins = stretches_of(runs, (rows + 2) * lag, most=MOST_STRETCHES)
    if len(begins) < FEWEST_STRETCHES - 2:  # gaps cost some
        return None
    scaled = 2 * (values - low) / (high - low) - 1
    at = begins[:, None] + lag * np.arange(rows)
    now = np.clip(scaled[at], -1.2, 1.2)  # a polynomial has no business beyond
    increments = scaled[at + 2 * lag] - scaled[at + lag]
    terms = np.polynomial.legendre.legvander(now, DEGREE)[..., 1:]
    design = (terms - terms.mean(axis=1, keepdims=True)).reshape(-1, DEGREE)
    goal = (increments - increments.mean(axis=1, keepdims=True)).ravel()
    normal = design.T @ design
    if np.linalg.cond(normal) > 1e12:  # numerical: a record of hardly any different values
        return None
    inverse = np.linalg.inv(normal)
    coefficients = inverse @ design.T @ goal
    rest = goal - design @ coefficients
    # Each stretch is one draw: its residuals may depend on each other and on the state as they like.
    scores = (design * rest[:, None]).reshape(len(begins), rows, DEGREE).sum(axis=1)
    freedom = goal.size - len(begins) - DEGREE
    covariance = inverse * float(rest @ rest) / freedom
    if len(begins) >= 4 * DEGREE:
        robust = inverse @ (scores.T @ scores) @ inverse * len(begins) / (len(begins) - 1)
        # Not smaller than either in any direction in which they differ.
        root = np.linalg.cholesky(covariance)
        whitening = np.linalg.inv(root)
        values_of, vectors = np.linalg.eigh(whitening @ robust @ whitening.T)
        covariance = (root @ vectors * np.maximum(values_of, 1.0)) @ (root @ vectors).T
    places = np.linspace(
        np.quantile(now, INNER_QUANTILE), np.quantile(now, 1 - INNER_QUANTILE), PLACES_COMPARED
    )
    at_places = np.polynomial.legendre.legvander(places, DEGREE)[:, 1:]
    first, second = np.triu_indices(PLACES_COMPARED, k=1)
    contrasts = at_places[second] - at_places[first]
    errors = np.sqrt(np.einsum("ij,jk,ik->i", contrasts, covariance, contrasts))
    largest = float(np.max(contrasts @ coefficients / errors))
    return largest, float(special.fdtrc(DEGREE, freedom, max(largest, 0.0) ** 2 / DEGREE))


def _valley_between(
    values: np.ndarray,
    runs: list[slice],
    relaxation: float,
    *,
    generator: np.random.Generator | None,
    surrogates: int = SURROGATES,
) -> tuple[float, float]:
    """Share of the samples in the lesser peak of the histogram, and its probability among surrogates.

    Surrogates have random phases from `generator`; None makes none. No more are drawn once `ENOUGH_DEEPER` of
    them are as deep: then it is not rare (Besag and Clifford, Biometrika 78 (1991) 301).
    """
    every = max(int(relaxation / 4), -(-len(values) // MOST_POINTS), 1)
    levelled = values.copy()
    for run in runs:  # less a straight line in every stretch, the last of a run longer
        count = max((run.stop - run.start) // max(int(STRETCH_TIMES * relaxation), 2), 1)
        for rows in np.array_split(np.arange(run.start, run.stop), count):
            line = np.vander(np.linspace(-1, 1, len(rows)), 2)
            levelled[rows] -= line @ np.linalg.lstsq(line, values[rows], rcond=None)[0]
    parts = [levelled[run][::every] for run in runs if run.stop - run.start >= 4 * every]
    if not parts:
        return 0.0, 1.0
    seen = _valley(np.concatenate(parts))
    if seen <= 0 or generator is None:
        return seen, 1.0
    spectra = [(np.fft.rfft(part), len(part)) for part in parts]
    deeper = 0
    for number in range(surrogates):
        drawn = []
        for spectrum, size in spectra:
            turned = spectrum * np.exp(2j * np.pi * generator.random(len(spectrum)))
            turned[0] = spectrum[0]
            drawn.append(np.fft.irfft(turned, n=size))
        deeper += _valley(np.concatenate(drawn)) >= seen
        if deeper == ENOUGH_DEEPER:
            return seen, deeper / (number + 1)
    return seen, (1 + deeper) / (1 + surrogates)


def _valley(series: np.ndarray) -> float:
    low, high = np.quantile(series, [0.001, 0.999])
    if not high > low:
        return 0.0
    share = np.histogram(series, bins=BINS, range=(float(low), float(high)))[0] / len(series)
    above = np.maximum(share[:, None] - share, 0)  # bins by places of the valley
    left, right = np.tril(above.T, -1).sum(axis=1), np.triu(above.T, 1).sum(axis=1)
    return float(np.minimum(left, right).max())


SIGNIFICANCE = 0.01  # probability with which a single state is taken for two
DECISIVE_P = 1e-5  # probability for the first test from which on the second one is not asked
PULLED_TOGETHER = -3.0  # standard errors: where f falls so clearly between all places, one state attracts


@dataclass(frozen=True, eq=False)
class RecordStates:
    """Two states that recordings show by themselves, and the hops between them.

    Two are supported if the record is pushed apart, and was seen to hop at least once. Levels and counts have
    the lower one first. `as_data` leaves out what is of each sample.
    """

    state: str  #: the measured quantity that shows them best, as its file calls it
    unit: str | None  #: None where the file does not say
    time_unit: str | None
    supported: bool  #: whether the record supports two states at all
    probability: float  #: of so much with a single state over a drifting background, all tests counted
    levels: tuple[float, float]  #: in the unit of the state, of the record less its background
    counts: tuple[DwellCount, DwellCount]  #: how long each lasts
    edges: np.ndarray  #: (b + 1,): of the histogram of the state
    density: np.ndarray  #: (b,): per unit of the state
    #: (n,): 0 or 1 at each sample, -1 before the record has reached a level
    visits: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    #: (n,): what drifts slowly below both levels; zero where nothing does
    background: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, recordings: Recordings) -> RecordStates | None:
        """What recordings show; None where they are too short to tell anything, or have no noise."""
        return switching(recordings) if markov_lag(recordings).may_hop else None

    @property
    def transitions(self) -> int:
        """How many were seen, both ways."""
        return self.counts[0].visits + self.counts[1].visits

    def dwell_times(self) -> pd.DataFrame:
        """How long each state lasts, a row for each.

        Returns
        -------
        pandas.DataFrame
            Columns ``level visits mean_time lowest highest``: the level of the state; how many visits were
            seen to end; their mean in the unit of time, NaN where none ended, with its interval of 95 %.
        """
        import pandas as pd

        pairs = zip(self.levels, self.counts, strict=True)
        rows = [(level, one.visits, one.mean, *one.limits) for level, one in pairs]
        return pd.DataFrame(rows, columns=["level", "visits", "mean_time", "lowest", "highest"])

    def sentence(self) -> str:
        """The same in a sentence; empty where two states are not supported."""
        values = {
            "state": self.state, "unit": self.unit, "time_unit": self.time_unit, "levels": self.levels,
            "transitions": self.transitions, "means": [one.mean for one in self.counts],
            "limits": [one.limits for one in self.counts], "visits": [one.visits for one in self.counts],
        }  # fmt: skip
        return sentence(Remark("data.record_hops", values)) if self.supported else ""

    def as_data(self) -> dict[str, Any]:
        """As plain data, which `from_data` reads back."""
        kept = {name: value for name, value in vars(self).items() if name not in ("visits", "background")}
        counts = [vars(one) for one in self.counts]
        arrays = {"edges": self.edges.tolist(), "density": self.density.tolist()}
        return {**kept, "levels": list(self.levels), "counts": counts, **arrays}

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> RecordStates:
        """What `as_data` gave."""
        first, second = (DwellCount(**one) for one in data["counts"])
        arrays = {name: np.array(data[name], dtype=float) for name in ("edges", "density")}
        return cls(**{**data, "levels": tuple(data["levels"]), "counts": (first, second), **arrays})


def switching(recordings: Recordings) -> RecordStates | None:
    """The two states that the recordings show best; None where they are too short to tell anything.

    Every state is looked at by itself, and the one in which the record is pushed apart most clearly is taken.
    Where a background drifts slowly it is taken off the histogram, as it is off the levels.

    Examples
    --------
    >>> import numpy as np
    >>> from siq.data.correlation import markov_lag
    >>> from siq.data.recordings import Recordings
    >>> generator = np.random.default_rng(1)
    >>> x = np.empty((20_000, 1))
    >>> x[0] = 1.0
    >>> for before in range(len(x) - 1):
    ...     kick = np.sqrt(0.25 * 0.05) * generator.standard_normal()
    ...     x[before + 1] = x[before] + 0.05 * (x[before] - x[before] ** 3) + kick
    >>> found = switching(Recordings.from_arrays(0.05 * np.arange(len(x)), x, names=["x"]))
    >>> found.supported, [round(level, 1) for level in found.levels]
    (True, [-0.9, 0.8])
    """
    runs, generator = runs_of(recordings), np.random.default_rng(0)  # always the same surrogates
    tests: dict[int, tuple[float, float, float]] = {}  # probability, less the depth, relaxation
    for place, column in enumerate(recordings.values.T):
        relaxation = relaxation_samples(column, runs)
        if relaxation is None:  # too short, or a column that runs on like a clock
            continue
        pushed, chance = _pushed_apart(column, runs, relaxation) or (float("nan"), 1.0)
        clear = pushed < PULLED_TOGETHER or chance < DECISIVE_P
        depth, rarity = _valley_between(
            column, runs, relaxation, generator=None if clear else generator,
            surrogates=SURROGATES * recordings.values.shape[1],
        )  # fmt: skip
        tests[place] = (min(chance, rarity), -depth, relaxation)
    if not tests:
        return None
    state = min(tests, key=lambda place: tests[place][:2])
    probability, _, relaxation = tests[state]
    values = recordings.values[:, state]
    background, levels = _two_levels(recordings, values, runs, relaxation)
    flat = values - background
    visits = _counted_visits(flat, runs, levels)
    counts = DwellCount.of_visits(recordings.t, visits, runs)
    chance = min(2 * probability * len(tests), 1.0)
    density, edges = np.histogram(flat, bins=BINS, density=True)
    return RecordStates(
        recordings.titles[state], recordings.units[state], recordings.time_unit,
        chance < SIGNIFICANCE and any(one.visits for one in counts), chance, levels,
        (counts[0], counts[1]), edges, density, visits, background,
    )  # fmt: skip
