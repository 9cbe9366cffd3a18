"""The dictionary of mechanisms, read from YAML: ours (`mechanisms.yaml`) and what a study adds."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from siq.dynamics.cards import Formula, Name
from siq.errors import InputError
from siq.files.documents import read_document, validate

Role = Literal[
    "position", "displacement", "angle", "velocity", "amplitude", "population", "prey", "predator", "level",
    "upper level", "lower level", "store", "stock", "state", "input", "parameter", "output",
]  # fmt: skip


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Shape(_Part):
    """Where a parameter is looked for that the mechanism does not depend on linearly.

    Give one way of looking.

    Attributes
    ----------
    at
        Multiples, or probabilities for `quantiles_of`, that are tried.
    scale_of
        A formula: multiples of its root mean square along the recordings are tried.
    inverse_scale_of
        The same of its inverse.
    quantiles_of
        A formula: its quantiles at these probabilities are tried.
    time_of
        A formula: multiples of the time in which it changes by its own spread are tried.
    lattice_of
        An output: the step of the lattice on which its recorded values lie. It is known from the recordings
        and not fitted; where they lie on none that holds zero, the mechanism is not tried.
    top_of, bottom_of
        An output: where its recorded values end in a plateau, above or below. Where there is none, the
        mechanism is not tried.
    samples
        Multiples of the time between samples are tried.
    frequencies
        So many angular frequencies that the recordings can resolve are tried.
    """

    at: tuple[float, ...] = (1.0,)
    scale_of: str | None = None
    inverse_scale_of: str | None = None
    quantiles_of: str | None = None
    time_of: str | None = None
    lattice_of: str | None = None
    top_of: str | None = None
    bottom_of: str | None = None
    samples: bool = False
    frequencies: Annotated[int, Field(ge=2, le=2000)] | None = None

    @model_validator(mode="after")
    def _one(self) -> Shape:
        given = (
            self.scale_of, self.inverse_scale_of, self.quantiles_of, self.time_of, self.lattice_of,
            self.top_of, self.bottom_of, self.frequencies,
        )  # fmt: skip
        if sum(each is not None for each in given) + self.samples != 1:
            raise ValueError("a shape is looked for in one way; give one of scale_of, quantiles_of, ...")
        return self

    @property
    def recorded(self) -> str | None:
        """The output whose recorded values tell the shape by themselves."""
        return self.lattice_of or self.top_of or self.bottom_of


class MechanismParameter(_Part):
    """A parameter that a mechanism brings: an amplitude, or a shape.

    Attributes
    ----------
    unit
        In terms of the roles and the time T: ``v/T/x**3``.
    sign
        ``positive`` where passivity, or the meaning of the word, demands it.
    shape
        Where to look for it. Left out, it is an amplitude, which is zero where the mechanism is absent.
    """

    unit: str = "1"
    sign: Literal["any", "positive"] = "any"
    shape: Shape | None = None


class FurtherState(_Part):
    """A state that a mechanism brings.

    Attributes
    ----------
    equation
        Its time derivative.
    unit
        In terms of the roles.
    scale
        A formula of its size.
    begin
        A formula of the roles: where it is taken to begin in every recording, until a fit tells.
    """

    equation: Formula
    unit: str = "1"
    scale: str
    begin: Formula = 0


class Form(_Part):
    """How a mechanism shows in one kind of system.

    Attributes
    ----------
    roles
        What each name in the formulas stands for. Several roles are filled by different states.
    terms
        Formulas that are added to the equation of the state in that role.
    replace
        Formulas that take the place of an input or a parameter, wherever it stands.
    within
        Formulas that take the place of a state in the equation of another: ``{q: {p: z}}`` puts z in the
        place of p in the equation of q.
    outputs
        Formulas of what a sensor reads instead; ``y`` stands for what it read before.
    states
        Further states, by name.
    noise
        The state on which random forces act.
    parameters
        What the mechanism's formulas need to know, by name.
    coordinate
        Along which role the mechanism acts.
    variant
        What tells the form from others of the same roles, in words that follow the name: ``from above``.
    symmetric
        Whether exchanging the roles gives the same mechanism.
    one_unit
        Whether the states that fill the roles must have one unit, and not be mere numbers.
    """

    roles: dict[Name, Role]
    terms: dict[Name, Formula] = {}
    replace: dict[Name, Formula] = {}
    within: dict[Name, dict[Name, Formula]] = {}
    outputs: dict[Name, Formula] = {}
    states: dict[Name, FurtherState] = {}
    noise: Name | None = None
    parameters: dict[Name, MechanismParameter]
    coordinate: str
    variant: str = ""
    symmetric: bool = False
    one_unit: bool = False

    @model_validator(mode="after")
    def _about_roles(self) -> Form:
        changed = [
            *self.terms, *self.replace, *self.outputs, *self.within,
            *(name for put in self.within.values() for name in put), *([self.noise] if self.noise else []),
        ]  # fmt: skip
        if not changed:
            raise ValueError("a form changes nothing; give terms, replace, within, outputs or noise")
        for name in changed:
            if name not in self.roles:
                raise ValueError(f"'{name}' has no role; add 'roles: {{{name}: state}}' or another role")
        return self


class Mechanism(_Part):
    """An entry of the dictionary.

    Attributes
    ----------
    name
        What pages and tables call it.
    sentence
        What it means, in a sentence.
    forms
        One for each kind of system in which it shows.
    generalises
        Mechanisms that are special cases of it.
    look_alikes
        Mechanisms that are easily taken for it.
    reference
        Where it is described.
    """

    name: Annotated[str, Field(min_length=1)]
    sentence: str
    forms: Annotated[tuple[Form, ...], Field(min_length=1)]
    generalises: tuple[str, ...] = ()
    look_alikes: tuple[str, ...] = ()
    reference: str = ""


class Dictionary(BaseModel):
    """The schema of a file of mechanisms."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    mechanisms: tuple[Mechanism, ...]


def standard_dictionary() -> tuple[Mechanism, ...]:
    """The mechanisms that come with the library."""
    with as_file(files("siq.mismatch") / "mechanisms.yaml") as path:
        return read_dictionary(path)


def read_dictionary(path: str | Path) -> tuple[Mechanism, ...]:
    """Read a file ``mechanisms: [...]``.

    Raises
    ------
    InputError
        With the line of the first entry that cannot be used.
    """
    document = read_document(path)
    return validate(document, Dictionary).mechanisms


def dictionary_of(
    *, without: Collection[str], further: Sequence[Mechanism], file: str
) -> tuple[Mechanism, ...]:
    """The standard mechanisms, less some by name, and with further ones; an equal name replaces.

    Raises
    ------
    InputError
        For a name to leave out that there is none of.
    """
    known = {each.name: each for each in standard_dictionary()}
    for name in without:
        if name not in known:
            raise InputError(
                file, "without", f"no mechanism is called '{name}'", f"use one of {', '.join(known)}"
            )
        del known[name]
    return tuple((known | {each.name: each for each in further}).values())
