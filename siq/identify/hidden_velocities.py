"""Which f(x, v) and which random forces do recordings of positions alone show?

``dx = v dt``, ``dv = f(x, v) dt + √ε σ dW``; x is measured, with an error R, and v never is. Differences of
positions are no velocities: the error of the sensor is divided by the step in them, and what they leave is
coloured. The likelihood of a filter that holds x and v needs none. All functions of a library are fitted so,
beginning with f = 0, whose filter is linear; coefficients enter linearly, so that the first step of
Gauss and Newton is already the weighted regression on what the filter knows of v. Terms are chosen as
everywhere (`siq.identify.filtered_terms`).

Noise drives the velocities, and is the same everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from siq.data.recordings import Recordings
from siq.dynamics.diffusion import Diffusion
from siq.errors import NumericalFailure
from siq.estimation.estimation import fit_by_filter
from siq.estimation.fit import Fit
from siq.estimation.innovations import whiten
from siq.estimation.measurements import Measurements
from siq.estimation.noise_uncertainty import NoiseUncertainty, noise_uncertainty
from siq.estimation.process_noise import without_idle_forces
from siq.identify.filtered_terms import FilteredTerms, neighbours
from siq.identify.flow import FlowMap
from siq.identify.identified_field import IdentifiedField
from siq.identify.library import CandidateLibrary
from siq.identify.noisy_sensor import NUMBERS, ROUNDS, moved_by
from siq.identify.seen_states import View
from siq.identify.selection import critical_values
from siq.identify.velocities import force_diffusion, smoothed_motion, with_definitions

KNOWN = 2.0  # half of the equations hold by definition, and no false term comes into them


@dataclass(frozen=True)
class HiddenMotion:
    """An identified f(x, v) with both noises.

    Attributes
    ----------
    found
        f of positions and velocities, `siq.identify.velocities.with_definitions`; D acts on velocities, and
        is the unit matrix there if no random forces are seen.
    sensor
        Variance of each position's sensor noise, shape ``(d/2,)``.
    sensor_error
        Standard error of its logarithm.
    intensity, intensity_error
        ε, and the standard error of its logarithm; zero of ring-downs, without random forces.
    correlation, score
        Of neighbouring innovations, the strongest, and in standard errors.
    states
        What the filter knows of positions and velocities at each sample, shape ``(n, d)``.
    log_likelihood
        Of the fit.
    """

    found: IdentifiedField
    sensor: np.ndarray
    sensor_error: np.ndarray
    intensity: float
    intensity_error: float
    correlation: float
    score: float
    states: np.ndarray
    log_likelihood: float


def identify_hidden_motion(
    library: CandidateLibrary,
    recordings: Recordings,
    *,
    false_terms: float,
    generator: np.random.Generator,
    pair_step: float | None = None,
) -> HiddenMotion:
    """Find the forces, how noise drives the velocities, and the noise of the sensors together.

    Parameters
    ----------
    library
        The candidate functions of positions and velocities.
    recordings
        Of positions, in the order of the library's first states.
    false_terms
        Probability that chance brings any false term into f.
    generator
        Draws recordings again, see `siq.identify.stability`.
    pair_step
        Longest time between samples that still belong together.

    Raises
    ------
    NumericalFailure
        When the fit does not settle, or the library is too large.
    """
    d = library.dimension
    half = d // 2
    view = View(library, Diffusion.identity(d), None, hidden=True)
    data = view.measured(recordings, pair_step)
    everything = view.everything
    if data.outputs.size * len(everything) > NUMBERS:
        raise NumericalFailure(
            f"{len(everything)} coefficients and {len(data.t)} samples are too much for the memory; lower"
            " identification.degree, or name the functions of f"
        )
    x, noise = smoothed_motion(data, library.states[:half])
    if not noise.process.any():
        raise NumericalFailure("no force is seen: the positions move evenly; record longer")
    whole = fit_by_filter(
        view.model(everything, np.zeros(len(everything))), data, x=x, noise=noise, iterations=ROUNDS,
        closure=False,
    )  # fmt: skip
    if whole.fault:
        raise NumericalFailure(f"the likelihood with hidden velocities cannot be worked out: {whole.fault}")
    critical = critical_values(library, false_terms=min(KNOWN * false_terms, 0.5))
    terms = FilteredTerms.along(view, data, whole, np.tile(critical, half))
    chosen = terms.chosen()
    for place, name in enumerate(library.states[half:], start=half):
        if place not in everything[chosen, 0]:
            raise NumericalFailure(f"no term of the equation of {name} is significant; record longer")
    fit, support, chosen = terms.settled(chosen, whole.noise, x=whole.linearised_at)
    # The search for intensities ends at the least that it tries; of ring-downs there are none.
    fit = without_idle_forces(fit, data) or fit
    one = _as_motion(view, support, fit, data, noise_uncertainty(fit, data))
    shares = np.concatenate([np.ones(half), terms.stability(chosen, generator=generator)])
    return replace(one, found=replace(one.found, rivals=terms.rivals(chosen), stability=shares))


def _as_motion(
    view: View, support: np.ndarray, fit: Fit, data: Measurements, certain: NoiseUncertainty
) -> HiddenMotion:
    library = view.library
    half = library.dimension // 2
    rate = fit.noise.intensity[0]
    diffusion, intensity = force_diffusion(rate[half:, half:])
    own = with_definitions(library, support, fit.model.values, certain.covariance)
    coefficients = np.zeros((library.size, library.dimension))
    coefficients[own[0][:, 1], own[0][:, 0]] = own[1]
    moved, step = moved_by(data)
    # What is not foreseen from a sample to the next: twice the sensor's error, and what noise makes of v.
    unforeseen = 2 * fit.noise.measurement + np.diag(rate)[half:] * step**3 / 3
    found = IdentifiedField(
        library, coefficients, own[0], own[2], rate, float(np.sqrt((unforeseen / moved).mean())),
        FlowMap(fit.substeps), diffusion,
    )  # fmt: skip
    return HiddenMotion(
        found,
        fit.noise.measurement,
        certain.measurement,
        intensity,
        float(np.sqrt((certain.process[half:] ** 2).sum())) / half if intensity else 0.0,
        *neighbours(whiten(fit.linearisation, data, fit.noise), data),
        fit.linearised_at,
        fit.log_likelihood,
    )
