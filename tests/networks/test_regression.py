from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from known_systems import exact_archetype

from siq.errors import NumericalFailure
from siq.inference.library import CandidateLibrary, candidate_library
from siq.networks.regression import RegressionOptions, points_below, sparse_decomposition
from siq.quasipotential.formulas import term_coefficients
from siq.systems.diffusion import Diffusion
from workflow.scoring import _exact_values

pytestmark = pytest.mark.portable

FULL = np.array([[1.0, 0.4], [0.4, 2.0]])
Values = tuple[np.ndarray, np.ndarray, np.ndarray]


PAPERS = {"threshold": 0.1, "threshold_on": "coefficient"}


def regress(
    x: np.ndarray,
    values: Values,
    *,
    states: str = "xy",
    diffusion: np.ndarray | None = None,
    **options: object,
) -> tuple[CandidateLibrary, Any]:
    settings = RegressionOptions(**{**PAPERS, "degree": 3, **options})
    library = candidate_library(
        tuple(states), degree=settings.degree, potential_degree=settings.potential_degree,
        circulatory_degree=settings.circulatory_degree, further=settings.functions,
    )  # fmt: skip
    diffusion = np.eye(len(states)) if diffusion is None else diffusion
    result = sparse_decomposition(library, x, *values, diffusion=Diffusion(diffusion), options=settings)
    return library, result


def terms(library: CandidateLibrary, coefficients: np.ndarray, *, constant: bool = True) -> dict[str, float]:
    return {
        name: float(value)
        for name, value in zip(library.names, coefficients, strict=True)
        if value != 0 and (constant or name != "1")
    }


def archetype_values(x: np.ndarray) -> Values:
    exact = exact_archetype().evaluate(x.T)
    return exact[0], exact[1:4].T, exact[4:].T


def below_two(count: int = 600) -> np.ndarray:
    x = np.random.default_rng(0).uniform(-1.6, 1.6, size=(count, 3))
    return x[points_below(_exact_values(exact_archetype(), x.T) / 2, level=2.0)]


def planar(
    x: np.ndarray, diffusion: np.ndarray, gradient: Callable[[np.ndarray], np.ndarray],
    potential: Callable[[np.ndarray], np.ndarray], turn: float = 0.8,
) -> Values:  # fmt: skip
    """V, g = turn·(-∂V/∂y, ∂V/∂x) and f = -D∇V + g: ∇V·g = 0 for any V."""
    slope = gradient(x)
    g = turn * np.stack([-slope[:, 1], slope[:, 0]], axis=1)
    return potential(x), g, g - slope @ diffusion


def well(x: np.ndarray) -> np.ndarray:
    return 0.5 * x[:, 0] ** 4 - x[:, 0] ** 2 + 0.7 * x[:, 1] ** 2 + 0.3 * x[:, 0] * x[:, 1]


def well_gradient(x: np.ndarray) -> np.ndarray:
    return np.stack([2 * x[:, 0] ** 3 - 2 * x[:, 0] + 0.3 * x[:, 1], 1.4 * x[:, 1] + 0.3 * x[:, 0]], axis=1)


WELL = {"x**4": 0.5, "x**2": -1.0, "y**2": 0.7, "x*y": 0.3}


def box(count: int = 400, seed: int = 1, dimension: int = 2) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.5, 1.5, size=(count, dimension))


def assert_coefficients(found: dict[str, float], expected: dict[str, float], tolerance: float) -> None:
    assert set(found) == set(expected)
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, abs=tolerance), name


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"threshold_on": "contribution", "threshold": 0.02},
        {"scaling": "none", "relaxation": 1e-5, "iterations": 300},
    ],
    ids=["default", "contribution", "published"],
)
def test_exact_values_of_the_archetype_give_exact_coefficients(options: dict) -> None:
    x = below_two()
    library, result = regress(x, archetype_values(x), states="xyz", **{"degree": 5, **options})
    exact = exact_archetype()
    truth = term_coefficients(exact.potential)
    found = terms(library, result.potential, constant=False)
    assert_coefficients(found, {name: value for name, value in truth.items() if name != "1"}, 1e-10)
    for i in range(3):
        assert_coefficients(
            terms(library, result.circulatory[:, i]), term_coefficients(exact.circulatory[i]), 1e-10
        )
        assert_coefficients(
            terms(library, result.vector_field[:, i]), term_coefficients(exact.vector_field[i]), 1e-10
        )
    assert result.constraint_residual < 1e-12
    assert result.misfit.max() < 1e-10
    assert result.points == len(x)


