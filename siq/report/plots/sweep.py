"""A control parameter, or a drift: where wells begin and end, how deep they are, how long they last."""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from siq.report.plots.style import (
    BLACK,
    BLUE,
    COLUMN_WIDTH,
    GREY,
    VERMILLION,
    axis_label,
    drawn_in_style,
    look,
    unit_label,
)
from siq.report.summary import well_name

BIFURCATIONS = {"fold": "o", "Hopf": "s", "branch point": "D", "fold of cycles": "^"}
PANEL = 2.2  # inches
BEYOND = 1e30  # for infinite ends of intervals, which go on beyond the panel
CURVES = {"fold": "-", "Hopf": "--"}
CURVE = "white"
OUTLINED = (withStroke(linewidth=2.4, foreground=BLACK),)  # seen on the dark and on the bright end of a map


@drawn_in_style
def plot_sweep(
    table: pd.DataFrame, branches: pd.DataFrame, bifurcations: pd.DataFrame, *, parameters: Sequence[str],
    states: Sequence[str], units: Mapping[str, str] | None = None, state: str | None = None,
    curves: pd.DataFrame | None = None,
) -> Figure:  # fmt: skip
    """Draw a sweep.

    Parameters
    ----------
    table, branches, bifurcations
        As `siq.Sweep` has them.
    parameters, states
        Their names.
    units
        By name; of the time as ``t``.
    state
        Which state is drawn above; by default the first.
    curves
        Of two parameters, where equilibria fold or begin to oscillate; by default none are drawn.

    Returns
    -------
    matplotlib.figure.Figure
        Of one parameter: equilibria and the extents of cycles, stable ones as lines of their well's colour
        and unstable ones dashed, with folds, Hopf points and branch points; below it the lowest barrier of
        every well, and, where the noise is known, how long each lasts and its share of time in the long run.
        Of two: maps of the number of wells and of the lowest barrier, with curves of folds and Hopf points.
    """
    units = units or {}
    if len(parameters) > 1:
        return _map(table, parameters, units, curves)
    place = 0 if state is None else list(states).index(state)
    columns = [name for name in ("barrier", "mean_time", "weight") if np.isfinite(table[name]).any()]
    figure = Figure(figsize=(COLUMN_WIDTH, PANEL * (1.2 + len(columns))))
    rows = figure.subplots(
        1 + len(columns), 1, sharex=True, squeeze=False, height_ratios=[1.2, *[1] * len(columns)]
    )[:, 0]
    _draw_branches(rows[0], branches, bifurcations, place)
    rows[0].set_ylabel(axis_label(states[place], units.get(states[place], "1")))
    labels = {
        "barrier": "barrier ΔU (unit of ε)",
        "mean_time": "mean time "
        + ("(time units)" if units.get("t", "1") in ("1", "") else unit_label(units["t"])),
        "weight": "share of time",
    }
    for axes, name in zip(rows[1:], columns, strict=True):
        for well in sorted({int(one) for one in table["well"] if one >= 0}):
            some = table[table["well"] == well]
            colour, style, marker = look(well)
            axes.plot(
                some["value"], some[name], color=colour, linestyle=style, marker=marker, markersize=3,
                linewidth=1.2,
            )  # fmt: skip
        axes.set_ylabel(labels[name])
        for value in bifurcations["value"]:
            axes.axvline(value, color=GREY, linewidth=0.5, linestyle=":")
    if "mean_time" in columns:
        rows[1 + columns.index("mean_time")].set_yscale("log")
    rows[-1].set_xlabel(axis_label(parameters[0], units.get(parameters[0], "1")))
    figure.legend(handles=_handles(table, branches, bifurcations), loc="outside upper center", ncols=3)
    return figure


@drawn_in_style
def plot_early_warning(
    course: pd.DataFrame, probability: pd.DataFrame, *, state: str, time_unit: str | None = None
) -> Figure:
    """Draw an early warning: its course and its probability, as `siq.early_warning` gives them.

    Barrier over noise and mean time along the record, and the probability of having left the state
    afterwards, each with its 90 % interval; an interval without an upper end goes on beyond the panel.
    `state` is the name of the column, `time_unit` the unit of its time.
    """
    figure = Figure(figsize=(COLUMN_WIDTH, 3 * PANEL))
    panels = figure.subplots(3, 1, sharex=True)
    columns = ("barrier_over_noise", "mean_time", "probability")
    for axes, table, name in zip(panels, (course, course, probability), columns, strict=True):
        short = {"barrier_over_noise": "barrier_", "mean_time": "mean_time_", "probability": ""}[name]
        lower, upper = (table[f"{short}{end}"].clip(upper=BEYOND) for end in ("lower", "upper"))
        colour = VERMILLION if name == "probability" else BLUE
        axes.fill_between(table["time"], lower, upper, color=colour, alpha=0.2, linewidth=0)
        axes.plot(table["time"], table[name], color=colour)
        axes.axvline(course["time"].iloc[-1], color=GREY, linewidth=0.5, linestyle=":")
        finite = table[name][np.isfinite(table[name])]
        if name == "probability":
            axes.set_ylim(0, 1)
        elif name == "mean_time":
            axes.set_yscale("log")
            axes.set_ylim(lower.min() / 2, 30 * finite.max() if len(finite) else 1e3 * lower.min())
        else:
            axes.set_ylim(0, 1.5 * finite.max() if len(finite) else 2 * lower.min())
    panels[0].set_ylabel(f"barrier of {state} ΔU/ε")
    panels[1].set_ylabel("mean time" + (f" {unit_label(time_unit)}" if time_unit else ""))
    panels[2].set_ylabel("probability\nof having left")
    panels[2].set_xlabel(axis_label("time", time_unit or "1"))
    return figure


