from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from siq.identify.library import CandidateLibrary, candidate_library
from siq.identify.selection import Equation, best_support, critical_values, improved_support, rival_changes

LIBRARY = candidate_library(["x", "y"], degree=5)
NAMES = list(LIBRARY.names)


def equation(seed: int, terms: dict[str, float], *, library: CandidateLibrary = LIBRARY) -> Equation:
    """States about x = ±1, as in two wells, with one unit of noise on what the terms make."""
    draw = np.random.default_rng(seed)
    count = 4000
    side = draw.choice([-1.0, 1.0], count)
    x = np.stack([side + 0.2 * draw.standard_normal(count), 0.2 * draw.standard_normal(count)], axis=1)
    functions = library.evaluate(x)
    goal = draw.standard_normal(count)
    for name, value in terms.items():
        goal = goal + value * functions[:, list(library.names).index(name)]
    triangle = np.linalg.qr(np.column_stack([functions, goal]), mode="r")
    critical = critical_values(library, false_terms=0.05)
    return Equation.of_triangle(triangle, 0, samples=count, critical=critical)


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
    assert named(improved_support(made, start)) == {"y", "x**2*y"}


def test_many_terms_that_make_up_a_few_are_left_for_these() -> None:
    made = equation(1, {"x": 2.0, "x**2": -2.0, "x*y": -3.0})
    start = [NAMES.index(one) for one in ("x**3", "x**4", "x**5", "x**3*y", "x*y**3", "x**4*y")]
    assert named(best_support(made, start)) == {"x", "x**2", "x*y"}


def test_noise_alone_brings_few_terms() -> None:
    false = [improved_support(equation(seed, {}), ()) for seed in range(60)]
    # One equation of two: 2.5 % of the seeds are expected to have one.
    assert sum(map(bool, false)) <= 4


def test_rivals_are_the_likelier_the_less_the_data_tell_them_apart() -> None:
    own = (NAMES.index("y"), NAMES.index("x**2*y"))
    apart, close = (equation(0, {"y": -2.0, "x**2*y": size}) for size in (-10.0, -0.6))
    # Against x⁴y, that is, which is nearly the same function on these states.
    sizes = [np.linalg.norm(rival_changes(one, own)[:, own[1]]) for one in (apart, close)]
    assert sizes[0] < 0.1 * sizes[1]
    assert rival_changes(apart, own).shape[1] == LIBRARY.size


def test_scores_of_neighbours_are_those_of_fits() -> None:
    made = equation(3, {"y": -1.0})
    support = (NAMES.index("y"), NAMES.index("x"))
    for score, other in made.neighbours(support):
        assert score == pytest.approx(made.score(other), rel=1e-6)
