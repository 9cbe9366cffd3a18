"""What recordings would have to show if an estimate of f and D were not the whole of their system.

A fit of f presumes that the states recorded are all of them, that nothing changes in time, that all
recordings are one system, and that the noise is Gaussian. None of it is asked by a test of f against the same
functions of the state. All of it says one thing of the residuals ``z = σ⁻¹(x)(Xh - E[Xh | X0])/√(εh)``: given
the state, *nothing else in the record predicts the next one*. So one test asks for each claim, with columns G
of its own,

    F = (‖P z‖²/q) / (‖z - P z‖²/(n - q)),

P being the projection on G less what functions of the state explain of it, those of f among them: so that
their coefficients may have been fitted to the same residuals (a score test; Rao, 1948). Columns may be made
of the past alone, and then the products ``G z`` are martingale differences, whatever f is.

``one_system``
    Each recording by itself: a constant, and slopes in the states. Likewise of ``z² - 1``, for D. Recordings
    that share no states cannot be compared.
``unchanged``
    Time itself, for a drift, and cosines and sines of it, from half a period in a recording to two samples;
    and these times the states. Half of the level is for drifts. Of periodograms of z, of ``φ(x) z`` and of
    ``z² - 1`` each octave of frequencies has the same share, since it is as likely to hold a peak.
``state_complete``
    Means of the past that fade with memories from a few samples to a thirtieth of the record, of the states,
    and of ``φ(x) z``, which follow what a hidden variable does to the force; and what filters know of a gate,
    which is not forgotten as such means are. A hidden variable that changes D shows in means of ``z² - 1``.
``gaussian_increments``
    The largest residual, how many are beyond three, and whether enough are beyond two and a half; values, or
    steps, that repeat themselves more often than rounding lets them; and stretches that are there twice.

``gaussian_force``
    Of a slow force that was not recorded: the fourth cumulant of what a filter knows of it. Where a gate with
    two values would not show in that, it is not tested.

``regular_clock``
    Not tested where samples were taken at other times than it is said: times are no better than their clock.

Of the neighbouring residual `siq.inference.checks` judges, which knows sensors and rounding: what it explains
is left out here, and the past begins two steps back.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import scipy.special

from siq.data.preparation import joined, repetitions
from siq.data.recordings import Recordings, SnapshotPairs, parent_recordings, snapshot_pairs
from siq.data.stationarity import usual_step
from siq.inference.checks import STATE_BINS, unexplained_probability
from siq.inference.diffusion_model import process_noise_increments
from siq.inference.field_estimate import FieldEstimate, Verdict
from siq.inference.observation import ObservationModel
from siq.inference.regression import coarse_pairs, residuals
from siq.numerics.integration import machine_code
from siq.numerics.randomness import positive
from siq.remarks import Remark, sentence

NOISELESS = 1e-3  # of the rms step: a state with less has no noise of its own, and its residuals say nothing
FEWEST_PAIRS = 30  # of a recording that is compared by itself
FEWEST_PER_COLUMN = 10  # pairs for each column of a regression
FASTEST_PERIOD = 2  # samples
FEWEST_OF_SPECTRUM = 10  # pairs of a run whose spectrum is asked for
SHORTEST_MEMORY, MEMORY_GROWTH, LONGEST_MEMORY = 4, 2.0, 1 / 30  # samples; a ratio; of all samples
VISIBLE = 4.0  # squares of the standard deviations by which a gate shows within its memory
ROUNDS = 4  # numerical: of filter and state, until they agree on what the state tells of a gate
OVERLAP = 0.02  # quantile between which, and one minus it, recordings share states
SLIGHT_EXCESS = 0.25  # of the standard deviation of what all recordings explain: 1/160 becomes 1/80
RANK = 1e-8  # numerical: of the squares of a column, what is left of it by chance
FORGOTTEN = 3.0  # of its times, after which a filter has forgotten that it did not know the force at first
POWER = 0.8  # probability with which a flaw as large as is said would have been noticed
TAIL, EDGE = 3.0, 2.5  # standard deviations: beyond are 2.7 in 1000, and 12: a choice
HARMLESS_CHANGE = 0.01  # of a barrier


class _Residuals:
    """White residuals of pairs, with what is known where each begins.

    `noise` are the residuals of the states that noise acts on, uncorrelated, of variance one, less what
    functions of the state explain: ``(n, c)``. `basis` are these functions, orthonormal, ``(n, q)``; `states`
    are one and the states, scaled, ``(n, 1 + d)``; `power` are the squares of the noise less one, less what
    the length of steps explains, too; `runs` are slices of the pairs of a recording, one after the other;
    gaps between them are passed over.
    """

    def __init__(self, found: FieldEstimate, pairs: SnapshotPairs) -> None:
        pairs = found.wrapped(pairs)
        rest = process_noise_increments(found, pairs, residuals(found, pairs))
        force = found.dynamics.drift(pairs.x0) * np.sqrt(pairs.h)[:, None]
        moves = positive(np.sqrt((rest**2).mean(axis=0)))
        if not found.diffusion.constant:
            whitening = found.diffusion.whitening_at(found.on_the_way(pairs))
            rest, force = (np.einsum("nij,nj->ni", whitening, one) for one in (rest, force))
        moved = np.sqrt(((pairs.xh - pairs.x0) ** 2 / pairs.h[:, None]).mean(axis=0))
        self.noisy = np.sqrt((rest**2).mean(axis=0)) > NOISELESS * moved
        if found.hidden_states:  # there is one innovation for each position
            self.noisy[found.library.dimension // 2 :] = False
        self.reach = float((pairs.x0.std(axis=0) / moves)[self.noisy].max(initial=0.0))
        shares = (force**2).mean(axis=0)[self.noisy] / (rest**2).mean(axis=0)[self.noisy]
        self.drift = float(shares.max(initial=0.0))  # of the squares of steps, over that of the noise
        self.pairs, n = pairs, len(pairs.h)
        functions = np.unique(found.support[:, 1])
        columns = [
            found.library.evaluate(pairs.x0)[:, functions], np.ones((n, 1)), pairs.equal_parts(STATE_BINS),
        ]  # fmt: skip
        together = np.concatenate(columns, axis=1) * np.sqrt(pairs.h / pairs.h.mean())[:, None]
        self.basis = _orthonormal(together)
        scaled = (pairs.x0 - pairs.x0.mean(axis=0)) / positive(pairs.x0.std(axis=0))
        self.states = np.concatenate([np.ones((n, 1)), scaled], axis=1)
        bounds = np.concatenate([[0], np.flatnonzero(np.diff(pairs.recording)) + 1, [n]])
        self.runs = [slice(int(a), int(b)) for a, b in pairwise(bounds)]
        self.noise = self.without(rest[:, self.noisy])
        self.noise = _orthonormal(self.noise) * np.sqrt(n)
        self.near = _orthonormal(self._standardised(self.past(self.noise, 0.0, delay=1)))
        # Long steps forget a part of their noise, and of short ones a filter knows less than all.
        steps, power = _orthonormal(pairs.equal_parts(STATE_BINS, of_steps=True) * 1.0), self.noise**2 - 1
        self.power = self._standardised(power - steps @ (steps.T @ power))

    def _standardised(self, values: np.ndarray) -> np.ndarray:
        values = self.without(values)
        return values / positive(np.sqrt((values**2).mean(axis=0)))

    def without(self, values: np.ndarray) -> np.ndarray:
        """Columns less what functions of the state explain."""
        return np.asarray(values - self.basis @ (self.basis.T @ values))

    def past(self, values: np.ndarray, memory: float, *, delay: int = 2) -> np.ndarray:
        """Means of columns so many pairs ago and earlier, which fade with a memory in pairs; run by run."""
        from scipy.signal import lfilter  # which brings all of scipy.stats, half a second to import

        fade, found = np.exp(-1 / memory) if memory > 0 else 0.0, np.zeros_like(values)
        for run in self.runs:
            if run.stop - run.start > delay:
                earlier = values[run][:-delay]
                begin = earlier[:1] * fade  # as if it had been so before
                faded, _ = lfilter([1 - fade], [1, -fade], earlier, axis=0, zi=begin)
                found[run][delay:] = faded
        return found

    def gated(self, memory: float, shape: np.ndarray) -> np.ndarray:
        """What a gate ±1 that pushes like a shape does to residuals, by filters with a memory in pairs.

        What the state tells of the gate f has taken over; it is given back to the residuals.
        """
        push, fade = np.sqrt(VISIBLE / memory) * shape[:, None], float(np.exp(-1 / memory))
        told = seen = np.zeros_like(self.noise)
        for _ in range(ROUNDS):
            values = self.noise + push * told
            seen = np.concatenate([_foreseen(values[run], push[run, 0], fade) for run in self.runs])
            told = seen - self.without(seen)
        return np.asarray(push * seen)

    def probability(self, columns: np.ndarray, rest: np.ndarray) -> float:
        """Probability of what columns explain of residuals, neighbours and the state apart."""
        columns = self.without(columns)
        columns, rest = (one - self.near @ (self.near.T @ one) for one in (columns, rest))
        columns = _orthonormal(columns)
        if not columns.shape[1] or len(rest) < FEWEST_PER_COLUMN * (columns.shape[1] + self.basis.shape[1]):
            return 1.0
        freedom = len(rest) - self.basis.shape[1] - self.near.shape[1]
        return unexplained_probability(columns, rest, freedom=freedom)

    def memories(self) -> Iterator[float]:
        """Memories to be looked at, in pairs."""
        longest = min(max(run.stop - run.start for run in self.runs) / 2, len(self.noise) * LONGEST_MEMORY)
        memory = float(SHORTEST_MEMORY)
        while memory <= longest:
            yield memory
            memory *= MEMORY_GROWTH


@machine_code
def _foreseen(values: np.ndarray, push: np.ndarray, fade: float) -> np.ndarray:
    """The mean, before each value, of a gate ±1 that adds ±push to noise of variance one (Wonham 1965)."""
    seen = np.zeros_like(values)
    for column in range(values.shape[1]):
        mean = 0.0
        for k in range(len(values)):
            seen[k, column] = mean = mean * fade
            told = np.tanh(push[k] * values[k, column])
            mean = (mean + told) / (1 + mean * told)
    return seen


def _orthonormal(columns: np.ndarray) -> np.ndarray:
    """A basis of what columns span, without what is rounding only."""
    sizes = np.linalg.norm(columns, axis=0)
    columns = columns[:, sizes > 0] / sizes[sizes > 0]
    values, vectors = np.linalg.eigh(columns.T @ columns)
    kept = values > RANK
    return np.asarray(columns @ (vectors[:, kept] / np.sqrt(values[kept])))


def _verdict(claim: str, probability: float, limit: float, **values: object) -> Verdict:
    remark = Remark(f"inference.not_{claim}", values | {"probability": min(probability, 1.0)})
    return Verdict.of_probability(probability, limit, sentence(remark))


def check_claims(
    found: FieldEstimate, states: Recordings, measured: Recordings, *, pair_step: float | None = None,
    false_alarms: float,
) -> dict[str, Verdict]:  # fmt: skip
    """Whether recordings bear out what an estimate of f and D presumes, by the names of the claims.

    Parameters
    ----------
    found
        f and D, from recordings with process noise.
    states, measured
        The recordings as they show the states: filtered where the sensor was noisy, else as they are; and as
        they are, for values that repeat themselves.
    pair_step
        See `siq.data.recordings.snapshot_pairs`.
    false_alarms
        Probability with which each claim is refused where it holds.
    """
    filtered = states is not measured
    states, measured = (
        one.select(np.flatnonzero(parent_recordings(one.labels) == np.arange(len(one.labels))))
        for one in (states, measured)
    )
    whole = joined(states)
    if found.memory is not None:
        pairs = coarse_pairs(whole, found.memory[0], lost=found.memory[1])
    elif filtered:  # a filter begins anew in each stretch
        pairs = snapshot_pairs(states, pair_step=pair_step)
        begins = np.searchsorted(states.recording, np.arange(len(states.labels)))
        pairs = replace(pairs, recording=whole.recording[begins][pairs.recording])
    else:
        pairs = snapshot_pairs(whole, pair_step=pair_step)
    rest = _Residuals(found, pairs)
    if not rest.noisy.any():  # what settles, seen by a sensor, has no noise that claims are about
        return {}
    forced = found.slow_force and found.noise_rate[1, 1]  # what follows the state alone has no noise
    further = {"gaussian_force": _gaussian_force(found, states, false_alarms)} if forced else {}
    if any(one.code == "data.clock" for one in measured.remarks):
        further["regular_clock"] = Verdict.not_tested(sentence(Remark("inference.clock")))
    return {
        "one_system": _one_system(rest, whole.labels, false_alarms),
        "unchanged": _unchanged(rest, false_alarms), "state_complete": _state_complete(rest, false_alarms),
        "gaussian_increments": _gaussian(rest, measured, false_alarms), **further,
    }  # fmt: skip


def _gaussian_force(found: FieldEstimate, states: Recordings, limit: float) -> Verdict:
    """Whether a slow force that was not recorded is spread as noise spreads it, and no gate with two values.

    The fourth cumulant of n values with the correlations ρ_k has the variance ``24/n Σ_k ρ_k⁴`` where they
    are Gaussian (Isserlis). Of a gate it is -2, of which a filter that knows the share r of the variance
    sees r². What follows the state is taken off first: that is spread as the state is.
    """
    time, begins = -1 / found.values[-1], np.searchsorted(states.recording, states.recording)
    known, force = states.t - states.t[begins] > FORGOTTEN * time, states.values[:, 1]
    observation, x, step = ObservationModel.of(found), states.values[:, 0], usual_step(states)
    force = (force - observation.following(x, np.unique(begins)[1:], found.values, step))[known]
    if len(force) < FEWEST_PAIRS:
        return Verdict.not_tested(sentence(Remark("inference.recordings_too_short")))
    force, lasted = force - force.mean(), len(force) * float(np.median(np.diff(states.t)))
    seen = float((force**2).mean())
    share = min(seen / (found.noise_rate[1, 1] * time / 2), 1.0) if found.noise_rate[1, 1] else 1.0
    error = np.sqrt(24 / max(2 * lasted / time, 1.0))
    score = float(((force**4).mean() / seen**2 - 3) / error)
    chance = 2 * float(scipy.special.ndtr(-abs(score)))
    if chance >= limit and 2 * share**2 / error < -scipy.special.ndtri(limit / 2) - scipy.special.ndtri(
        1 - POWER
    ):
        return Verdict.not_tested(sentence(Remark("inference.slow_force_unseen", {"share": share})))
    return _verdict("gaussian_force", chance, limit)


def _one_system(rest: _Residuals, labels: Sequence[str], limit: float) -> Verdict:
    numbers, index = np.unique(rest.pairs.recording, return_inverse=True)
    rows = np.split(np.argsort(index, kind="stable"), np.cumsum(np.bincount(index))[:-1])
    if len(numbers) < 2:
        return Verdict(0.0, -float(np.log10(limit)), True)
    enough = [place for place, own in enumerate(rows) if len(own) >= FEWEST_PAIRS]
    # What a recording explains by its own states is larger than chance makes it where it is short.
    columns = rest.states
    if _kendall_excess(rest.states[:, 1:], rows) > SLIGHT_EXCESS * np.sqrt(2 * len(rows) * columns.shape[1]):
        columns = columns[:, :1]
    # What each explains by itself, of the mean and of the variance; then again without the worst.
    noise, power, apart, order, least = rest.noise, rest.power, list[int](), list[int](), 1.0
    while len(apart) <= len(numbers) // 2:
        sums, of_power, chances = (0, np.zeros(noise.shape[1])), (0, np.zeros(noise.shape[1])), {}
        for place, own in enumerate(rows):
            if place in apart or len(own) <= rest.states.shape[1]:
                continue
            mean = _explained(columns[own], noise[own], rest.basis[own])
            sums = (sums[0] + mean[0], sums[1] + mean[1])
            if place in enough:
                freedom, square = _explained(rest.states[own, :1], power[own], rest.basis[own])
                variance = freedom, _as_normal(square, np.sign(power[own].sum(axis=0)), len(own))
                of_power = (of_power[0] + variance[0], of_power[1] + variance[1])
                chances[place] = 2 * min(_chance(*mean), _chance(*variance)) * len(enough)
        if not sums[0]:
            return Verdict.not_tested(sentence(Remark("inference.recordings_too_short")))
        single = min(chances.values(), default=1.0)
        if not apart:
            least = 3 * min(single, _chance(*sums), _chance(*of_power))
            order = sorted(chances, key=lambda place: chances[place])
        if 3 * single >= limit:
            break
        apart.append(min(chances, key=lambda place: chances[place]))
        worst = rest.without(rest.states * (index == apart[-1])[:, None])
        noise, power = (
            one - basis @ (basis.T @ one)
            for one, basis in ((noise, _orthonormal(worst)), (power, _orthonormal(worst[:, :1])))
        )
    if least >= limit and len(enough) > 1:
        # Recordings are compared with those that share states with them, and these with others.
        low, high = (
            np.array([np.quantile(rest.pairs.x0[rows[place]], q, axis=0) for place in enough])
            for q in (OVERLAP, 1 - OVERLAP)
        )
        alike = np.asarray(((low[:, None] <= high) & (low <= high[:, None])).all(axis=2))
        group = alike[0]
        while (alike[group].any(axis=0) & ~group).any():
            group = alike[group].any(axis=0)
        if not group.all():
            others = [labels[numbers[enough[place]]] for place in np.flatnonzero(~group)[:3]]
            values = {"names": others, "first": labels[numbers[enough[0]]]}
            return Verdict.not_tested(sentence(Remark("inference.no_common_states", values)))
    names = [labels[numbers[place]] for place in apart or order[:3]]
    return _verdict("one_system", least, limit, names=names[:3], count=len(names))


def _kendall_excess(states: np.ndarray, rows: Sequence[np.ndarray]) -> float:
    """By how much squares that states of the same recording explain of its noise exceed their mean, in all.

    A state follows its own noise, so that a regression on n of them, of the correlation ρ from one to the
    next, is off by -(1 + 3ρ)/n (Kendall 1954), which is ``(1 + 3ρ)/√(n (1 - ρ²))`` of its standard errors.
    """
    excess = 0.0
    for own in rows:
        x = states[own]
        around = ((x - x.mean(axis=0)) ** 2).sum(axis=0)
        slow = np.clip(1 - ((np.diff(x, axis=0) ** 2).sum(axis=0) / positive(2 * around)), 0.0, 1.0 - 1e-9)
        excess += float(((1 + 3 * slow) ** 2 / (len(own) * (1 - slow**2))).sum())
    return excess


def _explained(columns: np.ndarray, rest: np.ndarray, basis: np.ndarray) -> tuple[int, np.ndarray]:
    """How many columns that vanish elsewhere are independent; what they explain of residuals of variance one.

    All are given where columns do not vanish: what the basis of the state explains of them is taken off.
    """
    inner, pushed = basis.T @ columns, columns.T @ rest
    values, vectors = np.linalg.eigh(columns.T @ columns - inner.T @ inner)
    kept = values > RANK * len(columns)
    return int(kept.sum()), ((vectors[:, kept].T @ pushed) ** 2 / values[kept, None]).sum(axis=0)


def _as_normal(square: np.ndarray, sign: np.ndarray, count: int) -> np.ndarray:
    """Squares of scores of means of so many χ²₁, from those of a normal distribution (Wilson, Hilferty 1931).

    Of thousands of short recordings one has a variance that its mean and spread alone would make impossible.
    """
    mean, spread = np.maximum(1 + sign * np.sqrt(2 * square / count), 0.0), 2 / (9 * count)
    return np.asarray((np.cbrt(mean) - 1 + spread) ** 2 / spread)


def _chance(count: int, explained: np.ndarray) -> float:
    """Probability of so much explained, of the residual of which most is, by so many columns."""
    if not count:
        return 1.0
    return min(float(scipy.special.chdtrc(count, explained).min()) * len(explained), 1.0)


def _combined(chances: np.ndarray, shares: np.ndarray | None = None) -> float:
    """One probability of L tests with shares of a level, however they depend on each other: a harmonic mean.

    Of ``t = Σ s/p / Σ s`` it is ``1/(t - log L - 0.874)`` where it is small (Wilson, PNAS 116 (2019) 1195).
    """
    inverse = float(np.average(1 / np.maximum(chances, 1e-300), weights=shares))
    return 1 / max(inverse - np.log(len(chances)) - 0.874, 1.0)


def _unchanged(rest: _Residuals, limit: float) -> Verdict:
    runs = [run for run in rest.runs if run.stop - run.start >= FEWEST_OF_SPECTRUM]
    if not runs:
        return Verdict.not_tested(sentence(Remark("inference.runs_too_short")))
    size, step = 2 * max(run.stop - run.start for run in runs), float(np.median(rest.pairs.h))
    frequencies = np.arange(1, size // FASTEST_PERIOD + 1)
    octaves = np.log2(frequencies).astype(int)
    share = 1 / (np.bincount(octaves)[octaves] * (octaves[-1] + 1))
    # A drift has one direction in each recording, or in all as they follow each other.
    clocks = [np.concatenate([np.linspace(-1, 1, run.stop - run.start) for run in rest.runs])[:, None]]
    if len(rest.runs) > 1:
        clocks.append(np.linspace(-1, 1, len(rest.noise))[:, None])
    one = rest.states[:, :1]
    tried = [(rest.noise, one, False), (rest.noise, rest.states, False), (rest.power, one, True)]
    found = [  # probabilities, their shares of the level, periods, and whether they are of the noise
        (
            np.full(1, rest.probability(clock * shapes, series)),
            np.full(1, 1 / len(clocks)),
            np.zeros(1),
            of_noise,
        )
        for series, shapes, of_noise in tried
        for clock in clocks
    ]
    for series, shapes, of_noise in tried:
        peaks, freedom = np.zeros(len(frequencies)), np.zeros(len(frequencies))
        for run in runs:
            part = series[run] - (series[run].mean(axis=0) if len(runs) > 1 else 0.0)  # an offset is no swing
            products = (part[:, :, None] * _orthonormal(shapes[run])[:, None, :]).reshape(len(part), -1)
            seen = frequencies >= size / (2 * len(part))  # half a period in the run, or more
            power = np.abs(np.fft.rfft(products, n=size, axis=0)[frequencies]) ** 2
            peaks += np.where(seen, 2 * power.sum(axis=1), 0.0)
            freedom += 2 * products.shape[1] * seen
        # The variance of a peak of n samples is larger by the share of their fourth cumulant over n.
        excess = float(((series**4).mean(axis=0) / (series**2).mean(axis=0) ** 2).max() - 3)
        wider = 1 + max(excess, 0.0) * len(runs) / sum(run.stop - run.start for run in runs)
        swings = scipy.special.chdtrc(np.maximum(freedom, 1) / wider, peaks / wider)
        found.append((swings, share, size / frequencies * step, of_noise))
    chances, shares, periods = (np.concatenate([one[k] for one in found]) for k in range(3))
    which = np.concatenate([np.full(len(one[0]), one[3]) for one in found])
    worst = np.argmin(chances / shares)
    values = {"period": float(periods[worst]), "of_noise": bool(which[worst])}
    verdict = _verdict("unchanged", _combined(chances, shares), limit, **values)
    # A drift of the force from -a to a is a√h/√q of each residual in its direction, and 4as/q of U/ε along s.
    told = rest.without(clocks[0] * np.sqrt(rest.pairs.h)[:, None])
    least = -scipy.special.ndtri(limit / (4 * len(tried) * len(clocks))) + scipy.special.ndtri(POWER)
    change = 4 * rest.reach * float(least / np.linalg.norm(told))
    drift = sentence(Remark("inference.drift_unseen", {"change": change}))
    return replace(verdict, reason=drift) if verdict.passed else verdict


def _state_complete(rest: _Residuals, limit: float) -> Verdict:
    found: list[tuple[float, float, str]] = []
    shapes = rest.states
    forces = (rest.noise[:, :, None] * shapes[:, None, :]).reshape(len(shapes), -1)
    for memory in rest.memories():
        pushed = rest.past(forces, memory).reshape(len(shapes), -1, shapes.shape[1]) * shapes[:, None, :]
        found += [
            (rest.probability(pushed.reshape(len(shapes), -1), rest.noise), memory, "force"),
            (rest.probability(rest.past(shapes[:, 1:], memory), rest.noise), memory, "past"),
            (rest.probability(rest.past(rest.power, memory), rest.power), memory, "noise"),
        ]
        found += [
            (rest.probability(rest.gated(memory, shape), rest.noise), memory, "force") for shape in shapes.T
        ]
    if not found:
        return Verdict.not_tested(sentence(Remark("inference.runs_too_short")))
    time = min(found)[1] * float(np.median(rest.pairs.h))
    chance = _combined(np.array([one[0] for one in found]))
    return _verdict("state_complete", chance, limit, memory=time, kind=min(found)[2])


def _gaussian(rest: _Residuals, recordings: Recordings, limit: float) -> Verdict:
    # A fourth cumulant k of a step changes the action of a path by its share k (2fh)²/(12 εh); what changes
    # barriers by less is harmless, and makes tails larger by 1 + k (z⁴ - 3z²)/24 (Edgeworth).
    away, harmless = np.abs(rest.noise), min(12 * HARMLESS_CHANGE / max(4 * rest.drift, 1e-300), 1.0)

    def beyond(z: float, cumulant: float) -> float:
        return 2 * float(scipy.special.ndtr(-z)) * (1 + cumulant * (z**4 - 3 * z**2) / 24) * away.size

    largest, many, few = float(away.max()), int((away > TAIL).sum()), int((away > EDGE).sum())
    most, least = beyond(TAIL, harmless), beyond(EDGE, -harmless)
    chances: list[tuple[float, str, float, str]] = [  # probability, kind, figure, and the state that repeats
        (beyond(largest, harmless), "jump", largest, ""),
        (float(scipy.special.gammainc(many, most)), "tails", many / most, ""),
        (float(scipy.special.pdtr(few, least)), "cut", few / least, ""),
    ]
    for column in np.flatnonzero(rest.noisy[: recordings.values.shape[1]]):
        chances += [(*one, recordings.titles[column]) for one in repetitions(recordings, int(column))]
    chance, kind, value, state = min(chances)
    if state:
        told = sentence(Remark("inference.repeated", {"kind": kind, "value": value, "state": state}))
        return Verdict.of_probability(chance * len(chances), limit, told)
    return _verdict("gaussian_increments", chance * len(chances), limit, kind=kind, value=value)
