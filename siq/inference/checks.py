"""Checks of an estimated f: noise of its residuals, rounding, prediction, test on held-out recordings.

Process noise is white: the residuals of neighbouring pairs are independent, and their variance grows with the
time between samples. Measurement noise is shared by the two pairs that a sample belongs to, which makes their
residuals anticorrelated; it enters X0 as well, and biases every regression on X0. A value that was written to
three decimals is off by up to half of the last one, evenly: a measurement noise of known strength. Where the
bias that follows from it is well below the standard errors it does no harm, and they contain what rounding
adds to the scatter.

What f leaves of recordings that it was not fitted to has no mean that any function of the library explains,

    ``F = (‖P r‖²/q) / (‖r - P r‖²/(n - q))``,

P being the projection on the q functions, if f misses no term. Without noise recordings are predicted.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Annotated, Any

import numpy as np
import scipy.special
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as pydantic_dataclass

from siq.data.correlation import decimals_of, resolution_step, rounding_error
from siq.data.recordings import Recordings, SnapshotPairs, snapshot_pairs
from siq.inference.diffusion_model import (
    ResidualLikelihood,
    process_noise_increments,
    with_process_noise_rate,
)
from siq.inference.field_estimate import HARMLESS_BIAS, NOISE_FREE, FieldEstimate, NoiseDiagnosis, Verdict
from siq.inference.library import IdentificationOptions
from siq.inference.regression import (
    LaggedPairs,
    identify_vector_field,
    refit,
    residuals,
    weighted_triangle,
    with_noise_formula,
)
from siq.inference.transition_densities import Transitions
from siq.numerics.integration import runge_kutta_step
from siq.numerics.randomness import positive
from siq.remarks import Remark, sentence
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.formulas import compile_formulas

MAX_GAP = 10.0  # steps of a pair: samples farther apart say little of noise
MAX_PAIRS = 60_000  # numerical: their correlations are known to 1/√60000 = 0.004, a fifth of what is harmless
OUTLIER = 20.0  # times the median residual: what an inaccurate f carries far away
ROUNDING_RANGE = 0.3, 1.5  # measured noise over that of rounding; less where steps are as small as that
COARSE_ROUNDING = 0.05  # of the rms step of a state: rounding to less than that stops no identification
STEP_ACCURACY = 0.05  # step times the norm of the Jacobian, per step of the integrator
MAX_STEPS = 5000  # between two samples; what is faster than that between samples is not what was recorded
RUNAWAY_WIDTHS = 1e3  # widths of the recorded states: so far off a prediction has run away
CHANCE_TESTS = (  # of a certificate: those that chance can refuse
    "prediction", "descent", "one_system", "unchanged", "state_complete", "gaussian_increments", "times",
    "record",
)  # fmt: skip
UNPREDICTED = "f does not predict held-out recordings"
FEWEST_FOR_LAW, FALSE_LAW_RATE = 200, 1e-3  # samples that tell a sensor's law; its probability by chance
INSIDE = 0.05, 0.95  # quantiles of what is measured, between which a law of its variance is positive
NEARLY_EVEN = 1e-3  # of steps, that a simulation made all alike: clocks and decimals
UNDECIDED = 2.94  # of a log-likelihood: odds of 19 to 1
SHARED_SAMPLES = 4  # neighbours whose residuals have samples in common with those of one
STATE_BINS = 12  # of each state: any function of it is seen as a value in each


@pydantic_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PredictionLimits:
    """Limits of the test of f."""

    #: Median error of long-term prediction, for recordings without noise
    prediction: Annotated[float, Field(gt=0)] = 0.01
    #: Mean square of the residuals of f on held-out recordings over that on its own, for recordings with
    #: noise. The default, a tenth more, is what a systematic error of √0.1 of the noise adds.
    held_out_ratio: Annotated[float, Field(gt=1)] = 1.1
    #: Probability with which a whole certificate is refused by chance where everything is right. The tests
    #: that chance can refuse share it evenly, see `each`.
    false_alarms: Annotated[float, Field(gt=0, lt=0.5)] = 0.05

    @property
    def each(self) -> float:
        """Probability with which one of `CHANCE_TESTS` refuses what is right (Bonferroni)."""
        return self.false_alarms / len(CHANCE_TESTS)


def residual_noise(
    found: FieldEstimate, recordings: Recordings, *, pair_step: float | None
) -> NoiseDiagnosis:
    """Kind, strength and correlations of the noise in recordings, by the residuals of pairs about f."""
    d, diffusion = found.library.dimension, found.diffusion
    unit = np.eye(d)
    pairs = snapshot_pairs(recordings, pair_step=pair_step)
    if found.noise_free:
        covariance = diffusion.matrix if diffusion.constant else unit
        return NoiseDiagnosis("none", 0.0, covariance, 0.0, 0.0, np.zeros(d))
    if diffusion.constant:
        intensity = diffusion.intensity(found.noise_rate)
        covariance = found.noise_rate / intensity if intensity > 0 else diffusion.matrix
        whole = diffusion.whitening @ covariance @ diffusion.whitening.T
    else:
        forces = _whitened(found, pairs, residuals(found, pairs))
        whole = forces.T @ forces / len(forces)
        intensity = float(np.trace(whole)) / d
        whole = whole / intensity
        if found.noise is not None:  # its own formula says ε without the chance of the residuals
            intensity = found.intensity
        covariance = found.noise_rate / intensity
    sample = snapshot_pairs(recordings, pair_step=MAX_GAP * float(pairs.h.max()))
    if len(sample.h) > MAX_PAIRS:  # whole stretches, so that neighbours stay neighbours
        sample = sample.take(np.arange(MAX_PAIRS))
    correlations, scores = neighbour_correlations(found, sample)
    worst = int(np.argmax(np.abs(scores)))
    correlation, score = float(correlations[worst]), float(scores[worst])
    noise = NoiseDiagnosis("process", intensity, covariance, correlation, score, np.zeros(d))
    if noise.correlated and score > 0:
        noise = replace(noise, kind="coloured")
    elif noise.correlated:
        # From the covariance of neighbouring residuals. Errors of X0 bias f by the inverse of the step, so
        # that f is fitted to the long steps as well. An error of the sample that two pairs share is carried
        # on by the flow of the second.
        again = refit(replace(found, diffusion=Diffusion.identity(d)), sample)
        rest = residuals(again, sample)
        joined = _joined(sample, rest)
        shared = (rest[:-1][joined] * rest[1:][joined]).mean(axis=0)
        rates = np.einsum("nii->ni", again.dynamics.jacobian(sample.x0[1:][joined]))
        carried = np.exp(np.minimum(rates * sample.h[1:][joined, None], 1.0)).mean(axis=0)
        measurement = np.sqrt(np.maximum(-shared / carried, 0.0))
        noise = replace(noise, kind="measurement", measurement=measurement)
        bias = bias_of_rounding(found, pairs, recordings, measurement, correlation=correlation)
        if bias is not None:
            text = rounding_text(recordings)
            remark = Remark("inference.rounding", {"written": text})
            # How many decimals leave rounding below everything else: that of a recording without noise.
            moves = np.sqrt(((pairs.xh - pairs.x0) ** 2).mean(axis=0))
            step = NOISE_FREE * np.sqrt(6.0) * float(moves[moves > 0].min(initial=1.0))
            return replace(
                noise, kind="rounding", intensity=0.0, rounding=text, rounding_bias=bias,
                decimals=max(int(np.ceil(-np.log10(step))), 1),
                remarks=(remark,) if bias <= HARMLESS_BIAS else (),
            )  # fmt: skip
    return noise.with_deviation(whole, len(pairs.h))


def neighbour_correlations(found: FieldEstimate, sample: SnapshotPairs) -> tuple[np.ndarray, np.ndarray]:
    """Correlation of neighbouring residuals, state by state, and in standard errors.

    Negative where the sensor is noisy, since the sample in the middle is the later one of the first pair and
    the earlier one of the second.
    """
    rest = residuals(found, sample)
    if not found.diffusion.constant:
        rest = _whitened(found, sample, rest)
    joined = _joined(sample, rest)
    if not joined.any():  # every recording has two samples
        return np.zeros(rest.shape[1]), np.zeros(rest.shape[1])
    return correlations_between(rest[:-1][joined], rest[1:][joined])


def correlations_between(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Correlations of two residuals ``(n, d)`` without a mean, and in standard errors: ``(d,)`` each."""
    product = first * second
    size = np.sqrt((first**2).mean(axis=0) * (second**2).mean(axis=0))
    return product.mean(axis=0) / size, product.sum(axis=0) / np.sqrt((product**2).sum(axis=0))


