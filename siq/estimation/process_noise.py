"""Does a model need random forces to explain recordings? It is fitted with them and without."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.stats

from siq.dynamics.dynamics import Dynamics
from siq.estimation.budget import COMPILATION, Budget
from siq.estimation.estimation import fit_by_multiple_shooting
from siq.estimation.fit import Fit
from siq.estimation.innovations import Noise, with_parameters_changed
from siq.estimation.jumps import EDGE_SUBSTEPS, jumps_of, sharpened, spread_edges
from siq.estimation.measurements import Measurements
from siq.estimation.noise import log_likelihood
from siq.estimation.trajectories import fit_trajectories

THRESHOLD = 1e-4  # probability by chance, below which random forces are believed


def fit_with_process_noise_as_needed(
    model: Dynamics,
    data: Measurements,
    begin: Fit,
    *,
    level: float = 1.0,
    x: np.ndarray | None = None,
    budget: Budget | None = None,
) -> Fit:
    """Fit with process noise estimated, and without; the simpler unless the data speak against it.

    A jump that is spread too far leaves errors which random forces stand in for. Before they are believed the
    jumps of the fit without them are followed more finely.
    """
    loose, strict = fit_with_and_without_process_noise(model, data, begin, level=level, x=x, budget=budget)
    chosen = simpler_fit(loose, strict)
    if chosen is loose and strict.converged and strict.model.edges:
        chosen = simpler_fit(loose, sharpened(strict, data, budget=budget))
    return chosen


def simpler_fit(loose: Fit | None, strict: Fit) -> Fit:
    """The fit without process noise, unless the data speak against it."""
    return strict if loose is None or not process_noise_needed(loose, strict) else loose


def fit_with_and_without_process_noise(
    model: Dynamics,
    data: Measurements,
    begin: Fit,
    *,
    level: float = 1.0,
    x: np.ndarray | None = None,
    settled: bool = False,
    budget: Budget | None = None,
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
    settled
        Whether `begin` is itself the fit of the model with process noise, and need not be made again.
    budget
        Charged for every evaluation.

    Raises
    ------
    BudgetSpent
        When nothing is left of what is allowed.
    """
    if budget is not None:
        budget.charge(COMPILATION)
    states = begin.x if x is None else x
    substeps = begin.substeps
    if jumps_of(model):
        substeps = max(substeps, EDGE_SUBSTEPS)
        model = spread_edges(model, data, states, substeps=substeps)
    noise = begin.noise.of_states(model.dimension)
    loose: Fit | None = None
    if settled and not jumps_of(model):
        loose = begin
    elif noise.process.any():
        loose = fit_by_multiple_shooting(
            model,
            data,
            x=states,
            noise=noise.scaled(max(level, 1e-6)),
            estimate_process=True,
            substeps=substeps,
            budget=budget,
        )
    start = loose if loose is not None and loose.converged else None
    begun = model if start is None else start.model
    x, still = (states, noise) if start is None else (start.x, start.noise)

    def at_all_samples() -> Fit:
        return fit_by_multiple_shooting(
            begun, data, x=x, noise=still.without_process(), estimate_process=False, substeps=substeps,
            budget=budget,
        )  # fmt: skip

    def as_trajectories() -> Fit:
        # Where random forces led to nothing better, they led away.
        better = start is not None or (loose is not None and loose.log_likelihood > begin.log_likelihood)
        of = loose if loose is not None and better else None
        return fit_trajectories(
            model if of is None else of.model,
            data,
            begin=(states if of is None else of.x)[data.first[:-1]],
            noise=noise if of is None else of.noise,
            substeps=substeps,
            budget=budget,
        )

    # Where f jumps, steps of all samples at once go to and fro.
    ways = (as_trajectories, at_all_samples) if jumps_of(model) else (at_all_samples, as_trajectories)
    strict = ways[0]()
    if not strict.converged:
        strict = better_of(strict, ways[1]())
    vanished = None if start is None else without_idle_forces(start, data)
    return loose, strict if vanished is None else better_of(vanished, strict)


def without_idle_forces(fit: Fit, data: Measurements) -> Fit | None:
    """A fit without its random forces, where these do nothing in it; None where they do something.

    Their intensities may have gone towards zero. The fit without them has then been found already, and may be
    likelier than the one that another way of fitting ends in.
    """
    still = fit.noise.without_process()
    held = with_parameters_changed(fit.linearisation, np.zeros(len(fit.model.free)))
    with_them, alone = (log_likelihood(held, data, noise) for noise in (fit.noise, still))
    if not 2 * (with_them - alone) <= least_to_believe(fit.noise):
        return None
    return replace(fit, noise=still, log_likelihood=fit.log_likelihood - (with_them - alone))


def better_of(one: Fit, other: Fit) -> Fit:
    """The one that settled, and of two that did not the likelier."""
    if one.converged != other.converged:
        return one if one.converged else other
    return one if one.log_likelihood > other.log_likelihood else other


def process_noise_needed(loose: Fit, strict: Fit) -> bool:
    """Whether the likelihood ratio speaks for process noise; its null distribution has half its mass at 0."""
    if not strict.converged:
        return True
    return 2 * (loose.log_likelihood - strict.log_likelihood) > least_to_believe(loose.noise)


def least_to_believe(noise: Noise) -> float:
    """Twice the increase of the log-likelihood from which on random forces are believed."""
    driven = int((noise.process > 0).sum())
    return float(scipy.stats.chi2.isf(2 * THRESHOLD, driven)) if driven else np.inf
