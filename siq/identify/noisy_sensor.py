"""Which f do recordings show whose sensor is noisy?

The noise of a sensor is in both samples of a pair, and a regression of one on the other is biased by it. What
is not biased is the likelihood of whole recordings under f, random forces and sensor noise together
(`siq.estimation`). All functions of a library are fitted so; the terms are chosen by what they add to the
likelihood, and fitted again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from siq.data.recordings import Recordings
from siq.dynamics.diffusion import Diffusion
from siq.errors import NumericalFailure
from siq.estimation.estimation import fit_by_filter
from siq.estimation.fit import Fit
from siq.estimation.innovations import Noise, whiten
from siq.estimation.measurements import Measurements
from siq.estimation.noise import log_likelihood
from siq.estimation.noise_uncertainty import NoiseUncertainty, noise_uncertainty
from siq.estimation.process_noise import process_noise_needed
from siq.identify.filtered_terms import FilteredTerms, neighbours
from siq.identify.flow import FlowMap
from siq.identify.flow_regression import positive
from siq.identify.identified_field import IdentifiedField
from siq.identify.library import CandidateLibrary
from siq.identify.noise_beside_sensor import FilteredNoise, formula_noise, left_open, noise_by_state
from siq.identify.seen_states import View
from siq.identify.selection import critical_values
from siq.identify.weighted_regression import with_formula

NOISE_ROUNDS = 2  # of D by the trajectories of f, and f by the weights of D
ROUNDS = 8  # of the fit of a whole library, which only chooses terms
WITHOUT = 1e-6  # of a sensor's variance: as good as none
NUMBERS = 4e8  # of the derivatives by all coefficients at all samples: 3 GB


@dataclass(frozen=True)
class FilteredField:
    """An identified f with the noise of the sensor beside it.

    Attributes
    ----------
    found
        f, its covariance, and the random forces as its `noise_rate`.
    sensor
        Variance of each state's sensor noise, shape ``(d,)``.
    sensor_error
        Standard error of its logarithm, shape ``(d,)``.
    intensity_error
        Standard error of the logarithm of ε, the strength of the random forces.
    correlation, score
        Of neighbouring innovations, the strongest over the states, and in standard errors: white where the
        model holds.
    gain
        Twice the log-likelihood ratio to the same terms without sensor noise.
    exposure
        The time over which samples are means, None where they are not.
    """

    found: IdentifiedField
    sensor: np.ndarray
    sensor_error: np.ndarray
    intensity_error: float
    correlation: float
    score: float
    gain: float
    exposure: float | None = None


def identify_by_likelihood(
    library: CandidateLibrary,
    recordings: Recordings,
    diffusion: Diffusion,
    noise: Noise,
    *,
    false_terms: float,
    generator: np.random.Generator,
    pair_step: float | None = None,
    exposure: float | None = None,
) -> FilteredField:
    """Find f, the random forces and the noise of the sensor together.

    Parameters
    ----------
    library
        The candidate functions.
    recordings
        Whole trajectories.
    diffusion
        D, on which f does not depend.
    noise
        To begin with.
    false_terms
        Probability that a constant D is given up by chance; and that chance brings any false term into f, or
        into D.
    generator
        Draws recordings again, see `siq.identify.stability`.
    pair_step
        Longest time between samples that still belong together.
    exposure
        The time over which each sample is a mean (`siq.identify.exposure`), None where it is none.

    Raises
    ------
    NumericalFailure
        When the fit does not settle, or a library is too large for the recordings.
    """
    view = View(library, diffusion, exposure)
    data = view.measured(recordings, pair_step)
    d = library.dimension
    critical = critical_values(library, false_terms=false_terms)
    everything = view.everything
    if data.outputs.size * len(everything) > NUMBERS:
        raise NumericalFailure(
            f"{len(everything)} coefficients and {len(data.t)} samples with a noisy sensor are too much for"
            " the memory; lower identification.degree, or name the functions of f"
        )
    noise = view.noise(replace(noise, shape=np.eye(d)[None]))
    model = view.model(everything, np.zeros(len(everything)))
    x = view.states(data)
    whole = fit_by_filter(model, data, x=x, noise=noise, iterations=ROUNDS, closure=False)
    if whole.fault:
        raise NumericalFailure(f"the likelihood beside sensor noise cannot be worked out: {whole.fault}")
    seen = FilteredNoise(library.symbols, whole, data)
    chance = seen.constant_probability()
    by_state = chance < false_terms and bool(whole.noise.process.any())
    if by_state:
        # Weights that are wrong everywhere would choose wrong terms.
        own = noise_by_state(seen, false_terms=false_terms, probability=chance)
        whole = fit_by_filter(
            whole.model, data, x=whole.linearised_at,
            noise=view.noise(formula_noise(own.formula, own.sensor)), iterations=ROUNDS, closure=False,
        )  # fmt: skip
        if whole.fault:
            raise NumericalFailure(f"the likelihood beside sensor noise cannot be worked out: {whole.fault}")
    terms = FilteredTerms.along(view, data, whole, np.tile(critical, d))
    chosen = terms.chosen()
    for component, name in enumerate(library.states):
        if component not in everything[chosen, 0]:
            raise NumericalFailure(f"no term of the equation of {name} is significant; record longer")
    fit, support, chosen = terms.settled(chosen, whole.noise, x=whole.linearised_at)
    if by_state:
        one = _with_formula(view, support, fit, data, false_terms=false_terms, probability=chance)
    else:
        fit = without_needless_forces(fit, data)
        one = _as_field(view, support, fit, data, noise_uncertainty(fit, data))
        if one.found.noise_rate.any():
            one = replace(one, found=replace(one.found, constant_noise=seen.constant.formula))
    shares = terms.stability(chosen, generator=generator)
    return replace(one, found=replace(one.found, rivals=terms.rivals(chosen), stability=shares))


def without_needless_forces(fit: Fit, data: Measurements) -> Fit:
    """The fit of trajectories that no random force drives, unless the recordings speak against it."""
    strict = fit_by_filter(
        fit.model, data, x=fit.x, noise=fit.noise.without_process(), estimate_process=False,
        substeps=fit.substeps,
    )  # fmt: skip
    return fit if process_noise_needed(fit, strict) else strict


def _as_field(
    view: View,
    support: np.ndarray,
    fit: Fit,
    data: Measurements,
    certain: NoiseUncertainty,
) -> FilteredField:
    library, d = view.library, view.library.dimension
    coefficients = np.zeros((library.size, d))
    coefficients[support[:, 1], support[:, 0]] = fit.model.values
    rows = data.begins
    intensity = fit.noise.intensity
    rate = (intensity[0] if len(intensity) == 1 else intensity[rows].mean(axis=0))[:d, :d]
    moved, step = moved_by(data)
    ratio = float(np.sqrt(((np.diag(rate) * step + 2 * fit.noise.measurement) / positive(moved)).mean()))
    found = IdentifiedField(
        library,
        coefficients,
        support,
        certain.covariance,
        rate,
        ratio,
        FlowMap(fit.substeps),
        view.diffusion,
    )
    correlation, score = neighbours(whiten(fit.linearisation, data, fit.noise), data)
    without = replace(fit.noise, measurement=fit.noise.measurement * WITHOUT)
    alone = replace(data, sensor_noise=None)
    best = log_likelihood(fit.linearisation, alone, fit.noise)
    base = max(
        log_likelihood(fit.linearisation, alone, without.scaled(factor))
        for factor in 1 + np.linspace(0, 2, 21) * fit.noise.measurement.max() / max(rate.max() * step, 1e-300)
    )
    return FilteredField(
        found,
        fit.noise.measurement,
        certain.measurement,
        float(np.sqrt((certain.process[:d] ** 2).sum())) / d,
        correlation,
        score,
        2 * (best - base),
        view.exposure,
    )


def moved_by(data: Measurements) -> tuple[np.ndarray, float]:
    """Mean square of what each output moves by from a measured sample to the next, and the mean time.

    Raises
    ------
    NumericalFailure
        Where no sample has a next one.
    """
    measured = np.flatnonzero(~np.isnan(data.outputs).all(axis=1))
    before, after = measured[:-1], measured[1:]
    same = data.recording[before] == data.recording[after]
    before, after = before[same], after[same]
    if not len(before):
        raise NumericalFailure(
            "no two samples are so near in time that one tells of the other; record longer"
        )
    moved = ((data.outputs[after] - data.outputs[before]) ** 2).mean(axis=0)
    return moved, float((data.t[after] - data.t[before]).mean())


def _with_formula(
    view: View, support: np.ndarray, fit: Fit, data: Measurements, *, false_terms: float, probability: float
) -> FilteredField:
    """What is kept of a fit whose random forces depend on the state, once f and D know of each other."""
    symbols = view.library.symbols
    for _ in range(NOISE_ROUNDS):
        seen = FilteredNoise(symbols, fit, data)
        own = noise_by_state(seen, false_terms=false_terms, probability=probability)
        fit = fit_by_filter(
            fit.model, data, x=fit.linearised_at, noise=view.noise(formula_noise(own.formula, own.sensor)),
            estimate_process=False, estimate_sensor=False, substeps=fit.substeps,
        )  # fmt: skip
        if not fit.converged:
            raise NumericalFailure(
                "the fit of f beside sensor noise and random forces that depend on the state does not settle"
                + (f": {fit.fault}" if fit.fault else "")
                + "; record more, or sample more often"
            )
    p = len(own.formula.values)
    certain = NoiseUncertainty(
        np.sqrt(np.diag(own.covariance)[p:]),
        np.zeros(len(symbols)),
        fit.covariance + left_open(seen, own, fit, data),
    )
    one = _as_field(view, support, fit, data, certain)
    states = fit.linearised_at[:, : len(symbols)]
    slopes = own.formula.strength_slopes(states)
    error = float(np.sqrt(slopes @ own.formula.covariance @ slopes))
    return replace(one, found=with_formula(one.found, own.formula, states), intensity_error=error)
