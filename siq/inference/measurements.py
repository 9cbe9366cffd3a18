"""Measurements: recordings laid out for fitting, with inputs, first states and expectations of parameters.

Whoever writes a value on a card knows its order of magnitude. A parameter of a hidden state may be told by
nothing else, and a fit without expectations moves it anywhere, along with the hidden state, to gain next to
nothing. So a value is expected about that of the card, within its own size: a normal prior, as weak as that.
What recordings do tell, they tell far better.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import scipy.interpolate
import sympy

from siq.data.recordings import Recordings
from siq.errors import Fault
from siq.systems.dynamics import Dynamics, Input, JointExpectation, Parameter, Signals, symbol

OVERSAMPLING = 16  # of band-limited inputs, between whose dense samples cubics are exact enough
FOLDS = 4  # of which one is left out at a time: a quarter, as is held out by default
MIN_STRETCH_SAMPLES = 16  # of a stretch that an initial state and an error can be told from
LEAST_VARIANCE = 0.05  # of the mean one: a quadratic may vanish where hardly anything was measured (a choice)
STAIRCASE = 0.25  # of squared changes that go on in the next: none in a staircase, 0.36 of normal ones
PADDING = 64  # samples by which they are continued, mirrored, so that the ends do not ring


@dataclass(frozen=True)
class Measurements:
    """Recordings, one behind the other."""

    labels: tuple[str, ...]  #: of the recordings
    first: np.ndarray  #: the row at which each begins, then the number of rows: ``(recordings + 1,)``
    t: np.ndarray  #: times, shape ``(n,)``
    outputs: np.ndarray  #: what was measured, shape ``(n, m)``, in the order of the model's outputs
    courses: tuple[tuple[scipy.interpolate.PPoly, ...], ...]  #: for each recording, of its inputs in time
    #: Variance of each output's noise where it is known, NaN where it is to be estimated, shape ``(m,)``;
    #: None where none is known.
    sensor_noise: np.ndarray | None = None
    #: Variance of each output's noise as a quadratic of what is measured, in units of its mean: coefficients
    #: of 1, y and y², shape ``(m, 3)``; None where it is the same everywhere.
    sensor_law: np.ndarray | None = None
    #: Places of states that begin at zero with every interval, such as a mean over an exposure.
    restarting: tuple[int, ...] = ()
    #: Places of states that nothing but noise moves, and each recording finds as spread as noise leaves them.
    stationary: tuple[int, ...] = ()

    @property
    def begins(self) -> np.ndarray:
        """Rows at which an interval between two samples begins, shape ``(n - recordings,)``."""
        return np.setdiff1d(np.arange(len(self.t)), self.first[1:] - 1, assume_unique=True)

    @property
    def step(self) -> np.ndarray:
        """Time from each sample to the next, shape ``(n,)``; zero behind the last."""
        return np.append(np.diff(self.t), 0.0)

    @property
    def known_sensors(self) -> np.ndarray:
        """Which outputs' noise is known, shape ``(m,)``."""
        return np.isfinite(self.with_known_noise(np.full(self.outputs.shape[1], np.nan)))

    @property
    def roughness(self) -> np.ndarray:
        """Variance of each output's measurement noise, from third differences, shape ``(m,)``.

        What the motion itself adds is in it: a noise is hardly larger, and can be much smaller.
        """
        result = []
        for column in self.outputs.T:
            differences = np.concatenate([np.diff(part, n=3) for part in np.split(column, self.first[1:-1])])
            differences = differences[np.isfinite(differences)]
            # The variance of the third difference of white noise is 20 times its own.
            rough = np.mean(differences**2) / 20 if len(differences) else 0.0
            result.append(max(rough, 1e-12 * np.nanvar(column)) or 1.0)
        return np.array(result)

    def with_known_noise(self, measurement: np.ndarray) -> np.ndarray:
        """Variances of the outputs' noise, shape ``(m,)``, with those that are known in their places."""
        if self.sensor_noise is None:
            return measurement
        return np.where(np.isfinite(self.sensor_noise), self.sensor_noise, measurement)

    @staticmethod
    def relative_variance(law: np.ndarray, levels: np.ndarray) -> np.ndarray:
        """Variance of sensors' noise over its mean, by a law as of `sensor_law`, at levels ``(n, m)``."""
        found = np.einsum("mk,nmk->nm", law, levels[:, :, None] ** np.arange(3))
        return np.where(np.isfinite(found), np.maximum(found, LEAST_VARIANCE), 1.0)

    @property
    def recording(self) -> np.ndarray:
        """Place of each row's recording in `labels`."""
        return np.repeat(np.arange(len(self.labels)), np.diff(self.first))

    def signals(
        self, t: np.ndarray, recording: np.ndarray, *, delays: Sequence[tuple[int, float]],
        width: np.ndarray | float = 0.0,
    ) -> Signals:  # fmt: skip
        """Inputs at instants, each in its recording.

        Parameters
        ----------
        t
            Instants, shape ``(n,)``.
        recording
            The place of the recording of each; it never decreases.
        delays
            Delayed inputs wanted: the place of the input, and by how much time it lags. What was before a
            recording is taken to be as it began.
        width
            Of time about each instant, over which a delayed input that is held between samples is averaged:
            a jump within a step of an integration then acts as it should, and the lag has a derivative.
        """
        wide = np.broadcast_to(width, t.shape)
        inputs = np.empty((len(self.courses[0]) if self.courses else 0, len(t)))
        delayed, slopes = np.empty((len(delays), len(t))), np.empty((len(delays), len(t)))
        bounds = np.searchsorted(recording, np.arange(len(self.labels) + 1))
        for place, courses in enumerate(self.courses):
            rows = slice(bounds[place], bounds[place + 1])
            begin, end = self.t[self.first[place]], self.t[self.first[place + 1] - 1]
            for index, course in enumerate(courses):
                inputs[index, rows] = course(t[rows])
            for index, (which, lag) in enumerate(delays):
                course, half = courses[which], wide[rows] / 2
                before, at, after = (np.clip(t[rows] - lag + side, begin, end) for side in (-half, 0.0, half))
                delayed[index, rows], slopes[index, rows] = course(at), course(at, 1)
                if course.c.shape[0] == 1 and (half > 0).all():
                    outside, total = (2 * half - (after - before)) * course(at), course.antiderivative()
                    delayed[index, rows] = (total(after) - total(before) + outside) / (2 * half)
                    slopes[index, rows] = (course(after) - course(before)) / (2 * half)
        return Signals(inputs=inputs, delayed=delayed, slopes=slopes, t=t)

    def select(self, chosen: Sequence[int]) -> Measurements:
        """Some of the recordings, by their places."""
        return self._part(
            [np.arange(self.first[place], self.first[place + 1]) for place in chosen],
            labels=tuple(self.labels[place] for place in chosen),
            courses=tuple(self.courses[place] for place in chosen),
        )

    def followed_by(self, other: Measurements) -> Measurements:
        """These recordings and those of another, which were measured alike."""
        first, t = np.append(self.first, self.first[-1] + other.first[1:]), np.append(self.t, other.t)
        joined = replace(self, labels=self.labels + other.labels, courses=self.courses + other.courses)
        return replace(joined, first=first, t=t, outputs=np.concatenate([self.outputs, other.outputs]))

    def until(self, rows: np.ndarray) -> Measurements:
        """The first so many rows of each recording, shape ``(recordings,)``; the inputs stay whole."""
        return self._part(
            [np.arange(begin, begin + count) for begin, count in zip(self.first[:-1], rows, strict=True)]
        )

    def _part(self, rows: Sequence[np.ndarray], **changes: Any) -> Measurements:
        at, first = np.concatenate(rows), np.cumsum([0, *map(len, rows)])
        return replace(self, first=first, t=self.t[at], outputs=self.outputs[at], **changes)


