"""The estimate of a vector field and its diffusion, with covariances.

A vector field is held against pairs over their whole step, not against a difference quotient, whose error is
O(h). Two maps are known: the flow of the differential equation, and that of an Euler–Maruyama simulation,
whose increments are h f exactly and which differs from the continuous process by O(h).

Recordings fix only the product εD, and without noise nothing of it. D is a matter of units: if the unit of
one state is changed and D is not, another problem is posed. So the unit matrix is no answer for states of
different units.

Certificates and transitions take an `AnyField`: an identified f with its uncertainty, or this.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np
import sympy

from siq.errors import NumericalFailure
from siq.inference.library import CandidateLibrary
from siq.inference.selection import RivalTerms
from siq.numerics.integration import runge_kutta_step
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter, symbol
from siq.systems.formulas import compile_formulas, parse_formula

Field = Callable[[np.ndarray], np.ndarray]
"""f, mapping components ``(d, n)`` to components ``(d, n)``."""

LARGEST_REFINEMENT = 64  # Runge–Kutta steps within one pair


@dataclass(frozen=True)
class FlowMap:
    """How a state is carried over the step of a pair.

    Attributes
    ----------
    steps
        Steps of the integrator within every pair.
    euler
        Euler's rule, for pairs that an Euler–Maruyama simulation made with as many steps; otherwise the
        classical Runge–Kutta rule, for everything that is continuous in time.
    """

    steps: int = 1
    euler: bool = False

    def __call__(self, field: Field, x0: np.ndarray, h: np.ndarray) -> np.ndarray:
        """The state after h without noise: components ``(d, n)`` and steps ``(n,)`` to ``(d, n)``."""
        step = h / self.steps
        x = x0
        with np.errstate(over="ignore", invalid="ignore"):  # a trial f may run away
            for _ in range(self.steps):
                x = x + step * field(x) if self.euler else runge_kutta_step(field, x, step)
        return x

    @property
    def curvature_weight(self) -> float:
        """Share of h²/4 by which noise shifts the mean: ``E Xh - Φ(X0) = w h²/4 ΣD_jk ∂²f/∂x_j∂x_k ε``.

        The variance grows from zero within the pair; Euler's rule sees it only after each step.
        """
        return 1 - 1 / self.steps if self.euler else 1.0


def flow_map(
    field: Field, x0: np.ndarray, h: np.ndarray, *, integrator_step: float | None, tolerance: float
) -> FlowMap:
    """The map that fits the data: as many steps as the accuracy needs, or as the simulation made.

    Parameters
    ----------
    field
        An estimate of f.
    x0
        Some of the states, shape ``(d, n)``, and ...
    h
        ... the steps of their pairs, shape ``(n,)``.
    integrator_step
        Step of the Euler–Maruyama simulation that made the data; None for everything else.
    tolerance
        Accuracy of the increments wanted, relative to their root mean square, state by state.
    """
    if integrator_step is not None:
        return FlowMap(steps=max(round(float(np.median(h)) / integrator_step), 1), euler=True)
    steps = 1
    coarse = FlowMap(steps)(field, x0, h)
    while steps < LARGEST_REFINEMENT:
        fine = FlowMap(2 * steps)(field, x0, h)
        with np.errstate(over="ignore", invalid="ignore"):  # as above
            size = np.sqrt(((fine - x0) ** 2).mean(axis=1))
            error = np.sqrt(((fine - coarse) ** 2).mean(axis=1))
        # The error of the coarse result; that of the fine one is sixteen times smaller.
        if not (error > tolerance * size).any():
            break
        steps, coarse = 2 * steps, fine
    return FlowMap(steps)


def constant_noise(symbols: Sequence[sympy.Symbol], rate: np.ndarray, *, samples: float) -> NoiseFormula:
    """εD that is the same everywhere, from the covariance of so many residuals per time, ``(d, d)``.

    The entries of a covariance of n normal residuals have the covariance ``(R_ik R_jl + R_il R_jk)/n``.
    """
    d = len(symbols)
    places = np.array([(i, j) for i in range(d) for j in range(i, d)])
    i, j = places.T
    straight, crossed = rate[np.ix_(i, i)] * rate[np.ix_(j, j)], rate[np.ix_(i, j)] * rate[np.ix_(j, i)]
    values, one = rate[i, j], sympy.Integer(1)
    covariance = (straight + crossed) / samples
    return NoiseFormula(tuple(symbols), places, (one,) * len(places), values, covariance, 1.0)


@dataclass(frozen=True)
class NoiseFormula:
    """εD(x) as a sum of terms, with errors.

    Attributes
    ----------
    symbols
        The d states.
    places
        Shape ``(p, 2)``: the entry (i, j), i ≤ j, of each coefficient.
    terms
        The function of each coefficient.
    values, covariance
        Shapes ``(p,)`` and ``(p, p)``, in the states' units squared per time.
    probability
        That a constant D shows as much by chance.
    """

    symbols: tuple[sympy.Symbol, ...]
    places: np.ndarray
    terms: tuple[sympy.Expr, ...]
    values: np.ndarray
    covariance: np.ndarray
    probability: float

    def diffusion(self, intensity: float) -> Diffusion:
        """D, where ε is the intensity."""
        d = len(self.symbols)
        rows = [[sympy.S.Zero for _ in range(d)] for _ in range(d)]
        for (i, j), term, value in zip(self.places, self.terms, self.values, strict=True):
            rows[i][j] += sympy.Float(float(value / intensity), 17) * term
        return Diffusion.of_formulas(
            self.symbols, [[rows[min(i, j)][max(i, j)] for j in range(d)] for i in range(d)]
        )

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

    def as_data(self) -> dict[str, Any]:
        """The terms with their errors, and the covariance, as plain data."""
        names = [each.name for each in self.symbols]
        return {
            "terms": [
                {
                    "row": names[i],
                    "column": names[j],
                    "term": str(term),
                    "coefficient": float(value),
                    "standard_error": float(error),
                }
                for (i, j), term, value, error in zip(
                    self.places, self.terms, self.values, self.standard_errors, strict=True
                )
            ],
            "covariance": self.covariance.tolist(),
            "probability": self.probability,
        }

    @classmethod
    def from_data(cls, data: Mapping[str, Any], symbols: Sequence[sympy.Symbol]) -> NoiseFormula:
        """What `as_data` gave."""
        names = {each.name: each for each in symbols}
        place = {each.name: index for index, each in enumerate(symbols)}
        rows = data["terms"]
        return cls(
            tuple(symbols),
            np.array([[place[row["row"]], place[row["column"]]] for row in rows]),
            tuple(parse_formula(row["term"], names) for row in rows),
            np.array([float(row["coefficient"]) for row in rows]),
            np.array(data["covariance"], dtype=float),
            float(data["probability"]),
        )


NOISE_FREE = 1e-6  # residuals below this share of the increments are the integrator's and the rounding's


@dataclass(frozen=True)
class IdentifiedField:
    """A vector field ``f = Θ Ξ`` with its uncertainty.

    Attributes
    ----------
    library
        The q functions.
    coefficients
        Ξ, shape ``(q, d)``: column i holds the coefficients of f_i.
    support
        Shape ``(p, 2)``: the pair (component i, term k) of each of the p coefficients that are not zero.
    covariance
        Shape ``(p, p)``: their covariance.
    noise_rate
        Shape ``(d, d)``: covariance of the residual per unit of time. For process noise it is ε D, once
        `siq.inference.diffusion_model` has put back what a step forgets.
    residual_ratio
        Rms of the residuals over rms of the increments.
    flow
        The map over a pair's step that was fitted.
    diffusion
        D, which recordings do not tell apart from ε: of these only the product, `noise_rate`, is identified.
    rivals
        What other terms that fit nearly as well make of f. None where nobody asked.
    stability
        Shape ``(p,)``: the share of resampled recordings in which each term would be chosen
        (`siq.inference.selection`). None where nobody asked.
    noise
        εD as a formula of the states, where the recordings show that it depends on them; `noise_rate` is its
        mean over the recorded states then.
    constant_noise
        εD with its errors, where D was estimated and is the same everywhere; None elsewhere.
    """

    library: CandidateLibrary
    coefficients: np.ndarray
    support: np.ndarray
    covariance: np.ndarray
    noise_rate: np.ndarray
    residual_ratio: float
    flow: FlowMap
    diffusion: Diffusion
    rivals: RivalTerms | None = None
    stability: np.ndarray | None = None
    noise: NoiseFormula | None = None
    constant_noise: NoiseFormula | None = None

    def mean_change(self, slopes: np.ndarray) -> np.ndarray:
        """By how much the mean over rival terms moves what follows from f to first order, shape ``(...)``.

        Parameters
        ----------
        slopes
            Derivatives by all coefficients, shape ``(..., q, d)``.
        """
        if self.rivals is None:
            return np.zeros(slopes.shape[:-2])
        return np.asarray(np.einsum("...qd,qd->...", slopes, self.rivals.mean_change))

    def variance(self, slopes: np.ndarray, *, of_mean: bool = False) -> np.ndarray:
        """Variance of what follows from f to first order, by its coefficients and by which terms there are.

        Parameters
        ----------
        slopes
            Derivatives by all coefficients, shape ``(..., q, d)``.
        of_mean
            Whether what follows from f has been moved by `mean_change`. If not, the square of that is a part
            of the result.

        Returns
        -------
        numpy.ndarray
            Shape ``(...)``.
        """
        components, terms = self.support.T
        own = slopes[..., terms, components]
        total = np.einsum("...p,pr,...r->...", own, self.covariance, own)
        if self.rivals is not None:
            changes = np.tensordot(slopes, self.rivals.spread, axes=([-2, -1], [-2, -1]))
            total = total + (changes**2).sum(axis=-1)
            if not of_mean:
                total = total + self.mean_change(slopes) ** 2
        return np.asarray(np.maximum(total, 0.0))

    @cached_property
    def noise_slopes(self) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """``p·(∂D/∂θ) p`` by the k coefficients θ of an estimated εD, at points and momenta: to ``(n, k)``.

        There are none where D was given. Of a constant D only its shape changes: its determinant is 1 by
        definition, and what is left is the error of ε, which stands beside it.
        """
        if self.noise is not None:
            own, intensity = self.noise, self.intensity
            return lambda x, momenta: own.push_slopes(x, momenta) / intensity
        if self.constant_noise is None:
            return lambda x, momenta: np.zeros((len(x), 0))
        constant, intensity = self.constant_noise, self.diffusion.intensity(self.noise_rate)
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
            raise ValueError("D does not depend on the state; ε is that of the residuals")
        place = int(np.flatnonzero(self.noise.places[:, 0] == self.noise.places[:, 1])[0])
        (i, _), term = self.noise.places[place], self.noise.terms[place]
        own = sympy.Poly(self.diffusion.formulas[i][i], *self.library.symbols).coeff_monomial(term)
        return float(self.noise.values[place]) / float(own)

    @cached_property
    def dynamics(self) -> Dynamics:
        """F and D, with the p coefficients that are not zero as parameters, and their covariance."""
        return field_dynamics(
            self.library, self.support, self.values, diffusion=self.diffusion, covariance=self.covariance
        )

    @property
    def values(self) -> np.ndarray:
        """The p coefficients that are not zero."""
        return self.coefficients[self.support[:, 1], self.support[:, 0]]

    @property
    def standard_errors(self) -> np.ndarray:
        """Shape ``(q, d)``: standard error of each coefficient, zero where there is no term."""
        errors = np.zeros_like(self.coefficients)
        errors[self.support[:, 1], self.support[:, 0]] = np.sqrt(np.diag(self.covariance))
        return errors


def field_dynamics(
    library: CandidateLibrary,
    support: np.ndarray,
    values: np.ndarray,
    *,
    diffusion: Diffusion,
    covariance: np.ndarray | None = None,
) -> Dynamics:
    """Dynamics whose parameters are the coefficients of f over some terms of a library.

    Parameters
    ----------
    library
        The q functions of the d states.
    support
        Shape ``(p, 2)``: component and term of each coefficient.
    values
        The coefficients, shape ``(p,)``.
    diffusion
        D.
    covariance
        Of the coefficients, shape ``(p, p)``.
    """
    prefix = "c"
    while any(f"{prefix}{place}" in library.states for place in range(len(support))):
        prefix += "_"
    names = [f"{prefix}{place}" for place in range(len(support))]
    equations = [sympy.S.Zero] * library.dimension
    for (component, term), name in zip(support, names, strict=True):
        equations[component] += symbol(name) * library.terms[term]
    return Dynamics(
        states=library.states,
        equations=tuple(equations),
        diffusion=diffusion,
        parameters=tuple(Parameter(name, float(value)) for name, value in zip(names, values, strict=True)),
        covariance=covariance,
    )


class DiffusionSource(StrEnum):
    """Where D is from, and what has to be said of it."""

    GIVEN = "given"
    ESTIMATED = "estimated"
    OF_VELOCITIES = "estimated of velocities"
    UNIT = "unit"
    UNIT_OF_VELOCITIES = "unit of velocities"

    @property
    def note(self) -> str | None:
        """What a reader of U has to know; nothing where D was given."""
        return {
            DiffusionSource.GIVEN: None,
            DiffusionSource.ESTIMATED: "D is estimated from the noise of the recordings, since none was"
            " given, and scaled to the determinant 1: ε has the size of the noise, and U is in the unit of ε",
            DiffusionSource.OF_VELOCITIES: "D is estimated from the recorded positions, and its part that"
            " acts on the velocities, the only one there is, scaled to the determinant 1: ε has the size of"
            " the random forces, and U is in the unit of ε",
            DiffusionSource.UNIT: "D is taken as the unit matrix, since none was given and the recordings do"
            " not show it: U, barriers and times follow from it",
            DiffusionSource.UNIT_OF_VELOCITIES: "D is taken as the unit matrix of the velocities, since the"
            " recordings show no random forces: U and barriers follow from it, and times need the strength of"
            " the noise",
        }[self]


UNLIKE_GIVEN = (
    "the noise is stronger at some states than at others, and the D that was given is the same everywhere:"
    " leave it out, or give formulas of the states"
)
STANDARD_ERRORS = 4.0  # derived: chance passes it once in 16 000 pairs of states


def estimated_diffusion(found: IdentifiedField, *, pairs: int) -> Diffusion | None:
    """D as the residuals show it, of determinant 1; None where there is none to be shown.

    States whose noises show no significant correlation have none: an entry of D from chance alone would bring
    a term into g that nothing else asks for.

    The scale of D is a matter of convention, since a factor goes into ε. The determinant, unlike the trace
    or the largest eigenvalue, changes by a mere factor when the unit of one state does. Noise that is alike
    in all directions has the unit matrix, but for the error of the diagonal.

    Parameters
    ----------
    found
        f with the covariance of its residuals.
    pairs
        Number of independent residuals behind it: a correlation of none has the standard error 1/√pairs.

    Returns
    -------
    Diffusion or None
        None without noise, where noise does not reach every state, and where a state is but the derivative
        of another: what its residuals show is the noise of the other, and depends on the step of the pairs.
    """
    if found.noise_free or defined_states(found.dynamics):
        return None
    # To the last bit symmetric, as sums over the pairs are not.
    rate = (found.noise_rate + found.noise_rate.T) / 2
    size = np.sqrt(np.diag(rate))
    correlated = np.abs(rate) > STANDARD_ERRORS / np.sqrt(pairs) * np.outer(size, size)
    rate = np.where(correlated | np.eye(len(rate), dtype=bool), rate, 0.0)
    try:
        whole = Diffusion(rate)
    except ValueError:
        return None
    if not whole.regular:
        return None
    logarithm = float(np.linalg.slogdet(rate)[1])
    return Diffusion(rate / np.exp(logarithm / len(rate)))


def check_units(states: Sequence[str], units: Sequence[str | None]) -> None:
    """Refuse the unit matrix where states are known to have different units.

    Parameters
    ----------
    states
        Their names.
    units
        The unit of each, None where nobody said.

    Raises
    ------
    NumericalFailure
        With both states, and how D is given.
    """
    known = [(name, unit.strip()) for name, unit in zip(states, units, strict=True) if unit]
    other = next(((name, unit) for name, unit in known if unit != known[0][1]), None)
    if other is None:
        return
    (first, one), (second, two) = known[0], other
    raise NumericalFailure(
        f"D is not known: {first} is in {one} and {second} is in {two}, so that no unit matrix can stand for"
        " it, and the recordings carry no white noise that shows it; give D, up to a factor, as"
        " 'recordings.diffusion' of the study, or in Python as StateSpace(diffusion=...)"
    )


def defined_states(dynamics: Dynamics) -> list[str]:
    """States whose equation is another state, but for a factor: ``dx/dt = v``, which no noise drives."""
    return [
        name
        for name, own, formula in zip(dynamics.states, dynamics.symbols, dynamics.formulas, strict=True)
        if formula.as_coeff_Mul()[1] in set(dynamics.symbols) - {own}
    ]


@dataclass(frozen=True, eq=False)
class GivenField:
    """f and D as somebody gave them."""

    dynamics: Dynamics

    @property
    def diffusion(self) -> Diffusion:
        """D."""
        return self.dynamics.diffusion


AnyField = IdentifiedField | GivenField
"""f with what is not known of it."""
