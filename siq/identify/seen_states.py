"""How do samples show the states: as they are, or as means, with an error of the sensor?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.data.recordings import Recordings
from siq.data.stationarity import runs_of
from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.estimation.estimation import Fit, fit_by_filter
from siq.estimation.innovations import Noise
from siq.estimation.measurements import Measurements
from siq.identify.exposure import exposed, exposed_measurements, exposed_noise
from siq.identify.identified_field import IdentifiedField, field_dynamics
from siq.identify.library import CandidateLibrary


@dataclass(frozen=True)
class View:
    """How samples show the states: as they are, or as means over the step before them."""

    library: CandidateLibrary
    diffusion: Diffusion
    exposure: float | None

    def model(self, support: np.ndarray, values: np.ndarray) -> Dynamics:
        """Dynamics with the coefficients of a support as parameters, as they are measured."""
        plain = field_dynamics(self.library, support, values, diffusion=self.diffusion)
        return plain if self.exposure is None else exposed(plain, self.exposure)

    def measured(self, recordings: Recordings, pair_step: float | None) -> Measurements:
        """The recordings as measurements, a new one behind every gap."""
        data = unbroken(recordings, pair_step=pair_step)
        return data if self.exposure is None else exposed_measurements(data, self.library.dimension)

    def noise(self, noise: Noise) -> Noise:
        """The noise of the states, as it drives the model."""
        return noise if self.exposure is None else exposed_noise(noise, self.library.dimension)

    def states(self, values: np.ndarray) -> np.ndarray:
        """States of the model to begin with, from measured values ``(n, d)``."""
        return values if self.exposure is None else np.column_stack([values, values])


def noise_of(found: IdentifiedField, sensor: np.ndarray) -> Noise:
    """Both noises of an identified f, with the variance of each state's sensor."""
    rate = found.noise_rate
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


def unbroken(recordings: Recordings, *, pair_step: float | None = None) -> Measurements:
    """Recordings as measurements of their states, a new one behind every gap.

    Parameters
    ----------
    recordings
        Whole trajectories.
    pair_step
        Longest time between samples that still belong together; by default one and a half median steps.
    """
    runs, recording = runs_of(recordings, longest=pair_step), recordings.recording
    first = np.array([*(run.start for run in runs), len(recordings.t)])
    return Measurements(
        labels=tuple(recordings.labels[recording[row]] for row in first[:-1]),
        first=first,
        t=recordings.t,
        outputs=np.ascontiguousarray(recordings.values),
        courses=((),) * (len(first) - 1),
    )