def course_of_input(t: np.ndarray, u: np.ndarray, interpolation: str) -> scipy.interpolate.PPoly:
    """An input as a function of time, from samples ``(n,)`` of one recording.

    ``zero_order`` holds each sample until the next; ``linear`` joins them; ``band_limited`` takes the one
    signal without content above half the sampling rate, which needs regular sampling.
    """
    if len(t) < 2:
        return scipy.interpolate.PPoly(np.array([[u[0]]]), np.array([t[0], t[0] + 1.0]))
    if interpolation == "zero_order":
        return scipy.interpolate.PPoly(np.append(u[:-1], u[-1])[None, :], np.append(t, 2 * t[-1] - t[-2]))
    if interpolation == "linear":
        return scipy.interpolate.PPoly(np.stack([np.diff(u) / np.diff(t), u[:-1]]), t)
    step = np.diff(t)
    if np.ptp(step) > 1e-3 * step.mean():
        raise Fault("a band-limited input is sampled irregularly", "resample it, or call it linear")
    padding = min(PADDING, len(u) - 1)
    # Mirrored through its end points the signal goes on without a jump and without a kink.
    longer = np.concatenate([2 * u[0] - u[padding:0:-1], u, 2 * u[-1] - u[-2 : -padding - 2 : -1]])
    line = np.linspace(longer[0], longer[-1], len(longer))
    dense = scipy.signal.resample(longer - line, OVERSAMPLING * len(longer))
    dense_t = t[0] + step.mean() * (np.arange(len(dense)) / OVERSAMPLING - padding)
    slope = (longer[-1] - longer[0]) / (len(longer) - 1) / step.mean()
    dense += longer[0] + slope * (dense_t - dense_t[0])
    kept = slice((padding - 1) * OVERSAMPLING if padding else 0, (padding + len(u)) * OVERSAMPLING)
    return scipy.interpolate.CubicSpline(dense_t[kept], dense[kept])


