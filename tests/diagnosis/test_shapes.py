"""A smooth function has the name of the simplest formula within its errors, or none."""

from __future__ import annotations

import numpy as np
import pytest

from siq.diagnosis.smooth_functions import FORMS, A, _fitting

Z = np.linspace(-0.2, 1.0, 25)
SHAPES = {
    "constant": (lambda z: np.full_like(z, 1.0), [1.0]),
    "proportional": (lambda z: -0.8 * z, [-0.8]),
    "straight line": (lambda z: 1 - 0.5 * z, [-0.5, 1.0]),
    "square": (lambda z: 2 * z**2, [2.0]),
    "signed square": (lambda z: -2 * z * abs(z), [-2.0]),
    "cube": (lambda z: z**3, [1.0]),
    "fourth power": (lambda z: z**4, [1.0]),
    "exponential": (lambda z: 0.01 * np.exp(z / 0.2), [0.01, 0.2]),
    "exponential above a constant": (lambda z: 0.02 * np.expm1(z / 0.2), [0.02, -0.02, 0.2]),
    "saturating": (lambda z: z / (0.2 + abs(z)), [1.0, 0.2]),
    "saturating, tanh": (lambda z: 0.5 * np.tanh(z / 0.15), [0.5, 0.15]),
    "threshold": (lambda z: 2 * np.maximum(z - 0.43, 0), [2.0, 0.43]),
    "periodic": (lambda z: np.sin(2 * np.pi * z / 0.5), [1.0, 0.0, 0.5]),
}
NAMELESS = {
    "a bump": lambda z: np.exp(-0.5 * ((z - 0.3) / 0.1) ** 2),
    "a line that wavers": lambda z: z + 0.3 * np.sin(9 * z),
    "a step between two places": lambda z: np.tanh((z - 0.3) / 0.05) - np.tanh((z - 0.6) / 0.05),
}


def known_to(error: float, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Errors of a function, alike over a fifth of its range, and what makes them independent."""
    apart = np.subtract.outer(Z, Z) / np.ptp(Z)
    root = error * np.linalg.cholesky(np.exp(-0.5 * (apart / 0.2) ** 2) + 1e-4 * np.eye(len(Z)))
    return root @ draw.normal(size=len(Z)), np.linalg.inv(root)


def fits_of(values: np.ndarray, weights: np.ndarray, forms=FORMS):
    return _fitting(Z, weights, weights @ values, len(Z), forms)


@pytest.mark.parametrize("name", SHAPES)
def test_a_shape_is_found_with_its_coefficients(name: str) -> None:
    function, true = SHAPES[name]
    found, near = 0, 0
    for seed in range(20):
        errors, weights = known_to(0.004, np.random.default_rng(seed))
        fits = fits_of(function(Z) + errors, weights)
        if not fits or len(fits[0][1]) != len(true):
            continue
        form, coefficients = fits[0]
        found += form.name == name.split(",")[0].removesuffix(" above a constant")
        values, uncertain = np.array(list(coefficients.values())).T
        near += (abs(values - true) < 3 * uncertain).all()
    # By chance one in twenty is thought to be more than it is.
    assert found >= 15 and near >= found - 1


@pytest.mark.parametrize("name", NAMELESS)
def test_what_is_no_simple_formula_has_no_name(name: str) -> None:
    for seed in range(5):
        errors, weights = known_to(0.004, np.random.default_rng(seed))
        assert fits_of(NAMELESS[name](Z) + errors, weights) == []


def test_a_wide_band_asks_for_no_more_than_the_simplest() -> None:
    errors, weights = known_to(0.5, np.random.default_rng(1))
    (fit, *_) = fits_of(np.exp(Z) + errors, weights)
    assert len(fit[1]) == 1


def test_a_coefficient_that_may_not_be_negative_is_not() -> None:
    errors, weights = known_to(0.01, np.random.default_rng(1))
    (line,) = (each for each in FORMS if each.name == "proportional")
    for sign, count in ((1, 1), (-1, 0)):
        fits = fits_of(sign * Z + errors, weights, [line._replace(positive=(A,))])
        assert len(fits) == count
