"""At which values of a shape does a search begin?

What a mechanism does not depend on linearly is looked for about sizes, times and frequencies of the recorded
motion; what the values themselves show of a sensor, its steps and the ends of its range, is read off them.
"""

from __future__ import annotations

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import compile_values, parse_formula
from siq.dynamics.parametric import symbol
from siq.estimation.measurements import Measurements
from siq.mismatch.dictionary import Shape

ON_LATTICE = 1e-3  # of a step: numbers that were written with a few digits lie on their lattice within this


def places_of(search: Shape, data: Measurements, model: Dynamics, x: np.ndarray) -> np.ndarray:
    """The values of a shape that a search begins with."""
    factors = np.array(search.at)
    steps = np.diff(data.t)[np.diff(data.recording) == 0]
    if search.samples:
        return factors * np.median(steps)
    if search.frequencies is not None:
        longest = max(
            data.t[end - 1] - data.t[begin]
            for begin, end in zip(data.first[:-1], data.first[1:], strict=True)
        )
        # From one period in the longest recording to four samples a period.
        return np.linspace(2 * np.pi / longest, np.pi / (2 * np.median(steps)), search.frequencies)
    if search.recorded is not None:
        place = model.output_names.index(search.recorded)
        values = data.outputs[:, place]
        if search.lattice_of is not None:
            found = lattice_step(values)
        else:
            side = 1.0 if search.top_of is not None else -1.0
            top = plateau(side * values, data.recording, noise=float(np.sqrt(data.roughness[place])))
            found = None if top is None else side * top
        return np.zeros(0) if found is None else np.array([found])
    text = search.scale_of or search.inverse_scale_of or search.quantiles_of or search.time_of
    course = along(str(text), data, model, x)
    if search.quantiles_of is not None:
        return np.quantile(course, factors)
    if search.time_of is not None:
        rows = data.begins
        rates = (course[rows + 1] - course[rows]) / (data.t[rows + 1] - data.t[rows])
        rate = float(np.sqrt(np.mean(rates**2)))
        return factors * (float(course.std()) / rate if rate > 0 else float(np.median(steps)))
    size = float(np.sqrt(np.mean(course**2))) or 1.0
    return factors * size if search.scale_of is not None else factors / size


def lattice_step(values: np.ndarray) -> float | None:
    """The step of the lattice through zero on which all values lie; None where there is none.

    Parameters
    ----------
    values
        What a sensor recorded, shape ``(n,)``; NaN where nothing was measured.
    """
    values = values[np.isfinite(values)]
    levels = np.unique(values)
    if not 2 < len(levels) < len(values) / 2:  # of values that hardly repeat a lattice tells nothing
        return None
    step = float(np.diff(levels).min())
    numbers = np.rint(levels / step)
    if not numbers.any():
        return None
    step = float(levels @ numbers / (numbers @ numbers))
    return step if np.abs(levels - numbers * step).max() < ON_LATTICE * step else None


def plateau(values: np.ndarray, recording: np.ndarray, *, noise: float) -> float | None:
    """Where recorded values end, if they stay there for a while; None where they only turn.

    Parameters
    ----------
    values
        What a sensor recorded, shape ``(n,)``.
    recording
        The place of each value's recording; it never decreases. Shape ``(n,)``.
    noise
        Standard deviation of the sensor's noise: what lies within two of it on either side is at the end.
    """
    ends = values >= np.nanmax(values) - 4 * noise
    same = recording[2:] == recording[:-2]
    stays = ends[2:] & ends[1:-1] & ends[:-2] & same  # a parabola has two points of one height, not three
    if not stays.any():
        return None
    rows = np.flatnonzero(stays)
    return float(np.median(values[np.unique(np.concatenate([rows, rows + 1, rows + 2]))]))


def along(text: str, data: Measurements, model: Dynamics, x: np.ndarray) -> np.ndarray:
    """A formula of states and inputs at all samples, shape ``(n,)``."""
    known = {symbol(each.name): each.value for each in model.parameters}
    formula = parse_formula(text, model.names).subs(known)
    signals = data.signals(data.t, data.recording, delays=())
    arguments = [*(symbol(n) for n in model.states), *(symbol(e.name) for e in model.inputs), symbol("t")]
    value = compile_values([formula], arguments, common=False)(*x.T, *signals.inputs, signals.t)[0]
    return np.broadcast_to(value, data.t.shape)
