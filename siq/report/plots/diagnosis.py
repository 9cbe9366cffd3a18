"""Figures of a diagnosis: recordings beside simulations, what is missing and where.

A figure without anything to draw is None. Tables of what was held out have the columns ``recording t output
measured before recalibrated augmented scored``, a row for each sample and output. `units` are those of
states, inputs and outputs by name, `time_unit` that of time.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import scipy.interpolate
from matplotlib.axes import Axes
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from siq.diagnosis.dictionary import unit_of
from siq.inference.trajectories import scored_rows
from siq.numerics.text import value_text
from siq.report.diagnosis_page import largest_difference
from siq.report.formatting import with_unit
from siq.report.plots.quasipotential import new_axes, with_legend
from siq.report.plots.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY_BLUE,
    VERMILLION,
    WIDTH,
    axis_label,
    counted,
    drawn_to_be_read,
    name_label,
    scaled_label,
)

if TYPE_CHECKING:
    from siq.diagnosis.diagnosis import Diagnosis
    from siq.diagnosis.statement import Statement
    from siq.inference.measurements import Measurements


SAMPLES_SHOWN = 300
PAIRS = 4  # of recording and output
BEYOND = 0.35  # of the range of what was measured, by which a panel is higher
WORDS = {
    "before": ("simulated as given", BLUE, "--"),
    "recalibrated": ("with its own parameters refitted", VERMILLION, "-"),
    "augmented": ("with what was found", VERMILLION, "-"),
}


@drawn_to_be_read
def plot_before_after(
    table: pd.DataFrame, *, after: str, noise: Mapping[str, float] | None = None,
    units: Mapping[str, str] | None = None, time_unit: str = "1",
) -> Figure | None:  # fmt: skip
    """Draw the held-out recording that differs most, with the simulation before and after.

    The course stands above, simulation minus recording below. `after` is the simulation that the verdict ends
    with: ``"augmented"``, ``"recalibrated"``, or ``"before"`` where nothing is to be changed. `noise` is the
    variance of the sensor's noise by output, for a band of ± 2 standard deviations.
    """
    largest = largest_difference(table, after=after)
    if largest is None:
        return None
    output = largest["output"]
    figure = Figure(figsize=(WIDTH, 4.2))
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.7, 1])
    shown = list(dict.fromkeys(("before", after)))
    rows = _rows(table, largest["recording"], output)
    _draw(
        upper, lower, rows, shown, (units or {}).get(output, "1"), time_unit, noise=(noise or {}).get(output)
    )
    _legend_of(upper)
    return figure


@drawn_to_be_read
def plot_held_out(
    table: pd.DataFrame, *, units: Mapping[str, str] | None = None, time_unit: str = "1"
) -> Figure | None:
    """Draw held-out recordings with the free runs of all three simulations.

    Each of up to four pairs of recording and output has two panels below each other: the courses, and
    simulation minus recording.
    """
    scored = table[table["scored"].astype(bool)]
    if scored.empty:
        return None
    outputs = list(dict.fromkeys(scored["output"]))
    recordings = list(dict.fromkeys(scored["recording"]))[: max(1, PAIRS // len(outputs))]
    pairs = [(recording, output) for recording in recordings for output in outputs][:PAIRS]
    # Where nothing was added two of the three simulations are one.
    same = np.array_equal(scored["recalibrated"], scored["augmented"], equal_nan=True)
    shown = ["before", "recalibrated", *([] if same else ["augmented"])]
    figure = Figure(figsize=(WIDTH, 0.6 + 2.9 * len(pairs)))
    axes = figure.subplots(2 * len(pairs), 1, height_ratios=[1.5, 1] * len(pairs))
    for (recording, output), (upper, lower) in zip(pairs, axes.reshape(-1, 2), strict=True):
        rows, unit = _rows(table, recording, output), (units or {}).get(output, "1")
        _draw(upper, lower, rows, shown, unit, time_unit)
        upper.set_title(f"recording {recording}", loc="left")
        upper.tick_params(labelbottom=False)
    _legend_of(axes[0])
    return figure


@drawn_to_be_read
def plot_ladder(statement: Statement) -> Figure | None:
    """Draw the error on held-out recordings step by step, down to the measurement noise.

    As given, with its own parameters refitted, with each mechanism that is named on top of those before it,
    and with the model of what has no name. None where no errors are known.
    """
    errors, described = statement.errors, statement.described
    if errors.noise_floor is None or not errors.noise_floor > 0:
        return None
    last = errors.named if described and statement.mechanisms else errors.augmented
    named = () if statement.random_forces else statement.mechanisms
    steps = [("as given", errors.before, GREY, "s")]
    if errors.recalibrated != errors.before:  # otherwise no refit was better
        steps.append(("parameters refitted", errors.recalibrated, BLUE, "D"))
    for place, (each, error) in enumerate(zip(named, (*errors.rungs, last), strict=False)):
        steps.append((f"{'and' if place else 'with'} {each.label}", error, VERMILLION, "o"))
    if described:
        what = " and ".join(each.label for each in described)
        steps.append((f"{'and' if named else 'with'} {what}", errors.augmented, PURPLE, "^"))
    scale, unit = (100.0, "%") if errors.spread is None else (errors.spread, errors.unit)
    known = [scale * error for _, error, *_ in steps if error is not None] + [scale * errors.noise_floor]
    lowest, highest = 0.7 * min(known), 1.4 * max(known)
    figure = Figure(figsize=(WIDTH, 1.3 + 0.55 * len(steps)))
    axes = figure.subplots()
    axes.set_xscale("log")
    for place, (label, error, colour, marker) in enumerate(steps):
        at = highest if error is None else scale * error
        axes.plot([scale * errors.noise_floor, at], [place, place], color=colour, linewidth=2)
        if error is not None:
            axes.plot(at, place, marker, color=colour, markersize=7)
        said = "runs away" if error is None else value_text(at, unit=unit, digits=3)
        axes.text(1.08 * scale * errors.noise_floor, place - 0.15, f"{label}: {said}", va="bottom")
    axes.axvline(scale * errors.noise_floor, color=BLACK, linestyle=":", label="measurement noise")
    if errors.floor not in (None, errors.noise_floor):
        axes.axvline(scale * errors.floor, color=GREEN, linestyle="--", label="and process noise")
    axes.set_xlim(lowest, highest)
    axes.set_ylim(len(steps) - 0.6, -0.8)
    axes.set_yticks([])
    whole = "error on held-out recordings"
    axes.set_xlabel(f"{whole}, % of their spread" if errors.spread is None else with_unit(whole, unit))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return figure


def _rows(table: pd.DataFrame, recording: str, output: str) -> pd.DataFrame:
    mine = table[(table["recording"].astype(str) == recording) & (table["output"] == output)]
    return mine[mine["scored"].astype(bool)].tail(SAMPLES_SHOWN)


def _draw(
    upper: Axes, lower: Axes, rows: pd.DataFrame, shown: list[str], unit: str, time_unit: str, *,
    noise: float | None = None,
) -> None:  # fmt: skip
    """One recording of one output with some simulations, and below it what these are off by."""
    t, measured = rows["t"].to_numpy(float), rows["measured"].to_numpy(float)
    size = 3.5 if len(t) <= 100 else 2.2
    upper.plot(
        t, measured, "o", color=BLACK, markersize=size, markeredgewidth=0, alpha=0.75, label="recorded"
    )
    low, high = np.nanmin(measured), np.nanmax(measured)
    room = BEYOND * ((high - low) or abs(high) or 1.0)
    if noise is not None and noise > 0:
        band = 2 * float(np.sqrt(noise))
        lower.axhspan(-band, band, color=GREY, alpha=0.25, linewidth=0)
    lower.axhline(0.0, color=BLACK, linewidth=0.7)
    largest = 0.0
    for name in shown:
        label, colour, style = WORDS[name]
        style = "-" if len(shown) == 1 else style
        if name == "recalibrated" and "augmented" in shown:
            colour, style = GREY, ":"
        values = rows[name].to_numpy(float)
        upper.plot(t, values, color=colour, linestyle=style, label=label)
        lower.plot(t, values - measured, color=colour, linestyle=style)
        error = np.abs(values - measured)
        largest = max(largest, float(np.nanmax(error)) if np.isfinite(error).any() else 0.0)
    # A simulation that runs away would leave the others no room.
    upper.set_ylim(low - room, high + room)
    largest = 1.1 * min(largest, high - low + room)
    if largest > 0:
        lower.set_ylim(-largest, largest)
    upper.set_ylabel(axis_label(str(rows["output"].iloc[0]), unit))
    lower.set_ylabel(with_unit("error", unit))
    lower.set_xlabel(axis_label("t", time_unit))


def _legend_of(axes: Axes) -> None:
    """A legend of a panel's curves above the whole figure."""
    axes.figure.legend(
        *axes.get_legend_handles_labels(), loc="outside upper left", ncols=2, handlelength=1.6,
        columnspacing=1.2,
    )  # fmt: skip


