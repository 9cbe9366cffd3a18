"""The identified f: coefficients over a library, with their covariance, and what the residuals leave."""

from __future__ import annotations

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
    doubts
        Shape ``(r, q, d)``: by how much f would change with other terms that fit nearly as well, each scaled
        by the square root of its probability (`siq.identify.selection`). None where nobody asked.
    stability
        Shape ``(p,)``: the share of resampled recordings in which each term would be chosen
        (`siq.identify.stability`). None where nobody asked.
    noise
        εD as a formula of the states, where the recordings show that it depends on them; `noise_rate` is its
        mean over the recorded states then.
    """

    library: CandidateLibrary
    coefficients: np.ndarray
    support: np.ndarray
    covariance: np.ndarray
    noise_rate: np.ndarray
    residual_ratio: float
    flow: FlowMap
    diffusion: Diffusion
    doubts: np.ndarray | None = None
    stability: np.ndarray | None = None
    noise: NoiseFormula | None = None

    def variance(self, slopes: np.ndarray) -> np.ndarray:
        """Variance of what follows from f to first order, by its coefficients and by which terms there are.

        Parameters
        ----------
        slopes
            Derivatives by all coefficients, shape ``(..., q, d)``.

        Returns
        -------
        numpy.ndarray
            Shape ``(...)``.
        """
        components, terms = self.support.T
        own = slopes[..., terms, components]
        total = np.einsum("...p,pr,...r->...", own, self.covariance, own)
        if self.doubts is not None and len(self.doubts):
            changes = np.tensordot(slopes, self.doubts, axes=([-2, -1], [-2, -1]))
            total = total + (changes**2).sum(axis=-1)
        return np.asarray(np.maximum(total, 0.0))

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