def sensor_law(found: FieldEstimate, sample: SnapshotPairs) -> np.ndarray | None:
    """How the variance of each sensor's noise depends on what it shows; None where it does not.

    Of counts it grows with them, of a gain that is noisy with their square. Residuals r of f about the sample
    y_k in the middle share its noise, so that ``E[-r_k r_{k+1}] = F'(y_k) E[R(y_k)]``, whatever process noise
    does. R is a quadratic of y_k, or linear, by instrumental variables: the samples before and behind these
    residuals, whose noise is none of theirs (Reiersøl 1945). Chance is allowed for by covariances of as many
    neighbours as have samples in common (Newey and West 1987).

    Returns
    -------
    numpy.ndarray or None
        Coefficients of 1, y and y² in units of the mean variance, shape ``(m, 3)``.
    """
    rest = residuals(replace(found, flow=replace(found.flow, by_density=False)), sample)
    joined = _joined(sample, rest)
    at = np.flatnonzero(joined[:-2] & joined[1:-1] & joined[2:]) + 1  # the first of two residuals
    laws = np.tile([1.0, 0.0, 0.0], (rest.shape[1], 1))
    rates = np.einsum("nii->ni", found.dynamics.jacobian(sample.x0[at + 1])) * sample.h[at + 1, None]
    shared = -rest[at] * rest[at + 1] / np.exp(np.minimum(rates, 1.0))
    for state, one in enumerate(shared.T if len(at) >= FEWEST_FOR_LAW else ()):
        y = sample.xh[:, state]
        middle, width, mean = float(y[at].mean()), float(y[at].std()), float(one.mean())
        if not (width > 0 and mean > 0):
            continue
        scaled, first = (y - middle) / width, (sample.x0[:, state] - middle) / width
        apart, near = (first[at - 1] + scaled[at + 2]) / 2, (first[at] + scaled[at + 1]) / 2
        powers = np.stack([np.ones(len(at)), scaled[at], scaled[at] * near], axis=1)
        for count in (3, 2):
            instruments = apart[:, None] ** np.arange(count)
            inverse = np.linalg.pinv(instruments.T @ powers[:, :count])
            known = inverse @ (instruments.T @ one)
            scores = instruments * (one - powers[:, :count] @ known)[:, None]
            together = scores.T @ scores
            for lag in range(1, SHARED_SAMPLES + 1):
                later = scores[:-lag].T @ scores[lag:]
                together += (1 - lag / (SHARED_SAMPLES + 1)) * (later + later.T)
            error = float(np.sqrt(inverse[-1] @ together @ inverse[-1]))
            if abs(known[-1]) > -scipy.special.ndtri(FALSE_LAW_RATE / 4) * error:
                line = np.polynomial.Polynomial([-middle / width, 1 / width])
                law = np.polynomial.Polynomial(known / mean)(line)
                if (law(np.quantile(y[at], np.linspace(*INSIDE, STATE_BINS))) > 0).all():
                    laws[state] = np.append(law.coef, np.zeros(3 - count))
                break
    return laws if laws[:, 1:].any() else None


