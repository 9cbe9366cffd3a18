from __future__ import annotations

import matplotlib
import matplotlib.text
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from siq.report.plots.landscape import plot_degrees, plot_error_maps, plot_escape, plot_landscape
from siq.report.plots.landscape_curves import power_of_ten
from siq.report.plots.saving import save_figure

X, Y = np.linspace(-2, 2, 41), np.linspace(-1.5, 1.5, 31)
NO_EQUILIBRIA = pd.DataFrame(columns=["kind", "x", "y", "label"])
EQUILIBRIA = pd.DataFrame(
    [("attractor", -1, 0, "A1"), ("attractor", 1, 0, "A2"), ("saddle", 0, 0, ""), ("repeller", 1.2, 1, "")],
    columns=["kind", "x", "y", "label"],
)
LEG = np.column_stack([np.linspace(-1, 0, 9), np.zeros(9)])


def words(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(matplotlib.text.Text))


def archetype() -> np.ndarray:
    """U of the paper's system in two states, known below 1.6 alone; shape ``(nx, ny)``."""
    values = (X[:, None] ** 2 - 1) ** 2 + Y[None, :] ** 2
    return np.where(values < 1.6, values, np.nan)


def landscape(values: np.ndarray | None = None, **options: object) -> Figure:
    settings = {
        "names": ("x", "omega_0"), "units": ("mV", "1"), "energy_unit": "", "equilibria": EQUILIBRIA,
        "paths": [(LEG, -LEG[::-1]), (-LEG, LEG[::-1])], "level": 1.2,
    } | options  # fmt: skip
    axes_values = settings.pop("axes_values", (X, Y))
    return plot_landscape(axes_values, archetype() if values is None else values, **settings)  # type: ignore[arg-type]


def test_a_landscape_has_its_equilibria_its_paths_and_a_legend_outside() -> None:
    figure = landscape()
    axes, bar = figure.axes
    solid = [line for line in axes.lines if line.get_linestyle() == "-" and len(line.get_xdata()) > 1]
    dashed = [line for line in axes.lines if line.get_linestyle() == "--" and len(line.get_xdata()) > 1]
    assert len(solid) == len(dashed) == 2
    np.testing.assert_array_equal(solid[0].get_xdata(), LEG[:, 0])
    np.testing.assert_array_equal(dashed[0].get_xdata(), -LEG[::-1, 0])
    marks = {line.get_marker() for line in axes.lines if len(line.get_xdata()) == 1}
    assert marks == {"o", "x"}
    hollow = [line for line in axes.lines if line.get_markerfacecolor() == "none"]
    assert [line.get_xdata()[0] for line in hollow] == [1.2]
    text = words(figure)
    for label in ("A1", "A2", "$x$ (mV)", r"$\omega_{0}$ (dimensionless)", "$U$ (in the unit of ε)"):
        assert label in text
    for label in ("U$ is not known", "attractor", "saddle", "repeller", "uphill", "downhill"):
        assert label in text
    (legend,) = figure.legends
    assert legend.get_window_extent().y1 <= axes.get_window_extent().y0
    assert legend.get_window_extent().x0 >= 0 and legend.get_window_extent().x1 <= figure.bbox.width
    assert bar.get_ylabel() == "$U$ (in the unit of ε)"


def test_names_of_what_is_not_there_do_not_stand_in_the_legend() -> None:
    values = np.nan_to_num(archetype(), nan=2.0)
    figure = landscape(values, equilibria=NO_EQUILIBRIA, paths=[], level=None)
    assert not figure.legends
    some = landscape(values, equilibria=EQUILIBRIA[:1], paths=[(LEG, np.zeros((0, 2)))])
    text = words(some)
    assert "not known" not in text and "downhill" not in text and "saddle" not in text
    assert "attractor" in text and "uphill" in text


@pytest.mark.parametrize(("level", "top"), [(1.2, 1.2), (0.5, 0.5), (None, 1.6)])
def test_levels_are_round_and_end_at_the_top(level: float | None, top: float) -> None:
    filled = landscape(level=level).axes[0].collections[0]
    assert filled.levels[0] == 0
    assert top - 1e-9 <= filled.levels[-1] <= 1.2 * top
    assert filled.extend == ("max" if filled.levels[-1] < np.nanmax(archetype()) else "neither")
    np.testing.assert_allclose(np.diff(filled.levels), filled.levels[1])


