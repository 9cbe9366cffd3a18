"""Which f do recordings show whose sensor is noisy?

The noise of a sensor is in both samples of a pair, and a regression of one on the other is biased by it. What
is not biased is the likelihood of whole recordings under f, random forces and sensor noise together
(`siq.estimation`). All functions of a library are fitted so; the terms are chosen by what they add to the
likelihood, and fitted again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.special

from siq.data.recordings import LONGEST_STEP, Recordings
from siq.dynamics.diffusion import Diffusion
from siq.errors import NumericalFailure
from siq.estimation.estimation import Fit, fit_by_filter
from siq.estimation.innovations import Noise, Whitened, solve, whiten
from siq.estimation.linearisation import Grid, linearise
from siq.estimation.measurements import Measurements
from siq.estimation.noise import log_likelihood
from siq.estimation.noise_uncertainty import NoiseUncertainty, noise_uncertainty
from siq.estimation.process_noise import process_noise_needed
from siq.identify.flow import FlowMap
from siq.identify.flow_regression import positive
from siq.identify.identified_field import IdentifiedField, field_dynamics
from siq.identify.library import CandidateLibrary
from siq.identify.selection import Equation, best_support, rival_changes, strong_terms
from siq.identify.stability import blocks_of, stability, triangles

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
    correlation, score
        Of neighbouring innovations, the strongest over the states, and in standard errors: white where the
        model holds.
    gain
        Twice the log-likelihood ratio to the same terms without sensor noise.
    """

    found: IdentifiedField
    sensor: np.ndarray
    sensor_error: np.ndarray
    correlation: float
    score: float
    gain: float


def identify_by_likelihood(
    library: CandidateLibrary,
    recordings: Recordings,
    begin: IdentifiedField,
    noise: Noise,
    *,
    critical: np.ndarray,
    generator: np.random.Generator,
    pair_step: float | None = None,
) -> FilteredField:
    """Find f, the random forces and the noise of the sensor together.

    Parameters
    ----------
    library
        The candidate functions.
    recordings
        Whole trajectories.
    begin
        f as the regression of pairs has it, of which the diffusion is kept.
    noise
        To begin with.
    critical
        Standard errors that the coefficient of each function has to exceed, shape ``(q,)``.
    generator
        Draws recordings again, see `siq.identify.stability`.
    pair_step
        Longest time between samples that still belong together.

    Raises
    ------
    NumericalFailure
        When the fit does not settle, or a library is too large for the recordings.
    """
    data = unbroken(recordings, pair_step=pair_step)
    q, d = library.size, library.dimension
    everything = np.array([(i, k) for i in range(d) for k in range(q)])
    if data.outputs.size * len(everything) > NUMBERS:
        raise NumericalFailure(
            f"{len(everything)} coefficients and {len(data.t)} samples with a noisy sensor are too much for"
            " the memory; lower identification.degree, or name the functions of f"
        )
    noise = replace(noise, shape=np.eye(d)[None])
    zero = np.zeros(len(everything))
    model = field_dynamics(library, everything, zero, diffusion=begin.diffusion)
    whole = fit_by_filter(model, data, x=recordings.values, noise=noise, iterations=ROUNDS, closure=False)
    if whole.fault:
        raise NumericalFailure(f"the likelihood beside sensor noise cannot be worked out: {whole.fault}")
    white = whiten(whole.linearisation, data, whole.noise)
    values = whole.model.values
    goal = white.innovations + white.columns @ (values - _last_change(whole, white))
    triangle = scipy.linalg.qr(
        np.column_stack([white.columns, goal]), mode="r", overwrite_a=True, check_finite=False
    )[0][: len(values) + 1]
    # In units of the innovations' errors; all equations at once, since a filter couples them.
    equations = Equation(triangle[:, :-1], triangle[:, -1], 1.0, np.tile(critical, d))
    chosen = list(best_support(equations, strong_terms(equations)))
    support = everything[chosen]
    for component, name in enumerate(library.states):
        if component not in support[:, 0]:
            raise NumericalFailure(f"no term of the equation of {name} is significant")
    fit = _settled(library, support, data, whole.noise, values=values[chosen], x=whole.linearised_at)
    while (weak := _weakest(fit, support, critical)) is not None:
        support = np.delete(support, weak, axis=0)
        kept = np.delete(fit.model.values, weak)
        fit = _settled(library, support, data, fit.noise, values=kept, x=fit.linearised_at)
    fit = _without_forces(fit, data)
    one = _as_field(begin, library, support, fit, data, noise_uncertainty(fit, data))
    own = (support[:, 0] * q + support[:, 1]).tolist()
    doubts = rival_changes(equations, own)
    # Whitened values stand one behind the other, all states of a sample together.
    parts = triangles(np.column_stack([white.columns, goal]), np.repeat(blocks_of(recordings.recording), d))
    (shares,) = stability(
        parts,
        lambda drawn: [Equation(drawn[:, :-1], drawn[:, -1], 1.0, equations.critical)],
        [own],
        generator=generator,
    )
    field = replace(one.found, doubts=doubts.reshape(-1, d, q).transpose(0, 2, 1), stability=shares)
    return replace(one, found=field)


