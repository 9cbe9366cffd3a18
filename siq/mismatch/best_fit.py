"""The best fit of a model: with random forces or without, and with its jumps sharp enough."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.stats

from siq.mismatch.estimation import Fit, fit
from siq.mismatch.linearisation import spread_edges
from siq.mismatch.measurements import Measurements
from siq.mismatch.model import Model
from siq.mismatch.trajectories import fit_trajectories

EDGE_SUBSTEPS = 12  # between samples, for models whose f jumps
FINEST = 96  # the same, where the likelihood still changes
SHARP = 0.5  # change of the log-likelihood by halving the substeps, below which a jump is sharp enough


def best_fit(
    model: Model, data: Measurements, begin: Fit, *, level: float = 1.0, x: np.ndarray | None = None
) -> Fit:
    """Fit with process noise estimated, and without; the simpler unless the data speak against it."""
    return simpler(*both_fits(model, data, begin, level=level, x=x))


def simpler(loose: Fit | None, strict: Fit) -> Fit:
    """The fit without process noise, unless the data speak against it."""
    return strict if loose is None or not process_noise_needed(loose, strict) else loose


def both_fits(
    model: Model, data: Measurements, begin: Fit, *, level: float = 1.0, x: np.ndarray | None = None
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
    if any("sign(" in str(formula) for formula in model.equations):
        substeps = max(substeps, EDGE_SUBSTEPS)
        model = spread_edges(model, data, states, substeps=substeps)
    noise = begin.noise
    if len(noise.process) != model.dimension:  # what a mechanism brings is driven by no noise of its own
        driven = noise.process[: model.dimension]
        noise = replace(noise, process=np.append(driven, np.zeros(model.dimension - len(driven))))
    if noise.process.any():
        loose = fit(
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
    strict = fit(
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


def sharpened(rough: Fit, data: Measurements) -> Fit:
    """A fit whose jumps are spread so little that it no longer matters; motion that sticks asks for this.

    Without process noise only: with it the states follow the data anyway.
    """
    while (
        rough.converged and rough.model.edges and not rough.has_process_noise and 2 * rough.substeps <= FINEST
    ):
        substeps = 2 * rough.substeps
        model = spread_edges(rough.model, data, rough.x, substeps=substeps)
        finer = fit(model, data, x=rough.x, noise=rough.noise, estimate_process=False, substeps=substeps)
        if not finer.converged:
            begin = rough.x[data.first[:-1]]
            finer = fit_trajectories(model, data, begin=begin, noise=rough.noise, substeps=substeps)
        if not finer.converged:
            break
        gained, rough = finer.log_likelihood - rough.log_likelihood, finer
        if abs(gained) < SHARP:
            break
    return rough


def process_noise_needed(loose: Fit, strict: Fit, *, threshold: float = 1e-4) -> bool:
    """Whether the likelihood ratio speaks for process noise; its null distribution has half its mass at 0."""
    if not strict.converged:
        return True
    ratio = max(2 * (loose.log_likelihood - strict.log_likelihood), 0.0)
    driven = int((loose.noise.process > 0).sum())
    return driven > 0 and 0.5 * scipy.stats.chi2.sf(ratio, max(driven, 1)) < threshold
