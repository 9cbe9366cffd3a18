from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import sympy
from known_systems import exact_archetype

from siq.inference.library import candidate_library
from siq.networks.decomposition import TrainedNetworks, potential_on_grid
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.systems.dynamics import Dynamics
from siq.workflow.tables import as_table
from workflow.published import PublishedFigure
from workflow.rows import concatenate
from workflow.scoring import (
    GRID_POINTS,
    _coefficient_table,
    _domain_grid,
    _exact_values,
    _relative_root_mean_square_error,
    _support_is_correct,
    exact_answer,
    relative_error,
    summary_table,
)


def perturbed(archetype: Dynamics, addition: object) -> SymbolicDecomposition:
    exact = exact_archetype()
    potential = sympy.expand(exact.potential + sympy.sympify(addition))
    return dataclasses.replace(exact, potential=potential)


def score(archetype: Dynamics, identified: SymbolicDecomposition, run: int = 0) -> pd.DataFrame:
    terms = candidate_library(archetype.states, degree=5).names
    return _coefficient_table(run, "regression", identified, exact_archetype(), terms=terms)


def test_the_error_is_that_of_the_paper_worked_out_by_hand(archetype: Dynamics) -> None:
    x, _, z = archetype.symbols
    # U: 1, x², y², z², x⁴ are 1, -2, 1, 1, 1 exactly, and off by 0.02, -0.04, 0, 0.02, 0 here.
    identified = perturbed(archetype, 0.01 - 0.02 * x**2 + 0.01 * z**2)
    table = score(archetype, identified)
    expected = np.sqrt(0.02**2 + 0.04**2 + 0.02**2) / np.sqrt(1 + 4 + 1 + 1 + 1)
    assert _relative_root_mean_square_error(table) == pytest.approx(expected, rel=1e-12)
    assert _support_is_correct(table) is True


def test_exact_formulas_have_no_error_and_all_terms_are_listed(archetype: Dynamics) -> None:
    table = score(archetype, exact_archetype())
    assert _relative_root_mean_square_error(table) == 0
    assert _support_is_correct(table) is True
    assert len(table) == 8 * 56
    assert list(table.columns) == [
        "run",
        "method",
        "component",
        "term",
        "estimate",
        "exact",
        "standard_error",
    ]
    row = table[(table["component"] == "g_y") & (table["term"] == "x**3")].iloc[0]
    assert (row["estimate"], row["exact"]) == (2.0, 2.0)
    row = table[(table["component"] == "U") & (table["term"] == "x**2")].iloc[0]
    assert (row["estimate"], row["exact"]) == (-2.0, -2.0)


def test_a_false_term_shows_in_the_support_but_not_in_the_error(archetype: Dynamics) -> None:
    x, y, _ = archetype.symbols
    table = score(archetype, perturbed(archetype, 0.3 * x * y))
    assert _relative_root_mean_square_error(table) == 0
    assert _support_is_correct(table) is False


def test_a_missing_term_shows_in_both(archetype: Dynamics) -> None:
    _, y, _ = archetype.symbols
    table = score(archetype, perturbed(archetype, -(y**2) / 2))
    assert _relative_root_mean_square_error(table) == pytest.approx(1 / np.sqrt(8))
    assert _support_is_correct(table) is False


def test_the_constant_does_not_count_for_the_support(archetype: Dynamics) -> None:
    table = score(archetype, perturbed(archetype, sympy.Rational(-1, 2)))
    assert _support_is_correct(table) is True


def test_a_term_outside_the_library_is_listed_too(archetype: Dynamics) -> None:
    x, _, _ = archetype.symbols
    table = score(archetype, perturbed(archetype, sympy.sin(x)))
    row = table[(table["component"] == "U") & (table["term"] == "sin(x)")].iloc[0]
    assert (row["estimate"], row["exact"]) == (2.0, 0.0)
    assert _support_is_correct(table) is False


def test_a_card_that_does_not_know_u_has_no_exact_answer() -> None:
    systems = Path(__file__).parents[2] / "config" / "systems"
    assert exact_answer(systems / "resonator.yaml") is None
    found = exact_answer(systems / "archetype3d.yaml")
    assert found is not None
    x, y, z = np.random.default_rng(0).uniform(-2, 2, size=(3, 20))
    np.testing.assert_allclose(
        _exact_values(found, np.stack([x, y, z])), x**4 - 2 * x**2 + y**2 + z**2 + 1, rtol=1e-12
    )


def test_without_an_exact_answer_nothing_is_claimed() -> None:
    table = _coefficient_table(0, "regression", exact_archetype(), None, terms=("1", "x"))
    assert table["exact"].isna().all()
    assert np.isnan(_relative_root_mean_square_error(table))
    assert _support_is_correct(table) is None


def test_the_error_on_a_grid_does_not_depend_on_the_constant_of_u() -> None:
    exact = np.array([0.0, 3.0, 4.0])
    assert relative_error(exact + 7, exact - 2) == 0
    assert relative_error(np.array([1.0, 4.0, 6.0]), exact) == pytest.approx(1 / 5)


