"""Keys: what a case conceals, in the format in which anybody can write one (docs/blind-test.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, model_validator

from siq.errors import InputError
from siq.numerics.files import read_document, validate
from siq.systems.cards import Formula, Name

CaseKind = Literal["null", "shift", "mechanism", "process noise", "withheld"]
ROWS = ("t", "states", "inputs", "derivative_true", "derivative_without")


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class KeyShift(_Part):
    """A parameter that is wrong on the card: what the card says, and what is true."""

    card: float
    true: float


class KeyEffect(_Part):
    """The effect in formulas, in the names of the card and of its own parameters and states."""

    states: dict[Name, Formula] = {}
    terms: dict[Name, Formula] = {}
    replace: dict[Name, Formula] = {}
    outputs: dict[Name, Formula] = {}
    noise: dict[Name, Formula] = {}
    parameters: dict[Name, float] = {}

    @property
    def changes_equations(self) -> bool:
        """Whether it can be built into a simulation as a formula."""
        return bool(self.terms or self.replace or self.outputs)


class KeySensors(_Part):
    """What sensors did to the recordings, none of which is what a simulation lacks.

    Attributes
    ----------
    noise
        Deviation of each output's noise.
    steps
        In which an output is read, where it is rounded.
    lost
        Share of the samples that are lost.
    jitter
        Deviation of the times of the samples from those that are recorded, in intervals between samples.
    """

    noise: dict[Name, float] = {}
    steps: dict[Name, float] = {}
    lost: float = 0.0
    jitter: float = 0.0


class CaseKey(_Part):
    """The schema of ``CASE.json`` in a folder of keys."""

    case: str = ""
    salt: str = ""
    system: str = ""
    kind: CaseKind
    mechanism: str | None = None
    equations: tuple[str, ...] = ()
    coordinates: tuple[str, ...] = ()
    noise_db: float | None = None
    strength: float | None = None
    shifts: dict[Name, KeyShift] = {}
    effect: KeyEffect = KeyEffect()
    sensors: KeySensors = KeySensors()

    @model_validator(mode="after")
    def _named(self) -> CaseKey:
        if (self.mechanism is None) != (self.kind in ("null", "shift")):
            raise ValueError(
                "a mechanism is concealed, or none; give 'mechanism' unless kind is null or shift"
            )
        return self

    @property
    def mechanisms(self) -> bool:
        """Whether a mechanism of the dictionary is concealed."""
        return self.kind == "mechanism"


@dataclass(frozen=True)
class Truth:
    """Noise-free states of a case and their derivatives, at some rows.

    Attributes
    ----------
    t
        Shape ``(n,)``.
    states, inputs
        Shapes ``(n, d)`` and ``(n, i)``, in the order of the card.
    true, without
        Derivatives of the states with the effect and without it, shape ``(n, d)``.
    """

    t: np.ndarray
    states: np.ndarray
    inputs: np.ndarray
    true: np.ndarray
    without: np.ndarray


def read_key(path: str | Path) -> CaseKey:
    """Read a key.

    Raises
    ------
    InputError
        With the line of the first entry that cannot be used.
    """
    return validate(read_document(path), CaseKey)


def read_truth(path: str | Path) -> Truth | None:
    """Read the arrays of a key; None where there are none.

    Raises
    ------
    InputError
        When an array is missing.
    """
    if not Path(path).is_file():
        return None
    with np.load(path, allow_pickle=False) as arrays:
        known: Mapping[str, np.ndarray] = {name: arrays[name] for name in arrays.files}
    for name in ROWS:
        if name not in known:
            raise InputError(path, name, "the array is missing", f"give {', '.join(ROWS)}")
    return Truth(*(known[name] for name in ROWS))
