"""Mechanics: the effects of the masses on springs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from benchmarks.proof.concealment.effects import (
    Builder,
    Effect,
    Friction,
    Named,
    constant_bias,
    parameter_drift,
    periodic_forcing,
    process_noise,
    rounded,
    sensor,
)
from benchmarks.proof.concealment.force_laws import LAWS, RATE, SPEED, WITHHELD_LAWS, Draw, ForceLaw
from benchmarks.proof.concealment.physics import Values
from benchmarks.proof.concealment.systems import COUPLED_MASSES, OSCILLATOR


def _law(name: str, law: ForceLaw, masses: tuple[tuple[str, str], ...]) -> Builder:
    def build(rng: np.random.Generator) -> Effect:
        x, v = masses[int(rng.integers(len(masses)))]

        def local(function: Callable[[Named, Values], Any]) -> Callable[[Named, Values], Any]:
            return lambda s, p: function({**s, "x": s[x], "v": s[v]}, p)

        force, rates = local(law.force), local(law.rates)

        def added(s: Named, p: Values) -> Named:
            return {v: force(s, p), **rates(s, p)} if law.states else {v: force(s, p)}

        return Effect(
            name,
            (v,),
            tuple({"x": x, "v": v}.get(coordinate, coordinate) for coordinate in law.along),
            law.draw(rng),
            law.scaled,
            terms={v: law.formula.format(x=x, v=v)},
            states={state: formula.format(x=x, v=v) for state, formula in law.states.items()},
            added=added,
            switches=tuple(local(switch) for switch in law.switches),
        )

    return build


def _friction(
    name: str,
    formula: str,
    force: Callable[[Any, Any, Values], Any],
    draw: Draw,
    scaled: tuple[str, ...],
    velocities: tuple[str, ...],
) -> Builder:
    def build(rng: np.random.Generator) -> Effect:
        v = velocities[int(rng.integers(len(velocities)))]
        return Effect(
            name,
            (v,),
            (v,),
            draw(rng),
            scaled,
            terms={v: formula.format(v=v)},
            switches=(lambda s, p: s[v],),
            friction=Friction(v, force),
        )

    return build


def _unequal(rng: np.random.Generator) -> dict[str, float]:
    """One direction holds two to five times as strongly as the other."""
    weaker = rng.uniform(0.2, 0.5)
    return rounded(c_1=weaker, c_2=1) if rng.random() < 0.5 else rounded(c_1=1, c_2=weaker)


def _frictions(*velocities: str) -> dict[str, Builder]:
    return {
        "dry friction": _friction(
            "dry friction",
            "-c*sign({v})",
            lambda v, direction, p: -p["c"] * direction,
            lambda rng: {"c": 1.0},
            ("c",),
            velocities,
        ),
        "asymmetric friction": _friction(
            "asymmetric friction",
            "-c_1*Max(sign({v}), 0) + c_2*Max(-sign({v}), 0)",
            lambda v, direction, p: (
                -p["c_1"] * np.maximum(direction, 0) + p["c_2"] * np.maximum(-direction, 0)
            ),
            _unequal,
            ("c_1", "c_2"),
            velocities,
        ),
        "Stribeck friction": _friction(
            "Stribeck friction",
            "-(c + s*exp(-({v}/w)**2))*sign({v})",
            lambda v, direction, p: -(p["c"] + p["s"] * np.exp(-((v / p["w"]) ** 2))) * direction,
            lambda rng: rounded(c=1, s=rng.uniform(1, 3), w=SPEED * rng.uniform(0.2, 0.6)),
            ("c", "s"),
            velocities,
        ),
    }


def _input_delay(*equations: str) -> Builder:
    def build(rng: np.random.Generator) -> Effect:
        # At most a tenth of a period, beyond which nobody would overlook it.
        tau = {"tau": float(f"{rng.uniform(0.5, 1) * 0.2 * np.pi / RATE:.4g}")}
        replaced = {"u": "delay(u, tau)"}
        return Effect("input delay", equations, ("u",), tau, ("tau",), True, replaced=replaced, lag="tau")

    return build


def _saturation(*equations: str) -> Builder:
    def build(rng: np.random.Generator) -> Effect:
        return Effect(
            "saturation",
            equations,
            ("u",),
            rounded(c=rng.uniform(0.3, 0.6)),
            limit=True,
            replaced={"u": "tanh(c*u)/c"},
            driven=lambda u, p: np.tanh(p["c"] * u) / p["c"],
        )

    return build


def _between(
    name: str, formula: str, force: Callable[[Named, Values], Any], along: tuple[str, ...]
) -> Builder:
    """A force between the two masses, equal and opposite; both have the mass 1."""

    def build(rng: np.random.Generator) -> Effect:
        def added(s: Named, p: Values) -> Named:
            acting = force(s, p)
            return {"v1": acting, "v2": -acting}

        return Effect(
            name, ("v1", "v2"), along, {"c": 1.0}, terms={"v1": formula, "v2": f"-{formula}"}, added=added
        )

    return build


def _one_of(*builders: Builder) -> Builder:
    return lambda rng: builders[int(rng.integers(len(builders)))](rng)


ONE, TWO = (("x", "v"),), (("x1", "v1"), ("x2", "v2"))

OSCILLATOR_EFFECTS: Mapping[str, Builder] = {
    **{name: _law(name, law, ONE) for name, law in LAWS.items()},
    **_frictions("v"),
    "constant bias": constant_bias("v"),
    "parameter drift": parameter_drift(("k", ("v",))),
    "periodic forcing": periodic_forcing("v", RATE),
    "input delay": _input_delay("v"),
    "saturation": _saturation("v"),
    "sensor gain or offset": sensor({"x": OSCILLATOR.sizes["x"]}),
}
COUPLED_MASSES_EFFECTS: Mapping[str, Builder] = {
    **{name: _law(name, law, TWO) for name, law in LAWS.items()},
    **_frictions("v1", "v2"),
    "constant bias": _one_of(constant_bias("v1"), constant_bias("v2")),
    "parameter drift": parameter_drift(("k_1", ("v1",)), ("k_2", ("v2",))),
    "periodic forcing": _one_of(periodic_forcing("v1", RATE), periodic_forcing("v2", RATE)),
    "input delay": _input_delay("v1"),
    "saturation": _saturation("v1"),
    "linear coupling": _between(
        "linear coupling", "c*(v2 - v1)", lambda s, p: p["c"] * (s["v2"] - s["v1"]), ("v1", "v2")
    ),
    "nonlinear coupling": _between(
        "nonlinear coupling", "c*(x2 - x1)**3", lambda s, p: p["c"] * (s["x2"] - s["x1"]) ** 3, ("x1", "x2")
    ),
    "sensor gain or offset": sensor({name: COUPLED_MASSES.sizes[name] for name in ("x1", "x2")}),
}
OSCILLATOR_NOISE = process_noise("v")
COUPLED_MASSES_NOISE = _one_of(process_noise("v1"), process_noise("v2"))
OSCILLATOR_WITHHELD: Mapping[str, Builder] = {n: _law(n, law, ONE) for n, law in WITHHELD_LAWS.items()}
COUPLED_MASSES_WITHHELD: Mapping[str, Builder] = {n: _law(n, law, TWO) for n, law in WITHHELD_LAWS.items()}
