from __future__ import annotations

import matplotlib
import matplotlib.text
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from siq.report.plots.style import power_of_ten, save_figure
from workflow.figures.comparison import plot_degrees, plot_error_maps, plot_escape

X, Y = np.linspace(-2, 2, 41), np.linspace(-1.5, 1.5, 31)


def words(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(matplotlib.text.Text))


def archetype() -> np.ndarray:
    """U of the paper's system in two states, known below 1.6 alone; shape ``(nx, ny)``."""
    values = (X[:, None] ** 2 - 1) ** 2 + Y[None, :] ** 2
    return np.where(values < 1.6, values, np.nan)


@pytest.mark.parametrize(
    ("largest", "power"),
    [(0.0, 0), (1.0, 0), (0.2, 0), (0.02, -2), (1.2e-8, -8), (9999.0, 0), (2e4, 4), (np.inf, 0), (np.nan, 0)],
)
def test_powers_of_ten_are_left_out_where_numbers_are_not_handy(largest: float, power: int) -> None:
    assert power_of_ten(largest) == power


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


def test_error_maps_have_a_row_for_each_source_and_one_scale_a_column() -> None:
    figure = draw_maps(error_maps())
    names = [name for name in error_maps() if name != "regression"]  # of which nothing is known
    panels = np.array(figure.axes[:8]).reshape(4, 2)
    assert len(figure.axes) == 8 + 2
    assert [axes.get_title(loc="left") for axes in panels[:, 0]] == names
    assert len({id(axes.collections[0].norm) for axes in panels[:, 0]}) == 1
    images = [axes.collections[0] for axes in panels[1:, 1]]
    assert len({(image.norm.vmin, image.norm.vmax) for image in images}) == 1
    difference = np.asarray(images[0].get_array()).reshape(31, 41)
    highest = np.nanmax(archetype())
    expected = 1e-3 * archetype().T / highest
    np.testing.assert_allclose(difference, np.maximum(expected, images[0].norm.vmin), rtol=1e-9)
    assert images[0].norm.vmax == pytest.approx(0.01 / highest, rel=0.05)
    # The lowest colour stands for no difference at all.
    assert np.nanmax(images[2].get_array()) == pytest.approx(images[2].norm.vmin)


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
    assert f"at {100 * share:.3g} %" in text
    assert text.count("not known") == 1 and text.count("at ") == 1
    assert "difference\nfrom characteristics" in text
    assert "$P$" in [axes.get_xlabel() for axes in figure.axes[:8]]


def test_with_nothing_to_compare_there_is_no_figure() -> None:
    unknown = {"mesh": np.full((41, 31), np.nan), "networks": archetype()}
    for maps in ({}, {"characteristics": archetype()}, unknown):
        assert draw_maps(maps) is None


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
    for label in ("A", "B", "number of terms", "degree", "each of 5 runs", "their median"):
        assert label in text


def test_one_run_has_no_median_and_no_thin_lines() -> None:
    figure = plot_degrees(degrees(1))
    assert len([line for line in figure.axes[0].lines if line.get_linewidth() == 0.4]) == 0
    text = words(figure)
    assert "their median" not in text and "chosen" in text


def test_degrees_that_most_runs_did_not_finish_have_no_median() -> None:
    table = degrees(5)
    table = table[(table["degree"] < 8) | (table["run"] == 1)]
    thick = next(line for line in plot_degrees(table).axes[0].lines if line.get_linewidth() == 1.6)
    assert thick.get_xdata().tolist() == [12, 25]


def test_degrees_without_any_residual_are_not_drawn() -> None:
    for table in (degrees(0), degrees(2).assign(residual=np.nan), degrees(2).assign(residual=0.0)):
        assert plot_degrees(table) is None


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
    for label in ("A to B", "B to A", "2 of 6 times without a simulation", "mean escape time (s)"):
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


def test_escapes_that_are_not_there_are_not_drawn() -> None:
    for table in (pd.DataFrame(), escapes()[:0], escapes().assign(predicted=np.nan)):
        assert plot_escape(table) is None


def test_maps_are_no_megabyte_of_vector_graphics(tmp_path) -> None:
    assert all(path.stat().st_size < 1e6 for path in save_figure(draw_maps(error_maps()), tmp_path / "maps"))
