"""The landscape of equations: certificates, errors, barriers and seconds, system by system.

    .venv/bin/python benchmarks/equations.py [--about powers] [NAME ...]

Of each well the degree of its powers is told, and how many random units stand beside them, where they do.
Known barriers of Maier and Stein's system: 0.5 for β = 1; 0.4831 and 0.3400 for 5 and 10, by least action.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import sympy

import siq
from siq.quasipotential.landscape_assembly import EquationSettings
from siq.quasipotential.refinement import RefinementOptions
from siq.quasipotential.wells import Well

X, Y = sympy.symbols("x y", real=True)
SYSTEMS = Path(__file__).parents[1] / "config" / "systems"
U, V = sympy.symbols("u v", real=True)
TILT = sympy.Rational(1, 10)


def particles(count: int, friction: float) -> siq.Dynamics:
    """Damped particles that a double well couples; D = 1/2 on every velocity, so that V is 2γ(v²/2 + Φ)."""
    x, v = sympy.symbols(f"x:{count}", real=True), sympy.symbols(f"v:{count}", real=True)
    well = (x[0] ** 2 - 1) ** 2 / 4 - TILT * x[0]
    for one, other in zip(x[1:], x, strict=False):
        well += 0.7 * one**2 + 0.4 * one * other + 0.3 * one * x[0] ** 2
    forces = [-friction * speed - well.diff(place) for place, speed in zip(x, v, strict=True)]
    noise = [[0.5 * (i == j >= count) for j in range(2 * count)] for i in range(2 * count)]
    return siq.Dynamics.of((*x, *v), (*v, *forces), diffusion=noise, domain=[(-2, 2)] * (2 * count))


LATTICE = (-sympy.sin(X) - sympy.sin(Y) / 2, -sympy.sin(Y) + sympy.sin(X) / 2)
CASES: dict[str, str | Path | siq.Dynamics] = {
    "Maier–Stein, β = 1": SYSTEMS / "maier-stein.yaml",
    "Maier–Stein, β = 5": SYSTEMS / "maier-stein-5.yaml",
    "Maier–Stein, β = 10": SYSTEMS / "maier-stein-10.yaml",
    "archetype, 3 states": SYSTEMS / "archetype3d.yaml",
    "archetype, 4 states": SYSTEMS / "archetype4d.yaml",
    "resonator": SYSTEMS / "resonator.yaml",
    "consumer and resource": SYSTEMS / "consumer-resource.yaml",
    "toggle switch": siq.Dynamics.of((X, Y), (3 / (1 + Y**2) - X, 3 / (1 + X**2) - Y), domain=[(0, 4)] * 2),
    "steep toggle switch": siq.Dynamics.of(
        (X, Y), (5 / (1 + Y**4) - X, 5 / (1 + X**4) - Y), domain=[(0, 6)] * 2
    ),
    "trigonometric": siq.Dynamics.of((X, Y), LATTICE, domain=[(-3.5, 8)] * 2),
    "Schlögl": SYSTEMS / "schloegl.yaml",
    "spruce budworm": SYSTEMS / "budworm.yaml",
    "overturning circulation": SYSTEMS / "stommel.yaml",
    "FitzHugh–Nagumo": SYSTEMS / "fitzhugh-nagumo.yaml",
    "particle, damping 0.5": particles(1, 0.5),
    "particle, damping 0.1": particles(1, 0.1),
    "two particles": particles(2, 1.0),
    "three particles": particles(3, 1.0),
    "particle with nonlinear damping": SYSTEMS / "duffing.yaml",
    "noise on the velocity that grows with x²": siq.Dynamics.of(
        (X, V), (V, X - X**3 + TILT - V), diffusion=[[0, 0], [0, 1 + X**2 / 2]], domain=[(-2, 2)] * 2
    ),
    "coloured noise, τ = 1": siq.Dynamics.of(
        (X, U), (X - X**3 + TILT + U, -U), diffusion=[[0, 0], [0, 1]], domain=[(-2, 2)] * 2
    ),
    "coloured noise, τ = 0.1": siq.Dynamics.of(
        (X, U), (X - X**3 + U, -10 * U), diffusion=[[0, 0], [0, 100]], domain=[(-2, 2), (-5, 5)]
    ),
}


def functions(well: Well | None) -> str:
    """What V about an attractor is made of."""
    if well is None:
        return "-"
    units = len(well.basis.units)
    return f"{well.degree} and {units} units" if units else str(well.degree)


def main() -> None:
    """Print one line for each system."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--about", choices=("auto", "powers", "units"), default="auto", help="an attractor")
    parser.add_argument("names", nargs="*", metavar="NAME", help="part of the name of a system")
    asked = parser.parse_args()
    names: Sequence[str] = asked.names
    settings = EquationSettings(refinement=RefinementOptions(about=asked.about))
    for name, system in CASES.items():
        if names and not any(one in name for one in names):
            continue
        started = time.process_time()
        found = siq.Landscape.from_equations(system, settings)
        seconds = time.process_time() - started
        certificate = found.certificate
        assert certificate is not None
        verdict = "certified" if certificate.certified else "refused"
        barriers = ", ".join(f"{value:.7g}" for value in sorted(set(found.barriers()["barrier"].round(12))))
        degrees = ", ".join(map(functions, found.wells))
        print(
            f"| {name} | {verdict} | {certificate.error:.2g} | {degrees} | {barriers} | {seconds:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
