"""The verdict as data: what `verdict.json` says, in the order of its contract."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from siq.mismatch.candidates import PROCESS_NOISE
from siq.mismatch.diagnosis import Diagnosis
from siq.mismatch.estimation import Fit
from siq.mismatch.held_out import FreeRun, free_run, normalised_rms
from siq.mismatch.location import Location, locate
from siq.mismatch.measurements import Measurements
from siq.mismatch.model import Model
from siq.mismatch.trials import Trial

METRIC = "normalised rms, held-out recordings"
BOUND = 1.96


@dataclass(frozen=True)
class HeldOut:
    """Free runs of held-out recordings by the three simulations, and how far each is off.

    Attributes
    ----------
    before, recalibrated, augmented
        The card's simulation, with its parameters refitted, and with what was found.
    model
        The augmented simulation that was run.
    scores
        The normalised errors of the three, None where a simulation ran away, and the noise floor.
    """

    before: FreeRun
    recalibrated: FreeRun
    augmented: FreeRun
    model: Model
    scores: Mapping[str, float | None]


def held_out(diagnosis: Diagnosis, learned: Measurements, data: Measurements) -> HeldOut:
    """Show the fit on recordings that had no part in anything.

    Parameters
    ----------
    diagnosis
        What was found.
    learned
        The recordings that it was found in; they decide which estimates run freely best.
    data
        The recordings held out.
    """
    search = diagnosis.search
    noise, substeps = search.recalibrated.noise, max(search.fit.substeps, search.recalibrated.substeps)

    def error_where_learned(model: Model) -> float:
        error = normalised_rms(learned.outputs, free_run(model, learned, noise=noise, substeps=substeps))
        return np.inf if error is None else error

    # What fits best with random forces admitted need not be what runs best without.
    recalibrated = search.recalibrated.model
    if search.recalibrated.has_process_noise and np.isfinite(diagnosis.least_squares.sum_of_squares):
        choices = (diagnosis.least_squares.model, recalibrated, diagnosis.model)
        recalibrated = min(choices, key=error_where_learned)
    augmented = search.fit.model
    if diagnosis.augmented_least_squares is not None:
        augmented = min((diagnosis.augmented_least_squares.model, augmented), key=error_where_learned)
    models = {"before": diagnosis.model, "recalibrated": recalibrated, "augmented": augmented}
    runs = {name: free_run(model, data, noise=noise, substeps=substeps) for name, model in models.items()}
    scores = {name: normalised_rms(data.outputs, simulated) for name, simulated in runs.items()}
    scored = runs["before"].scored
    spread = np.nanvar(data.outputs[scored], axis=0)
    floor = np.sqrt(np.mean(search.fit.noise.measurement / np.where(spread > 0, spread, 1.0)))
    return HeldOut(**runs, model=augmented, scores={**scores, "noise_floor": float(floor)})


def verdict_of(diagnosis: Diagnosis, data: Measurements, shown: HeldOut) -> dict[str, Any]:
    """What is written to ``verdict.json``.

    Parameters
    ----------
    diagnosis
        What was found.
    data
        The recordings that it was found in.
    shown
        The fit on those held out.
    """
    place = locate(diagnosis, data)
    return {
        "verdict": diagnosis.verdict,
        "sentence": sentence(diagnosis, place),
        "mechanisms": mechanisms_of(diagnosis),
        "description": description_of(diagnosis),
        "location": place.as_data() if place is not None else None,
        "recalibration": recalibration_of(diagnosis),
        "fit": {"metric": METRIC, **shown.scores},
        "excluded": excluded(diagnosis) if diagnosis.verdict in ("no mismatch", "parameter shift") else {},
        "remarks": list(diagnosis.remarks),
    }


def mechanisms_of(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """What is named, each with its evidence."""
    if diagnosis.verdict != "missing physics":
        return []
    if diagnosis.process_noise:
        return [_process_noise(diagnosis)]
    return [
        _mechanism(each.best, diagnosis.search.fit, diagnosis.share)
        | {
            "indistinguishable_from": sorted(
                {other.candidate.name for other in each.indistinguishable} - {each.best.candidate.name}
            )
        }
        for each in diagnosis.search.found
    ]


def description_of(diagnosis: Diagnosis) -> dict[str, Any] | None:
    """What is known of a mismatch that has no name."""
    if diagnosis.verdict != "unexplained":
        return None
    trials = [_mechanism(each.best, diagnosis.search.fit, diagnosis.share) for each in diagnosis.search.found]
    return {
        "share_described": diagnosis.share if trials else 0.0,
        "by": trials,
        "p_residuals_random": diagnosis.after.p_value,
        "random_forces_admitted": diagnosis.search.fit.has_process_noise,
    }


def recalibration_of(diagnosis: Diagnosis) -> dict[str, dict[str, float]]:
    """The simulation's own parameters: on the card, and in the simulation that the verdict ends with."""
    fit = diagnosis.final
    errors = standard_errors(fit)
    return {
        entry.name: {
            "before": entry.value,
            "after": float(fit.model.values[place]),
            "standard_error": errors[entry.name],
        }
        for place, entry in enumerate(diagnosis.model.parameters)
        if entry.name in errors
    }


