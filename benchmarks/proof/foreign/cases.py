"""Cases: a card that lacks something, coarse recordings and a study; and apart from them the key."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.proof.cases import (
    HELD_OUT,
    NOISE_LEVELS,
    Design,
    ProofCase,
    RanAway,
    check_shares,
    in_random_order,
    key_of,
    thinned,
    turns,
    wrong_parameters,
)
from benchmarks.proof.foreign.effects import LAWS, draw_effect
from benchmarks.proof.foreign.formulas import evaluator
from benchmarks.proof.foreign.motion import PILOT, Motion, Truth, move
from benchmarks.proof.foreign.sensors import Sensors, draw_sensors, reader, recorded
from benchmarks.proof.foreign.systems import FAMILIES, Experiment, draw_experiment

ATTEMPTS = 60
ROUNDS = 4  # in which the amplitude of an effect is found
CLOSE = 1.25  # factor by which its strength may miss what was wanted
SHIFT = (0.05, 0.25)  # relative, by which a parameter of a card is wrong
KINDS = ("null", "shift", "withheld")
STRENGTHS = (0.05, 0.7)  # rms of the effect over that of what it is added to, the rate or the reading
IN_SENSOR = (0.03, 0.3)  # the same where it is a sensor's


def draw_cases(*, count: int, seed: int, shares: Mapping[str, float]) -> list[Design]:
    """Decide which cases there are.

    Parameters
    ----------
    count
        Their number.
    seed
        The same seed draws the same cases.
    shares
        Share of each of `KINDS`; respected to within one case.

    Raises
    ------
    ValueError
        For other kinds, or shares that do not sum to one.
    """
    check_shares(shares, KINDS)
    rng = np.random.default_rng(seed)
    edges = np.round(count * np.cumsum(list(shares.values()))).astype(int)
    kinds = np.repeat(list(shares), np.diff(edges, prepend=0))
    families = {kind: turns(list(FAMILIES), rng) for kind in shares}
    noise = {kind: turns(list(NOISE_LEVELS), rng) for kind in shares}
    laws, shifted = turns(list(LAWS), rng), turns([True, False], rng)
    drawn: list[dict[str, Any]] = []
    for kind in map(str, kinds):
        concealed = kind == "withheld"
        drawn.append(
            {
                "kind": kind,
                "system": next(families[kind]),
                "mechanism": next(laws) if concealed else None,
                "shifted": kind == "shift" or (concealed and next(shifted)),
                "strength": float(rng.random()),
                "noise_db": next(noise[kind]),
                "without": (),
                "seed": int(rng.integers(2**63)),
            }
        )
    return in_random_order(drawn, rng)


def make_case(design: Design) -> ProofCase:
    """Draw and simulate a case. The same design makes the same case.

    Raises
    ------
    RuntimeError
        When no draw moves within bounds and has an effect of the wanted strength.
    """
    rng = np.random.default_rng(design.seed)
    for _ in range(ATTEMPTS):
        system = FAMILIES[design.system](rng)
        experiment = draw_experiment(system, rng)
        truth = Truth(system, system.parameters)
        strength = None
        try:
            if design.mechanism is not None:
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
    design: Design, truth: Truth, experiment: Experiment, rng: np.random.Generator
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
        str(design.mechanism), ranges=_ranges(truth, pilot, experiment), acceptors=system.acceptors,
        outputs=tuple(system.outputs), rng=rng,
    )  # fmt: skip
    low, high = np.log(IN_SENSOR if effect.in_sensor else STRENGTHS)
    assert design.strength is not None
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
    design: Design,
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
    key = key_of(
        design,
        effect,
        rng,
        system=f"{system.family}, {len(system.states)} states",
        mechanism=effect.law if effect else None,
        strength=strength,
        shifts=shifts,
        sensors={
            "noise": table.noise,
            "steps": table.steps,
            "lost": 0.0 if system.driven else sensors.lost,
            "jitter": sensors.jitter,
        },
    )
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
