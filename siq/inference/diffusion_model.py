"""Models of the diffusion D(x) by scoring, from residuals of pairs or from the innovations of a filter.

A residual r of f over a step h has the covariance ``h εD(x)``, up to what the step forgets. First it is asked
whether a constant εD can be held, by Rao's test: the score of the coefficients of functions of the state
where the likelihood of a constant D is largest, less what follows of it from the other parameters,

    ``s = ∂ log L/∂S_k,    sᵀ B⁻¹ s ~ χ²``,

where B is the score's own sum of squares, so that no normal law of the residuals is asked for. If it cannot,
the formula ``εD(x) = Σ_k S_k φ_k(x)`` is the one of the largest likelihood, of residuals

    ``-½ Σ_n [log det εD(x_n) + rᵀ(εD(x_n))⁻¹ r/h]``,

which is minus infinity where D is not positive at a recorded state. Its terms are dropped one by one, as long
as one does not differ from zero by its own standard error. Over a step φ changes, too: in its place stands
``φ + h/2 (f·∇φ + ½ tr εD∇²φ)``.

Residuals of pairs would show the noise of a sensor as well. The likelihood of a Kalman filter separates them:
what process noise adds to the covariance of the state over an interval is εD(x), averaged over what the
filter knows of x there. The variances of the sensors are then scored together with the coefficients of D.

Where one state forgets much of itself from sample to sample no law of residuals is known: see
`siq.inference.transition_densities`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import scipy.special
import sympy

from siq.data.recordings import SnapshotPairs, StreamedPairs
from siq.errors import NumericalFailure
from siq.inference.field_estimate import STANDARD_ERRORS, FieldEstimate, NoiseFormula
from siq.inference.kalman_filter import Noise, whiten
from siq.inference.library import CandidateLibrary
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.numerics.randomness import positive
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.formulas import compile_formulas

DEGREE = 2  # of the formulas: the least that can bend, and keep positive where a straight line does not
HARMLESS_CHANGE = 0.02  # relative change of D over the states below which a constant one will do
MAX_STATES = 3  # of which correlations may depend on the state: sixty coefficients
MAX_NUMBERS = 2e7  # numerical: of an array in memory, 160 MB
MIN_RESIDUALS = 20  # for each coefficient of D: fewer do not show the sum of squares of its score
MAX_STEPS, MAX_HALVINGS = 60, 30  # numerical: of Fisher's scoring, each step halved until it gains
SCORING_TOLERANCE = 1e-9  # numerical: gain of the log-likelihood, per residual, with which scoring ends
MAX_RELAXATION = 0.5  # of Jh/2: beyond that a residual hardly knows where its step began
MAX_STEP_RELAXATION = 2.0  # of the rates of J times h: the same of the mean over pairs
MOST_UNKNOWN = 0.5  # of the pairs: where more have no covariance of the noise, the step is too coarse for f
AVERAGED_PAIRS = 500  # the mean of a smooth function of the state, to a few per cent of a small term
SERIES_TERMS = 24  # of the exponential series, which then is exact to ten digits


def _all_places(d: int, functions: int, most: int = MAX_STATES) -> np.ndarray:
    """Row, column and function of every coefficient that εD(x) may have, shape ``(p, 3)``."""
    # Of many states the correlations are constant: their formulas would be most of all coefficients.
    whole = d <= most
    return np.array(
        [(i, j, k) for i in range(d) for j in range(i, d) for k in range(functions if i == j or whole else 1)]
    )


class _DiffusionLikelihood:
    """Likelihood of recordings under ``εD(x) = Σ_k S_k φ_k(x)``, its scoring and tests: base of both kinds.

    A coefficient is a row ``(i, j, k)`` of places: of the entry ``i ≤ j`` of εD, and of the function φ_k. The
    `functions` act over each step, those `at_states` at recorded states, shape ``(n, q)``; `start` is εD
    where it is the same everywhere; `sensor` are the sensors' variances, of which some are free. Of at most
    `most_correlated` states the correlations may depend on the state.
    """

    functions: np.ndarray
    at_states: np.ndarray
    start: np.ndarray
    sensor: np.ndarray
    free: np.ndarray

    most_correlated = MAX_STATES

    def __init__(self, library: CandidateLibrary) -> None:
        self.symbols = library.symbols
        self.terms = [term for _, term in library.functions(library.symbols, DEGREE, library.angles)]

    def reached(
        self, places: np.ndarray, values: np.ndarray, sensor: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """The log-likelihood, its score, Fisher's information, and summed outer products of single scores.

        By coefficients ``(p,)``, then the logarithms of the sensors' variances ``(m,)``.
        """
        raise NotImplementedError

    def least_squares(self, places: np.ndarray) -> np.ndarray:
        """Coefficients to begin with where no constant part makes D positive; zero where none are known."""
        return np.zeros(len(places))

    def relative_change(self, change: np.ndarray) -> np.ndarray:
        """Changes of εD ``(n, d, d)`` in units of its start."""
        size = np.sqrt(np.diag(self.start))
        return change / np.outer(size, size)

    def matrices(self, places: np.ndarray, values: np.ndarray, functions: np.ndarray) -> np.ndarray:
        """εD where functions have the given values ``(n, q)``: shape ``(n, d, d)``."""
        d = len(self.symbols)
        found = np.zeros((len(functions), d, d))
        for (i, j, k), value in zip(places, values, strict=True):
            found[:, i, j] += value * functions[:, k]
            if i != j:
                found[:, j, i] += value * functions[:, k]
        return found

    def positive(self, places: np.ndarray, values: np.ndarray) -> bool:
        """Whether D is positive definite over every step, and at every recorded state."""
        try:
            for functions in (self.functions, self.at_states):
                np.linalg.cholesky(self.matrices(places, values, functions))
        except np.linalg.LinAlgError:
            return False
        return True

    def scored(self, places: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coefficients and sensors of the largest likelihood by Fisher's scoring, and their covariance.

        The covariance is the one that holds whatever the law of the residuals: ``F⁻¹ B F⁻¹`` with the
        information F and the sum of squares B of the score; zero for a sensor that is known.
        """
        p, sensor = len(values), self.sensor
        free = np.concatenate([np.ones(p, dtype=bool), self.free])
        inside = np.ix_(free, free)
        now = self.reached(places, values, sensor)
        for _ in range(MAX_STEPS):
            step, before = np.zeros(len(free)), now[0]
            step[free] = _inverse(now[2][inside]) @ now[1][free]
            for _ in range(MAX_HALVINGS):
                attempt = values + step[:p], sensor * np.exp(step[p:])
                if self.positive(places, attempt[0]):
                    then = self.reached(places, *attempt)
                    if then[0] > before:
                        (values, sensor), now = attempt, then
                        break
                step = step / 2
            if now[0] - before < SCORING_TOLERANCE * len(self.at_states):
                break
        covariance = np.zeros((len(free), len(free)))
        inverse = _inverse(now[2][inside])
        covariance[inside] = inverse @ now[3][inside] @ inverse
        return values, sensor, covariance

    def _formula(
        self, places: np.ndarray, values: np.ndarray, covariance: np.ndarray, p: float
    ) -> NoiseFormula:
        count, terms = len(values), tuple(self.terms[k] for k in places[:, 2])
        return NoiseFormula(self.symbols, places[:, :2], terms, values, covariance[:count, :count], p)

    @cached_property
    def constant(self) -> tuple[NoiseFormula, np.ndarray]:
        """εD that is the same everywhere, and the sensors with it."""
        places = _all_places(len(self.symbols), 1)
        values, sensor, covariance = self.scored(places, np.array([self.start[i, j] for i, j, _ in places]))
        return self._formula(places, values, covariance, 1.0), sensor

    def constant_probability(self) -> float:
        """Probability that recordings with a constant D speak as much for one that depends on the state.

        1 where the change that they speak for is harmless.
        """
        places = _all_places(len(self.symbols), len(self.terms), self.most_correlated)
        constant = places[:, 2] == 0
        formula, sensor = self.constant
        values = np.zeros(len(places))
        values[constant] = formula.values
        _, score, information, squares = self.reached(places, values, sensor)
        free = np.concatenate([np.ones(len(places), dtype=bool), self.free])
        null = np.concatenate([constant, np.ones(len(sensor), dtype=bool)])
        held, asked = np.flatnonzero(null & free), np.flatnonzero(~null & free)
        share = information[np.ix_(asked, held)] @ _inverse(information[np.ix_(held, held)])
        turn = np.zeros((len(asked), len(null)))
        turn[np.arange(len(asked)), asked] = 1.0
        turn[:, held] = -share
        left = information[np.ix_(asked, asked)] - share @ information[np.ix_(held, asked)]
        score, squares = turn @ score, turn @ squares @ turn.T
        change = np.zeros(len(places))
        change[asked] = _inverse(left) @ score
        changed = self.matrices(places, change, self.functions - self.functions.mean(axis=0))
        if np.sqrt((self.relative_change(changed) ** 2).mean(axis=0)).max() < HARMLESS_CHANGE:
            return 1.0
        statistic = float(score @ _inverse(squares) @ score)
        return float(scipy.special.chdtrc(np.linalg.matrix_rank(_scaled(squares)), statistic))

    def selected(
        self, *, false_terms: float, probability: float
    ) -> tuple[NoiseFormula, np.ndarray, np.ndarray]:
        """εD(x) of the largest likelihood, of the terms that differ from zero, together with the sensors.

        Chance brings any term into D with the probability `false_terms`; the other one is that of a
        `NoiseFormula`. The covariance is that of the coefficients and of the logarithms of the sensors'
        variances.

        Raises
        ------
        NumericalFailure
            When no formula of this kind is positive at all recorded states.
        """
        start = self.start
        places = _all_places(len(start), len(self.terms))
        values = np.array([start[i, j] if k == 0 else 0.0 for i, j, k in places])
        critical = float(-scipy.special.ndtri(false_terms / (2 * len(places))))
        while True:
            values, sensor, covariance = self.scored(places, values)
            count = len(values)
            kept, values = self._formula(places, values, covariance, probability).eliminated(critical)
            if len(kept) == count:
                break
            places = places[kept]
            # What is left may not be positive: then the others begin where they are sure to be, if they can.
            if not self.positive(places, values):
                values = np.array([start[i, j] * (i == j) if k == 0 else 0.0 for i, j, k in places])
            if not self.positive(places, values):
                values = self.least_squares(places)
            if not self.positive(places, values):
                raise NumericalFailure(
                    "the noise depends on the state, and no formula of low degree for it is positive at"
                    " all recorded states; give D as 'recordings.diffusion', in numbers or formulas"
                )
        formula = self._formula(places, values, covariance, probability)
        if len(sensor):  # they were left where the search for the terms began
            _, sensor, covariance = self.scored(places, values)
        return formula, sensor, covariance