def _whitened(found: FieldEstimate, pairs: SnapshotPairs, rest: np.ndarray) -> np.ndarray:
    """Residuals as noise ``σ(x)⁻¹ r/√h``, of the variance ε everywhere: shape ``(n, d)``."""
    forces = process_noise_increments(found, pairs, rest)
    return np.asarray((found.diffusion.whitening_at(found.on_the_way(pairs)) @ forces[:, :, None])[:, :, 0])


def _joined(sample: SnapshotPairs, rest: np.ndarray) -> np.ndarray:
    """Which pairs share a sample with the next, without the few that an inaccurate f carries far away."""
    usual = (np.abs(rest) < OUTLIER * np.median(np.abs(rest), axis=0)).all(axis=1)
    same = (sample.recording[1:] == sample.recording[:-1]) & (sample.xh[:-1] == sample.x0[1:]).all(axis=1)
    return np.asarray(same & usual[1:] & usual[:-1])


def simulation_step(
    found: FieldEstimate, by_state: FieldEstimate | None, pairs: SnapshotPairs, *,
    options: IdentificationOptions,
) -> tuple[float, float] | None:  # fmt: skip
    """The step of the Euler–Maruyama simulation that made pairs, and how probable a constant D is without it.

    A step of Euler's rule forgets nothing of its noise: read as continuous in time, a constant D looks weaker
    where f spreads states than where f gathers them. If it is refuted so, and not by the rule, with one step
    or two for each pair, the rule made the record; or if no constant D can be held, and pairs are likelier
    by the rule than `by_state`, the estimate of D(x) in continuous time, at Schwarz's price of parameters.
    """
    h, false_terms = float(np.median(pairs.h)), options.false_terms

    def constant(one: FieldEstimate) -> float:
        return ResidualLikelihood(one, pairs, residuals(one, pairs)).constant_probability()

    # That D depends on the state just as the rule has it would be a second coincidence.
    if np.ptp(pairs.h) > NEARLY_EVEN * h or (probability := constant(found)) > false_terms**2:
        return None
    regress = partial(identify_vector_field, found.library, pairs, options=options)
    fits = [(each, with_process_noise_rate(regress(integrator_step=each), pairs)) for each in (h, h / 2)]
    chance, best = max((constant(one), each) for each, one in fits)
    if by_state is None or chance >= false_terms:
        return (best, probability) if chance >= false_terms else None

    def worth(one: FieldEstimate | None) -> float:
        if one is None or one.noise is None:
            return -np.inf
        return _log_likelihood(one, pairs) - np.log(len(pairs.h)) / 2 * len([*one.values, *one.noise.values])

    by_formula = partial(with_noise_formula, pairs=pairs, false_terms=false_terms)
    most, best = max((worth(by_formula(one)), each) for each, one in fits)
    return (best, probability) if most - worth(by_state) > UNDECIDED else None


