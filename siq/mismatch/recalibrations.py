"""Which mechanisms are no more than a recalibration?

Where a simulation has a free damping rate, linear damping is another value of it: no recording can tell the
two apart, and a mechanism of that kind would only stand in the way of the parameter. This follows from the
formulas alone. To first order a mechanism adds the derivatives of f and h by its amplitudes; it is something
new where these are linearly independent, as functions of states, inputs and time, of the derivatives by the
free parameters.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import compile_values, parse_formula
from siq.dynamics.parametric import TIME, Signals, arguments_of, evaluable, symbol
from siq.mismatch.building import MechanismCandidate, label_of
from siq.mismatch.dictionary import Shape
from siq.mismatch.roles import ANYWHERE, trial_points

INDEPENDENT = 1e-6  # of a column's length, left beside others: between rounding and what any shape leaves


def beyond_parameters(
    model: Dynamics, candidates: Sequence[MechanismCandidate]
) -> list[MechanismCandidate | None]:
    """Candidates less what the simulation's own parameters can do; None for those of which nothing is left.

    Of several amplitudes those are taken out that the parameters, together with those before, stand for.

    Parameters
    ----------
    model
        The simulation.
    candidates
        The simulation with a mechanism built in, each.
    """
    count = 2 * (len(model.free) + 6)
    x, signals = trial_points(model, count, either_sign=True)
    # A parameter that happens to be zero hides what others do that stand beside it.
    nonzero = np.random.default_rng(0).uniform(*ANYWHERE, size=len(model.parameters))
    values = np.where(model.values == 0, nonzero, model.values)
    by_parameter = model.functions.slopes(x, signals, values)[1]
    outputs_by_parameter = model.functions.output_slopes(x, signals, values)[1]
    own = np.concatenate([by_parameter, outputs_by_parameter]).swapaxes(1, 2)
    own = own.reshape(own.shape[0] * count, len(model.free))
    result: list[MechanismCandidate | None] = []
    for each in candidates:
        new = _new_columns(own, _columns(model, each, x, signals, values))
        needless = {name for name, is_new in zip(each.amplitudes, new, strict=False) if not is_new}
        if not any(new):
            result.append(None)
        else:
            result.append(without_amplitudes(each, model, needless) if needless else each)
    return result


def _new_columns(own: np.ndarray, columns: np.ndarray) -> list[bool]:
    """Which columns are independent of others and of those before; rows that are no numbers tell nothing.

    Where too few rows are left to tell, all count as new: screening says what is the matter with them.
    """
    whole = np.isfinite(own).all(axis=1) & np.isfinite(columns).all(axis=1)
    if whole.sum() <= own.shape[1] + columns.shape[1]:
        return [True] * columns.shape[1]
    own, columns = _of_unit_length(own[whole]), _of_unit_length(columns[whole])
    left, sizes, _ = np.linalg.svd(own, full_matrices=False)
    basis = left[:, sizes > INDEPENDENT * sizes.max(initial=0.0)]
    new = []
    for column in columns.T:
        rest = column - basis @ (basis.T @ column)
        size = float(np.linalg.norm(rest))
        new.append(size > INDEPENDENT)
        if new[-1]:
            basis = np.column_stack([basis, rest / size])
    return new


def _of_unit_length(columns: np.ndarray) -> np.ndarray:
    largest = np.abs(columns).max(axis=0, initial=0.0)  # first, since squares may be beyond all numbers
    columns = columns / np.where(largest > 0, largest, 1.0)
    length = np.sqrt((columns**2).sum(axis=0))
    return columns / np.where(length > 0, length, 1.0)


def _columns(
    model: Dynamics, candidate: MechanismCandidate, x: np.ndarray, signals: Signals, values: np.ndarray
) -> np.ndarray:
    """What a little of a mechanism does to f and h at points, shape ``((d + m) n, amplitudes)``.

    Of a mechanism without an amplitude it is the whole change, for a shape such as a search begins with.
    """
    augmented, count = candidate.model, x.shape[1]
    generator = np.random.default_rng(1)
    # Its further states and delayed inputs may be anything: no parameter of the simulation acts by them.
    further = generator.normal(size=(augmented.dimension - model.dimension, count)) * np.abs(x).mean()
    delayed = generator.normal(size=(len(augmented.delays), count))
    for place, each in enumerate(augmented.delays):
        if each in model.delays:
            delayed[place] = signals.delayed[model.delays.index(each)]
    at = (*x, *further, *signals.inputs, *delayed, *delayed, signals.t)
    shapes = dict(zip(candidate.shapes, candidate.searches, strict=True))
    new = [
        _typical(shapes[each.name], model, x, signals) if each.name in shapes else 0.0
        for each in augmented.parameters[len(model.parameters) :]
    ]
    before = [*model.equations, *dict(model.outputs).values()]
    after = [*augmented.equations[: model.dimension], *dict(augmented.outputs).values()]
    result = np.zeros((len(before), count, max(len(candidate.amplitudes), 1)))
    changed = [place for place, pair in enumerate(zip(before, after, strict=True)) if pair[0] != pair[1]]
    formulas: list[sympy.Expr] = []
    for place in changed:
        formula, known = evaluable(after[place], augmented), evaluable(before[place], model)
        by_amplitude = [formula.diff(symbol(name)) for name in candidate.amplitudes]
        formulas += by_amplitude or [formula - known]
    with np.errstate(all="ignore"):
        found = compile_values(formulas, arguments_of(augmented), common=False)(*at, *values, *new)
    for number, value in enumerate(found):
        place, column = divmod(number, result.shape[2])
        result[changed[place], :, column] = value
    return result.reshape(-1, result.shape[2])


def _typical(shape: Shape, model: Dynamics, x: np.ndarray, signals: Signals) -> float:
    """A value of a shape for which a mechanism is what its name says: in the middle of the search."""
    at = shape.at[len(shape.at) // 2]
    text = shape.scale_of or shape.inverse_scale_of or shape.quantiles_of
    if text is None:
        return at if at > 0 else 1.0
    names = [*(symbol(name) for name in model.states), *(symbol(entry.name) for entry in model.inputs), TIME]
    course = compile_values([parse_formula(text, model.names)], names, common=False)(
        *x, *signals.inputs, signals.t
    )[0]
    course = np.broadcast_to(course, x.shape[1:])
    if shape.quantiles_of is not None:
        return float(np.quantile(course, at))
    size = float(np.sqrt(np.mean(course**2))) or 1.0
    return at * size if shape.scale_of is not None else at / size


def without_amplitudes(
    candidate: MechanismCandidate, model: Dynamics, names: Collection[str]
) -> MechanismCandidate:
    """A candidate less some of its amplitudes, which a simulation's own parameters stand for.

    What is left adds to these, so that it may have either sign.

    Parameters
    ----------
    candidate, model
        The mechanism, and the simulation that it is built into.
    names
        Of the amplitudes, not all of them.
    """
    zero = dict.fromkeys(map(symbol, names), 0)

    def less(formula: sympy.Expr, before: sympy.Expr | None) -> sympy.Expr:
        left = formula.subs(zero)
        return before if before is not None and sympy.expand(left - before) == 0 else left

    whole = candidate.model
    equations = tuple(
        less(formula, before) for formula, before in itertools.zip_longest(whole.equations, model.equations)
    )
    reduced = replace(
        whole,
        parameters=tuple(each for each in whole.parameters if each.name not in names),
        equations=equations,
        outputs=tuple(
            (name, less(formula, before))
            for (name, formula), (_, before) in zip(whole.outputs, model.outputs, strict=True)
        ),
    )
    changes = ((name, formula.subs(zero)) for name, formula in candidate.changes)
    return replace(
        candidate,
        label=label_of(candidate.name, candidate.variant, model, reduced),
        model=reduced,
        amplitudes=tuple(name for name in candidate.amplitudes if name not in names),
        positive=candidate.positive & set(candidate.shapes),
        equations=tuple(
            name
            for name, formula, before in zip(model.states, equations, model.equations, strict=False)
            if formula != before
        ),
        changes=tuple((name, formula) for name, formula in changes if formula != 0),
    )
