"""The page and the figures of a diagnosis, from a verdict made by hand."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
import sympy
from pydantic import TypeAdapter

from siq.diagnosis.dictionary import dictionary_of
from siq.diagnosis.statement import Statement
from siq.diagnosis.verdict import statement_of_failure
from siq.report.diagnosis_page import Findings, largest_difference, mismatch_answer, mismatch_page
from siq.report.formatting import texts
from siq.report.plots.diagnosis import (
    _limits_of,
    plot_before_after,
    plot_candidates,
    plot_curves,
    plot_described,
    plot_escapes,
    plot_held_out,
    plot_ladder,
    plot_missing,
)
from siq.systems.cards import load_system
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from workflow.consequences import compare_landscapes, identified, obstacle

CARD = """\
name: spring
time_unit: s
states:
  x: {{unit: mm, domain: [-2, 2]}}
  v: {{unit: mm/s, domain: [-2, 2]}}
parameters:
  k: {{value: 1.0, unit: 1/s**2}}
  d: {{value: 0.5, unit: 1/s}}
{further}
equations:
  x: v
  v: -k*x - d*v{terms}
outputs: {{x: x}}
"""
VERDICT = {
    "verdict": "missing physics",
    "mechanisms": [
        {
            "name": "cubic stiffness",
            "label": "cubic stiffness in v",
            "terms": {"v": "-c_1*x**3"},
            "parameters": {"c_1": {"estimate": 0.25, "standard_error": 0.01, "unit": "1/(mm**2*s**2)"}},
            "evidence": {"delta_chi2": 300.0, "delta_bic": -290.0, "p_white": 1e-60, "p_cluster": 1e-9},
            "share_of_excess": 0.99,
            "indistinguishable_from": ["quintic stiffness"],
            "equations": ["v"],
            "beside": [],
            "rivals": [
                {
                    "name": "quintic stiffness", "label": "quintic stiffness in v", "delta_chi2": 296.0,
                    "further_parameters": 0, "standing": "same",
                }
            ],
        }
    ],
    "description": None,
    "location": {
        "equations": {"v": 0.97},
        "coordinate": "x",
        "region": {"x": [-2.0, 2.0]},
        "time": None,
        "recordings": ["r01", "r02"],
        "recordings_total": 3,
    },
    "recalibration": {"k": {"before": 1.0, "after": 1.1, "standard_error": 0.02}},
    "errors": {
        "before": None,
        "recalibrated": 0.3,
        "augmented": 0.05,
        "noise_floor": 0.05,
        "squares": {"recalibrated": (0.09,) * 8, "augmented": (0.0025,) * 8},
    },
    "excluded": {},
}  # fmt: skip


@pytest.fixture
def models(write) -> tuple[Dynamics, Dynamics]:
    before = write(CARD.format(further="", terms=""), "before.yaml")
    after = write(
        CARD.format(further="  c_1: {value: 0.25, unit: 1/(mm**2*s**2)}", terms=" - c_1*x**3"), "after.yaml"
    )
    return load_system(before), load_system(after)


def candidates() -> pd.DataFrame:
    return pd.DataFrame(
        {
            "mechanism": ["cubic stiffness", "quintic stiffness", "dry friction"],
            "label": ["cubic stiffness in v", "quintic stiffness in v", "dry friction in $v$"],
            "shapes": ["", "", ""],
            "gain": [300.0, 296.0, 2.0],
            "stage": ["found", "same", "further"],
            "beside": "",
        }
    )


def findings(models, **changes) -> Findings:
    said = changes.pop("verdict", {})
    statement = (
        said if isinstance(said, Statement) else TypeAdapter(Statement).validate_python(VERDICT | said)
    )
    return Findings(
        statement=statement,
        before=models[0],
        after=models[1],
        dictionary=dictionary_of(without=(), further=(), file=""),
        candidates=candidates(),
        figures=dict.fromkeys(texts("captions")["diagnosis"], b"<svg/>"),
        **changes,
    )


class Collector(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.images: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag == "img":
            self.images.append(dict(attrs)["src"])
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def page_of(models, **changes) -> str:
    return mismatch_page(findings(models, **changes), title="A spring", commands=["make it"])


def test_page_says_what_where_how_sure_and_what_else(models):
    page = page_of(models)
    for part in (
        "missing physics",
        "Cubic stiffness (or quintic stiffness, which explains the recordings as well) is missing in the",
        "0.250 ± 0.010\u00a01/(mm²·s²)",
        "Duffing",
        "cannot tell cubic stiffness from quintic stiffness",
        "ran away",
        "r01 and r02",
        "make it",
    ):
        assert part in page
    assert page.count("<math") == 5  # the term, and both equations with their left sides


def test_page_is_self_contained_and_well_formed(models):
    page = page_of(models)
    parser = Collector()
    parser.feed(page)
    assert not parser.open
    assert parser.images and all(source.startswith("data:image/svg+xml") for source in parser.images)
    assert not re.search(r"(src|href)=\"https?:", page)
    assert "<script" not in page


@pytest.mark.parametrize("verdict", ["no mismatch", "parameter shift"])
def test_page_without_a_mechanism_tells_what_is_excluded(models, verdict):
    excluded = {
        "dry friction in v": {
            "upper_bound_95": 0.5,
            "unit": "mm/s**2",
            "parameter": "c_1",
            "label": "dry friction in v",
        }
    }
    page = page_of(
        models, verdict={"verdict": verdict, "mechanisms": [], "location": None, "excluded": excluded}
    )
    assert "at most (95 %)" in page and "0.50\u00a0mm/s²" in page
    assert "against chance" in page


def test_page_of_an_unexplained_mismatch_describes_it(models):
    description = {
        "share_described": 0.7,
        "by": VERDICT["mechanisms"],
        "p_residuals_random": 1e-9,
        "random_forces_admitted": True,
    }
    said = {"verdict": "unexplained", "mechanisms": [], "description": description}
    page = page_of(models, verdict=said)
    assert "What comes closest, as a formula" in page
    assert "Cubic stiffness in v explains 99 %" in page and "What is left is not noise" in page


def test_formula_that_cannot_be_read_is_shown_as_text(models):
    odd = VERDICT["mechanisms"][0] | {"terms": {"v": "mystery(x) <"}}
    assert "mystery(x) &lt;" in page_of(models, verdict={"mechanisms": [odd]})


def held_out() -> pd.DataFrame:
    t = np.linspace(0, 5, 40)
    runaway = np.where(t < 2, np.sin(t), np.nan)
    return pd.DataFrame(
        {
            "recording": "r01", "t": t, "output": "x", "measured": np.sin(t), "before": runaway,
            "recalibrated": np.sin(t) * 1e9, "augmented": np.sin(t) + 0.01, "scored": t > 1,
        }
    )  # fmt: skip


def curves() -> pd.DataFrame:
    at = np.linspace(-2, 2, 9)
    parts = [
        pd.DataFrame(
            {
                "stage": stage, "equation": equation, "coordinate": coordinate, "across": across, "at": at,
                "missing": at**3, "standard_error": 0.1, "gain": gain,
            }
        )
        for stage in ("before", "after")
        for equation, coordinate, across, gain in (
            ("v", "x", False, 100.0), ("v", "t", False, 200.0), ("x, v", "amplitude", True, 5.0),
        )
    ]  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def test_held_out_figure_keeps_a_runaway_out_of_its_limits():
    figure = plot_held_out(held_out(), units={"x": "mm"}, time_unit="s")
    upper, lower = figure.axes
    assert upper.get_ylabel() == "$x$ (mm)" and lower.get_xlabel() == "$t$ (s)"
    assert max(np.abs(upper.get_ylim())) < 5 and max(np.abs(lower.get_ylim())) < 10


@pytest.mark.parametrize(("after", "curves"), [("augmented", 2), ("recalibrated", 2), ("before", 1)])
def test_the_first_picture_shows_one_recording_before_and_after(after, curves):
    figure = plot_before_after(held_out(), after=after, noise={"x": 1e-4}, units={"x": "mm"}, time_unit="s")
    upper, lower = figure.axes
    assert len(upper.lines) == curves + 1  # and what was recorded
    assert len(lower.lines) == curves + 1  # and zero
    (band,) = lower.patches
    assert band.get_height() == pytest.approx(0.04)
    assert lower.get_ylabel() == "error (mm)"


@pytest.mark.parametrize(
    ("runaway", "recording", "before"), [(False, "worst", 0.5), (True, "runaway", np.inf)]
)
def test_the_page_begins_with_the_largest_difference(runaway, recording, before):
    """Of the output that is off the furthest in the middle of all recordings: one runaway does not decide."""
    t = np.arange(20.0)
    parts = [
        pd.DataFrame(
            {
                "recording": name, "t": t, "output": output, "measured": np.sin(t), "scored": True,
                "before": np.sin(t) + off, "recalibrated": 0.0, "augmented": np.sin(t) + 0.1,
            }
        )
        for output, scale in (("x", 0.1), ("y", 1.0))
        for name, off in (
            ("best", 0.1 * scale), ("runaway", np.nan if runaway or output == "x" else 0.0),
            ("worst", 0.5 * scale),
        )
    ]  # fmt: skip
    found = largest_difference(pd.concat(parts), after="augmented")
    assert (found["output"], found["recording"], found["recordings"]) == ("y", recording, 3)
    assert found["before"] == pytest.approx(before) and found["after"] == pytest.approx(0.1)


DESCRIBED = {
    "name": "a function of x", "label": "a function of x in v", "kind": "curve",
    "terms": {"v": "f_1*Abs(x)**3 + f_2"},
    "parameters": {"f_1": {"estimate": 0.2, "standard_error": 0.1, "unit": "mm/s**2"}},
    "evidence": {"delta_chi2": 90.0, "delta_bic": -80.0, "p_white": 0.0, "p_cluster": 0.0},
    "equations": ["v"], "outputs": [], "coordinates": ["x"], "beside": [],
    "curve": {
        "coordinate": "x", "at": [-1.0, -0.5, 0.2, 0.7, 1.5], "value": [0.1, 0.0, 0.3, 1.1, 0.2],
        "standard_error": [0.05, 0.02, 0.01, 0.02, 0.1],
    },
}  # fmt: skip


def test_the_model_of_what_has_no_name_is_on_the_page_and_drawn_with_its_band(models):
    figure = plot_described([DESCRIBED, DESCRIBED | {"curve": None}], units={"x": "mm"}, time_unit="s")
    (axes,) = figure.axes
    assert axes.get_xlabel() == "$x$ (mm)" and axes.get_ylabel() == "added in the equation of $v$"
    (band,) = axes.collections
    heights = band.get_paths()[0].vertices[:, 1]
    assert heights.max() > 1.1 and heights.min() < 0
    description = {
        "share_described": 0.0, "by": [], "p_residuals_random": 0.0, "random_forces_admitted": False,
        "too_faint": False,
    }  # fmt: skip
    said = {
        "verdict": "unexplained", "mechanisms": [], "description": description, "described": [DESCRIBED],
    }  # fmt: skip
    shown = findings(models, verdict=said)
    assert shown.statement.final_simulation == "augmented"
    page = mismatch_page(shown, title="t", commands=())
    assert "A model of what is missing" in page and re.search(r"1\.10+\s±\s0\.020?", page)
    assert "with what describes it" in page
    explanations = {"drag in v": 0.0, "forces": -31.25}
    told = findings(models, verdict={"explanations": explanations})
    assert "\N{MINUS SIGN}31.2" in mismatch_page(told, title="t", commands=()).replace(
        "-31.2", "\N{MINUS SIGN}31.2"
    )


def test_the_picture_stands_above_the_answer(models):
    figure = b'<svg xmlns="http://www.w3.org/2000/svg"></svg>'
    shown = replace(findings(models), figures={"before_after": figure}, held_out=held_out())
    page = mismatch_page(shown, title="t", commands=())
    assert 0 < page.index("<figure") < page.index('class="answer')
    assert re.search(
        "In the held-out recording .*, x as simulated .* as given, and .* with what was found", page
    )


def test_curve_of_the_named_mechanism_comes_first():
    figure = plot_curves(curves(), named=("v", "x"), units={"x": "mm", "v": "mm/s"}, time_unit="s")
    labels = [axes.get_xlabel() for axes in figure.axes]
    assert labels == ["$x$ (mm)", "$t$ (s)", "amplitude (mm)"]
    assert figure.axes[0].get_ylabel() == "missing in $\\dot{v}$\n(mm/s²)"
    # One below the other, so that a phone can show them.
    assert len({round(axes.get_position().x0, 2) for axes in figure.axes}) == 1


@pytest.mark.parametrize("error", [0.05, 250.0, np.inf])
def test_a_wide_band_does_not_hide_the_curve(error):
    at = np.linspace(-1, 1, 9)
    errors = np.where(np.abs(at) > 0.9, error, 0.05)
    table = pd.DataFrame({"missing": 8 * at, "standard_error": errors})
    low, high = _limits_of([table])
    assert -15 < low < -6 and 6 < high < 15
    # Even if no knot is known well, the axis is that of the values.
    low, high = _limits_of([table.assign(standard_error=250.0)])
    assert -15 < low <= -8 and 8 <= high < 15


def test_map_has_a_panel_for_each_of_two_equations():
    points = np.random.default_rng(0).normal(size=(500, 2))
    missing = {"x": 0.1 * points[:, 0], "v": points[:, 0] ** 3, "w": np.full(500, np.nan)}
    figure = plot_missing(points, missing, names=("x", "v"), units={"v": "mm/s"}, time_unit="s")
    bars = [axes.get_ylabel() for axes in figure.axes if "missing" in axes.get_ylabel()]
    assert bars == ["missing in $\\dot{v}$ (mm/s²)", "missing in $\\dot{x}$ (1/s)"]


@pytest.mark.parametrize("spread", [None, 2.0])
def test_the_ladder_has_a_step_for_each_name_and_for_what_has_none(spread):
    errors = FIT | {"named": 0.04, "rungs": [0.2], "floor": 0.015, "spread": spread, "unit": "mm"}
    said = {"mechanisms": VERDICT["mechanisms"] * 2, "described": [DESCRIBED], "errors": errors}
    statement = TypeAdapter(Statement).validate_python(VERDICT | said)
    (axes,) = plot_ladder(statement).axes
    scale, unit = (100, "%") if spread is None else (2, "mm")
    steps = [line for line in axes.lines if line.get_marker() not in ("None", None)]
    assert [line.get_xdata()[0] for line in steps] == pytest.approx(
        [scale * error for error in (0.5, 0.1, 0.2, 0.04, 0.02)]
    )
    words = [text.get_text() for text in axes.texts]
    assert words[2].startswith("with cubic stiffness in v: ") and words[3].startswith("and cubic stiffness")
    assert words[4].startswith("and a function of x in v: ") and all(text.endswith(unit) for text in words)
    assert axes.get_xscale() == "log" and unit in axes.get_xlabel()
    assert plot_ladder(replace(statement, errors=replace(statement.errors, noise_floor=None))) is None


def test_a_simulation_that_runs_away_has_no_place_on_the_ladder():
    statement = TypeAdapter(Statement).validate_python(VERDICT)
    (axes,) = plot_ladder(statement).axes
    assert axes.texts[0].get_text() == "as given: runs away"


def test_a_model_at_the_floor_is_missing_physics_with_its_formula(models):
    description = {
        "share_described": 0.0, "by": [], "p_residuals_random": 0.5, "random_forces_admitted": False,
    }  # fmt: skip
    shape = {
        "shape": "exponential", "formula": "s_1*exp(x/s_2)", "like": "cubic stiffness",
        "sizes": {
            "s_1": {"estimate": 2.0, "standard_error": 0.1, "unit": "mm/s**2"},
            "s_2": {"estimate": 0.5, "standard_error": 0.01, "unit": "mm"},
        },
    }  # fmt: skip
    said = {"mechanisms": [], "description": description, "described": [DESCRIBED | shape], "errors": FIT}
    shown = findings(models, verdict=said)
    sentence = shown.statement.sentence.replace("\u00a0", " ")
    assert sentence.startswith(
        "An effect of x is missing in the equation of v, exponential over 0.500 ± 0.010 mm, as cubic"
        " stiffness would have. With it, the error"
    )
    assert "As a formula: s_1*exp(x/s_2), s_1 = 2.00 ± 0.10 mm/s²" in sentence
    page = mismatch_page(shown, title="t", commands=())
    assert "missing physics, modelled" in page and "simplest formula that the recordings allow" in page
    assert page.index("A model of what is missing") < page.index("How sure it is")


def test_candidates_are_told_apart_by_what_they_are():
    figure = plot_candidates(candidates())
    colours = {patch.get_facecolor() for patch in figure.axes[0].patches}
    assert len(colours) == 3


@pytest.mark.parametrize(
    "figure",
    [
        lambda: plot_held_out(held_out().assign(scored=False)),
        lambda: plot_before_after(held_out().assign(scored=False), after="augmented"),
        lambda: plot_curves(pd.DataFrame()),
        lambda: plot_missing(np.zeros((3, 2)), {"x": np.zeros(3)}, names=("x", "v")),
        lambda: plot_candidates(pd.DataFrame()),
        lambda: plot_escapes(pd.DataFrame()),
    ],
)
def test_there_is_no_figure_without_data(figure):
    assert figure() is None


def test_a_simulation_that_cannot_be_fitted_has_a_page(models):
    said = findings(models, verdict=statement_of_failure("the simulation runs away"))
    page = mismatch_page(replace(said, candidates=candidates()[:0]), title="t", commands=())
    assert "no fit of it to them has a result" in page and "The simulation runs away." in page


def test_what_could_not_be_judged_is_on_the_page(models):
    remark = {"code": "diagnosis.fit_failed", "values": {"error": "", "message": "it overflows"}}
    further = {"not_fitted": [{"mechanism": "m", "label": "drag in v", "remark": remark}]}
    page = mismatch_page(findings(models, verdict=further), title="t", commands=())
    assert "Drag in v could not be judged: it overflows." in page


def two_wells(write, tilt: float) -> Dynamics:
    text = f"""\
