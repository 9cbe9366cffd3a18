"""Inspection of recordings: what they contain and what can be learned from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from siq.data.columns import FEWEST_VALUES, decimals_of, quantum, rounding_error
from siq.data.correlation import MarkovLag, NoiseFloor, markov_lag, noise_floors
from siq.data.recordings import (
    LONGEST_STEP,
    Recordings,
    SnapshotPairs,
    read_recordings,
    recordings_of,
    snapshot_pairs,
)
from siq.data.two_states import DwellCount, RecordStates, Switching, states_of_record, switching
from siq.errors import InputError
from siq.numerics.text import range_text as range_text_measured_text
from siq.numerics.text import value_text

BINS = 20  # along each state, between the quantiles: about what a formula of degree five can tell apart
OUTER = 0.001  # of the samples on either side: a few outliers would make the rest one bin
VISITED = 10  # samples in a cell, from which something is known of it: a mean to a third of its spread


@dataclass(frozen=True)
class Coverage:
    """The visited part of the range of the states.

    Attributes
    ----------
    share
        Of the cells of a grid over the range of the first two states (of one, where there is one), those that
        were visited.
    cells
        Number of cells.
    starts
        Number of different recordings: of relaxations each begins somewhere else.
    """

    share: float
    cells: int
    starts: int


def coverage_of(recordings: Recordings) -> Coverage:
    """How much of the range of the first states was visited."""
    values = recordings.values[:, :2]
    low, high = np.quantile(values, [OUTER, 1 - OUTER], axis=0)
    width = np.where(high > low, high - low, 1.0)
    place = np.floor((values - low) / width * BINS).astype(int)
    inside = ((place >= 0) & (place < BINS)).all(axis=1)
    d = values.shape[1]
    flat = np.ravel_multi_index(tuple(place[inside].T), (BINS,) * d)
    counts = np.bincount(flat, minlength=BINS**d)
    return Coverage(float((counts >= VISITED).mean()), BINS**d, len(recordings.labels))


HARMFUL = 0.02  # of the variance of a step, shared by neighbours: `siq.inference.residuals` takes no more
SAMPLE = 2000  # values looked at, for how many of them differ
REPEATED = 4  # times, at least, that values of a label occur
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
    values
        How many different values it has, where these are so few that it is rather a label than a state.
    """

    name: str
    title: str
    unit: str | None
    lowest: float
    highest: float
    quantum: float | None
    noise: NoiseFloor | None
    values: int | None = None


def states_of(recordings: Recordings) -> tuple[StateFacts, ...]:
    """The measured columns of recordings."""
    floors = noise_floors(recordings)
    return tuple(
        StateFacts(
            name, title, unit, float(values.min()), float(values.max()), quantum(values),
            None if floors is None else floors[place], _few_values(values),
        )
        for place, (name, title, unit, values) in enumerate(
            zip(recordings.names, recordings.titles, recordings.units, recordings.values.T, strict=True)
        )
    )  # fmt: skip


def span_of(values: np.ndarray) -> Span:
    """The shortest, the usual and the longest."""
    return Span(float(values.min()), float(np.median(values)), float(values.max()))


def sensor_dominates(state: StateFacts, step: float) -> bool:
    """Whether noise of the sensor, other than rounding, is more than an identification takes."""
    if state.noise is None:
        return False
    variance = state.noise.sensor**2
    rounded = state.quantum is not None and state.noise.sensor <= 1.5 * rounding_error(state.quantum)
    return not rounded and variance > HARMFUL * (state.noise.process * step + 2 * variance)


