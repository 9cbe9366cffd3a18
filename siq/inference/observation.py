"""The observation of states: measurement noise, integration time, hidden velocities.

The first half of the states are positions, the other half their velocities. ``dx/dt = v`` holds by
definition, and random forces act on velocities. What is sought is the force, ``dv/dt = f(x, v)``.

A camera that is exposed shows no state, but the mean of the state over the exposure. Such means remember: a
part of the same path may be in two of them. With the running mean as a state of its own, which begins anew
with every exposure, the system is Markovian again, and a filter treats it like any other.

An exposure that is shorter than the step begins between two samples, at an instant at which nothing is
measured. Where it is longer, of several samples one is kept, so that no two exposures overlap: of how the
state moves these tell nearly as much as all, as long as they are close beside the time in which it relaxes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy

from siq.data.recordings import Recordings
from siq.data.stationarity import runs_of, usual_step
from siq.errors import NumericalFailure
from siq.inference.field_estimate import IdentifiedField, field_dynamics
from siq.inference.kalman_filter import Noise
from siq.inference.library import CandidateLibrary
from siq.inference.maximum_likelihood import Fit, fit_by_filter
from siq.inference.measurements import Measurements
from siq.inference.state_dependent_diffusion import formula_noise
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, symbol

FIRST = 0.01  # of what positions move by: a force to begin with; the search goes up and down from it
LEAST_SAMPLES = 20  # of a recording, by which its first velocity is told beside its noise


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


def definitions(library: CandidateLibrary) -> np.ndarray:
    """Component and term of each ``dx/dt = v``, shape ``(d/2, 2)``."""
    half = library.dimension // 2
    return np.array([(i, library.terms.index(library.symbols[half + i])) for i in range(half)])


def with_definitions(
    library: CandidateLibrary, support: np.ndarray, values: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Terms of the forces with those of ``dx/dt = v`` before them, whose coefficients are exactly 1.

    Parameters
    ----------
    library
        Of positions and velocities.
    support, values, covariance
        Of the forces: shapes ``(p, 2)``, ``(p,)`` and ``(p, p)``.
    """
    known = definitions(library)
    count = len(known)
    whole = np.zeros((count + len(values),) * 2)
    whole[count:, count:] = covariance
    return np.concatenate([known, support]), np.concatenate([np.ones(count), values]), whole