def unbroken(recordings: Recordings, *, pair_step: float | None = None) -> Measurements:
    """Recordings as measurements of their states, a new one behind every gap.

    Parameters
    ----------
    recordings
        Whole trajectories.
    pair_step
        Longest time between samples that still belong together; by default `LONGEST_STEP` median steps.
    """
    gap, recording = np.diff(recordings.t), recordings.recording
    inside = recording[1:] == recording[:-1]
    if pair_step is None and inside.any():
        pair_step = LONGEST_STEP * float(np.quantile(gap[inside], 0.5, method="lower"))
    broken = ~inside if pair_step is None else ~inside | (gap > pair_step * (1 + 1e-6))
    first = np.concatenate([[0], np.flatnonzero(broken) + 1, [len(recordings.t)]])
    return Measurements(
        labels=tuple(recordings.labels[recording[row]] for row in first[:-1]),
        first=first,
        t=recordings.t,
        outputs=np.ascontiguousarray(recordings.values),
        courses=((),) * (len(first) - 1),
    )


def held_out_evidence(
    one: FilteredField, training: Recordings, unseen: Recordings, *, pair_step: float | None = None
) -> tuple[float, float]:
    """Does f hold for recordings that it was not fitted to?

    Parameters
    ----------
    one
        Fitted to all recordings; its terms are fitted to the training recordings again.
    training, unseen
        The two parts.
    pair_step
        As for `identify_by_likelihood`.

    Returns
    -------
    probability, ratio
        Of the unseen innovations having no part left that any function of the library explains, by an F test;
        and of their mean square to that of the training recordings.
    """
    library, support = one.found.library, one.found.support
    noise = _noise_of(one.found, one.sensor)
    own = unbroken(training, pair_step=pair_step)
    fit = _settled(library, support, own, noise, values=one.found.values, x=training.values)
    other = unbroken(unseen, pair_step=pair_step)
    still = tuple(replace(each, fixed=True) for each in fit.model.parameters)
    follow = fit_by_filter(
        replace(fit.model, parameters=still), other, x=unseen.values, noise=fit.noise,
        estimate_process=False, estimate_sensor=False, substeps=fit.substeps,
    )  # fmt: skip
    q, d = library.size, library.dimension
    everything = np.array([(i, k) for i in range(d) for k in range(q)])
    values = np.zeros(len(everything))
    values[support[:, 0] * q + support[:, 1]] = fit.model.values
    whole = field_dynamics(library, everything, values, diffusion=one.found.diffusion)
    along = linearise(whole, Grid(other, fit.substeps), values, follow.linearised_at)
    # The innovations are those of the filter itself; the library's columns are along the same states.
    white = whiten(replace(along, gap=follow.linearisation.gap), other, follow.noise)
    basis = np.linalg.qr(white.columns / positive(np.linalg.norm(white.columns, axis=0)))[0]
    explained = float(((basis.T @ white.innovations) ** 2).sum())
    count, rest = basis.shape[1], white.degrees_of_freedom - basis.shape[1]
    total = float(white.innovations @ white.innovations)
    if rest <= 0:
        return 1.0, 1.0
    probability = float(scipy.special.fdtrc(count, rest, explained / count / ((total - explained) / rest)))
    usual = fit.sum_of_squares / fit.degrees_of_freedom
    return probability, total / white.degrees_of_freedom / usual


def filtered_recordings(
    found: IdentifiedField, sensor: np.ndarray, recordings: Recordings, *, pair_step: float | None = None
) -> Recordings:
    """The states as a filter knows them at each sample, from that and the earlier ones.

    Their increments have the mean of f, as those of the states do; those of the measured values do not.

    Parameters
    ----------
    found
        f and the random forces.
    sensor
        Variance of each state's sensor noise, shape ``(d,)``.
    recordings, pair_step
        As for `identify_by_likelihood`.
    """
    data = unbroken(recordings, pair_step=pair_step)
    model = found.dynamics
    still = replace(model, parameters=tuple(replace(each, fixed=True) for each in model.parameters))
    follow = fit_by_filter(
        still, data, x=recordings.values, noise=_noise_of(found, sensor), estimate_process=False,
        estimate_sensor=False, substeps=found.flow.steps,
    )  # fmt: skip
    return replace(recordings, values=follow.linearised_at)


