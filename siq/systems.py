"""Systems: the equations of a simulation, read from a card.

A *system card* (``config/systems/NAME.yaml``) declares states, parameters, the vector field f, and the
covariance D of the noise in ``dx = f dt + sqrt(ε) D^(1/2) dW``. D belongs to the system because the
orthogonality ``∇V·g = 0`` of the decomposition ``f = -D∇V + g`` depends on it: the same equations in other
units are another problem unless D is carried along.
"""

from __future__ import annotations

import keyword
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import sympy
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator, model_validator

from siq.documents import Document, read_document, validate
from siq.errors import InputError
from siq.expressions import (
    CONSTANTS,
    FUNCTIONS,
    FormulaError,
    compile_formulas,
    exact_number,
    parse_formula,
)


def check_name(text: str) -> str:
    """Return a name that formulas can use; raises ValueError for any other."""
    if not text.isidentifier() or keyword.iskeyword(text):
        raise ValueError(f"'{text}' cannot be a name in a formula; use letters, digits and underscores")
    if text in FUNCTIONS or text in CONSTANTS or text in ("recording", "t", "delay"):
        raise ValueError(f"the name '{text}' is reserved; choose another")
    return text


Name = Annotated[str, AfterValidator(check_name)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Formula = str | Number
Diffusion = Literal["identity"] | list[Number] | list[list[Number]]


class _CardPart(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class StateEntry(_CardPart):
    """One state of a card: its unit, and the interval in which initial states are drawn."""

    unit: str = "1"
    domain: tuple[Number, Number]

    @field_validator("domain")
    @classmethod
    def _ordered(cls, domain: tuple[float, float]) -> tuple[float, float]:
        if not domain[0] < domain[1]:
            raise ValueError("the domain is empty; write it as [lower, upper] with lower < upper")
        return domain


class ParameterEntry(_CardPart):
    """One parameter of a card. ``fixed: true`` keeps it out of any recalibration."""

    value: Number
    unit: str = "1"
    fixed: bool = False


class InputEntry(_CardPart):
    """An exogenous signal u(t), a column of the recordings.

    `interpolation` says how it holds between samples: ``zero_order`` for what a converter puts out,
    ``linear``, or ``band_limited`` for what was filtered before it was sampled.
    """

    unit: str = "1"
    interpolation: Literal["zero_order", "linear", "band_limited"] = "linear"


class ExactEntry(_CardPart):
    """Exact answers, where known. They serve scoring only; no method reads them."""

    quasipotential: Formula | None = None


class SystemCard(_CardPart):
    """The schema of a system card.

    A state that is in no output is hidden. The time is called ``t`` in formulas of a system with inputs or
    of a mismatch study; see `siq.mismatch.model`.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    title: str = ""
    time_unit: str = "1"
    states: dict[Name, StateEntry] = Field(min_length=1)
    inputs: dict[Name, InputEntry] = {}
    parameters: dict[Name, ParameterEntry] = {}
    equations: dict[str, Formula]
    outputs: Annotated[dict[Name, Formula], Field(min_length=1)] | None = None
    diffusion: Diffusion = "identity"
    exact: ExactEntry = ExactEntry()

    @model_validator(mode="after")
    def _consistent(self) -> SystemCard:
        for name in self.states:
            if name not in self.equations:
                raise ValueError(f"the state '{name}' has no equation; add 'equations: {{{name}: ...}}'")
            if name in self.parameters:
                raise ValueError(f"'{name}' is both a state and a parameter; rename one of them")
        for name in self.inputs:
            if name in self.states or name in self.parameters:
                kind = "a state" if name in self.states else "a parameter"
                raise ValueError(f"'{name}' is both an input and {kind}; rename one of them")
        for name in self.equations:
            if name not in self.states:
                raise ValueError(f"the equation of '{name}' belongs to no state; declare it under states")
        diffusion_matrix(self.diffusion, len(self.states))
        return self


def diffusion_matrix(diffusion: Diffusion, dimension: int) -> np.ndarray:
    """Noise covariance D as a matrix.

    Parameters
    ----------
    diffusion
        ``"identity"``, the diagonal, or the whole matrix, in the units of the states squared per time.
    dimension
        Number of states, d.

    Returns
    -------
    numpy.ndarray
        D, shape ``(d, d)``, symmetric and positive definite.

    Raises
    ------
    ValueError
        When the shape is wrong or D is not symmetric and positive definite.
    """
    if diffusion == "identity":
        return np.eye(dimension)
    lengths = {len(row) for row in diffusion if isinstance(row, list)}
    if len(diffusion) != dimension or (lengths and lengths != {dimension}):
        raise ValueError(f"the diffusion does not fit {dimension} states; give a diagonal or a square matrix")
    matrix = np.array(diffusion, dtype=float)
    if matrix.ndim == 1:
        matrix = np.diag(matrix)
    if not np.array_equal(matrix, matrix.T) or np.linalg.eigvalsh(matrix)[0] <= 0:
        raise ValueError("the diffusion is not symmetric and positive definite; correct the matrix")
    return matrix


@dataclass(frozen=True)
class System:
    """A dynamical system ``dx = f(x) dt + sqrt(ε) D^(1/2) dW`` with its formulas.

    Attributes
    ----------
    name, title, time_unit
        As the card says.
    states
        Names, in the order of the state vector.
    units
        Unit of each state.
    domain
        Shape ``(d, 2)``: the box Ω in which initial states are drawn, in the states' units.
    symbols
        The states as sympy symbols.
    equations
        Components of the vector field f, parameters inserted.
    diffusion
        D, shape ``(d, d)``.
    exact_quasipotential
        U where it is known, otherwise None. For scoring only.
    """

    name: str
    title: str
    time_unit: str
    states: tuple[str, ...]
    units: tuple[str, ...]
    domain: np.ndarray
    symbols: tuple[sympy.Symbol, ...]
    equations: tuple[sympy.Expr, ...]
    diffusion: np.ndarray
    exact_quasipotential: sympy.Expr | None = None

    @property
    def dimension(self) -> int:
        """Number of states, d."""
        return len(self.states)

    @cached_property
    def vector_field(self) -> Callable[[np.ndarray], np.ndarray]:
        """The vector field f: components ``(d, ...)`` to components ``(d, ...)`` per time unit."""
        return compile_formulas(self.equations, self.symbols)

    @cached_property
    def jacobian(self) -> Callable[[np.ndarray], np.ndarray]:
        """The Jacobian ∂f_i/∂x_j, from symbolic derivatives: ``(d, ...)`` to ``(d, d, ...)``."""
        entries = [equation.diff(symbol) for equation in self.equations for symbol in self.symbols]
        flat = compile_formulas(entries, self.symbols)
        return lambda components: flat(components).reshape(
            self.dimension, self.dimension, *components.shape[1:]
        )

    def exact_values(self, components: np.ndarray) -> np.ndarray:
        """The exact U at points, shape ``(d, ...)`` to ``(...)``. For scoring only."""
        if self.exact_quasipotential is None:
            raise ValueError(f"no exact quasipotential of {self.name} is known")
        return compile_formulas([self.exact_quasipotential], self.symbols)(components)[0]


def load_system(path: str | Path) -> System:
    """Read and check a system card.

    Raises
    ------
    InputError
        With the card, the line and the offending name, for anything that the schema or the whitelist of
        formulas refuses.
    """
    document = read_document(path)
    return build_system(document, validate(document, SystemCard))


def build_system(document: Document, card: SystemCard) -> System:
    """Build the system that a checked card describes; `document` says where its formulas stand.

    Raises
    ------
    InputError
        For a formula that is refused, and for a card with inputs: it has no landscape of its own.
    """
    if card.inputs:
        raise InputError(
            document.file,
            document.place(("inputs",)),
            "a driven system has no quasipotential",
            "leave the inputs out, or use the card in a study of mismatch",
        )
    symbols = {name: sympy.Symbol(name, real=True) for name in card.states}
    names: dict[str, Any] = dict(symbols)
    names |= {name: exact_number(entry.value) for name, entry in card.parameters.items()}

    def parse(keys: tuple[str, ...], text: Formula) -> sympy.Expr:
        try:
            return parse_formula(text, names)
        except FormulaError as error:
            raise InputError(document.file, document.place(keys), error.fault, error.remedy) from None

    exact = card.exact.quasipotential
    return System(
        name=card.name,
        title=card.title or card.name,
        time_unit=card.time_unit,
        states=tuple(card.states),
        units=tuple(entry.unit for entry in card.states.values()),
        domain=np.array([entry.domain for entry in card.states.values()]),
        symbols=tuple(symbols.values()),
        equations=tuple(parse(("equations", name), card.equations[name]) for name in card.states),
        diffusion=diffusion_matrix(card.diffusion, len(card.states)),
        exact_quasipotential=None if exact is None else parse(("exact", "quasipotential"), exact),
    )
