"""Runs alike: several simulations run freely under the same conditions, so that their errors compare."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.estimation.fit import Fit
from siq.estimation.free_runs import FreeRun, UsualStates, free_run, squared_errors
from siq.estimation.innovations import Noise
from siq.estimation.measurements import Measurements


@dataclass(frozen=True)
class RunsAlike:
    """What all of them have in common.

    Attributes
    ----------
    noise
        See `siq.estimation.free_runs.free_run`.
    substeps
        Runge–Kutta steps between samples at least; a fit that needed more is run with its own.
    """

    noise: Noise
    substeps: int

    def run(self, fit: Fit, data: Measurements) -> FreeRun:
        """A fit's simulation of recordings, told how they begin and where it usually is."""
        finer = max(self.substeps, fit.substeps)
        return free_run(fit.model, data, noise=self.noise, substeps=finer, usual=UsualStates.along(fit.x))

    def errors(self, fit: Fit, data: Measurements) -> np.ndarray | None:
        """Normalised squared errors of that run, shape ``(values,)``; None where it ran away."""
        return squared_errors(data.outputs, self.run(fit, data))

    def nearest(self, fits: list[Fit], data: Measurements) -> Fit:
        """The fit that runs nearest to recordings; the first of those that are as near, or run away."""
        return fits[0] if len(fits) == 1 else min(fits, key=lambda fit: mean_error(self.errors(fit, data)))


def mean_error(squares: np.ndarray | None) -> float:
    """The mean of squared errors, infinite where a simulation ran away."""
    return float("inf") if squares is None else float(squares.mean())
