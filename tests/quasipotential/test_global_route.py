from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    double_well,
    exact_field,
    linear_system,
    maier_stein,
    polynomial_system,
    potential_values,
    uniform_points,
)

from siq.inference.field_estimate import IdentifiedField
from siq.inference.library import CandidateLibrary
from siq.quasipotential.global_formula import GlobalPotential, fit_values, refine_globally
from siq.systems.dynamics import Dynamics

SYSTEMS = {
    "archetype": archetype(3),
    "Maier-Stein": maier_stein(1),
    "double well": double_well(2),
    "linear": linear_system(3),
    "polynomial": polynomial_system(2, seed=1),
}


def exact_coefficients(known: KnownSystem, library: CandidateLibrary) -> np.ndarray:
    position = {term: k for k, term in enumerate(library.terms)}
    coefficients = np.zeros(library.size)
    for powers, value in sympy.Poly(known.potential, *known.dynamics.symbols).terms():
        if any(powers):
            term = sympy.Mul(*(s**e for s, e in zip(known.dynamics.symbols, powers, strict=True)))
            coefficients[position[term]] = float(value)
    return coefficients


def rough_start(
    known: KnownSystem, library: CandidateLibrary, x: np.ndarray, seed: int, error: float = 0.2
) -> np.ndarray:
    """A dense formula of V as networks might give it: off by a fifth, with all terms of the library."""
    draw = np.random.default_rng(seed)
    exact = exact_coefficients(known, library)
    spread = np.abs(library.evaluate(x)).mean(axis=0)
    size = np.abs(exact * spread).max()
    noise = draw.uniform(-1, 1, size=library.size) * size / np.where(spread > 0, spread, 1.0)
    noise = np.where(library.in_potential, noise, 0) * error / 20
    return exact * (1 + error * draw.uniform(-1, 1, size=library.size)) + noise


def refined(
    known: KnownSystem, start: np.ndarray, found: IdentifiedField, x: np.ndarray, **options: float
) -> GlobalPotential:
    return refine_globally(start, found.library, found, x, **options)


def names(result: GlobalPotential) -> set[str]:
    return {result.library.names[k] for k in np.flatnonzero(result.coefficients)}


@pytest.mark.parametrize("known", SYSTEMS.values(), ids=SYSTEMS)
def test_dense_starts_that_are_off_by_a_fifth_lead_to_the_right_terms(known: KnownSystem) -> None:
    found = exact_field(known, max(5, found_degree(known)))
    x = uniform_points(known, 400, share=0.6)
    exact = exact_coefficients(known, found.library)
    wanted = {found.library.names[k] for k in np.flatnonzero(exact)}
    solved = 0
    for seed in range(5):
        result = refined(known, rough_start(known, found.library, x, seed), found, x)
        if result.residual > 1e-10:  # a local minimum, which the residual shows
            assert result.residual > 1e-3
            continue
        solved += 1
        np.testing.assert_allclose(result.coefficients, exact, atol=1e-7)
        assert names(result) == wanted
    assert solved >= 3


def found_degree(known: KnownSystem) -> int:
    return max(
        sympy.Poly(equation, *known.dynamics.symbols).total_degree() for equation in known.dynamics.formulas
    )


def test_without_sparsity_all_terms_stay() -> None:
    known = SYSTEMS["Maier-Stein"]
    found, x = exact_field(known, 5), uniform_points(known, 400, share=0.6)
    result = refined(known, rough_start(known, found.library, x, 0), found, x, sparse=False)
    assert result.residual < 1e-10
    assert np.count_nonzero(result.coefficients) > len(names(refined(known, result.coefficients, found, x)))


@pytest.mark.parametrize("units", [np.array([1e-3, 40.0]), np.array([1e-6, 1e3])])
def test_other_units_give_the_same_terms(units: np.ndarray) -> None:
    known = SYSTEMS["Maier-Stein"]
    back = {s: s / sympy.Rational(str(u)) for s, u in zip(known.dynamics.symbols, units, strict=True)}
    scaled = KnownSystem(
        Dynamics.of(
            known.dynamics.symbols,
            tuple(
                sympy.expand(sympy.Rational(str(u)) * f.subs(back, simultaneous=True))
                for u, f in zip(units, known.dynamics.formulas, strict=True)
            ),
            diffusion=np.diag(units**2),
        ),
        sympy.expand(known.potential.subs(back, simultaneous=True)),
        known.attractors * units,
        known.domain * units[:, None],
    )
    found, other = exact_field(known, 5), exact_field(scaled, 5)
    x = uniform_points(known, 400, share=0.6)
    start = rough_start(known, found.library, x, 0)
    powers = np.array(
        [[sympy.degree(term, s) for s in known.dynamics.symbols] for term in found.library.terms]
    )
    factors = np.prod(units ** powers.astype(float), axis=1)
    one = refined(known, start, found, x)
    two = refined(scaled, start / factors, other, x * units)
    assert names(one) == names(two)
    np.testing.assert_allclose(two.coefficients * factors, one.coefficients, atol=1e-8)


@pytest.mark.parametrize("error", [1e-3, 1e-2])
@pytest.mark.parametrize("name", ["archetype", "Maier-Stein", "double well"])
def test_noise_in_f_brings_no_false_terms(name: str, error: float) -> None:
    known = SYSTEMS[name]
    found, x = exact_field(known, 5, relative_error=error), uniform_points(known, 400, share=0.6)
    exact = exact_coefficients(known, found.library)
    wanted = {found.library.names[k] for k in np.flatnonzero(exact)}
    right, scores = 0, []
    for seed in range(8):
        draw = np.random.default_rng(seed)
        coefficients = found.coefficients.copy()
        values = found.values * (1 + error * draw.normal(size=len(found.values)))
        coefficients[found.support[:, 1], found.support[:, 0]] = values
        mine = replace(found, coefficients=coefficients)
        result = refined(known, rough_start(known, found.library, x, seed, 0.05), mine, x)
        right += names(result) == wanted
        kept = np.flatnonzero(result.coefficients)
        scores.append((result.coefficients - exact)[kept] / np.sqrt(np.diag(result.covariance))[kept])
    assert right == 8
    assert np.abs(np.concatenate(scores)).max() < 4.5
    assert 0.4 < np.sqrt((np.concatenate(scores) ** 2).mean()) < 1.5


def test_a_start_of_zero_stays_zero() -> None:
    known = SYSTEMS["Maier-Stein"]
    found, x = exact_field(known, 4), uniform_points(known, 200, share=0.6)
    result = refined(known, np.zeros(found.library.size), found, x)
    assert not result.coefficients.any()
    assert not result.residual < 1


def test_values_of_a_potential_become_coefficients() -> None:
    known = SYSTEMS["archetype"]
    found, x = exact_field(known, 4), uniform_points(known, 300)
    coefficients = fit_values(found.library, x, potential_values(known, x) + 17)
    np.testing.assert_allclose(coefficients, exact_coefficients(known, found.library), atol=1e-9)


def test_the_sensitivity_has_rows_for_the_terms_that_stay() -> None:
    known = SYSTEMS["double well"]
    found, x = exact_field(known, 4, relative_error=1e-3), uniform_points(known, 300, share=0.6)
    result = refined(known, exact_coefficients(known, found.library), found, x)
    absent = result.coefficients == 0
    assert not result.sensitivity[absent].any()
    assert not result.covariance[absent].any()
    assert not result.covariance[:, absent].any()
    assert (np.diag(result.covariance)[~absent] > 0).all()
