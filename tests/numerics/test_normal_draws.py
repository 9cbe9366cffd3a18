"""Draws from a normal distribution: right for coordinates of any size."""

from __future__ import annotations

import numpy as np

from siq.numerics.randomness import normal_draws


def test_draws_have_mean_and_covariance_in_any_units() -> None:
    mean = np.array([1.0, -2.0, 0.5, 3.0])
    root = np.array([[1.0, 0, 0, 0], [0.9, 0.3, 0, 0], [-0.2, 0.5, 0.1, 0], [0, 0, 0, 0]])
    covariance = root @ root.T  # the last has no variance
    plain = normal_draws(mean, covariance, 20_000, generator=np.random.default_rng(1))
    np.testing.assert_allclose(plain.mean(axis=0), mean, atol=0.03)
    np.testing.assert_allclose(np.cov(plain.T), covariance, atol=0.03)
    np.testing.assert_array_equal(plain[:, 3], 3.0)
    units = np.array([1e-9, 1e14, 1.0, 1e5])
    other = normal_draws(
        mean * units, covariance * np.outer(units, units), 20_000, generator=np.random.default_rng(1)
    )
    np.testing.assert_allclose(other / units, plain, rtol=1e-9, atol=1e-9)


def test_what_rounding_makes_negative_is_zero() -> None:
    ones = np.ones((3, 3)) - 1e-12 * np.eye(3)[::-1]  # of rank one, but for rounding
    drawn = normal_draws(np.zeros(3), (ones + ones.T) / 2, 100, generator=np.random.default_rng(2))
    np.testing.assert_allclose(drawn, drawn[:, :1] * np.ones(3), atol=1e-4)
