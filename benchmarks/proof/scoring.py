"""Scores: a diagnosis held against the key of its case, one row a case."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
import sympy

from benchmarks.proof.keys import CaseKey, Truth, read_key, read_truth
from benchmarks.proof.oracle import Oracle, oracle_of, pairing, true_model
from siq.diagnosis.study import Comparison, read_case
from siq.systems.cards import load_system
from siq.systems.dynamics import Dynamics, Signals
from siq.systems.formulas import parse_formula

NOISE = "process noise"
NOTHING = ("no mismatch", "parameter shift")
NOTHING_CONCEALED = ("null", "shift")
NAMELESS = ("modelled", "unexplained")
EXPECTED: Mapping[str, tuple[str, ...]] = {
    "null": ("no mismatch",),
    "shift": ("parameter shift",),
    "mechanism": ("missing physics",),
    "process noise": ("missing physics",),
    "withheld": NAMELESS,
}
FAILED = "failed"
INTERVAL = 1.96

COLUMNS: Mapping[str, str] = {
    "case": "str",
    "system": "str",
    "kind": "str",
    "mechanism": "str",
    "noise_db": "float64",
    "strength": "float64",
    "shifted": "bool",
    "verdict": "str",
    "named": "str",
    "reported_class": "str",
    "class_size": "int64",
    "right": "bool",
    "truth_in_class": "bool",
    "false_alarm": "bool",
    "deterministic_under_noise": "bool",
    "detected": "bool",
    "equation_right": "bool",
    "coordinate_right": "bool",
    "location": "str",
    "same_formula": "bool",
    "delta_chi2": "float64",
    "oracle_delta_chi2": "float64",
    "oracle_error": "float64",
    "recalibrated_error": "float64",
    "augmented_error": "float64",
    "error_ratio": "float64",
    "functional_error": "float64",
    "oracle_functional_error": "float64",
    "intensity_ratio": "float64",
    "mechanism_intervals": "int64",
    "mechanism_covered": "int64",
    "parameter_intervals": "int64",
    "parameter_covered": "int64",
    "seconds": "float64",
    "note": "str",
}
"""Columns of the table of scores, in order, with their types."""


@dataclass(frozen=True)
class Answer:
    """What a diagnosis said of a case.

    Attributes
    ----------
    verdict
        The content of ``verdict.json``, None where there is none.
    card
        The augmented card, as text.
    seconds
        How long it took, NaN where nobody measured.
    failure
        Why there is no verdict.
    """

    verdict: Mapping[str, Any] | None
    card: str
    seconds: float = np.nan
    failure: str = ""


def read_answers(path: str | Path) -> dict[str, Answer]:
    """The answers of a batch by name of the case."""
    found = json.loads(Path(path).read_text(encoding="utf-8"))
    return {
        each["case"]: Answer(each["verdict"], each["card"], each["seconds"], each["failure"])
        for each in found
    }


def score_case(name: str, folder: str | Path, keys: str | Path, answer: Answer) -> dict[str, Any]:
    """Score a diagnosis.

    Parameters
    ----------
    name
        Of the case.
    folder
        Its files.
    keys
        The folder with ``NAME.json``, and ``NAME.npz`` where there are truths.
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
    case, key, truth = read_opened(name, Path(folder), Path(keys))
    row = judgement(key, answer) | {"case": name}
    oracle = oracle_of(case, key)
    notes = [answer.failure, oracle.note]
    row |= held_out_scores(answer, oracle)
    if key.kind == "mechanism" and oracle.model is not None:
        row["oracle_functional_error"] = functional_error(case.system, oracle.model, key, truth)[0]
    if answer.verdict is not None:
        augmented = model_of(answer.card)
        found, note = coefficient_scores(case, key, truth, answer.verdict, augmented, row)
        row |= found
        notes.append(note)
    return row | {"note": "; ".join(each for each in notes if each)}


def read_opened(name: str, folder: Path, keys: Path) -> tuple[Comparison, CaseKey, Truth | None]:
    """A case as the diagnosis had it, its key, and the arrays of the key where there are any."""
    csv, study = folder / "recordings.csv", folder / "study.yaml"
    recordings = csv if csv.is_file() else folder / "recordings.parquet"
    case = read_case(folder / "system.yaml", recordings, study if study.is_file() else None)
    return case, read_key(keys / f"{name}.json"), read_truth(keys / f"{name}.npz")


