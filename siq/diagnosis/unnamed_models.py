"""Models of effects that have no name: smooth functions, powers and products, fitted and judged.

What explains the recordings best as a whole describes them, be it a function or a mechanism that was found
and is not certain enough for its name.

Along the trajectories of a fit everything is linear. The likelihood of a smooth function, averaged over
everything that it could be, tells its lengths and its size: one that is too rough could have been too much
else, and one that is too smooth explains too little (MacKay, Neural Computation 4, 415 (1992)).

What a fit leaves says how smooth a function is, along the trajectories of that fit. Those with the function
are better, and say it better; so it is asked for again. Functions of two coordinates are fitted where they
are likelier than the likeliest functions of one, along the trajectories of these.

In the likeliest places (`siq.diagnosis.evidence`) a formula of a few powers and a smooth curve are fitted
in earnest.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import sympy

from siq.diagnosis.dictionary import Roles
from siq.diagnosis.evidence import (
    FITTED,
    LikelyPlace,
    correlation_time_left,
    evidences_by_size,
    few_powers,
    likely_places,
    log_evidence_of,
    orthonormal,
)
from siq.diagnosis.function_sites import (
    FORMULA,
    NUMBERS,
    Ground,
    Place,
    PlaceColumns,
    coordinates_of,
    ground_of,
    ground_of_two,
    simplest,
    with_formula,
)
from siq.diagnosis.mechanisms import MechanismCandidate
from siq.diagnosis.residual_structure import SUBSTEPS, something_left
from siq.diagnosis.screening import levels_of, probe_response, projected
from siq.diagnosis.significance import UNFORESEEN, TriedMechanism, correlation_time_of, judged
from siq.diagnosis.smooth_functions import (
    ProductFunction,
    Smooth,
    SmoothFunction,
    product_of,
    smooth_function,
    triangle_of,
    with_smooth_function,
)
from siq.errors import NumericalFailure
from siq.inference.budget import Budget, BudgetSpent
from siq.inference.kalman_filter import Grid, Whitened, profile_likelihood, substeps_needed, whiten
from siq.inference.maximum_likelihood import SUBSTEP_ERROR, Fit
from siq.inference.measurements import Measurements
from siq.inference.recalibration import better_of, fit_with_process_noise_as_needed
from siq.inference.trajectories import UsualStates, fit_trajectories, free_run, normalised_rms
from siq.systems.dynamics import Dynamics, symbol

MECHANISM = "mechanism"


@dataclass(frozen=True)
class Material:
    """What models are made from, and by which means.

    Attributes
    ----------
    data
        The recordings.
    roles
        Of the simulation's states.
    degree
        Highest degree of formulas.
    blocks
        For clustered errors; see `siq.diagnosis.significance.clustered_probability`.
    considered
        How many mechanisms there are.
    budget
        Charged for the work; the models that it does not reach are left out.
    """

    data: Measurements
    roles: Roles
    degree: int
    blocks: int
    considered: int
    budget: Budget = field(default_factory=Budget)


@dataclass(frozen=True)
class Part:
    """A part of a description.

    Attributes
    ----------
    trial
        What was added, fitted and judged.
    kind
        ``formula``, ``curve``, ``surface``, or ``mechanism``.
    cost
        Logarithm of the number of places, or mechanisms, that it was chosen among.
    place
        Where a function stands; None for a mechanism or a memory.
    smooth
        What a curve or a surface is made of: the amplitudes are the heights of its bumps.
    """

    trial: TriedMechanism
    kind: str
    cost: float
    place: Place | None = None
    smooth: Smooth | None = None


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
    def coordinates(self) -> int:
        """On how many coordinates the parts depend, each by itself."""
        return sum(1 if part.place is None else len(part.place.words) for part in self.parts)

    @property
    def cost(self) -> float:
        """Logarithm of how many combinations of parts this one was chosen among."""
        return sum(part.cost for part in self.parts)


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
        usual = UsualStates.along(each.x)
        run = free_run(each.model, data, noise=each.noise, substeps=2 * each.substeps, usual=usual)
        errors.append(normalised_rms(data.outputs, run))
    one, other = errors
    return one is not None and (other is None or one < other)


LOGGER = logging.getLogger(__name__)
LARGEST_PART = 0.25  # of the work left, that a single fit may take: a choice


def fitted_part(
    candidate: MechanismCandidate,
    level: float,
    place: Place | None,
    fit: Fit,
    cost: float,
    material: Material,
    *,
    smooth: Smooth | None = None,
    begin: Fit | None = None,
) -> list[Part]:
    """A function as part of a model, or nothing where it cannot be fitted.

    Parameters
    ----------
    candidate
        The simulation with the function.
    level
        Of random forces to begin with, as a multiple of those of the fit.
    place
        Where the function stands; None for a memory.
    fit
        The simulation without it.
    cost
        Logarithm of the number of functions that it was chosen among.
    material
        What models are made from.
    smooth
        See `Part`.
    begin
        Where the fit begins, if it is not the simulation without the function: with states for those that
        the function brings, if it brings any.
    """
    kind = FORMULA if smooth is None else smooth.kind
    try:
        material.budget.says(f"a {kind}: {candidate.label}")
        with material.budget.part(LARGEST_PART):
            trial = _fitted(candidate, level, begin or fit, fit, material)
    except (*UNFORESEEN, BudgetSpent) as error:
        LOGGER.info("%s as a %s cannot be fitted: %s", candidate.label, kind, error)
        return []
    return [Part(trial, kind, cost, place, smooth)]


def _fitted(
    candidate: MechanismCandidate, level: float, begin: Fit, fit: Fit, material: Material
) -> TriedMechanism:
    """A function, fitted from a fit on, and judged against the fit without it.

    Raises
    ------
    NumericalFailure
        When the fit does not settle.
    """
    data, budget = material.data, material.budget
    known = {each.name: each.value for each in begin.model.parameters}
    known |= {each.name: each.value for each in candidate.model.parameters if each.name in candidate.new}
    values = np.array([known.get(each.name, 0.0) for each in candidate.model.parameters])
    if not begin.has_process_noise:  # a function that was nearly right may not be followed by another
        begin = replace(begin, noise=replace(begin.noise, process=fit.noise.process))
    trial = fit_with_process_noise_as_needed(
        candidate.model.with_values(values), data, begin, level=level, budget=budget
    )
    # A function may be steeper than the simulation, whose steps are then too long to follow it.
    needed = substeps_needed(trial.model, data, trial.model.values, trial.x, tolerance=SUBSTEP_ERROR)
    if trial.converged and needed > trial.substeps:
        finer = replace(trial, substeps=needed)
        trial = fit_with_process_noise_as_needed(trial.model, data, finer, budget=budget)
    if not (trial.has_process_noise or fit.has_process_noise) and trial.log_likelihood < fit.log_likelihood:
        # Nothing added is as likely as the fit without it: steps of all samples at once have led away.
        damped = fit_trajectories(
            candidate.model.with_values(values),
            data,
            begin=begin.x[data.first[:-1]],
            noise=begin.noise.of_states(candidate.model.dimension),
            substeps=trial.substeps,
            budget=budget,
        )
        trial = better_of(trial, damped)
    if not trial.converged:
        raise NumericalFailure(trial.fault or "its fit does not settle")
    return judged(trial, fit, data, candidate, blocks=material.blocks)


SHARES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0, 2.0)  # of the range; over twice of it a function is a parabola
MOST_BUMPS = 100  # a guard on the time of a fit


@dataclass(frozen=True)
class Told:
    """What a fit leaves says of a function's values, at a level of random forces.

    Attributes
    ----------
    level
        Relative to the random forces of the fit.
    fine
        The function, with bumps as narrow as any.
    correlated
        Correlation time τ of the innovations in samples, with such a function: n of them count as n/τ.
    gram, overlap
        Of what a unit of each bump does to the innovations, with each other and with the innovations; shapes
        ``(b, b)`` and ``(b,)``. Over τ, as are those that follow.
    total, freedom
        Sum of squares of the innovations, and degrees of freedom.
    likelihood
        Logarithm, without the function.
    """

    level: float
    fine: SmoothFunction
    correlated: float
    gram: np.ndarray
    overlap: np.ndarray
    total: float
    freedom: float
    likelihood: float

    def over(self, correlated: float) -> Told:
        """The same where so many samples hang together."""
        return Told(
            self.level, self.fine, correlated, self.gram / correlated, self.overlap / correlated,
            self.total / correlated, self.freedom / correlated, self.likelihood / correlated,
        )  # fmt: skip


@dataclass(frozen=True)
class Smoothness:
    """How smooth a function is, as recordings tell it.

    Attributes
    ----------
    shares
        Its lengths, as shares of the ranges of its coordinates.
    deviation
        Its size.
    told
        What the recordings tell, at the level of random forces at which it is likeliest.
    noise
        Variance of the innovations then, in units of what the fit takes for it.
    log_evidence
        Logarithm of the odds for such a function, over none, each at its best level; averaged over all
        lengths and sizes.
    considered
        How many lengths and sizes these are.
    """

    shares: tuple[float, ...]
    deviation: float
    told: Told
    noise: float
    log_evidence: float
    considered: int


def smoothness_of(
    fit: Fit, data: Measurements, ground: Ground, *, known: Part | None = None, alike: bool = False
) -> Smoothness | None:
    """The likeliest smoothness of a function on top of a fit; None where it cannot be worked out.

    Parameters
    ----------
    fit, data
        The fit along whose trajectories everything is linear, and what it was made for.
    ground
        Where the function stands.
    known
        A part of the fit that is a first description of this function, in whose stead it comes.
    alike
        Whether both lengths are the same share of the range.
    """
    least, fine = _finest(ground, data, fit.model)
    some = [share for share in SHARES if share >= least]
    choices = [(each,) * len(ground.words) for each in some]
    if not alike:
        choices = list(itertools.product(some, repeat=len(ground.words)))
    # What processes of these lengths have for values at the finest bumps, as heights of these.
    shapes = [fine.heights_of(triangle_of(fine.centres, np.array(each) * ground.ranges)) for each in choices]
    alone = -np.inf
    values: list[np.ndarray] = []
    highest, best = -np.inf, None
    for told in _told(fit, data, fine, known):
        alone = max(alone, told.likelihood)
        for shares, shape in zip(choices, shapes, strict=True):
            gained, scale, rest = evidences_by_size(
                shape.T @ told.gram @ shape, shape.T @ told.overlap, told.total, freedom=told.freedom
            )
            values.append(told.likelihood + gained)
            place = int(np.argmax(gained))
            if values[-1][place] > highest:
                # The scale of the noise was at its best, too, and the size is one in units of it.
                highest, noise = values[-1][place], float(rest[place] / told.freedom)
                deviation = float(np.sqrt(scale[place] * noise))
                best = Smoothness(shares, deviation, told, noise, 0.0, len(gained) * len(choices))
    if best is None or not best.deviation > 0:
        return None
    whole = np.concatenate(values)
    mean = float(np.logaddexp.reduce(whole) - np.log(len(whole)))
    return replace(best, log_evidence=mean - alone)


def likeliest_product(asked: Smoothness, ground: Ground, *, times: float = 1.0) -> ProductFunction:
    """The likeliest product of two functions, where a function of two coordinates is asked for.

    Parameters
    ----------
    asked
        What the recordings say of a function of both.
    ground
        Where it stands.
    times
        Factor on the lengths to choose among.
    """
    told = asked.told
    by_value = told.fine.heights_of(told.fine.heights_of(told.gram).T)
    return product_of(
        ground,
        tuple(times * share for share in SHARES),
        points=told.fine.centres,
        gram=(by_value + by_value.T) / (2 * asked.noise),
        overlap=told.fine.heights_of(told.overlap) / asked.noise,
        deviation=asked.deviation,
        weight=told.correlated,
    )


def _told(fit: Fit, data: Measurements, fine: SmoothFunction, known: Part | None) -> list[Told]:
    """What is told at each level of random forces at which it can be worked out.

    Errors are as correlated as the likeliest level leaves them with such a function, at all levels.
    """
    grid = Grid(data, fit.substeps if known else min(fit.substeps, SUBSTEPS))
    response = probe_response(fit.model, grid, fit, PlaceColumns(fit.model, grid, [fine]))
    found: list[Told] = []
    highest, correlated = -np.inf, 1.0
    for level in levels_of(fit):
        try:
            white = whiten(response, data, fit.noise.scaled(level))
            white, parameters = _without(white, fit, known)
            left, columns = projected(white, parameters)
        except UNFORESEEN as error:
            LOGGER.info("no function of %s can be screened: %s", " and ".join(fine.ground.words), error)
            continue
        total, freedom = float(left @ left), white.degrees_of_freedom - parameters
        likelihood = profile_likelihood(total, freedom, white.log_determinant)
        found.append(
            Told(level, fine, 1.0, columns.T @ columns, columns.T @ left, total, freedom, likelihood)
        )
        basis = orthonormal(columns)
        rest = left - basis @ (basis.T @ left)
        likelihood = profile_likelihood(float(rest @ rest), freedom, white.log_determinant)
        if likelihood > highest:
            highest = likelihood
            correlated = correlation_time_of(rest, white.recording, outputs=len(fit.model.outputs))
    return [each.over(correlated) for each in found]


def _finest(ground: Ground, data: Measurements, model: Dynamics) -> tuple[float, SmoothFunction]:
    """The shortest length, as a share of the range, of which the recordings need not too many bumps."""
    room = NUMBERS // (len(data.t) * (model.dimension + len(model.outputs)))
    most = max(min(MOST_BUMPS, room), 1)
    for share in SHARES:
        function = smooth_function(ground, (share,) * len(ground.words), most=most + 1)
        if function.width <= most:
            return share, function
    return SHARES[-1], smooth_function(ground, (SHARES[-1],) * len(ground.words), most=most)


def _without(white: Whitened, fit: Fit, known: Part | None) -> tuple[Whitened, int]:
    """Innovations as if a part were not there, its columns left out, and the number of parameters left."""
    names = [fit.model.parameters[place].name for place in fit.model.free]
    amplitudes = () if known is None else known.trial.candidate.amplitudes
    mine = [names.index(name) for name in amplitudes]
    linear = mine if known is None or known.smooth is None else mine[: known.smooth.linear]
    values = fit.model.values[[fit.model.free[place] for place in linear]]
    others = np.delete(white.columns, mine, axis=1)
    innovations = white.innovations + white.columns[:, linear] @ values
    return replace(white, innovations=innovations, columns=others), len(names) - len(mine)


ROUNDS = 4  # of fits, each along the trajectories of the one before: a choice
WORTH = 1.0  # of a logarithm of odds, below which another round is not worth its time


def with_a_smooth_function(
    before: tuple[Part, ...],
    fit: Fit,
    ground: Ground,
    cost: float,
    material: Material,
    *,
    like: Model | None = None,
    product: bool = False,
) -> list[Model]:
    """The likeliest model with a smooth function on a ground; none where none can be fitted.

    Parameters
    ----------
    before, fit
        What was added already, and the fit with it.
    ground
        Where the function stands.
    cost
        Logarithm of the number of functions that it was chosen among.
    material
        What models are made from.
    like
        A model with a function in its stead that explains a part, if there is one.
    product
        Whether it is to be a product of two functions of one coordinate each.
    """
    data = material.data
    if not ground.usable:
        return []
    likeliest: Model | None = None
    current, known = (fit, None) if like is None else (like.fit, like.parts[-1])
    for _ in range(ROUNDS):
        here = ground.along(current.model, data, current.x)
        asked = _asked(current, data, here, known=known)
        if asked is None:
            break
        price = cost + float(np.log(asked.considered))
        parts: list[Part] = []
        # What promises to be rough and to need hardly any random forces may be what no fit can follow.
        for times, level in ((1.0, asked.told.level), (2.0, 1.0)):
            if parts:
                break
            try:
                function = _function(asked, here, product=product, times=times)
            except UNFORESEEN as error:
                LOGGER.info("no function of %s can be worked out: %s", " and ".join(here.words), error)
                break
            candidate = with_smooth_function(fit.model, function)
            parts = fitted_part(
                candidate, level, ground.place, fit, price, material, smooth=function, begin=current
            )
        if not parts:
            break
        found = Model((*before, parts[0]), parts[0].trial.fit)
        LOGGER.info(
            "%s, %d bumps: log-likelihood %.1f",
            candidate.label, function.width, found.fit.log_likelihood,
        )  # fmt: skip
        if likeliest is not None:
            new = {
                each.fit is found.fit: each.log_evidence for each in weighed([likeliest, found], fit, data)
            }
            if new[True] < new[False] + WORTH:
                break
        likeliest, current, known = found, found.fit, parts[0]
    return [] if likeliest is None else [likeliest]


def _asked(
    fit: Fit, data: Measurements, ground: Ground, *, known: Part | None, alike: bool = False
) -> Smoothness | None:
    """See `smoothness_of`; what is beyond all numbers ends a function, not a case."""
    try:
        return smoothness_of(fit, data, ground, known=known, alike=alike)
    except UNFORESEEN as error:
        LOGGER.info("no function of %s can be worked out: %s", " and ".join(ground.words), error)
        return None


def _function(asked: Smoothness, ground: Ground, *, product: bool, times: float) -> Smooth:
    """The function that is asked for, its lengths multiplied."""
    if product:
        return likeliest_product(asked, ground, times=times)
    shares = tuple(times * share for share in asked.shares)
    return smooth_function(ground, shares, deviation=asked.deviation, weight=asked.told.correlated)


def with_surfaces(fit: Fit, models: Sequence[Model], material: Material) -> list[Model]:
    """Models with a smooth function of two coordinates, where the recordings tell both.

    Parameters
    ----------
    fit
        Of the simulation without functions.
    models
        Those with functions of one coordinate, or of one times another, the likeliest first: one of two is
        asked for where the first ones have theirs, and has to be likelier there.
    material
        What models are made from.
    """
    material.budget.says("comparing functions of two coordinates")
    data = material.data
    begins = _begins(fit, models, material)
    asked: list[tuple[float, Ground, Model | None]] = []
    done = set()
    for place, like in begins:
        current, known = (fit, None) if like is None else (like.fit, like.parts[-1])
        alone = 0.0
        if known is not None:
            one = _asked(current, data, ground_of(place, current.model, data, current.x), known=known)
            alone = -np.inf if one is None else one.log_evidence
        for words in _pairs(fit.model, place):
            if (place.targets, words) in done:
                continue
            done.add((place.targets, words))
            ground = ground_of_two(place.targets[0], words, current.model, data, current.x)
            if not ground.usable:
                continue
            both = _asked(current, data, ground, known=known, alike=True)
            if both is not None:
                asked.append((both.log_evidence - alone, ground, like))
    cost = float(np.log(max(len(asked), 1)))
    ranked = sorted((each for each in asked if each[0] > cost), key=lambda each: -each[0])
    price = max((part.cost for model in models for part in model.parts), default=0.0) + cost
    found: list[Model] = []
    for _, ground, like in ranked[:FITTED]:
        for product in (True, False):
            some = with_a_smooth_function((), fit, ground, price, material, like=like, product=product)
            found += some
            if some and not something_left(some[0].fit, data):
                return found  # nothing is left for a surface, nor for a less likely pair
    return found


def _begins(fit: Fit, models: Sequence[Model], material: Material) -> list[tuple[Place, Model | None]]:
    """Where functions of two coordinates are asked for, and the models that have one of one there.

    Where there are none, one of two may tell so little of either coordinate alone.
    """
    single = [each for each in models if len(each.parts) == 1]
    known = [(each.parts[0].place, each) for each in single[:FITTED]]
    found: list[tuple[Place, Model | None]] = [(place, each) for place, each in known if place is not None]
    if not single:
        try:
            likely = likely_places(fit, material.data, material.roles)
        except UNFORESEEN as error:
            LOGGER.info("no function can be screened: %s", error)
            return []
        found = [(each.place, None) for each in likely[:FITTED]]
    # Not in a rotating frame, nor in a sensor.
    return [(place, model) for place, model in found if len(place.equations) == 1]


def _pairs(model: Dynamics, place: Place) -> Iterator[tuple[str, str]]:
    """A coordinate of a place, and any other state or input."""
    names = [name for name in coordinates_of(model) if name != "t"]
    return (each for each in itertools.combinations(names, 2) if set(each) & set(place.words))


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
    alone = (each for each in ranked if len(each.place.words) == 1)
    for likely in {id(each): each for each in (*ranked[:FITTED], *itertools.islice(alone, 1))}.values():
        ground = ground_of(likely.place, fit.model, data, fit.x)
        models += with_a_smooth_function(before, fit, ground, cost, material)
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
            parts = fitted_part(candidate, likely.level, place, fit, cost, material)
            models += [Model((*before, each), each.trial.fit) for each in parts]
        done.add(monomials)
    return models
