"""Units of what mechanisms bring, worked out from those of the card."""

from __future__ import annotations

import re
from collections.abc import Mapping

import sympy

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import FormulaError, parse_formula


def units_of(model: Dynamics) -> dict[str, str]:
    """Units of everything that a coordinate may be: states, inputs and the time, by name."""
    units = dict(zip(model.states, model.units, strict=True))
    units |= {entry.name: entry.unit for entry in model.inputs}
    return units | {"t": model.time_unit}


def unit_of(formula: str, units: Mapping[str, str]) -> str:
    """The unit of a formula of quantities, such as ``"v/T/x**2"``.

    Parameters
    ----------
    formula
        Products and powers of quantities.
    units
        The unit of each, such as ``"m/s"``; ``"1"`` for a number. What cannot be read as a product of powers
        (``"°C"``) is kept as one word.

    Returns
    -------
    str
        Such as ``"1/(m*s)"``.
    """
    words: dict[str, sympy.Symbol] = {}
    known = {name: _parse(unit, words) for name, unit in units.items()}
    result = parse_formula(formula, known)
    text = str(sympy.powsimp(result, force=True))
    for word, stand_in in words.items():
        text = re.sub(rf"\b{stand_in}\b", word, text)
    return text


def _parse(unit: str, words: dict[str, sympy.Symbol]) -> sympy.Expr:
    def stand_in(word: str) -> sympy.Symbol:
        return words.setdefault(word, sympy.Symbol(f"unit{len(words)}", positive=True))

    names = {word: stand_in(word) for word in re.findall(r"[A-Za-z_]\w*", unit)}
    try:
        return parse_formula(unit, names)
    except FormulaError:
        return stand_in(unit)
