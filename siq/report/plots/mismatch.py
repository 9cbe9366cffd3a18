"""Figures of a mismatch: recordings beside simulations, what is missing and where, and what it does."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from siq.report.plots.before_after import plot_before_after, plot_held_out
from siq.report.plots.reading import WIDTH, axis_unit, drawn_to_be_read, rate_unit
from siq.report.plots.style import BLACK, BLUE, GREY, ORANGE, SKY_BLUE, VERMILLION, counted, name_label

__all__ = [
    "plot_before_after",
    "plot_candidates",
    "plot_curves",
    "plot_escapes",
    "plot_held_out",
    "plot_missing",
]

SIMULATIONS = {"before": "as given", "recalibrated": "refitted", "augmented": "with what was found"}
CURVES = 3
CANDIDATES = 10
CELLS = 22  # of the map, in each direction
SUPPORTED = 3.0  # times the median error of a curve: what is known less well does not decide about its axis
STAGES = {
    "found": ("found", VERMILLION), "same": ("explains as much", ORANGE),
    "needless": ("explains as much, with more parameters", SKY_BLUE), "less": ("explains less", BLUE),
    "further": ("would add, on top of what was found", GREY), "instead": ("in its place, roughly", GREY),
}  # fmt: skip


@drawn_to_be_read
def plot_curves(
    curves: pd.DataFrame,
    *,
    named: tuple[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    time_unit: str = "1",
) -> Figure | None:
    """Draw what is missing in equations against coordinates, before and after mechanisms were added.

    Parameters
    ----------
    curves
        Columns ``stage equation coordinate across at missing standard_error gain``, one row per knot.
    named
        Equation and coordinate of the mechanism that was named; its curve is drawn first.
    units
        Units of states and inputs.
    time_unit
        Of time, for coordinates and rates.

    Returns
    -------
    matplotlib.figure.Figure or None
        Up to three panels below each other, by what a function of the coordinate alone explains; bands: ± 2
        standard errors, cut off at the edge of the panel. None where there is no curve.
    """
    before = curves[curves["stage"] == "before"] if len(curves) else curves
    if before.empty:
        return None
    keys = ["equation", "coordinate", "across"]
    order = before.groupby(keys, sort=False)["gain"].first().sort_values(ascending=False, kind="stable")
    shown = list(order.index)
    if named is not None:
        shown.sort(key=lambda key: (key[0], key[1]) != named)
    visible = before[before["missing"].abs() > 2 * before["standard_error"]].groupby(keys).size()
    # The first is what the page speaks of; others only if they show something.
    shown = [key for place, key in enumerate(shown) if place == 0 or key in visible.index][:CURVES]
    figure = Figure(figsize=(WIDTH, 0.7 + 2.3 * len(shown)))
    for axes, key in zip(np.atleast_1d(figure.subplots(len(shown), 1)), shown, strict=True):
        equation, coordinate, across = key
        stages = {
            stage: curves[(curves[keys] == list(key)).all(axis=1) & (curves["stage"] == stage)]
            for stage in ("before", "after")
        }
        _draw_curves(axes, stages)
        first = equation.split(", ")[0]
        unit = (units or {}).get(coordinate if coordinate != "amplitude" else first, "1")
        unit = time_unit if coordinate == "t" else unit
        symbol = coordinate if coordinate == "amplitude" else f"${name_label(coordinate)}$"
        axes.set_xlabel(f"{symbol}{axis_unit(unit)}")
        rate = axis_unit(rate_unit((units or {}).get(first, "1"), time_unit))
        where = " and ".join(f"$\\dot{{{name_label(name)}}}$" for name in equation.split(", "))
        axes.set_ylabel(f"missing in {where}\n{rate.strip()}" if rate else f"missing in {where}")
        if across:
            axes.set_title("across the amplitude", loc="left")
    figure.legend(
        handles=[
            Line2D([], [], color=BLUE, marker="o", markersize=4, label="before"),
            Line2D([], [], color=VERMILLION, linestyle="--", marker="s", markersize=4, label="after"),
            Patch(color=GREY, alpha=0.3, label="± 2 standard errors"),
        ],
        loc="outside upper left",
        ncols=3,
        columnspacing=1.2,
    )  # fmt: skip
    return figure


def _draw_curves(axes: Axes, stages: Mapping[str, pd.DataFrame]) -> None:
    """Both curves, with an axis on which the values can be seen, however wide the bands are."""
    low, high = limits_of(stages.values())
    looks = {"before": (BLUE, "-", "o"), "after": (VERMILLION, "--", "s")}
    for stage, (colour, style, marker) in looks.items():
        at, value, error = (
            stages[stage][name].to_numpy(float) for name in ("at", "missing", "standard_error")
        )
        wide = float(np.mean(2 * error > (high - low) / 2)) > 0.5 if len(at) else True
        if wide and stage == "after":
            continue  # the recordings say nothing about it
        # A band that fills the panel would only tint it.
        if not wide:
            band = [np.clip(value + sign * 2 * error, low, high) for sign in (-1, 1)]
            axes.fill_between(at, *band, color=colour, alpha=0.2, linewidth=0)
        axes.plot(at, value, color=colour, linestyle=style, marker=marker, markersize=4)
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.set_ylim(low, high)


def limits_of(curves: Iterable[pd.DataFrame]) -> tuple[float, float]:
    """Limits of an axis by the values of curves where these are supported by data, and zero.

    Parameters
    ----------
    curves
        Each with the columns ``missing standard_error``; a knot whose error is several times the median of
        its curve has hardly any data.
    """
    values = [np.zeros(1)]
    for curve in curves:
        value, error = (curve[name].to_numpy(float) for name in ("missing", "standard_error"))
        known = np.isfinite(value) & np.isfinite(error)
        if known.any():
            supported = known & (error <= SUPPORTED * np.median(error[known]))
            values.append(value[supported])
            # The error of a value that is well known belongs to the picture.
            largest = float(np.abs(value[supported]).max())
            small = supported & (2 * error < largest)
            values += [value[small] - 2 * error[small], value[small] + 2 * error[small]]
    together = np.concatenate(values)
    low, high = float(together.min()), float(together.max())
    margin = 0.15 * ((high - low) or 1.0)
    return low - margin, high + margin


@drawn_to_be_read
def plot_missing(
    points: np.ndarray,
    missing: Mapping[str, np.ndarray],
    *,
    names: tuple[str, str],
    units: Mapping[str, str] | None = None,
    time_unit: str = "1",
    source: str = "",
) -> Figure | None:
    """Draw the missing part of equations over a plane of the state space.

    Parameters
    ----------
    points
        States in the plane, shape ``(n, 2)``.
    missing
        What must be added to each equation there, shape ``(n,)`` each; means over cells are drawn.
    names
        Names of the two states.
    units, time_unit
        Units of states and time.
    source
        Where the numbers are from, in words.

    Returns
    -------
    matplotlib.figure.Figure or None
        A panel for each of up to two equations, below each other; None where nothing is missing anywhere.
    """
    shown = {name: values for name, values in missing.items() if np.isfinite(values).any()}
    shown = dict(sorted(shown.items(), key=lambda each: -float(np.nanstd(each[1])))[:2])
    if not len(points) or not any(np.any(values) for values in shown.values()):
        return None
    figure = Figure(figsize=(WIDTH, 0.4 + 3.2 * len(shown)))
    panels = np.atleast_1d(figure.subplots(len(shown), 1))
    for axes, (name, values) in zip(panels, shown.items(), strict=True):
        known = np.isfinite(values)
        x, y = points[known, 0], points[known, 1]
        counts, *edges = np.histogram2d(x, y, bins=CELLS)
        sums = np.histogram2d(x, y, bins=edges, weights=values[known])[0]
        mean = np.where(counts > 0, sums / np.where(counts > 0, counts, 1), np.nan)
        largest = float(np.nanquantile(np.abs(mean), 0.98)) or 1.0
        image = axes.pcolormesh(
            *edges, mean.T, cmap="PuOr", vmin=-largest, vmax=largest, rasterized=True, linewidth=0
        )
        axes.set_facecolor("#EDEDED")
        first, second = names
        axes.set_xlabel(f"${name_label(first)}${axis_unit((units or {}).get(first, '1'))}")
        axes.set_ylabel(f"${name_label(second)}${axis_unit((units or {}).get(second, '1'))}")
        rate = axis_unit(rate_unit((units or {}).get(name, "1"), time_unit))
        label = f"missing in $\\dot{{{name_label(name)}}}${rate}"
        axes.figure.colorbar(image, ax=axes, extend="both", label=label)
    if source:
        figure.suptitle(source)
    return figure


@drawn_to_be_read
def plot_candidates(table: pd.DataFrame) -> Figure | None:
    """Draw how much mechanisms explain: what was found, what was fitted in its place, what would add to it.

    Parameters
    ----------
    table
        Columns ``label gain stage``, one row per probe; of each label the best counts. For the stages see
        `siq.mismatch.tables.tables_of`.

    Returns
    -------
    matplotlib.figure.Figure or None
        The best ten, as bars, those that were found first; None where nothing would gain anything.
    """
    positive = table[table["gain"] > 0] if len(table) else table
    if positive.empty:
        return None
    best = positive.groupby(["label", "stage"], sort=False)["gain"].max().reset_index()
    best = best.assign(first=best["stage"] != "found")
    best = best.sort_values(["first", "gain"], ascending=[True, False], kind="stable").head(CANDIDATES)[::-1]
    figure = Figure(figsize=(WIDTH, 1.3 + 0.27 * len(best) + 0.1 * best["stage"].nunique()))
    axes = figure.add_subplot()
    places = np.arange(len(best))
    axes.barh(places, best["gain"], color=[STAGES[stage][1] for stage in best["stage"]], height=0.7)
    axes.set_yticks(places, [shortened(text).replace("$", r"\$") for text in best["label"]])
    axes.set_xscale("log")
    axes.set_xlim(left=min(1.0, float(best["gain"].min()) / 2))
    axes.set_xlabel(r"gain in $\chi^2$")
    present = [stage for stage in STAGES if stage in set(best["stage"])]
    handles = [Patch(color=STAGES[stage][1], label=STAGES[stage][0]) for stage in present]
    figure.legend(handles=handles, loc="outside upper left", ncols=1)
    return figure


def shortened(label: str, most: int = 30) -> str:
    """A label that leaves room for its bar."""
    return label if len(label) <= most else f"{label[: most - 1]}…"


@drawn_to_be_read
def plot_escapes(table: pd.DataFrame, *, time_unit: str = "1") -> Figure | None:
    """Draw mean escape times of two simulations against the inverse of the noise intensity.

    Parameters
    ----------
    table
        Columns ``transition intensity simulation time``, one row per way out, simulation and ε.
    time_unit
        Of the times.

    Returns
    -------
    matplotlib.figure.Figure or None
        A colour for each way out, a line style for each simulation; None where there is no way out.
    """
    if table.empty:
        return None
    figure = Figure(figsize=(WIDTH, 3.8))
    axes = figure.add_subplot()
    axes.set_yscale("log")
    colours = (BLUE, VERMILLION, BLACK, ORANGE)
    names, ways = (list(dict.fromkeys(table[column])) for column in ("simulation", "transition"))
    styles = dict(zip(names, ("--", "-"), strict=False))
    for place, way in enumerate(ways[: len(colours)]):
        for name in names:
            rows = table[(table["transition"] == way) & (table["simulation"] == name)]
            if len(rows):
                # Two ways of the same height would hide each other.
                axes.plot(
                    1 / rows["intensity"], rows["time"], color=colours[place],
                    label=f"{way}, {SIMULATIONS.get(name, name)}",
                    linestyle=styles[name], linewidth=2.6 - 1.2 * (place % 2),
                )  # fmt: skip
    axes.set_xlabel(r"$1/\varepsilon$, inverse of the noise intensity")
    axes.set_ylabel(f"mean escape time{axis_unit(time_unit)}")
    figure.legend(loc="outside upper left", ncols=1)
    if len(ways) > len(colours):
        figure.supxlabel(f"{counted(len(ways) - len(colours), 'further way')} out not drawn")
    return figure