def measurements(recordings: Recordings, model: Dynamics) -> Measurements:
    """Lay recordings out as the model needs them: its outputs, and the courses of its inputs.

    Their columns are outputs, then inputs. An input of which nothing else is said is held
    between samples where it was recorded as a staircase, whose changes have no other right behind, and
    which does not drift between them.

    Raises
    ------
    Fault
        When an input cannot be interpolated as the model says.
    """
    count = len(model.outputs)
    first = np.searchsorted(recordings.recording, np.arange(len(recordings.labels) + 1))
    within = np.diff(recordings.recording) == 0  # one recording may end far from where the next begins
    changes = np.diff(recordings.values[:, count:], axis=0) * within[:, None]
    small = np.where((squares := changes**2) < squares.mean(axis=0), changes, 0.0)
    staircase = np.minimum(squares[1:], squares[:-1]).sum(axis=0) < STAIRCASE * squares.sum(axis=0)
    staircase &= (small[1:] * small[:-1]).sum(axis=0) <= 0
    courses = []
    for begin, end in itertools.pairwise(first):
        t, mine = recordings.t[begin:end], []
        for column, entry in enumerate(model.inputs, count):
            course = entry.interpolation or ("zero_order" if staircase[column - count] else "linear")
            try:
                mine.append(course_of_input(t, recordings.values[begin:end, column], course))
            except Fault as error:
                raise Fault(f"input {entry.name}: {error.fault}", error.remedy) from None
        courses.append(tuple(mine))
    outputs = np.ascontiguousarray(recordings.values[:, :count])
    return Measurements(recordings.labels, first, recordings.t, outputs, tuple(courses))


