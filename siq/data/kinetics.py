"""States of a record of any number, their profile, and a Markov model of the hops between them.

*How many.* Where hops are quick against everything else, each state is a level with white noise about it, and
a hidden Markov model of normal distributions with so many states as leave white residuals is the record's
(deeptime). Otherwise states are the wells of the density: maxima that stand above the saddle to any higher
one by more than its error. The density at a sample is that of its nearest neighbours, of which so many are
independent as the relaxation time leaves, and wells are joined in the order of their density (persistence).

*Profile.* ``-log p`` along a state is the free energy in units of kT, or of ε. A bin is visited as often as
the correlation time of its own indicator leaves independent samples, which gives the error.

*Markov model.* From the hops along the path, ``P(τ)`` for lags τ (deeptime), with draws from its posterior.
A lag is long enough where ``P(τ)^m`` foresees ``P(mτ)`` (Chapman and Kolmogorov), and the shortest one is
taken. Times between hops follow from the generator ``log P(τ)/τ``, which allows for hops that were too quick
to see.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import ndimage, sparse, special
from scipy.spatial import cKDTree

from siq.data.correlation import resolution_step
from siq.data.stationarity import MOST_RUNS, WHITE_CORRELATION, correlated_samples
from siq.errors import NumericalFailure
from siq.numerics.randomness import positive

MOST_STATES = 6  # looked for
MOST_SAMPLES = 20_000  # from which their number is told, where they are levels with white noise
SMOOTH = 0.5  # a correlation of neighbours: no white noise about a level leaves as much
AVERAGING_TIME = 0.5  # of the local relaxation time: of samples, before wells are sought
MOST_NODES = 4000  # samples at which the density is estimated
FALSE_WELL = 3.5  # standard errors by which a well has to stand out: of the many saddles none does by chance
LEAST_NEIGHBOURS = 16  # independent ones: a density is then known to a quarter
NO_VARIANCE = 1e-6  # of columns that repeat each other
LINKS = 24  # neighbours that a sample is linked with
LOWEST_SINC = -0.217  # of sin(x)/x, the memory of noise behind an ideal low-pass filter
MOST_FILTERED = 20  # samples in which the memory of a filter is sought; beyond half of them there is none
MOST_ITERATIONS = 200  # of a hidden Markov model
DRAWS = 200  # of the transition matrix: ends of intervals are then known to a tenth of their width
REFUSED = 0.01  # probability with which a Markov process is refused at a lag
CONFIDENCE = 0.95
PROFILE_BINS = 40
OUTSIDE = 0.001  # of the samples on either side: a few outliers would make the rest one bin
FEWEST_BINS = 4  # a parabola through three knows no error
FEWEST_STAYS = 10  # from which their distribution is told
FORGOTTEN_STAYS = 4  # after so many of the longest a Markov process hardly knows where it began
# Standard errors by which a shape of 2 is away from that of exponential stays: refused at one per cent
# nine times in ten.
REGULAR = 2.58 + 1.28


def _wells_of(values: np.ndarray, relaxation: float, *, visited: bool = False) -> np.ndarray:
    """Places of the wells of the density of points ``(n, d)``, a row for each: shape ``(k, d)``.

    With `visited`, densities at a well and at its saddle have the errors of the visits to each, which may be
    far more at the saddle, and not all those of the relaxation.
    """
    scale = np.maximum(values.std(axis=0), np.finfo(float).tiny)
    every = -(-len(values) // MOST_NODES)
    nodes = (values[::every] - values.mean(axis=0)) / scale
    # Along a ridge distances would grow as in one dimension: columns are scaled until none is correlated.
    variance, turned = np.linalg.eigh(nodes.T @ nodes / len(nodes))
    nodes = nodes @ turned / np.sqrt(np.maximum(variance, NO_VARIANCE))
    count, dimension = nodes.shape
    together = max(2 * relaxation / every, 1.0)
    independent = max((count / together) ** (4 / (4 + dimension)) / 4, LEAST_NEIGHBOURS)
    neighbours = int(min(independent * together, count // 4))
    if neighbours < LEAST_NEIGHBOURS:
        return np.median(values, axis=0)[None]
    distance, near = cKDTree(nodes).query(nodes, k=neighbours + 1)
    density = -dimension * np.log(np.maximum(distance[:, -1], np.finfo(float).tiny))
    needed = FALSE_WELL * np.sqrt(2 * together / neighbours)
    linked = near[:, 1 :: max(neighbours // LINKS, 1)] if dimension == 1 else near[:, 1 : LINKS + 1]
    parent, height, links = [-1] * count, density.tolist(), linked.tolist()

    def top(node: int) -> int:
        while parent[node] != node:
            node = parent[node]
        return node

    def error(node: int) -> float:
        inside = np.zeros(count)
        inside[near[node]] = 1.0
        return float(np.sqrt(2 * correlated_samples(inside, [slice(0, count)]) / neighbours))

    for node in np.argsort(-density).tolist():
        tops = sorted(
            {top(other) for other in links[node] if parent[other] >= 0}, key=lambda one: -height[one]
        )
        parent[node] = tops[0] if tops else node
        for lower in tops[1:]:
            depth = height[lower] - height[node]
            if depth < needed or (visited and depth < FALSE_WELL * np.hypot(error(lower), error(node))):
                parent[lower] = tops[0]
    well = np.array([top(node) for node in range(count)])
    kept = [one for one in np.unique(well) if (well == one).sum() >= neighbours / 2]
    places = np.array([np.median(values[::every][well == one], axis=0) for one in kept])
    return places[np.lexsort(places.T[::-1])]


def _wells_apart(values: np.ndarray, runs: list[slice]) -> np.ndarray:
    """Wells ``(k, 1)`` of a series ``(n, 1)``: peaks of its histogram, if valleys tell them from the others.

    A state that is rare, and visited often, has neighbours enough in a bin, and not in all of the record.
    """
    from scipy.signal import find_peaks  # which brings all of scipy.stats, half a second to import

    counts, edges = np.histogram(values, PROFILE_BINS, np.quantile(values, [OUTSIDE, 1 - OUTSIDE]).tolist())
    padded = np.concatenate([[0], counts, [0]]) + 0.5
    peaks, shape = find_peaks(np.log(padded), prominence=0.0)
    valleys = np.maximum(padded[shape["left_bases"]], padded[shape["right_bases"]])
    # With errors as if all samples were independent: what these do not tell, nothing does.
    peaks = peaks[shape["prominences"] > FALSE_WELL * np.sqrt(1 / padded[peaks] + 1 / valleys)]
    wells = ((edges[1:] + edges[:-1]) / 2)[peaks - 1, None]
    # Pulses of one shape have a peak wherever one is sampled, and are at the next place a sample later.
    if len(wells) > 1:
        near = np.abs(values - wells.T).argmin(axis=1)
        first, then = np.concatenate([np.stack([near[run][:-1], near[run][1:]]) for run in runs], axis=1)
        held = np.bincount(first, weights=first == then, minlength=len(wells))
        wells = wells[held > 0.5 * np.bincount(first, minlength=len(wells))]
    while len(wells) > 1:
        path, _ = _path_between(values, runs, wells)
        profile = Profile.of(values[:, 0], runs, path, wells[:, 0])
        depth, error = profile.tops[:, ::2], profile.tops[:, 1::2]
        least = (depth / error).min(axis=1)
        place = int(least.argmin())
        if least[place] > FALSE_WELL:
            break
        wells = np.delete(wells, place if depth[place, 0] < depth[place, 1] else place + 1, axis=0)
    return wells


def _path_between(values: np.ndarray, runs: list[slice], wells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The path ``(n,)`` from core to core of wells ``(k, d)``, and the median of what is nearest to each."""
    distance = np.linalg.norm((values[:, None] - wells) / positive(values.std(axis=0)), axis=2)
    near = distance.argmin(axis=1)
    core = np.where(distance[np.arange(len(near)), near] <= _medians(distance, near)[near], near, -1)
    return continued_visits(core, runs), _places(values, near, len(wells))


