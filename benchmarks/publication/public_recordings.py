"""Recordings of public benchmarks: from their files, as downloaded, to tables of recordings.

The files are no part of this project. Both benchmarks are described at nonlinearbenchmark.org, and their
official loader (github.com/GerbenBeintema/nonlinear_benchmarks) says which rows are for learning, which are a
test, and how many samples at the begin of a test a simulation may learn its initial state from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from siq.data.recordings import Recordings
from siq.errors import InputError

SILVERBOX_STEP = 2**14 / 1e7  # s between samples
SILVERBOX_TRAINING = (40650, 105712)
"""Rows for learning, half open; those of the tests follow, as the official loader has them."""
SILVERBOX_TESTS = {
    "multisine": (105712, 127400),
    "arrow": (100, 40575),
    "arrow without extrapolation": (100, 32100),
}
QUIET = 2e-3  # V of the input about its median: between two realisations of the multisine
GAP = 50  # samples, fewer than these gaps have and far more than the multisine is ever quiet for
PERIODS = 8  # of the multisine within the rows for learning: as many recordings are made of them
TANKS = ("Est", "Val")
AGAIN = "get it again from nonlinearbenchmark.org"
SECOND_HAND = "as quoted by others, not checked"


@dataclass(frozen=True)
class PublishedError:
    """What others reached in a test.

    Attributes
    ----------
    error
        Root mean square, in the unit of the benchmark.
    method
        By what.
    scored
        How, as far as it is known.
    source
        Who says so.
    """

    error: float
    method: str
    scored: str = "root mean square error of a simulation; which samples told the initial state is not said"
    source: str = SECOND_HAND


@dataclass(frozen=True)
class OfficialTest:
    """A test of a benchmark: a recording, of which a simulation is told no more than how it begins.

    Attributes
    ----------
    window
        Samples at its begin that may tell the initial state, and are not scored.
    published
        What others reached.
    """

    window: int
    published: tuple[PublishedError, ...]


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
    tests
        Its official tests, by the label of their recording. All other recordings are for learning.
    unit, factor
        Unit of the errors, and how many of it make one unit of the recordings.
    """

    file: str
    what: str
    read: Callable[[str | Path], Recordings]
    tests: dict[str, OfficialTest]
    unit: str
    factor: float


def read_silverbox(path: str | Path) -> Recordings:
    """Recordings of the Silverbox: `multisine1` to `multisine8` for learning, and one for each test.

    The input is what the generator adds to its value at rest, which it has between the realisations of the
    rows for learning; nothing of a test has a part in it. The output is as it was measured, offset included.

    Raises
    ------
    InputError
        When the file is not that of the benchmark.
    """
    table = _columns(path, ("V1", "V2"))
    last = max(end for _, end in SILVERBOX_TESTS.values())
    if len(table) < last:
        raise InputError(path, "", f"it has {len(table)} rows of at least {last}", AGAIN)
    u, y = table.T
    u = u - _at_rest(u[slice(*SILVERBOX_TRAINING)], path)
    pieces = np.array_split(np.arange(*SILVERBOX_TRAINING), PERIODS)
    parts = {f"multisine{place}": rows for place, rows in enumerate(pieces, start=1)}
    parts |= {name: np.arange(*rows) for name, rows in SILVERBOX_TESTS.items()}
    return _recordings({name: (y[rows], u[rows]) for name, rows in parts.items()}, SILVERBOX_STEP)


def _at_rest(u: np.ndarray, path: str | Path) -> float:
    """The mean of an input over the gaps in which its generator is silent."""
    quiet = np.concatenate([[False], np.abs(u - np.median(u)) < QUIET, [False]])
    begins, ends = np.flatnonzero(np.diff(quiet.astype(int))).reshape(-1, 2).T
    long = ends - begins >= GAP
    if not long.any():
        raise InputError(path, "", "no gaps between realisations are found", AGAIN)
    gaps = zip(begins[long], ends[long], strict=True)
    return float(np.concatenate([u[begin:end] for begin, end in gaps]).mean())


def read_tanks(path: str | Path) -> Recordings:
    """Recordings of the cascaded tanks: `est` for learning, `val` for the test.

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
        tests={
            "multisine": OfficialTest(50, (PublishedError(0.30, "Gaussian process"),)),
            "arrow": OfficialTest(50, (PublishedError(0.26, "polynomial state space"),)),
            "arrow without extrapolation": OfficialTest(
                50, (PublishedError(0.26, "the best that is quoted"),)
            ),
        },
        unit="mV",
        factor=1e3,
    ),
    "cascaded-tanks": Benchmark(
        file="cascaded-tanks/dataBenchmark.csv",
        what="dataBenchmark.csv of the Cascaded Tanks",
        read=read_tanks,
        tests={
            "val": OfficialTest(
                5,
                (
                    PublishedError(0.19, "physical equations with overflow, given beforehand"),
                    PublishedError(0.25, "the best of networks"),
                    PublishedError(0.67, "Bernoulli’s law, refitted"),
                ),
            )
        },
        unit="V",
        factor=1.0,
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
