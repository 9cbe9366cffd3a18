"""In how many runs each term is a part of each component."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from siq.report.plots.style import (
    COLUMN_WIDTH,
    PAGE_WIDTH,
    VERMILLION,
    counted,
    drawn_in_style,
    name_label,
    sorted_terms,
    term_label,
)


@drawn_in_style
def plot_inclusion(coefficients: pd.DataFrame, *, method: str) -> Figure | None:
    """Draw how often every term is non-zero in every component.

    Parameters
    ----------
    coefficients
        Columns ``run method component term estimate exact``, as for `plot_coefficient_distributions`.
    method
        The method to show.

    Returns
    -------
    matplotlib.figure.Figure
        Terms by components, the share of runs in per cent; cells of the exact terms are outlined where they
        are known. Terms that no run uses and that are not exact are counted in a sentence.
    """
    rows = coefficients[coefficients["method"] == method].dropna(subset=["estimate"])
    runs = rows["run"].nunique()
    if runs < 2:
        return None
    components = list(dict.fromkeys(rows["component"]))
    terms = sorted_terms(rows["term"])
    cells = rows.assign(used=rows["estimate"] != 0, wanted=rows["exact"].fillna(0) != 0)
    table = cells.groupby(["term", "component"])[["used", "wanted"]].agg({"used": "mean", "wanted": "any"})
    frequency = table["used"].unstack().reindex(index=terms, columns=components)
    wanted = table["wanted"].unstack().reindex(index=terms, columns=components).fillna(False).astype(bool)
    kept = (frequency.fillna(0) > 0).any(axis=1) | wanted.any(axis=1)
    unused = int((~kept).sum())
    if not kept.any():
        return None

    height = 0.23 * int(kept.sum()) + 1.6
    width = min(max(COLUMN_WIDTH, 1.4 + 0.5 * len(components)), PAGE_WIDTH)
    figure = Figure(figsize=(width, height))
    axes = figure.add_subplot()
    _draw_cells(axes, frequency[kept].to_numpy(float), wanted[kept].to_numpy(bool))
    axes.set_xticks(range(len(components)), [f"${name_label(name)}$" for name in components])
    axes.set_yticks(range(int(kept.sum())), [term_label(term) for term in frequency.index[kept]])
    axes.set_xlabel("component")
    axes.set_ylabel("term")
    figure.suptitle(f"Share of {counted(runs, 'run')} that use a term (%),\nmethod “{method}”")
    sentences = ["outlined: in the exact formula"] if wanted.to_numpy().any() else []
    if unused:
        every = "the run" if runs == 1 else f"every component of all {runs} runs"
        sentences.append(f"the other {counted(unused, 'term')}: zero in {every}")
    figure.supxlabel("\n".join(sentences))
    return figure


def _draw_cells(axes: Axes, frequency: np.ndarray, wanted: np.ndarray) -> None:
    axes.imshow(np.ma.masked_equal(np.nan_to_num(frequency), 0), cmap="Blues", vmin=0, vmax=1, aspect="auto")
    axes.set_frame_on(False)
    axes.tick_params(length=0)
    axes.set_xticks(np.arange(-0.5, frequency.shape[1]), minor=True)
    axes.set_yticks(np.arange(-0.5, frequency.shape[0]), minor=True)
    axes.grid(which="minor", color="#DDDDDD", linewidth=0.5)
    axes.tick_params(which="minor", length=0)
    for row, column in np.ndindex(*frequency.shape):
        share = frequency[row, column]
        if share > 0 or wanted[row, column]:
            text = "<1" if 0 < share < 0.005 else ">99" if 0.995 < share < 1 else f"{100 * share:.0f}"
            colour = "white" if share > 0.5 else "black"
            axes.text(column, row, text, ha="center", va="center", color=colour)
        if wanted[row, column]:
            box = Rectangle(
                (column - 0.5, row - 0.5),
                1,
                1,
                fill=False,
                edgecolor=VERMILLION,
                linewidth=1.4,
                clip_on=False,
                zorder=3,
            )
            axes.add_patch(box)
