from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from siq.inference.field_estimate import FieldEstimate
from siq.inference.library import candidate_library
from siq.inference.selection import (
    LinearProblem,
    _improved_support,
    _mean_over_supports,
    _prices,
    all_coefficients,
    critical_values,
    model_average,
    strong_terms,
)

LIBRARY = candidate_library(["x"], degree=5)
CRITICAL = critical_values(LIBRARY, false_terms=0.05)
NONE = np.zeros(6, dtype=bool)  # of the terms is free


def equation(
    coefficients: np.ndarray, *, generator: np.random.Generator, component: int = 0
) -> LinearProblem:
    """Of states in two wells, the errors of all coefficients being of the order of one."""
    states = np.linspace(-1, 1, 400)
    functions = LIBRARY.evaluate(states[:, None])
    columns = np.linalg.qr(functions, mode="r")
    return LinearProblem(
        columns,
        columns @ coefficients + generator.standard_normal(len(columns)),
        1.0,
        CRITICAL,
        all_coefficients([component], 6),
    )


def chosen(one: LinearProblem) -> tuple[int, ...]:
    return _improved_support(one, strong_terms(one))


def test_odds_of_terms_that_are_not_there_add_up_to_what_was_expected() -> None:
    draws = np.random.default_rng(0).standard_normal((200_000, 1))
    price = _prices(CRITICAL, further=0.7)
    odds = np.where(np.abs(draws) < CRITICAL, np.exp((draws**2 - price) / 2), 0.0)
    assert odds.mean(axis=0).sum() == pytest.approx(0.7, rel=0.05)


def test_the_mean_is_that_over_all_supports() -> None:
    one = equation(np.array([0.2, 2.0, 0.0, -2.0, 0.0, 0.0]), generator=np.random.default_rng(3))
    own = chosen(one)
    mean, spread = _mean_over_supports(one, own, further=1.0, free=NONE)
    price = _prices(CRITICAL, further=1.0)
    supports = [s for size in range(7) for s in itertools.combinations(range(6), size)]
    scores = np.array([one.chi_square(s) + price[list(s)].sum() for s in supports])
    odds = np.exp(-(scores - scores.min()) / 2)
    odds[odds < 0.01] = 0
    odds /= odds.sum()
    changes = np.array([one.solve(s) for s in supports]) - one.solve(own)
    expected = odds @ changes
    assert mean == pytest.approx(expected, rel=1e-6, abs=1e-9)
    total = (changes - expected).T @ (odds[:, None] * (changes - expected))
    for s, weight in [*zip(supports, odds, strict=True), (own, -1.0)]:
        inverse = np.linalg.pinv(one.columns[:, list(s)])
        total[np.ix_(s, s)] += weight * inverse @ inverse.T
    # What the chosen support is less sure of than the others is not subtracted: errors never shrink by it.
    assert np.diag(spread.T @ spread) == pytest.approx(np.diag(total), rel=0.2)
    assert (np.diag(spread.T @ spread) >= np.diag(total) * (1 - 1e-9)).all()


def test_without_doubt_there_are_no_rivals_of_any_weight() -> None:
    one = equation(np.array([0.0, 400.0, 0.0, -400.0, 0.0, 0.0]), generator=np.random.default_rng(1))
    mean, spread = _mean_over_supports(one, (1, 3), further=1e-9, free=NONE)
    assert not mean.any()
    assert not len(spread)


@pytest.mark.parametrize("strength", [0.0, 1.5, 2.2, 3.0])
def test_barriers_hold_the_truth_however_strong_a_term_is(strength: float) -> None:
    """A constant of 2.2 errors is left out of f in every third record; alone, f's barriers are off by it."""
    columns = equation(np.zeros(6), generator=np.random.default_rng(0)).columns
    error = np.linalg.norm(np.linalg.pinv(columns[:, [0, 1, 3]])[0])
    truth = np.array([strength * error, 20.0, 0.0, -25.0, 0.0, 0.0])
    top = 0.8 ** np.arange(1, 7) / np.arange(1, 7)  # of ∫f from the middle to a well
    draw = np.random.default_rng(5)
    alone, together = [], []
    for _ in range(200):
        one = equation(truth, generator=draw)
        own = chosen(one)
        mean, spread = _mean_over_supports(one, own, further=1.0, free=NONE)
        inverse = np.linalg.pinv(one.columns[:, list(own)])
        variance = float(((top[list(own)] @ inverse) ** 2).sum())
        off = top @ (one.solve(own) - truth)
        alone.append(abs(off) < 1.96 * np.sqrt(variance))
        together.append(abs(off + top @ mean) < 1.96 * np.sqrt(variance + ((spread @ top) ** 2).sum()))
    assert np.mean(together) > 0.85
    assert np.mean(together) > 0.94 or np.mean(together) > np.mean(alone) + 0.1


