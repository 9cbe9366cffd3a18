"""Recordings: trajectories as measured, in one long table, and the pairs of neighbouring samples.

A table has the columns ``recording`` (a label), ``t`` (the time) and one column per measured quantity. It is
read and checked, written, resampled by whole recordings, and cut into snapshot pairs. Whatever cannot be used
is refused with its row and column; rows are counted from 1 without the header.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from siq.errors import InputError, NumericalFailure, needs_extra
from siq.numerics.files import whole_file
from siq.numerics.randomness import positive
from siq.remarks import Remark, sentence

if TYPE_CHECKING:
    import pandas as pd
    import xarray

TABLE = "the table"  # what messages call what is in no file
LONGEST_STEP = 1.5  # of the median step: a missing sample makes two of it, jitter rarely a half more
UNEVEN_SHARE = 0.1  # of all steps, up to twice as long as the longest: samples come as they come (a choice)
HELD_OUT_SHARE = 0.2
FAR = 10.0  # half ranges from the origin within which powers are alike for other reasons
ROUNDED_TURN = 1e-6  # of a period, by which a wrapped angle may exceed it
MOST_WIDE_STEPS = 0.01  # of normal steps as many are beyond 2.6 deviations, and twice as far 2 in 10 million
SINGLE_RECORDING_REMEDY = (
    "record how the system settles from many starting points, or one long record in which noise makes it hop;"
    " if these are positions of something that has inertia, set 'identification.hidden_velocities'"
)


@dataclass(frozen=True)
class Recordings:
    """Trajectories as measured, checked: finite numbers, and times that increase within every recording.

    Not to be confused with `SnapshotPairs`, which have lost the order in time.
    """

    #: The d measured columns
    names: tuple[str, ...]
    #: The unit of each measured column, None where the file does not say
    units: tuple[str | None, ...]
    #: One label per recording, in order of first appearance
    labels: tuple[str, ...]
    #: Shape ``(n,)``: the index of each row's recording in `labels`; it never decreases
    recording: np.ndarray
    #: Shape ``(n,)``: the time of each row, in `time_unit`
    t: np.ndarray
    #: Shape ``(n, d)``: what was measured, in `units`
    values: np.ndarray
    #: The unit of `t`, None where the file does not say
    time_unit: str | None = None
    #: What the file calls each measured column, where that is no name for a formula: ``bead x`` of
    #: ``bead_x``. Empty where all are called by their names.
    headings: tuple[str, ...] = ()
    #: What was assumed or repaired when they were read
    remarks: tuple[Remark, ...] = ()

    @property
    def longest_step(self) -> float:
        """The longest time between neighbouring samples that is no gap; NaN where no recording has two.

        It is `LONGEST_STEP` median steps, and twice as long as often as this takes in `UNEVEN_SHARE` of all:
        where clouds hide every other image, or samples are taken as they come, long steps are no gaps.
        """
        return _longest(np.diff(self.t)[np.diff(self.recording) == 0])

    @property
    def titles(self) -> tuple[str, ...]:
        """What people call each state: its heading in the file, or else its name."""
        return self.headings or self.names

    @property
    def notes(self) -> tuple[str, ...]:
        """`remarks` in words, each a clause without a full stop."""
        return tuple(map(sentence, self.remarks))

    @classmethod
    def of(cls, source: str | Path | Recordings | pd.DataFrame | xarray.Dataset) -> Recordings:
        """Recordings, whatever they are in: a file or a folder, a table or a dataset, or as they are.

        Raises
        ------
        InputError
            For the first thing that cannot be read; see `read_recordings` and `from_frame`.
        """
        if isinstance(source, Recordings):
            return source
        if isinstance(source, str | Path):
            return read_recordings(source)
        if hasattr(source, "data_vars"):
            from siq.data.tables import read_tables  # which imports pyarrow

            return read_tables(source, columns=None, units=None)
        return cls.from_frame(source)

    @classmethod
    def from_frame(
        cls, frame: pd.DataFrame, *, columns: Sequence[str] | None = None,
        units: Mapping[str, str] | None = None,
    ) -> Recordings:  # fmt: skip
        """Recordings from a table in memory, checked as a file is.

        Parameters
        ----------
        frame
            As `read_recordings` reads a file; units may stand in the metadata ``frame.attrs["units"]``, too.
            An index called ``recording`` or ``t`` counts as a column. Without ``recording`` it is one.
        columns, units
            See `read_recordings`; the units are those of columns that say none.

        Raises
        ------
        InputError
            For the first thing in the table that cannot be used, with its row and column.

        Examples
        --------
        >>> import pandas as pd
        >>> table = pd.DataFrame({"t": [0.0, 0.1, 0.2], "x [mm]": [1.0, 0.8, 0.7]})
        >>> recordings = Recordings.from_frame(table)
        >>> recordings.names, recordings.units, recordings.labels
        (('x',), ('mm',), ('0',))
        """
        from siq.data.tables import read_tables  # which imports pyarrow

        levels = [name for name in frame.index.names if name in ("recording", "t")]
        read = read_tables(frame.reset_index(level=levels) if levels else frame, columns=columns, units=units)
        given = units or {}
        return replace(
            read,
            units=tuple(given.get(name, unit) for name, unit in zip(read.names, read.units, strict=True)),
            time_unit=given.get("t", read.time_unit),
        )

    @classmethod
    def from_arrays(
        cls, t: np.ndarray | Sequence[np.ndarray], values: np.ndarray | Sequence[np.ndarray], *,
        names: Sequence[str], units: Sequence[str | None] | None = None, time_unit: str | None = None,
    ) -> Recordings:  # fmt: skip
        """Recordings from arrays: all of one length, or each of its own.

        Parameters
        ----------
        t
            Times. Shape ``(n,)`` for all recordings, or one such array for each.
        values
            States. Shape ``(n, d)`` for one recording, ``(r, n, d)`` for r of one length, or one array
            ``(n_k, d)`` for each.
        names, units, time_unit
            Of the d states, and of `t`; units are not known by default.

        Raises
        ------
        ValueError
            When the shapes do not fit each other, or numbers are not finite.
        InputError
            When the times of a recording do not increase.

        Examples
        --------
        >>> t = np.linspace(0, 1, 11)
        >>> decays = np.exp(-t)[None, :, None] * np.array([1.0, -1.0, 0.5])[:, None, None]
        >>> Recordings.from_arrays(t, decays, names=["x"]).labels
        ('0', '1', '2')
        """
        from siq.data.tables import check_times  # which imports pyarrow

        one = isinstance(values, np.ndarray) and values.ndim == 2
        parts = [np.asarray(each, dtype=float) for each in ([values] if one else values)]
        times = [np.asarray(each, dtype=float) for each in ([t] * len(parts) if np.ndim(t[0]) == 0 else t)]
        if len(times) != len(parts):
            raise ValueError(f"there are times of {len(times)} recordings and values of {len(parts)}")
        if units is not None and len(units) != len(names):
            raise ValueError(f"there are {len(units)} units for {len(names)} states")
        if len({*names, "recording", "t"}) != len(names) + 2:
            raise ValueError(f"the names {list(names)} are not distinct, or one is 'recording' or 't'")
        for index, (time, part) in enumerate(zip(times, parts, strict=True)):
            if time.ndim != 1 or part.shape != (len(time), len(names)):
                raise ValueError(
                    f"recording {index} has values of shape {part.shape} at times of shape {time.shape};"
                    f" {len(names)} names need ({len(time)}, {len(names)})"
                )
            if not (np.isfinite(time).all() and np.isfinite(part).all()):
                raise ValueError(f"recording {index} holds numbers that are not finite; remove their samples")
        recording = np.repeat(np.arange(len(parts)), [len(time) for time in times])
        labels = tuple(map(str, range(len(parts))))
        together = np.concatenate([*times, np.empty(0)])
        check_times(TABLE, together, recording, labels, np.arange(len(together)))
        return cls(
            tuple(names), tuple(units or (None,) * len(names)), labels, recording, together,
            np.concatenate(parts), time_unit,
        )  # fmt: skip

    def unwrapped(self, angles: Mapping[str, Sequence[float]]) -> Recordings:
        """These recordings with angles that count their turns, where they were recorded within one.

        Parameters
        ----------
        angles
            The two ends of a period by the name of the column.

        Raises
        ------
        InputError
            For a name that no column has, and where samples are too far apart to tell which way
            round an angle went: steps of a quarter of a period are one in a hundred then, or more.

        Examples
        --------
        >>> values = np.array([[[3.0], [-3.1], [-2.9]]])
        >>> table = Recordings.from_arrays([0.0, 0.1, 0.2], values, names=["phi"])
        >>> table.unwrapped({"phi": (-np.pi, np.pi)}).values[:, 0].round(2)
        array([3.  , 3.18, 3.38])
        """
        if not angles:
            return self
        values, inside = self.values.copy(), np.diff(self.recording) == 0
        for name, (low, high) in angles.items():
            if name not in self.names:
                fault = f"there is no column '{name}', which is called an angle"
                raise InputError(TABLE, "", fault, f"name one of {', '.join(self.names)}")
            place, period = self.names.index(name), float(high) - float(low)
            column = values[:, place]
            if np.ptp(column) > period * (1 + ROUNDED_TURN):
                continue  # it counts its turns already
            steps = np.diff(column)
            turns = np.where(inside, np.round(steps / period), 0.0)
            if (np.abs(steps - turns * period)[inside] > period / 4).mean() > MOST_WIDE_STEPS:
                fault = "from one sample to the next it goes so far that nobody can tell which way round"
                raise InputError(TABLE, f"column {self.titles[place]}", fault, "record it more often")
            values[1:, place] -= period * np.cumsum(turns)
        return replace(self, values=values)

    def centred(self, *, degree: int) -> Recordings:
        """These recordings less a round number, of states too far from zero to tell their powers apart.

        Such a state is called by what was taken off: ``T_minus_273``.
        """
        names, headings, values = list(self.names), list(self.titles), self.values.copy()
        remarks = list(self.remarks)
        for state, x in enumerate(self.values.T):
            middle, half = (float(x.max()) + float(x.min())) / 2, float(np.ptp(x)) / 2
            if abs(middle) <= FAR * half or not half > 0 or self.told_apart(np.vander(x, degree + 1)):
                continue
            origin = round(middle, -int(np.floor(np.log10(half))))
            sign, word = ("−", "minus") if origin > 0 else ("+", "plus")
            values[:, state] -= origin
            headings[state] = f"{headings[state]} {sign} {abs(origin):.10g}"
            names[state] = names[state] + re.sub(r"\W", "_", f"_{word}_{abs(origin):.10g}")
            told = {"column": self.titles[state], "origin": f"{origin:.10g}", "name": names[state]}
            remarks.append(Remark("data.centred", told))
        if len(remarks) == len(self.remarks):
            return self
        return replace(
            self, names=tuple(names), headings=tuple(headings), values=values, remarks=tuple(remarks)
        )

    @staticmethod
    def told_apart(columns: np.ndarray) -> bool:
        """Whether columns ``(n, q)`` are apart to half of all digits: covariances lose twice as many."""
        size = np.linalg.norm(columns, axis=0)
        values = np.linalg.svd(np.linalg.qr(columns / positive(size), mode="r"), compute_uv=False)
        return bool(values[-1] > np.sqrt(np.finfo(float).eps) * values[0])

    def to_xarray(self) -> xarray.Dataset:
        """An `xarray.Dataset` over the dimension ``sample``, with units; ``Recordings.of`` reads it back.

        Its method ``to_netcdf`` writes a file that `read_recordings` reads.

        Raises
        ------
        MissingExtra
            Where xarray is not installed.
        """
        with needs_extra("netcdf"):
            import xarray

        def variable(values: np.ndarray, unit: str | None) -> tuple[str, np.ndarray, dict[str, str]]:
            return "sample", values, {} if unit is None else {"units": unit}

        states = zip(self.names, self.values.T, self.units, strict=True)
        labels = np.array(self.labels)[self.recording]
        return xarray.Dataset(
            {name: variable(values, unit) for name, values, unit in states},
            {"recording": variable(labels, None), "t": variable(self.t, self.time_unit)},
        )

    def of_states(self, places: Sequence[int] | np.ndarray, remarks: Iterable[Remark]) -> Recordings:
        """These states alone, by their places, with what there is to say of the others."""

        def kept(several: tuple[Any, ...]) -> tuple[Any, ...]:
            return tuple(several[place] for place in places) if several else ()

        return replace(
            self, names=kept(self.names), units=kept(self.units), headings=kept(self.headings),
            values=np.ascontiguousarray(self.values[:, places]), remarks=(*self.remarks, *remarks),
        )  # fmt: skip

    def select(self, indices: Sequence[int] | np.ndarray) -> Recordings:
        """Whole recordings, in the order given.

        Parameters
        ----------
        indices
            Indices into `labels`, not of rows. One that stands twice gives copies, told apart by their
            labels: ``r07``, ``r07#2``.

        Raises
        ------
        ValueError
            When `indices` is empty, is a mask, or points outside the recordings.
        """
        chosen, count = np.asarray(indices), len(self.labels)
        if chosen.ndim != 1 or chosen.dtype.kind not in "iu" or chosen.size == 0:
            raise ValueError("recordings are selected by a list of at least one index")
        if chosen.min() < 0 or chosen.max() >= count:
            raise ValueError(f"a selected recording is not one of 0 ... {count - 1}")
        taken = set(self.labels)  # a label of the file may itself look like that of a copy
        copies: dict[int, int] = {}
        labels = []
        for index in chosen.tolist():
            label, copy = self.labels[index], copies.get(index, 0) + 1
            while copy > 1 and f"{label}#{copy}" in taken:
                copy += 1
            copies[index] = copy
            labels.append(label if copy == 1 else f"{label}#{copy}")
            taken.add(labels[-1])
        own = np.split(np.arange(len(self.t)), np.searchsorted(self.recording, np.arange(1, count)))
        parts = [own[index] for index in chosen]
        rows, recording = np.concatenate(parts), np.repeat(np.arange(len(parts)), [*map(len, parts)])
        return replace(
            self, labels=tuple(labels), recording=recording, t=self.t[rows], values=self.values[rows]
        )

    def resampled(self, *, generator: np.random.Generator) -> Recordings:
        """As many recordings, drawn with replacement: one bootstrap sample.

        Whole recordings are drawn, not rows, since the samples of one recording are not independent.
        """
        count = len(self.labels)
        return self.select(generator.integers(count, size=count))

    def held_out(self, *, generator: np.random.Generator, share: float = HELD_OUT_SHARE) -> np.ndarray:
        """A random part of the recordings, as a mask over `labels`.

        Copies of a resampled recording stay together: none is held out while another is fitted.

        Raises
        ------
        NumericalFailure
            When all recordings are copies of one, so that none can be held out.
        """
        groups = parent_recordings(self.labels)
        names = np.unique(groups)
        if len(names) < 2:
            raise NumericalFailure(
                "there is one recording, and it shows no process noise or is too short to be divided, so"
                f" that none can be held out; {SINGLE_RECORDING_REMEDY}"
            )
        count = min(max(round(share * len(names)), 1), len(names) - 1)
        return np.isin(groups, generator.permutation(names)[:count])


@dataclass(frozen=True)
class SnapshotPairs:
    """States a short time apart, each pair with its own step. See `snapshot_pairs`.

    Copies of a resampled recording share one index, so that none is held out while another trains.
    """

    x0: np.ndarray  #: (n, d): the earlier state
    xh: np.ndarray  #: (n, d): the later state
    h: np.ndarray  #: (n,): the time between the two
    recording: np.ndarray  #: (n,): the index of the recording that the pair is from
    copies: float = field(default=1.0, kw_only=True)  #: how often a pair stands there, in the mean over pairs

    def __len__(self) -> int:
        """How many there are."""
        return len(self.h)

    def blocks(self) -> Iterator[SnapshotPairs]:
        """All pairs in one block, which is what `StreamedPairs` are without."""
        yield self

    @cached_property
    def mean_square_speed(self) -> np.ndarray:
        """The mean of ``|Xh - X0|²/h`` of each state, shape ``(d,)``."""
        return np.asarray(((self.xh - self.x0) ** 2 / self.h[:, None]).mean(axis=0))

    def equal_parts(self, parts: int, *, of_steps: bool = False) -> np.ndarray:
        """Whether pairs are in each but the first of so many parts of states, or steps: ``(n, columns)``."""
        found, shares = [], np.linspace(0, 1, parts + 1)[1:-1]
        for each in [np.round(self.h / np.median(self.h), 2)] if of_steps else self.x0.T:
            edges = np.unique(np.quantile(each, shares))
            found.append(np.searchsorted(edges, each, side="right")[:, None] == np.arange(1, len(edges) + 1))
        return np.concatenate(found, axis=1)

    def take(self, rows: np.ndarray | slice) -> SnapshotPairs:
        """Some of the pairs, by their indices or by a mask."""
        parts = self.x0[rows], self.xh[rows], self.h[rows], self.recording[rows]
        return SnapshotPairs(*parts, copies=self.copies)


def _longest(steps: np.ndarray) -> float:
    # Of the two middle ones the shorter: pairs with gaps between them have about as many of either.
    longest = LONGEST_STEP * float(np.quantile(steps, 0.5, method="lower")) if len(steps) else np.nan
    while True:
        longer = np.sum((steps > longest * (1 + 1e-6)) & (steps <= 2 * longest * (1 + 1e-6)))
        if not longer - np.sqrt(longer) >= max(UNEVEN_SHARE * len(steps), 1):  # of few steps one may be a gap
            return longest
        longest *= 2


class StreamedPairs:
    """Pairs of a Parquet file that need not fit into memory: read block by block whenever they are used.

    A regression of them is that of `snapshot_pairs`, to rounding (`siq.inference.regression`). The file is as
    `write_recordings` writes it: the rows of a recording stand together, in the order of time.

    Parameters
    ----------
    path
        A Parquet file with the columns ``t``, the states, and ``recording`` where there are several.
    pair_step
        See `snapshot_pairs`; by default from the steps of the first block.
    rows
        Samples in a block.

    Raises
    ------
    InputError
        When the rows are in another order, or a number is missing.
    """

    copies = 1.0

    def __init__(self, path: str | Path, *, pair_step: float | None = None, rows: int = 1 << 16) -> None:
        from pyarrow import parquet

        self.path, self.rows, self.pair_step = Path(path), rows, pair_step
        self._columns = parquet.read_schema(path).names
        self.names = tuple(name for name in self._columns if name not in ("recording", "t"))
        count, squares = 0, np.zeros(len(self.names))
        for block in self.blocks():
            if self.pair_step is None:
                self.pair_step = _longest(block.h)
            count, squares = count + len(block), squares + block.mean_square_speed * len(block)
        self._count, self.mean_square_speed, self._wanted = count, squares / max(count, 1), np.array([])

    def __len__(self) -> int:
        """How many there are."""
        return self._count

    def blocks(self) -> Iterator[SnapshotPairs]:
        """The pairs, block by block; each begins with the last sample of the one before."""
        from pyarrow import parquet

        t, x, label, seen = np.empty(0), np.empty((0, len(self.names))), None, 0
        with parquet.ParquetFile(self.path, pre_buffer=False) as file:
            for batch in file.iter_batches(batch_size=self.rows):
                new = np.zeros(len(batch), dtype=np.int64)
                if "recording" in self._columns:
                    labels = batch.column("recording").dictionary_decode().to_numpy(zero_copy_only=False)
                    new[1:] = labels[1:] != labels[:-1]
                    new[0], label = label is not None and labels[0] != label, labels[-1]
                states = [batch.column(name).to_numpy(zero_copy_only=False) for name in self.names]
                own = np.concatenate([np.zeros_like(new[: len(t[-1:])]), np.cumsum(new)])
                t = np.concatenate([t[-1:], batch.column("t").to_numpy(zero_copy_only=False)])
                x = np.concatenate([x[-1:], np.stack(states, axis=1)])
                if not np.isfinite(x).all() or not (np.diff(t)[np.diff(own) == 0] > 0).all():
                    fault = "a number is missing, or the times of a recording do not increase"
                    place = f"rows {seen + 1} to {seen + len(batch)}"
                    raise InputError(self.path, place, fault, "write it by siq.write_recordings")
                seen += len(batch)
                numbers = tuple(map(str, range(own[-1] + 1)))
                part = Recordings(self.names, (None,) * len(self.names), numbers, own, t, x)
                with contextlib.suppress(ValueError):  # a block without a pair
                    yield snapshot_pairs(part, pair_step=self.pair_step)

    def take(self, rows: np.ndarray | slice) -> SnapshotPairs:
        """Some of the pairs, by their indices in ascending order."""
        wanted = np.arange(*rows.indices(len(self))) if isinstance(rows, slice) else rows
        if not len(self._wanted) or not np.array_equal(wanted, self._wanted):  # several ask for the same
            parts, first = [], 0
            for block in self.blocks():
                low, high = np.searchsorted(wanted, [first, first + len(block)])
                parts.append(block.take(wanted[low:high] - first))
                first += len(block)
            x0, xh, h = (np.concatenate([getattr(one, name) for one in parts]) for name in ("x0", "xh", "h"))
            whose, self._wanted = np.zeros(len(wanted), dtype=np.int64), wanted
            self._taken = SnapshotPairs(x0, xh, h, whose)
        return self._taken


def read_recordings(
    path: str | Path, *, columns: Sequence[str] | None = None, units: Mapping[str, str] | None = None,
    gaps: bool = True,
) -> Recordings:  # fmt: skip
    """Read a long table of trajectories and check it.

    Rows of one recording need not stand together; they are grouped, in order of first appearance. What had to
    be assumed, or could be put right without a guess, stands in `Recordings.remarks`.

    Parameters
    ----------
    path
        A file that `siq.data.formats.open_columns` can read, or a folder with one file per recording. A
        unit may stand behind a name (``x [mm]``, ``x (mm)``), in the file's metadata, or in every cell of a
        column (``1.2 mm``).
    columns
        The measured columns wanted, in the order of the state vector; the file's others are then ignored.
        Default: all columns but ``recording`` and ``t``, in the order of the file.
    units
        The units that are expected, by column, ``t`` included. Nothing is converted: another unit in the
        file is refused. A column without a unit in the file is taken as it is.
    gaps
        Whether rows in which a measured value is missing are left out, and said. Otherwise they are refused,
        as they have to be where an input of the system could be among them.

    Raises
    ------
    InputError
        For the first thing in the file that cannot be used, with its row and column.
    """
    from siq.data.tables import read_tables  # which imports pyarrow

    return read_tables(path, columns=columns, units=units, gaps=gaps)


def write_recordings(path: str | Path, recordings: Recordings) -> None:
    """Write recordings as Parquet; `read_recordings` gives them back to the last bit.

    The file appears complete or not at all, and the same recordings give the same bytes.

    Parameters
    ----------
    path
        A file named ``.parquet``; one that exists is replaced.
    recordings
        What to write.

    Raises
    ------
    ValueError
        When the path has another suffix.
    """
    import pyarrow as pa
    from pyarrow import parquet

    path = Path(path)
    if path.suffix.lower() != ".parquet":
        raise ValueError(f"recordings are written as .parquet, not as '{path.name}'")

    def field(name: str, unit: str | None, title: str | None) -> pa.Field:
        said = {key: text for key, text in (("unit", unit), ("heading", title)) if text is not None}
        return pa.field(name, pa.float64(), metadata=said or None)

    label = pa.DictionaryArray.from_arrays(
        pa.array(recordings.recording.astype(np.int32)), pa.array(recordings.labels, type=pa.string())
    )
    names, units = ("t", *recordings.names), (recordings.time_unit, *recordings.units)
    titles = (None, *(recordings.headings or (None,) * len(recordings.names)))
    fields = [field(name, unit, title) for name, unit, title in zip(names, units, titles, strict=True)]
    remarks = [each.as_data() for each in recordings.remarks]
    noted = {"notes": json.dumps(remarks, ensure_ascii=False)} if remarks else None
    table = pa.table(
        [label, pa.array(recordings.t), *(pa.array(column) for column in recordings.values.T)],
        schema=pa.schema([pa.field("recording", label.type), *fields], metadata=noted),
    )
    with whole_file(path) as partial:
        parquet.write_table(table, partial, compression="zstd", use_dictionary=["recording"])


def snapshot_pairs(recordings: Recordings, *, pair_step: float | None = None) -> SnapshotPairs:
    """Pair every sample with the next one of the same recording.

    Parameters
    ----------
    recordings
        The trajectories.
    pair_step
        The longest gap that still makes a pair, in the unit of `t`; by default `Recordings.longest_step`.
        This is a limit, not the step h of the pairs, of which each has its own.

    Raises
    ------
    ValueError
        When no pair results.
    """
    if pair_step is not None and not pair_step > 0:
        raise ValueError(f"pair_step is {pair_step}, but it must be positive")
    t, recording = recordings.t, recordings.recording
    gap, keep = np.diff(t), recording[1:] == recording[:-1]
    if pair_step is None and keep.any():
        pair_step = recordings.longest_step
    if pair_step is not None:
        # Times such as 0.1·k, or seconds since 1970, carry rounding errors into their differences.
        keep &= gap <= pair_step * (1 + 1e-6) + 2 * np.spacing(np.abs(t[1:]))
    if not keep.any():
        limit = "" if pair_step is None else f" that are at most pair_step = {pair_step} apart"
        raise ValueError(f"no recording has two consecutive samples{limit}")
    chosen = slice(None) if keep.all() else keep  # no copies where there is nothing to leave out
    parents, copies = parents_of(recordings, recording[:-1][chosen])
    x0, xh = recordings.values[:-1][chosen], recordings.values[1:][chosen]
    return SnapshotPairs(x0, xh, gap[chosen], parents, copies=copies)


def parents_of(recordings: Recordings, recording: np.ndarray) -> tuple[np.ndarray, float]:
    """Of pairs from these recordings, ``(n,)``, those that each is from or a copy of; and the mean of copies.

    A pair that stands m times counts with weight m, but has only one residual: variances grow by the
    mean of m.
    """
    parents = parent_recordings(recordings.labels)
    count = np.bincount(recording, minlength=len(parents))
    copies = np.bincount(parents[count > 0], minlength=len(parents))[parents]
    return parents[recording], float(count @ copies / count.sum())


@lru_cache(maxsize=16)
def parent_recordings(labels: tuple[str, ...]) -> np.ndarray:
    """Index into labels of the recording that each is, or is a copy of: ``r07#2`` is one of ``r07``."""
    position = {label: index for index, label in enumerate(labels)}
    parents = []
    for label in labels:
        original, _, copy = label.rpartition("#")
        parents.append(position[original if copy.isdigit() and original in position else label])
    found = np.array(parents, dtype=np.int64)
    found.flags.writeable = False  # every caller has the same array
    return found
