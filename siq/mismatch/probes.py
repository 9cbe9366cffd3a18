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
from siq.dynamics.formulas import compile_values, parse_formula
from siq.dynamics.parametric import arguments_of, evaluable, symbol
from siq.estimation.linearisation import Grid
from siq.estimation.measurements import Measurements
from siq.mismatch.candidates import MechanismCandidate
from siq.mismatch.dictionary import Shape


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
        for probe in self._probes:
            compiled = self._compiled[id(probe.candidate)]
            if compiled.output_entries:
                signals = self._grid.at_samples(compiled.delays_at(probe))
                zeros = np.zeros((len(probe.candidate.scales), x.shape[1]))
                at = (*x, *zeros, *signals.inputs, *signals.delayed, *signals.slopes, signals.t)
                numbers = compiled.numbers(probe, values)
                _fill(result, place, compiled.output_entries, compiled.outputs(*at, *numbers))
            place += probe.width
        return result

    @cached_property
    def _node_states(self) -> list[np.ndarray]:
        """States of the simulation at all nodes, between the samples of `x` by straight lines."""
        rows = self._grid.rows
        begin, end = self._x[rows].T, self._x[rows + 1].T
        substeps = self._grid.substeps
        return [
            begin + (end - begin) * ((node // 3 + (node % 3) / 2) / substeps) for node in range(3 * substeps)
        ]

    def further_states(self, index: int) -> np.ndarray:
        """The states that a probe brings, at all samples, shape ``(n, k)``."""
        nodes = self._memory(index)
        rows = self._grid.rows
        states = np.zeros((len(self._x), len(nodes[0])))
        states[rows + 1] = nodes[-1].T
        states[rows] = nodes[0].T
        return states

    def _memory(self, index: int) -> list[np.ndarray]:
        """The further states of a probe at all nodes, carried along each recording from zero."""
        cache = self.__dict__.setdefault("_memories", {})
        if index not in cache:
            cache[index] = self._carry(self._probes[index])
        return cache[index]

    def _carry(self, probe: Probe) -> list[np.ndarray]:
        compiled = self._compiled[id(probe.candidate)]
        grid, data = self._grid, self._grid.data
        rows = grid.rows
        count = len(probe.candidate.scales)
        nodes = [np.zeros((count, len(rows))) for _ in range(3 * grid.substeps)]
        numbers = compiled.numbers(probe, self._values)
        lengths = np.diff(data.first) - 1
        begins = np.concatenate([[0], np.cumsum(lengths)])[:-1]
        state = np.zeros((count, len(lengths)))
        signals = [grid.signals(node, compiled.delays_at(probe)) for node in range(3 * grid.substeps)]

        def rate(z: np.ndarray, node: int, at: np.ndarray) -> np.ndarray:
            s = signals[node]
            arguments = (
                *self._node_states[node][:, at], *z, *s.inputs[:, at],
                *s.delayed[:, at], *s.slopes[:, at], s.t[at],
            )  # fmt: skip
            return np.array([np.broadcast_to(v, at.shape) for v in compiled.memory(*arguments, *numbers)])

        for sample in range(int(lengths.max(initial=0))):
            alive = np.flatnonzero(lengths > sample)
            at = begins[alive] + sample
            z, step = state[:, alive], grid.step[at]
            for part in range(grid.substeps):
                first, middle, last = 3 * part, 3 * part + 1, 3 * part + 2
                k1 = rate(z, first, at)
                k2 = rate(z + step / 2 * k1, middle, at)
                k3 = rate(z + step / 2 * k2, middle, at)
                k4 = rate(z + step * k3, last, at)
                after = z + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
                nodes[first][:, at], nodes[last][:, at] = z, after
                nodes[middle][:, at] = z + step / 2 * k2
                z = after
            state[:, alive] = z
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
        further = written[model.dimension : augmented.dimension]
        self.memory = compile_values(further, arguments, common=False)

    def numbers(self, probe: Probe, values: np.ndarray) -> tuple[float, ...]:
        """All parameters: the simulation's, then the mechanism's."""
        shapes = dict(probe.shapes)
        new = self._candidate.model.parameters[self._count :]
        return (*values, *(shapes.get(each.name, 0.0) for each in new))

    def delays_at(self, probe: Probe) -> tuple[tuple[int, float], ...]:
        """Delayed inputs of the candidate's formulas."""
        shapes = dict(probe.shapes)
        values = [shapes.get(each.name, each.value) for each in self._candidate.model.parameters]
        return self._candidate.model.lags(np.array(values))


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


def places_of(search: Shape, data: Measurements, model: Dynamics, x: np.ndarray) -> np.ndarray:
    """The values of a shape that a search begins with."""
    factors = np.array(search.at)
    steps = np.diff(data.t)[np.diff(data.recording) == 0]
    if search.samples:
        return factors * np.median(steps)
    if search.frequencies is not None:
        longest = max(
            data.t[end - 1] - data.t[begin]
            for begin, end in zip(data.first[:-1], data.first[1:], strict=True)
        )
        # From one period in the longest recording to four samples a period.
        return np.linspace(2 * np.pi / longest, np.pi / (2 * np.median(steps)), search.frequencies)
    text = search.scale_of or search.inverse_scale_of or search.quantiles_of
    course = along(str(text), data, model, x)
    if search.quantiles_of is not None:
        return np.quantile(course, factors)
    size = float(np.sqrt(np.mean(course**2))) or 1.0
    return factors * size if search.scale_of is not None else factors / size


def along(text: str, data: Measurements, model: Dynamics, x: np.ndarray) -> np.ndarray:
    """A formula of states and inputs at all samples, shape ``(n,)``."""
    formula = parse_formula(text, model.names)
    signals = data.signals(data.t, data.recording, delays=())
    arguments = [*(symbol(n) for n in model.states), *(symbol(e.name) for e in model.inputs), symbol("t")]
    value = compile_values([formula], arguments, common=False)(*x.T, *signals.inputs, signals.t)[0]
    return np.broadcast_to(value, data.t.shape)


def _fill(result: np.ndarray, place: int, entries: list[tuple[int, int]], found: Sequence[object]) -> None:
    for (row, column), value in zip(entries, found, strict=True):
        result[row, place + column] = value
