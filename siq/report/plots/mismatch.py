"""Figures of a mismatch: recordings beside simulations, what is missing and where, and what it does."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from siq.report.plots.style import (
    BLACK,
    BLUE,
    COLUMN_WIDTH,
    GREY,
    ORANGE,
    PAGE_WIDTH,
    VERMILLION,
    counted,
    drawn_in_style,
    name_label,
    sentence_figure,
    unit_label,
)

SIMULATIONS = {"before": (GREY, ":"), "recalibrated": (BLUE, "--"), "augmented": (VERMILLION, "-")}
SAMPLES_SHOWN = 300
PANELS = 4  # pairs of recording and output
CURVES = 3
CANDIDATES = 12
CELLS = 22  # of the map, in each direction
BEYOND = 0.6  # of the range of what was measured, by which a panel is higher


@drawn_in_style
def plot_held_out(
    table: pd.DataFrame, *, units: Mapping[str, str] | None = None, time_unit: str = "1"
) -> Figure:
    """Draw held-out recordings with the free runs of three simulations, and how far these are off.

    Parameters
    ----------
    table
        Columns ``recording t output measured before recalibrated augmented scored``, one row per sample and
        output.
    units
        Units of the outputs.
    time_unit
        Of ``t``.

    Returns
    -------
    matplotlib.figure.Figure
        A row for each of up to four pairs of recording and output: the courses, and simulation - recording.
        Of a long recording the end is drawn, where simulations are off the furthest.
    """
    scored = table[table["scored"].astype(bool)]
    if scored.empty:
        return sentence_figure("No recording was held out.")
    outputs = list(dict.fromkeys(scored["output"]))
    recordings = list(dict.fromkeys(scored["recording"]))[: max(1, PANELS // len(outputs))]
    pairs = [(recording, output) for recording in recordings for output in outputs][:PANELS]
    figure = Figure(figsize=(PAGE_WIDTH, 0.6 + 1.5 * len(pairs)))
    axes = figure.subplots(len(pairs), 2, squeeze=False)
    for (recording, output), (left, right) in zip(pairs, axes, strict=True):
        rows = scored[(scored["recording"] == recording) & (scored["output"] == output)].tail(SAMPLES_SHOWN)
        _draw_run(left, right, rows)
        unit = unit_label((units or {}).get(output, "1"))
        left.set_ylabel(f"${name_label(output)}$ {unit}")
        right.set_ylabel(f"error of ${name_label(output)}$ {unit}")
        left.set_title(f"recording {recording}", loc="left")
        right.set_title("simulation − recording", loc="left")
    for side in axes[-1]:
        side.set_xlabel(f"$t$ {unit_label(time_unit)}")
    handles = [Line2D([], [], color=ORANGE, linewidth=2.6, alpha=0.7, label="recording")]
    handles += [
        Line2D([], [], color=colour, linestyle=style, label=name)
        for name, (colour, style) in SIMULATIONS.items()
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=4)
    return figure


def _draw_run(left: Axes, right: Axes, rows: pd.DataFrame) -> None:
    t, measured = rows["t"].to_numpy(float), rows["measured"].to_numpy(float)
    left.plot(t, measured, color=ORANGE, linewidth=2.6, alpha=0.7)
    right.axhline(0.0, color=ORANGE, linewidth=2.6, alpha=0.7)
    # A simulation that runs away would leave the others no room.
    low, high = np.nanmin(measured), np.nanmax(measured)
    room = BEYOND * ((high - low) or abs(high) or 1.0)
    sizes = []
    for name, (colour, style) in SIMULATIONS.items():
        values = rows[name].to_numpy(float)
        left.plot(t, values, color=colour, linestyle=style)
        right.plot(t, values - measured, color=colour, linestyle=style)
        if name != "before":
            error = np.abs(values - measured)
            sizes += [float(np.nanmax(error))] if np.isfinite(error).any() else []
    left.set_ylim(low - room, high + room)
    largest = 1.15 * min(max(sizes, default=room), high - low + room)
    if largest > 0:
        right.set_ylim(-largest, largest)


@drawn_in_style
def plot_curves(
    curves: pd.DataFrame,
    *,
    named: tuple[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    time_unit: str = "1",
) -> Figure:
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
    matplotlib.figure.Figure
        Up to three panels, by what a function of the coordinate alone explains; bands: ± 2 standard errors.
    """
    before = curves[curves["stage"] == "before"] if len(curves) else curves
    if before.empty:
        return sentence_figure("There is no coordinate along which anything could be missing.")
    keys = ["equation", "coordinate", "across"]
    order = before.groupby(keys, sort=False)["gain"].first().sort_values(ascending=False, kind="stable")
    shown = list(order.index)
    if named is not None:
        shown.sort(key=lambda key: (key[0], key[1]) != named)
    shown = shown[:CURVES]
    figure = Figure(figsize=(PAGE_WIDTH, 2.6))
    for axes, key in zip(np.atleast_1d(figure.subplots(1, len(shown))), shown, strict=True):
        equation, coordinate, across = key
        for stage, colour, style in (("before", BLUE, "-"), ("after", VERMILLION, "--")):
            rows = curves[(curves[keys] == list(key)).all(axis=1) & (curves["stage"] == stage)]
            at, value, error = (rows[name].to_numpy(float) for name in ("at", "missing", "standard_error"))
            axes.fill_between(at, value - 2 * error, value + 2 * error, color=colour, alpha=0.22, linewidth=0)
            axes.plot(at, value, color=colour, linestyle=style, marker="o", markersize=2.5)
        axes.axhline(0.0, color=GREY, linewidth=0.6)
        first = equation.split(", ")[0]
        unit = (units or {}).get(coordinate if coordinate != "amplitude" else first, "1")
        unit = time_unit if coordinate == "t" else unit
        symbol = coordinate if coordinate == "amplitude" else f"${name_label(coordinate)}$"
        axes.set_xlabel(f"{symbol} {unit_label(unit)}")
        where = " and ".join(f"${name_label(name)}'$" for name in equation.split(", "))
        axes.set_ylabel(f"missing in {where} {_rate(units, first, time_unit)}")
        direction = ", across" if across else ""
        axes.set_title(f"explains $\\Delta\\chi^2$ = {order[key]:.3g}{direction}", loc="left")
    figure.legend(
        handles=[
            Line2D([], [], color=BLUE, marker="o", markersize=2.5, label="recalibrated"),
            Line2D([], [], color=VERMILLION, linestyle="--", marker="o", markersize=2.5, label="at the end"),
            Patch(color=GREY, alpha=0.3, label="± 2 standard errors"),
        ],
        loc="outside upper center",
        ncols=3,
    )  # fmt: skip
    return figure


