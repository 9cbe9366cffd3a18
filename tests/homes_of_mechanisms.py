"""A home for every form of every mechanism: a card that lacks it, and recordings of the system that has it.

The truth is the candidate's own model with values of its parameters, integrated in small steps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import pandas as pd

from siq.diagnosis.dictionary import roles_of, standard_dictionary
from siq.diagnosis.mechanisms import MechanismCandidate, along, candidates_of
from siq.diagnosis.study import _measurements_of
from siq.inference.kalman_filter import Grid
from siq.inference.measurements import Measurements
from siq.numerics.files import Document, validate
from siq.systems.cards import SystemCard, build_system
from siq.systems.dynamics import Dynamics, Signals

FINE = 10  # steps of integration between samples
NOISE = 0.01  # of the spread of what is measured


@dataclass(frozen=True)
class Home:
    """A card, and how its system is recorded.

    Attributes
    ----------
    card
        Without a name.
    step, samples, recordings
        Of the recordings.
    begin
        Draws the first state of a recording, shape ``(d,)``.
    drive
        Draws the inputs of a recording from its times, shape ``(inputs, samples)``.
    """

    card: Mapping[str, Any]
    step: float
    begin: Callable[[np.random.Generator], np.ndarray]
    drive: Callable[[np.random.Generator, np.ndarray], np.ndarray] = lambda rng, t: np.zeros((0, len(t)))
    samples: int = 80
    recordings: int = 4

    @cached_property
    def model(self) -> Dynamics:
        """The simulation that lacks something."""
        return model_of(self.card)


@dataclass(frozen=True)
class Resident:
    """A form of a mechanism at home, and the values of its parameters.

    The label is a part of the candidate's, or of what it changes, where several have the same parameters.
    """

    name: str
    home: str
    values: Mapping[str, float]
    label: str = ""


def model_of(card: Mapping[str, Any]) -> Dynamics:
    """The simulation of a card, which needs no name."""
    document = Document("card.yaml", {"name": "home", **card}, {})
    return build_system(document, validate(document, SystemCard))


def states(**units: str) -> dict[str, dict[str, str]]:
    return {name: {"unit": unit} for name, unit in units.items()}


def numbers(**values: float) -> dict[str, dict[str, Any]]:
    """Parameters that are free; with an underscore at the end they are fixed."""
    return {name.rstrip("_"): {"value": value, "fixed": name.endswith("_")} for name, value in values.items()}


def waves(rng: np.random.Generator, t: np.ndarray, *, size: float = 1.0, slowest: float = 0.6) -> np.ndarray:
    """An input of four frequencies, of another strength in every recording."""
    omega, phase = rng.uniform(slowest, 4 * slowest, (4, 1)), rng.uniform(0, 2 * np.pi, (4, 1))
    return size * rng.uniform(0.4, 1.6) * np.cos(omega * t + phase).sum(axis=0, keepdims=True)


def spun(rng: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """An angle, and its speed, which rises."""
    begin, rise = rng.uniform(0.5, 1.5), rng.uniform(0.05, 0.2)
    return np.stack([begin * t + rise * t**2 / 2, begin + rise * t])


def inflow(rng: np.random.Generator, t: np.ndarray, *, size: float = 1.0) -> np.ndarray:
    """An input that is held for a while at a level, and never negative."""
    levels = size * rng.uniform(0.1, 2.0, len(t) // 10 + 1)
    return np.repeat(levels, 10)[None, : len(t)]


def warmed(
    rate: str, units: Mapping[str, str], begin: tuple[float, float], *, time: str = "s", size: float = 1.0,
    **values: float,
) -> Home:  # fmt: skip
    """What an input u warms; it gives off a tenth of its heat in a unit of time, and s begins in a range."""
    card = {
        "time_unit": time,
        "states": states(s=units["s"]),
        "inputs": {"u": {"unit": units["u"], "interpolation": "zero_order"}},
        "parameters": numbers(**values, h=0.1),
        "equations": {"s": rate},
    }
    return Home(card, 0.5, lambda rng: rng.uniform(*begin, size=1), lambda rng, t: inflow(rng, t, size=size))


def mixed(unit: str) -> Home:
    """A stirred tank through which u flows, which brings w of what s is of."""
    card = {
        "time_unit": "min",
        "states": states(s=unit),
        "inputs": {"u": {"unit": "L/min", "interpolation": "zero_order"}, "w": {"unit": unit}},
        "parameters": numbers(k=0.2),
        "equations": {"s": "-k*s"},
    }

    def course(rng: np.random.Generator, t: np.ndarray) -> np.ndarray:
        return np.concatenate([inflow(rng, t, size=1.5), 2.0 + waves(rng, t)])

    return Home(card, 0.3, lambda rng: rng.uniform(1.0, 4.0, size=1), course)


HOMES: Mapping[str, Home] = {
    "mass": Home(
        {
            "time_unit": "s",
            "states": states(x="m", v="m/s"),
            "inputs": {"u": {"unit": "N"}},
            "parameters": numbers(k=4.0, d=0.3, m_=1.0),
            "equations": {"x": "v", "v": "(-k*x - d*v + u)/m"},
            "outputs": {"x": "x"},
        },
        0.15,
        lambda rng: rng.normal(size=2) * [0.8, 1.0],
        waves,
    ),
    "ball in a tube": Home(
        {
            "time_unit": "s",
            "states": states(h="m", v="m/s"),
            "inputs": {"u": {"unit": "1"}},
            "parameters": numbers(a=0.5, g_=9.81),
            "equations": {"h": "v", "v": "a*u**2 - g"},
            "outputs": {"h": "h"},
        },
        0.05,
        lambda rng: rng.normal(size=2) * [0.3, 1.5],
        lambda rng, t: 1.55 + waves(rng, t, size=0.15, slowest=1.5),
    ),
    "plate": Home(
        {
            "time_unit": "us",
            "states": states(x="um", v="um/us"),
            "inputs": {"u": {"unit": "V"}},
            "parameters": numbers(k=1.0, d=0.2, e=0.02),
            "equations": {"x": "v", "v": "-k*x - d*v + e*u**2"},
            "outputs": {"x": "x"},
        },
        0.3,
        lambda rng: rng.normal(size=2) * 0.05,
        lambda rng, t: 2.0 + waves(rng, t, size=0.2, slowest=0.3),
    ),
    "drone": Home(
        {
            "time_unit": "s",
            "states": states(h="m", v="m/s"),
            "inputs": {"u": {"unit": "N"}},
            "parameters": numbers(m_=1.5, g_=9.81, c=0.4),
            "equations": {"h": "v", "v": "(u - c*v)/m - g"},
            "outputs": {"h": "h"},
        },
        0.05,
        lambda rng: np.array([rng.uniform(0.9, 1.6), 0.0]),
        lambda rng, t: 14.45 + waves(rng, t, size=0.3, slowest=1.0),
    ),
    "lake": Home(
        {
            "time_unit": "a",
            "states": states(p="1"),
            "inputs": {"u": {"unit": "1/a"}},
            "parameters": numbers(s=0.6),
            "equations": {"p": "u - s*p"},
        },
        0.6,
        lambda rng: rng.uniform(0.2, 2.0, size=1),
        lambda rng, t: 0.3 + waves(rng, t, size=0.04, slowest=0.2),
    ),
    "cell": Home(
        {
            "time_unit": "s",
            "states": states(q="1"),
            "inputs": {"u": {"unit": "A", "interpolation": "zero_order"}},
            "parameters": {
                **numbers(Q_=3600.0),
                "a": {"value": 3.3, "unit": "V"},
                "b": {"value": 0.7, "unit": "V"},
                "R": {"value": 0.05, "unit": "V/A"},
            },
            "equations": {"q": "-u/Q"},
            "outputs": {"y": "a + b*q - R*u"},
        },
        10.0,
        lambda rng: rng.uniform(0.6, 0.9, size=1),
        lambda rng, t: rng.choice([-1.0, 0.0, 0.0, 1.0, 2.0], size=(1, len(t) // 8 + 1))[
            :, np.arange(len(t)) // 8
        ],
    ),
    "enzyme": Home(
        {
            "time_unit": "min",
            "states": states(s="mM", p="mM"),
            "parameters": {"V": {"value": 1.2, "unit": "mM/min"}, "K": {"value": 2.0, "unit": "mM"}},
            "equations": {"s": "-V*s/(K + s)", "p": "V*s/(K + s)"},
        },
        0.2,
        lambda rng: np.array([rng.uniform(2, 12), rng.uniform(0, 5)]),
    ),
    "rotor": Home(
        {
            "time_unit": "s",
            "states": states(x="mm", v="mm/s"),
            "inputs": {"a": {"unit": "rad"}, "w": {"unit": "rad/s"}},
            "parameters": numbers(k=4.0, d=0.3),
            "equations": {"x": "v", "v": "-k*x - d*v"},
            "outputs": {"x": "x"},
        },
        0.15,
        lambda rng: rng.normal(size=2) * [0.8, 1.0],
        spun,
    ),
    "mass without damping": Home(
        {
            "time_unit": "s",
            "states": states(x="m", v="m/s"),
            "inputs": {"u": {"unit": "N"}},
            "parameters": numbers(k=4.0, m_=1.0),
            "equations": {"x": "v", "v": "(-k*x + u)/m"},
            "outputs": {"x": "x"},
        },
        0.15,
        lambda rng: rng.normal(size=2) * [0.8, 1.0],
        waves,
    ),
    "mass without spring": Home(
        {
            "time_unit": "s",
            "states": states(x="m", v="m/s"),
            "inputs": {"u": {"unit": "N"}},
            "parameters": numbers(d=0.3, m_=1.0),
            "equations": {"x": "v", "v": "(-d*v + u)/m"},
            "outputs": {"x": "x"},
        },
        0.15,
        lambda rng: rng.normal(size=2) * [0.8, 1.0],
        waves,
    ),
    "pendulum": Home(
        {
            "time_unit": "s",
            "states": states(q="rad", w="rad/s"),
            "parameters": numbers(d=0.1, g_=9.81, l_=1.0),
            "equations": {"q": "w", "w": "-g/l*sin(q) - d*w"},
            "outputs": {"q": "q"},
        },
        0.1,
        lambda rng: rng.normal(size=2) * [1.0, 2.0],
    ),
    "pendulum on a trolley": Home(
        {
            "time_unit": "s",
            "states": states(th="rad", w="rad/s"),
            "inputs": {"a": {"unit": "m/s^2"}},
            "parameters": numbers(k=4.0, c=0.2),
            "equations": {"th": "w", "w": "-k*sin(th) - c*w - a"},
            "outputs": {"th": "th"},
        },
        0.15,
        lambda rng: rng.normal(size=2) * [0.8, 1.0],
        waves,
    ),
    "arm": Home(
        {
            "time_unit": "s",
            "states": states(q="rad", w="rad/s"),
            "inputs": {"u": {"unit": "N*m"}},
            "parameters": numbers(d=0.5, i_=1.0),
            "equations": {"q": "w", "w": "(u - d*w)/i"},
            "outputs": {"q": "q"},
        },
        0.1,
        lambda rng: rng.normal(size=2) * [1.5, 1.0],
        lambda rng, t: waves(rng, t, size=2.0),
    ),
    "double pendulum": Home(
        {
            "time_unit": "s",
            "states": states(a="rad", p="rad/s", b="rad", q="rad/s"),
            "parameters": numbers(g_=9.81, c=0.05),
            "equations": {
                "a": "p",
                "p": "(-2*g*sin(a) + cos(a - b)*g*sin(b) - sin(a - b)*(q**2 + cos(a - b)*p**2))"
                "/(2 - cos(a - b)**2) - c*p",
                "b": "q",
                "q": "(2*g*(cos(a - b)*sin(a) - sin(b)) + sin(a - b)*(2*p**2 + cos(a - b)*q**2))"
                "/(2 - cos(a - b)**2) - c*q",
            },
            "outputs": {"a": "a", "b": "b"},
        },
        0.04,
        lambda rng: rng.normal(size=4) * [0.6, 0.5, 0.6, 0.5],
    ),
    "two masses": Home(
        {
            "time_unit": "s",
            "states": states(x="m", v="m/s", y="m", w="m/s"),
            "inputs": {"u": {"unit": "N"}},
            "parameters": numbers(k=4.0, h=6.0, d=0.3, m_=1.0),
            "equations": {"x": "v", "v": "(-k*x - d*v + u)/m", "y": "w", "w": "(-h*y - d*w)/m"},
            "outputs": {"x": "x", "y": "y"},
        },
        0.15,
        lambda rng: rng.normal(size=4) * [0.8, 1.0, 0.8, 1.0],
        waves,
    ),
    "two driven masses": Home(
        {
            "time_unit": "s",
            "states": states(x="m", v="m/s", y="m", w="m/s"),
            "parameters": numbers(k=4.0, h=6.0, s=2.0, d=0.1),
            "equations": {
                "x": "v",
                "v": "-k*x - d*v + s*(y - x)",
                "y": "w",
                "w": "-h*y - d*w + s*(x - y)",
            },
            "outputs": {"x": "x", "y": "y"},
        },
        0.15,
        lambda rng: rng.normal(size=4) * [0.8, 1.0, 0.8, 1.0],
    ),
    "cart": Home(
        {
            "time_unit": "s",
            "states": states(v="m/s"),
            "inputs": {"u": {"unit": "m/s"}, "p": {"unit": "V"}},
            "parameters": numbers(g=0.4, d=0.3),
            "equations": {"v": "g*p - d*v"},
        },
        0.2,
        lambda rng: rng.normal(size=1),
        lambda rng, t: np.concatenate([waves(rng, t, size=0.7), waves(rng, t, size=1.0)]),
    ),
    "boat": Home(
        {
            "time_unit": "s",
            "states": states(v="m/s"),
            "inputs": {"u": {"unit": "m/s^2"}},
            "parameters": numbers(d=0.5),
            "equations": {"v": "u - d*v*Abs(v)"},
        },
        0.2,
        lambda rng: rng.normal(size=1),
        waves,
    ),
    "wind turbine": Home(
        {
            "time_unit": "s",
            "states": states(w="rad/s"),
            "inputs": {"u": {"unit": "m/s"}},
            "parameters": numbers(d=0.3, k=0.2),
            "equations": {"w": "k*u - d*w"},
        },
        0.2,
        lambda rng: rng.uniform(1.0, 4.0, size=1),
        lambda rng, t: 4.0 + waves(rng, t),
    ),
    "pipe": Home(
        {
            "time_unit": "s",
            "states": states(q="L/s"),
            "inputs": {"u": {"unit": "L/s**2"}},
            "parameters": numbers(d=0.2),
            "equations": {"q": "u - d*q"},
        },
        0.2,
        lambda rng: rng.normal(size=1),
        waves,
    ),
    "rotating frame": Home(
        {
            "time_unit": "s",
            "states": states(a="m", b="m"),
            "parameters": numbers(f=0.5, g=0.1, h=0.3),
            "equations": {"a": "f*b - g*a", "b": "-f*a - g*b - h"},
        },
        0.3,
        lambda rng: rng.normal(size=2),
    ),
    "rotating frame without damping": Home(
        {
            "time_unit": "s",
            "states": states(a="m", b="m"),
            "parameters": numbers(f=0.5, h=0.3),
            "equations": {"a": "f*b", "b": "-f*a - h"},
        },
        0.3,
        lambda rng: rng.normal(size=2),
    ),
    "rotating frame on resonance": Home(
        {
            "time_unit": "s",
            "states": states(a="m", b="m"),
            "parameters": numbers(f_=0.5, g=0.1, h=0.3),
            "equations": {"a": "f*b - g*a", "b": "-f*a - g*b - h"},
        },
        0.3,
        lambda rng: rng.normal(size=2),
    ),
    "prey and predator": Home(
        {
            "time_unit": "a",
            "states": states(n="1/km**2", p="1/km**2"),
            "parameters": numbers(r=1.0, b=0.5, e=0.25, m=0.75),
            "equations": {"n": "r*n - b*n*p", "p": "-m*p + e*n*p"},
        },
        0.3,
        lambda rng: np.array([3.0, 2.0]) * np.exp(rng.normal(size=2) * 0.6),
    ),
    "prey with limits and predator": Home(
        {
            "time_unit": "a",
            "states": states(n="1/km**2", p="1/km**2"),
            "parameters": numbers(r=1.0, s=0.1, b=0.5, e=0.25, m=0.5),
            "equations": {"n": "r*n - s*n**2 - b*n*p", "p": "-m*p + e*n*p"},
        },
        0.3,
        lambda rng: np.array([3.0, 1.5]) * np.exp(rng.normal(size=2) * 0.6),
    ),
    "two populations": Home(
        {
            "time_unit": "a",
            "states": states(n="1/km**2", p="1/km**2"),
            "parameters": numbers(r=1.0, K=4.0, s=0.8, L=3.0),
            "equations": {"n": "r*n*(1 - n/K)", "p": "s*p*(1 - p/L)"},
        },
        0.2,
        lambda rng: np.exp(rng.normal(size=2)),
    ),
    "fermenter": Home(
        {
            "time_unit": "h",
            "states": states(s="g/L", n="g/L", q="g/L"),
            "parameters": {"m": {"value": 0.5, "unit": "1/h"}, **numbers(k=1.0, y=0.5, a=2.0)},
            "equations": {"s": "-m*s/(k + s)*n/y", "n": "m*s/(k + s)*n", "q": "a*m*s/(k + s)*n"},
        },
        0.15,
        lambda rng: np.array([rng.uniform(6, 14), rng.uniform(0.3, 2), rng.uniform(0, 4)]),
    ),
    "chemostat": Home(
        {
            "time_unit": "h",
            "states": states(s="g/L", n="g/L"),
            "inputs": {"u": {"unit": "1/h", "interpolation": "zero_order"}},
            "parameters": {"m": {"value": 0.5, "unit": "1/h"}, **numbers(k=1.0, y=0.5, f_=15.0)},
            "equations": {"s": "u*(f - s) - m*s/(k + s)*n/y", "n": "m*s/(k + s)*n - u*n"},
        },
        0.4,
        lambda rng: np.array([rng.uniform(1, 14), rng.uniform(1, 4)]),
        lambda rng, t: np.repeat(rng.uniform(0.02, 0.2, (1, 8)), -(-len(t) // 8), axis=1)[:, : len(t)],
    ),
    "fermenter with a feed": Home(
        {
            "time_unit": "h",
            "states": states(n="g/L"),
            "inputs": {"u": {"unit": "1/h", "interpolation": "zero_order"}},
            "parameters": numbers(r=1.0, k=0.3),
            "equations": {"n": "r*n - k*n**2"},
        },
        0.3,
        lambda rng: np.array([rng.uniform(0.3, 4)]),
        lambda rng, t: inflow(rng, t, size=1.5),
    ),
    "mixer": mixed("K"),
    "salt mixer": mixed("g/L"),
    "culture": Home(
        {
            "time_unit": "h",
            "states": states(n="g/L", s="g/L"),
            "parameters": numbers(m=0.5, y=0.5),
            "equations": {"n": "m*n", "s": "-m*n/y"},
        },
        0.15,
        lambda rng: np.array([rng.uniform(0.3, 2), rng.uniform(6, 14)]),
    ),
    "inducible gene": Home(
        {
            "time_unit": "h",
            "states": states(s="nM"),
            "inputs": {"u": {"unit": "nM", "interpolation": "zero_order"}},
            "parameters": {name: {"value": value, "unit": "1/h"} for name, value in (("b", 2.0), ("d", 0.5))},
            "equations": {"s": "b*u - d*s"},
        },
        0.3,
        lambda rng: rng.uniform(0.0, 4.0, size=1),
        lambda rng, t: np.abs(inflow(rng, t)),
    ),
    "gene and protein": Home(
        {
            "time_unit": "min",
            "states": {"s": {"unit": "1", "domain": [0, 100]}, "r": {"unit": "1", "domain": [0, 100]}},
            "inputs": {"u": {"unit": "1", "interpolation": "zero_order"}},
            "parameters": {
                name: {"value": value, "unit": "1/min"}
                for name, value in {"b": 8.0, "d": 0.5, "k": 2.0, "g": 0.3}.items()
            },
            "equations": {"s": "b*u - d*s", "r": "k*s - g*r"},
        },
        0.4,
        lambda rng: rng.uniform(0.0, 10.0, size=2),
        lambda rng, t: np.abs(inflow(rng, t)),
    ),
    "two substances": Home(
        {
            "time_unit": "min",
            "states": states(s="mol/L", r="mol/L"),
            "parameters": numbers(k=0.4, l=0.2),
            "equations": {"s": "-k*s", "r": "k*s - l*r"},
        },
        0.15,
        lambda rng: rng.uniform(0.2, 3.0, size=2),
    ),
    "coil": Home(
        {
            "time_unit": "ms",
            "states": states(s="A"),
            "inputs": {"u": {"unit": "V", "interpolation": "zero_order"}},
            "parameters": numbers(g=0.8, l=1.5),
            "equations": {"s": "(u - g*s)/l"},
        },
        0.3,
        lambda rng: rng.uniform(-1.0, 1.0, size=1),
        inflow,
    ),
    "algae": Home(
        {
            "time_unit": "d",
            "states": states(n="1"),
            "inputs": {"u": {"unit": "klx", "interpolation": "zero_order"}},
            "parameters": numbers(a=0.6, b=0.5, c=0.1),
            "equations": {"n": "n*(a*u - b - c*n)"},
        },
        0.3,
        lambda rng: rng.uniform(0.3, 3.0, size=1),
        lambda rng, t: np.abs(inflow(rng, t)),
    ),
    "crop": Home(
        {
            "time_unit": "a",
            "states": states(n="t"),
            "parameters": numbers(r=1.0, c=0.2),
            "equations": {"n": "r*n - c*n**2"},
        },
        0.15,
        lambda rng: rng.uniform(0.3, 9.0, size=1),
    ),
    "crop of known growth": Home(
        {
            "time_unit": "a",
            "states": states(n="t"),
            "parameters": numbers(r_=1.0, c=0.2),
            "equations": {"n": "r*n - c*n**2"},
        },
        0.15,
        lambda rng: rng.uniform(0.3, 9.0, size=1),
    ),
    "heat": Home(
        {
            "time_unit": "s",
            "states": states(s="K", r="K"),
            "inputs": {"u": {"unit": "W"}},
            "parameters": numbers(g=1.0, h=0.2, c_=1.0),
            "equations": {"s": "g*u/c", "r": "h*(s - r)"},
        },
        0.2,
        lambda rng: rng.uniform(0.0, 4.0, size=2),
        lambda rng, t: waves(rng, t, size=1.0),
    ),
    "two bodies": Home(
        {
            "time_unit": "s",
            "states": states(s="K", r="K"),
            "inputs": {"u": {"unit": "W"}},
            "parameters": numbers(g=1.0, a=0.5, b=0.2),
            "equations": {"s": "g*u - a*s", "r": "-b*r + g*u"},
        },
        0.2,
        lambda rng: rng.uniform(0.0, 4.0, size=2),
        lambda rng, t: waves(rng, t, size=1.0),
    ),
    "two tanks": Home(
        {
            "time_unit": "s",
            "states": states(h="cm", g="cm"),
            "inputs": {"u": {"unit": "V", "interpolation": "zero_order"}},
            "parameters": numbers(a=1.0, b=1.0, c=1.2, e=1.0),
            "equations": {
                "h": "e*u - a*sqrt(Max(h, 0))",
                "g": "c*sqrt(Max(h, 0)) - b*sqrt(Max(g, 0))",
            },
        },
        0.3,
        lambda rng: rng.uniform(1.0, 4.0, size=2),
        lambda rng, t: inflow(rng, t, size=1.5),
    ),
    "circuit": Home(
        {
            "time_unit": "ms",
            "states": states(s="V"),
            "inputs": {"u": {"unit": "V"}},
            "parameters": numbers(g=0.4),
            "equations": {"s": "g*(u - s)"},
        },
        0.2,
        lambda rng: rng.uniform(-2.0, 2.0, size=1),
        lambda rng, t: waves(rng, t, size=1.5),
    ),
    "laser": Home(
        {
            "time_unit": "us",
            "states": states(p="W"),
            "inputs": {"u": {"unit": "1", "interpolation": "zero_order"}},
            "parameters": numbers(g=0.5, c=0.4, s=0.05),
            "equations": {"p": "g*u*p - c*p + s"},
        },
        0.3,
        lambda rng: rng.uniform(0.1, 2.0, size=1),
        inflow,
    ),
    "furnace": warmed("g*u - h*(s - 300)", {"s": "K", "u": "W"}, (300.0, 1000.0), g=100.0),
    "kettle": warmed("g*u - h*s", {"s": "°C", "u": "W"}, (20.0, 300.0), g=20.0),
    "pond": warmed("g*u - h*(s - 15)", {"s": "°C", "u": "kW"}, (20.0, 80.0), time="h", g=2.0),
    "hut": warmed("g - h*s", {"s": "K", "u": "K"}, (20.0, 80.0), time="h", size=20.0, g=3.0),
    "heated reactor": Home(
        {
            "time_unit": "h",
            "states": states(s="mol/L"),
            "inputs": {"u": {"unit": "°C"}},
            "parameters": numbers(k=0.3, g_=0.5),
            "equations": {"s": "g - k*s"},
        },
        0.3,
        lambda rng: rng.uniform(0.5, 2.5, size=1),
        lambda rng, t: 25.0 + waves(rng, t, size=4.0),
    ),
    "lamp": Home(
        {
            "time_unit": "s",
            "states": states(s="K"),
            "inputs": {"u": {"unit": "A"}},
            "parameters": numbers(k=0.5),
            "equations": {"s": "-k*s"},
        },
        0.2,
        lambda rng: rng.uniform(0.0, 2.0, size=1),
        waves,
    ),
    "basins": Home(
        {
            "time_unit": "s",
            "states": states(h="m", g="m"),
            "inputs": {"u": {"unit": "m/s", "interpolation": "zero_order"}},
            "parameters": numbers(e=1.0, k=0.2),
            "equations": {"h": "e*u", "g": "e*u - k*g"},
        },
        0.3,
        lambda rng: rng.uniform(1.0, 4.0, size=2),
        lambda rng, t: inflow(rng, t, size=0.5),
    ),
    "epidemic": Home(
        {
            "time_unit": "d",
            "states": states(s="1", i="1"),
            "parameters": numbers(b=0.5, g=0.2),
            "equations": {"s": "-b*s*i", "i": "b*s*i - g*i"},
        },
        1.5,
        lambda rng: np.array([rng.uniform(0.4, 0.95), rng.uniform(0.01, 0.1)]),
    ),
    "epidemic with those who recovered": Home(
        {
            "time_unit": "d",
            "states": states(s="1", i="1", r="1"),
            "parameters": numbers(b=0.5, g=0.2),
            "equations": {"s": "-b*s*i", "i": "b*s*i - g*i", "r": "g*i"},
        },
        1.5,
        lambda rng: np.array([rng.uniform(0.4, 0.8), rng.uniform(0.01, 0.1), rng.uniform(0.0, 0.2)]),
    ),
}

RESIDENTS: Sequence[Resident] = (
    Resident("linear stiffness", "mass without spring", {"c": 3.0}),
    Resident("linear stiffness", "rotating frame on resonance", {"c": 0.1}),
    Resident("geometric stiffness", "mass", {"c": 4.0, "a": 0.5}),
    Resident("preload", "mass", {"c": 0.8}),
    Resident("backlash", "mass", {"c": 3.0, "a": 0.3}),
    Resident("backlash", "mass", {"a": 0.4}, "or dead zone"),
    Resident("backlash", "two masses", {"c": 1.5, "d": 1.5, "a": 0.4}),
    Resident("backlash", "mass", {"a": 0.1}, "of what is measured"),
    Resident("backlash", "mass", {"a": 0.6, "tau": 0.15}, "in what u moves"),
    Resident("gravity", "arm", {"c": 3.0}),
    Resident("gravity", "arm", {"d": 2.0}),
    Resident("gravity", "arm", {"c": 2.0, "d": 1.5}),
    Resident("added mass", "mass", {"c": 0.3}),
    Resident("moment of inertia", "pendulum", {"c": 0.3}),
    Resident("moment of inertia", "double pendulum", {"c": 0.15, "d": 0.2, "p": 0.5, "q": 1.0}),
    Resident("linear damping", "mass without damping", {"c": 0.4}),
    Resident("linear damping", "rotating frame without damping", {"c": 0.15}),
    Resident("quadratic stiffness", "mass", {"c": 0.4}),
    Resident("cubic stiffness", "mass", {"c": 1.0}),
    Resident("cubic stiffness", "rotating frame", {"c": 0.2}),
    Resident("quintic stiffness", "mass", {"c": 0.5}),
    Resident("quintic stiffness", "rotating frame", {"c": 0.05}),
    Resident("quadratic drag", "mass", {"c": 0.4}),
    Resident("quadratic drag", "rotating frame", {"c": 0.2}),
    Resident("quadratic drag", "pipe", {"c": 0.4}),
    Resident("cubic damping", "mass", {"c": 0.2}),
    Resident("eddy-current brake", "mass without damping", {"c": 1.5, "w": 0.5}),
    Resident("amplitude-dependent damping", "rotating frame", {"c": 0.1}),
    Resident("dry friction", "mass", {"c": 0.4}),
    Resident("dry friction", "mass", {"c": 0.4, "w": 0.05}, "creeps"),
    Resident("dry friction", "rotating frame", {"c": 0.03}),
    Resident("Coulomb and viscous friction", "mass without damping", {"c": 0.2, "d": 0.3}),
    Resident("rolling resistance and drag", "mass", {"c": 0.2, "d": 0.3}),
    Resident("linear and quadratic drag", "mass without damping", {"c": 0.1, "d": 0.2}),
    Resident("asymmetric friction", "mass", {"c": 0.5, "d": 0.15}),
    Resident("asymmetric damping", "mass", {"c": 0.5}),
    Resident("asymmetric damping", "mass without damping", {"c": 0.5, "d": 0.15}),
    Resident("wind or current", "boat", {"w": 0.4}),
    Resident("Stribeck friction", "mass", {"c": 0.3, "s": 0.6, "w": 0.5}),
    Resident("position-dependent damping", "mass", {"c": 0.8}),
    Resident("constant bias", "mass", {"c": 0.8}),
    Resident("linear coupling", "two bodies", {"c": 0.3, "d": 0.3}),
    Resident("linear coupling", "two masses", {"c": 0.5, "d": 0.5}, "-v + w"),
    Resident("linear coupling", "two masses", {"c": 1.5, "d": 1.5}, "-x + y"),
    Resident("linear coupling", "heat", {"c": 0.3}),
    Resident("nonlinear coupling", "two masses", {"c": 1.0, "d": 1.0}),
    Resident("nonlinear coupling", "prey and predator", {"c": -0.05}, "n*p**2"),
    Resident("nonlinear coupling", "prey with limits and predator", {"c": -0.05}, "n**2*p"),
    Resident("competition", "two populations", {"c": 0.15, "d": 0.2}),
    Resident("competition", "two populations", {"c": 0.15}, "in n"),
    Resident("mutualism", "two populations", {"c": 0.1}, "in p"),
    Resident("self-limitation", "prey and predator", {"c": 0.05}),
    Resident("mortality", "crop of known growth", {"c": 0.3}),
    Resident("harvest", "crop", {"c": 1.0, "w": 0.8}),
    Resident("Allee effect", "crop", {"c": 1.6, "w": 1.0}),
    Resident("inhibition", "fermenter", {"w": 4.0}, "of m by q in"),
    Resident("inhibition", "fermenter", {"c": 0.05}, "in proportion"),
    Resident("inhibition", "chemostat", {"w": 5.0}, "of m by s in"),
    Resident("inhibition", "gene and protein", {"w": 8.0, "n": 1.0}, "of b by r"),
    Resident("inhibition", "inducible gene", {"w": 1.5, "n": 3.0}, "by s itself"),
    Resident("inhibition", "enzyme", {"w": 3.0}, "by p, competitive"),
    Resident("prey refuge", "prey and predator", {"m": 0.8}),
    Resident("sigmoid functional response", "prey with limits and predator", {"w": 1.5}, "with satiation"),
    Resident("sigmoid functional response", "prey and predator", {"w": 0.8}, "without satiation"),
    Resident("predator interference", "prey with limits and predator", {"k": 0.3}),
    Resident("predator interference", "prey with limits and predator", {"h": 0.1, "k": 0.3}),
    Resident("decay or leakage", "heat", {"c": 0.3}),
    Resident("decay or leakage", "heat", {"c": 0.3, "d": 0.8}),
    Resident("delayed response", "prey with limits and predator", {"c": 1.0, "tau": 1.0}, "stage in p"),
    Resident("delayed response", "prey with limits and predator", {"c": 1.0, "tau": 1.5}, "stages in p"),
    Resident("delayed response", "heat", {"c": 1.0, "tau": 1.5}, "one stage"),
    Resident("saturation", "mass", {"c": 0.5}),
    Resident("saturation", "mass", {"a": 0.8}, "at a limit"),
    Resident("saturation", "prey with limits and predator", {"h": 0.2}),
    Resident("parametric drive", "mass", {"c": 1.0, "d": 0.5, "w": 3.0}),
    Resident("parametric drive", "rotating frame", {"c": 0.1, "d": 0.05}),
    Resident("parameter drift", "mass", {"r": 0.03}, "drift in v"),
    Resident("parameter drift", "mass", {"r": 0.15}, "as a decay"),
    Resident("periodic forcing", "mass", {"c": 0.5, "d": 0.3, "w": 3.0}),
    Resident("overflow", "two tanks", {"c": 1.0, "L": 2.5}),
    Resident("overflow", "two tanks", {"c": 1.0, "d": 0.6, "L": 2.5}, "h, g"),
    Resident("overflow", "two tanks", {"c": 1.0, "d": 0.8, "L": 2.2, "M": 3.0}, "h, g"),
    Resident("flow over a weir", "basins", {"c": 0.15}, "in h"),
    Resident("flow over a weir", "basins", {"c": 0.4, "L": 2.0}, "in h"),
    Resident("leak", "two tanks", {"c": 0.3}, "in h"),
    Resident("leak", "two tanks", {"c": 0.3, "d": 0.2}, "h, g"),
    Resident("input delay", "mass", {"tau": 0.3}),
    Resident("elastic stop", "mass", {"c": 8.0, "a": 0.5}, "from above"),
    Resident("elastic stop", "mass", {"c": 8.0, "a": -0.4}, "from below"),
    Resident("elastic stop", "mass", {"c": 8.0, "a": 0.6}, "on both sides"),
    Resident("viscoelastic relaxation", "mass", {"c": 2.0, "tau": 0.6}),
    Resident("hysteresis", "mass", {"c": 2.0, "b": 1.5, "g": 0.5}),
    Resident("sensor gain or offset", "mass", {"g": 0.2}),
    Resident("sensor gain or offset", "mass", {"o": 0.3}),
    Resident("sensor gain or offset", "mass", {"g": 0.2, "o": 0.3}),
    Resident("thermal drift", "mass", {"r": 0.05}, "of the zero"),
    Resident("thermal drift", "mass", {"r": 0.04}, "of the gain"),
    Resident("thermal drift", "mass", {"c": 0.5, "tau": 3.0}),
    Resident("sensor lag", "mass", {"tau": 0.1}),
    Resident("quantisation", "mass", {"c": 1.0, "q": 0.3}),
    Resident("clipping", "mass", {"L": 1.2}, "above"),
    Resident("clipping", "mass", {"L": -1.2}, "below"),
    Resident("clipping", "mass", {"H": 1.2, "L": -1.0}),
    Resident("rectification", "cart", {"c": 1.0}),
    Resident("quadratic drag", "cart", {"c": 0.3}, "relative to u"),
    Resident("quadratic drag", "ball in a tube", {"c": 0.35, "k": 3.2}, "that u drives"),
    Resident("ground effect", "drone", {"c": 0.03}),
    Resident("pull across a gap", "plate", {"c": 0.4}),
    Resident("sigmoid feedback", "lake", {"c": 0.5, "w": 1.0, "n": 4.0}),
    Resident("overpotential", "cell", {"c": 0.03, "tau": 60.0}),
    Resident("input gain", "cart", {"c": 0.3}, "'v', c_1*u"),
    Resident("Joule heating", "lamp", {"c": 2.0}),
    Resident("unbalance", "rotor", {"c": 0.5, "d": 0.2}),
    Resident("lever arm", "pendulum on a trolley", {"c": 1.0}),
    Resident("dependence on an input", "cart", {"c": 0.5}, "of d on u"),
    Resident("thrust of a propeller", "cart", {"c": 0.3}, "p*Abs(p)"),
    Resident("actuator lag", "mass", {"tau": 0.5}),
    Resident("hidden capacity", "hut", {"c": 0.5, "tau": 4.0, "eta": 30.0}, "next to u"),
    Resident("hidden capacity", "heat", {"c": 0.5, "tau": 3.0}, "capacity in s"),
    Resident("hidden capacity", "heat", {"c": 0.5, "tau": 3.0}, "empty at first in s"),
    Resident("maturation delay", "crop", {"tau": 2.0}, "three stages"),
    Resident("maturation delay", "crop", {"tau": 2.0}, "one length"),
    Resident("delayed self-limitation", "crop", {"tau": 0.8}),
    Resident("washout", "fermenter with a feed", {"c": 0.3}),
    Resident("washout", "salt mixer", {"c": 0.3, "d": 0.8}),
    Resident("washout", "salt mixer", {"c": 0.3}, "by what has w"),
    Resident("exchange with a flow", "mixer", {"c": 0.3, "d": 0.8}),
    Resident("exchange with a flow", "mixer", {"c": 0.3}, "that has w"),
    Resident("saturated elimination", "heat", {"c": 1.0, "w": 1.0}, "in s"),
    Resident("diode or exponential loss", "circuit", {"c": 0.05, "w": 0.3}),
    Resident("thermal radiation", "furnace", {"c": 2e-10}),
    Resident("thermal radiation", "kettle", {"c": 1e-9}),
    Resident("overflow", "basins", {"c": 1.0, "L": 3.0}, "in h"),
    Resident("outflow through an opening", "basins", {"c": 0.4}, "in h"),
    Resident("linear coupling", "basins", {"c": 0.3, "d": 0.3}),
    Resident("reverse reaction or backflow", "two bodies", {"c": 0.3}),
    Resident("adaptation", "heat", {"c": 0.5, "tau": 3.0}, "in s"),
    Resident("adaptation", "heat", {"b": 0.5, "c": 0.5, "tau": 3.0}, "level in s"),
    Resident("decay or leakage", "hut", {"c": 0.3}, "to u"),
    Resident("temperature dependence", "heated reactor", {"c": 20.0}),
    Resident("latent heat", "kettle", {"c": 3.0, "m": 120.0, "w": 30.0}),
    Resident("limited throughput", "heat", {"c": 0.15, "L": 1.5}, "in r"),
    Resident("gas spring", "mass", {"c": 1.0, "h": 4.0, "n": 1.3}),
    Resident("fatigue or depletion", "circuit", {"c": 0.5, "tau": 8.0}),
    Resident("pressure of a flow", "wind turbine", {"c": 0.1}),
    Resident("lag phase", "crop", {"c": 1.0, "n": 2.0, "l": 2.0}),
    Resident("cooling by evaporation", "pond", {"c": 0.05, "d": 0.1}),
    Resident("waning immunity", "epidemic", {"c": 0.05, "N": 1.0}),
    Resident("recruitment", "epidemic", {"c": 0.05, "N": 1.0}),
    Resident("waning immunity", "epidemic with those who recovered", {"c": 0.05}),
    Resident("seasonality", "crop", {"c": 0.3, "d": 0.2, "w": 3.0}),
    Resident("seasonality", "epidemic", {"c": 0.3, "d": 0.2, "w": 0.5}, "of meetings"),
    Resident("saturation", "crop", {"h": 0.3}, "of growth"),
    Resident("Allee effect", "crop", {"a": 1.5}, "threshold"),
    Resident("saturation", "laser", {"h": 0.5}, "of the gain"),
    Resident("Gompertz growth", "crop of known growth", {"c": 0.5}),
    Resident("Richards growth", "crop of known growth", {"w": 4.0, "n": 3.0}),
    Resident("second-order reaction", "two substances", {"c": 0.3}, "in s"),
    Resident("second-order reaction", "two substances", {"c": 0.2}, "in s, r"),
    Resident("saturation", "inducible gene", {"w": 1.0}, "threshold"),
    Resident("attached oscillator", "mass", {"m": 0.3, "tau": 0.6, "d": 0.1}),
    Resident("rate limit", "circuit", {"r": 0.25}),
    Resident("magnetic saturation", "coil", {"c": 0.4}),
    Resident("photoinhibition", "algae", {"h": 0.4}),
    Resident("photoinhibition", "algae", {"h": 0.5, "k": 0.6}, "beyond a saturation"),
    Resident("limiting resource", "culture", {"w": 1.0}, "of m"),
    Resident("thermal radiation", "furnace", {"c": 2e-10, "d": 5.0}, "to surroundings"),
    Resident("thermal radiation", "kettle", {"c": 1e-9, "d": 6.0}, "to surroundings"),
    Resident("cogging or gear ripple", "arm", {"c": 1.0, "d": 0.5, "n": 3.0}),
    Resident("clock offset and drift", "mass", {"o": 0.06}),
    Resident("clock offset and drift", "mass", {"o": 0.05, "r": 0.01}),
    Resident("clock offset and drift", "two driven masses", {"o": 0.06}),
)  # fmt: skip


@cache  # of homes, which are there once
def candidates(model: Dynamics) -> tuple[MechanismCandidate, ...]:
    """All that the dictionary has for a model."""
    return tuple(candidates_of(model, roles_of(model), standard_dictionary()))


def truth_of(resident: Resident) -> MechanismCandidate:
    """The candidate whose model is the truth, with its parameters' values in it."""
    for candidate in candidates(HOMES[resident.home].model):
        stems = {name.rsplit("_", 1)[0]: name for name in candidate.new}
        said = f"{candidate.label} {candidate.changes}"
        if candidate.name == resident.name and set(stems) == set(resident.values) and resident.label in said:
            new = {stems[stem]: value for stem, value in resident.values.items()}
            values = [new.get(each.name, each.value) for each in candidate.model.parameters]
            return replace(candidate, model=candidate.model.with_values(np.array(values)))
    raise LookupError(f"{resident} has no home")


