"""Of what was found, what is kept? What runs better than the card; formulas are refitted along trajectories.

Regression of derivatives leaves biased numbers. So a formula gets the same fit as the card's own parameters
got, which is more than the method itself would do. A simulation that then runs worse along the recordings
that it was learned from is not used: nobody would.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import sympy

from benchmarks.discrepancies.added import Added, Polynomial
from benchmarks.discrepancies.simulation import Simulation
from siq.errors import NumericalFailure
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.inference.recalibration import recalibrate
from siq.systems.dynamics import Dynamics, Parameter, symbol

COEFFICIENT = "_coefficient_"
MOST = 20  # terms, up to which a formula is refitted


def refitted(
    card: Fit, model: Dynamics, added: Polynomial, data: Measurements
) -> tuple[Dynamics, Polynomial]:
    """The model and the coefficients, fitted along trajectories; as they were where that leads nowhere.

    Parameters
    ----------
    card
        The recalibrated card, than which the formula must be likelier.
    model, added
        The card with the parameters that regression gave, and the terms.
    data
        The recordings.
    """
    coefficients = np.array(added.coefficients)
    places = np.argwhere(coefficients != 0)
    if len(places) > MOST:
        return model, added
    names = [*model.states, *(each.name for each in model.inputs)]
    equations = list(model.equations)
    for number, (state, term) in enumerate(places):
        product = sympy.prod(
            symbol(name) ** power for name, power in zip(names, added.exponents[term], strict=True)
        )
        equations[state] += symbol(f"{COEFFICIENT}{number}") * product
    further = tuple(
        Parameter(f"{COEFFICIENT}{number}", float(coefficients[state, term]))
        for number, (state, term) in enumerate(places)
    )
    whole = replace(model, equations=tuple(equations), parameters=(*model.parameters, *further))
    try:
        fit, _ = recalibrate(whole, data)
    except (NumericalFailure, ArithmeticError, ValueError, np.linalg.LinAlgError):
        return model, added
    if not (fit.converged and fit.log_likelihood > card.log_likelihood):
        return model, added
    count = len(model.parameters)
    for (state, term), value in zip(places, fit.model.values[count:], strict=True):
        coefficients[state, term] = value
    return model.with_values(fit.model.values[:count]), added.model_copy(
        update={"coefficients": coefficients.tolist()}
    )


def runs_better(
    card: Dynamics, model: Dynamics, added: Added, data: Measurements, starts: Sequence[np.ndarray]
) -> bool:
    """Whether a mended simulation runs better than the card along the recordings.

    Parameters
    ----------
    card
        Recalibrated.
    model, added
        The mended one.
    data
        The recordings.
    starts
        First states as they may be told, ``(recordings, d)`` each; a simulation has those that suit it best.
    """
    mended = min(_error(model, added, data, each) for each in starts)
    return mended < min(_error(card, None, data, each) for each in starts)


def _error(model: Dynamics, added: Added | None, data: Measurements, starts: np.ndarray) -> float:
    simulation = Simulation(model, data, added)
    with np.errstate(all="ignore"):
        states = simulation.run(model.values, starts)
        errors = (simulation.outputs(states, model.values) - data.outputs) / np.nanstd(data.outputs, axis=0)
    error = float(np.sqrt(np.nanmean(errors**2))) if np.isfinite(states).all() else np.inf
    return error if np.isfinite(error) else np.inf
