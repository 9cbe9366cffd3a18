"""Functions without a name, fitted: in which places, with how many powers or knots.

Smooth functions are compared in all places by their evidence (`siq.mismatch.evidence`), along the
trajectories of a fit and at several levels of random forces, as mechanisms are screened. In the best places
a formula of a few powers and a spline are fitted in earnest.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy

from siq.dynamics.parametric import symbol
from siq.errors import NumericalFailure
from siq.estimation.budget import BudgetSpent
from siq.estimation.estimation import SUBSTEP_ERROR, Fit
from siq.estimation.innovations import Whitened, profile_likelihood, whiten
from siq.estimation.linearisation import Grid, substeps_needed
from siq.estimation.measurements import Measurements
from siq.estimation.process_noise import (
    fit_with_and_without_process_noise,
    fit_with_process_noise_as_needed,
    simpler_fit,
)
from siq.mismatch.candidates import MechanismCandidate
from siq.mismatch.clusters import correlation_time_of
from siq.mismatch.evidence import evidence_of_function, orthonormal
from siq.mismatch.function_places import (
    Place,
    cardinal_splines,
    linearised_with_places,
    places_in,
    products_in,
)
from siq.mismatch.functions import FORMULA, SPLINE, Power, powers, simplest, with_formula, with_spline
from siq.mismatch.nameless_models import Material, Model, Part, weighed
from siq.mismatch.probes import Probe, ProbeColumns
from siq.mismatch.roles import Roles
from siq.mismatch.screening import LEVELS, probe_response, projected
from siq.mismatch.trials import PROBE_SUBSTEPS, UNFORESEEN, TriedMechanism, judged

LOGGER = logging.getLogger(__name__)
FITTED = 3  # places in which functions are fitted, the most likely ones: a choice


@dataclass(frozen=True)
class LikelyPlace:
    """A place, the logarithm of its evidence, and the level of random forces at which it is best.

    The evidence is that of a smooth function there over that of none, each at its best level.
    """

    place: Place
    log_evidence: float
    level: float


def with_a_function(before: tuple[Part, ...], fit: Fit, material: Material) -> list[Model]:
    """Models with one function more, in the likeliest places, that earn it.

    Parameters
    ----------
    before, fit
        What was added already, and the fit with it.
    material
        What models are made from.

    Returns
    -------
    list of Model
        The likeliest first, with the evidence over that of `fit`.
    """
    data, budget = material.data, material.budget
    budget.says("comparing functions without a name")
    try:
        ranked = likely_places(fit, data, material.roles)
    except UNFORESEEN as error:
        LOGGER.info("no function can be screened: %s", error)
        return []
    cost = float(np.log(max(len(ranked), 1)))  # a function is chosen among so many places
    ranked = [each for each in ranked if each.log_evidence > cost]
    if not ranked:
        return []
    models = _formulas(before, fit, ranked, cost, material)
    curved = {(ranked[0].place.targets, ranked[0].place.words)}
    for best in weighed(models, fit, data)[:1]:
        if best.parts[-1].place is not None:
            curved.add((best.parts[-1].place.targets, best.parts[-1].place.words))
    for likely in ranked:
        if (likely.place.targets, likely.place.words) in curved:
            for knots in few_knots(likely, fit, data):
                candidate = with_spline(fit.model, likely.place, knots)
                part = _part(candidate, likely, likely.place, fit, cost, material, knots=knots)
                models += [Model((*before, each), each.trial.fit) for each in part]
    given = sum(part.cost for part in before)
    found = [replace(each, log_evidence=each.log_evidence + given) for each in weighed(models, fit, data)]
    for each in found:
        last = each.parts[-1]
        LOGGER.info(
            "%s as a %s: log-evidence better by %.1f",
            last.trial.candidate.label, last.kind, each.log_evidence,
        )  # fmt: skip
    return [each for each in found if each.log_evidence > 0]


def _formulas(
    before: tuple[Part, ...], fit: Fit, ranked: Sequence[LikelyPlace], cost: float, material: Material
) -> list[Model]:
    """Formulas in the likeliest places, each once."""
    single = {(each.place.targets, each.place.words): each.place.knots for each in ranked}
    done: set[frozenset[tuple[str, sympy.Expr]]] = set()
    models: list[Model] = []
    for likely in ranked[:FITTED]:
        terms = few_powers(likely, fit, material.data, degree=material.degree)
        if not terms:
            continue
        place, terms = simplest(likely.place, terms)
        place = replace(place, knots=single.get((place.targets, place.words), likely.place.knots))
        candidate = with_formula(fit.model, place, terms)
        # A sum of x²v and xv² is the same function, whichever coordinate comes first.
        monomials = frozenset(
            (name, formula.diff(symbol(amplitude)))
            for name, formula in candidate.changes
            for amplitude in candidate.amplitudes
        )
        if monomials not in done:
            parts = _part(candidate, likely, place, fit, cost, material)
            models += [Model((*before, each), each.trial.fit) for each in parts]
        done.add(monomials)
    return models


def _part(
    candidate: MechanismCandidate,
    likely: LikelyPlace,
    place: Place,
    fit: Fit,
    cost: float,
    material: Material,
    *,
    knots: np.ndarray | None = None,
) -> list[Part]:
    """A function as part of a model, or nothing where it cannot be fitted."""
    kind = FORMULA if knots is None else SPLINE
    try:
        material.budget.says(f"a {kind}: {candidate.label}")
        trial = _fitted(candidate, likely.level, fit, material)
    except (*UNFORESEEN, BudgetSpent) as error:
        LOGGER.info("%s as a %s cannot be fitted: %s", candidate.label, kind, error)
        return []
    return [Part(trial, kind, cost, place, knots)]


def likely_places(fit: Fit, data: Measurements, roles: Roles) -> list[LikelyPlace]:
    """All places, the one in which a smooth function is likeliest first.

    Functions of one coordinate are tried everywhere, and as coefficients of other coordinates in the
    equations in which they do best.
    """
    single = places_in(fit.model, roles, data, fit.x)
    ranked = _compared(fit, data, single)
    if not ranked:
        return []
    equations = {each.place.targets for each in ranked[:FITTED] if each.place.equations}
    products = products_in([each for each in single if each.targets in equations], fit.model, data, fit.x)
    return sorted((*ranked, *_compared(fit, data, products)), key=lambda each: -each.log_evidence)


def _compared(fit: Fit, data: Measurements, places: Sequence[Place]) -> list[LikelyPlace]:
    parameters = len(fit.model.free)
    found: dict[int, LikelyPlace] = {}
    alone = -np.inf
    for response, some in linearised_with_places(fit, data, places):
        for level in LEVELS if fit.has_process_noise else (1.0,):
            try:
                white = whiten(response, data, fit.noise.scaled(level))
                left, columns = projected(white, parameters)
            except NumericalFailure:  # without random forces an unstable simulation does not follow
                continue
            freedom = white.degrees_of_freedom - parameters
            base = profile_likelihood(float(left @ left), freedom, white.log_determinant)
            alone = max(alone, base)
            begin = 0
            for place in some:
                own = columns[:, begin : begin + len(place.knots)]
                begin += len(place.knots)
                value = base + evidence_of_function(own, left, place.knots, freedom=freedom)
                known = found.get(id(place))
                if own.any() and (known is None or value > known.log_evidence):
                    found[id(place)] = LikelyPlace(place, value, level)
    ranked = sorted(found.values(), key=lambda each: -each.log_evidence)
    return [replace(each, log_evidence=each.log_evidence - alone) for each in ranked]


def few_knots(likely: LikelyPlace, fit: Fit, data: Measurements) -> list[np.ndarray]:
    """The knots that a spline needs, as many as earn their place (Schwarz), and the next finer ones.

    Errors count as correlated as the finest spline leaves them (`siq.mismatch.evidence`).
    """
    knots = likely.place.knots
    response, _ = next(iter(linearised_with_places(fit, data, [likely.place])))
    white = whiten(response, data, fit.noise.scaled(likely.level))
    left, columns = projected(white, len(fit.model.free))
    count = _independent(left, columns, white, fit)
    choices, costs = [], []
    for number in sorted({min(each, len(knots)) for each in (4, 5, 7, 9, 13, len(knots))}):
        some = knots[np.linspace(0, len(knots) - 1, number).round().astype(int)]
        own = orthonormal(columns @ cardinal_splines(some, knots).T)
        sum_of = max(float(((left - own @ (own.T @ left)) ** 2).sum()), 1e-300)
        choices.append(some)
        costs.append(count * np.log(sum_of) + own.shape[1] * np.log(count))
    best = int(np.argmin(costs))
    return choices[best : best + 2]


def few_powers(likely: LikelyPlace, fit: Fit, data: Measurements, *, degree: int) -> tuple[Power, ...]:
    """The powers that a formula needs: each added as long as it earns its place (Schwarz).

    Errors count as correlated as all of the powers leave them (`siq.mismatch.evidence`).
    """
    terms = powers(likely.place, degree=degree)
    probe = Probe(with_formula(fit.model, likely.place, terms), ())
    grid = Grid(data, min(fit.substeps, PROBE_SUBSTEPS))
    columns = ProbeColumns(fit.model, grid, [probe], fit.x, fit.model.values)
    white = whiten(probe_response(fit.model, grid, fit, columns), data, fit.noise.scaled(likely.level))
    left, own = projected(white, len(fit.model.free))
    count = _independent(left, own, white, fit)
    chosen: list[int] = []
    total = float(left @ left)
    while len(chosen) < len(terms):
        sums = {}
        for place in range(len(terms)):
            if place not in chosen and own[:, place].any():
                some = own[:, [*chosen, place]]
                some = some / np.sqrt((some**2).sum(axis=0))
                sums[place] = float(((left - some @ np.linalg.lstsq(some, left, rcond=1e-9)[0]) ** 2).sum())
        if not sums:
            break
        best = min(sums, key=lambda place: sums[place])
        if count * np.log(total / max(sums[best], 1e-300)) < np.log(count):
            break
        chosen.append(best)
        total = sums[best]
    return tuple(terms[place] for place in sorted(chosen))


def _independent(left: np.ndarray, columns: np.ndarray, white: Whitened, fit: Fit) -> float:
    """How many errors count as independent, if columns are fitted to what is left."""
    basis = orthonormal(columns)
    rest = left - basis @ (basis.T @ left)
    correlated = correlation_time_of(rest, white.recording, outputs=len(fit.model.outputs))
    return max(float(white.known.sum()) / correlated, 2.0)


def _fitted(candidate: MechanismCandidate, level: float, begin: Fit, material: Material) -> TriedMechanism:
    """A function, fitted and judged against the fit without it.

    Raises
    ------
    NumericalFailure
        When the fit does not settle.
    """
    data, budget = material.data, material.budget
    known = {each.name: each.value for each in begin.model.parameters}
    values = np.array([known.get(each.name, 0.0) for each in candidate.model.parameters])
    trial = simpler_fit(
        *fit_with_and_without_process_noise(
            candidate.model.with_values(values), data, begin, level=level, budget=budget
        )
    )
    # A function may be steeper than the simulation, whose steps are then too long to follow it.
    needed = substeps_needed(trial.model, data, trial.model.values, trial.x, tolerance=SUBSTEP_ERROR)
    if trial.converged and needed > trial.substeps:
        finer = replace(trial, substeps=needed)
        trial = fit_with_process_noise_as_needed(trial.model, data, finer, budget=budget)
    if not trial.converged:
        raise NumericalFailure(trial.fault or "its fit does not settle")
    return judged(trial, begin, data, candidate, blocks=material.blocks)