POINTS = 200
LEVELS = 20  # an even number of edges, so that zero lies within the white one
BAND = 1.96  # standard errors within which 95 % lie


@drawn_to_be_read
def plot_described(
    described: Sequence[Mapping[str, Any]], *, units: Mapping[str, str] | None = None, time_unit: str = "1"
) -> Figure | None:
    """Draw every curve and every surface of a model, a panel for each, with bands of 95 % between knots.

    They are as ``verdict.json`` has them; see `siq.diagnosis.statement.StatedTerm`.
    """
    shown = [each for each in described if each.get("curve") or each.get("surface")]
    if not shown:
        return None
    figure = Figure(figsize=(WIDTH, 0.4 + 2.4 * len(shown)))
    for axes, each in zip(np.atleast_1d(figure.subplots(len(shown), 1)), shown, strict=True):

        def with_unit(name: str) -> str:
            return _coordinate_label(name, time_unit if name == "t" else (units or {}).get(name, "1"))

        targets = " and ".join(f"${name_label(name)}$" for name in (*each["equations"], *each["outputs"]))
        where = f"added {'in the equation of' if each['equations'] else 'in the measurement of'} {targets}"
        if each.get("curve"):
            _draw_curve(axes, each["curve"])
            axes.set_xlabel(with_unit(each["curve"]["coordinate"]))
            axes.set_ylabel(where)
            if len(each["coordinates"]) > 1:
                axes.set_title(f"the coefficient of ${name_label(each['coordinates'][1])}$", loc="left")
        else:
            figure.colorbar(_draw_surface(axes, each["surface"]), ax=axes, label=where)
            first, second = each["surface"]["coordinates"]
            axes.set_xlabel(with_unit(first))
            axes.set_ylabel(with_unit(second))
    return figure


