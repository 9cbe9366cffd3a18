"""What is kept of an f(x, v) that was identified from positions alone; and when are velocities missed?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from siq.certificate.tests import PredictionLimits, check_prediction
from siq.data.held_out import held_out_recordings
from siq.data.recordings import Recordings, snapshot_pairs
from siq.data.selection import select_recordings
from siq.errors import NumericalFailure
from siq.identify.diffusion import DiffusionSource
from siq.identify.filtered_states import evidence
from siq.identify.hidden_velocities import HiddenMotion, identify_hidden_motion
from siq.identify.identification import IdentificationOptions
from siq.identify.inertia import inertia_test, seen_inertia
from siq.identify.residuals import LARGE, SIGNIFICANT
from siq.identify.seen_states import View
from siq.identify.storage import FieldRecord, field_library
from siq.identify.velocities import velocity_names
from siq.numerics.randomness import Purpose, generator
from siq.steps.identify_beside_sensor import units_of_states
from siq.steps.settings import Sampling, StateSpace


def hidden_record(
    recordings: Recordings,
    *,
    seed: int,
    number: int,
    space: StateSpace,
    sampling: Sampling,
    options: IdentificationOptions,
    limits: PredictionLimits,
) -> FieldRecord:
    """f(x, v), D and both noises of recordings of positions, with the test on held-out recordings.

    Parameters
    ----------
    recordings
        Of positions.
    seed, number
        Of the study, and the run.
    space, sampling, options, limits
        Of the step `identify`.

    Raises
    ------
    NumericalFailure
        Where nothing is found, and where D is given: it would be that of positions, which no noise drives.
    """
    if space.diffusion is not None:
        raise NumericalFailure(
            "D is given for the positions, and noise drives the hidden velocities; leave the diffusion out,"
            " it is found"
        )
    library = field_library((*recordings.names, *velocity_names(recordings.names)), options)
    motion = identify_hidden_motion(
        library, recordings, false_terms=options.false_terms, pair_step=sampling.pair_step,
        generator=generator(seed, number, Purpose.STABILITY),
    )  # fmt: skip
    held = held_out_recordings(recordings, generator=generator(seed, number, Purpose.HOLD_OUT))
    parts = [select_recordings(recordings, np.flatnonzero(chosen)) for chosen in (~held, held)]
    view = View(library, motion.found.diffusion, None, hidden=True)
    probability, ratio = evidence(
        view, motion.found, motion.sensor, parts[0], parts[1], pair_step=sampling.pair_step
    )
    fault = _fault(motion)
    verdict = check_prediction(
        noise_fault=fault, errors=None, mean_probability=probability, held_out_ratio=ratio, limits=limits
    )
    sizes = np.sqrt(motion.sensor)
    forced = motion.intensity > 0
    if not forced and len({unit for unit in units_of_states(recordings, space) if unit}) > 1:
        raise NumericalFailure(
            "no random forces are seen that would show D, and the positions have different units, so that no"
            " unit matrix can stand for it; scale them to one unit"
        )
    error = motion.intensity * motion.intensity_error
    said = ", ".join(f"{size:.2g} in {name}" for size, name in zip(sizes, recordings.titles, strict=True))
    noises = "the forces' noise and that" if forced else "and the noise"
    return FieldRecord(
        motion.found,
        verdict.as_data(),
        {
            "kind": "coloured" if fault is not None else "process" if forced else "sensor",
            "intensity": motion.intensity,
            "intensity_error": error if np.isfinite(error) else None,
            "covariance": motion.found.diffusion.matrix.tolist(),
            "correlation": motion.correlation,
            "correlation_score": motion.score,
            "measurement": sizes.tolist(),
            "measurement_error": (sizes * motion.sensor_error / 2).tolist(),
            "diffusion": str(DiffusionSource.OF_VELOCITIES if forced else DiffusionSource.UNIT_OF_VELOCITIES),
            "note": f"velocities were not recorded: f, {noises} of the sensor, {said}, are by the likelihood"
            " of positions alone",
            "pairs": len(snapshot_pairs(recordings, pair_step=sampling.pair_step).h),
        },
    )


def _fault(motion: HiddenMotion) -> str | None:
    """What speaks against a particle that white noise drives."""
    if abs(motion.score) <= SIGNIFICANT or abs(motion.correlation) <= LARGE:
        return None
    return (
        f"the innovations of neighbouring samples are correlated ({motion.correlation:.2f}) though velocities"
        " and noise of the sensor are allowed for: the random forces have a memory, or a further state is"
        " missing"
    )


def with_inertia_asked(
    record: FieldRecord, recordings: Recordings, *, pair_step: float | None
) -> FieldRecord:
    """The f of a position alone, refused where its recordings remember since it has inertia."""
    if record.memory is None and record.prediction["passed"]:
        return record
    advice = advice_on_inertia(recordings, pair_step=pair_step)
    if advice is None:
        return record
    reasons = [str(record.prediction["reason"]), advice]
    verdict = {
        **record.prediction,
        "passed": False,
        "reason": "; ".join(one for one in reasons if one),
    }
    return replace(record, prediction=verdict)


def advice_on_inertia(recordings: Recordings, *, pair_step: float | None) -> str | None:
    """What to do where a recorded position has inertia; None where that is not seen, or slight.

    Asked where f of the position alone has failed, or remembers.
    """
    if len(recordings.names) != 1:
        return None
    try:
        test = seen_inertia(recordings, pair_step=pair_step)
    except (NumericalFailure, np.linalg.LinAlgError):
        return None
    if test is None or not test.needs_velocity:
        return None
    return (
        f"{test.sentence(recordings.time_unit or '')}: set 'identification.hidden_velocities: true', in"
        " Python hidden_velocities=True, and the velocity is a state that was not recorded"
    )


def advice_on_velocities(recordings: Recordings, *, pair_step: float | None) -> str | None:
    """What to do where f(x, v) was not found of a position that shows no inertia, or a slight one.

    None where inertia is seen, and the velocity is needed.
    """
    if len(recordings.names) != 1:
        return None
    try:
        test = inertia_test(recordings, pair_step=pair_step)
    except (NumericalFailure, np.linalg.LinAlgError):
        return None
    if test.needs_velocity:
        return None
    said = test.sentence(recordings.time_unit or "")
    if test.undecided:
        return said
    return f"{said}: leave 'identification.hidden_velocities' out, the position alone is the state"
