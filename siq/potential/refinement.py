"""Refinement: from the identified f, and from what the networks found, to formulas of V and g.

Two routes lead to V. They share f, the recorded points and Gauss–Newton; and by `training.check` networks are
trained until they agree with the local route, so that their agreement is no evidence from elsewhere. The
*network route* starts from the networks and seeks one formula for the whole recorded region; where no single
formula can hold, since V has a kink between its wells, it takes each well for itself. The *local route* grows
V from each attractor, and needs no network. Whether to believe either is decided by `siq.certificate.tests`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
import scipy.special
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from siq.dynamics.phase_portrait import PhasePortrait
from siq.errors import NumericalFailure
from siq.identify.identified_field import IdentifiedField
from siq.identify.library import CandidateLibrary, joint_library, total_degree
from siq.identify.rival_terms import RivalTerms
from siq.potential.bases import affordable_degree
from siq.potential.global_route import (
    GlobalPotential,
    fit_wells,
    network_starts,
    refine_globally,
)
from siq.potential.local_route import fit_well
from siq.potential.local_wells import WellOptions, local_well
from siq.potential.orthogonal_fit import OrthogonalFit, fit_orthogonal
from siq.potential.well import Well

Route = Literal["network", "local"]

IMPLAUSIBLE = 1e-4  # a probability below which no orthogonal fit is believed
NETWORK_DEGREE = 8  # highest power of a well by the network route, whose start knows no more
ON_SOME = "noise acts on some states only: V has one formula for each well, and none over all of them"
ELSEWHERE = "where D depends on the state no single formula is sought: each well has its own"
FIT_POINTS = 400  # where ∇V·g is asked to vanish in a joint fit


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class RefinementOptions(WellOptions):
    """How V is refined, about each attractor and over the whole region.

    Attributes
    ----------
    degrees, accuracy, reach, tolerance
        Of the local route; see `siq.potential.local_wells.WellOptions`.
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
