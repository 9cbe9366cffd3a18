"""What stands beside the paper, and that nothing of the paper is left out."""

import re
from fnmatch import fnmatchcase
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import sympy

from benchmarks.publication.publication import (
    attractor_rows,
    gradient_coefficients,
    load_contents,
    load_parameters,
    numbers,
    parameter_table,
    shown,
)
from siq.report.formatting import texts
from siq.systems.dynamics import Dynamics
from siq.workflow.study import load_study
from siq.workflow.tables import as_table
from workflow.published import PublishedFigure, load_published
from workflow.scoring import summary_table

CONFIG = Path(__file__).parents[2] / "config"
RULES = Path(__file__).parents[2] / "workflow" / "rules"
CONTENTS = load_contents(CONFIG / "published" / "contents.yaml")
LABELS = (
    "fig1a", "fig11", "fig:stat", "fig1b", "fig1_noisy", "fig1_4d", "fig2a", "fig2b", "fig2c", "fig22",
    "fig:fig_error", "tab1a", "tab1a4D", "tab0",
)  # fmt: skip


def test_every_table_and_figure_of_the_paper_has_its_place() -> None:
    places = " ".join(one.place for one in CONTENTS.places)
    assert [label for label in LABELS if f"({label})" not in places] == []


def test_every_published_number_has_its_place() -> None:
    reproduced = {one.study for one in CONTENTS.places} - {None}
    for name in reproduced:
        patterns = [p for one in CONTENTS.places if one.study == name for p in one.quantities]
        published = load_published(CONFIG / "published" / f"{name}.yaml").figures
        assert [q for q in published if not any(fnmatchcase(q, p) for p in patterns)] == []
        assert load_study(CONFIG / "studies" / f"{name}.yaml").published == name
    assert {path.stem for path in (CONFIG / "published").glob("*.yaml")} == reproduced | {
        "contents", "parameters", "contradictions",
    }  # fmt: skip


def test_every_pattern_means_something() -> None:
    for place in CONTENTS.places:
        for pattern in place.quantities:
            figures = load_published(CONFIG / "published" / f"{place.study}.yaml").figures
            assert any(fnmatchcase(quantity, pattern) for quantity in figures), (place.place, pattern)
        if set(place.tables) - {"parameters", "timings"} or place.figures:
            assert place.study is not None


def test_every_figure_is_one_that_studies_have() -> None:
    assert {figure for one in CONTENTS.places for figure in one.figures} <= set(texts("captions")["figures"])
    common = (RULES / "common.smk").read_text(encoding="utf-8")
    (reproduced,) = re.findall(r"REPRODUCED = \[(.*)\]", common)
    assert {one.study for one in CONTENTS.places} - {None} == set(re.findall(r'"([\w-]+)"', reproduced))


TERMS = (("V", "x**4", 0.5), ("V", "x*y", 3.0), ("V", "1", 7.0), ("f_x", "x", 9.0))
COEFFICIENTS = as_table(
    "coefficients",
    [
        {"run": run, "method": "refined", "component": component, "term": term, "estimate": value + run,
         "exact": value, "standard_error": 0.1}
        for run in (0, 1)
        for component, term, value in TERMS
    ],
)  # fmt: skip


def test_coefficients_of_the_gradient_are_those_of_v_differentiated() -> None:
    found = gradient_coefficients(COEFFICIENTS, ("x", "y")).set_index(["run", "component", "term"])[
        "estimate"
    ]
    assert found.to_dict() == {
        (0, "dV_x", "x**3"): 2.0, (0, "dV_x", "y"): 3.0, (0, "dV_y", "x"): 3.0,
        (1, "dV_x", "x**3"): 6.0, (1, "dV_x", "y"): 4.0, (1, "dV_y", "x"): 4.0,
    }  # fmt: skip
    nothing = gradient_coefficients(COEFFICIENTS[COEFFICIENTS["component"] == "f_x"], ("x", "y"))
    assert len(nothing) == 0 and list(nothing.columns) == list(COEFFICIENTS.columns)


def test_numbers_have_ours_and_the_difference_beside_them() -> None:
    published = {
        "dV_x:x**3": PublishedFigure(mean=2.001, source="Table 1"),
        "dV_y:x": PublishedFigure(mean=3.0, standard_deviation=0.5, source="Table 1"),
    }
    rrmse = as_table("rrmse", [{"run": run, "method": "refined", "certified": True} for run in (0, 1)])
    gradient = gradient_coefficients(COEFFICIENTS, ("x", "y"))
    summary = summary_table(gradient, rrmse, as_table("prediction", []), published)
    table = numbers(summary, ("dV_y:*", "dV_*", "none"))
    assert list(table["quantity"]) == ["dV_y:x", "dV_x:x**3"]
    row = table.iloc[1]
    assert row["refined"] == 4.0 and row["exact"] == 2.0 and row["runs"] == 2
    assert row["refined − published"] == pytest.approx(1.999)
    assert "regression" not in table and "published ±" in table
    assert numbers(summary, ("none",)).empty
    page = shown(table).iloc[1]
    assert page["quantity"] == "∇V_x: x³" and page["published"] == "2.001" and page["ours"] == "4 ± 2.8"
    assert page["ours − published"] == row["refined − published"]


def test_attractors_are_where_the_identified_field_vanishes() -> None:
    x, y = symbols = sympy.symbols("x y", real=True)
    fields = [Dynamics.of(symbols, (1e-9 * (x - x**3), shift - y)) for shift in (0.1, 0.3)]
    published = {
        "attractor B:x": PublishedFigure(mean=0.9, source="here"),
        "attractor B:y": PublishedFigure(mean=0.2, source="here"),
        "rrmse": PublishedFigure(mean=1.0, source="here"),
    }
    rows = pd.DataFrame(attractor_rows(published, fields, fields[0])).set_index("quantity")
    assert rows.loc["attractor B:x", "mean"] == pytest.approx(1.0)
    assert rows.loc["attractor B:y", "mean"] == pytest.approx(0.2)
    assert rows.loc["attractor B:y", "exact"] == pytest.approx(0.1)
    assert rows.loc["attractor B:y", "standard_deviation"] == pytest.approx(0.2 / np.sqrt(2))
    assert attractor_rows(published, [], None) == []
    nowhere = Dynamics.of(symbols, (1 + x**2, -y))
    assert np.isnan(pd.DataFrame(attractor_rows(published, [nowhere], None))["mean"]).all()


def test_parameters_stand_beside_those_of_the_studies() -> None:
    parameters = load_parameters(CONFIG / "published" / "parameters.yaml")
    names = [name for studies in parameters.studies.values() for name in studies]
    plain: dict[str, object] = {}
    for name in names:
        study = load_study(CONFIG / "studies" / f"{name}.yaml")
        plain[name] = SimpleNamespace(
            domain=[[-2.0, 2.0]],
            runs=study.runs,
            simulation=study.simulation,
            training=study.training,
            regression=study.regression,
        )
    table = parameter_table(parameters, plain).set_index("parameter")
    assert list(table.columns) == ["published, archetype", *names[:2], "published, resonator", *names[2:]]
    # The studies with the paper's settings have them to the letter.
    for example, name in (("archetype", "archetype3d-published"), ("resonator", "resonator-published")):
        same = table[f"published, {example}"] == table[name]
        assert list(table.index[~same]) == (["Ω"] if example == "archetype" else ["Ω", "λ of the loss"])
