"""Whether the training of the networks came to rest, in every run."""

from __future__ import annotations

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from siq.report.plots.style import BLACK, PAGE_WIDTH, SKY_BLUE, counted, drawn_in_style

_PANELS = {
    "training_loss": "on training pairs",
    "held_out_loss": "on held-out pairs",
    "dynamics": "dynamics part",
    "orthogonality": "orthogonality part",
    "learning_rate": "learning rate",
}


@drawn_in_style
def plot_training(training: pd.DataFrame) -> Figure | None:
    """Draw the course of training, one thin line a run.

    Parameters
    ----------
    training
        Columns ``run step training_loss held_out_loss dynamics orthogonality learning_rate``.

    Returns
    -------
    matplotlib.figure.Figure
        A panel with logarithmic axes for each column that was recorded, and the median of several runs
        wherever at least half of them are. None where nothing was trained.
    """
    # Step zero has no place on a logarithmic axis.
    rows = training[training["step"] > 0]
    if not (rows[list(_PANELS)] > 0).any(axis=None):
        return None
    runs = rows["run"].nunique()
    shown = {column: title for column, title in _PANELS.items() if (rows[column] > 0).any()}
    figure = Figure(figsize=(PAGE_WIDTH, 2.3 * -(-len(shown) // 2) + 0.6))
    panels = figure.subplots(-(-len(shown) // 2), 2, sharex=True, squeeze=False).ravel()
    for axes in panels[len(shown) :]:
        axes.remove()
    for axes, (column, title) in zip(panels, shown.items(), strict=False):
        _draw_column(axes, rows, column)
        axes.set_title(title, loc="left")
        axes.set_ylabel("rate" if column == "learning_rate" else "loss")
    for axes in panels[max(len(shown) - 2, 0) : len(shown)]:
        axes.set_xlabel("training step")
        axes.tick_params(labelbottom=True)
    if runs > 1:
        handles = [
            Line2D([], [], color=SKY_BLUE, linewidth=0.8, label=f"one run ({runs} in all)"),
            Line2D([], [], color=BLACK, linewidth=1.6, label=f"median of {counted(runs, 'run')}"),
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def _draw_column(axes: Axes, rows: pd.DataFrame, column: str) -> None:
    measured = rows[rows[column] > 0]
    table = measured.pivot_table(index="step", columns="run", values=column)
    for run in table:
        course = table[run].dropna()
        # Fifty runs of thousands of steps would be megabytes of vector graphics; an image does.
        axes.plot(course.index, course, color=SKY_BLUE, linewidth=0.5, alpha=0.7, rasterized=True)
    enough = table.notna().sum(axis=1) >= table.shape[1] / 2
    median = table[enough].median(axis=1)
    axes.plot(median.index, median, color=BLACK, linewidth=1.6)
    axes.set_xscale("log")
    axes.set_yscale("log")
