"""Identification of f by the likelihood of a Kalman filter: of noisy sensors, exposures, hidden velocities.

The noise of a sensor is in both samples of a pair, and a regression of one on the other is biased by it. What
is not biased is the likelihood of whole recordings under f, process noise and measurement noise together
(`siq.inference.maximum_likelihood`), of the states as samples show them (`siq.inference.observation`).

All functions of a library are fitted first, beginning with f = 0, whose filter is linear; coefficients enter
linearly, so that the first step of Gauss and Newton is already the weighted regression on what the filter
knows of the state. Along that fit everything is linear: the innovations are a regression problem like any
other (`siq.inference.selection`), all equations at once since a filter couples them. What is chosen is fitted
again, and terms leave as long as one is not significant after all. Where the innovations show that the
process noise depends on the state, f and D are fitted in turn (`siq.inference.diffusion_model`).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import ndtr, ndtri

from siq.data.recordings import Recordings, parent_recordings, snapshot_pairs
from siq.data.stationarity import runs_of
from siq.errors import NumericalFailure
from siq.inference.checks import correlations_between, unexplained_probability
from siq.inference.diffusion_model import InnovationLikelihood
from siq.inference.field_estimate import FieldEstimate, NoiseDiagnosis
from siq.inference.kalman_filter import Grid, Noise, linearise, whiten
from siq.inference.maximum_likelihood import Fit, fit_by_filter, noise_uncertainty
from siq.inference.measurements import Measurements
from siq.inference.observation import ObservationModel, moved_by, smoothed_motion
from siq.inference.recalibration import drop_insignificant_process_noise, process_noise_needed
from siq.inference.selection import (
    LinearProblem,
    blocks_of,
    chosen_terms,
    critical_values,
    fit_significant,
    model_average,
    stability,
    triangles,
)
from siq.inference.transition_densities import Transitions
from siq.numerics.integration import FlowMap
from siq.numerics.randomness import positive
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics

LAGS = (1, 2, 3)  # steps over which innovations are compared: what is correlated at all is so over these
UNKNOWN_STATE = 100.0  # standard deviations of a state, from which a filter begins that knows none
DIFFUSION_ROUNDS = 2  # of D by the trajectories of f, and f by the weights of D
LIBRARY_ROUNDS = 8  # of the fit of a whole library, which only chooses terms
SENSOR_BEGIN = 1e-3  # of what a sample moves by, squared
NO_SENSOR_NOISE = 1e-6  # of a sensor's variance: as good as none
MAX_NUMBERS = 4e8  # of the derivatives by all coefficients at all samples: 3 GB
SHORTEST_FORCE, LONGEST_FORCE = 4, 1 / 30  # steps; of a record: correlation times that a search begins with
SLOW_SHARE = 0.1  # of the variance of what is measured: slow measurement noise that a search begins with
SHORTEST_NOISE = 1  # step: the same of a sensor, whose noise is as good as white below it


def identify_by_likelihood(
    observation: ObservationModel, recordings: Recordings, noise: Noise | None = None, *,
    false_terms: float, generator: np.random.Generator, pair_step: float | None = None,
) -> FieldEstimate:  # fmt: skip
    """f, the process noise and measurement noise together, with the diagnosis.

    D is that of the observation, unless it depends on the state, or acts on hidden velocities: there it is
    the unit matrix if no process noise is seen.

    Parameters
    ----------
    observation, recordings
        The candidate functions, and how samples show the states; and whole trajectories of these.
    noise
        To begin with; not needed with hidden velocities.
    false_terms
        Probability that a constant D is given up by chance; and that chance brings any false term into f, or
        into D.
    generator, pair_step
        Draws recordings again, see `siq.inference.selection`; longest time between samples that still belong
        together.

    Raises
    ------
    NumericalFailure
        When the fit does not settle, or a library is too large for the recordings.
    """
    library, d, hidden = observation.library, observation.library.dimension, observation.hidden
    data, everything = observation.measured(recordings, pair_step), observation.everything
    if data.outputs.size * len(everything) > MAX_NUMBERS:
        raise NumericalFailure(
            f"{len(everything)} coefficients and {len(data.t)} samples with measurement noise are too much"
            " for the memory; lower identification.degree, or name the functions of f"
        )
    begins, slow = [], observation.sensor_time is not None
    if observation.slow_force or slow:
        begins = _of_slow_noise(observation, data)
    elif hidden:
        x, noise = smoothed_motion(data, library.states[: d // 2])
        if not noise.process.any():
            raise NumericalFailure("no force is seen: the positions move evenly; record longer")
        begins = [(observation, np.zeros(len(everything)), x, noise)]
    else:
        assert noise is not None
        noise = observation.noise(replace(noise, shape=np.eye(d)[None]))
        begins = [(observation, np.zeros(len(everything)), observation.states(data), noise)]
    wholes, faults = list[Fit](), list[NumericalFailure]()
    for view, one, x, noise in begins:
        try:
            wholes.append(_fit_library(view.model(everything, one), data, x, noise))
        except NumericalFailure as error:
            faults.append(error)
    if not wholes:
        raise faults[0]
    price = np.log(len(data.t)) / 2  # Schwarz's, for each noise
    worth = [one.restricted_likelihood(data) - price * (one.noise.process > 0).sum() for one in wholes]
    whole = wholes[int(np.argmax(worth))]
    if slow:  # the state is hidden by what has a memory, and steps are small
        x, values = whole.linearised_at, whole.model.values
        observation = _with_time_of(whole, observation, data)
        model = observation.model(everything, values[: len(everything)])
        whole = _fit_library(model, data, x, whole.noise, rounds=4 * LIBRARY_ROUNDS)
        observation = _with_time_of(whole, observation, data)
    likelihood = None if hidden or slow else InnovationLikelihood(library, whole, data)
    chance = 1.0 if likelihood is None else likelihood.constant_probability()
    by_state = chance < false_terms and bool(whole.noise.process.any())
    if likelihood is not None and by_state:
        # Weights that are wrong everywhere would choose wrong terms.
        likelihood = InnovationLikelihood(library, whole, data, bent=False)
        formula, sensor, _ = likelihood.selected(false_terms=false_terms, probability=chance)
        noise = observation.noise(Noise(sensor, np.ones(d), field=formula.diffusion(1.0)))
        whole = _fit_library(whole.model, data, whole.linearised_at, noise)
    # What holds by definition brings no false term: the others share their probability.
    each = ndtr(-critical_values(library, false_terms=false_terms)[everything[:, 1]])
    critical = -ndtri(each * min(false_terms, 0.5) / (2 * each.sum()))
    white = whiten(whole.linearisation, data, whole.noise)
    last = white.solve()[0] if whole.converged else 0.0
    columns, known = white.columns[:, : len(everything)], (whole.model.values - last)[: len(everything)]
    goal = white.innovations + columns @ known
    # Whitened values stand one behind the other, all outputs of a sample together.
    blocks = np.repeat(blocks_of(parent_recordings(data.labels)[data.recording]), data.outputs.shape[1])
    parts = triangles(columns, goal, blocks)

    def problem_of(triangle: np.ndarray) -> LinearProblem:
        return LinearProblem(triangle[:, :-1], triangle[:, -1], 1.0, critical, everything)

    problem = problem_of(np.asarray(np.linalg.qr(np.concatenate(parts), mode="r")))
    support, fit = chosen_terms([problem], library), whole

    def fit_terms(support: np.ndarray) -> tuple[Fit, np.ndarray]:
        nonlocal fit, observation
        places = problem.places(support)
        # Where functions are nearly alike, those that stay take over what the others did: all begin anew.
        values = problem.solve(places)[places]
        fit = observation.fitted(support, values, data, noise=fit.noise, x=fit.linearised_at)
        if slow:
            observation = _with_time_of(fit, observation, data)
        return fit, (np.abs(fit.model.values) / fit.standard_errors)[: len(places)] / critical[places]

    fit, support = fit_significant(fit_terms, support)
    if by_state:
        found = _with_formula(observation, support, fit, data, false_terms=false_terms, probability=chance)
    else:
        if observation.slow_force and not (fit.noise.process[0] and fit.model.values[-1] < 0):
            raise NumericalFailure("the slow force is all the noise that there is, or grows")
        if hidden:  # the search for intensities ends at the least that it tries; of ring-downs there are none
            fit = drop_insignificant_process_noise(fit, data) or fit
        elif slow:
            if not fit.noise.process.all():
                raise NumericalFailure("slow measurement noise is all the noise that there is")
        else:
            strict = fit_by_filter(
                fit.model, data, x=fit.x, noise=fit.noise.without_process(), estimate_process=False,
                substeps=fit.substeps,
            )  # fmt: skip
            fit = fit if process_noise_needed(fit, strict) else strict
        found = _estimate(observation, support, fit, data, *noise_uncertainty(fit, data))
        if likelihood is not None and found.noise_rate.any():
            found = replace(found, constant_noise=likelihood.constant[0])
    shares = stability(parts, lambda triangle: [problem_of(triangle)], support, generator=generator)
    shares = np.append(np.ones(len(observation.definitions)), shares)
    average = model_average([problem], support, library)
    if observation.slow_force:  # in the unit of the estimate
        of_state = library.terms.index(library.symbols[0])
        average[0][of_state, 1] /= found.slow_force
        average[1][:, of_state, 1] /= found.slow_force
    return replace(found, alternatives=average, stability=shares)


def _with_time_of(fit: Fit, observation: ObservationModel, data: Measurements) -> ObservationModel:
    """The observation with the correlation time of slow measurement noise that a fit found.

    What wanders without ever returning lasts as long as all that was recorded.
    """
    longest = float(data.step.sum())
    return replace(observation, sensor_time=1 / max(float(np.exp(fit.model.values[-1])), 1 / longest))


def _of_slow_noise(
    observation: ObservationModel, data: Measurements
) -> list[tuple[ObservationModel, np.ndarray, np.ndarray, Noise]]:
    """Observation, coefficients ``(p,)``, states and noise to begin with, for some correlation times.

    The likelihood has a maximum where a slow force is white noise, and others. To begin with it moves the
    state as much within its correlation time as the white noise does; one that follows the state may have no
    noise at all, and is a fading mean of the past. Slow measurement noise moves what is measured at most as
    much as the state does, and has a share of its variance.
    """
    moved, step = moved_by(data)
    rate, x = moved[0] / step, observation.states(data)
    longest = len(data.t) / len(data.labels) * len(np.unique(parent_recordings(data.labels))) * LONGEST_FORCE
    shortest = SHORTEST_FORCE if observation.slow_force else SHORTEST_NOISE
    count = max(int(np.log2(max(longest / shortest, 1.0)) / 2) + 1, 1)
    found = []
    for time in shortest * step * 4.0 ** np.arange(count):
        values, view = np.zeros(len(observation.everything)), observation
        if observation.slow_force:
            values[-1], process = -1 / time, np.array([rate, rate / time**2])
            if observation.follows:
                found.append((view, values, x, Noise(SENSOR_BEGIN * moved, process * [1, 0])))
        else:
            added = min(rate / 2, 2 * SLOW_SHARE * float(data.outputs.var()) / time)
            view, process = replace(observation, sensor_time=time), np.array([rate - added, added])
        found.append((view, values, x, Noise(SENSOR_BEGIN * moved, process)))
    return found


def _fit_library(
    model: Dynamics, data: Measurements, x: np.ndarray, noise: Noise, *, rounds: int = LIBRARY_ROUNDS
) -> Fit:
    fit = fit_by_filter(model, data, x=x, noise=noise, iterations=rounds, closure=False)
    if fit.fault:
        raise NumericalFailure(f"the likelihood of the recordings cannot be worked out: {fit.fault}")
    return fit


def _estimate(
    observation: ObservationModel, support: np.ndarray, fit: Fit, data: Measurements,
    sensor_error: np.ndarray, process_error: np.ndarray, covariance: np.ndarray,
    joint: np.ndarray | None = None,
) -> FieldEstimate:  # fmt: skip
    """The estimate of a fit whose noise has known errors; see `noise_uncertainty`."""
    library, diffusion, d = observation.library, observation.diffusion, observation.library.dimension
    intensity, sensor = fit.noise.intensity, fit.noise.measurement
    rate = (intensity[0] if len(intensity) == 1 else intensity[data.begins].mean(axis=0))[:d, :d]
    moved, step = moved_by(data)
    strength, evidence, driven = 0.0, None, slice(observation.hidden_states, d)
    values, known = fit.model.values[: len(support)], observation.definitions
    whole, held = np.zeros((len(known) + len(support),) * 2), np.ones(len(known))
    whole[len(known) :, len(known) :] = covariance[: len(support), : len(support)]
    slow_sensor = None
    if observation.sensor_time is not None:
        time = observation.sensor_time
        size, spread = np.sqrt(intensity[0][-1, -1] * time / 2), np.sqrt(covariance[-1, -1])
        slow_sensor = (float(size), time, time * (min(float(spread), 1.0) if spread else 1.0))
    if observation.hidden:
        # The part of D that acts on velocities has the determinant 1.
        force, matrix = rate[driven, driven], np.zeros((d, d))
        strength = float(np.exp(np.linalg.slogdet(force)[1] / len(force))) if force.any() else 0.0
        matrix[driven, driven] = (force + force.T) / 2 / strength if force.any() else np.eye(len(force))
        diffusion = Diffusion(matrix)
        # What is not foreseen from a sample to the next: twice the sensor's noise, and what noise makes of v.
        here, there = np.split(np.diag(rate), 2)
        ratio = float(np.sqrt(((2 * sensor + here * step + there * step**3 / 3) / moved).mean()))
    else:
        strength = diffusion.intensity(rate) if diffusion.constant else 0.0
        ratio = float(np.sqrt(((np.diag(rate) * step + 2 * sensor) / positive(moved)).mean()))
        without = replace(fit.noise, measurement=sensor * NO_SENSOR_NOISE)
        factors = 1 + np.linspace(0, 2, 21) * sensor.max() / max(rate.max() * step, 1e-300)
        likelihood = partial(fit.linearisation.log_likelihood, data.first, data.step)
        base = max(likelihood(without.scaled(factor)) for factor in factors)
        evidence = 2 * (likelihood(fit.noise) - base)
    if observation.slow_force and joint is not None:
        # Its unit is such that noise moves it as it moves the state: D is known then, and the size of the
        # force a coefficient. Without noise of its own, such that it follows the state.
        on_state, on_force = np.diag(rate)
        size = float(np.sqrt(on_force / on_state)) if on_force else -float(values[-1])
        follows = (support[:, 0] == 1) & (support[:, 1] != support[-1, 1])
        values, held = np.where(follows, values / size, values), np.array([size])
        slopes = np.zeros((len(whole), len(joint)))
        slopes[1:, :-2] = np.diag(np.where(follows, 1 / size, 1.0))
        if on_force:
            slopes[:, -1] = np.append(size, np.where(follows, -values, 0.0)) / 2
            slopes[:, -2] = -slopes[:, -1]
        whole = slopes @ joint @ slopes.T
        rate = np.diag([on_state, on_state if on_force else 0.0])
        diffusion = Diffusion(np.diag([1.0, float(on_force > 0)]))
        strength, driven = float(on_state), slice(0, 1)
    correlation, score = _strongest_correlation(fit, data)
    error = strength * float(np.sqrt((process_error[driven] ** 2).sum())) / len(process_error[driven])
    deviation = np.sqrt(sensor)
    unit = diffusion.matrix if observation.hidden else np.eye(d)
    diagnosis = NoiseDiagnosis(
        "process" if rate.any() else "sensor", strength, rate / strength if strength else unit, correlation,
        score, deviation, deviation * sensor_error / 2, exposure=observation.exposure,
        thinned=observation.thinned, intensity_error=error if np.isfinite(error) else None,
        slow_sensor=slow_sensor, sensor_evidence=evidence, sensor_law=observation.sensor_law,
    )  # fmt: skip
    if diagnosis.correlated:
        diagnosis = replace(diagnosis, kind="coloured")
    return FieldEstimate.on_support(
        library, np.concatenate([known, support]), np.append(held, values), whole,
        rate, ratio, FlowMap(fit.substeps), diffusion, diagnosis=diagnosis,
    )  # fmt: skip


def _with_formula(
    observation: ObservationModel, support: np.ndarray, fit: Fit, data: Measurements, *,
    false_terms: float, probability: float,
) -> FieldEstimate:  # fmt: skip
    """The estimate of a fit whose process noise depends on the state, once f and D know of each other."""
    symbols = observation.library.symbols
    for _ in range(DIFFUSION_ROUNDS):
        likelihood = InnovationLikelihood(observation.library, fit, data)
        formula, sensor, covariance = likelihood.selected(false_terms=false_terms, probability=probability)
        noise = observation.noise(Noise(sensor, np.ones(len(symbols)), field=formula.diffusion(1.0)))
        fit = observation.fitted(
            support, fit.model.values, data, noise=noise, x=fit.linearised_at, estimate_process=False,
            estimate_sensor=False, substeps=fit.substeps,
        )  # fmt: skip
    of_sensor, of_process = np.sqrt(np.diag(covariance)[len(formula.values) :]), np.zeros(len(symbols))
    added = likelihood.parameter_covariance(formula, sensor, covariance, fit)
    found = _estimate(observation, support, fit, data, of_sensor, of_process, fit.covariance + added)
    states = fit.linearised_at[:, : len(symbols)]
    slopes, found = formula.strength_slopes(states), found.with_formula(formula, states)
    assert found.diagnosis is not None
    intensity = found.intensity
    error = intensity * float(np.sqrt(slopes @ formula.covariance @ slopes))
    return replace(found, diagnosis=replace(found.diagnosis, intensity=intensity, intensity_error=error))


def _strongest_correlation(fit: Fit, data: Measurements) -> tuple[float, float]:
    """Strongest correlation of near innovations over outputs and lags, and in standard errors.

    Initial states are as good as unknown to the filter: fitted ones, of many short recordings, would make
    innovations depend on each other.
    """
    unknown = np.diag(UNKNOWN_STATE**2 * positive(fit.linearised_at.var(axis=0)))
    white = fit.linearisation.filtered(data.first, data.step, fit.noise, begin_covariance=unknown)[0]
    measured = ~np.isnan(fit.linearisation.residual).all(axis=1)
    innovations, recording = white[measured][:, :, 0], data.recording[measured]
    found: list[tuple[float, float]] = []
    for lag in LAGS:
        rows = np.flatnonzero(recording[lag:] == recording[:-lag])
        found += zip(*correlations_between(innovations[rows], innovations[rows + lag]), strict=True)
    correlation, score = max(found, key=lambda one: abs(one[1]))
    return float(correlation), float(score)


def held_out_innovations(
    found: FieldEstimate, training: Recordings, unseen: Recordings, *, pair_step: float | None = None
) -> tuple[float, float]:
    """Whether an f by likelihood holds for recordings that it was not fitted to, by the innovations.

    Its terms are fitted to the training recordings again. Probability of the unseen innovations having no
    part left that any function of the library explains, see `unexplained_probability`; and the ratio of their
    mean square to that of the training recordings.
    """
    observation = ObservationModel.of(found)
    support, values = observation.unknown(found)
    own, other = (observation.measured(each, pair_step) for each in (training, unseen))
    begin = observation.states(own, values)
    fit = observation.fitted(support, values, own, noise=observation.noise_of(found), x=begin)
    follow = observation.followed(other, fit.model, noise=fit.noise, substeps=fit.substeps)
    everything = observation.everything
    values = np.zeros(len(everything))
    values[[everything.tolist().index(one) for one in support.tolist()]] = fit.model.values[: len(support)]
    if observation.sensor_time is not None:
        observation = _with_time_of(fit, observation, own)
    whole = observation.model(everything, values)
    along = linearise(whole, Grid(other, fit.substeps), whole.values, follow.linearised_at)
    # The innovations are those of the filter itself; the library's columns are along the same states.
    white = whiten(replace(along, gap=follow.linearisation.gap), other, follow.noise)
    if white.degrees_of_freedom <= white.columns.shape[1]:
        return 1.0, 1.0
    rest, freedom = white.innovations, white.degrees_of_freedom
    probability = unexplained_probability(
        white.columns, rest[:, None], freedom=freedom, inflation=1 + freedom / fit.degrees_of_freedom
    )
    return probability, float(rest @ rest) / freedom / (fit.sum_of_squares / fit.degrees_of_freedom)


def of_all_states(
    recordings: Recordings, found: FieldEstimate, *, pair_step: float | None = None
) -> Recordings:
    """The recordings, with the velocities of an estimate that were not recorded among their states."""
    return filtered_recordings(found, recordings, pair_step=pair_step) if found.hidden_states else recordings


def filtered_recordings(
    found: FieldEstimate, recordings: Recordings, *, pair_step: float | None = None
) -> Recordings:
    """The states as a filter knows them at each sample that it uses, from that and the earlier ones.

    Velocities that were not measured are among them. Their increments have the mean of f, as those of the
    states do; those of the measured values do not.
    """
    observation = ObservationModel.of(found)
    count = observation.library.dimension - observation.hidden_states
    runs, every = runs_of(recordings, longest=pair_step), observation.every(recordings)
    if found.flow.by_density:  # of each run the first value is all that is known of its state
        runs = [run for run in runs if run.stop - run.start > 1]
    rows = np.concatenate([np.arange(run.start, run.stop, every) for run in runs])
    if found.flow.by_density:
        later, states = np.isin(rows, [run.start for run in runs], invert=True), recordings.values[rows]
        states[later, 0] = Transitions(found, snapshot_pairs(recordings, pair_step=pair_step)).states()
    else:
        data = observation.measured(recordings, pair_step)
        model, noise = observation.model(*observation.unknown(found)), observation.noise_of(found)
        follow = observation.followed(data, model, noise=noise, substeps=found.flow.steps)
        states = follow.linearised_at[~np.isnan(data.outputs).all(axis=1)]
    seen = replace(
        recordings, recording=recordings.recording[rows], t=recordings.t[rows],
        values=states[:, :count].copy(),
    )  # fmt: skip
    if not observation.hidden:
        return seen

    def bracketed(unit: str) -> str:
        return unit if unit.replace("²", "").isalnum() else f"({unit})"

    time = bracketed(seen.time_unit or "1")
    per_time = [None if unit is None else f"{bracketed(unit)}/{time}" for unit in seen.units]
    per_time = list(seen.units) if observation.slow_force else per_time
    headings = (*seen.titles, *found.library.states[count:]) if seen.headings else ()
    units = (*seen.units, *per_time)
    return replace(seen, names=found.library.states, units=units, headings=headings, values=states)