class _Levels(NamedTuple):
    """A hidden Markov model of normal distributions about levels."""

    centre: np.ndarray  # (k,), rising
    spread: np.ndarray  # (k,)
    weights: np.ndarray  # (n, k): probability of each state at each sample; zero where there is none
    path: np.ndarray  # (n,): the likeliest, -1 where there is none
    counts: np.ndarray  # (k, k): expected transitions

    def left(self, series: np.ndarray, runs: list[slice], *, every: int = 1) -> tuple[float, float]:
        """What levels leave of a series: its share of the covariance of neighbours, and their correlation."""
        moved, rest = np.where(self.path >= 0, series - float(series.mean()), 0.0), self.rest(series)
        whole, left = (
            sum(float(one[run][:-every] @ one[run][every:]) for run in runs) for one in (moved, rest)
        )
        return left / max(whole, 1e-300), left / max(float(rest @ rest), 1e-300)

    def rest(self, series: np.ndarray) -> np.ndarray:
        """What levels leave of a series ``(n,)``, zero where there is none."""
        own = self.weights.T @ series / np.maximum(self.weights.sum(axis=0), 1e-300)
        return np.where(self.path >= 0, series - self.weights @ own, 0.0)

    def filtered(self, series: np.ndarray, runs: list[slice]) -> int:
        """From how many samples on the noise about the levels is white, 1 where no filter correlates it.

        What relaxes forgets the same share in every step. A filter before sampling forgets little at first,
        then all; what falls below the memory of an ideal one swings by itself.
        """
        rest = self.rest(series)
        sums = [
            sum(float(rest[run][: -k or None] @ rest[run][k:]) for run in runs if run.stop - run.start > k)
            for k in range(MOST_FILTERED + 1)
        ]
        if not sums[0] > 0:  # nothing but the levels
            return 1
        memory = np.array(sums) / sums[0]
        from_here = 1 + int(np.flatnonzero(np.abs(memory) >= WHITE_CORRELATION)[-1])
        error = FALSE_WELL / np.sqrt(len(series))
        quick = memory[2] < memory[1] ** 2 - 2 * error and memory.min() > LOWEST_SINC - error
        return from_here if quick and 2 * from_here <= MOST_FILTERED else 1


