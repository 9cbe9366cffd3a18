"""Networks about each attractor: each holds in its own well, and nothing is known elsewhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from siq.errors import InputError
from siq.networks.decomposition import (
    NetworksByWell,
    TrainedNetworks,
    load_networks,
    pack,
    save_networks,
    shuffled,
)

D = np.array([[2.0, 0.6], [0.6, 1.0]])
HEIGHTS = np.array([0.0, 0.25])
LEVELS = np.array([1.0, 0.5])


def networks(seed: int, *, units: int) -> TrainedNetworks:
    """Networks with one hidden layer of random weights."""
    draw = np.random.default_rng(seed)

    def layers(outputs: int) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
        return tuple(
            (draw.normal(size=(rows, columns)), draw.normal(size=(1, columns)))
            for rows, columns in ((2, units), (units, outputs))
        )

    ones = np.ones((1, 1))
    return TrainedNetworks(layers(1), layers(2), draw.normal(size=(1, 2)), np.ones((1, 2)), ones, ones, D)


@pytest.fixture
def by_well() -> NetworksByWell:
    """Wells left and right of x = 0, of different sizes; the networks hold nowhere above y = 1."""
    states = np.random.default_rng(0).uniform(-2, 2, size=(4000, 2))
    attractor_of = np.where(states[:, 1] > 1, NetworksByWell.NOWHERE, states[:, 0] > 0)
    return NetworksByWell((networks(1, units=5), networks(2, units=7)), HEIGHTS, LEVELS, states, attractor_of)


def test_each_holds_in_its_own_well_and_none_elsewhere(by_well: NetworksByWell) -> None:
    x = np.array([[-1.0, 0.0], [1.0, 0.0], [-1.0, 1.8], [np.nan, 0.0], [1.0, -1.0]])
    left, right, nowhere = [0], [1, 4], [2, 3]
    assert [list(rows) for rows in by_well.of_wells(x)] == [left, right]
    potential, circulatory, vector_field = by_well.evaluate(x)
    for part, height, rows in zip(by_well.parts, HEIGHTS, (left, right), strict=True):
        values, g, f = part.evaluate(x[rows])
        np.testing.assert_array_equal(potential[rows], values + height)
        np.testing.assert_array_equal(circulatory[rows], g)
        np.testing.assert_array_equal(vector_field[rows], f)
    assert all(np.isnan(one[nowhere]).all() for one in (potential, circulatory, vector_field))
    np.testing.assert_allclose(by_well.potential_at(x), potential, rtol=1e-14)  # NaN at the same points
    np.testing.assert_array_equal(by_well.diffusion, D)


def test_what_lies_low_in_a_well_is_told_apart(by_well: NetworksByWell) -> None:
    for index, part in enumerate(by_well.parts):
        states = by_well.states[by_well.attractor_of == index]
        values = part.potential_at(states)
        level = float(np.quantile(values, 0.7)) / 0.9
        one = replace(by_well, levels=np.full(2, level))
        low = states[values < 0.9 * level]
        assert 0 < len(low) < len(states)
        np.testing.assert_array_equal(one.below(0.9, part.mean[0], by_well.states), low)
        some = one.below(0.9, part.mean[0], by_well.states[:500])
        np.testing.assert_array_equal(some, low[: len(some)])


def test_they_are_kept_beside_those_of_other_runs(by_well: NetworksByWell, tmp_path: Path) -> None:
    single = networks(3, units=9)
    save_networks(tmp_path / "n.npz", [single, by_well, single])
    first, again, last = (load_networks(tmp_path / "n.npz", run=run) for run in range(3))
    assert isinstance(again, NetworksByWell)
    for name in ("heights", "levels", "states", "attractor_of"):
        np.testing.assert_array_equal(getattr(again, name), getattr(by_well, name))
    for one, other in (([first], [single]), ([last], [single]), (again.parts, by_well.parts)):
        assert all(isinstance(each, TrainedNetworks) for each in one)
        for name, array in pack(other).items():
            np.testing.assert_array_equal(pack(one)[name], array)  # type: ignore[arg-type]
    with pytest.raises(InputError):
        load_networks(tmp_path / "n.npz", run=3)


def test_shuffled_they_have_the_same_weights_and_wells_and_another_v(by_well: NetworksByWell) -> None:
    null = shuffled(by_well, generator=np.random.default_rng(5))
    assert isinstance(null, NetworksByWell)
    for one, other in zip(null.parts, by_well.parts, strict=True):
        for mine, theirs in zip(one.potential, other.potential, strict=True):
            for array, before in zip(mine, theirs, strict=True):
                np.testing.assert_array_equal(np.sort(array, axis=None), np.sort(before, axis=None))
    x = by_well.states
    np.testing.assert_array_equal(null.attractor_of, by_well.attractor_of)
    before, after = by_well.potential_at(x), null.potential_at(x)
    np.testing.assert_array_equal(np.isnan(before), np.isnan(after))
    assert np.nanstd(after - before) > 0.1 * np.nanstd(before)
