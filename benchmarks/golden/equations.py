"""Landscapes of given equations: one to five states, noise of every kind, points and cycles."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import sympy

import siq
from benchmarks.equations import CASES, SYSTEMS
from benchmarks.golden.landscapes import landscape
from benchmarks.golden.table import tolerated

TOLERANCES = {
    **tolerated("attractors saddles periods curvature parting_periods", 1e-6, 1e-9),
    **tolerated("path_barrier heights U_between multipliers", 1e-5, 1e-8),
    **tolerated("barrier", 1e-6),
    **tolerated("mean_time dwell_time", 1e-4),
    **tolerated("barrier_error", 0.05, 1e-6),
    **tolerated("stated_error", 0.1, 1e-8),
    **tolerated("basins", 0.0, 0.01),
}
REFERENCES = (
    "linear double-well growing-noise archetype maier-stein maier-stein-5 toggle fitzhugh-nagumo particle"
)
CARDS = "archetype4d budworm duffing lake resonator schloegl stommel"
OTHERS = ("noise on the velocity that grows with x²", "coloured noise, τ = 1", "steep toggle switch")
X, Y = sympy.symbols("x y", real=True)


def turning(count: int) -> siq.Dynamics:
    """States in a row that pull on their neighbours; the first and the last one turn about each other."""
    x = sympy.symbols(f"x:{count}", real=True)
    energy = x[-1] ** 2 + sum(one**2 - one * other / 2 for one, other in itertools.pairwise(x))
    force = [-energy.diff(one) for one in x]
    force[0], force[-1] = force[0] + x[-1] / 2, force[-1] - x[0]
    return siq.Dynamics.of(x, force, domain=[(-2, 2)] * count)


def systems() -> dict[str, Any]:
    """All of them by name."""
    known, box = siq.reference_systems(), [(-2, 2)] * 2
    hopf = (X - Y - X * (X**2 + Y**2), X + Y - Y * (X**2 + Y**2))
    growing = [[1 + X**2 / 4, 0], [0, 1]]
    return {
        **{f"reference {name}": known[name].dynamics for name in REFERENCES.split()},
        **{f"card {name}": SYSTEMS / f"{name}.yaml" for name in CARDS.split()},
        **{name: CASES[name] for name in OTHERS},
        "cycle alone": siq.Dynamics.of((X, Y), hopf, domain=box),
        "point and cycle": known["point-and-cycle"].dynamics,
        "no attractor": siq.Dynamics.of((X, Y), (X, Y), domain=box),
        "no noise in y": siq.Dynamics.of((X, Y), (X - X**3, -Y), diffusion=[[1, 0], [0, 0]], domain=box),
        "noise grows with x": siq.Dynamics.of((X, Y), (X - X**3, X - Y), diffusion=growing, domain=box),
        "five states": turning(5),
    }


def items(results: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every landscape, or the kind of error where there is none."""
    for name, system in systems().items():
        try:
            yield name, landscape(siq.Landscape.from_equations(system))
        except (siq.InputError, siq.NumericalFailure) as error:
            yield name, {"refused": type(error).__name__}
