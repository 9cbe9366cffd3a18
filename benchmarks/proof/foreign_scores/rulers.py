"""How near is what was named, where was it said to be, and how much of the gain was had?"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.proof.foreign_scores.places import orthonormal
from benchmarks.proof.keys import CaseKey, Truth
from benchmarks.proof.oracle import true_model
from siq.systems.dynamics import Dynamics, Signals

NEAR = 0.1
"""Relative error up to which a named function is the drawn one."""

ROUNDING = "quantisation"
STEP = 0.1  # relative error up to which a step in which a sensor reads is the true one


def name_error(system: Dynamics, augmented: Dynamics, key: CaseKey, truth: Truth) -> float:
    """How far the mended simulation is from the true one, relative to what is concealed.

    Whatever other values of the free parameters can do counts on neither side: no recording tells a function
    from them. Equations and outputs are taken together, each in units of its own size.

    Parameters
    ----------
    system
        The card's simulation.
    augmented
        The simulation with what was named.
    key, truth
        What is concealed, and the rows at which it is evaluated.

    Returns
    -------
    float
        Infinite where states or delays were added, which the truth has none of; NaN where free parameters can
        do all that is concealed.
    """
    if augmented.dimension > system.dimension or augmented.delays:
        return np.inf
    true, _ = true_model(system, key)
    own = _own(system, true)
    right = system.with_values(own)
    theirs, without, ours = (_all_values(each, truth) for each in (true, right, augmented))
    size = np.sqrt(np.mean(theirs**2, axis=1, keepdims=True))
    size = np.where(size > 0, size, 1.0)
    columns = []
    for place in system.free:
        step = 1e-5 * max(abs(own[place]), 1e-3)
        moved = own.copy()
        moved[place] += step
        columns.append(((_all_values(system.with_values(moved), truth) - without) / step / size).ravel())
    basis = orthonormal(np.stack(columns, axis=1)) if columns else np.zeros((without.size, 0))

    def beyond(difference: np.ndarray) -> float:
        flat = (difference / size).ravel()
        return float(np.linalg.norm(flat - basis @ (basis.T @ flat)))

    concealed = beyond(theirs - without)
    if not concealed > 1e-6 * float(np.linalg.norm(((theirs - without) / size).ravel())):
        return np.nan
    found = beyond(ours - theirs) / concealed
    return found if np.isfinite(found) else np.inf


def _own(system: Dynamics, other: Dynamics) -> np.ndarray:
    known = {each.name: each.value for each in other.parameters}
    return np.array([known[each.name] for each in system.parameters])


def _all_values(model: Dynamics, truth: Truth) -> np.ndarray:
    """Time derivatives and outputs at the rows of the key, shape ``(d + m, n)``."""
    signals = Signals(truth.inputs.T, np.zeros((0, len(truth.t))), np.zeros((0, len(truth.t))), truth.t)
    states = truth.states.T
    return np.concatenate(
        [
            model.functions.rates(states, signals, model.values),
            model.functions.outputs(states, signals, model.values),
        ]
    )


def unreal_names(mechanisms: Sequence[Mapping[str, Any]], key: CaseKey) -> list[str]:
    """Names but for those of sensors' faults: that a sensor rounds is right where it does."""
    return [str(each["name"]) for each in mechanisms if not _rounds(each, key)]


def _rounds(mechanism: Mapping[str, Any], key: CaseKey) -> bool:
    steps = [key.sensors.steps[name] for name in mechanism["terms"] if name in key.sensors.steps]
    if mechanism["name"] != ROUNDING or not steps:
        return False
    values = [each["estimate"] for each in mechanism["parameters"].values()]
    return any(abs(value / step - 1) < STEP for value in values for step in steps)


def said_place(verdict: Mapping[str, Any]) -> tuple[set[str], set[str]]:
    """Equations, or sensors, and coordinates that a verdict names as the place of a mismatch."""
    place = verdict.get("location") or {}
    if place.get("coordinate") == "measurement":
        outputs = set(place.get("outputs", []))
        return {f"sensor {name}" for name in outputs}, outputs
    return set(place.get("equations", {})), set(re.findall(r"\w+", str(place.get("coordinate", ""))))


def true_place(key: CaseKey) -> set[str]:
    """The equation, or the sensor, in which something is concealed."""
    return set(key.equations) or {f"sensor {name}" for name in key.effect.outputs}
