"""Figures of systems with one state."""

from __future__ import annotations

import functools
from dataclasses import replace

import matplotlib.text
import numpy as np
import pytest
from known_systems import double_well, exact_field, portrait_of
from matplotlib.figure import Figure

from siq.quasipotential.invariant_density import SampledPotential, StationaryDensity
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.landscape_assembly import find_landscape
from siq.quasipotential.landscape_comparison import reference_landscape
from siq.quasipotential.landscape_files import read_landscape, write_landscape
from siq.quasipotential.refinement import RefinementOptions
from siq.workflow.study import StateSpace
from siq.workflow.tables import as_table
from workflow.figures.density import plot_invariant_distribution
from workflow.figures.recorded import plot_components
from workflow.figures.study import _project_landscape, landscape_figures

KNOWN = double_well(1)


def words(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(matplotlib.text.Text))


@functools.cache
def landscape() -> Landscape:
    return find_landscape(
        exact_field(KNOWN, 3), portrait_of(KNOWN, share=0.9), options=RefinementOptions(degrees=(4,))
    )


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Figure | None]:
    file = tmp_path_factory.mktemp("one") / "quasipotential.json"
    write_landscape(file, landscape())
    stored = read_landscape(file, dynamics=KNOWN.dynamics)
    assert stored is not None
    reference = reference_landscape(
        KNOWN.dynamics, portrait_of(KNOWN), box=KNOWN.domain, reach=1.2, generator=np.random.default_rng(0)
    )
    space = StateSpace(names=("x",), units={"x": "mV", "t": "s"})
    return landscape_figures(
        space,
        degrees=as_table("degrees", []), escape=as_table("escape", []), landscape=stored, reference=reference,
    )  # fmt: skip


def test_the_errors_are_a_curve_too(figures: dict[str, Figure | None]) -> None:
    figure = figures["landscape_errors"]
    assert figure is not None and figures["escape"] is None and "landscape_published" not in figures
    left, right = figure.axes
    assert len(left.lines) == 2 and len(right.lines) == 1
    assert np.nanmax(right.lines[0].get_ydata()) < 1e-4
    text = words(figure)
    assert "characteristics" in text and "local formulas" in text and "$x$ (mV)" in text


def test_the_density_is_a_curve_over_a_histogram() -> None:
    potential = landscape().global_quasipotential
    assert potential is not None
    fine, coarse = (SampledPotential.of(potential, KNOWN.domain, cells=cells) for cells in (400, 200))
    found = fine.density(coarse, coarse.lowest_possible(KNOWN.dynamics), intensity=0.1)
    whole = found.marginal()
    samples = np.random.default_rng(0).normal(-1, 0.1, (1, 4, 200))
    smooth = StationaryDensity((0,), 0.1, whole.x1, whole.x2, np.exp(-(whole.x1[None] ** 2)))
    smooth = replace(smooth, comparison=smooth.compare(samples))
    figure = plot_invariant_distribution([whole, smooth], states=["x"], units=["mV"])
    assert len(figure.axes) == 2
    text = words(figure)
    for label in ("density (per mV)", "$x$ (mV)", "total variation", "a long simulation", "hatched: at most"):
        assert label in text


def test_the_components_of_a_landscape_of_one_state_are_curves() -> None:
    potential = landscape().global_quasipotential
    assert potential is not None
    fields = _project_landscape(potential, domain=KNOWN.domain, trajectories=(), resolution=41)
    assert fields.quasipotential is not None and fields.quasipotential.shape == (1, 41)
    figure = plot_components(fields, states=["x"], units=["mV"], domain=KNOWN.domain)
    assert figure is not None
    assert [axes.get_title(loc="left")[:3] for axes in figure.axes] == ["(a)", "(b)"]
