"""The figure of a sweep and its section of the page: what was found is drawn, and said."""

from pathlib import Path

import numpy as np
import pytest
import sympy

from siq.report.page import ReportSection
from siq.report.plots.sweep import plot_sweep
from siq.report.study_page import StudyResults, study_page
from siq.systems.dynamics import Dynamics
from siq.workflow.study import Study, SweepOptions
from siq.workflow.sweep import Sweep, sweep
from siq.workflow.tables import as_table
from workflow.figures.study import _sweep_figure

h, a, x = sympy.symbols("h a x", real=True)
CUSP = Dynamics.of((x,), (h + a * x - x**3,), domain=[(-2, 2)], parameters={h: 0.0, a: 1.0})
VALUES = [-0.5, 0.0, 0.2]


@pytest.fixture(scope="module")
def found() -> Sweep:
    return sweep(CUSP, "h", VALUES, noise=0.04)


def tables_of(found: Sweep) -> dict:
    return {
        "sweep": found.table,
        "branches": found.branches,
        "bifurcations": found.bifurcations,
        "bifurcation_curves": found.curves,
    }


def section_of(options: dict, tables: dict) -> ReportSection:
    study = Study.model_validate({"name": "s", "system": "cusp.yaml", "from": "equations", "sweep": options})
    of_landscape = ("landscape", "degrees", "certificates", "outcomes")
    tables = {name: as_table(name, []) for name in of_landscape} | tables
    results = StudyResults(tables, Path("results/s/tables"), images={}, vectors={}, system=CUSP)
    page = study_page(study, results, command="siq run s.yaml", versions={})
    return next(section for section in page.sections if section.heading.startswith("Against"))


def test_one_panel_for_equilibria_and_one_for_each_quantity_that_is_known(found):
    above, *below = found.plot().axes
    assert [axes.get_ylabel() for axes in below] == [
        "barrier ΔU (unit of ε)", "mean time (time units)", "share of time",
    ]  # fmt: skip
    drawn = np.concatenate([line.get_ydata() for line in above.lines])
    assert drawn.min() < -1.1 and drawn.max() > 1.08
    assert below[-1].get_xlabel() == "$h$" and below[1].get_yscale() == "log"
    quiet = sweep(CUSP, "h", VALUES)
    assert len(quiet.plot().axes) == 2


def test_two_parameters_are_a_map():
    found = sweep(CUSP, "h", [0.0, 0.1], second=("a", [-0.5, 1.0]))
    count, lowest = (axes.collections[0].get_array().reshape(2, 2) for axes in found.plot().axes[:2])
    assert count.tolist() == [[1, 1], [2, 2]]
    assert lowest[1, 0] == pytest.approx(0.5, rel=1e-4) and np.isnan(np.ma.filled(lowest, np.nan)[0, 0])


def test_the_folds_of_a_map_are_drawn_and_said():
    options = {"parameter": "h", "from": -0.4, "to": 0.4, "step": 0.4}
    second = {"parameter": "a", "from": -0.5, "to": 1.0, "step": 0.5}
    asked = SweepOptions.model_validate(options | {"second": second})
    found = sweep(CUSP, "h", asked.numbers, second=("a", asked.second.numbers))
    assert set(found.curves["kind"]) == {"fold"} and found.curves["curve"].nunique() == 1
    assert (27 * found.curves["value"] ** 2 - 4 * found.curves["second_value"] ** 3).abs().max() < 1e-9
    for axes in found.plot().axes[:2]:
        (line,) = axes.lines
        assert 27 * line.get_xdata() ** 2 == pytest.approx(4 * line.get_ydata() ** 3, abs=1e-9)
    section = section_of(options | {"second": second}, tables_of(found))
    assert "Folds lie on 1 curve of the plane, within h = -0.3849 to 0.3849 and a = " in section.text[1]
    assert "bifurcation_curves.csv" in section.notes[-1]


def test_a_state_that_is_named_is_drawn(found):
    axes = plot_sweep(
        found.table, found.branches, found.bifurcations, parameters=("h",), states=("x",), state="x",
        units={"x": "nM", "h": "1/s"},
    ).axes  # fmt: skip
    assert axes[0].get_ylabel() == "$x$ (nM)" and axes[-1].get_xlabel() == "$h$ (1/s)"


def test_the_section_says_where_wells_end_and_what_was_not_found(found):
    options = SweepOptions.model_validate({"parameter": "h", "values": VALUES})
    table = found.table.assign(note=found.table["note"])
    table.loc[table["value"] == -0.5, ["well", "note"]] = [-1, "it was too far"]
    tables = tables_of(found) | {"sweep": table}
    section = section_of({"parameter": "h", "values": VALUES}, tables)
    assert section.heading == "Against h"
    assert "h has 3 values from -0.5 to 0.2: 3 landscapes" in section.text[0]
    assert "fold at h = -0.3849" in section.text[1]
    assert "No landscape at h = -0.5: it was too far." in section.notes
    (shown,) = section.tables
    assert list(shown.frame["what"]) == ["fold"]
    assert len(_sweep_figure(CUSP, options, tables).axes) == 4
