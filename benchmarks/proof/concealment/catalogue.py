"""Catalogue: which effects each system can conceal.

Those of resonator, populations and archetype stand here, those of masses on springs in `mechanics`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from benchmarks.proof.concealment import mechanics
from benchmarks.proof.concealment.effects import (
    Builder,
    Effect,
    Named,
    constant_bias,
    either_sign,
    parameter_drift,
    periodic_forcing,
    process_noise,
    rounded,
    sensor,
)
from benchmarks.proof.concealment.physics import Values
from benchmarks.proof.concealment.systems import ARCHETYPE3D, PREDATOR_PREY, RESONATOR


@dataclass(frozen=True)
class Catalogue:
    """What can be concealed in one system: mechanisms, process noise, and effects outside the dictionary."""

    mechanisms: Mapping[str, Builder]
    noise: Builder
    withheld: Mapping[str, Builder]


def _fixed(
    name: str,
    coordinates: tuple[str, ...],
    terms: Mapping[str, str],
    added: Callable[[Named, Values], Named],
    draw: Callable[[np.random.Generator], Mapping[str, float]] = lambda rng: {"c": 1.0},
    states: Mapping[str, str] | None = None,
) -> Builder:
    """An effect whose strength is c, and of which only the parameters are drawn."""

    def build(rng: np.random.Generator) -> Effect:
        return Effect(
            name, tuple(terms), coordinates, draw(rng), terms=terms, states=states or {}, added=added
        )

    return build


def _signed(rng: np.random.Generator) -> dict[str, float]:
    return {"c": either_sign(rng)}


# --- Resonator. R2 is the square of its amplitude.

R2 = "(P**2 + Q**2)"


def _turning(name: str, formula: str, factor: Callable[[Any, Values], Any]) -> Builder:
    """A restoring force that depends on amplitude: it turns the quadratures."""

    def added(s: Named, p: Values) -> Named:
        value = factor(s["P"] ** 2 + s["Q"] ** 2, p)
        return {"P": value * s["Q"], "Q": -value * s["P"]}

    return _fixed(name, ("amplitude",), {"P": f"{formula}*Q", "Q": f"-{formula}*P"}, added, _signed)


def _damping(
    name: str,
    formula: str,
    factor: Callable[[Any, Values], Any],
    draw: Callable[[np.random.Generator], Mapping[str, float]] = lambda rng: {"c": 1.0},
) -> Builder:
    """A damping that depends on amplitude: it shrinks both quadratures."""

    def added(s: Named, p: Values) -> Named:
        value = factor(s["P"] ** 2 + s["Q"] ** 2, p)
        return {"P": -value * s["P"], "Q": -value * s["Q"]}

    return _fixed(name, ("amplitude",), {"P": f"-{formula}*P", "Q": f"-{formula}*Q"}, added, draw)


RESONATOR_CATALOGUE = Catalogue(
    {
        "quintic stiffness": _turning("quintic stiffness", f"c*{R2}**2", lambda r2, p: p["c"] * r2**2),
        "quadratic drag": _damping("quadratic drag", f"c*sqrt{R2}", lambda r2, p: p["c"] * np.sqrt(r2)),
        "amplitude-dependent damping": _damping(
            "amplitude-dependent damping", f"c*{R2}", lambda r2, p: p["c"] * r2
        ),
        "dry friction": _damping("dry friction", f"c/sqrt{R2}", lambda r2, p: p["c"] / np.sqrt(r2)),
        "parametric drive": _fixed(
            "parametric drive",
            ("P", "Q", "amplitude"),
            {"P": "c*Q", "Q": "c*P"},
            lambda s, p: {"P": p["c"] * s["Q"], "Q": p["c"] * s["P"]},
            _signed,
        ),
        # A constant in the equation of Q would be a shift of beta.
        "constant bias": constant_bias("P"),
        "parameter drift": parameter_drift(("omega_0", ("P", "Q")), ("beta", ("Q",))),
        "sensor gain or offset": sensor(RESONATOR.sizes),
    },
    process_noise("P", "Q"),
    {
        "oscillating damping": _damping(
            "oscillating damping",
            f"c*sin({R2}/s)",
            lambda r2, p: p["c"] * np.sin(r2 / p["s"]),
            lambda rng: rounded(c=either_sign(rng), s=rng.uniform(4e-5, 8e-5)),
        ),
        # Light or current heats it, and the heat, which detunes it, comes late.
        "thermal memory": _fixed(
            "thermal memory",
            ("amplitude",),
            {"P": "c*h*Q", "Q": "-c*h*P"},
            lambda s, p: {
                "P": p["c"] * s["h"] * s["Q"],
                "Q": -p["c"] * s["h"] * s["P"],
                "h": (s["P"] ** 2 + s["Q"] ** 2 - s["h"]) / p["tau"],
            },
            lambda rng: rounded(c=either_sign(rng), tau=rng.uniform(500, 2500)),
            {"h": f"({R2} - h)/tau"},
        ),
    },
)

# --- Populations


def _self_limitation(rng: np.random.Generator) -> Effect:
    name = str(rng.choice(["prey", "predator"]))
    added: Callable[[Named, Values], Named] = lambda s, p: {name: -p["c"] * s[name] ** 2}  # noqa: E731
    return Effect("self-limitation", (name,), (name,), {"c": 1.0}, terms={name: f"-c*{name}**2"}, added=added)


def _satiation(rng: np.random.Generator) -> Effect:
    """Holling's second type: who has prey in abundance does not hunt more."""
    return Effect(
        "saturation",
        ("prey", "predator"),
        ("prey",),
        rounded(h=rng.uniform(0.2, 0.4)),
        ("h",),
        True,
        replaced={"beta": "beta/(1 + h*prey)", "delta": "delta/(1 + h*prey)"},
        changed=lambda s, theta, p: {
            **theta,
            "beta": theta["beta"] / (1 + p["h"] * s["prey"]),
            "delta": theta["delta"] / (1 + p["h"] * s["prey"]),
        },
    )


