"""Cases: recordings and a card that lacks something, and apart from them the key that says what.

A case is what a user of the diagnosis would have: a card, recordings, and a study. Nothing in it may betray
the key.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
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
    rounded,
    thinned,
    turns,
    wrong_parameters,
)
from benchmarks.proof.concealment.catalogue import CATALOGUES
from benchmarks.proof.concealment.effects import Effect
from benchmarks.proof.concealment.model import Trajectories, TrueSystem, derivatives
from benchmarks.proof.concealment.simulation import simulate
from benchmarks.proof.concealment.strengths import STRONGEST, WEAKEST, calibrate, effect_strength
from benchmarks.proof.concealment.systems import SYSTEMS

SHIFT = (0.03, 0.25)  # relative, by which a parameter of a card is wrong
ATTEMPTS = 40
KINDS = ("null", "shift", "mechanism", "process noise", "withheld")
ALWAYS_WITHHELD: Mapping[str, tuple[str, ...]] = {
    "predator_prey": ("Allee effect", "delayed response"),
    # A stop beyond a gap is a backlash beside another stiffness.
    "oscillator": ("backlash",),
    "coupled_masses": ("backlash",),
}
"""Entries of the dictionary that are, or contain, an effect that this generator calls withheld."""
DECOYS = 0.15  # of the mechanical cases say "without hysteresis" though there is none


def draw_cases(*, count: int, seed: int, shares: Mapping[str, float]) -> list[Design]:
    """Decide which cases there are.

    Parameters
    ----------
    count
        Their number.
    seed
        The same seed draws the same cases.
    shares
        Share of each kind, as in ``config/proof.yaml``; they are respected to within one case.

    Returns
    -------
    list of Design
        In an order that says nothing. Systems, and within each system the effects, take turns; half of the
        cases with an effect have wrong parameters as well.
    """
    check_shares(shares, KINDS)
    rng = np.random.default_rng(seed)
    # Whole numbers that are as close to the shares as possible: the largest remainders are rounded up.
    wanted = np.array(list(shares.values())) * count
    numbers = np.floor(wanted + 1e-9).astype(int)
    numbers[np.argsort(numbers - wanted, kind="stable")[: count - numbers.sum()]] += 1
    kinds = np.repeat(list(shares), numbers)
    systems = {kind: turns(list(SYSTEMS), rng) for kind in shares}
    effects: dict[tuple[str, str], Iterator[str]] = {}
    noise = turns(list(NOISE_LEVELS), rng)
    shifted = turns([True, False], rng)
    drawn: list[dict[str, Any]] = []
    for kind in map(str, kinds):
        system = next(systems[kind])
        mechanism = None
        if kind not in ("null", "shift"):
            choices = {
                "mechanism": list(CATALOGUES[system].mechanisms),
                "process noise": ["process noise"],
                "withheld": list(CATALOGUES[system].withheld),
            }[kind]
            mechanism = next(effects.setdefault((kind, system), turns(choices, rng)))
        drawn.append(
            {
                "system": system,
                "kind": kind,
                "mechanism": mechanism,
                "shifted": kind == "shift" or (mechanism is not None and next(shifted)),
                "strength": log_uniform(WEAKEST, STRONGEST, rng) if mechanism else None,
                "noise_db": next(noise),
                "without": _without(system, kind, mechanism, rng),
                "seed": int(rng.integers(2**63)),
            }
        )
    return in_random_order(drawn, rng)


def log_uniform(low: float, high: float, rng: np.random.Generator) -> float:
    """A number whose logarithm is uniformly distributed."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _without(system: str, kind: str, mechanism: str | None, rng: np.random.Generator) -> tuple[str, ...]:
    """Entries that the diagnosis has to do without; what is always withheld gives nothing away."""
    always = ALWAYS_WITHHELD.get(system, ())
    decoy = rng.random() < DECOYS
    if mechanism == "hysteresis":
        return (*always, "hysteresis") if kind == "withheld" else always
    # A study that does without hysteresis must not give away that this is what is concealed.
    hidden = decoy and "hysteresis" in CATALOGUES[system].mechanisms
    return (*always, "hysteresis") if hidden else always


