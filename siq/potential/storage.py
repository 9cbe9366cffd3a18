"""`model.json`: a result as a file that anything can evaluate without this library.

Polynomials stand as ``{"center", "scale", "exponents", "coefficients"}``, meaning
``Σ c Π ((x - center)/scale)^e`` in the states' own units; anything else as ``{"formula": "text"}``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import FormulaError, parse_formula
from siq.dynamics.state_noise import diffusion_of_rows, diffusion_rows_of
from siq.errors import InputError
from siq.files.whole import whole_file
from siq.potential.bases import PowerBasis
from siq.potential.symbolic import SymbolicDecomposition
from siq.potential.well import TOLERANCE, DegreeTrial, Well


def expression_to_data(expression: sympy.Expr, symbols: Sequence[sympy.Symbol]) -> dict[str, Any]:
    """A formula as plain data: a polynomial by its coefficients, anything else by its text."""
    # "is polynomial" must not simplify: 1/x*x**2 is what the library said it is.
    if expression.is_polynomial(*symbols):
        polynomial = sympy.Poly(expression, *symbols)
        pairs = [(list(map(int, e)), float(c)) for e, c in polynomial.terms() if c != 0]
        return {
            "center": [0.0] * len(symbols),
            "scale": [1.0] * len(symbols),
            "exponents": [exponents for exponents, _ in pairs],
            "coefficients": [coefficient for _, coefficient in pairs],
        }
    return {"formula": str(expression)}


def expression_from_data(data: Mapping[str, Any], symbols: Sequence[sympy.Symbol]) -> sympy.Expr:
    """The formula that `expression_to_data` wrote; text goes through the whitelist of formulas."""
    if "formula" in data:
        return parse_formula(data["formula"], {symbol.name: symbol for symbol in symbols})
    scaled = [
        symbol if (center, scale) == (0, 1) else (symbol - center) / scale
        for symbol, center, scale in zip(symbols, data["center"], data["scale"], strict=True)
    ]
    return sympy.Add(
        *(
            sympy.Float(float(coefficient), 17)
            * sympy.Mul(*(s ** int(e) for s, e in zip(scaled, exponents, strict=True)))
            for exponents, coefficient in zip(data["exponents"], data["coefficients"], strict=True)
        )
    )


def model_to_data(
    decompositions: Mapping[str, SymbolicDecomposition], certificates: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """Decompositions by method, with a certificate for each, as plain data.

    Certificates of what is no method, such as a randomised network, stand beside them.
    """
    if not decompositions:
        return {"states": [], "methods": {}, "certificate": {}}
    symbols = next(iter(decompositions.values())).symbols
    methods = {method: _decomposition_to_data(one) for method, one in decompositions.items()}
    return {
        "states": [symbol.name for symbol in symbols],
        "methods": methods,
        "certificate": {method: dict(one) for method, one in certificates.items()},
    }


def _decomposition_to_data(one: SymbolicDecomposition) -> dict[str, Any]:
    symbols = one.symbols
    data: dict[str, Any] = {
        "V": None if one.potential is None else expression_to_data(one.potential, symbols),
        "g": [expression_to_data(component, symbols) for component in one.circulatory],
        "f": [expression_to_data(component, symbols) for component in one.vector_field],
    }
    if one.wells:
        data["wells"] = [
            {
                "attractor": well.attractor.tolist(),
                "level": well.level,
                "saddle": None if well.saddle is None else well.saddle.tolist(),
                "reach": well.reach,
                "tolerance": well.tolerance,
                "residual": well.residual,
                "V": powers_to_data(well),
                "degrees": [asdict(trial) for trial in well.trials],
            }
            for well in one.wells
        ]
        data["D"] = diffusion_rows_of(one.wells[0].dynamics.diffusion)
    if one.standard_errors:
        data["standard_errors"] = {name: dict(errors) for name, errors in one.standard_errors.items()}
    return data


def powers_to_data(well: Well) -> dict[str, Any]:
    """V of a well as center, scale, exponents and coefficients."""
    basis = well.basis
    return {
        "center": basis.center.tolist(),
        "scale": basis.scale.tolist(),
        "exponents": basis.exponents.tolist(),
        "coefficients": well.coefficients.tolist(),
    }


def basis_from_data(powers: Mapping[str, Any], symbols: tuple[sympy.Symbol, ...]) -> PowerBasis:
    """The powers that `powers_to_data` wrote."""
    return PowerBasis(
        symbols, np.array(powers["center"]), np.array(powers["scale"]), np.array(powers["exponents"])
    )


def _wells_from_data(method: Mapping[str, Any], symbols: tuple[sympy.Symbol, ...]) -> tuple[Well, ...]:
    if not method.get("wells"):
        return ()
    d = len(symbols)
    equations = [expression_from_data(part, symbols) for part in method["f"]]
    diffusion = diffusion_of_rows(symbols, method.get("D", np.eye(d).tolist()))
    dynamics = Dynamics.of(symbols, equations, diffusion=diffusion)
    return tuple(
        Well(
            dynamics, np.array(one["attractor"]), basis_from_data(one["V"], symbols),
            np.array(one["V"]["coefficients"], dtype=float), float(one["level"]),
            None if one.get("saddle") is None else np.array(one["saddle"]),
            float(one.get("residual", np.nan)), np.zeros((0, d)), float(one.get("reach", one["level"])),
            float(one.get("tolerance", TOLERANCE)), None,
            tuple(DegreeTrial(**trial) for trial in one.get("degrees", ())),
        )
        for one in method["wells"]
    )  # fmt: skip


def write_model(path: str | Path, model: Mapping[str, Any]) -> None:
    """Write a model whole or not at all."""
    with whole_file(path) as partial:
        partial.write_text(json.dumps(model, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_model(path: str | Path) -> tuple[dict[str, SymbolicDecomposition], dict[str, Any]]:
    """Read a model: its decompositions by method, and their certificates.

    Raises
    ------
    InputError
        When the file is not a model, or a formula in it is refused.
    """
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
        symbols = tuple(sympy.Symbol(name, real=True) for name in data["states"])
        decompositions = {
            method: SymbolicDecomposition(
                symbols=symbols,
                potential=None if one["V"] is None else expression_from_data(one["V"], symbols),
                circulatory=tuple(expression_from_data(part, symbols) for part in one["g"]),
                vector_field=tuple(expression_from_data(part, symbols) for part in one["f"]),
                wells=_wells_from_data(one, symbols),
                standard_errors=one.get("standard_errors", {}),
            )
            for method, one in data["methods"].items()
        }
        return decompositions, data["certificate"]
    except FormulaError as error:
        raise InputError(path, "", error.fault, error.remedy) from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(path, "", f"it is not a model ({type(error).__name__})", "make it again") from None
