"""The simulation as its author believes it: equations, inputs, outputs and parameters, all of them symbols.

A system card read for a study of mismatch keeps its parameters as symbols, since they are to be fitted, and
knows inputs, outputs and the time, which `siq.systems.System` does not. What physics may be missing is said
by other models of the same kind, with further terms, parameters or states (`siq.mismatch.candidates`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import sympy

from siq.expressions import compile_values, delay

TIME = sympy.Symbol("t", real=True)
SMOOTHER = 30.0  # widths of a jump over which its derivative is spread


@dataclass(frozen=True)
class Input:
    """An exogenous signal: its name, unit, and how it holds between samples."""

    name: str
    unit: str
    interpolation: str


@dataclass(frozen=True)
class Parameter:
    """A parameter with the value that the card gives it; a fixed one is never recalibrated."""

    name: str
    value: float
    unit: str = "1"
    fixed: bool = False


@dataclass(frozen=True)
class Model:
    """A simulation ``dx/dt = f(x, u, t; θ)`` of which ``y = h(x, u, t; θ)`` is measured.

    Attributes
    ----------
    name, title, time_unit
        As the card says.
    states, state_units
        Names and units, in the order of the state vector.
    domain
        Shape ``(d, 2)``: where the states are expected, in their units.
    inputs
        The signals that drive it.
    parameters
        θ, in the order of the parameter vector.
    equations
        Components of f, in symbols for states, inputs, parameters and ``t``.
    outputs
        What a recording measures, by the name of its column.
    edges
        Arguments of ``sign`` in f and the widths over which the jump is spread when f is evaluated, so that
        an integrator can follow it: ``sign(e)`` is taken as ``tanh(e/w)``. The formulas keep the sign.
    """

    name: str
    title: str
    time_unit: str
    states: tuple[str, ...]
    state_units: tuple[str, ...]
    domain: np.ndarray
    inputs: tuple[Input, ...]
    parameters: tuple[Parameter, ...]
    equations: tuple[sympy.Expr, ...]
    outputs: tuple[tuple[str, sympy.Expr], ...]
    edges: tuple[tuple[sympy.Expr, float], ...] = ()

    @property
    def dimension(self) -> int:
        """Number of states, d."""
        return len(self.states)

    @property
    def output_names(self) -> tuple[str, ...]:
        """The measured columns."""
        return tuple(name for name, _ in self.outputs)

    @property
    def values(self) -> np.ndarray:
        """The parameters' values, shape ``(p,)``."""
        return np.array([parameter.value for parameter in self.parameters], dtype=float)

    @property
    def free(self) -> tuple[int, ...]:
        """Places of the parameters that may be recalibrated."""
        used = set().union(*(each.free_symbols for each in (*self.equations, *dict(self.outputs).values())))
        return tuple(
            place
            for place, parameter in enumerate(self.parameters)
            if not parameter.fixed and symbol(parameter.name) in used
        )

    @property
    def names(self) -> dict[str, sympy.Symbol]:
        """What the names in its formulas stand for."""
        known = [*self.states, *(each.name for each in self.inputs), *(each.name for each in self.parameters)]
        return {name: symbol(name) for name in known} | {"t": TIME}

    @property
    def kinematic(self) -> tuple[bool, ...]:
        """Which equations only define a state as the derivative of another, ``dx/dt = v``.

        Such an equation holds by definition: no physics can be missing in it, and no noise drives it.
        """
        states = {symbol(name) for name in self.states}
        return tuple(equation in states for equation in self.equations)

    def with_values(self, values: np.ndarray) -> Model:
        """The same model with other parameters' values, shape ``(p,)``."""
        changed = (
            replace(parameter, value=float(value))
            for parameter, value in zip(self.parameters, values, strict=True)
        )
        return replace(self, parameters=tuple(changed))

    @cached_property
    def compiled(self) -> CompiledModel:
        """The model as functions of arrays."""
        return CompiledModel(self)

    @cached_property
    def delays(self) -> tuple[sympy.Expr, ...]:
        """The delayed inputs in its formulas, each once, in an order that does not change."""
        return delays_of([*self.equations, *(formula for _, formula in self.outputs)])

    @cached_property
    def _lags(self) -> Callable[..., Sequence[np.ndarray | float]]:
        return compile_values(
            [each.args[1] for each in self.delays], [symbol(each.name) for each in self.parameters]
        )

    def lags(self, values: np.ndarray) -> tuple[tuple[int, float], ...]:
        """Delayed inputs at parameters' values: the place of the input, and by how much time it lags."""
        if not self.delays:
            return ()
        places = {entry.name: place for place, entry in enumerate(self.inputs)}
        times = self._lags(*values)
        return tuple(
            (places[str(each.args[0])], float(time)) for each, time in zip(self.delays, times, strict=True)
        )


def symbol(name: str) -> sympy.Symbol:
    """The symbol that stands for a name in every formula of a model."""
    return TIME if name == "t" else sympy.Symbol(name, real=True)


@dataclass(frozen=True)
class Signals:
    """Inputs and times at n instants.

    Attributes
    ----------
    inputs
        Shape ``(i, n)``, in the order of the model's inputs.
    delayed, slopes
        The delayed inputs of the compiled model and their time derivatives, shape ``(j, n)`` each.
    t
        Shape ``(n,)``.
    """

    inputs: np.ndarray
    delayed: np.ndarray
    slopes: np.ndarray
    t: np.ndarray