def test_a_bottom_that_is_zero_to_rounding_has_no_level_below_it() -> None:
    values = archetype() - 1e-7
    filled = landscape(values).axes[0].collections[0]
    assert filled.levels[0] == 0
    # What lies below counts as the bottom, and not as unknown.
    assert np.asarray(filled.cvalues).min() > 0
    assert filled.get_paths()[0].contains_point((-1.0, 0.0))


def test_small_units_are_written_once_at_the_axis() -> None:
    axes_values = (1e-2 * X, 1e-3 * Y)
    small = EQUILIBRIA.assign(x=1e-2 * EQUILIBRIA["x"], y=1e-3 * EQUILIBRIA["y"])
    figure = landscape(
        1e-8 * archetype(), axes_values=axes_values, equilibria=small, paths=[], level=1.2e-8,
        units=("1", "m"), energy_unit="J",
    )  # fmt: skip
    axes, bar = figure.axes
    assert axes.get_xlabel() == "$x$ ($10^{-2}$)"
    assert axes.get_ylabel() == r"$\omega_{0}$ ($10^{-3}$ m)"
    assert bar.get_ylabel() == "$U$ ($10^{-8}$ J)"
    ticks = [text.get_text() for text in [*axes.get_xticklabels(), *bar.get_yticklabels()]]
    assert {"−1", "0", "1", "0.2", "1.2"} <= set(ticks)
    assert all(len(tick) <= 5 for tick in ticks)
    unnamed = landscape(1e-8 * archetype(), axes_values=axes_values, equilibria=small, paths=[], level=None)
    assert unnamed.axes[1].get_ylabel() == "$U$ ($10^{-8}$, in the unit of ε)"


@pytest.mark.parametrize(
    ("largest", "power"),
    [(0.0, 0), (1.0, 0), (0.2, 0), (0.02, -2), (1.2e-8, -8), (9999.0, 0), (2e4, 4), (np.inf, 0), (np.nan, 0)],
)
def test_powers_of_ten_are_left_out_where_numbers_are_not_handy(largest: float, power: int) -> None:
    assert power_of_ten(largest) == power


def test_only_what_is_known_is_shown_with_the_equilibria_around_it() -> None:
    values = archetype()
    values[X > -0.2] = np.nan  # one well
    low, high = landscape(values, equilibria=EQUILIBRIA[:1], paths=[]).axes[0].get_xlim()
    assert -2 <= low < -1.4 and -0.3 < high < 0
    low, high = landscape(values, paths=[]).axes[0].get_xlim()
    assert 1.2 < high < 1.5


def test_a_landscape_that_is_known_nowhere_is_told_in_words() -> None:
    assert "known nowhere" in words(landscape(np.full((41, 31), np.nan)))
    flat = landscape(np.zeros((41, 31)))
    assert len(flat.axes) == 2


def error_maps() -> dict[str, np.ndarray]:
    exact = archetype()
    worse = exact + 0.01 * np.sin(3 * X)[:, None]
    worse[:10] = np.nan
    return {
        "characteristics": exact, "mesh": 1.001 * exact, "networks": worse,
        "regression": np.full_like(exact, np.nan), "local formulas": exact.copy(),
    }  # fmt: skip


def draw_maps(maps: dict[str, np.ndarray], **options: object) -> Figure:
    settings = {"names": ("P", "Q"), "units": ("1", "1"), "energy_unit": ""} | options
    return plot_error_maps((X, Y), maps, **settings)  # type: ignore[arg-type]


