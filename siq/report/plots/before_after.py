"""A held-out recording with the simulation as given, and as it is with what was found."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from siq.report.largest_difference import largest_difference
from siq.report.plots.reading import WIDTH, axis_unit, drawn_to_be_read
from siq.report.plots.style import BLACK, BLUE, GREY, VERMILLION, name_label

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
    table: pd.DataFrame,
    *,
    after: str,
    noise: Mapping[str, float] | None = None,
    units: Mapping[str, str] | None = None,
    time_unit: str = "1",
) -> Figure | None:
    """Draw the held-out recording that differs most, with the simulation before and after.

    Parameters
    ----------
    table
        Columns ``recording t output measured before recalibrated augmented scored``.
    after
        The simulation that the verdict ends with: ``"augmented"``, ``"recalibrated"``, or ``"before"`` where
        nothing is to be changed.
    noise
        Variance of the sensor's noise by output, for a band of ± 2 standard deviations.
    units
        Units of the outputs.
    time_unit
        Of ``t``.

    Returns
    -------
    matplotlib.figure.Figure or None
        The course above, simulation minus recording below; None where no recording was held out.
    """
    largest = largest_difference(table, after=after)
    if largest is None:
        return None
    pair = (largest.recording, largest.output)
    figure = Figure(figsize=(WIDTH, 4.2))
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.7, 1])
    shown = ["before"] if after == "before" else ["before", after]
    _draw(upper, lower, _rows(table, *pair), shown, noise=(noise or {}).get(pair[1]))
    unit = axis_unit((units or {}).get(pair[1], "1"))
    upper.set_ylabel(f"${name_label(pair[1])}${unit}")
    lower.set_ylabel(f"error{unit}")
    lower.set_xlabel(f"$t${axis_unit(time_unit)}")
    handles, labels = upper.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=2, handlelength=1.6, columnspacing=1.2)
    return figure


@drawn_to_be_read
def plot_held_out(
    table: pd.DataFrame, *, units: Mapping[str, str] | None = None, time_unit: str = "1"
) -> Figure | None:
    """Draw held-out recordings with the free runs of all three simulations.

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
    matplotlib.figure.Figure or None
        Two panels below each other for each of up to four pairs of recording and output: the courses, and
        simulation minus recording. None where no recording was held out.
    """
    scored = table[table["scored"].astype(bool)]
    if scored.empty:
        return None
    outputs = list(dict.fromkeys(scored["output"]))
    recordings = list(dict.fromkeys(scored["recording"]))[: max(1, PAIRS // len(outputs))]
    pairs = [(recording, output) for recording in recordings for output in outputs][:PAIRS]
    figure = Figure(figsize=(WIDTH, 0.6 + 2.9 * len(pairs)))
    axes = figure.subplots(2 * len(pairs), 1, height_ratios=[1.5, 1] * len(pairs))
    for (recording, output), (upper, lower) in zip(pairs, axes.reshape(-1, 2), strict=True):
        same = _same(scored)
        shown = ["before", "recalibrated"] if same else ["before", "recalibrated", "augmented"]
        _draw(upper, lower, _rows(table, recording, output), shown, distinct=not same)
        unit = axis_unit((units or {}).get(output, "1"))
        upper.set_title(f"recording {recording}", loc="left")
        upper.set_ylabel(f"${name_label(output)}${unit}")
        upper.tick_params(labelbottom=False)
        lower.set_ylabel(f"error{unit}")
        lower.set_xlabel(f"$t${axis_unit(time_unit)}")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=2, handlelength=1.6, columnspacing=1.2)
    return figure


def _same(scored: pd.DataFrame) -> bool:
    """Whether nothing was added, so that two of the three simulations are one."""
    return bool(np.array_equal(scored["recalibrated"], scored["augmented"], equal_nan=True))


def _rows(table: pd.DataFrame, recording: str, output: str) -> pd.DataFrame:
    mine = table[(table["recording"].astype(str) == recording) & (table["output"] == output)]
    return mine[mine["scored"].astype(bool)].tail(SAMPLES_SHOWN)


def _draw(
    upper: Axes, lower: Axes, rows: pd.DataFrame, shown: list[str], *, noise: float | None = None,
    distinct: bool = False,
) -> None:  # fmt: skip
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
        if distinct and name == "recalibrated":
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
