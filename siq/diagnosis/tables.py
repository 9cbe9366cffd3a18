"""The tables that figures of a diagnosis are drawn from."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from siq.diagnosis.diagnosis import Diagnosis
from siq.diagnosis.investigation import Comparison, Investigation
from siq.diagnosis.search import Search
from siq.inference.maximum_likelihood import Fit
from siq.systems.dynamics import Dynamics

CURVE_COLUMNS = [
    "equation", "coordinate", "across", "at", "missing", "standard_error", "gain", "p_value", "stage",
]  # fmt: skip
CANDIDATE_COLUMNS = ["mechanism", "label", "shapes", "gain", "process_noise_level", "stage", "beside"]
HELD_OUT_COLUMNS = [
    "recording", "t", "output", "measured", "before", "recalibrated", "augmented", "scored",
]  # fmt: skip
NOISE_COLUMNS = ["stage", "kind", "name", "variance"]


def tables_of(diagnosis: Diagnosis) -> dict[str, pd.DataFrame]:
    """The tables that figures are drawn from.

    Returns
    -------
    dict
        ``curves``: what is missing against each coordinate, in the unit of the equation.
        ``candidates``: every mechanism that was fitted, and every probe that was only screened, with what it
        gains ``beside`` the mechanisms that were in place. Stages: ``found``; fitted in its place: ``same``,
        ``needless`` and ``less`` (see `siq.diagnosis.wording.Rival`); screened: ``further``, on top of
        all that was found, and ``instead``, in the place of the last that was found.
        ``held_out``: recordings and their three simulations.
        ``forces``: what the recalibrated simulation lacks at each sample, as far as random forces were
        admitted.
        ``noise``: of the sensors by output, and of random forces by state.
    """
    case, found, shown = diagnosis.case, diagnosis.investigation, diagnosis.held_out
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
        for stage, structure in (("before", found.before), ("after", found.after))
        for curve in structure.curves
        for at, value, error in zip(curve.direction.knots, curve.values, curve.standard_errors, strict=True)
    ]
    candidates = _candidates(found.search)
    data = case.kept
    rows = []
    for place, name in enumerate(case.system.output_names):
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
        "curves": pd.DataFrame(curves, columns=CURVE_COLUMNS),
        "candidates": pd.DataFrame(candidates, columns=CANDIDATE_COLUMNS),
        "held_out": pd.concat(rows, ignore_index=True),
        "forces": _forces(case, found),
        "noise": _noise(case.system, found.search.recalibrated, found.final),
    }


def tables_of_failure(case: Comparison) -> dict[str, pd.DataFrame]:
    """The same tables where no fit has a result: empty, but for what the recordings show of their noise."""
    data, system = case.learn, case.system
    noise = pd.DataFrame({"name": system.output_names, "variance": data.with_known_noise(data.roughness)})
    return {
        "curves": pd.DataFrame(columns=CURVE_COLUMNS),
        "candidates": pd.DataFrame(columns=CANDIDATE_COLUMNS),
        "held_out": pd.DataFrame(columns=HELD_OUT_COLUMNS),
        "forces": pd.DataFrame(columns=["recording", "t", *system.states]),
        "noise": noise.assign(stage="recalibrated", kind="measurement")[NOISE_COLUMNS],
    }


def _candidates(search: Search) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    labels = [each.best.candidate.label for each in search.found]
    fitted: set[tuple[str, str]] = set()
    for place, each in enumerate(search.found):
        beside = ", ".join(labels[:place])
        for stage, trials in (
            ("found", (each.best,)), ("same", each.indistinguishable), ("needless", each.needless),
            ("less", each.lesser),
        ):  # fmt: skip
            fitted |= {(trial.candidate.label, beside) for trial in trials}
            rows += [
                {
                    "mechanism": trial.candidate.name, "label": trial.candidate.label, "shapes": "",
                    "gain": trial.delta_chi2, "process_noise_level": 1.0, "stage": stage, "beside": beside,
                }
                for trial in trials
            ]  # fmt: skip
    beside = ", ".join(search.screened_beside)
    stage = "further" if list(search.screened_beside) == labels else "instead"
    return rows + [
        {
            "mechanism": probe.candidate.name,
            "label": probe.candidate.label,
            "shapes": ", ".join(f"{name}={value:.4g}" for name, value in probe.shapes),
            "gain": result.gain,
            "process_noise_level": result.level,
            "stage": stage,
            "beside": beside,
        }
        for probe, result in search.screened
        # Of what was fitted, what the screening had promised is of no interest.
        if (probe.candidate.label, beside) not in fitted
    ]


def _noise(model: Dynamics, recalibrated: Fit, final: Fit) -> pd.DataFrame:
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
        columns=NOISE_COLUMNS,
    )


def _forces(case: Comparison, found: Investigation) -> pd.DataFrame:
    """What must be added to f in each interval for the states to follow the recordings."""
    fit, data = found.search.recalibrated, case.learn
    rows = data.begins
    step = data.t[rows + 1] - data.t[rows]
    frame: dict[str, Any] = {
        "recording": np.array(data.labels)[data.recording[rows]],
        "t": data.t[rows],
    }
    for place, name in enumerate(case.system.states):
        frame[name] = fit.x[rows, place]
    for place, name in enumerate(case.system.states):
        if name in found.roles.states:
            frame[f"missing_in_{name}"] = -fit.linearisation.gap[rows, place] / step
    return pd.DataFrame(frame)