def score_table(rows: list[dict[str, Any]], columns: Mapping[str, str] = COLUMNS) -> pd.DataFrame:
    """Rows as a table with all columns; what a row does not say is missing, not counted or no."""
    empty: dict[str, Any] = {"str": "", "bool": False, "int64": 0, "float64": np.nan}
    whole = [{name: row.get(name, empty[kind]) for name, kind in columns.items()} for row in rows]
    frame = pd.DataFrame(whole, columns=list(columns))
    return frame.astype(dict(columns)).sort_values("case", ignore_index=True)


def stated(key: CaseKey, answer: Answer, names: Sequence[str]) -> dict[str, Any]:
    """What of a key and a verdict stands in every table of scores; `names` are those that count."""
    verdict = answer.verdict or {}
    modelled = verdict.get("outcome") == "modelled"  # missing physics, too, and without a name
    said = "modelled" if modelled else str(verdict.get("verdict", FAILED))
    nothing = said in NOTHING or (said == "missing physics" and not names)
    found = not nothing and said != FAILED
    return {
        "system": key.system,
        "kind": key.kind,
        "noise_db": np.nan if key.noise_db is None else key.noise_db,
        "strength": np.nan if key.strength is None else key.strength,
        "shifted": bool(key.shifts),
        "verdict": said,
        "named": ", ".join(names),
        "false_alarm": key.kind in NOTHING_CONCEALED and found,
        "detected": found,
        "seconds": answer.seconds,
    }


def judgement(key: CaseKey, answer: Answer) -> dict[str, Any]:
    """What follows from verdict and key alone."""
    verdict: Mapping[str, Any] = answer.verdict or {}
    named = list(verdict.get("mechanisms", ()))
    reported = reported_class(named)
    names = [str(each["name"]) for each in named]
    row = stated(key, answer, names)
    place = verdict.get("location") or {}
    return row | {
        "mechanism": key.mechanism or "",
        "reported_class": ", ".join(reported),
        "class_size": len(reported),
        "right": row["verdict"] in EXPECTED[key.kind] and (key.kind != NOISE or names == [NOISE]),
        "truth_in_class": key.mechanism in reported,
        "deterministic_under_noise": key.kind == NOISE and any(name != NOISE for name in names),
        "equation_right": bool(place) and set(key.equations) <= set(place.get("equations", {})),
        "coordinate_right": bool(place) and coordinate_right(key, place, named),
        "location": f"{', '.join(place.get('equations', {}))} along {place.get('coordinate')}"
        if place
        else "",
        "delta_chi2": _number(named[0]["evidence"]["delta_chi2"]) if named else np.nan,
    }


def reported_class(named: list[Mapping[str, Any]]) -> list[str]:
    """The first mechanism and what cannot be told from it; empty where none is named."""
    if not named:
        return []
    first = str(named[0]["name"])
    return [first, *sorted(set(map(str, named[0]["indistinguishable_from"])) - {first})]


def coordinate_right(key: CaseKey, place: Mapping[str, Any], named: list[Mapping[str, Any]]) -> bool:
    """Whether all that the diagnosis names as coordinate counts as right."""
    if not key.coordinates:
        return True
    said = str(place["coordinate"])
    # Of a sensor's fault the coordinate is what it measures.
    words = set(named[0]["terms"]) if said == "measurement" and named else set(re.findall(r"\w+", said))
    return bool(words) and words <= set(key.coordinates)


def held_out_scores(answer: Answer, oracle: Oracle) -> dict[str, float]:
    """Errors on held-out recordings, beside that of the oracle."""
    errors = (answer.verdict or {}).get("fit", {})
    augmented = _number(errors.get("augmented"))
    return {
        "oracle_delta_chi2": oracle.delta_chi2,
        "oracle_error": oracle.error,
        "recalibrated_error": _number(errors.get("recalibrated")),
        "augmented_error": augmented,
        "error_ratio": augmented / oracle.error if oracle.error > 0 else np.nan,
    }