def standard_errors(fit: Fit) -> dict[str, float]:
    """Standard error of every free parameter, by name."""
    names = [fit.model.parameters[place].name for place in fit.model.free]
    return dict(zip(names, map(float, fit.standard_errors), strict=True))


def excluded(diagnosis: Diagnosis) -> dict[str, dict[str, Any]]:
    """Upper bounds (95 %) of the amplitudes of mechanisms that were not found."""
    bounds: dict[str, dict[str, Any]] = {}
    for probe, result in diagnosis.search.screened:
        candidate = probe.candidate
        for name, estimate, error in zip(
            candidate.amplitudes, result.amplitudes, result.standard_errors, strict=False
        ):
            bound = abs(float(estimate)) + BOUND * float(error)
            unit = next(p.unit for p in candidate.model.parameters if p.name == name)
            entry = {"upper_bound_95": bound, "unit": unit, "parameter": name, "label": candidate.label}
            known = bounds.get(candidate.label)
            if np.isfinite(bound) and error > 0 and (known is None or bound > known["upper_bound_95"]):
                bounds[candidate.label] = entry
    return dict(sorted(bounds.items()))


def sentence(diagnosis: Diagnosis, place: Location | None) -> str:
    """The verdict in one sentence."""
    if diagnosis.verdict == "no mismatch":
        return "The simulation explains the recordings to within their noise, as it is."
    if diagnosis.verdict == "parameter shift":
        return (
            "The simulation's equations explain the recordings to within their noise, with other parameters."
        )
    where = f" {place.sentence}" if place is not None else ""
    if diagnosis.verdict == "unexplained":
        return f"The recordings differ from the simulation in a way that no mechanism accounts for.{where}"
    names = [each["name"] for each in mechanisms_of(diagnosis)]
    if names == [PROCESS_NOISE]:
        return "Random forces drive the system that the simulation does not have."
    return f"The simulation lacks {' and '.join(names)}.{where}"


def _mechanism(trial: Trial, final: Fit, share: float) -> dict[str, Any]:
    candidate = trial.candidate
    errors = standard_errors(final)
    known = {entry.name: entry for entry in final.model.parameters}
    return {
        "name": candidate.name,
        "label": candidate.label,
        "terms": {name: str(formula) for name, formula in candidate.changes},
        "parameters": {
            name: {
                "estimate": known[name].value,
                "standard_error": errors.get(name),
                "unit": known[name].unit,
            }
            for name in candidate.new
            if name in known
        },
        "evidence": {
            "delta_chi2": trial.delta_chi2,
            "delta_bic": trial.delta_bic,
            "p_white": trial.p_white,
            "p_cluster": trial.p_cluster,
        },
        "share_of_excess": share,
    }


def _process_noise(diagnosis: Diagnosis) -> dict[str, Any]:
    fit = diagnosis.search.fit
    return {
        "name": PROCESS_NOISE,
        "label": PROCESS_NOISE,
        "terms": {},
        "parameters": {
            f"intensity_{name}": {
                "estimate": float(value),
                "standard_error": None,
                "unit": f"({unit})**2/({fit.model.time_unit})",
            }
            for name, unit, value in zip(
                fit.model.states, fit.model.state_units, fit.noise.process, strict=True
            )
            if value > 0
        },
        "evidence": {"delta_chi2": None, "delta_bic": None, "p_white": None, "p_cluster": None},
        "share_of_excess": 1.0,
        "indistinguishable_from": [],
    }