def test_error_maps_have_two_rows_with_one_scale_each() -> None:
    figure = draw_maps(error_maps())
    assert figure.get_figwidth() == 7
    panels = figure.axes[:10]
    assert len(figure.axes) == 10 + 2
    assert [axes.get_title() for axes in panels[:5]] == list(error_maps())
    norms = {id(panels[k].collections[0].norm) for k in (0, 1, 2, 4)}
    assert len(norms) == 1
    images = {k: panels[5 + k].collections[0] for k in (1, 2, 4)}
    assert len({(image.norm.vmin, image.norm.vmax) for image in images.values()}) == 1
    difference = np.asarray(images[1].get_array()).reshape(31, 41)
    highest = np.nanmax(archetype())
    expected = 1e-3 * archetype().T / highest
    np.testing.assert_allclose(difference, np.maximum(expected, images[1].norm.vmin), rtol=1e-9)
    assert images[1].norm.vmax == pytest.approx(0.01 / highest, rel=0.05)
    # The lowest colour stands for no difference at all.
    assert np.nanmax(images[4].get_array()) == pytest.approx(images[4].norm.vmin)


def test_error_maps_tell_the_error_and_what_is_not_known() -> None:
    figure = draw_maps(error_maps())
    text = words(figure)
    shown = archetype()[10:]
    size = np.sqrt(np.nanmean(((0.01 * np.sin(3 * X[10:]))[:, None] + 0 * shown) ** 2)) / np.nanmax(
        archetype()
    )
    mantissa, exponent = f"{size:.1e}".split("e")
    assert rf"{mantissa} \times 10^{{{int(exponent)}}}" in text
    share = np.isfinite(shown).sum() / np.isfinite(archetype()).sum()
    assert f"at {100 * share:.3g} % of the points" in text
    assert text.count("not known") == 2 + 1  # both panels of one source, and the legend
    assert "difference from\ncharacteristics" in text
    assert text.count("at ") == 1
    labels = [axes.get_xlabel() for axes in figure.axes[:10] if axes.xaxis.label.get_visible()]
    assert labels.count("$P$ (dimensionless)") == 5


def test_a_reference_alone_has_one_row() -> None:
    figure = draw_maps({"characteristics": archetype()})
    assert len(figure.axes) == 1 + 1


def test_nothing_to_compare_is_told_in_words() -> None:
    assert "no U to compare" in words(draw_maps({}))
    unknown = {"mesh": np.full((41, 31), np.nan), "networks": archetype()}
    assert "U by mesh is known nowhere" in words(draw_maps(unknown))


def degrees(runs: int) -> pd.DataFrame:
    rows = [
        (run, name, degree, (degree + 1) * (degree + 2) // 2 - 3, (run + 1) * factor * 10.0**-degree,
         1 - 0.1 / degree, degree == (8 if run % 3 else 6))
        for run in range(runs) for name, factor in (("A1", 1.0), ("A2", 3.0)) for degree in (4, 6, 8)
    ]  # fmt: skip
    return pd.DataFrame(
        rows, columns=["run", "attractor", "degree", "terms", "residual", "covered", "chosen"]
    )


def test_every_run_is_a_thin_line_and_every_attractor_a_thick_one() -> None:
    figure = plot_degrees(degrees(5))
    left, right = figure.axes
    assert left.get_yscale() == "log" and right.get_yscale() == "linear"
    for axes, column in ((left, "residual"), (right, "covered")):
        thin = [line for line in axes.lines if line.get_linewidth() == 0.4]
        thick = [line for line in axes.lines if line.get_linewidth() == 1.6]
        rings = [line for line in axes.lines if line.get_markersize() == 8]
        assert len(thin) == 10 and len(thick) == 2 and len(rings) == 2
        table = degrees(5)
        expected = table[table["attractor"] == "A1"].groupby("terms")[column].median()
        np.testing.assert_allclose(thick[0].get_xydata(), np.column_stack([expected.index, expected]))
        # Of five runs three chose degree 8, which has 42 terms.
        np.testing.assert_allclose(rings[0].get_xydata(), [[42, expected[42]]])
    text = words(figure)
    for label in ("A1", "A2", "number of terms", "degree", "one run (5 in all)", "median of 5 runs"):
        assert label in text


def test_one_run_has_no_median_and_no_thin_lines() -> None:
    figure = plot_degrees(degrees(1))
    assert len([line for line in figure.axes[0].lines if line.get_linewidth() == 0.4]) == 0
    text = words(figure)
    assert "median of" not in text.replace("(median over", "") and "chosen" in text


