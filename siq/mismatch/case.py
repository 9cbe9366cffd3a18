"""A case: a simulation, recordings and a study, from files to everything that is reported."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from siq.documents import Document, read_document, validate
from siq.mismatch.cards import augmented_card, build_model
from siq.mismatch.diagnosis import Diagnosis, diagnose
from siq.mismatch.dictionary import Mechanism, dictionary_of
from siq.mismatch.estimation import Fit
from siq.mismatch.measurements import Measurements
from siq.mismatch.model import Model
from siq.mismatch.study import (
    MismatchStudy,
    load_mismatch_study,
    read_measurements,
    split,
    with_known_noise,
)
from siq.mismatch.verdict import HeldOut, held_out, verdict_of
from siq.systems import SystemCard


@dataclass(frozen=True)
class Case:
    """What is compared with what.

    Attributes
    ----------
    card
        The system card as read.
    model
        The simulation that it describes.
    learn, kept
        Recordings to learn from, and those held out.
    study
        How to go about it.
    dictionary
        The mechanisms that may be named.
    """

    card: Document
    model: Model
    learn: Measurements
    kept: Measurements
    study: MismatchStudy
    dictionary: tuple[Mechanism, ...]


@dataclass(frozen=True)
class Outcome:
    """All that is known in the end.

    Attributes
    ----------
    diagnosis
        What was found.
    shown
        The fit on held-out recordings.
    verdict
        The content of ``verdict.json``.
    card
        The augmented card, as text.
    recalibrated
        The card with its own parameters fitted and nothing added, as text.
    """

    diagnosis: Diagnosis
    shown: HeldOut
    verdict: dict[str, Any]
    card: str
    recalibrated: str


def read_case(card: str | Path, recordings: str | Path, study: str | Path | None) -> Case:
    """Read and check the files of a case.

    Raises
    ------
    InputError
        For the first thing that cannot be used, with its file, place and remedy.
    """
    document = read_document(card)
    model = build_model(document, validate(document, SystemCard))
    options = load_mismatch_study(study) if study is not None else MismatchStudy()
    file = str(study) if study is not None else "the study"
    data = with_known_noise(read_measurements(recordings, model), model, options, file=file)
    learn, kept = split(data, options, file=file)
    dictionary = dictionary_of(without=options.without, further=options.mechanisms, file=file)
    return Case(document, model, learn, kept, options, dictionary)


def solve_case(case: Case) -> Outcome:
    """Diagnose a case, show the fit, and write the augmented card.

    Raises
    ------
    NumericalFailure
        When the simulation cannot be fitted at all.
    """
    diagnosis = diagnose(case.model, case.learn, case.dictionary, case.study)
    shown = held_out(diagnosis, case.learn, case.kept)
    final = diagnosis.final
    card = augmented_card(
        case.card,
        shown.model if diagnosis.verdict == "missing physics" else final.model,
        process=final.noise.process if diagnosis.process_noise else None,
        scale=final.x.std(axis=0),
    )
    recalibrated = augmented_card(case.card, diagnosis.search.recalibrated.model)
    return Outcome(diagnosis, shown, verdict_of(diagnosis, case.learn, shown), card, recalibrated)


def tables_of(case: Case, outcome: Outcome) -> dict[str, pd.DataFrame]:
    """The tables that figures are drawn from.

    Returns
    -------
    dict
        ``curves``: what is missing against each coordinate, in the unit of the equation.
        ``candidates``: every probe, with what it would gain first, or on top of what was found.
        ``held_out``: recordings and their three simulations.
        ``forces``: what the recalibrated simulation lacks at each sample, as far as random forces were
        admitted.
        ``noise``: of the sensors by output, and of random forces by state.
    """
    diagnosis, shown = outcome.diagnosis, outcome.shown
    curves = [
        {
            "equation": ", ".join(curve.direction.equations),
            "coordinate": curve.direction.coordinate,
            "across": curve.direction.across,
            "at": at,
            "missing": value,
            "standard_error": error,
            "gain": curve.gain,
            "p_value": curve.p_value,
            "stage": stage,
        }
        for stage, structure in (("before", diagnosis.before), ("after", diagnosis.after))
        for curve in structure.curves
        for at, value, error in zip(curve.direction.knots, curve.values, curve.standard_errors, strict=True)
    ]
    candidates: list[dict[str, Any]] = [
        {
            "mechanism": trial.candidate.name,
            "label": trial.candidate.label,
            "shapes": "",
            "gain": trial.delta_chi2,
            "process_noise_level": 1.0,
            "stage": stage,
        }
        for found in diagnosis.search.found
        for stage, trial in (("found", found.best), *(("same", each) for each in found.indistinguishable))
    ]
    candidates += [
        {
            "mechanism": probe.candidate.name,
            "label": probe.candidate.label,
            "shapes": ", ".join(f"{name}={value:.4g}" for name, value in probe.shapes),
            "gain": result.gain,
            "process_noise_level": result.level,
            "stage": "further",
        }
        for probe, result in diagnosis.search.screened
    ]
    data = case.kept
    rows = []
    for place, name in enumerate(case.model.output_names):
        rows.append(
            pd.DataFrame(
                {
                    "recording": np.array(data.labels)[data.recording],
                    "t": data.t,
                    "output": name,
                    "measured": data.outputs[:, place],
                    "before": shown.before.outputs[:, place],
                    "recalibrated": shown.recalibrated.outputs[:, place],
                    "augmented": shown.augmented.outputs[:, place],
                    "scored": shown.before.scored,
                }
            )
        )
    return {
        "curves": pd.DataFrame(curves),
        "candidates": pd.DataFrame(candidates),
        "held_out": pd.concat(rows, ignore_index=True),
        "forces": _forces(case, diagnosis),
        "noise": _noise(case.model, diagnosis.search.recalibrated, diagnosis.final),
    }


def _noise(model: Model, recalibrated: Fit, final: Fit) -> pd.DataFrame:
    """Both kinds of noise, of the recalibrated simulation and of the one that the verdict stands on."""
    return pd.DataFrame(
        [
            {"stage": stage, "kind": kind, "name": name, "variance": float(value)}
            for stage, fit in (("recalibrated", recalibrated), ("final", final))
            for kind, names, values in (
                ("measurement", model.output_names, fit.noise.measurement),
                ("process", fit.model.states, fit.noise.process),
            )
            for name, value in zip(names, values, strict=False)
        ],
        columns=["stage", "kind", "name", "variance"],
    )


def _forces(case: Case, diagnosis: Diagnosis) -> pd.DataFrame:
    """What must be added to f in each interval for the states to follow the recordings."""
    fit, data = diagnosis.search.recalibrated, case.learn
    rows = data.begins
    step = data.t[rows + 1] - data.t[rows]
    frame: dict[str, Any] = {
        "recording": np.array(data.labels)[data.recording[rows]],
        "t": data.t[rows],
    }
    for place, name in enumerate(case.model.states):
        frame[name] = fit.x[rows, place]
    for place, name in enumerate(case.model.states):
        if name in diagnosis.roles.states:
            frame[f"missing_in_{name}"] = -fit.linearisation.gap[rows, place] / step
    return pd.DataFrame(frame)
