"""Formulas of V and g together, at the Cramér–Rao bound: f constrained to have an orthogonal decomposition.

An f identified from noisy data has no exact decomposition on the terms that V and g have: its coefficients
err independently. Given those terms, only few of its coefficients are free: f = -D∇V + g with ∇V·g = 0
identically. The generalised least-squares fit of f within that family uses all of the data's information
about V, which solving the Hamilton–Jacobi equation for the f found does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.special

from siq.identify.identified_field import IdentifiedField
from siq.identify.library import CandidateLibrary

STEPS = 50
RANK = 1e-7  # singular values below this share of the largest are no constraint of their own


@dataclass(frozen=True)
class OrthogonalFit:
    """V and g over the library of f, with ∇V·g = 0 identically.

    Attributes
    ----------
    potential, circulatory
        Coefficients of V, shape ``(q,)``, and of g, shape ``(q, d)``.
    potential_covariance
        Shape ``(q, q)``.
    circulatory_errors
        Standard errors of g, shape ``(q, d)``.
    freedom
        Number of constraints on the coefficients of f.
    chi_square
        Squared distance of the constrained f from the identified one, in its own covariance.
    """

    potential: np.ndarray
    circulatory: np.ndarray
    potential_covariance: np.ndarray
    circulatory_errors: np.ndarray
    freedom: int
    chi_square: float

    @property
    def probability(self) -> float:
        """Probability of so large a distance by chance: tiny where no such V and g exist."""
        return float(scipy.special.chdtrc(self.freedom, self.chi_square)) if self.freedom else 1.0


def fit_orthogonal(
    found: IdentifiedField,
    potential: np.ndarray,
    circulatory: np.ndarray,
    points: np.ndarray,
) -> OrthogonalFit | None:
    """Fit V and g on their terms so that f = -D∇V + g, ∇V·g = 0, is closest to the identified f.

    Parameters
    ----------
    found
        f with its covariance.
    potential, circulatory
        Coefficients to start from over the library of f, shapes ``(q,)`` and ``(q, d)``; those that are
        zero stay so.
    points
        Where ∇V·g is asked to vanish, shape ``(n, d)``. More points than coefficients make it vanish
        identically.

    Returns
    -------
    OrthogonalFit or None
        None where the iteration finds no decomposition that is orthogonal to rounding.
    """
    library = found.library
    family = _Family(found, potential != 0, circulatory != 0, points)
    theta = np.concatenate([potential[family.of_potential], circulatory.T[family.of_circulatory]])
    whiten = scipy.linalg.solve_triangular(
        np.linalg.cholesky(found.covariance), np.eye(len(found.support)), lower=True
    )
    # Coefficients in units of what each of them does to f, so that the units of the states do not matter.
    design = whiten @ family.observed / family.scale
    tangent = np.zeros((len(theta), 0))
    rank = 0
    for _ in range(STEPS):
        violation, slope = family.constraints(theta)
        left, singular, right = np.linalg.svd(slope / family.scale, full_matrices=True)
        rank = int((singular > RANK * singular[0]).sum()) if len(singular) else 0
        restore = -right[:rank].T @ ((left[:, :rank].T @ violation) / singular[:rank])
        tangent = right[rank:].T
        wanted = whiten @ found.values - design @ (theta * family.scale + restore)
        step = restore.copy()
        if tangent.shape[1]:
            step += tangent @ np.linalg.lstsq(design @ tangent, wanted, rcond=None)[0]
        theta = theta + step / family.scale
        if np.linalg.norm(step) <= 1e-13 * np.linalg.norm(theta * family.scale):
            break
    violation, _slope = family.constraints(theta)
    if not np.isfinite(theta).all() or np.abs(violation).max() > 1e-8:
        return None
    inverse = tangent @ np.linalg.pinv(design @ tangent) / family.scale[:, None]
    covariance = inverse @ inverse.T
    distance = whiten @ found.values - design @ (theta * family.scale)
    q, d = library.size, library.dimension
    count = int(family.of_potential.sum())
    fitted_potential, fitted = np.zeros(q), np.zeros((d, q))
    fitted_potential[family.of_potential] = theta[:count]
    fitted[family.of_circulatory] = theta[count:]
    potential_covariance, errors = np.zeros((q, q)), np.zeros((d, q))
    terms = np.flatnonzero(family.of_potential)
    potential_covariance[np.ix_(terms, terms)] = covariance[:count, :count]
    errors[family.of_circulatory] = np.sqrt(np.maximum(np.diag(covariance)[count:], 0))
    return OrthogonalFit(
        fitted_potential, fitted.T, potential_covariance, errors.T,
        freedom=len(found.values) - tangent.shape[1], chi_square=float(distance @ distance),
    )  # fmt: skip


class _Family:
    """Fields f = -D∇V + g over given terms, linear in θ = (coefficients of V, of g), and ∇V·g."""

    def __init__(
        self,
        found: IdentifiedField,
        of_potential: np.ndarray,
        of_circulatory: np.ndarray,
        points: np.ndarray,
    ) -> None:
        library: CandidateLibrary = found.library
        q, d = library.size, library.dimension
        self.of_potential, self.of_circulatory = of_potential, of_circulatory.T
        terms = np.flatnonzero(of_potential)
        places = np.argwhere(self.of_circulatory)
        downhill = library.downhill(found.diffusion)[:, :, terms]
        whole = np.zeros((d, q, len(terms) + len(places)))
        whole[:, :, : len(terms)] = -downhill
        for column, (i, k) in enumerate(places):
            whole[i, k, len(terms) + column] = 1.0
        listed = np.zeros((d, q), dtype=bool)
        listed[found.support[:, 0], found.support[:, 1]] = True
        self.observed = whole[found.support[:, 0], found.support[:, 1]]
        values = library.evaluate(points)
        noise = found.diffusion
        speed = np.sqrt(noise.squared_speed(points, found.dynamics.drift(points)))
        usual = np.sqrt((speed**2).mean())
        # What one unit of each term adds to f, relative to f.
        sizes = np.sqrt(np.outer(np.diag(noise.precision), (values**2).mean(axis=0))) / usual
        self.absent = (sizes[:, :, None] * whole)[~listed]
        self.absent = self.absent[np.abs(self.absent).any(axis=1)]
        self.gradients = np.einsum("nk,kij->nij", values, library.derivatives[:, :, terms])
        self.circulation = np.zeros((len(points), d, len(places)))
        for column, (i, k) in enumerate(places):
            self.circulation[:, i, column] = values[:, k]
        slopes = np.sqrt(noise.steepness(points, self.gradients.transpose(0, 2, 1)))
        scale = np.concatenate([np.sqrt((slopes**2).mean(axis=0)) / usual, sizes[self.of_circulatory]])
        self.scale = np.where(scale > 0, scale, 1.0)
        self.weight = 1 / np.maximum(speed, 1e-3 * speed.max()) / usual / np.sqrt(len(points))

    def constraints(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weighted ∇V·g at the points and the terms that f does not have, with their derivatives."""
        count = self.gradients.shape[2]
        gradient = self.gradients @ theta[:count]
        circulation = self.circulation @ theta[count:]
        weight = self.weight[:, None]
        slope = np.concatenate(
            [
                weight * np.einsum("nd,ndj->nj", circulation, self.gradients),
                weight * np.einsum("nd,ndj->nj", gradient, self.circulation),
            ],
            axis=1,
        )
        product = self.weight * (gradient * circulation).sum(axis=1)
        return (
            np.concatenate([product, self.absent @ theta]),
            np.concatenate([slope, self.absent]),
        )