def _noise_of(found: IdentifiedField, sensor: np.ndarray) -> Noise:
    rate = found.noise_rate
    if not rate.any():
        return Noise(sensor, np.zeros(len(rate)))
    size = np.sqrt(np.diag(rate))
    return Noise(sensor, np.diag(rate).copy(), (rate / np.outer(size, size))[None])


def _settled(
    library: CandidateLibrary,
    support: np.ndarray,
    data: Measurements,
    noise: Noise,
    *,
    values: np.ndarray,
    x: np.ndarray,
) -> Fit:
    """The fit of some terms.

    Raises
    ------
    NumericalFailure
        When it does not settle.
    """
    model = field_dynamics(library, support, values, diffusion=Diffusion.identity(library.dimension))
    fit = fit_by_filter(model, data, x=x, noise=noise)
    if not fit.converged:
        raise NumericalFailure(
            "the fit of f beside sensor noise does not settle"
            + (f": {fit.fault}" if fit.fault else "")
            + "; record more, or sample more often"
        )
    return fit


def _without_forces(fit: Fit, data: Measurements) -> Fit:
    """The fit of trajectories that no random force drives, unless the recordings speak against it."""
    strict = fit_by_filter(
        fit.model, data, x=fit.x, noise=fit.noise.without_process(), estimate_process=False,
        substeps=fit.substeps,
    )  # fmt: skip
    return fit if process_noise_needed(fit, strict) else strict


def _last_change(fit: Fit, white: Whitened) -> np.ndarray:
    """What the estimates are beyond the values at which a fit was linearised."""
    change = solve(white.columns, white.innovations)[0]
    return change if fit.converged else 0 * change


def _weakest(fit: Fit, support: np.ndarray, critical: np.ndarray) -> int | None:
    """The least significant term, if it is not significant, and not the last of its equation."""
    strength = np.abs(fit.model.values) / fit.standard_errors / critical[support[:, 1]]
    for place in np.argsort(strength):
        if strength[place] >= 1:
            return None
        if np.sum(support[:, 0] == support[place, 0]) > 1:
            return int(place)
    return None


def _as_field(
    begin: IdentifiedField,
    library: CandidateLibrary,
    support: np.ndarray,
    fit: Fit,
    data: Measurements,
    certain: NoiseUncertainty,
) -> FilteredField:
    coefficients = np.zeros((library.size, library.dimension))
    coefficients[support[:, 1], support[:, 0]] = fit.model.values
    rate = fit.noise.intensity[0]
    rows = data.begins
    moved = ((data.outputs[rows + 1] - data.outputs[rows]) ** 2).mean(axis=0)
    step = float(np.mean(data.t[rows + 1] - data.t[rows]))
    ratio = float(np.sqrt(((np.diag(rate) * step + 2 * fit.noise.measurement) / positive(moved)).mean()))
    found = IdentifiedField(
        library,
        coefficients,
        support,
        certain.covariance,
        rate,
        ratio,
        FlowMap(fit.substeps),
        begin.diffusion,
    )
    correlation, score = _neighbours(whiten(fit.linearisation, data, fit.noise), data)
    without = replace(fit.noise, measurement=fit.noise.measurement * WITHOUT)
    alone = replace(data, sensor_noise=None)
    best = log_likelihood(fit.linearisation, alone, fit.noise)
    base = max(
        log_likelihood(fit.linearisation, alone, without.scaled(factor))
        for factor in 1 + np.linspace(0, 2, 21) * fit.noise.measurement.max() / max(rate.max() * step, 1e-300)
    )
    return FilteredField(
        found, fit.noise.measurement, certain.measurement, correlation, score, 2 * (best - base)
    )


def _neighbours(white: Whitened, data: Measurements) -> tuple[float, float]:
    """Strongest correlation of neighbouring innovations over the outputs, and in standard errors."""
    innovations = white.innovations.reshape(len(data.t), -1)
    first, second = innovations[data.begins], innovations[data.begins + 1]
    product = first * second
    correlations = product.mean(axis=0) / np.sqrt((first**2).mean(axis=0) * (second**2).mean(axis=0))
    scores = product.sum(axis=0) / np.sqrt((product**2).sum(axis=0))
    worst = int(np.argmax(np.abs(scores)))
    return float(correlations[worst]), float(scores[worst])
