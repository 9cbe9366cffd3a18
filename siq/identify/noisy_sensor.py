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
from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.estimation.estimation import Fit, fit_by_filter
from siq.estimation.innovations import Noise, Whitened, solve, whiten
from siq.estimation.linearisation import Grid, linearise
from siq.estimation.measurements import Measurements
from siq.estimation.noise import log_likelihood
from siq.estimation.noise_uncertainty import NoiseUncertainty, noise_uncertainty
from siq.estimation.process_noise import process_noise_needed
from siq.identify.exposure import exposed, exposed_measurements, exposed_noise
from siq.identify.flow import FlowMap
from siq.identify.flow_regression import positive
from siq.identify.identified_field import IdentifiedField, field_dynamics
from siq.identify.library import CandidateLibrary
from siq.identify.selection import Equation, best_support, doubts_of_all, strong_terms
from siq.identify.stability import blocks_of, stability, triangles

ROUNDS = 8  # of the fit of a whole library, which only chooses terms
LAGS = (1, 2, 3)  # steps over which innovations are compared: what remembers at all remembers so long
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
    forces_error
        The same of the random forces' intensity.
    correlation, score
        Of neighbouring innovations, the strongest over the states, and in standard errors: white where the
        model holds.
    gain
        Twice the log-likelihood ratio to the same terms without sensor noise.
    exposure
        The step over which samples are means, None where they are not.
    """

    found: IdentifiedField
    sensor: np.ndarray
    sensor_error: np.ndarray
    forces_error: np.ndarray
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
    critical: np.ndarray,
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
    critical
        Standard errors that the coefficient of each function has to exceed, shape ``(q,)``.
    generator
        Draws recordings again, see `siq.identify.stability`.
    pair_step
        Longest time between samples that still belong together.
    exposure
        The step over which each sample is a mean (`siq.identify.exposure`), None where it is none.

    Raises
    ------
    NumericalFailure
        When the fit does not settle, or a library is too large for the recordings.
    """
    view = _View(library, diffusion, exposure)
    data = view.measured(recordings, pair_step)
    q, d = library.size, library.dimension
    everything = np.array([(i, k) for i in range(d) for k in range(q)])
    if data.outputs.size * len(everything) > NUMBERS:
        raise NumericalFailure(
            f"{len(everything)} coefficients and {len(data.t)} samples with a noisy sensor are too much for"
            " the memory; lower identification.degree, or name the functions of f"
        )
    noise = view.noise(replace(noise, shape=np.eye(d)[None]))
    model = view.model(everything, np.zeros(len(everything)))
    x = view.states(recordings.values)
    whole = fit_by_filter(model, data, x=x, noise=noise, iterations=ROUNDS, closure=False)
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
    fit = _settled(view, support, data, whole.noise, values=values[chosen], x=whole.linearised_at)
    while (weak := _weakest(fit, support, critical)) is not None:
        support = np.delete(support, weak, axis=0)
        kept = np.delete(fit.model.values, weak)
        fit = _settled(view, support, data, fit.noise, values=kept, x=fit.linearised_at)
    fit = _without_forces(fit, data)
    one = _as_field(view, support, fit, data, noise_uncertainty(fit, data))
    own = (support[:, 0] * q + support[:, 1]).tolist()
    # Whitened values stand one behind the other, all states of a sample together.
    parts = triangles(np.column_stack([white.columns, goal]), np.repeat(blocks_of(recordings.recording), d))
    (shares,) = stability(
        parts,
        lambda drawn: [Equation(drawn[:, :-1], drawn[:, -1], 1.0, equations.critical)],
        [own],
        generator=generator,
    )
    field = replace(one.found, doubts=doubts_of_all(equations, support, dimension=d), stability=shares)
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
    view = _View(library, one.found.diffusion, one.exposure)
    noise = view.noise(_noise_of(one.found, one.sensor))
    own = view.measured(training, pair_step)
    x = view.states(training.values)
    fit = _settled(view, support, own, noise, values=one.found.values, x=x)
    other = view.measured(unseen, pair_step)
    still = tuple(replace(each, fixed=True) for each in fit.model.parameters)
    follow = fit_by_filter(
        replace(fit.model, parameters=still), other, x=view.states(unseen.values), noise=fit.noise,
        estimate_process=False, estimate_sensor=False, substeps=fit.substeps,
    )  # fmt: skip
    q, d = library.size, library.dimension
    everything = np.array([(i, k) for i in range(d) for k in range(q)])
    values = np.zeros(len(everything))
    values[support[:, 0] * q + support[:, 1]] = fit.model.values
    whole = view.model(everything, values)
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
    found: IdentifiedField,
    sensor: np.ndarray,
    recordings: Recordings,
    *,
    pair_step: float | None = None,
    exposure: float | None = None,
) -> Recordings:
    """The states as a filter knows them at each sample, from that and the earlier ones.

    Their increments have the mean of f, as those of the states do; those of the measured values do not.

    Parameters
    ----------
    found
        f and the random forces.
    sensor
        Variance of each state's sensor noise, shape ``(d,)``.
    recordings, pair_step, exposure
        As for `identify_by_likelihood`.
    """
    view = _View(found.library, found.diffusion, exposure)
    data = view.measured(recordings, pair_step)
    model = view.model(found.support, found.values)
    still = replace(model, parameters=tuple(replace(each, fixed=True) for each in model.parameters))
    follow = fit_by_filter(
        still, data, x=view.states(recordings.values), noise=view.noise(_noise_of(found, sensor)),
        estimate_process=False, estimate_sensor=False, substeps=found.flow.steps,
    )  # fmt: skip
    return replace(recordings, values=follow.linearised_at[:, : len(sensor)].copy())


