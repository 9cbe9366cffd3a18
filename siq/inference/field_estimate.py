"""The estimate of a vector field and its diffusion: one result, whatever identified it, and its file.

Of ``dx = f(x) dt + √ε σ(x) dW`` with ``D = σσᵀ`` recordings determine ``f = Θ Ξ`` over a library, with the
covariance of Ξ, and the product εD. How it is split is a convention: an estimated D has the determinant 1, or
the geometric mean 1 of it over the recorded states. Without noise nothing of D is determined, and the unit
matrix is no answer for states of different units.

A vector field is compared with pairs of samples over their whole step, not with a difference quotient, whose
error is O(h). Two maps are known: the flow of the differential equation, and that of an Euler–Maruyama
simulation, whose increments are h f exactly and which differs from the continuous process by O(h).

Certificates and transitions take an `AnyField`: an estimated f with its uncertainty, or a given one.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import sympy

from siq.data.recordings import SnapshotPairs
from siq.errors import Fault, InputError, NumericalFailure
from siq.inference.library import CandidateLibrary, IdentificationOptions, field_dynamics, field_library
from siq.numerics.files import whole_file
from siq.numerics.integration import FlowMap
from siq.numerics.randomness import normal_draws
from siq.remarks import Remark, sentence
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.formulas import compile_formulas, parse_formula

NoiseKind = Literal["none", "process", "sensor", "measurement", "rounding", "coloured"]
NOISE_FREE = 1e-6  # residuals below this share of the increments are the integrator's and the rounding's
STANDARD_ERRORS = 4.0  # derived: chance passes it once in 16 000 pairs of states
SIGNIFICANT_SCORE = 5.0  # standard errors
BEYOND_STATES = 2.0  # standard deviations of a sensor, by which values are beyond any state (a choice)
HARMLESS_CORRELATION = 0.02  # a correlation, or a deviation of D, below this is harmless however significant
HARMLESS_BIAS = 0.5  # of a standard error: with such a bias an error bar holds 0.95 - 0.02 of the time


@dataclass(frozen=True)
class NoiseFormula:
    """εD(x) as a sum of terms, with errors."""

    symbols: tuple[sympy.Symbol, ...]  #: the d states
    #: The entry (i, j), i ≤ j, of each coefficient, shape ``(p, 2)``; and its function of the states.
    places: np.ndarray
    terms: tuple[sympy.Expr, ...]
    #: Shapes ``(p,)`` and ``(p, p)``, in the states' units squared per time.
    values: np.ndarray
    covariance: np.ndarray
    probability: float  #: that a constant D shows as much by chance

    def diffusion(self, intensity: float) -> Diffusion:
        """D, where ε is the intensity."""
        matrix = sympy.zeros(len(self.symbols))
        for (i, j), term, value in zip(self.places, self.terms, self.values, strict=True):
            matrix[i, j] += sympy.Float(float(value / intensity), 17) * term
            matrix[j, i] = matrix[i, j]
        return Diffusion.of_formulas(self.symbols, matrix.tolist())

    @cached_property
    def _functions(self) -> Callable[[np.ndarray], np.ndarray]:
        return compile_formulas(self.terms, self.symbols)

    @property
    def standard_errors(self) -> np.ndarray:
        """Shape ``(p,)``."""
        return np.sqrt(np.diag(self.covariance))

    def push_slopes(self, x: np.ndarray, momenta: np.ndarray) -> np.ndarray:
        """``p·(∂εD/∂value) p`` at points and momenta ``(n, d)``: shape ``(n, p)``."""
        terms = self._functions(np.ascontiguousarray(x.T)).T
        i, j = self.places.T
        return np.asarray(np.where(i == j, 1.0, 2.0) * momenta[:, i] * momenta[:, j] * terms)

    def strength_slopes(self, x: np.ndarray) -> np.ndarray:
        """Derivatives of ``ln ε`` by the coefficients, shape ``(p,)``.

        ε is such that the determinant of D has the geometric mean one over the states ``(n, d)``.
        """
        terms = self._functions(np.ascontiguousarray(x.T))
        precision = self.diffusion(1.0).precision_at(x)
        i, j = self.places.T
        share = np.where(i == j, 1.0, 2.0)[:, None] * precision[:, i, j].T * terms
        return np.asarray(share.mean(axis=1) / len(self.symbols))

    def eliminated(self, critical: float) -> tuple[np.ndarray, np.ndarray]:
        """Backward elimination about the largest likelihood: the coefficients that stay, and their values.

        The last term of a state's own noise stays: without it there would be none.
        """
        kept, values, covariance = np.arange(len(self.values)), self.values, self.covariance
        while len(kept):
            own = self.places[kept, 0] == self.places[kept, 1]
            count = np.array([(own & (self.places[kept, 0] == i)).sum() for i in self.places[kept, 0]])
            strength = np.abs(values) / np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
            strength[own & (count == 1)] = np.inf
            weakest = int(np.argmin(strength))
            if strength[weakest] >= critical:
                break
            along = covariance[:, weakest] / covariance[weakest, weakest]
            values = np.delete(values - along * values[weakest], weakest)
            covariance = covariance - np.outer(along, covariance[weakest])
            covariance = np.delete(np.delete(covariance, weakest, axis=0), weakest, axis=1)
            kept = np.delete(kept, weakest)
        return kept, values

    def as_data(self) -> dict[str, Any]:
        """The terms with their errors, and the covariance, as plain data."""
        names = [each.name for each in self.symbols]
        numbers = zip(self.places, self.terms, self.values, self.standard_errors, strict=True)
        return {
            "terms": [
                {"row": names[i], "column": names[j], "term": str(term), "coefficient": float(value),
                 "standard_error": float(error)}
                for (i, j), term, value, error in numbers
            ],
            "covariance": self.covariance.tolist(), "probability": self.probability,
        }  # fmt: skip

    @classmethod
    def from_data(cls, data: Mapping[str, Any], symbols: Sequence[sympy.Symbol]) -> NoiseFormula:
        """A formula as `as_data` stored it."""
        names, rows = {each.name: each for each in symbols}, data["terms"]
        places = np.array([[list(names).index(row[key]) for key in ("row", "column")] for row in rows])
        terms = tuple(parse_formula(row["term"], names) for row in rows)
        values = np.array([float(row["coefficient"]) for row in rows])
        covariance = np.array(data["covariance"], dtype=float)
        return cls(tuple(symbols), places, terms, values, covariance, float(data["probability"]))


@dataclass(frozen=True)
class Verdict:
    """One test: the figure, its limit, the verdict, and what it means in words.

    What could not be tested has not `passed`, and has not failed either; the reason says why.
    """

    value: float
    limit: float
    passed: bool
    reason: str = ""
    tested: bool = True

    def as_data(self) -> dict[str, Any]:
        """As it is stored; a figure that is not finite becomes null."""
        value = float(self.value) if np.isfinite(self.value) else None
        return vars(self) | {"value": value, "limit": float(self.limit), "passed": bool(self.passed)}

    @classmethod
    def of(cls, value: float, limit: float, reason: str) -> Verdict:
        """Passed where a figure is no larger than its limit; the reason is why it would be refused."""
        passed = bool(value <= limit)
        return cls(value, limit, passed, "" if passed else reason)

    @classmethod
    def refused(cls, reason: str, limit: float = 0.0) -> Verdict:
        """A test that cannot be made, or fails without a figure."""
        return cls(np.inf, limit, False, reason)

    @classmethod
    def of_probability(cls, probability: float, limit: float, reason: str = "") -> Verdict:
        """Passed where chance makes a figure so likely; the figures are powers of ten below 1."""
        return cls.of(-float(np.log10(min(max(probability, 1e-300), 1.0))), -float(np.log10(limit)), reason)

    @classmethod
    def not_tested(cls, reason: str) -> Verdict:
        """What the recordings could neither bear out nor refute, and why."""
        return cls(np.inf, 0.0, False, reason, tested=False)

    @staticmethod
    def worst(verdicts: Sequence[Verdict]) -> Verdict:
        """Of several verdicts of one test the one that decides."""
        return max(verdicts, key=lambda one: (not one.passed, one.tested, one.value / (one.limit or 1.0)))

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> Verdict:
        """A verdict as `as_data` stored it."""
        return cls(**{**data, "value": np.inf if data["value"] is None else data["value"]})


class DiffusionSource(StrEnum):
    """Where D is from, and what has to be said of it."""

    GIVEN = "given"
    ESTIMATED = "estimated"
    OF_VELOCITIES = "estimated of velocities"
    UNIT = "unit"
    UNIT_OF_VELOCITIES = "unit of velocities"

    @property
    def note(self) -> str | None:
        """A remark for the reader of U; none where D was given."""
        remark = Remark("inference.diffusion_source", {"source": str(self)})
        return None if self == DiffusionSource.GIVEN else sentence(remark)


@dataclass(frozen=True)
class NoiseDiagnosis:
    """The noise in recordings about an estimated f."""

    #: ``none``: only the integrator's error and rounding. ``process``: white process noise. ``sensor``:
    #: measurement noise alone, which the estimate allows for. ``measurement``: measurement noise that it does
    #: not allow for, so that neighbouring residuals are anticorrelated. ``rounding``: the same, and no more
    #: than the values were rounded by when they were written. ``coloured``: residuals of neighbours are
    #: correlated though all that is known is allowed for.
    kind: NoiseKind
    intensity: float  #: ε of ``√ε D^(1/2) dW``
    #: Shape ``(d, d)``: the residuals' covariance per time over the intensity; D, if D is right.
    covariance: np.ndarray
    #: Of neighbouring residuals, the strongest over the states; and in standard errors.
    correlation: float
    correlation_score: float
    #: Shape ``(m,)``: standard deviation of each measured state's noise, zero where none is recognised; and
    #: its standard error, None where it was not estimated with f.
    measurement: np.ndarray
    measurement_error: np.ndarray | None = None
    intensity_error: float | None = None  #: of ε; None where it follows from the number of pairs
    pairs: int = 0  #: number of pairs of samples, or of so many independent ones
    diffusion: DiffusionSource = DiffusionSource.GIVEN  #: where D is from
    #: The time over which each sample was taken as a mean; None where as the state itself.
    exposure: float | None = None
    thinned: int = 1  #: of how many samples one was used, as neighbours share more than the state
    #: Standard deviation, correlation time and its standard error of what a sensor adds to its white noise;
    #: None where that is nothing.
    slow_sensor: tuple[float, float, float] | None = None
    #: Coefficients ``(m, 3)`` of 1, y and y² in the variance of each sensor's noise over its mean; None where
    #: it is the same everywhere.
    sensor_law: np.ndarray | None = None
    #: Number of steps from which on the recordings are Markovian, None where they are from sample to sample;
    #: and by how much their correlations delay what forces do (`siq.inference.regression.lost_time`).
    lag: int | None = None
    lost_time: float = 0.0
    #: Twice the log-likelihood ratio to the same terms without measurement noise, where that was estimated.
    sensor_evidence: float | None = None
    #: Largest entry of ``D^(-1/2) covariance D^(-1/2) - 1``, and the same in its standard errors.
    deviation: float = 0.0
    deviation_score: float = 0.0
    #: How the values were written, in words, None where that is not seen; the largest bias that it brings
    #: into a coefficient of f, in its standard errors; and how many decimals would leave no trace.
    rounding: str | None = None
    rounding_bias: float = 0.0
    decimals: int = 0
    remarks: tuple[Remark, ...] = ()

    @property
    def correlated(self) -> bool:
        """Whether neighbouring residuals are correlated, significantly and by more than is harmless."""
        return (
            abs(self.correlation_score) > SIGNIFICANT_SCORE and abs(self.correlation) > HARMLESS_CORRELATION
        )

    def with_deviation(self, whitened: np.ndarray, samples: int) -> NoiseDiagnosis:
        """With the deviation of the covariance ``(d, d)`` of so many residuals, in units of D."""
        unit = np.eye(len(whitened))
        excess = np.abs(whitened - unit)
        score = float((excess / np.sqrt((1 + unit) / samples)).max())
        return replace(self, deviation=float(excess.max()), deviation_score=score)

    def fault(self, states: Sequence[str]) -> str | None:
        """Why formulas from these recordings would be biased, in words; None where they are not."""
        deviates = self.deviation_score > SIGNIFICANT_SCORE and self.deviation > HARMLESS_CORRELATION
        faulty = {"rounding": self.rounding_bias > HARMLESS_BIAS, "process": deviates}
        if not faulty.get(self.kind, self.kind in ("measurement", "coloured")):
            return None
        worst = int(np.argmax(self.measurement))
        shown = np.array2string(self.covariance, precision=3, separator=", ").replace("\n", "")
        values = {
            "kind": self.kind, "noise": self.measurement[worst], "state": states[worst],
            "correlation": self.correlation, "rounding": self.rounding, "bias": self.rounding_bias,
            "decimals": self.decimals, "covariance": shown, "intensity": self.intensity,
            "allowed_for": self.measurement_error is not None,
        }  # fmt: skip
        return sentence(Remark("inference.noise_fault", values))

    def as_data(self) -> dict[str, Any]:
        """As it is stored in `vector_field.json`; what is not finite in an array becomes null."""
        arrays = {
            name: np.where(np.isfinite(value), value, np.array(None)).tolist()
            for name, value in vars(self).items()
            if isinstance(value, np.ndarray)
        }
        remarks = [each.as_data() for each in self.remarks]
        return vars(self) | arrays | {"diffusion": str(self.diffusion), "remarks": remarks}

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> NoiseDiagnosis:
        """A diagnosis as `as_data` stored it."""
        known: dict[str, Any] = {name: value for name, value in data.items() if value is not None}
        for name in {"covariance", "measurement", "measurement_error", "sensor_law"} & known.keys():
            known[name] = np.array(known[name], dtype=float)
        if "measurement_error" in known:
            known["measurement_error"][np.isnan(known["measurement_error"])] = np.inf
        if "slow_sensor" in known:
            known["slow_sensor"] = tuple(known["slow_sensor"])
        known["diffusion"] = DiffusionSource(known["diffusion"])
        known["remarks"] = tuple(map(Remark.from_data, known["remarks"]))
        return cls(**known)


@dataclass(frozen=True)
class FieldEstimate:
    """A vector field ``f = Θ Ξ`` and its noise, with their uncertainty: the result of an identification."""

    #: The q functions; and Ξ, shape ``(q, d)``: column i holds the coefficients of f_i
    library: CandidateLibrary
    coefficients: np.ndarray
    #: The pair (component i, term k) of each of the p coefficients that are not zero, shape ``(p, 2)``; and
    #: their covariance, shape ``(p, p)``
    support: np.ndarray
    covariance: np.ndarray
    #: Shape ``(d, d)``: covariance of the residual per unit of time. For process noise it is εD, once
    #: `siq.inference.diffusion_model` has put back what a step forgets.
    noise_rate: np.ndarray
    #: Rms of the residuals over rms of the increments; and the map over a pair's step that was fitted
    residual_ratio: float
    flow: FlowMap
    #: D, which recordings do not tell apart from ε: of these only the product, `noise_rate`, is identified
    diffusion: Diffusion
    #: What other terms that fit nearly as well make of f: bias ``(q, d)`` and spread ``(r, q, d)``, see
    #: `siq.inference.selection.model_average`. This and what follows is None where it was not asked for.
    alternatives: tuple[np.ndarray, np.ndarray] | None = None
    #: Shape ``(p,)``: the share of resampled recordings in which each term would be chosen
    #: (`siq.inference.selection`)
    stability: np.ndarray | None = None
    #: εD as a formula of the states, where the recordings show that it depends on them; `noise_rate` is its
    #: mean over the recorded states then. Or with its errors, where D was estimated and is the same
    #: everywhere.
    noise: NoiseFormula | None = None
    constant_noise: NoiseFormula | None = None
    #: The noise that the recordings show, and how samples were taken to show the states
    diagnosis: NoiseDiagnosis | None = None
    #: Whether f holds for recordings that it was not fitted to
    prediction: Verdict | None = None

    @classmethod
    def on_support(
        cls, library: CandidateLibrary, support: np.ndarray, values: np.ndarray, *args: Any, **fields: Any
    ) -> FieldEstimate:
        """An estimate from the values of the coefficients that are not zero, shape ``(p,)``."""
        return cls(library, _spread_out(library, support, values), support, *args, **fields)

    def with_values(self, support: np.ndarray, values: np.ndarray, **changes: Any) -> FieldEstimate:
        """An estimate with other coefficients, those of a support, and other changes."""
        coefficients = _spread_out(self.library, support, values)
        return replace(self, coefficients=coefficients, support=support, **changes)

    def with_formula(self, formula: NoiseFormula, x: np.ndarray) -> FieldEstimate:
        """The field with D of a formula, and the mean of εD over states ``(n, d)`` for its noise rate.

        Raises
        ------
        NumericalFailure
            Where εD is not positive at one of the states.
        """
        matrices = formula.diffusion(1.0).at(x)
        signs, logarithms = np.linalg.slogdet(matrices)
        if not (signs > 0).all():
            raise NumericalFailure("the formula of the noise is not positive at all recorded states")
        diffusion = formula.diffusion(float(np.exp(logarithms.mean() / len(matrices[0]))))
        rate = matrices.mean(axis=0)
        return replace(self, diffusion=diffusion, noise_rate=rate, noise=formula, constant_noise=None)

    def noise_rate_at(self, x: np.ndarray) -> np.ndarray:
        """εD at states ``(n, d)``: shape ``(d, d)`` where it is the same at all, else ``(n, d, d)``."""
        if self.noise is not None:
            return self.noise.diffusion(1.0).at(x)
        if self.diffusion.constant or self.noise_free:
            return self.noise_rate
        matrices = self.diffusion.at(x)
        return np.asarray(matrices * (np.trace(self.noise_rate) / np.trace(matrices.mean(axis=0))))

    @property
    def diffusion_source(self) -> DiffusionSource:
        """Where D is from."""
        return DiffusionSource.GIVEN if self.diagnosis is None else self.diagnosis.diffusion

    @property
    def memory(self) -> tuple[int, float] | None:
        """The lag from which on the recordings are Markovian, and the time lost; None of those that are."""
        noise = self.diagnosis
        return None if noise is None or noise.lag is None else (noise.lag, noise.lost_time)

    @property
    def sensor_variance(self) -> np.ndarray | None:
        """Variance of each measured state's noise, shape ``(m,)``; None where f was found without any."""
        noise = self.diagnosis
        if noise is None or noise.kind not in ("process", "sensor") or not (noise.measurement > 0).any():
            return None
        return noise.measurement**2 + (0.0 if noise.slow_sensor is None else noise.slow_sensor[0] ** 2)

    @property
    def hidden_states(self) -> bool:
        """Whether half of the states were not recorded: velocities, or a slow force."""
        return self.diagnosis is not None and len(self.diagnosis.measurement) * 2 == self.library.dimension

    @property
    def has_hidden_state(self) -> bool:
        """Whether a state has a memory and was not recorded: of the system, or of its sensor alone."""
        return self.hidden_states or self.slow_sensor is not None

    @property
    def slow_force(self) -> float:
        """The factor of a slow force that was not recorded in ``dx/dt``; zero where there is none."""
        if not self.hidden_states or not self.noise_rate[0, 0] > 0:
            return 0.0
        return float(self.coefficients[self.library.terms.index(self.library.symbols[1]), 0])

    @property
    def exposure(self) -> float | None:
        """The time over which each sample was taken as a mean; None where as the state itself."""
        return None if self.diagnosis is None else self.diagnosis.exposure

    @property
    def slow_sensor(self) -> tuple[float, float, float] | None:
        """Size, correlation time and its error of slow measurement noise; None where there is none."""
        return None if self.diagnosis is None else self.diagnosis.slow_sensor

    @property
    def noise_strength(self) -> tuple[float, float] | None:
        """ε and its standard error, None where the recordings show no white noise.

        The variance of n residuals of d states has the relative standard error ``√(2/nd)``. Where
        measurement noise was estimated, too, it is larger, and stands in the diagnosis.
        """
        noise = self.diagnosis
        if noise is None or noise.kind not in ("process", "sensor") or not noise.intensity > 0:
            return None
        if noise.intensity_error is not None:
            return noise.intensity, noise.intensity_error
        samples = noise.pairs * self.library.dimension
        return noise.intensity, noise.intensity * (2 / samples) ** 0.5 if samples else 0.0

    def error_of_strength(self, x0: np.ndarray, h: np.ndarray) -> float:
        """Standard error of ``ln ε`` by residuals of pairs from states ``(n, d)``, h apart."""
        if self.flow.by_density and self.constant_noise is not None:
            return float(np.sqrt(self.constant_noise.covariance[0, 0]) / self.constant_noise.values[0])
        # The variance of n residuals of d states has the relative standard error √(2/nd). A step multiplies
        # it by about exp(h tr J/d), which is known as well as the divergence of f is.
        d, (components, terms) = self.library.dimension, self.support.T
        means = (self.library.evaluate(x0) * h[:, None]).mean(axis=0)
        forgotten = means @ self.library.derivatives[:, components, terms] * 2 * self.flow.response_share / d
        return float(np.sqrt(2 / (len(h) * d) + forgotten @ self.covariance @ forgotten))

    def on_the_way(self, pairs: SnapshotPairs) -> np.ndarray:
        """States in the middle of the mean way of pairs, ``(n, d)``: there D is that of the step.

        To first order; where it is none, as behind the end of a formula, and of densities, where pairs begin.
        What a noisy sensor shows farthest away is no state.
        """
        if self.flow.by_density and self.sensor_variance is not None:
            reach, middle = BEYOND_STATES * np.sqrt(self.sensor_variance), np.median(pairs.x0, axis=0)
            low, high = pairs.x0.min(axis=0) + reach, pairs.x0.max(axis=0) - reach
            return np.clip(pairs.x0, np.minimum(low, middle), np.maximum(high, middle))
        if self.diffusion.constant or self.flow.by_density:
            return pairs.x0
        middle = pairs.x0 + (self.flow.response_share * pairs.h)[:, None] * self.dynamics.drift(pairs.x0)
        matrices = self.diffusion.at(middle)
        positive = np.isfinite(matrices).all(axis=(1, 2))
        positive[positive] = np.linalg.eigvalsh(matrices[positive])[:, 0] > 0
        return np.where(positive[:, None], middle, pairs.x0)

    def with_rival(self, other: FieldEstimate, probability: float) -> FieldEstimate:
        """With what another estimate, of some probability, leaves open in f and in ε.

        Both have the same library. ε is compared by the determinants of both noises, whatever D stands for.
        """
        bias, spread = self.alternatives or (0 * self.coefficients, np.zeros((0, *self.coefficients.shape)))
        change = np.sqrt(probability) * (other.coefficients - self.coefficients)
        found = replace(self, alternatives=(bias, np.concatenate([spread, change[None]])))
        strengths = [np.linalg.slogdet(one.noise_rate)[1] for one in (self, other)]
        noise, share = self.diagnosis, probability * (np.diff(strengths)[0] / self.library.dimension) ** 2
        if noise is None or noise.intensity_error is None or not np.isfinite(share):
            return found
        error = float(np.hypot(noise.intensity_error, noise.intensity * np.sqrt(share)))
        return replace(found, diagnosis=replace(noise, intensity_error=error))

    def with_shape_tested(self, chance: float, *, limit: float, along: str) -> FieldEstimate:
        """With what another test says of the prediction: samples and f disagree `along` a way or a state.

        The test of held-out recordings is one of the same claim, so that the chance counts twice.
        """
        chance = min(2 * chance, 1.0)
        if chance >= limit or self.prediction is None or not self.prediction.passed:
            return self
        reason = sentence(Remark("inference.other_shape", {"probability": chance, "along": along}))
        return replace(self, prediction=Verdict.of_probability(chance, limit, reason))

    def bias(self, slopes: np.ndarray) -> np.ndarray:
        """By how much alternative terms move what follows from f, by its derivatives ``(..., q, d)``."""
        if self.alternatives is None:
            return np.zeros(slopes.shape[:-2])
        return np.asarray(np.einsum("...qd,qd->...", slopes, self.alternatives[0]))

    def drawn_alternatives(self, count: int, *, generator: np.random.Generator) -> np.ndarray:
        """Changes of f by other terms, beside those of its own coefficients: shape ``(count, q, d)``."""
        if self.alternatives is None:
            return np.zeros((count, *self.coefficients.shape))
        bias, spread = self.alternatives
        numbers = generator.standard_normal((count, len(spread)))
        return np.asarray(bias + np.tensordot(numbers, spread, axes=1))

    def drawn(self, generator: np.random.Generator | None = None) -> Dynamics:
        """f and D drawn from their distributions, by default their means, with all terms that f may have."""
        coefficients = self.coefficients.copy()
        if generator is not None:
            own = normal_draws(self.values, self.covariance, 1, generator=generator)[0]
            coefficients[self.support[:, 1], self.support[:, 0]] = own
            coefficients += self.drawn_alternatives(1, generator=generator)[0]
        elif self.alternatives is not None:
            coefficients += self.alternatives[0]
        support = np.argwhere(coefficients.T != 0)
        diffusion = self.diffusion
        if generator is not None and self.noise is not None:
            entries = normal_draws(self.noise.values, self.noise.covariance, 1, generator=generator)[0]
            diffusion = replace(self.noise, values=entries).diffusion(self.intensity)
        values = coefficients[support[:, 1], support[:, 0]]
        return field_dynamics(self.library, support, values, diffusion=diffusion)

    def wrapped(self, pairs: SnapshotPairs) -> SnapshotPairs:
        """Pairs moved by whole periods, of states that have one, so that each begins in the first period."""
        dynamics = self.dynamics
        shift = dynamics.turns(pairs.x0) * dynamics.periods
        return replace(pairs, x0=pairs.x0 - shift, xh=pairs.xh - shift) if shift.any() else pairs

    def variance(self, slopes: np.ndarray, *, of_mean: bool = False) -> np.ndarray:
        """Variance of what follows from f to first order, by its coefficients and by which terms there are.

        Derivatives by all coefficients ``(..., q, d)`` to ``(...)``. The square of `bias` is a part of it,
        unless it is that `of_mean`, which has been moved by the bias.
        """
        own = slopes[..., self.support[:, 1], self.support[:, 0]]
        total = np.einsum("...p,pr,...r->...", own, self.covariance, own)
        if self.alternatives is not None:
            changes = np.tensordot(slopes, self.alternatives[1], axes=([-2, -1], [-2, -1]))
            total = total + (changes**2).sum(axis=-1)
            if not of_mean:
                total = total + self.bias(slopes) ** 2
        return np.asarray(np.maximum(total, 0.0))

    @cached_property
    def noise_slopes(self) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """``p·(∂D/∂θ) p`` by the k coefficients θ of an estimated εD, at points and momenta: to ``(n, k)``.

        There are none where D was given. Of a constant D only its shape changes: its determinant is 1 by
        definition, and what is left is the error of ε, which stands beside it.
        """
        if (own := self.noise) is not None:
            strength = self.intensity
            return lambda x, momenta: own.push_slopes(x, momenta) / strength
        if (constant := self.constant_noise) is None:
            return lambda x, momenta: np.zeros((len(x), 0))
        intensity = self.diffusion.intensity(self.noise_rate)
        scale = constant.strength_slopes(np.zeros((1, self.library.dimension)))

        def of_shape(x: np.ndarray, momenta: np.ndarray) -> np.ndarray:
            slopes = constant.push_slopes(x, momenta)
            return np.asarray(slopes - (slopes @ constant.values)[:, None] * scale) / intensity

        return of_shape

    def noise_variance(self, slopes: np.ndarray) -> np.ndarray:
        """Variance of what follows from D to first order, from derivatives ``(..., k)`` by the same θ."""
        known = self.noise or self.constant_noise
        if known is None:
            return np.zeros(slopes.shape[:-1])
        return np.asarray(np.einsum("...k,kl,...l->...", slopes, known.covariance, slopes))

    @property
    def noise_free(self) -> bool:
        """Whether the residuals are those of the integrator and of rounding."""
        return self.residual_ratio < NOISE_FREE

    @property
    def intensity(self) -> float:
        """ε of the formula of εD, where there is one: ``εD = ε D``."""
        if self.noise is None:
            raise Fault("D does not depend on the state", "ε is that of the residuals")
        place = int(np.flatnonzero(self.noise.places[:, 0] == self.noise.places[:, 1])[0])
        (i, _), term = self.noise.places[place], self.noise.terms[place]
        own = sympy.Poly(self.diffusion.formulas[i][i], *self.library.symbols).coeff_monomial(term)
        return float(self.noise.values[place]) / float(own)

    @cached_property
    def dynamics(self) -> Dynamics:
        """f and D, with the p coefficients that are not zero as parameters, and their covariance."""
        return field_dynamics(
            self.library, self.support, self.values, diffusion=self.diffusion, covariance=self.covariance
        )

    @property
    def values(self) -> np.ndarray:
        """The p coefficients that are not zero."""
        return self.coefficients[self.support[:, 1], self.support[:, 0]]

    @property
    def standard_errors(self) -> np.ndarray:
        """Shape ``(q, d)``: standard error of each coefficient, zero where there is no term.

        What other terms leave open is a part of it: a term that was chosen for its size is smaller in the
        mean over supports, and one that took the place of another might not be there.
        """
        variance = np.diag(self.covariance).copy()
        if self.alternatives is not None:
            (components, terms), (bias, spread) = self.support.T, self.alternatives
            variance += bias[terms, components] ** 2 + (spread[:, terms, components] ** 2).sum(axis=0)
        return _spread_out(self.library, self.support, np.sqrt(variance))