class CompiledModel:
    """A model as functions of arrays, with its derivatives by states and by free parameters.

    Parameters
    ----------
    model
        What is compiled.
    """

    def __init__(self, model: Model) -> None:
        formulas = [*model.equations, *(formula for _, formula in model.outputs)]
        delays = model.delays
        self._arguments = arguments_of(model)
        written = [evaluable(formula, model) for formula in formulas]
        equations, outputs = written[: model.dimension], written[model.dimension :]
        # A jump's derivative is a spike. Spread over more than a step it is seen in full by every rule of
        # integration, and carries deviations across the jump as they are carried in the mean.
        smooth = [evaluable(formula, model, wider=SMOOTHER) for formula in model.equations]
        states = [symbol(name) for name in model.states]
        free = [symbol(model.parameters[place].name) for place in model.free]
        self._shapes = (model.dimension, len(outputs), len(free))
        self._rates = compile_values(equations, self._arguments)
        self._outputs = compile_values(outputs, self._arguments)
        self._slopes = compile_values(
            [each.diff(state) for each in smooth for state in states]
            + [by_parameter(each, parameter, delays) for each in equations for parameter in free],
            self._arguments,
        )
        self._output_slopes = compile_values(
            [each.diff(state) for each in outputs for state in states]
            + [by_parameter(each, parameter, delays) for each in outputs for parameter in free],
            self._arguments,
        )

    def rates(self, x: np.ndarray, signals: Signals, values: np.ndarray) -> np.ndarray:
        """F at states ``(d, n)``, for parameters' values ``(p,)``: shape ``(d, n)``."""
        return _stacked(self._rates, self._shapes[0], x, signals, values)

    def outputs(self, x: np.ndarray, signals: Signals, values: np.ndarray) -> np.ndarray:
        """H at states ``(d, n)``: shape ``(m, n)``."""
        return _stacked(self._outputs, self._shapes[1], x, signals, values)

    def slopes(self, x: np.ndarray, signals: Signals, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of f by states and by free parameters: ``(d, d, n)`` and ``(d, p, n)``."""
        d, _, p = self._shapes
        flat = _stacked(self._slopes, d * d + d * p, x, signals, values)
        return flat[: d * d].reshape(d, d, x.shape[1]), flat[d * d :].reshape(d, p, x.shape[1])

    def output_slopes(
        self, x: np.ndarray, signals: Signals, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of h by states and by free parameters: ``(m, d, n)`` and ``(m, p, n)``."""
        d, m, p = self._shapes
        flat = _stacked(self._output_slopes, m * d + m * p, x, signals, values)
        return flat[: m * d].reshape(m, d, x.shape[1]), flat[m * d :].reshape(m, p, x.shape[1])


def delays_of(formulas: Sequence[sympy.Expr]) -> tuple[sympy.Expr, ...]:
    """The delayed inputs in formulas, each once, in an order that does not change."""
    found = {each for formula in formulas for each in formula.atoms(delay)}
    return tuple(sorted(found, key=str))


def arguments_of(model: Model) -> list[sympy.Symbol]:
    """The arguments of a compiled model: states, inputs, delayed inputs and slopes, time, parameters."""
    return [
        *(symbol(name) for name in model.states),
        *(symbol(each.name) for each in model.inputs),
        *(_delayed(k) for k in range(len(model.delays))),
        *(_slope(k) for k in range(len(model.delays))),
        TIME,
        *(symbol(each.name) for each in model.parameters),
    ]


def evaluable(formula: sympy.Expr, model: Model, *, wider: float = 1.0) -> sympy.Expr:
    """A formula with its jumps spread, over a multiple of their widths, and symbols for delayed inputs."""
    spread = {sympy.sign(at): sympy.tanh(at / (wider * width)) for at, width in model.edges}
    return formula.xreplace(spread).xreplace({each: _delayed(k) for k, each in enumerate(model.delays)})


def by_parameter(formula: sympy.Expr, parameter: sympy.Symbol, delays: Sequence[sympy.Expr]) -> sympy.Expr:
    """Derivative of an evaluable formula by a parameter, which may stand in a delay as well."""
    result = formula.diff(parameter)
    for k, each in enumerate(delays):
        # u(t - τ) depends on τ through the slope of u, backwards.
        result -= formula.diff(_delayed(k)) * _slope(k) * each.args[1].diff(parameter)
    return result


def _delayed(place: int) -> sympy.Symbol:
    return sympy.Symbol(f"_delayed_{place}", real=True)


def _slope(place: int) -> sympy.Symbol:
    return sympy.Symbol(f"_slope_{place}", real=True)


def _stacked(
    function: Callable[..., Sequence[np.ndarray | float]],
    count: int,
    x: np.ndarray,
    signals: Signals,
    values: np.ndarray,
) -> np.ndarray:
    result = np.empty((count, x.shape[1]))
    arguments = (*x, *signals.inputs, *signals.delayed, *signals.slopes, signals.t, *values)
    with np.errstate(all="ignore"):  # a trial state may lie where a formula has no value; the fit steps back
        for place, value in enumerate(function(*arguments)):
            result[place] = value
    return result