def test_the_grid_covers_the_domain_evenly() -> None:
    _, grid = _domain_grid(np.array([[-1.0, 1.0], [0.0, 3.0], [5.0, 6.0]]), points=1000)
    assert grid.shape == (3, 1000)
    np.testing.assert_array_equal(grid.min(axis=1), [-1, 0, 5])
    np.testing.assert_array_equal(grid.max(axis=1), [1, 3, 6])
    assert [len(np.unique(axis)) for axis in grid] == [10, 10, 10]
    assert _domain_grid(np.array([[0.0, 1.0]]), points=GRID_POINTS)[1].shape == (1, 1_000_000)


def test_v_on_a_grid_is_that_of_networks_at_its_points() -> None:
    draw = np.random.default_rng(0)
    hidden, outer = (draw.normal(size=(2, 30)), draw.normal(size=(1, 30))), draw.normal(size=(30, 1))
    one = TrainedNetworks(
        potential=(hidden, (outer, np.array([[0.3]]))),
        circulatory=(hidden, (outer @ np.ones((1, 2)), np.ones((1, 2)))),
        mean=np.array([[0.5, -1.0]]), scale=np.array([[0.7, 2.0]]), potential_scale=np.array([[1.5]]),
        circulatory_scale=np.ones((1, 1)), diffusion=np.eye(2),
    )  # fmt: skip
    axes, grid = _domain_grid(np.array([[-3.0, 2.0], [0.0, 300.0]]), points=900)
    np.testing.assert_allclose(
        potential_on_grid(one, axes, grid), one.potential_at(grid.T), rtol=1e-12, atol=1e-11
    )


# Summaries


def summary(archetype: Dynamics, errors: list[float | None], additions: list[object]) -> pd.DataFrame:
    tables = [score(archetype, perturbed(archetype, extra), run) for run, extra in enumerate(additions)]
    rrmse = as_table(
        "rrmse",
        [
            {
                "run": run,
                "method": "regression",
                "rrmse": np.nan if error is None else error,
                "support_correct": None if error is None else error < 0.2,
                "certified": False,
                "network_error": 0.1 if run else np.nan,
            }
            for run, error in enumerate(errors)
        ],
    )
    published = {"rrmse": PublishedFigure(mean=8.87e-4, standard_deviation=3.48e-4, source="paper")}
    return summary_table(
        concatenate("coefficients", tables), rrmse, as_table("prediction", []), published
    ).set_index("quantity")


def test_failed_runs_are_not_averaged_but_shown_by_the_count(archetype: Dynamics) -> None:
    found = summary(archetype, [0.1, 0.3, None], [0, 0])
    row = found.loc["rrmse"]
    assert (row["mean"], row["median"], row["runs"]) == (pytest.approx(0.2), pytest.approx(0.2), 2)
    assert row["standard_deviation"] == pytest.approx(np.std([0.1, 0.3], ddof=1))
    assert (row["published"], row["published_standard_deviation"], row["source"]) == (
        8.87e-4,
        3.48e-4,
        "paper",
    )
    assert found.loc["support_correct", "mean"] == 0.5
    assert found.loc["network_error", "runs"] == 2


def test_inclusion_is_the_share_of_runs_that_have_the_term(archetype: Dynamics) -> None:
    x, y, _ = archetype.symbols
    found = summary(archetype, [0.1] * 4, [0, 0.1 * x * y, 0, -(y**2) / 2])
    assert found.loc["U:x*y", "inclusion_frequency"] == 0.25
    assert found.loc["U:x*y", "mean"] == pytest.approx(0.05)
    assert found.loc["U:x*y", "exact"] == 0
    assert found.loc["U:y**2", "inclusion_frequency"] == 0.75
    assert found.loc["U:x**4", "inclusion_frequency"] == 1
    assert "U:x**5" not in found.index


def test_a_missing_estimate_is_not_an_included_term() -> None:
    coefficients = as_table(
        "coefficients",
        [
            {
                "run": run,
                "method": "regression",
                "component": "U",
                "term": "x",
                "estimate": value,
                "exact": 1.0,
            }
            for run, value in enumerate([1.0, 0.0, np.nan])
        ],
    )
    rrmse = as_table("rrmse", [{"run": 0, "method": "regression", "certified": False}])
    row = summary_table(coefficients, rrmse, as_table("prediction", []), {}).set_index("quantity").loc["U:x"]
    assert row["runs"] == 2
    assert row["inclusion_frequency"] == 0.5


def test_a_term_that_one_run_lists_is_included_in_one_run_only(archetype: Dynamics) -> None:
    x, _, _ = archetype.symbols
    found = summary(archetype, [0.1] * 4, [0, sympy.sin(x), 0, 0])
    assert found.loc["U:sin(x)", "inclusion_frequency"] == 0.25


def test_a_study_of_which_every_run_failed_has_a_summary() -> None:
    rrmse = as_table("rrmse", [{"run": run, "method": "regression", "certified": False} for run in range(2)])
    found = summary_table(as_table("coefficients", []), rrmse, as_table("prediction", []), {}).set_index(
        "quantity"
    )
    assert found.loc[["rrmse", "network_error", "support_correct"], "runs"].tolist() == [0, 0, 0]
    found = found.loc[["rrmse", "network_error", "support_correct"]]
    assert found["mean"].isna().all()
