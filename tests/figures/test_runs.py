import itertools
from dataclasses import replace

import matplotlib
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from siq.quasipotential.invariant_density import DensityComparison, StationaryDensity
from siq.report.plots.style import mean_and_spread, name_label, save_figure
from workflow.figures.density import plot_invariant_distribution
from workflow.figures.prediction import plot_prediction
from workflow.figures.recorded import ComponentFields, Dataset, plot_components, plot_dataset
from workflow.figures.runs import (
    plot_coefficient_distributions,
    plot_error_distribution,
    plot_inclusion,
    plot_training,
    sorted_terms,
    term_label,
)

EXACT = {
    "U": {"1": 1.0, "x**2": -2.0, "y**2": 1.0, "z**2": 1.0, "x**4": 1.0},
    "g_x": {"y": -1.0, "z": -1.0},
}
TERMS = [
    "*".join(
        name if power == 1 else f"{name}**{power}" for name, power in zip("xyz", powers, strict=True) if power
    )
    or "1"
    for powers in itertools.product(range(6), repeat=3)
    if sum(powers) <= 5
]


def synthetic_coefficients(runs: int, *, known: bool = True, scatter: float = 1e-3) -> pd.DataFrame:
    rng = np.random.default_rng(0)
    rows = [
        (run, "regression", component, term, exact * (1 + scatter * rng.normal()), exact if known else np.nan)
        for run in range(runs)
        for component, formula in EXACT.items()
        for term in TERMS
        for exact in [formula.get(term, 0.0)]
    ]
    return pd.DataFrame(rows, columns=["run", "method", "component", "term", "estimate", "exact"])


def words(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(matplotlib.text.Text))


@pytest.mark.parametrize(("runs", "known"), [(3, True), (50, True), (50, False)])
def test_a_panel_for_each_nontrivial_term_and_one_for_the_others(runs: int, known: bool) -> None:
    table = synthetic_coefficients(runs, known=known)
    table = table[table["run"] != 7]  # a failed run has no rows
    figure = plot_coefficient_distributions(table, method="regression")
    assert len(figure.axes) == 5 + 1
    bars = [sum(patch.get_height() for patch in axes.patches) for axes in figure.axes[:5]]
    assert bars == [runs - (runs > 7)] * 5
    assert "the other 51 terms" in words(figure)


def test_false_terms_are_drawn_and_missing_ones_counted() -> None:
    table = synthetic_coefficients(4)
    table.loc[(table["term"] == "x**2") & (table["run"] == 0), "estimate"] = 0.0
    false = (table["component"] == "U") & (table["term"] == "x*y") & (table["run"] < 2)
    table.loc[false, "estimate"] = [0.02, -0.3]
    figure = plot_coefficient_distributions(table, method="regression")
    panel = next(axes for axes in figure.axes if axes.get_title().startswith("$x^{2}$"))
    assert sum(patch.get_height() for patch in panel.patches) == 3
    assert "zero in 1 run" in words(figure)
    last = figure.axes[-1]
    assert [patch.get_height() for patch in last.patches] == [0.5]
    assert "0.3" in last.texts[0].get_text()
    assert "falsely" in last.get_title()


def test_tiny_scatter_is_drawn_as_deviation() -> None:
    table = synthetic_coefficients(6, scatter=1e-9)
    table = table[table["term"].isin(["x", "x**2"])]
    assert "coefficient + $2$" in words(plot_coefficient_distributions(table, method="regression"))


def test_terms_that_most_runs_use_are_nontrivial_where_nothing_is_known() -> None:
    table = synthetic_coefficients(2, known=False)
    table = table[(table["component"] == "U") & table["term"].isin(TERMS[:12])].assign(estimate=1.0)
    assert len(plot_coefficient_distributions(table, method="regression").axes) == 12 + 1


@pytest.mark.parametrize(("runs", "method"), [(3, "refined"), (1, "regression")])
def test_without_two_runs_there_is_no_distribution(runs: int, method: str) -> None:
    table = synthetic_coefficients(runs)
    assert plot_coefficient_distributions(table, method=method) is None
    assert plot_inclusion(table, method=method) is None
    assert plot_error_distribution(synthetic_errors()[:0]) is None
    one_run = synthetic_errors()[synthetic_errors()["run"] == 0]
    assert plot_error_distribution(one_run) is None