def coefficient_scores(
    case: Comparison,
    key: CaseKey,
    truth: Truth | None,
    verdict: Mapping[str, Any],
    augmented: Dynamics,
    row: Mapping[str, Any],
) -> tuple[dict[str, Any], str]:
    """Functional error, coverage of intervals, and what kept them from being known."""
    scores: dict[str, Any] = {}
    note = ""
    named = list(verdict["mechanisms"])
    pairs = None
    if key.kind == NOISE and row["right"]:
        scores["intensity_ratio"] = intensity_ratio(key, named[0]["parameters"])
    if key.kind == "mechanism" and row["truth_in_class"]:
        true, names = true_model(case.system, key)
        pairs = pairing(augmented, true, case.system)
        scores["same_formula"] = pairs is not None
        if pairs is not None:
            known = {own: sign * key.effect.parameters[names[name]] for own, (name, sign) in pairs.items()}
            parameters = {own: entry for each in named for own, entry in each["parameters"].items()}
            scores |= _counted("mechanism", covered(parameters, known, value="estimate"))
        scores["functional_error"], note = functional_error(case.system, augmented, key, truth)
        if pairs is not None and note and augmented.delays and len(pairs) == 1:
            ((own, (name, sign)),) = pairs.items()
            estimate = next(each.value for each in augmented.parameters if each.name == own)
            scores["functional_error"] = abs(sign * estimate / key.effect.parameters[names[name]] - 1)
            note = ""
    if (row["right"] and key.kind in NOTHING_CONCEALED) or pairs is not None:
        shifts = {name: shift.true for name, shift in key.shifts.items()}
        truths = {name: shifts.get(name, entry["before"]) for name, entry in verdict["recalibration"].items()}
        scores |= _counted("parameter", covered(verdict["recalibration"], truths, value="after"))
    return scores, note


def covered(
    entries: Mapping[str, Mapping[str, Any]], truths: Mapping[str, float], *, value: str
) -> tuple[int, int]:
    """How many 95 % intervals there are, and how many of them have the truth."""
    known = [
        (abs(entries[name][value] - true), entries[name]["standard_error"])
        for name, true in truths.items()
        if name in entries and entries[name]["standard_error"]
    ]
    return len(known), sum(distance <= INTERVAL * error for distance, error in known)


def functional_error(
    base: Dynamics, augmented: Dynamics, key: CaseKey, truth: Truth | None
) -> tuple[float, str]:
    """Error of the augmented f, or of what its sensor reads, relative to the effect.

    Parameters
    ----------
    base
        The card's simulation.
    augmented
        What the diagnosis ended with.
    key, truth
        What is concealed, and the rows at which it is evaluated.

    Returns
    -------
    float, str
        Root mean square over the rows and the effect's equations; NaN and the reason where it is not known.
    """
    if truth is None:
        return np.nan, "the key has no arrays"
    if augmented.dimension > base.dimension or augmented.delays:
        return np.nan, "no functional error: the effect has a memory"
    if key.effect.outputs and not key.equations:
        places = [base.dimension + base.output_names.index(name) for name in key.effect.outputs]
        theirs, without = (values_at(each, truth)[places] for each in (true_model(base, key)[0], base))
    else:
        places = [base.states.index(name) for name in key.equations]
        theirs, without = truth.true.T[places], truth.without.T[places]
    ours = values_at(augmented, truth)[places]
    size = np.sqrt(np.mean((theirs - without) ** 2, axis=1))
    error = np.sqrt(np.mean((ours - theirs) ** 2, axis=1))
    seen = size > 0
    if not seen.any():
        return np.nan, "no functional error: the effect is zero at all rows"
    return float(np.sqrt(np.mean((error[seen] / size[seen]) ** 2))), ""


def values_at(model: Dynamics, truth: Truth) -> np.ndarray:
    """Time derivatives and outputs at the rows of a key, shape ``(d + m, n)``."""
    none = np.zeros((0, len(truth.t)))
    signals, states = Signals(truth.inputs.T, none, none, truth.t), truth.states.T
    functions = (model.functions.rates, model.functions.outputs)
    return np.concatenate([one(states, signals, model.values) for one in functions])


def intensity_ratio(key: CaseKey, parameters: Mapping[str, Mapping[str, Any]]) -> float:
    """Estimated over true intensity of process noise, σ² per time."""
    ratios = []
    for name, text in key.effect.noise.items():
        sigma = float(
            parse_formula(text, {each: sympy.Float(v) for each, v in key.effect.parameters.items()})
        )
        estimate = parameters.get(f"intensity_{name}", {"estimate": 0.0})["estimate"]
        ratios.append(float(estimate) / sigma**2)
    return float(np.mean(ratios)) if ratios else np.nan


def model_of(card: str) -> Dynamics:
    """The simulation of a card that is given as text."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "system.yaml"
        path.write_text(card, encoding="utf-8")
        return load_system(path)


def _counted(what: str, counts: tuple[int, int]) -> dict[str, int]:
    return {f"{what}_intervals": counts[0], f"{what}_covered": counts[1]}


def _number(value: Any) -> float:
    return np.nan if value is None else float(value)
