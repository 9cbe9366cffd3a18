"""What is known of each measured column, as numbers and in words?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.data.noise_floor import NoiseFloor, noise_floors
from siq.data.quantum import FEWEST_VALUES, decimals_of, quantum, rounding_error
from siq.data.recordings import Recordings

HARMFUL = 0.02  # of the variance of a step, shared by neighbours: `siq.identify.residuals` takes no more
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
