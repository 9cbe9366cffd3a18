from __future__ import annotations

import numpy as np
import pytest
from scipy.special import chdtri, ndtr

from siq.errors import NumericalFailure
from siq.inference.library import CandidateLibrary, candidate_library
from siq.inference.selection import (
    JOINT_TERMS_SHARE,
    LinearProblem,
    _improved_support,
    _lacks_terms,
    best_support,
    chosen_terms,
    critical_values,
    fit_significant,
    strong_terms,
    triangle_of,
)

pytestmark = pytest.mark.portable

LIBRARY = candidate_library(["x", "y"], degree=5)
NAMES = list(LIBRARY.names)


def equation(seed: int, terms: dict[str, float], *, library: CandidateLibrary = LIBRARY) -> LinearProblem:
    """States about x = ±1, as in two wells, with one unit of noise on what the terms make."""
    draw = np.random.default_rng(seed)
    count = 4000
    side = draw.choice([-1.0, 1.0], count)
    x = np.stack([side + 0.2 * draw.standard_normal(count), 0.2 * draw.standard_normal(count)], axis=1)
    functions = library.evaluate(x)
    goal = draw.standard_normal(count)
    for name, value in terms.items():
        goal = goal + value * functions[:, list(library.names).index(name)]
    return of_rows(np.column_stack([functions, goal]), library)


def of_rows(rows: np.ndarray, library: CandidateLibrary) -> LinearProblem:
    """The equation of functions and, in the last column, what they are to explain."""
    critical = critical_values(library, false_terms=0.05)
    triangle = np.linalg.qr(rows, mode="r")
    return LinearProblem.of_components(triangle, samples=len(rows), critical=critical)[0]


def named(support: tuple[int, ...]) -> set[str]:
    return {NAMES[place] for place in support}


def test_terms_of_low_degree_need_the_least_evidence_and_all_keep_the_probability() -> None:
    critical = critical_values(LIBRARY, false_terms=0.05)
    degrees = np.array([sum(map(int, power)) for power in _exponents()])
    assert all(np.ptp(critical[degrees == one]) == 0 for one in range(6))
    assert (np.diff([critical[degrees == one][0] for one in range(6)]) > 0).all()
    assert 2 * LIBRARY.dimension * ndtr(-critical).sum() == pytest.approx(0.05)


def _exponents() -> list[tuple[int, ...]]:
    return [(total - k, k) for total in range(6) for k in range(total + 1)]


@pytest.mark.parametrize("seed", range(8))
def test_a_term_that_elimination_mistook_is_exchanged(seed: int) -> None:
    made = equation(seed, {"y": -2.0, "x**2*y": -2.0})
    start = [NAMES.index("y"), NAMES.index("x**4*y")]
    assert named(_improved_support(made, start)) == {"y", "x**2*y"}


def test_many_terms_that_make_up_a_few_are_left_for_these() -> None:
    made = equation(1, {"x": 2.0, "x**2": -2.0, "x*y": -3.0})
    assert named(best_support(made)) == {"x", "x**2", "x*y"}


@pytest.mark.parametrize("seed", range(10))
def test_states_far_from_the_origin_hide_no_better_support(seed: int) -> None:
    """Where all monomials are nearly alike, exchanges of single terms end far from the best."""
    draw = np.random.default_rng(seed)
    functions = LIBRARY.evaluate(1.5 + 0.5 * draw.standard_normal((4000, 2)))
    terms = {"x": 1.0, "y": -1.0, "x**2*y": 1.0, "y**3": -0.5}
    true = tuple(sorted(NAMES.index(name) for name in terms))
    goal = functions[:, true] @ [terms[NAMES[place]] for place in true] + draw.standard_normal(4000)
    made = of_rows(np.column_stack([functions, goal]), LIBRARY)
    assert made.score(best_support(made)) <= made.score(true) + 1e-6


ONE_STATE = candidate_library(["x"], degree=5)


def away_from_the_origin(seed: int, *, bend: float) -> LinearProblem:
    draw = np.random.default_rng(seed)
    x = draw.uniform(3.0, 6.3, 4800)
    goal = -(x - 4.6) + bend * (x - 3.8) * (x - 4.6) * (x - 5.5) + 8 * draw.standard_normal(len(x))
    return of_rows(np.column_stack([ONE_STATE.evaluate(x[:, None]), goal]), ONE_STATE)


def test_terms_that_are_needed_together_are_taken_together() -> None:
    """None of the four monomials of a cubic far from the origin does much without the others."""
    made = [away_from_the_origin(seed, bend=1.5) for seed in range(10)]
    assert all(_lacks_terms(one, (0, 1)) for one in made)
    assert all(len(best_support(one)) >= 3 for one in made)
    assert not any(_lacks_terms(one, best_support(one)) for one in made)