def _draw_curve(axes: Axes, curve: Mapping[str, Any]) -> None:
    """A function of one coordinate, its values at knots and its band."""
    at, value, error = (np.array(curve[name]) for name in ("at", "value", "standard_error"))
    fine = np.linspace(at[0], at[-1], POINTS)
    middle, wide = (
        scipy.interpolate.make_interp_spline(at, values, bc_type="natural")(fine)
        if len(at) > 3
        else np.interp(fine, at, values)
        for values in (value, error)
    )
    half = BAND * np.abs(wide)
    axes.fill_between(fine, middle - half, middle + half, color=BLUE, alpha=0.2, linewidth=0)
    axes.plot(fine, middle, color=BLUE)
    axes.plot(at, value, "o", color=BLUE, markersize=4)
    axes.axhline(0.0, color=GREY, linewidth=0.8)


def _draw_surface(axes: Axes, surface: Mapping[str, Any]) -> ContourSet:
    """A function of two coordinates in colours, white where it is zero; dotted where it may well be zero."""
    first, second = (np.array(each) for each in surface["at"])
    value, error = (np.array(surface[name]).T for name in ("value", "standard_error"))
    most = max(float(np.abs(value).max()), np.finfo(float).tiny)
    levels = np.linspace(-most, most, LEVELS)
    drawn = axes.contourf(first, second, value, levels=levels, cmap="PuOr")
    unclear = np.abs(value) <= BAND * error
    axes.contourf(first, second, unclear.astype(float), levels=[0.5, 1.5], colors="none", hatches=["..."])
    return drawn


