"""Cases: what both generators of the proof share, without anything of `siq`.

What a case is and how it is written, how designs take turns, which parameters of a card are wrong, and which
rows of a motion a key keeps.
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
        shifts[name] = {"card": float(f"{true[name] * factor:.4g}"), "true": true[name]}
    return shifts


def thinned(count: int) -> np.ndarray:
    """The rows of a motion that a key keeps, evenly."""
    return np.unique(np.linspace(0, count - 1, min(KEY_ROWS, count)).astype(int))
