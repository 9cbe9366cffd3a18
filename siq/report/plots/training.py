"""Whether the training of the networks came to rest, in every run."""

from __future__ import annotations

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from siq.report.plots.style import BLACK, PAGE_WIDTH, SKY_BLUE, counted, drawn_in_style, say, sentence_figure

_PANELS = {
    "training_loss": "loss on the training pairs",
    "held_out_loss": "loss on the held-out pairs",
    "dynamics": "dynamics part of the loss",
    "orthogonality": "orthogonality part of the loss",
    "learning_rate": "learning rate",
}


@drawn_in_style
def plot_training(training: pd.DataFrame) -> Figure:
    """Draw the course of training, one thin line a run.

    Parameters
    ----------
    training
        Columns ``run step training_loss held_out_loss dynamics orthogonality learning_rate``.

    Returns
    -------
    matplotlib.figure.Figure
        Five panels with logarithmic axes, and the median of the runs wherever at least half of them are.
    """
    # Step zero has no place on a logarithmic axis.
    rows = training[training["step"] > 0]
    if rows.empty:
        return sentence_figure("No training is recorded.")
    runs = rows["run"].nunique()
    figure = Figure(figsize=(PAGE_WIDTH, 3.9))
    panels = figure.subplots(2, 3, sharex=True).T.ravel()
    legend, *panels = panels[[4, 0, 1, 2, 3, 5]]
    for axes, (column, title) in zip(panels, _PANELS.items(), strict=True):
        _draw_column(axes, rows, column)
        axes.set_title(title)
        axes.set_ylabel("rate (dimensionless)" if column == "learning_rate" else "loss (units of the card)")
    for axes in (panels[1], panels[3], panels[4]):
        axes.set_xlabel("training step")
    legend.set_axis_off()
    handles = [
        Line2D([], [], color=SKY_BLUE, linewidth=0.8, label=f"one run ({runs} in all)"),
        Line2D([], [], color=BLACK, linewidth=1.6, label=f"median of {counted(runs, 'run')}"),
    ]
    legend.legend(handles=handles, loc="center")
    return figure


def _draw_column(axes: Axes, rows: pd.DataFrame, column: str) -> None:
    measured = rows[rows[column] > 0]
    if measured.empty:
        say(axes, "not recorded")
        return
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