name: wells
states: {{x: {{domain: [-2, 2]}}, y: {{domain: [-2, 2]}}}}
parameters: {{a: {{value: {tilt}}}}}
equations: {{x: x - x**3 + a, y: -y}}
"""
    return load_system(write(text, f"wells{tilt}.yaml"))


def test_a_force_tilts_the_wells_of_a_gradient_system(write):
    states = np.random.default_rng(0).uniform(-1.6, 1.6, size=(1500, 2))
    models = {"recalibrated": two_wells(write, 0.0), "augmented": two_wells(write, 0.1)}
    assert obstacle(list(models.values())) == ""
    wells, escape, _ = compare_landscapes(models, states)
    ways = wells[wells["kind"] == "way out"].set_index(["simulation", "item"])["barrier"]
    x = np.sort(np.roots([-1, 0, 1, 0.1]).real)
    energy = x**4 / 4 - x**2 / 2 - 0.1 * x
    left, right = (2 * (energy[1] - energy[end]) for end in (0, 2))
    assert ways["recalibrated"].to_numpy() == pytest.approx([0.5, 0.5], rel=0.01)
    assert sorted(ways["augmented"]) == pytest.approx(sorted([left, right]), rel=0.01)
    assert set(escape["simulation"]) == {"recalibrated", "augmented"}


def test_identified_field_is_the_model_at_its_values(models):
    x = np.random.default_rng(1).normal(size=(20, 2))
    expected = np.stack([x[:, 1], -x[:, 0] - 0.5 * x[:, 1] - 0.25 * x[:, 0] ** 3], axis=1)
    assert identified(models[1]).dynamics.drift(x) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"equations": "sign"}, "not smooth"),
        ({"equations": "t"}, "change with time"),
    ],
)
def test_systems_without_a_landscape_are_told(models, change, part):
    v = sympy.Symbol("v", real=True)
    formula = sympy.sign(v) if change["equations"] == "sign" else sympy.Symbol("t", real=True) * v
    rough = replace(models[0], equations=(v, formula))
    assert part in obstacle([models[0], rough])


@pytest.mark.parametrize(("noise", "part"), [([1.0, 1.0], "acts on x"), ([0.0, 1.0], "does not reach every")])
def test_noise_without_a_landscape_is_told(models, noise, part):
    assert part in obstacle([each.with_diffusion(Diffusion(np.diag(noise))) for each in models])


SQUARES = {"before": (0.25,) * 8, "recalibrated": (0.01,) * 8, "augmented": (4e-4,) * 8}
FIT = {"before": 0.5, "recalibrated": 0.1, "augmented": 0.02, "noise_floor": 0.01, "squares": SQUARES}


@pytest.mark.parametrize(
    ("verdict", "named", "described", "outcome", "after"),
    [
        ("missing physics", ["cubic stiffness"], [], "named", 0.02),
        ("missing physics", ["process noise"], [], "process noise", 0.1),
        ("missing physics", [], [DESCRIBED], "modelled", 0.02),
        ("parameter shift", [], [], "parameter shift", 0.1),
        ("unexplained", [], [], "unexplained", 0.1),
        ("unexplained", [], [DESCRIBED], "unexplained", 0.02),
        ("no mismatch", [], [], "no mismatch", 0.5),
    ],
)
def test_the_error_after_is_that_of_the_simulation_that_the_verdict_ends_with(
    verdict, named, described, outcome, after
):
    statement = TypeAdapter(Statement).validate_python(
        VERDICT | {
            "verdict": verdict, "errors": FIT, "described": described,
            "mechanisms": [VERDICT["mechanisms"][0] | {"name": name} for name in named],
        }
    )  # fmt: skip
    answer = mismatch_answer(statement, title="A spring")
    assert answer.pop("sentence")
    assert answer == {
        "title": "A spring", "verdict": verdict, "outcome": outcome, "compared": True,
        "held_out_before": 0.5, "held_out_after": after, "held_out_noise": 0.01,
    }  # fmt: skip


def test_a_simulation_that_cannot_be_compared_says_so():
    answer = mismatch_answer(statement_of_failure("it runs away"), title="t")
    assert answer["compared"] is False and answer["held_out_before"] is None
