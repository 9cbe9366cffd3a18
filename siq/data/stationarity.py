"""Stationarity: relaxation times and slow drift of a record.

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

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from siq.data.recordings import LONGEST_STEP, Recordings

FEWEST = 48  # samples of the shortest stretch looked at
SETTLED = 1.3  # in stretches twice as long a walk's correlation lasts twice as long, a relaxation's as long
LEAST = 0.5  # of a sample: shorter correlations are not told from none
WHITE = 0.05  # of the variance: a correlation of neighbours below is none
MOST_STRETCHES = 4000  # looked at
SLOWEST = 8  # half periods of the background in a record: what returns more often is part of the system
RARE = 1e-3  # probability with which a record without a background is said to have one


@dataclass(frozen=True)
class Background:
    """A slow drift of what was measured, less its mean over the record.

    Attributes
    ----------
    values
        Shape ``(n,)``, at the samples; zero where no drift is seen.
    half_periods
        How many the fastest cosine has in a recording; 0 where no drift is seen.
    range
        From the lowest to the highest value.
    """

    values: np.ndarray
    half_periods: int

    @property
    def range(self) -> float:
        """From the lowest to the highest value, in the unit of the state."""
        return float(np.ptp(self.values)) if self.half_periods else 0.0


def usual_step(recordings: Recordings) -> float:
    """The median time between neighbouring samples of a recording; NaN where no recording has two."""
    gaps = np.diff(recordings.t)[np.diff(recordings.recording) == 0]
    return float(np.quantile(gaps, 0.5, method="lower")) if len(gaps) else float("nan")


def runs_of(recordings: Recordings, *, longest: float | None = None) -> list[slice]:
    """Rows of one recording without a gap between them, each a slice.

    Parameters
    ----------
    recordings
        Trajectories.
    longest
        Time between samples that is no gap yet; by default `LONGEST_STEP` median steps.
    """
    if longest is None:
        longest = LONGEST_STEP * usual_step(recordings)
    broken = np.diff(recordings.recording) != 0
    if np.isfinite(longest):
        broken |= np.diff(recordings.t) > longest * (1 + 1e-6)
    bounds = np.concatenate([[0], np.flatnonzero(broken) + 1, [len(recordings.t)]])
    return [slice(int(a), int(b)) for a, b in pairwise(bounds) if b > a]


def stretches_of_all(runs: list[slice], length: int) -> np.ndarray:
    """First rows of all stretches of that many samples; a run that is shorter gives none."""
    return np.concatenate(
        [np.zeros(0, dtype=int), *(np.arange(run.start, run.stop - length + 1, length) for run in runs)]
    )


def stretches_of(runs: list[slice], length: int) -> np.ndarray:
    """First rows of stretches of that many samples in a run, one behind the other; a part of many."""
    found = stretches_of_all(runs, length)
    return found[:: max(len(found) // MOST_STRETCHES, 1)]


def relaxation_samples(values: np.ndarray, runs: list[slice]) -> float | None:
    """The local relaxation time in samples; None where no stretch is long enough to tell.

    Parameters
    ----------
    values
        Shape ``(n,)``.
    runs
        See `runs_of`.
    """
    length, longest = FEWEST, max((run.stop - run.start for run in runs), default=0)
    times = []
    while length <= longest:
        if (time := _correlated(values, stretches_of(runs, length), length)) is not None:
            times.append(max(time, LEAST))
        length *= 2
    if len(times) < 2:
        return None
    # A walk that nothing holds is correlated over the same share of every stretch, a relaxation for as long.
    # Longer stretches hold hops and a slow background, and their correlation grows once more.
    growth = np.array(times[1:]) / times[:-1]
    turns = np.append(False, (growth[1:-1] < growth[:-2]) & (growth[1:-1] < growth[2:]))
    settled = np.flatnonzero((growth[: len(turns)] <= SETTLED) | turns)
    place = int(settled[0]) if len(settled) else int(np.argmin(growth))
    return max(times[place + 1], 1.0)


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
    # Noise of the sensor falls into lag 0 alone: what is left of it at lag 1 is what relaxes.
    if correlation[1] <= WHITE * correlation[0]:
        return 0.0
    below = np.flatnonzero(correlation < correlation[1] / np.e)
    if not len(below):
        return None
    last = int(below[0])
    share = (correlation[last - 1] - correlation[1] / np.e) / (correlation[last - 1] - correlation[last])
    return float(last - 2 + share)


def correlation_times(recordings: Recordings) -> np.ndarray:
    """``∫ ρ(s) ds`` of each state over positive lags, in the unit of time: shape ``(d,)``.

    The sum runs over pairs of neighbouring lags as long as their sum is positive and falls (Geyer's initial
    monotone sequence). Recordings share their mean; gaps between samples are passed over.
    """
    runs, step = runs_of(recordings), usual_step(recordings)
    return np.array([step * correlated_samples(column, runs) for column in recordings.values.T])


def correlated_samples(values: np.ndarray, runs: list[slice]) -> float:
    """``Σ ρ_k`` over lags, in samples, half of lag 0 included: at least a half."""
    longest = max(run.stop - run.start for run in runs)
    width = 1 << int(2 * longest - 1).bit_length()
    centred = values - values.mean()
    products, counts = np.zeros(longest), np.zeros(longest)
    for run in runs:
        part, size = centred[run], run.stop - run.start
        power = np.abs(np.fft.rfft(part, n=width)) ** 2
        products[:size] += np.fft.irfft(power, n=width)[:size]
        counts[:size] += np.arange(size, 0, -1)
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


def background_of(recordings: Recordings, values: np.ndarray) -> Background:
    """The slow drift of a series, common to all that it does: of a hopping record, less its levels.

    Every recording has cosines of its own, ``cos(πkt/T)`` with k from 1 to the number of half periods.

    Parameters
    ----------
    recordings
        Whose times and divisions these are.
    values
        Shape ``(n,)``.
    """
    runs = runs_of(recordings)
    nothing = Background(np.zeros(len(values)), 0)
    best, found = 0.0, nothing
    spread = float(np.var(values))
    if spread <= 0:
        return nothing
    counts = np.bincount(recordings.recording)
    for half_periods in range(1, SLOWEST + 1):
        fitted = _slow(recordings, values, half_periods)
        rest = values - fitted
        independent = len(values) / (2 * correlated_samples(rest, runs))
        used = half_periods * int((counts > half_periods).sum())
        if independent <= 4 * used:
            break
        gain = independent * np.log(spread / max(float(np.var(rest)), 1e-300))
        # Twice the gain in the logarithm of the likelihood, less what chance gives it with this probability.
        surplus = gain - used * np.log(independent) - 2 * np.log(1 / RARE)
        if surplus > best:
            best, found = surplus, Background(fitted - fitted.mean(), half_periods)
    return found


def _slow(recordings: Recordings, values: np.ndarray, half_periods: int) -> np.ndarray:
    fitted = np.empty(len(values))
    bounds = np.searchsorted(recordings.recording, np.arange(len(recordings.labels) + 1))
    for first, last in pairwise(bounds):
        part = values[first:last]
        if last - first <= half_periods:
            fitted[first:last] = part.mean() if len(part) else 0.0
            continue
        t = recordings.t[first:last]
        phase = np.pi * (t - t[0]) / (t[-1] - t[0])
        waves = np.cos(phase[:, None] * np.arange(half_periods + 1))
        fitted[first:last] = waves @ np.linalg.lstsq(waves, part, rcond=None)[0]
        fitted[first:last] -= fitted[first:last].mean() - values.mean()
    return fitted


def without_background(recordings: Recordings, state: int, background: Background) -> Recordings:
    """The recordings with a state's slow drift taken off, which a note says."""
    if not background.half_periods:
        return recordings
    values = recordings.values.copy()
    values[:, state] -= background.values
    unit = recordings.units[state]
    note = (
        f"the background of '{recordings.titles[state]}' drifts slowly, over a range of"
        f" {background.range:.3g}{f' {unit}' if unit else ''}; it was taken off"
    )
    return replace(recordings, values=values, notes=(*recordings.notes, note))
