"""Which cases are there, and how are their keys made again?

They come from both generators of the proof, from seeds of their own.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from pydantic import BaseModel, ConfigDict

from benchmarks.proof.batches import Generator, ProofSet, check_digests, read_digests, write_batch
from benchmarks.proof.concealment import cases as concealment
from benchmarks.proof.foreign import cases as foreign
from siq.diagnosis.study import Comparison, read_case
from siq.numerics.files import read_document, validate, whole_file

GENERATORS: Mapping[str, Generator] = {"concealment": concealment, "foreign": foreign}


class Sets(BaseModel):
    """The schema of ``config/discrepancies.yaml``: a set of cases for each generator."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    concealment: ProofSet
    foreign: ProofSet


@dataclass(frozen=True)
class CaseFiles:
    """Where a case lies.

    Attributes
    ----------
    generator, name
        Which case.
    folder
        With its card, its recordings and its study; no key.
    """

    generator: str
    name: str
    folder: Path

    def read(self) -> Comparison:
        """The case as every method has it."""
        return read_case(
            self.folder / "system.yaml", self.folder / "recordings.parquet", self.folder / "study.yaml"
        )


def read_sets(path: str | Path) -> Sets:
    """Read which cases there are.

    Raises
    ------
    InputError
        With the line of the first entry that cannot be used.
    """
    return validate(read_document(path), Sets)


def conceal(sets: Sets, folder: Path) -> list[CaseFiles]:
    """Make the cases that are not there yet. Of their keys only the digests are left."""
    for name, generator in GENERATORS.items():
        digests = folder / "cases" / f"{name}.json"
        if digests.is_file():
            continue
        with TemporaryDirectory() as keys:
            found = write_batch(
                getattr(sets, name).model_dump(), 0, generator=generator,
                cases=folder / "cases" / name, keys=Path(keys),
            )  # fmt: skip
        with whole_file(digests) as partial:
            partial.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return list(known_cases(folder))


def known_cases(folder: Path) -> Iterator[CaseFiles]:
    """The cases that are there: one of each generator in turn, so that a run cut short knows of both."""
    names = {name: sorted(read_digests(folder / "cases" / f"{name}.json")) for name in GENERATORS}
    for place in range(max(map(len, names.values()))):
        for generator, cases in names.items():
            if place < len(cases):
                yield CaseFiles(generator, cases[place], folder / "cases" / generator / cases[place])


def open_keys(sets: Sets, folder: Path, keys: Path) -> None:
    """Make the keys again, below one folder for each generator, and hold them against the digests."""
    for name, generator in GENERATORS.items():
        with TemporaryDirectory() as cases:
            found = write_batch(
                getattr(sets, name).model_dump(), 0, generator=generator,
                cases=Path(cases), keys=keys / name,
            )  # fmt: skip
        digests = folder / "cases" / f"{name}.json"
        check_digests(found, read_digests(digests), file=digests)