def _log_likelihood(found: FieldEstimate, pairs: SnapshotPairs) -> float:
    """Of pairs, by the densities of their ends where they are known, else by normal laws."""
    if found.flow.by_density:
        return Transitions(found, pairs).log_likelihood
    # What puts back what a step forgot is linear, and known by what it makes of the axes.
    axes = np.eye(found.library.dimension)[:, None] * np.ones((len(pairs.h), 1))
    turned = np.stack([process_noise_increments(found, pairs, axis) for axis in axes], axis=2)
    forces = process_noise_increments(found, pairs, residuals(found, pairs))[:, :, None]
    rate = np.broadcast_to(found.noise_rate_at(found.on_the_way(pairs)), turned.shape)
    sizes = np.linalg.slogdet(turned)[1] - np.linalg.slogdet(2 * np.pi * rate)[1] / 2
    return float(sizes.sum() - (forces * np.linalg.solve(rate, forces)).sum() / 2)


def bias_of_rounding(
    found: FieldEstimate, pairs: SnapshotPairs, recordings: Recordings, measured: np.ndarray, *,
    correlation: float,
) -> float | None:  # fmt: skip
    """The largest bias of a coefficient of f where measured noise is that of rounding; None where not.

    The noise is in standard deviations ``(d,)``, and the correlation that of neighbouring residuals: of
    rounding alone it is -1/2 at most.
    """
    rounding = np.array([rounding_error(resolution_step(values) or 0.0) for values in recordings.values.T])
    low, high = ROUNDING_RANGE
    own = rounding > 0
    known = (measured <= high * rounding) & ((measured >= low * rounding) | (rounding < rounding.max()))
    small = known[own].all() and (measured[~own] <= rounding.max()).all()
    return _rounding_bias(found, pairs, rounding) if own.any() and small and correlation < -0.3 else None


def _rounding_bias(found: FieldEstimate, pairs: SnapshotPairs, rounding: np.ndarray) -> float:
    """The largest bias that rounding brings into a coefficient of f, in its standard errors.

    The error e of X0 stands in the velocity as ``-e/h``, and in a function θ as ``e ∂θ/∂x``: their product
    does not average out. To first order the coefficients of an equation are off by
    ``-(Σ h θθᵀ)⁻¹ Σ ∂θ/∂x R``, R the variance of the rounding.
    """
    errors, symbols, largest = np.sqrt(np.diag(found.covariance)), found.library.symbols, []
    x = np.ascontiguousarray(pairs.x0.T)
    for state, symbol in enumerate(symbols):
        own = found.support[:, 0] == state
        terms = [found.library.terms[k] for k in found.support[own, 1]]
        values = compile_formulas(terms, symbols)(x)
        slopes = compile_formulas([term.diff(symbol) for term in terms], symbols)(x)
        scale = np.sqrt((values**2 * pairs.h).sum(axis=1))
        scaled, goal = values / scale[:, None], slopes.sum(axis=1) / scale
        bias = np.linalg.lstsq((scaled * pairs.h) @ scaled.T, goal, rcond=None)[0] / scale
        largest.append((np.abs(bias) * rounding[state] ** 2 / errors[own]).max())
    return float(max(largest))


