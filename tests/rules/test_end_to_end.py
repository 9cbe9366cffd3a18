"""The workflow from the card to the report, as a user runs it."""

import json
import re

import pandas as pd
import pytest

from benchmarks.publication import ReproductionSettings
from benchmarks.publication.page import Paper, Results, render_reproduction, reproduction_page
from benchmarks.publication.publication import Parameters, Place
from siq.quasipotential.formulas import read_model
from siq.systems.cards import load_system
from siq.workflow.study import completed, load_study, settings_of
from siq.workflow.tables import COLUMNS
from workflow.published import load_published

pytestmark = pytest.mark.workflow


def table(project, name):
    return pd.read_parquet(project.path(f"results/mini/tables/{name}.parquet"))


# See test_landscape.py and test_equations.py.
NOT_OF_THIS = (
    "landscape_errors", "escape", "sweep", "sweep_ways", "branches", "bifurcations", "bifurcation_curves",
    "beside_equations",
)  # fmt: skip


@pytest.mark.parametrize("name", [name for name in COLUMNS if name not in NOT_OF_THIS])
def test_every_table_of_the_contract_is_there_twice(finished, name):
    parquet = table(finished, name)
    assert list(parquet.columns) == list(COLUMNS[name])
    csv = pd.read_csv(finished.path(f"results/mini/tables/{name}.csv"))
    assert len(csv) == len(parquet)


def test_every_step_of_every_run_has_an_outcome(finished):
    outcomes = table(finished, "outcomes")
    assert list(zip(outcomes["run"], outcomes["step"], strict=True)) == [
        (run, step)
        for run in (0, 1)
        for step in ("simulate", "identify", "train", "regress", "refine", "score")
    ]
    assert set(outcomes["status"]) <= {"ok", "warning"}
    timings = table(finished, "timings")
    assert set(timings["run"]) == {0, 1} and (timings["seconds"] > 0).all()


def test_coefficients_cover_every_term_of_every_component_of_every_run(finished):
    coefficients = table(finished, "coefficients").query("method == 'regression'")
    assert set(coefficients["component"]) == {"U", "V", "f_x", "f_y", "f_z", "g_x", "g_y", "g_z"}
    sizes = coefficients.groupby(["run", "component"])["term"].nunique()
    assert set(sizes) == {35}  # monomials up to degree 4 in three states


def test_the_runs_are_independent(finished):
    estimates = (
        table(finished, "coefficients")
        .query("method == 'regression'")
        .pivot_table(index=["component", "term"], columns="run", values="estimate")
    )
    assert (estimates[0] != estimates[1]).any()


def test_the_published_method_is_not_certified_and_the_control_never_agrees(finished):
    rrmse = table(finished, "rrmse")
    assert not rrmse[rrmse["method"] == "regression"]["certified"].any()
    control = table(finished, "certificates").query("method == 'randomised network'")
    assert list(zip(control["run"], control["test"], strict=True)) == [(0, "agreement"), (1, "agreement")]
    assert not control["passed"].any()
    error = rrmse.pivot(index="run", columns="method", values="network_error")
    assert (error["refined"] < 0.2).all() and (error["randomised network"] > 1).all()
    model = json.loads(finished.path("results/mini/runs/000/model.json").read_text())
    assert model["certificate"]["regression"]["certified"] is False


def test_the_model_alone_gives_back_the_identity_of_the_decomposition(finished):
    decomposition = read_model(finished.path("results/mini/runs/000/model.json"))[0]["regression"]
    for f, g, gradient in zip(
        decomposition.vector_field, decomposition.circulatory, decomposition.gradient, strict=True
    ):
        difference = (f - (g - gradient)).expand()
        largest = max((abs(float(c)) for c in difference.as_coefficients_dict().values()), default=0)
        assert largest < 1e-10


