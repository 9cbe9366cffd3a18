"""One formula for the recorded region: its terms, its errors, and the joint fit of V and g."""

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
    linear_system,
    maier_stein,
    polynomial_system,
    potential_values,
    uniform_points,
)

from siq.errors import NumericalFailure
from siq.inference.field_estimate import FieldEstimate
from siq.inference.library import CandidateLibrary
from siq.quasipotential.global_formula import (
    GlobalFormula,
    _fit_orthogonal,
    fit_values,
    refine_globally,
)
from siq.systems.diffusion import Diffusion
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
    known: KnownSystem, start: np.ndarray, found: FieldEstimate, x: np.ndarray, **options: float
) -> GlobalFormula:
    return refine_globally(start, found, x, **options)


def names(library: CandidateLibrary, result: GlobalFormula) -> set[str]:
    return {library.names[k] for k in np.flatnonzero(result.potential)}


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
        np.testing.assert_allclose(result.potential, exact, atol=1e-7)
        assert names(found.library, result) == wanted
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
    assert np.count_nonzero(result.potential) > len(
        names(found.library, refined(known, result.potential, found, x))
    )


def test_two_places_tell_no_formula() -> None:
    """As of a channel that is 0 or 1: V had fewer equations than terms."""
    known = SYSTEMS["Maier-Stein"]
    found, x = exact_field(known, 5), uniform_points(known, 2, share=0.6)
    with pytest.raises(NumericalFailure, match="2 places"):
        refined(known, np.ones(found.library.size), found, x)


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
    assert names(found.library, one) == names(found.library, two)
    np.testing.assert_allclose(two.potential * factors, one.potential, atol=1e-8)


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
        right += names(found.library, result) == wanted
        kept = np.flatnonzero(result.potential)
        scores.append((result.potential - exact)[kept] / np.sqrt(np.diag(result.covariance))[kept])
    assert right == 8
    assert np.abs(np.concatenate(scores)).max() < 4.5
    assert 0.4 < np.sqrt((np.concatenate(scores) ** 2).mean()) < 1.5


def test_a_start_of_zero_stays_zero() -> None:
    known = SYSTEMS["Maier-Stein"]
    found, x = exact_field(known, 4), uniform_points(known, 200, share=0.6)
    result = refined(known, np.zeros(found.library.size), found, x)
    assert not result.potential.any()
    assert not result.residual < 1


def test_values_of_a_potential_become_coefficients() -> None:
    known = SYSTEMS["archetype"]
    found, x = exact_field(known, 4), uniform_points(known, 300)
    coefficients = fit_values(found.library, [x], [potential_values(known, x) + 17])
    np.testing.assert_allclose(coefficients, exact_coefficients(known, found.library), atol=1e-9)


def test_the_sensitivity_has_rows_for_the_terms_that_stay() -> None:
    known = SYSTEMS["double well"]
    found, x = exact_field(known, 4, relative_error=1e-3), uniform_points(known, 300, share=0.6)
    result = refined(known, exact_coefficients(known, found.library), found, x)
    absent = result.potential == 0
    assert not result.sensitivity[absent].any()
    assert not result.covariance[absent].any()
    assert not result.covariance[:, absent].any()
    assert (np.diag(result.covariance)[~absent] > 0).all()


pytestmark = pytest.mark.portable

POLYNOMIALS = {
    "archetype": archetype(3),
    "Maier-Stein": maier_stein(1),
    "double well": double_well(2),
    "polynomial": polynomial_system(2, seed=1, linear_rotation=False),
}


def over_library(found: FieldEstimate, expression: sympy.Expr) -> np.ndarray:
    position = {term: k for k, term in enumerate(found.library.terms)}
    coefficients = np.zeros(found.library.size)
    for powers, value in sympy.Poly(expression, *found.library.symbols).terms():
        term = sympy.Mul(*(s**e for s, e in zip(found.library.symbols, powers, strict=True)))
        coefficients[position[term]] = float(value)
    return coefficients