def _levels_of(
    series: np.ndarray, runs: list[slice], centre: np.ndarray, *, every: int = 1
) -> _Levels | None:
    """Levels of a series ``(n,)``, from a first guess ``(k,)``, by deeptime's hidden Markov model.

    None where it is degenerate. With `every`, only one of so many samples is looked at, and stands for those
    up to the next.
    """
    from deeptime.markov.hmm import GaussianOutputModel, HiddenMarkovModel, MaximumLikelihoodHMM
    from deeptime.markov.msm import MarkovStateModel

    states, scale = len(centre), max(float(series.std()), 1e-300)
    shift, near = float(series.mean()), np.abs(series[:, None] - centre).argmin(axis=1)
    spread = [
        max(float(series[near == k].std() if (near == k).any() else 0.0), 1e-2 * scale) for k in range(states)
    ]
    transition = np.full((states, states), 0.1 / states) + 0.9 * np.eye(states)
    guess = HiddenMarkovModel(
        MarkovStateModel(transition),
        GaussianOutputModel(states, (centre - shift) / scale, np.array(spread) / scale),
        initial_distribution=np.full(states, 1 / states),
    )
    used = [run for run in runs if run.stop - run.start > every]
    estimator = MaximumLikelihoodHMM(
        guess, 1, reversible=False, accuracy=1e-6 * len(series) ** 0.5, maxit=MOST_ITERATIONS
    )
    try:
        fitted = estimator.fit([(series[run][::every] - shift) / scale for run in used]).fetch_model()
    except (AssertionError, RuntimeError, ValueError):  # a state of hardly any samples, whose spread is lost
        return None
    order = np.argsort(fitted.output_model.means)
    weights, path = np.zeros((len(series), states)), np.full(len(series), -1)
    for run, own, likeliest in zip(
        used, fitted.state_probabilities, fitted.hidden_state_trajectories, strict=True
    ):
        size = run.stop - run.start
        weights[run] = np.repeat(own[:, order], every, axis=0)[:size]
        path[run] = np.repeat(np.argsort(order)[likeliest], every)[:size]
    model = fitted.output_model
    centre, spread = model.means[order] * scale + shift, model.sigmas[order] * scale
    return _Levels(centre, spread, weights, path, fitted.transition_counts[order][:, order])


