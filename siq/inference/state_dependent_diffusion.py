"""Is the noise stronger here than there, and by which formula, where the sensor is noisy as well?

Residuals of pairs would show the noise of the sensor with that of the forces, and at states that are off by
it. The likelihood of a filter tells them apart: what forces add to the covariance of the state over an
interval is ``εD(x) = Σ_k S_k φ_k(x)``, averaged over what the filter knows of x there, and the innovations
have the variance that follows. Their scores say whether a constant D can be held; the formula is the one of
the largest likelihood, the sensors' variances along with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.special
import sympy

from siq.errors import NumericalFailure
from siq.inference.diffusion_model import HARMLESS, all_places, noise_functions, selected_noise
from siq.inference.field_estimate import NoiseFormula
from siq.inference.filter_kernels import noise_scores
from siq.inference.flow_regression import positive
from siq.inference.kalman_filter import Noise, solve, whiten, with_parameters_changed
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.systems.diffusion import Diffusion
from siq.systems.formulas import compile_formulas

STEPS, HALVINGS = 60, 30  # numerical, as in `siq.inference.diffusion_model`
SETTLED = 1e-9  # numerical: gain of the log-likelihood, per value, with which scoring ends


@dataclass(frozen=True)
class FormulaField:
    """εD(x) as a filter meets it: the mean over an interval, and over what is known of the state.

    Attributes
    ----------
    noise
        εD, of the first d states of the model.
    """

    noise: Diffusion

    def over(self, x: np.ndarray, spread: np.ndarray, step: np.ndarray) -> np.ndarray:
        """See `siq.inference.kalman_filter.NoiseField`; zero for states that no forces drive."""
        d = self.noise.dimension
        matrices = self.noise.at(x[:, :d])
        wide = _widened(spread[:, :d, :d], matrices, step)
        bends = self.noise.derivatives(x[:, :d], 2)
        matrices = matrices + np.einsum("nijkl,nkl->nij", bends, wide) / 2
        # On its way a fit may come where the formula is no covariance.
        levels, vectors = np.linalg.eigh(matrices)
        whole = np.zeros((len(x), x.shape[1], x.shape[1]))
        whole[:, :d, :d] = np.einsum("nik,nk,njk->nij", vectors, np.maximum(levels, 0.0), vectors)
        return whole


def formula_noise(formula: NoiseFormula, sensor: np.ndarray) -> Noise:
    """Both noises of a filter, the random forces by a formula of the state."""
    d = len(formula.symbols)
    return Noise(sensor, np.ones(d), field=FormulaField(formula.diffusion(1.0)))


def _widened(spread: np.ndarray, intensity: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Covariance of the state in the middle of an interval: forces of half of it are added."""
    return np.asarray(spread + intensity * step[:, None, None] / 2)


@dataclass(frozen=True)
class _Reached:
    """The likelihood of all innovations with its derivatives."""

    logarithm: float
    score: np.ndarray
    information: np.ndarray
    squares: np.ndarray


@dataclass(frozen=True)
class NoiseEstimate:
    """The noise beside a sensor, with errors.

    Attributes
    ----------
    formula
        εD(x).
    sensor
        Variance of each output's noise, shape ``(m,)``.
    covariance
        Of the coefficients of the formula and the logarithms of these variances, ``(p + m, p + m)``; zero
        for a sensor that is known.
    """

    formula: NoiseFormula
    sensor: np.ndarray
    covariance: np.ndarray


