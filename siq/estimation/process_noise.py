"""Does a model need random forces to explain recordings? It is fitted with them and without."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.stats

from siq.dynamics.dynamics import Dynamics
from siq.estimation.estimation import Fit, fit_by_multiple_shooting
from siq.estimation.jumps import EDGE_SUBSTEPS, jumps_of, spread_edges
from siq.estimation.measurements import Measurements
from siq.estimation.trajectories import fit_trajectories

THRESHOLD = 1e-4  # probability by chance, below which random forces are believed


def fit_with_process_noise_as_needed(
    model: Dynamics, data: Measurements, begin: Fit, *, level: float = 1.0, x: np.ndarray | None = None
) -> Fit:
    """Fit with process noise estimated, and without; the simpler unless the data speak against it."""
    return simpler_fit(*fit_with_and_without_process_noise(model, data, begin, level=level, x=x))


def simpler_fit(loose: Fit | None, strict: Fit) -> Fit:
    """The fit without process noise, unless the data speak against it."""
    return strict if loose is None or not process_noise_needed(loose, strict) else loose


def fit_with_and_without_process_noise(
    model: Dynamics, data: Measurements, begin: Fit, *, level: float = 1.0, x: np.ndarray | None = None
) -> tuple[Fit | None, Fit]:
    """Fit with process noise estimated, where that was begun with, and without.

    Parameters
    ----------
    model
        With the parameters' values to begin with.
    data
        The recordings.
    begin
        A fit whose states and noise are begun with.
    level
        Factor on its process noise.
    x
        States, where the model has more of them.
    """
    states = begin.x if x is None else x
    substeps = begin.substeps
    if jumps_of(model):
        substeps = max(substeps, EDGE_SUBSTEPS)
        model = spread_edges(model, data, states, substeps=substeps)
    noise = begin.noise
    if len(noise.process) != model.dimension:  # what a mechanism brings is driven by no noise of its own
        driven = noise.process[: model.dimension]
        noise = replace(noise, process=np.append(driven, np.zeros(model.dimension - len(driven))))
    if noise.process.any():
        loose = fit_by_multiple_shooting(
            model,
            data,
            x=states,
            noise=noise.scaled(max(level, 1e-6)),
            estimate_process=True,
            substeps=substeps,
        )
    else:
        loose = None
    start = loose if loose is not None and loose.converged else None
    strict = fit_by_multiple_shooting(
        model if start is None else start.model,
        data,
        x=states if start is None else start.x,
        noise=(noise if start is None else start.noise).without_process(),
        estimate_process=False,
        substeps=substeps,
    )
    if not strict.converged:
        # Where random forces led to nothing better, they led away.
        if loose is not None and loose.log_likelihood > begin.log_likelihood:
            model, states, noise = loose.model, loose.x, loose.noise
        strict = fit_trajectories(model, data, begin=states[data.first[:-1]], noise=noise, substeps=substeps)
    return loose, strict


def process_noise_needed(loose: Fit, strict: Fit) -> bool:
    """Whether the likelihood ratio speaks for process noise; its null distribution has half its mass at 0."""
    if not strict.converged:
        return True
    ratio = max(2 * (loose.log_likelihood - strict.log_likelihood), 0.0)
    driven = int((loose.noise.process > 0).sum())
    return driven > 0 and 0.5 * scipy.stats.chi2.sf(ratio, max(driven, 1)) < THRESHOLD