def _spread_out(library: CandidateLibrary, support: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values on a support as a matrix of all coefficients, shape ``(q, d)``."""
    matrix = np.zeros((library.size, library.dimension))
    matrix[support[:, 1], support[:, 0]] = values
    return matrix


AnyField = FieldEstimate | Dynamics
"""f and D with their uncertainty, or as given."""


def dynamics_of(found: AnyField) -> Dynamics:
    """f and D alone."""
    return found if isinstance(found, Dynamics) else found.dynamics


def write_field(path: str | Path, estimate: FieldEstimate, options: IdentificationOptions) -> None:
    """Write an estimate whole or not at all, as `vector_field.json` is documented."""
    library, average = estimate.library, estimate.alternatives
    shares = [None] * len(estimate.support) if estimate.stability is None else estimate.stability.tolist()
    errors = estimate.standard_errors[estimate.support[:, 1], estimate.support[:, 0]]
    terms = zip(estimate.support, estimate.values, errors, shares, strict=True)
    data = {
        "states": list(library.states), "degree": options.degree, "functions": list(options.functions),
        "angles": {name: limits for name, *limits in library.angles},
        "terms": [
            {"component": library.states[i], "term": library.names[k], "coefficient": float(value),
             "standard_error": float(error), "stability": share}
            for (i, k), value, error, share in terms
        ],
        "covariance": estimate.covariance.tolist(),
        "alternatives": average and {"bias": average[0].tolist(), "spread": average[1].tolist()},
        "noise_rate": estimate.noise_rate.tolist(), "residual_ratio": estimate.residual_ratio,
        "diffusion": estimate.diffusion.rows, "noise_formula": estimate.noise and estimate.noise.as_data(),
        "constant_noise": estimate.constant_noise and estimate.constant_noise.as_data(),
        "flow": vars(estimate.flow), "noise": estimate.diagnosis and estimate.diagnosis.as_data(),
        "prediction": estimate.prediction and estimate.prediction.as_data(),
    }  # fmt: skip
    with whole_file(path) as partial:
        partial.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_field(path: str | Path) -> FieldEstimate | None:
    """Read what `write_field` wrote; None where the file is empty since nothing was identified.

    Raises
    ------
    InputError
        When the file is no such record.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        if not text:
            return None
        data = json.loads(text)
        options = IdentificationOptions(
            degree=data["degree"], functions=tuple(data["functions"]), angles=data.get("angles", {})
        )
        library, rows = field_library(data["states"], options), data["terms"]
        support = np.array(
            [[library.states.index(row["component"]), library.names.index(row["term"])] for row in rows]
        )
        shares = [row.get("stability") for row in rows]
        average, shape = data.get("alternatives"), (library.size, library.dimension)
        formulas = [
            NoiseFormula.from_data(data[key], library.symbols) if data.get(key) else None
            for key in ("noise_formula", "constant_noise")
        ]
        found = FieldEstimate.on_support(
            library, support, np.array([float(row["coefficient"]) for row in rows]),
            np.array(data["covariance"]), np.array(data["noise_rate"]), float(data["residual_ratio"]),
            FlowMap(**data["flow"]), Diffusion.of_rows(library.symbols, data["diffusion"]),
            average and (
                np.array(average["bias"]).reshape(shape), np.array(average["spread"]).reshape(-1, *shape)
            ),
            None if None in shares else np.array(shares, dtype=float), *formulas,
            NoiseDiagnosis.from_data(data["noise"]) if data["noise"] else None,
            Verdict.from_data(data["prediction"]) if data["prediction"] else None,
        )  # fmt: skip
        p, d = len(support), library.dimension
        if found.covariance.shape != (p, p) or found.noise_rate.shape != (d, d):
            raise ValueError("covariances do not fit the terms")
        if found.diffusion.dimension != d:
            raise ValueError("D does not fit the states")
        return found
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            path, "", f"it is no vector field ({type(error).__name__})", "make it again"
        ) from None
