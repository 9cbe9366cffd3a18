"""Recalibration: parameters with and without process noise, and those of readings that were rounded.

A filter that took a sensor for noisier than it is follows the recordings less, and takes f at other states:
the coefficients of f depend on the noise, and the noise is an estimate. Forty samples seldom prove process
noise, and a fit without it has errors that are right only if there is none. What the recordings do not rule
out belongs to the errors: they are averaged over all strengths of the process noise, each with its
likelihood, and so is how the parameters would change.

*Quantisation.* Where the steps of a sensor are wide compared with its noise, rounding errors are
autocorrelated and look like process noise, or like physics that is missing. The steps are known: the recorded
values lie on them. Of a reading that was rounded it is known that the value lay within its step, and a
simulation says where: at the mean of a normal distribution that is cut off at the edges of the step. About
the right simulation the residuals to these values are independent of each other (the generalised residuals of
Gourieroux, Monfort, Renault and Trognon, Journal of Econometrics 34, 5, 1987), and the fit to them is that of
highest likelihood of the readings (Dempster, Laird and Rubin's EM algorithm).

*Stationarity.* Process noise drives a system alike whether it moves or rests. What a simulation lacks of a
hidden part - a second oscillator, a memory - can pass for process noise, too, where recordings are noisy; but
such forces fade with the motion that excites them. The likelihood tells the two apart.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import scipy.special

from siq.data.correlation import resolution_step
from siq.errors import NumericalFailure
from siq.inference.budget import COMPILATION, Budget, evaluation
from siq.inference.kalman_filter import Grid, Noise, profile_likelihood, whiten
from siq.inference.maximum_likelihood import Fit, first_noise, fit_by_multiple_shooting
from siq.inference.measurements import Measurements, first_states, with_expectations, with_variation
from siq.inference.trajectories import EDGE_SUBSTEPS, fit_trajectories, run, sharpened, spread_edges
from siq.numerics.randomness import positive
from siq.systems.dynamics import Dynamics

LOGGER = logging.getLogger(__name__)
FEWEST_VARYING = 5  # recordings, as clusters of errors need: the spread of fewer is hardly known
DECADES = 14  # of strengths that are looked through, downwards from noise that would make all of the motion
POINTS = 16  # of the average
UNLIKELY = 8.0  # logarithm of a likelihood, relative to the largest, that adds nothing to an average
THRESHOLD = 1e-4  # probability by chance, below which process noise is believed
FAINT = 1e-4  # process noise, relative to the motion, from which a fit without any is loosened
# Mean square of errors in units of the sensors' noise. Errors twice as large cost a log-likelihood of 0.7 for
# each value, which is not credible.
MISSED = 4.0
FOLLOWING_SHARES = (0.5, 0.9, 0.99)  # of the forces that follow the motion
NOISE_RATIOS = (1 / 8, 1 / 4, 1 / 2, 1 / 1.4, 1.0, 1.4, 2.0, 4.0, 8.0)  # of process noise, to that of the fit
QUANTISATION_ROUNDS = 30  # of fits to values before they were rounded, at most
NOISE_SETTLED = 0.01  # relative change of the noise, at which these have settled
SINGULAR = 1e-9  # numerical: of the largest eigenvalue of a correlation
BETTER = 0.5  # of a log-likelihood: what half a parameter gains by chance, below which two fits are one


def covariance_with_unknown_process_noise(
    fit: Fit, data: Measurements, *, budget: Budget | None = None
) -> np.ndarray:
    """Covariance of the free parameters of a fit, shape ``(p, p)``, whatever the strength of process noise.

    The strength is one factor on the process noise of the fit; on such as would make the motion of each state
    where it has none. Beforehand every standard deviation of them is as probable (Gelman 2006, Bayesian
    Analysis 1, 515); the scale of all noise and the parameters are integrated out as linear. A fit without
    process noise is made once more with that of the average, since its trajectories may be far from those
    that process noise made.
    """
    if not len(fit.model.free) or not np.isfinite(fit.covariance).all():
        return fit.covariance
    if fit.has_process_noise:
        return _average(fit, data, fit.noise.process, budget)[0]
    rows = data.begins
    process = np.mean((fit.x[rows + 1] - fit.x[rows]) ** 2 / data.step[rows, None], axis=0)
    process = np.where(fit.model.kinematic, 0.0, process)
    if not (process > 0).any():
        return fit.covariance
    covariance, size = _average(fit, data, process, budget)
    forced = fit_by_multiple_shooting(
        fit.model, data, x=fit.x, noise=Noise(fit.noise.measurement, process * size**2),
        estimate_process=False, substeps=fit.substeps, budget=budget,
    )  # fmt: skip
    if not forced.converged or not forced.has_process_noise:
        return covariance
    apart = (forced.model.values - fit.model.values)[np.array(fit.model.free, dtype=int)]
    return _average(forced, data, forced.noise.process, budget)[0] + np.outer(apart, apart)


def _average(
    fit: Fit, data: Measurements, process: np.ndarray, budget: Budget | None
) -> tuple[np.ndarray, float]:
    """Covariance averaged over factors on the standard deviation of a noise; and the mean of that factor."""
    known, units = bool(data.known_sensors.all()), positive(np.sqrt(np.diag(fit.covariance)))

    def at(size: float) -> tuple[float, np.ndarray, np.ndarray]:
        """Log-likelihood, change and covariance of the parameters for a factor."""
        if budget is not None:
            budget.charge(evaluation(fit.model, data))
        noise = Noise(fit.noise.measurement, process * size**2, fit.noise.shape)
        try:
            white = whiten(fit.linearisation, data, noise)
            change, covariance = white.solve()
        except (NumericalFailure, np.linalg.LinAlgError):
            return -np.inf, np.zeros(len(units)), fit.covariance
        left = white.innovations - white.columns @ change
        total, freedom = float(left @ left), white.degrees_of_freedom - len(change)
        covariance = covariance if known else covariance * (total / freedom)
        sign, volume = np.linalg.slogdet(covariance / np.outer(units, units))
        profile = profile_likelihood(total, freedom, white.log_determinant)
        value = -0.5 * (total + white.log_determinant) if known else profile
        return value + (0.5 * volume if sign > 0 else 0.0), change, covariance

    # Of noise that is estimated the strength is about one, and of other noise anywhere below.
    sizes = np.concatenate([[0.0], 10.0 ** (np.arange(-DECADES, 5) / 2)])
    coarse = np.array([at(size)[0] for size in sizes])
    if not np.isfinite(coarse).any():
        return fit.covariance, 0.0
    likely = np.flatnonzero(coarse > coarse.max() - UNLIKELY)
    lowest, highest = sizes[max(likely[0] - 1, 0)], sizes[min(likely[-1] + 1, len(sizes) - 1)]
    sizes = np.linspace(lowest, highest, POINTS)
    values, changes, covariances = zip(*map(at, sizes), strict=True)
    if not np.isfinite(values).any():
        return fit.covariance, 0.0
    weights = np.exp(np.array(values) - max(values))
    weights /= weights.sum()
    covariance = np.zeros_like(fit.covariance)
    for weight, change, own in zip(weights, changes, covariances, strict=True):
        covariance += weight * (own + np.outer(change, change))
    return covariance, float(weights @ sizes)


def most_varying(
    model: Dynamics, data: Measurements, recalibrated: Fit, *, budget: Budget, least: float = 0.0
) -> str | None:
    """The free parameter that tells most by differing from recording to recording, if it does.

    Linearly about the recalibrated fit it promises most. Fitted, it has to gain more than deviations that are
    not there do on average, and at `least` so much in twice the log-likelihood. Of fewer than
    `FEWEST_VARYING` recordings no spread of a parameter can be known. The errors of that fit are raised.
    """
    count, known = len(data.labels), recalibrated.model.parameters
    names = {each.name for each in model.parameters if each.value and not each.fixed}
    if not names or count < FEWEST_VARYING:
        return None
    white, left = whiten(recalibrated.linearisation, data, recalibrated.noise), {}
    owner = white.recording[:, None] == np.arange(count)
    for place, at in enumerate(recalibrated.model.free):
        if (name := known[at].name) in names:
            own = np.column_stack([np.delete(white.columns, place, 1), white.columns[:, [place]] * owner])
            change = np.linalg.lstsq(own, white.innovations, rcond=None)[0]
            left[name] = float(((white.innovations - own @ change) ** 2).sum())
    found = min(left, key=left.__getitem__)
    varied, varying, _ = with_variation(model, (found,), data, data)
    fit, _ = recalibrate(with_expectations(varied), varying, budget=budget)
    gain = 2 * (fit.log_likelihood - recalibrated.log_likelihood)
    LOGGER.info("%s differs from recording to recording: chi2 better by %.1f", found, gain)
    return found if gain > max(count, least) else None


def fit_with_process_noise_as_needed(
    model: Dynamics, data: Measurements, begin: Fit, *, budget: Budget | None = None, **options: Any
) -> Fit:
    """Of the fits of `fit_with_and_without_process_noise` the simpler, unless the data speak against it.

    A jump that is spread too far leaves errors which process noise stands in for. Before that is believed the
    jumps of the fit without them are followed more finely.
    """
    loose, strict = fit_with_and_without_process_noise(
        model, data, begin, budget=budget, hopeless=MISSED, **options
    )
    chosen = _simpler_fit(loose, strict)
    coarse = strict.converged and strict.model.edges
    if loose is None or chosen is strict or not coarse or _missed_without(loose, data) > MISSED:
        return chosen
    return _simpler_fit(loose, sharpened(strict, data, goal=loose.log_likelihood, budget=budget))


def _simpler_fit(loose: Fit | None, strict: Fit) -> Fit:
    """The fit without process noise, unless the data speak against it."""
    return strict if loose is None or not process_noise_needed(loose, strict) else loose


def fit_with_and_without_process_noise(
    model: Dynamics, data: Measurements, begin: Fit, *, level: float = 1.0, x: np.ndarray | None = None,
    settled: bool = False, hopeless: float = np.inf, budget: Budget | None = None,
) -> tuple[Fit | None, Fit]:  # fmt: skip
    """Fit with process noise estimated, where that was begun with, and without.

    Parameters
    ----------
    model, data
        With the parameters' values to begin with.
    begin
        A fit whose states and noise are begun with.
    level
        Factor on its process noise.
    x
        States, where the model has more of them.
    settled
        Whether `begin` is itself the fit of the model with process noise, and need not be made again.
    hopeless
        Mean square of errors, in units of the sensors' noise, beyond which trajectories are not followed step
        by step to where they end: errors that linear equations along the fit with process noise foresee.

    Raises
    ------
    BudgetSpent
        When nothing is left of what is allowed.
    """
    if budget is not None:
        budget.charge(COMPILATION)
    states, substeps = begin.x if x is None else x, begin.substeps
    model = spread_edges(model, data, states, substeps=max(substeps, EDGE_SUBSTEPS))
    substeps = max(substeps, EDGE_SUBSTEPS) if model.edges else substeps
    noise = begin.noise.of_states(model.dimension)
    same: dict[str, Any] = {"substeps": substeps, "budget": budget}
    loose: Fit | None = None
    if settled and not model.edges:
        loose = begin
    elif noise.process.any():
        driven = noise.scaled(max(level, 1e-6))
        loose = fit_by_multiple_shooting(model, data, x=states, noise=driven, estimate_process=True, **same)

    def at_all_samples() -> Fit:
        of = loose if loose is not None and loose.converged else None
        at, still = (states, noise) if of is None else (of.x, of.noise)
        return fit_by_multiple_shooting(
            model if of is None else of.model, data, x=at, noise=still.without_process(),
            estimate_process=False, **same,
        )  # fmt: skip

    def as_trajectories() -> Fit:
        # Where process noise led to nothing better, it led away.
        better = loose is not None and (loose.converged or loose.log_likelihood > begin.log_likelihood)
        of = loose if better else None
        at, still = (states, noise) if of is None else (of.x, of.noise)
        return fit_trajectories(
            model if of is None else of.model, data, begin=at[data.first[:-1]], noise=still, **same
        )

    finite = np.isfinite(hopeless)  # otherwise nothing is worked out
    far = finite and loose is not None and _missed_without(loose, data) > hopeless
    # Where f jumps, steps of all samples at once go to and fro.
    ways = (as_trajectories, at_all_samples) if model.edges and not far else (at_all_samples, as_trajectories)
    strict = ways[0]()
    if not (strict.converged or far):
        strict = preferred_fit(strict, ways[1]())
    return loose, _with_insignificant_dropped(loose, strict, data)


def _missed_without(loose: Fit, data: Measurements) -> float:
    """Mean square of the errors that a fit would have without its process noise, if all were linear."""
    if not loose.has_process_noise:
        return 0.0
    try:
        white = whiten(loose.linearisation, data, loose.noise.without_process())
        left = white.innovations - white.columns @ white.solve()[0]
    except (NumericalFailure, np.linalg.LinAlgError):
        return 0.0
    return float(left @ left) / max(white.degrees_of_freedom - white.columns.shape[1], 1)


def _with_insignificant_dropped(loose: Fit | None, strict: Fit, data: Measurements) -> Fit:
    """Of a fit without process noise, and one whose process noise does nothing in it, the better one."""
    idle = drop_insignificant_process_noise(loose, data) if loose is not None and loose.converged else None
    return strict if idle is None else preferred_fit(idle, strict)


def drop_insignificant_process_noise(fit: Fit, data: Measurements) -> Fit | None:
    """A fit without its process noise, where that does nothing in it; None where it does something.

    Their intensities may have gone towards zero. The fit without them has then been found already, and may be
    likelier than the one that another way of fitting ends in. If it is far likelier, that is no maximum.
    """
    still = fit.noise.without_process()
    held = fit.linearisation.with_parameters_changed(np.zeros(len(fit.model.free)))
    with_them, alone = (held.log_likelihood(data.first, data.step, noise) for noise in (fit.noise, still))
    if not 2 * abs(with_them - alone) <= least_to_believe(fit.noise):
        return None
    return replace(fit, noise=still, log_likelihood=fit.log_likelihood - (with_them - alone))


def preferred_fit(one: Fit, other: Fit) -> Fit:
    """The one that settled, and of two that did not the likelier."""
    if one.converged != other.converged:
        return one if one.converged else other
    return one if one.log_likelihood > other.log_likelihood else other


def process_noise_needed(loose: Fit, strict: Fit) -> bool:
    """Whether the likelihood ratio speaks for process noise; its null distribution has half its mass at 0."""
    if not strict.converged:
        return True
    return 2 * (loose.log_likelihood - strict.log_likelihood) > least_to_believe(loose.noise)


def least_to_believe(noise: Noise) -> float:
    """Twice the increase of the log-likelihood from which on process noise is believed."""
    driven = int((noise.process > 0).sum())
    return float(scipy.special.chdtri(driven, 2 * THRESHOLD)) if driven else np.inf


def recalibrate(model: Dynamics, data: Measurements, *, budget: Budget | None = None) -> tuple[Fit, Fit]:
    """Fit the simulation's own parameters: with process noise where the data ask for it, and without.

    The likelihood has more than one maximum where a state is hidden. A fit begins twice, along states that
    follow the recordings and along the card's own simulation, and the likelier end counts.

    Raises
    ------
    NumericalFailure
        When neither fit can be made.
    """
    x = first_states(model, data)
    model = spread_edges(model, data, x, substeps=1)
    noise, fitted = first_noise(model, data, x), partial(fit_by_multiple_shooting, data=data, budget=budget)
    loose = fitted(model, x=x, noise=noise, estimate_process=True)
    # Without process noise, beginning along the simulation as the card has it.
    begin, substeps = x[data.first[:-1]], max(loose.substeps, 1)
    followed = run(model, Grid(data, substeps), begin)
    x = np.where(np.isfinite(followed), followed, x)
    own = fitted(model, x=x, noise=noise.without_process(), estimate_process=False)
    if not own.converged:
        # Steps at all samples at once may lead anywhere, from where a search could explain nothing. Damped
        # steps of whole trajectories never make a fit worse than the card's own simulation is.
        damped = fit_trajectories(model, data, begin=begin, noise=noise, substeps=substeps, budget=budget)
        own = preferred_fit(own, damped)
    known: Fit | None = None
    if loose.converged:
        known, strict = fit_with_and_without_process_noise(
            loose.model, data, loose, settled=True, budget=budget
        )
        if not (own.converged and own.log_likelihood > strict.log_likelihood + BETTER):
            return _simpler_fit(known, strict), strict
    # Where process noise on a hidden state could explain anything, the fit has no end, or one far off. The
    # card's own simulation is then the better start.
    strict = own
    if not strict.converged:
        if not np.isfinite(loose.sum_of_squares):
            raise NumericalFailure(strict.fault or loose.fault)
        return loose, strict
    small = Noise(strict.noise.measurement, noise.process * FAINT)
    again = fitted(strict.model, x=strict.x, noise=small, estimate_process=True, substeps=strict.substeps)
    strict = _with_insignificant_dropped(again, strict, data)
    loosened = [each for each in (known, again) if each is not None and each.converged]
    return _simpler_fit(max(loosened, key=lambda each: each.log_likelihood, default=None), strict), strict


def fit_before_rounding(
    data: Measurements, strict: Fit, *, budget: Budget | None = None
) -> tuple[Fit, Measurements, tuple[str, ...]] | None:
    """The fit to readings before a sensor rounded them, where no process noise is needed any more.

    Parameters
    ----------
    data
        The readings.
    strict
        The fit of the simulation to them without process noise.

    Returns
    -------
    (Fit, Measurements, tuple of str) or None
        The fit, the values before rounding, and the names of the outputs that are rounded; None where no
        output has steps wider than its noise, or the fit still needs process noise.
    """
    steps = np.array([resolution_step(each) or 0.0 for each in data.outputs.T])
    # What rounding does under noise half as wide as a step is white (Widrow and Kollár 2008), and fitted.
    coarse = steps > np.sqrt(strict.noise.measurement)
    if not (strict.converged and coarse.any()):
        return None
    values, fit, deviation = data, strict, np.sqrt(strict.noise.measurement)
    for _ in range(QUANTISATION_ROUNDS):
        before = deviation
        signals = Grid(values, fit.substeps).at_samples(fit.model.lags(fit.model.values))
        simulated = fit.model.functions.outputs(np.ascontiguousarray(fit.x.T), signals, fit.model.values).T
        values, deviation = _before_rounding(data, simulated, steps, before)
        fit = fit_by_multiple_shooting(
            fit.model, values, x=fit.x, noise=fit.noise, estimate_process=False, substeps=fit.substeps,
            budget=budget,
        )  # fmt: skip
        if not fit.converged:
            return None
        if (np.abs(deviation - before) < NOISE_SETTLED * before).all():
            break
    faint = Noise(fit.noise.measurement, FAINT * first_noise(fit.model, values, fit.x).process)
    forced = fit_by_multiple_shooting(
        fit.model, values, x=fit.x, noise=faint, estimate_process=True, substeps=fit.substeps, budget=budget
    )
    if forced.converged and process_noise_needed(forced, fit):
        return None
    return fit, values, tuple(np.array(fit.model.output_names)[coarse].tolist())


def _before_rounding(
    data: Measurements, simulation: np.ndarray, steps: np.ndarray, deviation: np.ndarray
) -> tuple[Measurements, np.ndarray]:
    """Recordings before they were rounded, as far as a simulation tells, and the deviation of their noise."""
    from scipy.stats import truncnorm  # takes half a second to import, and only rounded values need it

    outputs, wide = data.outputs.copy(), deviation.copy()
    for place in np.flatnonzero(steps > 0):
        off = (data.outputs[:, place] - simulation[:, place]) / deviation[place]
        half = steps[place] / 2 / deviation[place]
        known = np.isfinite(off)
        mean, variance = truncnorm.stats(off[known] - half, off[known] + half, moments="mv")
        outputs[known, place] = simulation[known, place] + deviation[place] * mean
        wide[place] = deviation[place] * np.sqrt(np.mean(mean**2 + variance))
    return replace(data, outputs=outputs), wide


def noise_nonstationarity(fit: Fit, data: Measurements) -> float:
    """How much better process noise fits that follows the motion than stationary noise does, in χ².

    Both have their intensities at their best; of forces that follow the motion at least half are in
    proportion to the square of its size.
    """
    motion = (((fit.x - fit.x.mean(axis=0)) / positive(fit.x.std(axis=0))) ** 2).mean(axis=1)
    following = motion / motion.mean()

    def likelihood(weight: np.ndarray) -> float:
        """With both kinds of noise at their best; the weight is of the process noise at every sample."""
        noises = (Noise(fit.noise.measurement, ratio * fit.noise.process) for ratio in NOISE_RATIOS)
        sums = (fit.linearisation.sums(data.first, weight * data.step, noise) for noise in noises)
        return max(profile_likelihood(total, freedom, logarithm) for total, logarithm, freedom in sums)

    steady = likelihood(np.ones(len(motion)))
    return 2 * (max(likelihood(1 - share + share * following) for share in FOLLOWING_SHARES) - steady)


def wald_probability(differences: np.ndarray, covariance: np.ndarray) -> float:
    """Probability that differences ``(p,)`` with a covariance are as large by chance (Wald's test).

    Only directions that the covariance tells count; it is 1 where there are none.
    """
    if not len(differences):
        return 1.0
    scale = np.sqrt(np.diag(covariance))
    scale = np.where(scale > 0, scale, np.inf)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > SINGULAR * values[-1]
    along = vectors[:, kept].T @ (differences / scale) / np.sqrt(values[kept])
    return float(scipy.special.chdtrc(int(kept.sum()), float(along @ along)))