def _immigration(rng: np.random.Generator) -> Effect:
    # Emigration at a constant rate would end below zero.
    effect = constant_bias(str(rng.choice(["prey", "predator"])))(rng)
    return replace(effect, parameters={"c": 1.0})


PREDATOR_PREY_CATALOGUE = Catalogue(
    {
        "self-limitation": _self_limitation,
        "saturation": _satiation,
        "constant bias": _immigration,
        "nonlinear coupling": _fixed(
            "nonlinear coupling",
            ("predator",),
            {"prey": "-c*prey*predator**2"},
            lambda s, p: {"prey": -p["c"] * s["prey"] * s["predator"] ** 2},
        ),
        "periodic forcing": lambda rng: periodic_forcing(
            str(rng.choice(["prey", "predator"])), PREDATOR_PREY.rate
        )(rng),
        "parameter drift": parameter_drift(("alpha", ("prey",)), ("gamma", ("predator",))),
        "sensor gain or offset": sensor(PREDATOR_PREY.sizes),
    },
    process_noise("prey", "predator"),
    {
        # Prey that is rare grows faster, or more slowly, than prey that is common.
        "refuge or Allee effect": _fixed(
            "refuge or Allee effect",
            ("prey",),
            {"prey": "c*prey*exp(-prey/w)"},
            lambda s, p: {"prey": p["c"] * s["prey"] * np.exp(-s["prey"] / p["w"])},
            lambda rng: rounded(c=either_sign(rng), w=rng.uniform(0.8, 2)),
        ),
        "late maturity": _fixed(
            "late maturity",
            ("prey", "predator"),
            {"predator": "c*h*predator"},
            lambda s, p: {
                "predator": p["c"] * s["h"] * s["predator"],
                "h": (s["prey"] - s["h"]) / p["tau"],
            },
            lambda rng: rounded(c=1, tau=rng.uniform(1, 4)),
            {"h": "(prey - h)/tau"},
        ),
    },
)

# --- Archetype: monomials up to degree three that its card has not

PRESENT = {"x": {"x**3", "x", "y", "z"}, "y": {"y", "x**3", "x"}, "z": {"z", "x**3", "x"}}


def _monomial(exponents: tuple[int, ...]) -> str:
    powers = zip(ARCHETYPE3D.states, exponents, strict=True)
    return "*".join(name if power == 1 else f"{name}**{power}" for name, power in powers if power)


ABSENT = [
    (equation, exponents)
    for equation in ARCHETYPE3D.states
    for exponents in product(range(4), repeat=3)
    if 1 <= sum(exponents) <= 3 and _monomial(exponents) not in PRESENT[equation]
]


def _monomial_term(rng: np.random.Generator) -> Effect:
    equation, exponents = ABSENT[int(rng.integers(len(ABSENT)))]
    i, j, k = exponents
    return Effect(
        "monomial",
        (equation,),
        tuple(name for name, power in zip(ARCHETYPE3D.states, exponents, strict=True) if power),
        _signed(rng),
        terms={equation: f"c*{_monomial(exponents)}"},
        added=lambda s, p: {equation: p["c"] * s["x"] ** i * s["y"] ** j * s["z"] ** k},
    )


ARCHETYPE3D_CATALOGUE = Catalogue(
    {
        "constant bias": lambda rng: constant_bias(str(rng.choice(ARCHETYPE3D.states)))(rng),
    },
    process_noise("x", "y", "z"),
    {
        "monomial": _monomial_term,
        "periodic potential": _fixed(
            "periodic potential",
            ("x",),
            {"y": "c*sin(q*x)"},
            lambda s, p: {"y": p["c"] * np.sin(p["q"] * s["x"])},
            lambda rng: rounded(c=either_sign(rng), q=rng.uniform(3, 6)),
        ),
        "hidden slow state": _fixed(
            "hidden slow state",
            ("x", "y"),
            {"y": "c*h"},
            lambda s, p: {"y": p["c"] * s["h"], "h": (s["x"] - s["h"]) / p["tau"]},
            lambda rng: rounded(c=either_sign(rng), tau=rng.uniform(0.5, 2)),
            {"h": "(x - h)/tau"},
        ),
    },
)

CATALOGUES: Mapping[str, Catalogue] = {
    "resonator": RESONATOR_CATALOGUE,
    "archetype3d": ARCHETYPE3D_CATALOGUE,
    "oscillator": Catalogue(
        mechanics.OSCILLATOR_EFFECTS, mechanics.OSCILLATOR_NOISE, mechanics.OSCILLATOR_WITHHELD
    ),
    "predator_prey": PREDATOR_PREY_CATALOGUE,
    "coupled_masses": Catalogue(
        mechanics.COUPLED_MASSES_EFFECTS, mechanics.COUPLED_MASSES_NOISE, mechanics.COUPLED_MASSES_WITHHELD
    ),
}
