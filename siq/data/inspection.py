"""What is in a file of recordings, and what will it be good for? Told in seconds, before anything runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from siq.data.learnable import SINGLE, SINGLE_REMEDY, remarks
from siq.data.noise_floor import NoiseFloor, noise_floors
from siq.data.quantum import decimals_of, quantum, rounding_error
from siq.data.recordings import LONGEST_STEP, Recordings, read_recordings

HARMFUL = 0.02  # of the variance of a step, shared by neighbours: `siq.identify.residuals` takes no more
SEEN = 1e-6  # of the range of a state: rounding to less than that is not worth a word


@dataclass(frozen=True)
class Span:
    """The shortest, the usual and the longest of something."""

    shortest: float
    usual: float
    longest: float


@dataclass(frozen=True)
class StateFacts:
    """What is known of one measured column.

    Attributes
    ----------
    name, title
        Its name in formulas, and what the file calls it.
    unit
        None where the file does not say.
    lowest, highest
        The interval of its values.
    quantum
        The step to which it was rounded when it was written, None where none is recognised.
    noise
        A first look at its noise; None where neighbouring samples are too few or uneven.
    """

    name: str
    title: str
    unit: str | None
    lowest: float
    highest: float
    quantum: float | None
    noise: NoiseFloor | None


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
    notes: tuple[str, ...]
    prospects: tuple[str, ...]

    def text(self) -> str:
        """As lines of plain text, for a terminal."""
        return _text(self)


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
    floors = noise_floors(recordings)
    states = tuple(
        StateFacts(
            name, title, unit, float(values.min()), float(values.max()), quantum(values),
            None if floors is None else floors[place],
        )
        for place, (name, title, unit, values) in enumerate(
            zip(recordings.names, recordings.titles, recordings.units, recordings.values.T, strict=True)
        )
    )  # fmt: skip
    usual = _usual_step(recordings)
    return Inspection(
        file=file,
        recordings=recordings,
        states=states,
        samples=_span(counts),
        durations=_span(durations),
        steps=_span(gaps) if len(gaps) else None,
        pairs=int((gaps <= LONGEST_STEP * usual * (1 + 1e-6)).sum()),
        notes=(*recordings.notes, *remarks(recordings)),
        prospects=_prospects(recordings, states),
    )


def _span(values: np.ndarray) -> Span:
    return Span(float(values.min()), float(np.median(values)), float(values.max()))


def _prospects(recordings: Recordings, states: tuple[StateFacts, ...]) -> tuple[str, ...]:
    said = []
    noises = [state.noise for state in states if state.noise is not None]
    forced = any(noise.process > 0 for noise in noises)
    if forced:
        said.append(
            "Random forces are seen: their strength is estimated, and how long each stable state lasts."
        )
    elif noises and len(recordings.labels) == 1:
        said.append(f"{SINGLE[0].upper()}{SINGLE[1:]}: {SINGLE_REMEDY}.")
    elif noises:
        said.append(
            "No random forces are seen: you get the wells and the barriers between them, but not how long"
            " each stable state lasts, since that depends on the noise."
        )
    else:
        said.append(
            "Whether there is noise is not known beforehand: too few neighbouring samples are evenly spaced."
        )
    known = {state.unit for state in states if state.unit}
    if not forced and len(known) > 1:
        said.append(
            f"The states have different units ({', '.join(sorted(known))}): say in the study how strong the"
            " noise is in each, recordings.diffusion."
        )
    step = _usual_step(recordings)
    noisy = [state.title for state in states if _sensor_dominates(state, step)]
    if noisy:
        said.append(
            f"The noise of the sensor is a large part of what happens to {' and '.join(noisy)} from sample to"
            " sample: formulas will be shown, but not certified. Average before you sample."
        )
    if recordings.time_unit is None:
        said.append(
            "The file does not say in which unit the time is: write it into the heading, such as t [s]."
        )
    return tuple(said)


def _sensor_dominates(state: StateFacts, step: float) -> bool:
    """Whether noise of the sensor, other than rounding, is more than an identification takes."""
    if state.noise is None:
        return False
    variance = state.noise.sensor**2
    rounded = state.quantum is not None and state.noise.sensor <= 1.5 * rounding_error(state.quantum)
    return not rounded and variance > HARMFUL * (state.noise.process * step + 2 * variance)


def _usual_step(recordings: Recordings) -> float:
    gaps = np.diff(recordings.t)[np.diff(recordings.recording) == 0]
    return float(np.median(gaps)) if len(gaps) else 0.0


def _text(found: Inspection) -> str:
    recordings = found.recordings
    unit = f" {recordings.time_unit}" if recordings.time_unit else ""
    count = len(recordings.labels)
    lines = [
        found.file,
        f"  {count:,} recording{'s' if count > 1 else ''} of {_range(found.samples)} samples,"
        f" {_range(found.durations)}{unit} long",
    ]
    if found.steps is not None:
        lines.append(
            f"  time step {_range(found.steps)}{unit}; {found.pairs:,} pairs of neighbouring samples"
        )
    lines += [f"  {_state_text(state, recordings.time_unit)}" for state in found.states]
    lines += [f"  Note: {note[0].upper()}{note[1:]}." for note in found.notes]
    lines += [f"  {sentence}" for sentence in found.prospects]
    return "\n".join(lines)


def _range(span: Span) -> str:
    low, usual, high = (_plain(value) for value in (span.shortest, span.usual, span.longest))
    return low if low == high else f"{low} to {high} (usually {usual})"


def _plain(value: float) -> str:
    return f"{value:,.0f}" if value >= 1000 else f"{value:.4g}"


def _state_text(state: StateFacts, time_unit: str | None) -> str:
    unit = f" {state.unit}" if state.unit else ""
    named = state.name if state.name == state.title else f"{state.title} (in formulas: {state.name})"
    said = [f"{named}: {state.lowest:.4g} to {state.highest:.4g}{unit}"]
    if state.quantum is not None and rounding_error(state.quantum) > SEEN * (state.highest - state.lowest):
        decimals = decimals_of(state.quantum)
        how = f"to {decimals} decimals" if decimals else f"in steps of {state.quantum:.3g}{unit}"
        said.append(f"written {how}, an error of {rounding_error(state.quantum):.1g}{unit}")
    if state.noise is not None and state.noise.process > 0:
        per = f" ({state.unit})²/{time_unit}" if state.unit and time_unit else ""
        said.append(f"random forces of about {state.noise.process:.2g}{per}")
    if state.noise is not None and state.noise.sensor > 0:
        said.append(f"sensor noise of about {state.noise.sensor:.2g}{unit}")
    return "; ".join(said)
