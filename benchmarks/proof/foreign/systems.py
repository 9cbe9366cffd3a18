"""Random systems of two to six states, and what is done to them.

A *polynomial* system has random rotations and random products, held together by cubes. A *rational* one is a
network of stores that further or hinder one another, each emptying in proportion to what it holds. A
*mechanical* one is a chain of masses on random springs that stiffen. What leaves its bounds is drawn again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.proof.cases import rounded

FIXED = 0.5  # share of the parameters of which the author of a card is sure
DRIVEN = 0.5  # share of the systems that have an input
HIDDEN = 0.3  # share of the systems of three states or more, not mechanical, of which one is not measured
SPREAD = 0.5  # factor by which parameters differ from one system to the next, as the deviation of a logarithm


@dataclass(frozen=True)
class RandomSystem:
    """A system, and how it is set in motion.

    Attributes
    ----------
    family
        ``polynomial``, ``rational`` or ``mechanical``.
    states, equations
        Names, and the time derivative of each, as a formula.
    parameters
        Their values.
    fixed
        Parameters of which the author of the card is sure.
    units
        Of states, parameters and the input, by name.
    time_unit
        Of t.
    outputs
        What is measured, as formulas by name.
    acceptors
        States in whose equations something can be missing.
    driven
        Whether there is an input ``u``.
    held
        Whether the input is held from one tick of its clock to the next, or goes straight.
    interval
        Time between two ticks.
    box
        Interval of the first values of each state, shape ``(d, 2)``.
    """

    family: str
    states: tuple[str, ...]
    equations: tuple[str, ...]
    parameters: Mapping[str, float]
    fixed: frozenset[str]
    units: Mapping[str, str]
    time_unit: str
    outputs: Mapping[str, str]
    acceptors: tuple[str, ...]
    driven: bool
    held: bool
    interval: float
    box: np.ndarray

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return ("u",) if self.driven else ()

    @property
    def free(self) -> tuple[str, ...]:
        """Parameters that may be wrong on a card."""
        return tuple(name for name in self.parameters if name not in self.fixed)

    def card(self, values: Mapping[str, float]) -> dict[str, Any]:
        """What a card says of it, with some values of its parameters."""
        parameters = {
            name: {"value": values[name], "unit": self.units[name]}
            | ({"fixed": True} if name in self.fixed else {})
            for name in self.parameters
        }
        card: dict[str, Any] = {
            "name": "system",
            "time_unit": self.time_unit,
            "states": {name: {"unit": self.units[name]} for name in self.states},
            "parameters": parameters,
            "equations": dict(zip(self.states, self.equations, strict=True)),
            "outputs": dict(self.outputs),
            "diffusion": "identity",
        }
        if self.driven:
            how = "zero_order" if self.held else "linear"
            card["inputs"] = {"u": {"unit": self.units["u"], "interpolation": how}}
        return card


@dataclass
class _Draft:
    """A system in the making: right-hand sides as sums of terms, each coefficient being a parameter."""

    rng: np.random.Generator
    states: tuple[str, ...]
    terms: dict[str, list[str]] = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)

    def parameter(self, value: float, unit: str = "1") -> str:
        """The name of a new parameter, of about this value."""
        name = f"p{len(self.parameters) + 1}"
        self.parameters[name] = rounded(value * float(np.exp(SPREAD * self.rng.uniform(-1, 1))))
        self.units[name] = unit
        return name

    def add(self, state: str, text: str) -> None:
        self.terms.setdefault(state, []).append(text)

    def finished(self, *, units: Mapping[str, str], **other: Any) -> RandomSystem:
        """The system, with about half of its parameters fixed, and two free at least."""
        names = list(self.parameters)
        count = min(int(self.rng.binomial(len(names), FIXED)), len(names) - 2)
        sure = map(str, self.rng.choice(names, size=count, replace=False))
        return RandomSystem(
            states=self.states,
            equations=tuple(" + ".join(self.terms[name]).replace("+ -", "- ") for name in self.states),
            parameters=self.parameters,
            fixed=frozenset(sure),
            units={**units, **self.units},
            held=bool(self.rng.random() < 0.5),
            **other,
        )


def polynomial_system(rng: np.random.Generator) -> RandomSystem:
    """Damped rotations in two to six dimensions with random products, held together by cubes."""
    d = int(rng.integers(2, 7))
    states = tuple(f"x{number + 1}" for number in range(d))
    draft = _Draft(rng, states)
    for name in states:
        draft.add(name, f"-{draft.parameter(0.3)}*{name}")
        draft.add(name, f"-{draft.parameter(0.15)}*{name}**3")
    order = rng.permutation(d)
    for here, there in pairwise(order):
        one, other = states[here], states[there]
        draft.add(one, f"{draft.parameter(1.5)}*{other}")
        draft.add(other, f"-{draft.parameter(1.5)}*{one}")
    for _ in range(d):
        where, first, second = (states[int(k)] for k in rng.integers(0, d, 3))
        sign = rng.choice(["", "-"])
        draft.add(where, f"{sign}{draft.parameter(0.25)}*{first}*{second}")
    driven = bool(rng.random() < DRIVEN)
    if driven:
        draft.add(states[int(rng.integers(d))], f"{draft.parameter(1.0)}*u")
    return draft.finished(
        family="polynomial",
        driven=driven,
        interval=rounded(rng.uniform(0.08, 0.15), 3),
        box=np.tile([-1.5, 1.5], (d, 1)),
        units={**dict.fromkeys(states, "1"), "u": "1"},
        time_unit="1",
        outputs=_some_measured(states, rng),
        acceptors=states,
    )


def rational_system(rng: np.random.Generator) -> RandomSystem:
    """Two to six stores that fill at rates which others further or hinder, and empty by themselves."""
    d = int(rng.integers(2, 7))
    states = tuple(f"m{number + 1}" for number in range(d))
    draft = _Draft(rng, states)
    unit = str(rng.choice(["1", "mol/L", "g/L"]))
    rate = "1/s" if unit == "1" else f"{unit}/s"
    order = rng.permutation(d)
    for place, name in enumerate(states):
        draft.add(name, draft.parameter(0.2, rate))
        draft.add(name, f"-{draft.parameter(0.8, '1/s')}*{name}")
        # A ring in random order, and now and then another arrow.
        sources = [states[order[(int(np.flatnonzero(order == place)[0]) + 1) % d]]]
        if rng.random() < 0.5:
            sources.append(states[int(rng.integers(d))])
        for source in sources:
            most, half = draft.parameter(1.5, rate), draft.parameter(0.8, unit)
            power = int(rng.integers(1, 5))
            above = f"{source}**{power}" if rng.random() < 0.5 else f"{half}**{power}"
            draft.add(name, f"{most}*{above}/({half}**{power} + {source}**{power})")
    driven = bool(rng.random() < DRIVEN)
    if driven:
        where = states[int(rng.integers(d))]
        draft.add(where, f"{draft.parameter(0.5, '1/s')}*u")
    return draft.finished(
        family="rational",
        driven=driven,
        interval=rounded(rng.uniform(0.08, 0.2), 3),
        box=np.tile([0.05, 3.0], (d, 1)),
        units={**dict.fromkeys(states, unit), "u": unit},
        time_unit="s",
        outputs=_some_measured(states, rng),
        acceptors=states,
    )


def mechanical_system(rng: np.random.Generator) -> RandomSystem:
    """A chain of one to three masses on springs that stiffen, the first one now and then driven."""
    masses = int(rng.integers(1, 4))
    positions = tuple(f"q{number + 1}" for number in range(masses))
    speeds = tuple(f"w{number + 1}" for number in range(masses))
    states = tuple(name for pair in zip(positions, speeds, strict=True) for name in pair)
    draft = _Draft(rng, states)
    for q, w in zip(positions, speeds, strict=True):
        draft.add(q, w)
        draft.add(w, f"-{draft.parameter(30.0, '1/s**2')}*{q}")
        draft.add(w, f"-{draft.parameter(0.6, '1/s')}*{w}")
        if rng.random() < 0.5:
            draft.add(w, f"-{draft.parameter(15.0, '1/(m**2*s**2)')}*{q}**3")
    for number in range(masses - 1):
        stiff = draft.parameter(8.0, "1/s**2")
        ratio = draft.parameter(1.0)
        apart = f"({positions[number + 1]} - {positions[number]})"
        draft.add(speeds[number], f"{stiff}*{apart}")
        draft.add(speeds[number + 1], f"-{ratio}*{stiff}*{apart}")
    driven = bool(rng.random() < DRIVEN)
    if driven:
        draft.add(speeds[0], f"{draft.parameter(1.0, '1/kg')}*u")
    measured = states if rng.random() < 0.4 else positions
    return draft.finished(
        family="mechanical",
        driven=driven,
        interval=rounded(rng.uniform(0.03, 0.05), 3),
        box=np.tile([[-1.0, 1.0], [-5.0, 5.0]], (masses, 1)),
        units={**dict.fromkeys(positions, "m"), **dict.fromkeys(speeds, "m/s"), "u": "N"},
        time_unit="s",
        outputs={name: name for name in measured},
        acceptors=speeds,
    )


def _some_measured(states: tuple[str, ...], rng: np.random.Generator) -> dict[str, str]:
    hidden = states[int(rng.integers(len(states)))] if len(states) > 2 and rng.random() < HIDDEN else None
    return {name: name for name in states if name != hidden}


FAMILIES: Mapping[str, Callable[[np.random.Generator], RandomSystem]] = {
    "polynomial": polynomial_system,
    "rational": rational_system,
    "mechanical": mechanical_system,
}


@dataclass(frozen=True)
class Experiment:
    """What is done to a system; recordings are of unequal length.

    Attributes
    ----------
    lengths
        Ticks of each recording, shape ``(R,)``.
    starts
        First states, shape ``(d, R)``.
    drive
        The input at each tick, shape ``(R, longest)``; zero where there is none.
    """

    lengths: np.ndarray
    starts: np.ndarray
    drive: np.ndarray


RECORDINGS = (1, 2, 3, 4, 5, 6, 8)
SAMPLES = (300, 1200)  # in all, of two states; of more states fewer, so that each case takes as long
LONGEST, SHORTEST = 400, 40  # of a recording


def draw_experiment(system: RandomSystem, rng: np.random.Generator) -> Experiment:
    """A few recordings of unequal length from random first states, with random tones as input."""
    recordings = int(rng.choice(RECORDINGS))
    share = np.exp(rng.uniform(-0.7, 0.7, recordings))
    total = max(rng.integers(*SAMPLES) * np.sqrt(2 / len(system.states)), SAMPLES[0])
    lengths = np.clip(total * share / share.sum(), SHORTEST, LONGEST).astype(int)
    low, high = system.box.T
    starts = rng.uniform(low[:, None], high[:, None], (len(low), recordings))
    times = system.interval * np.arange(lengths.max())
    drive = np.zeros((recordings, len(times)))
    if system.driven:
        nyquist = np.pi / system.interval
        rates = nyquist * np.exp(rng.uniform(np.log(0.01), np.log(0.15), (recordings, 6)))
        phases = rng.uniform(0, 2 * np.pi, rates.shape)
        size = {"polynomial": 1.0, "rational": 0.5, "mechanical": 12.0}[system.family]
        drive = size / np.sqrt(3) * np.sin(rates[..., None] * times + phases[..., None]).sum(axis=1)
        drive *= np.exp(rng.uniform(-1, 0, recordings))[:, None]
        if system.family == "rational":
            drive = np.abs(drive)  # nothing is taken out of a store
    return Experiment(lengths, starts, drive)
