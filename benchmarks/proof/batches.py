"""Sets of cases as ``config/proof.yaml`` asks for them, their batches, and the digests of the keys.

Cases and keys follow from the settings alone.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Protocol

from pydantic import BaseModel, ConfigDict, Field, model_validator

from benchmarks.proof.cases import ProofCase
from benchmarks.proof.keys import CaseKind
from siq.errors import InputError
from siq.numerics.files import read_document, validate

LOGGER = logging.getLogger(__name__)


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


class Generator(Protocol):
    """What draws and makes cases: a module such as `benchmarks.proof.concealment.cases`."""

    def draw_cases(self, *, count: int, seed: int, shares: Mapping[str, float]) -> Sequence[Any]:
        """Decide which cases there are."""

    def make_case(self, design: Any) -> ProofCase:
        """Make a case; the same design makes the same case."""


def write_batch(
    settings: Mapping[str, Any], batch: int, *, generator: Generator, cases: Path, keys: Path
) -> dict[str, str]:
    """Make the cases of a batch, and their keys; the same every time.

    Parameters
    ----------
    settings
        The set as ``config/proof.yaml`` has it.
    batch
        Which batch, from 0.
    generator
        What draws and writes them.
    cases, keys
        Folders that they are written to.

    Returns
    -------
    dict
        SHA-256 of every key file by name of the case. A case whose motion never stayed bounded is missing.
    """
    designs = generator.draw_cases(count=settings["cases"], seed=settings["seed"], shares=settings["shares"])
    size = settings["batch"]
    for folder in (cases, keys):
        folder.mkdir(parents=True, exist_ok=True)
    for design in designs[batch * size : (batch + 1) * size]:
        try:
            generator.make_case(design).write(design.name, cases=cases, keys=keys)
        except RuntimeError as error:
            LOGGER.warning("left out: %s", error)
    return digests_of(keys)


def digests_of(keys: Path) -> dict[str, str]:
    """SHA-256 of every key file by name of the case: published before any case is diagnosed."""
    return {path.stem: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(keys.glob("*.json"))}


def check_digests(found: Mapping[str, str], published: Mapping[str, str], *, file: str | Path) -> None:
    """Refuse keys that are not those whose digests were published.

    Parameters
    ----------
    found
        Digests of the keys of some cases.
    published
        Digests of all.
    file
        Where the published ones stand.

    Raises
    ------
    InputError
        For the first key that differs.
    """
    for name, digest in found.items():
        if published.get(name) != digest:
            raise InputError(
                file,
                name,
                "the key is not the one whose digest was published before the diagnosis",
                "conceal, diagnose and score again with one version of the generator",
            )


def read_digests(path: str | Path) -> dict[str, str]:
    """Read what `write_batch` returned, as a file."""
    digests: dict[str, str] = json.loads(Path(path).read_text(encoding="utf-8"))
    return digests