def make_case(design: Design) -> ProofCase:
    """Simulate a case. The same design makes the same case.

    Parameters
    ----------
    design
        What has been decided.

    Returns
    -------
    ProofCase
        With an effect that is as strong as wanted; weaker, where the motion did not stay bounded.
    """
    rng = np.random.default_rng(design.seed)
    system = SYSTEMS[design.system]
    wanted = design.strength
    for attempt in range(ATTEMPTS):
        true = {
            name: rounded(value * np.exp(rng.uniform(-0.1, 0.1)) if name in system.free() else value)
            for name, value in system.nominal().items()
        }
        experiment = system.experiment(rng)
        effect = _draw_effect(design, rng)
        try:
            if effect is not None and wanted is not None:
                effect = calibrate(system, true, effect, experiment, wanted, rng)
            model = TrueSystem(system, true, effect)
            path = simulate(model, experiment, rng)
        except RanAway:
            path = None
        reached = effect_strength(model, path) if path is not None and effect is not None else None
        if path is not None and (reached is None or WEAKEST / 1.2 <= reached <= STRONGEST * 1.2):
            return _assemble(design, model, path, reached, rng)
        if wanted is not None and attempt % 4 == 3:
            wanted = log_uniform(WEAKEST, max(wanted, 2 * WEAKEST), rng)
    raise RuntimeError(f"{design.name}: no bounded motion in {ATTEMPTS} attempts")


def _draw_effect(design: Design, rng: np.random.Generator) -> Effect | None:
    catalogue = CATALOGUES[design.system]
    if design.mechanism is None:
        return None
    if design.kind == "process noise":
        return catalogue.noise(rng)
    return (catalogue.mechanisms if design.kind == "mechanism" else catalogue.withheld)[design.mechanism](rng)


def _assemble(
    design: Design,
    model: TrueSystem,
    path: Trajectories,
    reached: float | None,
    rng: np.random.Generator,
) -> ProofCase:
    """Everything of a case that follows from what the system did."""
    system, effect = model.system, model.effect
    shifts = wrong_parameters(list(system.free()), model.parameters, *SHIFT, rng) if design.shifted else {}
    table = _recordings(model, path, design.noise_db, rng)
    labels = sorted(set(table["recording"]))
    held_out = rng.choice(labels, size=round(HELD_OUT * len(labels)), replace=False)
    study: dict[str, Any] = {"held_out": sorted(map(str, held_out))}
    if design.without:
        study["without"] = list(design.without)
    key = key_of(
        design, effect, rng, system=design.system, mechanism=design.mechanism, strength=reached, shifts=shifts
    )
    return ProofCase(_card(model, shifts), study, table, key, _truth(model, path))


def _card(model: TrueSystem, shifts: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """The card without the effect, and with the parameters that it wrongly believes in."""
    parameters = {
        name: {**entry, "value": shifts[name]["card"] if name in shifts else model.parameters[name]}
        for name, entry in model.system.card["parameters"].items()
    }
    return {**model.system.card, "parameters": parameters}


def _recordings(
    model: TrueSystem, path: Trajectories, noise_db: float, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Columns of the table of recordings: outputs as they are measured, inputs as they were given."""
    system, effect = model.system, model.effect
    recordings, samples = path.states.shape[1:]
    # The order of the labels is not that of the amplitudes, nor of what was driven.
    order = rng.permutation(recordings)
    columns = {
        "recording": np.repeat([f"r{number:02d}" for number in range(1, recordings + 1)], samples),
        "t": np.tile(path.times, recordings),
    }
    for name in system.outputs:
        output = path.states[system.states.index(name), order].ravel()
        if effect and effect.measured and name in effect.outputs:
            output = effect.measured(output, effect.parameters)
        noise = np.std(output) * 10 ** (-noise_db / 20)
        columns[name] = output + noise * rng.standard_normal(output.shape)
    for row, name in enumerate(system.inputs):
        columns[name] = path.inputs[row, order].ravel()
    return columns


def _truth(model: TrueSystem, path: Trajectories) -> dict[str, np.ndarray]:
    """Arrays of the key: noise-free states and their derivatives, thinned evenly over all recordings."""
    states = len(model.system.states)
    columns = path.states[:states].reshape(states, -1)
    rows = thinned(columns.shape[1])
    return {
        "t": np.tile(path.times, path.states.shape[1])[rows],
        "states": columns[:, rows].T,
        "inputs": path.inputs.reshape(len(path.inputs), columns.shape[1])[:, rows].T,
        "derivative_true": derivatives(model, path, model.effect)[:states, rows].T,
        "derivative_without": derivatives(model, path, None)[:, rows].T,
    }
