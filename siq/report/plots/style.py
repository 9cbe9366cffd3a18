"""How all figures look, and how they are written to files."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import ParamSpec, TypeVar

import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from siq.numerics.files import whole_file
from siq.numerics.text import unit_text
from siq.report.formatting import with_unit

# Inches. A figure is no wider than its letters allow: a phone of 400 pixels leaves it 368, and there text of
# `SMALLEST` points in a figure of `PAGE_WIDTH` is 9 pixels high.
COLUMN_WIDTH = 4.2
PAGE_WIDTH = 5.4
SMALLEST = 9.5

# The palette of Okabe and Ito, which readers with any common colour blindness can tell apart.
BLACK = "#000000"
ORANGE = "#E69F00"
SKY_BLUE = "#56B4E9"
GREEN = "#009E73"
BLUE = "#0072B2"
VERMILLION = "#D55E00"
PURPLE = "#CC79A7"
GREY = "#6E6E6E"

_STYLE = Path(__file__).with_name("figures.mplstyle")

# A figure that had a layout keeps a placeholder of one otherwise, and is drawn twice whenever it is saved.
_FROZEN = {"figure.constrained_layout.use": False}

_GREEK = re.compile(
    "alpha|beta|gamma|delta|epsilon|zeta|eta|theta|iota|kappa|lambda|mu|nu|xi|pi|rho|sigma|tau|upsilon|phi|chi|psi"
    "|omega|Gamma|Delta|Theta|Lambda|Xi|Pi|Sigma|Upsilon|Phi|Psi|Omega"
)

Parameters = ParamSpec("Parameters")
Drawn = TypeVar("Drawn", Figure, Figure | None)


def _drawing_style(settings: Mapping[str, object]) -> AbstractContextManager[None]:
    """Make matplotlib's defaults, those of `_STYLE` and some more settings hold for a ``with`` block."""
    context: AbstractContextManager[None] = matplotlib.style.context(["default", _STYLE, dict(settings)])
    return context


def drawn_in_style(function: Callable[Parameters, Drawn], **settings: object) -> Callable[Parameters, Drawn]:
    """Decorate a plot function: common style while it draws, fixed layout afterwards.

    A function gives None where there is nothing to draw: a figure that says so is none.
    """

    @functools.wraps(function)
    def draw(*arguments: Parameters.args, **options: Parameters.kwargs) -> Drawn:
        with _drawing_style(settings):
            figure = function(*arguments, **options)
            if figure is None:
                return figure
            # The constrained layout moves on a little with every drawing. Worked out once and then
            # frozen, the same figure gives the same file however often it is saved.
            figure.draw_without_rendering()
        with _drawing_style(_FROZEN):
            figure.set_layout_engine(None)
        return figure

    return draw


def say(axes: Axes, sentence: str) -> None:
    """Write a sentence in place of a panel's curves."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, sentence, transform=axes.transAxes, ha="center", va="center", wrap=True, color=GREY)


def counted(number: int, noun: str) -> str:
    """Write a number with its noun: ``1 run``, ``2 runs``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def name_label(name: str) -> str:
    """Typeset a name without dollar signs: ``f_x`` with an index, ``omega`` as a Greek letter."""
    numbered = re.fullmatch(r"([^\W\d_])(\d+)", name)
    stem, _, index = name.partition("_") if not numbered else (numbered[1], "", numbered[2])
    if not stem:
        return r"\mathrm{" + name.replace("_", r"\_") + "}"
    letter = rf"\{stem}" if _GREEK.fullmatch(stem) else stem if len(stem) == 1 else rf"\mathrm{{{stem}}}"
    index = index.strip("_")
    if index:
        # Two indices on one letter, as in x_1_2, are no valid mathematical text.
        letter += f"_{{{name_label(index) if index[0].isalpha() else index.replace('_', ',')}}}"
    return letter


def unit_label(unit: str) -> str:
    """A unit behind a name: ``(mV)``; ``(dimensionless)`` for ``1``, nothing where none is known."""
    if unit == "":
        return ""
    return "(dimensionless)" if unit == "1" else f"({unit_text(unit)})"


def axis_label(name: str, unit: str) -> str:
    """Typeset a state with its unit; the unit ``1`` needs no word where a name stands alone."""
    return with_unit(f"${name_label(name)}$", unit)


def energy_label(unit: str) -> str:
    """Typeset U with its unit; nothing is that of ε."""
    return f"$U$ ({unit_text(unit)})" if unit not in ("", "1") else "$U$ (unit of ε)"


