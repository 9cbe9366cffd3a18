"""What of an answer is right? One row a case and method, failures included."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.discrepancies.added import Added
from benchmarks.discrepancies.answers import Answer, Term, answer_file, read_answer
from benchmarks.discrepancies.cases import CaseFiles
from benchmarks.discrepancies.truth import TrueCase, true_case
from benchmarks.proof.foreign_scores.scores import NEAR, first_states, name_error, true_place, unreal_names
from benchmarks.proof.keys import CaseKey, read_key, read_truth
from benchmarks.proof.scoring import NOISE, NOTHING_CONCEALED, Answer as ProofAnswer, judgement, model_of
from siq.diagnosis.study import Comparison
from siq.errors import NumericalFailure
from siq.inference.recalibration import recalibrate
from siq.systems.dynamics import Dynamics
from workflow.files import write_table

CARD = "card alone"
"""The row of the recalibrated card, to which nothing was added."""

OURS = "siq"
KNOWN = 100.0  # Δχ² from which on an oracle knows something, as in the proofs
CONCEALING = ("mechanism", "withheld")
AMPLITUDE = "amplitude"  # a coordinate that is made of all states of a rotating frame

COLUMNS: Mapping[str, str] = {
    "generator": "str",
    "case": "str",
    "system": "str",
    "kind": "str",
    "concealed": "str",
    "noise_db": "float64",
    "strength": "float64",
    "oracle_delta_chi2": "float64",
    "knowable": "bool",
    "method": "str",
    "applied": "bool",
    "answered": "bool",
    "detected": "bool",
    "evidence": "float64",
    "false_alarm": "bool",
    "nameable": "bool",
    "named": "str",
    "name_right": "bool",
    "name_wrong": "bool",
    "true_place": "str",
    "said_place": "str",
    "equation_right": "bool",
    "place_right": "bool",
    "error": "float64",
    "card_error": "float64",
    "oracle_error": "float64",
    "error_ratio": "float64",
    "seconds": "float64",
    "commit": "str",
    "note": "str",
}
"""Columns of the table of scores, in order, with their types."""


def scored_case(case: CaseFiles, folder: Path, keys: Path, methods: Sequence[str]) -> list[dict[str, Any]]:
    """Score all answers to a case, and the card alone.

    Parameters
    ----------
    case
        Which case.
    folder
        With the answers.
    keys
        With a folder of keys for each generator.
    methods
        Whose answers; one that is missing is a row without an answer.
    """
    own = keys / case.generator
    key, truth = read_key(own / f"{case.name}.json"), read_truth(own / f"{case.name}.npz")
    assert truth is not None
    comparison = case.read()
    starts = first_states(comparison, own / f"{case.name}.npz") if case.generator == "foreign" else None
    true = true_case(comparison, key, truth, starts)
    errors = Errors(comparison, true)
    oracle, card = errors.of(true.model, None), errors.of(recalibrated(comparison), None)
    common: dict[str, Any] = {
        "generator": case.generator,
        "case": case.name,
        "system": key.system,
        "kind": key.kind,
        "concealed": key.mechanism or "",
        "noise_db": np.nan if key.noise_db is None else key.noise_db,
        "strength": np.nan if key.strength is None else key.strength,
        "oracle_delta_chi2": true.delta_chi2,
        "knowable": key.kind in CONCEALING and true.delta_chi2 >= KNOWN,
        "true_place": place_text(true_place(key), key.coordinates),
        "card_error": card,
        "oracle_error": oracle,
    }
    rows = [common | {"method": CARD, "applied": True, "answered": True, "error": card}]
    for method in methods:
        file = answer_file(folder, case.generator, case.name, method)
        answer = read_answer(file) if file.is_file() else Answer(fault="not asked")
        rows.append(common | {"method": method} | judged(method, case.generator, comparison, true, answer))
        # Whoever has no answer is left with the recalibrated card.
        rows[-1]["error"] = errors.of_answer(answer) if answer.answered else card
    for row in rows:
        row["error_ratio"] = row["error"] / oracle if oracle > 0 else np.nan
    return rows


class Errors:
    """Held-out errors of simulations of one case, each worked out once.

    Parameters
    ----------
    case
        As every method had it.
    true
        What is concealed in it.
    """

    def __init__(self, case: Comparison, true: TrueCase) -> None:
        self._case, self._true = case, true
        self._known: dict[str, float] = {}

    def of(self, model: Dynamics, added: Added | None) -> float:
        """The error of a card with something added."""
        text = f"{model.equations} {model.outputs} {model.values.tolist()} {added}"
        if text not in self._known:
            self._known[text] = self._true.error(self._case, model, added)
        return self._known[text]

    def of_answer(self, answer: Answer) -> float:
        """The error of the simulation that a method ended with."""
        if answer.card:
            return self.of(model_of(answer.card), None)
        system = self._case.system
        values = np.array([answer.values[each.name] for each in system.parameters])
        return self.of(system.with_values(values), answer.added)


def recalibrated(case: Comparison) -> Dynamics:
    """The card with its own parameters refitted; as it is where that leads nowhere."""
    try:
        fit, _ = recalibrate(case.system, case.learn)
    except NumericalFailure:
        return case.system
    return fit.model


def judged(method: str, generator: str, case: Comparison, true: TrueCase, answer: Answer) -> dict[str, Any]:
    """What of an answer is right, but for the held-out error."""
    key = true.key
    if method == OURS:
        named = _our_names(generator, case, true, answer)
    else:
        named = _terms_named(case.system, true, answer)
    detected = answer.detected
    if method == OURS and answer.verdict is not None and generator == "foreign":
        # That a coarse sensor rounds is right where it does, and no discrepancy.
        nameless = answer.verdict["verdict"] != "missing physics" or not answer.verdict["mechanisms"]
        detected = bool(detected and (named["named"] or nameless))
    concealing = key.kind in CONCEALING
    equation, coordinate = place_right(key, answer) if concealing and detected else (False, False)
    return {
        "applied": answer.applied,
        "answered": answer.answered,
        "detected": detected,
        "evidence": answer.evidence,
        "false_alarm": key.kind in NOTHING_CONCEALED and detected,
        "said_place": place_text(answer.equations, answer.coordinates),
        "equation_right": equation,
        "place_right": equation and coordinate,
        "seconds": answer.seconds,
        "commit": answer.commit,
        "note": answer.fault,
        **named,
    }


def _our_names(generator: str, case: Comparison, true: TrueCase, answer: Answer) -> dict[str, Any]:
    key, verdict = true.key, answer.verdict or {"mechanisms": []}
    names = unreal_names(verdict["mechanisms"], key)
    nameable = generator == "concealment" and key.kind in ("mechanism", NOISE)
    right = False
    if names and generator == "foreign":
        right = name_error(case.system, model_of(answer.card), key, true.truth) <= NEAR
    elif names:
        said = judgement(key, ProofAnswer(answer.verdict, answer.card))
        right = names == [NOISE] if key.kind == NOISE else bool(said["truth_in_class"])
    return {
        "nameable": nameable,
        "named": ", ".join(names),
        "name_right": bool(right),
        "name_wrong": bool(names) and not right,
    }


def _terms_named(system: Dynamics, true: TrueCase, answer: Answer) -> dict[str, Any]:
    """Terms are the right name where they are those of the concealed function, no more and no less."""
    said = frozenset((term.equation, term.exponents) for term in answer.terms) if answer.detected else None
    right = bool(said) and said == true.terms
    return {
        "nameable": true.terms is not None,
        "named": ", ".join(term_text(system, term) for term in answer.terms) if said else "",
        "name_right": right,
        "name_wrong": bool(said) and not right,
    }


def place_right(key: CaseKey, answer: Answer) -> tuple[bool, bool]:
    """Whether equations and coordinates are right, by the rule of the case's own proof."""
    here, where = true_place(key), set(answer.equations)
    equation = here == where or (not key.sensors.noise and bool(here) and here <= where)
    coordinates = set(key.coordinates)
    if AMPLITUDE in coordinates:
        coordinates |= set(key.equations)
    along = {word for each in answer.coordinates for word in re.findall(r"\w+", each)}
    return equation, not key.coordinates or (bool(along) and along <= coordinates)


def place_text(equations: Sequence[str] | set[str], coordinates: Sequence[str]) -> str:
    """A place in words; empty where there is none."""
    if not equations:
        return ""
    return f"{', '.join(sorted(equations))} along {', '.join(coordinates)}"


def term_text(system: Dynamics, term: Term) -> str:
    """A term as a formula, behind its equation."""
    names = (*system.states, *(each.name for each in system.inputs))
    powers = [
        name + (f"**{power}" if power > 1 else "")
        for name, power in zip(names, term.exponents, strict=True)
        if power
    ]
    return f"{term.equation}: {'*'.join([f'{term.coefficient:.3g}', *powers])}"


def write_scores(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write the table of scores, with a CSV beside it; what a row does not say is missing, or no."""
    empty: dict[str, Any] = {"str": "", "bool": False, "float64": np.nan}
    whole = [{name: row.get(name, empty[kind]) for name, kind in COLUMNS.items()} for row in rows]
    write_table(path, pd.DataFrame(whole, columns=list(COLUMNS)).astype(dict(COLUMNS)))
