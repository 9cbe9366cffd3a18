"""A study from equations: one step, a page, tables of the contract; nothing is simulated."""

import json
import re

import numpy as np
import pandas as pd
import pytest

from siq.workflow.tables import COLUMNS

pytestmark = pytest.mark.workflow

CARD = """\
name: wells
title: Two wells
states:
  x: {unit: "1", domain: [-2, 2]}
  y: {unit: "1", domain: [-2, 2]}
equations: {x: "x - x**3", y: "-y"}
diffusion: identity
"""
STUDY = """\
name: mini
system: wells.yaml
from: equations
landscape: {noise_intensities: [0.05]}
"""


@pytest.mark.slow
def test_equations_alone_give_the_page(fresh_project):
    fresh_project.path("wells.yaml").write_text(CARD)
    fresh_project.path("study.yaml").write_text(STUDY + "invariant: [0.1]\n")
    fresh_project.make("results/mini/report.html")
    results = fresh_project.path("results/mini")
    for name in ("landscape", "degrees", "certificates", "outcomes", "invariant", "well_shares"):
        table = pd.read_parquet(results / "tables" / f"{name}.parquet")
        assert list(table.columns) == list(COLUMNS[name]) and len(table)
    landscape = pd.read_parquet(results / "tables" / "landscape.parquet")
    ways = landscape[landscape["kind"] == "transition"]
    assert ways["barrier"].to_numpy() == pytest.approx([0.5, 0.5], rel=1e-5)
    assert ways["mean_time"].notna().all() and (ways["standard_error"] == 0).all()
    answer = json.loads((results / "answer.json").read_text())
    assert answer["certified"] == "all" and answer["sentence"].startswith("The equations have two stable")
    page = (results / "report.html").read_text()
    density = pd.read_parquet(results / "tables" / "invariant.parquet").iloc[0]
    # U = (x² - 1)²/2 + y²: the quadrature over the domain, and a long simulation of the card.
    x = np.linspace(-2, 2, 4001)
    exact = np.trapezoid(np.exp(-((x**2 - 1) ** 2) / 0.2), x) * np.sqrt(0.1 * np.pi)
    assert density["quadrature"] == pytest.approx(exact, rel=0.01)  # where U is known
    assert density["simulated_distance"] < 3 * density["sampling_floor"]
    assert "shares of the invariant distribution" in page and (results / "figures" / "invariant.svg").exists()
    assert "Nothing was recorded or learned" in page and "recorded states" not in page
    assert not (results / "runs").exists()


@pytest.mark.slow
def test_what_only_trajectories_can_give_is_refused(fresh_project):
    fresh_project.path("wells.yaml").write_text(CARD)
    fresh_project.path("study.yaml").write_text(STUDY + "runs: 3\n")
    done = fresh_project.run("-n", "results/mini/report.html")
    assert done.returncode != 0
    assert "'runs' belongs to studies of trajectories" in done.stdout


def tilted(value: float = 0) -> str:
    """The card with a parameter h that tilts its wells."""
    card = CARD.replace("equations: {x:", f"parameters: {{h: {{value: {value}}}}}\nequations: {{x:")
    return card.replace("x - x**3", "h + x - x**3")


SWEEP = "sweep: {{parameter: h, from: {first}, to: {last}, step: 0.25}}\n"


@pytest.mark.slow
def test_another_range_computes_new_points_only(fresh_project):
    fresh_project.path("wells.yaml").write_text(tilted())
    fresh_project.path("study.yaml").write_text(STUDY + SWEEP.format(first=0, last=0.25))
    fresh_project.make("results/mini/report.html")
    points = fresh_project.path("results/mini/sweep")
    assert sorted(path.name for path in points.iterdir()) == ["h=0.25.json", "h=0.json"]
    before = {path.name: path.stat().st_mtime_ns for path in points.iterdir()}
    fresh_project.path("study.yaml").write_text(STUDY + SWEEP.format(first=0, last=0.5))
    fresh_project.path("wells.yaml").write_text(tilted(0.1))
    fresh_project.make("results/mini/report.html")
    after = {path.name: path.stat().st_mtime_ns for path in points.iterdir()}
    assert before.items() < after.items() and set(after) == {"h=0.25.json", "h=0.json", "h=0.5.json"}
    tables = {
        name: pd.read_parquet(fresh_project.path(f"results/mini/tables/{name}.parquet"))
        for name in ("sweep", "sweep_ways", "branches", "bifurcations", "bifurcation_curves")
    }
    for name, table in tables.items():
        assert list(table.columns) == list(COLUMNS[name])
        assert len(table) or name == "bifurcation_curves"  # which are of two parameters
    assert tables["bifurcations"]["value"].to_numpy() == pytest.approx([2 / 27**0.5], abs=1e-9)
    page = fresh_project.path("results/mini/report.html").read_text()
    assert "Against h" in page and "fold at h = 0.3849" in page
    assert fresh_project.path("results/mini/figures/sweep.svg").exists()


@pytest.mark.slow
def test_a_parameter_that_the_card_has_not_is_refused(fresh_project):
    fresh_project.path("wells.yaml").write_text(CARD)
    fresh_project.path("study.yaml").write_text(STUDY + SWEEP.format(first=0, last=1))
    done = fresh_project.run("-n", "results/mini/report.html")
    assert done.returncode != 0 and "has no parameter 'h'" in done.stdout


def test_a_sweep_is_planned_as_a_job_for_each_value(fresh_project):
    fresh_project.path("wells.yaml").write_text(tilted())
    fresh_project.path("study.yaml").write_text(
        STUDY + SWEEP.format(first=0, last=0.5) + "invariant: [0.1]\n"
    )
    planned = fresh_project.make("-n", "results/mini/report.html").partition("Job stats:")[2]
    for rule, count in (
        ("sweep_point", 3),
        ("sweep", 1),
        ("equations", 1),
        ("equations_invariant", 1),
        ("equations_page", 1),
    ):
        assert re.search(rf"^{rule} +{count}$", planned, flags=re.MULTILINE), planned
