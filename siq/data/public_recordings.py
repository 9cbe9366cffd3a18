"""Recordings of public benchmarks: from their files, as downloaded, to tables of recordings.

The files are no part of this project. Both benchmarks are described at nonlinearbenchmark.org.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from siq.data.recordings import Recordings
from siq.errors import InputError

SILVERBOX_STEP = 2**14 / 1e7  # s between samples
QUIET = 2e-3  # V of the input about its mean: the gaps between the realisations of the multisine
GAP = 50  # samples, fewer than the gaps have and far more than the multisine is ever quiet for
MULTISINE = 8192  # samples of one period
TRANSIENT = 250  # samples at the begin of a realisation that are left out
REALISATIONS = 3  # of ten, and
SAMPLES = 2048  # of each: enough to learn from
TANKS = ("Est", "Val")
AGAIN = "get it again from nonlinearbenchmark.org"


@dataclass(frozen=True)
class Benchmark:
    """A public benchmark.

    Attributes
    ----------
    file
        Where its file lies below the folder of recordings.
    what
        What is to be got from nonlinearbenchmark.org.
    read
        From that file to recordings.
    score
        What a simulation is scored by, in words, by the length of the windows of held-out recordings in
        samples; None is the whole recording.
    unit, factor
        Unit of the score, and how many of it make one unit of the recordings.
    published
        What others reached by a score, in words.
    """

    file: str
    what: str
    read: Callable[[str | Path], Recordings]
    score: dict[str, int | None]
    unit: str
    factor: float
    published: dict[str, str]


def read_silverbox(path: str | Path) -> Recordings:
    """Recordings of the Silverbox: the arrow, and parts of some realisations of the multisine.

    Offsets of both channels are removed, as the benchmark's authors do: they are of the instruments, and
    visible where the generator was silent.

    Raises
    ------
    InputError
        When the file is not that of the benchmark.
    """
    table = _columns(path, ("V1", "V2"))
    u, y = (table - table.mean(axis=0)).T
    quiet = np.concatenate([[False], np.abs(u) < QUIET, [False]])
    begins, ends = np.flatnonzero(np.diff(quiet.astype(int))).reshape(-1, 2).T
    long = ends - begins >= GAP
    begins, ends = begins[long], ends[long]
    # Between two gaps lies a realisation; what is longer or shorter is the arrow, which begins quietly too.
    between = [
        (int(start), int(gap))
        for start, gap in zip(ends[:-1], begins[1:], strict=True)
        if MULTISINE < gap - start < 1.1 * MULTISINE
    ]
    if len(between) < REALISATIONS:
        raise InputError(path, "", "no gaps between realisations are found", AGAIN)
    parts = {"arrow": slice(0, int(begins[ends == between[0][0]][0]))}
    for place, (start, _) in enumerate(between[:REALISATIONS]):
        parts[f"multisine{place + 1}"] = slice(start + TRANSIENT, start + TRANSIENT + SAMPLES)
    return _recordings({name: (y[rows], u[rows]) for name, rows in parts.items()}, SILVERBOX_STEP)


def read_tanks(path: str | Path) -> Recordings:
    """Recordings of the cascaded tanks: `est` and `val`.

    Raises
    ------
    InputError
        When the file is not that of the benchmark.
    """
    table = _columns(path, tuple(f"{name}{part}" for part in TANKS for name in "yu"))
    parts = {"est": (table[:, 0], table[:, 1]), "val": (table[:, 2], table[:, 3])}
    return _recordings(parts, float(_columns(path, ("Ts",), rows=1)[0, 0]))


BENCHMARKS = {
    "silverbox": Benchmark(
        file="silverbox/SNLS80mV.csv",
        what="SNLS80mV.csv of the Silverbox",
        read=read_silverbox,
        score={"windows of 200 samples": 200, "free run over the arrow": None},
        unit="mV",
        factor=1e3,
        published={"free run over the arrow": "0.26 to 0.4 mV"},
    ),
    "cascaded-tanks": Benchmark(
        file="cascaded-tanks/dataBenchmark.csv",
        what="dataBenchmark.csv of the Cascaded Tanks",
        read=read_tanks,
        score={"free run over the validation data": None},
        unit="V",
        factor=1.0,
        published={"free run over the validation data": "0.67 V, Bernoulli recalibrated"},
    ),
}


def _columns(path: str | Path, names: tuple[str, ...], *, rows: int | None = None) -> np.ndarray:
    import pandas as pd

    try:
        table = pd.read_csv(path, usecols=list(names), nrows=rows, index_col=False)
        values = table[list(names)].to_numpy(dtype=float)
    except (OSError, ValueError):
        raise InputError(path, "", f"it has no columns of numbers {', '.join(names)}", AGAIN) from None
    if not len(values) or not np.isfinite(values).all():
        raise InputError(path, "", "a number is missing", AGAIN)
    return values


def _recordings(parts: dict[str, tuple[np.ndarray, np.ndarray]], step: float) -> Recordings:
    lengths = [len(y) for y, _ in parts.values()]
    return Recordings(
        names=("y", "u"),
        units=("V", "V"),
        labels=tuple(parts),
        recording=np.repeat(np.arange(len(parts)), lengths),
        t=np.concatenate([np.arange(length) * step for length in lengths]),
        values=np.concatenate([np.stack([y, u], axis=1) for y, u in parts.values()]),
        time_unit="s",
    )