def rounding_text(recordings: Recordings, *, coarse: bool = False) -> str | None:
    """The rounding of recordings and the error that it means, in words; None where no rounding is seen.

    Where only `coarse` rounding counts, none that is small beside the steps from sample to sample.
    """
    alike: dict[tuple[float, str], dict[str, Any]] = {}
    for name, unit, values in zip(recordings.titles, recordings.units, recordings.values.T, strict=True):
        if (step := resolution_step(values)) is None:
            continue
        error, behind = rounding_error(step), f" {unit}" if unit else ""
        if coarse and error < COARSE_ROUNDING * np.sqrt(np.mean(np.diff(values) ** 2)):
            continue
        new = {"names": [], "step": step, "unit": behind, "decimals": decimals_of(step), "error": error}
        alike.setdefault((step, behind), new)["names"].append(f"'{name}'")
    return sentence(Remark("inference.written", {"steps": list(alike.values())})) if alike else None


def unexplained_probability(
    columns: np.ndarray, rest: np.ndarray, *, freedom: int | None = None,
    variance: np.ndarray | None = None, inflation: float = 1.0,
) -> float:  # fmt: skip
    """Probability of residuals having no part left that columns explain: tiny where f misses a term.

    An F test of the regression of the residuals on the columns, or a χ² test where their variance is known.

    Parameters
    ----------
    columns, rest
        Shapes ``(n, q)`` and ``(n, r)``, of white residuals; the smallest probability of the r counts,
        corrected for their number.
    freedom
        Degrees of freedom of the residuals, n by default.
    variance
        Of each of the r residuals, shape ``(r,)``, where it is known.
    inflation
        By how much more columns explain of residuals that were not fitted: 1 + n/m, where the columns were
        fitted to m others, whose errors these have as well.
    """
    basis = np.linalg.qr(columns / positive(np.linalg.norm(columns, axis=0)))[0]
    explained, count = ((basis.T @ rest) ** 2).sum(axis=0) / inflation, columns.shape[1]
    if variance is not None:
        probability = scipy.special.chdtrc(count, explained / variance)
    else:
        left = (len(rest) if freedom is None else freedom) - count
        with np.errstate(divide="ignore"):  # where columns explain everything
            ratio = (explained / count) / (((rest**2).sum(axis=0) - explained) / left)
        probability = scipy.special.fdtrc(count, left, ratio)
    return float(min(probability.min() * rest.shape[1], 1.0))


def mean_residual_probability(found: FieldEstimate, pairs: SnapshotPairs, *, seen: int = 0) -> float:
    """Probability of the residuals of held-out pairs having no mean left that f's library could express.

    The number of pairs `seen` that f was fitted to counts, if it is known: its own error adds the share
    ``len(pairs.h)/seen`` to what the library explains of their residuals, at most.
    """
    library, inflation = found.library, 1 + (len(pairs.h) / seen if seen else 0.0)
    if isinstance(pairs, LaggedPairs):
        rest = residuals(found, pairs)
        spread = np.diag(found.noise_rate) * float(np.median(pairs.h)) * pairs.copies
        return unexplained_probability(pairs.directions(library), rest, variance=spread, inflation=inflation)
    inflation *= pairs.copies  # copies of resampled recordings are no evidence
    if not found.diffusion.constant and not found.flow.by_density:
        triangle = weighted_triangle(found, pairs, None, of_rest=True)[0]
        freedom = len(pairs.h) * library.dimension
        return unexplained_probability(
            triangle[:, :-1], triangle[:, -1:], freedom=freedom, inflation=inflation
        )
    # By densities there is one state, and residuals are as large as its noise is there.
    deviation = np.sqrt(found.diffusion.at(found.on_the_way(pairs))[:, 0]) if found.flow.by_density else 1.0
    weight = np.sqrt(pairs.h)[:, None]
    columns = library.evaluate(pairs.x0) * weight / deviation
    rest = residuals(found, pairs) / weight / deviation
    return unexplained_probability(columns, rest, inflation=inflation)


