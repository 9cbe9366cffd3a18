"""Could the recordings tell another place from the true one?

To first order about the true motion: what the concealed function does to the recordings, less what
parameters, first states and any function of one coordinate in another place can do instead. What remains, in
units of the noise, is the Δχ² by which an oracle knows the place.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from benchmarks.proof.foreign_scores.oracle import LeastSquares
from benchmarks.proof.keys import CaseKey
from siq.diagnosis.study import Comparison

KNOTS = 8  # of the piecewise linear functions in other places
FAINT = 1e-9  # relative size below which a direction is none


@dataclass(frozen=True)
class Told:
    """By which Δχ² an oracle knows.

    Attributes
    ----------
    effect
        That the function is there at all.
    equation
        That it is in its equation, or its sensor, rather than in any other.
    coordinate
        That it is a function of its coordinates, rather than of another one in the same place.
    """

    effect: float
    equation: float
    coordinate: float


def told_places(case: Comparison, key: CaseKey, true: LeastSquares) -> Told:
    """Hold the concealed function against functions of one coordinate in other places.

    Parameters
    ----------
    case
        As the diagnosis had it.
    key
        What it conceals: one function with one amplitude, the last parameter of the true simulation.
    true
        The fit of the true simulation.
    """
    columns = true.jacobian()
    names = [true.model.parameters[place].name for place in true.model.free]
    known = {each.name for each in case.system.parameters}
    ours = next(k for k, name in enumerate(names) if name not in known)
    effect = columns[:, ours] * true.model.values[true.model.free[ours]]
    basis = orthonormal(np.delete(columns, ours, axis=1))
    left = effect - basis @ (basis.T @ effect)
    place = key.equations[0] if key.equations else next(iter(key.effect.outputs))
    equation, coordinate = [np.inf], [np.inf]
    for (where, of), responses in _responses(true).items():
        rival = responses - basis @ (basis.T @ responses)
        own = orthonormal(rival)
        remains = float(np.sum((left - own @ (own.T @ left)) ** 2))
        here = where == (place if key.equations else f"sensor {place}")
        if not here:
            equation.append(remains)
        elif of not in key.coordinates:
            coordinate.append(remains)
    return Told(float(left @ left), min(equation), min(coordinate))


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the span of some columns, each of them scaled alike."""
    size = np.linalg.norm(columns, axis=0)
    kept = columns[:, size > 0] / size[size > 0]
    if not kept.shape[1]:
        return np.zeros((len(columns), 0))
    left, values, _ = np.linalg.svd(kept, full_matrices=False)
    basis: np.ndarray = left[:, values > FAINT * values[0]]
    return basis


def _responses(true: LeastSquares) -> Mapping[tuple[str, str], np.ndarray]:
    """What functions of one coordinate do to the recordings, by place and coordinate, ``(n m, knots)``."""
    integrator, model, values = true.integrator, true.model, true.model.values
    states = integrator.run(values, true.starts)
    along = integrator.sensitivities(values, states)
    by_states, _ = integrator.output_slopes(values, states)
    coordinates = dict(zip(model.states, states.T, strict=True))
    coordinates |= {each.name: row for each, row in zip(model.inputs, integrator.inputs, strict=True)}
    begins, found = integrator.begins, {}
    for of, course in coordinates.items():
        hats = _hats(course)
        between = (hats[begins] + hats[begins + 1]) / 2
        for place, name in enumerate(model.states):
            if model.kinematic[place]:
                continue
            driven = along.by_forces[:, :, place, None] * between[:, None, :]
            moved = by_states @ integrator.chained(along, driven)
            found[name, of] = (moved / true.noise[None, :, None]).reshape(-1, hats.shape[1])
    measured = integrator.outputs(states, values)
    for place, name in enumerate(model.output_names):
        hats = _hats(measured[:, place])
        added = np.zeros((*measured.shape, hats.shape[1]))
        added[:, place] = hats / true.noise[place]
        found[f"sensor {name}", name] = added.reshape(-1, hats.shape[1])
    return found


def _hats(course: np.ndarray) -> np.ndarray:
    """Piecewise linear functions on knots between which equally many values lie, shape ``(n, knots)``."""
    knots = np.unique(np.quantile(course, np.linspace(0, 1, KNOTS)))
    if len(knots) < 2:
        return np.ones((len(course), 1))
    return np.stack([np.interp(course, knots, row) for row in np.eye(len(knots))], axis=1)
