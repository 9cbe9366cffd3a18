"""What can be learned from recordings and what not, in sentences, before anything is identified."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from siq.data.coverage import Coverage
from siq.data.learnable import SINGLE, SINGLE_REMEDY
from siq.data.markov_lag import MarkovLag
from siq.data.recordings import Recordings
from siq.data.transitions import Switching
from siq.data.visits import DwellCount
from siq.numerics.measured_text import range_text, value_text

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
    return f"{value_text(count.mean, digits=3)}{unit} ({range_text(low, high)})"


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