def _rate(units: Mapping[str, str] | None, name: str, time_unit: str) -> str:
    unit = (units or {}).get(name, "1")
    if time_unit in ("1", ""):
        return unit_label(unit)
    return f"({unit}/{time_unit})" if unit not in ("1", "") else f"(1/{time_unit})"


@drawn_in_style
def plot_missing(
    points: np.ndarray,
    missing: Mapping[str, np.ndarray],
    *,
    names: tuple[str, str],
    units: Mapping[str, str] | None = None,
    time_unit: str = "1",
    source: str = "",
) -> Figure:
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
    matplotlib.figure.Figure
        A panel for each of up to two equations.
    """
    shown = {name: values for name, values in missing.items() if np.isfinite(values).any()}
    shown = dict(sorted(shown.items(), key=lambda each: -float(np.nanstd(each[1])))[:2])
    if not len(points) or not any(np.any(values) for values in shown.values()):
        return sentence_figure("Nothing is missing at any recorded state.")
    figure = Figure(figsize=(COLUMN_WIDTH * max(len(shown), 1.3), 3.0))
    panels = np.atleast_1d(figure.subplots(1, len(shown)))
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
        axes.set_xlabel(f"${name_label(first)}$ {unit_label((units or {}).get(first, '1'))}")
        axes.set_ylabel(f"${name_label(second)}$ {unit_label((units or {}).get(second, '1'))}")
        label = f"missing in ${name_label(name)}'$ {_rate(units, name, time_unit)}"
        axes.figure.colorbar(image, ax=axes, extend="both", label=label)
    if source:
        figure.suptitle(source, fontsize=8)
    return figure


@drawn_in_style
def plot_candidates(table: pd.DataFrame) -> Figure:
    """Draw how much mechanisms explain: what was found, and what others would add to it.

    Parameters
    ----------
    table
        Columns ``label gain stage``, one row per probe; of each label the best counts. Stages are ``found``,
        ``same`` for what cannot be told from it, and ``further``.

    Returns
    -------
    matplotlib.figure.Figure
        The best twelve, as bars.
    """
    positive = table[table["gain"] > 0] if len(table) else table
    if positive.empty:
        return sentence_figure("No mechanism of the dictionary would explain anything.")
    best = positive.groupby(["label", "stage"], sort=False)["gain"].max().reset_index()
    best = best.sort_values("gain", ascending=False, kind="stable").head(CANDIDATES)[::-1]
    kinds = {
        "found": ("found", VERMILLION), "same": ("not to be told from it", ORANGE),
        "further": ("would explain on top of what was found", GREY),
    }  # fmt: skip
    figure = Figure(figsize=(PAGE_WIDTH, 0.8 + 0.21 * len(best)))
    axes = figure.add_subplot()
    colours = [kinds[stage][1] for stage in best["stage"]]
    axes.barh(np.arange(len(best)), best["gain"], color=colours, height=0.7)
    axes.set_yticks(np.arange(len(best)), [text.replace("$", r"\$") for text in best["label"]])
    axes.set_xscale("log")
    lowest = float(best["gain"].min())
    axes.set_xlim(left=min(1.0, lowest / 2))
    axes.set_xlabel(r"gain in $\chi^2$ over the simulation without it")
    handles = [Patch(color=colour, label=words) for words, colour in kinds.values() if colour in colours]
    figure.legend(handles=handles, loc="outside upper center", ncols=3)
    return figure


@drawn_in_style
def plot_escapes(table: pd.DataFrame, *, time_unit: str = "1") -> Figure:
    """Draw mean escape times of two simulations against the inverse of the noise intensity.

    Parameters
    ----------
    table
        Columns ``transition intensity simulation time``, one row per way out, simulation and ε.
    time_unit
        Of the times.

    Returns
    -------
    matplotlib.figure.Figure
        A colour for each way out, a line style for each simulation.
    """
    if table.empty:
        return sentence_figure("There is no way out of any well in both simulations.")
    figure = Figure(figsize=(COLUMN_WIDTH * 1.3, 3.0))
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
                    1 / rows["intensity"], rows["time"], color=colours[place], label=f"{way}, {name}",
                    linestyle=styles[name], linewidth=2.2 - 1.2 * (place % 2),
                )  # fmt: skip
    axes.set_xlabel(r"$1/\varepsilon$, inverse of the noise intensity")
    axes.set_ylabel("mean escape time " + ("(time units)" if time_unit in ("1", "") else f"({time_unit})"))
    figure.legend(loc="outside upper center", ncols=2)
    if len(ways) > len(colours):
        figure.supxlabel(f"{counted(len(ways) - len(colours), 'further way')} out not drawn", fontsize=7)
    return figure