def _draw_branches(axes: Axes, branches: pd.DataFrame, bifurcations: pd.DataFrame, place: int) -> None:
    ends = pd.concat([branches.assign(end=name, at=branches[name]) for name in ("least", "largest")])
    ends["state"] = [float(ast.literal_eval(text)[place]) for text in ends["at"]]
    for _, rows in ends.groupby(["branch", "end"]):
        # Neighbouring stretches share a point, or a gap would part them.
        change = np.flatnonzero(np.diff(rows["well"].to_numpy())) + 1
        for first, last in pairwise([0, *change, len(rows)]):
            some = rows.iloc[first : last + 1]
            well = int(rows["well"].iloc[first])
            colour, line, width = (look(well)[0], "-", 1.6) if well >= 0 else (GREY, "--", 0.8)
            axes.plot(some["value"], some["state"], color=colour, linestyle=line, linewidth=width)
    for kind, marker in BIFURCATIONS.items():
        rows = bifurcations[bifurcations["kind"] == kind]
        at = [ast.literal_eval(text)[place] for text in rows["position"]]
        axes.plot(rows["value"], at, linestyle="none", marker=marker, markersize=4.5, color=BLACK)


def _handles(table: pd.DataFrame, branches: pd.DataFrame, bifurcations: pd.DataFrame) -> list[Line2D]:
    handles = [
        Line2D([], [], color=colour, marker=marker, linestyle=style, markersize=3, label=well_name(well))
        for well in sorted({int(well) for well in table["well"] if well >= 0})
        for colour, style, marker in [look(well)]
    ]
    if (branches["well"] < 0).any():
        handles.append(Line2D([], [], color=GREY, linestyle="--", linewidth=0.8, label="unstable"))
    handles += [
        Line2D([], [], color=BLACK, linestyle="none", marker=marker, markersize=4.5, label=kind)
        for kind, marker in BIFURCATIONS.items()
        if (bifurcations["kind"] == kind).any()
    ]
    return handles


def _map(
    table: pd.DataFrame, parameters: Sequence[str], units: Mapping[str, str], curves: pd.DataFrame | None
) -> Figure:
    """How many wells there are, and the lowest barrier among them, against two parameters."""
    grid = table.assign(one=(table["well"] >= 0).astype(float)).groupby(["second_value", "value"])
    count, lowest = grid["one"].sum().unstack(), grid["barrier"].min().unstack()
    figure = Figure(figsize=(COLUMN_WIDTH, 2.6 * PANEL))
    panels = figure.subplots(2, 1, sharex=True)
    for axes, values, label in zip(
        panels, (count, lowest), ("number of stable states", "lowest barrier ΔU (unit of ε)"), strict=True
    ):
        drawn = axes.pcolormesh(
            values.columns, values.index, values.to_numpy(float), shading="nearest", cmap="cividis"
        )
        bar = figure.colorbar(drawn, ax=axes, label=label)
        if values is count:
            bar.set_ticks(sorted(set(count.to_numpy().ravel())))
        axes.set_ylabel(axis_label(parameters[1], units.get(parameters[1], "1")))
        if curves is not None:
            limits = axes.get_xlim(), axes.get_ylim()  # those of the cells stay
            for _, rows in curves.groupby("curve"):
                axes.plot(
                    rows["value"], rows["second_value"], color=CURVE, linestyle=CURVES[rows["kind"].iloc[0]],
                    linewidth=1.2, path_effects=OUTLINED,
                )  # fmt: skip
            axes.set(xlim=limits[0], ylim=limits[1])
    handles = [
        Line2D([], [], color=CURVE, linestyle=CURVES[kind], path_effects=OUTLINED, label=kind)
        for kind in CURVES
        if curves is not None and (curves["kind"] == kind).any()
    ]
    if handles:
        figure.legend(handles=handles, loc="outside upper center", ncols=len(handles))
    panels[-1].set_xlabel(axis_label(parameters[0], units.get(parameters[0], "1")))
    return figure
