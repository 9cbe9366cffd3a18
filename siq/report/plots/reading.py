"""Figures that can be read on a phone: narrow, text as large as that of the page, panels below each other."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from typing import ParamSpec

import matplotlib as mpl
from matplotlib.figure import Figure

from siq.numerics.measured_text import unit_text
from siq.report.plots.style import drawing_style

WIDTH = 5.0  # inches; on a phone of 400 pixels a point of text is then one pixel high
_LARGE = {
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.labelsize": 10,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "legend.fontsize": 9.5,
    "figure.titlesize": 10,
    "lines.linewidth": 1.4,
}

Parameters = ParamSpec("Parameters")


def drawn_to_be_read(function: Callable[Parameters, Figure | None]) -> Callable[Parameters, Figure | None]:
    """Decorate a plot function that returns None where there is nothing to draw."""

    @functools.wraps(function)
    def draw(*arguments: Parameters.args, **options: Parameters.kwargs) -> Figure | None:
        with drawing_style():
            mpl.rcParams.update(_LARGE)  # which the context undoes
            figure = function(*arguments, **options)
            if figure is not None:
                # Worked out once and then frozen, the same figure gives the same file.
                figure.draw_without_rendering()
                figure.set_layout_engine("none")
        return figure

    return draw


def axis_unit(unit: str) -> str:
    """A unit behind the name of an axis, typeset; nothing for a plain number."""
    text = unit_text(unit)
    return f" ({text})" if text else ""


def rate_unit(unit: str, time_unit: str) -> str:
    """The unit of a rate of change, as cards write units."""
    if time_unit in ("1", ""):
        return unit
    if unit in ("1", ""):
        return f"1/{time_unit}"
    if power := re.fullmatch(rf"(.+)/{re.escape(time_unit)}(?:\*\*(\d+))?", unit):
        return f"{power[1]}/{time_unit}**{int(power[2] or 1) + 1}"
    return f"{unit}/{time_unit}" if "/" not in unit else f"({unit})/{time_unit}"
