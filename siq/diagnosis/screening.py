"""Screening: how much likelier a fit would be with a little of each of many terms.

A term that a simulation lacks enters, to first order, by the derivative of f by its coefficients.
Along the trajectories of a fit everything is linear: the likelihood with a term, its coefficients and
all parameters at their best, is a matter of least squares. It is worked out for several levels of process
noise: where physics is missing the fit had to admit such noise, and the right term makes it needless.

`rank` compares terms of any kind, mechanisms (`Probe`) or functions (`siq.diagnosis.terms.Place`); what is
compared is up to a `Judge`: the likelihood at the best amplitudes, or that averaged over all functions.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from siq.diagnosis.evidence import BUDGET_SPENT, NUMERICAL_ERRORS, OVERFLOWS, NotFitted, orthonormal
from siq.diagnosis.mechanisms import MechanismCandidate, along, places_of
from siq.errors import NumericalFailure
from siq.inference.budget import Budget, BudgetSpent, evaluation
from siq.inference.kalman_filter import Grid, Linearisation, Whitened, linearise, profile_likelihood, whiten
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements, first_states
from siq.inference.trajectories import EDGE_SUBSTEPS, fit_trajectories, run, run_along, spread_edges
from siq.systems.dynamics import Dynamics, Tape
from siq.systems.formulas import compile_values

Entry = tuple[int, int | slice, np.ndarray]
"""A row of f or h, the columns of a term that act there, and their values."""
Evaluated = Callable[[np.ndarray, np.ndarray, int | None], Iterator[Entry]]
"""From states ``(d, n)``, parameters and a node to what a term does to f there; without a node, to h."""


@dataclass(frozen=True)
class Trajectories:
    """States ``(n, d)`` of a simulation along recordings, at the samples and between them."""

    model: Dynamics
    grid: Grid
    x: np.ndarray
    compiled: dict[int, Any] = field(default_factory=dict)

    @cached_property
    def node_states(self) -> list[np.ndarray]:
        """States at all nodes: between samples cubics that have the slopes of f.

        Straight lines would be early or late by half a sample, as much as what a sensor's lag does.
        """
        grid, model = self.grid, self.model
        rows, substeps = grid.rows, grid.substeps
        begin, end = self.x[rows].T, self.x[rows + 1].T
        delays, whole = model.lags(model.values), grid.step * substeps
        first, last = (
            whole * model.functions.rates(x, grid.signals(node, delays), model.values)
            for x, node in ((begin, 0), (end, 3 * substeps - 1))
        )
        turn = first + last - 2 * (end - begin)
        bend = 3 * (end - begin) - 2 * first - last
        shares = [(node // 3 + (node % 3) / 2) / substeps for node in range(3 * substeps)]
        return [begin + share * (first + share * (bend + share * turn)) for share in shares]


class Term(Protocol):
    """An unknown part of an equation, or of what is measured, that is linear in its coefficients."""

    @property
    def width(self) -> int:
        """The number of coefficients."""

    def columns(self, trajectories: Trajectories) -> Evaluated:
        """What a unit of each does along trajectories."""


@dataclass(frozen=True)
class Probe:
    """A mechanism with its shapes set, by name; its amplitudes are what the data are asked for: a `Term`."""

    candidate: MechanismCandidate
    shapes: tuple[tuple[str, float], ...]

    @classmethod
    def all_of(
        cls, candidate: MechanismCandidate, data: Measurements, model: Dynamics, x: np.ndarray
    ) -> list[Probe]:
        """A candidate with its shapes at all places where they are looked for.

        Parameters
        ----------
        candidate
            The mechanism.
        data, model, x
            The recordings, and the simulation along them: sizes of motion are taken from there.
        """
        choices: list[tuple[tuple[str, float], ...]] = [()]
        for name, search in zip(candidate.shapes, candidate.searches, strict=True):
            found = places_of(search, data, model, x)
            if search.magnitude_of is not None:
                column = model.output_names.index(search.magnitude_of)
                begin = first_states(model, data)[data.first[:-1]]
                given = run(candidate.model, Grid(data, EDGE_SUBSTEPS), begin)
                simulated = along([candidate.model.outputs[column][1]], candidate.model, data, given)
                least, zero = np.nanmin(data.outputs[:, column]), -4 * np.sqrt(data.roughness[column])
                found = found if least >= zero and (simulated < zero).any() else found[:0]
            choices = [(*before, (name, float(place))) for before in choices for place in found]
        return [cls(candidate, shapes) for shapes in choices]

    @classmethod
    def along(cls, candidate: MechanismCandidate, fit: Fit, data: Measurements) -> list[Probe]:
        """The same along the trajectories of a fit, with jumps of f spread as its integration asks for."""
        substeps = max(fit.substeps, EDGE_SUBSTEPS)
        spread = replace(candidate, model=spread_edges(candidate.model, data, fit.x, substeps=substeps))
        return cls.all_of(spread, data, fit.model, fit.x)

    @property
    def recorded(self) -> bool:
        """Whether the recordings themselves show its shape.

        States that follow what was recorded never leave the range of a sensor: along them such a mechanism
        seems to change nothing, and only its fit tells.
        """
        return any(search.recorded is not None for search in self.candidate.searches)

    @property
    def width(self) -> int:
        """How many columns it has."""
        return max(len(self.candidate.amplitudes), 1)

    @property
    def positive(self) -> np.ndarray:
        """Which of its columns have amplitudes that must not be negative."""
        return np.array([each in self.candidate.positive for each in self.candidate.amplitudes] or [True])

    @property
    def delays(self) -> tuple[tuple[int, float], ...]:
        """Of inputs in the candidate's formulas."""
        shapes = dict(self.shapes)
        values = [shapes.get(each.name, each.value) for each in self.candidate.model.parameters]
        return self.candidate.model.lags(np.array(values))

    def parameters(self, values: np.ndarray) -> tuple[float, ...]:
        """All parameters: the simulation's, then the mechanism's."""
        shapes = dict(self.shapes)
        new = self.candidate.model.parameters[len(values) :]
        # As numpy has them: a division by zero is then infinite, and no error.
        return (*values, *(np.float64(shapes.get(each.name, 0.0)) for each in new))

    def columns(self, trajectories: Trajectories) -> Evaluated:
        """See `Term`."""
        model, grid, candidate = trajectories.model, trajectories.grid, self.candidate
        if id(candidate) not in trajectories.compiled:  # once for all probes of a candidate
            # Of rates and of outputs: the entries that are not zero, and their functions.
            columns, d = candidate.columns(model), model.dimension
            compiled = []
            for measured in (False, True):
                some = [one for one in columns if (one[0] >= d) is measured]
                entries = [(row - d * measured, column) for row, column, _ in some]
                formulas = [one for _, _, one in some]
                compiled.append((entries, compile_values(formulas, candidate.model.arguments)))
            trajectories.compiled[id(candidate)] = compiled
        of_rates, of_outputs = trajectories.compiled[id(candidate)]
        nodes = self._carried(trajectories) if candidate.scales else []

        def evaluated(x: np.ndarray, values: np.ndarray, node: int | None) -> Iterator[Entry]:
            entries, functions = of_outputs if node is None else of_rates
            if entries:
                further = x[:0]
                if nodes:
                    further = nodes[node] if node is not None else _at_samples(nodes, grid).T
                delays = self.delays
                signals = grid.at_samples(delays) if node is None else grid.signals(node, delays)
                at = (*x, *further, *signals.inputs, *signals.delayed, *signals.slopes, signals.t)
                found = functions(*at, *self.parameters(values))
                yield from ((row, column, value) for (row, column), value in zip(entries, found, strict=True))

        return evaluated

    def begin(self, fit: Fit, data: Measurements, x: np.ndarray) -> tuple[dict[str, float], np.ndarray]:
        """Where to begin on top of a fit: values by name, and states along recordings.

        States ``(n, d)`` follow those that it brings, shape ``(n, d + k)``. What follows recordings without a
        sign has lost it: there it begins with the simulation as given, fitted as it runs by itself.
        """
        known = dict(self.shapes)
        if self.candidate.unsigned:
            model = self.candidate.begun(self.candidate.model, known)
            first, grid, off = data.first[:-1], Grid(data, fit.substeps), []
            begin = first_states(fit.model, data)[first]  # those of the fit may be anywhere, where unseen
            for either in (begin, -begin):
                shown = along([h for _, h in model.outputs], model, data, run(model, grid, either)).T
                squares = np.where(np.isfinite(data.outputs), (shown - data.outputs) ** 2, 0.0)
                off.append(np.add.reduceat(squares / fit.noise.measurement, first).sum(axis=1))
            begin = np.where(off[1] < off[0], -1.0, 1.0)[:, None] * begin
            free = fit_trajectories(model, data, begin=begin, noise=fit.noise, substeps=fit.substeps)
            return {each.name: each.value for each in free.model.parameters}, free.x
        if not self.candidate.scales:
            return known, x
        grid = Grid(data, max(fit.substeps, EDGE_SUBSTEPS))  # it may be faster than the simulation
        further = _at_samples(self._carried(Trajectories(fit.model, grid, x)), grid)
        return known, np.concatenate([x, further], axis=1)

    def _carried(self, trajectories: Trajectories) -> list[np.ndarray]:
        """Its further states at all nodes, carried along each recording from its begin.

        Sample after sample along each recording, then within all intervals side by side.
        """
        grid, model, augmented = trajectories.grid, trajectories.model, self.candidate.model
        step = grid.step
        numbers = self.parameters(model.values)
        begins = along(self.candidate.begins, model, grid.data, trajectories.x)
        begin = np.ascontiguousarray(begins[:, grid.data.first[:-1]].T, dtype=float)
        # Further states, which come first, are carried; all else is known along the recordings.
        formulas = [augmented.evaluable(each) for each in augmented.equations[model.dimension :]]
        own = augmented.symbols[model.dimension :]
        arguments = [*own, *(each for each in augmented.arguments if each not in own)]
        rates, tape = compile_values(formulas, arguments), Tape.of(formulas, arguments)
        if tape is None:
            names = ", ".join(map(str, formulas))
            raise NumericalFailure(f"a state of its own has a formula that cannot be followed: {names}")
        signals = [
            np.concatenate([x, s.inputs, s.delayed, s.slopes, s.t[None]])
            for node, x in enumerate(trajectories.node_states)
            for s in (grid.signals(node, self.delays),)
        ]

        def rate(z: np.ndarray, node: int) -> np.ndarray:
            values = rates(*z, *signals[node], *numbers)
            return np.array([np.broadcast_to(value, z.shape[1:]) for value in values])

        z = run_along(tape, grid, np.stack(signals), np.array(numbers), begin)[grid.rows].T
        nodes = []
        for part in range(grid.substeps):
            first, middle, last = 3 * part, 3 * part + 1, 3 * part + 2
            k1 = rate(z, first)
            k2 = rate(z + step / 2 * k1, middle)
            k3 = rate(z + step / 2 * k2, middle)
            after = z + step / 6 * (k1 + 2 * k2 + 2 * k3 + rate(z + step * k3, last))
            nodes += [z, z + step / 2 * k2, after]
            z = after
        return nodes