def test_a_refined_formula_is_right_and_certified_if_and_only_if_networks_agree(finished):
    rrmse = table(finished, "rrmse").query("method == 'refined'").set_index("run")
    assert (rrmse["rrmse"] < 1e-6).all()
    tests = table(finished, "certificates").query("method == 'refined' and test == 'agreement'")
    assert rrmse["certified"].to_dict() == tests.set_index("run")["passed"].to_dict()
    assert rrmse["certified"].any()
    prediction = table(finished, "prediction").query("method == 'refined'")
    assert len(prediction) == 2000 and prediction["error"].median() < 1e-6
    refined = table(finished, "coefficients").query("method == 'refined' and component == 'U'")
    assert (refined[refined["estimate"] != 0]["standard_error"] > 0).all()


def test_the_report_needs_nothing_from_outside(finished):
    page = finished.path("results/mini/report.html").read_text(encoding="utf-8")
    assert not re.search(r"(src|href)\s*=\s*[\"']?(https?:)?//", page)
    assert "not certified" in page and "<math" in page and "data:image" in page


def test_nothing_is_run_twice(finished):
    assert "Nothing to be done" in finished.make("results/mini/report.html")


def test_snakemakes_own_report_is_written_with_captions(finished):
    done = finished.run("results/mini/report.html", "--report", "workflow-report.html")
    assert done.returncode == 0, done.stdout[-2000:]
    said = finished.path("workflow-report.html").read_text(encoding="utf-8")
    parts = [said.index(f'"{part}"') for part in ("1 The answer", "2 Evidence", "4 The runs")]
    assert parts == sorted(parts)  # in the order of the page
    assert "How often each term was found" in said


def test_every_figure_of_the_page_is_a_file_and_none_is_a_sentence(finished):
    figures = finished.path("results/mini/figures")
    names = {path.stem for path in figures.glob("*.png")}
    assert names == {path.stem for path in figures.glob("*.svg")}
    assert {"quasipotential", "coefficients_refined", "prediction"} <= names
    # Nobody asked for the density, and nothing was published of this landscape.
    assert not names & {"invariant", "escape", "landscape_published"}


def test_the_page_and_the_terminal_have_the_same_answer(finished):
    answer = json.loads(finished.path("results/mini/answer.json").read_text(encoding="utf-8"))
    page = finished.path("results/mini/report.html").read_text(encoding="utf-8")
    assert answer["runs"] == 2 and answer["formulas"] == 2 and answer["failed"] == 0
    # The study finds no landscape of every run; that of the run that is shown tells the answer.
    assert answer["sentence"].startswith("The recordings show two stable states, A at")
    assert answer["sentence"].split(",")[0] in page
    overview = json.loads(finished.path("results/mini/overview.json").read_text(encoding="utf-8"))
    assert len(overview["wells"]) == 2


def test_the_page_beside_the_paper_takes_what_a_study_left(finished):
    study = load_study(finished.path("study.yaml"))
    system = load_system(finished.path("config/systems/archetype3d.yaml"))
    whole = completed(study, system)
    told, box = settings_of(whole, system), tuple(map(tuple, system.domain.tolist()))
    own = ReproductionSettings(whole.runs, told.simulation, told.training, told.regression, box)
    figures = load_published(finished.path("config/published/archetype3d.yaml")).figures
    results = Results("mini", finished.path("results/mini"), own, figures, system)
    places = (
        Place(place="Table 1", says="the coefficients", study="mini", quantities=("U:*",)),
        Place(place="Fig. 2", says="the data", study="mini", figures=("dataset",), tables=("timings",)),
    )
    paper = Paper(places, Parameters(studies={}, rows=()), {})
    content, numbers = reproduction_page(paper, {"mini": results}, {"mini": own}, command="make it")
    assert {"U:x**2", "U:y**2"} <= set(numbers["quantity"])
    assert set(numbers["place"]) == {"Table 1"} and numbers["published"].notna().all()
    assert [section.figures != [] for section in content.sections] == [False, True]
    assert "Table 1" in render_reproduction(content)
