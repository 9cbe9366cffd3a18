"""Batches of the proof: cases and keys that follow from the settings alone, and the digests of the keys."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from benchmarks.proof.cases import ProofCase
from siq.errors import InputError

LOGGER = logging.getLogger(__name__)


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
