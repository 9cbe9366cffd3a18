"""Draws from a normal distribution, and subsets of points that cover the region of all."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from siq.numerics.randomness import generator, normal_draws, representative_subset

pytestmark = pytest.mark.portable


def naive_subset(points: np.ndarray, distance: float, order: np.ndarray) -> np.ndarray:
    kept: list[int] = []
    for index in order:
        if all(np.linalg.norm(points[index] - points[other]) >= distance for other in kept):
            kept.append(index)
    return np.sort(kept)


@pytest.mark.parametrize("dimension", [1, 2, 3, 4, 5])
def test_kept_points_are_separate_and_cover_the_others(dimension: int) -> None:
    points = generator(dimension).normal(size=(5000, dimension))
    distance = [0.02, 0.1, 0.3, 0.6, 0.9][dimension - 1]
    kept = representative_subset(points, distance=distance, generator=generator(1))
    assert 5 < len(kept) < 5000
    assert pdist(points[kept]).min() >= distance
    left_out = np.delete(points, kept, axis=0)
    assert cKDTree(points[kept]).query(left_out)[0].max() < distance


@pytest.mark.parametrize(("count", "distance"), [(300, 0.2), (300, 1e-9), (2500, 0.3), (4500, 0.15)])
def test_the_result_is_that_of_visiting_the_points_one_by_one(count: int, distance: float) -> None:
    points = generator(count).normal(size=(count, 2))
    kept = representative_subset(points, distance=distance, generator=generator(7))
    order = generator(7).permutation(count)
    np.testing.assert_array_equal(kept, naive_subset(points, distance, order))


def test_points_exactly_the_distance_apart_are_both_kept() -> None:
    grid = np.array(list(itertools.product(range(7), repeat=2)), dtype=float)
    kept = representative_subset(grid, distance=1.0, generator=generator(0))
    np.testing.assert_array_equal(kept, np.arange(49))


def test_of_equal_points_one_is_kept() -> None:
    points = np.repeat(np.array([[0.0, 0.0], [5.0, 5.0]]), 2000, axis=0)
    kept = representative_subset(points, distance=0.1, generator=generator(0))
    assert len(kept) == 2
    assert kept[0] < 2000 <= kept[1]


def test_the_same_generator_gives_the_same_subset_and_another_a_different_one() -> None:
    points = generator(0).uniform(size=(1000, 3))
    one, again, other = (
        representative_subset(points, distance=0.2, generator=generator(seed)) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)


def test_the_subset_crowds_less_than_the_points() -> None:
    draw = generator(0)
    points = np.concatenate([draw.normal(scale=0.02, size=(4000, 2)), draw.uniform(-1, 1, size=(1000, 2))])
    kept = representative_subset(points, distance=0.1, generator=draw)
    near = np.linalg.norm(points[kept], axis=1) < 0.1
    assert near.mean() < 0.05


@pytest.mark.parametrize("distance", [0.0, -1.0, float("nan")])
def test_a_distance_that_is_not_positive_is_refused(distance: float) -> None:
    with pytest.raises(ValueError, match="positive"):
        representative_subset(np.zeros((3, 1)), distance=distance, generator=generator(0))


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
