"""Stationarity: stretches of a record, relaxation and correlation times, slow drift.

Three times of a record differ by orders of magnitude, and each has its use:

- the *local relaxation time*: how long a fluctuation lasts where the record just is. It is the first lag at
  which the correlation of stretches, each less a straight line, has fallen to 1/e, in stretches so long
  that twice the length changes nothing. Neither hops nor a slow background enter it;
- the *correlation time* ``∫ ρ(s) ds`` over all positive lags, hops and background included: of N samples a
  step h apart, ``N h / 2τ`` count as independent;
- that of the *background*, which moves by itself and takes all states with it: slow cosines of time, as many
  as an information criterion over independent samples asks for.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import special

from siq.data.recordings import Recordings

SHORTEST_STRETCH = 12  # samples of the shortest stretch looked at
SHORTEST_RUN = 96  # samples, of which at least one run has as many: fewer tell no relaxation
SETTLED_GROWTH = 1.3  # with twice the length a walk's correlation lasts twice as long, a relaxation's as long
SHORTEST_TIME = 0.5  # of a sample: shorter correlations are not told from none
WHITE_CORRELATION = 0.05  # of the variance: a correlation of neighbours below is none
STEP_TOLERANCE = 0.01  # of a step: stretches end where a step differs by more
ROUNDED_STEP = 0.1  # of a step, by which the tick of a clock may change it: a choice
MOST_STRETCHES = 4000  # looked at
MOST_RUNS = 200  # without a gap, from which a correlation time is found
BRIDGED = 0.1  # of the correlation time: so long a gap hides two hops in one case of a hundred
MOST_SLOW_FUNCTIONS = 8  # of the background in a record: what returns more often is part of the system
NEIGHBOURS, FEWEST_NEIGHBOURS = 10, 3  # frequencies on either side to compare one with, of all recordings
HARMLESS_LINE = 0.01  # of the variance: it changes -log p by a hundredth
FALSE_CHANGE_RATE = 0.01  # probability with which a stationary record is said to change
LEVEL_ROUNDS = 10  # numerical: of the levels and the hops between them
FALSE_DRIFT_RATE = 1e-3  # probability with which a record without a background is said to have one


def usual_step(recordings: Recordings) -> float:
    """The median time between neighbouring samples of a recording; NaN where no recording has two."""
    gaps = np.diff(recordings.t)[np.diff(recordings.recording) == 0]
    return float(np.quantile(gaps, 0.5, method="lower")) if len(gaps) else float("nan")


def runs_of(recordings: Recordings, *, longest: float | None = None, bridged: bool = False) -> list[slice]:
    """Rows of one recording without a gap between them, each a slice.

    A time between samples is a gap beyond the longest, by default `Recordings.longest_step`. Where gaps are
    `bridged`, they end a run only if they are longer than what the record remembers: the least local
    relaxation time (`relaxation_samples`), or `BRIDGED` of the correlation time. What lasts longer, such as a
    visit to a state or a drift, is not ended by samples that are missing; increments are.
    """
    broken = np.diff(recordings.recording) != 0
    if longest is None:
        steps, longest = np.diff(recordings.t)[~broken], recordings.longest_step
        if bridged and (steps > longest * (1 + 1e-6)).any():
            whole, times = runs_of(recordings, longest=np.inf), []
            some = whole[:: -(-len(whole) // MOST_RUNS)]
            for one in recordings.values.T:
                relaxation = relaxation_samples(one, whole) or 0.0
                times.append(max(relaxation, BRIDGED * correlated_samples(one, some)))
            longest = max(longest, min(times) * usual_step(recordings))
    if np.isfinite(longest):
        broken |= np.diff(recordings.t) > longest * (1 + 1e-6)
    bounds = np.concatenate([[0], np.flatnonzero(broken) + 1, [len(recordings.t)]])
    return [slice(int(a), int(b)) for a, b in pairwise(bounds) if b > a]


def stretches_of(runs: list[slice], length: int) -> np.ndarray:
    """First rows of stretches of so many samples in a run, one behind the other; of many only some."""
    found = np.concatenate(
        [np.zeros(0, dtype=int), *(np.arange(run.start, run.stop - length + 1, length) for run in runs)]
    )
    return found[:: max(len(found) // MOST_STRETCHES, 1)]


def relaxation_samples(values: np.ndarray, runs: list[slice], *, noisy: bool = False) -> float | None:
    """The local relaxation time in samples; None where no stretch is long enough to tell.

    Short stretches of levels, or of a `noisy` sensor, show white noise alone. Levels relax at once; behind a
    sensor's noise longer stretches tell.
    """
    length, longest = SHORTEST_STRETCH, max((run.stop - run.start for run in runs), default=0)
    times = []
    while length <= longest and longest >= SHORTEST_RUN:
        if (time := _correlated(values, stretches_of(runs, length), length)) is not None:
            times.append(max(time, SHORTEST_TIME))
        length *= 2
    if noisy:
        times = [one for one in times if one > SHORTEST_TIME] or times
    if len(times) < 2:
        return None
    # A walk that nothing holds is correlated over the same share of every stretch, a relaxation for as long.
    # Longer stretches hold hops and a slow background, and their correlation grows once more.
    growth = np.array(times[1:]) / times[:-1]
    turns = np.append(False, (growth[1:-1] < growth[:-2]) & (growth[1:-1] < growth[2:]))
    settled = np.flatnonzero((growth[: len(turns)] <= SETTLED_GROWTH) | turns)
    return max(times[int(settled[0] if len(settled) else np.argmin(growth)) + 1], 1.0)


def _correlated(values: np.ndarray, begins: np.ndarray, length: int) -> float | None:
    """The lag, in samples, at which the correlation within stretches falls to 1/e of what it is at one."""
    parts = values[begins[:, None] + np.arange(length)]
    line = np.linalg.qr(np.vander(np.linspace(-1, 1, length), 2))[0]
    parts = parts - (parts @ line) @ line.T
    spread = parts.std(axis=1, keepdims=True)
    parts = parts[spread[:, 0] > 0] / spread[spread[:, 0] > 0]
    if not len(parts):
        return None
    width = 2 * length
    power = np.mean(np.abs(np.fft.rfft(parts, n=width, axis=1)) ** 2, axis=0)
    correlation = np.fft.irfft(power, n=width)[: length // 2] / np.arange(length, length - length // 2, -1)
    # Measurement noise falls into lag 0 alone: what is left of it at lag 1 is what relaxes.
    if correlation[1] <= WHITE_CORRELATION * correlation[0]:
        return 0.0
    below = np.flatnonzero(correlation < correlation[1] / np.e)
    if not len(below):
        return None
    last = int(below[0])
    share = (correlation[last - 1] - correlation[1] / np.e) / (correlation[last - 1] - correlation[last])
    return float(last - 2 + share)


def correlated_samples(values: np.ndarray, runs: list[slice]) -> float:
    """The correlation time ``Σ ρ_k`` over lags, in samples, half of lag 0 included: at least a half.

    The sum runs over pairs of neighbouring lags as long as their sum is positive and falls (Geyer's initial
    monotone sequence). Recordings share their mean; gaps between samples are passed over.
    """
    longest = max(run.stop - run.start for run in runs)
    width, centred = 1 << int(2 * longest - 1).bit_length(), values - values.mean()
    power, counts = np.zeros(width // 2 + 1), np.zeros(longest)
    for run in runs:
        size = run.stop - run.start
        power += np.abs(np.fft.rfft(centred[run], n=width)) ** 2
        counts[:size] += np.arange(size, 0, -1)
    products = np.fft.irfft(power, n=width)[:longest]
    # Beyond half of a run a mean is of hardly any samples.
    usable = max(longest // 2, 1)
    correlation = products[:usable] / np.maximum(counts[:usable], 1)
    if correlation[0] <= 0:
        return 0.5
    correlation = correlation / correlation[0]
    pairs = correlation[: 2 * (usable // 2)].reshape(-1, 2).sum(axis=1)
    if not len(pairs):
        return 0.5
    ends = np.flatnonzero(pairs <= 0)
    kept = np.minimum.accumulate(pairs[: ends[0] if len(ends) else len(pairs)])
    return max(float(kept.sum()) - 0.5, 0.5)


def change_of(
    recordings: Recordings, values: np.ndarray, path: np.ndarray, *, harmless: float = HARMLESS_LINE,
    held: int = 1,
) -> float | None:  # fmt: skip
    """The period with which states change, in samples; infinite where they do slowly, None where not at all.

    The state at each sample, `path` ``(n,)`` with -1 where it is not known, the distance of the `values`
    ``(n,)`` from the mean of their state, and its square are asked for a straight line, in the course of all
    recordings and of each, and for a frequency that stands out from its neighbours: with power P there and
    L at these, ``P/L`` has the F distribution in any stationary process whose spectrum is smooth. A line is
    passed over that has a `harmless` share of the variance, or is faster than the path tells, which is `held`
    for so many samples.
    """
    inside = (path[:, None] == np.arange(path.max() + 1)).astype(float)
    shares = np.maximum(inside.sum(axis=0), 1.0)
    rest = values - inside @ (inside.T @ values / shares)
    square = rest**2 - inside @ (inside.T @ rest**2 / shares)
    known = path >= 0
    series = np.where(
        known[:, None], np.column_stack([inside - inside[known].mean(axis=0), rest, square]), 0.0
    )
    series = series[:, np.ptp(series, axis=0) > 0]
    bounds = np.searchsorted(recordings.recording, np.arange(len(recordings.labels) + 1))
    parts = [slice(int(a), int(b)) for a, b in pairwise(bounds) if b > a]
    lines = [np.linspace(-1, 1, len(path))]
    if len(parts) > 1:
        lines.append(np.concatenate([np.linspace(-1, 1, one.stop - one.start) for one in parts]))
    runs = runs_of(recordings, bridged=True)
    some = runs[:: -(-len(runs) // MOST_RUNS)]
    for line in lines:
        line = np.where(known, line - line[known].mean(), 0.0)
        for one in series.T:
            slope = float(line @ one / (line @ line))
            left = one - slope * line
            together = 2 * correlated_samples(left, some)
            error = left.std() * np.sqrt(together / float(line @ line))
            freedom = max(known.sum() / together - 2, 1.0)
            chance = 2 * float(special.stdtr(freedom, -abs(slope) / max(error, 1e-300)))
            if chance * len(lines) * series.shape[1] < FALSE_CHANGE_RATE / 2:
                return np.inf
    longest = max(one.stop - one.start for one in parts)
    used = [one for one in parts if one.stop - one.start > 4 * NEIGHBOURS]
    # So many of equal length would tell as much (Satterthwaite): short ones hardly add to a long one.
    lengths = np.array([one.stop - one.start for one in used], dtype=float)
    count = lengths.sum() ** 2 / max(float(lengths @ lengths), 1.0)
    # At half the distance of independent frequencies, so that none falls between two of them; slow ones are
    # compared with fewer, so that none of these is that of the mean, which was taken off.
    near = 2 * max(int(np.ceil(NEIGHBOURS / max(count, 1.0))), FEWEST_NEIGHBOURS)
    frequencies = np.arange(2 * FEWEST_NEIGHBOURS + 3, longest // max(held, 1) - near)
    if not used or not len(frequencies):
        return None
    reach = np.minimum(near, frequencies - 2)
    # Each octave is as likely to hold a line, which may be any of its frequencies.
    price = np.log2(2 * frequencies[-1] / frequencies[0]) * frequencies * series.shape[1]
    for one in series.T:
        power = np.sum([np.abs(np.fft.rfft(one[part], n=2 * longest)) ** 2 for part in used], axis=0)
        below = np.append(0.0, np.cumsum(power))
        around = below[frequencies + reach + 1] - below[frequencies - reach]
        others, own = 2 * reach - 6, power[frequencies]
        level = (around - below[frequencies + 4] + below[frequencies - 3]) / others
        chance = price * special.fdtrc(2 * count, count * others, own / np.maximum(level, 1e-300))
        chance[2 * (own - level) < harmless * power[1:].sum()] = 1.0
        if chance.min() < FALSE_CHANGE_RATE / 2:
            return float(2 * longest / frequencies[chance.argmin()])
    return None


def background_of(recordings: Recordings, values: np.ndarray, *, functions: int | None = None) -> np.ndarray:
    """The slow drift of a series, common to all that it does: of a hopping record, less its levels.

    Every recording has a straight line of its own, and cosines ``cos(πkt/T)`` with k from 1 on: so many
    `functions`, or else those that are seen. Gives the drift ``(n,)``, of mean zero; zero where none is seen,
    or hops between two levels explain what is seen better.
    """
    bounds = np.searchsorted(recordings.recording, np.arange(len(recordings.labels) + 1))

    def fitted(count: int) -> np.ndarray:
        found = np.zeros(len(values))
        for first, last in pairwise(bounds):
            if last - first > count:
                t = recordings.t[first:last]
                phase = np.pi * (t - t[0]) / (t[-1] - t[0])
                waves = np.column_stack([phase, np.cos(phase[:, None] * np.arange(count))])
                found[first:last] = waves @ np.linalg.lstsq(waves, values[first:last], rcond=None)[0]
                found[first:last] -= found[first:last].mean()
        return found

    if functions is not None:
        return fitted(functions)
    runs, counts = runs_of(recordings, bridged=True), np.bincount(recordings.recording)
    best, drift, chosen, spread = 0.0, np.zeros(len(values)), 0, float(np.var(values))
    for count in range(1, MOST_SLOW_FUNCTIONS + 1 if spread > 0 else 0):
        slow = fitted(count)
        rest = values - slow
        independent = len(values) / (2 * correlated_samples(rest, runs))
        used = count * int((counts > count).sum())
        if independent <= 4 * used:
            break
        gain = independent * np.log(spread / max(float(np.var(rest)), 1e-300))
        # Twice the gain in the logarithm of the likelihood, less what chance gives it with this probability.
        surplus = gain - used * np.log(independent) - 2 * np.log(1 / FALSE_DRIFT_RATE)
        if surplus > best:
            best, drift, chosen = surplus, slow, used
    return np.zeros(len(values)) if chosen and _hops_rather(values, drift, chosen, runs) else drift


def _hops_rather(values: np.ndarray, drift: np.ndarray, used: int, runs: list[slice]) -> bool:
    """Whether hops between two levels explain a series better than its drift with so many coefficients.

    Compared are means over as many samples as are one independent value of what the drift leaves, by Bayes's
    information criterion. A hop costs two coefficients, as it may be anywhere, and is one to a mean that is
    nearer to the other level than a third of the way.
    """
    size = int(np.ceil(2 * correlated_samples(values - drift, runs)))
    parts = [range(run.start, run.stop - size + 1, size) for run in runs]
    seen, slow = (
        np.array([one[at : at + size].mean() for part in parts for at in part]) for one in (values, drift)
    )
    numbers = np.arange(len(seen))
    begins = np.isin(numbers, np.cumsum([0, *map(len, parts)]))
    levels = np.quantile(seen, [0.1, 0.9]) if len(seen) else np.zeros(2)
    path = np.zeros(len(seen), dtype=int)
    for _ in range(LEVEL_ROUNDS):
        away = np.abs(seen[:, None] - levels)
        sure = (away.min(axis=1) < np.ptp(levels) / 3) | begins
        path = away.argmin(axis=1)[np.maximum.accumulate(np.where(sure, numbers, 0))]
        if len(np.unique(path)) < 2:
            return False
        levels = np.array([seen[path == one].mean() for one in (0, 1)])
    hops = int(((np.diff(path) != 0) & ~begins[1:]).sum())
    left = [float(np.var(seen - one)) for one in (levels[path], slow)]
    gain = len(seen) * np.log(max(left[1], 1e-300) / max(left[0], 1e-300))
    return bool(gain > (2 * hops + 1 - used) * np.log(len(seen)))


class Stretches(NamedTuple):
    """Steps between neighbouring samples, numbered by the stretch of even steps that they belong to."""

    number: np.ndarray  #: (n - 1,) for n samples: of the step from each to the next, -1 where it is in none
    step: float  #: the usual time between neighbouring samples; 0 where there are none

    def within(self, lag: int) -> np.ndarray:
        """The first of `lag` + 1 steps that belong to one stretch, as indices of steps."""
        return np.flatnonzero(same_stretch(self.number, lag))


def same_stretch(number: np.ndarray, lag: int) -> np.ndarray:
    """Which steps have one `lag` steps later in their stretch; shape ``(n - lag,)`` for n steps."""
    earlier = number[: max(len(number) - lag, 0)]
    return np.asarray((earlier >= 0) & (earlier == number[lag:]))


def even_stretches(recordings: Recordings) -> Stretches:
    """Cut recordings into stretches of even steps, or where most are uneven, of all without gaps."""
    gap, inside = np.diff(recordings.t), np.diff(recordings.recording) == 0
    if not inside.any():
        return Stretches(np.full(len(gap), -1), 0.0)
    usual = usual_step(recordings)
    # Times such as 0.1·k, or seconds since 1970, carry rounding errors into their differences.
    even = inside & (np.abs(gap - usual) <= STEP_TOLERANCE * usual + 4 * np.spacing(np.abs(recordings.t[1:])))
    if not even.all():  # rounded to the tick of a clock, one step has two lengths, or three
        near = inside & (np.abs(gap - usual) <= ROUNDED_STEP * usual)
        even = near if len(np.unique(np.round(gap[near] / usual, 3))) <= 3 else even
    if 2 * even.sum() < inside.sum():
        even = inside & (gap <= recordings.longest_step * (1 + 1e-6))
    return Stretches(np.where(even, np.cumsum(~even), -1), usual)


def lagged_covariances(rest: np.ndarray, number: np.ndarray, most: int) -> np.ndarray:
    """Covariances of what is left of steps, ``(n, d)`` with mean zero, with what is left of later ones.

    Steps of a stretch follow each other; `number` says of which each is, -1 for none. Shape ``(most + 1, d,
    d)``: ``C[k, i, j]`` is the mean of ``rest[m, i] rest[m + k, j]``; zero where no two are so far apart.
    """
    d = rest.shape[1]
    covariances = np.zeros((most + 1, d, d))
    for lag in range(min(most, len(rest) - 1) + 1):
        both = same_stretch(number, lag)
        if both.any():
            covariances[lag] = (rest[: len(both)] * both[:, None]).T @ rest[lag:] / both.sum()
    return covariances


def long_run_covariance(covariances: np.ndarray, lag: int) -> np.ndarray:
    """``C_0 + Σ_k (C_k + C_kᵀ)`` up to a lag: what sums of many steps have, per step; shape ``(d, d)``."""
    later = covariances[1 : lag + 1].sum(axis=0)
    return np.asarray(covariances[0] + later + later.T)