def first_states(model: Dynamics, data: Measurements) -> np.ndarray:
    """States to begin with: measured ones as measured, velocities by differences, others mid-domain.

    A state that is none of these, and of which no domain is known, begins at zero; at one where f has no
    slope at zero, such as a square root.
    """
    states = np.tile(_middle(model), (len(data.t), 1))
    measured: dict[str, np.ndarray] = {}  # those that an output is, up to a factor and an offset
    values = {symbol(each.name): each.value for each in model.parameters}
    for column, (_, formula) in zip(data.outputs.T, model.outputs, strict=False):
        known = formula.xreplace(values)
        for name in model.states:
            slope = known.diff(symbol(name))
            if not slope.is_number or slope == 0:
                continue
            # Of a constant slope the rest is what is left at zero: long formulas are never multiplied out.
            rest = known.xreplace({symbol(name): sympy.S.Zero})
            if rest.is_number:
                filled = pd.Series(column).interpolate(limit_direction="both").fillna(0.0)
                measured[name] = (filled.to_numpy() - float(rest)) / float(slope)
    definitions = zip(model.states, model.equations, model.kinematic, strict=True)
    derivative_of = {str(equation): name for name, equation, defined in definitions if defined}
    for place, name in enumerate(model.states):
        if name in measured:
            states[:, place] = measured[name]
        elif (position := measured.get(derivative_of.get(name, ""))) is not None:
            for begin, end in zip(data.first[:-1], data.first[1:], strict=True):
                if end - begin > 1:
                    states[begin:end, place] = np.gradient(position[begin:end], data.t[begin:end])
    return states


def _middle(model: Dynamics) -> np.ndarray:
    """A value of each state, shape ``(d,)``: the middle of its domain where it has one."""
    middle = model.limits.mean(axis=1)
    unknown = np.isnan(middle)
    if not unknown.any():
        return middle
    one, delayed = np.ones((len(model.inputs), 1)), np.ones((len(model.delays), 1))
    signals = Signals(inputs=one, delayed=delayed, slopes=delayed, t=np.ones(1))
    about = np.where(unknown, 1.0, middle)  # the others somewhere, so that only the unknown ones matter
    for place in np.flatnonzero(unknown):
        at = about.copy()
        at[place] = 0.0
        if np.isfinite(model.functions.slopes(at[:, None], signals, model.values)[0]).all():
            about = at
    return about


