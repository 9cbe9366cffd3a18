"""Where does f jump, and how finely must a jump be followed?

A force that takes another sign in no time, such as dry friction, is spread over a little of its argument when
it is evaluated, so that an integrator can follow it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import compile_values
from siq.dynamics.parametric import arguments_of, evaluable
from siq.estimation.budget import Budget
from siq.estimation.estimation import fit_by_multiple_shooting
from siq.estimation.fit import Fit
from siq.estimation.measurements import Measurements
from siq.estimation.trajectories import fit_trajectories

EDGE_SUBSTEPS = 12  # between samples, for models whose f jumps
# A guard, for where the likelihood still changes. Friction that sticks took more than 96 at 40 dB.
FINEST = 384
SHARP = 0.5  # change of the log-likelihood by halving the substeps, below which a jump is sharp enough
EDGE = 0.05  # width of a jump, in what its argument passes in a substep


def jumps_of(model: Dynamics) -> list[sympy.Expr]:
    """What changes its sign where f jumps, each once, in an order that does not change."""
    signs = {each for formula in model.equations for each in formula.atoms(sympy.sign)}
    return sorted((each.args[0] for each in signs), key=str)


def spread_edges(model: Dynamics, data: Measurements, x: np.ndarray, *, substeps: int) -> Dynamics:
    """The model with its jumps spread over about what their arguments pass in a substep.

    Parameters
    ----------
    model, data
        The model and what it is compared with.
    x
        States along which it is used, shape ``(n, d)``.
    substeps
        Runge–Kutta steps between samples.
    """
    arguments = jumps_of(model)
    if not arguments:
        return model
    formulas = [evaluable(each, model) for each in arguments]
    signals = data.signals(data.t, data.recording, delays=model.lags(model.values))
    function = compile_values(formulas, arguments_of(model), common=False)
    further = np.zeros((model.dimension - x.shape[1], len(x)))  # states that a mechanism brings
    along = function(
        *x.T, *further, *signals.inputs, *signals.delayed, *signals.slopes, signals.t, *model.values
    )
    rows = data.begins
    widths = []
    for course in along:
        course = np.broadcast_to(course, data.t.shape)
        passed = np.sqrt(np.mean((course[rows + 1] - course[rows]) ** 2))
        widths.append(EDGE * float(passed) / substeps + 1e-300)
    return replace(model, edges=tuple(zip(arguments, widths, strict=True)))


def sharpened(rough: Fit, data: Measurements, *, budget: Budget | None = None) -> Fit:
    """A fit whose jumps are spread so little that it no longer matters; motion that sticks asks for this.

    Without process noise only: with it the states follow the data anyway.
    """
    while (
        rough.converged and rough.model.edges and not rough.has_process_noise and 2 * rough.substeps <= FINEST
    ):
        substeps = 2 * rough.substeps
        model = spread_edges(rough.model, data, rough.x, substeps=substeps)
        begin = rough.x[data.first[:-1]]
        finer = fit_trajectories(
            model, data, begin=begin, noise=rough.noise, substeps=substeps, budget=budget
        )
        if not finer.converged:
            finer = fit_by_multiple_shooting(
                model,
                data,
                x=rough.x,
                noise=rough.noise,
                estimate_process=False,
                substeps=substeps,
                budget=budget,
            )
        if not finer.converged:
            break
        gained, rough = finer.log_likelihood - rough.log_likelihood, finer
        if abs(gained) < SHARP:
            break
    return rough
