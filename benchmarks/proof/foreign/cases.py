"""Cases: a card that lacks something, coarse recordings and a study; and apart from them the key."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.proof.cases import HELD_OUT, ProofCase, thinned, wrong_parameters
from benchmarks.proof.foreign.designs import IN_SENSOR, STRENGTHS, ForeignDesign, draw_cases
from benchmarks.proof.foreign.effects import draw_effect
from benchmarks.proof.foreign.formulas import evaluator
from benchmarks.proof.foreign.motion import PILOT, Motion, RanAway, Truth, move
from benchmarks.proof.foreign.sensors import Sensors, draw_sensors, reader, recorded
from benchmarks.proof.foreign.systems import FAMILIES, Experiment, draw_experiment

__all__ = ["ForeignDesign", "draw_cases", "make_case"]

ATTEMPTS = 60
ROUNDS = 4  # in which the amplitude of an effect is found
CLOSE = 1.25  # factor by which its strength may miss what was wanted
SHIFT = (0.05, 0.25)  # relative, by which a parameter of a card is wrong


def make_case(design: ForeignDesign) -> ProofCase:
    """Draw and simulate a case. The same design makes the same case.

    Raises
    ------
    RuntimeError
        When no draw moves within bounds and has an effect of the wanted strength.
    """
    rng = np.random.default_rng(design.seed)
    for _ in range(ATTEMPTS):
        system = FAMILIES[design.family](rng)
        experiment = draw_experiment(system, rng)
        truth = Truth(system, system.parameters)
        strength = None
        try:
            if design.law is not None:
                truth, strength = _concealing(design, truth, experiment, rng)
            motion = move(truth, experiment)
        except RanAway:
            continue
        if _moves(motion):
            sensors = draw_sensors(design.noise_db, rng)
            return _assembled(design, truth, experiment, motion, strength, sensors, rng)
    raise RuntimeError(f"{design.name}: no bounded motion in {ATTEMPTS} attempts")


def _moves(motion: Motion) -> bool:
    """Whether every state does something."""
    states = motion.ticks().reshape(len(motion.states), -1)
    return bool((states.std(axis=1) > 0.02 * np.abs(states).max(axis=1)).all())


def _concealing(
    design: ForeignDesign, truth: Truth, experiment: Experiment, rng: np.random.Generator
) -> tuple[Truth, float]:
    """The system with an effect that is as strong as wanted.

    Raises
    ------
    RanAway
        When the motion does not stay bounded, or no amplitude is right.
    """
    system = truth.system
    pilot = move(truth, experiment, steps=PILOT)
    effect = draw_effect(
        str(design.law), ranges=_ranges(truth, pilot, experiment), acceptors=system.acceptors,
        outputs=tuple(system.outputs), rng=rng,
    )  # fmt: skip
    low, high = np.log(IN_SENSOR if effect.in_sensor else STRENGTHS)
    wanted = float(np.exp(low + design.strength * (high - low)))
    concealing = Truth(system, truth.parameters, effect)
    amplitude = wanted / strength_of(concealing, pilot, experiment)
    for _ in range(ROUNDS):
        concealing = concealing.times(amplitude)
        motion = move(concealing, experiment, steps=PILOT)
        reached = strength_of(concealing, motion, experiment)
        if wanted / CLOSE < reached < wanted * CLOSE:
            return concealing, reached
        amplitude *= wanted / reached
    raise RanAway


def _within(motion: Motion, experiment: Experiment) -> tuple[np.ndarray, np.ndarray]:
    """States ``(d, n)`` and inputs ``(n,)`` at the ticks that are recorded."""
    inside = np.arange(experiment.lengths.max()) < experiment.lengths[:, None]
    return motion.ticks()[:, inside], experiment.drive[inside]


def _ranges(truth: Truth, motion: Motion, experiment: Experiment) -> dict[str, tuple[float, float]]:
    states, drive = _within(motion, experiment)
    rows = [*zip(truth.system.states, states, strict=True), *((name, drive) for name in truth.system.inputs)]
    rows += zip(truth.system.outputs, reader(truth)(states, drive), strict=True)
    return {name: (float(row.min()), float(row.max())) for name, row in rows}


def strength_of(truth: Truth, motion: Motion, experiment: Experiment) -> float:
    """Root mean square of the effect over that of what it is added to, both about their means.

    Raises
    ------
    RanAway
        When the effect does not act where the system moves.
    """
    effect = truth.effect
    assert effect is not None
    states, drive = _within(motion, experiment)
    without = Truth(truth.system, truth.parameters)
    if effect.in_sensor:
        beside = reader(without)(states, drive)[list(truth.system.outputs).index(effect.place)]
        acting = reader(truth)(states, drive)[list(truth.system.outputs).index(effect.place)] - beside
    else:
        beside = without.rates(states, drive)[truth.system.states.index(effect.place)]
        named = {**dict(zip(truth.system.states, states, strict=True)), "u": drive}
        acting = effect.amplitude * evaluator([effect.text], effect.coordinates)(named)[0]
    strength = float(acting.std() / beside.std())
    if not strength > 0:
        raise RanAway
    return strength


def _assembled(
    design: ForeignDesign,
    truth: Truth,
    experiment: Experiment,
    motion: Motion,
    strength: float | None,
    sensors: Sensors,
    rng: np.random.Generator,
) -> ProofCase:
    system, effect = truth.system, truth.effect
    shifts = wrong_parameters(system.free, truth.parameters, *SHIFT, rng) if design.shifted else {}
    table = recorded(truth, motion, experiment, sensors, rng)
    believed = {name: shift["card"] for name, shift in shifts.items()}
    key: dict[str, Any] = {
        "case": design.name,
        "salt": rng.bytes(16).hex(),
        "system": f"{system.family}, {len(system.states)} states",
        "kind": design.kind,
        "mechanism": effect.law if effect else None,
        "equations": [] if effect is None or effect.in_sensor else [effect.place],
        "coordinates": list(effect.coordinates) if effect else [],
        "noise_db": design.noise_db,
        "strength": strength,
        "shifts": shifts,
        "effect": effect.formulas() if effect else {},
        "sensors": {
            "noise": table.noise,
            "steps": table.steps,
            "lost": 0.0 if system.driven else sensors.lost,
            "jitter": sensors.jitter,
        },
    }
    return ProofCase(
        system.card({**truth.parameters, **believed}),
        _study(table.columns, rng),
        table.columns,
        key,
        {**_rows(truth, motion, experiment), "starts": experiment.starts[:, table.order].T},
    )


def _study(table: Mapping[str, np.ndarray], rng: np.random.Generator) -> dict[str, Any]:
    """What is held out: a quarter of the recordings, and of one recording its last quarter."""
    labels = np.unique(table["recording"])
    if len(labels) == 1:
        return {"held_out": HELD_OUT}
    count = max(round(HELD_OUT * len(labels)), 1)
    return {"held_out": sorted(map(str, rng.choice(labels, size=count, replace=False)))}


def _rows(truth: Truth, motion: Motion, experiment: Experiment) -> dict[str, np.ndarray]:
    """Arrays of the key: noise-free states and their derivatives, thinned evenly."""
    states, drive = _within(motion, experiment)
    rows = thinned(len(drive))
    states, drive = states[:, rows], drive[rows]
    inputs = drive[None] if truth.system.driven else np.zeros((0, len(rows)))
    return {
        "t": rows * truth.system.interval,
        "states": states.T,
        "inputs": inputs.T,
        "derivative_true": truth.rates(states, drive).T,
        "derivative_without": Truth(truth.system, truth.parameters).rates(states, drive).T,
    }
