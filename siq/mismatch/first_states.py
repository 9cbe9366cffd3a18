"""States to begin a fit with, read off what was measured."""

from __future__ import annotations

import numpy as np

from siq.mismatch.measurements import Measurements
from siq.mismatch.model import Model


def first_states(model: Model, data: Measurements) -> np.ndarray:
    """States to begin with: measured ones as measured, velocities by differences, others mid-domain."""
    states = np.tile(model.domain.mean(axis=1), (len(data.t), 1))
    from_output = {str(formula): place for place, (_, formula) in enumerate(model.outputs)}
    derivative_of = {
        str(equation): name
        for name, equation, is_definition in zip(model.states, model.equations, model.kinematic, strict=True)
        if is_definition
    }
    for place, name in enumerate(model.states):
        if name in from_output:
            states[:, place] = _filled(data, data.outputs[:, from_output[name]])
    for place, name in enumerate(model.states):
        if name not in from_output and derivative_of.get(name) in from_output:
            position = _filled(data, data.outputs[:, from_output[derivative_of[name]]])
            for begin, end in zip(data.first[:-1], data.first[1:], strict=True):
                if end - begin > 1:
                    states[begin:end, place] = np.gradient(position[begin:end], data.t[begin:end])
    return states


def _filled(data: Measurements, column: np.ndarray) -> np.ndarray:
    """A measured column with gaps filled linearly."""
    known = np.isfinite(column)
    if known.all() or not known.any():
        return np.nan_to_num(column)
    return np.interp(np.arange(len(column)), np.flatnonzero(known), column[known])
