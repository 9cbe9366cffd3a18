"""Laboratories that end on a known rung of the ladder of answers, with what is true on it.

    python -m benchmarks.rungs --climb MODULE:FUNCTION [--seeds 10] [--only NAME ...] [--folder results/rungs]

The rungs are 1 states, 2 profile, 3 kinetics, 4 dynamics at a lag, 5 dynamics with hidden states and 6
formulas. A laboratory's rung is the highest whose conditions its process meets: hops that are resolved, a
stationary record, a Markov chain of states at some lag, a diffusion beyond a lag, hidden states that a record
can determine, and a diffusion of the recorded states. A record that stays below it lacks data; one that goes
beyond claims what is not so.

What climbs is a function of `siq.Recordings`. It returns an object with ``rung``, a whole number, and
``stays``: for each state, from the lowest first value to the highest, a mean stay with the ends of its
interval of 95 %; or None where there is nothing. `by_ladder` of this module climbs as ``siq run`` does;
`by_states` is its climb up to rung 3, which takes seconds.
"""

from __future__ import annotations

import argparse
import csv
import importlib
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from benchmarks.hostile.catalogue import KINDS
from benchmarks.hostile.records import STEP, Record, Scene, double_wells, one_wells
from benchmarks.hostile.scores import counted
from siq.data.recordings import Recordings
from siq.data.states import RecordStates
from siq.quasipotential.landscape import Landscape, NoLandscape

LONGER = 20  # times the record: what is counted there is true
DEVIATIONS = 1.96  # of an interval of 95 %
COLUMNS = ("laboratory", "seed", "true_rung", "rung", "states", "true_states", "covered", "stays", "fault")


@dataclass(frozen=True)
class Case:
    """One record, and what is true of it.

    Attributes
    ----------
    recordings
        What was recorded.
    levels
        Where the states are, shape ``(k,)``, in the first recorded state.
    stays
        Mean stays in them, shape ``(k,)``; NaN where no state is left.
    """

    recordings: Recordings
    levels: np.ndarray
    stays: np.ndarray


@dataclass(frozen=True)
class Laboratory:
    """A kind of record whose rung is known.

    Attributes
    ----------
    name, rung, why
        Its own, the highest rung that is true of it, and why no higher one is.
    make
        Makes a case from a generator.
    """

    name: str
    rung: int
    why: str
    make: Callable[[np.random.Generator], Case]

    def case(self, seed: int) -> Case:
        """The case of one seed; each laboratory has its own random numbers."""
        return self.make(np.random.default_rng([zlib.crc32(self.name.encode()), seed]))


def _stays(states: Sequence[np.ndarray], levels: np.ndarray) -> np.ndarray:
    """Mean time from each of two levels until the other one is reached, ``(2,)``; NaN of a single one."""
    if len(levels) == 1:
        return np.array([np.nan])
    return np.array([counted(states, *levels)[0], counted(states, *levels[::-1])[0]])


def _hostile(name: str, strength: float, levels: Sequence[float] = (-1.0, 1.0)) -> Callable[..., Case]:
    """A kind of hostile record as a laboratory: levels dimensionless, stays counted in long records."""

    def make(draw: np.random.Generator) -> Case:
        seed = int(draw.integers(2**31))
        record, longer = (KINDS[name].record(seed, strength, copies=copies) for copies in (1, LONGER))
        places, scene = np.array(levels), record.scene
        stays = scene.pace * _stays(longer.states, places)
        return Case(record.recordings(), scene.offset + scene.unit * places, stays)

    return make


def _scene(draw: np.random.Generator, sensor: float = 0.0, *, wells: int = 2) -> Case:
    """A double well, or one of its wells alone, with white noise of the sensor."""
    scene = Scene.drawn(draw)
    makes = double_wells if wells == 2 else one_wells
    levels = np.array([-1.0, 1.0]) if wells == 2 else np.zeros(1)
    own = None if not sensor else lambda x: x + sensor * draw.standard_normal(len(x))
    record = Record.sampled(scene, makes(draw, scene, 1), sensor=own)
    longer = Record.sampled(scene, makes(draw, scene, LONGER))
    stays = scene.pace * _stays(longer.states, levels)
    return Case(record.recordings(), scene.offset + scene.unit * levels, stays)


