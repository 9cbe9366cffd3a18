"""Sensors as laboratories have them: noise, steps of reading, samples that are lost, clocks that jitter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.proof.cases import rounded
from benchmarks.proof.foreign.formulas import evaluator
from benchmarks.proof.foreign.motion import Motion, Truth, drive_at
from benchmarks.proof.foreign.systems import Experiment

ROUNDING = 0.4  # share of the cases in which sensors round
BITS = (7, 13)
LOSING = 0.6  # share of the cases without an input in which samples are lost
LOST = (0.01, 0.15)  # of the samples
JITTERING = 0.4  # share of the cases in which samples are taken too early or too late
JITTER = (0.003, 0.03)  # deviation, relative to the interval
SPARE = 0.2  # by which the range of a sensor is wider than what it measures
FEWEST = 16  # samples that every recording keeps


@dataclass(frozen=True)
class Sensors:
    """How a case is recorded.

    Attributes
    ----------
    noise_db
        Signal-to-noise ratio of each output, in decibels.
    bits
        Of the converter; None where nothing is rounded.
    lost
        Share of the samples that are lost.
    jitter
        Deviation of the times at which samples are taken from those that are recorded, in intervals.
    """

    noise_db: float
    bits: int | None
    lost: float
    jitter: float


def draw_sensors(noise_db: float, rng: np.random.Generator) -> Sensors:
    """Draw which of their faults the sensors of a case have."""
    rounding, losing, jittering = rng.random(3) < (ROUNDING, LOSING, JITTERING)
    bits, lost = int(rng.integers(*BITS)), rng.uniform(*LOST)
    jitter = float(np.exp(rng.uniform(*np.log(JITTER))))
    return Sensors(
        noise_db, bits if rounding else None, float(lost) if losing else 0.0, jitter if jittering else 0.0
    )


@dataclass(frozen=True)
class Table:
    """What was recorded.

    Attributes
    ----------
    columns
        ``recording``, ``t``, the outputs and the input.
    noise
        Deviation of each output's noise.
    steps
        In which each output is read; empty where nothing is rounded.
    order
        The place in the experiment of each label, shape ``(R,)``.
    """

    columns: dict[str, np.ndarray]
    noise: dict[str, float]
    steps: dict[str, float]
    order: np.ndarray


def recorded(
    truth: Truth, motion: Motion, experiment: Experiment, sensors: Sensors, rng: np.random.Generator
) -> Table:
    """The table of recordings.

    Samples are lost as rows, and only where nothing drives the system: nobody knows the input of a lost row.
    """
    system, interval = truth.system, truth.system.interval
    read = reader(truth)
    labels, times, inputs, values = [], [], [], []
    order = rng.permutation(len(experiment.lengths))  # the order of the labels says nothing
    for number, recording in enumerate(order, start=1):
        ticks = np.arange(experiment.lengths[recording])
        early = sensors.jitter * rng.standard_normal(len(ticks))
        taken = np.clip(ticks + early, 0, len(ticks) - 1) * interval
        states = motion.at(int(recording), taken)
        at = np.minimum((taken / interval).astype(int), experiment.drive.shape[1] - 2)
        drive = np.array(
            [
                drive_at(experiment, held=system.held, tick=int(k), share=float(s))[recording]
                for k, s in zip(at, taken / interval - at, strict=True)
            ]
        )
        labels.append(np.full(len(ticks), f"r{number:02d}"))
        times.append(ticks * interval)
        inputs.append(experiment.drive[recording, ticks])
        values.append(read(states, drive))
    clean = np.concatenate(values, axis=1)
    noise = clean.std(axis=1) * 10 ** (-sensors.noise_db / 20)
    steps: dict[str, float] = {}
    measured = clean + noise[:, None] * rng.standard_normal(clean.shape)
    if sensors.bits is not None:
        width = np.ptp(clean, axis=1) * (1 + SPARE)
        steps = {
            name: rounded(each / 2**sensors.bits, 3) for name, each in zip(system.outputs, width, strict=True)
        }
        step = np.array(list(steps.values()))[:, None]
        measured = step * np.round(measured / step)
    columns: dict[str, np.ndarray] = {"recording": np.concatenate(labels), "t": np.concatenate(times)}
    kept = _kept(columns["recording"], 0.0 if system.driven else sensors.lost, rng)
    columns |= dict(zip(system.outputs, measured, strict=True))
    if system.driven:
        columns["u"] = np.concatenate(inputs)
    return Table(
        {name: column[kept] for name, column in columns.items()},
        dict(zip(system.outputs, map(float, noise), strict=True)),
        steps,
        order,
    )


def reader(truth: Truth) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """What the sensors read without noise, as a function of states and input."""
    system, effect = truth.system, truth.effect
    distorted = effect if effect is not None and effect.in_sensor else None
    exact = evaluator(list(system.outputs.values()), truth.names)
    added = None if distorted is None else evaluator([distorted.text], distorted.coordinates)

    def read(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        values = exact(truth.named(x, u))
        if distorted is not None and added is not None:
            place = list(system.outputs).index(distorted.place)
            values[place] += distorted.amplitude * added({distorted.place: values[place]})[0]
        return values

    return read


def _kept(labels: np.ndarray, lost: float, rng: np.random.Generator) -> np.ndarray:
    """Which samples are not lost: single ones and short stretches are, the first of a recording never."""
    kept = np.ones(len(labels), dtype=bool)
    if not lost:
        return kept
    while (~kept).mean() < lost:
        begin = int(rng.integers(len(kept)))
        kept[begin : begin + int(rng.choice([1, 1, 2, 5]))] = False
    for label in np.unique(labels):
        kept[np.flatnonzero(labels == label)[:FEWEST]] = True
    return kept
