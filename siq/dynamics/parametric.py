"""Dynamics as functions of states, signals and parameters, with their derivatives.

Where parameters are fitted they stay symbols, and inputs, their delays and the time are arguments. Compare
`siq.dynamics.dynamics.Dynamics.drift`, in which the parameters' values are inserted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import sympy

from siq.dynamics.formulas import compile_values, delay
from siq.dynamics.tape import Tape, tape_of

if TYPE_CHECKING:
    from siq.dynamics.dynamics import Dynamics

TIME = sympy.Symbol("t", real=True)
Compiled = Callable[..., Sequence[np.ndarray | float]]
SMOOTHER = 30.0  # widths of a jump over which its derivative is spread


def symbol(name: str) -> sympy.Symbol:
    """The symbol that stands for a name in every formula of a dynamics."""
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


class ParametricFunctions:
    """Dynamics as functions of arrays, with derivatives by states and by free parameters.

    Parameters
    ----------
    dynamics
        What is compiled.
    """

    def __init__(self, dynamics: Dynamics) -> None:
        formulas = [*dynamics.equations, *(formula for _, formula in dynamics.outputs)]
        self._delays = dynamics.delays
        self._arguments = arguments_of(dynamics)
        written = [evaluable(formula, dynamics) for formula in formulas]
        self._equations, self._measured = written[: dynamics.dimension], written[dynamics.dimension :]
        # A jump's derivative is a spike. Spread over more than a step it is seen in full by every rule of
        # integration, and carries deviations across the jump as they are carried in the mean.
        self._smooth = [evaluable(formula, dynamics, wider=SMOOTHER) for formula in dynamics.equations]
        self._states = [symbol(name) for name in dynamics.states]
        self._free = [symbol(dynamics.parameters[place].name) for place in dynamics.free]
        self._shapes = (dynamics.dimension, len(self._measured), len(self._free))

    @cached_property
    def _rates(self) -> Compiled:
        return compile_values(self._equations, self._arguments)

    @cached_property
    def _outputs(self) -> Compiled:
        return compile_values(self._measured, self._arguments)

    @cached_property
    def _slopes(self) -> Compiled:
        return compile_values(
            [each.diff(state) for each in self._smooth for state in self._states]
            + [by_parameter(each, one, self._delays) for each in self._equations for one in self._free],
            self._arguments,
        )

    @cached_property
    def _output_slopes(self) -> Compiled:
        return compile_values(
            [without_teeth(each).diff(state) for each in self._measured for state in self._states]
            + [by_parameter(each, one, self._delays) for each in self._measured for one in self._free],
            self._arguments,
        )

    @cached_property
    def tape(self) -> Tape | None:
        """F as a tape in the same arguments; None where it has a function that no tape knows."""
        return tape_of(self._equations, self._arguments)

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


def arguments_of(dynamics: Dynamics) -> list[sympy.Symbol]:
    """The arguments of a compiled model: states, inputs, delayed inputs and slopes, time, parameters."""
    return [
        *(symbol(name) for name in dynamics.states),
        *(symbol(each.name) for each in dynamics.inputs),
        *(_delayed(k) for k in range(len(dynamics.delays))),
        *(_slope(k) for k in range(len(dynamics.delays))),
        TIME,
        *(symbol(each.name) for each in dynamics.parameters),
    ]


def evaluable(formula: sympy.Expr, dynamics: Dynamics, *, wider: float = 1.0) -> sympy.Expr:
    """A formula with its jumps spread, over a multiple of their widths, and symbols for delayed inputs."""
    spread = {sympy.sign(at): sympy.tanh(at / (wider * width)) for at, width in dynamics.edges}
    return formula.xreplace(spread).xreplace({each: _delayed(k) for k, each in enumerate(dynamics.delays)})


def without_teeth(formula: sympy.Expr) -> sympy.Expr:
    """A formula whose sawtooth ``atan(tan(z))``, as of rounding, is taken for its mean, zero.

    A reading that is rounded stands still and jumps: its slope is nothing almost everywhere, and says nothing
    of what it follows, step by step. On the whole it follows with the slope that it has without the teeth.
    """
    return formula.replace(
        lambda each: isinstance(each, sympy.atan) and isinstance(each.args[0], sympy.tan),
        lambda each: sympy.Integer(0),
    )


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