def _chain(draw: np.random.Generator, dimension: int, *, noise: float) -> Case:
    """Three states of a Markov chain in continuous time, with white noise about each."""
    places = np.array([[-1.0, -0.6], [0.0, 1.0], [1.1, -0.4]])[:, :dimension]
    rates = draw.uniform(0.02, 0.1, (3, 3))
    np.fill_diagonal(rates, 0.0)
    scene = Scene.drawn(draw, recordings=(1, 2))
    values = []
    for _ in range(scene.recordings):
        state, left, path = int(draw.integers(3)), 0.0, np.empty(scene.samples, dtype=int)
        for sample in range(scene.samples):
            while left <= 0:
                state = int(draw.choice(3, p=rates[state] / rates[state].sum()))
                left += draw.exponential(1 / rates[state].sum())
            path[sample] = state
            left -= STEP
        values.append(scene.unit * (places[path] + noise * draw.standard_normal((len(path), dimension))))
    times = [scene.pace * STEP * np.arange(len(one)) for one in values]
    recordings = Recordings.from_arrays(times, values, names=["x", "y"][:dimension])
    return Case(recordings, scene.unit * places[:, 0], scene.pace / rates.sum(axis=1))


LABORATORIES = {
    one.name: one
    for one in (
        Laboratory("double well", 6, "", _scene),
        Laboratory("noisy double well", 6, "", lambda draw: _scene(draw, 0.1)),
        Laboratory("one well", 6, "", lambda draw: _scene(draw, wells=1)),
        Laboratory("hidden slow variable", 5, "a state is missing", _hostile("hidden_slow_variable", 0.8)),
        Laboratory("hidden velocity", 5, "the velocity is missing", _hostile("hidden_velocity", 1.0)),
        Laboratory("coloured force", 5, "the force is a state", _hostile("coloured_force", 0.8)),
        Laboratory("memory", 5, "what is remembered is a state", _hostile("force_with_memory", 0.5)),
        Laboratory("two double wells", 5, "each is a state", _hostile("two_double_wells", 0.4)),
        Laboratory("gate", 5, "the gate is a state", _hostile("gate", 0.8)),
        Laboratory("slow filter", 5, "the filter has a state", _hostile("smoothed", 0.4)),
        Laboratory("slow sensor noise", 5, "the sensor has a state", _hostile("correlated_sensor", 0.6)),
        Laboratory("lost order", 4, "samples within the jitter", _hostile("jittered_clock", 0.6)),
        Laboratory("held values", 6, "", _hostile("held_values", 0.4)),
        Laboratory("few passages", 4, "hardly a passage", _hostile("few_passages", 0.8)),
        Laboratory("telegraph", 3, "no path between levels", _hostile("popcorn", 1.0)),
        Laboratory("chain of three", 3, "no path between levels", lambda draw: _chain(draw, 1, noise=0.15)),
        Laboratory("chain in a plane", 3, "no path between levels", lambda draw: _chain(draw, 2, noise=0.2)),
        Laboratory("jumps", 3, "paths are not continuous", _hostile("levy_noise_in_wells", 1.0)),
        Laboratory("regular stays", 2, "no chain at any lag", _hostile("regular_stays", 1.0)),
        Laboratory("swinging tilt", 1, "the force depends on time", _hostile("swinging_tilt", 0.8)),
        Laboratory("growing noise", 1, "the noise depends on time", _hostile("growing_noise", 0.9)),
    )
}  # fmt: skip


class _Climbed(NamedTuple):
    rung: int
    stays: list[tuple[float, float, float]]


def by_states(recordings: Recordings) -> _Climbed | None:
    """What the record supports by itself, up to rung 3: stays by the Markov model, or else as counted."""
    found = RecordStates.of(recordings)
    if found is None or not found.supported:
        return None
    names = ("mean_time", "lowest", "highest")
    if found.markov is not None:
        names = ("markov_time", "markov_lowest", "markov_highest")
    stays = found.dwell_times()[list(names)].iloc[np.argsort(found.places[:, 0])]
    return _Climbed(found.rung, list(stays.itertuples(index=False, name=None)))


