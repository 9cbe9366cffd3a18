"""Which coefficients the runs found, and how far they scatter (paper, Fig. 11)."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from siq.report.plots.style import (
    ORANGE,
    PAGE_WIDTH,
    SKY_BLUE,
    VERMILLION,
    counted,
    drawn_in_style,
    magnitude_label,
    mean_and_spread,
    name_label,
    sorted_terms,
    term_label,
)

NARROW = 1e-4  # coefficients that scatter less than this share of their value are drawn as deviations
BARS_IN_A_PANEL = 6
BARS_IN_A_ROW = 20


@drawn_in_style
def plot_coefficient_distributions(
    coefficients: pd.DataFrame, *, method: str, component: str = "U"
) -> Figure | None:
    """Draw the distribution of every non-trivial coefficient over the runs.

    Parameters
    ----------
    coefficients
        Columns ``run method component term estimate exact``: one row per run × method × component × term,
        zeros included; `exact` is missing where unknown. Failed runs have no rows.
    method
        The method to show.
    component
        The component to show: ``U``, ``V``, ``f_x``, ``g_x`` and so on.

    Returns
    -------
    matplotlib.figure.Figure
        A histogram of the non-zero estimates for each non-trivial term (exact coefficient not zero or, where
        it is unknown, estimate not zero in at least half of the runs), then one panel on all other terms.
        None of fewer than two runs, which have no distribution.
    """
    chosen = (coefficients["method"] == method) & (coefficients["component"] == component)
    rows = coefficients[chosen].dropna(subset=["estimate"])
    runs = rows["run"].nunique()
    if runs < 2:
        return None
    terms = sorted_terms(rows["term"])
    estimates = {term: group.to_numpy(float) for term, group in rows.groupby("term")["estimate"]}
    exact = rows.groupby("term")["exact"].first()
    shown = [term for term in terms if _is_nontrivial(float(exact[term]), estimates[term])]
    others = {term: estimates[term] for term in terms if term not in shown}
    false_terms = sum(bool(np.any(values)) for values in others.values())

    wide = false_terms > BARS_IN_A_PANEL
    panels = len(shown) + (0 if wide else 1)
    columns = 2  # more could not be read on a phone
    lines = math.ceil(panels / columns) + (1 if wide else 0)
    figure = Figure(figsize=(PAGE_WIDTH, 2.3 * lines + 0.6))
    grid = figure.add_gridspec(lines, columns)
    for index, term in enumerate(shown):
        axes = figure.add_subplot(grid[index // columns, index % columns])
        _draw_histogram(axes, term, estimates[term], float(exact[term]))
        if index % columns == 0:
            axes.set_ylabel("number of runs")
    last = grid[-1, :] if wide else grid[(panels - 1) // columns, (panels - 1) % columns]
    known = bool(exact.notna().any())
    figure.suptitle(
        f"Coefficients of ${name_label(component)}$ in {counted(runs, 'run')}, “{method}”\n"
        + "(mean ± standard deviation,\n"
        + ("in the units of the states" + ("; dashed: exact)" if known else ")"))
    )
    _draw_other_terms(figure.add_subplot(last), others, runs, known=known, wide=wide)
    return figure


def _is_nontrivial(exact: float, estimates: np.ndarray) -> bool:
    return exact != 0 if math.isfinite(exact) else bool(np.mean(estimates != 0) >= 0.5)


def _draw_histogram(axes: Axes, term: str, estimates: np.ndarray, exact: float) -> None:
    found = estimates[estimates != 0]
    axes.set_xlabel("coefficient")
    known = math.isfinite(exact)
    reference = exact if known else float(f"{np.median(found):.4g}") if found.size else 0.0
    width = float(np.max(np.abs(found - reference), initial=0.0))
    narrow = bool(0 < width < NARROW * abs(reference))
    title = (
        mean_and_spread(found.mean(), found.std(ddof=1) if found.size > 1 else math.nan) if found.size else ""
    )
    if narrow:
        spread = (found - reference).std(ddof=1) if found.size > 1 else math.nan
        deviation = mean_and_spread((found - reference).mean(), spread)
        title = f"${reference:g}$ + {deviation}"
        sign = "−" if reference > 0 else "+"
        axes.set_xlabel(f"coefficient {sign} ${abs(reference):g}$")
        found = found - reference
        exact = exact - reference
    if found.size:
        axes.hist(found, bins=_bins(found, exact), color=SKY_BLUE, edgecolor="white", linewidth=0.4)
    if known:
        axes.axvline(exact, color=VERMILLION, linestyle="--", linewidth=1.2)
    absent = int(np.sum(estimates == 0))
    if absent:
        note = f"zero in {counted(absent, 'run')}\n(left out)"
        axes.text(0.03, 0.97, note, transform=axes.transAxes, va="top", color=VERMILLION)
    axes.set_title(f"{term_label(term)}\n{title}")
    axes.xaxis.set_major_locator(MaxNLocator(3))
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.ticklabel_format(axis="x", useOffset=False, scilimits=(-2, 4), useMathText=True)
    axes.set_ylim(bottom=0, top=axes.get_ylim()[1] * (1.45 if absent and found.size else 1.0))


def _bins(values: np.ndarray, exact: float) -> list[float]:
    lowest, highest = float(values.min()), float(values.max())
    if highest - lowest <= 1e-12 * max(abs(lowest), abs(highest)):
        # One value has no width of its own; its bar is to stand beside the exact value, not over it.
        distance = abs(lowest - exact) if math.isfinite(exact) else 0.0
        half = 0.2 * (distance or 0.02 * abs(lowest) or 1.0)
        return [lowest - half, highest + half]
    number = np.histogram_bin_edges(values, bins="auto").size - 1
    return np.linspace(lowest, highest, min(max(number, 5), 20) + 1).tolist()


def _draw_other_terms(
    axes: Axes, others: dict[str, np.ndarray], runs: int, *, known: bool, wide: bool
) -> None:
    frequency = {term: np.count_nonzero(values) / runs for term, values in others.items()}
    nonzero = sorted((term for term in others if frequency[term]), key=lambda term: -frequency[term])
    every = "the run" if runs == 1 else f"all {runs} runs"
    if not nonzero:
        remaining = "no other term" if not others else f"the other {counted(len(others), 'term')}:"
        axes.text(
            0.5,
            0.5,
            remaining + (f"\nzero in {every}" if others else ""),
            transform=axes.transAxes,
            ha="center",
            va="center",
        )
        axes.set_axis_off()
        return
    drawn = nonzero[:BARS_IN_A_ROW]
    axes.bar(range(len(drawn)), [frequency[term] for term in drawn], color=ORANGE, width=0.7)
    for place, term in enumerate(drawn):
        largest = magnitude_label(float(np.max(np.abs(others[term]))), digits=1)
        text = f" {largest}"
        axes.text(place, frequency[term], text, rotation=90, ha="center", va="bottom")
    axes.set_xticks(range(len(drawn)), [term_label(term) for term in drawn], rotation=90)
    axes.set_xlim(-0.7, max(len(drawn), 4) - 0.3)
    axes.set_ylim(0, max(frequency.values()) * 1.9)
    axes.set_ylabel("share of runs")
    what = "falsely non-zero" if known else "non-zero in under half of the runs"
    title = [f"other terms {what}", "number: largest magnitude"]
    if len(nonzero) > len(drawn):
        title.append(f"the {len(drawn)} most frequent of {len(nonzero)}")
    if len(others) > len(nonzero):
        title.append(f"{len(others) - len(nonzero)} more: zero in {every}")
    axes.set_title(("; " if wide else "\n").join(title))
