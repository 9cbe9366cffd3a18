"""What is in recordings, and what will they be good for? Told in seconds, before anything runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from siq.data.coverage import Coverage, coverage_of
from siq.data.inspected_states import (
    Span,
    StateFacts,
    range_text,
    sensor_dominates,
    span_of,
    state_text,
    states_of,
)
from siq.data.learnable import remarks
from siq.data.markov_lag import MarkovLag, markov_lag
from siq.data.prospects import (
    coverage_sentence,
    memory_prospects,
    memory_sentences,
    noise_prospects,
    transition_sentences,
)
from siq.data.record_states import RecordStates, states_of_record
from siq.data.recordings import LONGEST_STEP, Recordings, read_recordings, recordings_of
from siq.data.transitions import Switching, switching
from siq.numerics.measured_text import value_text

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


RESTFUL = ("none", "unknown")  # of a memory: what relaxes without noise neither hops nor drifts


@dataclass(frozen=True)
class Inspection:
    """A file of recordings at a glance.

    Attributes
    ----------
    file
        As it was named.
    recordings
        What was read.
    states
        The measured columns.
    samples
        Of a recording.
    durations
        Of a recording, in the unit of time.
    steps
        Between neighbouring samples, in the unit of time; None where no recording has two.
    pairs
        Number of neighbouring samples that are close enough to learn from.
    gaps
        Number of neighbouring samples that are further apart than that.
    memory
        From which lag on the recordings are Markovian, and what makes them remember until then.
    coverage
        Which part of the range of the states was visited.
    switching
        Two states with the hops between them and the background; None where nothing is known of them, as of
        recordings without noise.
    findings
        What the last four say, each a sentence.
    notes
        What was assumed or repaired in reading.
    prospects
        What will be possible, and what is missing for more, each a sentence.
    """

    file: str
    recordings: Recordings
    states: tuple[StateFacts, ...]
    samples: Span
    durations: Span
    steps: Span | None
    pairs: int
    gaps: int
    memory: MarkovLag
    coverage: Coverage
    switching: Switching | None
    findings: tuple[str, ...]
    notes: tuple[str, ...]
    prospects: tuple[str, ...]

    @property
    def seen(self) -> RecordStates | None:
        """The two states that the recordings show by themselves; None where nothing is known of them."""
        return states_of_record(self.recordings, self.switching)

    def text(self) -> str:
        """As lines of plain text, for a terminal."""
        return "\n".join([self.file, *(f"  {line}" for line in self.lines())])

    def lines(self) -> list[str]:
        """The same without the name of the file: what was read, what it shows, what can be learned."""
        return _lines(self)

    def plot(self) -> Figure:
        """Three panels: the states in time, how often each is visited, and what neighbours remember."""
        from siq.report.plots.inspection import plot_inspection

        return plot_inspection(self)


def inspect(source: str | Path | Recordings | pd.DataFrame) -> Inspection:
    """Look at recordings, and say what is in them and what can be learned: seconds, before anything runs.

    Parameters
    ----------
    source
        A file, a folder of files, recordings, or a table with the columns ``t``, the measured ones and, of
        several recordings, ``recording``.

    Returns
    -------
    Inspection
        With `text()` and `plot()`.

    Raises
    ------
    InputError
        For the first thing that cannot be read; see `siq.data.recordings.read_recordings`.

    Examples
    --------
    >>> generator = np.random.default_rng(0)
    >>> walk = np.zeros((2000, 1))
    >>> for k in range(1999):
    ...     walk[k + 1] = 0.95 * walk[k] + 0.1 * generator.standard_normal()
    >>> found = inspect(Recordings.from_arrays(0.1 * np.arange(2000), walk, names=["x"]))
    >>> found.memory.kind, found.memory.lag
    ('white', 0)
    """
    if isinstance(source, str | Path):
        return inspect_recordings(source)
    named = "the recordings" if isinstance(source, Recordings) else "the table"
    return inspection_of(recordings_of(source), file=named)


def inspect_recordings(path: str | Path) -> Inspection:
    """Look at a file, or a folder of files, and say what is in it.

    Raises
    ------
    InputError
        For the first thing that cannot be read; see `siq.data.recordings.read_recordings`.
    """
    return inspection_of(read_recordings(path), file=str(path))


def inspection_of(recordings: Recordings, *, file: str = "the recordings") -> Inspection:
    """What `inspect_recordings` says, of recordings in memory."""
    counts = np.bincount(recordings.recording)
    first = np.cumsum(counts) - counts
    durations = recordings.t[first + counts - 1] - recordings.t[first]
    gaps = np.diff(recordings.t)[np.diff(recordings.recording) == 0]
    states = states_of(recordings)
    usual = _usual_step(recordings)
    near = int((gaps <= LONGEST_STEP * usual * (1 + 1e-6)).sum())
    memory, coverage = markov_lag(recordings), coverage_of(recordings)
    hops = None if memory.kind in RESTFUL else switching(recordings)
    return Inspection(
        file=file,
        recordings=recordings,
        states=states,
        samples=span_of(counts),
        durations=span_of(durations),
        steps=span_of(gaps) if len(gaps) else None,
        pairs=near,
        gaps=len(gaps) - near,
        memory=memory,
        coverage=coverage,
        switching=hops,
        findings=tuple(_findings(recordings, memory, coverage, hops)),
        notes=(*recordings.notes, *remarks(recordings)),
        prospects=_prospects(recordings, states, memory),
    )


def seen_states(recordings: Recordings) -> RecordStates | None:
    """The two states that recordings show by themselves, without the rest of an inspection."""
    if markov_lag(recordings).kind in RESTFUL:
        return None
    return states_of_record(recordings, switching(recordings))


def _findings(
    recordings: Recordings, memory: MarkovLag, coverage: Coverage, hops: Switching | None
) -> list[str]:
    said = memory_sentences(memory, titles=recordings.titles, time_unit=recordings.time_unit)
    if np.isfinite(memory.relaxation) and memory.kind not in ("unknown", "hidden"):
        unit = f" {recordings.time_unit}" if recordings.time_unit else ""
        said.append(
            f"A fluctuation is forgotten within about {value_text(memory.relaxation, digits=2)}{unit},"
            f" {value_text(memory.relaxation / memory.step, digits=2)} steps."
        )
    said += transition_sentences(hops, titles=recordings.titles, time_unit=recordings.time_unit)
    return [*said, coverage_sentence(coverage, titles=recordings.titles)]


def _prospects(recordings: Recordings, states: tuple[StateFacts, ...], memory: MarkovLag) -> tuple[str, ...]:
    noises = [state.noise for state in states if state.noise is not None]
    step = _usual_step(recordings)
    remembers = memory.remembers
    # Correlated forces fill the windows of the first look as a smooth motion does.
    said = noise_prospects(
        recordings,
        forced=remembers or any(noise.process > 0 for noise in noises),
        known=remembers or bool(noises),
        noisy=[state.title for state in states if sensor_dominates(state, step) and not remembers],
    )
    said += memory_prospects(memory, time_unit=recordings.time_unit)
    if recordings.time_unit is None:
        said.append(
            "The file does not say in which unit the time is: write it into the heading, such as t [s]."
        )
    return tuple(said)


def _usual_step(recordings: Recordings) -> float:
    gaps = np.diff(recordings.t)[np.diff(recordings.recording) == 0]
    return float(np.median(gaps)) if len(gaps) else 0.0


def _lines(found: Inspection) -> list[str]:
    recordings = found.recordings
    unit = f" {recordings.time_unit}" if recordings.time_unit else ""
    count = len(recordings.labels)
    lines = [
        f"{count:,} recording{'s' if count > 1 else ''} of {range_text(found.samples)} samples,"
        f" {range_text(found.durations)}{unit} long",
    ]
    if found.steps is not None:
        lines.append(
            f"time step {range_text(found.steps)}{unit}; {found.pairs:,} pairs of neighbouring samples"
            + (f", {found.gaps:,} gap{'s' if found.gaps > 1 else ''}" if found.gaps else "")
        )
    # Where increments are correlated the two noises of a first look are neither.
    told = not found.memory.remembers and found.memory.kind != "hidden"
    lines += [state_text(state, recordings.time_unit, noise=told) for state in found.states]
    lines += found.findings
    lines += [f"Note: {note[0].upper()}{note[1:]}." for note in found.notes]
    return [*lines, *found.prospects]
