"""Figures of recordings: states in time, what was visited, and the two components of the field."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from siq.data.inspection import Inspection
from siq.data.states import RecordStates
from siq.report.plots.style import (
    BLACK,
    BLUE,
    COLUMN_WIDTH,
    GREEN,
    GREY,
    VERMILLION,
    axis_label,
    counted,
    drawn_in_style,
    name_label,
    say,
    unit_label,
)

POINTS = 1500  # across a panel: more than it has dots
TOGETHER = 12  # short recordings drawn in one panel
SHORT = 20  # recordings; where there are more, each is a relaxation, and several are drawn
LONG = 0.9  # of the longest recording
BINS = 60
LAGS = 60  # shown at most
STAYS_SHOWN = 60  # stays of the usual length
STATE_COLOURS = (BLUE, VERMILLION, GREEN, BLACK)
STATES = 4  # drawn below each other; the text has all


@drawn_in_style
def plot_inspection(found: Inspection) -> Figure:
    """Three panels below each other, of the first state and, where there is one, the second.

    Parameters
    ----------
    found
        See `siq.data.inspection.inspect`.
    """
    figure = Figure(figsize=(COLUMN_WIDTH, 7.2))
    first, second, third = figure.subplots(3, 1)
    _draw_record(first, found, 0)
    _draw_visits(second, found)
    _draw_memory(third, found)
    for axes, letter in zip((first, second, third), "abc", strict=True):
        axes.set_title(f"({letter}) {axes.get_title(loc='left')}", loc="left")
    return figure


def inspection_figures(found: Inspection) -> dict[str, Figure]:
    """Figures of a page: ``states_in_time``, ``visited``, ``memory``, and ``states`` where it has some."""
    hops = found.switching
    states = {"states": _states_figure(found, hops)} if hops is not None and hops.supported else {}
    return states | {
        "states_in_time": _record_figure(found),
        "visited": _figure_of(_draw_visits, found, 2.9),
        "memory": _figure_of(_draw_memory, found, 2.7),
    }


@drawn_in_style
def _record_figure(found: Inspection) -> Figure:
    """The states in the course of time, a panel for each."""
    count = min(len(found.states), STATES)
    figure = Figure(figsize=(COLUMN_WIDTH, 1.7 * count + 0.5))
    for state, axes in enumerate(figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]):
        _draw_record(axes, found, state)
        if state < count - 1:
            axes.set_xlabel("")
        if state > 0:
            axes.set_title("", loc="left")
    return figure


@drawn_in_style
def _states_figure(found: Inspection, hops: RecordStates) -> Figure:
    """The record with its states in colour, the profile, and stays against the exponential law."""
    figure = Figure(figsize=(COLUMN_WIDTH, 6.4))
    record, profile, stays = figure.subplots(3, 1)
    recordings = found.recordings
    column = recordings.titles.index(hops.state)
    # The longest recording, so much of it that some tens of stays can be seen.
    counts = np.bincount(recordings.recording)
    begin = int(counts[: np.argmax(counts)].sum())
    usual = np.median(np.concatenate(hops.stays)) if any(map(len, hops.stays)) else np.inf
    rows = slice(begin, begin + int(counts.max()))
    t = recordings.t[rows] - recordings.t[begin]
    shown = t <= min(STAYS_SHOWN * usual, t[-1])
    t, x, visits = t[shown], recordings.values[rows, column][shown], hops.visits[rows][shown]
    every = max(len(t) // POINTS, 1)
    record.plot(t[::every], x[::every], color=GREY, linewidth=0.4, rasterized=True)
    label, time_label = _labels(found)[column], unit_label(recordings.time_unit or "")
    colours = [STATE_COLOURS[state % len(STATE_COLOURS)] for state in range(len(hops.counts))]
    for state, (colour, lengths) in enumerate(zip(colours, hops.stays, strict=True)):
        mine = visits == state
        record.plot(t[mine][::every], x[mine][::every], ".", color=colour, markersize=2, rasterized=True)
        if len(lengths):
            times = np.sort(lengths)
            share = 1 - np.arange(len(times)) / len(times)
            stays.step(times, share, where="post", color=colour, label=f"state {state + 1}")
            # The dead time is that of the shortest stay.
            law = np.exp(-(times - times[0]) / max(times.mean() - times[0], 1e-300))
            stays.plot(times, law, color=colour, linestyle="--", linewidth=0.8)
    record.set(xlabel=f"time {time_label}".strip(), ylabel=label)
    if (drawn := hops.profile) is not None:
        profile.fill_between(
            drawn.place, drawn.height - 2 * drawn.error, drawn.height + 2 * drawn.error, color=GREY, alpha=0.4
        )
        profile.plot(drawn.place, drawn.height, color=BLACK)
        for level, colour in zip(hops.levels, colours, strict=True):
            profile.axvline(level, color=colour, linestyle="--", linewidth=0.8)
        profile.set(xlabel=label, ylabel=r"$-\log p$")
    else:
        say(profile, "no profile: the record is not stationary")
    if any(map(len, hops.stays)):
        stays.set(xlabel=f"stay {time_label}".strip(), ylabel="share that last longer", yscale="log")
        stays.legend()
    else:
        say(stays, "no stay was seen from beginning to end")
    return figure


@drawn_in_style
def _figure_of(draw: Callable[[Axes, Inspection], None], found: Inspection, height: float) -> Figure:
    figure = Figure(figsize=(COLUMN_WIDTH, height))
    draw(figure.add_subplot(), found)
    return figure


def _labels(found: Inspection) -> list[str]:
    recordings = found.recordings
    return [
        axis_label(name, unit or "1") for name, unit in zip(recordings.names, recordings.units, strict=True)
    ]


def _draw_record(axes: Axes, found: Inspection, state: int) -> None:
    """One state in time: the longest recording, or several where there are many short ones."""
    recordings = found.recordings
    counts = np.bincount(recordings.recording)
    begins = np.cumsum(counts) - counts
    if len(counts) > SHORT:
        chosen = np.unique(np.linspace(0, len(counts) - 1, TOGETHER).astype(int))
    else:
        # Of the longest the one that moves most: it shows transitions, where there are any.
        long = np.flatnonzero(counts >= LONG * counts.max())
        spans = [np.ptp(recordings.values[begins[one] : begins[one] + counts[one], state]) for one in long]
        chosen = long[[int(np.argmax(spans))]]
    for one in chosen:
        rows = slice(begins[one], begins[one] + counts[one])
        t, x = recordings.t[rows] - recordings.t[begins[one]], recordings.values[rows, state]
        every = -(-len(t) // POINTS)
        if every < 4:
            axes.plot(t, x, linewidth=0.6, color=BLUE, rasterized=True)
            continue
        # From the lowest to the highest value of each dot: no excursion is lost.
        edges = np.arange(0, len(t), every)
        low, high = np.minimum.reduceat(x, edges), np.maximum.reduceat(x, edges)
        axes.fill_between(t[edges], low, high, color=BLUE, linewidth=0.3, rasterized=True)
    hops = found.switching
    if hops is not None and hops.supported and hops.state == recordings.titles[state]:
        for level in hops.levels:
            axes.axhline(level, color=BLACK, linestyle="--", linewidth=0.8)
    axes.set_xlabel(f"time {unit_label(recordings.time_unit or '')}".strip())
    axes.set_ylabel(_labels(found)[state])
    shown = f"{len(chosen)} of {counted(len(counts), 'recording')}" if len(counts) > 1 else "the recording"
    axes.set_title(shown, loc="left")


def _draw_visits(axes: Axes, found: Inspection) -> None:
    values, labels = found.recordings.values, _labels(found)
    if values.shape[1] == 1:
        axes.hist(values[:, 0], bins=BINS, color=GREY)
        axes.set_xlabel(labels[0])
        axes.set_ylabel("number of samples")
    else:
        counts, *edges = np.histogram2d(values[:, 0], values[:, 1], bins=BINS)
        seen = np.where(counts > 0, np.log10(np.maximum(counts, 1.0)), np.nan)
        mesh = axes.pcolormesh(*edges, seen.T, cmap="cividis_r", rasterized=True)
        axes.figure.colorbar(mesh, ax=axes, label=r"$\log_{10}$ of the samples")
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])
    axes.set_title(f"visited: {100 * found.coverage:.0f} % of the range", loc="left")


def _draw_memory(axes: Axes, found: Inspection) -> None:
    memory = found.memory
    if not len(memory.lags):
        say(axes, "too few evenly spaced samples to tell what neighbours remember")
        return
    shown = slice(0, LAGS)
    lags = memory.lags[shown]
    band = 2 * memory.errors[shown].max(axis=1)
    axes.fill_between(lags, -band, band, color=GREY, alpha=0.3, linewidth=0, label="± 2 standard errors")
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    if memory.remembers and memory.lag is not None:
        axes.axvline(memory.lag, color=BLACK, linestyle="--", linewidth=0.9, label="Markovian from here on")
    for state, name in enumerate(found.recordings.names[:STATES]):
        axes.plot(
            lags, memory.correlations[shown, state], marker="o", markersize=3, linewidth=0.8,
            color=(BLUE, VERMILLION, "#009E73", "#E69F00")[state], label=f"${name_label(name)}$",
        )  # fmt: skip
    axes.set_xlabel("steps between two increments")
    axes.set_ylabel("correlation")
    axes.set_title("what one increment knows of another", loc="left")
    axes.legend(loc="best")
