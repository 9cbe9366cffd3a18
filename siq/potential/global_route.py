"""The network route: one formula of V over the whole recorded region, from the networks' formula.

Gauss–Newton on the Hamilton–Jacobi equation starts from the regression's V with all functions of the library,
then drops, one by one, those that their own standard errors do not tell from zero. Neither M nor anything
else that the local route uses takes part.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.special

from siq.identify.identified_field import IdentifiedField
from siq.identify.library import CandidateLibrary
from siq.potential.bases import LibraryBasis, potential_basis
from siq.potential.hamilton_jacobi import HamiltonJacobi, Solution, equation_at, gauss_newton, sensitivity
from siq.potential.well import Well

LOWER_PARTS = (0.7, 0.5, 0.3)  # of the points, by V


@dataclass(frozen=True)
class GlobalPotential:
    """V over one library, refined.

    Attributes
    ----------
    library
        The q functions.
    coefficients
        Of V, shape ``(q,)``.
    sensitivity
        ∂ξ/∂c, shape ``(q, p)``: how they follow the p coefficients of f.
    covariance
        Shape ``(q, q)``, zero for terms that are not there.
    residual
        Relative Hamilton–Jacobi residual on the points of the fit.
    converged
        Whether Gauss–Newton settled.
    """

    library: CandidateLibrary
    coefficients: np.ndarray
    sensitivity: np.ndarray
    covariance: np.ndarray
    residual: float
    converged: bool


def fit_values(library: CandidateLibrary, x: np.ndarray, potential: np.ndarray) -> np.ndarray:
    """Coefficients of V, shape ``(q,)``, by least squares of its values at points ``(n, d)``."""
    basis = potential_basis(library)
    values = np.column_stack([basis.values(x), np.ones(len(x))])
    scale = np.sqrt((values**2).mean(axis=0))
    solution = np.linalg.lstsq(values / scale, potential, rcond=1e-10)[0] / scale
    coefficients = np.zeros(library.size)
    coefficients[basis.chosen] = solution[:-1]
    return coefficients


def fit_wells(library: CandidateLibrary, wells: Sequence[Well]) -> np.ndarray:
    """Coefficients of V, shape ``(q,)``, by least squares of the V of several wells within each of them.

    How deep the wells are among each other is left open: each has a constant of its own.
    """
    basis = potential_basis(library)
    inside = [well.inside for well in wells]
    counts = [len(x) for x in inside]
    # Every well counts as much as any other, however many points it has.
    weight = np.repeat([1 / np.sqrt(max(count, 1)) for count in counts], counts)
    constants = np.repeat(np.eye(len(wells)), counts, axis=0)
    functions = np.column_stack([basis.values(np.concatenate(inside)), constants])
    scale = np.sqrt((functions**2).mean(axis=0))
    scale = np.where(scale > 0, scale, 1.0)
    goal = np.concatenate([well.values(x) for well, x in zip(wells, inside, strict=True)])
    matrix = weight[:, None] * functions / scale
    solution = np.linalg.lstsq(matrix, weight * goal, rcond=1e-10)[0] / scale
    coefficients = np.zeros(library.size)
    coefficients[basis.chosen] = solution[: basis.size]
    return coefficients


def network_starts(
    library: CandidateLibrary,
    found: IdentifiedField,
    points: np.ndarray,
    potential: np.ndarray,
) -> Iterator[np.ndarray]:
    """Starts for V from its values by the networks, one after the other until one serves.

    The first is the fit of all values. Networks are worst where recordings are few, far out, and Gauss–Newton
    may follow them to a false solution; the further ones are refined on lower and lower parts of V first.

    Parameters
    ----------
    library, found, points
        As for `refine_globally`.
    potential
        V_θ at the points, shape ``(n,)``.
    """
    yield fit_values(library, points, potential)
    for share in LOWER_PARTS:
        part = potential <= np.quantile(potential, share)
        if part.sum() > 2 * library.size:
            start = fit_values(library, points[part], potential[part])
            yield refine_globally(start, library, found, points[part], sparse=False).coefficients


def refine_globally(
    start: np.ndarray,
    library: CandidateLibrary,
    found: IdentifiedField,
    points: np.ndarray,
    *,
    false_terms: float = 0.01,
    precision: float = 1e-7,
    sparse: bool = True,
) -> GlobalPotential:
    """Refine V from a start, and keep only the terms that the data support.

    Parameters
    ----------
    start
        Coefficients of V over the library, shape ``(q,)``.
    library
        The functions that V may use.
    found
        The identified f with its uncertainty.
    points
        Where the equation is asked for, shape ``(n, d)``.
    false_terms
        Probability that the uncertainty of f alone brings any false term into V.
    precision
        Terms that contribute less than this share of V are dropped in any case.
    sparse
        Whether to drop terms at all.
    """
    basis = potential_basis(library)
    equation = equation_at(basis, points, found.dynamics)
    solution = gauss_newton(equation, start[basis.chosen])
    active = np.arange(basis.size)
    if sparse:
        # Dropping terms changes the others, hence the errors: repeat until nothing more can go.
        for _ in range(6):
            kept = _eliminate(
                equation, basis.restricted(active), solution, found,
                critical=float(-scipy.special.ndtri(false_terms / (2 * basis.size))), precision=precision,
            )  # fmt: skip
            if len(kept) == len(active) or not len(kept):
                break
            equation = equation.restricted(kept)
            active = active[kept]
            solution = gauss_newton(equation, solution.coefficients[kept])
    return _assemble(library, basis.restricted(active), equation, solution, found)


def _assemble(
    library: CandidateLibrary,
    basis: LibraryBasis,
    equation: HamiltonJacobi,
    solution: Solution,
    found: IdentifiedField,
) -> GlobalPotential:
    q, p = library.size, len(found.support)
    terms = field_terms(found, equation.points)
    response = sensitivity(equation, solution.coefficients, field_terms=terms, components=found.support[:, 0])
    coefficients, sensitivities, covariance = np.zeros(q), np.zeros((q, p)), np.zeros((q, q))
    coefficients[basis.chosen] = solution.coefficients
    sensitivities[basis.chosen] = response
    misfit = _misfit_covariance(equation, solution)
    covariance[np.ix_(basis.chosen, basis.chosen)] = response @ found.covariance @ response.T + misfit
    return GlobalPotential(
        library, coefficients, sensitivities, covariance, solution.residual, solution.converged
    )


def field_terms(found: IdentifiedField, points: np.ndarray) -> np.ndarray:
    """The function of each of the p coefficients of f at points, shape ``(n, p)``."""
    return found.library.evaluate(points)[:, found.support[:, 1]]


def _misfit_covariance(equation: HamiltonJacobi, solution: Solution) -> np.ndarray:
    """What a residual that no V in this library can remove adds to the uncertainty."""
    jacobian = equation.jacobian(solution.coefficients)
    scale = np.linalg.norm(jacobian, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    inverse = np.linalg.pinv(jacobian / scale, rcond=1e-11)
    residual = equation.residual(solution.coefficients)
    freedom = max(len(residual) - len(scale), 1)
    return float(residual @ residual) / freedom * (inverse @ inverse.T) / np.outer(scale, scale)


def _eliminate(
    equation: HamiltonJacobi,
    basis: LibraryBasis,
    solution: Solution,
    found: IdentifiedField,
    *,
    critical: float,
    precision: float,
) -> np.ndarray:
    """Backward elimination in the linearised equation: positions of the terms to be kept."""
    coefficients = solution.coefficients
    jacobian = equation.jacobian(coefficients)
    goal = jacobian @ coefficients - equation.residual(coefficients)
    gradient = equation.gradients @ coefficients
    forcing = -(
        equation.weight[:, None] * gradient[:, found.support[:, 0]] * field_terms(found, equation.points)
    )
    # Everything depends on the points through a triangular matrix only.
    triangle = np.asarray(np.linalg.qr(np.column_stack([jacobian, goal, forcing]), mode="r"))
    m = len(coefficients)
    spread = equation.sizes()
    size = np.sqrt(equation.diffusion.steepness(equation.points, gradient).mean()) or 1.0
    rows = max(len(equation.points) - m, 1)
    active = np.arange(m)
    while len(active):
        columns = triangle[:, active]
        scale = np.linalg.norm(columns, axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        inverse = _left_inverse(columns / scale) / scale[:, None]
        current = inverse @ triangle[:, m]
        misfit = triangle[:, m] - columns @ current
        response = inverse @ triangle[:, m + 1 :]
        variance = np.einsum("mp,pq,mq->m", response, found.covariance, response)
        variance = variance + misfit @ misfit / rows * (inverse**2).sum(axis=1)
        contribution = np.abs(current) * spread[active] / size
        strength = np.minimum(
            np.abs(current) / (critical * np.sqrt(variance) + 1e-300), contribution / precision
        )
        weakest = int(np.argmin(strength))
        if strength[weakest] >= 1:
            break
        active = np.delete(active, weakest)
    return active


def _left_inverse(columns: np.ndarray) -> np.ndarray:
    """The inverse of least squares; by QR where the columns are independent, which is ten times faster."""
    orthogonal, upper = np.linalg.qr(columns)
    diagonal = np.abs(np.diag(upper))
    if diagonal.min() > 1e-10 * diagonal.max():
        return scipy.linalg.solve_triangular(upper, orthogonal.T)
    return np.linalg.pinv(columns, rcond=1e-11)
