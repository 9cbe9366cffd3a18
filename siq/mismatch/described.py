"""Described: a model of what has no name, from the place and the function that the recordings ask for.

Smooth functions are compared in all places by their evidence (`siq.mismatch.evidence`), along the
trajectories of the recalibrated simulation and at several levels of random forces, as mechanisms are
screened. In the best places a formula of a few powers and a spline are fitted in earnest. What explains the
recordings best as a whole describes them, be it a function or a mechanism that was found and is not certain
enough for its name. What mechanisms with a name leave is described in the same way, on top of them.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy

from siq.errors import NumericalFailure
from siq.estimation.budget import Budget, BudgetSpent
from siq.estimation.estimation import SUBSTEP_ERROR, Fit
from siq.estimation.free_runs import free_run, normalised_rms
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
from siq.mismatch.evidence import (
    correlation_time_left,
    evidence_of_function,
    log_evidence_of,
    orthonormal,
)
from siq.mismatch.function_places import (
    Place,
    cardinal_splines,
    linearised_with_places,
    places_in,
    products_in,
)
from siq.mismatch.functions import FORMULA, SPLINE, Power, powers, simplest, with_formula, with_spline
from siq.mismatch.probes import Probe, ProbeColumns
from siq.mismatch.roles import Roles
from siq.mismatch.screening import LEVELS, probe_response, projected
from siq.mismatch.search import Search, something_left
from siq.mismatch.trials import PROBE_SUBSTEPS, UNFORESEEN, TriedMechanism, admissible, judged

MECHANISM = "mechanism"
LOGGER = logging.getLogger(__name__)
FITTED = 3  # places in which functions are fitted, the most likely ones: a choice
MOST = 2  # functions that are put on top of each other: more are no description


@dataclass(frozen=True)
class Part:
    """A part of a description.

    Attributes
    ----------
    trial
        What was added, fitted and judged.
    kind
        ``formula``, ``spline``, or ``mechanism``.
    cost
        Logarithm of the number of places, or mechanisms, that it was chosen among.
    place
        Where a function stands; None for a mechanism.
    knots
        Of a spline, shape ``(k,)``: the amplitudes are its values there.
    """

    trial: TriedMechanism
    kind: str
    cost: float
    place: Place | None = None
    knots: np.ndarray | None = None


@dataclass(frozen=True)
class Model:
    """A simulation that describes what has no name.

    Attributes
    ----------
    parts
        What was added, in the order in which it was found.
    fit
        Of the simulation with all of it.
    log_evidence
        Of the whole over that of the simulation without its parts, less the costs of these; see `weighed`.
    exact
        The fit whose trajectories follow the equations, if random forces are part of `fit`.
    """

    parts: tuple[Part, ...]
    fit: Fit
    log_evidence: float = float("nan")
    exact: Fit | None = None

    @property
    def cost(self) -> float:
        """Logarithm of how many combinations of parts this one was chosen among."""
        return sum(part.cost for part in self.parts)


@dataclass(frozen=True)
class LikelyPlace:
    """A place, the logarithm of its evidence, and the level of random forces at which it is best.

    The evidence is that of a smooth function there over that of none, each at its best level.
    """

    place: Place
    log_evidence: float
    level: float


def models_of_the_nameless(
    data: Measurements,
    search: Search,
    roles: Roles,
    *,
    degree: int,
    blocks: int,
    considered: int,
    budget: Budget | None = None,
) -> tuple[Model, ...]:
    """Models of what is missing, the likeliest first; none where none is likelier than the simulation alone.

    Parameters
    ----------
    data
        The recordings.
    search
        What was found; mechanisms among it are one of the models.
    roles
        Of the simulation's states.
    degree
        Highest degree of formulas.
    blocks
        For clustered errors; see `siq.mismatch.clusters.clustered_probability`.
    considered
        How many mechanisms there are.
    budget
        Charged for the work; the models that it does not reach are left out.
    """
    base, budget = search.recalibrated, budget or Budget()
    models = with_a_function((), base, data, roles, degree=degree, blocks=blocks, budget=budget)
    if search.found and np.isfinite(search.fit.log_likelihood):
        models.append(Model(parts_of(search, considered), search.fit))
    models = weighed(models, base, data)
    best = models[0] if models else None
    if (
        best is not None
        and best.fit.model.dimension == base.model.dimension
        and len(best.parts) < MOST
        and something_left(best.fit, data)
    ):
        models += with_a_function(
            best.parts, best.fit, data, roles, degree=degree, blocks=blocks, budget=budget
        )
    return likeliest(models, base, data)


def models_beside_names(
    data: Measurements,
    named: Search,
    whole: Search,
    roles: Roles,
    *,
    functions: Sequence[Model] | None,
    degree: int,
    blocks: int,
    considered: int,
    budget: Budget | None = None,
) -> tuple[Model, ...]:
    """Models of what mechanisms with a name leave, the likeliest first; none where none is likelier.

    They are functions on top of the names, and what was found beside them, not certain enough for a name.

    Parameters
    ----------
    data
        The recordings.
    named, whole
        The search with what is named, and with all that was found.
    roles
        Of the simulation's states.
    functions
        Those on top of the names, where they are fitted already.
    degree, blocks, considered, budget
        See `models_of_the_nameless`.
    """
    base, budget = named.fit, budget or Budget()

    def on_top(parts: tuple[Part, ...], fit: Fit) -> list[Model]:
        if fit.model.dimension > named.recalibrated.model.dimension or not something_left(fit, data):
            return []
        return with_a_function(parts, fit, data, roles, degree=degree, blocks=blocks, budget=budget)

    models = list(on_top((), base) if functions is None else functions)
    parts = parts_of(whole, considered)[len(named.found) :]
    fits = [each.best.fit for each in whole.found[len(named.found) :]]
    models += [Model(parts[: place + 1], fit) for place, fit in enumerate(fits)]
    if parts:
        models += on_top(parts, whole.fit)
    names = [each.best.candidate for each in named.found]
    allowed = [
        each
        for each in models
        if np.isfinite(each.fit.log_likelihood) and all(admissible(each.fit, name) for name in names)
    ]
    return likeliest(allowed, base, data)


def parts_of(search: Search, considered: int) -> tuple[Part, ...]:
    """The mechanisms of a search as parts of a model, each chosen among so many."""
    cost = float(np.log(max(considered, 1)))
    return tuple(Part(each.best, MECHANISM, cost) for each in search.found)


def weighed(models: Sequence[Model], alone: Fit, data: Measurements) -> list[Model]:
    """Models with their evidence over that of a simulation without their parts, the likeliest first.

    Errors are as correlated as the model that fits best leaves them (`correlation_time_left`), for all.
    """
    fits = [each.fit for each in models]
    correlated = correlation_time_left([alone, *fits], data)
    without = log_evidence_of(alone, data, correlated=correlated)
    known = [
        replace(
            each,
            log_evidence=log_evidence_of(each.fit, data, correlated=correlated) - each.cost - without,
        )
        for each in models
    ]
    return sorted(known, key=lambda each: -each.log_evidence)


def likeliest(models: Sequence[Model], alone: Fit, data: Measurements) -> tuple[Model, ...]:
    """The few models that are likelier than the simulation without them, the likeliest first."""
    likelier = (
        each
        for each in weighed(models, alone, data)
        if each.log_evidence > 0 and runs_freely(each.fit, alone, data)
    )
    return tuple(_followed(each, data) for each in itertools.islice(likelier, FITTED))


def runs_freely(fit: Fit, alone: Fit, data: Measurements) -> bool:
    """Whether a fit without random forces runs along the recordings, and nearer to them than one without it.

    A fit that holds on to every sample may not: where it is steeper than any step of an integration, it runs
    away from where it was held.
    """
    if fit.has_process_noise or alone.has_process_noise:
        return True
    errors = []
    for each in (fit, alone):
        # Steps twice as fine: what depends on them is no property of the simulation.
        run = free_run(each.model, data, noise=each.noise, substeps=2 * each.substeps)
        errors.append(normalised_rms(data.outputs, run))
    one, other = errors
    return one is not None and (other is None or one < other)


def with_a_function(
    before: tuple[Part, ...],
    fit: Fit,
    data: Measurements,
    roles: Roles,
    *,
    degree: int,
    blocks: int,
    budget: Budget,
) -> list[Model]:
    """Models with one function more, in the likeliest places, that earn it.

    Parameters
    ----------
    before, fit
        What was added already, and the fit with it.
    data, roles, degree, blocks, budget
        See `models_of_the_nameless`.
    """
    budget.says("comparing functions without a name")
    try:
        ranked = likely_places(fit, data, roles)
    except UNFORESEEN as error:
        LOGGER.info("no function can be screened: %s", error)
        return []
    cost = float(np.log(max(len(ranked), 1)))  # a function is chosen among so many places
    ranked = [each for each in ranked if each.log_evidence > cost]
    if not ranked:
        return []
    models: list[Model] = []

    def attempt(
        place: Place, candidate: MechanismCandidate, level: float, knots: np.ndarray | None = None
    ) -> None:
        kind = FORMULA if knots is None else SPLINE
        try:
            budget.says(f"a {kind}: {candidate.label}")
            trial = _fitted(candidate, level, fit, data, blocks=blocks, budget=budget)
            parts = (*before, Part(trial, kind, cost, place, knots))
            models.append(Model(parts, trial.fit))
        except (*UNFORESEEN, BudgetSpent) as error:
            LOGGER.info("%s as a %s cannot be fitted: %s", candidate.label, kind, error)

    single = {(each.place.targets, each.place.words): each.place.knots for each in ranked}
    done: set[tuple[tuple[str, sympy.Expr], ...]] = set()
    for likely in ranked[:FITTED]:
        terms = few_powers(likely, fit, data, degree=degree)
        if terms:
            place, terms = simplest(likely.place, terms)
            place = replace(place, knots=single.get((place.targets, place.words), likely.place.knots))
            candidate = with_formula(fit.model, place, terms)
            if candidate.changes not in done:
                attempt(place, candidate, likely.level)
            done.add(candidate.changes)
    curved = {(ranked[0].place.targets, ranked[0].place.words)}
    for best in weighed(models, fit, data)[:1]:
        if best.parts[-1].place is not None:
            curved.add((best.parts[-1].place.targets, best.parts[-1].place.words))
    for likely in ranked:
        if (likely.place.targets, likely.place.words) in curved:
            for knots in few_knots(likely, fit, data):
                attempt(likely.place, with_spline(fit.model, likely.place, knots), likely.level, knots)
    given = sum(part.cost for part in before)
    found = [replace(each, log_evidence=each.log_evidence + given) for each in weighed(models, fit, data)]
    for each in found:
        part = each.parts[-1]
        LOGGER.info(
            "%s as a %s: log-evidence better by %.1f",
            part.trial.candidate.label, part.kind, each.log_evidence,
        )  # fmt: skip
    return [each for each in found if each.log_evidence > 0]


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


def _fitted(
    candidate: MechanismCandidate,
    level: float,
    begin: Fit,
    data: Measurements,
    *,
    blocks: int,
    budget: Budget,
) -> TriedMechanism:
    """A function, fitted and judged against the fit without it.

    Raises
    ------
    NumericalFailure
        When the fit does not settle.
    """
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
    return judged(trial, begin, data, candidate, blocks=blocks)


def _followed(model: Model, data: Measurements) -> Model:
    """A model with its estimates of least squares, where random forces are part of its fit."""
    if not model.fit.has_process_noise:
        return model
    still = replace(model.fit, noise=model.fit.noise.without_process())
    followed = fit_with_and_without_process_noise(model.fit.model, data, still)[1]
    return replace(model, exact=followed) if followed.converged else model
