"""System cards: the equations of a simulation as a file, and the dynamics that they describe.

A *system card* (``config/systems/NAME.yaml``) declares states, parameters, the vector field f, and the
covariance D of the noise in ``dx = f dt + sqrt(ε) D^(1/2) dW``, in numbers or formulas. D belongs to
the system because the orthogonality ``∇V·g = 0`` of the decomposition ``f = -D∇V + g`` depends on it: the
same equations in other units are another problem unless D is carried along.
"""

from __future__ import annotations

import keyword
import re
import unicodedata
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import sympy
import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    field_validator,
    model_validator,
)

from siq.errors import Fault, InputError
from siq.numerics.files import Document, read_document, validate
from siq.systems.diffusion import LARGEST_STATE, Diffusion
from siq.systems.dynamics import TIME, Dynamics, Input, Parameter, symbol
from siq.systems.formulas import (
    CONSTANTS,
    FUNCTIONS,
    FormulaError,
    exact_number,
    formulas_in_time,
    parse_formula,
)


def check_name(text: str) -> str:
    """Return a name that formulas can use, as they are read (NFKC); raises ValueError for any other."""
    text = unicodedata.normalize("NFKC", text)
    if len(text) > LONGEST_NAME:
        raise Fault(f"the name '{text[:20]}…' has {len(text)} letters", f"keep it to {LONGEST_NAME}")
    if not text.isidentifier() or keyword.iskeyword(text):
        raise Fault(f"'{text}' cannot be a name in a formula", "use letters, digits and underscores")
    if text in FUNCTIONS or text in CONSTANTS or text in ("recording", "t", "delay"):
        raise Fault(f"the name '{text}' is reserved", "choose another")
    return text


