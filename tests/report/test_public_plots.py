"""The plots that people call: what they draw, on whose axes, and how large their letters are."""

from __future__ import annotations

import functools
import importlib
import sys
from dataclasses import replace

import matplotlib.text
import numpy as np
import pytest
from known_systems import double_well, exact_field, portrait_of
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import siq
from siq.numerics.integration import runge_kutta_step
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.landscape_assembly import find_landscape
from siq.quasipotential.landscape_files import landscape_data, landscape_from_data
from siq.quasipotential.refinement import RefinementOptions
from siq.quasipotential.transitions import Transition, _barrier_uncertainty
from siq.report.plots import prediction
from siq.report.plots.quasipotential import _on_plane, quasipotential_figure
from siq.report.plots.wells import _joined
from siq.report.summary import LandscapeSummary, summarise


@functools.cache
def landscape(dimension: int) -> Landscape:
    known = double_well(dimension)
    found = find_landscape(
        exact_field(known, 3), portrait_of(known, 300, share=0.8), options=RefinementOptions(degrees=(4,))
    )
    return found.in_units(("um",) * dimension, time="s")


def recordings(dimension: int) -> siq.Recordings:
    """Ring-downs of the known system, by small steps."""
    dynamics = double_well(dimension).dynamics
    x = np.random.default_rng(0).uniform(-1, 1, (40, dimension))
    path = [x]
    for _ in range(60):
        for _ in range(10):
            x = x + 0.005 * dynamics.drift(x + 0.0025 * dynamics.drift(x))
        path.append(x)
    times = 0.05 * np.arange(61)
    return siq.Recordings.from_arrays(
        times, np.stack(path, axis=1), names=list(dynamics.states), units=["um"] * dimension, time_unit="s"
    )


def words(axes: Axes) -> str:
    return "\n".join(text.get_text() for text in axes.figure.findobj(matplotlib.text.Text))


@pytest.mark.parametrize("dimension", [1, 2, 3])
@pytest.mark.parametrize("name", ["plot_quasipotential", "plot_wells", "plot_paths", "plot_barriers"])
def test_every_plot_draws_on_the_axes_that_it_is_given(
    name: str, dimension: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)  # whose state is left alone
    axes = Figure().add_subplot()
    assert getattr(siq, name)(landscape(dimension), ax=axes) is axes
    assert axes.has_data()
    text = words(axes)
    assert "µm²/s" in text or (name == "plot_wells" and dimension > 1)
    assert "A" in text and "B" in text


def test_the_states_of_the_plane_and_the_view_can_be_chosen() -> None:
    axes = siq.plot_quasipotential(landscape(3), states=("x", "y"), view="section", ax=Figure().add_subplot())
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("$x$ (µm)", "$y$ (µm)")
    assert axes.get_title(loc="left").startswith("Section at z = ")
    with pytest.raises(ValueError, match="name two of x, y, z"):
        siq.plot_quasipotential(landscape(3), states=("x", "w"), ax=Figure().add_subplot())
    with pytest.raises(ValueError, match="'projection' or 'section'"):
        _on_plane(summarise(landscape(3)), (0, 1), "shadow")  # type: ignore[arg-type]


