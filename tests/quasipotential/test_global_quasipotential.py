from __future__ import annotations

import itertools

import numpy as np
import pytest
from known_systems import potential_values, uniform_points
from known_wells import matched, stationary

from siq.errors import NumericalFailure
from siq.quasipotential.global_formula import MOST_WELLS, GlobalQuasipotential, heights_of_attractors

NONE = np.inf


def test_one_attractor_lies_at_zero() -> None:
    np.testing.assert_array_equal(heights_of_attractors(np.array([[NONE]])), [0.0])


@pytest.mark.parametrize(
    ("there", "back", "heights"), [(1.0, 3.0, [2.0, 0.0]), (3.0, 1.0, [0.0, 2.0]), (2.0, 2.0, [0.0, 0.0])]
)
def test_of_two_attractors_the_one_with_the_lower_barrier_lies_higher(
    there: float, back: float, heights: list[float]
) -> None:
    barriers = np.array([[NONE, there], [back, NONE]])
    np.testing.assert_allclose(heights_of_attractors(barriers), heights)


def test_three_wells_in_a_row_add_up_as_those_of_a_potential() -> None:
    # Wells at 0, 1 and -1 with passes at 3 and 2 between them: barriers are differences.
    barriers = np.array([[NONE, 3, NONE], [2, NONE, 1], [NONE, 3, NONE]])
    np.testing.assert_allclose(heights_of_attractors(barriers), [1, 2, 0])


def test_a_ring_in_one_direction_has_a_single_tree_for_each_root() -> None:
    # 0 → 1 → 2 → 0 at 1, 2 and 4; the tree into a root leaves out the way from it: 6, 5, 3.
    barriers = np.array([[NONE, 1, NONE], [NONE, NONE, 2], [4, NONE, NONE]])
    np.testing.assert_allclose(heights_of_attractors(barriers), [3, 2, 0])


def test_a_ring_with_unequal_rates_has_the_least_of_three_trees() -> None:
    # Forward 0 → 1 → 2 → 0 at 1, 1, 2; backward 0 → 2 → 1 → 0 at 5, 4, 3. Into each root lead
    #   0: 1→0 2→0: 3 + 2,   1→2 2→0: 1 + 2,   2→1 1→0: 4 + 3;
    #   1: 0→1 2→1: 1 + 4,   0→2 2→1: 5 + 4,   2→0 0→1: 2 + 1;
    #   2: 0→2 1→2: 5 + 1,   0→1 1→2: 1 + 1,   1→0 0→2: 3 + 5.
    barriers = np.array([[NONE, 1, 5], [3, NONE, 1], [2, 4, NONE]])
    np.testing.assert_allclose(heights_of_attractors(barriers), [1, 1, 0])


@pytest.mark.parametrize("count", [2, 3, 4, 5, MOST_WELLS])
def test_heights_are_those_of_the_stationary_distribution_of_the_jumps(count: int) -> None:
    draw = np.random.default_rng(count)
    barriers = draw.uniform(0.5, 2.0, size=(count, count))
    barriers[draw.uniform(size=(count, count)) < 0.3] = NONE
    for i in range(count):  # whatever else is missing, a ring connects them
        barriers[i, (i + 1) % count] = draw.uniform(0.5, 2.0)
    np.fill_diagonal(barriers, NONE)
    intensity = 0.005
    heights = -intensity * np.log(stationary(np.exp(-barriers / intensity)))
    # Several trees of nearly the same total shift the logarithm by less than that of their number.
    np.testing.assert_allclose(heights_of_attractors(barriers), heights - heights.min(), atol=4 * intensity)


def test_a_diagonal_of_any_value_means_nothing() -> None:
    barriers = np.array([[0.0, 1.0, 5.0], [3.0, 0.0, 1.0], [2.0, 4.0, -7.0]])
    np.testing.assert_allclose(heights_of_attractors(barriers), [1, 1, 0])


def test_the_order_of_the_attractors_means_nothing() -> None:
    barriers = np.random.default_rng(0).uniform(0.5, 2.0, size=(4, 4))
    heights = heights_of_attractors(barriers)
    for order in itertools.permutations(range(4)):
        rows = np.array(order)
        np.testing.assert_allclose(heights_of_attractors(barriers[np.ix_(rows, rows)]), heights[rows])


