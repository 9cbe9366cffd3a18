"""States to begin a fit with, read off what was measured."""

from __future__ import annotations

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.parametric import Signals, symbol
from siq.estimation.measurements import Measurements


def first_states(model: Dynamics, data: Measurements) -> np.ndarray:
    """States to begin with: measured ones as measured, velocities by differences, others mid-domain.

    A state that is none of these, and of which no domain is known, begins at zero; at one where f has no
    slope at zero, such as a square root.
    """
    states = np.tile(_middle(model), (len(data.t), 1))
    from_output = _measured_states(model)
    derivative_of = {
        str(equation): name
        for name, equation, is_definition in zip(model.states, model.equations, model.kinematic, strict=True)
        if is_definition
    }
    for place, name in enumerate(model.states):
        if name in from_output:
            states[:, place] = _read_off(data, *from_output[name])
    for place, name in enumerate(model.states):
        if name not in from_output and derivative_of.get(name) in from_output:
            position = _read_off(data, *from_output[derivative_of[name]])
            for begin, end in zip(data.first[:-1], data.first[1:], strict=True):
                if end - begin > 1:
                    states[begin:end, place] = np.gradient(position[begin:end], data.t[begin:end])
    return states


def _measured_states(model: Dynamics) -> dict[str, tuple[int, float, float]]:
    """States that an output is, up to a factor and an offset: its place, the factor and the offset."""
    values = {symbol(each.name): each.value for each in model.parameters}
    found = {}
    for place, (_, formula) in enumerate(model.outputs):
        known = formula.xreplace(values)
        for name in model.states:
            slope = known.diff(symbol(name))
            if not slope.is_number or slope == 0:
                continue
            # Of a constant slope the rest is what is left at zero: long formulas are never multiplied out.
            rest = known.xreplace({symbol(name): sympy.S.Zero})
            if rest.is_number:
                found[name] = (place, float(slope), float(rest))
    return found


def _read_off(data: Measurements, place: int, slope: float, rest: float) -> np.ndarray:
    return (_filled(data, data.outputs[:, place]) - rest) / slope


def _middle(model: Dynamics) -> np.ndarray:
    """A value of each state, shape ``(d,)``: the middle of its domain where it has one."""
    middle = model.limits.mean(axis=1)
    unknown = np.isnan(middle)
    if not unknown.any():
        return middle
    about = np.where(unknown, 1.0, middle)  # the others somewhere, so that only the unknown ones matter
    for place in np.flatnonzero(unknown):
        at = about.copy()
        at[place] = 0.0
        if np.isfinite(_slopes(model, at)).all():
            about = at
    return about


def _slopes(model: Dynamics, x: np.ndarray) -> np.ndarray:
    """Derivatives of f by the states at a point ``(d,)``, with inputs and time of one."""
    one, delayed = np.ones((len(model.inputs), 1)), np.ones((len(model.delays), 1))
    signals = Signals(inputs=one, delayed=delayed, slopes=delayed, t=np.ones(1))
    return model.functions.slopes(x[:, None], signals, model.values)[0]


def _filled(data: Measurements, column: np.ndarray) -> np.ndarray:
    """A measured column with gaps filled linearly."""
    known = np.isfinite(column)
    if known.all() or not known.any():
        return np.nan_to_num(column)
    return np.interp(np.arange(len(column)), np.flatnonzero(known), column[known])