def recorded(resident: Resident, *, seed: int = 1) -> Measurements:
    """Recordings of the system that has the mechanism, with noise of one per cent."""
    home, truth = HOMES[resident.home], truth_of(resident)
    rng = np.random.default_rng(seed)
    t = home.step * np.arange(home.samples)
    before = home.model
    tables = [
        pd.DataFrame({"recording": f"r{place}", "t": t}).assign(
            **dict.fromkeys(before.output_names, 0.0),
            **dict(zip([each.name for each in before.inputs], home.drive(rng, t), strict=True)),
        )
        for place in range(home.recordings)
    ]
    empty = _measurements_of(pd.concat(tables), before)
    begin = np.stack([home.begin(rng) for _ in range(home.recordings)], axis=1)
    states = simulated(truth, empty, begin)
    known, signals = before.dimension, empty.signals(empty.t, empty.recording, delays=())
    clean = before.functions.outputs(states[:known], signals, before.values)
    noise = NOISE * clean.std(axis=1, keepdims=True) * rng.normal(size=clean.shape)
    signals = empty.signals(empty.t, empty.recording, delays=truth.model.lags(truth.model.values))
    measured = truth.model.functions.outputs(states, signals, truth.model.values) + noise
    if resident.name == "quantisation":  # noise is there before a sensor rounds
        step = resident.values["q"]
        measured = step * np.rint((clean + noise) / step)
    return replace(empty, outputs=np.ascontiguousarray(measured.T))