def test_inclusion_collapses_unused_terms_and_outlines_exact_ones() -> None:
    figure = plot_inclusion(synthetic_coefficients(3), method="regression")
    (axes,) = figure.axes
    assert len(axes.get_yticks()) == 7
    assert len(axes.patches) == 5 + 2
    assert "the other 49 terms" in words(figure)


def synthetic_errors() -> pd.DataFrame:
    return pd.DataFrame(
        {
            "run": [0, 1, 2, 0, 1, 2],
            "method": ["regression"] * 3 + ["refined"] * 3,
            "rrmse": [1e-3, 2e-3, np.nan, 1e-7, 2e-7, 0.1],
            "support_correct": [True, False, None, True, True, False],
            "certified": [False, False, None, True, True, False],
            "network_error": 4e-3,
        }
    )


def test_every_measured_run_is_a_dot_and_the_others_are_counted() -> None:
    figure = plot_error_distribution(synthetic_errors(), published=(8.87e-4, 3.48e-4))
    dots = [line for line in figure.axes[0].lines if line.get_marker() in ("o", "^")]
    assert sum(len(line.get_xdata()) for line in dots) == 5
    text = words(figure)
    assert "regression: 1 run without an error" in text
    assert "8.87" in text and "3.48" in text and "not certified" in text


def test_errors_that_nobody_knows_are_not_drawn() -> None:
    assert plot_error_distribution(synthetic_errors().assign(rrmse=np.nan)) is None


def archetype_fields() -> ComponentFields:
    x, y = np.linspace(-2, 2, 21), np.linspace(-1.5, 1.5, 17)
    X, Y = np.meshgrid(x, y)
    U = X**4 - 2 * X**2 + Y**2 + 1
    return ComponentFields(
        x1=x,
        x2=y,
        minus_gradient=np.array([2 * X - 2 * X**3, -Y]),
        circulatory=np.array([-Y, 2 * X**3 - 2 * X]),
        quasipotential=1.01 * U,
        exact_quasipotential=U,
        trajectories=[np.column_stack([np.linspace(-1, 0, 9), np.full(9, level)]) for level in range(5)],
    )


def test_both_landscapes_share_one_colour_scale() -> None:
    domain = np.array([[-2.0, 2.0], [-1.5, 1.5], [-1.5, 1.5]])
    figure = plot_components(archetype_fields(), states="xyz", units=("mV", "1", "1"), domain=domain)
    exact, identified = (axes.collections[0] for axes in figure.axes[3:5])
    assert list(exact.norm.boundaries) == list(identified.norm.boundaries)
    assert figure.axes[0].get_xlabel() == "$x$ (mV)"


def test_a_panel_without_data_is_not_there() -> None:
    domain = np.array([[-2.0, 2.0], [-1.5, 1.5]])
    part = replace(archetype_fields(), exact_quasipotential=None, circulatory=np.zeros((2, 17, 21)))
    figure = plot_components(part, states="xy", units="11", domain=domain)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert [title for title in titles if title] == [
        "(a) 5 recordings, • to ×", r"(b) $-\nabla V$, identified", "(c) $U$, identified",
    ]  # fmt: skip
    nothing = ComponentFields(x1=part.x1, x2=part.x2, trajectories=part.trajectories)
    assert plot_components(nothing, states="xy", units="11", domain=domain) is None


def test_one_state_gives_curves() -> None:
    x = np.linspace(-2, 2, 11)
    fields = ComponentFields(
        x1=x,
        x2=np.zeros(1),
        circulatory=np.ones((1, 1, 11)),
        quasipotential=(x**2)[None],
        exact_quasipotential=(1.5 * x**2)[None],
        trajectories=[np.ones((4, 1))],
    )
    figure = plot_components(fields, states=["x"], units=["V"], domain=np.array([[-2, 2]]))
    np.testing.assert_allclose(figure.axes[1].lines[0].get_ydata(), x**2 / 2)
    assert figure.axes[3].get_ylim() == figure.axes[4].get_ylim()