DIAGNOSIS_SAMPLES_SHOWN = 400  # of a long recording the end, where simulations are off the furthest
DIAGNOSIS_BEYOND = 0.6  # of the range of what was measured, by which the axis is longer
RECORDED: dict[str, Any] = {"color": ORANGE, "linewidth": 4.0, "alpha": 0.55, "label": "recording"}
SIMULATED: dict[str, dict[str, Any]] = {
    "before": {"color": GREY, "linestyle": (0, (1, 1)), "linewidth": 1.8, "label": "simulation as given"},
    "recalibrated": {
        "color": BLUE,
        "linestyle": (0, (4, 2)),
        "linewidth": 1.5,
        "label": "parameters refitted",
    },
    "augmented": {"color": VERMILLION, "linestyle": "-", "linewidth": 1.5, "label": "with what was found"},
}


def plot_diagnosis(
    diagnosis: Diagnosis, *, output: str | None = None, recording: str | None = None, legend: bool = True,
    ax: Axes | None = None,
) -> Axes:  # fmt: skip
    """Draw a recording that was held out, and the simulation before and after.

    Main arguments
    --------------
    diagnosis
        What `siq.diagnose` gave.

    Other arguments
    ---------------
    output
        Which output is shown; by default the first.
    recording
        Which held-out recording; by default the one in which the simulation as it was is off the most.
    legend
        Whether to say below the axes which line is which.
    ax
        Where; by default new axes of pyplot.

    Returns
    -------
    matplotlib.axes.Axes
        Measured values as a broad line, and the simulation as given, with its own parameters refitted, and
        with what was found.
    """
    axes = new_axes() if ax is None else ax
    case, place, rows = _shown(diagnosis, output, recording)
    t, measured = case.t[rows], case.outputs[rows, place]
    handles = axes.plot(t, measured, **RECORDED)
    for values, look in _simulations(diagnosis):
        handles += axes.plot(t, values[rows, place], **look)
    # A simulation that runs away would leave the others no room.
    low, high = np.nanmin(measured), np.nanmax(measured)
    room = DIAGNOSIS_BEYOND * ((high - low) or abs(high) or 1.0)
    axes.set_ylim(low - room, high + room)
    _name(axes, diagnosis, place, t, "")
    return with_legend(axes, handles, legend=legend)


def draw_errors(axes: Axes, diagnosis: Diagnosis, *, output: str | None = None) -> list[Any]:
    """Draw simulation minus recording, held out; what is returned belongs into the legend."""
    case, place, rows = _shown(diagnosis, output, None)
    t, measured = case.t[rows], case.outputs[rows, place]
    handles: list[Any] = []
    sizes: list[float] = []
    for values, look in _simulations(diagnosis):
        error = values[rows, place] - measured
        handles += axes.plot(t, error, **look)
        known = np.abs(error[np.isfinite(error)])
        sizes.append(float(known.max()) if len(known) else np.inf)
    axes.axhline(0.0, color=BLACK, linewidth=0.6, zorder=0)
    largest = min(sizes[0], (np.nanmax(measured) - np.nanmin(measured)) or np.inf)
    largest = max(largest, *(size for size in sizes[1:] if size <= 2 * largest), 0.0)
    if 0 < largest < np.inf:
        axes.set_ylim(-1.1 * largest, 1.1 * largest)
    _name(axes, diagnosis, place, t, "simulation − recording, ")
    return handles


