"""The identified f: coefficients over a library, with their covariance, and what the residuals leave."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import sympy

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics, Parameter
from siq.dynamics.parametric import symbol
from siq.identify.flow import FlowMap
from siq.identify.library import CandidateLibrary
from siq.identify.noise_formula import NoiseFormula
from siq.identify.rival_terms import RivalTerms

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
        `siq.identify.random_forces` has put back what a step forgets.
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
        (`siq.identify.stability`). None where nobody asked.
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
