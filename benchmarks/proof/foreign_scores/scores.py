"""What of a diagnosis is right? One row a case."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.proof.foreign_scores.oracle import TrueSimulation, free_errors, true_simulation
from benchmarks.proof.foreign_scores.places import Told, told_places
from benchmarks.proof.foreign_scores.rulers import NEAR, name_error, said_place, true_place, unreal_names
from benchmarks.proof.keys import CaseKey, Truth, read_key, read_truth
from benchmarks.proof.scoring import FAILED, NOTHING, Answer, model_of
from siq.diagnosis.study import Comparison, read_case

KNOWN = 100.0
"""Δχ² from which on an oracle knows something, as in the first proof."""

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
    folder, keys = Path(folder), Path(keys)
    key, truth = read_key(keys / f"{name}.json"), read_truth(keys / f"{name}.npz")
    assert truth is not None
    case = read_case(folder / "system.yaml", folder / "recordings.parquet", folder / "study.yaml")
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
    word = str(verdict.get("verdict", FAILED))
    names = unreal_names(verdict.get("mechanisms", []), key)
    nothing = word in NOTHING or (word == "missing physics" and not names)
    concealed = key.kind == "withheld"
    right = {"null": word == "no mismatch", "shift": word == "parameter shift"}
    faults = [
        f"steps of {max(key.sensors.steps.values()):.2g}" if key.sensors.steps else "",
        f"{100 * key.sensors.lost:.0f} % lost" if key.sensors.lost else "",
        f"jitter of {100 * key.sensors.jitter:.1f} %" if key.sensors.jitter else "",
    ]
    return {
        "system": key.system,
        "kind": key.kind,
        "law": key.mechanism or "",
        "noise_db": key.noise_db,
        "strength": np.nan if key.strength is None else key.strength,
        "shifted": bool(key.shifts),
        "sensors": ", ".join(filter(None, faults)),
        "verdict": word,
        "named": ", ".join(names),
        "described": ", ".join(str(each["label"]) for each in verdict.get("described", [])),
        "right": right.get(key.kind, word == "unexplained"),
        "false_alarm": not concealed and not nothing and word != FAILED,
        "detected": not nothing and word != FAILED,
        "seconds": answer.seconds,
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