def test_training_has_a_line_for_every_run_and_the_median() -> None:
    steps = np.arange(0, 500, 100)
    table = pd.concat(
        pd.DataFrame({"run": run, "step": steps, "training_loss": (run + 1.0) / (1 + steps)})
        for run in range(3)
    ).assign(held_out_loss=np.nan, dynamics=1.0, orthogonality=1.0, learning_rate=1e-3)
    figure = plot_training(table)
    panel = next(axes for axes in figure.axes if axes.get_title(loc="left") == "on training pairs")
    assert len(panel.lines) == 3 + 1
    np.testing.assert_allclose(panel.lines[-1].get_ydata(), 2 / (1 + steps[1:]))
    assert "held-out" not in words(figure) and len(figure.axes) == 4
    assert plot_training(table[:0]) is None


def invariant_panel(intensity: float, *, simulated: bool = True) -> StationaryDensity:
    x, y = np.linspace(-2, 2, 41), np.linspace(-1.5, 1.5, 31)
    values = np.exp(-((x[None, :] ** 2 - 1) ** 2 + y[:, None] ** 2) / intensity)
    edges = [np.linspace(axis[0], axis[-1], 9) for axis in (x, y)]
    comparison = DensityComparison(0.0312, 0.028, 0.0, *edges, histogram=np.ones((8, 8)))
    return StationaryDensity((0, 2), intensity, x, y, values, 0.5236, comparison if simulated else None)


def test_the_invariant_distribution_has_a_row_for_each_intensity() -> None:
    panels = [invariant_panel(0.05), invariant_panel(0.1), invariant_panel(0.2, simulated=False)]
    figure = plot_invariant_distribution(panels, states="xyz", units=("mV", "1", "K"))
    assert len(figure.axes) == 5 + 3  # two of three were simulated, and a colour bar for each row
    text = words(figure)
    for label in ("varepsilon$ = $0.05$", "0.5236", "$x$ (mV)", "$z$ (K)", "(per mV per K)"):
        assert label in text
    assert "0.031\n(sampling alone: 0.028)" in text and "not simulated" not in text
    lines = figure.axes[1].collections[1].levels
    assert lines == pytest.approx(np.nanmax(panels[0].values) * np.array([0.1, 0.5, 0.9]))


def test_without_a_simulation_there_is_one_panel() -> None:
    figure = plot_invariant_distribution(
        [invariant_panel(0.1, simulated=False)], states="xyz", units=("m", "1", "m")
    )
    assert len(figure.axes) == 1 + 1
    assert "(per m²)" in words(figure)
    assert plot_invariant_distribution([], states="xy", units="11") is None


def test_where_the_density_is_not_known_the_plane_is_hatched() -> None:
    panel = invariant_panel(1e-9)
    hidden = np.where(panel.x1[None, :] > 0.5, np.nan, panel.values)
    partly = replace(panel, values=hidden, unknown=0.0321)
    figure = plot_invariant_distribution([partly], states="xyz", units=("1", "1", "1"))
    assert [len(axes.patches) for axes in figure.axes[:2]] == [1, 1]
    assert figure.axes[0].get_xlim()[1] < 1
    text = words(figure)
    assert "hatched: at most 3.2 %" in text and "10^{-9}" in text
    whole = plot_invariant_distribution([panel], states="xyz", units=("1", "1", "1"))
    assert len(whole.axes[0].patches) == 0 and "hatched" not in words(whole)


def test_the_dataset_shows_what_the_regression_sees() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (500, 2))
    path = np.column_stack([np.linspace(0, 1, 9), np.zeros(9)])
    grid = np.linspace(-1, 1, 21)
    potential = grid[None, :] ** 2 + grid[:, None] ** 2
    below = (points**2).sum(axis=1) < 0.25
    data = Dataset([path, path], [path], points, below, (grid, grid), potential, 0.25)
    figure = plot_dataset(data, states="xy", units=("mV", "1"))
    left, middle, right = figure.axes
    assert len(left.lines) == 2 * 2 + 1
    assert [len(axes.lines[0].get_xdata()) for axes in (middle, right)] == [500, below.sum()]
    assert [len(axes.collections) for axes in (left, middle, right)] == [0, 1, 1]
    text = words(figure)
    for label in (
        "2 recordings;\ndashed: no noise",
        "500 pairs",
        f"{100 * below.mean():.3g} %",
        "(mV)",
    ):
        assert label in text
    unknown = plot_dataset(Dataset([path], [], points), states="xyz", units=("1", "1", "1"))
    assert len(unknown.axes) == 2 and "dashed" not in words(unknown)
    one_state = plot_dataset(
        Dataset([path[:, :1]], [path[:, :1]], points[:, :1], below), states="x", units=("mV",)
    )
    left, middle, right = one_state.axes
    assert [sum(bar.get_height() for bar in axes.patches) for axes in (middle, right)] == [500, below.sum()]
    assert "$x$ (mV)" in words(one_state) and "dashed: no noise" in words(one_state)


