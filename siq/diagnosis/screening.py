"""Screening: how much a little of each mechanism would improve the fit.

A mechanism that is absent from a simulation enters, to first order, by the derivative of f by its amplitudes.
Along the trajectories of one fit everything is linear, so that the likelihood with a probe, its amplitude and
all parameters at their best, is a matter of least squares. It is worked out for several levels of process
noise: where physics is missing the fit had to admit such noise, and the right probe makes it needless.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from siq.diagnosis.evidence import (
    BUDGET_SPENT,
    NUMERICAL_ERRORS,
    NotFitted,
    orthonormal,
)
from siq.diagnosis.mechanisms import MechanismCandidate, along, places_of
from siq.errors import NumericalFailure
from siq.inference.budget import Budget, BudgetSpent, evaluation
from siq.inference.kalman_filter import (
    Columns,
    Grid,
    Linearisation,
    Whitened,
    linearise,
    profile_likelihood,
    whiten,
)
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.inference.trajectories import EDGE_SUBSTEPS, run_along, spread_edges
from siq.systems.dynamics import Dynamics, Tape
from siq.systems.formulas import compile_values


@dataclass(frozen=True)
class Probe:
    """A candidate with its shapes set; its amplitudes are what the data are asked for.

    Attributes
    ----------
    candidate
        The mechanism and the model that has it.
    shapes
        Values of the shapes, by name.
    """

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
            choices = [(*before, (name, float(place))) for before in choices for place in found]
        return [cls(candidate, shapes) for shapes in choices]

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

    def states_along(self, fit: Fit, data: Measurements, x: np.ndarray) -> np.ndarray:
        """States ``(n, d)`` along recordings, with those that it brings to a fit, shape ``(n, d + k)``."""
        if not self.candidate.scales:
            return x
        columns = ProbeColumns(fit.model, Grid(data, fit.substeps), [self], x)
        return np.concatenate([x, columns.further_states(0)], axis=1)


class Basis(Protocol):
    """A function with linear parameters, such as values at knots."""

    @property
    def width(self) -> int:
        """The number of its parameters."""

    def values(self, courses: np.ndarray) -> np.ndarray:
        """What a unit of each does along courses ``(c, n)`` of the coordinates, shape ``(width, n)``."""


class ProbeColumns:
    """The columns of many probes, as `siq.inference.kalman_filter.linearise` wants them.

    Parameters
    ----------
    model
        The simulation that the candidates extend.
    grid
        Measurements and substeps.
    probes
        The columns stand in their order.
    x
        States along which further states of candidates are carried, shape ``(n, d)``.
    """

    def __init__(self, model: Dynamics, grid: Grid, probes: Sequence[Probe], x: np.ndarray) -> None:
        self._model, self._grid, self._probes, self._x = model, grid, probes, x
        self.width = sum(probe.width for probe in probes)
        # Of each candidate, of rates and of outputs: the entries that are not zero, and their functions.
        self._compiled = {}
        self._memories: dict[int, list[np.ndarray]] = {}
        for key, each in {id(probe.candidate): probe.candidate for probe in probes}.items():
            columns, d = each.columns(model), model.dimension
            for measured in (False, True):
                some = [one for one in columns if (one[0] >= d) is measured]
                entries = [(row - d * measured, column) for row, column, _ in some]
                functions = compile_values([one for _, _, one in some], each.model.arguments, common=False)
                self._compiled[key, measured] = entries, functions

    def rates(self, x: np.ndarray, values: np.ndarray, node: int) -> np.ndarray:
        """See `siq.inference.kalman_filter.Columns`."""
        return self._filled(x, values, node)

    def outputs(self, x: np.ndarray, values: np.ndarray) -> np.ndarray:
        """See `siq.inference.kalman_filter.Columns`."""
        return self._filled(x, values, None)

    def _filled(self, x: np.ndarray, values: np.ndarray, node: int | None) -> np.ndarray:
        """Columns of the rates at a node, or of the outputs at all samples."""
        count = len(self._model.outputs) if node is None else self._model.dimension
        result = np.zeros((count, self.width, x.shape[1]))
        place = 0
        for index, probe in enumerate(self._probes):
            entries, functions = self._compiled[id(probe.candidate), node is None]
            if entries:
                further, delays = x[:0], probe.delays
                if probe.candidate.scales:
                    further = self.further_states(index).T if node is None else self._memory(index)[node]
                signals = self._grid.at_samples(delays) if node is None else self._grid.signals(node, delays)
                at = (*x, *further, *signals.inputs, *signals.delayed, *signals.slopes, signals.t)
                found = functions(*at, *probe.parameters(values))
                for (row, column), value in zip(entries, found, strict=True):
                    result[row, place + column] = value
            place += probe.width
        return result

    @cached_property
    def _node_states(self) -> list[np.ndarray]:
        """States of the simulation at all nodes: between samples cubics that have the slopes of f.

        Straight lines would be early or late by half a sample, as much as what a sensor's lag does.
        """
        grid, model = self._grid, self._model
        rows, substeps = grid.rows, grid.substeps
        begin, end = self._x[rows].T, self._x[rows + 1].T
        delays, whole = model.lags(model.values), grid.step * substeps
        first, last = (
            whole * model.functions.rates(x, grid.signals(node, delays), model.values)
            for x, node in ((begin, 0), (end, 3 * substeps - 1))
        )
        turn = first + last - 2 * (end - begin)
        bend = 3 * (end - begin) - 2 * first - last
        shares = [(node // 3 + (node % 3) / 2) / substeps for node in range(3 * substeps)]
        return [begin + share * (first + share * (bend + share * turn)) for share in shares]

    def further_states(self, index: int) -> np.ndarray:
        """The states that a probe brings, at all samples, shape ``(n, k)``."""
        nodes = self._memory(index)
        rows = self._grid.rows
        states = np.zeros((len(self._x), len(nodes[0])))
        states[rows + 1] = nodes[-1].T
        states[rows] = nodes[0].T
        return states

    def _memory(self, index: int) -> list[np.ndarray]:
        """The further states of a probe at all nodes, carried along each recording from its begin."""
        if index not in self._memories:
            self._memories[index] = self._carry(self._probes[index])
        return self._memories[index]

    def _carry(self, probe: Probe) -> list[np.ndarray]:
        """Sample after sample along each recording, then within all intervals side by side."""
        grid, model, augmented = self._grid, self._model, probe.candidate.model
        step = grid.step
        numbers = probe.parameters(model.values)
        begins = along(probe.candidate.begins, model, grid.data, self._x)
        begin = np.ascontiguousarray(begins[:, grid.data.first[:-1]].T, dtype=float)
        # Further states, which come first, are carried; all else is known along the recordings.
        formulas = [augmented.evaluable(each) for each in augmented.equations[model.dimension :]]
        own = augmented.symbols[model.dimension :]
        arguments = [*own, *(each for each in augmented.arguments if each not in own)]
        rates, tape = compile_values(formulas, arguments, common=False), Tape.of(formulas, arguments)
        if tape is None:
            names = ", ".join(map(str, formulas))
            raise NumericalFailure(f"a state of its own has a formula that cannot be followed: {names}")
        signals = [
            np.concatenate([x, s.inputs, s.delayed, s.slopes, s.t[None]])
            for x, s in (
                (self._node_states[node], grid.signals(node, probe.delays))
                for node in range(3 * grid.substeps)
            )
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
            k4 = rate(z + step * k3, last)
            after = z + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            nodes += [z, z + step / 2 * k2, after]
            z = after
        return nodes


NOISE_LEVELS = (1.0, 0.1, 1e-2, 1e-3, 1e-4, 0.0)
"""Process noise, relative to that of the fit."""
LARGEST_PORTION = 20_000_000  # numbers that are worked out at once; with copies about a gigabyte
LEAST_PORTION = 10  # columns
NEGATIVE_ERRORS = 2.0  # standard errors below zero, from which on an amplitude is taken for negative
COLLINEAR = 0.02  # share of a column left by the parameters, below which its amplitude knows no bounds


@dataclass(frozen=True)
class Screened:
    """What one group of columns would do.

    Attributes
    ----------
    gain
        Twice the increase of the log-likelihood, each side at its best level of process noise.
    level
        The level at which it is best.
    amplitudes, standard_errors
        There; shape ``(k,)``.
    finite
        Whether what the columns do to what is measured is a number at any level.
    """

    gain: float
    level: float
    amplitudes: np.ndarray
    standard_errors: np.ndarray
    finite: bool = True


def levels_of(fit: Fit) -> tuple[float, ...]:
    """The levels of process noise at which something is judged on top of a fit; one where it has none."""
    return NOISE_LEVELS if fit.has_process_noise else (1.0,)


def slices_of(bases: Sequence[Probe | Basis]) -> list[slice]:
    """Which columns are those of which basis, where they stand one behind the other."""
    ends = itertools.accumulate(each.width for each in bases)
    return [slice(end - each.width, end) for each, end in zip(bases, ends, strict=True)]


def probe_response(fit: Fit, grid: Grid, columns: Columns) -> Linearisation:
    """The linearisation of a fit, with further columns, on a grid that may be coarser, behind its own."""
    with np.errstate(all="ignore"):  # what overflows is left out of the screening
        coarse = linearise(fit.model, grid, fit.model.values, fit.linearised_at, columns=columns)
    known, parameters = fit.linearisation, len(fit.model.free)
    return replace(
        known,
        response=np.concatenate([known.response, coarse.response[:, :, parameters:]], axis=2),
        measured_response=np.concatenate(
            [known.measured_response, coarse.measured_response[:, :, parameters:]], axis=2
        ),
    )


def projected(white: Whitened, parameters: int) -> tuple[np.ndarray, np.ndarray]:
    """Innovations and further columns with the parameters' columns projected out.

    A column of which little is left is set to zero, since the parameters can do what it does, and so is one
    that is not finite.

    Raises
    ------
    NumericalFailure
        When a parameter's column is not finite.
    """
    own, further = white.columns[:, :parameters], white.columns[:, parameters:]
    if not np.isfinite(own).all():
        raise NumericalFailure("the effect of a parameter on what is measured is beyond all numbers")
    further = np.where(np.isfinite(further).all(axis=0), further, 0.0)
    basis = orthonormal(own)
    left = white.innovations - basis @ (basis.T @ white.innovations)
    size = np.sqrt((further**2).sum(axis=0))
    further = further - basis @ (basis.T @ further)
    further[:, np.sqrt((further**2).sum(axis=0)) <= COLLINEAR * size] = 0.0
    return left, further


def _screen(
    linearisation: Linearisation,
    data: Measurements,
    fit: Fit,
    groups: Sequence[slice],
    *,
    positive: Sequence[np.ndarray],
) -> list[Screened]:
    """Screen groups of columns."""
    parameters = len(fit.model.free)
    base = -np.inf
    best = [Screened(-np.inf, 1.0, np.zeros(0), np.zeros(0), finite=False)] * len(groups)
    failure: NumericalFailure | None = None
    for level in levels_of(fit):
        try:
            white = whiten(linearisation, data, fit.noise.scaled(level))
        except NumericalFailure as error:  # without process noise an unstable simulation does not follow
            failure = error
            continue
        finite = np.isfinite(white.columns[:, parameters:]).all(axis=0)
        freedom = white.degrees_of_freedom - parameters
        left, columns = projected(white, parameters)
        total = float(left @ left)
        base = max(base, profile_likelihood(total, freedom, white.log_determinant))
        overlap = columns.T @ left
        for place, group in enumerate(groups):
            if not finite[group].all():
                continue
            best[place] = replace(best[place], finite=True)
            gram = columns[:, group].T @ columns[:, group]
            amplitudes, errors, after = _admissible(gram, overlap[group], total, freedom, positive[place])
            value = profile_likelihood(after, freedom, white.log_determinant)
            if amplitudes.any() and value > best[place].gain:
                best[place] = Screened(value, level, amplitudes, errors)
    if failure is not None and base == -np.inf:
        raise failure
    return [replace(each, gain=2 * (each.gain - base)) for each in best]


def _admissible(
    gram: np.ndarray, overlap: np.ndarray, total: float, freedom: int, positive: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Amplitudes that their signs allow, their standard errors, and the squares that are left.

    Those that would clearly be negative, and must not, are zero, the clearest first: what is left of a
    mechanism then is a special case of it.
    """
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
        spread = np.sqrt(np.diag(covariance) * after / max(freedom - len(solved), 1))
        amplitudes[kept], errors[kept] = solved, spread
        below = np.where(positive & kept, -amplitudes / np.maximum(errors, np.finfo(float).tiny), 0.0)
        worst = int(np.argmax(below))
        if below[worst] <= NEGATIVE_ERRORS:
            break
        kept[worst] = False
        amplitudes[worst] = errors[worst] = 0.0
    return amplitudes, errors, after if kept.any() else total


