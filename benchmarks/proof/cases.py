"""Cases: what both generators of the proof share, without anything of `siq`.

What is decided of a case beforehand, what a case and its key are, and how they are written.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import yaml
from pyarrow import parquet

HELD_OUT = 0.25  # share of the recordings
KEY_ROWS = 500
NOISE_LEVELS = (40.0, 30.0, 20.0)  # signal-to-noise ratios, in decibels


class RanAway(Exception):
    """A motion that does not stay bounded."""


@dataclass(frozen=True)
class Design:
    """What is decided of a case before anything is simulated; small, so that cases are made in parallel.

    Attributes
    ----------
    name
        Its neutral name.
    system
        Name of its system, or of the family that it is drawn from.
    kind
        ``null``, ``shift``, ``mechanism``, ``process noise`` or ``withheld``.
    mechanism
        Name of what is concealed, or kind of the function; none for nulls and shifts.
    shifted
        Whether the card has wrong parameters.
    strength
        How strong an effect is aimed at, or where between the weakest and the strongest, from 0 to 1.
    noise_db
        Signal-to-noise ratio of the measurement, in decibels.
    without
        Dictionary entries that the diagnosis is to do without.
    seed
        Seed of everything else.
    """

    name: str
    system: str
    kind: str
    mechanism: str | None
    shifted: bool
    strength: float | None
    noise_db: float
    without: tuple[str, ...]
    seed: int


@dataclass(frozen=True)
class ProofCase:
    """A case as it is written, and its key.

    Attributes
    ----------
    card, study
        What the YAML files say.
    recordings
        Columns of the table of recordings.
    key
        What the JSON file says.
    truth
        The arrays that go with it.
    """

    card: Mapping[str, Any]
    study: Mapping[str, Any]
    recordings: Mapping[str, Any]
    key: Mapping[str, Any]
    truth: Mapping[str, Any]

    def write(self, name: str, *, cases: Path, keys: Path) -> None:
        """Write a case, and its key, to two folders.

        Parameters
        ----------
        name
            Of the case.
        cases
            Gets the folder of the case, with ``system.yaml``, ``recordings.parquet`` and ``study.yaml``.
        keys
            Gets ``NAME.json`` and ``NAME.npz``.
        """
        folder = cases / name
        folder.mkdir(parents=True, exist_ok=True)
        keys.mkdir(parents=True, exist_ok=True)
        for file, content in (("system", self.card), ("study", self.study)):
            text = yaml.safe_dump(dict(content), sort_keys=False, allow_unicode=True)
            (folder / f"{file}.yaml").write_text(text, encoding="utf-8")
        parquet.write_table(pa.table(dict(self.recordings)), folder / "recordings.parquet")
        text = json.dumps(self.key, indent=1, ensure_ascii=False) + "\n"
        (keys / f"{name}.json").write_text(text, encoding="utf-8")
        np.savez_compressed(keys / f"{name}.npz", **self.truth)


def check_shares(shares: Mapping[str, float], kinds: Sequence[str]) -> None:
    """Refuse shares of other kinds, or that do not sum to one."""
    if set(shares) - set(kinds) or abs(sum(shares.values()) - 1) > 1e-9:
        raise ValueError(f"shares {dict(shares)} are not shares of {', '.join(kinds)} that sum to 1")


def in_random_order(drawn: Sequence[Mapping[str, Any]], rng: np.random.Generator) -> list[Design]:
    """Designs in an order that says nothing, with names that follow it."""
    order = rng.permutation(len(drawn))
    return [Design(name=f"case-{number:04d}", **drawn[i]) for number, i in enumerate(order, start=1)]


def key_of(
    design: Design,
    effect: Any,
    rng: np.random.Generator,
    *,
    system: str,
    mechanism: str | None,
    strength: float | None,
    shifts: Mapping[str, Mapping[str, float]],
    **further: Any,
) -> dict[str, Any]:
    """What the key of a case says, with an effect of either generator, or None.

    Its salt is drawn, so that nobody finds the key out by trying digests.
    """
    return {
        "case": design.name,
        "salt": rng.bytes(16).hex(),
        "system": system,
        "kind": design.kind,
        "mechanism": mechanism,
        "equations": list(effect.equations) if effect else [],
        "coordinates": list(effect.coordinates) if effect else [],
        "noise_db": design.noise_db,
        "strength": strength,
        "shifts": shifts,
        "effect": effect.formulas() if effect else {},
        **further,
    }


def turns(choices: Sequence[Any], rng: np.random.Generator) -> Iterator[Any]:
    """All choices in random order, again and again."""
    while True:
        for index in rng.permutation(len(choices)):
            yield choices[index]


def wrong_parameters(
    free: Sequence[str], true: Mapping[str, float], least: float, most: float, rng: np.random.Generator
) -> dict[str, dict[str, float]]:
    """One to three free parameters that the card has wrong, by a share between `least` and `most`."""
    count = int(rng.integers(1, min(3, len(free)) + 1))
    shifts = {}
    for name in map(str, rng.choice(free, size=count, replace=False)):
        factor = 1 + float(rng.choice([-1, 1])) * rng.uniform(least, most)
        shifts[name] = {"card": rounded(true[name] * factor), "true": true[name]}
    return shifts


def rounded(value: float, digits: int = 4) -> float:
    """A number with few digits, so that what a key says is exactly what was simulated."""
    return float(f"{value:.{digits}g}")


def thinned(count: int) -> np.ndarray:
    """The rows of a motion that a key keeps, evenly."""
    return np.unique(np.linspace(0, count - 1, min(KEY_ROWS, count)).astype(int))