def _at_samples(nodes: Sequence[np.ndarray], grid: Grid) -> np.ndarray:
    """What is known at all nodes, at the samples, shape ``(n, k)``."""
    states = np.zeros((len(grid.data.t), len(nodes[0])))
    states[grid.rows + 1] = nodes[-1].T
    states[grid.rows] = nodes[0].T
    return states


class _TermColumns:
    """The columns of terms, one behind the other: `siq.inference.kalman_filter.Columns`."""

    def __init__(self, terms: Sequence[Term], trajectories: Trajectories) -> None:
        ends = itertools.accumulate(each.width for each in terms)
        self._model = trajectories.model
        self.slices = [slice(end - each.width, end) for each, end in zip(terms, ends, strict=True)]
        self._parts = [
            (each.columns(trajectories), part) for each, part in zip(terms, self.slices, strict=True)
        ]

    def rates(self, x: np.ndarray, values: np.ndarray, node: int | None) -> np.ndarray:
        """See `siq.inference.kalman_filter.Columns`; without a node, of the outputs at all samples."""
        count = len(self._model.outputs) if node is None else self._model.dimension
        result = np.zeros((count, self.slices[-1].stop if self.slices else 0, x.shape[1]))
        for evaluated, part in self._parts:
            for row, column, value in evaluated(x, values, node):
                result[row, part][column] = value
        return result

    def outputs(self, x: np.ndarray, values: np.ndarray) -> np.ndarray:
        """See `siq.inference.kalman_filter.Columns`."""
        return self.rates(x, values, None)