@pytest.mark.parametrize(
    "diffusion", [np.eye(2), np.diag([1.0, 0.25]), FULL], ids=["one", "diagonal", "full"]
)
def test_any_diffusion_gives_exact_coefficients_and_the_identity(diffusion: np.ndarray) -> None:
    x = box()
    library, result = regress(x, planar(x, diffusion, well_gradient, well), diffusion=diffusion, degree=4)
    assert_coefficients(terms(library, result.potential, constant=False), WELL, 1e-10)
    assert result.constraint_residual <= 1e-12
    points = box(20, seed=9)
    theta = library.evaluate(points)
    gradient = np.stack([theta @ library.derivatives[:, i] @ result.potential for i in range(2)], axis=1)
    np.testing.assert_allclose(
        theta @ result.vector_field, theta @ result.circulatory - gradient @ diffusion, atol=1e-11
    )


@pytest.mark.parametrize("diffusion", [np.eye(2), FULL], ids=["one", "full"])
def test_a_smooth_error_of_two_percent_leaves_the_right_terms(diffusion: np.ndarray) -> None:
    x = box()
    potential, g, f = planar(x, diffusion, well_gradient, well)
    wave = np.sin(3 * x[:, 0] + 1) * np.cos(2 * x[:, 1])
    potential = potential + 0.02 * potential.std() * wave
    g = g + 0.02 * g.std(axis=0) * np.stack([wave, -wave], axis=1)
    f = f + 0.02 * f.std(axis=0) * np.stack([wave * x[:, 0], wave], axis=1)
    library, result = regress(x, (potential, g, f), diffusion=diffusion, degree=4)
    assert_coefficients(terms(library, result.potential, constant=False), WELL, 0.05)
    assert set(terms(library, result.circulatory[:, 0])) == {"x", "y"}
    assert set(terms(library, result.circulatory[:, 1])) == {"x", "y", "x**3"}
    assert result.constraint_residual <= 1e-12
    assert 1e-4 < result.misfit.max() < 0.1


@pytest.mark.parametrize(("threshold_on", "threshold"), [("coefficient", 0.0), ("contribution", 0.02)])
def test_other_units_give_the_same_functions(threshold_on: str, threshold: float) -> None:
    x = box()
    potential, g, f = planar(x, FULL, well_gradient, well)
    potential = potential + 0.01 * np.sin(3 * x[:, 0])  # so that not every route gives the same
    units = np.array([1e-3, 40.0])
    options = {"degree": 4, "threshold_on": threshold_on, "threshold": threshold}
    library, before = regress(x, (potential, g, f), diffusion=FULL, **options)
    _, after = regress(
        x * units, (potential, g * units, f * units), diffusion=FULL * np.outer(units, units), **options
    )
    points = box(30, seed=5)
    theta, theta_in_units = library.evaluate(points), library.evaluate(points * units)
    np.testing.assert_allclose(theta_in_units @ after.potential, theta @ before.potential, atol=1e-8)
    np.testing.assert_allclose(
        theta_in_units @ after.circulatory / units, theta @ before.circulatory, atol=1e-8
    )
    np.testing.assert_allclose(
        theta_in_units @ after.vector_field / units, theta @ before.vector_field, atol=1e-8
    )
    np.testing.assert_allclose(before.misfit, after.misfit, rtol=1e-6, atol=1e-10)
    for name in ("potential", "circulatory", "vector_field"):
        np.testing.assert_array_equal(getattr(before, name) != 0, getattr(after, name) != 0)