@pytest.mark.parametrize(
    "barriers",
    [
        [[NONE, NONE], [NONE, NONE]],
        [[NONE, 1, NONE], [1, NONE, NONE], [NONE, NONE, NONE]],
        # Nothing leads back from the last one: a root of trees it is, but no other has one.
        [[NONE, 1, 1], [1, NONE, 1], [NONE, NONE, NONE]],
        [[NONE, np.nan], [1, NONE]],
    ],
    ids=["two", "one of three", "no way back", "not known"],
)
def test_attractors_that_are_not_connected_have_no_heights(barriers: list[list[float]]) -> None:
    with pytest.raises(NumericalFailure, match="no transitions over known saddles"):
        heights_of_attractors(np.array(barriers, dtype=float))


def test_too_many_attractors_are_refused() -> None:
    with pytest.raises(NumericalFailure, match=f"for {MOST_WELLS} at most"):
        heights_of_attractors(np.ones((MOST_WELLS + 1, MOST_WELLS + 1)))


def test_heights_are_u_at_the_attractors() -> None:
    known, whole = matched("double well")
    exact = 2 * potential_values(known, np.stack([one.attractor for one in whole.wells]))
    np.testing.assert_allclose(whole.heights, exact - exact.min(), atol=1e-9)
    assert whole.heights.max() > 0.3
    np.testing.assert_allclose(matched("Maier-Stein")[1].heights, [0, 0], atol=1e-9)


@pytest.mark.parametrize("which", ["double well", "Maier-Stein"])
def test_u_over_both_wells_is_exact_wherever_it_is_known(which: str) -> None:
    known, whole = matched(which)
    x = uniform_points(known, 4000, seed=2, share=0.7)
    values, exact = whole(x), 2 * potential_values(known, x)
    seen = np.isfinite(values)
    top = 2 * max(height / 2 + one.reach for height, one in zip(whole.heights, whole.wells, strict=True))
    assert seen[exact < 0.8 * top / 1.2].mean() > 0.97
    np.testing.assert_allclose(values[seen], exact[seen], atol=1e-9)


def test_both_formulas_have_the_same_value_at_the_saddle() -> None:
    _, whole = matched("double well")
    saddle = whole.wells[0].saddle
    assert saddle is not None
    formulas = [
        height + 2 * one.values(saddle[None])[0]
        for height, one in zip(whole.heights, whole.wells, strict=True)
    ]
    assert formulas[0] == pytest.approx(formulas[1], rel=1e-9)
    # Along the way from one bottom to the other U has no jump, wherever the formulas take turns.
    ends = [one.attractor for one in whole.wells]
    way = np.concatenate([np.linspace(ends[0], saddle, 400), np.linspace(saddle, ends[1], 400)])
    values = whole(way)
    assert np.isfinite(values).mean() > 0.9
    jumps = np.abs(np.diff(values))
    assert np.nanmax(jumps) < 0.01 * formulas[0]


def test_where_no_formula_is_believed_u_is_not_known() -> None:
    _, whole = matched("double well")
    bottoms = np.stack([one.attractor for one in whole.wells])
    far = np.array([[50.0, 50.0], [1.9, -1.9], [-1.9, 1.9]])
    assert np.isnan(whole(far)).all()
    by_well = whole.by_well(np.concatenate([bottoms, far]))
    assert by_well.shape == (2, 5)
    np.testing.assert_array_equal(
        np.isfinite(by_well), [[True, False, False, False, False], [False, True, False, False, False]]
    )
    np.testing.assert_array_equal(np.diag(by_well), whole.heights)
    np.testing.assert_array_equal(whole(bottoms), whole.heights)


def test_of_two_formulas_the_lower_one_counts() -> None:
    _, whole = matched("double well")
    x = whole.wells[0].attractor[None]
    lifted = GlobalQuasipotential((whole.wells[0], whole.wells[0]), np.array([0.7, 0.2]))
    assert lifted(x) == pytest.approx(0.2)
