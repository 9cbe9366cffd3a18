"""Cases: recordings and a card that lacks something, and apart from them the key that says what.

A case is what a user of the diagnosis would have: a card, recordings, and a study. Nothing in it may betray
the key.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.proof.cases import HELD_OUT, ProofCase, thinned, wrong_parameters
from benchmarks.proof.concealment.catalogue import CATALOGUES
from benchmarks.proof.concealment.designs import CaseDesign, draw_cases, log_uniform
from benchmarks.proof.concealment.effects import Effect
from benchmarks.proof.concealment.model import Trajectories, TrueSystem, derivatives
from benchmarks.proof.concealment.simulation import RanAway, simulate
from benchmarks.proof.concealment.strengths import STRONGEST, WEAKEST, calibrate, effect_strength
from benchmarks.proof.concealment.systems import SYSTEMS

__all__ = ["CaseDesign", "draw_cases", "make_case"]

SHIFT = (0.03, 0.25)  # relative, by which a parameter of a card is wrong
ATTEMPTS = 40


def make_case(design: CaseDesign) -> ProofCase:
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
            name: float(f"{value * np.exp(rng.uniform(-0.1, 0.1)) if name in system.free() else value:.4g}")
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


def _draw_effect(design: CaseDesign, rng: np.random.Generator) -> Effect | None:
    catalogue = CATALOGUES[design.system]
    if design.mechanism is None:
        return None
    if design.kind == "process noise":
        return catalogue.noise(rng)
    return (catalogue.mechanisms if design.kind == "mechanism" else catalogue.withheld)[design.mechanism](rng)


def _assemble(
    design: CaseDesign,
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
    key = {
        "case": design.name,
        "salt": rng.bytes(16).hex(),  # nobody finds out a key by trying digests
        "system": design.system,
        "kind": design.kind,
        "mechanism": design.mechanism,
        "equations": list(effect.equations) if effect else [],
        "coordinates": list(effect.coordinates) if effect else [],
        "noise_db": design.noise_db,
        "strength": reached,
        "shifts": shifts,
        "effect": effect.formulas() if effect else {},
    }
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