@dataclass(frozen=True)
class _View:
    """How samples show the states: as they are, or as means over the step before them."""

    library: CandidateLibrary
    diffusion: Diffusion
    exposure: float | None

    def model(self, support: np.ndarray, values: np.ndarray) -> Dynamics:
        """Dynamics with the coefficients of a support as parameters, as they are measured."""
        plain = field_dynamics(self.library, support, values, diffusion=self.diffusion)
        return plain if self.exposure is None else exposed(plain, self.exposure)

    def measured(self, recordings: Recordings, pair_step: float | None) -> Measurements:
        data = unbroken(recordings, pair_step=pair_step)
        return data if self.exposure is None else exposed_measurements(data, self.library.dimension)

    def noise(self, noise: Noise) -> Noise:
        return noise if self.exposure is None else exposed_noise(noise, self.library.dimension)

    def states(self, values: np.ndarray) -> np.ndarray:
        return values if self.exposure is None else np.column_stack([values, values])


def _noise_of(found: IdentifiedField, sensor: np.ndarray) -> Noise:
    rate = found.noise_rate
    if not rate.any():
        return Noise(sensor, np.zeros(len(rate)))
    size = np.sqrt(np.diag(rate))
    return Noise(sensor, np.diag(rate).copy(), (rate / np.outer(size, size))[None])


def _settled(
    view: _View,
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
    fit = fit_by_filter(view.model(support, values), data, x=x, noise=noise)
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
    view: _View,
    support: np.ndarray,
    fit: Fit,
    data: Measurements,
    certain: NoiseUncertainty,
) -> FilteredField:
    library, d = view.library, view.library.dimension
    coefficients = np.zeros((library.size, d))
    coefficients[support[:, 1], support[:, 0]] = fit.model.values
    rate = fit.noise.intensity[0][:d, :d]
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
        view.diffusion,
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
        found,
        fit.noise.measurement,
        certain.measurement,
        certain.process[:d],
        correlation,
        score,
        2 * (best - base),
        view.exposure,
    )


def _neighbours(white: Whitened, data: Measurements) -> tuple[float, float]:
    """Strongest correlation of near innovations over outputs and lags, and in standard errors."""
    innovations = white.innovations.reshape(len(data.t), -1)
    found: list[tuple[float, float, float]] = []
    for lag in LAGS:
        rows = np.flatnonzero(data.recording[lag:] == data.recording[:-lag])
        first, second = innovations[rows], innovations[rows + lag]
        product = first * second
        size = np.sqrt((first**2).mean(axis=0) * (second**2).mean(axis=0))
        scores = product.sum(axis=0) / np.sqrt((product**2).sum(axis=0))
        found += zip(np.abs(scores), product.mean(axis=0) / size, scores, strict=True)
    _, correlation, score = max(found)
    return float(correlation), float(score)
