"""What is kept of an f that was identified beside the noise of a sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from siq.certificate.tests import PredictionLimits, check_prediction
from siq.data.recordings import Recordings, SnapshotPairs, snapshot_pairs
from siq.dynamics.diffusion import Diffusion
from siq.errors import NumericalFailure
from siq.estimation.innovations import Noise
from siq.identify.diffusion import UNLIKE_GIVEN, DiffusionSource, check_units, estimated_diffusion
from siq.identify.filtered_states import filtered_recordings, held_out_evidence
from siq.identify.identification import IdentificationOptions
from siq.identify.identified_field import IdentifiedField
from siq.identify.library import CandidateLibrary
from siq.identify.noisy_sensor import FilteredField, identify_by_likelihood, moved_by
from siq.identify.residuals import LARGE, SIGNIFICANT, shared_errors
from siq.identify.rounding import HARMLESS, is_rounding, rounding_bias, rounding_errors
from siq.identify.seen_states import View
from siq.identify.storage import FieldRecord
from siq.steps.settings import Sampling, StateSpace

SUSPECT = -1.0  # standard errors of the correlation of neighbouring residuals
FROM_ABOVE = 0.1  # of what means move by: a search finds its way down to no sensor noise, but not up from it
LEAST, MOST = 1e-3, 0.45  # of the residuals' variance: a sensor's share of it that a fit begins with


def beside_sensor_noise(
    found: IdentifiedField,
    recordings: Recordings,
    *,
    options: IdentificationOptions,
    pair_step: float | None,
    generator: np.random.Generator,
) -> FilteredField | None:
    """F by the likelihood of whole recordings, where their sensors are noisy; None where they are not.

    What could be sensor noise is asked of the likelihood from one standard error on: it would bias f long
    before it is significant.

    Parameters
    ----------
    found
        f of the regression of pairs.
    recordings
        Whole trajectories.
    options
        What makes a term significant.
    pair_step
        Longest time between samples that still belong together.
    generator
        Draws recordings again, for the stability of the terms.

    Raises
    ------
    NumericalFailure
        Where much sensor noise is seen and the likelihood leads to no f.
    """
    correlation, score = shared_errors(found, recordings, pair_step=pair_step)
    if not (score < SUSPECT).any():
        return None
    pairs = snapshot_pairs(recordings, pair_step=pair_step)
    if _harmless_rounding(found, recordings, pairs, correlation):
        return None
    much = bool(((score < -SIGNIFICANT) & (correlation < -LARGE)).any())
    share = np.clip(-correlation, LEAST, MOST)
    variance = np.diag(found.noise_rate) * float(np.median(pairs.h))
    start = Noise(share * variance, np.diag(found.noise_rate) * (1 - 2 * share))
    try:
        filtered = identify_by_likelihood(
            found.library, recordings, found.diffusion, start, pair_step=pair_step, generator=generator,
            false_terms=options.false_terms,
        )  # fmt: skip
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        if much:
            raise NumericalFailure(f"the sensor is noisy, and f beside it is not found: {error}") from None
        return None
    return filtered if filtered.gain > 1 else None


def means_over_exposures(
    recordings: Recordings,
    exposure: float,
    *,
    library: CandidateLibrary,
    options: IdentificationOptions,
    pair_step: float | None,
    generator: np.random.Generator,
) -> FilteredField | None:
    """F by the likelihood of samples that are means over an exposure; None where they are no such means.

    They are such means if nothing is left in the innovations that neighbours share. The arguments are those
    of `beside_sensor_noise`, with the exposure, and the candidate functions.
    """
    identity = Diffusion.identity(library.dimension)
    try:
        moved, step = moved_by(View(library, identity, exposure).measured(recordings, pair_step))
        start = Noise(FROM_ABOVE * moved, moved / step)
        filtered = identify_by_likelihood(
            library, recordings, identity, start, pair_step=pair_step,
            false_terms=options.false_terms, generator=generator, exposure=exposure,
        )  # fmt: skip
    except (NumericalFailure, np.linalg.LinAlgError):
        return None
    remembers = abs(filtered.score) > SIGNIFICANT and abs(filtered.correlation) > LARGE
    return None if remembers or not filtered.found.noise_rate.any() else filtered


def filtered_record(
    filtered: FilteredField,
    recordings: Recordings,
    parts: tuple[Recordings, Recordings],
    *,
    sampling: Sampling,
    space: StateSpace,
    limits: PredictionLimits,
) -> FieldRecord:
    """What is kept of an f that was identified beside sensor noise.

    Parameters
    ----------
    filtered, recordings
        What was found, of which recordings.
    parts
        Those that train, and those that are held out.
    sampling, space, limits
        Of the step `identify`.
    """
    step = sampling.pair_step
    pairs = len(snapshot_pairs(recordings, pair_step=step).h)
    given = space.noise(recordings.names)
    estimated = None
    if given is None and filtered.found.noise is not None:
        estimated = filtered.found.diffusion
    elif given is None and filtered.found.noise_rate.any():
        estimated = estimated_diffusion(filtered.found, pairs=pairs)
    source = DiffusionSource.GIVEN if given is not None else DiffusionSource.ESTIMATED
    if given is None and estimated is None:
        source = DiffusionSource.UNIT
        check_units(recordings.names, units_of_states(recordings, space))
    diffusion = given or estimated or filtered.found.diffusion
    found = replace(filtered.found, diffusion=diffusion)
    if estimated is None:
        found = replace(found, noise=None, constant_noise=None)
    intensity = (
        found.intensity if found.noise is not None else _strength(filtered, diffusion, recordings, step)
    )
    probability, ratio = held_out_evidence(filtered, *parts, pair_step=step)
    forced = bool(found.noise_rate.any())
    error = intensity * filtered.intensity_error
    coloured = abs(filtered.score) > SIGNIFICANT and abs(filtered.correlation) > LARGE
    verdict = check_prediction(
        noise_fault=(
            f"the innovations of neighbouring samples are correlated ({filtered.correlation:.2f}) though"
            " noise of the sensor is allowed for: the random forces have a memory, or a state is missing;"
            " record that state, or keep every few samples only"
        )
        if coloured else None,
        errors=None, mean_probability=probability, held_out_ratio=ratio, limits=limits,
    )  # fmt: skip
    sizes = np.sqrt(filtered.sensor)
    said = ", ".join(f"{size:.2g} in {name}" for size, name in zip(sizes, recordings.titles, strict=True))
    notes = [f"the noise of the sensor, {said}, was estimated beside f and is allowed for"]
    if filtered.exposure is not None:
        unit = f" {recordings.time_unit}" if recordings.time_unit else ""
        every = View(found.library, diffusion, filtered.exposure).every(recordings)
        notes.append(f"each sample was taken as the mean over the {filtered.exposure:.3g}{unit} before it")
        if every > 1:
            notes.append(f"of {every} samples one was used, so that exposures do not overlap")
    if filtered.found.noise is not None and given is not None and given.constant:
        notes.append(UNLIKE_GIVEN)
    return FieldRecord(
        found,
        verdict.as_data(),
        {
            "kind": "coloured" if coloured else "process" if forced else "sensor",
            "intensity": intensity,
            "intensity_error": error if np.isfinite(error) else None,
            "covariance": (found.noise_rate / intensity if forced else np.eye(len(sizes))).tolist(),
            "correlation": filtered.correlation,
            "correlation_score": filtered.score,
            "measurement": sizes.tolist(),
            "measurement_error": (sizes * filtered.sensor_error / 2).tolist(),
            "diffusion": str(source),
            "exposure": filtered.exposure,
            "note": "; ".join(notes),
            "pairs": pairs,
        },
    )


def _strength(
    filtered: FilteredField, diffusion: Diffusion, recordings: Recordings, pair_step: float | None
) -> float:
    """ε of a D that is not the one that was found: the mean of ``tr D⁻¹(x) εD(x) / d`` over the states."""
    found = filtered.found
    if diffusion.constant:
        return diffusion.intensity(found.noise_rate)
    states = filtered_recordings(
        found, filtered.sensor, recordings, pair_step=pair_step, exposure=filtered.exposure
    ).values
    forces = found.noise_rate if found.noise is None else found.noise.diffusion(1.0).at(states)
    products = diffusion.precision_at(states) * forces
    return float(products.sum(axis=(1, 2)).mean() / states.shape[1])


def units_of_states(recordings: Recordings, space: StateSpace) -> list[str | None]:
    """The unit of each state, None where nobody said."""
    named = zip(recordings.names, recordings.units, strict=True)
    return [unit or space.unit(name) or None for name, unit in named]


def _harmless_rounding(
    found: IdentifiedField, recordings: Recordings, pairs: SnapshotPairs, correlation: np.ndarray
) -> bool:
    """Whether the noise of the sensor is that of rounding, and too little to bias f."""
    rounding = rounding_errors(recordings)
    size = np.diag(found.noise_rate) * float(np.median(pairs.h))
    measured = np.sqrt(np.maximum(-correlation, 0.0) * size)
    if not is_rounding(measured, rounding, correlation=float(correlation.min())):
        return False
    return rounding_bias(found, pairs, rounding) <= HARMLESS