def check_title(text: str) -> str:
    """Return a name that files and folders can have; raises ValueError for any other.

    It stands in names of files, which have up to 255 bytes. What is repeated 20 times would be
    taken for a rule that calls itself.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", text):
        remedy = "use letters, digits, dots, dashes and underscores, and begin with a letter or a digit"
        raise Fault(f"'{text[:80]}' cannot be the name of files", remedy)
    if len(text) > LONGEST_NAME or re.search(r"(.+?)\1{18}", text):
        fault = f"the name '{text[:20]}…' is too long, or repeats itself"
        raise Fault(fault, f"give it another of at most {LONGEST_NAME} letters")
    return text


Name = Annotated[str, AfterValidator(check_name)]
FileName = Annotated[str, AfterValidator(check_title)]
Number = Annotated[float, Field(allow_inf_nan=False)]


def _number(text: object) -> object:
    """What a formula without names is worth, such as ``2*pi``; anything else as it is."""
    return float(parse_formula(text, {})) if isinstance(text, str) else text


Limit = Annotated[Number, BeforeValidator(_number, json_schema_input_type=float | str)]
"""A limit of a domain: a number, or a formula such as ``2*pi``."""
Formula = str | Number
DiffusionEntry = Literal["identity"] | list[Formula] | list[list[Formula]]

LINE_WIDTH = 110
GRAVITY, GRAVITY_ERROR = 9.80, 0.03  # m/s², from mountains at the equator to the poles
PERIODS_TRIED = 5  # states at which equations are compared with themselves a period on
SAME_VALUE = 1e-9  # numerical, of their size
LONGEST_NAME = 100  # letters: names of files have up to 255 bytes, of which two names may be a part


class _CardPart(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class StateEntry(_CardPart):
    """One state of a card: its unit, and the interval in which initial states are drawn."""

    unit: str = "1"  #: compared with the units of recordings; nothing is converted
    #: The interval ``[lower, upper]``, in this unit: initial states are drawn from it, and scores use it.
    #: Only a simulation needs it. Where there are recordings to compare with, they tell it.
    domain: tuple[Limit, Limit] | None = None
    #: ``true`` of an angle, or a phase: the domain is one period then, such as ``[0, 2*pi]``, and the state
    #: counts its turns.
    periodic: bool = False

    @model_validator(mode="after")
    def _of_known_period(self) -> StateEntry:
        if self.periodic and self.domain is None:
            raise Fault("the period is not known", "add 'domain: [0, 2*pi]', one period")
        return self

    @field_validator("domain")
    @classmethod
    def _ordered(cls, domain: tuple[float, float] | None) -> tuple[float, float] | None:
        if domain is not None and not domain[0] < domain[1]:
            raise Fault("the domain is empty", "write it as [lower, upper] with lower < upper")
        if domain is not None and not (
            max(map(abs, domain)) <= LARGEST_STATE and domain[1] - domain[0] >= 1 / LARGEST_STATE
        ):
            raise Fault("the domain is too wide or too narrow for numbers", "write it in another unit")
        return domain


class ParameterEntry(_CardPart):
    """One parameter of a card."""

    value: Number  #: its value
    unit: str = "1"  #: for people
    fixed: bool = False  #: ``true`` when you are sure of the value: no recalibration changes it then
    #: How far the value may be off: one standard deviation, in its unit. By default that is as large as the
    #: value; of the acceleration of gravity in m/s² it is what this differs by on Earth, 0.03.
    error: Annotated[Number, Field(gt=0)] | None = None

    @property
    def known_to(self) -> float | None:
        """The error, as given or of the acceleration of gravity."""
        unit = self.unit.replace(" ", "").replace("**", "^").replace("²", "^2")
        of_gravity = unit == "m/s^2" and abs(abs(self.value) - GRAVITY) <= GRAVITY_ERROR
        return GRAVITY_ERROR if self.error is None and of_gravity else self.error


class InputEntry(_CardPart):
    """An exogenous signal u(t), a column of the recordings."""

    unit: str = "1"  #: compared with the units of recordings
    #: How it runs between samples: ``zero_order`` for what a converter puts out, ``linear``, or
    #: ``band_limited`` for what was filtered before it was sampled. By default a staircase jumps.
    interpolation: Literal["zero_order", "linear", "band_limited"] | None = None


class ExactEntry(_CardPart):
    """Exact answers, where known. They serve scoring only; no method reads them."""

    quasipotential: Formula | None = None  #: U as a formula of the states


class SystemCard(_CardPart):
    """The schema of a system card.

    A state that is in no output is hidden. The time is called ``t`` in formulas of a system with inputs or
    of a mismatch study; see `siq.systems.dynamics`.
    """

    #: Letters, digits, ``_``, ``.`` and ``-``; in ``config/systems/`` the file is called the same.
    name: FileName
    title: str = ""  #: what people call the system; by default the name
    time_unit: str = "1"  #: of t
    states: dict[Name, StateEntry] = Field(min_length=1)  #: by name, in the order of the state vector
    inputs: dict[Name, InputEntry] = {}  #: signals that drive it, by name; only a diagnosis reads them
    parameters: dict[Name, ParameterEntry] = {}  #: constants of the equations, by name
    equations: dict[str, Formula]  #: the time derivative of each state
    #: What a recording measures, as formulas by name; by default the states. Only a diagnosis reads them.
    outputs: Annotated[dict[Name, Formula], Field(min_length=1)] | None = None
    #: D of ``dx = f dt + √ε D^(1/2) dW``: ``identity``, the diagonal as a list, or the whole matrix as a list
    #: of rows, in squared units of the states per unit of time. An entry is a number, or a formula of the
    #: states and parameters in the sense of Itô, such as ``[1 + 0.8*x, 1]``; parameters count with the values
    #: of the card. A zero says that no noise acts on a state. Where a landscape is asked for, noise has to
    #: act on every state if f comes from trajectories, and to reach it at least by way of other states if
    #: the equations are given.
    diffusion: DiffusionEntry = "identity"
    exact: ExactEntry = ExactEntry()  #: exact answers, where they are known

    @model_validator(mode="after")
    def _consistent(self) -> SystemCard:
        for name in self.states:
            if name not in self.equations:
                raise Fault(f"the state '{name}' has no equation", f"add 'equations: {{{name}: ...}}'")
            if name in self.parameters:
                raise Fault(f"'{name}' is both a state and a parameter", "rename one of them")
        for name in self.inputs:
            if name in self.states or name in self.parameters:
                kind = "a state" if name in self.states else "a parameter"
                raise Fault(f"'{name}' is both an input and {kind}", "rename one of them")
        for name in self.equations:
            if name not in self.states:
                raise Fault(f"the equation of '{name}' belongs to no state", "declare it under states")
        diffusion_rows(self.diffusion, len(self.states))
        return self


def diffusion_rows(diffusion: DiffusionEntry, dimension: int) -> list[list[Formula]]:
    """D of d states as rows of numbers and formulas, from ``"identity"``, the diagonal, or the whole matrix.

    Raises
    ------
    ValueError
        When the shape is wrong, or numbers are not symmetric and positive semi-definite.
    """
    if diffusion == "identity":
        return [[float(i == j) for j in range(dimension)] for i in range(dimension)]
    lengths = {len(row) for row in diffusion if isinstance(row, list)}
    if len(diffusion) != dimension or (lengths and lengths != {dimension}):
        raise Fault(f"the diffusion does not fit {dimension} states", "give a diagonal or a square matrix")
    rows = [
        row if isinstance(row, list) else [row if i == j else 0.0 for j in range(dimension)]
        for i, row in enumerate(diffusion)
    ]
    if all(not isinstance(entry, str) for row in rows for entry in row):
        Diffusion(np.array(rows, dtype=float))
    return rows


def load_system(card: str | Path | Mapping[str, Any], *, simulated: bool = False) -> Dynamics:
    """Read and check a system card.

    Parameters
    ----------
    card
        The path of one, or what one says, as a mapping.
    simulated
        Whether a simulator takes the place of its equations, which may then be left out, but for definitions
        such as ``x: v``; so may its name. Units tell what states are, and may not.

    Raises
    ------
    InputError
        With the card, the line and the offending name, for anything that the schema or the whitelist of
        formulas refuses.
    """
    document = Document("the card", dict(card), {}) if isinstance(card, Mapping) else read_document(card)
    if simulated:
        states, written = document.data.get("states"), document.data.get("equations") or {}
        states = states if isinstance(states, dict) else {}
        for name, entry in states.items():
            if not isinstance(entry, dict) or "unit" not in entry:
                place = document.place(("states", name))
                remedy = "give it, for no equation tells what the state is; a mere number has the unit 1"
                raise InputError(document.file, place, f"'{name}' has no unit", remedy)
        if isinstance(written, dict):
            filled = {"name": "simulator", **document.data, "equations": dict.fromkeys(states, 0) | written}
            document = replace(document, data=filled)
    return build_system(document, validate(document, SystemCard))


def build_system(document: Document, card: SystemCard) -> Dynamics:
    """The dynamics that a checked card describes; `document` says where its formulas stand.

    Parameters stay symbols, so that they can be fitted; `Dynamics.formulas` has their values inserted.

    Raises
    ------
    InputError
        For a formula that is refused, as it stands or with the parameters' values.
    """
    outputs = card.outputs if card.outputs is not None else {name: name for name in card.states}
    parse, numbers = _parser(document, card)
    of_noise: set[str] = set()

    def inserted(text: Formula) -> sympy.Expr:
        formula = parse(("diffusion",), text)
        of_noise.update(each.name for each in formula.free_symbols & set(numbers))
        return formula.xreplace(numbers)

    try:
        rows = diffusion_rows(card.diffusion, len(card.states))
        diffusion = Diffusion.of_rows([symbol(name) for name in card.states], rows, parse=inserted)
    except Fault as error:
        raise error.at(document.file, document.place(("diffusion",))) from None
    dynamics = Dynamics(
        name=card.name,
        title=card.title or card.name,
        time_unit=card.time_unit,
        states=tuple(card.states),
        units=tuple(entry.unit for entry in card.states.values()),
        diffusion=diffusion,
        domain=np.array([one.domain or (np.nan, np.nan) for one in card.states.values()], dtype=float),
        inputs=tuple(Input(name, entry.unit, entry.interpolation) for name, entry in card.inputs.items()),
        parameters=tuple(
            Parameter(name, entry.value, entry.unit, entry.fixed, error=entry.known_to)
            for name, entry in card.parameters.items()
        ),
        equations=tuple(parse(("equations", name), card.equations[name]) for name in card.states),
        outputs=tuple((name, parse(("outputs", name), text)) for name, text in outputs.items()),
        parameters_of_noise=tuple(sorted(of_noise)),
        periodic=tuple(name for name, entry in card.states.items() if entry.periodic),
    )
    for name, period in zip(dynamics.states, dynamics.periods, strict=True):
        if period and (other := _changed_by(dynamics, name, period)):
            fault = f"the {other} is not the same a period of '{name}' on"
            remedy = f"write it in sines and cosines of {name}, or leave out 'periodic'"
            raise InputError(document.file, document.place(("states", name)), fault, remedy)
    return dynamics


def _changed_by(dynamics: Dynamics, name: str, period: float) -> str:
    """What is another one a period of a state on: an equation, or D; empty where nothing is."""
    shift, generator = {symbol(name): symbol(name) + period}, np.random.default_rng(0)
    named = [(f"equation of '{own}'", f) for own, f in zip(dynamics.states, dynamics.formulas, strict=True)]
    named += [("diffusion", entry) for row in dynamics.diffusion.formulas for entry in row]
    for what, formula in named:
        formula = sympy.sympify(formula)
        for _ in range(PERIODS_TRIED):
            at = {each: float(generator.uniform(-1, 1)) for each in formula.free_symbols}
            here, there = (complex(one.subs(at).evalf()) for one in (formula, formula.xreplace(shift)))
            if np.isfinite([here, there]).all() and abs(there - here) > SAME_VALUE * (abs(here) + period):
                return what
    return ""


def load_exact(path: str | Path) -> sympy.Expr | None:
    """The exact U that a card knows, its parameters inserted; None for none. Raises as `load_system`."""
    document = read_document(path)
    card = validate(document, SystemCard)
    text = card.exact.quasipotential
    if text is None:
        return None
    parse, numbers = _parser(document, card)
    return parse(("exact", "quasipotential"), text).xreplace(numbers)


def _parser(
    document: Document, card: SystemCard
) -> tuple[Callable[[tuple[str, ...], Formula], sympy.Expr], dict[sympy.Symbol, sympy.Expr]]:
    """Parser of the formulas of a card, which refuses them with their line; and its parameters' values."""
    names = {name: symbol(name) for name in (*card.states, *card.inputs, *card.parameters)} | {"t": TIME}
    values = {name: exact_number(entry.value) for name, entry in card.parameters.items()}

    def parse(keys: tuple[str, ...], text: Formula) -> sympy.Expr:
        try:
            # A power may be too high, or a divisor zero, at the parameters' values alone.
            with formulas_in_time("the formula"):
                parse_formula(text, names | values, inputs=tuple(card.inputs))
                return parse_formula(text, names, inputs=tuple(card.inputs))
        except FormulaError as error:
            raise error.at(document.file, document.place(keys)) from None

    return parse, {symbol(name): value for name, value in values.items()}