NOISE_LEVELS = (1.0, 0.1, 1e-2, 1e-3, 1e-4, 0.0)
"""Process noise, relative to that of the fit."""
LARGEST_PORTION = 20_000_000  # numbers that are worked out at once; with copies about a gigabyte
LEAST_PORTION = 10  # columns
NEGATIVE_ERRORS = 2.0  # standard errors below zero, from which on an amplitude is taken for negative
COLLINEAR = 0.02  # share of a column left by the parameters, below which its amplitude knows no bounds
PROBE_SUBSTEPS = 2  # what a little of a mechanism does need not be known to many digits
AnyTerm = TypeVar("AnyTerm", bound=Term)


def portions(fit: Fit, data: Measurements, terms: Sequence[AnyTerm]) -> list[list[AnyTerm]]:
    """Terms divided so that the response to a portion fits into the memory."""
    most = LARGEST_PORTION // (len(data.t) * (fit.model.dimension + len(fit.model.outputs)))
    found, columns = list[list[AnyTerm]](), 0
    for term in terms:
        columns += term.width
        if not found or columns > max(most, LEAST_PORTION):
            found.append([])
            columns = term.width
        found[-1].append(term)
    return found


def linearised_with(
    fit: Fit, data: Measurements, terms: Sequence[Term], *, substeps: int = PROBE_SUBSTEPS,
    without: Sequence[int] = (),
) -> tuple[Linearisation, list[slice]]:  # fmt: skip
    """The linearisation of a fit with the columns of terms behind its parameters, and which is whose.

    These are worked out with so many substeps between samples at most, and in the place of what some free
    parameters do, by their places.
    """
    grid = Grid(data, min(fit.substeps, substeps))
    noise = fit.noise if fit.has_process_noise else None
    with np.errstate(all="ignore"):  # what overflows is left out of the screening
        columns = _TermColumns(terms, Trajectories(fit.model, grid, fit.x))
        at, values = fit.linearised_at, fit.model.values
        coarse = linearise(fit.model, grid, values, at, columns=columns, noise=noise, without=without)
    known, parameters = fit.linearisation, len(fit.model.free)
    further = coarse.response[:, :, parameters:], coarse.measured_response[:, :, parameters:]
    return replace(
        known,
        response=np.concatenate([known.response, further[0]], axis=2),
        measured_response=np.concatenate([known.measured_response, further[1]], axis=2),
    ), columns.slices


