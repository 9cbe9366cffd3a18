"""What does a method say of a case? One file each, written whole or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from benchmarks.discrepancies.added import Added
from siq.numerics.files import whole_file


class Term(BaseModel):
    """A product of powers that is said to be missing.

    Attributes
    ----------
    equation
        The state in whose equation.
    exponents
        Of states and inputs.
    coefficient
        What it is multiplied by.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    equation: str
    exponents: tuple[int, ...]
    coefficient: float


class Answer(BaseModel):
    """What a method says.

    Attributes
    ----------
    applied
        Whether it can be applied: False where it needs a state that cannot be had from what was measured.
    detected
        Whether something is missing, by the criterion of the method.
    evidence
        What the criterion compares; standard errors of the improvement for all methods but `siq`.
    equations, coordinates
        The place: where it is missing, and along which states or inputs.
    terms
        What is missing as a formula, where the method gives one.
    values
        The card's parameters, by name, that the mended simulation runs with.
    added
        What is added to its equations.
    card
        The mended card as text, of `siq`.
    verdict
        The content of ``verdict.json``, of `siq`.
    seconds
        Of a core.
    fault
        Why there is no answer, or which part of it is missing.
    commit
        Of the code that answered.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="constants")

    applied: bool = True
    detected: bool = False
    evidence: float = 0.0
    equations: tuple[str, ...] = ()
    coordinates: tuple[str, ...] = ()
    terms: tuple[Term, ...] = ()
    values: dict[str, float] = {}
    added: Added | None = None
    card: str = ""
    verdict: dict[str, Any] | None = None
    seconds: float = 0.0
    fault: str = ""
    commit: str = ""

    @property
    def answered(self) -> bool:
        """Whether there is an answer at all, be it one that was cut short."""
        return self.applied and bool(self.values or self.card)


def write_answer(path: Path, answer: Answer) -> None:
    """Write an answer, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as partial:
        partial.write_text(answer.model_dump_json(indent=1) + "\n", encoding="utf-8")


def read_answer(path: Path) -> Answer:
    """Read an answer."""
    return Answer.model_validate_json(path.read_text(encoding="utf-8"))


def answer_file(folder: Path, generator: str, case: str, method: str) -> Path:
    """Where the answer of a method lies."""
    return folder / "answers" / generator / f"{case}-{method.replace(', ', '-').replace(' ', '-')}.json"
