"""Effects: what a simulation may lack, once as formulas for the key and once as functions for the truth.

Both are written down by hand. A test holds them against each other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from benchmarks.proof.cases import rounded as to_digits
from benchmarks.proof.concealment.physics import Values

Named = Mapping[str, Any]  # states, and t, by their names
Formulas = Mapping[str, str]


@dataclass(frozen=True)
class Friction:
    """A force that jumps where a velocity changes its sign, and that can hold what rests.

    Attributes
    ----------
    velocity
        The state whose sign matters; the force acts in its equation.
    force
        Maps the velocity, the direction of motion (-1 to 1) and the effect's parameters to the force per
        mass.
    """

    velocity: str
    force: Callable[[Any, Any, Values], Any]


@dataclass(frozen=True)
class Effect:
    """One piece of physics that stands in the recordings and not in the card.

    Attributes
    ----------
    name
        Its name in the dictionary of the diagnosis, or for withheld effects a name of its own.
    equations
        The states in whose equations it stands; none for sensors.
    coordinates
        The names that count as the right answer to "along which coordinate?".
    parameters
        Its parameters. They have names that no card has.
    scaled
        The parameters that make it stronger or weaker.
    limit
        True where strength is no linear function of `scaled`, whose values are then the largest ones allowed.
    terms, states, replaced, outputs, noise
        Formulas: terms to be added to equations; equations of its own states, which start at zero; what
        takes the place of a parameter or an input; outputs; and the σ of noise σ dW in equations.
    added
        Maps states and t by name and the effect's parameters to what is added to each equation, and to the
        rates of its own states.
    changed
        Maps states and t by name, the card's parameters and the effect's to parameters with other values.
    driven
        Maps an input and the effect's parameters to the input that acts.
    lag
        The parameter that says how late inputs arrive.
    switches
        Functions of the states by name and the effect's parameters. Where one crosses zero a law has a kink
        or a jump; their signs reach `added` as ``sides``.
    friction
        A force that jumps. The velocity is then the first and only switch.
    measured
        Maps an output and the effect's parameters to what the sensor says; of the output named in `outputs`.
    """

    name: str
    equations: tuple[str, ...]
    coordinates: tuple[str, ...]
    parameters: Mapping[str, float]
    scaled: tuple[str, ...] = ("c",)
    limit: bool = False
    terms: Formulas = field(default_factory=dict)
    states: Formulas = field(default_factory=dict)
    replaced: Formulas = field(default_factory=dict)
    outputs: Formulas = field(default_factory=dict)
    noise: Formulas = field(default_factory=dict)
    added: Callable[[Named, Values], Named] | None = None
    changed: Callable[[Named, Values, Values], Values] | None = None
    driven: Callable[[Any, Values], Any] | None = None
    lag: str = ""
    switches: tuple[Callable[[Named, Values], Any], ...] = ()
    friction: Friction | None = None
    measured: Callable[[Any, Values], Any] | None = None

    def times(self, factor: float) -> Effect:
        """The same effect, stronger by a factor; numbers are rounded so that the key states them exactly."""
        scaled = {name: to_digits(factor * self.parameters[name], 6) for name in self.scaled}
        return replace(self, parameters={**self.parameters, **scaled})

    def formulas(self) -> dict[str, Any]:
        """Everything that the key says of it."""
        return {
            "states": dict(self.states),
            "terms": dict(self.terms),
            "replace": dict(self.replaced),
            "outputs": dict(self.outputs),
            "noise": dict(self.noise),
            "parameters": dict(self.parameters),
        }


Builder = Callable[[np.random.Generator], Effect]


def either_sign(rng: np.random.Generator) -> float:
    """+1 or -1."""
    return float(rng.choice([-1.0, 1.0]))


def constant_bias(equation: str) -> Builder:
    """A constant in one equation. It acts along no coordinate."""

    def build(rng: np.random.Generator) -> Effect:
        return Effect(
            "constant bias",
            (equation,),
            (),
            {"c": either_sign(rng)},
            terms={equation: "c"},
            added=lambda s, p: {equation: p["c"] + 0 * s["t"]},
        )

    return build


def periodic_forcing(equation: str, rate: float) -> Builder:
    """A forcing of one frequency from a third to 1.6 of the system's own, at any phase."""

    def build(rng: np.random.Generator) -> Effect:
        phase = rng.uniform(0, 2 * np.pi)
        w = rate * float(np.exp(rng.uniform(np.log(0.35), np.log(1.6))))
        return Effect(
            "periodic forcing",
            (equation,),
            ("t",),
            rounded(c=np.cos(phase), s=np.sin(phase), w=w),
            ("c", "s"),
            terms={equation: "c*cos(w*t) + s*sin(w*t)"},
            added=lambda s, p: {
                equation: p["c"] * np.cos(p["w"] * s["t"]) + p["s"] * np.sin(p["w"] * s["t"])
            },
        )

    return build


def parameter_drift(*choices: tuple[str, tuple[str, ...]]) -> Builder:
    """A parameter that grows or shrinks linearly from the start of each recording on.

    Parameters
    ----------
    *choices
        Names of parameters, each with the equations it stands in.
    """

    def build(rng: np.random.Generator) -> Effect:
        name, equations = choices[int(rng.integers(len(choices)))]
        return Effect(
            "parameter drift",
            equations,
            ("t",),
            {"r": either_sign(rng)},
            ("r",),
            replaced={name: f"{name}*(1 + r*t)"},
            changed=lambda s, theta, p: {**theta, name: theta[name] * (1 + p["r"] * s["t"])},
        )

    return build


def process_noise(*states: str) -> Builder:
    """White noise of one intensity in one or more equations."""

    def build(rng: np.random.Generator) -> Effect:
        return Effect("process noise", states, (), {"c": 1.0}, noise=dict.fromkeys(states, "c"))

    return build


def sensor(sizes: Mapping[str, float]) -> Builder:
    """A sensor that is off by a gain and an offset of like size.

    A gain alone cannot be seen where the system is linear and nothing drives it.

    Parameters
    ----------
    sizes
        The outputs, one of which it measures, with the typical size of each.
    """

    def build(rng: np.random.Generator) -> Effect:
        output = str(rng.choice(list(sizes)))
        gain = either_sign(rng) * rng.uniform(0.5, 1)
        offset = either_sign(rng) * rng.uniform(0.5, 1) * sizes[output]
        return Effect(
            "sensor gain or offset",
            (),
            (output,),
            rounded(g=gain, o=offset),
            ("g", "o"),
            outputs={output: f"(1 + g)*{output} + o"},
            measured=lambda y, p: (1 + p["g"]) * y + p["o"],
        )

    return build


def rounded(**values: float) -> dict[str, float]:
    """Parameters with four digits: the key then states them exactly."""
    return {name: to_digits(value) for name, value in values.items()}