def simulated(truth: MechanismCandidate, data: Measurements, begin: np.ndarray) -> np.ndarray:
    """States at all samples, shape ``(d, n)``, from those at the begins, ``(k, recordings)``.

    States that the mechanism brings begin where its entry says.
    """
    model, grid = truth.model, Grid(data, FINE)
    delays = model.lags(model.values)
    count, length = len(data.labels), len(data.t) // len(data.labels)
    x = np.zeros((model.dimension, count))
    x[: len(begin)] = begin
    if truth.begins:
        rows = along(truth.begins, model, data, np.repeat(x, length, axis=1).T)
        x[len(begin) :] = rows[:, ::length]
    path = np.empty((model.dimension, count, length))
    nodes = [grid.signals(node, delays) for node in range(3 * FINE)]

    def rates(at: np.ndarray, node: int, rows: np.ndarray) -> np.ndarray:
        s = nodes[node]
        here = Signals(s.inputs[:, rows], s.delayed[:, rows], s.slopes[:, rows], s.t[rows])
        return model.functions.rates(at, here, model.values)

    for sample in range(length):
        path[:, :, sample] = x
        if sample == length - 1:
            break
        rows = np.arange(count) * (length - 1) + sample
        h = grid.step[rows]
        for part in range(FINE):
            k1 = rates(x, 3 * part, rows)
            k2 = rates(x + h / 2 * k1, 3 * part + 1, rows)
            k3 = rates(x + h / 2 * k2, 3 * part + 1, rows)
            k4 = rates(x + h * k3, 3 * part + 2, rows)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return path.reshape(model.dimension, -1)
