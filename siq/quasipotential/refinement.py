"""Refinement of what the networks found to formulas of V and g.

Gauss–Newton on the Hamilton–Jacobi equation starts from the regression's V with all functions of the library,
then drops, one by one, those that their own standard errors do not tell from zero. Neither M nor anything
else that the local route uses takes part.

An f identified from noisy data has no exact decomposition on the terms that V and g have: its coefficients
err independently. Given those terms, only few of its coefficients are free: f = -D∇V + g with ∇V·g = 0
identically. The generalised least-squares fit of f within that family uses all of the data's information
about V, which solving the Hamilton–Jacobi equation for the f found does not.

Two routes lead to V. They share f, the recorded points and Gauss–Newton; and by `training.check` networks are
trained until they agree with the local route, so that their agreement is no evidence from elsewhere. The
*network route* starts from the networks and seeks one formula for the whole recorded region; where no single
formula can hold, since V has a kink between its wells, it takes each well for itself. The *local route* grows
V from each attractor, and needs no network. Whether to believe either is
decided by `siq.quasipotential.certificate_tests`.

It does, in small, what will be done in earnest afterwards: V_θ is written in powers, refined on the
Hamilton–Jacobi equation of the identified f, and compared with the local route, which needs no network.
Whatever passes was thereby selected for agreement: that of a certificate is a test of consistency alone.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from dataclasses import dataclass as plain_dataclass
from typing import Annotated, Literal

import numpy as np
import scipy.linalg
import scipy.special
import sympy
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as pydantic_dataclass

from siq.errors import NumericalFailure
from siq.inference.field_estimate import IdentifiedField
from siq.inference.library import CandidateLibrary, joint_library, total_degree
from siq.inference.selection import RivalTerms
from siq.networks.decomposition import CheckOptions, TrainedNetworks
from siq.quasipotential.formulas import SymbolicDecomposition, minimum
from siq.quasipotential.hamilton_jacobi import (
    HamiltonJacobi,
    LibraryBasis,
    Solution,
    affordable_degree,
    equation_at,
    gauss_newton,
    potential_basis,
    sensitivity,
)
from siq.quasipotential.wells import Well, WellOptions, fit_well, local_well
from siq.systems.phase_portrait import PhasePortrait, evenly_spread, phase_portrait

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
    size = np.sqrt(equation.diffusion.contract(equation.points, gradient).mean()) or 1.0
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
        slopes = np.sqrt(noise.contract(points, self.gradients.transpose(0, 2, 1)))
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


Route = Literal["network", "local"]

IMPLAUSIBLE = 1e-4  # a probability below which no orthogonal fit is believed
NETWORK_DEGREE = 8  # highest power of a well by the network route, whose start knows no more
ON_SOME = "noise acts on some states only: V has one formula for each well, and none over all of them"
ELSEWHERE = "where D depends on the state no single formula is sought: each well has its own"
FIT_POINTS = 400  # where ∇V·g is asked to vanish in a joint fit


@pydantic_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class RefinementOptions(WellOptions):
    """How V is refined, about each attractor and over the whole region.

    Attributes
    ----------
    degrees, accuracy, reach, tolerance
        Of the local route; see `siq.quasipotential.wells.WellOptions`.
    routes
        ``network``, ``local``, or both, which are then compared with each other. By default both where
        networks are asked for, and otherwise the local one; see `with_routes`.
    formula_degree
        Highest power of one formula for the whole region; by default what the identified f allows, see
        `formula_library`.
    functions
        Further functions that such a formula may use, as formulas of the states, beside those of f.
    single_formula
        Largest relative Hamilton–Jacobi residual with which one formula stands for the whole region.
    false_terms
        Probability that the uncertainty of f brings any false term into V.
    precision
        Terms that contribute less than this share are dropped in any case.
    """

    routes: Annotated[tuple[Route, ...], Field(min_length=1)] | None = None
    formula_degree: Annotated[int, Field(ge=1, le=12)] | None = None
    functions: tuple[str, ...] = ()
    single_formula: Annotated[float, Field(gt=0)] = 0.005
    false_terms: Annotated[float, Field(gt=0, lt=0.5)] = 0.01
    precision: Annotated[float, Field(gt=0, lt=0.1)] = 1e-7

    def with_routes(self, *, networks: bool) -> RefinementOptions:
        """These options with the routes named, where nobody named them: those that there are."""
        there: tuple[Route, ...] = ("network", "local") if networks else ("local",)
        return self if self.routes is not None else replace(self, routes=there)


@plain_dataclass(frozen=True)
class Refined:
    """What both routes found.

    Attributes
    ----------
    found
        The identified f.
    library
        The functions of the formulas below: those of f and of V together.
    potential
        Coefficients of V over it, shape ``(q,)``, where one formula holds over the whole region; else None.
    circulatory
        Those of g, shape ``(q, d)``.
    potential_covariance
        Shape ``(q, q)``.
    circulatory_errors
        Standard errors of g, shape ``(q, d)``.
    residual
        Relative Hamilton–Jacobi residual of V.
    joint
        Whether V and g were fitted together at the Cramér–Rao bound.
    wells
        By the local route, one for each attractor.
    network_wells
        By the network route, where it found no single formula.
    notes
        What could not be done, in words.
    """

    found: IdentifiedField
    library: CandidateLibrary
    potential: np.ndarray | None
    circulatory: np.ndarray | None
    potential_covariance: np.ndarray | None
    circulatory_errors: np.ndarray | None
    residual: float
    joint: bool
    wells: tuple[Well, ...]
    network_wells: tuple[Well, ...]
    notes: tuple[str, ...]


def formula_library(found: IdentifiedField, options: RefinementOptions) -> CandidateLibrary:
    """The functions in which one formula of V is sought for the whole region.

    No polynomial V has a higher degree than f has, and one: of ``∇V·(f + D∇V) = 0`` the highest powers would
    be those of ``∇V·D∇V``, which cannot vanish where D is regular. Where V is no polynomial, a quartic is the
    least that has two wells; so this is the default.

    Parameters
    ----------
    found
        The identified f.
    options
        Its degree and functions, where the study says them.
    """
    degree = options.formula_degree
    if degree is None:
        highest = max(total_degree(found.library, term) for _, term in found.support)
        degree = affordable_degree(found.library.dimension, max(4, highest + 1))
    return joint_library(found.library, degree=degree, potential_degree=degree, further=options.functions)


def refine(
    found: IdentifiedField,
    portrait: PhasePortrait,
    *,
    library: CandidateLibrary,
    formula: np.ndarray | None,
    network: Callable[[np.ndarray], np.ndarray] | None,
    points: np.ndarray,
    options: RefinementOptions,
    seed: int = 0,
) -> Refined:
    """Follow the routes that the options name.

    Parameters
    ----------
    found
        The identified f.
    portrait
        Attractors, saddles and basins of f.
    library
        The functions that f, V and g may use. It must hold all of f's.
    formula
        The regression's coefficients of V over the library, shape ``(q,)``: the start of the network route.
    network
        V_θ, points ``(n, d)`` to values ``(n,)``: its second start, where the formula leads nowhere.
    points
        Recorded states over which one formula is sought, shape ``(n, d)``.
    options
        The routes, and what they keep.
    seed
        Decides which points are used where there are too many.
    """
    notes: list[str] = []
    routes = options.with_routes(networks=network is not None).routes or ()
    found = over_library(found, library)
    wells: tuple[Well, ...] = ()
    if "local" in routes:
        wells, notes = local_wells(found, portrait, options=options, seed=seed)

    def globally(start: np.ndarray) -> GlobalPotential:
        return refine_globally(
            start, library, found, points,
            false_terms=options.false_terms, precision=options.precision,
        )  # fmt: skip

    limit = allowed_residual(found, options)
    best: GlobalPotential | None = None
    network_wells: Sequence[Well] = ()
    if "network" in routes:
        starts: Iterable[np.ndarray] = [] if formula is None else [formula]
        if network is not None:
            further = network_starts(library, found, points, network(points))
            starts = itertools.chain(starts, further)
        best = _best_of(map(globally, starts), limit)
        if network is not None and not _good(best, limit):
            network_wells = _network_wells(found, portrait, wells, network, seed, notes)
    elif wells:
        network_wells = wells
    if not found.diffusion.constant:  # g = f + D∇V would need functions that no library has
        notes.append(ELSEWHERE)
        return _without_formula(found, library, best, wells, network_wells, routes, notes)
    if not found.diffusion.regular:  # the equation of Hamilton and Jacobi is weighed by its inverse
        notes.append(ON_SOME)
        return _without_formula(found, library, best, wells, network_wells, routes, notes)
    if network_wells and not _good(best, limit):
        # Refined one by one, the wells may turn out to share one formula. All of them together make the
        # start: one alone does not tell an odd power from an even one, and goes on wrongly in the others.
        groups = [network_wells, *([well] for well in network_wells if len(network_wells) > 1)]
        values = (fit_wells(library, group) for group in groups)
        best = _best_of(map(globally, values), limit, best)
    if best is not None and _good(best, limit):
        whole = _with_circulation(best, found, points, options, wells, notes)
        if whole is not None:
            return whole
    notes.append("no single formula in this library holds over the whole recorded region")
    return _without_formula(found, library, best, wells, network_wells, routes, notes)


def _without_formula(
    found: IdentifiedField,
    library: CandidateLibrary,
    best: GlobalPotential | None,
    wells: Sequence[Well],
    network_wells: Sequence[Well],
    routes: Sequence[Route],
    notes: Sequence[str],
) -> Refined:
    return Refined(
        found, library, None, None, None, None,
        np.inf if best is None else best.residual, False, tuple(wells),
        tuple(network_wells) if "network" in routes else (), tuple(notes),
    )  # fmt: skip


def _good(trial: GlobalPotential | None, limit: float) -> bool:
    return trial is not None and bool(trial.coefficients.any()) and trial.residual < limit


def _best_of(
    trials: Iterable[GlobalPotential], limit: float, best: GlobalPotential | None = None
) -> GlobalPotential | None:
    """The first that is good enough, otherwise that of the smallest residual."""
    for trial in trials:
        if best is None or trial.residual < best.residual:
            best = trial
        if _good(best, limit):
            break
    return best


def _network_wells(
    found: IdentifiedField,
    portrait: PhasePortrait,
    local: Sequence[Well],
    network: Callable[[np.ndarray], np.ndarray],
    seed: int,
    notes: list[str],
) -> list[Well]:
    """V about each attractor by the network route, in powers no higher than the local route took."""
    degree = max((well.degree for well in local), default=NETWORK_DEGREE)
    degree = affordable_degree(found.library.dimension, min(degree, NETWORK_DEGREE))
    wells = []
    for index, attractor in enumerate(portrait.attractors):
        try:
            wells.append(
                fit_well(
                    found.dynamics,
                    attractor,
                    portrait.basins[index],
                    portrait.saddles[index],
                    network,
                    degree=degree,
                    generator=np.random.default_rng(seed),
                )
            )
        except NumericalFailure as error:
            notes.append(f"network route: {error}")
    return wells


def allowed_residual(found: IdentifiedField, options: RefinementOptions) -> float:
    """Residual up to which one formula is believed to hold: the errors of f make some of it."""
    errors = np.abs(np.sqrt(np.diag(found.covariance)) / found.values)
    noise = 0.0 if found.noise_free else 3 * float(np.sqrt((errors**2).mean()))
    return options.single_formula + noise


def over_library(found: IdentifiedField, library: CandidateLibrary) -> IdentifiedField:
    """The same f over another library that holds all its functions."""
    if found.library is library:
        return found
    position = {term: k for k, term in enumerate(library.terms)}
    coefficients = np.zeros((library.size, library.dimension))
    support = np.empty_like(found.support)
    for row, (component, term) in enumerate(found.support):
        place = position[found.library.terms[term]]
        support[row] = component, place
        coefficients[place, component] = found.coefficients[term, component]
    rivals = found.rivals
    if rivals is not None:
        places = [position[term] for term in found.library.terms]
        mean = np.zeros_like(coefficients)
        spread = np.zeros((len(rivals.spread), *coefficients.shape))
        mean[places], spread[:, places] = rivals.mean_change, rivals.spread
        rivals = RivalTerms(mean, spread)
    return replace(found, library=library, coefficients=coefficients, support=support, rivals=rivals)


def local_wells(
    found: IdentifiedField,
    portrait: PhasePortrait,
    *,
    options: RefinementOptions,
    seed: int = 0,
) -> tuple[tuple[Well, ...], list[str]]:
    """The local route: V about each attractor, and where that was not possible, in words."""
    wells, notes = [], []
    for index in range(len(portrait.attractors)):
        try:
            wells.append(local_well(found.dynamics, portrait, index, options=options, seed=seed))
        except NumericalFailure as error:
            notes.append(f"local route: {error}")
    return tuple(wells), notes


def _with_circulation(
    best: GlobalPotential,
    found: IdentifiedField,
    points: np.ndarray,
    options: RefinementOptions,
    wells: Sequence[Well],
    notes: list[str],
) -> Refined | None:
    """G = f + D∇V with its uncertainty, on the terms that differ from zero; jointly with V under noise.

    Under noise V may fail the Hamilton–Jacobi equation of the identified f by as much as f errs. What tells
    whether that is all is the joint fit: an f that V and g make up exactly, and that the data allow. Where
    there is none V has to solve the equation as without noise; None where it does not.
    """
    library = best.library
    q, d = library.size, library.dimension
    downhill = library.downhill(found.diffusion)
    circulatory = found.coefficients + np.einsum("ikj,j->ki", downhill, best.coefficients)
    # δg = δf + D∇δV with δV = S δf, coefficient by coefficient
    response = np.einsum("ikj,jp->ikp", downhill, best.sensitivity)
    for column, (component, term) in enumerate(found.support):
        response[component, term, column] += 1.0
    errors = np.sqrt(np.einsum("ikp,pr,ikr->ki", response, found.covariance, response))
    values = library.evaluate(points)
    size = np.sqrt((values**2).mean(axis=0))[:, None]
    speed = np.sqrt((found.dynamics.drift(points) ** 2).mean(axis=0))[None, :]
    critical = float(-scipy.special.ndtri(options.false_terms / (2 * q * d)))
    weak = np.abs(circulatory) * size < options.precision * speed.max()
    if not found.noise_free:
        weak |= np.abs(circulatory) < critical * errors
    circulatory = np.where(weak, 0.0, circulatory)
    fit: OrthogonalFit | None = None
    if not found.noise_free:
        rows = np.unique(np.linspace(0, len(points) - 1, FIT_POINTS).astype(int))
        fit = fit_orthogonal(found, best.coefficients, circulatory, points[rows])
        if fit is None or fit.probability < IMPLAUSIBLE:
            fit = None
            if best.residual >= options.single_formula:
                return None
            notes.append("V and g have no exactly orthogonal form on their terms: they are fitted one by one")
    if fit is not None:
        return Refined(
            found, library, fit.potential, fit.circulatory, fit.potential_covariance,
            fit.circulatory_errors, best.residual, True, tuple(wells), (), tuple(notes),
        )  # fmt: skip
    return Refined(
        found, library, best.coefficients, circulatory, best.covariance,
        np.where(weak, 0.0, errors), best.residual, False, tuple(wells), (), tuple(notes),
    )  # fmt: skip


def refined_decomposition(refined: Refined, points: np.ndarray) -> SymbolicDecomposition:
    """V, g and f of a refinement, V zero at its minimum.

    Parameters
    ----------
    refined
        What the routes found.
    points
        Recorded states, shape ``(n, d)``; the minimum of V is sought within their box.

    Returns
    -------
    SymbolicDecomposition
        With f as it was identified, so that f = -D∇V + g is a statement and no definition. Where there is
        one attractor only, its well's formula stands for the whole where no other was found.
    """
    library, found = refined.library, refined.found
    symbols = library.symbols
    wells = refined.wells or refined.network_wells
    vector_field = found.dynamics.formulas
    errors = {
        f"f_{state}": _named(found.standard_errors[:, i], library.names)
        for i, state in enumerate(library.states)
    }
    if refined.potential is None:
        return SymbolicDecomposition(symbols, None, (), vector_field, wells, errors)
    assert refined.circulatory is not None and refined.potential_covariance is not None
    assert refined.circulatory_errors is not None
    value = expression_over(refined.potential, library.terms)
    lowest = minimum(value, symbols, points)
    potential_errors = np.sqrt(np.diag(refined.potential_covariance))
    # The constant is minus the minimum; at the minimum its own place does not matter to first order.
    at = library.evaluate(points[np.argmin(library.evaluate(points) @ refined.potential)][None])[0]
    constant = float(np.sqrt(at @ refined.potential_covariance @ at))
    named = _named(potential_errors, library.names) | {"1": constant}
    errors |= {"V": named, "U": {term: 2 * error for term, error in named.items()}}
    errors |= {
        f"g_{state}": _named(refined.circulatory_errors[:, i], library.names)
        for i, state in enumerate(library.states)
    }
    return SymbolicDecomposition(
        symbols=symbols,
        potential=value - sympy.Float(lowest, 17),
        circulatory=tuple(expression_over(column, library.terms) for column in refined.circulatory.T),
        vector_field=vector_field,
        wells=wells,
        standard_errors=errors,
    )


def expression_over(coefficients: np.ndarray, terms: Sequence[sympy.Expr]) -> sympy.Expr:
    """A sum of terms with float coefficients, zeros left out."""
    return sympy.Add(
        *(sympy.Float(float(c), 17) * term for c, term in zip(coefficients, terms, strict=True) if c != 0)
    )


def relative_error_of(refined: Refined, points: np.ndarray) -> float:
    """Relative standard error of V over points, from the uncertainty of f alone."""
    if refined.potential is None or refined.potential_covariance is None or refined.found.noise_free:
        return 0.0
    functions = refined.library.evaluate(points)
    values = functions @ refined.potential
    lowest = int(np.argmin(values))
    difference = functions - functions[lowest]
    variance = np.einsum("nq,qr,nr->n", difference, refined.potential_covariance, difference)
    size = np.linalg.norm(values - values[lowest])
    return float(np.sqrt(np.maximum(variance, 0).sum()) / size)


def _named(errors: np.ndarray, names: Sequence[str]) -> dict[str, float]:
    return {name: float(error) for name, error in zip(names, errors, strict=True) if error > 0}


Function = Callable[[np.ndarray], np.ndarray]

logger = logging.getLogger(__name__)

WELL_STEPS = 15  # of Gauss–Newton: what does not converge quickly is not ready
DEGREES = (
    4,
    6,
    8,
)  # of the wells with which networks are compared, to some per cent
SHARE = 0.75  # of the recorded points, the lowest in V, on which one formula is tried


@dataclass(frozen=True)
class TrainingCheck:
    """What the check of one run knows beforehand.

    Attributes
    ----------
    found
        The identified f.
    portrait
        Attractors and basins.
    wells
        V about each attractor by the local route, to be compared with.
    library
        Powers for V, with the functions of f.
    options
        When the check passes.
    """

    found: IdentifiedField
    portrait: PhasePortrait
    wells: tuple[Well, ...]
    library: CandidateLibrary
    options: CheckOptions

    def hopeless(self) -> str | None:
        """Why no training can pass, in words; None where one can."""
        fault = self.portrait.fault()
        if fault is None and len(self.wells) < len(self.portrait.attractors):
            fault = "the local route found no formula about some attractor"
        return fault

    def passes(self, networks: TrainedNetworks) -> bool:
        """Whether refinement will succeed from the networks of one run."""
        if self.hopeless() is not None:
            return False

        def potential(x: np.ndarray) -> np.ndarray:
            return networks.evaluate(x).potential

        return self._single_formula(potential) or self._by_wells(potential)

    def _single_formula(self, potential: Function) -> bool:
        points = self.portrait.points
        values = potential(points)
        below = values <= np.quantile(values, SHARE)
        start = fit_values(self.library, points[below], values[below])
        result = refine_globally(start, self.library, self.found, points[below], sparse=False)
        basis = potential_basis(self.library)
        coefficients = result.coefficients[basis.chosen]
        worst = max(self._difference(well, lambda x: basis.values(x) @ coefficients) for well in self.wells)
        logger.info("check of one formula: residual %.1e, difference %.1e", result.residual, worst)
        return result.residual < self.options.residual / 10 and worst < self.options.difference

    def _by_wells(self, potential: Function) -> bool:
        for index, (one, local) in enumerate(zip(self.portrait.attractors, self.wells, strict=True)):
            try:
                well = fit_well(
                    self.found.dynamics, one, self.portrait.basins[index], self.portrait.saddles[index],
                    potential, degree=local.degree,
                    generator=np.random.default_rng(0), steps=WELL_STEPS,
                )  # fmt: skip
            except NumericalFailure:
                return False
            difference = self._difference(local, well.values)
            logger.info("check of a well: residual %.1e, difference %.1e", well.residual, difference)
            allowed = self.options.difference + 2 * (local.residual + well.residual)
            if well.residual > self.options.residual or difference > allowed:
                return False
        return True

    def _difference(self, well: Well, values: Function) -> float:
        """Relative difference of V from that of the local route, in a well."""
        x = well.points[well.values(well.points) < 0.9 * well.level]
        other = values(x) - values(well.attractor[None])
        return float(np.linalg.norm(other - well.values(x)) / np.linalg.norm(well.values(x)))


def training_check(
    found: IdentifiedField, x: np.ndarray, *, options: CheckOptions, seed: int
) -> TrainingCheck:
    """Prepare the check of one run from its identified f and recorded states ``(n, d)``."""
    points = x[evenly_spread(x, generator=np.random.default_rng(seed))]
    setting = phase_portrait(found.dynamics, points, seed=seed)
    wells, _ = local_wells(found, setting, options=RefinementOptions(degrees=DEGREES), seed=seed)
    library = joint_library(found.library, degree=options.degree, potential_degree=options.degree)
    return TrainingCheck(over_library(found, library), setting, wells, library, options)
