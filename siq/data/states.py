"""States of a record: whether it supports several, their levels, hops and residence times.

Nothing is identified here: this is what the numbers say before any f is known, and it holds where none is
found or certified. How many states there are, and where the record is in which, is the matter of
`siq.data.kinetics`; what these have in common is the background (`siq.data.stationarity.background_of`), and
each recording may have a baseline of its own.

*Hops* are counted from core to core: a visit begins where the record reaches the core of a state, and lasts
until it reaches that of another one. The mean residence time is the time of all visits, those that the record
cuts at its ends included, over the number of visits whose end was seen: the best estimate for exponential
times, with a relative error of ``1/√n``.

*Two tests.* A histogram with two peaks is no evidence: a slow background makes one of a single state. Two
states have a place between them from which the record is pushed away to both sides. The first test regresses
increments over a lag on polynomials of the state in stretches of forty local relaxation times, each with a
level of its own, which takes with it whatever drifts slowly. With the polynomial of the state,
``E[x(t + 2l) - x(t + l) | x(t)] = l·f(x(t))``, every difference f(b) - f(a) with a < b would be negative if a
single state attracted. The largest of them in standard errors counts, with Scheffé's bound for having looked
at all pairs. The second test asks for a valley of the histogram of any quantity, as it is or averaged, deeper
than in surrogates of the record with the same spectra and random phases, which are what a linear system could
have shown; quantities and averages are judged together. It is not asked where the first one is beyond doubt.
Several states are supported if one of the tests says so, a hop was seen, and the valley is none of the
floor of a flat well: it is told from none by the errors of the profile.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic_core import to_jsonable_python
from scipy import ndimage, sparse, special

from siq.data.correlation import FEWEST_VALUES, markov_lag, resolution_step
from siq.data.kinetics import CONFIDENCE, FALSE_WELL, MarkovModel, Profile, exponential, path_of, stays_of
from siq.data.recordings import Recordings
from siq.data.stationarity import (
    SHORTEST_STRETCH,
    background_of,
    change_of,
    correlated_samples,
    relaxation_samples,
    runs_of,
    stretches_of,
    usual_step,
)
from siq.errors import NumericalFailure
from siq.numerics.integration import machine_code
from siq.numerics.randomness import positive
from siq.remarks import Remark, sentence

if TYPE_CHECKING:
    import pandas as pd

FEWEST_HOPS = 5  # out of each state: fewer test no model of them


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
            ended += np.bincount(before[known & (inside[1:] != before)], minlength=states)
        return tuple(cls(int(n), float(time)) for n, time in zip(ended, spent, strict=True))

    @property
    def mean(self) -> float:
        """Mean dwell time; NaN where no visit ended."""
        return self.time / self.visits if self.visits else float("nan")

    @property
    def limits(self) -> tuple[float, float]:
        """Interval of 95 % for exponential times; the upper end is infinite where no visit ended.

        The number of hops in a given time is Poisson's, so that ``2T/τ`` lies between quantiles of χ².
        """
        tail = (1 - CONFIDENCE) / 2
        upper = 2 * special.gammaincinv(self.visits + 1, 1 - tail)
        lower = 2 * special.gammaincinv(self.visits, tail) if self.visits else 0.0
        return float(2 * self.time / upper), float(2 * self.time / lower) if lower > 0 else float("inf")


SURROGATES, FEWEST_SURROGATES = 999, 200
ENOUGH_DEEPER = 10  # of the fewest, as deep as the record: a valley is then not rare
AVERAGED_SHARES = (0.0, 0.5, 1.0)  # of the relaxation time, over which samples are averaged
FEWEST_POINTS = 4  # of a run, with a spectrum
MOST_POINTS = 8192  # of a series that surrogates are made of
BINS = 40  # of a histogram, at most
ATOM = 10  # a choice: with so many times the samples of the number next to it the last number is an end
FEWEST_BINS = 10  # in which a valley can be seen
DEGREES = (5, 9)  # of f in the test: two attractors that differ need more than a cubic, three more than that
STRETCH_TIMES = 40  # local relaxation times: shorter ones bias f towards one state, longer ones let drifts in
FEWEST_STRETCHES, SHORTEST_TIMES = 6, 10  # for so many stretches they may be as short as ten of these
LAG_SHARE = 0.1  # of the local relaxation time: over it a state hardly changes what pushes it
PLACES_COMPARED = 25  # at which f is compared with itself, between the quantiles
INNER_QUANTILE = 0.02  # the quantile from which on f is known well enough


def _pushed_apart(
    values: np.ndarray, runs: list[slice], relaxation: float, *, degree: int
) -> tuple[float, float]:
    """The largest ``(f(b) - f(a)) / error`` with a < b, and its probability where a single state attracts.

    `relaxation` is the local relaxation time in samples, `degree` that of f. Too few stretches tell nothing.
    """
    lag = max(int(LAG_SHARE * relaxation), 1)
    longest = sum(run.stop - run.start for run in runs) / (lag * FEWEST_STRETCHES) - 2
    rows = int(min(np.ceil(STRETCH_TIMES * relaxation / lag), longest))
    low, high = np.quantile(values, [0.001, 0.999])
    if rows * lag < SHORTEST_TIMES * relaxation or not high > low:
        return 0.0, 1.0
    begins = stretches_of(runs, (rows + 2) * lag)
    if len(begins) < FEWEST_STRETCHES - 2:  # gaps cost some
        return 0.0, 1.0
    scaled = 2 * (values - low) / (high - low) - 1
    at = begins[:, None] + lag * np.arange(rows)
    now = np.clip(scaled[at], -1.2, 1.2)  # a polynomial has no business beyond
    increments = scaled[at + 2 * lag] - scaled[at + lag]
    terms = np.polynomial.legendre.legvander(now, degree)[..., 1:]
    design = (terms - terms.mean(axis=1, keepdims=True)).reshape(-1, degree)
    goal = (increments - increments.mean(axis=1, keepdims=True)).ravel()
    normal = design.T @ design
    # Numerical: of a record of hardly any different values the inverse would have no digits.
    if np.linalg.cond(normal) > 1 / np.sqrt(np.finfo(float).eps):
        return 0.0, 1.0
    inverse = np.linalg.inv(normal)
    coefficients = inverse @ design.T @ goal
    rest = goal - design @ coefficients
    # Each stretch is one draw: its residuals may depend on each other and on the state as they like.
    scores = (design * rest[:, None]).reshape(len(begins), rows, degree).sum(axis=1)
    freedom = goal.size - len(begins) - degree
    covariance = inverse * float(rest @ rest) / freedom
    if len(begins) >= 4 * degree:
        robust = inverse @ (scores.T @ scores) @ inverse * len(begins) / (len(begins) - 1)
        # Not smaller than either in any direction in which they differ.
        root = np.linalg.cholesky(covariance)
        whitening = np.linalg.inv(root)
        values_of, vectors = np.linalg.eigh(whitening @ robust @ whitening.T)
        covariance = (root @ vectors * np.maximum(values_of, 1.0)) @ (root @ vectors).T
    places = np.linspace(
        np.quantile(now, INNER_QUANTILE), np.quantile(now, 1 - INNER_QUANTILE), PLACES_COMPARED
    )
    at_places = np.polynomial.legendre.legvander(places, degree)[:, 1:]
    first, second = np.triu_indices(PLACES_COMPARED, k=1)
    contrasts = at_places[second] - at_places[first]
    errors = np.sqrt(np.einsum("ij,jk,ik->i", contrasts, covariance, contrasts))
    largest = float(np.max(contrasts @ coefficients / errors))
    return largest, float(special.fdtrc(degree, freedom, max(largest, 0.0) ** 2 / degree))


def _valleys(
    values: np.ndarray, runs: list[slice], relaxations: Sequence[float], *, generator: np.random.Generator
) -> tuple[float, np.ndarray, np.ndarray]:
    """Valleys of the histograms of columns ``(n, d)``, against surrogates with random phases.

    Every column is looked at as it is, and as means over some shares of its relaxation time, in samples,
    which hardly any noise blurs. Surrogates turn the phases of all columns alike, which keeps spectra and
    cross-spectra. Returned are the probability of the rarest valley of all, or of as rare ones in all columns
    together (Westfall and Young, 1993: the least of probabilities that depend on each other is held against
    the same of each surrogate); the least of each column alone, ``(d,)``; and the largest share of its
    samples in a lesser peak, ``(d,)``.
    """
    every = -(-len(values) // MOST_POINTS)
    parts: list[list[np.ndarray]] = [[] for _ in runs]
    for one, relaxation in zip(values.T, relaxations, strict=True):
        # Levels of a digitiser are no peaks, which bins make of them that hold one level or two by turns.
        step = resolution_step(one) if len(np.unique(one)) >= FEWEST_VALUES else None
        if step is not None:
            one = one + step * (generator.random(len(one)) - 0.5)
        # As it is, and less a straight line in every stretch, the last of a run longer: slow hops need the
        # one, quick hops over a drift the other.
        levelled = one.copy()
        for run in runs:
            count = max((run.stop - run.start) // max(int(STRETCH_TIMES * relaxation), 2), 1)
            for rows in np.array_split(np.arange(run.start, run.stop), count):
                line = np.vander(np.linspace(-1, 1, len(rows)), 2)
                levelled[rows] -= line @ np.linalg.lstsq(line, one[rows], rcond=None)[0]
        for series, share in product((one - one.mean(), levelled), AVERAGED_SHARES):
            # What the sensor adds to each sample would fill the valley.
            width = max(int(share * relaxation), 1)
            for run, found in zip(runs, parts, strict=True):
                found.append(ndimage.uniform_filter1d(series[run], width, mode="nearest")[::every])
    columns = values.shape[1]
    # Rice's rule for so many bins as independent samples fill; each width has those of its column.
    bins = [
        int(np.clip(2 * (len(values) / (2 * time)) ** (1 / 3), FEWEST_BINS, BINS))
        for time in relaxations
        for _ in range(2 * len(AVERAGED_SHARES))
    ]
    depths: list[list[float]] = []
    for series in _surrogates([np.array(one) for one in parts], SURROGATES, generator=generator):
        depths.append(_valley_depths(series, bins))
        if (
            len(depths) > FEWEST_SURROGATES
            and (np.sum(depths[1:] >= np.array(depths[0]), axis=0) >= ENOUGH_DEEPER).all()
        ):
            break
    if not depths:
        return 1.0, np.ones(columns), np.zeros(columns)
    depth = np.array(depths)

    def rarity(extremes: np.ndarray) -> np.ndarray:
        """Of each row ``(n, k)``, the share of rows as extreme."""
        ranks = [np.searchsorted(np.sort(one), one, side="left") for one in extremes.T]
        return 1 - np.array(ranks).T / len(extremes)

    alone = rarity(depth).reshape(len(depth), columns, -1).min(axis=2)
    # One quantity may show the states, or all of them a little (Fisher's sum).
    either = np.column_stack([-np.log(alone.min(axis=1)), -np.log(alone).sum(axis=1)])
    least = rarity(either).min(axis=1)
    return float(np.mean(least <= least[0])), alone[0], depth[0].reshape(columns, -1).max(axis=1)


def _surrogates(
    parts: Sequence[np.ndarray], count: int, *, generator: np.random.Generator
) -> Iterator[np.ndarray]:
    """Columns ``(c, n)`` of a record, by those of its runs ``(c, m)``; then surrogates with random phases.

    Those of all columns are turned alike, and runs of one size together: there may be thousands.
    """
    sizes = dict.fromkeys(one.shape[1] for one in parts if one.shape[1] >= FEWEST_POINTS)
    spectra = {size: np.fft.rfft([one for one in parts if one.shape[1] == size]) for size in sizes}
    for number in range(count + 1 if spectra else 0):
        drawn = []
        for size, spectrum in spectra.items():
            turns = np.exp(2j * np.pi * generator.random((len(spectrum), 1, spectrum.shape[2])))
            turns[..., 0] = 1.0
            whole = np.fft.irfft(spectrum * turns if number else spectrum, n=size)
            drawn.append(whole.transpose(1, 0, 2).reshape(whole.shape[1], -1))
        yield np.concatenate(drawn, axis=1)


def _valley_depths(series: np.ndarray, bins: Sequence[int]) -> list[float]:
    """Of each row ``(c, n)``, in so many bins, the largest share of its samples in a lesser peak."""
    count = series.shape[1]
    limits = np.quantile(series, [0.001, 0.999], axis=1).T
    depths = []
    for row, number, (least, most) in zip(series, bins, limits, strict=True):
        if not most > least:
            depths.append(0.0)
            continue
        inside = _histogram(row, np.linspace(least, most, number + 1))
        above = np.maximum(inside[:, None] - inside, 0).cumsum(axis=0)  # bins by places of the valley
        left = above.diagonal()
        depths.append(float(np.minimum(left, above[-1] - left).max()) / count)
    return depths


@machine_code
def _histogram(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """How many values lie between each of equally spaced edges and the next; the last is of its bin."""
    bins, least, most = len(edges) - 1, edges[0], edges[-1]
    counts = np.zeros(bins, dtype=np.int64)
    for value in values:
        if least <= value <= most:
            place = min(int((value - least) * (bins / (most - least))), bins - 1)
            while value < edges[place]:  # by rounding
                place -= 1
            while place < bins - 1 and value >= edges[place + 1]:
                place += 1
            counts[place] += 1
    return counts


SIGNIFICANCE = 0.01  # probability with which a single state is taken for several
DECISIVE_P = 1e-5  # probability for the first test from which on the second one is not asked
MOST_PASSES = 10  # over states and background, each in turn, and of the search for baselines
SETTLED_BACKGROUND = 0.01  # of the spread of a state
FALSE_OFFSET_RATE = 1e-3  # probability with which recordings with one baseline are given one each
LAGS_COMPARED, MOST_COMPARED = 8, 100_000  # up to the relaxation time; samples
MOST_COLUMNS = 3  # in which states are sought together: neighbours are far away in more


@dataclass(frozen=True, eq=False)
class RecordStates:
    """States that recordings show by themselves, the hops between them, and how far these can be relied on.

    The states are supported if a single one is refused, and the record was seen to hop at least once. The
    `rung` is what the record supports: 0 a single state; 1 states with counted stays; 2 their profile, too,
    since the record is stationary; 3 a Markov model of the hops, too. `as_data` leaves out what is of each
    sample.
    """

    state: str  #: the measured quantity that shows them best, as its file calls it
    unit: str | None  #: None where the file does not say
    time_unit: str | None
    supported: bool  #: whether the record supports several states at all
    probability: float  #: of so much with a single state over a drifting background, all tests counted
    #: of each state, in the unit of the quantity, of the record less its background
    levels: tuple[float, ...]
    counts: tuple[DwellCount, ...]  #: how long each lasts
    edges: np.ndarray  #: (b + 1,): of the histogram of the state
    density: np.ndarray  #: (b,): per unit of the state
    #: (n,): the state at each sample, -1 before the record has reached one
    visits: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    #: (n,): what drifts slowly below all levels; zero where nothing does
    background: np.ndarray = field(default_factory=lambda: np.zeros(0))
    rung: int = 0
    limit: Remark | None = None  #: why the next rung is out of reach, and what would help
    columns: tuple[str, ...] = ()  #: measured quantities in which they were sought
    places: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  #: (k, d): of the states in these
    hops: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  #: (k, k): seen from state to state
    exponential: tuple[bool | None, ...] = ()  #: whether stays are; None of too few to tell
    stays: tuple[np.ndarray, ...] = ()  #: lengths of the visits to each state, in the unit of time
    profile: Profile | None = None
    markov: MarkovModel | None = None  #: in the unit of time
    offset: float = 0.0  #: the range of the baselines of the recordings; 0 where these do not differ
    #: (n,): the baseline of each sample's recording, less their mean; zero where these do not differ
    baseline: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, recordings: Recordings) -> RecordStates | None:
        """What recordings show; None where they are too short to tell anything, or have no noise."""
        return switching(recordings) if markov_lag(recordings).may_hop else None

    @property
    def transitions(self) -> int:
        """How many were seen, all ways together."""
        return sum(one.visits for one in self.counts)

    def dwell_times(self) -> pd.DataFrame:
        """How long each state lasts, a row for each.

        Returns
        -------
        pandas.DataFrame
            Columns ``level share visits mean_time lowest highest exponential markov_time markov_lowest
            markov_highest``: the level of the state; its share of the time; how many visits were seen to end;
            their mean in the unit of time, NaN where none ended, with its interval of 95 %; whether they are
            spread as exponential times; and the same mean by the Markov model, which allows for hops that
            were too quick to see, NaN without one.
        """
        import pandas as pd

        whole = sum(one.time for one in self.counts) or np.nan
        markov = np.full((len(self.counts), 3), np.nan) if self.markov is None else self.markov.stays
        exponential = self.exponential or (None,) * len(self.counts)
        rows = [
            (level, one.time / whole, one.visits, one.mean, *one.limits, law, *model)
            for level, one, law, model in zip(self.levels, self.counts, exponential, markov, strict=True)
        ]
        names = (
            "level share visits mean_time lowest highest exponential markov_time markov_lowest markov_highest"
        )
        return pd.DataFrame(rows, columns=names.split())

    def remark(self) -> Remark:
        """What was found as a remark."""
        model = [] if self.markov is None else self.markov.stays.tolist()
        # Neighbours in one bin, as where values are spread over decades, have no top between them.
        tops = np.zeros((0, 4)) if self.profile is None or len(self.columns) > 1 else self.profile.tops
        apart = any(high < one.limits[0] for (_, _, high), one in zip(model, self.counts, strict=False))
        places = self.places if self.places.size else np.array(self.levels)[:, None]
        # Three digits, and as many more as all places have in common.
        common = np.log10(np.abs(places).max(axis=0) / positive(np.ptp(places, axis=0)))
        values = {
            "columns": self.columns or (self.state,), "unit": self.unit, "time_unit": self.time_unit,
            "places": places.tolist(), "levels": self.levels,
            "digits": np.maximum(np.ceil(common).astype(int) + 2, 3).tolist(),
            "transitions": self.transitions, "means": [one.mean for one in self.counts],
            "limits": [one.limits for one in self.counts], "visits": [one.visits for one in self.counts],
            "rung": self.rung, "lag": None if self.markov is None else self.markov.lag,
            "tops": tops.tolist() if tops[:, ::2].all() else [],
            "offset": self.offset, "missed": model if apart else [],
        }  # fmt: skip
        return Remark("data.record_hops", values)

    def rest(self) -> Remark:
        """What a record without several states shows: where it is nearly always."""
        share = np.append(0, np.cumsum(self.density * np.diff(self.edges)))
        low, high = np.interp([(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], share, self.edges)
        values = {"state": self.state, "unit": self.unit, "low": float(low), "high": float(high)}
        peaks = sorted(self.levels) if self.probability < SIGNIFICANCE and self.transitions else []
        return Remark("data.record_rests", {**values, "peaks": peaks, "changes": self.transitions})

    def sentence(self) -> str:
        """What was found in a sentence; empty where only one state is supported."""
        limit = "" if self.limit is None else " " + sentence(self.limit)
        return sentence(self.remark()) + limit if self.supported else ""

    def as_data(self) -> dict[str, Any]:
        """As plain data, which `from_data` reads back; what is no number is None, as JSON has none."""
        kept = {
            name: value
            for name, value in vars(self).items()
            if name not in ("visits", "background", "baseline")
        }
        kept |= {
            name: None if (one := kept[name]) is None else one._asdict() for name in ("profile", "markov")
        }
        return dict(to_jsonable_python(kept, inf_nan_mode="null", fallback=lambda value: value.tolist()))

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> RecordStates:
        """What `as_data` gave."""
        data = dict(data)
        for name, kind in (("profile", Profile), ("markov", MarkovModel)):
            if (one := data[name]) is not None:
                arrays: dict[str, Any] = {
                    key: _array(value) if isinstance(value, list) else value for key, value in one.items()
                }
                data[name] = kind(**arrays)
        data |= {name: tuple(data[name]) for name in ("levels", "columns", "exponential")}
        data |= {name: _array(data[name]) for name in ("edges", "density", "places", "hops")}
        data["counts"] = tuple(DwellCount(**one) for one in data["counts"])
        data["stays"] = tuple(map(_array, data["stays"]))
        data["limit"] = None if data["limit"] is None else Remark.from_data(data["limit"])
        return cls(**data)


def _array(values: Any) -> np.ndarray:
    return np.array(values, dtype=float)  # None is read as NaN


def switching(recordings: Recordings, *, rungs: bool = True) -> RecordStates | None:
    """The states that the recordings show by themselves; None where they are too short to tell anything.

    Every quantity is looked at by itself, and the one in which a single state is refused most clearly is
    taken for levels and histogram; states are sought in up to three together. Where a background drifts
    slowly, or recordings differ in their baselines, it is taken off.

    Parameters
    ----------
    recordings
        What was measured.
    rungs
        Whether profile and Markov model are worked out, too.

    Examples
    --------
    >>> import numpy as np
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
    runs = runs_of(recordings, bridged=True)
    generator = np.random.default_rng(0)  # always the same surrogates
    relaxations = {
        place: time
        for place, one in enumerate(recordings.values.T)
        if (time := relaxation_samples(one, runs)) is not None  # too short, or it runs on like a clock
    }
    if not relaxations:
        return None
    tried, recorded = list(relaxations), recordings.values
    # Less baselines, and less what a drift in one direction would have moved it by: hops may hide that.
    drifts = np.zeros((2, *recorded.shape))
    for place, time in relaxations.items():
        one = recorded[:, [place]]
        drifts[:, :, [place]] = _baselines(recordings, one, one, int(np.ceil(time / 2)))
        drifts[1, :, place] += background_of(recordings, recorded[:, place], functions=1)
    apart = np.array(
        [
            [
                [_pushed_apart(series[:, place], runs, time, degree=degree) for degree in DEGREES]
                for series in recorded - drifts
            ]
            for place, time in relaxations.items()
        ]
    )
    pushed, count = apart[..., 1].min(axis=(1, 2)), 2 * len(DEGREES) * len(tried)
    chance = count * float(pushed.min())
    rarest, rarities, depths = 1.0, np.ones(len(tried)), np.zeros(len(tried))
    if chance >= DECISIVE_P:
        rarest, rarities, depths = _valleys(
            (recorded - drifts[0])[:, tried], runs, list(relaxations.values()), generator=generator
        )
    kinds = 2 if apart[..., 0].any() else 1  # too few stretches make no test of the first kind
    probability = min(kinds * min(chance, rarest), 1.0)
    # Surrogates tell probabilities to a factor: of those of one size the deepest valley counts.
    size = np.round(np.log10(np.maximum(np.minimum(pushed, rarities), np.finfo(float).tiny)))
    order = sorted(range(len(tried)), key=lambda one: (size[one], -depths[one]))
    columns, state = sorted(tried[one] for one in order[:MOST_COLUMNS]), tried[order[0]]
    values, column = recordings.values[:, columns], columns.index(state)
    relaxation = min(relaxations[place] for place in columns)
    chances = count * apart[[tried.index(place) for place in columns], :, :, 1].min(axis=2)
    # What looks like a drift may be a few hops.
    drifting = ((chances >= SIGNIFICANCE) == [True, False]).all(axis=1).astype(int)
    background, baseline = drifts[drifting, :, columns].T, np.zeros_like(values)
    places, path, expected = np.median(values, axis=0)[None], np.zeros(len(values), dtype=int), None
    wells, levels = 1, 0
    for _ in range(MOST_PASSES if probability < SIGNIFICANCE else 0):
        flat = values - background
        places, path, expected, wells, levels = path_of(flat, runs, relaxation, column=column)
        level = np.where(path[:, None] >= 0, places[path], np.median(flat, axis=0))
        slow = np.array([background_of(recordings, one) for one in (values - level).T]).T
        baseline = _baselines(recordings, values - slow, values - level - slow, int(np.ceil(relaxation / 2)))
        moved = slow + baseline - background
        background = slow + baseline
        if (np.abs(moved).max(axis=0) <= SETTLED_BACKGROUND * (values - level).std(axis=0)).all():
            break
    number = len(places)
    counts = DwellCount.of_visits(recordings.t, path, runs, states=number)
    # A valley that is deeper than a linear system's may be the floor of one flat well; levels are apart.
    wanted = kinds * count * pushed[order[0]] >= SIGNIFICANCE
    supported = probability < SIGNIFICANCE and any(one.visits for one in counts)
    own = values[:, column] - background[:, column]
    if supported and _crossed_as_often(own, places[:, column], runs, relaxation) >= SIGNIFICANCE:
        # What swings from one to the other is driven, and no linear noise.
        supported = bool(np.isfinite(change_of(recordings, own, path, held=levels) or np.inf))
    profile = Profile.of(own, runs, path, places[:, column]) if supported else None
    if profile is not None and wanted and wells == 1 and not levels:
        supported = bool((profile.tops[:, ::2] > FALSE_WELL * profile.tops[:, 1::2]).all())
    if not supported:  # what was taken for hops may be a drift
        background[:] = 0.0
        background[:, column] = background_of(recordings, values[:, column])
        own = values[:, column] - background[:, column]
    density, edges = np.histogram(own, bins=BINS, density=True)
    lengths, hops = stays_of(path, runs, number), np.zeros((number, number))
    for part in (path[run][path[run] >= 0] for run in runs):
        turns = np.flatnonzero(np.diff(part))
        np.add.at(hops, (part[turns], part[turns + 1]), 1)
    steps = np.concatenate([np.diff(recordings.t[run]) for run in runs])  # with what is missing in between
    step = float(steps.mean()) if len(steps) else usual_step(recordings)
    found = RecordStates(
        recordings.titles[state], recordings.units[state], recordings.time_unit, supported, probability,
        tuple(map(float, places[:, column])), counts, edges, density, path, background[:, column],
        int(supported), columns=tuple(recordings.titles[one] for one in columns), places=places,
        exponential=exponential(path, runs, number, 0 if levels else int(np.ceil(relaxation))),
        offset=float(np.ptp(baseline[:, column])), baseline=baseline[:, column],
        stays=tuple(step * one for one in lengths), hops=hops,
    )  # fmt: skip
    if not rungs or not supported:
        return found
    if (period := change_of(recordings, own, path, held=levels)) is not None:
        known = step * period if np.isfinite(period) else None
        return replace(
            found, limit=Remark("data.not_stationary", {"period": known, "unit": recordings.time_unit})
        )
    numbers, times = np.unique(values[:, column], return_counts=True)
    for end, next_to_it in ((0, 1), (-1, -2)):
        if len(numbers) > BINS and times[end] > max(len(values) / BINS, ATOM * times[next_to_it]):
            told = {"state": found.state, "value": float(numbers[end]), "unit": found.unit or ""}
            told["share"] = float(times[end] / len(values))
            return replace(found, limit=Remark("data.clipped", told))
    found = replace(found, rung=2, profile=profile)
    if min(one.visits for one in counts) < FEWEST_HOPS:
        return replace(found, limit=Remark("data.few_hops", {"fewest": FEWEST_HOPS}))
    if sparse.csgraph.connected_components(found.hops, connection="strong")[0] > 1:
        return replace(found, limit=Remark("data.states_apart"))
    try:
        model = MarkovModel.of(path, runs, number, expected)
    except NumericalFailure:
        return replace(found, limit=Remark("data.few_hops"))
    if model is None:
        return replace(found, limit=Remark("data.not_markov"))
    model = model._replace(lag=step * model.lag, stays=step * model.stays, rates=model.rates / step)
    return replace(found, rung=3, markov=model, limit=Remark("data.levels_alone") if levels else None)