def expectations(model: Dynamics, values: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Priors of changes of the free parameters: combinations of them ``(r, p)`` are normal, of unit width.

    With how far the values of all parameters, by default the model's own, fall short of what is expected of
    each combination, shape ``(r,)``. What divides a term is expected by its inverse: x²/K and b x² are one,
    and a capacity may be infinite.
    """
    now = (model.values if values is None else values)[list(model.free)]
    free = {model.parameters[place].name: column for column, place in enumerate(model.free)}
    fixed = {each.name: each.value for each in model.parameters}
    entries = [model.parameters[place] for place in model.free]
    sizes = [each.expected or 0.0 for each in entries]
    told = np.flatnonzero(sizes)
    # In units of their size, by how much they may be off.
    width = np.array([(entries[k].error or abs(sizes[k])) / abs(sizes[k]) for k in told])
    size, inverse = np.array(sizes)[told], np.isin(np.array(model.free)[told], [*model.divisors])
    # Of K about K₀, -K₀/K about -1: its change by K, and what is short of it where K is now.
    at = np.where(inverse, now[told], 1.0)
    rows = [np.eye(len(free))[told] * (np.where(inverse, size / at**2, 1 / np.abs(size)) / width)[:, None]]
    middle = [np.where(inverse, 2 * size / at - 1, np.sign(size)) / width]
    for each in model.expected_together:
        mine = [place for place, name in enumerate(each.names) if name in free]
        if mine:
            rows.append(np.zeros((len(each.roots), len(free))))
            roots = np.sqrt(each.weight) * each.roots
            rows[-1][:, [free[each.names[place]] for place in mine]] = roots[:, mine]
            middle.append(-roots @ np.array([0.0 if name in free else fixed[name] for name in each.names]))
    together = np.concatenate(rows)
    return together, np.concatenate(middle) - together @ now


def with_expectations(model: Dynamics) -> Dynamics:
    """A model whose free parameters are expected to be about as they are; zero says nothing of a size."""
    parameters = (
        each if each.fixed or each.value == 0 else replace(each, expected=each.value)
        for each in model.parameters
    )
    return replace(model, parameters=tuple(parameters))


def with_variation(
    model: Dynamics, names: Sequence[str], data: Measurements, further: Measurements
) -> tuple[Dynamics, Measurements, Measurements]:
    """A model in which parameters differ from recording to recording, with the recordings for it.

    Each of them is a mean, plus a deviation of every recording that is expected about zero within the size of
    the mean, ``c + Σ c_k i_k``: inputs i_k tell which recording it is. What is not learned from has the mean.
    Names of the inputs and of the deviations, which have the order of the recordings, begin with a low line.

    Parameters
    ----------
    model
        Its parameters of these names have values other than zero.
    names
        Of the parameters that differ.
    data, further
        Recordings that are learned from, and others.
    """
    count, change, parameters, expected = len(data.labels), {}, [], []
    signs = tuple(Input(f"_run_{k + 1}", "1", "zero_order") for k in range(count))
    for entry in (each for each in model.parameters if each.name in names):
        own = tuple(f"_{entry.name}_{k + 1}" for k in range(count))
        parameters += [Parameter(name, 0.0, entry.unit) for name in own]
        expected.append(JointExpectation(own, np.eye(count) / abs(entry.value)))
        terms = (symbol(name) * symbol(sign.name) for name, sign in zip(own, signs, strict=True))
        change[symbol(entry.name)] = symbol(entry.name) + sympy.Add(*terms)
    constant = [scipy.interpolate.PPoly(np.array([[value]]), np.array([0.0, 1.0])) for value in (0.0, 1.0)]

    def courses(of: Measurements, learned: bool) -> tuple[tuple[scipy.interpolate.PPoly, ...], ...]:
        marks = ([constant[learned and k == place] for k in range(count)] for place in range(len(of.labels)))
        return tuple((*own, *mark) for own, mark in zip(of.courses, marks, strict=True))

    varied = replace(
        model, equations=tuple(each.xreplace(change) for each in model.equations),
        outputs=tuple((name, formula.xreplace(change)) for name, formula in model.outputs),
        inputs=(*model.inputs, *signs), parameters=(*model.parameters, *parameters),
        expected_together=(*model.expected_together, *expected), covariance=None,
    )  # fmt: skip
    return (
        varied,
        replace(data, courses=courses(data, True)),
        replace(further, courses=courses(further, False)),
    )


def cross_validation_folds(learned: Measurements) -> Iterator[tuple[Measurements, Measurements, np.ndarray]]:
    """The recordings in parts: one that is left out, the rest, and the rows of the rest in all of them.

    Of recordings, so many at equal distances are a part; a single one is cut into stretches, of which the
    rest has two recordings unless it is the first or the last that is left out.
    """
    count, rows = len(learned.labels), len(learned.t)
    if count > 1:
        edges, owner = learned.first, list(range(count))
        groups = [list(range(part, count, FOLDS)) for part in range(min(FOLDS, count))]
    else:
        parts = max(min(FOLDS, rows // MIN_STRETCH_SAMPLES), 2)
        edges, owner = np.linspace(0, rows, parts + 1).round().astype(int), [0] * parts
        groups = [[part] for part in range(parts)]
    pieces = list(itertools.pairwise(edges))

    def stretches(chosen: Sequence[tuple[int, int]], of: Sequence[int]) -> tuple[Measurements, np.ndarray]:
        """Stretches of rows as recordings of their own, and their rows; the inputs stay whole."""
        at = np.concatenate([np.arange(begin, end) for begin, end in chosen])
        named = zip(of, chosen, strict=True)
        return replace(
            learned,
            labels=tuple(f"{learned.labels[place]}, rows {a} to {b}" for place, (a, b) in named),
            first=np.cumsum([0, *(end - begin for begin, end in chosen)]),
            t=learned.t[at],
            outputs=learned.outputs[at],
            courses=tuple(learned.courses[place] for place in of) if learned.courses else learned.courses,
        ), at

    for group in groups:
        out = [pieces[place] for place in group]
        others = [place for place in range(len(pieces)) if place not in group]
        kept = [pieces[place] for place in others]
        if count == 1:  # what was not cut stays one recording
            ((begin, end),) = out
            kept = [(a, b) for a, b in ((0, begin), (end, rows)) if b > a]
            others = others[: len(kept)]
        rest = stretches(kept, [owner[place] for place in others])
        yield stretches(out, [owner[place] for place in group])[0], *rest