PROBE_SUBSTEPS = 2  # what a little of a mechanism does need not be known to many digits
OVERFLOWS = "its effect along the recorded motion is beyond all numbers"


def screen_all(
    data: Measurements,
    current: Fit,
    candidates: Sequence[MechanismCandidate],
    *,
    fruitless: Collection[str] = (),
    budget: Budget | None = None,
) -> tuple[list[tuple[Probe, Screened]], list[NotFitted]]:
    """Screen every candidate, with its shapes at all places where they are looked for.

    One whose shape the recordings themselves show promises as much as the best, unless it was fitted before
    and gained nothing: see `Probe.recorded`.

    Parameters
    ----------
    data, current
        The recordings, and the fit that is to be improved.
    candidates
        What may be missing.
    fruitless
        Labels of those that gained nothing when they were fitted.
    budget
        Charged for the work; what it does not reach is not screened.

    Returns
    -------
    list of (Probe, Screened), list of NotFitted
        What each probe would gain; and candidates of which no probe could be screened, with the reason.
    """
    budget, model, substeps = budget or Budget(), current.model, current.substeps
    untried: dict[str, NotFitted] = {}
    probes = []
    for candidate in candidates:
        try:
            sharp = max(substeps, EDGE_SUBSTEPS)
            spread = replace(candidate, model=spread_edges(candidate.model, data, current.x, substeps=sharp))
            probes += Probe.all_of(spread, data, model, current.x)
        except NUMERICAL_ERRORS as error:
            untried[candidate.label] = NotFitted.of(candidate, error)
    grid = Grid(data, min(substeps, PROBE_SUBSTEPS))
    screened: list[tuple[Probe, Screened]] = []
    # Divided so that the response to a portion fits into the memory.
    most = max(LARGEST_PORTION // (len(data.t) * (model.dimension + len(model.outputs))), LEAST_PORTION)
    portions: list[list[Probe]] = []
    for probe in probes:
        if not portions or sum(each.width for each in portions[-1]) + probe.width > most:
            portions.append([])
        portions[-1].append(probe)
    for some in portions:
        try:
            budget.says(f"screening {len(candidates)} candidates")
            budget.charge(grid.substeps * evaluation(model, data, columns=sum(probe.width for probe in some)))
            response = probe_response(current, grid, ProbeColumns(model, grid, some, current.x))
            groups = slices_of(some)
            positive = [
                np.array([name in each.candidate.positive for name in each.candidate.amplitudes] or [True])
                for each in some
            ]
            results = _screen(response, data, current, groups, positive=positive)
            screened += zip(some, results, strict=True)
        except BudgetSpent:
            break
        except NUMERICAL_ERRORS as error:
            for probe in some:
                untried[probe.candidate.label] = NotFitted.of(probe.candidate, error)
    promised = max((result.gain for _, result in screened), default=0.0)
    screened = [
        (probe, replace(result, gain=max(promised, result.gain)))
        if probe.recorded and result.finite and probe.candidate.label not in fruitless
        else (probe, result)
        for probe, result in screened
    ]
    finite = {probe.candidate.label for probe, result in screened if result.finite}
    seen = {probe.candidate.label for probe, _ in screened}
    for candidate in (probe.candidate for probe in probes):  # some have no place where they could be
        if candidate.label not in finite:
            why = OVERFLOWS if candidate.label in seen else BUDGET_SPENT
            untried.setdefault(candidate.label, NotFitted.of(candidate, why))
    return screened, [each for label, each in untried.items() if label not in finite]