@dataclass(frozen=True)
class Projection:
    """Innovations and columns of terms, in units of noise, the effects of all parameters projected out.

    A column of which little is left is zero, since the parameters can do what it does, and so is one that is
    not finite.
    """

    left: np.ndarray
    columns: np.ndarray
    finite: np.ndarray
    freedom: int
    white: Whitened

    @classmethod
    def of(cls, white: Whitened, parameters: int) -> Projection:
        """Of whitened innovations, whose first columns are those of parameters.

        Raises
        ------
        NumericalFailure
            When a parameter's column is not finite.
        """
        own, further = white.columns[:, :parameters], white.columns[:, parameters:]
        if not np.isfinite(own).all():
            raise NumericalFailure("the effect of a parameter on what is measured is beyond all numbers")
        finite = (np.abs(further) < 1e150).all(axis=0)  # so that squares can be summed
        further = np.where(finite, further, 0.0)
        basis = orthonormal(own)
        left = white.innovations - basis @ (basis.T @ white.innovations)
        size = np.sqrt((further**2).sum(axis=0))
        further = further - basis @ (basis.T @ further)
        further[:, np.sqrt((further**2).sum(axis=0)) <= COLLINEAR * size] = 0.0
        return cls(left, further, finite, white.degrees_of_freedom - parameters, white)

    @cached_property
    def total(self) -> float:
        """Sum of squares."""
        return float(self.left @ self.left)

    @cached_property
    def overlap(self) -> np.ndarray:
        """Of the columns with the innovations."""
        return self.columns.T @ self.left

    @property
    def unexplained(self) -> np.ndarray:
        """What all columns together leave."""
        basis = orthonormal(self.columns)
        return self.left - basis @ (basis.T @ self.left)

    def likelihood(self, total: float) -> float:
        """Log-likelihood with so large a sum of squares left, the scale of the noise at its best."""
        return profile_likelihood(total, self.freedom, self.white.log_determinant)