class FilteredNoise:
    """Innovations of a fit as the likelihood of a formula of the noise.

    See `siq.inference.diffusion_model.NoiseLikelihood`, which this is.

    Parameters
    ----------
    symbols
        The d states that forces may drive, the first ones of the model.
    fit
        Of f, whose trajectories and coefficients stay as they are.
    data
        What it was fitted to.
    """

    def __init__(self, symbols: tuple[sympy.Symbol, ...], fit: Fit, data: Measurements) -> None:
        self.symbols, self.terms = symbols, noise_functions(symbols)
        white = whiten(fit.linearisation, data, fit.noise)
        still = with_parameters_changed(fit.linearisation, solve(white.columns, white.innovations)[0])
        d, rows, x = len(symbols), data.begins, fit.linearised_at
        step = np.append(np.diff(data.t), 0.0)
        middle = x[:, :d].copy()
        middle[rows] += (x[rows + 1, :d] + still.gap[rows, :d] - x[rows, :d]) / 2
        intensity = np.broadcast_to(fit.noise.intensity, (len(x), *fit.noise.intensity.shape[1:]))[:, :d, :d]
        spread = np.zeros_like(intensity) if fit.spread is None else fit.spread[:, :d, :d]
        wide = _widened(spread, intensity, step)
        second = [term.diff(one, other) for term in self.terms for one in symbols for other in symbols]
        components = np.ascontiguousarray(middle.T)
        bends = compile_formulas(second, symbols)(components).reshape(len(self.terms), d, d, -1)
        plain = compile_formulas(self.terms, symbols)
        self.functions = np.ascontiguousarray(
            (plain(components) + np.einsum("kijn,nij->kn", bends, wide) / 2).T
        )
        self._at_states = plain(np.ascontiguousarray(x[:, :d].T)).T
        self._rows, self._still, self._data, self._step = rows, still, data, step
        self._begin = np.diag(x.var(axis=0))
        self.start = intensity[rows].mean(axis=0)
        self.sensor = fit.noise.measurement
        known = np.zeros(len(self.sensor), dtype=bool)
        self._free = ~(known if data.sensor_noise is None else np.isfinite(data.sensor_noise))

    @cached_property
    def size(self) -> np.ndarray:
        """Rms of each function, shape ``(q,)``."""
        return positive(np.sqrt((self.functions[self._rows] ** 2).mean(axis=0)))

    def matrices(self, chosen: np.ndarray, values: np.ndarray, functions: np.ndarray) -> np.ndarray:
        """ΕD where functions have the given values ``(n, q)``: shape ``(n, d, d)``."""
        d = len(self.symbols)
        found = np.zeros((len(functions), d, d))
        for (i, j, k), value in zip(chosen, values, strict=True):
            found[:, i, j] += value * functions[:, k]
            if i != j:
                found[:, j, i] += value * functions[:, k]
        return found

    def positive(self, chosen: np.ndarray, values: np.ndarray) -> bool:
        """Whether D is positive definite on every interval, and at every state that the filter knows."""
        try:
            for functions in (self.functions[self._rows], self._at_states):
                np.linalg.cholesky(self.matrices(chosen, values, functions))
        except np.linalg.LinAlgError:
            return False
        return True

    def least_squares(self, chosen: np.ndarray) -> np.ndarray:
        """Where no constant part is left there is no start.

        Raises
        ------
        NumericalFailure
            Always.
        """
        raise NumericalFailure(
            "the noise depends on the state, and no formula of low degree for it is positive at all recorded"
            " states; give D as 'recordings.diffusion', in numbers or formulas"
        )

    def scored(self, chosen: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `siq.inference.diffusion_model.NoiseLikelihood`."""
        values, _, covariance = self.together(chosen, values)
        return values, covariance[: len(values), : len(values)]

    def together(self, chosen: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coefficients and sensors of the largest likelihood by Fisher's scoring, and their covariance.

        The covariance is the one that holds whatever the law of the innovations, as in
        `siq.inference.diffusion_model`.
        """
        p, sensor = len(values), self.sensor
        free = np.concatenate([np.ones(p, dtype=bool), self._free])
        now = self._reached(chosen, values, sensor)
        for _ in range(STEPS):
            step = np.zeros(len(free))
            step[free] = _solved(now.information[np.ix_(free, free)], now.score[free])
            gain = 0.0
            for _ in range(HALVINGS):
                attempt = values + step[:p], sensor * np.exp(step[p:])
                if self.positive(chosen, attempt[0]):
                    then = self._reached(chosen, *attempt)
                    if then.logarithm > now.logarithm:
                        gain = then.logarithm - now.logarithm
                        (values, sensor), now = attempt, then
                        break
                step = step / 2
            if gain < SETTLED * len(self.functions):
                break
        covariance = np.zeros((len(free), len(free)))
        inverse = _inverse(now.information[np.ix_(free, free)])
        covariance[np.ix_(free, free)] = inverse @ now.squares[np.ix_(free, free)] @ inverse
        return values, sensor, covariance

    @cached_property
    def constant(self) -> NoiseEstimate:
        """εD that is the same everywhere."""
        places = all_places(len(self.symbols), 1)
        values = np.array([self.start[i, j] for i, j, _ in places])
        values, sensor, covariance = self.together(places, values)
        formula = NoiseFormula(
            self.symbols, places[:, :2], (self.terms[0],) * len(places), values,
            covariance[: len(values), : len(values)], 1.0,
        )  # fmt: skip
        return NoiseEstimate(formula, sensor, covariance)

    def constant_probability(self) -> float:
        """Probability that innovations under a constant D speak as much for one that depends on the state.

        1 where the change that they speak for is harmless.

        Notes
        -----
        Rao's test: the score of all coefficients where the likelihood of a constant D and of the sensors is
        largest, less what follows of it from theirs. It is the likelihood ratio test to the first order, and
        needs no normal law.
        """
        places = all_places(len(self.symbols), len(self.terms))
        constant = places[:, 2] == 0
        sensor, values = self.constant.sensor, np.zeros(len(places))
        values[constant] = self.constant.formula.values
        now = self._reached(places, values, sensor)
        free = np.concatenate([np.ones(len(places), dtype=bool), self._free])
        null = np.concatenate([constant, np.ones(len(sensor), dtype=bool)])
        held, asked = np.flatnonzero(null & free), np.flatnonzero(~null & free)
        if not len(asked):
            return 1.0
        information = now.information
        share = information[np.ix_(asked, held)] @ _inverse(information[np.ix_(held, held)])
        turn = np.zeros((len(asked), len(null)))
        turn[np.arange(len(asked)), asked] = 1.0
        turn[:, held] = -share
        score, squares = turn @ now.score, turn @ now.squares @ turn.T
        left = information[np.ix_(asked, asked)] - share @ information[np.ix_(held, asked)]
        change = np.zeros(len(places))
        change[asked] = _solved(left, score)
        if self._relative_change(places, change) < HARMLESS:
            return 1.0
        statistic = float(score @ _solved(squares, score))
        return float(scipy.special.chdtrc(np.linalg.matrix_rank(_scaled(squares)), statistic))

    def noise_of(self, formula: NoiseFormula, change: np.ndarray, sensor: np.ndarray) -> Noise:
        """The noise along the trajectories for a formula whose coefficients are changed, shape ``(p,)``."""
        d, whole = len(self.symbols), len(self._begin)
        shape = np.zeros((len(self.functions), whole, whole))
        shape[:, :d, :d] = self.matrices(self.places_of(formula), formula.values + change, self.functions)
        return Noise(sensor, np.ones(whole), shape)

    def places_of(self, formula: NoiseFormula) -> np.ndarray:
        """Row, column and function of each of its coefficients, shape ``(p, 3)``."""
        return np.column_stack([formula.places, [self.terms.index(term) for term in formula.terms]])

    def _relative_change(self, places: np.ndarray, change: np.ndarray) -> float:
        """Rms change of any entry of D over the states, in units of the constant D."""
        functions = self.functions[self._rows]
        changed = self.matrices(places, change, functions - functions.mean(axis=0))
        size = np.sqrt(np.diag(self.start))
        return float(np.sqrt((changed**2).mean(axis=0) / np.outer(size, size) ** 2).max())

    def _reached(self, chosen: np.ndarray, values: np.ndarray, sensor: np.ndarray) -> _Reached:
        still = self._still
        return _Reached(
            *noise_scores(
                self._data.first, still.transition, still.gap, still.measured, still.residual, self._step,
                sensor, self._begin, self.functions, chosen, values,
            )
        )  # fmt: skip


def left_open(seen: FilteredNoise, own: NoiseEstimate, fit: Fit, data: Measurements) -> np.ndarray:
    """What the errors of a noise leave open in the coefficients of f: their further covariance, ``(p, p)``.

    Parameters
    ----------
    seen, own
        The noise, and the likelihood that it is of.
    fit, data
        Of f.
    """
    count = len(own.formula.values)
    levels, axes = np.linalg.eigh(own.covariance)
    total = np.zeros_like(fit.covariance)
    for axis in (axes * np.sqrt(np.maximum(levels, 0.0))).T:
        ends = []
        for change in (axis, -axis):
            noise = seen.noise_of(own.formula, change[:count], own.sensor * np.exp(change[count:]))
            white = whiten(fit.linearisation, data, noise)
            ends.append(solve(white.columns, white.innovations)[0])
        total += np.outer(ends[0] - ends[1], ends[0] - ends[1]) / 4
    return total


def noise_by_state(likelihood: FilteredNoise, *, false_terms: float, probability: float) -> NoiseEstimate:
    """The formula of εD of the terms that differ from zero, with the sensors' variances beside it.

    Parameters
    ----------
    likelihood
        Along the trajectories of a fit.
    false_terms, probability
        As for `siq.inference.diffusion_model.selected_noise`, which also says what it raises.
    """
    formula = selected_noise(likelihood, false_terms=false_terms, probability=probability)
    _, sensor, covariance = likelihood.together(likelihood.places_of(formula), formula.values)
    return NoiseEstimate(formula, sensor, covariance)


def _scaled(matrix: np.ndarray) -> np.ndarray:
    size = positive(np.sqrt(np.diag(matrix)))
    return np.asarray(matrix / np.outer(size, size))


def _inverse(matrix: np.ndarray) -> np.ndarray:
    size = positive(np.sqrt(np.diag(matrix)))
    return np.asarray(np.linalg.pinv(_scaled(matrix), hermitian=True) / np.outer(size, size))


def _solved(matrix: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.asarray(_inverse(matrix) @ target)
