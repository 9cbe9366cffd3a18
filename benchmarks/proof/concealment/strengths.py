"""Strengths: how strong an effect is, and which parameters make it as strong as wanted."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchmarks.proof.concealment.effects import Effect
from benchmarks.proof.concealment.experiments import Experiment
from benchmarks.proof.concealment.model import Drive, Trajectories, TrueSystem, derivatives
from benchmarks.proof.concealment.physics import PhysicalSystem
from benchmarks.proof.concealment.simulation import simulate

WEAKEST, STRONGEST = 0.01, 0.3
NEAR_ENOUGH = 0.15
BISECTIONS = 20
FINE = 20  # points of time between two samples


def effect_strength(model: TrueSystem, path: Trajectories) -> float:
    """Strength of a model's effect along what the model, or a similar one, did.

    Parameters
    ----------
    model
        A model with an effect.
    path
        What it did.

    Returns
    -------
    float
        Root mean square of what the effect contributes to an equation, relative to that of the equation's
        right-hand side without it, in the equation where this is largest. What noise or a delay contribute is
        their mean over one sampling interval; a sensor's error is relative to the output about its mean.
    """
    effect, system = model.effect, model.system
    assert effect is not None
    if effect.measured:
        signal = path.states[[system.states.index(name) for name in effect.outputs]]
        error = effect.measured(signal, effect.parameters) - signal
        return float(_rms(error.ravel()) / np.std(signal))
    without = derivatives(model, path, None)
    if effect.noise:
        rows = [system.states.index(name) for name in effect.noise]
        noise = [effect.parameters[symbol] for symbol in effect.noise.values()] / np.sqrt(path.times[1])
        return float(np.max(noise / _rms(without[rows])))
    if effect.lag:
        difference = _late(model, path)
    else:
        difference = derivatives(model, path, effect)[: len(without)] - without
    return float(np.max(_rms(difference) / _rms(without)))


def calibrate(
    system: PhysicalSystem,
    parameters: Mapping[str, float],
    effect: Effect,
    experiment: Experiment,
    wanted: float,
    rng: np.random.Generator,
) -> Effect:
    """Make an effect as strong as wanted, by pilot simulations.

    Parameters
    ----------
    system, parameters
        The system and what its parameters really are.
    effect
        The effect at any strength.
    experiment
        What will be done to the system.
    wanted
        The strength.
    rng
        Draws process noise.

    Returns
    -------
    Effect
        About as strong as wanted, or as strong as its limit allows.

    Raises
    ------
    RanAway
        When a pilot does not stay bounded.
    """
    # States that the effect brings along have to follow the motion before they can act on it.
    path = simulate(
        TrueSystem(system, parameters, effect.times(1e-9) if effect.states else None),
        experiment,
        rng,
        pilot=True,
    )
    for _ in range(3):
        effect = _fitted(system, parameters, effect, path, wanted)
        if effect.noise or effect.measured:
            break  # the pilot does not depend on these
        path = simulate(TrueSystem(system, parameters, effect), experiment, rng, pilot=True)
        if abs(np.log(effect_strength(TrueSystem(system, parameters, effect), path) / wanted)) < NEAR_ENOUGH:
            break
    return effect


def _fitted(
    system: PhysicalSystem, parameters: Mapping[str, float], effect: Effect, path: Trajectories, wanted: float
) -> Effect:
    """The effect with the wanted strength along given trajectories."""

    def strength(factor: float) -> float:
        return effect_strength(TrueSystem(system, parameters, effect.times(factor)), path)

    if not effect.limit:
        return effect.times(wanted / strength(1.0))
    low, high = np.log(1e-4), 0.0
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if strength(float(np.exp(middle))) < wanted else (low, middle)
    return effect.times(float(np.exp(high)))


def _late(model: TrueSystem, path: Trajectories) -> np.ndarray:
    """What the delay of inputs changes, as mean over each sampling interval, for held inputs jump."""
    moments = path.times[0] + path.times[1] * (np.arange(FINE * len(path.times)) + 0.5) / FINE
    late = Drive(path.times, path.inputs, model.system.held, model.lag).at(moments)
    change = late - Drive(path.times, path.inputs, model.system.held, 0.0).at(moments)
    mean = change.reshape(*change.shape[:2], -1, FINE).mean(axis=-1).reshape(len(change), -1)
    # Inputs enter linearly, so the state does not matter.
    rest = np.zeros((len(model.system.states), mean.shape[1]))
    return TrueSystem(model.system, model.parameters).drift(0.0, rest, mean)


def _rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(values**2, axis=-1))