def _crossed_as_often(values: np.ndarray, levels: np.ndarray, runs: list[slice], relaxation: float) -> float:
    """The probability that a linear process crosses boundaries between levels as seldom as values ``(n,)``.

    A histogram with two peaks may be the sensor's, or of samples that are drawn anew each time. So surrogates
    keep it, and the spectrum of the normal scores: they are linear, seen through any monotone function.
    """
    draw, values = np.random.default_rng(0), values[:MOST_COMPARED]
    # Equal values, of a sensor that clips, are no noise: means over more and more samples around them, as
    # integers, tell them apart. Of levels alone nothing else is known.
    ranks = [np.unique(values, return_inverse=True)[1]]
    told = ranks[0].max() >= FEWEST_VALUES
    for width in 3 ** np.arange(int(np.log(len(values)) / np.log(3)) if told else 0):
        wider = ranks[-1].copy()
        for run in runs:
            wider[run] += np.roll(ranks[-1][run], width) + np.roll(ranks[-1][run], -width)
        ranks.append(wider)
    scores, order = np.empty(len(values)), np.lexsort((draw.random(len(values)), *ranks[::-1]))
    scores[order] = special.ndtri((np.arange(len(values)) + 0.5) / len(values))
    levels, lags = np.sort(levels), np.unique(np.geomspace(1, max(relaxation, 1), LAGS_COMPARED).astype(int))
    below = [np.mean(values <= one) for one in (levels[1:] + levels[:-1]) / 2]
    places = special.ndtri(np.clip(below, 1 / len(values), 1 - 1 / len(values)))[:, None]
    parts, counts = [scores[None, run] for run in runs if run.start < len(values)], []
    for series in _surrogates(parts, FEWEST_SURROGATES, generator=draw):
        above = series > places
        counts.append(np.concatenate([(above[:, lag:] != above[:, :-lag]).sum(axis=1) for lag in lags]))
    largest = ((np.mean(counts[1:], axis=0) - counts) / positive(np.std(counts[1:], axis=0))).max(axis=1)
    return float(np.mean(largest[1:] >= largest[0]))


