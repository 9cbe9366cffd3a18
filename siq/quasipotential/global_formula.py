"""U over the whole region: one formula of V, with g, in functions of a library, or U of all wells together.

Gauss–Newton on the Hamilton–Jacobi equation starts from the V of networks or of wells with all functions of
the library; then those that their own standard errors do not tell from zero are dropped one by one
(`refine_globally`). Neither M nor anything else that the local route uses takes part.

An f identified from noisy data has no exact decomposition on the terms that V and g have: its coefficients
err independently. Given those terms, only few of its coefficients are free: f = -D∇V + g with ∇V·g = 0
identically. The generalised least-squares fit of f within that family uses all of the data's information
about V, which solving the Hamilton–Jacobi equation for the f found does not (`_fit_orthogonal`).

About each attractor i the quasipotential is ``U_i(x)``, zero there. The one that the invariant distribution
follows, ``p ~ exp(-U/ε)``, is

    U(x) = min_i (W_i + U_i(x)) - min_i W_i,

where W_i is the least total of barriers over all trees of transitions that end in i (M. Freidlin,
A. Wentzell, *Random Perturbations of Dynamical Systems*, chapter 6). For two wells this says that both local
formulas have the same value at the saddle between them.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.special

from siq.errors import NumericalFailure
from siq.inference.field_estimate import FieldEstimate
from siq.inference.library import CandidateLibrary
from siq.numerics.randomness import positive
from siq.quasipotential.hamilton_jacobi import HamiltonJacobi, LibraryBasis
from siq.quasipotential.wells import Well

MOST_WELLS = 6  # of which all trees can be counted
MIN_PROBABILITY = 1e-4  # a probability below which no orthogonal fit is believed
FIT_POINTS = 400  # where ∇V·g is asked to vanish in a joint fit
EXACT = 1e-6  # numerical, of a coefficient: the error of one that holds by definition
MAX_STEPS = 50  # of it
RANK_TOLERANCE = 1e-7  # singular values below this share of the largest are no constraint of their own


@dataclass(frozen=True)
class GlobalFormula:
    """V over the library of f, q functions, and g where it was sought.

    A joint fit of V and g is one at the Cramér–Rao bound, with ∇V·g = 0 identically.
    """

    potential: np.ndarray  #: coefficients of V, shape (q,)
    covariance: np.ndarray  #: shape (q, q), zero for terms that are not there
    residual: float = np.nan  #: relative, of the Hamilton–Jacobi equation on the points of the fit
    sensitivity: np.ndarray | None = None  #: how the coefficients follow the p of f, shape (q, p)
    circulatory: np.ndarray | None = None  #: coefficients of g, shape (q, d)
    circulatory_errors: np.ndarray | None = None  #: their standard errors
    joint: bool = False
    freedom: int = 0  #: constraints on the coefficients of f in a joint fit
    chi_square: float = 0.0  #: squared distance of its f from the identified one, in the covariance of that

    @property
    def probability(self) -> float:
        """Probability of so large a distance by chance: tiny where no such V and g exist."""
        return float(scipy.special.chdtrc(self.freedom, self.chi_square)) if self.freedom else 1.0

    def relative_error(self, functions: np.ndarray) -> float:
        """Relative standard error of V over points at which the library has values, shape ``(n, q)``."""
        values = functions @ self.potential
        lowest = int(np.argmin(values))
        difference = functions - functions[lowest]
        variance = np.einsum("nq,qr,nr->n", difference, self.covariance, difference)
        return float(np.sqrt(np.maximum(variance, 0).sum()) / np.linalg.norm(values - values[lowest]))

    def with_circulation(
        self, found: FieldEstimate, points: np.ndarray, *, false_terms: float, precision: float,
        single_formula: float,
    ) -> GlobalFormula | None:  # fmt: skip
        """The circulation g = f + D∇V with its uncertainty, on the terms that differ from zero.

        Under noise V and g are fitted together: V may fail the Hamilton–Jacobi equation of the identified f
        by as much as f errs. What tells whether that is all is the joint fit: an f that V and g make up
        exactly, and that the data allow. Where there is none V has to solve the equation as without noise;
        None where it does not.
        """
        assert self.sensitivity is not None
        library = found.library
        q, d = library.size, library.dimension
        downhill = library.downhill(found.diffusion)
        circulatory = found.coefficients + np.einsum("ikj,j->ki", downhill, self.potential)
        # δg = δf + D∇δV with δV = S δf, coefficient by coefficient
        response = np.einsum("ikj,jp->ikp", downhill, self.sensitivity)
        response[*found.support.T, np.arange(len(found.support))] += 1.0
        errors = np.sqrt(np.einsum("ikp,pr,ikr->ki", response, found.covariance, response))
        size = np.sqrt((library.evaluate(points) ** 2).mean(axis=0))[:, None]
        speed = np.sqrt((found.dynamics.drift(points) ** 2).mean(axis=0))[None, :]
        critical = float(-scipy.special.ndtri(false_terms / (2 * q * d)))
        weak = np.abs(circulatory) * size < precision * speed.max()
        if not found.noise_free:
            weak |= np.abs(circulatory) < critical * errors
        circulatory = np.where(weak, 0.0, circulatory)
        if not found.noise_free:
            rows = np.unique(np.linspace(0, len(points) - 1, FIT_POINTS).astype(int))
            fit = _fit_orthogonal(found, self.potential, circulatory, points[rows])
            if fit is not None and fit.probability >= MIN_PROBABILITY:
                return fit
            if self.residual >= single_formula:
                return None
        return replace(self, circulatory=circulatory, circulatory_errors=np.where(weak, 0.0, errors))


def fit_values(
    library: CandidateLibrary, points: Sequence[np.ndarray], values: Sequence[np.ndarray]
) -> np.ndarray:
    """Coefficients of V, shape ``(q,)``, by least squares of its values at groups of points ``(n, d)``.

    Each group, as a well, has a constant of its own, and counts as much as any other, however many points
    it has.
    """
    basis, counts = LibraryBasis.of_potential(library), [len(x) for x in points]
    weight = np.repeat([1 / np.sqrt(max(count, 1)) for count in counts], counts)
    constants = np.repeat(np.eye(len(points)), counts, axis=0)
    functions = np.column_stack([basis.values(np.concatenate(points)), constants])
    scale = positive(np.sqrt((functions**2).mean(axis=0)))
    matrix = weight[:, None] * functions / scale
    solution = np.linalg.lstsq(matrix, weight * np.concatenate(values), rcond=1e-10)[0] / scale
    coefficients = np.zeros(library.size)
    coefficients[basis.chosen] = solution[: basis.size]
    return coefficients


def refine_globally(
    start: np.ndarray, found: FieldEstimate, points: np.ndarray, *, false_terms: float = 0.01,
    precision: float = 1e-7, sparse: bool = True,
) -> GlobalFormula:  # fmt: skip
    """Refine V from a start, and keep only the terms that the data support.

    Parameters
    ----------
    start
        Coefficients of V over the library of f, shape ``(q,)``.
    found, points
        The identified f with its uncertainty, and where the equation is asked for, shape ``(n, d)``.
    false_terms
        Probability that the uncertainty of f alone brings any false term into V.
    precision
        Terms that contribute less than this share of V are dropped in any case; none at all if not `sparse`.

    Raises
    ------
    NumericalFailure
        Where there are fewer points than terms, as of levels without noise.
    """
    library = found.library
    basis = LibraryBasis.of_potential(library)
    if len(points) < basis.size:
        raise NumericalFailure(
            f"states were recorded at {len(points)} places, too few for {basis.size} terms of V"
        )
    equation = HamiltonJacobi.at(basis, points, found.dynamics)
    solution, left = equation.gauss_newton(start[basis.chosen])
    critical = float(-scipy.special.ndtri(false_terms / (2 * basis.size)))
    # Dropping terms changes the others, hence the errors: repeat until nothing more can go.
    for _ in range(6 if sparse else 0):
        kept = _eliminate(equation, solution, found, critical, precision)
        if len(kept) == basis.size or not len(kept):
            break
        equation = replace(equation, gradients=equation.gradients[:, :, kept])
        basis = LibraryBasis(library, basis.chosen[kept])
        solution, left = equation.gauss_newton(solution[kept])
    # Coefficients of V follow those of f to first order; a residual that no V here can remove adds to their
    # uncertainty.
    inverse = _left_inverse(equation.jacobian(solution))
    response = -inverse @ _forcing(equation, solution, found)
    residual = equation.residual(solution)
    misfit = float(residual @ residual) / max(len(residual) - len(inverse), 1) * (inverse @ inverse.T)
    q, p = library.size, len(found.support)
    coefficients, sensitivities, covariance = np.zeros(q), np.zeros((q, p)), np.zeros((q, q))
    coefficients[basis.chosen] = solution
    sensitivities[basis.chosen] = response
    covariance[np.ix_(basis.chosen, basis.chosen)] = response @ found.covariance @ response.T + misfit
    return GlobalFormula(coefficients, covariance, left, sensitivities)


def _left_inverse(jacobian: np.ndarray) -> np.ndarray:
    """The inverse of least squares, shape ``(m, n)``, of columns that may be of very different sizes."""
    scale = positive(np.linalg.norm(jacobian, axis=0))
    return np.asarray(np.linalg.pinv(jacobian / scale, rcond=1e-11) / scale[:, None])


def _forcing(equation: HamiltonJacobi, coefficients: np.ndarray, found: FieldEstimate) -> np.ndarray:
    """Derivative of the residual by each of the p coefficients of f, shape ``(n, p)``."""
    components, functions = found.support.T
    slopes = equation.slopes(coefficients)[:, components]
    return equation.weight[:, None] * slopes * found.library.evaluate(equation.points)[:, functions]


def _eliminate(
    equation: HamiltonJacobi, coefficients: np.ndarray, found: FieldEstimate, critical: float,
    precision: float,
) -> np.ndarray:  # fmt: skip
    """Backward elimination in the linearised equation: positions of the terms to be kept."""
    jacobian = equation.jacobian(coefficients)
    goal = jacobian @ coefficients - equation.residual(coefficients)
    forcing = -_forcing(equation, coefficients, found)
    # Everything depends on the points through a triangular matrix only.
    triangle = np.asarray(np.linalg.qr(np.column_stack([jacobian, goal, forcing]), mode="r"))
    m, spread = len(coefficients), equation.sizes()
    size = np.sqrt(equation.diffusion.contract(equation.points, equation.slopes(coefficients)).mean()) or 1.0
    rows = max(len(equation.points) - m, 1)
    active = np.arange(m)
    while len(active):
        columns = triangle[:, active]
        scale = positive(np.linalg.norm(columns, axis=0))
        # The inverse of least squares; by QR where columns are independent, which is ten times faster.
        orthogonal, upper = np.linalg.qr(columns / scale)
        diagonal = np.abs(np.diag(upper))
        if diagonal.min() > 1e-10 * diagonal.max():
            inverse = scipy.linalg.solve_triangular(upper, orthogonal.T) / scale[:, None]
        else:
            inverse = _left_inverse(columns)
        current = inverse @ triangle[:, m]
        misfit = triangle[:, m] - columns @ current
        response = inverse @ triangle[:, m + 1 :]
        variance = np.einsum("mp,pq,mq->m", response, found.covariance, response)
        variance = variance + misfit @ misfit / rows * (inverse**2).sum(axis=1)
        contribution = np.abs(current) * spread[active] / size
        certainty = np.abs(current) / (critical * np.sqrt(variance) + 1e-300)
        strength = np.minimum(certainty, contribution / precision)
        weakest = int(np.argmin(strength))
        if strength[weakest] >= 1:
            break
        active = np.delete(active, weakest)
    return active


def _fit_orthogonal(
    found: FieldEstimate, potential: np.ndarray, circulatory: np.ndarray, points: np.ndarray
) -> GlobalFormula | None:
    """Fit V and g on their terms so that f = -D∇V + g, ∇V·g = 0, is closest to the identified f.

    ∇V·g is asked to vanish at points; more of them than coefficients make it vanish identically. None where
    the iteration finds no decomposition that is orthogonal to rounding.
    """
    library, noise = found.library, found.diffusion
    q, d = library.size, library.dimension
    # The family f = -D∇V + g is linear in θ = (coefficients of V, of g).
    of_potential, of_circulatory = potential != 0, circulatory.T != 0
    terms, places = np.flatnonzero(of_potential), np.argwhere(of_circulatory)
    count = len(terms)
    whole = np.zeros((d, q, count + len(places)))
    whole[:, :, :count] = -library.downhill(noise)[:, :, terms]
    whole[*places.T, count + np.arange(len(places))] = 1.0
    components, functions = found.support.T
    listed = np.zeros((d, q), dtype=bool)
    listed[components, functions] = True
    values = library.evaluate(points)
    speed = np.sqrt(noise.squared_speed(points, found.dynamics.drift(points)))
    usual = np.sqrt((speed**2).mean())
    # What one unit of each term adds to f, relative to f.
    sizes = np.sqrt(np.outer(np.diag(noise.precision), (values**2).mean(axis=0))) / usual
    absent = (sizes[:, :, None] * whole)[~listed]
    absent = absent[np.abs(absent).any(axis=1)]
    gradients = np.einsum("nk,kij->nij", values, library.derivatives[:, :, terms])
    circulation = np.einsum("nk,ikj->nij", values, whole[:, :, count:])
    slopes = np.sqrt(noise.contract(points, gradients.transpose(0, 2, 1)))
    scale = positive(np.concatenate([np.sqrt((slopes**2).mean(axis=0)) / usual, sizes[of_circulatory]]))
    weight = 1 / np.maximum(speed, 1e-3 * speed.max()) / usual / np.sqrt(len(points))

    def constraints(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weighted ∇V·g at the points and the terms that f does not have, with their derivatives."""
        gradient, turning = gradients @ theta[:count], circulation @ theta[count:]
        slopes = (np.einsum("nd,ndj->nj", turning, gradients), np.einsum("nd,ndj->nj", gradient, circulation))
        product = weight * (gradient * turning).sum(axis=1)
        slope = weight[:, None] * np.concatenate(slopes, axis=1)
        return np.concatenate([product, absent @ theta]), np.concatenate([slope, absent])

    theta = np.concatenate([potential[of_potential], circulatory.T[of_circulatory]])
    variance = np.diag(found.covariance)
    exact = np.where(variance > 0, 0.0, (EXACT * found.values) ** 2)  # such as that of v in dx = v dt
    whiten = scipy.linalg.solve_triangular(
        np.linalg.cholesky(found.covariance + np.diag(exact)), np.eye(len(found.support)), lower=True
    )
    # Coefficients in units of what each of them does to f, so that the units of the states do not matter.
    design = whiten @ whole[components, functions] / scale
    for _ in range(MAX_STEPS):
        violation, slope = constraints(theta)
        left, singular, right = np.linalg.svd(slope / scale, full_matrices=True)
        rank = int((singular > RANK_TOLERANCE * singular[0]).sum()) if len(singular) else 0
        restore = -right[:rank].T @ ((left[:, :rank].T @ violation) / singular[:rank])
        tangent = right[rank:].T
        wanted = whiten @ found.values - design @ (theta * scale + restore)
        step = restore.copy()
        if tangent.shape[1]:
            step += tangent @ np.linalg.lstsq(design @ tangent, wanted, rcond=None)[0]
        theta = theta + step / scale
        if np.linalg.norm(step) <= 1e-13 * np.linalg.norm(theta * scale):
            break
    if not np.isfinite(theta).all() or np.abs(constraints(theta)[0]).max() > 1e-8:
        return None
    inverse = tangent @ np.linalg.pinv(design @ tangent) / scale[:, None]
    covariance = inverse @ inverse.T
    distance = whiten @ found.values - design @ (theta * scale)
    of_v, of_v_covariance, of_g, of_g_errors = (np.zeros(n) for n in (q, (q, q), (d, q), (d, q)))
    of_v[terms], of_g[of_circulatory] = theta[:count], theta[count:]
    of_v_covariance[np.ix_(terms, terms)] = covariance[:count, :count]
    of_g_errors[of_circulatory] = np.sqrt(np.maximum(np.diag(covariance)[count:], 0))
    return GlobalFormula(
        of_v, of_v_covariance, circulatory=of_g.T, circulatory_errors=of_g_errors.T, joint=True,
        freedom=len(found.values) - tangent.shape[1], chi_square=float(distance @ distance),
    )  # fmt: skip


