"""The landscape of a card, with everything that it is held against."""

import pandas as pd
import pytest

from siq.workflow.tables import COLUMNS

pytestmark = [pytest.mark.workflow, pytest.mark.slow]

STUDY = """\
name: mini
system: resonator
runs: 1
seed: 7
published: resonator
invariant: [2.0e-9]
beside_equations: true
simulation: {trajectories: 400, pairs: 60, pair_step: 10, interval: 100}
training:
  widths: [12, 12]
  steps: 60
  batch_size: 64
  check: null
  decay_steps: 1000
  orthogonality_weight: 10
  representative_share: 0
  relative_dynamics: false
  normalise_on: pairs
  potential_gain: 1
  matching: symmetric
  slow_speed: 0.1
  thinning_distance: 1.0e-3
regression: {degree: 4, threshold: 0.001, threshold_on: contribution, level: 6.0e-9}
refinement: {routes: [local], degrees: [8, 10]}
landscape: {noise_intensities: [2.5e-9]}
"""


@pytest.fixture(scope="module")
def tables(fresh_module_project):
    project = fresh_module_project
    project.path("study.yaml").write_text(STUDY)
    project.make("results/mini/report.html")
    names = (
        "landscape",
        "degrees",
        "landscape_errors",
        "beside_equations",
        "escape",
        "invariant",
        "well_shares",
    )
    return {name: pd.read_parquet(project.path(f"results/mini/tables/{name}.parquet")) for name in names}


def test_the_tables_are_those_of_the_contract(tables):
    for name, table in tables.items():
        assert list(table.columns) == list(COLUMNS[name]) and len(table)


def test_equilibria_are_found_and_barriers_are_those_of_the_minimum_action(tables):
    landscape = tables["landscape"]
    assert sorted(landscape["kind"]) == ["attractor", "attractor", "saddle", "transition", "transition"]
    barriers = landscape[landscape["kind"] == "transition"]["barrier"].to_numpy()
    assert barriers == pytest.approx([1.046857e-8, 8.16145e-9], rel=0.01)


def test_the_equations_stand_beside_the_trajectories(tables):
    beside = tables["beside_equations"]
    assert list(beside["quantity"].value_counts().sort_index()) == [2, 2, 2]  # barrier, mean time, prefactor
    barriers = beside[beside["quantity"] == "barrier"]
    assert barriers["equations"].to_numpy() == pytest.approx([1.046857e-8, 8.16145e-9], rel=1e-5)
    assert (beside["relative_difference"].abs() < 0.05).all()


def test_formulas_are_close_to_characteristics_and_the_mesh_too(tables):
    errors = tables["landscape_errors"]
    own = errors[errors["source"] == "local formulas"].set_index("region")
    wells = own[own.index.str.startswith("A")]
    assert (wells["error"] < 0.01).all() and (wells["covered"] > 0.97).all()
    whole = own[own.index.str.startswith("U <")]
    assert (whole["error"] < 0.02).all() and (whole["covered"] > 0.9).all()
    assert (errors[errors["source"] == "mesh"]["error"] < 0.005).all()


def test_the_escape_law_is_that_of_the_simulation(tables):
    escape = tables["escape"]
    assert len(escape) == 2
    ratio = escape["simulated"] / escape["predicted"]
    # The law is the leading order; the barriers are 3.3 and 4.2 ε.
    assert ((ratio > 0.85) & (ratio < 1.35)).all()


def test_the_published_formula_is_scored_beside_ours(tables):
    errors = tables["landscape_errors"]
    found = errors[errors["source"] == "published formula"]["error"].to_numpy()
    assert found[:2] == pytest.approx([0.144, 0.234], abs=2e-3)
    assert 0.17 < found[2] < 0.2
    others = errors[errors["source"] == "published formula, digits not printed"]
    assert len(others) == 3 * 100 and others["error"].between(0.1, 0.35).all()


def test_the_invariant_distribution_over_both_wells_is_that_of_the_simulation(tables):
    ours, published = tables["invariant"].itertuples()
    assert (ours.method, published.method) == ("local formulas", "published formula")
    assert ours.quadrature == pytest.approx(3.25e-5, rel=0.02)
    assert 0 < ours.simulated_unknown < ours.unknown_at_most < 0.3
    assert ours.simulated_distance < 0.09 < published.simulated_distance
    shares = tables["well_shares"]
    assert shares["share"].sum() == pytest.approx(1) and shares["by_rates"].sum() == pytest.approx(1)
    # Walkers cross at this ε, and go where the escape times say: there the prefactor counts.
    assert (shares["changed"] > 0.05).all()
    away = (shares["simulated"] - shares["by_rates"]).abs()
    assert (away < (shares["share"] - shares["by_rates"]).abs()).all()
