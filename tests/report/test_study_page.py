"""The page of every kind of study: what stands where, and that only what exists is shown."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import sympy
from known_systems import double_well, exact_field
from told_landscapes import NOISE, landscape, record_row, told, unseen_row

from siq.inference.field_estimate import FieldEstimate
from siq.quasipotential.formulas import SymbolicDecomposition, exact_decomposition, write_model
from siq.report.formatting import texts
from siq.report.page import ReportContent, ReportSection, render_report
from siq.report.study_page import LEADING, StudyResults, study_page
from siq.report.summary import summarise
from siq.systems.dynamics import Dynamics
from siq.workflow.study import Study
from siq.workflow.tables import COLUMNS, Method, ModelFiles, as_table
from workflow.scoring import _coefficient_table, summary_table

FIGURES = texts("captions")["figures"]
CAPTIONS = {name: caption["text"] for name, caption in FIGURES.items()}
OF_ONE_STATE = texts("captions")["lead"]["one_state"]
PNG = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + (1400).to_bytes(4, "big") + (940).to_bytes(4, "big")
X = sympy.Symbol("x", real=True)
SYSTEM = Dynamics.of((X,), (2.0 * X - 8.0 * X**3,))
EXACT = exact_decomposition(SYSTEM, 4.0 * X**4 - 2.0 * X**2 + 0.25)


def certificate(*, passed: bool) -> dict[str, Any]:
    test = {
        "value": 1e-6 if passed else 0.3,
        "limit": 0.05,
        "passed": passed,
        "reason": "" if passed else "too far",
    }
    return {
        "certified": passed, "scope": "region", "stated_error": 4.2e-6 if passed else None,
        "reason": "" if passed else "too far", "tested_on": "points", "independent": ["characteristics"],
        "tests": {"characteristics": test},
    }  # fmt: skip


def page_of(
    folder: Path,
    *,
    certified: bool = True,
    runs: int = 1,
    regressed: bool = False,
    exact: SymbolicDecomposition | None = None,
    overview: dict[str, Any] | None = None,
    images: tuple[str, ...] = (),
    reason: str = "",
    record: list[dict[str, object]] | None = None,
    inspection: list[str] | None = None,
    control: tuple[bool, ...] = (),
    identified: FieldEstimate | None = None,
    **study: Any,
) -> ReportContent:
    """The page of a study with these results; where there is a reason for it, without formulas."""
    found: dict[str, SymbolicDecomposition] = {} if reason else {str(Method.REFINED): EXACT}
    if regressed:
        found[str(Method.REGRESSION)] = EXACT
        study["training"] = {}
    certificates = {name: certificate(passed=certified and name == Method.REFINED) for name in found}
    paths, coefficients, rrmse, tests, outcomes = [], [], [], [], []
    for run in range(runs):
        path = folder / f"{run}.json"
        write_model(path, found, certificates)
        paths.append(str(path))
        for name, one in found.items():
            coefficients.append(
                _coefficient_table(run, name, one, exact, terms=("1", "x", "x**2", "x**3", "x**4"))
            )
            rrmse.append({"run": run, "method": name, "certified": certificates[name]["certified"]})
            tests.append({"run": run, "method": name, "test": "characteristics", "reason": ""}
                         | {key: certificates[name]["tests"]["characteristics"][key]
                            for key in ("value", "limit", "passed")})  # fmt: skip
        outcomes.append({"run": run, "step": "identify", "status": "ok", "reason": ""})
        if reason:
            outcomes.append({"run": run, "step": "refine", "status": "failed", "reason": reason})
    tests += [
        {"run": run, "method": Method.CONTROL, "test": "agreement", "passed": agrees, "reason": ""}
        for run, agrees in enumerate(control)
    ]
    tables = {name: as_table(name, []) for name in COLUMNS}
    tables |= {
        "rrmse": as_table("rrmse", rrmse), "certificates": as_table("certificates", tests),
        "outcomes": as_table("outcomes", outcomes),
        "timings": as_table("timings", [{"run": 0, "step": "identify", "seconds": 1.6}]),
    }  # fmt: skip
    if record:
        tables["record"] = as_table("record", record)
    if coefficients:
        tables["coefficients"] = as_table("coefficients", pd.concat(coefficients))
    tables["summary"] = summary_table(tables["coefficients"], tables["rrmse"], tables["prediction"], {})
    del tables["landscape_errors"], tables["escape"]
    models = ModelFiles(tuple(paths))
    asked = Study.model_validate({"name": "mine", "runs": runs, "recordings": {"file": "mine.csv"}} | study)
    results = StudyResults(
        tables, Path("results/mine/tables"), images=dict.fromkeys(images, PNG), vectors={}, models=models,
        shown=models.representative(tables["rrmse"]), exact=exact, record=identified,
        landscape=None if overview is None else summarise(told(overview)), inspection=inspection,
    )  # fmt: skip
    return study_page(asked, results, command="siq run mine.yaml", versions={"siq": "1"})


def headings(content: ReportContent) -> list[str]:
    return [section.heading for section in content.sections]


def section_of(content: ReportContent, heading: str) -> ReportSection:
    return next(section for section in content.sections if section.heading == heading)


WELLS = landscape([[-0.5], [0.5]], [0.25, 0.25], noise=NOISE)
EVERY = tuple(CAPTIONS)


def test_the_answer_then_formulas_then_evidence_then_workings(tmp_path: Path) -> None:
    content = page_of(tmp_path, overview=WELLS, images=("quasipotential", "residuals", "dataset"))
    assert content.answer[0].startswith("The recordings show two stable states")
    assert content.badge and content.good
    assert content.figure is not None and content.figure.caption == OF_ONE_STATE
    assert content.table is not None and "lasts (s)" in list(content.table.frame["stable state"])
    assert headings(content) == [
        "Formulas", "How far it can be trusted", "The landscape in full", "The recordings and the workings",
        "How to run it again", "The study and the versions",
    ]  # fmt: skip
    assert content.sections[-1].text[-1] == "Processor time by step: identify 2 s."
    folded = [section.heading for section in content.sections if section.folded]
    assert folded == ["The recordings and the workings", "The study and the versions"]


def test_of_one_run_without_networks_card_and_paper_nothing_speaks_of_them(tmp_path: Path) -> None:
    page = render_report(page_of(tmp_path, overview=WELLS, images=EVERY))
    text = re.sub(r'base64,[^"]*', "", page[page.index("<main>") : page.index("The study and the versions")])
    for word in ("runs", "1 of 1", "Exact", "paper", "regression", "published", "network", "RRMSE", "run 0"):
        assert word not in text, word


@pytest.mark.parametrize("runs", [1, 3])
@pytest.mark.parametrize("regressed", [False, True])
def test_every_figure_that_makes_sense_is_shown_once(tmp_path: Path, runs: int, regressed: bool) -> None:
    content = page_of(
        tmp_path, overview=WELLS, images=(*EVERY, "of_tomorrow"), runs=runs, regressed=regressed
    )
    shown = [figure.alternative for section in content.sections for figure in section.figures]
    assert content.figure is not None
    shown.append(content.figure.alternative)
    absent = {
        LEADING[1],
        "landscape_published",
        "sweep",
        "states",
    }  # sweeps have tables, and no states were seen
    of_runs, of_networks = (
        {name for name, caption in FIGURES.items() if one in caption.get("only_with", ())}
        for one in ("runs", "networks")
    )
    assert "error_distribution" in of_runs and "training" in of_networks
    absent |= of_runs if runs == 1 else set()
    absent |= set() if regressed else of_networks
    texts = CAPTIONS | {"quasipotential": OF_ONE_STATE}
    expected = [text for name, text in texts.items() if name not in absent]
    assert sorted(shown) == sorted([*expected, "Of tomorrow."])


@pytest.mark.parametrize(
    ("study", "compared"),
    [
        ({"training": {}}, True),
        ({"training": {}, "refinement": {"routes": ["local"]}}, False),
        ({}, False),
    ],
)
def test_networks_are_told_to_be_a_second_route_where_they_are_compared(
    tmp_path: Path, study: dict[str, Any], compared: bool
) -> None:
    content = page_of(tmp_path, identified=exact_field(double_well(2), 3), **study)
    text = " ".join(section_of(content, "The recordings and the workings").text)
    assert "The formulas follow from this f alone" in text
    assert ("The networks are a second route to U" in text) == compared


@pytest.mark.parametrize(
    ("control", "count", "alarm"),
    [((False, False), "2 of 2 runs.", False), ((False, True), "1 of 2 runs;", True)],
)
def test_a_control_that_agrees_with_the_refined_u_is_told(
    tmp_path: Path, control: tuple[bool, ...], count: str, alarm: bool
) -> None:
    content = page_of(tmp_path, runs=2, control=control)
    text = " ".join(section_of(content, "How far it can be trusted").text)
    assert f"They were refused in {count}" in text
    assert ("agreement is no evidence here" in text) == alarm
    assert "As a control" not in render_report(page_of(tmp_path))


def test_a_figure_that_was_not_drawn_leaves_no_trace(tmp_path: Path) -> None:
    content = page_of(tmp_path, overview=WELLS)
    page = render_report(content)
    assert content.figure is None and "<img" not in page and "Figure" not in page


def test_the_published_method_is_folded_away_unless_a_paper_is_named(tmp_path: Path) -> None:
    for published, folded in ((None, True), ("archetype3d", False)):
        content = page_of(tmp_path, overview=WELLS, regressed=True, published=published)
        section = next(one for one in content.sections if one.heading == "The published method")
        assert section.folded is folded and [row.quantity for row in section.formulas] == ["U", "g", "f"]
        assert "not certified" in section.text[-1]
    assert "The published method" not in headings(page_of(tmp_path, overview=WELLS))


def test_figures_name_the_paper_only_beside_it(tmp_path: Path) -> None:
    captions = [
        "".join(figure.caption for section in page.sections for figure in section.figures)
        for page in (
            page_of(tmp_path, overview=WELLS, images=EVERY, published=name) for name in (None, "archetype3d")
        )
    ]
    assert "paper" not in captions[0] and "In the paper: Fig. 1." in captions[1]


def test_a_refusal_is_told_as_one(tmp_path: Path) -> None:
    content = page_of(tmp_path, overview=WELLS, certified=False)
    assert content.badge == "not certified" and not content.good
    assert content.promise[0] == ("An independent calculation, along characteristics of f, gives another U.")
    evidence = next(one for one in content.sections if one.heading == "How far it can be trusted")
    assert any("not certified" in table.caption for table in evidence.tables)


def test_a_study_without_a_formula_says_why_and_has_no_table_of_nothing(tmp_path: Path) -> None:
    content = page_of(tmp_path, reason="the recordings are too short")
    assert content.answer == ["No landscape was found: the recordings are too short."]
    assert content.table is None and content.badge == "no formula"
    page = render_report(content)
    assert "the table has no rows" not in page.lower() and "nan" not in page[page.index("<main>") :]


def test_several_runs_say_together_what_they_have_in_common(tmp_path: Path) -> None:
    content = page_of(tmp_path, overview=WELLS, runs=3)
    section = next(one for one in content.sections if one.heading == "What 3 runs say together")
    assert any("3 of 3 runs are certified" in line for line in section.text)
    assert list(section.tables[0].frame["quantity"])[-1] == "U: x⁴"
    assert "3 of 3 runs are certified." in content.promise


def test_an_exact_answer_stands_beside_ours(tmp_path: Path) -> None:
    page = render_report(page_of(tmp_path, overview=WELLS, exact=EXACT))
    assert ">Exact</th>" in page and "Against the exact U" not in page  # no error was scored here
    assert ">Exact</th>" not in render_report(page_of(tmp_path, overview=WELLS))


def test_what_the_command_prints_is_what_the_page_opens_with(tmp_path: Path) -> None:
    page = render_report(page_of(tmp_path, overview=WELLS))
    sentence = page_of(tmp_path, overview=WELLS).answer[0]
    assert page.index(sentence.split(";")[0]) < page.index("Formulas</h2>")


def test_hops_are_counted_and_what_they_allow_is_said(tmp_path: Path) -> None:
    rows = [record_row(), record_row(attractor="(-1)", visits=25)]
    section = section_of(page_of(tmp_path, overview=WELLS, record=rows), "Against the record itself")
    (said,) = section.text
    assert said.startswith("41 hops") and "f of the other half" in said and "is known to 25 % at best" in said
    counted = section.tables[0].frame["mean visit, counted (s)"].tolist()
    assert counted == ["50.0 (31 to 87)", "32.0 (22 to 49)"]
    assert section.tables[0].frame["predicted (s)"].tolist()[0] == "51.0 ± 3.0"
    assert list(section.tables[0].column_help) == [
        "visits seen to end", "mean visit, counted (s)", "predicted (s)", "probability",
    ]  # fmt: skip


def test_where_nothing_hops_it_is_said(tmp_path: Path) -> None:
    section = section_of(
        page_of(tmp_path, overview=WELLS, record=[unseen_row()]), "Against the record itself"
    )
    assert section.text == ["No hop from well to well was seen."]
    assert section.tables[0].frame["mean visit, counted (s)"].tolist() == ["above 217"]
    assert "Against the record itself" not in headings(page_of(tmp_path, overview=WELLS))


def test_the_test_against_the_record_is_drawn_beside_its_table(tmp_path: Path) -> None:
    images = ("record", "states_in_time", "visited", "memory")
    content = page_of(
        tmp_path, overview=WELLS, record=[unseen_row()], inspection=["the noise is white."], images=images
    )
    assert len(content.sections[0].figures) == 3
    (figure,) = section_of(content, "Against the record itself").figures
    assert figure.alternative == CAPTIONS["record"]
    assert not set(texts("captions")["inspection"]) & set(texts("captions")["figures"])


def test_what_is_in_the_recordings_comes_first(tmp_path: Path) -> None:
    lines = ["x: 2 recordings", "the noise is white."]
    content = page_of(
        tmp_path, overview=WELLS, inspection=lines, images=("states_in_time", "visited", "memory")
    )
    first = content.sections[0]
    assert first.heading == "What is in the recordings" and len(first.figures) == 3
    assert first.text == ["x: 2 recordings.", "The noise is white."]