def test_a_straight_line_lacks_nothing() -> None:
    lacking = [_lacks_terms(away_from_the_origin(seed, bend=0.0), (0, 1)) for seed in range(100)]
    assert sum(lacking) <= 9  # 5 expected at most


def test_noise_alone_brings_few_terms() -> None:
    false = [_improved_support(equation(seed, {}), ()) for seed in range(60)]
    # One equation of two: 2.5 % of the seeds are expected to have one.
    assert sum(map(bool, false)) <= 4


@pytest.mark.parametrize("more", [0.99, 1.01])
def test_terms_are_lacking_where_chance_would_seldom_gain_as_much(more: float) -> None:
    functions = 8  # as far from zero as each other, and independent
    critical, support = np.full(functions, 3.0), (1, 4)
    chance = JOINT_TERMS_SHARE * 2 * functions * ndtr(-3.0)
    gain = more * chdtri(functions - len(support), chance)
    for unit in (1.0, 1e-3):
        goal = np.full(functions, unit * np.sqrt(gain / (functions - len(support))))
        labels = np.array([(0, place) for place in range(functions)])
        made = LinearProblem(np.eye(functions), goal, unit**2, critical, labels)
        assert _lacks_terms(made, support) == (more > 1)


def test_the_variance_of_each_component_is_that_of_its_residuals() -> None:
    draw = np.random.default_rng(0)
    functions, noise = draw.standard_normal((200, 5)), draw.standard_normal((200, 2)) * [1.0, 3.0]
    made = LinearProblem.of_components(triangle_of(functions, noise), samples=200, critical=np.full(5, 2.0))
    squares = np.linalg.lstsq(functions, noise, rcond=None)[1]
    assert [one.variance for one in made] == pytest.approx(squares / 195)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("more", [0.99, 1.01])
def test_a_term_stays_as_far_from_zero_as_its_standard_errors_say(unit: float, more: float) -> None:
    draw = np.random.default_rng(0)
    columns = draw.standard_normal((6, 3)) @ [[1, 0.9, 0], [0, 1, 0.8], [0, 0, 1]] * [1e-2, 1.0, 1e2]
    errors, critical = np.sqrt(np.diag(np.linalg.inv(columns.T @ columns))), np.array([2.0, 3.0, 4.0])
    labels = np.array([(0, place) for place in range(4)])
    # The second one is as many standard errors from zero as it takes, or not quite; the last has no values.
    coefficients = unit * errors * critical * [5.0, more, -5.0]
    whole = np.column_stack([columns, np.zeros(6)])
    made = LinearProblem(whole, columns @ coefficients, unit**2, np.array([*critical, 2.0]), labels)
    assert strong_terms(made) == ((0, 1, 2) if more > 1 else (0, 2))


def test_scores_of_neighbours_are_those_of_fits() -> None:
    made = equation(3, {"y": -1.0})
    support = (NAMES.index("y"), NAMES.index("x"))
    for score, other in made.neighbours(support):
        assert score == pytest.approx(made.score(other), rel=1e-6)


def test_without_noise_a_term_counts_by_its_share() -> None:
    draw = np.random.default_rng(0)
    functions = LIBRARY.evaluate(draw.uniform(-1, 1, (500, 2)))
    x, weak = functions[:, NAMES.index("x")], functions[:, NAMES.index("y**2")]
    share = 1e-3
    goal = x + share * np.linalg.norm(x) / np.linalg.norm(weak) * weak
    exact = of_rows(np.column_stack([functions, goal]), LIBRARY)
    assert named(strong_terms(exact, precision=share / 10)) == {"x", "y**2"}
    assert named(strong_terms(exact, precision=share * 10)) == {"x"}


def test_an_equation_without_a_term_is_named() -> None:
    rows = np.random.default_rng(0).standard_normal((400, 1 + LIBRARY.size))
    noise, motion = of_rows(rows, LIBRARY), equation(0, {"x": 2.0})
    assert {NAMES[k] for _, k in chosen_terms([motion], LIBRARY)} == {"x"}
    with pytest.raises(NumericalFailure, match="equation of x is significant; record longer"):
        chosen_terms([noise], LIBRARY, lambda problem: ())
    with pytest.raises(NumericalFailure, match="equation of x"):
        chosen_terms([noise], LIBRARY)


def test_weak_terms_leave_one_by_one_but_for_the_last_of_an_equation() -> None:
    strengths = {(0, 1): 0.5, (0, 2): 3.0, (0, 3): 0.9, (1, 4): 0.1}
    seen = []

    def fit(support: np.ndarray) -> tuple[int, np.ndarray]:
        seen.append({tuple(row) for row in support.tolist()})
        return len(support), np.array([strengths[tuple(row)] for row in support.tolist()])

    fitted, support = fit_significant(fit, np.array(list(strengths)))
    assert [len(each) for each in seen] == [4, 3, 2] and (0, 1) not in seen[1]
    assert fitted == 2 and support.tolist() == [[0, 2], [1, 4]]