def at_noise_levels(
    response: Linearisation, fit: Fit, data: Measurements,
    prepare: Callable[[Whitened], tuple[Whitened, int]] | None = None,
) -> Iterator[tuple[float, Projection]]:  # fmt: skip
    """The problem at each level of process noise at which it can be worked out; one where a fit has none.

    Innovations may be prepared, and are then returned with the number of parameters that are left.

    Raises
    ------
    NumericalFailure, numpy.linalg.LinAlgError
        When it cannot be worked out at any.
    """
    failure, worked = None, False
    for level in NOISE_LEVELS if fit.has_process_noise else (1.0,):
        try:
            white, parameters = whiten(response, data, fit.noise.scaled(level)), len(fit.model.free)
            if prepare is not None:
                white, parameters = prepare(white)
            problem = Projection.of(white, parameters)
        except NUMERICAL_ERRORS as error:  # without process noise an unstable simulation does not follow
            failure = error
            continue
        worked = True
        yield level, problem
    if failure is not None and not worked:
        raise failure


@dataclass(frozen=True)
class Ranked(Generic[AnyTerm]):
    """What a term would do."""

    term: AnyTerm
    #: Increase of what the judge tells, over that of no term, each at its best level of process noise.
    gain: float = -np.inf
    level: float = 1.0  #: at which it is best
    #: There; shape ``(k,)``, none where they are averaged over.
    amplitudes: np.ndarray = field(default_factory=lambda: np.zeros(0))
    standard_errors: np.ndarray = field(default_factory=lambda: np.zeros(0))  #: of these
    finite: bool = False  #: whether what it does to what is measured is a number at any level
    p_value: float = np.nan  #: probability of as much by chance, where that is asked


Judge = Callable[[AnyTerm, Projection, slice], tuple[float, np.ndarray, np.ndarray] | None]
"""Log-likelihood with a term, which has these columns, its amplitudes and their errors; None where there is
nothing to judge."""


def rank(
    fit: Fit, data: Measurements, terms: Sequence[AnyTerm], *, judge: Judge[AnyTerm],
    budget: Budget | None = None,
) -> tuple[list[Ranked[AnyTerm]], list[tuple[AnyTerm, Exception]]]:  # fmt: skip
    """Judge terms on top of a fit, and say why the others could not be worked out.

    The budget is charged for the work; terms that it does not reach are in neither list.
    """
    budget, ranked, failed = budget or Budget(), list[Ranked[AnyTerm]](), list[tuple[AnyTerm, Exception]]()
    for some in portions(fit, data, terms):
        try:
            work = evaluation(fit.model, data, columns=sum(each.width for each in some))
            budget.charge(min(fit.substeps, PROBE_SUBSTEPS) * work)
            response, groups = linearised_with(fit, data, some)
            base, best = -np.inf, [Ranked(each) for each in some]
            for level, problem in at_noise_levels(response, fit, data):
                base = max(base, problem.likelihood(problem.total))
                for place, (term, group) in enumerate(zip(some, groups, strict=True)):
                    if (found := judge(term, problem, group)) is not None:
                        best[place] = replace(best[place], finite=True)
                        if found[0] > best[place].gain:
                            best[place] = Ranked(term, found[0], level, *found[1:], finite=True)
            ranked += [replace(each, gain=each.gain - base) for each in best]
        except BudgetSpent:
            break
        except NUMERICAL_ERRORS as error:
            failed += [(each, error) for each in some]
    return ranked, failed