def _baselines(recordings: Recordings, values: np.ndarray, rest: np.ndarray, lag: int) -> np.ndarray:
    """What recordings differ by, ``(n, d)``; zero where they do by chance alone.

    Told by the mean of ``rest``, which states leave of ``values``, or by steps over ``lag`` samples, the mean
    of which is one function of what a baseline leaves of ``values``: then it does not count how long a
    recording stays near the tops between states. Whichever has the smaller errors counts.
    """
    labels, number, found = recordings.recording, len(recordings.labels), np.zeros_like(rest)
    if number < 2:
        return found
    whole, apart = runs_of(recordings, bridged=True), 1 + len(labels) // MOST_COMPARED
    starts = [np.arange(run.start, run.stop - lag, apart) for run in whole]
    begins, ends = np.concatenate(starts), np.cumsum([0, *map(len, starts)])
    counts, which = np.bincount(labels, minlength=number), labels[begins]
    told_by_steps = np.bincount(which, minlength=number)[counts > 0].min() > SHORTEST_STRETCH
    chosen = sparse.eye_array(number, format="csr")[which]
    runs = [slice(*one) for one in pairwise(ends) if one[0] < one[1]]
    centred = np.eye(number) - counts / positive(counts.sum())
    for place, series in enumerate(values.T):
        steps, of_states = series[begins + lag] - series[begins], rest[:, place]
        means = [np.bincount(labels, one, number) / np.maximum(counts, 1) for one in (of_states, series)]
        inside = of_states - means[0][labels]
        error = inside.var() * 2 * correlated_samples(inside, whole) / np.maximum(counts, 1)
        least, told = np.inf, [(centred @ means[0], centred @ np.diag(error) @ centred.T)]
        # States may be taken for each other: the search begins at no baselines, and at all means, too.
        for offsets in (np.zeros(number), *means) if told_by_steps else ():
            for _ in range(MOST_PASSES):
                x = series[begins] - offsets[which]
                x = (2 * x - x.max() - x.min()) / (scale := positive(np.ptp(x)))
                basis = np.polynomial.legendre.legvander(x, max(DEGREES))
                squares, of_mean = basis.T @ basis, basis.T @ steps
                slope = -2 / scale * np.polynomial.Legendre(np.linalg.lstsq(squares, of_mean)[0]).deriv()(x)
                mixed = chosen.T @ (slope[:, None] * basis)
                normal = np.block([[squares, mixed.T], [mixed, np.diag(chosen.T @ slope**2)]])
                inverse = np.linalg.pinv(normal, hermitian=True)
                mean, moved = np.split(inverse @ [*of_mean, *(chosen.T @ (slope * steps))], [len(squares)])
                offsets = centred @ (offsets + moved)
                if np.abs(centred @ moved).max() <= SETTLED_BACKGROUND * series.std():
                    break
            error = steps - basis @ mean - slope * moved[which]
            independent = len(error) / (2 * correlated_samples(error, runs))
            gained = independent * np.log(least / positive(error.var()))
            # Recordings moved apart share no steps that could tell; twice the variance is a choice.
            moved_apart = (series - offsets[labels]).var() > 2 * series.var()
            if moved_apart or gained <= 2 * np.log(1 / FALSE_OFFSET_RATE):
                continue
            least, score = error.var(), slope * error
            spread = score.var() / positive(np.mean(slope**2)) * 2 * correlated_samples(score, runs)
            covariance = spread * centred @ inverse[len(squares) :, len(squares) :] @ centred.T
            told[1:] = [(offsets, covariance)]
        offsets, covariance = min(told, key=lambda one: float(np.trace(one[1])))
        chi_squared = offsets @ np.linalg.pinv(covariance, hermitian=True) @ offsets
        if special.chdtrc((counts > 0).sum() - 1, chi_squared) < FALSE_OFFSET_RATE:
            found[:, place] = offsets[labels]
    return found