def test_wells_of_two_states_hold_the_truth_though_no_constant_is_seen() -> None:
    """Without a constant two wells of ``x - x³`` lie exactly at one distance, as those of few systems do."""
    planar, draw = candidate_library(["x", "y"], degree=5), np.random.default_rng(5)
    states = np.array([[0.9, 0.0]]) * draw.choice([-1, 1], (2000, 1)) + 0.3 * draw.standard_normal((2000, 2))
    columns = 0.9 * np.linalg.qr(planar.evaluate(states), mode="r")
    own = [planar.terms.index(planar.symbols[0] ** power) for power in (1, 3)]
    constant = planar.terms.index(1)
    error = np.linalg.norm(np.linalg.pinv(columns[:, [constant, *own]])[0])
    slopes = planar.evaluate(np.array([[1.0, 0.0]]))[0] / 2  # of the place where f = 0
    truth = np.zeros(planar.size)
    truth[[constant, *own]] = 2.0 * error, 1.0, -1.0  # which a search leaves out mostly
    critical = critical_values(planar, false_terms=0.05)
    labels = all_coefficients([0], planar.size)
    held = []
    for _ in range(120):
        goal = columns @ truth + draw.standard_normal(len(columns))
        one = LinearProblem(columns, goal, 1.0, critical, labels)
        support = sorted(own)
        bias, spread = model_average([one, one], one.labels[support], planar)  # of both states alike
        known = float(((slopes[support] @ np.linalg.pinv(one.columns[:, support])) ** 2).sum())
        known += ((spread[: len(spread) // 2, :, 0] @ slopes) ** 2).sum() + (slopes @ bias[:, 0]) ** 2
        held.append(abs(slopes @ (one.solve(support) - truth)) < 1.96 * np.sqrt(known))
    assert np.mean(held) > 0.9


def drawn(average: tuple[np.ndarray, np.ndarray], count: int) -> np.ndarray:
    found: Any = SimpleNamespace(alternatives=average)
    return FieldEstimate.drawn_alternatives(found, count, generator=np.random.default_rng(0))


def test_one_problem_of_two_equations_is_the_same_as_both() -> None:
    draw = np.random.default_rng(2)
    truth = np.array([0.0, 9.0, 0.0, -9.0, 0.0, 0.0])
    ones = [equation(truth, generator=draw, component=i) for i in range(2)]
    empty = np.zeros((6, 6))
    together = LinearProblem(
        np.block([[ones[0].columns, empty], [empty, ones[1].columns]]),
        np.concatenate([one.goal for one in ones]), 1.0, np.tile(CRITICAL, 2), all_coefficients([0, 1], 6),
    )  # fmt: skip
    support = np.array([(0, 1), (0, 3), (1, 1), (1, 3)])
    planar = candidate_library(["x", "y"], degree=2)  # six functions, too
    apart, joint = (model_average(these, support, planar) for these in (ones, [together]))
    scale = np.linalg.norm(ones[0].columns, axis=0)[:, None]
    # What is cut off as unlikely is not quite the same.
    assert joint[0] * scale == pytest.approx(apart[0] * scale, abs=0.15)
    draws = [drawn(one, 4000) * scale for one in (apart, joint)]
    assert draws[0].std(axis=0) == pytest.approx(draws[1].std(axis=0), rel=0.3)


def test_draws_have_the_mean_and_the_spread() -> None:
    draws = drawn((np.full((6, 1), 2.0), np.eye(6)[:, :, None]), 20_000)
    assert draws.mean(axis=0) == pytest.approx(np.full((6, 1), 2.0), abs=0.05)
    assert draws.std(axis=0) == pytest.approx(np.ones((6, 1)), rel=0.05)
