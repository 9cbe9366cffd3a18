"""Probes: the response of the simulation to a little of each mechanism.

A mechanism that is absent from a simulation enters, to first order, by the derivative of f by its amplitudes.
The responses of all candidates are worked out together, along the trajectories of a fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import compile_values
from siq.dynamics.parametric import arguments_of, evaluable, symbol
from siq.dynamics.tape import tape_of
from siq.errors import NumericalFailure
from siq.estimation.linearisation import Grid
from siq.estimation.measurements import Measurements
from siq.estimation.trajectories import run_along
from siq.mismatch.building import MechanismCandidate
from siq.mismatch.places import along, places_of


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


class ProbeColumns:
    """The columns of many probes, as `siq.estimation.linearisation.linearise` wants them.

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
    values
        The simulation's parameters.
    """

    def __init__(
        self, model: Dynamics, grid: Grid, probes: Sequence[Probe], x: np.ndarray, values: np.ndarray
    ) -> None:
        self._model, self._grid, self._probes = model, grid, probes
        self._x, self._values = x, values
        candidates = {id(each.candidate): each.candidate for each in probes}
        self._compiled = {key: _Compiled(model, each) for key, each in candidates.items()}
        self.width = sum(probe.width for probe in probes)

    def rates(self, x: np.ndarray, values: np.ndarray, node: int) -> np.ndarray:
        """See `siq.estimation.linearisation.Columns`."""
        result = np.zeros((self._model.dimension, self.width, x.shape[1]))
        place = 0
        for index, probe in enumerate(self._probes):
            compiled = self._compiled[id(probe.candidate)]
            if compiled.rate_entries:
                further = self._memory(index)[node] if probe.candidate.scales else x[:0]
                signals = self._grid.signals(node, compiled.delays_at(probe))
                at = (*x, *further, *signals.inputs, *signals.delayed, *signals.slopes, signals.t)
                _fill(
                    result,
                    place,
                    compiled.rate_entries,
                    compiled.rates(*at, *compiled.numbers(probe, values)),
                )
            place += probe.width
        return result

    def outputs(self, x: np.ndarray, values: np.ndarray) -> np.ndarray:
        """See `siq.estimation.linearisation.Columns`."""
        result = np.zeros((len(self._model.outputs), self.width, x.shape[1]))
        place = 0
        for index, probe in enumerate(self._probes):
            compiled = self._compiled[id(probe.candidate)]
            if compiled.output_entries:
                signals = self._grid.at_samples(compiled.delays_at(probe))
                further = self.further_states(index).T if probe.candidate.scales else x[:0]
                at = (*x, *further, *signals.inputs, *signals.delayed, *signals.slopes, signals.t)
                numbers = compiled.numbers(probe, values)
                _fill(result, place, compiled.output_entries, compiled.outputs(*at, *numbers))
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
        delays, whole = model.lags(self._values), grid.step * substeps
        first, last = (
            whole * model.functions.rates(x, grid.signals(node, delays), self._values)
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
        cache = self.__dict__.setdefault("_memories", {})
        if index not in cache:
            cache[index] = self._carry(self._probes[index])
        return cache[index]

    def _carry(self, probe: Probe) -> list[np.ndarray]:
        """Sample after sample along each recording, then within all intervals side by side."""
        compiled = self._compiled[id(probe.candidate)]
        grid = self._grid
        step = grid.step
        numbers = compiled.numbers(probe, self._values)
        begin = np.empty((len(grid.data.labels), len(probe.candidate.begins)))
        model = self._model.with_values(self._values)
        for place, formula in enumerate(probe.candidate.begins):
            begin[:, place] = along(str(formula), grid.data, model, self._x)[grid.data.first[:-1]]
        signals = [
            np.concatenate([x, s.inputs, s.delayed, s.slopes, s.t[None]])
            for x, s in (
                (self._node_states[node], grid.signals(node, compiled.delays_at(probe)))
                for node in range(3 * grid.substeps)
            )
        ]

        def rate(z: np.ndarray, node: int) -> np.ndarray:
            values = compiled.memory(*z, *signals[node], *numbers)
            return np.array([np.broadcast_to(value, z.shape[1:]) for value in values])

        z = compiled.carried(grid, np.stack(signals), numbers, begin)[grid.rows].T
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


class _Compiled:
    """The columns of one candidate as functions; entries without an effect are left out."""

    def __init__(self, model: Dynamics, candidate: MechanismCandidate) -> None:
        augmented = candidate.model
        self._candidate, self._count = candidate, len(model.parameters)
        formulas = [*augmented.equations, *(formula for _, formula in augmented.outputs)]
        arguments = arguments_of(augmented)
        written = [evaluable(formula, augmented) for formula in formulas]
        zero = {symbol(name): 0 for name in candidate.amplitudes}

        def columns(formula: sympy.Expr, before: sympy.Expr) -> list[sympy.Expr]:
            if not candidate.amplitudes:
                return [formula - before]
            return [formula.diff(symbol(name)).subs(zero) for name in candidate.amplitudes]

        base = [evaluable(formula, model) for formula in model.equations]
        rates = [columns(f, b) for f, b in zip(written[: model.dimension], base, strict=True)]
        outputs = [
            columns(f, b) for f, (_, b) in zip(written[augmented.dimension :], model.outputs, strict=True)
        ]
        self.rate_entries = [(i, j) for i, row in enumerate(rates) for j, each in enumerate(row) if each != 0]
        self.output_entries = [
            (i, j) for i, row in enumerate(outputs) for j, each in enumerate(row) if each != 0
        ]
        self.rates = compile_values([rates[i][j] for i, j in self.rate_entries], arguments, common=False)
        self.outputs = compile_values(
            [outputs[i][j] for i, j in self.output_entries], arguments, common=False
        )
        # Of further states, which come first: they are carried, and all else is known along the recordings.
        self._further = written[model.dimension : augmented.dimension]
        own = [symbol(name) for name in augmented.states[model.dimension :]]
        self._memory_arguments = [*own, *(each for each in arguments if each not in own)]
        self.memory = compile_values(self._further, self._memory_arguments, common=False)

    def numbers(self, probe: Probe, values: np.ndarray) -> tuple[float, ...]:
        """All parameters: the simulation's, then the mechanism's."""
        shapes = dict(probe.shapes)
        new = self._candidate.model.parameters[self._count :]
        # As numpy has them: a division by zero is then infinite, and no error.
        return (*values, *(np.float64(shapes.get(each.name, 0.0)) for each in new))

    def carried(
        self, grid: Grid, signals: np.ndarray, numbers: tuple[float, ...], begin: np.ndarray
    ) -> np.ndarray:
        """The further states at all samples, shape ``(n, k)``.

        Parameters
        ----------
        grid, signals
            What is known at all nodes, shape ``(3 substeps, s, intervals)``.
        numbers
            All parameters.
        begin
            Where they begin, shape ``(recordings, k)``.
        """
        tape = tape_of(self._further, self._memory_arguments)
        if tape is None:
            names = ", ".join(map(str, self._further))
            raise NumericalFailure(f"a state of its own has a formula that cannot be followed: {names}")
        return run_along(tape, grid, signals, np.array(numbers), begin)

    def delays_at(self, probe: Probe) -> tuple[tuple[int, float], ...]:
        """Delayed inputs of the candidate's formulas."""
        shapes = dict(probe.shapes)
        values = [shapes.get(each.name, each.value) for each in self._candidate.model.parameters]
        return self._candidate.model.lags(np.array(values))


def with_further_states(
    probe: Probe, model: Dynamics, data: Measurements, x: np.ndarray, *, substeps: int, values: np.ndarray
) -> np.ndarray:
    """States along recordings, with those that a probe brings behind them, shape ``(n, d + k)``.

    Parameters
    ----------
    probe
        The mechanism with its shapes.
    model, data, x
        The simulation without it, the recordings, and the states along them, shape ``(n, d)``.
    substeps, values
        Runge–Kutta steps between samples, and the simulation's parameters.
    """
    if not probe.candidate.scales:
        return x
    own = ProbeColumns(model, Grid(data, substeps), [probe], x, values)
    return np.concatenate([x, own.further_states(0)], axis=1)


def probes_of(
    candidate: MechanismCandidate, data: Measurements, model: Dynamics, x: np.ndarray
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
    return [Probe(candidate, shapes) for shapes in choices]


def _fill(result: np.ndarray, place: int, entries: list[tuple[int, int]], found: Sequence[object]) -> None:
    for (row, column), value in zip(entries, found, strict=True):
        result[row, place + column] = value