def _few_values(values: np.ndarray) -> int | None:
    """The number of different values, where they are few and occur again and again."""
    different = len(np.unique(values[:: max(len(values) // SAMPLE, 1)]))
    return different if different < FEWEST_VALUES <= len(values) / REPEATED else None


def range_text(span: Span) -> str:
    """As text: one number where all are alike."""
    low, usual, high = (_plain(value) for value in (span.shortest, span.usual, span.longest))
    return low if low == high else f"{low} to {high} (usually {usual})"


def _plain(value: float) -> str:
    return f"{value:,.0f}" if value >= 1000 else f"{value:.4g}"


def state_text(state: StateFacts, time_unit: str | None, *, noise: bool) -> str:
    """What is known of a column, in words; of its noise where `noise` says that the first look is right."""
    unit = f" {state.unit}" if state.unit else ""
    named = state.name if state.name == state.title else f"{state.title} (in formulas: {state.name})"
    said = [f"{named}: {state.lowest:.4g} to {state.highest:.4g}{unit}"]
    if state.values is not None:
        said.append(f"only {state.values} different values, as a label has: leave it out of the states")
    if state.quantum is not None and rounding_error(state.quantum) > SEEN * (state.highest - state.lowest):
        decimals = decimals_of(state.quantum)
        how = f"to {decimals} decimals" if decimals else f"in steps of {state.quantum:.3g}{unit}"
        said.append(f"written {how}, an error of {rounding_error(state.quantum):.1g}{unit}")
    floor = state.noise if noise else None
    if floor is not None and floor.process > 0:
        per = f" ({state.unit})²/{time_unit}" if state.unit and time_unit else ""
        said.append(f"random forces of about {floor.process:.2g} ± {floor.process_error:.1g}{per}")
    if floor is not None and floor.sensor > 0:
        said.append(f"sensor noise of about {floor.sensor:.2g} ± {floor.sensor_error:.1g}{unit}")
    return "; ".join(said)


TURNS = {2 * np.pi: "2π", 360.0: "360"}  # of an angle, in radians and in degrees
NEARLY = 0.9  # of a turn: a jump by so much, in a column that stays within one, is no motion

SINGLE = (
    "there is one recording, and it shows no random forces: it leads into one stable state and tells nothing"
    " of others, nor of barriers"
)
SINGLE_REMEDY = (
    "record how the system settles from many starting points, or one long record in which noise makes it hop;"
    " if these are positions of something that has inertia, set 'identification.hidden_velocities'"
)


def checked_for_learning(
    recordings: Recordings, *, file: str, chosen: bool, hidden_velocities: bool = False
) -> Recordings:
    """Refuse what nothing can be learned from; leave out columns that never change.

    Parameters
    ----------
    recordings
        As read.
    file
        For messages.
    chosen
        Whether somebody named the states: then none is left out.
    hidden_velocities
        Whether they are positions: these are smooth, however strong the random forces on velocities are.

    Raises
    ------
    InputError
        For a single recording without noise, and for a state that never changes.
    """
    recordings = _moving(recordings, file=file, chosen=chosen)
    if len(recordings.labels) == 1 and not hidden_velocities:
        floors = noise_floors(recordings)
        if floors is not None and all(floor.process == 0 for floor in floors):
            raise InputError(file, "", SINGLE, SINGLE_REMEDY)
    return replace(recordings, notes=(*recordings.notes, *remarks(recordings)))


def _moving(recordings: Recordings, *, file: str, chosen: bool) -> Recordings:
    still = np.ptp(recordings.values, axis=0) == 0
    if not still.any():
        return recordings
    title = recordings.titles[int(np.argmax(still))]
    value = f"{recordings.values[0, int(np.argmax(still))]:g}"
    if still.all() or chosen:
        raise InputError(
            file, f"column {title}", f"it is {value} in every row, and what never changes is no state",
            "leave it out of the states" if chosen else "record how the system moves",
        )  # fmt: skip
    kept = np.flatnonzero(~still)
    notes = [
        f"the column '{name}' is {recordings.values[0, place]:g} in every row and was left out"
        for place, name in enumerate(recordings.titles)
        if still[place]
    ]
    return replace(
        recordings,
        names=tuple(recordings.names[place] for place in kept),
        units=tuple(recordings.units[place] for place in kept),
        headings=tuple(recordings.headings[place] for place in kept) if recordings.headings else (),
        values=np.ascontiguousarray(recordings.values[:, kept]),
        notes=(*recordings.notes, *notes),
    )


def remarks(recordings: Recordings) -> list[str]:
    """What is unusual, and may be wrong."""
    said = []
    single = int((np.bincount(recordings.recording) == 1).sum())
    if single:
        said.append(
            "one recording has a single sample, which tells nothing"
            if single == 1
            else f"{single} recordings have a single sample each, which tells nothing"
        )
    inside = recordings.recording[1:] == recordings.recording[:-1]
    for title, values in zip(recordings.titles, recordings.values.T, strict=True):
        jumps = np.abs(np.diff(values)[inside])
        for turn, text in TURNS.items():
            count = int((jumps > NEARLY * turn).sum())
            between = ((jumps > 0.5 * turn) & (jumps < NEARLY * turn)).any()
            if count and not between and np.ptp(values) <= turn * (1 + 1e-6):
                times = "once" if count == 1 else f"{count} times"
                said.append(
                    f"'{title}' jumps by {text} {times}, as an angle does that wraps around: unwrap it first,"
                    " or record its sine and cosine"
                )
    return said


def read_pairs(
    path: str | Path,
    *,
    states: Sequence[str] | None,
    units: Mapping[str, str] | None,
    pair_step: float | None,
    hidden_velocities: bool = False,
) -> tuple[Recordings, SnapshotPairs]:
    """Read recordings that something is to be learned from, and their pairs.

    Parameters
    ----------
    path, states, units
        See `read_recordings`.
    pair_step
        See `snapshot_pairs`.
    hidden_velocities
        See `checked_for_learning`.

    Raises
    ------
    InputError
        As `read_recordings` and `checked_for_learning` do, and when no two samples are
        close enough to be a pair.
    """
    recordings = read_recordings(path, columns=states, units=units)
    recordings = checked_for_learning(
        recordings, file=str(path), chosen=states is not None, hidden_velocities=hidden_velocities
    )
    try:
        pairs = snapshot_pairs(recordings, pair_step=pair_step)
    except ValueError as error:
        raise InputError(path, "", str(error), "raise recordings.pair_step in the study") from None
    without = len(recordings.labels) - len(np.unique(pairs.recording))
    single = int((np.bincount(recordings.recording) == 1).sum())
    if without > single:
        note = (
            f"{without - single} of {len(recordings.labels)} recordings have longer steps than the others and"
            " give no pairs; recordings.pair_step in the study says how long a step may be"
        )
        recordings = replace(recordings, notes=(*recordings.notes, note))
    return recordings, pairs


COARSE = 0.5  # relaxation times: over a longer step most of what f does is forgotten
SPARSE = 0.3  # of the cells of the range; less is a thin line, on which a formula knows nothing beside it


def memory_sentences(memory: MarkovLag, *, titles: Sequence[str], time_unit: str | None) -> list[str]:
    """How long the recordings remember, and why."""
    unit = f" {time_unit}" if time_unit else ""
    steps = "step" if memory.lag == 1 else "steps"
    lag = f"{memory.lag} {steps} ({memory.time:.2g}{unit})" if memory.lag else ""
    strongest = ""
    if len(memory.correlations):
        row, place = np.unravel_index(np.argmax(np.abs(memory.correlations)), memory.correlations.shape)
        strongest = f" ({memory.correlations[row, place]:+.2f} in {titles[int(place)]})"
    said = {
        "none": "No noise: what neighbouring samples leave of a smooth motion is that of rounding.",
        "white": "Markovian from the first step on: increments know nothing of each other, as under random"
        " forces without a memory and a sensor without noise.",
        "sensor": f"Neighbouring increments are anticorrelated{strongest}, those further apart are not: each"
        " sample has an error of the sensor of its own.",
        "blur": f"Neighbouring increments are correlated{strongest}, and no longer beyond an exposure of"
        f" {memory.memory:.2g}{unit}: each sample is a mean. Markovian from {lag} on.",
        "coloured": f"Increments are correlated{strongest} and forget it within {memory.memory:.2g}{unit}:"
        f" the random forces have a memory, or the sensor is slow. Markovian from {lag} on.",
        "either": f"Neighbouring increments are correlated{strongest}: samples are means over an exposure, or"
        f" the random forces have a memory. Markovian from {lag} on.",
        "memory": f"Increments are correlated over several steps{strongest}, neither as by an exposure nor as"
        " by forces that simply forget: something oscillates, or a state is not recorded. Markovian from"
        f" {lag} on.",
        "hidden": f"Increments are correlated{strongest}, for longer than the state takes to relax: a state"
        " is not recorded, such as a velocity, or the forces have a long memory.",
        "unknown": "Whether the recordings remember is not known: too few samples are evenly spaced.",
    }
    return [said[memory.kind]]


def transition_sentences(
    found: Switching | None, *, titles: Sequence[str], time_unit: str | None
) -> list[str]:
    """How many states the recordings themselves support, how often they hop, and what that allows."""
    if found is None:
        return []
    title, unit = titles[found.state], f" {time_unit}" if time_unit else ""
    said = []
    if found.supported:
        low, high = found.levels
        means = " and ".join(_dwell(count, unit) for count in found.counts)
        said.append(
            f"Two states are supported, at {low:.3g} and {high:.3g} of {title}, with {found.hops} transitions"
            f" seen: they last {means} in the mean."
        )
        fewest = min(count.visits for count in found.counts)
        if fewest:
            said.append(
                f"From {fewest} transitions a mean dwell time is known to {100 / np.sqrt(fewest):.0f} % at"
                " best; more needs longer recordings."
            )
    else:
        said.append("By themselves the recordings do not support more than one state.")
    if found.background.half_periods:
        said.append(
            f"The background of {title} drifts slowly, over a range of {found.background.range:.2g}: a part"
            " of its histogram is due to that."
        )
    else:
        said.append("Stationary: no slow drift of the background is seen.")
    return said


def _dwell(count: DwellCount, unit: str) -> str:
    low, high = count.limits
    if not count.visits:
        return f"more than {value_text(low, digits=2)}{unit}"
    return f"{value_text(count.mean, digits=3)}{unit} ({range_text_measured_text(low, high)})"


def noise_prospects(recordings: Recordings, *, forced: bool, known: bool, noisy: Sequence[str]) -> list[str]:
    """What the noise allows.

    Parameters
    ----------
    recordings
        What was read.
    forced
        Whether random forces are seen.
    known
        Whether anything is known of the noise.
    noisy
        The states, by their titles, of which noise of the sensor is a large part.
    """
    said = []
    if forced:
        said.append(
            "Random forces are seen: their strength is estimated, and how long each stable state lasts."
        )
    elif known and len(recordings.labels) == 1:
        said.append(f"{SINGLE[0].upper()}{SINGLE[1:]}: {SINGLE_REMEDY}.")
    elif known:
        said.append(
            "No random forces are seen: you get the wells and the barriers between them, but not how long"
            " each stable state lasts, since that depends on the noise."
        )
    else:
        said.append(
            "Whether there is noise is not known beforehand: too few neighbouring samples are evenly spaced."
        )
    units = {unit for unit in recordings.units if unit}
    if not forced and len(units) > 1:
        said.append(
            f"The states have different units ({', '.join(sorted(units))}): say in the study how strong the"
            " noise is in each, recordings.diffusion."
        )
    if noisy:
        said.append(
            f"The noise of the sensor is a large part of what happens to {' and '.join(noisy)} from sample to"
            " sample: it is estimated beside the formulas, whose errors are larger for it."
        )
    return said


def memory_prospects(memory: MarkovLag, *, time_unit: str | None) -> list[str]:
    """What memory and sampling allow."""
    unit = f" {time_unit}" if time_unit else ""
    said = []
    if memory.remembers:
        said.append(
            f"Formulas are sought all the same: each increment is seen from a sample {memory.lag} steps"
            " earlier, which knows nothing of what is remembered."
        )
    if memory.kind == "hidden":
        said.append(
            "Formulas of what was recorded will be refused: record the missing state (if it is a velocity,"
            " set 'identification.hidden_velocities'), or record longer, so"
            " that the memory can be told from the motion."
        )
    if np.isfinite(memory.relaxation) and memory.step > COARSE * memory.relaxation:
        said.append(
            f"The step of {memory.step:.2g}{unit} is long beside the {memory.relaxation:.2g}{unit} in which"
            " the state relaxes: f and the noise will be uncertain. Record more often."
        )
    return said


def coverage_sentence(coverage: Coverage, *, titles: Sequence[str]) -> str:
    """How much of the range was visited."""
    share = f"{100 * coverage.share:.0f} %"
    if len(titles) == 1:
        return f"{share} of the range of {titles[0]} was visited ten times or more."
    said = f"{share} of the ranges of {titles[0]} and {titles[1]} together was visited ten times or more."
    if coverage.share < SPARSE:
        said += " Formulas hold there, and not beside it."
    return said


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
        from siq.report.plots.recordings import plot_inspection

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
