"""Formulas as a tape: elementary operations one after the other, for loops in machine code.

A trajectory is a long chain of small steps. Numpy needs microseconds for each operation of each step, and to
compile every formula of every candidate would take seconds. A tape is made in no time, and one compiled loop
runs all tapes (`siq.estimation.trajectory_kernel`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import sympy


class Operation(IntEnum):
    """What a step of a tape does with one register, or two."""

    ADD = 0
    MULTIPLY = 1
    INVERT = 2
    WHOLE_POWER = 3
    POWER = 4
    SQRT = 5
    SIN = 6
    COS = 7
    TAN = 8
    EXP = 9
    LOG = 10
    TANH = 11
    ATAN = 12
    ABS = 13
    SIGN = 14
    MAX = 15
    MIN = 16


_FUNCTIONS = {
    sympy.sin: Operation.SIN,
    sympy.cos: Operation.COS,
    sympy.tan: Operation.TAN,
    sympy.exp: Operation.EXP,
    sympy.log: Operation.LOG,
    sympy.tanh: Operation.TANH,
    sympy.atan: Operation.ATAN,
    sympy.Abs: Operation.ABS,
    sympy.sign: Operation.SIGN,
}
_CHAINS = {
    sympy.Add: Operation.ADD,
    sympy.Mul: Operation.MULTIPLY,
    sympy.Max: Operation.MAX,
    sympy.Min: Operation.MIN,
}


@dataclass(frozen=True)
class Tape:
    """Formulas as operations on registers.

    Attributes
    ----------
    operations
        Shape ``(k, 3)``: an `Operation`, and the registers of its arguments; the second is the exponent
        itself of a whole power. The result goes to the register ``base + k``.
    registers
        To begin with, shape ``(base + k,)``: arguments, which are to be filled in, then constants.
    base
        How many arguments and constants there are.
    results
        Registers that hold the values of the formulas in the end.
    """

    operations: np.ndarray
    registers: np.ndarray
    base: int
    results: np.ndarray


def tape_of(formulas: Sequence[sympy.Expr], arguments: Sequence[sympy.Symbol]) -> Tape | None:
    """The tape of formulas in some arguments; None where a formula has a function that no tape knows.

    What occurs twice is worked out once.
    """
    writer = _Writer(arguments, formulas)
    try:
        results = [writer.register(formula) for formula in formulas]
    except NotImplementedError:
        return None
    return Tape(
        operations=np.array(writer.operations, dtype=np.int64).reshape(-1, 3),
        registers=np.concatenate([writer.start, np.zeros(len(writer.operations))]),
        base=len(writer.start),
        results=np.array(results, dtype=np.int64),
    )


class _Writer:
    """A tape in the making."""

    def __init__(self, arguments: Sequence[sympy.Symbol], formulas: Sequence[sympy.Expr]) -> None:
        self.operations: list[tuple[int, int, int]] = []
        self._known: dict[sympy.Expr, int] = {each: place for place, each in enumerate(arguments)}
        constants: dict[sympy.Expr, float] = {}
        for formula in formulas:
            for part in sympy.preorder_traversal(sympy.sympify(formula)):
                if part.is_number and not part.free_symbols:
                    constants.setdefault(part, float(part) if part.is_real else np.nan)
        self._known |= {each: len(arguments) + place for place, each in enumerate(constants)}
        self.start = np.concatenate([np.zeros(len(arguments)), list(constants.values())])

    def register(self, formula: sympy.Expr) -> int:
        """Where the value of a formula is, once the tape has run so far."""
        formula = sympy.sympify(formula)
        if formula not in self._known:
            self._known[formula] = self._written(formula)
        return self._known[formula]

    def _written(self, formula: sympy.Expr) -> int:
        if formula.func in _CHAINS:
            operation = _CHAINS[formula.func]
            place = self.register(formula.args[0])
            for other in formula.args[1:]:
                place = self._add(operation, place, self.register(other))
            return place
        if formula.func in _FUNCTIONS:
            return self._add(_FUNCTIONS[formula.func], self.register(formula.args[0]), 0)
        if isinstance(formula, sympy.Pow):
            return self._power(*formula.args)
        raise NotImplementedError(str(formula.func))

    def _power(self, base: sympy.Expr, exponent: sympy.Expr) -> int:
        place = self.register(base)
        if exponent.is_Integer:
            if abs(int(exponent)) > 1:
                place = self._add(Operation.WHOLE_POWER, place, abs(int(exponent)))
            return place if exponent > 0 else self._add(Operation.INVERT, place, 0)
        if abs(exponent) == sympy.S.Half:
            place = self._add(Operation.SQRT, place, 0)
            return place if exponent > 0 else self._add(Operation.INVERT, place, 0)
        return self._add(Operation.POWER, place, self.register(exponent))

    def _add(self, operation: Operation, one: int, other: int) -> int:
        self.operations.append((int(operation), one, other))
        return len(self.start) + len(self.operations) - 1
