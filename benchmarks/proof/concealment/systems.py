"""Systems: five cards, and their equations written down a second time.

The equations stand here as numpy functions of their own and are not read from the cards, so that a fault in
how cards are read cannot conceal itself. Arrays hold states first: ``(states, ...)``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.proof.concealment.experiments import (
    Experiment,
    amplitudes_within,
    counts,
    driven_or_free,
    linear_response,
    on_orbits,
)
from benchmarks.proof.concealment.physics import PhysicalSystem, Values


def _parameters(unit: str = "1", /, **values: float) -> dict[str, dict[str, Any]]:
    return {name: {"value": value, "unit": unit} for name, value in values.items()}


# --- Nanomechanical resonator: slow flow of a driven Duffing oscillator, quadratures P and Q


def _resonator(x: np.ndarray, u: np.ndarray, p: Values) -> Sequence[np.ndarray]:
    P, Q = x
    turning = (p["omega_0"] ** 2 - p["omega_F"] ** 2) / (2 * p["omega_F"])
    turning = turning + 3 * p["alpha"] / (8 * p["omega_F"]) * (P * P + Q * Q)
    return turning * Q - p["zeta"] * P, -turning * P - p["zeta"] * Q - p["beta"] / (2 * p["omega_F"])


def _resonator_experiment(rng: np.random.Generator) -> Experiment:
    recordings, samples = counts(rng)
    radius, angle = amplitudes_within(0.022, recordings, rng), rng.uniform(0, 2 * np.pi, recordings)
    # It turns within 1000 to 4000 units of time, and its motion is damped within 1/zeta = 2200.
    starts = radius * np.array([np.cos(angle), np.sin(angle)])
    return Experiment(50.0, samples, starts, np.zeros((0, recordings, samples)))


RESONATOR = PhysicalSystem(
    card={
        "name": "resonator",
        "title": "Nanomechanical resonator, slow flow",
        "time_unit": "1",
        "states": {"P": {"unit": "1", "domain": [-0.02, 0.02]}, "Q": {"unit": "1", "domain": [-0.02, 0.02]}},
        "parameters": {
            "omega_0": {"value": 1.0, "unit": "1", "fixed": True},
            "omega_F": {"value": 1.0018, "unit": "1", "fixed": True},
            **_parameters(zeta=4.5e-4, alpha=33.0, beta=1.4e-5),
        },
        "equations": {
            "P": "(omega_0**2 - omega_F**2)/(2*omega_F)*Q - zeta*P + 3*alpha/(8*omega_F)*Q*(P**2 + Q**2)",
            "Q": "-(omega_0**2 - omega_F**2)/(2*omega_F)*P - zeta*Q"
            " - 3*alpha/(8*omega_F)*P*(P**2 + Q**2) - beta/(2*omega_F)",
        },
        "diffusion": "identity",
    },
    equations=_resonator,
    experiment=_resonator_experiment,
    rate=0.002,
    sizes={"P": 0.01, "Q": 0.01},
)


# --- Archetypal model in three dimensions: no physical roles, all coefficients are parameters


def _archetype3d(x: np.ndarray, u: np.ndarray, p: Values) -> Sequence[np.ndarray]:
    x1, x2, x3 = x
    cube = x1 * x1 * x1
    return (
        p["a_2"] * x1 - p["a_1"] * cube - p["a_3"] * x2 - p["a_4"] * x3,
        p["b_2"] * cube - p["b_3"] * x1 - p["b_1"] * x2,
        p["d_2"] * cube - p["d_3"] * x1 - p["d_1"] * x3,
    )


def _archetype3d_experiment(rng: np.random.Generator) -> Experiment:
    recordings, samples = counts(rng)
    starts = rng.uniform(-1, 1, (3, recordings)) * np.array([[2.0], [1.5], [1.5]])
    # Everything is at rest after four units of time, however many samples are taken.
    return Experiment(4.0 / samples, samples, starts, np.zeros((0, recordings, samples)))


ARCHETYPE3D = PhysicalSystem(
    card={
        "name": "archetype3d",
        "title": "Archetypal model, three dimensions",
        "time_unit": "1",
        "states": {
            "x": {"unit": "1", "domain": [-2.0, 2.0]},
            "y": {"unit": "1", "domain": [-1.5, 1.5]},
            "z": {"unit": "1", "domain": [-1.5, 1.5]},
        },
        "parameters": _parameters(
            a_1=2.0, a_2=2.0, a_3=1.0, a_4=1.0, b_1=1.0, b_2=2.0, b_3=2.0, d_1=1.0, d_2=2.0, d_3=2.0
        ),
        "equations": {
            "x": "-a_1*x**3 + a_2*x - a_3*y - a_4*z",
            "y": "-b_1*y + b_2*x**3 - b_3*x",
            "z": "-d_1*z + d_2*x**3 - d_3*x",
        },
        "diffusion": "identity",
    },
    equations=_archetype3d,
    experiment=_archetype3d_experiment,
    rate=2.4,
    sizes={"x": 1.0, "y": 0.7, "z": 0.7},
)


# --- Mass on a spring, driven by a force, only its position being measured


def _oscillator(x: np.ndarray, u: np.ndarray, p: Values) -> Sequence[np.ndarray]:
    position, velocity = x
    return velocity, (u[0] - p["k"] * position - p["d"] * velocity) / p["m"]


def _oscillator_experiment(rng: np.random.Generator) -> Experiment:
    samples, amplitudes, inputs = driven_or_free(rng, 0.9, 0.05, linear_response(40.0, 0.6))
    return Experiment(0.05, samples, np.array(on_orbits(amplitudes, 6.3, rng)), inputs)


OSCILLATOR = PhysicalSystem(
    card={
        "name": "oscillator",
        "title": "Driven mass on a spring",
        "time_unit": "s",
        "states": {"x": {"unit": "m", "domain": [-2.0, 2.0]}, "v": {"unit": "m/s", "domain": [-12.0, 12.0]}},
        "inputs": {"u": {"unit": "N", "interpolation": "linear"}},
        "parameters": {
            **_parameters("N/m", k=40.0),
            **_parameters("N*s/m", d=0.6),
            "m": {"value": 1.0, "unit": "kg", "fixed": True},
        },
        "equations": {"x": "v", "v": "(-k*x - d*v + u)/m"},
        "outputs": {"x": "x"},
        "diffusion": "identity",
    },
    equations=_oscillator,
    experiment=_oscillator_experiment,
    rate=6.3,
    sizes={"x": 0.5, "v": 3.0},
)


# --- Lotka and Volterra's populations


def _predator_prey(x: np.ndarray, u: np.ndarray, p: Values) -> Sequence[np.ndarray]:
    prey, predator = x
    meetings = prey * predator
    return p["alpha"] * prey - p["beta"] * meetings, p["delta"] * meetings - p["gamma"] * predator


def _predator_prey_experiment(rng: np.random.Generator) -> Experiment:
    recordings, samples = counts(rng)
    # Near its equilibrium the model is harmonic in the logarithms of both populations.
    size, angle = amplitudes_within(0.9, recordings, rng), rng.uniform(0, 2 * np.pi, recordings)
    starts = np.array([[3.0], [2.0]]) * np.exp(size * np.array([np.cos(angle), np.sin(angle)]))
    return Experiment(0.3, samples, starts, np.zeros((0, recordings, samples)))


PREDATOR_PREY = PhysicalSystem(
    card={
        "name": "predator_prey",
        "title": "Predators and their prey",
        "time_unit": "a",
        "states": {
            "prey": {"unit": "1/km**2", "domain": [0.0, 10.0]},
            "predator": {"unit": "1/km**2", "domain": [0.0, 7.0]},
        },
        "parameters": {
            **_parameters("1/a", alpha=1.0),
            **_parameters("km**2/a", beta=0.5),
            **_parameters("1/a", gamma=0.75),
            **_parameters("km**2/a", delta=0.25),
        },
        "equations": {
            "prey": "alpha*prey - beta*prey*predator",
            "predator": "-gamma*predator + delta*prey*predator",
        },
        "diffusion": "identity",
    },
    equations=_predator_prey,
    experiment=_predator_prey_experiment,
    rate=0.87,
    sizes={"prey": 3.0, "predator": 2.0},
)


# --- Two masses on springs with a weak spring between them, only their positions being measured


def _coupled_masses(x: np.ndarray, u: np.ndarray, p: Values) -> Sequence[np.ndarray]:
    x1, v1, x2, v2 = x
    between = p["k_c"] * (x2 - x1)
    return (
        v1,
        (u[0] + between - p["k_1"] * x1 - p["d_1"] * v1) / p["m_1"],
        v2,
        (-between - p["k_2"] * x2 - p["d_2"] * v2) / p["m_2"],
    )


def _coupled_masses_experiment(rng: np.random.Generator) -> Experiment:
    samples, amplitudes, inputs = driven_or_free(rng, 0.9, 0.05, linear_response(44.0, 0.6))
    starts = np.array([*on_orbits(amplitudes, 6.5, rng), *on_orbits(amplitudes, 5.8, rng)])
    return Experiment(0.05, samples, starts, inputs)


COUPLED_MASSES = PhysicalSystem(
    card={
        "name": "coupled_masses",
        "title": "Two coupled masses on springs",
        "time_unit": "s",
        "states": {
            "x1": {"unit": "m", "domain": [-2.0, 2.0]},
            "v1": {"unit": "m/s", "domain": [-12.0, 12.0]},
            "x2": {"unit": "m", "domain": [-2.0, 2.0]},
            "v2": {"unit": "m/s", "domain": [-12.0, 12.0]},
        },
        "inputs": {"u": {"unit": "N", "interpolation": "zero_order"}},
        "parameters": {
            **_parameters("N/m", k_1=40.0, k_2=32.0, k_c=4.0),
            **_parameters("N*s/m", d_1=0.6, d_2=0.5),
            "m_1": {"value": 1.0, "unit": "kg", "fixed": True},
            "m_2": {"value": 1.0, "unit": "kg", "fixed": True},
        },
        "equations": {
            "x1": "v1",
            "v1": "(-k_1*x1 - d_1*v1 + k_c*(x2 - x1) + u)/m_1",
            "x2": "v2",
            "v2": "(-k_2*x2 - d_2*v2 - k_c*(x2 - x1))/m_2",
        },
        "outputs": {"x1": "x1", "x2": "x2"},
        "diffusion": "identity",
    },
    equations=_coupled_masses,
    experiment=_coupled_masses_experiment,
    rate=6.3,
    sizes={"x1": 0.5, "v1": 3.0, "x2": 0.5, "v2": 3.0},
)

SYSTEMS: Mapping[str, PhysicalSystem] = {
    system.card["name"]: system
    for system in (RESONATOR, ARCHETYPE3D, OSCILLATOR, PREDATOR_PREY, COUPLED_MASSES)
}
