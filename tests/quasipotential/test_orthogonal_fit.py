from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    double_well,
    exact_field,
    maier_stein,
    polynomial_system,
    uniform_points,
)

from siq.inference.field_estimate import IdentifiedField
from siq.quasipotential.global_formula import RegionFormula, _fit_orthogonal, refine_globally
from siq.systems.diffusion import Diffusion

pytestmark = pytest.mark.portable

SYSTEMS = {
    "archetype": archetype(3),
    "Maier-Stein": maier_stein(1),
    "double well": double_well(2),
    "polynomial": polynomial_system(2, seed=1, linear_rotation=False),
}


def over_library(found: IdentifiedField, expression: sympy.Expr) -> np.ndarray:
    position = {term: k for k, term in enumerate(found.library.terms)}
    coefficients = np.zeros(found.library.size)
    for powers, value in sympy.Poly(expression, *found.library.symbols).terms():
        term = sympy.Mul(*(s**e for s, e in zip(found.library.symbols, powers, strict=True)))
        coefficients[position[term]] = float(value)
    return coefficients


def decomposition(known: KnownSystem, found: IdentifiedField) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of the true V, without its constant, and of g = f + D∇V."""
    potential = over_library(found, known.potential)
    potential[found.library.constant] = 0
    slope = sympy.Matrix([known.potential.diff(s) for s in known.dynamics.symbols])
    diffusion = sympy.Matrix(known.diffusion.tolist()).applyfunc(sympy.nsimplify)
    g = sympy.Matrix(known.dynamics.formulas) + diffusion * slope
    circulatory = np.stack([over_library(found, sympy.expand(part)) for part in g], axis=1)
    circulatory[np.abs(circulatory) < 1e-12] = 0
    return potential, circulatory


def uncertain(known: KnownSystem, size: float) -> IdentifiedField:
    """The exact f, claimed to be known with correlated errors."""
    found = exact_field(known, 4, relative_error=size)
    draw = np.random.default_rng(3).normal(size=(len(found.values),) * 2)
    factor = size * (draw / np.sqrt(len(draw)) + np.eye(len(draw)))
    return replace(found, covariance=factor @ factor.T)


def drawn(found: IdentifiedField, seed: int) -> IdentifiedField:
    values = np.random.default_rng(seed).multivariate_normal(found.values, found.covariance)
    coefficients = found.coefficients.copy()
    coefficients[found.support[:, 1], found.support[:, 0]] = values
    return replace(found, coefficients=coefficients)


def fitted(
    known: KnownSystem, found: IdentifiedField, potential: np.ndarray, circulatory: np.ndarray
) -> RegionFormula | None:
    x = uniform_points(known, 300, share=0.6)
    return _fit_orthogonal(found, potential, circulatory, x)


@pytest.mark.parametrize("name", SYSTEMS)
def test_an_exact_f_keeps_its_decomposition(name: str) -> None:
    known = SYSTEMS[name]
    found = uncertain(known, 1e-3)
    potential, circulatory = decomposition(known, found)
    fit = fitted(known, found, potential, circulatory)
    assert fit is not None
    np.testing.assert_allclose(fit.potential, potential, atol=1e-9)
    np.testing.assert_allclose(fit.circulatory, circulatory, atol=1e-9)
    assert fit.chi_square < 1e-12
    assert fit.probability > 0.99


@pytest.mark.parametrize("name", SYSTEMS)
def test_v_and_g_are_orthogonal_everywhere_and_make_up_a_field(name: str) -> None:
    known = SYSTEMS[name]
    found = drawn(uncertain(known, 5e-3), 0)
    fit = fitted(known, found, *decomposition(known, found))
    assert fit is not None
    x = uniform_points(known, 200, seed=8)  # farther out than the points of the fit
    theta = found.library.evaluate(x)
    gradient = np.einsum("nk,kij,j->ni", theta, found.library.derivatives, fit.potential)
    g = theta @ fit.circulatory
    size = np.linalg.norm(gradient, axis=1) * np.linalg.norm(g, axis=1)
    assert (np.abs((gradient * g).sum(axis=1)) <= 1e-9 * size + 1e-12).all()
    # The field that V and g make has no terms that the identified one does not have.
    downhill = np.einsum("il,klj,j->ki", known.diffusion, found.library.derivatives, fit.potential)
    built = fit.circulatory - downhill
    assert np.abs(built[found.coefficients == 0]).max() < 1e-8


@pytest.mark.parametrize("name", SYSTEMS)
def test_errors_are_as_large_as_stated_and_smaller_than_without_the_constraint(name: str) -> None:
    known = SYSTEMS[name]
    center = uncertain(known, 5e-3)
    potential, circulatory = decomposition(known, center)
    terms = potential != 0
    x = uniform_points(known, 300, share=0.6)
    scores, scores_of_g, errors, others, chances = [], [], [], [], []
    for seed in range(30):
        found = drawn(center, seed)
        fit = _fit_orthogonal(found, potential, circulatory, x)
        assert fit is not None
        stated = np.sqrt(np.diag(fit.potential_covariance))[terms]
        error = (fit.potential - potential)[terms]
        scores.append(error / stated)
        errors.append(error)
        moving = fit.circulatory_errors > 0
        scores_of_g.append((fit.circulatory - circulatory)[moving] / fit.circulatory_errors[moving])
        plain = refine_globally(potential, found.library, found, x, sparse=False)
        others.append((plain.coefficients - potential)[terms])
        chances.append(fit.probability)
    assert 0.8 < np.sqrt(np.mean(np.square(scores))) < 1.2
    if scores_of_g[0].size:
        assert 0.75 < np.sqrt(np.mean(np.square(np.concatenate(scores_of_g)))) < 1.25
    covered = np.mean(np.abs(scores) < 1.96)
    assert covered > 0.95 - 4 * np.sqrt(0.05 * 0.95 / (30 * min(terms.sum(), 4)))
    ratio = np.sqrt(np.mean(np.square(errors), axis=0) / np.mean(np.square(others), axis=0))
    assert np.exp(np.log(ratio).mean()) < 0.97
    if fit.freedom:
        assert scipy.stats.kstest(chances, "uniform").pvalue > 1e-3


def test_a_missing_term_of_v_is_implausible() -> None:
    known = SYSTEMS["double well"]
    found = uncertain(known, 2e-3)
    potential, circulatory = decomposition(known, found)
    for k in np.flatnonzero(potential):
        without = potential.copy()
        without[k] = 0
        fit = fitted(known, found, without, circulatory)
        assert fit is None or fit.probability < 1e-8


def test_a_missing_term_of_g_is_implausible() -> None:
    known = SYSTEMS["Maier-Stein"]
    found = uncertain(known, 2e-3)
    potential, circulatory = decomposition(known, found)
    for k, i in np.argwhere(circulatory):
        without = circulatory.copy()
        without[k, i] = 0
        fit = fitted(known, found, potential, without)
        assert fit is None or fit.probability < 1e-8


def test_more_terms_than_needed_cost_precision_only() -> None:
    known = SYSTEMS["archetype"]
    found = drawn(uncertain(known, 5e-3), 1)
    potential, circulatory = decomposition(known, found)
    fit = fitted(known, found, potential, circulatory)
    more = potential.copy()
    more[found.library.names.index("y*z")] = 1e-3
    wide = fitted(known, found, more, circulatory)
    assert fit is not None
    assert wide is not None
    np.testing.assert_allclose(wide.potential, fit.potential, atol=0.05)
    assert wide.chi_square <= fit.chi_square + 1e-9


def test_no_freedom_left_is_no_evidence() -> None:
    fit = RegionFormula(
        np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)), freedom=0, chi_square=0.0
    )
    assert fit.probability == 1.0


@pytest.mark.parametrize("units", [np.array([1e-3, 40.0]), np.array([1e-5, 1e3])])
def test_other_units_give_the_same_fit(units: np.ndarray) -> None:
    known = SYSTEMS["Maier-Stein"]
    found = drawn(uncertain(known, 5e-3), 0)
    potential, circulatory = decomposition(known, found)
    x = uniform_points(known, 300, share=0.6)
    powers = np.array(
        [[sympy.degree(term, s) for s in found.library.symbols] for term in found.library.terms]
    )
    factors = np.prod(units ** powers.astype(float), axis=1)
    change = (units[found.support[:, 0]]) / factors[found.support[:, 1]]
    scaled = replace(
        found, coefficients=found.coefficients * units / factors[:, None],
        covariance=found.covariance * np.outer(change, change),
        diffusion=Diffusion(known.diffusion * np.outer(units, units)),
    )  # fmt: skip
    one = _fit_orthogonal(found, potential, circulatory, x)
    two = _fit_orthogonal(
        scaled, potential / factors, circulatory * units / factors[:, None], x * units,
    )  # fmt: skip
    assert one is not None
    assert two is not None
    assert two.freedom == one.freedom
    assert two.chi_square == pytest.approx(one.chi_square, rel=1e-6)
    np.testing.assert_allclose(two.potential * factors, one.potential, atol=1e-9)
    np.testing.assert_allclose(two.circulatory * factors[:, None] / units, one.circulatory, atol=1e-9)
    errors = np.sqrt(np.diag(one.potential_covariance))
    np.testing.assert_allclose(np.sqrt(np.diag(two.potential_covariance)) * factors, errors, rtol=1e-5)