def by_ladder(recordings: Recordings) -> _Climbed | None:
    """The answer of ``siq run``: residence times as f and D have them from rung 4 on, else the states' own.

    These stand also where f and D tell no times, as those of a force that may be a gate. What visits are
    foreseen to last (`siq.quasipotential.occupancy`) is another time: they end where the core of another
    attractor begins, and true stays on its level.
    """
    try:
        found = Landscape.from_recordings(recordings)
    except NoLandscape as error:
        return by_states(recordings) if error.rung else None
    if found.rung < 4:
        return by_states(recordings) if found.rung else None
    times = found.dwell_times()
    if times["mean_time"].isna().any() and (seen := by_states(recordings)) is not None:
        return seen._replace(rung=found.rung)
    order = np.argsort([one.position[0] for one in found.attractors])
    factor = np.exp(DEVIATIONS * np.hypot(times["data_error"], times["law_error"]))
    stays = np.stack([times["mean_time"], times["mean_time"] / factor, times["mean_time"] * factor], axis=1)
    return _Climbed(found.rung, [(float(a), float(b), float(c)) for a, b, c in stays[order]])


def judged(laboratory: Laboratory, seed: int, climb: Callable[[Recordings], Any]) -> dict[str, Any]:
    """What was answered of one case, and whether the true stays are in their intervals."""
    case = laboratory.case(seed)
    row: dict[str, Any] = {"laboratory": laboratory.name, "seed": seed, "true_rung": laboratory.rung}
    row |= {"true_states": len(case.levels), "rung": 0, "states": 0, "covered": 0, "stays": 0, "fault": ""}
    try:
        found = climb(case.recordings)
    except Exception as error:
        return row | {"fault": f"{type(error).__name__}: {error}"}
    if found is None:
        return row
    stays = list(found.stays)
    row |= {"rung": int(found.rung), "states": len(stays)}
    if len(stays) == len(case.stays):
        known = [(one, true) for one, true in zip(stays, case.stays, strict=True) if np.isfinite(true)]
        row["stays"] = len(known)
        row["covered"] = sum(bool(low <= true <= high) for (_, low, high), true in known)
    return row


def table(rows: pd.DataFrame) -> str:
    """How many records of each laboratory ended on the right rung, and above; and covered stays."""
    rows = rows.assign(right=rows.rung == rows.true_rung, above=rows.rung > rows.true_rung)
    counts = rows.assign(count=rows.states == rows.true_states)
    by = counts.groupby("laboratory", sort=False)
    found = by[["right", "above", "count", "covered", "stays"]].sum().assign(cases=by.size())
    total = found.sum()
    shares = (
        f"right rung: {total.right} of {total.cases}; above it: {total.above};"
        f" stays within their intervals: {total.covered} of {total.stays}"
    )
    return f"{found.to_string()}\n{shares}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is missing, and say what came out."""
    parser = argparse.ArgumentParser(prog="benchmarks.rungs", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--climb", required=True, metavar="MODULE:FUNCTION")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="the first of the seeds")
    parser.add_argument("--only", nargs="+", default=list(LABORATORIES), choices=list(LABORATORIES))
    parser.add_argument("--folder", type=Path, default=Path("results/rungs"))
    chosen = parser.parse_args(arguments)
    module, _, name = chosen.climb.partition(":")
    climb = getattr(importlib.import_module(module), name)
    file = chosen.folder / "cases.csv"
    file.parent.mkdir(parents=True, exist_ok=True)
    there = pd.read_csv(file) if file.exists() else pd.DataFrame(columns=list(COLUMNS))
    done = set(zip(there.laboratory, there.seed, strict=True))
    with file.open("a", newline="", encoding="utf-8", buffering=1) as lines:
        writer = csv.DictWriter(lines, COLUMNS)
        if not file.stat().st_size:
            writer.writeheader()
        for seed in range(chosen.first, chosen.first + chosen.seeds):
            for one in chosen.only:
                if (one, seed) not in done:
                    writer.writerow(judged(LABORATORIES[one], seed, climb))
    print(table(pd.read_csv(file)))


if __name__ == "__main__":
    main()
