"""Figures of all runs of a study: coefficients, terms, errors, training (paper, Figs. 2 and 3)."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from siq.report.plots.style import (
    BLACK,
    BLUE,
    COLUMN_WIDTH,
    GREY,
    ORANGE,
    PAGE_WIDTH,
    SKY_BLUE,
    VERMILLION,
    counted,
    drawn_in_style,
    magnitude_label,
    mean_and_spread,
    name_label,
)

GOLDEN_RATIO = (5**0.5 - 1) / 2


@drawn_in_style
def plot_error_distribution(
    rrmse: pd.DataFrame, *, published: tuple[float, float] | None = None
) -> Figure | None:
    """Draw the error of the coefficients of U, one dot a run.

    Parameters
    ----------
    rrmse
        Columns ``run method rrmse support_correct certified network_error``, one row per run × method.
        Runs without an error are counted in a note.
    published
        Mean and standard deviation of a published result, drawn as a band.

    Returns
    -------
    matplotlib.figure.Figure
        Relative root-mean-square error on a logarithmic axis, by method. Shape and colour tell whether the
        terms are exactly the right ones, a hollow mark that the run is not certified. None where fewer than
        two runs have an error.
    """
    if rrmse["run"].nunique() < 2 or not (rrmse["rrmse"] > 0).any():
        return None
    methods = list(dict.fromkeys(rrmse["method"]))
    figure = Figure(figsize=(COLUMN_WIDTH if len(methods) <= 2 else PAGE_WIDTH, 4.8))
    axes = figure.add_subplot()
    axes.set_yscale("log")
    labels = []
    notes = []
    for place, method in enumerate(methods):
        rows = rrmse[rrmse["method"] == method]
        measured = rows[rows["rrmse"] > 0].sort_values(["rrmse", "run"])
        _draw_runs(axes, place, measured)
        labels.append(f"{method}\n" + _summary(measured["rrmse"].to_numpy(float)))
        missing, zero = int(rows["rrmse"].isna().sum()), int((rows["rrmse"] == 0).sum())
        notes += [f"{method}: {counted(missing, 'run')} without an error"] if missing else []
        notes += [f"{method}: {counted(zero, 'run')} with no error at all"] if zero else []
    if published is not None:
        _draw_published(axes, *published)
    axes.set_xticks(range(len(methods)), labels)
    axes.set_xlim(-0.6, len(methods) - 0.4)
    axes.set_ylabel("relative error of the coefficients\nof $U$ (RRMSE, dimensionless)")
    axes.grid(axis="y", linewidth=0.3, color="#CCCCCC")
    axes.set_axisbelow(True)
    handles = _legend(rrmse, axes)
    figure.legend(handles=handles, loc="outside upper left", ncols=1)
    if notes:
        figure.supxlabel("\n".join(notes))
    return figure


def _is_true(column: pd.Series) -> np.ndarray:
    # The column holds missing values where nothing is known; those do not count as true.
    return np.array(
        [value is True or value is np.True_ or value == 1 for value in column.tolist()], dtype=bool
    )


def _draw_runs(axes: Axes, place: int, rows: pd.DataFrame) -> None:
    # Multiples of the golden ratio spread neighbours in size far apart, the same way every time.
    offsets = (
        0.56 * ((np.arange(len(rows)) * GOLDEN_RATIO) % 1 - 0.5) if len(rows) > 1 else np.zeros(len(rows))
    )
    values = rows["rrmse"].to_numpy(float)
    correct, certified = _is_true(rows["support_correct"]), _is_true(rows["certified"])
    for right in (True, False):
        for sure in (True, False):
            chosen = (correct == right) & (certified == sure)
            colour, marker = (BLUE, "o") if right else (VERMILLION, "^")
            axes.plot(
                place + offsets[chosen],
                values[chosen],
                linestyle="none",
                marker=marker,
                markersize=4,
                markeredgecolor=colour,
                markerfacecolor=colour if sure else "white",
                markeredgewidth=0.8,
            )
    if len(values):
        median = float(np.median(values))
        axes.plot([place - 0.36, place + 0.36], [median, median], color=BLACK, linewidth=1.2)


def _summary(values: np.ndarray) -> str:
    if values.size == 0:
        return "no run measured"
    if values.size == 1:
        return f"1 run\n{magnitude_label(float(values[0]), digits=3)}"
    spread = values.std(ddof=1)
    median = magnitude_label(float(np.median(values)))
    return f"{counted(values.size, 'run')}\nmedian {median}\n{mean_and_spread(values.mean(), spread)}"


def _draw_published(axes: Axes, mean: float, spread: float) -> None:
    lowest = axes.get_ylim()[0]
    bottom = mean - spread if mean > spread else min(lowest, mean / 10)
    axes.axhspan(bottom, mean + spread, color=GREY, alpha=0.25, linewidth=0, zorder=0)
    label = f"published: {mean_and_spread(mean, spread, digits=3)}"
    axes.axhline(mean, color=GREY, linewidth=1.0, linestyle="--", label=label, zorder=0.5)


def _legend(rrmse: pd.DataFrame, axes: Axes) -> list[Line2D]:
    measured = rrmse[rrmse["rrmse"] > 0]
    correct, certified = _is_true(measured["support_correct"]), _is_true(measured["certified"])
    entries = [
        (bool(correct.any()), "o", BLUE, BLUE, "exactly the right terms"),
        (bool((~correct).any()), "^", VERMILLION, VERMILLION, "terms missing or too many"),
        (bool((~certified).any()), "s", GREY, "white", "hollow: not certified"),
    ]
    handles = [
        Line2D(
            [],
            [],
            linestyle="none",
            marker=marker,
            markersize=4,
            markeredgecolor=edge,
            markerfacecolor=face,
            label=text,
        )
        for present, marker, edge, face, text in entries
        if present
    ]
    handles.append(
        Line2D([], [], color=BLACK, linewidth=1.2, label="median (last line: mean ± standard deviation)")
    )
    return handles + [line for line in axes.get_lines() if str(line.get_label()).startswith("published")]


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


def term_label(term: str) -> str:
    """Typeset a term such as ``x**2*y``; anything but a monomial is left as it is."""
    powers = _powers(term)
    if powers is None:
        return term.replace("$", r"\$")
    typeset = (name_label(name) + (f"^{{{power}}}" if power > 1 else "") for name, power in powers)
    return "$" + r"\,".join(typeset) + "$"


def _degree(term: str) -> int:
    """Count the factors of a monomial; a term that is none comes after all monomials."""
    powers = _powers(term)
    return 1000 if powers is None else sum(power for name, power in powers if name != "1")


def _powers(term: str) -> list[tuple[str, int]] | None:
    factors = [
        re.fullmatch(r"([^\W\d]\w*|1)(?:\^(\d+))?", factor)
        for factor in term.replace(" ", "").replace("**", "^").split("*")
    ]
    if not all(factors):
        return None
    return [(factor[1], int(factor[2] or 1)) for factor in factors if factor]


def sorted_terms(terms: Iterable[str]) -> list[str]:
    """Order different terms by degree, otherwise as they first appear in the table."""
    return sorted(dict.fromkeys(terms), key=_degree)