def test_degrees_that_most_runs_did_not_finish_have_no_median() -> None:
    table = degrees(5)
    table = table[(table["degree"] < 8) | (table["run"] == 1)]
    thick = next(line for line in plot_degrees(table).axes[0].lines if line.get_linewidth() == 1.6)
    assert thick.get_xdata().tolist() == [12, 25]


def test_degrees_without_any_residual_are_told_in_words() -> None:
    assert "No formula was tried" in words(plot_degrees(degrees(0)))
    assert "no residual is known" in words(plot_degrees(degrees(2).assign(residual=np.nan)))
    assert "no residual is known" in words(plot_degrees(degrees(2).assign(residual=0.0)))


def escapes() -> pd.DataFrame:
    rows = []
    for name, barrier in (("A1 to A2", 1.05e-8), ("A2 to A1", 8.2e-9)):
        for number in (4.0, 6.0, 8.0):
            intensity = 1e-8 / number
            time = 5e3 * np.exp(barrier / intensity)
            seen = number < 7
            rows.append((name, intensity, time, 1.1 * time if seen else np.nan, 0.05 * time, 100, ""))
    columns = ["transition", "intensity", "predicted", "simulated", "simulated_error", "escapes", "note"]
    return pd.DataFrame(rows, columns=columns)


def test_the_law_is_a_straight_line_and_simulations_are_points() -> None:
    figure = plot_escape(escapes(), time_unit="s")
    (axes,) = figure.axes
    assert axes.get_yscale() == "log"
    laws = [line for line in axes.lines if line.get_linestyle() in ("-", "--") and len(line.get_xdata()) == 3]
    assert len(laws) == 2
    inverse, times = laws[0].get_data()
    np.testing.assert_allclose(inverse, [4e8, 6e8, 8e8])
    np.testing.assert_allclose(np.diff(np.log(times)) / np.diff(inverse), 1.05e-8)
    assert len(axes.containers) == 2  # one series of bars a transition
    points, _, (bars,) = axes.containers[0]
    assert len(points.get_xdata()) == 2
    segment = bars.get_segments()[0]
    assert segment[1, 1] - segment[0, 1] == pytest.approx(0.1 * times[0])
    text = words(figure)
    for label in ("A1 to A2", "A2 to A1", "2 of 6 times without a simulation", "mean escape time (s)"):
        assert label in text
    assert axes.get_xlabel() == r"$1/\varepsilon$ ($10^{8}$)"


def test_an_error_larger_than_the_mean_leaves_the_axis_its_range() -> None:
    table = escapes().assign(simulated_error=np.inf)
    low, high = plot_escape(table.fillna({"simulated": 1e5})).axes[0].get_ylim()
    assert low > 1e4 and high < 1e12
    table = escapes()
    table["simulated_error"] = 3 * table["simulated"]
    assert plot_escape(table, energy_unit="J").axes[0].get_ylim()[0] > 1e4


def test_a_law_without_any_simulation_is_drawn_and_the_missing_are_counted() -> None:
    for nothing in (np.nan, np.inf):
        text = words(plot_escape(escapes().assign(simulated=nothing, simulated_error=nothing)))
        assert "6 of 6 times without a simulation" in text
    assert "time units" in text


def test_escapes_that_are_not_there_are_told_in_words() -> None:
    assert "No escape time" in words(plot_escape(pd.DataFrame()))
    assert "No escape time" in words(plot_escape(escapes()[:0]))
    assert "No escape time" in words(plot_escape(escapes().assign(predicted=np.nan)))


def test_a_landscape_is_the_same_files_every_time(tmp_path) -> None:
    first, second = (
        [path.read_bytes() for path in save_figure(landscape(), tmp_path / "u")] for _ in range(2)
    )
    assert first == second


def test_maps_are_no_megabyte_of_vector_graphics(tmp_path) -> None:
    assert all(path.stat().st_size < 1e6 for path in save_figure(draw_maps(error_maps()), tmp_path / "maps"))