def _scaled(matrix: np.ndarray) -> np.ndarray:
    size = positive(np.sqrt(np.diag(matrix)))
    return np.asarray(matrix / np.outer(size, size))


def _inverse(matrix: np.ndarray) -> np.ndarray:
    size = positive(np.sqrt(np.diag(matrix)))
    return np.asarray(np.linalg.pinv(_scaled(matrix), hermitian=True) / np.outer(size, size))


class ResidualLikelihood(_DiffusionLikelihood):
    """The likelihood of residuals ``(n, d)`` of pairs about f; no sensor is noisy.

    They are evenly thinned where there are more than memory has room for. That noise bends functions of the
    state over a step can be left out, before D(x) is known: a mean of D may be many times what it is where
    noise is least.
    """

    def __init__(
        self, found: FieldEstimate, pairs: SnapshotPairs, rest: np.ndarray, *, bent: bool = True
    ) -> None:
        super().__init__(found.library)
        (n, d), symbols, m = rest.shape, self.symbols, len(self.terms)
        rows = np.unique(np.linspace(0, n - 1, min(n, int(MAX_NUMBERS / (m * d * (d + 1))))).astype(int))
        if len(rows) < n:
            pairs, rest = pairs.take(rows), rest[rows]
        x, share = pairs.x0, found.flow.response_share
        self.rest = process_noise_increments(found, pairs, rest)
        first = [term.diff(one) for term in self.terms for one in symbols]
        second = [term.diff(one, other) for term in self.terms for one in symbols for other in symbols]
        components = np.ascontiguousarray(x.T)
        values = compile_formulas(self.terms, symbols)(components)
        slopes = compile_formulas(first, symbols)(components).reshape(m, d, -1)
        bends = compile_formulas(second, symbols)(components).reshape(m, d * d, -1)
        moved = np.einsum("kin,ni->kn", slopes, found.dynamics.drift(x))
        rate = np.broadcast_to(found.noise_rate_at(x), (len(x), d, d)).reshape(len(x), -1)
        moved += bent * 0.5 * np.einsum("kan,na->kn", bends, rate)
        self.functions, self.at_states = (values + share * pairs.h * moved).T, values.T
        self.start = np.asarray(self.rest.T @ self.rest / len(self.rest))
        self.sensor, self.free, self.most_correlated = np.zeros(0), np.zeros(0, dtype=bool), d

    def constant_probability(self) -> float:
        """See `_DiffusionLikelihood.constant_probability`; 1 where the residuals are too few to tell."""
        n, d = self.rest.shape
        few = n < MIN_RESIDUALS * d * (d + 1) // 2 * len(self.terms)
        return 1.0 if few else super().constant_probability()

    def relative_change(self, change: np.ndarray) -> np.ndarray:
        """Changes of εD ``(n, d, d)`` where its start is the unit matrix."""
        root = np.linalg.inv(np.linalg.cholesky(self.start))
        return np.asarray(root @ change @ root.T)

    def least_squares(self, places: np.ndarray) -> np.ndarray:
        """Coefficients by least squares of the squares of residuals."""
        values = np.zeros(len(places))
        for i, j in np.unique(places[:, :2], axis=0):
            rows = (places[:, :2] == (i, j)).all(axis=1)
            product = self.rest[:, i] * self.rest[:, j]
            values[rows] = np.linalg.lstsq(self.functions[:, places[rows, 2]], product, rcond=None)[0]
        return values

    def reached(
        self, places: np.ndarray, values: np.ndarray, sensor: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """The log-likelihood with score, information ``½ Σ tr D⁻¹∂D D⁻¹∂D``, and squares of single scores."""
        matrices = self.matrices(places, values, self.functions)
        precision = np.linalg.inv(matrices)
        pulled = (precision @ self.rest[:, :, None])[:, :, 0]
        logarithm = -0.5 * float((np.linalg.slogdet(matrices)[1] + (pulled * self.rest).sum(axis=1)).sum())
        score = np.empty((len(pulled), len(places)))
        half = np.where(np.eye(len(precision[0]), dtype=bool), 0.5, 1.0)
        for column, (i, j, k) in enumerate(places):
            score[:, column] = half[i, j] * (pulled[:, i] * pulled[:, j] - precision[:, i, j])
            score[:, column] *= self.functions[:, k]
        information = np.empty((len(places), len(places)))
        entries = np.unique(places[:, :2], axis=0)
        at = [np.flatnonzero((places[:, :2] == entry).all(axis=1)) for entry in entries]
        for (i, j), rows in zip(entries, at, strict=True):
            for (k, m), columns in zip(entries, at, strict=True):
                both = precision[:, i, k] * precision[:, j, m] + precision[:, i, m] * precision[:, j, k]
                left = self.functions[:, places[rows, 2]] * (half[i, j] * half[k, m] * both)[:, None]
                information[np.ix_(rows, columns)] = left.T @ self.functions[:, places[columns, 2]]
        return logarithm, score.sum(axis=0), information, score.T @ score


def process_noise_increments(found: FieldEstimate, pairs: SnapshotPairs, rest: np.ndarray) -> np.ndarray:
    """Residuals per root of time, with what the system forgot within the step put back: shape ``(n, d)``.

    ``∫₀ʰ e^{Js} D e^{Jᵀs} ds`` is ``h e^{Jh/2} D e^{Jᵀh/2}`` but for the second order in Jh. Of coarse steps
    it is the covariance of `siq.numerics.integration.FlowMap.moments`.
    """
    if found.flow.by_density:
        return np.asarray(rest / np.sqrt(pairs.h)[:, None])
    if found.flow.coarse:
        rate = found.noise_rate_at(found.on_the_way(pairs))
        rate = np.broadcast_to(rate, (len(rest), *found.noise_rate.shape))
        given = np.ascontiguousarray(pairs.x0.T), pairs.h, rate
        spread = found.flow.moments(found.dynamics.drift_of_components, *given)[1]
        # Of a few states f leads far away within a step, or D is none, as where formulas of both end.
        known = np.isfinite(spread).all(axis=(1, 2))
        for matrices in (rate, spread):
            known[known] = np.linalg.eigvalsh(matrices[known])[:, 0] > 0
        if known.mean() < 1 - MOST_UNKNOWN:
            raise NumericalFailure(
                "samples are so far apart that what the noise did between two of them cannot be worked out;"
                " sample more often"
            )
        root = np.eye(rest.shape[1]) / np.sqrt(pairs.h)[:, None, None]
        root[known] = np.linalg.cholesky(rate[known]) @ np.linalg.inv(np.linalg.cholesky(spread[known]))
        return np.asarray(np.einsum("nij,nj->ni", root, rest))
    step = found.dynamics.jacobian(pairs.x0) * (found.flow.response_share * pairs.h)[:, None, None]
    if not (np.abs(step) <= MAX_RELAXATION).all():
        step = np.zeros_like(step)
    back = np.eye(rest.shape[1]) - step + step @ step / 2
    return np.asarray((back @ rest[:, :, None])[:, :, 0] / np.sqrt(pairs.h)[:, None])


def with_process_noise_rate(found: FieldEstimate, pairs: SnapshotPairs | StreamedPairs) -> FieldEstimate:
    """An estimate by pairs whose `noise_rate` is that of the process noise and no longer that of residuals.

    Along a step the system forgets a part of what kicked it: a residual has the covariance
    ``∫₀ʰ e^{Js} εD e^{Jᵀs} ds`` with the Jacobian J of f, and not hεD. The mean of that map over the pairs is
    inverted. What is left is of second order in the step, where the noise moves J itself. An Euler–Maruyama
    simulation forgets in steps of its own, and nothing within one.
    """
    if found.noise_free or found.flow.coarse or not len(pairs):
        return found
    some = pairs.take(slice(None, None, max(len(pairs) // AVERAGED_PAIRS, 1)))
    step = found.dynamics.jacobian(some.x0) * some.h[:, None, None]
    if not np.isfinite(step).all() or np.abs(np.linalg.eigvals(step)).max() > MAX_STEP_RELAXATION:
        return found
    n, d, _ = step.shape
    unit, square = np.eye(d), (n, d * d, d * d)
    total, term = np.zeros(square), np.broadcast_to(np.eye(d * d), square)
    if found.flow.euler:  # the mean of M^k ⊗ M^k for the steps k of the simulation, M = 1 + hJ/steps
        steps = found.flow.steps
        forward = unit + step / steps
        generator = np.einsum("nij,nkl->nikjl", forward, forward).reshape(square)
        for _ in range(steps):
            total += term / steps
            term = term @ generator
    else:  # ∫₀¹ e^{As} ⊗ e^{As} ds for A = hJ, where e^{As} ⊗ e^{As} = e^{(A ⊗ 1 + 1 ⊗ A) s}
        generator = np.einsum("nij,kl->nikjl", step, unit) + np.einsum("ij,nkl->nikjl", unit, step)
        for order in range(1, SERIES_TERMS + 1):
            total += term / order
            term = term @ generator.reshape(square) / order
    rate = np.linalg.solve(total.mean(axis=0), found.noise_rate.ravel()).reshape(d, d)
    rate = (rate + rate.T) / 2
    # Of noise on a part of the states the residuals have rounding, too.
    return found if np.linalg.eigvalsh(rate)[0] < 0 else replace(found, noise_rate=rate)


class InnovationLikelihood(_DiffusionLikelihood):
    """The likelihood of a filter's innovations, the sensors' variances with the coefficients of D.

    Of a fit of f, whose trajectories and coefficients stay as they are; noise may drive the first d states of
    the model, those of the symbols. For `bent` see `ResidualLikelihood`.
    """

    def __init__(self, library: CandidateLibrary, fit: Fit, data: Measurements, *, bent: bool = True) -> None:
        super().__init__(library)
        symbols = library.symbols
        change, _ = whiten(fit.linearisation, data, fit.noise).solve()
        still = fit.linearisation.with_parameters_changed(change)
        d, rows, x = len(symbols), data.begins, fit.linearised_at
        middle = x[:, :d].copy()
        middle[rows] += (x[rows + 1, :d] + still.gap[rows, :d] - x[rows, :d]) / 2
        intensity = np.broadcast_to(fit.noise.intensity, (len(x), *fit.noise.intensity.shape[1:]))[:, :d, :d]
        spread = np.zeros_like(intensity) if fit.spread is None else fit.spread[:, :d, :d]
        wide = spread + bent * intensity * data.step[:, None, None] / 2
        second = [term.diff(one, other) for term in self.terms for one in symbols for other in symbols]
        components, plain = np.ascontiguousarray(middle.T), compile_formulas(self.terms, symbols)
        bends = compile_formulas(second, symbols)(components).reshape(len(self.terms), d, d, -1)
        functions = plain(components) + np.einsum("kijn,nij->kn", bends, wide) / 2
        self.all_functions = np.ascontiguousarray(functions.T)
        self.functions = self.all_functions[rows]
        self.at_states = plain(np.ascontiguousarray(x[:, :d].T)).T
        self._still, self._data = still, data
        self._begin = np.diag(x.var(axis=0))
        self.start = intensity[rows].mean(axis=0)
        self.sensor = fit.noise.measurement
        self.free = ~data.known_sensors

    def reached(
        self, places: np.ndarray, values: np.ndarray, sensor: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """By the derivatives of the filter, see `siq.inference.filter_kernels.filter_recursion`."""
        found = self._still.filtered(
            self._data.first, self._data.step, self._noise(places, values, sensor),
            begin_covariance=self._begin, functions=self.all_functions, places=places,
        )  # fmt: skip
        return -0.5 * (float((found[0][:, :, 0] ** 2).sum()) + found[1]), *found[2:5]

    def parameter_covariance(
        self, formula: NoiseFormula, sensor: np.ndarray, covariance: np.ndarray, fit: Fit
    ) -> np.ndarray:
        """Covariance of the coefficients of f by the errors of a formula and its sensors."""
        count = len(formula.values)
        places = np.column_stack([formula.places, [self.terms.index(term) for term in formula.terms]])

        def estimate(change: np.ndarray) -> np.ndarray:
            noise = self._noise(places, formula.values + change[:count], sensor * np.exp(change[count:]))
            return whiten(fit.linearisation, self._data, noise).solve()[0]

        levels, axes = np.linalg.eigh(covariance)
        total = np.zeros_like(fit.covariance)
        for axis in (axes * np.sqrt(np.maximum(levels, 0.0))).T:
            change = estimate(axis) - estimate(-axis)
            total += np.outer(change, change) / 4
        return total

    def _noise(self, places: np.ndarray, values: np.ndarray, sensor: np.ndarray) -> Noise:
        """Both noises at every sample; beyond the states of D nothing is driven."""
        d, whole = len(self.symbols), len(self._begin)
        intensity = np.zeros((len(self.all_functions), whole, whole))
        intensity[:, :d, :d] = self.matrices(places, values, self.all_functions)
        return Noise(sensor, np.ones(whole), intensity)


def constant_noise(symbols: Sequence[sympy.Symbol], rate: np.ndarray, *, samples: float) -> NoiseFormula:
    """εD that is the same everywhere, from the covariance of so many residuals per time, ``(d, d)``.

    The entries of a covariance of n normal residuals have the covariance ``(R_ik R_jl + R_il R_jk)/n``.
    """
    places = _all_places(len(symbols), 1)[:, :2]
    i, j = places.T
    straight, crossed = rate[np.ix_(i, i)] * rate[np.ix_(j, j)], rate[np.ix_(i, j)] * rate[np.ix_(j, i)]
    terms = (sympy.Integer(1),) * len(places)
    return NoiseFormula(tuple(symbols), places, terms, rate[i, j], (straight + crossed) / samples, 1.0)


def estimated_diffusion(found: FieldEstimate, *, pairs: int) -> Diffusion | None:
    """D as the residuals show it, of determinant 1; None where there is none to be shown.

    States whose noises show no significant correlation have none: an entry of D from chance alone would bring
    a term into g that nothing else asks for. The correlation of so many `pairs` has the standard error
    1/√pairs.

    There is none without noise, where noise does not reach every state, and where a state is but the
    derivative of another: what its residuals show is the noise of the other, and depends on the step of the
    pairs.
    """
    if found.noise_free or defined_states(found.dynamics):
        return None
    # To the last bit symmetric, as sums over the pairs are not.
    rate = (found.noise_rate + found.noise_rate.T) / 2
    size = np.sqrt(np.diag(rate))
    correlated = np.abs(rate) > STANDARD_ERRORS / np.sqrt(pairs) * np.outer(size, size)
    rate = np.where(correlated | np.eye(len(rate), dtype=bool), rate, 0.0)
    try:
        regular = Diffusion(rate).regular
    except ValueError:
        return None
    return Diffusion(rate / np.exp(float(np.linalg.slogdet(rate)[1]) / len(rate))) if regular else None


def check_units(states: Sequence[str], units: Sequence[str | None]) -> None:
    """Refuse the unit matrix for D, by a NumericalFailure, where states are known to have different units."""
    known = [(name, unit.strip()) for name, unit in zip(states, units, strict=True) if unit]
    other = next(((name, unit) for name, unit in known if unit != known[0][1]), None)
    if other is not None:
        (first, one), (second, two) = known[0], other
        raise NumericalFailure(
            f"D is not known: {first} is in {one} and {second} is in {two}, so that no unit matrix can stand"
            " for it, and the recordings carry no white noise that shows it; give D, up to a factor, as"
            " 'recordings.diffusion' of the study, or in Python as StateSpace(diffusion=...)"
        )


def defined_states(dynamics: Dynamics) -> list[str]:
    """States whose equation is another state, but for a factor: ``dx/dt = v``, which no noise drives."""
    return [
        name
        for name, own, formula in zip(dynamics.states, dynamics.symbols, dynamics.formulas, strict=True)
        if formula.as_coeff_Mul()[1] in set(dynamics.symbols) - {own}
    ]
