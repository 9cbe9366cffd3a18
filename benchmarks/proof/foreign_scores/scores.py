"""What of a diagnosis is right? One row a case: its names, its place, and how much of the gain was had."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.proof.foreign_scores.oracle import TrueSimulation, free_errors, true_simulation
from benchmarks.proof.foreign_scores.places import Told, orthonormal, told_places
from benchmarks.proof.keys import CaseKey, Truth
from benchmarks.proof.oracle import own_values, true_model
from benchmarks.proof.scoring import EXPECTED, Answer, model_of, read_opened, stated, values_at
from siq.diagnosis.study import Comparison
from siq.systems.dynamics import Dynamics

KNOWN = 100.0
"""Δχ² from which on an oracle knows something, as in the first proof."""

NEAR = 0.1
"""Relative error up to which a named function is the drawn one."""

ROUNDING = "quantisation"
STEP = 0.1  # relative error up to which a step in which a sensor reads is the true one
SURE = 2.0  # standard errors of the oracle's gain, from which on it is asked for
ENOUGH = 0.9  # of it

COLUMNS: Mapping[str, str] = {
    "case": "str",
    "system": "str",
    "kind": "str",
    "law": "str",
    "noise_db": "float64",
    "strength": "float64",
    "shifted": "bool",
    "sensors": "str",
    "recordings": "int64",
    "samples": "int64",
    "verdict": "str",
    "named": "str",
    "described": "str",
    "right": "bool",
    "false_alarm": "bool",
    "detected": "bool",
    "wrong_name": "bool",
    "name_error": "float64",
    "true_place": "str",
    "said_place": "str",
    "told_effect": "float64",
    "told_equation": "float64",
    "told_coordinate": "float64",
    "place_asked": "bool",
    "place_right": "bool",
    "oracle_delta_chi2": "float64",
    "card_error": "float64",
    "oracle_error": "float64",
    "augmented_error": "float64",
    "gain": "float64",
    "gain_error": "float64",
    "share_of_gain": "float64",
    "gain_asked": "bool",
    "gain_had": "bool",
    "seconds": "float64",
    "note": "str",
}
"""Columns of the table of scores, in order, with their types."""


def score_foreign_case(name: str, folder: str | Path, keys: str | Path, answer: Answer) -> dict[str, Any]:
    """Score a diagnosis.

    Parameters
    ----------
    name
        Of the case.
    folder
        Its files.
    keys
        The folder with ``NAME.json`` and ``NAME.npz``.
    answer
        What is scored.

    Returns
    -------
    dict
        A row of the table `COLUMNS`.

    Raises
    ------
    InputError
        When a file of the case, or its key, cannot be used.
    """
    keys = Path(keys)
    case, key, truth = read_opened(name, Path(folder), keys)
    assert truth is not None
    row = said(key, answer) | {"case": name}
    row |= {"recordings": len(case.learn.labels), "samples": len(case.learn.t)}
    notes = [answer.failure]
    augmented = None if answer.verdict is None else model_of(answer.card)
    if row["named"] and augmented is not None and key.kind == "withheld":
        row["name_error"] = name_error(case.system, augmented, key, truth)
        row["wrong_name"] = not row["name_error"] <= NEAR
        row["right"] = not row["wrong_name"]
    try:
        oracle = true_simulation(case, key, truth, first_states(case, keys / f"{name}.npz"))
        row |= gains(case, key, truth, oracle, answer)
        if key.kind == "withheld":
            row |= places(key, told_places(case, key, oracle.true), answer)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        notes.append(f"no oracle: {error}")
    return row | {"note": "; ".join(each for each in notes if each)}


def first_states(case: Comparison, path: Path) -> np.ndarray:
    """True first states of the recordings that were learned from; labels are r01, r02, and so on."""
    with np.load(path, allow_pickle=False) as arrays:
        starts = arrays["starts"]
    return np.asarray(starts[[int(label[1:]) - 1 for label in case.learn.labels]])


def said(key: CaseKey, answer: Answer) -> dict[str, Any]:
    """What a diagnosis said, and what of it needs no fit to be judged."""
    verdict = answer.verdict or {}
    row = stated(key, answer, unreal_names(verdict.get("mechanisms", []), key))
    faults = [
        f"steps of {max(key.sensors.steps.values()):.2g}" if key.sensors.steps else "",
        f"{100 * key.sensors.lost:.0f} % lost" if key.sensors.lost else "",
        f"jitter of {100 * key.sensors.jitter:.1f} %" if key.sensors.jitter else "",
    ]
    return row | {
        "law": key.mechanism or "",
        "sensors": ", ".join(filter(None, faults)),
        "described": ", ".join(str(each["label"]) for each in verdict.get("described", [])),
        "right": row["verdict"] in EXPECTED[key.kind],
    }


def gains(
    case: Comparison, key: CaseKey, truth: Truth, oracle: TrueSimulation, answer: Answer
) -> dict[str, Any]:
    """How much better held-out recordings are predicted, by the oracle and by the mended simulation."""
    card, augmented = oracle.card_error, np.nan
    if answer.verdict is not None:
        errors = free_errors(model_of(answer.card), case.kept, oracle.true.noise, truth)
        augmented = float(np.sqrt(errors.mean()))
    gain = card - oracle.true_error
    asked = key.kind == "withheld" and bool(gain > SURE * oracle.gain_error)
    share = (card - augmented) / gain if asked else np.nan
    return {
        "oracle_delta_chi2": oracle.delta_chi2,
        "card_error": card,
        "oracle_error": oracle.true_error,
        "augmented_error": augmented,
        "gain": gain,
        "gain_error": oracle.gain_error,
        "share_of_gain": share,
        "gain_asked": asked,
        "gain_had": bool(share >= ENOUGH),
    }


def places(key: CaseKey, told: Told, answer: Answer) -> dict[str, Any]:
    """Whether the place is right, as far as the oracle can tell it.

    The equation, or the sensor, is asked for where an oracle tells it from all others, and the coordinate
    where it tells that, too. All that is said has to be right.
    """
    where, along = said_place(answer.verdict or {})
    here = true_place(key)
    equation = where == here
    coordinate = bool(along) and along <= set(key.coordinates)
    asked = told.equation >= KNOWN
    along_too = asked and told.coordinate >= KNOWN
    return {
        "true_place": f"{', '.join(sorted(here))} along {', '.join(key.coordinates)}",
        "said_place": f"{', '.join(sorted(where))} along {', '.join(sorted(along))}"
        if where or along
        else "",
        "told_effect": told.effect,
        "told_equation": told.equation,
        "told_coordinate": told.coordinate,
        "place_asked": asked,
        "place_right": asked and equation and (coordinate or not along_too),
    }


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
    own = own_values(system, true)
    right = system.with_values(own)
    theirs, without, ours = (values_at(each, truth) for each in (true, right, augmented))
    size = np.sqrt(np.mean(theirs**2, axis=1, keepdims=True))
    size = np.where(size > 0, size, 1.0)
    columns = []
    for place in system.free:
        step = 1e-5 * max(abs(own[place]), 1e-3)
        moved = own.copy()
        moved[place] += step
        columns.append(((values_at(system.with_values(moved), truth) - without) / step / size).ravel())
    basis = orthonormal(np.stack(columns, axis=1)) if columns else np.zeros((without.size, 0))

    def beyond(difference: np.ndarray) -> float:
        flat = (difference / size).ravel()
        return float(np.linalg.norm(flat - basis @ (basis.T @ flat)))

    concealed = beyond(theirs - without)
    if not concealed > 1e-6 * float(np.linalg.norm(((theirs - without) / size).ravel())):
        return np.nan
    found = beyond(ours - theirs) / concealed
    return found if np.isfinite(found) else np.inf


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
