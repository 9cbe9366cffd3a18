"""Forecasts: explanations judged by how well they foresee recordings that they were not fitted to.

No machine follows a formula down to its encoder. Between an explanation and the recordings stands an error of
the model (Kennedy and O'Hagan 2001, J. R. Stat. Soc. B 63; Brynjarsdóttir and O'Hagan 2014, Inverse Problems
30): process noise, whose size every fit estimates anew, alike for all explanations. An explanation is worth
the logarithm of the probability with which it foresees parts of the recordings that were left out of its fit.

One sample ahead a filter foresees the fine structure of this error, and not the motion. So it is also shown
every fourth sample only, every sixteenth, and so on, as long as there are enough: it then has to foresee the
motion over as much time. Every horizon counts alike. With the log-density ``l`` of the parts left out and the
correlation time ``tau`` of the errors in samples, an explanation gains over nothing

    G = mean over horizons of (l - l_nothing) / tau.

Explanations are mechanisms of the dictionary, one by one within their family, and functions without a name.
Along the trajectories of a fit with the leading mechanism everything is linear, and all of them are compared
there, in its place.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import sympy
from scipy.special import logsumexp

from siq.data.correlation import correlation_time_of
from siq.diagnosis.evidence import (
    NUMERICAL_ERRORS,
    OVERFLOWS,
    SMOOTH_LENGTHS,
    FittedCandidate,
    NotFitted,
    orthonormal,
    sizes_of_effects,
    smooth_prior,
)
from siq.diagnosis.holdout import NEARLY_ALL, errors_left_out, in_blocks, typically_better
from siq.diagnosis.mechanisms import MechanismCandidate
from siq.diagnosis.screening import PROBE_SUBSTEPS, Probe, linearised_with, portions
from siq.diagnosis.search import AcceptedMechanism, FitContext, Standing
from siq.diagnosis.terms import Place, places_in, products_in
from siq.errors import NumericalFailure
from siq.inference.budget import Budget, BudgetSpent, evaluation
from siq.inference.kalman_filter import Noise, Whitened, substeps_needed, whiten
from siq.inference.maximum_likelihood import Fit, first_noise, fit_by_multiple_shooting, fit_of_states
from siq.inference.measurements import Measurements
from siq.inference.recalibration import fit_with_process_noise_as_needed
from siq.inference.trajectories import EDGE_SUBSTEPS, fit_trajectories, spread_edges
from siq.numerics.randomness import positive
from siq.systems.dynamics import Dynamics

LOGGER = logging.getLogger(__name__)
THINNING = 4  # from one horizon to the next: a choice
TRIALS = 2  # families that may have a companion, where nothing is certain alone: a choice
# At a horizon, at least, beside the initial states: a choice. With three a parameter, most explanations of a
# motor's recordings foresaw parts left out far worse than none did.
SAMPLES_PER_PARAMETER = 10
FOLDS = 8  # parts of the recordings that are left out in turn: a choice
ALONE, IN_PLACE = (0.1, 1.0), (1.0, 10.0)  # levels of process noise, relative to that of the fits
PROMISING, SHAPES = 32, 3  # explanations, and shapes of each, that are asked at all horizons: a choice
LEADERS, ATTEMPTS = 6, 12  # explanations that are fitted in earnest before none is said to lead: a choice
SUSPECTS = 4  # rivals of the leader that are fitted in earnest before they count: a choice
UNSETTLED = "its fit does not settle"
EXACT = 1e-6  # numerical: of an effect, what is not reproduced where nothing tells two mechanisms apart
RIDGE = 1e-10  # numerical: of normal equations whose columns have unit length
# Of the budget, for the first name, so that tests have something left where forecasts name nothing: a choice.
FIRST_NAME_SHARE = 0.5
EVEN = 0.5  # probability of a cause without a name, where nothing is known beforehand
PLAUSIBLE = 0.05  # of the probability of a family, from which on a member is not ruled out


def _thinned(data: Measurements, every: int) -> Measurements:
    """Recordings of which only every so-manieth sample was measured."""
    outputs = np.full_like(data.outputs, np.nan)
    for begin, end in itertools.pairwise(data.first):
        outputs[begin:end:every] = data.outputs[begin:end:every]
    return replace(data, outputs=outputs)


def _fold_of(data: Measurements) -> np.ndarray:
    """The part of each measured value, shape ``(n·m,)``: recordings, or stretches where these are few.

    Of many recordings each part has several, by their labels, so that their order does not matter.
    """
    count = len(data.labels)
    stretches = -(-FOLDS // count) if count < FOLDS // 2 else 1
    fold, rank = np.empty(len(data.t), dtype=int), np.argsort(np.argsort(data.labels))
    for place, (begin, end) in enumerate(itertools.pairwise(data.first)):
        fold[begin:end] = rank[place] * stretches + (np.arange(end - begin) * stretches) // (end - begin)
    return np.repeat(fold if stretches > 1 else fold % FOLDS, data.outputs.shape[1])


@dataclass(frozen=True)
class _Foreseen:
    """Parts left out in turn, as a linear problem: innovations, and columns of parameters."""

    white: Whitened
    target: np.ndarray
    own: np.ndarray
    fold: np.ndarray

    @cached_property
    def _parts(self) -> list[np.ndarray]:
        """The rows of each part."""
        return [np.flatnonzero(self.fold == each) for each in np.unique(self.fold)]

    @cached_property
    def _base(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """By part: squares of the target, its overlap with the parameters, their Gram matrix, the count."""
        parts = self._parts
        return (
            np.array([self.target[rows] @ self.target[rows] for rows in parts]),
            np.stack([self.own[rows].T @ self.target[rows] for rows in parts]),
            np.stack([self.own[rows].T @ self.own[rows] for rows in parts]),
            np.array([self.white.known[rows].sum() for rows in parts], dtype=float),
        )

    def sums(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations of parameters and columns ``(n, k)``, one for each part, and right-hand sides."""
        _, overlap, gram, _ = self._base
        p, size = self.own.shape[1], self.own.shape[1] + columns.shape[1]
        whole, right = np.zeros((len(gram), size, size)), np.zeros((len(gram), size))
        whole[:, :p, :p], right[:, :p] = gram, overlap
        for place, rows in enumerate(self._parts):
            some = columns[rows]
            whole[place, :p, p:] = self.own[rows].T @ some
            whole[place, p:, :p] = whole[place, :p, p:].T
            whole[place, p:, p:] = some.T @ some
            right[place, p:] = some.T @ self.target[rows]
        return whole, right

    def signs(self, sums: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Signs of the coefficients of columns, fitted to all parts, shape ``(k,)``."""
        whole, right = (each.sum(axis=0) for each in sums)
        scale = positive(np.sqrt(np.diag(whole)))
        damped = whole / np.outer(scale, scale) + RIDGE * np.eye(len(scale))
        return np.asarray(np.sign(np.linalg.solve(damped, right / scale))[self.own.shape[1] :])

    def log_density(
        self, sums: tuple[np.ndarray, np.ndarray], precision: np.ndarray | None = None
    ) -> np.ndarray:
        """Log-densities of the parts, up to a constant, each foreseen from the others, shape ``(folds,)``.

        With columns by their normal equations (`sums`), whose coefficients have the prior precision
        ``(k, k)`` in units of the noise.
        """
        (squares, _, _, count), (whole, right), p = self._base, sums, self.own.shape[1]
        k = whole.shape[1] - p
        scale = positive(np.sqrt(np.einsum("fii->i", whole)))
        whole, right = whole / np.outer(scale, scale), right / scale
        damping = RIDGE * np.eye(p + k)
        if precision is not None:
            damping[p:, p:] += precision / np.outer(scale[p:], scale[p:])
        others, rest = whole.sum(axis=0) - whole + damping, right.sum(axis=0) - right
        found = np.linalg.solve(others, rest[:, :, None])[:, :, 0]
        learned = squares.sum() - squares - np.einsum("fp,fp->f", found, rest)
        variance = np.maximum(learned, 1e-12 * squares.sum()) / np.maximum(count.sum() - count - p - k, 1.0)
        missed = squares - 2 * np.einsum("fp,fp->f", found, right)
        missed += np.einsum("fp,fpq,fq->f", found, whole, found)
        return -0.5 * (np.maximum(missed, 0.0) / variance + count * np.log(variance))


@dataclass(frozen=True)
class Horizon:
    """A fit to recordings of which every so-manieth sample is known, and how well it foresees their parts."""

    data: Measurements  #: the recordings
    fit: Fit  #: to all of them
    log_density: float  #: of what was left out in turn, as a logarithm
    correlated: float  #: correlation time of the errors, in samples: of so many one counts

    @classmethod
    def of(cls, fit: Fit, data: Measurements) -> Horizon:
        """Of a fit; the whitened innovations and what its parameters explain of them are linear."""
        white = whiten(fit.linearisation, data, fit.noise)
        foreseen = _Foreseen(white, white.innovations, white.columns, _fold_of(data))
        left = white.innovations - white.columns @ white.solve()[0]
        outputs = len(fit.model.outputs)
        shown = white.known.reshape(-1, outputs).any(axis=1)
        correlated = correlation_time_of(
            left.reshape(-1, outputs)[shown].ravel(),
            white.recording.reshape(-1, outputs)[shown].ravel(),
            outputs=outputs,
        )
        density = float(foreseen.log_density(foreseen.sums(np.zeros((len(left), 0)))).sum())
        return cls(data, fit, density - 0.5 * white.log_determinant, correlated)


def _horizons_of(fit: Fit, context: FitContext) -> list[Horizon]:
    """A simulation fitted once for each horizon, with forces at random; fails where it cannot be at any."""
    data, found, every = context.data, list[Horizon](), 1
    if not fit.has_process_noise:
        fit = replace(fit, noise=first_noise(fit.model, data, fit.x))
    parameters = len(fit.model.free) + 1
    while True:
        some = _thinned(data, every)
        known = int(np.isfinite(some.outputs).sum()) - fit.model.dimension * len(data.labels)
        if found and known < SAMPLES_PER_PARAMETER * parameters:
            return found
        begin = found[-1].fit if found else fit
        try:
            there = _fitted(fit.model, some, begin, begin.x, data.roughness, budget=context.budget)
            # Where f jumps its derivatives are never exact, and steps may go to and fro about the best fit.
            if not (there.converged or there.model.edges):
                raise NumericalFailure(UNSETTLED)
            found.append(Horizon.of(there, some))
        except NUMERICAL_ERRORS as error:
            LOGGER.info("every %d. sample: %s", every, error)
            if not found:
                raise
            return found
        every *= THINNING


def _fitted(
    model: Dynamics, data: Measurements, begin: Fit, states: np.ndarray, rough: np.ndarray, *, budget: Budget
) -> Fit:
    """A model fitted with forces at random, from states, a fit's noise, and third differences of outputs.

    A simulation that lacks much may take all noise of its sensors for forces, and what begins there may stay.
    One that does not settle, as where shapes stand in for each other, leads nothing. As a rival it promises
    no more than it foresees.
    """
    substeps, noise = begin.substeps, begin.noise.of_states(model.dimension)
    if model.dimension > begin.model.dimension:  # what it brings may be faster than all others
        substeps = max(substeps, substeps_needed(model, data, model.values, states))
    model = spread_edges(model, data, states, substeps=max(substeps, EDGE_SUBSTEPS))
    substeps = max(substeps, EDGE_SUBSTEPS) if model.edges else substeps
    shown = replace(noise, measurement=data.with_known_noise(np.maximum(noise.measurement, rough)))
    known: dict[str, Any] = {"x": states, "estimate_process": True, "substeps": substeps, "budget": budget}
    fit = fit_by_multiple_shooting(model, data, noise=shown, **known)
    if not fit.converged and (shown.measurement > noise.measurement).any():
        other = fit_by_multiple_shooting(model, data, noise=noise, **known)
        fit = max(other, fit, key=lambda each: (each.converged, each.log_likelihood))
    if not fit.converged and any(formula.has(sympy.Abs) for _, formula in model.outputs):
        # What reads the same either way goes to and fro where it was led to the wrong side.
        free = fit_trajectories(
            fit.model, data, begin=states[data.first[:-1]], noise=fit.noise, substeps=substeps, budget=budget
        )
        other = fit_by_multiple_shooting(free.model, data, noise=shown, **(known | {"x": free.x}))
        fit = max(other, fit, key=lambda each: each.log_likelihood)
    if fit.fault:
        raise NumericalFailure(fit.fault)
    return fit


@dataclass(frozen=True)
class _Site:
    """An explanation at one place: a mechanism with all shapes at which it is looked for, or a function.

    Its prior is the logarithm of a probability, and what that is if all mechanisms are as likely, with a name
    or without; its family has an equation in which it acts.
    """

    terms: tuple[Probe | Place, ...]
    prior: float
    flat: float
    family: tuple[str, tuple[str, ...]]
    candidate: MechanismCandidate | None = None

    @property
    def label(self) -> str:
        """In words of the system."""
        if self.candidate is not None:
            return self.candidate.label
        place = self.terms[0]
        assert isinstance(place, Place)
        return f"a function of {' and '.join(place.words)} in {', '.join(place.targets)}"


def _sites(
    candidates: Sequence[MechanismCandidate], along: Fit, context: FitContext, untried: dict[str, NotFitted]
) -> list[_Site]:
    """All explanations on top of a fit, with their priors.

    A family counts once, and its members alike. A function of a coordinate along which several members of a
    family act, in the same equation, is that family's general form.
    """
    data, unnamed = context.data, context.study.search.unnamed
    model, x = along.model, along.x
    priors = _log_priors(candidates, unnamed)
    alike = _log_priors([replace(each, weight=1.0) for each in candidates], EVEN)
    found = []
    for each, prior, flat in zip(candidates, priors, alike, strict=True):
        try:
            probes = Probe.along(each, along, data)
        except NUMERICAL_ERRORS as error:
            LOGGER.info("%s: %s", each.label, error)
            untried[each.label] = NotFitted.of(each, error)
            continue
        if probes:
            found.append(_Site(tuple(probes), prior, flat, _kind_of(each, model), each))
    single = places_in(model, context.roles, data, x)
    places = (*single, *products_in([each for each in single if each.equations], model, data, x))
    for place in places:
        acting = {
            (_kind_of(each, model), each.name)
            for each in candidates
            if each.equations == place.targets and each.coordinate == ", ".join(place.words)
        }
        shared = Counter(kind for kind, _ in acting)
        kind = next((one for one, count in shared.most_common(1) if count > 1), ("", place.targets))
        prior, flat = (float(np.log(share) - np.log(len(places))) for share in (unnamed, EVEN))
        found.append(_Site((place,), prior, flat, kind))
    return found


def _kind_of(candidate: MechanismCandidate, model: Dynamics) -> tuple[str, tuple[str, ...]]:
    """A mechanism's family, and where it acts: in a sensor, along a state that acts back, in equations."""
    # In a machine of several joints, friction in one of them acts on all.
    along = candidate.coordinate
    if not candidate.equations:
        return candidate.family, tuple(name for name, _ in candidate.changes if name in dict(model.outputs))
    return candidate.family, (along,) if along in model.states else (along, *candidate.equations)


def _log_priors(candidates: Sequence[MechanismCandidate], unnamed: float) -> list[float]:
    """Logarithms of prior probabilities: by weight of families, and of their members; alike over places."""
    families: dict[str, float] = {}
    members: dict[tuple[str, str], float] = {}
    for each in candidates:
        families[each.family] = max(families.get(each.family, 0.0), each.weight)
        members[each.family, each.name] = each.weight
    of_family: Counter[str] = Counter()
    for (family, _), weight in members.items():
        of_family[family] += weight  # type: ignore[assignment]
    places = Counter((each.family, each.name) for each in candidates)
    whole = sum(families.values())
    return [
        float(
            np.log1p(-unnamed)
            + np.log(families[each.family] / whole * each.weight / of_family[each.family])
            - np.log(places[each.family, each.name])
        )
        for each in candidates
    ]


def _gained(
    horizon: Horizon, terms: Sequence[Probe | Place], leading: MechanismCandidate | None, budget: Budget
) -> np.ndarray:
    """What terms gain at a horizon over nothing, or over a leading mechanism in its place, ``(terms,)``."""
    fit, data = horizon.fit, horizon.data
    fold, nothing, known = _fold_of(data), -np.inf, leading.places(fit, linear=True) if leading else []
    best, at = np.full(len(terms), -np.inf), 0
    for some in portions(fit, data, terms):
        work = evaluation(fit.model, data, columns=sum(each.width for each in some))
        budget.charge((min(fit.substeps, PROBE_SUBSTEPS) + len(IN_PLACE)) * work)
        response, groups = linearised_with(fit, data, some, without=known)
        for level in ALONE if leading is None else IN_PLACE:
            try:
                white = whiten(response, data, fit.noise.scaled(level))
                problem = _in_place_of(leading, fit, white, fold)
            except NUMERICAL_ERRORS:
                continue
            further = white.columns[:, len(fit.model.free) :]
            constant = -0.5 * white.log_determinant
            without = problem.log_density(problem.sums(white.columns[:, known])).sum()
            nothing = max(nothing, float(without) + constant)
            for place, (term, group) in enumerate(zip(some, groups, strict=True), start=at):
                columns = further[:, group]
                if not np.isfinite(columns).all():
                    best[place] = np.nan
                elif columns.any():
                    with contextlib.suppress(np.linalg.LinAlgError):  # what cannot be told promises nothing
                        best[place] = max(best[place], _density(problem, term, columns) + constant)
        at += len(some)
    return (best - nothing) / horizon.correlated


def _gains(
    horizons: Sequence[Horizon], sites: Sequence[_Site], leading: MechanismCandidate | None, budget: Budget,
    untried: dict[str, NotFitted],
) -> tuple[list[_Site], np.ndarray]:  # fmt: skip
    """The sites that may matter, and what they gain: means over horizons, ``(sites,)``.

    All are asked one sample ahead, and those that promise most there, with their best shapes, at the
    other horizons.
    """
    asked = _gained(horizons[0], [term for site in sites for term in site.terms], leading, budget)
    promised = np.split(asked, np.cumsum([len(site.terms) for site in sites])[:-1])
    for site, one in zip(sites, promised, strict=True):
        if site.candidate is not None and np.isnan(one).all():
            untried[site.label] = NotFitted.of(site.candidate, OVERFLOWS)
    promised = [np.where(np.isnan(one), -np.inf, one) for one in promised]
    order = sorted(range(len(sites)), key=lambda place: -promised[place].max())[:PROMISING]
    kept, total = list[_Site](), list[np.ndarray]()
    for place in order:
        shapes = np.argsort(-promised[place])[:SHAPES]
        kept.append(replace(sites[place], terms=tuple(sites[place].terms[shape] for shape in shapes)))
        total.append(promised[place][shapes])
    gained = np.concatenate(total)
    for each in horizons[1:]:
        gained = gained + _gained(each, [term for site in kept for term in site.terms], leading, budget)
    gained = np.where(np.isnan(gained), -np.inf, gained) / len(horizons)
    own = np.split(gained, np.cumsum([len(site.terms) for site in kept])[:-1])
    # The prior of a mechanism is spread over all shapes at which it was looked for.
    found = [logsumexp(one) - np.log(len(sites[k].terms)) for k, one in zip(order, own, strict=True)]
    best = [
        replace(site, terms=tuple(site.terms[shape] for shape in np.argsort(-one)))
        for site, one in zip(kept, own, strict=True)
    ]
    return best, np.array(found)


def _in_place_of(
    leading: MechanismCandidate | None, fit: Fit, white: Whitened, fold: np.ndarray
) -> _Foreseen:
    """The problem of what is missing without a mechanism, along the trajectories of the fit with it."""
    own = white.columns[:, : len(fit.model.free)]
    tested, linear = (leading.places(fit, linear=each) if leading else [] for each in (False, True))
    change = np.linalg.lstsq(own, white.innovations, rcond=1e-10)[0] if own.shape[1] else np.zeros(0)
    target = white.innovations + own[:, linear] @ (fit.model.values[list(fit.model.free)] + change)[linear]
    return _Foreseen(white, target, np.delete(own, tested, axis=1), fold)


def _containing(
    horizon: Horizon, sites: Sequence[_Site], leading: MechanismCandidate
) -> tuple[set[str], set[str]]:
    """Labels of sites that could do what a leading mechanism does: nearly, with more parameters, or exactly.

    A product of a function and a velocity contains linear damping. It is the mechanism and more, rather than
    something else. So is a hysteresis that does what a drag does. And an offset of the sensor is what a
    constant force does to a linear spring: no recording of this kind tells them apart.
    """
    fit, data, size = horizon.fit, horizon.data, len(leading.new)
    more, equal = set[str](), set[str]()
    counts = [np.inf if each.candidate is None else len(each.candidate.new) for each in sites]
    chosen = [(site, count) for site, count in zip(sites, counts, strict=True) if count >= size]
    terms, without = [each.terms[0] for each, _ in chosen], leading.places(fit, linear=True)
    response, groups = linearised_with(fit, data, terms, without=without)
    white = whiten(response, data, fit.noise)
    problem = _in_place_of(leading, fit, white, _fold_of(data))
    basis, effect = orthonormal(problem.own), problem.target - white.innovations
    effect = effect - basis @ (basis.T @ effect)
    for (each, count), group in zip(chosen, groups, strict=True):
        columns = white.columns[:, len(fit.model.free) :][:, group]
        if np.isfinite(columns).all():
            own = orthonormal(columns - basis @ (basis.T @ columns))
            share = ((own.T @ effect) ** 2).sum() / (effect @ effect)
            if share >= (NEARLY_ALL if count > size else 1 - EXACT):
                (more if count > size else equal).add(each.label)
    return more, equal


def _density(problem: _Foreseen, term: Probe | Place, columns: np.ndarray) -> float:
    """With a term, averaged over what is expected of it; signs are those that it may have."""
    sums = problem.sums(columns)
    if isinstance(term, Probe):
        positive = term.positive
        while (wrong := (problem.signs(sums) < 0) & positive).any():
            columns, positive = columns[:, ~wrong], positive[~wrong]
            if not columns.shape[1]:
                return -np.inf
            sums = problem.sums(columns)
        return float(problem.log_density(sums).sum())
    values = []
    sizes = sizes_of_effects(float(problem.target @ problem.target))
    sizes = sizes[:: max(len(sizes) // 4, 1)]
    gram = sums[0].sum(axis=0)[problem.own.shape[1] :, problem.own.shape[1] :]
    for length in SMOOTH_LENGTHS:
        prior = smooth_prior(term.knots, length)
        told, inverse = float((prior * gram).sum()), np.linalg.inv(prior)
        values += [problem.log_density(sums, inverse * (told / size)).sum() for size in sizes]
    return float(logsumexp(values) - np.log(len(values)))


@dataclass(frozen=True)
class _Rung:
    """A mechanism with the family that it belongs to, on top of those before it."""

    accepted: AcceptedMechanism  #: the likeliest member, with those that are not ruled out
    horizons: tuple[Horizon, ...]  #: the fits with it
    log_odds: float  #: of its family, against all other explanations together
    flat_log_odds: float  #: the same, if all mechanisms are as likely beforehand, with a name or without

    def placed(self, candidate: MechanismCandidate, horizons: Sequence[Horizon]) -> _Rung:
        """It in other fits, with the evidence that it has where it is."""
        best = replace(self.accepted.best, candidate=candidate, fit=horizons[0].fit)
        return replace(self, accepted=replace(self.accepted, best=best), horizons=tuple(horizons))


@dataclass(frozen=True, eq=False)
class _Leader:
    """A mechanism that was fitted at every horizon, and what it gains over the fits without it."""

    site: _Site
    horizons: list[Horizon]
    gain: float

    @property
    def candidate(self) -> MechanismCandidate:
        """The mechanism."""
        assert self.site.candidate is not None
        return self.site.candidate

    @property
    def weight(self) -> float:
        """Logarithm of its probability, up to a constant."""
        return self.gain + self.site.prior

    @property
    def kind(self) -> tuple[str, int]:
        """Its family, and how many parameters it brings."""
        return self.candidate.family, len(self.candidate.new)

    def on_top(self, base: Dynamics, other: _Leader) -> _Site:
        """Its site on top of another mechanism of the same base, whose parameters may have the same names."""
        candidate, probe = self.candidate.rebased(base, other.candidate.model), self.site.terms[0]
        assert isinstance(probe, Probe)
        shapes = zip(candidate.shapes, (value for _, value in probe.shapes), strict=True)
        return replace(self.site, terms=(Probe(candidate, tuple(shapes)),), candidate=candidate)


def _fitted_at(
    horizons: Sequence[Horizon], site: _Site, budget: Budget, untried: dict[str, NotFitted]
) -> tuple[list[Horizon], float] | None:
    """A mechanism fitted at every horizon, and what it gains; None where that fails.

    It gains less than nothing if its sign is wrong. What does not settle one sample ahead is untried, too.
    """
    candidate, probe, found = site.candidate, site.terms[0], list[Horizon]()
    assert candidate is not None and isinstance(probe, Probe)
    known, settled = dict[str, float](), False  # what the horizon before led to
    for each in horizons:
        try:
            begun, x = probe.begin(each.fit, each.data, each.fit.x)
            model, rough = candidate.begun(each.fit.model, begun | known), horizons[0].data.roughness
            fit = _fitted(model, each.data, each.fit, x, rough, budget=budget)
            if not candidate.admits(fit, each.data):  # it is refuted, whatever it promised
                error = NumericalFailure("its best parameters have a sign or a period that it cannot have")
                untried[candidate.label] = NotFitted.of(candidate, error)
                return [], -np.inf
            if candidate.generalises and candidate.idle(fit):
                raise NumericalFailure("it is no more than the special case of it")
            found.append(Horizon.of(fit, each.data))
            known |= {one.name: one.value for one in fit.model.parameters}
            # What jumps, or reads the same either way, may go to and fro.
            settled = found[0].fit.converged or bool(found[0].fit.model.edges) or candidate.unsigned
            if not settled and _gain_over(found[:1], horizons[:1]) < 0:
                break  # it leads nothing, and is no rival
        except NUMERICAL_ERRORS as error:
            LOGGER.info("%s at a horizon: %s", candidate.label, error)
            untried[candidate.label] = NotFitted.of(candidate, error)
            return None
    untried.pop(candidate.label, None)
    if not settled:
        untried[candidate.label] = NotFitted.of(candidate, NumericalFailure(UNSETTLED))
    return found, _gain_over(found, horizons[: len(found)])


def _gain_over(one: Sequence[Horizon], other: Sequence[Horizon]) -> float:
    """What fits at every horizon gain over others."""
    pairs = [(a.log_density - b.log_density, a, b) for a, b in zip(one, other, strict=True)]
    return float(np.mean([gain / min(a.correlated, b.correlated) for gain, a, b in pairs]))


def _next_rung(
    horizons: Sequence[Horizon], candidates: Sequence[MechanismCandidate], context: FitContext,
    untried: dict[str, NotFitted], on_trial: list[_Leader] | None = None, asked: str = "",
) -> _Rung | None:  # fmt: skip
    """The mechanism that stands first on top of fits; None where none is likelier than what has no name.

    Then the two of different families that come first all the same are put on trial, where a list for that is
    given. One that is asked for by its label is fitted whatever it promises.
    """
    options, base, budget = context.study.search, horizons[0].fit, context.budget
    budget.says("comparing forecasts of what was left out")
    places = _sites(candidates, base, context, untried)
    sites, gains = _gains(horizons, places, None, budget, untried)
    # The mechanisms that promise most, fitted at every horizon; those that foresee better than nothing.
    fitted, leading, outdone = dict[str, _Leader](), list[_Leader](), set[str]()

    def attempt(site: _Site, promise: float = np.inf) -> None:
        for term in site.terms:  # until one settles, or fails while others gain more than it promised
            another = _fitted_at(horizons, replace(site, terms=(term,)), budget, untried)
            if another is not None and not (site.label in untried and site.label in fitted):
                fitted[site.label] = _Leader(site, *another)
            leading[:] = [each for label, each in fitted.items() if label not in untried and each.gain > 0]
            failed = another is None or another[1] < 0
            if site.label not in untried or (failed and any(e.weight > promise for e in leading)):
                break

    weights = gains + np.array([site.prior for site in sites])
    named = {k: one for k in np.argsort(-weights) if (one := sites[k].candidate) is not None}
    most = {(named[k].name, named[k].coordinate): gains[k] for k in sorted(named, key=lambda k: gains[k])}
    # Friction of two kinds is not fitted where one of them promises nearly as much.
    less = {k: [most.get((n, one.coordinate), -np.inf) for n in one.generalises] for k, one in named.items()}
    order = [k for k in named if max(less[k], default=-np.inf) < NEARLY_ALL * gains[k]]
    # A sensor without a sign bends the motion until it is seen; what was fitted cannot show it.
    for site in places:
        if site.label == asked or (site.candidate is not None and site.candidate.unsigned):
            attempt(site)
    # A state of its own follows the motion. That is bent one sample ahead, where forces at random have to do
    # what the state would: behind a gear with play the motor seems to wait whenever it turns.
    far, promise = _gains(horizons[-1:], places, None, budget, untried)
    ahead = far[int(np.argmax(promise + np.array([site.prior for site in far])))]
    own_states = ahead.candidate is not None and ahead.candidate.model.dimension > base.model.dimension
    if own_states and ahead.label not in {sites[k].label for k in order if gains[k] > 0}:
        for term in ahead.terms:
            if not leading:
                attempt(replace(ahead, terms=(term,)))
    for number, place in enumerate(order[:ATTEMPTS], start=1):
        if not gains[place] > 0 or len(leading) == LEADERS:
            break
        budget.says(f"candidate {number} of at most {min(ATTEMPTS, len(order))}: {sites[place].label}")
        attempt(sites[place], weights[place])
    # Free to follow any motion is what brings a state of its own; a clock, since of what swings by itself any
    # season of its period foresees as much; and what is not absent where it is zero, as the end of a sensor's
    # range.
    apart = [[s.frequencies or s.top_of or s.bottom_of for s in each.searches] for each in candidates]
    d = base.model.dimension
    free = {e.label for e, one in zip(candidates, apart, strict=True) if any(one) or e.model.dimension > d}
    # A delay is not seen a little at a time. A season of its period foresees nearly as much as what makes a
    # system swing by itself, and a delay of an input nearly as much as a lag.
    likely = max(leading, key=lambda each: each.weight).site if leading else None
    kin = None if likely is None or likely.label in free else likely.family[0]
    for place, one in named.items():
        delay = one.model.dimension > d and not one.amplitudes
        if delay and kin in (None, one.family) and one.label not in {*fitted, *untried}:
            attempt(sites[place])
    if not leading:
        return None
    alone = {site.label: site for site in sites if site.candidate is not None}
    if max(leading, key=lambda each: each.weight).candidate.model.dimension > d:
        # States of its own may follow any motion: what needs none is fitted first, whatever it promises.
        stateless = {each.label for each in candidates if each.model.dimension == d} - {*fitted, *untried}
        for place in [place for place in order if sites[place].label in stateless][:ATTEMPTS]:
            attempt(sites[place], weights[place])
    # Of those that are not told apart, the one with the fewest parameters; special cases are asked, and what
    # it is a special case of, if that promises more.
    first = max(leading, key=lambda each: each.weight).candidate
    promised = max((gains[k] for k, one in named.items() if one.label == first.label), default=np.inf)
    for place, one in named.items():
        near = one.coordinate == first.coordinate and one.label not in fitted
        more = first.name in one.generalises and gains[place] > promised
        if near and (more or one.name in first.generalises):
            attempt(sites[place])
    heaviest = max(each.weight for each in leading)
    plausible = [each for each in leading if each.weight > heaviest + np.log(PLAUSIBLE)]
    leader = min(plausible, key=lambda each: (len(each.candidate.new), -each.weight))
    errors = cache(lambda one: _left_out(one.horizons[0].fit, [one.candidate], base.noise, context))
    # All others are compared in the place of one that is not free to follow the motion.
    steady, ground = [each for each in leading if each.site.label not in free], None
    if steady:
        ground = leader if leader in steady else max(steady, key=lambda each: each.weight)
        # What is a simpler mechanism and hardly more has to take most of what that one leaves: a gain beside
        # an offset may take no more than a part of an error of the model.
        for each in sorted(steady, key=lambda each: -each.weight):
            if (
                len(each.candidate.new) < len(ground.candidate.new)
                and each.gain >= NEARLY_ALL * ground.gain
                and _containing(each.horizons[0], [ground.on_top(base.model, each)], each.candidate)[0]
                and not _takes_most(errors(each), errors(ground), ground.horizons[0].fit, context.data)
            ):
                leader, ground = each if leader is ground else leader, each
        there = ground.horizons[0].fit
        rebased = [each.rebased(base.model, there.model) for each in candidates]
        remaining = _sites(rebased, there, context, untried)
        # A lag in the place of a delay is no more than that.
        near = [each for each in plausible if each not in steady and each.kind != ground.kind]
        if near:
            # A state that follows the motion may be a simple mechanism and something simple at a time, or
            # what lasts of an error of the model, for which white noise is all that is allowed.
            plain = [one for one in remaining if one.candidate is None or one.label not in free]
            above, more = _gains(ground.horizons, plain, None, budget, untried)
            both = ground.weight + max([0.0, *(more + np.array([site.prior for site in above]))])
            outdone = {
                each.site.label
                for each in near
                if both > each.weight
                or not _takes_most(errors(ground), errors(each), each.horizons[0].fit, context.data)
            }
            leader = ground if leader.site.label in outdone else leader
        sites, gains = _gains(ground.horizons, remaining, ground.candidate, budget, untried)
        gains = gains + ground.gain

    # What would outvote it is fitted first: a sensor's gain may promise what a parameter then takes over.
    promised = gains + np.array([site.prior for site in sites])
    suspects = [
        alone[sites[place].label]
        for place in np.argsort(-promised)
        if promised[place] > leader.weight - options.least_log_odds
        and sites[place].family != leader.site.family
        and sites[place].label in alone.keys() - fitted.keys() - untried.keys()
    ]
    for site in suspects[:SUSPECTS]:
        attempt(site)
    contained, equal = set[str](), set[str]()
    if leader is ground:
        contained, equal = _containing(leader.horizons[0], sites, leader.candidate)
    else:  # a lag of what drives and one of what measures are the same to a linear system
        equal = {label for label, each in fitted.items() if each.kind == leader.kind}
    # What has more parameters is no rival where it takes no more than it leaves of what the leader leaves.
    outdone |= {
        label
        for label, each in fitted.items()
        if each.weight > leader.weight - options.least_log_odds
        and each.site.family != leader.site.family
        and len(each.candidate.new) > len(leader.candidate.new)
        and not _takes_most(errors(leader), errors(each), each.horizons[0].fit, context.data)
    }
    # What was fitted in earnest counts as it was fitted; if it did not settle, at most as it promised.
    limit = dict(zip((site.label for site in sites), gains, strict=True))
    kept = [place for place, site in enumerate(sites) if site.label not in fitted]
    sites = [*(sites[place] for place in kept), *(each.site for each in fitted.values())]
    own = [min(one.gain, limit.get(name, 0.0) if name in untried else np.inf) for name, one in fitted.items()]
    gains = np.append(gains[kept], own)
    gains[[site.label in outdone for site in sites]] = -np.inf
    # The mechanism and hardly more is no rival, nor is what cannot be fitted; but what is clearly better says
    # that it is another thing.
    more = np.array([site.label in untried or site.label in contained for site in sites])
    rival = ~more | ((gains > leader.gain + options.least_log_odds) & (leader.gain < NEARLY_ALL * gains))
    weights = np.where(rival, gains + np.array([site.prior for site in sites]), -np.inf)
    flat = np.where(rival, gains + np.array([site.flat for site in sites]), -np.inf)
    family = np.array([site.family == leader.site.family or site.label in equal for site in sites])
    log_odds, flat_log_odds = (
        float(logsumexp(each[family]) - logsumexp(np.append(each[~family], 0.0)))  # and nothing at all
        for each in (weights, flat)
    )
    for place in np.argsort(-gains)[:LEADERS]:
        LOGGER.info("%s: gains %.1f", sites[place].label, gains[place])
    LOGGER.info("%s: log-odds of %s %.1f", leader.site.label, leader.site.family[0], log_odds)
    # The general form of a family may do more than any member of it: another physics then, of the same kind.
    likelier = (weights > leader.weight + options.least_log_odds) & (leader.gain < NEARLY_ALL * gains)
    general = np.array([site.candidate is None for site in sites]) & family & likelier
    if log_odds < options.least_log_odds or general.any():
        if on_trial is not None:
            foremost = {each.site.family: each for each in sorted(leading, key=lambda each: each.weight)}
            on_trial += sorted(foremost.values(), key=lambda each: -each.weight)[:TRIALS]
        return None
    members = {sites[k].label: weights[k] for k in np.flatnonzero(family) if sites[k].candidate is not None}
    alike = {label for label, weight in members.items() if weight > leader.weight + np.log(PLAUSIBLE)}
    for label in alike.intersection(alone) - fitted.keys():
        attempt(alone[label])
    # What is likelier, and hardly better with more parameters, is as good, unless it follows any motion.
    alike |= {label for label in (outdone & fitted.keys()) - free if fitted[label].weight > leader.weight}
    known = {
        label: FittedCandidate.of(
            each.horizons[0].fit, base, horizons[0].data, each.candidate, blocks=options.blocks
        )
        for label, each in fitted.items()
        if each.horizons
    }
    best = known.pop(leader.site.label)
    others: dict[Standing, tuple[FittedCandidate, ...]] = {
        "same": tuple(each for label, each in known.items() if label in alike),
        "less": tuple(each for label, each in known.items() if label not in alike),
    }
    return _Rung(AcceptedMechanism(best, others), tuple(leader.horizons), log_odds, flat_log_odds)


def _left_out(
    fit: Fit, added: Sequence[MechanismCandidate], noise: Noise, context: FitContext
) -> np.ndarray | None:
    """Squared errors of free runs of parts left out, by blocks; None where there are none."""
    with context.budget.exempt():
        squares = errors_left_out(fit, context.data, noise=noise, candidates=added, budget=context.budget)
    return None if squares is None else np.array(in_blocks(squares))


def _takes_most(
    before: np.ndarray | None, after: np.ndarray | None, fit: Fit, data: Measurements, *, surely: bool = True
) -> bool:
    """Whether a fit takes more than it leaves of the errors of free runs of parts left out.

    That is b - a > a - s², with squared errors b before it and a after it, and s² of the sensors: surely, if
    it is more so than by chance; else, if typical errors have it so, and a is below b by more than chance.
    """
    if before is None or after is None:
        return after is not None
    sensors = (fit.noise.measurement / np.nanvar(data.outputs, axis=0)).mean()
    if surely:
        return typically_better(before + sensors, 2 * after)
    return typically_better(before, after) and bool(np.log((before + sensors) / (2 * after)).mean() > 0)


def _needed(
    candidate: MechanismCandidate, fit: Fit, found: Sequence[MechanismCandidate], context: FitContext
) -> bool:
    """Whether a fit with mechanisms needs one of them: its sign is right, and free runs are worse without."""
    if not (candidate.amplitudes and candidate.admits(fit, context.data)):
        return not candidate.amplitudes
    model = fit.model.held(candidate.new, zero=candidate.amplitudes)
    try:
        with context.budget.exempt():
            without = fit_with_process_noise_as_needed(model, context.data, fit, budget=context.budget)
    except NUMERICAL_ERRORS:
        return True
    rest = [each for each in found if each is not candidate]
    before, after = (
        _left_out(*each, fit.noise, context) for each in ((without, rest), (fit, [*rest, candidate]))
    )
    return _takes_most(before, after, without, context.data, surely=False)


def _exchanged(found: list[_Rung], alone: Sequence[Horizon], context: FitContext) -> list[_Rung]:
    """A climb with a mechanism exchanged for one that was not told apart from it, where that foresees better.

    A delay and a lag may look alike as long as friction is missing, too. What is exchanged comes last.
    """
    for place, rung in enumerate(found[:-1]):
        best, same = rung.accepted.best, rung.accepted.others["same"]
        for other in same:
            less = (best, *(each for each in same if each is not other))
            last = replace(rung, accepted=AcceptedMechanism(other, {"same": (), "less": less}))
            rungs, horizons = found[:place], found[place - 1].horizons if place else alone
            for each in (*found[place + 1 :], last):
                above = _on_top(horizons, each, context)
                if above is None:
                    break
                rungs, horizons = [*rungs, above], above.horizons
            else:
                if _gain_over(horizons, found[-1].horizons) > context.study.search.least_log_odds:
                    LOGGER.info("%s is exchanged for %s", best.candidate.label, other.candidate.label)
                    return rungs
    return found


def _on_top(horizons: Sequence[Horizon], rung: _Rung, context: FitContext) -> _Rung | None:
    """The mechanism of a rung fitted on top of other fits; None where it does not settle there."""
    base, label = horizons[0].fit, rung.accepted.best.candidate.label
    (plain,) = (each for each in context.candidates if each.label == label)
    candidate = plain.rebased(context.model, base.model)
    for probe in Probe.along(candidate, base, context.data):
        failed, site = dict[str, NotFitted](), _Site((probe,), 0.0, 0.0, ("", ()), candidate)
        fitted = _fitted_at(horizons, site, context.budget, failed)
        if fitted is not None and not failed:
            fit, blocks = fitted[0][0].fit, context.study.search.blocks
            whole = FittedCandidate.of(fit, base, context.data, candidate, blocks=blocks)
            return replace(rung, accepted=replace(rung.accepted, best=whole), horizons=tuple(fitted[0]))
    return None


def _below(rung: _Rung, context: FitContext) -> _Rung | None:
    """A rung without the one that it was found on, where both led: without it a fit may run away."""
    best, found = rung.accepted.best, list[Horizon]()
    (plain,) = (each for each in context.candidates if each.label == best.candidate.label)
    names = dict(zip(plain.new, best.candidate.new, strict=True))
    try:
        for each in rung.horizons:
            known = {parameter.name: parameter.value for parameter in each.fit.model.parameters}
            values = [known[names.get(p.name, p.name)] for p in plain.model.parameters]
            d, own = context.model.dimension, plain.model.dimension - context.model.dimension
            x = np.hstack([each.fit.x[:, :d], each.fit.x[:, each.fit.x.shape[1] - own :]])
            model, noise = plain.model.with_values(np.array(values)), each.fit.noise.of_states(x.shape[1])
            fit = fit_of_states(
                model, each.data, x=x, noise=noise, substeps=each.fit.substeps, converged=False
            )
            found.append(Horizon.of(fit, each.data))
    except NUMERICAL_ERRORS as error:
        LOGGER.info("%s alone: %s", plain.label, error)
        return None
    return rung.placed(plain, found)


def climb(fit: Fit, context: FitContext) -> tuple[list[Horizon], list[_Rung], list[NotFitted], list[_Rung]]:
    """Mechanisms one on top of the other, as long as the next is likelier than what has no name.

    Where nothing is certain at first, two may be that are certain only beside each other.

    A mechanism may take over a part of an error of the model, above all on top of others, and most causes
    that have no name look a little like one that has. So the last one has to take more than it leaves of what
    free runs of parts left out are off by, beyond the sensors' noise, or it is taken back, and then the one
    before it is the last; of two that need each other both are. One that those after it make needless stood
    for them: the climb is made again without it, and counts unless it has more names or foresees worse.

    Returned are also the fits of the simulation alone, empty where it cannot be fitted, what could not be
    judged, and what was taken back.
    """
    model, found, untried = context.model, list[_Rung](), dict[str, NotFitted]()
    alone, budget, together = list[Horizon](), context.budget, False

    def next_on(
        below: Sequence[MechanismCandidate], horizons: Sequence[Horizon],
        on_trial: list[_Leader] | None = None, asked: str = "",
    ) -> _Rung | None:  # fmt: skip
        base = horizons[0].fit.model
        remaining = [
            each.rebased(model, base) if below else each
            for each in context.candidates
            if not any(each.repeats(other) for other in below)
        ]
        return _next_rung(horizons, remaining, context, untried, on_trial, asked)

    def together_with(first: _Leader) -> list[_Rung]:
        """The two that are certain beside each other, where neither is alone."""
        own, horizons = first.candidate, first.horizons
        second = next_on([own], horizons)
        for _ in range(TRIALS):
            below = None if second is None else _below(second, context)
            if second is None or below is None:
                break
            plain = below.accepted.best.candidate
            again = next_on([plain], below.horizons, asked=own.label)
            if again is not None and again.accepted.best.candidate.label == own.label:
                return [again.placed(own, horizons), second]
            if again is not None and _kind_of(again.accepted.best.candidate, model) == _kind_of(own, model):
                return [below, again]
            # Beside the second another may be certain: then that is asked in the place of the first.
            own, horizons, second = plain, [*below.horizons], again
        return []

    try:
        with budget.part(FIRST_NAME_SHARE):
            alone = _horizons_of(fit, context)
        while len(found) < context.study.search.mechanisms:
            on_trial, names = list[_Leader](), [each.accepted.best.candidate for each in found]
            with budget.part(1.0 if found else FIRST_NAME_SHARE):
                rung = next_on(names, found[-1].horizons if found else alone, None if found else on_trial)
                rungs = [rung] if rung is not None else []
                for leader in on_trial:
                    rungs = rungs or together_with(leader)
            if not rungs:
                break
            together |= len(rungs) > 1
            for each in rungs:
                LOGGER.info("found %s by forecasts", each.accepted.best.candidate.label)
            found += rungs
        found = _exchanged(found, alone, context)
    except (*NUMERICAL_ERRORS, BudgetSpent) as error:
        LOGGER.info("forecasts end: %s", error)

    best, back = [each.accepted.best for each in found], list[_Rung]()
    fits = [*(each.fit for each in alone[:1]), *(each.fit for each in best)]
    own = [each.candidate for each in best]
    errors = cache(lambda count: _left_out(fits[count], own[:count], alone[0].fit.noise, context))
    while (last := len(found)) and not _takes_most(
        errors(last - 1), errors(last), fits[last], context.data, surely=False
    ):
        LOGGER.info("%s makes no free run better", own[last - 1].label)
        back.append(found.pop())
        if together and last == 2:
            back.append(found.pop())
    own, last = own[: len(found)], len(found)
    # So may a general form whose special case is enough beside what came after it.
    needless = {e.label for e in own[:-1] if e.generalises or not _needed(e, fits[last], own, context)}
    fewer = tuple(each for each in context.candidates if each.label not in needless)
    if needless and (before := errors(last)) is not None:
        _, again, more, _ = climb(fit, replace(context, candidates=fewer))
        best = [each.accepted.best for each in again]
        added = [each.candidate for each in best]
        after = _left_out(best[-1].fit, added, alone[0].fit.noise, context) if best else None
        LOGGER.info("climbed once more, without what became needless: %s", [each.label for each in added])
        if after is not None and len(again) <= last and not typically_better(after, before):
            return alone, again, more, back
    return alone, found, list(untried.values()), back