def _simulations(diagnosis: Diagnosis) -> list[tuple[np.ndarray, dict[str, Any]]]:
    names = [name for name in SIMULATED if name != "augmented" or diagnosis.mechanisms]
    return [(getattr(diagnosis.held_out, name), SIMULATED[name]) for name in names]


def _shown(
    diagnosis: Diagnosis, output: str | None, recording: str | None
) -> tuple[Measurements, int, np.ndarray]:
    """The held-out recordings, the place of the output, and the rows that are drawn."""
    case = diagnosis.case.kept
    names = diagnosis.case.system.output_names
    if output is not None and output not in names:
        raise ValueError(f"there is no output {output}; name one of {', '.join(names)}")
    if recording is not None and recording not in case.labels:
        raise ValueError(f"no recording {recording} was held out; name one of {', '.join(case.labels)}")
    place = 0 if output is None else names.index(output)
    parts = [np.arange(*ends) for ends in zip(case.first[:-1], case.first[1:], strict=True)]
    scored = scored_rows(case)
    parts = [part[scored[part]] for part in parts]
    error = np.abs(diagnosis.held_out.before[:, place] - case.outputs[:, place])
    error = np.nan_to_num(error, nan=np.inf)
    worst = max(
        range(len(parts)), key=lambda one: float(np.median(error[parts[one]])) if len(parts[one]) else -1.0
    )
    chosen = worst if recording is None else case.labels.index(recording)
    return case, place, parts[chosen][-DIAGNOSIS_SAMPLES_SHOWN:]


def _name(axes: Axes, diagnosis: Diagnosis, place: int, t: np.ndarray, what: str) -> None:
    system = diagnosis.case.system
    name, formula = system.outputs[place]
    unit = dict(zip(system.states, system.units, strict=True)).get(str(formula), "1")
    largest = max(abs(limit) for limit in axes.get_ylim())
    axes.set_ylabel(scaled_label(axes.yaxis, f"{what}${name_label(name)}$", unit, largest))
    axes.set_xlabel(scaled_label(axes.xaxis, "$t$", system.time_unit, float(np.abs(t).max(initial=0.0))))


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
    curves: pd.DataFrame, *, named: tuple[str, str] | None = None, units: Mapping[str, str] | None = None,
    time_unit: str = "1",
) -> Figure | None:  # fmt: skip
    """Draw what is missing in equations against coordinates, before and after mechanisms were added.

    There are up to three panels, by what a function of the coordinate alone explains, with bands of ± 2
    standard errors, cut off at the edge. The table has the columns ``stage equation coordinate across at
    missing standard_error gain``, a row for each knot. The curve of the mechanism that was named, given by
    equation and coordinate, is drawn first.
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
        unit = (units or {}).get(coordinate if coordinate != "amplitude" else equation.split(", ")[0], "1")
        unit = time_unit if coordinate == "t" else unit
        axes.set_xlabel(_coordinate_label(coordinate, unit))
        axes.set_ylabel(_missing_label(equation, units, time_unit).replace(" (", "\n("))
        if across:
            axes.set_title("across the amplitude", loc="left")
    figure.legend(
        handles=[
            Line2D([], [], color=BLUE, marker="o", markersize=4, label="before"),
            Line2D([], [], color=VERMILLION, linestyle="--", marker="s", markersize=4, label="after"),
            Patch(color=GREY, alpha=0.3, label="± 2 standard errors"),
        ],
        loc="outside upper left", ncols=3, columnspacing=1.2,
    )  # fmt: skip
    return figure


def _coordinate_label(name: str, unit: str) -> str:
    return with_unit(name, unit) if name == "amplitude" else axis_label(name, unit)


def _missing_label(equation: str, units: Mapping[str, str] | None, time_unit: str) -> str:
    """What is missing in one equation, or in several with commas between them, with its unit."""
    names = equation.split(", ")
    where = " and ".join(f"$\\dot{{{name_label(name)}}}$" for name in names)
    rate = unit_of("_x/_t", {"_x": (units or {}).get(names[0], "1") or "1", "_t": time_unit or "1"})
    return with_unit(f"missing in {where}", rate)


def _draw_curves(axes: Axes, stages: Mapping[str, pd.DataFrame]) -> None:
    """Both curves, with an axis on which the values can be seen, however wide the bands are."""
    low, high = _limits_of(stages.values())
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


def _limits_of(curves: Iterable[pd.DataFrame]) -> tuple[float, float]:
    """Limits of an axis by zero, and by the values of curves where data support them."""
    values = [np.zeros(1)]
    for curve in curves:
        value, error = (curve[name].to_numpy(float) for name in ("missing", "standard_error"))
        known = np.isfinite(value) & np.isfinite(error)
        if known.any():
            supported = known & (error <= SUPPORTED * np.median(error[known]))
            values.append(value[supported])
            # The error of a value that is well known belongs to the picture.
            small = supported & (2 * error < float(np.abs(value[supported]).max()))
            values += [value[small] - 2 * error[small], value[small] + 2 * error[small]]
    together = np.concatenate(values)
    low, high = float(together.min()), float(together.max())
    margin = 0.15 * ((high - low) or 1.0)
    return low - margin, high + margin


@drawn_to_be_read
def plot_missing(
    points: np.ndarray, missing: Mapping[str, np.ndarray], *, names: tuple[str, str],
    units: Mapping[str, str] | None = None, time_unit: str = "1", source: str = "",
) -> Figure | None:  # fmt: skip
    """Draw the missing part of equations over a plane of the state space, given by the `names` of two states.

    At points ``(n, 2)`` of the plane `missing` is what must be added to each equation, shape ``(n,)`` each.
    Means over cells are drawn, a panel for each of up to two equations; `source` says in words where the
    numbers are from.
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
        axes.set_xlabel(axis_label(first, (units or {}).get(first, "1")))
        axes.set_ylabel(axis_label(second, (units or {}).get(second, "1")))
        axes.figure.colorbar(image, ax=axes, extend="both", label=_missing_label(name, units, time_unit))
    if source:
        figure.suptitle(source)
    return figure


