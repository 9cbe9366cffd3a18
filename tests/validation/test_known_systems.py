from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    double_well,
    hamilton_jacobi_residual,
    limit_cycle,
    linear_system,
    maier_stein,
    polynomial_system,
    potential_gradient,
    potential_values,
)

from siq.systems.cards import load_exact, load_system
from siq.systems.equilibria import hessian_at

CARDS = Path(__file__).parents[2] / "config" / "systems"

BUILDERS: dict[str, Callable[[], KnownSystem]] = {
    **{f"linear {d}": lambda d=d: linear_system(d) for d in range(2, 7)},
    **{f"archetype {d}": lambda d=d: archetype(d) for d in (2, 3, 4)},
    "Maier-Stein": lambda: maier_stein(1),
    "double well 2": lambda: double_well(2),
    "double well 3": lambda: double_well(3),
    "limit cycle": limit_cycle,
    **{f"polynomial 2, draw {seed}": lambda seed=seed: polynomial_system(2, seed=seed) for seed in range(3)},
    "polynomial 2, constant rotation": lambda: polynomial_system(2, linear_rotation=False),
    "polynomial 3": lambda: polynomial_system(3),
}


@pytest.mark.parametrize("build", BUILDERS.values(), ids=BUILDERS)
def test_the_hamilton_jacobi_equation_holds_exactly(build: Callable[[], KnownSystem]) -> None:
    assert hamilton_jacobi_residual(build()) == 0


@pytest.mark.parametrize("build", BUILDERS.values(), ids=BUILDERS)
def test_attractors_are_stable_equilibria_and_the_lyapunov_equation_gives_the_hessian(
    build: Callable[[], KnownSystem],
) -> None:
    known = build()
    assert known.domain.shape == (known.dynamics.dimension, 2)
    for attractor in known.attractors:
        assert np.all((known.domain[:, 0] < attractor) & (attractor < known.domain[:, 1]))
        assert np.abs(known.dynamics.drift(attractor[None])).max() < 1e-13
        assert np.linalg.eigvals(known.dynamics.jacobian(attractor[None])[0]).real.max() < 0
        point = dict(zip(known.dynamics.symbols, attractor, strict=True))
        exact = np.array(sympy.hessian(known.potential, known.dynamics.symbols).subs(point), dtype=float)
        found = hessian_at(known.dynamics, attractor)
        np.testing.assert_allclose(found, exact, rtol=1e-9, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize("build", BUILDERS.values(), ids=BUILDERS)
def test_the_potential_falls_along_the_flow(build: Callable[[], KnownSystem]) -> None:
    known = build()
    x = np.random.default_rng(0).uniform(*known.domain.T, size=(200, known.dynamics.dimension))
    gradient = potential_gradient(known, x)
    falls = np.einsum("ni,ij,nj->n", gradient, known.diffusion, gradient)
    np.testing.assert_allclose(
        np.sum(gradient * known.dynamics.drift(x), axis=1), -falls, rtol=1e-7, atol=1e-8
    )
    assert potential_values(known, x).min() > -1e-12


def test_random_systems_have_different_numbers_of_wells() -> None:
    assert len({len(polynomial_system(2, seed=seed).attractors) for seed in range(4)}) > 1


def test_the_linear_systems_rotate_strongly() -> None:
    for dimension in range(2, 7):
        rates = np.linalg.eigvals(linear_system(dimension).dynamics.jacobian(np.zeros((1, dimension)))[0])
        assert (np.abs(rates.imag) / -rates.real).max() > 1.5


@pytest.mark.parametrize(("name", "beta"), [("maier-stein", 1), ("maier-stein-5", 5), ("maier-stein-10", 10)])
def test_the_cards_of_maier_and_stein_are_those_systems(name: str, beta: float) -> None:
    system, known = load_system(CARDS / f"{name}.yaml"), maier_stein(beta)
    assert system.symbols == known.dynamics.symbols
    for found, wanted in zip(system.formulas, known.dynamics.formulas, strict=True):
        assert sympy.expand(found - wanted) == 0
    np.testing.assert_array_equal(system.domain, known.domain)
    np.testing.assert_array_equal(system.diffusion.matrix, known.diffusion)
    if known.potential is None:
        assert load_exact(CARDS / f"{name}.yaml") is None
    else:
        assert sympy.expand(load_exact(CARDS / f"{name}.yaml") - 2 * known.potential) == 0
