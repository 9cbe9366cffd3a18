"""Preparation of recordings: what is refused, left out, cut or taken off before anything is learned.

A single long recording is cut into stretches, of which some can be held out or drawn again, and less what
drifts slowly in it. Columns that never change are no states. Each step leaves a remark.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from typing import Literal

import numpy as np
from scipy import ndimage, optimize, special

from siq.data.correlation import markov_lag, noise_floors, resolution_step
from siq.data.recordings import (
    MOST_WIDE_STEPS,
    ROUNDED_TURN,
    Recordings,
    SnapshotPairs,
    read_recordings,
    snapshot_pairs,
)
from siq.data.states import switching
from siq.data.stationarity import (
    HARMLESS_LINE,
    background_of,
    change_of,
    correlated_samples,
    runs_of,
    usual_step,
)
from siq.errors import InputError
from siq.numerics.randomness import positive
from siq.remarks import Remark

FULL_TURNS = {2 * np.pi: "2π", 360.0: "360"}  # of an angle, in radians and in degrees
ANGLES = ("data.wrapped_angle", "data.unwrapped_angle")  # codes of remarks on columns that are one
# Choices: turns that show f to be the same in each; probabilities that f has no such period, and that it has.
FEWEST_TURNS, OF_A_TURN, NOT_OF_A_TURN = 3, 1e-6, 0.01
ENDS_OF_TURN = 0.05  # of a turn, within which a column that jumps by one comes to 0 and 1 of it, or to ±½
FEWEST_STRETCHES = 10  # of few recordings together, at least, two of which are held out
MOST_STRETCHES = 40  # more make no error better known
STRETCH_LENGTH = 10  # correlation times: what is left of its first sample at its end is then nothing
BLOCK = 200  # steps, whose median says how large steps are thereabouts
FALSE_FAULT_RATE = 1e-3  # probability with which a record of white noise has a step that stands out
FEW_JUMPS, MOST_APART = 0.05, 0.01  # that stay, a sample that does not; of all samples
MOST_ALIKE = 0.1  # of all samples, where most that stand apart are one number; of held values, one number
QUARTERS, SAME_WAVE = 4, 0.5  # of a recording, in which a hum has one amplitude and phase, to a half of it
STEP_KNOWN = 4 * np.sqrt(2)  # errors of the clock, of two samples: steps as long are known to a quarter
BY_CHANCE = 2.5  # standard errors of such an amplitude and phase: four in five records are within
SLIGHT_HUM = 0.1  # of the variance of a state: what moves it more may be the state itself, which circulates
SEASONS = {"day": 86_400.0, "year": 31_556_952.0}  # seconds: what the sun does to what stands outdoors
DRIFT_DEGREE, HUM_ROUNDS = 7, 4  # of the mean step by the state; rounds over that and a hum in turn
HUM_ODDS = 2 * np.log(100)  # of a hum against a force that swings, twice their logarithm
MAINS, MAINS_VARY = np.outer((50.0, 60.0), (1, 2, 3, 4)), 0.002  # hertz; relative, in most grids
_SECONDS = {
    "[uµμ]s": 1e-6, "m(s|sec|illisec.*)": 1e-3, "s(ec.*)?": 1, "min.*": 60, "h.*": 3600, "d.*": 86_400,
    "week.*": 604_800, "y.*": 31_556_952,
}  # fmt: skip
FEWEST_SEASONS, MOST_HARMONICS = 4, 4
KNOWN_SCALE = 0.01  # a choice: relative error to which a velocity tells how its position moves
SMALL_CHANGE = 0.3  # standard deviations: up to there a distribution is flat
STATE_PARTS, LEAST_SPREAD = 20, 0.01  # of samples by their state; of the largest spread, where all are held
ROUNDED_LINE = 2  # steps by which a straight line that is rounded is bent at most
SMALL_STEP, FEWEST_SMALL = 0.2, 0.05  # of the median step; of steps, at least: half of what normal ones have
FEWEST_TOGETHER = 0.1  # a choice: of samples with a new value of any state, those with one of all
COPIED = 12  # samples of a stretch that is sought a second time
NEIGHBOURS, NEARBY = 3, 20  # samples on either side: of a cubic; of how well one fits there
SMOOTH_AROUND = 8  # a choice: times as far off is an outlier as any neighbour; a kink at a sample is by five
MOST_TOGETHER, MOST_ROUNDS = 2, 10  # outliers with values of their own; of taking samples for them
PULSE = 0.1  # a choice: of the range of an input, up and down within two samples
MOST_OUTLIERS = 0.05  # a choice: of all samples; what stands apart more often belongs to the system
MOST_DIGITS = 12  # of numbers that were rounded: those of floating point have sixteen
HARMLESS_SHARE = 2e-4  # a choice: of values that repeat themselves; about as little is missing of D
ALIKE = 1e-9  # of the rms step: closer values, or steps, are the same
_STRETCH_LABEL = re.compile(r"(?P<label>.*) \((?P<number>\d+) of (?P<of>\d+)\)")


def read_pairs(
    path: str | Path, *, states: Sequence[str] | None, units: Mapping[str, str] | None,
    pair_step: float | None,
) -> tuple[Recordings, SnapshotPairs]:  # fmt: skip
    """Read recordings that something is to be learned from (`read_recordings`), and their `snapshot_pairs`.

    Raises
    ------
    InputError
        As `read_recordings` does, for a state that never changes, and when no two samples are close enough
        to be a pair.
    """
    recordings = read_recordings(path, columns=states, units=units)
    recordings = _checked_for_learning(recordings, file=str(path), chosen=states is not None)
    try:
        pairs = snapshot_pairs(recordings, pair_step=pair_step)
    except ValueError as error:
        raise InputError(path, "", str(error), "raise recordings.pair_step in the study") from None
    without = len(recordings.labels) - len(np.unique(pairs.recording))
    single = int((np.bincount(recordings.recording) == 1).sum())
    if without > single:
        values = {"recordings": without - single, "all": len(recordings.labels)}
        remark = Remark("data.recordings_without_pairs", values)
        recordings = replace(recordings, remarks=(*recordings.remarks, remark))
    return recordings, pairs


def _checked_for_learning(recordings: Recordings, *, file: str, chosen: bool) -> Recordings:
    """Refuse what nothing can be learned from; leave out angles that cannot be unwrapped, unless `chosen`."""
    coarse = {one.values["name"]: one for one in unusual(recordings) if one.values.get("wide")}
    others = [place for place, name in enumerate(recordings.names) if name not in coarse]
    if coarse and others and not chosen:
        told = [replace(one, values={**one.values, "left_out": True}) for one in coarse.values()]
        recordings = recordings.of_states(others, told)
    still = np.ptp(recordings.values, axis=0) == 0
    if still.any():
        first = int(np.argmax(still))
        fault = f"it is {recordings.values[0, first]:g} in every row, and what never changes is no state"
        remedy = "leave it out of the states" if chosen else "record how the system moves"
        raise InputError(file, f"column {recordings.titles[first]}", fault, remedy)
    return replace(recordings, remarks=(*recordings.remarks, *unusual(recordings)))


def _shows_no_process_noise(recordings: Recordings) -> bool:
    floors = noise_floors(recordings)
    return floors is not None and all(floor.process == 0 for floor in floors)


def turns_back(recordings: Recordings) -> bool:
    """Whether one recorded state without process noise turns back, more than once, by a third of its range.

    A force on the state alone moves it one way only; what turns back has a velocity, or is driven.
    """
    if len(recordings.names) > 1 or not _shows_no_process_noise(recordings):
        return False
    x = recordings.values[:, 0]
    low, high = x.min() + np.ptp(x) * np.array([1 / 3, 2 / 3])
    sides = (np.sign((x[run] > high) - 1.0 * (x[run] < low)) for run in runs_of(joined(recordings)))
    return any((np.diff(side[side != 0]) != 0).sum() > 1 for side in sides)


def unusual(recordings: Recordings) -> list[Remark]:
    """What is unusual, and may be wrong."""
    single = int((np.bincount(recordings.recording) == 1).sum())
    found = [Remark("data.single_samples", {"recordings": single})] if single else []
    inside = recordings.recording[1:] == recordings.recording[:-1]
    named = zip(recordings.names, recordings.titles, recordings.values.T, strict=True)
    for name, title, values in named:
        jumps = np.abs(np.diff(values)[inside])
        for turn, text in FULL_TURNS.items():
            count = int((jumps > 0.75 * turn).sum())
            wide = ((jumps > 0.25 * turn) & (jumps < 0.75 * turn)).mean() if len(jumps) else 0.0
            ends = np.array([values.min(), values.max()])
            within = [np.abs(ends - np.array(each) * turn).max() for each in ((0, 1), (-0.5, 0.5))]
            close = min(within) < ENDS_OF_TURN * turn and np.ptp(values) <= turn * (1 + ROUNDED_TURN)
            if count > ((jumps > 0.5 * turn) & (jumps < 0.75 * turn)).sum() and close:
                told = {"column": title, "name": name, "turn": text, "count": count}
                told |= {"wide": 0.0 if wide <= MOST_WIDE_STEPS else float(wide), "left_out": False}
                found.append(Remark("data.wrapped_angle", told))
            far = wide <= MOST_WIDE_STEPS and np.ptp(values) > FEWEST_TURNS * turn
            if far and _repeats_itself(values[:-1][inside], np.diff(values)[inside], turn):
                found.append(Remark("data.unwrapped_angle", {"column": title, "name": name, "turn": text}))
    return found


def _repeats_itself(x: np.ndarray, moves: np.ndarray, turn: float) -> bool:
    """Whether what moves a state is the same a turn on: it depends on the phase, and not on the turn."""
    waves = np.exp(2j * np.pi * np.outer(x, [1, 2]) / turn)
    shapes = np.column_stack([np.ones(len(x)), waves.real, waves.imag])
    quarter = np.searchsorted(np.quantile(x, np.arange(1, QUARTERS) / QUARTERS), x)
    own = shapes[:, :, None] * (quarter[:, None] == np.arange(QUARTERS))[:, None]
    designs = (shapes[:, :1], shapes, own.reshape(len(x), -1))
    left = np.array([np.linalg.lstsq(one, moves, rcond=None)[1].sum() for one in designs])
    sizes = np.array([one.shape[1] for one in designs])
    more, free = np.diff(sizes), len(x) - sizes[1:]
    of_phase, of_turn = special.fdtrc(more, free, -np.diff(left) / more * free / positive(left[1:]))
    return bool(of_phase < OF_A_TURN and of_turn > NOT_OF_A_TURN and left[2] > 0)


def in_stretches(recordings: Recordings, *, hidden_velocities: bool | Literal["auto"] = False) -> Recordings:
    """Cut few recordings into stretches, of which some can be held out, or drawn again.

    Stretches are ten correlation times long, hops included, where this makes between ten and forty of them.
    Of few recordings the one that is held out may be the only one to have been in a well. Ten and more come
    back as they are; so do several of fewer than 1,000 samples, of whose pairs ten cuts cost a hundredth, and
    those without noise, as what settles once does so in no other stretch, unless velocities are hidden.
    """
    count, several = len(recordings.t), len(recordings.labels)
    if several >= FEWEST_STRETCHES or count < FEWEST_STRETCHES * (2 if several == 1 else 100):
        return recordings
    smooth = hidden_velocities is not True and _shows_no_process_noise(recordings)
    if smooth and not (hidden_velocities and turns_back(recordings)):
        return recordings
    runs = runs_of(recordings, bridged=True)
    longest = max(correlated_samples(column, runs) for column in recordings.values.T)
    cut = int(np.clip(count / (STRETCH_LENGTH * longest), FEWEST_STRETCHES, min(MOST_STRETCHES, count // 2)))
    counts = np.bincount(recordings.recording)
    parts = -(-cut * counts // count)  # rounded up
    rows = [np.arange(n) * each // n for n, each in zip(counts, parts, strict=True)]
    names = zip(recordings.labels, parts, strict=True)
    labels = [f"{name} ({number} of {each})" for name, each in names for number in range(1, each + 1)]
    remark = Remark("data.cut_recording", {"stretches": int(parts.sum()), "of": several})
    return replace(
        recordings, labels=tuple(labels), remarks=(*recordings.remarks, remark),
        recording=np.concatenate(rows) + np.repeat(np.cumsum(parts) - parts, counts),
    )  # fmt: skip


def joined(recordings: Recordings) -> Recordings:
    """Put together again what `in_stretches` has cut, where one stretch follows the other.

    What takes long, such as a hop or a memory, is not seen in a stretch: how long a record remembers, and how
    it hops, is asked of the record as a whole. Rows stay as they are.
    """
    matches = [_STRETCH_LABEL.fullmatch(label) for label in recordings.labels]
    parts = [(one["label"], one["of"], int(one["number"])) if one else (None, None, 0) for one in matches]
    follows = [other[0] is not None and (*one[:2], one[2] + 1) == other for one, other in pairwise(parts)]
    begins = ~np.array([False, *follows])
    if begins.all():
        return recordings
    labels = [recordings.labels[place] for place in np.flatnonzero(begins)]
    wholes = [parts[place][0] or recordings.labels[place] for place in np.flatnonzero(begins)]
    # Of recordings drawn again, some may follow, and others not.
    labels = wholes if len(set(wholes)) == len(wholes) else labels
    return replace(recordings, labels=tuple(labels), recording=(np.cumsum(begins) - 1)[recordings.recording])


def without_faults(recordings: Recordings) -> Recordings:
    """Recordings less what the system did not do.

    Values that were filled in and samples that stand apart are left out, day and year and the hum of mains
    taken off. A sample stands apart whose steps from the last and to the next are larger than noise makes one
    in all of the record, or one of them and the other nearly, and lead back to where it came from; so do two
    samples together, and several of one value, where most such faults last one sample only. Where more than a
    few such steps do not lead back, the state itself jumps, and nothing is left out. A hum is a line in the
    spectrum of the steps that keeps its amplitude and its phase in every quarter of a recording, and that
    hardly moves the state; at 50 or 60 Hz, and up to four times that, it may be as slight as it likes. Of
    each state four such lines are taken off at most. What has the period of a day or of a year, and is alike
    in each, is the weather's. Where the clock errs, one of so many samples is kept that steps are known to a
    quarter.
    """
    if noise_floors(recordings) is None:
        return recordings
    recordings = _without_filled(recordings)
    apart, remarks = np.zeros(len(recordings.t), dtype=bool), list(recordings.remarks)
    for state in range(len(recordings.names)):
        same, moves = np.diff(recordings.recording) == 0, np.diff(recordings.values[:, state])
        begins = np.flatnonzero(np.r_[True, ~same | (moves != 0)])  # of stretches of one value
        lasts = np.diff(np.r_[begins, len(recordings.t)])
        steps = np.where(same, moves, 0.0)[begins[1:] - 1]
        if not len(steps):  # it never changes
            continue
        blocks = [np.abs(one) for one in np.array_split(steps, max(len(steps) // BLOCK, 1))]
        usual = np.repeat([np.median(one) for one in blocks], [len(one) for one in blocks])
        scale = np.maximum(usual, np.median(usual)) / special.ndtri(0.75)
        largest = -special.ndtri(FALSE_FAULT_RATE / 2 / len(steps)) * scale
        size, large = np.abs(steps), np.abs(steps) > largest
        # One step may be just too short to be large; and a fault may follow another.
        either = np.maximum(size[:-1], size[1:]) > largest[1:]
        both = np.minimum(size[:-1], size[1:]) > largest[1:] / 2
        alone = either & both & (np.abs(steps[:-1] + steps[1:]) <= largest[1:])
        back = np.abs(steps[:-2] + steps[1:-1] + steps[2:]) <= largest[1:-1]
        pair = large[:-2] & large[2:] & back & ~alone[:-1] & ~alone[1:]
        alone[:-1] |= pair
        alone[1:] |= pair
        if 2 * (alone & (lasts[1:-1] == 1)).sum() < alone.sum():
            alone &= lasts[1:-1] == 1
        left_out = np.repeat(np.r_[False, alone, False], lasts)
        numbers, times = np.unique(recordings.values[left_out, state], return_counts=True)
        if alike := times.max(initial=0) > max(times.sum() / 2, 1):  # what lies between two of them is right
            left_out &= recordings.values[:, state] == numbers[np.argmax(times)]
        jumps = int((large & ~(np.r_[alone, False] | np.r_[False, alone])).sum())
        count = int(left_out.sum())
        most = (MOST_ALIKE if alike else MOST_APART) * len(recordings.t)
        few = jumps <= FEW_JUMPS * alone.sum() and 0 < count <= most
        # What jumps where there is no noise was measured; large faults would hide the noise.
        floors = noise_floors(_without_rows(recordings, left_out)) if few else None
        if floors and floors[state].process:
            apart |= left_out
            values = {"column": recordings.titles[state], "samples": count}
            remarks.append(Remark("data.samples_apart", values))
    found = _without_rows(recordings, apart)
    if (seen := markov_lag(found)).kind == "clock":
        every = math.ceil(STEP_KNOWN * seen.memory / seen.step)
        begins = np.searchsorted(found.recording, found.recording)
        found = _without_rows(found, (np.arange(len(found.t)) - begins) % every != 0)
        values = {"every": every, "error": seen.memory, "unit": found.time_unit}
        remarks.append(Remark("data.clock", values))
    for state, name in product(range(len(found.names)), SEASONS):
        season = _season_of(found, found.values[:, state], name)
        if season.any():
            found.values[:, state] -= season
            values = {"column": found.titles[state], "period": name, "range": float(np.ptp(season))}
            remarks.append(Remark("data.season_taken_off", {**values, "unit": found.units[state]}))
    for state in [place for place, floor in enumerate(noise_floors(found) or ()) if floor.process]:
        for _ in range(MOST_HARMONICS):
            hum, period = _hum_of(found, found.values[:, state])
            amplitude = float(np.sqrt(2) * hum.std())
            if not amplitude > (resolution_step(found.values[:, state]) or 0.0):
                break
            found.values[:, state] -= hum
            told = {"column": found.titles[state], "period": period, "amplitude": amplitude}
            units = {"unit": found.units[state], "time_unit": found.time_unit}
            remarks.append(Remark("data.hum_taken_off", told | units))
    return replace(found, remarks=tuple(remarks)) if len(remarks) > len(recordings.remarks) else recordings


def outliers(t: np.ndarray, x: np.ndarray, recording: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Which samples of a motion that is smooth in pieces the sensor alone has made, shape ``(n,)``.

    An outlier is off the cubic through its neighbours, outliers left out, by more than noise makes of any
    sample of the record. These lie on that cubic, and the straight lines of either side miss the outlier in
    the same direction: next to a kink or a jump one of them does not. What lasts for several samples is one
    only where all are one number, as when a sensor drops out. They are left in where they are not most of
    what the sensor adds, by their squares. Not to be confused with what `without_faults` leaves out, which
    has no smooth motion to be held against.

    Parameters
    ----------
    t, x, recording
        Times, values (NaN where there is none), and the place of the recording of each, shape ``(n,)``.
    inputs
        What moves the system, shape ``(k, n)``: beside a pulse of one sample nothing is an outlier.
    """
    rows, result = np.flatnonzero(np.isfinite(x)), np.zeros(len(x), dtype=bool)
    t, values, which = t[rows], x[rows], recording[rows]
    every, width, suspects = np.arange(len(rows)), 2 * NEIGHBOURS + 1, np.zeros(len(rows), dtype=bool)
    if len(rows) <= 2 * NEARBY:
        return result

    def cubic(used: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How far each sample is off the cubic through those near it, these at most, and over which time."""
        first, end = (np.searchsorted(which[used], which, side) for side in ("left", "right"))
        begin = np.maximum(np.minimum(np.searchsorted(used, every) - NEIGHBOURS, end - width), first)
        near = used[np.minimum(begin[:, None] + np.arange(width), len(used) - 1)]
        others, times = near != every[:, None], t[near] - t[:, None]
        span = positive(np.ptp(times, axis=1))
        powers = (times / span[:, None])[..., None] ** np.arange(4)
        solved = np.linalg.pinv(powers * others[..., None])
        found = np.einsum("nij,nj->ni", solved, values[near] * others)
        around = np.abs(values[near] - np.einsum("nij,nj->ni", powers, found)) * others
        off = np.abs(values - found[:, 0]) / np.sqrt(1 + (solved[:, 0] ** 2).sum(axis=1))
        return np.where(end - first >= width, off, 0.0), around.max(axis=1), span

    # A cubic through every second sample shows whether a longer time makes it worse: not if it is noise.
    off, around, span = cubic(every)
    worse = np.median(cubic(every[::2])[0][::2]) / positive(np.median(off))
    power = np.clip(np.log2(positive(worse)), 0, 4)
    step, most = resolution_step(values) or 0.0, -special.ndtri(FALSE_FAULT_RATE / 2 / len(rows))
    for _ in range(MOST_ROUNDS):
        used = np.flatnonzero(~suspects)
        if suspects.any():
            off, around, span = cubic(used)
        usual = np.maximum(ndimage.median_filter(off[used], 2 * NEARBY + 1), np.median(off[used]))
        usual = np.maximum(usual / special.ndtri(0.75), step)[np.minimum(np.cumsum(~suspects), len(used) - 1)]
        apart = off > SMOOTH_AROUND * around
        large = off > most * usual * np.maximum(span / np.median(span), 1) ** power
        before, suspects = suspects, large & (apart | suspects | ~suspects.any())
        if (before == suspects).all() or (~suspects).sum() <= 2 * NEARBY:
            break
    apart &= suspects
    for u in inputs:
        steps, back = np.abs(np.diff(u)) > PULSE * np.ptp(u), np.diff(u[1:]) * np.diff(u[:-1]) < 0
        apart &= ~ndimage.binary_dilation(np.r_[False, steps[1:] & steps[:-1] & back, False])[rows]
    for row in np.flatnonzero(apart):
        sides = (used[used < row][:-3:-1], used[used > row][:2])
        if any(len(side) < 2 or (which[side] != which[row]).any() for side in sides):
            apart[row] = False
            continue
        slopes = [np.diff(values[side])[0] / np.diff(t[side])[0] for side in sides]
        far = [
            values[row] - values[i] - slope * (t[row] - t[i])
            for (i, _), slope in zip(sides, slopes, strict=True)
        ]
        apart[row] = far[0] * far[1] > 0 and min(np.abs(far)) > off[row] / 2
    for run in np.split(np.flatnonzero(apart), np.flatnonzero(np.diff(np.flatnonzero(apart)) > 1) + 1):
        result[rows[run]] = len(run) <= MOST_TOGETHER or np.ptp(values[run]) == 0
    few, squares = result.sum() <= MOST_OUTLIERS * len(rows), off**2
    return result & few & (squares[result[rows]].sum() > squares.sum() / 2)


def _without_rows(recordings: Recordings, left_out: np.ndarray) -> Recordings:
    kept = {name: getattr(recordings, name)[~left_out] for name in ("t", "recording", "values")}
    return replace(recordings, **kept)


def _without_filled(recordings: Recordings) -> Recordings:
    """Recordings less samples that repeat the one before, or lie on a straight line between their neighbours.

    A file holds a value until the next one is measured, or fills gaps along lines, if noisy values repeat
    themselves more often than `repetitions` allows. Of values at which a sensor is clipped, which are few, of
    one that stays until it is moved far enough, which makes no small steps, and of states that were hardly
    ever measured together nothing is left out.
    """
    x, same = recordings.values, np.diff(recordings.recording) == 0
    rate, filled, told = FALSE_FAULT_RATE / x.shape[1], np.zeros(x.shape, dtype=bool), list[Remark]()
    for column, title in enumerate(recordings.titles):
        moves, own = np.diff(x[:, column]), filled[:, column]
        near = ALIKE * float(np.sqrt((moves[same] ** 2).mean())) if same.any() else 0.0
        if not any((np.abs(each) <= near).any() for each in (moves, np.diff(moves))):  # as in most files
            continue
        again, step = np.r_[False, same & (np.abs(moves) <= near)], resolution_step(x[:, column]) or 0.0
        likely = {kind for chance, kind, _ in repetitions(recordings, column) if chance < rate}
        if "held" in likely:
            numbers = np.unique(x[again & ~np.roll(again, 1), column], return_counts=True)[1]
            sizes = np.abs(np.diff(x[~again, column])[np.diff(recordings.recording[~again]) == 0])
            small = (sizes < SMALL_STEP * np.median(sizes)).mean() if len(sizes) else 0.0
            if numbers.max(initial=0) <= MOST_ALIKE * numbers.sum() and small >= FEWEST_SMALL:
                own |= again
        bend = max(near, (ROUNDED_LINE + 0.5) * step)
        if "straight" in likely and bend < SMALL_STEP * np.median(np.abs(moves[same & ~again[1:]])):
            bent = np.abs(np.diff(moves)) > bend
            own[1:-1] |= same[1:] & same[:-1] & ~bent & ~again[1:-1] & ~again[2:]
        if own.any():
            told.append(Remark("data.filled_left_out", {"column": title, "samples": int(own.sum())}))
    if not told or (~filled).all(axis=1).sum() < FEWEST_TOGETHER * (~filled).any(axis=1).sum():
        return recordings
    return replace(_without_rows(recordings, filled.max(axis=1)), remarks=(*recordings.remarks, *told))


def _seconds_of(recordings: Recordings) -> float:
    """In the unit of time; 0 where that is not known."""
    return next(
        (size for one, size in _SECONDS.items() if re.fullmatch(one, recordings.time_unit or "")), 0.0
    )


def _season_of(recordings: Recordings, values: np.ndarray, name: str) -> np.ndarray:
    """What recurs each day or year in a series, ``(n,)``; zero where it is not alike in all of them.

    The amplitude of a harmonic is the mean of those of single periods, and is held against how these differ.
    """
    unit = _seconds_of(recordings)
    season, step = np.zeros(len(values)), usual_step(recordings)
    samples = SEASONS[name] / (unit * step) if unit * step > 0 else 0.0  # in a period
    harmonics = np.arange(1, min(MOST_HARMONICS, int(samples / 4)) + 1)
    same = np.flatnonzero(np.diff(recordings.recording)) + 1
    phase = 2 * np.pi * recordings.t / (SEASONS[name] / max(unit, 1))
    each = []  # amplitudes in single periods
    for part in np.split(np.arange(len(values)), same) if len(harmonics) else ():
        turn = (phase[part] - phase[part[0]]) // (2 * np.pi)
        periods = np.split(part, np.flatnonzero(np.diff(turn)) + 1)
        # How recordings begin may be alike in all of them, and is no season.
        for rows in periods if len(same) == 0 else periods[1:]:
            if len(rows) > 0.8 * samples:
                waves = np.exp(1j * np.outer(phase[rows], harmonics))
                line = np.vander(np.linspace(-1, 1, len(rows)), 2)
                columns = np.column_stack([line, waves.real, -waves.imag])
                found = np.linalg.lstsq(columns, values[rows], rcond=None)[0][2:].reshape(2, -1)
                each.append(found[0] + 1j * found[1])
    if len(each) < FEWEST_SEASONS:
        return season
    mean, differ = np.mean(each, axis=0), np.var(each, axis=0, ddof=1)
    chance = special.fdtrc(2, 2 * len(each) - 2, len(each) * np.abs(mean) ** 2 / positive(differ))
    recurring = chance < FALSE_FAULT_RATE / (len(SEASONS) * len(harmonics))
    for harmonic, amplitude in zip(harmonics, mean * recurring, strict=True):
        season += (amplitude * np.exp(1j * harmonic * phase)).real
    return season


def _hum_of(recordings: Recordings, values: np.ndarray) -> tuple[np.ndarray, float]:
    """The hum in a series, ``(n,)`` and zero where there is none, and its period in the unit of time.

    Hops hide a slight one. At mains the mean step from a state is taken off, and ``h(t + Δt) - s h(t)`` is
    left of a hum h, where a share s of the state stays. Elsewhere a force that swings would be taken for one.
    """
    bounds = np.searchsorted(recordings.recording, np.arange(len(recordings.labels) + 1))
    parts = [slice(int(a), int(b)) for a, b in pairwise(bounds) if b - a > QUARTERS]
    nothing, last = np.zeros(len(values)), bounds[1:] - 1
    if not parts:
        return nothing, 0.0
    width, seconds = np.pi / max(float(np.ptp(recordings.t[part])) for part in parts), _seconds_of(recordings)

    def moves(series: np.ndarray, *, back: bool) -> tuple[np.ndarray, np.ndarray]:
        """Steps from each value, less their mean where that is taken off, and the share that stays."""
        steps, stays = np.append(np.diff(series), 0.0), np.ones(len(series))
        if back and np.ptp(domain := np.quantile(series, [0.001, 0.999])) > 0:
            place = np.clip(series, *domain)
            known = np.delete(np.stack([place, steps]), last, axis=1)
            mean = np.polynomial.Legendre.fit(known[0], known[1], DRIFT_DEGREE, domain=domain)
            steps, stays = steps - mean(place), 1 + mean.deriv()(place)
        steps[last] = 0.0
        return steps, stays

    for harmless, back in ((HARMLESS_LINE, False), (0.0, False), (0.0, True))[: 3 if seconds else 1]:
        series, path = moves(values, back=back)[0], np.zeros(len(values), dtype=int)
        period = change_of(recordings, series, path, harmless=harmless)
        if period is None or not np.isfinite(period):
            continue
        about = 2 * np.pi / (period * usual_step(recordings))
        hertz = about / (2 * np.pi * (seconds or np.inf))
        mains = bool((np.abs(hertz / MAINS - 1) < max(MAINS_VARY, width / about)).any())
        if harmless or mains:
            break
    else:
        return nothing, 0.0
    steps, stays = moves(values, back=mains)

    def fitted(frequency: float, part: slice, stays: np.ndarray) -> tuple[complex, float, float]:
        """Amplitude by the steps of a part, squares left of these, and what an amplitude of 1 does to one."""
        wave = np.exp(1j * frequency * recordings.t[part])
        moved = np.asarray(wave[1:] - stays[part][:-1] * wave[:-1])
        waves = moved[:, None].view(float) * [1, -1]
        found, squares, *_ = np.linalg.lstsq(waves, steps[part][:-1], rcond=None)
        return complex(*found), float(squares.sum()), float(np.abs(moved).mean())

    def left(frequency: float, stays: np.ndarray) -> float:
        return sum(fitted(frequency, part, stays)[1] for part in parts)

    around = (about - width, about + width)
    frequency = float(optimize.minimize_scalar(left, args=(stays,), bounds=around, method="bounded").x)
    hum = nothing.copy()
    for _ in range(HUM_ROUNDS if mains else 1):  # a strong hum blurs the mean step at first
        steps, stays = moves(values - hum, back=mains)
        steps += np.append(np.diff(hum), 0.0) + (1 - stays) * hum
        for part in parts:
            hum[part] = (fitted(frequency, part, stays)[0] * np.exp(1j * frequency * recordings.t[part])).real
    # A force that swings moves all states alike, a hum those more that lead back. In one well both are one.
    odds = (left(frequency, 0 * stays) - left(frequency, stays)) / steps.var()
    if mains and odds < (HUM_ODDS if back else -HUM_ODDS):
        return nothing, 0.0
    for part in parts:
        (whole, _, moved), length = fitted(frequency, part, stays), part.stop - part.start
        cuts = part.start + length * np.arange(QUARTERS + 1) // QUARTERS
        each = [fitted(frequency, slice(int(a), int(b)), stays)[0] for a, b in pairwise(cuts)]
        error = steps[part].std() * np.sqrt(2 * QUARTERS / length) / moved
        if max(abs(one - whole) for one in each) > SAME_WAVE * abs(whole) + BY_CHANCE * error:
            return nothing, 0.0
    return (hum, 2 * np.pi / frequency) if hum.var() < SLIGHT_HUM * values.var() else (nothing, 0.0)


def without_velocity(recordings: Recordings) -> Recordings:
    """Recordings of a position and its velocity less the velocity, where noise acts on that alone.

    D then has no inverse, and f with its noise is found from the position, whose velocity is a state again.
    Over a step h a position moves by ``c h (v + v') / 2``, off that by ``c² h² q / 12`` in the mean square
    where v moves by q (Brownian bridge), and by errors of its sensor, which the next step takes back. What
    has noise of its own moves by more; twelve times the bridge is let pass.
    """
    floors = noise_floors(recordings) if len(recordings.names) == 2 else None
    inside = np.diff(recordings.recording) == 0
    steps, moves = np.diff(recordings.t), np.diff(recordings.values, axis=0)
    for velocity in (0, 1):
        if floors is None or not floors[velocity].process:
            continue
        values = recordings.values[:, velocity]
        swept = np.where(inside, steps * (values[1:] + values[:-1]) / 2, 0.0)
        moved = np.where(inside, moves[:, 1 - velocity], 0.0)
        scale = float(moved @ swept) / float(swept @ swept)
        rest = moved - scale * swept
        error = 4 * float(rest @ rest) / np.sqrt(inside.sum())
        apart = max(float(rest @ rest + 2 * rest[1:] @ rest[:-1]), error)
        free = scale**2 * float(((steps * moves[:, velocity])[inside] ** 2).sum())
        known = KNOWN_SCALE**2 * scale**2 * float(swept @ swept)
        if apart < free and apart / inside.sum() < known:
            told = {"column": recordings.titles[velocity], "position": recordings.titles[1 - velocity]}
            found = recordings.of_states([1 - velocity], [Remark("data.velocity_found_again", told)])
            enough = len(found.labels) > 1 or turns_back(found) or not _shows_no_process_noise(found)
            return found if enough else recordings
    return recordings


def without_background(recordings: Recordings) -> Recordings:
    """Recordings less what is no property of the system, which is remarked for each quantity.

    Of a single long recording that is slow drift: what all levels have in common where it supports several
    states, otherwise what slow cosines explain. Of several that hop it is the baseline of each, where these
    differ beyond chance; how others begin may be a part of what they show, and they come back as they are. So
    does a record without process noise, in which nothing but the system itself moves.
    """
    single = len(recordings.labels) == 1
    floors = noise_floors(recordings) if single else ()
    if floors is None or any(floor.process == 0 for floor in floors):
        return recordings
    if not single and not markov_lag(recordings).may_hop:
        return recordings
    found = switching(recordings, rungs=False)
    hops = found if found is not None and found.supported else None
    visits = np.zeros(len(recordings.t), dtype=int) if hops is None else hops.visits + 1
    flat, remarks = recordings.values.copy(), list(recordings.remarks)
    for state, (title, values) in enumerate(zip(recordings.titles, recordings.values.T, strict=True)):
        background = np.zeros(len(values))
        if hops is not None and title == hops.state:
            background = hops.background if single else hops.baseline
        elif single:
            # What differs between the states of another quantity hops with it, and is no drift.
            level = np.bincount(visits, values) / np.maximum(np.bincount(visits), 1)
            background = background_of(recordings, values - level[visits])
        if not background.any():
            continue
        flat[:, state] -= background
        told = {"column": title, "range": float(np.ptp(background)), "unit": recordings.units[state]}
        baseline = Remark("data.baselines_taken_off", told)
        remarks.append(Remark("data.drift_taken_off", told) if single else baseline)
    if len(remarks) == len(recordings.remarks):
        return recordings
    return replace(recordings, values=flat, remarks=tuple(remarks))


def repetitions(recordings: Recordings, column: int) -> list[tuple[float, str, float]]:
    """Values of a noisy state that repeat themselves: the probability of so many, their kind, their share.

    ``held``: equal to the one before. ``straight``: steps that are. ``copied``: stretches of `COPIED` samples
    that stand in the recordings twice. What rounding to a resolution step makes of it is allowed for.
    """
    x, which = recordings.values[:, column], recordings.recording
    same, moves = np.diff(which) == 0, np.diff(x)
    size = float(np.sqrt((moves[same] ** 2).mean())) if same.any() else 0.0
    if len(x) <= COPIED or not size > 0:
        return []
    # Less a straight drift, what was rounded has no step: its second differences do.
    both = same[1:] & same[:-1]
    bends = np.diff(moves)[both]
    step = resolution_step(x) or resolution_step(ALIKE * size * np.round(bends / (ALIKE * size)))
    # Of numbers written with so many digits in all, large ones have a coarser step.
    widths = np.maximum(ALIKE * size if step is None else step, _last_digits(x))
    found, width = [], float(widths.max())
    for kind, changes, at in (("held", moves[same], x[:-1][same]), ("straight", bends, x[1:-1][both])):
        if not len(changes):
            continue
        # Noise may be small in some states: how large it is in each twentieth of the samples, by their state.
        part = np.argsort(np.argsort(at, kind="stable"), kind="stable") * min(STATE_PARTS, len(at)) // len(at)
        spread = np.sqrt(np.bincount(part, changes**2) / np.bincount(part))
        spread = np.maximum(spread, max(LEAST_SPREAD * float(spread.max()), 1e-300))
        sizes = np.abs(changes)
        count, share = int((sizes < ALIKE * size).sum()), float(widths.mean()) / width
        usual = len(changes) * min(share * width / np.sqrt(2 * np.pi) * float((1 / spread).mean()), 1.0)
        # As many are zero as any other small number of steps; a line that is rounded is bent by one or two.
        most = int(SMALL_CHANGE * spread.min() / width)
        if most >= 2 * ROUNDED_LINE:
            small = (sizes > (ROUNDED_LINE + 0.5) * width) & (sizes < (most + 0.5) * width)
            usual = max(usual, share * float(small.sum()) / (2 * (most - ROUNDED_LINE)))
        chance = float(special.gammainc(count, usual)) if count > HARMLESS_SHARE * len(changes) else 1.0
        found.append((chance, kind, count / len(moves)))
    # A stretch is another one by chance where each of its steps is.
    begins = np.arange(len(x) - COPIED + 1)
    begins = begins[which[begins] == which[begins + COPIED - 1]]
    marks = np.convolve(x - x.mean(), np.random.default_rng(0).standard_normal(COPIED), mode="valid")[begins]
    moved = np.ptp(x[begins[:, None] + np.arange(COPIED)], axis=1) > ALIKE * size
    count = int(moved.sum()) - len(np.unique(marks[moved]))
    alike = min(width / (2 * np.sqrt(np.pi) * size), 1.0) ** (COPIED - 1)
    chance = float(special.gammainc(count, len(begins) ** 2 / 2 * alike))
    return [*found, (chance, "copied", count / max(len(begins), 1))]


def _last_digits(values: np.ndarray) -> np.ndarray:
    """One in the last digit of each value ``(n,)``, where all have so many digits; zero where they do not."""
    exponents = np.floor(np.log10(positive(np.abs(values))))
    for digits in range(1, MOST_DIGITS + 1):
        last = 10.0 ** (exponents + 1 - digits)
        if np.allclose(np.round(values / last) * last, values, rtol=1e-14, atol=0.0):
            return last
    return np.zeros(len(values))