@dataclass(frozen=True)
class GlobalQuasipotential:
    """U over all wells, where it is known."""

    wells: tuple[Well, ...]  #: V about the attractors
    heights: np.ndarray  #: U at the attractors, shape (k,); the lowest is zero

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """U at points ``(n, d)``: shape ``(n,)``, NaN where it is not known."""
        return np.fmin.reduce(self.by_well(x))

    def by_well(self, x: np.ndarray) -> np.ndarray:
        """``W_i + U_i`` at points, shape ``(k, n)``, NaN where the formula of a well is not believed."""
        return np.stack(
            [
                h + 2 * one.known_values(self.placed(one, x))
                for h, one in zip(self.heights, self.wells, strict=True)
            ]
        )

    def placed(self, well: Well, x: np.ndarray) -> np.ndarray:
        """Points ``(n, d)``, moved by whole periods to where V of a well is least."""
        dynamics = well.dynamics
        if not dynamics.periodic:
            return x
        images = dynamics.wrapped(x) + dynamics.shifts[:, None]
        values = [well.known_values(each) for each in images]
        return np.asarray(images[np.argmin(np.nan_to_num(values, nan=np.inf), axis=0), np.arange(len(x))])


def heights_of_attractors(barriers: np.ndarray) -> np.ndarray:
    """U at the attractors, shape ``(k,)``, the lowest being zero, from the barriers between them.

    The barriers, ``(k, k)``, are the lowest of U on the way from i to j in one step, infinite where there is
    none. It fails (`NumericalFailure`) when they do not connect the attractors, or there are too many of
    them.
    """
    count = len(barriers)
    if count > MOST_WELLS:
        raise NumericalFailure(f"there are {count} attractors; heights are found for {MOST_WELLS} at most")
    totals = np.full(count, np.inf)
    for root in range(count):
        others = [index for index in range(count) if index != root]
        for targets in itertools.product(range(count), repeat=count - 1):
            step = dict(zip(others, targets, strict=True))
            total = float(sum(barriers[start, end] for start, end in step.items()))
            ends = others
            if total < totals[root]:
                for _ in others:  # of a tree every branch has arrived at the root by then
                    ends = [step.get(index, root) for index in ends]
                totals[root] = total if all(end == root for end in ends) else totals[root]
    if not np.isfinite(totals).all():
        raise NumericalFailure(
            "no transitions over known saddles connect all attractors: their heights are not known"
        )
    return np.asarray(totals - totals.min())
