"""Identify the vector field of a run from its pairs, and test it on recordings that are held out."""

from pathlib import Path
from typing import Any

import numpy as np

from siq.certificate import Verdict, check_prediction
from siq.errors import NumericalFailure
from siq.field_file import FieldRecord, field_library, write_field
from siq.held_out import held_out_recordings
from siq.identification import (
    IdentificationOptions,
    IdentifiedField,
    carries_noise,
    identify_vector_field,
    refit,
    residuals,
)
from siq.noise import diagnose, mean_residual_probability
from siq.prediction import prediction_errors
from siq.randomness import generator
from siq.recordings import Recordings, SnapshotPairs, select_recordings, snapshot_pairs
from siq.systems import diffusion_matrix
from step import integrator_step, job, outcome, pair_step, read_run, write_outcomes

PREDICTED = 200  # held-out recordings that are predicted


def held_out_verdict(
    found: IdentifiedField,
    fitted: IdentifiedField,
    parts: tuple[SnapshotPairs, SnapshotPairs],
    held_out: Recordings,
    *,
    fault: str | None,
    limit: float,
) -> Verdict:
    """Whether f holds for recordings that it was not fitted to."""
    if found.noise_free:
        labels = np.arange(min(len(held_out.labels), PREDICTED))
        errors = prediction_errors(found.field, select_recordings(held_out, labels))
        return check_prediction(
            noise_fault=fault, errors=errors, mean_probability=None, held_out_ratio=1.0, limit=limit
        )
    training, unseen = parts
    squares = [
        float((residuals(fitted, pairs) ** 2 / pairs.h[:, None]).mean()) for pairs in (unseen, training)
    ]
    return check_prediction(
        noise_fault=fault,
        errors=None,
        mean_probability=mean_residual_probability(fitted, unseen),
        held_out_ratio=squares[0] / squares[1],
        limit=limit,
    )


def identify(recordings: Recordings, run: int, study: dict[str, Any]) -> FieldRecord:
    """F of one run, with the verdict of the recordings that were held out."""
    options = IdentificationOptions(**study["identification"])
    held = held_out_recordings(recordings, generator=generator(study["seed"], run, "hold out"))
    held_out = select_recordings(recordings, np.flatnonzero(held))
    training = select_recordings(recordings, np.flatnonzero(~held))
    step = pair_step(study)
    parts = snapshot_pairs(training, pair_step=step), snapshot_pairs(held_out, pair_step=step)
    library = field_library(recordings.names, options)
    maker = integrator_step(study)
    if carries_noise(library, parts[0], options=options, integrator_step=maker):
        # Under noise every recording counts: all give the result, a part of them its test.
        everything = snapshot_pairs(recordings, pair_step=step)
        found = identify_vector_field(library, everything, options=options, integrator_step=maker)
        fitted = refit(found, parts[0])
    else:
        found = fitted = identify_vector_field(library, parts[0], options=options, integrator_step=maker)
    diffusion = diffusion_matrix(study["metric"]["diffusion"], len(recordings.names))
    noise = diagnose(found, recordings, diffusion=diffusion, pair_step=step)
    verdict = held_out_verdict(
        found, fitted, parts, held_out,
        fault=noise.fault(recordings.names),
        limit=study["prediction"],
    )  # fmt: skip
    kept = {
        "kind": noise.kind,
        "intensity": noise.intensity,
        "covariance": noise.covariance.tolist(),
        "correlation": noise.correlation,
        "correlation_score": noise.correlation_score,
        "measurement": noise.measurement.tolist(),
    }
    return FieldRecord(found, verdict.as_data(), kept)


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    run = int(snakemake.wildcards.run)
    study = snakemake.params.study
    target = snakemake.output
    recordings = read_run(snakemake.input.recordings)
    if recordings is None:
        result = outcome(run, "identify", "skipped", "the run has no trajectories")
    else:
        try:
            record = identify(recordings, run, study)
            write_field(target.field, record, IdentificationOptions(**study["identification"]))
            passed = record.prediction["passed"]
            result = outcome(
                run, "identify", "ok" if passed else "warning", "" if passed else record.prediction["reason"]
            )
        except (NumericalFailure, np.linalg.LinAlgError) as error:
            result = outcome(run, "identify", "failed", str(error))
    if result["status"] in ("failed", "skipped"):
        Path(target.field).touch()
    write_outcomes(target.outcome, [result])


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