def test_the_number_of_points_does_not_matter_with_scaled_columns() -> None:
    x = box()
    potential, g, f = planar(x, FULL, well_gradient, well)
    potential = potential + 0.01 * np.sin(3 * x[:, 0])
    _, once = regress(x, (potential, g, f), diffusion=FULL, degree=4)
    thrice = tuple(np.concatenate([part] * 3) for part in (potential, g, f))
    _, more = regress(np.concatenate([x] * 3), thrice, diffusion=FULL, degree=4)
    np.testing.assert_allclose(more.potential, once.potential, atol=1e-9)
    np.testing.assert_allclose(more.circulatory, once.circulatory, atol=1e-9)
    assert more.iterations == once.iterations


@pytest.mark.parametrize(
    ("function", "potential", "slope"),
    [
        ("sqrt(x**2 + 1)", lambda x: np.sqrt(x**2 + 1), lambda x: x / np.sqrt(x**2 + 1)),
        ("log(x**2 + 1)", lambda x: np.log(x**2 + 1), lambda x: 2 * x / (x**2 + 1)),
    ],
)
def test_a_potential_that_is_no_polynomial_is_recovered(
    function: str, potential: Callable, slope: Callable
) -> None:
    x = box(800) * 1.5

    def value(x: np.ndarray) -> np.ndarray:
        return 1.5 * potential(x[:, 0]) + 0.5 * x[:, 1] ** 2

    def gradient(x: np.ndarray) -> np.ndarray:
        return np.stack([1.5 * slope(x[:, 0]), x[:, 1]], axis=1)

    library, result = regress(x, planar(x, np.eye(2), gradient, value), degree=2, functions=(function,))
    assert_coefficients(terms(library, result.potential, constant=False), {function: 1.5, "y**2": 0.5}, 1e-8)
    assert result.constraint_residual <= 1e-12
    assert result.misfit.max() < 1e-8


def test_without_a_threshold_the_result_is_the_least_squares_fit_of_v_and_g() -> None:
    x = box(60)
    potential, g, f = planar(x, FULL, well_gradient, well)
    potential, g = potential + 0.1 * np.sin(5 * x[:, 0]), g + 0.1 * np.cos(4 * x)
    library, result = regress(x, (potential, g, f), diffusion=FULL, degree=3, threshold=0.0, scaling="none")
    # The same without constraints: V and g are free, f follows from them.
    theta, q = library.evaluate(x), library.size
    downhill = [-theta @ np.einsum("l,klj->kj", FULL[i], library.derivatives) for i in range(2)]
    zero = np.zeros_like(theta)
    design = np.block(
        [
            [downhill[0], theta, zero],
            [downhill[1], zero, theta],
            [theta, zero, zero],
            [zero, theta, zero],
            [zero, zero, theta],
        ]
    )
    goal = np.concatenate([f[:, 0], f[:, 1], potential - potential.min(), g[:, 0], g[:, 1]])
    expected = np.linalg.lstsq(design, goal, rcond=None)[0]
    np.testing.assert_allclose(result.potential, expected[:q], atol=1e-9)
    np.testing.assert_allclose(result.circulatory.T.ravel(), expected[q:], atol=1e-9)


def test_a_gradient_system_has_no_terms_of_g() -> None:
    x = box()
    library, result = regress(x, planar(x, FULL, well_gradient, well, turn=0.0), diffusion=FULL, degree=4)
    assert not result.circulatory.any()
    assert_coefficients(terms(library, result.potential, constant=False), WELL, 1e-10)
    assert np.isfinite(result.misfit).all()


@pytest.mark.parametrize("dimension", [1, 2, 4])
def test_linear_systems_of_any_dimension_are_recovered(dimension: int) -> None:
    draw = np.random.default_rng(dimension)
    turn = draw.normal(size=(dimension, dimension))
    turn = turn - turn.T
    turn[np.abs(turn) < 0.3] = 0
    x = box(400, dimension=dimension)
    values = (0.5 * (x**2).sum(axis=1), x @ turn.T, x @ turn.T - x)
    library, result = regress(x, values, states="xyzw"[:dimension], degree=2)
    names = "xyzw"[:dimension]
    assert_coefficients(
        terms(library, result.potential, constant=False), {f"{s}**2": 0.5 for s in names}, 1e-10
    )
    for i in range(dimension):
        expected = {s: turn[i, j] for j, s in enumerate(names) if turn[i, j]}
        assert_coefficients(terms(library, result.circulatory[:, i]), expected, 1e-10)