@drawn_to_be_read
def plot_candidates(table: pd.DataFrame) -> Figure | None:
    """Draw how much mechanisms explain: what was found, what was fitted in its place, what would add to it.

    The best ten are bars, those that were found first. The table has the columns ``label gain stage``, a row
    for each probe, of which the best of each label counts; for the stages see
    `siq.diagnosis.diagnosis.tables_of`.
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
    labels = [text if len(text) <= 30 else f"{text[:29]}…" for text in best["label"]]  # room for the bars
    axes.barh(places, best["gain"], color=[STAGES[stage][1] for stage in best["stage"]], height=0.7)
    axes.set_yticks(places, [text.replace("$", r"\$") for text in labels])
    axes.set_xscale("log")
    axes.set_xlim(left=min(1.0, float(best["gain"].min()) / 2))
    axes.set_xlabel(r"gain in $\chi^2$")
    present = [stage for stage in STAGES if stage in set(best["stage"])]
    handles = [Patch(color=STAGES[stage][1], label=STAGES[stage][0]) for stage in present]
    figure.legend(handles=handles, loc="outside upper left", ncols=1)
    return figure


@drawn_to_be_read
def plot_escapes(table: pd.DataFrame, *, time_unit: str = "1") -> Figure | None:
    """Draw mean escape times of two simulations against the inverse of the noise intensity.

    Ways out have colours, simulations line styles. The table has the columns ``transition intensity
    simulation time``, a row for each way out, simulation and ε.
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
    axes.set_ylabel(with_unit("mean escape time", time_unit))
    figure.legend(loc="outside upper left", ncols=1)
    if len(ways) > len(colours):
        figure.supxlabel(f"{counted(len(ways) - len(colours), 'further way')} out not drawn")
    return figure