def decomposition(known: KnownSystem, found: FieldEstimate) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of the true V, without its constant, and of g = f + D∇V."""
    potential = over_library(found, known.potential)
    potential[found.library.constant] = 0
    slope = sympy.Matrix([known.potential.diff(s) for s in known.dynamics.symbols])
    diffusion = sympy.Matrix(known.diffusion.tolist()).applyfunc(sympy.nsimplify)
    g = sympy.Matrix(known.dynamics.formulas) + diffusion * slope
    circulatory = np.stack([over_library(found, sympy.expand(part)) for part in g], axis=1)
    circulatory[np.abs(circulatory) < 1e-12] = 0
    return potential, circulatory


def uncertain(known: KnownSystem, size: float) -> FieldEstimate:
    """The exact f, claimed to be known with correlated errors."""
    found = exact_field(known, 4, relative_error=size)
    draw = np.random.default_rng(3).normal(size=(len(found.values),) * 2)
    factor = size * (draw / np.sqrt(len(draw)) + np.eye(len(draw)))
    return replace(found, covariance=factor @ factor.T)


def drawn(found: FieldEstimate, seed: int) -> FieldEstimate:
    values = np.random.default_rng(seed).multivariate_normal(found.values, found.covariance)
    coefficients = found.coefficients.copy()
    coefficients[found.support[:, 1], found.support[:, 0]] = values
    return replace(found, coefficients=coefficients)


def fitted(
    known: KnownSystem, found: FieldEstimate, potential: np.ndarray, circulatory: np.ndarray
) -> GlobalFormula | None:
    x = uniform_points(known, 300, share=0.6)
    return _fit_orthogonal(found, potential, circulatory, x)


@pytest.mark.parametrize("name", POLYNOMIALS)
def test_an_exact_f_keeps_its_decomposition(name: str) -> None:
    known = POLYNOMIALS[name]
    found = uncertain(known, 1e-3)
    potential, circulatory = decomposition(known, found)
    fit = fitted(known, found, potential, circulatory)
    assert fit is not None
    np.testing.assert_allclose(fit.potential, potential, atol=1e-9)
    np.testing.assert_allclose(fit.circulatory, circulatory, atol=1e-9)
    assert fit.chi_square < 1e-12
    assert fit.probability > 0.99


@pytest.mark.parametrize("name", POLYNOMIALS)
def test_v_and_g_are_orthogonal_everywhere_and_make_up_a_field(name: str) -> None:
    known = POLYNOMIALS[name]
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


@pytest.mark.parametrize("name", POLYNOMIALS)
def test_errors_are_as_large_as_stated_and_smaller_than_without_the_constraint(name: str) -> None:
    known = POLYNOMIALS[name]
    center = uncertain(known, 5e-3)
    potential, circulatory = decomposition(known, center)
    terms = potential != 0
    x = uniform_points(known, 300, share=0.6)
    scores, scores_of_g, errors, others, chances = [], [], [], [], []
    for seed in range(30):
        found = drawn(center, seed)
        fit = _fit_orthogonal(found, potential, circulatory, x)
        assert fit is not None
        stated = np.sqrt(np.diag(fit.covariance))[terms]
        error = (fit.potential - potential)[terms]
        scores.append(error / stated)
        errors.append(error)
        moving = fit.circulatory_errors > 0
        scores_of_g.append((fit.circulatory - circulatory)[moving] / fit.circulatory_errors[moving])
        plain = refine_globally(potential, found, x, sparse=False)
        others.append((plain.potential - potential)[terms])
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
    known = POLYNOMIALS["double well"]
    found = uncertain(known, 2e-3)
    potential, circulatory = decomposition(known, found)
    for k in np.flatnonzero(potential):
        without = potential.copy()
        without[k] = 0
        fit = fitted(known, found, without, circulatory)
        assert fit is None or fit.probability < 1e-8


def test_a_missing_term_of_g_is_implausible() -> None:
    known = POLYNOMIALS["Maier-Stein"]
    found = uncertain(known, 2e-3)
    potential, circulatory = decomposition(known, found)
    for k, i in np.argwhere(circulatory):
        without = circulatory.copy()
        without[k, i] = 0
        fit = fitted(known, found, potential, without)
        assert fit is None or fit.probability < 1e-8


def test_more_terms_than_needed_cost_precision_only() -> None:
    known = POLYNOMIALS["archetype"]
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
    fit = GlobalFormula(np.zeros(1), np.zeros((1, 1)), freedom=0, chi_square=0.0)
    assert fit.probability == 1.0


@pytest.mark.parametrize("units", [np.array([1e-3, 40.0]), np.array([1e-5, 1e3])])
def test_other_units_give_the_same_fit(units: np.ndarray) -> None:
    known = POLYNOMIALS["Maier-Stein"]
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
    errors = np.sqrt(np.diag(one.covariance))
    np.testing.assert_allclose(np.sqrt(np.diag(two.covariance)) * factors, errors, rtol=1e-5)