def without_definitions(
    library: CandidateLibrary, support: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The terms of the forces alone."""
    force = support[:, 0] >= library.dimension // 2
    return support[force], values[force]


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


def force_diffusion(rate: np.ndarray) -> tuple[Diffusion, float]:
    """D and ε of forces that noise drives: the part of D that acts on velocities has the determinant 1.

    Without noise it is the unit matrix there, and ε is zero.

    Parameters
    ----------
    rate
        What noise adds to the covariance of the velocities in a unit of time, shape ``(d/2, d/2)``.
    """
    half = len(rate)
    forced = bool(rate.any())
    intensity = float(np.exp(np.linalg.slogdet(rate)[1] / half)) if forced else 0.0
    matrix = np.zeros((2 * half, 2 * half))
    matrix[half:, half:] = (rate + rate.T) / 2 / intensity if forced else np.eye(half)
    return Diffusion(matrix), intensity


def smoothed_motion(data: Measurements, names: Sequence[str]) -> tuple[np.ndarray, Noise]:
    """Positions and velocities to begin with, and both noises, when nothing but noise drives the velocities.

    That model is linear: its smoother is a spline through the measured positions whose stiffness the
    likelihood tells, and no start matters.

    Parameters
    ----------
    data
        Of positions.
    names
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
    if np.diff(data.first).min() < LEAST_SAMPLES:
        raise NumericalFailure(
            f"a recording has fewer than {LEAST_SAMPLES} samples, by which its velocity is not told; leave it"
            " out"
        )
    half = len(names)
    states = (*names, *velocity_names(names))
    free = seen_positions(Dynamics(states, (sympy.S.Zero,) * (2 * half), Diffusion.identity(2 * half)))
    begins = data.begins
    rate = (data.outputs[begins + 1] - data.outputs[begins]) / np.diff(data.t)[begins, None]
    velocity = np.zeros_like(data.outputs)
    velocity[begins] = rate
    step = float(np.median(np.diff(data.t)[begins]))
    begin = FIRST * (rate**2).mean(axis=0) / step
    fit = fit_by_filter(
        free, data, x=np.concatenate([data.outputs, velocity], axis=1),
        noise=force_noise(data.with_known_noise(data.roughness), np.diag(begin)), closure=False,
    )  # fmt: skip
    if fit.fault:
        raise NumericalFailure(f"the velocities cannot be worked out: {fit.fault}")
    return fit.x, fit.noise


SAME = 1e-6  # of an exposure: what rounding leaves between two instants


def kept_samples(step: float, exposure: float) -> int:
    """Of how many samples one is kept, so that exposures do not overlap."""
    return max(int(np.ceil(exposure / step * (1 - SAME))), 1)


def exposed(model: Dynamics, exposure: float) -> Dynamics:
    """The same dynamics, of which each sample is the mean over the exposure before it.

    Parameters
    ----------
    model
        Of d states, all of them measured.
    exposure
        Its length, in the unit of time.

    Returns
    -------
    Dynamics
        Of 2d states: the d states, and their running means, which are what is measured.
    """
    names = [f"_mean_{name}" for name in model.states]
    return Dynamics(
        states=(*model.states, *names),
        equations=(*model.equations, *(each / exposure for each in model.symbols)),
        diffusion=Diffusion(np.eye(2 * model.dimension)),
        parameters=model.parameters,
        outputs=tuple((name, symbol(mean)) for (name, _), mean in zip(model.outputs, names, strict=True)),
    )


def exposed_measurements(data: Measurements, dimension: int, exposure: float) -> Measurements:
    """The same measurements, with running means that begin anew where an exposure does.

    Where that is between two samples a row without any measured value stands there.
    """
    restarting = tuple(range(dimension, 2 * dimension))
    ends = data.begins + 1
    start = data.t[ends] - exposure
    inside = start > data.t[ends - 1] + SAME * exposure
    at, before = ends[inside], np.searchsorted(ends[inside], data.first)
    return replace(
        data,
        first=data.first + before,
        t=np.insert(data.t, at, start[inside]),
        outputs=np.insert(data.outputs, at, np.nan, axis=0),
        restarting=restarting,
    )


def exposed_noise(noise: Noise, dimension: int) -> Noise:
    """The same noise, of which nothing drives the running means."""
    process = np.concatenate([noise.process, np.zeros(dimension)])
    shape = None
    if noise.shape is not None and noise.field is None:
        shape = np.eye(2 * dimension)[None].copy()
        shape[0, :dimension, :dimension] = noise.shape[0]
    return Noise(noise.measurement, process, shape, noise.field)


@dataclass(frozen=True)
class View:
    """How samples show the states: as they are, or as means over an exposure before them.

    Attributes
    ----------
    library, diffusion
        Of f.
    exposure
        The time over which a sample is a mean, None where it is none.
    hidden
        Whether the second half of the states are velocities, of which samples show nothing
        (`siq.inference.observation`).
    """

    library: CandidateLibrary
    diffusion: Diffusion
    exposure: float | None
    hidden: bool = False

    @property
    def everything(self) -> np.ndarray:
        """Component and term of every coefficient that is not known beforehand, shape ``(p, 2)``."""
        d = self.library.dimension
        return np.array(
            [(i, k) for i in range(d // 2 if self.hidden else 0, d) for k in range(self.library.size)]
        )

    def unknown(self, found: IdentifiedField) -> tuple[np.ndarray, np.ndarray]:
        """The terms of an identified f that are fitted, and their coefficients."""
        if not self.hidden:
            return found.support, found.values
        return without_definitions(self.library, found.support, found.values)

    def model(self, support: np.ndarray, values: np.ndarray) -> Dynamics:
        """Dynamics with the coefficients of a support as parameters, as they are measured."""
        plain = field_dynamics(self.library, support, values, diffusion=self.diffusion)
        if self.hidden:
            return seen_positions(plain)
        return plain if self.exposure is None else exposed(plain, self.exposure)

    def measured(self, recordings: Recordings, pair_step: float | None) -> Measurements:
        """The recordings as measurements, a new one behind every gap."""
        data = unbroken(recordings, pair_step=pair_step, every=self.every(recordings))
        if self.exposure is None:
            return data
        return exposed_measurements(data, self.library.dimension, self.exposure)

    def every(self, recordings: Recordings) -> int:
        """Of how many samples one is kept."""
        return 1 if self.exposure is None else kept_samples(usual_step(recordings), self.exposure)

    def noise(self, noise: Noise) -> Noise:
        """The noise of the states, as it drives the model."""
        return noise if self.exposure is None else exposed_noise(noise, self.library.dimension)

    def states(self, data: Measurements) -> np.ndarray:
        """States of the model to begin with, as they are measured next."""
        unknown = np.isnan(data.outputs).any(axis=1)
        rows = np.arange(len(unknown))
        values = data.outputs[rows + unknown]  # never two in a row, nor at an end
        if self.hidden:
            return smoothed_motion(data, self.library.states[: self.library.dimension // 2])[0]
        return values if self.exposure is None else np.column_stack([values, values])


def noise_of(found: IdentifiedField, sensor: np.ndarray) -> Noise:
    """Both noises of an identified f, with the variance of each state's sensor."""
    if found.noise is not None:
        return formula_noise(found.noise, sensor)
    rate, half = found.noise_rate, len(sensor)
    if half < len(rate):
        return force_noise(sensor, rate[half:, half:])
    if not rate.any():
        return Noise(sensor, np.zeros(len(rate)))
    size = np.sqrt(np.diag(rate))
    return Noise(sensor, np.diag(rate).copy(), (rate / np.outer(size, size))[None])


def settled(
    view: View,
    support: np.ndarray,
    data: Measurements,
    noise: Noise,
    *,
    values: np.ndarray,
    x: np.ndarray,
) -> Fit:
    """The fit of some terms.

    Raises
    ------
    NumericalFailure
        When it does not settle.
    """
    fit = fit_by_filter(view.model(support, values), data, x=x, noise=noise)
    if not fit.converged:
        raise NumericalFailure(
            "the fit of f beside sensor noise does not settle"
            + (f": {fit.fault}" if fit.fault else "")
            + "; record more, or sample more often"
        )
    return fit


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


def kept_rows(recordings: Recordings, *, pair_step: float | None, every: int) -> list[np.ndarray]:
    """The rows of each stretch without a gap, of every so many one; see `unbroken`."""
    return [np.arange(run.start, run.stop, every) for run in runs_of(recordings, longest=pair_step)]
