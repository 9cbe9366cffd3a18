"""The sets of concealed cases, as ``config/proof.yaml`` asks for them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

from benchmarks.proof.keys import CaseKind
from siq.numerics.files import read_document, validate


class ProofSet(BaseModel):
    """The schema of an entry of ``config/proof.yaml``: a set of cases that conceal something.

    Attributes
    ----------
    cases
        Their number.
    seed
        The same seed makes the same cases.
    shares
        Share of each kind; the second generator knows ``null``, ``shift`` and ``withheld``.
    batch
        Cases that one job takes.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    cases: Annotated[int, Field(ge=1)]
    seed: Annotated[int, Field(ge=0)]
    shares: dict[CaseKind, Annotated[float, Field(ge=0, le=1)]]
    batch: Annotated[int, Field(ge=1)] = 10

    @model_validator(mode="after")
    def _whole(self) -> ProofSet:
        if abs(sum(self.shares.values()) - 1) > 1e-9:
            raise ValueError(f"the shares sum to {sum(self.shares.values()):g}; make them sum to 1")
        return self

    def batch_names(self) -> list[str]:
        """``000``, ``001``, …, one for every batch."""
        return [f"{number:03d}" for number in range(-(-self.cases // self.batch))]


FOREIGN = ("proof_foreign", "proof_foreign_small")
"""The sets of the second generator."""


class Proofs(BaseModel):
    """The schema of ``config/proof.yaml``.

    Attributes
    ----------
    proof, proof_full
        Of the first generator, `benchmarks.proof.concealment`.
    proof_foreign, proof_foreign_small
        Of the second, `benchmarks.proof.foreign`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    proof: ProofSet
    proof_full: ProofSet
    proof_foreign: ProofSet | None = None
    proof_foreign_small: ProofSet | None = None


def load_proofs(path: str | Path) -> dict[str, ProofSet]:
    """Read the sets of concealed cases.

    Raises
    ------
    InputError
        With the line of the first entry that cannot be used.
    """
    checked = validate(read_document(path), Proofs)
    sets = {name: getattr(checked, name) for name in Proofs.model_fields}
    return {name: one for name, one in sets.items() if one is not None}
