"""What is kept of an f that was identified beside the noise of a sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from siq.certificate.tests import PredictionLimits, check_prediction
from siq.data.recordings import Recordings, SnapshotPairs, snapshot_pairs
from siq.dynamics.diffusion import Diffusion
from siq.errors import NumericalFailure
from siq.estimation.innovations import Noise
from siq.identify.diffusion import DiffusionSource, check_units, estimated_diffusion
from siq.identify.filtered_states import held_out_evidence
from siq.identify.flow_regression import residuals
from siq.identify.identification import IdentificationOptions
from siq.identify.identified_field import IdentifiedField
from siq.identify.library import CandidateLibrary
from siq.identify.noise_regression import constant_noise_probability
from siq.identify.noisy_sensor import FilteredField, identify_by_likelihood
from siq.identify.residuals import LARGE, SIGNIFICANT, shared_errors
from siq.identify.rounding import HARMLESS, is_rounding, rounding_bias, rounding_errors
from siq.identify.selection import critical_values
from siq.identify.storage import FieldRecord
from siq.steps.settings import Sampling, StateSpace

SUSPECT = -1.0  # standard errors of the correlation of neighbouring residuals
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
    before it is significant. Where random forces depend on the state it has to be significant, since the
    likelihood takes them as constant.

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
    if not much and constant_noise_probability(found, pairs, residuals(found, pairs)) < options.false_terms:
        return None
    share = np.clip(-correlation, LEAST, MOST)
    variance = np.diag(found.noise_rate) * float(np.median(pairs.h))
    start = Noise(share * variance, np.diag(found.noise_rate) * (1 - 2 * share))
    try:
        filtered = identify_by_likelihood(
            found.library, recordings, found.diffusion, start, pair_step=pair_step, generator=generator,
            critical=critical_values(found.library, false_terms=options.false_terms),
        )  # fmt: skip
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        if much:
            raise NumericalFailure(f"the sensor is noisy, and f beside it is not found: {error}") from None
        return None
    return filtered if filtered.gain > 1 else None


def means_over_exposures(
    recordings: Recordings,
    *,
    library: CandidateLibrary,
    options: IdentificationOptions,
    pair_step: float | None,
    generator: np.random.Generator,
) -> FilteredField | None:
    """F by the likelihood of samples that are means over their whole step; None where they are no such means.

    They are such means if nothing is left in the innovations that neighbours share. The arguments are those
    of `beside_sensor_noise`, with the candidate functions.
    """
    pairs = snapshot_pairs(recordings, pair_step=pair_step)
    step = float(np.median(pairs.h))
    moved = ((pairs.xh - pairs.x0) ** 2).mean(axis=0)
    start = Noise(LEAST * moved, moved / step)
    try:
        filtered = identify_by_likelihood(
            library, recordings, Diffusion.identity(library.dimension), start, pair_step=pair_step,
            critical=critical_values(library, false_terms=options.false_terms), generator=generator,
            exposure=step,
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
    if given is None and filtered.found.noise_rate.any():
        estimated = estimated_diffusion(filtered.found, pairs=pairs)
    source = DiffusionSource.GIVEN if given is not None else DiffusionSource.ESTIMATED
    if given is None and estimated is None:
        source = DiffusionSource.UNIT
        check_units(recordings.names, units_of_states(recordings, space))
    diffusion = given or estimated or filtered.found.diffusion
    found = replace(filtered.found, diffusion=diffusion)
    intensity = diffusion.intensity(found.noise_rate)
    probability, ratio = held_out_evidence(filtered, *parts, pair_step=step)
    forced = bool(found.noise_rate.any())
    error = intensity * float(np.sqrt((filtered.forces_error**2).sum())) / len(filtered.sensor)
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
            "note": f"the noise of the sensor, {said}, was estimated beside f and is allowed for"
            + (
                ""
                if filtered.exposure is None
                else "; each sample was taken as the mean over the step before"
            ),
            "pairs": pairs,
        },
    )


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
