"""What has to be said of recordings that remember, and of the noise that is left beyond their memory?"""

from __future__ import annotations

import numpy as np

from siq.data.markov_lag import MarkovLag
from siq.identify.identified_field import IdentifiedField
from siq.identify.residuals import NoiseDiagnosis

NEAR = 0.05  # of an exposure, as exactly as residuals show it of some thousand samples
CAUSES = {
    "blur": "each sample is the mean over an exposure of {memory}",
    "coloured": "the random forces, or a slow sensor, have a memory of {memory}",
    "memory": "what is recorded remembers for some steps, as with an oscillation or a state not recorded",
    "either": "samples are means over an exposure, or the random forces have a memory",
}


def possible_exposures(found: MarkovLag) -> list[float]:
    """Exposures that samples may be means over, the likeliest first; none where they are no such means.

    A camera is mostly exposed for a whole number of steps: where the memory is near one, that is tried first.
    One that may be as well that of coloured forces says no more than that; only a whole step is tried then.
    """
    if found.kind == "either":
        return [found.step]
    if found.kind != "blur":
        return []
    steps = found.memory / found.step
    whole = round(steps)
    near = [whole * found.step] if abs(steps - whole) < NEAR * steps else []
    return [*near, found.memory]


def memory_text(found: MarkovLag, *, time_unit: str | None = None) -> str:
    """Why a record remembers, for how long, and what is made of it: a clause without a full stop."""
    unit = f" {time_unit}" if time_unit else ""
    cause = CAUSES[found.kind].format(memory=f"{found.memory:.2g}{unit}")
    return (
        f"{cause}: from {found.lag} sampling steps ({found.time:.2g}{unit}) on the recordings are"
        " Markovian, and f was identified by what samples so much earlier tell of each increment"
    )


def lagged_noise(
    found: IdentifiedField, memory: MarkovLag, *, independent: int, time_unit: str | None = None
) -> NoiseDiagnosis:
    """The random forces as they act beyond their memory, held against D.

    Parameters
    ----------
    found
        f with D, and the long-run covariance of its residuals.
    memory
        Why the recordings remember.
    independent
        Number of independent residuals that the covariance is known from.
    time_unit
        Of the recordings.
    """
    noise, d = found.diffusion, found.library.dimension
    intensity = noise.intensity(found.noise_rate)
    covariance = found.noise_rate / intensity
    excess = np.abs(noise.whitening @ covariance @ noise.whitening.T - np.eye(d))
    score = float((excess / np.sqrt((1 + np.eye(d)) / independent)).max())
    state = int(np.argmax(np.abs(memory.correlations[0])))
    correlation = float(memory.correlations[0, state])
    return NoiseDiagnosis(
        "process", intensity, covariance, float(excess.max()), score,
        correlation, correlation / float(memory.errors[0, state]), np.zeros(d),
        memory=memory_text(memory, time_unit=time_unit),
    )  # fmt: skip