def card_of(dynamics: Dynamics) -> str:
    """A system card, in YAML, with the parameters' values; an unknown domain is left out."""
    name = dynamics.name or "system"
    data: dict[str, Any] = {
        "name": name,
        "title": "" if dynamics.title == name else dynamics.title,
        "time_unit": dynamics.time_unit,
        "states": {
            state: {"unit": unit}
            | ({"domain": [float(limit) for limit in limits]} if limits[0] < limits[1] else {})
            | ({"periodic": True} if state in dynamics.periodic else {})
            for state, unit, limits in zip(dynamics.states, dynamics.units, dynamics.limits, strict=True)
        },
    }
    if dynamics.inputs:
        data["inputs"] = {
            one.name: {key: each for key, each in vars(one).items() if each and key != "name"}
            for one in dynamics.inputs
        }
    if dynamics.parameters:
        data["parameters"] = {
            entry.name: {"value": float(entry.value), "unit": entry.unit}
            | ({"fixed": True} if entry.fixed else {})
            | ({} if entry.error is None else {"error": entry.error})
            for entry in dynamics.parameters
        }
    data["equations"] = {
        state: str(formula) for state, formula in zip(dynamics.states, dynamics.equations, strict=True)
    }
    data["outputs"] = {output: str(formula) for output, formula in dynamics.outputs}
    rows = dynamics.diffusion.rows  # of which a diagonal, or 1, is written as that
    diagonal = [row[place] for place, row in enumerate(rows)]
    if any(entry not in (0.0, "0") for i, row in enumerate(rows) for entry in row[:i] + row[i + 1 :]):
        data["diffusion"] = rows
    else:
        data["diffusion"] = "identity" if all(entry == 1.0 for entry in diagonal) else diagonal
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=LINE_WIDTH)
