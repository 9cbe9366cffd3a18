"""How do samples show the states: as they are, or as means, with an error of the sensor?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.data.recordings import Recordings
from siq.data.stationarity import runs_of, usual_step
from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.estimation.estimation import fit_by_filter
from siq.estimation.fit import Fit
from siq.estimation.innovations import Noise
from siq.estimation.measurements import Measurements
from siq.identify.exposure import exposed, exposed_measurements, exposed_noise, kept_samples
from siq.identify.identified_field import IdentifiedField, field_dynamics
from siq.identify.library import CandidateLibrary
from siq.identify.noise_beside_sensor import formula_noise
from siq.identify.velocities import force_noise, seen_positions, smoothed_motion, without_definitions


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
        (`siq.identify.velocities`).
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