@pytest.mark.parametrize(("value", "kept"), [(0.101, True), (-0.101, True), (0.099, False), (-0.099, False)])
def test_a_term_is_kept_exactly_above_the_threshold(value: float, kept: bool) -> None:
    x = box() * [1.0, 3.0]  # scaled columns: the threshold still acts on coefficients

    def potential(x: np.ndarray) -> np.ndarray:
        return x[:, 0] ** 2 + x[:, 1] ** 2 + value * x[:, 0] * x[:, 1]

    def gradient(x: np.ndarray) -> np.ndarray:
        return np.stack([2 * x[:, 0] + value * x[:, 1], 2 * x[:, 1] + value * x[:, 0]], axis=1)

    library, result = regress(x, planar(x, np.eye(2), gradient, potential, turn=1.0), degree=2)
    assert ("x*y" in terms(library, result.potential)) is kept


def test_v_and_g_keep_to_their_degrees() -> None:
    x = box()
    library, result = regress(
        x, planar(x, np.eye(2), well_gradient, well), degree=4, potential_degree=2, circulatory_degree=1
    )
    degrees = np.array([sum(map(int, np.atleast_1d(row))) for row in _exponents(library)])
    assert not result.potential[degrees > 2].any()
    assert not result.circulatory[degrees > 1].any()
    assert result.constraint_residual <= 1e-12


def _exponents(library: CandidateLibrary) -> list[tuple[int, ...]]:
    return [tuple(int(term.as_powers_dict().get(s, 0)) for s in library.symbols) for term in library.terms]


def test_the_constant_of_v_does_not_change_anything_else() -> None:
    x = box()
    potential, g, f = planar(x, FULL, well_gradient, well)
    _, one = regress(x, (potential, g, f), diffusion=FULL, degree=4)
    _, other = regress(x, (potential + 1e3, g, f), diffusion=FULL, degree=4)
    np.testing.assert_allclose(other.potential[1:], one.potential[1:], atol=1e-8)
    np.testing.assert_allclose(other.vector_field, one.vector_field, atol=1e-8)


def test_too_few_points_are_a_numerical_failure() -> None:
    x = box(9)
    with pytest.raises(NumericalFailure, match="only 9 points lie below the level, fewer than the 10"):
        regress(x, planar(x, np.eye(2), well_gradient, well))


@pytest.mark.parametrize("place", [0, 1, 2])
def test_values_that_are_not_finite_are_a_numerical_failure(place: int) -> None:
    x = box()
    values = planar(x, np.eye(2), well_gradient, well)
    values[place].flat[3] = np.nan
    with pytest.raises(NumericalFailure, match="not finite"):
        regress(x, values)


def test_a_library_function_that_is_not_finite_is_a_numerical_failure() -> None:
    x = box()
    with pytest.raises(NumericalFailure, match="not finite"), np.errstate(invalid="ignore"):
        regress(x, planar(x, np.eye(2), well_gradient, well), functions=("log(x)",))


def test_points_below_the_level_are_counted_from_the_minimum() -> None:
    np.testing.assert_array_equal(
        points_below(np.array([-3.0, -1.5, -1.0, -0.9, 5.0]), level=2.0), [True, True, False, False, False]
    )


def test_without_a_level_the_lowest_three_quarters_of_the_points_are_used_in_any_units() -> None:
    values = np.random.default_rng(0).normal(size=400)
    below = points_below(values, level=None)
    assert below.sum() == 300 and values[below].max() < values[~below].min()
    np.testing.assert_array_equal(below, points_below(1e-9 * values - 7, level=None))
