"""Symbolic decompositions ``f = -D∇V + g``: the formulas of V, g and f, and their file `model.json`.

A formula is a sympy expression of the states. In the file polynomials stand as ``{"center", "scale",
"exponents", "coefficients"}``, meaning ``Σ c Π ((x - center)/scale)^e`` in the states' own units; anything
else as ``{"formula": "text"}``. What was written is read back as the same objects.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy.optimize
import sympy

from siq.errors import Fault, InputError, NumericalFailure
from siq.inference.library import CandidateLibrary, linear_combination
from siq.numerics.files import whole_file
from siq.quasipotential.hamilton_jacobi import LibraryBasis, PowerBasis
from siq.quasipotential.wells import DegreeTrial, Well
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.formulas import FormulaError, compile_formulas, parse_formula

MOST_STARTS = 8  # of descents to the minimum of V
WELL = ("attractor", "level", "saddle", "reach", "tolerance", "residual")
"""What the file has of a well as it is."""


@dataclass(frozen=True)
class SymbolicDecomposition:
    """Formulas of ``f = -D∇V + g``."""

    symbols: tuple[sympy.Symbol, ...]  #: the d states
    potential: sympy.Expr | None  #: V, zero at its minimum; None where no single formula holds over the wells
    #: Components of g, none where there is no V, and of f.
    circulatory: tuple[sympy.Expr, ...]
    vector_field: tuple[sympy.Expr, ...]
    #: V about each attractor, zero there and valid below a level, where it was found.
    wells: tuple[Well, ...] = ()
    #: Of the coefficients, by component (``U``, ``V``, ``f_x``, ``g_x``) and term, where they are known.
    standard_errors: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def quasipotential(self) -> sympy.Expr:
        """U = 2V, zero at its minimum: the action is ½∫∣φ̇ - f∣²dt, and p ~ exp(-U/ε) for √ε dW."""
        return sympy.expand(2 * self._potential())

    @property
    def gradient(self) -> tuple[sympy.Expr, ...]:
        """∇V."""
        return tuple(self._potential().diff(symbol) for symbol in self.symbols)

    def _potential(self) -> sympy.Expr:
        if self.potential is None:
            raise Fault("no single formula of V was found", "each well has its own")
        return self.potential

    @cached_property
    def evaluate(self) -> Callable[[np.ndarray], np.ndarray]:
        """V, g_1 … g_d, f_1 … f_d: points as components ``(d, ...)`` to values ``(2d + 1, ...)``."""
        return compile_formulas([self._potential(), *self.circulatory, *self.vector_field], self.symbols)

    def values(self, x: np.ndarray) -> np.ndarray:
        """V at points ``(n, d)``, shape ``(n,)``."""
        return np.asarray(self.evaluate(np.ascontiguousarray(x.T))[0])

    @cached_property
    def evaluate_gradient(self) -> Callable[[np.ndarray], np.ndarray]:
        """∇V: points as components ``(d, ...)`` to components ``(d, ...)``."""
        return compile_formulas(self.gradient, self.symbols)

    def components(self) -> dict[str, sympy.Expr]:
        """The formulas by the names that tables give them: ``U``, ``V``, ``f_x``, ``g_x`` and so on."""
        formulas = {} if self.potential is None else {"U": self.quasipotential, "V": self.potential}
        formulas |= {f"f_{s}": f for s, f in zip(self.symbols, self.vector_field, strict=True)}
        if self.circulatory:
            formulas |= {f"g_{s}": g for s, g in zip(self.symbols, self.circulatory, strict=True)}
        return formulas


def exact_decomposition(dynamics: Dynamics, quasipotential: sympy.Expr) -> SymbolicDecomposition:
    """The decomposition of known dynamics with a known U = 2V; g = f + D∇V. For scoring only."""
    potential = sympy.expand(quasipotential / 2)
    gradient = sympy.Matrix([potential.diff(one) for one in dynamics.symbols])
    downhill = sympy.Matrix(dynamics.diffusion.formulas) * gradient
    circulatory = tuple(sympy.expand(f + v) for f, v in zip(dynamics.formulas, downhill, strict=True))
    flow = tuple(map(sympy.expand, dynamics.formulas))
    return SymbolicDecomposition(dynamics.symbols, potential, circulatory, flow)


def decomposition_from_coefficients(
    library: CandidateLibrary, *, potential: np.ndarray, circulatory: np.ndarray, vector_field: np.ndarray,
    points: np.ndarray,
) -> SymbolicDecomposition:  # fmt: skip
    """Formulas from coefficients over a library, with V shifted to be zero at its minimum.

    Coefficients of V have the shape ``(q,)``, those of g and f ``(q, d)``. The minimum is sought within the
    box of the points ``(n, d)``, from the lowest of them; a V that is nowhere finite there is a
    `NumericalFailure`.
    """
    formula = LibraryBasis(library, np.arange(library.size)).expression
    value = formula(potential)
    value -= sympy.Float(_minimum(value, library.symbols, points), 17)
    return SymbolicDecomposition(
        library.symbols, value, tuple(map(formula, circulatory.T)), tuple(map(formula, vector_field.T))
    )


def _minimum(expression: sympy.Expr, symbols: Sequence[sympy.Symbol], points: np.ndarray) -> float:
    """Smallest value of an expression within the box of points ``(n, d)``.

    Descents start from the lowest of the points that do not lie side by side.
    """
    together = compile_formulas([expression, *(expression.diff(s) for s in symbols)], tuple(symbols))
    values = together(points.T)[0]
    if not np.isfinite(values).any():
        raise NumericalFailure("the formula of V is nowhere finite on the recorded points")
    scale = np.ptp(points, axis=0)
    scale[scale == 0] = 1.0
    # Spread over all points, not among the lowest only: one well may be recorded far more often than a
    # deeper one.
    order = points[np.argsort(np.where(np.isfinite(values), values, np.inf))]
    chosen: list[np.ndarray] = []
    while len(order) and len(chosen) < MOST_STARTS:
        chosen.append(order[0])
        order = order[np.linalg.norm((order - order[0]) / scale, axis=1) > 0.15]
    bounds = np.stack([points.min(axis=0), points.max(axis=0)], axis=1) / scale[:, None]
    unit = float(np.ptp(values[np.isfinite(values)])) or 1.0

    def function(y: np.ndarray) -> tuple[float, np.ndarray]:
        result = together((y * scale)[:, None])[:, 0]
        return result[0] / unit, result[1:] * scale / unit

    best = float(np.nanmin(values))
    for point in chosen:
        found = scipy.optimize.minimize(
            function, point / scale, jac=True, bounds=bounds, method="L-BFGS-B",
            options={"ftol": 1e-15, "gtol": 1e-12},
        )  # fmt: skip
        best = min(best, float(found.fun) * unit)
    return best


def term_coefficients(expression: sympy.Expr) -> dict[str, float]:
    """Coefficients by term as text, such as ``{"x**2": -2.0, "1": 1.0}``; zeros left out."""
    return {str(term): value for term, value in linear_combination(expression).items()}


def _expression_to_data(expression: sympy.Expr, symbols: Sequence[sympy.Symbol]) -> dict[str, Any]:
    """A formula as plain data: a polynomial by its coefficients, anything else by its text."""
    # "is polynomial" must not simplify: 1/x*x**2 is what the library said it is.
    if not expression.is_polynomial(*symbols):
        return {"formula": str(expression)}
    pairs = [(list(map(int, e)), float(c)) for e, c in sympy.Poly(expression, *symbols).terms() if c != 0]
    data = {"center": [0.0] * len(symbols), "scale": [1.0] * len(symbols)}
    return data | {"exponents": [e for e, _ in pairs], "coefficients": [c for _, c in pairs]}


def _expression_from_data(data: Mapping[str, Any], symbols: Sequence[sympy.Symbol]) -> sympy.Expr:
    """The formula that `_expression_to_data` wrote; text goes through the whitelist of formulas."""
    if "formula" in data:
        return parse_formula(data["formula"], {symbol.name: symbol for symbol in symbols})
    return PowerBasis.from_data(data, tuple(symbols)).expression(data["coefficients"])


def _decomposition_data(one: SymbolicDecomposition) -> dict[str, Any]:
    """A decomposition as it stands in the file."""
    symbols = one.symbols
    data: dict[str, Any] = {
        "V": None if one.potential is None else _expression_to_data(one.potential, symbols),
        "g": [_expression_to_data(component, symbols) for component in one.circulatory],
        "f": [_expression_to_data(component, symbols) for component in one.vector_field],
    }
    if one.wells:
        data["wells"] = [
            {
                name: None if (part := getattr(well, name)) is None else np.asarray(part).tolist()
                for name in WELL
            }
            | {"V": well.powers, "degrees": [asdict(trial) for trial in well.trials]}
            for well in one.wells
        ]
        data["D"] = one.wells[0].dynamics.diffusion.rows
    if one.standard_errors:
        data["standard_errors"] = {name: dict(errors) for name, errors in one.standard_errors.items()}
    return data


def _wells_from_data(method: Mapping[str, Any], symbols: tuple[sympy.Symbol, ...]) -> tuple[Well, ...]:
    if "wells" not in method:
        return ()
    equations = [_expression_from_data(part, symbols) for part in method["f"]]
    dynamics = Dynamics.of(symbols, equations, diffusion=Diffusion.of_rows(symbols, method["D"]))

    def field_of(value: Any) -> Any:
        return np.array(value) if isinstance(value, list) else value

    return tuple(
        Well(
            PowerBasis.from_data(one["V"], symbols), np.array(one["V"]["coefficients"]), dynamics,
            points=np.zeros((0, len(symbols))), trials=tuple(DegreeTrial(**each) for each in one["degrees"]),
            **{name: field_of(one[name]) for name in WELL},
        )
        for one in method["wells"]
    )  # fmt: skip


def write_model(
    path: str | Path, decompositions: Mapping[str, SymbolicDecomposition],
    certificates: Mapping[str, Mapping[str, Any]],
) -> None:  # fmt: skip
    """Write decompositions by method, with a certificate for each, whole or not at all.

    Certificates of what is no method, such as a randomised network, stand beside them.
    """
    symbols = next((one.symbols for one in decompositions.values()), ())
    model = {
        "states": [symbol.name for symbol in symbols],
        "methods": {method: _decomposition_data(one) for method, one in decompositions.items()},
        "certificate": {method: dict(one) for method, one in certificates.items() if decompositions},
    }
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
                potential=None if one["V"] is None else _expression_from_data(one["V"], symbols),
                circulatory=tuple(_expression_from_data(part, symbols) for part in one["g"]),
                vector_field=tuple(_expression_from_data(part, symbols) for part in one["f"]),
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