def predict(dynamics: Dynamics, recordings: Recordings) -> np.ndarray:
    """Follow f from the first sample of every recording through all its times.

    In the order of ``recordings.values``, shape ``(n, d)``; not finite where the prediction runs away, or f
    is too fast to be followed from sample to sample.
    """
    states, starts = recordings.values, np.flatnonzero(np.diff(recordings.recording, prepend=-1))
    lengths = np.diff(np.append(starts, len(recordings.t)))
    width, center = positive(np.ptp(states, axis=0)), states.mean(axis=0)
    jacobian = dynamics.jacobian(states) * width / width[:, None]
    rate = float(np.quantile(np.linalg.norm(jacobian, axis=(1, 2)), 0.999))
    predicted, x = np.full_like(states, np.nan), states[starts].T.copy()
    predicted[starts] = states[starts]
    with np.errstate(over="ignore", invalid="ignore"):
        for place in range(1, int(lengths.max())):
            near = (np.abs(x - center[:, None]) < RUNAWAY_WIDTHS * width[:, None]).all(axis=0)
            going = (lengths > place) & near
            if not going.any():
                break
            rows = starts[going] + place
            gap = recordings.t[rows] - recordings.t[rows - 1]
            steps = max(int(np.ceil(gap.max() * rate / STEP_ACCURACY)), 1)
            if steps > MAX_STEPS:
                break
            part = np.ascontiguousarray(x[:, going])
            for _ in range(steps):
                part = runge_kutta_step(dynamics.drift_of_components, part, gap / steps)
            x[:, going] = part
            predicted[rows] = part.T
    return predicted


def prediction_errors(dynamics: Dynamics, recordings: Recordings) -> np.ndarray:
    """``E_k = ‖X_predicted(t) - X_k(t)‖ / ‖X_k(t)‖`` of every recording k (paper, Eq. error), shape ``(K,)``.

    The norms are over all samples of a recording and all states. A prediction that runs away has an
    infinite error.
    """
    difference = ((predict(dynamics, recordings) - recordings.values) ** 2).sum(axis=1)
    difference = np.where(np.isfinite(difference), difference, np.inf)
    squares = difference, (recordings.values**2).sum(axis=1)
    total, size = (np.bincount(recordings.recording, one, len(recordings.labels)) for one in squares)
    return np.asarray(np.sqrt(total / size))


def check_prediction(
    *, noise_fault: str | None, limits: PredictionLimits, errors: np.ndarray | None = None,
    mean_probability: float | None = None, held_out_ratio: float = 1.0, held_out_values: float = np.inf,
) -> Verdict:  # fmt: skip
    """Whether f, which every V here is made from, holds for recordings that it was not fitted to.

    Without noise by the median of the errors of long-term prediction. Under noise by the mean square of the
    held-out residuals over that of the others, whose excess is the figure, less what chance makes of so many
    values; and by the probability of their mean: where that refuses, the figure is how many powers of ten it
    lies below 1. A fault of the noise (`NoiseDiagnosis.fault`) refuses before all.
    """
    if noise_fault is not None:
        return Verdict.refused(noise_fault, limits.prediction)
    if errors is not None:
        return Verdict.of(float(np.median(errors)), limits.prediction, UNPREDICTED)
    assert mean_probability is not None
    chance = float(np.exp(-scipy.special.ndtri(limits.each) * np.sqrt(2 / held_out_values)))
    value, limit = max(held_out_ratio / chance - 1, 0.0), limits.held_out_ratio - 1
    rarity, rare = -float(np.log10(max(mean_probability, 1e-300))), -float(np.log10(limits.each))
    if value <= limit and not rarity <= rare:
        reason = (
            "the residuals of f on held-out recordings have a mean, of a probability of"
            f" {mean_probability:.1g}: f misses a term"
        )
        return Verdict(rarity, rare, False, reason)
    return Verdict.of(value, limit, "f fits held-out recordings worse than its own")