def by_likelihood(
    probe: Probe, problem: Projection, group: slice
) -> tuple[float, np.ndarray, np.ndarray] | None:
    """A `Judge`: the likelihood, amplitudes at their best values with signs that they may have.

    Those that would clearly be negative, and must not, are zero, the clearest first: what is left of a
    mechanism then is a special case of it.
    """
    if not problem.finite[group].all():
        return None
    columns, overlap, positive = problem.columns[:, group], problem.overlap[group], probe.positive
    gram, total = columns.T @ columns, problem.total
    kept = np.ones(len(overlap), dtype=bool)
    amplitudes, errors, after = np.zeros(len(overlap)), np.zeros(len(overlap)), total
    while kept.any():
        part = gram[np.ix_(kept, kept)]
        scale = np.sqrt(np.diag(part))
        scale = np.where(scale > 0, scale, np.inf)
        values, vectors = np.linalg.eigh(part / np.outer(scale, scale))
        told = values > 1e-10 * max(values[-1], 1e-300)
        covariance = (vectors[:, told] / values[told]) @ vectors[:, told].T / np.outer(scale, scale)
        solved = covariance @ overlap[kept]
        after = max(total - float(solved @ overlap[kept]), 1e-12 * total)
        spread = np.sqrt(np.diag(covariance) * after / max(problem.freedom - len(solved), 1))
        amplitudes[kept], errors[kept] = solved, spread
        below = np.where(positive & kept, -amplitudes / np.maximum(errors, np.finfo(float).tiny), 0.0)
        worst = int(np.argmax(below))
        if below[worst] <= NEGATIVE_ERRORS:
            break
        kept[worst] = False
        amplitudes[worst] = errors[worst] = 0.0
    return problem.likelihood(after) if amplitudes.any() else -np.inf, amplitudes, errors


def screen_all(
    data: Measurements, current: Fit, candidates: Sequence[MechanismCandidate], *,
    fruitless: Collection[str] = (), budget: Budget | None = None,
) -> tuple[list[Ranked[Probe]], list[NotFitted]]:  # fmt: skip
    """Screen every candidate on top of a fit, with its shapes at all places where they are looked for.

    One whose shape the recordings themselves show promises as much as the best, unless it was fitted before
    and gained nothing (`fruitless`, by label): see `Probe.recorded`. What the budget does not reach is not
    screened.

    Returns
    -------
    list of Ranked, list of NotFitted
        What each probe would gain, in χ²; and candidates of which none could be screened, with the reason.
    """
    budget, untried = budget or Budget(), dict[str, NotFitted]()
    probes: list[Probe] = []
    budget.says(f"screening {len(candidates)} candidates")
    for candidate in candidates:
        try:
            probes += Probe.along(candidate, current, data)
        except NUMERICAL_ERRORS as error:
            untried[candidate.label] = NotFitted.of(candidate, error)
    ranked, failed = rank(current, data, probes, judge=by_likelihood, budget=budget)
    untried |= {each.candidate.label: NotFitted.of(each.candidate, error) for each, error in failed}
    promised = max((2 * each.gain for each in ranked), default=0.0)
    screened = []
    for each in ranked:
        shown = each.term.recorded and each.finite and each.term.candidate.label not in fruitless
        screened.append(replace(each, gain=promised if shown else 2 * each.gain))
    finite = {each.term.candidate.label for each in ranked if each.finite}
    seen = {each.term.candidate.label for each in ranked}
    for candidate in (probe.candidate for probe in probes):  # some have no place where they could be
        if candidate.label not in finite:
            why = OVERFLOWS if candidate.label in seen else BUDGET_SPENT
            untried.setdefault(candidate.label, NotFitted.of(candidate, why))
    return screened, [each for label, each in untried.items() if label not in finite]