def test_a_projection_keeps_wells_and_passes_at_their_heights() -> None:
    """The lowest U over z is U of the double well of x and y, since z only adds to it."""
    shown = summarise(landscape(3))
    values, _ = _on_plane(shown, (0, 1))
    known = np.isfinite(values)
    assert known.mean() > 0.1
    x, y = (shown.along(place, len(values)) for place in (0, 1))
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    points = np.column_stack([grid, np.zeros(len(grid))])
    at_zero = shown.potential(points).reshape(values.shape)
    both = known & np.isfinite(at_zero)
    # Never above the section through any one z, and at most as far below it as V falls beside z = 0.
    assert (values[both] <= at_zero[both] + 1e-12).all()
    fine = np.linspace(*shown.box[2], 81)
    columns = np.repeat(grid[both.ravel()][::40], 81, axis=0)
    every = shown.potential(np.column_stack([columns, np.tile(fine, len(columns) // 81)])).reshape(-1, 81)
    lowest = np.nanmin(every, axis=1)
    np.testing.assert_allclose(values[both][::40], lowest, atol=0.01 * np.nanmax(at_zero))


def test_the_band_of_one_state_is_that_of_the_barrier() -> None:
    """Standard error of U at the saddle: by the curve, and by the path of least action."""
    found, field = landscape(1), exact_field(double_well(1), 3)
    half = np.random.default_rng(0).normal(0, 0.01, (len(field.support), len(field.support)))
    field = replace(field, covariance=half @ half.T)
    shown = replace(summarise(found), dynamics=field.dynamics)
    deepest = int(np.argmin(found.heights))
    way = next(one for one in found.transitions if one.start == deepest)
    assert way.path is not None
    x = shown.along(0, 4001)
    band = shown.standard_error(x)
    assert band is not None
    top = np.interp(float(way.saddle.position[0]), x, band)
    assert top == pytest.approx(_barrier_uncertainty(way.path, field)[0], rel=1e-3)
    assert np.interp(float(found.attractors[deepest].position[0]), x, band) < 1e-3 * top
    assert summarise(landscape(2)).standard_error(x) is None


def test_the_picture_is_the_same_from_a_file() -> None:
    data = landscape_data(landscape(2))
    # Points of a fit are rounded in the file.
    read = replace(landscape_from_data(data, landscape(2).dynamics), wells=landscape(2).wells)
    from_file = summarise(read)
    shown = summarise(landscape(2))
    assert from_file.energy_unit == shown.energy_unit == "um^2/s"
    np.testing.assert_array_equal(from_file.box, shown.box)
    x = landscape(2).wells[0].points[:20]
    np.testing.assert_array_equal(from_file.potential(x), landscape(2).quasipotential(x))


def test_one_formula_is_drawn_where_states_were_recorded() -> None:
    known = double_well(2)
    formula = SymbolicDecomposition(known.dynamics.symbols, known.potential, (), known.dynamics.equations)
    points = np.random.default_rng(0).uniform(*known.domain.T, (500, 2))
    without = replace(landscape(2), wells=(None,) * len(landscape(2).wells))
    shown = summarise(without, points, formula=formula)
    assert np.isfinite(shown.potential(points)).all()
    assert np.isnan(shown.potential(points + 10 * np.ptp(points, axis=0))).all()
    assert quasipotential_figure(shown) is not None
    nothing = summarise(without, points)
    assert quasipotential_figure(nothing) is None


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_the_first_picture_can_be_read_on_a_phone(dimension: int) -> None:
    """Letters of nine pixels where the page leaves a figure 368, as on a phone of 400."""
    figure = quasipotential_figure(summarise(landscape(dimension)))
    assert figure is not None
    sizes = [text.get_fontsize() for text in figure.findobj(matplotlib.text.Text) if text.get_text().strip()]
    assert min(sizes) * 368 / (72 * figure.get_figwidth()) >= 9


def of_heights(heights: list[float], passes: dict[tuple[int, int], float]) -> LandscapeSummary:
    known = summarise(landscape(1))
    ways = [
        Transition(*pair, known.ways[0].saddle, None, top - heights[pair[0]], standard_error=0.01)
        for (left, right), top in passes.items()
        for pair in ((left, right), (right, left))
    ]
    wells = tuple(
        replace(
            known.wells[0], label="ABCDEF"[k], position=np.array([float(k)]), height=u,
            depth=min(way.barrier for way in ways if way.start == k), depth_error=0.01,
        )
        for k, u in enumerate(heights)
    )  # fmt: skip
    return replace(known, wells=wells, ways=tuple(ways), equilibria=())


def test_wells_join_from_the_lowest_pass_to_the_highest_and_no_lines_cross() -> None:
    six = of_heights(
        [0.0, 0.3, 0.1, 0.5, 0.2, 0.4], {(0, 3): 1.0, (1, 2): 0.8, (2, 3): 1.5, (4, 5): 0.9, (5, 0): 2.0}
    )
    tree, _ = _joined(six)
    assert [height for *_, height in tree] == pytest.approx([0.8, 0.9, 1.0, 1.5, 2.0])
    assert [set(group) for group in tree[3][:2]] == [{0, 3}, {1, 2}]
    axes = siq.plot_barriers(six, ax=Figure().add_subplot())
    columns = {
        text.get_text()[0]: place
        for place, text in zip(axes.get_xticks(), axes.get_xticklabels(), strict=True)
    }
    assert abs(columns["A"] - columns["D"]) == abs(columns["B"] - columns["C"]) == 1
    assert len(set(columns.values())) == 6


def test_what_is_not_known_is_said_in_a_sentence() -> None:
    lonely = replace(landscape(1), transitions=())
    with pytest.raises(ValueError, match="no barrier of this landscape is known"):
        siq.plot_barriers(lonely, ax=Figure().add_subplot())
    with pytest.raises(ValueError, match="no way out of any well is known"):
        siq.plot_paths(lonely, ax=Figure().add_subplot())
    with pytest.raises(ValueError, match="give recordings of x, y; none are given"):
        siq.plot_residuals(landscape(2), ax=Figure().add_subplot())
    with pytest.raises(ValueError, match="the recordings have the states x, and the landscape has x, y"):
        siq.plot_quasipotential(landscape(2), recordings=recordings(1), ax=Figure().add_subplot())


def test_residuals_of_the_right_field_lie_within_the_band_and_a_missing_term_beyond() -> None:
    known, rng = double_well(1), np.random.default_rng(3)
    x = rng.uniform(-1, 1, (200, 1))
    path = [x]
    for _ in range(400):
        x = x + 0.01 * known.dynamics.drift(x) + 0.03 * rng.normal(size=x.shape)
        path.append(x)
    noisy = siq.Recordings.from_arrays(0.01 * np.arange(401), np.stack(path, axis=1), names=["x"])
    right, _ = prediction._binned_residuals(known.dynamics, noisy, 0)
    far = np.abs(right["mean"]) / right["standard_error"]
    assert (far < 2).mean() > 0.75 and far.max() < 5
    missing = known.dynamics.of(known.dynamics.symbols, [known.dynamics.formulas[0] + 0.5])
    wrong, _ = prediction._binned_residuals(missing, noisy, 0)
    mean, error = wrong["mean"], wrong["standard_error"]
    assert (np.abs(mean) > 2 * error).mean() > 0.7
    assert np.average(mean, weights=error**-2) == pytest.approx(-0.5, abs=0.05)


def test_where_rounding_alone_is_left_there_is_no_figure_and_no_band() -> None:
    known, t = double_well(1), 0.05 * np.arange(41)
    x = np.random.default_rng(0).uniform(-1, 1, (1, 30))
    path = [x]
    for _ in range(40):
        for _ in range(100):
            x = runge_kutta_step(known.dynamics.drift_of_components, x, 5e-4)
        path.append(x)
    quiet = siq.Recordings.from_arrays(t, np.concatenate(path).T[:, :, None], names=["x"], units=["um"])
    assert prediction.residuals_figure(known.dynamics, quiet, units=["um"]) is None
    axes = siq.plot_residuals(landscape(1), quiet, ax=Figure().add_subplot())
    assert len(axes.collections) == (0 if "no noise" in axes.get_title(loc="left") else 1)
    shake = 1e-3 * np.random.default_rng(1).normal(size=quiet.values.shape)
    shaken = replace(quiet, values=quiet.values + shake)
    figure = prediction.residuals_figure(known.dynamics, shaken, units=["um"], time_unit="s")
    assert figure is not None and "µm/s" in figure.axes[0].get_ylabel()


def test_residuals_carry_the_rate_of_their_state() -> None:
    axes = siq.plot_residuals(landscape(2), recordings(2), state="y", ax=Figure().add_subplot())
    assert axes.get_xlabel() == "$y$ (µm)" and "µm/s" in axes.get_ylabel()
    with pytest.raises(ValueError, match="there is no state w"):
        siq.plot_residuals(landscape(2), recordings(2), state="w", ax=Figure().add_subplot())


def test_without_matplotlib_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = {name: sys.modules.pop(name) for name in list(sys.modules) if name.startswith("siq.report.plots")}
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for name in [name for name in sys.modules if name.startswith("matplotlib.")]:
        monkeypatch.setitem(sys.modules, name, None)
    try:
        with pytest.raises(siq.MissingExtra, match=r"'matplotlib' is not installed.*\[plots\]"):
            importlib.import_module("siq.report.plots.quasipotential")
    finally:
        sys.modules.update(kept)