def test_predictions_lie_beside_the_observed_and_their_errors_on_a_logarithmic_axis() -> None:
    paths = [
        np.column_stack([np.linspace(-1, level, 9), np.full(9, level), np.zeros(9)]) for level in range(8)
    ]
    errors = pd.DataFrame(
        {
            "method": ["regression"] * 5 + ["refined"] * 3,
            "error": [1e-3, 2e-3, np.nan, 1e-2, 0.0, 1e-7, 1e-7, 2e-7],
        }
    )
    figure = plot_prediction(
        paths, paths, errors, states="xyz", units=("mV", "1", "1"), published=(3.04e-4, 6.55e-4)
    )
    left, right = figure.axes
    assert len(left.lines) == 6 * 2 * 2  # the curve and its start, observed and predicted
    assert right.get_xscale() == "log"
    assert [patch.get_data().values.sum() for patch in right.patches[:2]] == pytest.approx([3 / 5, 1])
    text = words(figure)
    for label in ("6 held-out trajectories", "$x$ (mV)", "regression, 5 predictions", "3.04", "6.55"):
        assert label in text
    assert "regression: 1 prediction without an error" in text
    assert "regression: 1 prediction with no error at all" in text


def test_predictions_that_are_not_there_are_not_drawn() -> None:
    nothing = pd.DataFrame({"method": ["regression"], "error": [np.nan]})
    path = [np.ones((4, 1))]
    assert plot_prediction([], [], nothing.assign(error=1.0), states="xy", units="11") is None
    assert plot_prediction(path, path, nothing, states="x", units="V") is None
    one = plot_prediction(path, path, nothing.assign(error=1.0), states="x", units="V")
    assert "number of the sample" in words(one) and "1 held-out trajectory" in words(one)


def test_the_same_figure_gives_the_same_files(tmp_path) -> None:
    table = synthetic_coefficients(2)
    table = table[table["component"] == "g_x"]
    figure = plot_inclusion(table, method="regression")
    first = [path.read_bytes() for path in save_figure(figure, tmp_path / "new" / "first")]
    with matplotlib.rc_context(
        {"font.size": 20, "svg.hashsalt": None}
    ):  # settings of the machine do not matter
        again = plot_inclusion(table, method="regression")
        second = [path.read_bytes() for path in save_figure(again, tmp_path / "second")]
    third = [path.read_bytes() for path in save_figure(figure, tmp_path / "second")]
    assert first == second == third
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new", "second.png", "second.svg"]


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("x", "x"),
        ("x1", "x_{1}"),
        ("f_x", "f_{x}"),
        ("omega_0", r"\omega_{0}"),
        ("f_theta_1", r"f_{\theta_{1}}"),
        ("heat", r"\mathrm{heat}"),
        ("x__1_2", "x_{1,2}"),
    ],
)
def test_names_are_typeset(name: str, label: str) -> None:
    assert name_label(name) == label


def test_terms_are_typeset_and_sorted_by_degree() -> None:
    assert term_label("x**2*y") == r"$x^{2}\,y$"
    assert term_label("sin(x)") == "sin(x)"
    assert sorted_terms(["x**4", "1", "sin(x)", "x*y", "y"]) == ["1", "y", "x*y", "x**4", "sin(x)"]


def test_mean_and_spread_share_their_digits() -> None:
    assert mean_and_spread(8.87e-4, 3.48e-4, digits=3) == r"$(8.87 \pm 3.48) \times 10^{-4}$"
    assert mean_and_spread(-1.99987, 0.0012) == r"$-1.9999 \pm 0.0012$"
    assert mean_and_spread(-1e-9, 0.01) == r"$0.000 \pm 0.010$"
