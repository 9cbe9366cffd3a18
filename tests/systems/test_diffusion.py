from __future__ import annotations

import numpy as np
import pytest

from siq.errors import NumericalFailure
from siq.systems.diffusion import Diffusion

FULL = np.array([[2.0, 0.5, 0.1], [0.5, 1.0, -0.3], [0.1, -0.3, 0.7]])
DRAW = np.random.default_rng(0)
X, P = DRAW.normal(size=(2, 5, 3))


@pytest.mark.parametrize("scale", [np.ones(3), np.array([1e-6, 1.0, 1e8])])
def test_root_inverse_and_whitening_belong_to_one_d_in_any_units(scale: np.ndarray) -> None:
    noise = Diffusion(FULL * np.outer(scale, scale))
    own = np.outer(scale, scale)
    np.testing.assert_allclose(noise.root @ noise.root.T / own, FULL, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(
        (noise.precision @ noise.matrix) * np.outer(scale, 1 / scale), np.eye(3), atol=1e-12
    )
    np.testing.assert_allclose(noise.whitening @ noise.root, np.eye(3), atol=1e-12)
    assert noise.intensity(0.3 * noise.matrix) == pytest.approx(0.3, rel=1e-12)


def test_products_at_points() -> None:
    noise = Diffusion(FULL)
    np.testing.assert_allclose(noise.push(X, P), P @ FULL, rtol=1e-14)
    np.testing.assert_allclose(noise.contract(X, P), [p @ FULL @ p for p in P], rtol=1e-13)
    np.testing.assert_allclose(noise.squared_speed(X, noise.push(X, P)), noise.contract(X, P), rtol=1e-12)
    np.testing.assert_array_equal(noise.at(X)[3], FULL)


def test_several_momenta_at_a_point_are_taken_one_by_one() -> None:
    noise, many = Diffusion(FULL), np.random.default_rng(1).normal(size=(5, 4, 3))
    together = noise.contract(X, many)
    assert noise.push(X, many).shape == (5, 4, 3)
    for k in range(4):
        np.testing.assert_allclose(together[:, k], noise.contract(X, many[:, k]), rtol=1e-13)


def test_a_noise_that_does_not_reach_every_state_has_a_root_and_no_inverse() -> None:
    noise = Diffusion(np.array([[1.0]])).extended(1)
    assert not noise.regular
    np.testing.assert_allclose(noise.root @ noise.root.T, np.diag([1.0, 0.0]), atol=1e-15)
    for ask in (
        lambda: noise.precision,
        lambda: noise.whitening,
        lambda: noise.squared_speed(X[:, :2], P[:, :2]),
    ):
        with pytest.raises(NumericalFailure, match="does not reach every state"):
            ask()


def test_a_matrix_that_is_symmetric_to_rounding_is_taken_as_symmetric() -> None:
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    found = Diffusion(turn @ np.eye(2) @ turn.T + np.array([[0.0, 1e-17], [0.0, 0.0]]))
    np.testing.assert_array_equal(found.matrix, found.matrix.T)


@pytest.mark.parametrize(
    ("matrix", "fault"),
    [
        (np.ones(2), "not a square matrix"),
        (np.ones((2, 3)), "not a square matrix"),
        (np.array([[1.0, 0.5], [0.4, 1.0]]), "not symmetric"),
        (np.array([[1.0, np.nan], [np.nan, 1.0]]), "not symmetric"),
        (np.diag([1.0, -1.0]), "not positive semi-definite"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "not positive semi-definite"),
    ],
)
def test_what_is_no_covariance_is_refused(matrix: np.ndarray, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        Diffusion(matrix)
