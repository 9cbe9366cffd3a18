"""Identification through a noisy sensor: f by the likelihood of a Kalman filter.

All functions of a library are fitted first. Along that fit everything is linear: the innovations are a
regression problem like any other (`siq.inference.selection`), all equations at once since a filter couples
them. What is chosen is fitted again, and terms leave as long as one is not significant after all.

The noise of a sensor is in both samples of a pair, and a regression of one on the other is biased by it. What
is not biased is the likelihood of whole recordings under f, random forces and sensor noise together
(`siq.estimation`). All functions of a library are fitted so; the terms are chosen by what they add to the
likelihood, and fitted again.

A value that was written to three decimals is off by up to half of the last one, evenly: a noise of the
measurement whose strength is known. It enters X0 as well as Xh, and biases the regression by an amount that
follows from it. Where that is well below the standard errors it does no harm, and they contain what rounding
adds to the scatter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.special

from siq.data.correlation import decimals_of, resolution_step, rounding_error
from siq.data.recordings import Recordings, SnapshotPairs, parent_recordings
from siq.errors import NumericalFailure
from siq.inference.field_estimate import NOISE_FREE, FlowMap, IdentifiedField
from siq.inference.flow_regression import positive, with_formula
from siq.inference.identification import FieldRecord
from siq.inference.kalman_filter import Grid, Noise, Whitened, linearise, solve, whiten
from siq.inference.library import CandidateLibrary
from siq.inference.maximum_likelihood import Fit, fit_by_filter
from siq.inference.measurements import Measurements
from siq.inference.noise import log_likelihood
from siq.inference.observation import View, kept_rows, noise_of, settled
from siq.inference.recalibration import NoiseUncertainty, noise_uncertainty, process_noise_needed
from siq.inference.selection import (
    Equation,
    RivalTerms,
    best_support,
    blocks_of,
    critical_values,
    rivals_of_all,
    stability,
    triangles,
    weakest_term,
)
from siq.inference.state_dependent_diffusion import FilteredNoise, formula_noise, left_open, noise_by_state
from siq.systems.diffusion import Diffusion
from siq.systems.formulas import compile_formulas

LAGS = (1, 2, 3)  # steps over which innovations are compared: what remembers at all remembers so long


@dataclass(frozen=True)
class FilteredTerms:
    """The regression problem of a filter's innovations.

    Attributes
    ----------
    view
        How samples show the states.
    data
        The measurements.
    parts
        Triangles of blocks of the recordings, of which `equations` is the whole.
    equations
        In units of the innovations' errors.
    """

    view: View
    data: Measurements
    parts: tuple[np.ndarray, ...]
    equations: Equation

    @classmethod
    def along(cls, view: View, data: Measurements, whole: Fit, critical: np.ndarray) -> FilteredTerms:
        """That of a fit of all functions; `critical` says how significant each has to be, ``(p,)``."""
        white = whiten(whole.linearisation, data, whole.noise)
        goal = white.innovations + white.columns @ (whole.model.values - _last_change(whole, white))
        # Whitened values stand one behind the other, all outputs of a sample together.
        outputs = data.outputs.shape[1]
        blocks = blocks_of(parent_recordings(data.labels)[data.recording])
        parts = triangles(white.columns, goal, np.repeat(blocks, outputs))
        triangle = np.asarray(np.linalg.qr(np.concatenate(parts), mode="r"))
        return cls(view, data, parts, Equation(triangle[:, :-1], triangle[:, -1], 1.0, critical))

    def chosen(self) -> list[int]:
        """Places of the terms that the innovations ask for, among `View.everything`."""
        return list(best_support(self.equations))

    def settled(self, chosen: list[int], noise: Noise, *, x: np.ndarray) -> tuple[Fit, np.ndarray, list[int]]:
        """The fit of chosen terms, of which all are significant, with component and term of each.

        Raises
        ------
        NumericalFailure
            When it does not settle.
        """
        support = self.view.everything[chosen]
        while True:
            # Where functions are nearly alike, those that stay take over what the others did: all begin anew.
            values = self.equations.fitted(chosen)[chosen]
            fit = settled(self.view, support, self.data, noise, values=values, x=x)
            strength = np.abs(fit.model.values) / fit.standard_errors / self.equations.critical[chosen]
            weak = weakest_term(strength, support)
            if weak is None:
                return fit, support, chosen
            support, chosen = np.delete(support, weak, axis=0), np.delete(chosen, weak).tolist()
            noise, x = fit.noise, fit.linearised_at

    def stability(self, chosen: list[int], *, generator: np.random.Generator) -> np.ndarray:
        """The share of resampled recordings in which each chosen term would be chosen, shape ``(p,)``."""
        (shares,) = stability(
            self.parts,
            lambda drawn: [Equation(drawn[:, :-1], drawn[:, -1], 1.0, self.equations.critical)],
            [chosen],
            generator=generator,
        )
        return shares

    def rivals(self, chosen: list[int]) -> RivalTerms:
        """What other terms that do nearly as well make of f."""
        support, d = self.view.everything[chosen], self.view.library.dimension
        known = int(self.view.everything[0, 0])  # equations that hold by definition come first
        own = rivals_of_all(self.equations, support - [known, 0], dimension=d - known)
        return RivalTerms(
            np.pad(own.mean_change, ((0, 0), (known, 0))),
            np.pad(own.spread, ((0, 0), (0, 0), (known, 0))),
        )


def _last_change(fit: Fit, white: Whitened) -> np.ndarray:
    """What the estimates are beyond the values at which a fit was linearised."""
    change = solve(white.columns, white.innovations)[0]
    return change if fit.converged else 0 * change


def neighbours(white: Whitened, data: Measurements) -> tuple[float, float]:
    """Strongest correlation of near innovations over outputs and lags, and in standard errors."""
    measured = white.known.reshape(len(data.t), -1).any(axis=1)
    innovations, recording = white.innovations.reshape(len(data.t), -1)[measured], data.recording[measured]
    found: list[tuple[float, float, float]] = []
    for lag in LAGS:
        rows = np.flatnonzero(recording[lag:] == recording[:-lag])
        first, second = innovations[rows], innovations[rows + lag]
        product = first * second
        size = np.sqrt((first**2).mean(axis=0) * (second**2).mean(axis=0))
        scores = product.sum(axis=0) / np.sqrt((product**2).sum(axis=0))
        found += zip(np.abs(scores), product.mean(axis=0) / size, scores, strict=True)
    _, correlation, score = max(found)
    return float(correlation), float(score)


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
        Draws recordings again, see `siq.inference.selection`.
    pair_step
        Longest time between samples that still belong together.
    exposure
        The time over which each sample is a mean (`siq.inference.observation`), None where it is none.

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
    view = View(one.found.library, one.found.diffusion, one.exposure)
    return evidence(view, one.found, one.sensor, training, unseen, pair_step=pair_step)


def evidence(
    view: View,
    found: IdentifiedField,
    sensor: np.ndarray,
    training: Recordings,
    unseen: Recordings,
    *,
    pair_step: float | None = None,
) -> tuple[float, float]:
    """The same of any view: f, and the variance of each sensor, as they were found of both parts."""
    noise = view.noise(noise_of(found, sensor))
    support, values = view.unknown(found)
    own = view.measured(training, pair_step)
    x = view.states(own)
    fit = settled(view, support, own, noise, values=values, x=x)
    other = view.measured(unseen, pair_step)
    still = tuple(replace(each, fixed=True) for each in fit.model.parameters)
    follow = fit_by_filter(
        replace(fit.model, parameters=still), other, x=view.states(other), noise=fit.noise,
        estimate_process=False, estimate_sensor=False, substeps=fit.substeps,
    )  # fmt: skip
    everything = view.everything
    values = np.zeros(len(everything))
    values[[everything.tolist().index(one) for one in support.tolist()]] = fit.model.values
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


def of_all_states(recordings: Recordings, record: FieldRecord, *, pair_step: float | None) -> Recordings:
    """The recordings, with the velocities of an identified f that were not recorded among their states."""
    if not record.hidden_velocities:
        return recordings
    sensor = np.array(record.noise["measurement"]) ** 2
    return filtered_recordings(record.found, sensor, recordings, pair_step=pair_step)


def filtered_recordings(
    found: IdentifiedField,
    sensor: np.ndarray,
    recordings: Recordings,
    *,
    pair_step: float | None = None,
    exposure: float | None = None,
) -> Recordings:
    """The states as a filter knows them at each sample that it uses, from that and the earlier ones.

    Velocities that nobody measured are among them (`siq.inference.observation`). Their increments have the
    mean of f, as those of the states do; those of the measured values do not.

    Parameters
    ----------
    found
        f and the random forces.
    sensor
        Variance of each state's sensor noise, shape ``(d,)``.
    recordings, pair_step, exposure
        As for `identify_by_likelihood`.
    """
    view = View(found.library, found.diffusion, exposure, hidden=len(sensor) < found.library.dimension)
    data = view.measured(recordings, pair_step)
    model = view.model(*view.unknown(found))
    still = replace(model, parameters=tuple(replace(each, fixed=True) for each in model.parameters))
    follow = fit_by_filter(
        still, data, x=view.states(data), noise=view.noise(noise_of(found, sensor)),
        estimate_process=False, estimate_sensor=False, substeps=found.flow.steps,
    )  # fmt: skip
    rows = np.concatenate(kept_rows(recordings, pair_step=pair_step, every=view.every(recordings)))
    measured = ~np.isnan(data.outputs).all(axis=1)
    seen = replace(
        recordings,
        recording=recordings.recording[rows],
        t=recordings.t[rows],
        values=follow.linearised_at[measured, : len(sensor)].copy(),
    )
    if not view.hidden:
        return seen
    per_time = [None if unit is None else _per(unit, seen.time_unit or "1") for unit in seen.units]
    return replace(
        seen,
        names=found.library.states,
        units=(*seen.units, *per_time),
        headings=(*seen.titles, *found.library.states[len(sensor) :]) if seen.headings else (),
        values=follow.linearised_at.copy(),
    )


def _per(unit: str, time: str) -> str:
    """The unit of a velocity; what is no single symbol stands in brackets."""
    one, other = (each if each.replace("²", "").isalnum() else f"({each})" for each in (unit, time))
    return f"{one}/{other}"


HARMLESS = 0.5  # of a standard error: with such a bias an error bar holds 0.95 - 0.02 of the time
LIKE_ROUNDING = (
    0.3,
    1.5,
)  # measured noise over that of rounding; less where steps are as small as the rounding
COARSE = 0.05  # of the rms step of a state: rounding to less than that stops no identification


def rounding_errors(recordings: Recordings) -> np.ndarray:
    """Standard deviation of what rounding did to each state, 0 where none is recognised: shape ``(d,)``."""
    steps = [resolution_step(values) for values in recordings.values.T]
    return np.array([0.0 if step is None else rounding_error(step) for step in steps])


def is_rounding(measured: np.ndarray, rounding: np.ndarray, *, correlation: float) -> bool:
    """Whether the noise of a measurement is that of rounding, and no other.

    Parameters
    ----------
    measured
        Shape ``(d,)``: standard deviations of the noise that the residuals show.
    rounding
        Shape ``(d,)``: of rounding.
    correlation
        Of neighbouring residuals: -1/2 where nothing but the measurement is noisy.
    """
    low, high = LIKE_ROUNDING
    own = rounding > 0
    known = (measured <= high * rounding) & ((measured >= low * rounding) | (rounding < rounding.max()))
    return bool(
        own.any() and known[own].all() and (measured[~own] <= rounding.max()).all() and correlation < -0.3
    )


def rounding_bias(found: IdentifiedField, pairs: SnapshotPairs, rounding: np.ndarray) -> float:
    """The largest bias that rounding brings into a coefficient of f, in its standard errors.

    The error e of X0 stands in the velocity as ``-e/h``, and in a function θ as ``e ∂θ/∂x``: their product
    does not average out. To first order the coefficients of an equation are off by
    ``-(Σ h θθᵀ)⁻¹ Σ ∂θ/∂x R``, R the variance of the rounding.
    """
    errors = np.sqrt(np.diag(found.covariance))
    largest = 0.0
    for state in range(found.library.dimension):
        own = found.support[:, 0] == state
        terms = [found.library.terms[k] for k in found.support[own, 1]]
        symbol = found.library.symbols[state]
        x = np.ascontiguousarray(pairs.x0.T)
        values = compile_formulas(terms, found.library.symbols)(x)
        slopes = compile_formulas([term.diff(symbol) for term in terms], found.library.symbols)(x)
        scale = np.sqrt((values**2 * pairs.h).sum(axis=1))
        scaled = values / scale[:, None]
        bias = (
            np.linalg.lstsq((scaled * pairs.h) @ scaled.T, slopes.sum(axis=1) / scale, rcond=None)[0] / scale
        )
        largest = max(largest, float((np.abs(bias) * rounding[state] ** 2 / errors[own]).max()))
    return largest


def rounding_text(recordings: Recordings, *, coarse: bool = False) -> str | None:
    """How the recordings were written and what error that means, in words; None where no rounding is seen.

    Parameters
    ----------
    recordings
        Trajectories.
    coarse
        Whether only rounding counts that is not small beside the steps from sample to sample.
    """
    alike: dict[tuple[float, str | None], list[str]] = {}
    for name, unit, values in zip(recordings.titles, recordings.units, recordings.values.T, strict=True):
        step = resolution_step(values)
        if step is None:
            continue
        if coarse and rounding_error(step) < COARSE * np.sqrt(np.mean(np.diff(values) ** 2)):
            continue
        alike.setdefault((step, unit), []).append(f"'{name}'")
    said = [_written(names, step, unit) for (step, unit), names in alike.items()]
    return ", and ".join(said) or None


def _written(names: list[str], step: float, unit: str | None) -> str:
    decimals, behind = decimals_of(step), f" {unit}" if unit else ""
    how = (
        f"to {decimals} decimal{'s' if decimals > 1 else ''}"
        if decimals
        else f"in steps of {step:.3g}{behind}"
    )
    error = f"{rounding_error(step):.1g}{behind}"
    if len(names) == 1:
        return f"{names[0]} is written {how}, an error of {error} in each value"
    return f"{', '.join(names[:-1])} and {names[-1]} are written {how}, an error of {error} in each value"


def decimals_needed(recordings: Recordings, pairs: SnapshotPairs) -> int:
    """How many decimals leave rounding below everything else: that of a recording without noise."""
    moves = np.sqrt(((pairs.xh - pairs.x0) ** 2).mean(axis=0))
    step = NOISE_FREE * np.sqrt(6.0) * float(moves[moves > 0].min(initial=1.0))
    return max(int(np.ceil(-np.log10(step))), 1)