def path_of(
    values: np.ndarray, runs: list[slice], relaxation: float, *, column: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, int, int]:
    """Places of states ``(k, d)``, path ``(n,)``, expected transitions, wells, and samples to a level.

    Parameters
    ----------
    values, runs, relaxation
        Samples ``(n, d)`` without a drifting background, rows without a gap, and the relaxation time in
        samples.
    column
        The quantity that shows the states best. There are at least two, by other tests.

    Returns
    -------
    tuple
        The path is -1 before a state was reached. Transitions between samples ``(k, k)`` are those of a
        hidden Markov model, None where the path goes from core to core. Wells are those of the density.
        Levels are nearly all that neighbouring samples share: then one of so many samples was looked at,
        behind a filter more than 1, and stands for them. It is 0 where there are none.
    """
    series, width = values[:, column], max(int(AVERAGING_TIME * relaxation), 1)
    smooth = np.empty_like(values)
    for run in runs:
        smooth[run] = ndimage.uniform_filter1d(values[run], width, axis=0, mode="nearest")
    # Values of a counter or a digitiser have no nearest neighbours.
    steps, draw = np.array([resolution_step(one) or 0.0 for one in values.T]), np.random.default_rng(0)
    some, longest = runs[:: -(-len(runs) // MOST_RUNS)], []  # how long visits to a place are remembered
    for one in smooth.T:
        bins = np.searchsorted(np.quantile(one, np.arange(0.1, 1.0, 0.1)), one)
        visited = np.unique(bins) if np.ptp(one) > 0 else ()
        times = [correlated_samples((bins == each).astype(float), some) for each in visited]
        longest.append(max(relaxation, float(np.median(times or [0.0]))))
    spread_out = smooth + steps * (draw.random(values.shape) - 0.5)
    wells = _wells_of(spread_out, max(longest))
    if len(longest) == 1:
        # What hops from well to well for long before it is anywhere else knows a valley by all its passages.
        # Not in averages, though: halfway between two levels these have a peak of hops.
        fine = _wells_apart(values + steps * (draw.random(values.shape) - 0.5), runs)
    else:
        fine = _wells_of(spread_out, relaxation, visited=True)
    wells = fine if len(wells) < len(fine) <= MOST_STATES else wells
    each = (
        [wells]
        if len(longest) == 1
        else [_wells_of(spread_out[:, [k]], one) for k, one in enumerate(longest)]
    )
    alone = each[column]

    def guess(states: int, place: int = column) -> np.ndarray:
        low, high = np.quantile(values[:, place], [0.05, 0.95])
        return np.sort(each[place][:, 0]) if len(each[place]) == states else np.linspace(low, high, states)

    most, further = list[slice](), MOST_SAMPLES
    for run in runs:
        if further > 1:
            most.append(slice(run.start, min(run.stop, run.start + further)))
            further -= run.stop - run.start
    for place in sorted(range(len(each)), key=lambda one: one != column):
        one = values[:, place]
        # One level may hide among the wells of the density; with more, any motion is cut into pieces.
        fewest = max(len(each[place]), 2)
        for states in range(fewest, min(fewest + 1, MOST_STATES) + 1):
            if (levels := _levels_of(one, most, guess(states, place))) is None:
                break
            share, correlation = levels.left(one, most)
            every = levels.filtered(one, most)
            if every > 1 and (thin := _levels_of(one, most, levels.centre, every=every)) is not None:
                levels, (share, correlation) = thin, thin.left(one, most, every=every)
            # With levels enough any motion is cut into pieces that look white; wells of the density are none.
            limit = SMOOTH if states == len(each[place]) else 2 * WHITE_CORRELATION
            if correlation > SMOOTH and states > fewest:
                break
            others = [levels.left(other, most) for other in np.delete(values, place, axis=1).T]
            white = all(part < WHITE_CORRELATION or rest < 2 * WHITE_CORRELATION for part, rest in others)
            # Levels in excess leave less than nothing of what neighbours share.
            if white and share < WHITE_CORRELATION and abs(correlation) < limit:
                levels = _levels_of(one, runs, levels.centre, every=every) or levels
                places = _places(values, levels.path, states)
                order = np.argsort(places[:, column])
                whole = np.where(levels.path >= 0, np.argsort(order)[levels.path], -1)
                path, blurred = _without_blurred(whole, runs, states)
                counts = None if blurred or every > 1 else levels.counts[order][:, order]
                return places[order], path, counts, len(wells), every
    if len(wells) <= max(len(alone), 2):
        states = max(len(alone), 2)
        means: list[np.ndarray] = []
        rows: list[slice] = []
        for run in runs:
            begins = np.arange(run.start, run.stop - width + 1, width)
            if len(begins) > 1:
                first = rows[-1].stop if rows else 0
                rows.append(slice(first, first + len(begins)))
                means.append(series[begins[:, None] + np.arange(width)].mean(axis=1))
        if not means or not np.ptp(guess(states)) > 0:
            return np.median(values, axis=0)[None], np.zeros(len(values), dtype=int), None, len(wells), 0
        levels = _levels_of(np.concatenate(means), rows, guess(states))
        centre = guess(states) if levels is None else levels.centre
        distance = np.abs(series[:, None] - centre)
        near = distance.argmin(axis=1)
        inside = distance[np.arange(len(series)), near] <= _medians(distance, near)[near]
        # Beyond the outermost levels a sample is in the state as at the level itself.
        core = np.where(inside, near, -1)
        core[series <= centre[0]], core[series >= centre[-1]] = 0, states - 1
        core[(core == 0) & (series > centre[0])] = -1
        core[(core == states - 1) & (series < centre[-1])] = -1
        places = _places(values, near, states)
        places[:, column] = centre
        return places, continued_visits(core, runs), None, len(wells), 0
    path, places = _path_between(values, runs, wells[np.argsort(wells[:, column])])
    return places, path, None, len(wells), 0


def _without_blurred(path: np.ndarray, runs: list[slice], states: int) -> tuple[np.ndarray, bool]:
    """The path without single samples on the way from one state to another, in states with too many of these.

    A sample that averages over a hop is taken for a state between. There are too many of them where visits of
    one sample are more than the law of the longer ones explains.
    """
    blurred = np.zeros(states, dtype=bool)
    for state, stays in enumerate(stays_of(path, runs, states)):
        longer = stays[stays > 1]
        if len(longer) < FEWEST_STAYS:
            continue
        ended = 1 / float((longer - 1).mean())  # of a geometric law, after each sample
        expected = len(longer) * ended / max(1 - ended, 1e-9)
        error = np.sqrt(expected * (1 + expected / len(longer)))
        blurred[state] = (stays == 1).sum() > expected + FALSE_WELL * error
    if not blurred.any():
        return path, False
    core = np.full(len(path), -1)
    for run in runs:
        part = path[run]
        before, after = np.append(part[:1], part[:-1]), np.append(part[1:], part[-1:])
        passed = blurred[part] & (before != part) & (after != part) & (before != after)
        core[run] = np.where(passed, -1, part)
    return continued_visits(core, runs), True


def _places(values: np.ndarray, core: np.ndarray, states: int) -> np.ndarray:
    middle = np.median(values, axis=0)
    return np.array(
        [np.median(values[core == k], axis=0) if (core == k).any() else middle for k in range(states)]
    )


def _medians(distance: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Of the distances of samples from the state that is nearest: half of them make its core."""
    return np.array(
        [np.median(distance[near == k, k]) if (near == k).any() else 0.0 for k in range(distance.shape[1])]
    )


def continued_visits(core: np.ndarray, runs: list[slice]) -> np.ndarray:
    """Which core was entered last, at every sample of a run; a core ``(n,)`` is -1 where there is none."""
    visits = np.full(len(core), -1)
    for run in runs:
        part = core[run]
        last = np.maximum.accumulate(np.where(part >= 0, np.arange(len(part)), -1))
        visits[run] = np.where(last >= 0, part[np.maximum(last, 0)], -1)
    return visits


def stays_of(path: np.ndarray, runs: list[slice], states: int) -> list[np.ndarray]:
    """Lengths, in samples, of the visits to each state that were seen from beginning to end."""
    found: list[list[np.ndarray]] = [[] for _ in range(states)]
    for run in runs:
        part = path[run]
        turns = np.flatnonzero(np.diff(part)) + 1
        lengths, visited = np.diff(turns), part[turns[:-1]]
        for state in range(states):
            found[state].append(lengths[visited == state])
    return [np.concatenate(one) if one else np.zeros(0) for one in found]


def _memoryless(path: np.ndarray, runs: list[slice], states: int, dead: int) -> np.ndarray:
    """Whether a state that has lasted so many samples is left as often, however long it has lasted since.

    The exits after each age ``a`` beyond the dead time are held against one rate for all ages, in the
    direction of ``log a``: the score test of exponential times against those of Weibull, whose shape it is.
    Visits that a run cuts count with the ages that were seen of them. Returned are score, its variance, and
    exits of each state, ``(k, 3)``: an error of the shape is one over the root of the variance, and shapes
    above 1, where the score is positive, are of regular stays.
    """
    found = np.zeros((states, 3))
    longest = max(run.stop - run.start for run in runs) + 1
    exits, risk = np.zeros((states, longest)), np.zeros((states, longest))
    for run in runs:
        part = path[run]
        turns = np.flatnonzero(np.diff(part)) + 1
        lengths, visited = np.diff(np.append(turns, len(part))), part[turns]
        seen = np.arange(len(turns)) < len(turns) - 1
        np.add.at(exits, (visited[seen], lengths[seen]), 1)
        np.add.at(risk, (visited, lengths - ~seen), 1)
    risk, age = np.cumsum(risk[:, ::-1], axis=1)[:, ::-1], np.log(np.arange(1, longest - dead))
    for state, (ended, under) in enumerate(zip(exits[:, dead + 1 :], risk[:, dead + 1 :], strict=True)):
        if not ended.sum() or not len(age):
            continue
        rate, mean = ended.sum() / under.sum(), float(under @ age) / under.sum()
        variance = rate * (1 - rate) * float(under @ (age - mean) ** 2)
        found[state] = (ended - rate * under) @ (age - mean), variance, ended.sum()
    return found


def exponential(path: np.ndarray, runs: list[slice], states: int, dead: int) -> tuple[bool | None, ...]:
    """Whether stays beyond a dead time, in samples, are spread as exponential times; None of too few."""
    return tuple(
        None if ended < FEWEST_STAYS or not variance > 0 else _chance(score, variance) > REFUSED
        for score, variance, ended in _memoryless(path, runs, states, dead)
    )


def _chance(score: float, variance: float) -> float:
    return 2 * float(special.ndtr(-abs(score) / np.sqrt(variance)))


class MarkovModel(NamedTuple):
    """Hops between states as a Markov process."""

    lag: float  #: in samples: the shortest at which it predicts later hops
    chance: float  #: of hops as far from those predicted, if it is Markovian at this lag
    stays: np.ndarray  #: (k, 3): mean times between hops, in samples, and the ends of their intervals
    rates: np.ndarray  #: (k, k): from state to state, per sample

    @classmethod
    def of(
        cls, path: np.ndarray, runs: list[slice], states: int, counts: np.ndarray | None
    ) -> MarkovModel | None:
        """The Markov model of a path at the shortest lag that its test allows; None where there is none.

        `counts` are transitions from sample to sample, where a hidden Markov model knows them better. Hops
        that are too few to test a model raise NumericalFailure.
        """
        from deeptime.markov import TransitionCountEstimator

        pieces = [part[part >= 0] for part in (path[run] for run in runs)]
        stays = [one.mean() if len(one) else len(path) for one in stays_of(path, runs, states)]

        def counted(lag: int) -> np.ndarray:
            longer = [part for part in pieces if len(part) > lag]
            if not longer:
                return np.zeros((states, states))
            model = TransitionCountEstimator(lag, "sliding", n_states=states).fit(longer).fetch_model()
            found = model.count_matrix
            return np.asarray(found.toarray() if sparse.issparse(found) else found) / lag

        for lag in 2 ** np.arange(max(int(np.log2(max(min(stays) / 2, 1))), 0) + 1):
            scores = _memoryless(path, runs, states, int(lag) - 1)
            tested = scores[scores[:, 1] > 0]
            if tested[:, 1].sum() < REGULAR**2:
                if lag == 1:
                    raise NumericalFailure("the hops are too few")
                return None
            aged = min(_chance(*one) for one in (tested[:, :2].sum(axis=0), *tested[:, :2]))
            if aged * (len(tested) + 1) <= REFUSED:
                continue
            own = counts if counts is not None and lag == 1 else counted(int(lag))
            hops = own - np.diag(np.diag(own))
            if sparse.csgraph.connected_components(hops >= 1, connection="strong")[0] > 1:
                return None
            # Rows of the transition matrix have Dirichlet's distribution; the prior is no hop at all.
            drawn = np.random.default_rng(0).standard_gamma(own, size=(DRAWS, states, states))
            drawn /= drawn.sum(axis=2, keepdims=True)
            usual, worst = own / own.sum(axis=1, keepdims=True), 0.0
            # Beyond the time that visits last: before, hardly anything hops, and any model passes.
            multiples = 2 ** np.arange(1, int(np.log2(max(FORGOTTEN_STAYS * max(stays) / lag, 2))) + 1)
            for multiple in multiples:
                later = counted(int(lag * multiple))
                visits = later.sum(axis=1, keepdims=True)
                if (visits < 1).any():
                    continue
                seen, expected = later / visits, np.linalg.matrix_power(usual, int(multiple))
                spread = np.linalg.matrix_power(drawn, int(multiple)).var(axis=0)
                spread += expected * (1 - expected) / visits
                off = np.abs(seen - expected) / np.sqrt(np.maximum(spread, 1e-12))
                worst = max(worst, float(off.max()))
            chance = min(2 * float(special.ndtr(-worst)) * states * (states - 1) * len(multiples), 1.0)
            if chance > REFUSED:
                times = -lag / np.diagonal(_generators(drawn), axis1=1, axis2=2)
                tail = (1 - CONFIDENCE) / 2
                rates = _generators(usual) / lag
                limits = np.quantile(times, [tail, 1 - tail], axis=0)
                return cls(int(lag), chance, np.column_stack([-1 / np.diag(rates), *limits]), rates)
        return None


def _generators(transitions: np.ndarray) -> np.ndarray:
    """log P of matrices ``(..., k, k)``, or ``P - 1`` where that is none of a Markov process."""
    # By eigenvectors, all matrices at once: Schur's form of each in turn takes a thousand times as long.
    eigenvalues, vectors = np.linalg.eig(transitions)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = vectors * np.log(eigenvalues.astype(complex))[..., None, :] @ np.linalg.inv(vectors)
    real = (np.abs(found.imag) < 1e-9).all(axis=(-2, -1), keepdims=True)
    return np.where(real, found.real, transitions - np.eye(transitions.shape[-1]))


class Profile(NamedTuple):
    """Free energy along a state, in units of kT, or of ε: ``-log p`` less its least value."""

    place: np.ndarray  #: (b,): middles of the bins that were visited
    height: np.ndarray  #: (b,)
    error: np.ndarray  #: (b,): standard errors, by independent visits
    curvatures: np.ndarray  #: (k,): at the bottom of each state, per square of its unit; NaN where unknown
    tops: np.ndarray  #: (k - 1, 4): above the lower neighbour, its error, above the upper one, its error

    @classmethod
    def of(cls, series: np.ndarray, runs: list[slice], path: np.ndarray, places: np.ndarray) -> Profile:
        """The profile of a series ``(n,)`` between its quantiles; the states' places ``(k,)`` rise."""
        low, high = np.quantile(series, [OUTSIDE, 1 - OUTSIDE])
        counts, edges = np.histogram(series, bins=PROFILE_BINS, range=(float(low), float(high)))
        bins = np.clip(np.searchsorted(edges, series, side="right") - 1, 0, PROFILE_BINS - 1)
        inside = (series >= low) & (series <= high)
        place, kept = (edges[1:] + edges[:-1]) / 2, np.flatnonzero(counts >= 2)
        some = runs[:: -(-len(runs) // MOST_RUNS)]
        independent = [
            counts[one] / (2 * correlated_samples(((bins == one) & inside).astype(float), some))
            for one in kept
        ]
        error = 1 / np.sqrt(np.maximum(independent, 1.0))
        height = -np.log(counts[kept] / counts.max())
        place = place[kept]
        bottoms = [
            int(np.argmin(np.where(np.abs(place - one) <= _reach(series, path, k), height, np.inf)))
            for k, one in enumerate(places)
        ]
        curvatures = np.full(len(places), np.nan)
        for k, bottom in enumerate(bottoms):
            near = (height < height[bottom] + 1) & (np.abs(place - places[k]) <= 2 * _reach(series, path, k))
            if near.sum() >= FEWEST_BINS:
                curvatures[k] = (
                    2 * np.polyfit(place[near] - place[bottom], height[near], 2, w=1 / error[near])[0]
                )
        tops = []
        for first, second in pairwise(bottoms):
            between = slice(min(first, second), max(first, second) + 1)
            top = between.start + int(np.argmax(height[between]))
            tops.append(
                [
                    one
                    for end in (first, second)
                    for one in (height[top] - height[end], np.hypot(error[top], error[end]))
                ]
            )
        return cls(place, height, error, curvatures, np.array(tops).reshape(-1, 4))


def _reach(series: np.ndarray, path: np.ndarray, state: int) -> float:
    """How far a state spreads about its place."""
    inside = series[path == state]
    return float(inside.std()) if len(inside) else 0.0