def magnitude_label(value: float, *, digits: int = 2) -> str:
    """Typeset a number with so many significant digits."""
    if value != 0 and not 1e-2 <= abs(value) < 1e4:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return rf"${mantissa} \times 10^{{{int(exponent)}}}$"
    return f"${value:.{digits}g}$"


def mean_and_spread(mean: float, spread: float, *, digits: int = 2) -> str:
    """Typeset mean ± standard deviation, both to so many significant digits of the deviation."""
    scale = max(abs(mean), spread if math.isfinite(spread) else 0.0)
    exponent = math.floor(math.log10(scale)) if scale > 0 else 0
    exponent = 0 if -2 <= exponent < 4 else exponent
    mean, spread = mean / 10.0**exponent, spread / 10.0**exponent
    decimals = 4
    if math.isfinite(spread) and spread > 0:
        decimals = min(max(digits - 1 - math.floor(math.log10(spread)), 0), 12)
    mean = round(mean, decimals) + 0.0  # no "−0.0"
    numbers = f"{mean:.{decimals}f}" + (f" \\pm {spread:.{decimals}f}" if math.isfinite(spread) else "")
    if exponent == 0:
        return f"${numbers}$"
    bracketed = f"({numbers})" if math.isfinite(spread) else numbers
    return rf"${bracketed} \times 10^{{{exponent}}}$"


DOTS_PER_INCH = {".svg": 300, ".png": 200}  # in an SVG, of the parts drawn as an image


def save_figure(figure: Figure, path_without_suffix: str | Path) -> tuple[Path, Path]:
    """Write a figure as SVG and PNG, whole or not at all, the same bytes every time.

    Parameters
    ----------
    figure
        The figure.
    path_without_suffix
        Where to, without ``.svg`` or ``.png``; the folder is created if need be.

    Returns
    -------
    tuple of pathlib.Path
        The SVG file and the PNG file.
    """
    stem = Path(path_without_suffix)
    vector, image = (stem.with_name(stem.name + suffix) for suffix in DOTS_PER_INCH)
    # Date and Software would make the same figure differ between days and versions.
    for path, metadata in ((vector, {"Date": None}), (image, {"Software": None})):
        with whole_file(path) as partial, _drawing_style(_FROZEN):
            figure.savefig(partial, dpi=DOTS_PER_INCH[path.suffix], metadata=metadata)
    return vector, image


WIDTH = 5.0  # inches; on a phone of 400 pixels a point of text is then one pixel high
_LARGE = {"xtick.labelsize": 9, "ytick.labelsize": 9, "lines.linewidth": 1.4}


def drawn_to_be_read(function: Callable[Parameters, Drawn]) -> Callable[Parameters, Drawn]:
    """Decorate a plot function as `drawn_in_style` does, for figures of `WIDTH` with thicker lines."""
    return drawn_in_style(function, **_LARGE)


CURVE_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, BLACK)
MARKERS = ("o", "s", "^", "D", "v", "P")
LINE_STYLES = ("-", "--", "-.", ":")


def look(place: int) -> tuple[str, str, str]:
    """Colour, style of line and marker of the curve at a place, told apart without colour too."""
    colour, style, marker = (each[place % len(each)] for each in (CURVE_COLOURS, LINE_STYLES, MARKERS))
    return colour, style, marker


def power_of_ten(largest: float) -> int:
    """The power that is written once at an axis and not at every tick: zero for numbers that are handy."""
    if not math.isfinite(largest) or largest == 0 or 0.1 <= abs(largest) < 1e4:
        return 0
    return math.floor(math.log10(abs(largest)))


def scaled_label(axis: Axis, symbol: str, unit: str, largest: float) -> str:
    """The label of an axis with its unit, and with the power of ten that its ticks leave out from now on.

    Parameters
    ----------
    axis
        The axis; its label is left to the caller.
    symbol
        What is shown, typeset.
    unit
        Its unit; ``1`` and the empty text mean a plain number.
    largest
        The largest number that occurs.
    """
    power = power_of_ten(largest)
    plain = unit in ("1", "")
    if not power:
        return symbol if plain else f"{symbol} {unit_label(unit)}"
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value / 10.0**power:.6g}".replace("-", "−")))
    factor = rf"$10^{{{power}}}$"
    return f"{symbol} ({factor})" if plain else f"{symbol} ({factor} {unit_text(unit)})"
