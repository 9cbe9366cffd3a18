"""The public references: what is called exact is exact, and what was computed twice comes out again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.integrate
import scipy.sparse.linalg
import sympy

import siq
from siq.quasipotential.hamiltonian_paths import hamiltonian_paths
from siq.quasipotential.paths import minimum_action_path
from siq.systems.equilibria import classify
from siq.validation.reference_systems import TWO_METHODS, _KnownBarrier, _ReferenceSystem

SYSTEMS = siq.reference_systems()
KNOWN = [name for name, each in SYSTEMS.items() if each.quasipotential is not None]
QUICK = ("maier-stein-5", "van-der-pol")
COMPUTED = [name for name, each in SYSTEMS.items() if each.quasipotential is None]


@pytest.mark.parametrize("name", KNOWN)
def test_u_solves_its_equation_as_a_formula(name: str) -> None:
    system = SYSTEMS[name]
    dynamics, potential = system.dynamics, system.quasipotential
    slope = sympy.Matrix([potential.diff(each) for each in dynamics.symbols])
    noise = sympy.nsimplify(sympy.Matrix(dynamics.diffusion.formulas), rational=True)
    residual = sympy.Matrix(dynamics.formulas).dot(slope) + (slope.T * noise * slope)[0] / 2
    assert sympy.simplify(sympy.nsimplify(residual, rational=True)) == 0


@pytest.mark.parametrize("name", [name for name, each in SYSTEMS.items() if "cycle" not in name])
def test_ways_lead_from_attractors_over_saddles(name: str) -> None:
    for barrier in SYSTEMS[name].barriers:
        found = [classify(SYSTEMS[name].dynamics, place).kind for place in _settled(SYSTEMS[name], barrier)]
        assert found == ["attractor", "saddle", "attractor"]


def _settled(system: _ReferenceSystem, barrier: _KnownBarrier) -> list[np.ndarray]:
    """The equilibria of a way by one step of Newton's method, which has to be a small one."""
    places = np.stack([barrier.start, barrier.saddle, barrier.end])
    steps = np.linalg.solve(system.dynamics.jacobian(places), system.dynamics.drift(places)[..., None])[
        ..., 0
    ]
    assert np.abs(steps).max() < 1e-7
    return list(places - steps)


@pytest.mark.parametrize("name", ["double-well", "growing-noise"])
def test_the_prefactor_is_that_of_the_exact_time_of_one_state(name: str) -> None:
    """``E[τ] = ∫ exp(U(z)/ε) ∫ 2/(εD(y)) exp(-U(y)/ε) dy dz``, from the attractor to the one beyond."""
    system, intensity = SYSTEMS[name], 0.02
    (x,) = system.dynamics.symbols
    potential = sympy.lambdify(x, system.quasipotential / intensity, "numpy")
    barrier = system.barriers[0]
    level = float(potential(barrier.saddle[0]))
    z = np.linspace(-2.5, barrier.end[0], 200_001)
    lower = float(potential(barrier.start[0]))
    noise = intensity * system.dynamics.diffusion.at(z[:, None])[:, 0, 0]
    inner = scipy.integrate.cumulative_simpson(2 / noise * np.exp(lower - potential(z)), x=z, initial=0.0)
    beyond = z >= barrier.start[0]
    exact = scipy.integrate.simpson((np.exp(potential(z) - level) * inner)[beyond], x=z[beyond])
    assert exact == pytest.approx(barrier.prefactor, rel=0.05)  # the law is of leading order in ε/ΔU


def _least_action_in_time(system: _ReferenceSystem) -> tuple[float, np.ndarray]:
    """½ ∫ (v̇ - f_v)²/D_vv dt of positions at even times from -1 to 0, by Gauss and Newton; and its path.

    The error is of second and fourth order of the step, and both are taken out.
    """
    force = sympy.expand(system.dynamics.formulas[1])
    pushed = sympy.lambdify(system.dynamics.symbols, [force, *map(force.diff, system.dynamics.symbols)])
    duration, actions = 50.0, []
    for count in (1000, 2000, 4000):
        step = duration / count
        time = step * np.arange(count + 1)
        x = -1 / (1 + np.exp((time - 0.6 * duration) / 2))
        x[:2], x[-2:] = -1, 0
        damping, before = 1e-3, np.inf
        while damping < 1e8:
            speed = (x[2:] - x[:-2]) / (2 * step)
            value, by_x, by_v = np.broadcast_arrays(*pushed(x[1:-1], speed))
            residual = np.diff(x, 2) / step**2 - value
            now = float(residual @ residual)
            if now < before:
                kept, gained, before, damping = x, before - now, now, max(damping / 6, 1e-13)
                bands = [
                    1 / step**2 + by_v / (2 * step),
                    -2 / step**2 - by_x,
                    1 / step**2 - by_v / (2 * step),
                ]
                slope = scipy.sparse.diags(bands, [0, 1, 2], shape=(count - 1, count + 1)).tocsc()[:, 2:-2]
                normal, downwards = slope.T @ slope, -slope.T @ residual
                if gained < 1e-14 * now:
                    break
            else:
                damping *= 4
            x = kept.copy()
            damped = normal + damping * scipy.sparse.diags(normal.diagonal())
            x[2:-2] += scipy.sparse.linalg.spsolve(damped.tocsc(), downwards)
        actions.append(before * step / 2 / system.dynamics.diffusion.matrix[1, 1])
    coarse, fine = (4 * np.array(actions[1:]) - actions[:-1]) / 3
    return float((16 * fine - coarse) / 15), np.column_stack([kept, np.gradient(kept, step)])


@pytest.mark.parametrize(
    "name", [pytest.param(each, marks=[pytest.mark.slow] * (each not in QUICK)) for each in COMPUTED]
)
def test_what_was_computed_by_two_methods_comes_out_again(name: str) -> None:
    system = SYSTEMS[name]
    if not system.dynamics.diffusion.regular:
        action, points = _least_action_in_time(system)
        orbit = hamiltonian_paths(system.dynamics, points[0], points[-1], tolerance=1e-7, curves=[points])[0]
        for barrier in system.barriers:  # of both sides, which are mirror images
            assert [action, orbit.action] == pytest.approx([barrier.value] * 2, abs=2e-9)
        return
    for barrier in system.barriers:
        assert barrier.how == TWO_METHODS
        start, saddle, _ = _settled(system, barrier)
        chain = minimum_action_path(system.dynamics, start, saddle, tolerance=1e-7)
        orbit = hamiltonian_paths(system.dynamics, start, saddle, tolerance=1e-7, curves=[chain.points])[0]
        assert chain.action == pytest.approx(barrier.value, rel=1e-8, abs=2e-9)
        assert orbit.action == pytest.approx(barrier.value, rel=1e-8, abs=2e-9)


def test_the_table_holds_what_the_systems_say(tmp_path: Path) -> None:
    path = tmp_path / "references.parquet"
    siq.reference_table(points=5).to_parquet(path)
    table = pd.read_parquet(path)
    assert set(table["system"]) == set(SYSTEMS)
    assert (table.groupby("system")["quantity"].apply(lambda each: (each == "U").sum())[KNOWN] == 5).all()
    row = table[(table["system"] == "maier-stein") & (table["quantity"] == "barrier")].iloc[0]
    assert row["value"] == 0.5 and list(row["at"]) == [-1.0, 0.0] and row["how"] == "exact"
    assert table["value"].notna().all()
