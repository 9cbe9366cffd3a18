"""Inspection of recordings: what is in them and what can be learned from them, before anything runs.

An `Inspection` holds facts: samples, steps, ranges and noise of each state, the Markov lag, how much of the
range was visited, and the two states that the record supports by itself. What they amount to is told by
remarks, whose sentences stand in ``siq/report/templates/remarks/data.yaml``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from siq.data.correlation import (
    FEWEST_VALUES,
    MIN_REPETITIONS,
    MarkovLag,
    NoiseFloor,
    decimals_of,
    markov_lag,
    noise_floors,
    resolution_step,
    rounding_error,
)
from siq.data.preparation import ANGLES, turns_back, unusual, without_faults
from siq.data.recordings import SINGLE_RECORDING_REMEDY, Recordings
from siq.data.states import RecordStates, switching
from siq.numerics.randomness import positive
from siq.remarks import Remark, sentence

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

CELLS = 20  # along each state, between the quantiles: about what a formula of degree five can tell apart
OUTLIER_SHARE = 0.001  # of the samples on either side: a few outliers would make the rest one cell
VISITED_SAMPLES = 10  # in a cell, from which something is known of it: a mean to a third of its spread
SPARSE_COVERAGE = 0.3  # of the cells; less is a thin line, on which a formula knows nothing beside it
SENSOR_SHARE = 0.02  # of the variance of a step, shared by neighbours: identification takes no more
VALUES_SAMPLED = 2000  # looked at, for how many of them differ
NEGLIGIBLE_ROUNDING = 1e-6  # of the range of a state
COARSE_STEP = 0.5  # relaxation times: over a longer step most of what f does is forgotten


class _Span(NamedTuple):
    """The least, the usual (median) and the greatest of something."""

    least: float
    usual: float
    greatest: float


@dataclass(frozen=True)
class _StateFacts:
    """What is known of one measured column."""

    name: str  #: in formulas
    title: str  #: what the file calls it
    unit: str | None  #: None where the file does not say
    lowest: float  #: of its values
    highest: float  #: of its values
    quantum: float | None  #: the step to which it was rounded when it was written; None for none
    noise: NoiseFloor | None  #: a first look; None where neighbouring samples are too few or uneven
    values: int | None = None  #: how many differ, where so few that it is rather a label than a state


@dataclass(frozen=True)
class Inspection:
    """A file of recordings at a glance."""

    file: str  #: as it was named
    recordings: Recordings  #: what was read
    states: tuple[_StateFacts, ...]  #: the measured columns
    samples: _Span  #: of a recording: the fewest, the usual number, the most
    durations: _Span  #: of a recording, in the unit of time
    steps: _Span | None  #: between neighbouring samples, in the unit of time; None where no recording has two
    pairs: int  #: number of neighbouring samples that are close enough to learn from
    gaps: int  #: number of neighbouring samples that are further apart than that
    memory: MarkovLag  #: from which lag on they are Markovian, and what makes them remember until then
    coverage: float  #: share of the cells of a grid over the range of the first two states that was visited
    switching: RecordStates | None  #: two states with the hops between them; None of recordings without noise

    @property
    def notes(self) -> tuple[str, ...]:
        """What was assumed or repaired in reading, and what is unusual, in words."""
        return tuple(map(sentence, (*self.recordings.remarks, *unusual(self.recordings))))

    def remarks(self) -> list[Remark]:
        """What was read, what it shows, and what can be learned from it."""
        notes = [Remark("data.note", {"text": note}) for note in self.notes]
        return [*self._contents(), *self._findings(), *notes, *self._prospects()]

    def text(self) -> str:
        """As lines of plain text, for a terminal."""
        return "\n".join([self.file, *(f"  {line}" for line in self.lines())])

    def lines(self) -> list[str]:
        """`remarks` as sentences."""
        return [sentence(remark) for remark in self.remarks()]

    def plot(self) -> Figure:
        """Three panels: the states in time, how often each is visited, and what neighbours remember."""
        from siq.report.plots.recordings import plot_inspection

        return plot_inspection(self)

    def _contents(self) -> list[Remark]:
        time_unit = self.recordings.time_unit
        values: dict[str, Any] = {
            "recordings": len(self.recordings.labels), "samples": self.samples, "durations": self.durations,
            "steps": self.steps, "pairs": self.pairs, "gaps": self.gaps, "unit": time_unit,
        }  # fmt: skip
        found = [Remark("data.recordings", values)]
        if self.steps is not None:
            found.append(Remark("data.steps", values))
        # Where increments are correlated the two noises of a first look are neither.
        told = not self.memory.remembers and self.memory.kind != "hidden"
        for state in self.states:
            noise = (state.noise if told else None) or NoiseFloor(0.0, 0.0, 0.0, 0.0)
            error = rounding_error(state.quantum or 0.0)
            step = state.quantum if error > NEGLIGIBLE_ROUNDING * (state.highest - state.lowest) else None
            values = {
                **vars(state), **vars(noise), "time_unit": time_unit, "rounding_step": step,
                "rounding_error": error, "decimals": None if step is None else decimals_of(step),
            }  # fmt: skip
            found.append(Remark("data.state", values))
        return found

    def _findings(self) -> list[Remark]:
        memory, titles, unit = self.memory, self.recordings.titles, self.recordings.time_unit
        values: dict[str, Any] = {
            "kind": memory.kind, "lag": memory.lag, "time": memory.time, "memory": memory.memory,
            "correlation": 0.0, "state": "", "unit": unit,
        }  # fmt: skip
        if len(memory.correlations):
            row, place = np.unravel_index(np.argmax(np.abs(memory.correlations)), memory.correlations.shape)
            values |= {"correlation": float(memory.correlations[row, place]), "state": titles[int(place)]}
        found = [Remark("data.memory", values)]
        if np.isfinite(memory.relaxation) and memory.kind not in ("unknown", "hidden"):
            values = {"time": memory.relaxation, "steps": memory.relaxation / memory.step, "unit": unit}
            found.append(Remark("data.relaxation", values))
        if (hops := self.switching) is not None:
            found.append(hops.remark() if hops.supported else Remark("data.one_state"))
            if hops.limit is not None:
                found.append(hops.limit)
            fewest = min(hops.counts, key=lambda count: count.visits)
            if hops.supported and fewest.visits:
                found.append(Remark("data.few_transitions", {"transitions": fewest.visits}))
            taken = any(one.code == "data.drift_taken_off" for one in self.recordings.remarks)
            values = {"state": hops.state, "range": float(np.ptp(hops.background)), "taken": taken}
            drifts = bool(hops.background.any())
            found.append(Remark("data.drift", values) if drifts else Remark("data.stationary", values))
        sparse = self.coverage < SPARSE_COVERAGE and len(titles) > 1
        values = {"share": self.coverage, "states": list(titles[:2]), "sparse": sparse}
        return [*found, Remark("data.coverage", values)]

    def _prospects(self) -> list[Remark]:
        recordings, memory = self.recordings, self.memory
        noises = [state.noise for state in self.states if state.noise is not None]
        # Correlated forces fill the windows of the first look as a smooth motion does.
        forced = memory.remembers or any(noise.process > 0 for noise in noises)
        forced = forced or (self.switching is not None and self.switching.supported)
        if forced:
            found = [Remark("data.noise_seen")]
        elif noises and turns_back(recordings):
            found = [Remark("data.turns_back")]
        elif noises and len(recordings.labels) == 1:
            found = [Remark("data.single_recording", {"remedy": SINGLE_RECORDING_REMEDY})]
        else:
            found = [Remark("data.no_noise") if noises else Remark("data.noise_unknown")]
        units = sorted({unit for unit in recordings.units if unit})
        if not forced and len(units) > 1:
            found.append(Remark("data.different_units", {"units": units}))
        step = 0.0 if self.steps is None else self.steps.usual
        noisy = []  # with more measurement noise, other than rounding, than an identification takes
        for state in self.states:
            if state.noise is not None:
                variance, rounding = state.noise.sensor**2, rounding_error(state.quantum or 0.0)
                large = variance > SENSOR_SHARE * (state.noise.process * step + 2 * variance)
                noisy += [state.title] if large and state.noise.sensor > 1.5 * rounding else []
        if noisy and not memory.remembers:
            found.append(Remark("data.sensor_noise", {"states": noisy}))
        if memory.remembers:
            found.append(Remark("data.instruments", {"lag": memory.lag}))
        if memory.kind == "hidden":
            found.append(Remark("data.hidden_state"))
        if np.isfinite(memory.relaxation) and memory.step > COARSE_STEP * memory.relaxation:
            values = {"step": memory.step, "relaxation": memory.relaxation, "unit": recordings.time_unit}
            found.append(Remark("data.coarse_step", values))
        return found if recordings.time_unit else [*found, Remark("data.no_time_unit")]


def inspect(
    source: str | Path | Recordings | pd.DataFrame, *, angles: Mapping[str, Sequence[float]] | None = None,
) -> Inspection:  # fmt: skip
    """Look at recordings, and say what is in them and what can be learned: seconds, before anything runs.

    Parameters
    ----------
    source
        A file, a folder of files, recordings, or a table with the columns ``t``, the measured ones and, of
        several recordings, ``recording``.
    angles
        Both ends of a period of each state that is an angle, which counts its turns.

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
    recordings = without_faults(Recordings.of(source))
    named = "the recordings" if isinstance(source, Recordings) else "the table"
    counts = np.bincount(recordings.recording)
    first = np.cumsum(counts) - counts
    gaps = np.diff(recordings.t)[np.diff(recordings.recording) == 0]
    steps = _span(gaps) if len(gaps) else None
    near = int((gaps <= recordings.longest_step * (1 + 1e-6)).sum())
    states = []
    floors = noise_floors(recordings) or (None,) * len(recordings.names)
    columns = zip(
        recordings.names, recordings.titles, recordings.units, recordings.values.T, floors, strict=True
    )
    for name, title, unit, x, noise in columns:
        different = len(np.unique(x[:: max(len(x) // VALUES_SAMPLED, 1)]))
        label = different if different < FEWEST_VALUES <= len(x) / MIN_REPETITIONS else None
        low, high = float(x.min()), float(x.max())
        states.append(_StateFacts(name, title, unit, low, high, resolution_step(x), noise, label))
    memory = markov_lag(recordings, angles=angles)
    turns = any(one.code in ANGLES for one in unusual(recordings))  # it is where it was, turned
    # Of the cells over the range of one state or two, those that were visited.
    some = recordings.values[:, :2]
    low, high = np.quantile(some, [OUTLIER_SHARE, 1 - OUTLIER_SHARE], axis=0)
    place = np.floor((some - low) / positive(high - low) * CELLS).astype(int)
    visits, _ = np.histogramdd(place, bins=[np.arange(CELLS + 1) - 0.5] * place.shape[1])
    return Inspection(
        file=str(source) if isinstance(source, str | Path) else named, recordings=recordings,
        states=tuple(states), samples=_span(counts),
        durations=_span(recordings.t[first + counts - 1] - recordings.t[first]), steps=steps, pairs=near,
        gaps=len(gaps) - near, memory=memory, coverage=float((visits >= VISITED_SAMPLES).mean()),
        switching=switching(recordings) if memory.may_hop and not turns else None,
    )  # fmt: skip


def _span(values: np.ndarray | Sequence[float]) -> _Span:
    return _Span(float(np.min(values)), float(np.median(values)), float(np.max(values)))
