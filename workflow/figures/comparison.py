"""Figures of U by several sources, of formulas by degree, and of escape times (paper, fig2b, Appendix E)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from siq.numerics.text import unit_text
from siq.report.plots.style import (
    BLACK,
    COLUMN_WIDTH,
    GREY,
    PAGE_WIDTH,
    counted,
    drawn_in_style,
    look,
    magnitude_label,
    name_label,
    power_of_ten,
    say,
    scaled_label,
)
from siq.report.summary import well_name
from workflow.figures.density import UNKNOWN, hatch_unknown

ENERGY = "unit of ε"
DECADES = {1: 6, 2: 4}  # of differences, below the largest one, by the number of states


@drawn_in_style
def plot_error_curves(
    x: np.ndarray, curves: Mapping[str, np.ndarray], *, name: str, unit: str, energy_unit: str = ""
) -> Figure | None:
    """Draw U of one state by several sources, and how far each is from the first one.

    Parameters
    ----------
    x
        States in ascending order, shape ``(n,)``.
    curves
        U by each source, shape ``(n,)``, NaN where it says nothing. The first one is the reference.
    name, unit
        Of the state.
    energy_unit
        Unit of U; empty where it is that of ε.

    Returns
    -------
    matplotlib.figure.Figure
        Above U; below the absolute difference as a share of the reference's highest value, on a
        logarithmic axis.
    """
    (reference_name, reference), *others = [
        (key, one) for key, one in curves.items() if np.isfinite(one).any()
    ] or [("the reference", np.zeros(0))]
    if not reference.size or not others:
        return None
    highest = float(np.nanmax(np.abs(reference))) or 1.0
    figure = Figure(figsize=(COLUMN_WIDTH, 5.4))
    left, right = figure.subplots(2, 1, sharex=True)
    left.plot(x, reference, color=BLACK, linewidth=2.4, alpha=0.4, label=reference_name)
    right.set_yscale("log")
    shares = []
    for place, (key, values) in enumerate(others):
        colour, style, _ = look(place)
        left.plot(x, values, color=colour, linestyle=style, linewidth=1.2, label=key)
        difference = np.abs(values - reference) / highest
        shares.append(float(np.nanmax(difference, initial=0.0)))
        shown = np.where(difference > 0, difference, np.nan)
        right.plot(x, shown, color=colour, linestyle=style, linewidth=1.0)
    largest = max(shares)
    if largest > 0:
        right.set_ylim(largest / 10 ** DECADES[1], 2 * largest)
    else:
        say(right, "no difference at all")
    left.set_ylabel(scaled_label(left.yaxis, "$U$", energy_unit or ENERGY, highest))
    right.set_ylabel(f"difference from\n{reference_name} / highest $U$")
    for axes in (left, right):
        axes.set_xlabel(scaled_label(axes.xaxis, f"${name_label(name)}$", unit, float(np.abs(x).max())))
    figure.legend(loc="outside upper center", ncols=2)
    return figure


@drawn_in_style
def plot_degrees(table: pd.DataFrame) -> Figure | None:
    """Draw how formulas about the attractors improve with their number of terms.

    Parameters
    ----------
    table
        Columns ``run attractor degree terms residual covered chosen`` (further ones are ignored), one row per
        run × attractor × degree: the median relative Hamilton–Jacobi residual on points that took no part in
        the fit, the share of them at which the formula is believed, and whether this degree was chosen.

    Returns
    -------
    matplotlib.figure.Figure
        Two panels against the number of terms, None where no residual is known: the residual on a logarithmic
        axis, and the share covered. A thin line a run, a thick one for the median, wherever at least half of
        the runs are; a dot marks the degree that was chosen in a run, a ring the one that was chosen most
        often.
    """
    if not (table["residual"] > 0).any():
        return None
    figure = Figure(figsize=(COLUMN_WIDTH, 6.6))
    left, right = figure.subplots(2, 1, sharex=True)
    names = list(dict.fromkeys(table["attractor"]))
    left.set_yscale("log")
    for place, name in enumerate(names):
        rows = table[table["attractor"] == name]
        _draw_runs(left, rows[rows["residual"] > 0], "residual", place)
        _draw_runs(right, rows, "covered", place)
    degrees = table.drop_duplicates("terms").sort_values("terms")
    for axes in (left, right):
        axes.set_xlabel("number of terms")
        top = axes.secondary_xaxis("top")
        top.set_xticks(degrees["terms"].tolist(), [str(degree) for degree in degrees["degree"]])
        top.set_xlabel("degree")
        axes.spines["top"].set_visible(True)
        axes.grid(axis="y", linewidth=0.3, color="#CCCCCC")
        axes.set_axisbelow(True)
    left.set_ylabel("Hamilton–Jacobi residual\n(median over held-out points, relative)")
    right.set_ylabel("share of the held-out points\nat which the formula is believed")
    runs = table["run"].nunique()
    handles = [
        Line2D(
            [],
            [],
            color=colour,
            linestyle=style,
            marker=marker,
            markersize=3.5,
            linewidth=1.6,
            label=by_letters(name),
        )
        for name, (colour, style, marker) in zip(names, map(look, range(len(names))), strict=True)
    ]
    handles.append(_ring(GREY, label="chosen" if runs == 1 else "chosen most often"))
    if runs > 1:
        thin: dict[str, Any] = {"color": GREY, "linewidth": 0.5, "alpha": 0.7}
        handles.append(Line2D([], [], marker="o", markersize=2, label=f"each of {runs} runs", **thin))
        handles.append(Line2D([], [], color=GREY, linewidth=1.6, label="their median"))
    figure.legend(handles=handles, loc="outside upper center", ncols=2)
    return figure


def _ring(colour: str, **options: Any) -> Line2D:
    return Line2D(
        [], [], linestyle="none", marker="o", markersize=8, markerfacecolor="none", markeredgecolor=colour,
        markeredgewidth=1.2, **options,
    )  # fmt: skip


def _draw_runs(axes: Axes, rows: pd.DataFrame, column: str, place: int) -> None:
    rows = rows[np.isfinite(rows[column])]
    if rows.empty:
        return
    colour, style, marker = look(place)
    courses = rows.pivot_table(index="terms", columns="run", values=column)
    chosen = rows[rows["chosen"].astype(bool)]
    if courses.shape[1] > 1:
        for run in courses:
            course = courses[run].dropna()
            axes.plot(course.index, course, color=colour, linewidth=0.4, alpha=0.4)
        axes.plot(
            chosen["terms"], chosen[column], linestyle="none", marker="o", markersize=2, color=colour,
            markeredgewidth=0, alpha=0.6,
        )  # fmt: skip
    median = courses[courses.notna().sum(axis=1) >= courses.shape[1] / 2].median(axis=1)
    axes.plot(
        median.index, median, color=colour, linestyle=style, linewidth=1.6, marker=marker, markersize=3.5
    )
    if len(chosen):
        terms = chosen["terms"].mode().iloc[0]
        if terms in median.index:
            ring = _ring(colour)
            ring.set_data([terms], [median[terms]])
            axes.add_line(ring)


@drawn_in_style
def plot_escape(table: pd.DataFrame, *, time_unit: str = "1", energy_unit: str = "1") -> Figure | None:
    """Draw mean escape times against the inverse of the noise intensity.

    Parameters
    ----------
    table
        Columns ``transition intensity predicted simulated simulated_error`` (further ones are ignored), one
        row per transition × ε: the mean time by the law, and in a simulation with its standard error, both in
        time units. What was not simulated is missing or not finite.
    time_unit, energy_unit
        Units of time and of ε; ``1`` and the empty text mean none.

    Returns
    -------
    matplotlib.figure.Figure
        The law as lines, which are straight where the time is logarithmic; simulations as points with bars
        of one standard error.
    """
    rows = table[table["predicted"] > 0] if len(table) else table
    if rows.empty:
        return None
    figure = Figure(figsize=(COLUMN_WIDTH, 3.8))
    axes = figure.add_subplot()
    axes.set_yscale("log")
    handles, missing = [], 0
    for place, (name, unsorted) in enumerate(rows.groupby("transition", sort=False)):
        ways = unsorted.sort_values("intensity", ascending=False)
        colour, style, marker = look(place)
        inverse = 1 / ways["intensity"].to_numpy(float)
        axes.plot(inverse, ways["predicted"].to_numpy(float), color=colour, linestyle=style, linewidth=1.2)
        times, errors = (ways[column].to_numpy(float) for column in ("simulated", "simulated_error"))
        seen = np.isfinite(times) & (times > 0)
        missing += int((~seen).sum())
        # An error as large as the mean has no lower end on a logarithmic axis: its bar runs out of sight.
        errors = np.where(np.isfinite(errors), errors, 0.0)
        bars = np.stack([np.minimum(errors, (1 - 1e-9) * times), errors])[:, seen]
        axes.errorbar(
            inverse[seen], times[seen], yerr=bars, linestyle="none", marker=marker,
            markersize=4, markerfacecolor="white", color=colour, elinewidth=1.0, capsize=2,
        )  # fmt: skip
        handles.append(
            Line2D([], [], color=colour, linestyle=style, marker=marker, markersize=4,
                   markerfacecolor="white", label=by_letters(str(name)))
        )  # fmt: skip
    _limit(axes, rows)
    largest = float((1 / rows["intensity"]).max())
    inverse_unit = "" if energy_unit in ("1", "") else f"1/({energy_unit})"
    axes.set_xlabel(scaled_label(axes.xaxis, r"$1/\varepsilon$", inverse_unit, largest))
    axes.set_ylabel(
        "mean escape time " + ("(time units)" if time_unit in ("1", "") else f"({unit_text(time_unit)})")
    )
    figure.legend(
        handles=handles, loc="outside upper center", ncols=2,
        title="lines: law, points: simulation ± standard error",
    )  # fmt: skip
    if missing:
        figure.supxlabel(f"{missing} of {counted(len(rows), 'time')} without a simulation")
    return figure


def _limit(axes: Axes, rows: pd.DataFrame) -> None:
    """Limits by the times themselves: an error bar that runs to zero would leave them no room."""
    times = rows[["predicted", "simulated"]].to_numpy(float)
    times = times[np.isfinite(times) & (times > 0)]
    room = max((times.max() / times.min()) ** 0.08, 1.3)
    axes.set_ylim(times.min() / room, times.max() * room)


def by_letters(name: str) -> str:
    """The letters by which pages call wells, for the numbers that tables have: ``A1 to A2`` as A to B."""
    return re.sub(r"\bA(\d+)\b", lambda found: well_name(int(found[1]) - 1), name)


COLOUR_MAP = "viridis"
DIFFERENCE_MAP = "magma"
LEVELS = 14
MARGIN = 0.06  # of what is known: shown around it
RIM: dict[str, Any] = {"path_effects": [withStroke(linewidth=2.0, foreground="white")]}


def _name_axes(
    axes: Axes, axes_values: Sequence[np.ndarray], names: Sequence[str], units: Sequence[str]
) -> None:
    for axis, place, name, unit in zip((axes.xaxis, axes.yaxis), axes_values, names, units, strict=True):
        label = scaled_label(axis, f"${name_label(name)}$", unit, float(np.abs(place).max()))
        axis.set_label_text(label)


@drawn_in_style
def plot_error_maps(
    axes_values: Sequence[np.ndarray],
    maps: Mapping[str, np.ndarray],
    *,
    names: Sequence[str],
    units: Sequence[str],
    energy_unit: str,
) -> Figure | None:
    """Draw U by several sources, and how far each is from the first one.

    Parameters
    ----------
    axes_values
        The grid, shapes ``(nx,)`` and ``(ny,)``, ascending, in the states' units.
    maps
        U by each source, shape ``(nx, ny)``, NaN where it says nothing. The first one is the reference.
    names, units
        Of the two states.
    energy_unit
        Unit of U and ε; ``1`` and the empty text mean that of ε.

    Returns
    -------
    matplotlib.figure.Figure
        A row for each source: on the left U in the colours of the reference; on the right the absolute
        difference as a share of the reference's highest value, on a logarithmic scale, with its root mean
        square. None where there is nothing to compare.
    """
    fields = {name: np.asarray(values, dtype=float) for name, values in maps.items()}
    fields = {name: values for name, values in fields.items() if np.isfinite(values).any()}
    if len(fields) < 2 or next(iter(fields)) != next(iter(maps)):
        return None
    reference_name, reference = next(iter(fields.items()))
    highest = float(np.nanmax(np.abs(reference))) or 1.0
    figure = Figure(figsize=(PAGE_WIDTH, 1.9 * len(fields) + 0.9))
    panels = figure.subplots(len(fields), 2, sharex=True, sharey=True)
    lowest, top = float(np.nanmin(reference)), float(np.nanmax(reference))
    top = top if top > lowest else lowest + (abs(lowest) or 1.0)  # a flat landscape has levels, too
    # The bottom is zero to rounding, and a level below it would have no meaning.
    bottom = 0.0 if abs(lowest) < 1e-3 * (top - lowest) else lowest
    levels = np.asarray(MaxNLocator(LEVELS).tick_values(bottom, top))
    norm = BoundaryNorm(levels, 256, extend="both")
    differences = [np.abs(values - reference) / highest for values in list(fields.values())[1:]]
    for axes, (name, values) in zip(panels[:, 0], fields.items(), strict=True):
        axes.set_title(name, loc="left")
        hatch_unknown(axes)
        for drawn in (
            axes.contourf(*axes_values, values.T, levels=levels, norm=norm, extend="both", cmap=COLOUR_MAP),
            axes.contour(*axes_values, values.T, levels=levels, colors="white", linewidths=0.25),
        ):
            drawn.set_rasterized(True)
    power = power_of_ten(float(np.abs(levels).max()))
    factor = f"$10^{{{power}}}$" if power else ""
    unit = f"{factor} {unit_text(energy_unit) or ENERGY}".strip()
    bar = figure.colorbar(
        ScalarMappable(norm=norm, cmap=COLOUR_MAP), ax=list(panels[:, 0]), location="bottom",
        pad=0.02, aspect=25, label=f"$U$ ({unit})", spacing="proportional",
    )  # fmt: skip
    ticks = levels[:: 4 if len(levels) > 8 else 2]
    bar.set_ticks(ticks.tolist())
    bar.minorticks_off()
    bar.ax.set_xticklabels([f"{one / 10.0**power:.4g}".replace("-", "−") for one in ticks])
    _draw_differences(figure, list(panels[:, 1]), axes_values, differences, np.isfinite(reference).sum())
    corner = panels[0, 1]
    corner.set_axis_off()
    text = f"right: difference\nfrom {reference_name}\n/ highest $U$"
    corner.text(0.5, 0.65, text, transform=corner.transAxes, ha="center", va="center")
    corner.legend(handles=[Patch(label="not known", **UNKNOWN)], loc="lower center", borderpad=0)
    # What is known, as far as the grid goes: the rest of it would only be hatched.
    for index, limit in enumerate((panels[0, 0].set_xlim, panels[0, 0].set_ylim)):
        nodes = axes_values[index]
        shown = nodes[np.isfinite(reference).any(axis=1 - index)]
        room = MARGIN * (shown.max() - shown.min())
        limit(max(shown.min() - room, nodes[0]), min(shown.max() + room, nodes[-1]))
    for axes in panels.ravel().tolist():
        axes.xaxis.set_major_locator(MaxNLocator(3))
        axes.yaxis.set_major_locator(MaxNLocator(4))
        _name_axes(axes, axes_values, names, units)
        axes.label_outer()
    return figure


def _draw_differences(
    figure: Figure,
    panels: Sequence[Axes],
    axes_values: Sequence[np.ndarray],
    differences: Sequence[np.ndarray],
    compared: int,
) -> None:
    known = [one[np.isfinite(one)] for one in differences]
    largest = max((float(one.max(initial=0.0)) for one in known), default=0.0) or 1.0
    lowest = largest / 10 ** DECADES[2]
    norm = LogNorm(lowest, largest)
    for axes, difference, found in zip(panels[1:], differences, known, strict=True):
        if not found.size:
            hatch_unknown(axes)
            axes.text(0.5, 0.5, "not known", transform=axes.transAxes, ha="center", va="center", **RIM)
            continue
        hatch_unknown(axes)
        # As an image: thousands of small rectangles would make a megabyte of vector graphics. What is less
        # than the scale shows, zero included, has its lowest colour.
        axes.pcolormesh(
            *axes_values, np.maximum(difference, lowest).T, norm=norm, cmap=DIFFERENCE_MAP,
            shading="nearest", rasterized=True,
        )  # fmt: skip
        title = f"rms {magnitude_label(float(np.sqrt((found**2).mean())))}"
        if found.size < compared:
            title += f", at {100 * found.size / compared:.3g} %"
        axes.set_title(title, loc="left")
    bar = figure.colorbar(
        ScalarMappable(norm=norm, cmap=DIFFERENCE_MAP), ax=panels, label="difference / highest $U$",
        location="bottom", pad=0.02, aspect=25, extend="min",
    )  # fmt: skip
    bar.minorticks_off()
