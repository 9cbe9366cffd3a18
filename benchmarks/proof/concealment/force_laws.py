"""Force laws: what acts on one mass, those of the diagnosis' dictionary and withheld ones.

A law is written for one mass, its position ``x`` and its velocity ``v``, and acts as force per mass. In
formulas ``{x}`` and ``{v}`` stand for the names that these have in a system.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.proof.concealment.effects import Named, either_sign, rounded
from benchmarks.proof.concealment.physics import Values

LENGTH, SPEED, RATE = 0.5, 3.0, 6.3  # typical of both systems
Draw = Callable[[np.random.Generator], Mapping[str, float]]


@dataclass(frozen=True)
class ForceLaw:
    """A force per mass, as a formula and as a function.

    Attributes
    ----------
    formula
        With ``{x}`` and ``{v}``.
    force
        Maps ``x``, ``v``, ``t`` and the law's own states by name, and its parameters, to the force.
    along
        The coordinates that it acts along: ``x``, ``v``, ``t``.
    draw
        Draws its parameters.
    scaled
        Those that make it stronger.
    states
        Equations of its own states.
    rates
        The same as a function, like `force`.
    switches
        Where they cross zero the law has a kink. `force` and `rates` get their signs as ``sides``, and
        continue smoothly beyond the kink as long as these stay as they are.
    """

    formula: str
    force: Callable[[Named, Values], Any]
    along: tuple[str, ...]
    draw: Draw = lambda rng: {"c": 1.0}
    scaled: tuple[str, ...] = ("c",)
    states: Mapping[str, str] = field(default_factory=dict)
    rates: Callable[[Named, Values], Named] = lambda s, p: {}
    switches: tuple[Callable[[Named, Values], Any], ...] = ()


def _signed(rng: np.random.Generator) -> dict[str, float]:
    return {"c": either_sign(rng)}


def _bouc_wen(rng: np.random.Generator) -> dict[str, float]:
    # The force is saturated where Abs(z) = 1/(b + g), at a part of the amplitude.
    b, g = rng.dirichlet([3.0, 3.0]) / (LENGTH * rng.uniform(0.3, 0.8))
    return rounded(c=1, b=b, g=g)


def _attached(rng: np.random.Generator) -> dict[str, float]:
    w = RATE * rng.uniform(0.6, 1.6)
    return rounded(c=1, w=w, g=rng.uniform(0.1, 0.6) * w)


LAWS: Mapping[str, ForceLaw] = {
    "quadratic stiffness": ForceLaw("-c*{x}**2", lambda s, p: -p["c"] * s["x"] ** 2, ("x",), _signed),
    "cubic stiffness": ForceLaw("-c*{x}**3", lambda s, p: -p["c"] * s["x"] ** 3, ("x",), _signed),
    "quintic stiffness": ForceLaw("-c*{x}**5", lambda s, p: -p["c"] * s["x"] ** 5, ("x",), _signed),
    "quadratic drag": ForceLaw(
        "-c*Abs({v})*{v}",
        lambda s, p: -p["c"] * s["sides"][0] * s["v"] ** 2,
        ("v",),
        switches=(lambda s, p: s["v"],),
    ),
    "cubic damping": ForceLaw("-c*{v}**3", lambda s, p: -p["c"] * s["v"] ** 3, ("v",)),
    "position-dependent damping": ForceLaw(
        "-c*{x}**2*{v}", lambda s, p: -p["c"] * s["x"] ** 2 * s["v"], ("x", "v")
    ),
    "parametric drive": ForceLaw(
        "c*cos(w*t + phi)*{x}",
        lambda s, p: p["c"] * np.cos(p["w"] * s["t"] + p["phi"]) * s["x"],
        ("t",),
        lambda rng: rounded(c=1, w=RATE * rng.uniform(0.4, 2.2), phi=rng.uniform(0, 2 * np.pi)),
    ),
    "hysteresis": ForceLaw(
        "-c*z",
        lambda s, p: -p["c"] * s["z"],
        ("x", "v"),
        _bouc_wen,
        states={"z": "{v} - b*Abs({v})*z - g*{v}*Abs(z)"},
        rates=lambda s, p: {
            "z": s["v"] - p["b"] * s["sides"][0] * s["v"] * s["z"] - p["g"] * s["v"] * s["sides"][1] * s["z"]
        },
        switches=(lambda s, p: s["v"], lambda s, p: s["z"]),
    ),
}

WITHHELD_LAWS: Mapping[str, ForceLaw] = {
    "periodic potential": ForceLaw(
        "-c*sin(q*{x})",
        lambda s, p: -p["c"] * np.sin(p["q"] * s["x"]),
        ("x",),
        lambda rng: rounded(c=either_sign(rng), q=rng.uniform(4, 9)),
    ),
    "force bump": ForceLaw(
        "c*exp(-(({x} - a)/w)**2)",
        lambda s, p: p["c"] * np.exp(-(((s["x"] - p["a"]) / p["w"]) ** 2)),
        ("x",),
        lambda rng: rounded(
            c=either_sign(rng), a=either_sign(rng) * rng.uniform(0.1, 0.5), w=rng.uniform(0.1, 0.25)
        ),
    ),
    "stop beyond a gap": ForceLaw(
        "-c*({x} - Max(Min({x}, a), -a))",
        lambda s, p: (
            -p["c"]
            * (
                (s["x"] - p["a"]) * np.maximum(s["sides"][0], 0)
                + (s["x"] + p["a"]) * np.maximum(-s["sides"][1], 0)
            )
        ),
        ("x",),
        lambda rng: rounded(c=1, a=rng.uniform(0.25, 0.5)),
        switches=(lambda s, p: s["x"] - p["a"], lambda s, p: s["x"] + p["a"]),
    ),
    "memory": ForceLaw(
        "-c*z",
        lambda s, p: -p["c"] * s["z"],
        ("x", "v"),
        lambda rng: rounded(c=1, tau=rng.uniform(0.7, 3) / RATE),
        states={"z": "{v} - z/tau"},
        rates=lambda s, p: {"z": s["v"] - s["z"] / p["tau"]},
    ),
    "hidden oscillator": ForceLaw(
        "c*z",
        lambda s, p: p["c"] * s["z"],
        ("x", "v"),
        _attached,
        # Its own coordinate is scaled such that the spring between them counts once, in c.
        states={"z": "y", "y": "-w**2*z - g*y + w**2*{x}"},
        rates=lambda s, p: {
            "z": s["y"],
            "y": -(p["w"] ** 2) * s["z"] - p["g"] * s["y"] + p["w"] ** 2 * s["x"],
        },
    ),
    "hysteresis": LAWS["hysteresis"],
}
