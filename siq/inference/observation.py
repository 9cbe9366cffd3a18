"""The observation of states: measurement noise, integration time, hidden velocities.

A sample shows the state of a model with the noise of its sensor. It may be the mean of the state over an
integration time before it, as of an exposed camera. Such means are correlated: a part of the same path may be
in two of them. With the running mean as a state of its own, which begins anew with every exposure,

    ``dm/dt = x/T``,

the system is Markovian again. An exposure that is shorter than the step begins between two samples, at an
instant at which nothing is measured. Where it is longer, of several samples one is kept, so that no two
exposures overlap: of how the state moves these tell nearly as much as all, as long as they are close beside
the time in which it relaxes.

Or samples show positions, and the second half of the states are velocities of which they show nothing.
``dx/dt = v`` holds by definition, process noise acts on velocities, and what is sought is the force in
``dv/dt = f(x, v)``. Differences of positions are no velocities: the noise of the sensor is divided by the
step in them, and what they leave is coloured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy

from siq.data.recordings import Recordings
from siq.data.stationarity import runs_of, usual_step
from siq.errors import NumericalFailure
from siq.inference.field_estimate import FieldEstimate, field_dynamics
from siq.inference.kalman_filter import Noise
from siq.inference.library import CandidateLibrary
from siq.inference.maximum_likelihood import Fit, fit_by_filter
from siq.inference.measurements import Measurements
from siq.inference.selection import all_coefficients
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, symbol

FIRST_FORCE = 0.01  # of what positions move by: a force to begin with; the search goes up and down from it
MIN_SAMPLES = 20  # of a recording, by which its first velocity is determined beside its noise
INSTANT_TOLERANCE = 1e-6  # of an exposure: what rounding leaves between two instants


def velocity_names(positions: Sequence[str]) -> tuple[str, ...]:
    """The names of the velocities: ``v_x`` of x.

    Raises
    ------
    NumericalFailure
        Where a recorded column has that name already.
    """
    names = tuple(f"v_{name}" for name in positions)
    if taken := set(names) & set(positions):
        raise NumericalFailure(
            f"{min(taken)} is recorded and would be the name of a hidden velocity as well; leave"
            " 'hidden_velocities' out if the velocities are recorded, or rename the column"
        )
    return names


def seen_positions(plain: Dynamics) -> Dynamics:
    """Dynamics of forces alone, with ``dx/dt = v`` and with positions for their outputs."""
    half = plain.dimension // 2
    names, symbols = plain.states[:half], [symbol(name) for name in plain.states]
    return Dynamics(
        states=plain.states,
        equations=(*symbols[half:], *plain.equations[half:]),
        diffusion=plain.diffusion,
        parameters=plain.parameters,
        outputs=tuple(zip(names, symbols[:half], strict=True)),
    )


def force_noise(sensor: np.ndarray, rate: np.ndarray) -> Noise:
    """Both noises: variances of the sensors ``(d/2,)``, and what drives the velocities, ``(d/2, d/2)``."""
    half = len(sensor)
    shape, process = np.eye(2 * half), np.zeros(2 * half)
    process[half:] = np.diag(rate)
    if process.any():
        size = np.sqrt(np.diag(rate))
        shape[half:, half:] = rate / np.outer(size, size)
    return Noise(sensor, process, shape[None])


def smoothed_motion(data: Measurements, names: Sequence[str]) -> tuple[np.ndarray, Noise]:
    """Positions and velocities to begin with, and both noises, when nothing but noise drives the velocities.

    That model is linear: its smoother is a spline through the measured positions whose stiffness follows from
    the likelihood, and no start matters.

    Parameters
    ----------
    data, names
        Of positions.

    Returns
    -------
    states, noise
        Shape ``(n, d)``, positions before velocities.

    Raises
    ------
    NumericalFailure
        Where recordings are too short for it, or its likelihood cannot be worked out.
    """
    if np.diff(data.first).min() < MIN_SAMPLES:
        raise NumericalFailure(
            f"a recording has fewer than {MIN_SAMPLES} samples, which do not determine its velocity; leave it"
            " out"
        )
    states = (*names, *velocity_names(names))
    free = seen_positions(Dynamics(states, (sympy.S.Zero,) * len(states), Diffusion.identity(len(states))))
    begins = data.begins
    rate = (data.outputs[begins + 1] - data.outputs[begins]) / data.step[begins, None]
    velocity = np.zeros_like(data.outputs)
    velocity[begins] = rate
    begin = FIRST_FORCE * (rate**2).mean(axis=0) / float(np.median(data.step[begins]))
    fit = fit_by_filter(
        free, data, x=np.concatenate([data.outputs, velocity], axis=1),
        noise=force_noise(data.with_known_noise(data.roughness), np.diag(begin)), closure=False,
    )  # fmt: skip
    if fit.fault:
        raise NumericalFailure(f"the velocities cannot be worked out: {fit.fault}")
    return fit.x, fit.noise


@dataclass(frozen=True)
class ObservationModel:
    """How samples show the states of f.

    Attributes
    ----------
    library, diffusion
        Of f.
    exposure
        The time over which a sample is a mean, None where it is none.
    hidden
        Whether the second half of the states are velocities, of which samples show nothing.
    """

    library: CandidateLibrary
    diffusion: Diffusion
    exposure: float | None = None
    hidden: bool = False

    @classmethod
    def of(cls, found: FieldEstimate) -> ObservationModel:
        """The one that an estimate was made with."""
        return cls(found.library, found.diffusion, found.exposure, found.hidden_velocities)

    @property
    def measured_states(self) -> int:
        """How many states are measured."""
        return self.library.dimension // 2 if self.hidden else self.library.dimension

    @property
    def everything(self) -> np.ndarray:
        """Component and term of every coefficient that is not known beforehand, shape ``(p, 2)``."""
        d = self.library.dimension
        return all_coefficients(range(d // 2 if self.hidden else 0, d), self.library.size)

    @property
    def definitions(self) -> np.ndarray:
        """Component and term of each ``dx/dt = v``, shape ``(d/2, 2)``; none where nothing is hidden."""
        half = self.library.dimension // 2 if self.hidden else 0
        velocities = [self.library.terms.index(self.library.symbols[half + i]) for i in range(half)]
        return np.array(list(enumerate(velocities)), dtype=int).reshape(-1, 2)

    def unknown(self, found: FieldEstimate) -> tuple[np.ndarray, np.ndarray]:
        """The terms of an estimated f that are fitted, and their coefficients."""
        fitted = found.support[:, 0] >= (self.library.dimension // 2 if self.hidden else 0)
        return found.support[fitted], found.values[fitted]

    def model(self, support: np.ndarray, values: np.ndarray) -> Dynamics:
        """Dynamics with the coefficients of a support as parameters, as they are measured."""
        plain = field_dynamics(self.library, support, values, diffusion=self.diffusion)
        if self.hidden:
            return seen_positions(plain)
        if self.exposure is None:
            return plain
        # The states, and their running means, which are what is measured.
        names = [f"_mean_{name}" for name in plain.states]
        return Dynamics(
            states=(*plain.states, *names),
            equations=(*plain.equations, *(each / self.exposure for each in plain.symbols)),
            diffusion=Diffusion(np.eye(2 * plain.dimension)),
            parameters=plain.parameters,
            outputs=tuple((name, symbol(mean)) for (name, _), mean in zip(plain.outputs, names, strict=True)),
        )

    def measured(self, recordings: Recordings, pair_step: float | None) -> Measurements:
        """The recordings as measurements, a new one behind every gap.

        Running means begin anew where an exposure does. Where that is between two samples a row without any
        measured value stands there.
        """
        data = unbroken(recordings, pair_step=pair_step, every=self.every(recordings))
        if self.exposure is None:
            return data
        d = self.library.dimension
        ends = data.begins + 1
        start = data.t[ends] - self.exposure
        inside = start > data.t[ends - 1] + INSTANT_TOLERANCE * self.exposure
        at, before = ends[inside], np.searchsorted(ends[inside], data.first)
        return replace(
            data,
            first=data.first + before,
            t=np.insert(data.t, at, start[inside]),
            outputs=np.insert(data.outputs, at, np.nan, axis=0),
            restarting=tuple(range(d, 2 * d)),
        )

    def every(self, recordings: Recordings) -> int:
        """Of how many samples one is kept, so that exposures do not overlap."""
        if self.exposure is None:
            return 1
        steps = self.exposure / usual_step(recordings)
        return max(int(np.ceil(steps * (1 - INSTANT_TOLERANCE))), 1)

    def noise(self, noise: Noise) -> Noise:
        """The noise of the states, as it drives the model: nothing drives running means."""
        if self.exposure is None:
            return noise
        d, shape = self.library.dimension, None
        if noise.shape is not None and noise.field is None:
            shape = np.eye(2 * d)[None].copy()
            shape[0, :d, :d] = noise.shape[0]
        return Noise(noise.measurement, np.concatenate([noise.process, np.zeros(d)]), shape, noise.field)

    def noise_of(self, found: FieldEstimate) -> Noise:
        """Both noises of an estimate, as they are in the model."""
        assert found.diagnosis is not None
        sensor, rate, half = found.diagnosis.measurement**2, found.noise_rate, self.measured_states
        if found.noise is not None:
            noise = Noise(sensor, np.ones(len(rate)), field=found.noise.diffusion(1.0))
        elif self.hidden:
            noise = force_noise(sensor, rate[half:, half:])
        elif not rate.any():
            noise = Noise(sensor, np.zeros(len(rate)))
        else:
            size = np.sqrt(np.diag(rate))
            noise = Noise(sensor, np.diag(rate).copy(), (rate / np.outer(size, size))[None])
        return self.noise(noise)

    def states(self, data: Measurements) -> np.ndarray:
        """States of the model to begin with, as they are measured next."""
        if self.hidden:
            return smoothed_motion(data, self.library.states[: self.measured_states])[0]
        unknown = np.isnan(data.outputs).any(axis=1)
        values = data.outputs[np.arange(len(unknown)) + unknown]  # never two in a row, nor at an end
        return values if self.exposure is None else np.column_stack([values, values])

    def fitted(
        self, support: np.ndarray, values: np.ndarray, data: Measurements, *, noise: Noise, x: np.ndarray
    ) -> Fit:
        """The fit of some terms, beginning with their values, states and noise.

        Raises
        ------
        NumericalFailure
            When it does not settle.
        """
        return settled(fit_by_filter(self.model(support, values), data, x=x, noise=noise))


def settled(fit: Fit) -> Fit:
    """A fit of f and its noise that has converged.

    Raises
    ------
    NumericalFailure
        When it has not.
    """
    if not fit.converged:
        raise NumericalFailure(
            "the fit of f with measurement noise does not settle"
            + (f": {fit.fault}" if fit.fault else "")
            + "; record more, or sample more often"
        )
    return fit


def moved_by(data: Measurements) -> tuple[np.ndarray, float]:
    """Mean square of what each output moves by from a measured sample to the next, and the mean time.

    Raises
    ------
    NumericalFailure
        Where no sample has a next one.
    """
    measured = np.flatnonzero(~np.isnan(data.outputs).all(axis=1))
    before, after = measured[:-1], measured[1:]
    same = data.recording[before] == data.recording[after]
    before, after = before[same], after[same]
    if not len(before):
        raise NumericalFailure(
            "no two samples are so near in time that one tells of the other; record longer"
        )
    moved = ((data.outputs[after] - data.outputs[before]) ** 2).mean(axis=0)
    return moved, float((data.t[after] - data.t[before]).mean())


def kept_rows(recordings: Recordings, *, pair_step: float | None, every: int = 1) -> list[np.ndarray]:
    """The rows of each stretch without a gap, of every so many one; see `unbroken`."""
    return [np.arange(run.start, run.stop, every) for run in runs_of(recordings, longest=pair_step)]


def unbroken(recordings: Recordings, *, pair_step: float | None = None, every: int = 1) -> Measurements:
    """Recordings as measurements of their states, a new one behind every gap.

    Parameters
    ----------
    recordings
        Whole trajectories.
    pair_step
        Longest time between samples that still belong together; by default one and a half median steps.
    every
        Of so many samples one is kept.
    """
    runs = kept_rows(recordings, pair_step=pair_step, every=every)
    rows = np.concatenate(runs)
    return Measurements(
        labels=tuple(recordings.labels[recordings.recording[run[0]]] for run in runs),
        first=np.cumsum([0, *map(len, runs)]),
        t=recordings.t[rows],
        outputs=np.ascontiguousarray(recordings.values[rows]),
        courses=((),) * len(runs),
    )
