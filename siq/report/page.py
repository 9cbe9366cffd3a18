"""Pages: sections with formulas, tables and figures, and U as a figure that a reader turns.

The page asks nothing of any other machine: style, figures, formulas and downloads stand in it. It has no
scripts, but for the view of U that can be turned, where there is one. `siq.report.formatting` makes HTML
of it.

The data are U on a coarse grid in steps of one part in 250, wells, saddles and paths: they are read, never
run. The script asks nothing of any other machine, and draws with what every browser has.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any, Literal

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from siq.numerics.text import unit_text
from siq.report.formatting import render_template
from siq.report.landscape_summary import BLOCK_OF_POINTS, DrawnLandscape, chosen_states


@dataclass(frozen=True)
class FormulaRow:
    """One formula.

    Attributes
    ----------
    quantity
        What the formula gives: ``"U"``, ``"f"``, typeset or as text.
    formula
        Typeset by `siq.report.formatting`; plain text is shown as text.
    note
        What to know of it, in a sentence.
    exact
        The exact formula, where one is known.
    whole
        The formula in full, folded away, where `formula` leaves small terms out.
    """

    quantity: Markup | str
    formula: Markup | str
    note: str = ""
    exact: Markup | str | None = None
    whole: Markup | str | None = None


@dataclass(frozen=True)
class ReportTable:
    """A table of the report; it can be downloaded as CSV, with all its rows.

    Attributes
    ----------
    caption
        What the table shows, in a sentence.
    frame
        The table; its index is not shown, and neither are columns that hold nothing.
    column_help
        What the columns mean, by name.
    whole
        Where it lies as a file, for one that is cut.
    rows_shown
        After how many rows the table is cut.
    data
        What is downloaded, where that is more than what is shown.
    rows_named
        Whether the first column names the rows.
    """

    caption: str
    frame: pd.DataFrame
    column_help: Mapping[str, str] = field(default_factory=dict)
    whole: str = ""
    rows_shown: int = 30
    data: pd.DataFrame | None = None
    rows_named: bool = False


@dataclass(frozen=True)
class ReportFigure:
    """A figure of the report; it can be downloaded.

    Attributes
    ----------
    caption
        What the figure shows, in sentences.
    alternative
        What somebody who cannot see it should know of it.
    image
        The bytes of the file.
    kind
        Its format.
    vector
        The same as SVG, for the download.
    """

    caption: str
    alternative: str
    image: bytes
    kind: Literal["svg", "png"] = "svg"
    vector: bytes | None = None


@dataclass(frozen=True)
class ReportSection:
    """A section of the report.

    Attributes
    ----------
    heading
        Its heading.
    text
        Paragraphs.
    formulas, tables, figures
        Below the text, in this order.
    notes
        Paragraphs below all of it, in small print.
    folded
        Whether it is closed until a reader opens it.
    listing
        Lines of code, such as commands.
    """

    heading: str
    text: Sequence[str] = ()
    formulas: Sequence[FormulaRow] = ()
    tables: Sequence[ReportTable] = ()
    figures: Sequence[ReportFigure] = ()
    notes: Sequence[str] = ()
    folded: bool = False
    listing: str = ""


@dataclass(frozen=True)
class Badge:
    """Whether the answer may be believed.

    Attributes
    ----------
    label
        In two words.
    good
        Whether it may.
    promise
        What that means, in plain words.
    """

    label: str
    good: bool
    promise: Sequence[str] = ()


@dataclass(frozen=True)
class ReportContent:
    """All that a report says, in the order in which it is read.

    Attributes
    ----------
    title
        Title of the study.
    answer
        The answer: a sentence that stands alone, and what has to be known of it.
    badge
        Whether it may be believed.
    figure, table
        What it looks like, beside each other.
    figure_first
        Whether the figure stands above the answer.
    interactive
        A view that can be turned, with its script; None where there is none.
    sections
        Everything else.
    language
        Language of the page, for hyphenation and screen readers.
    """

    title: str
    answer: Sequence[str] = ()
    badge: Badge | None = None
    figure: ReportFigure | None = None
    table: ReportTable | None = None
    figure_first: bool = False
    interactive: Markup | None = None
    sections: Sequence[ReportSection] = ()
    language: str = "en"


def render_report(content: ReportContent) -> str:
    """Render a report as one HTML page.

    Parameters
    ----------
    content
        What the page says. All text is escaped, but for formulas that are `markupsafe.Markup`.

    Returns
    -------
    str
        The page. The same content gives the same page.
    """
    return render_template("report.html.j2", content)


NODES = 64_000  # of the grid: 85 kB in the page
MOST_NODES = 128  # along one state
MOST_STATES = 4  # a grid of more would be too coarse to show a well
ABOVE, UNKNOWN = 254, 255
PATH_POINTS = 80
ROOM = 0.3  # of the height of the highest saddle: shown above it, as in the picture
BANDS = 12  # of colours in a section
SURFACE = 0.9  # of the height of the lowest saddle: where the surface is at first, a bubble about each well


def interactive_view(landscape: DrawnLandscape) -> Markup | None:
    """A view of U that can be turned and cut; None of one state, and where U is known nowhere.

    Parameters
    ----------
    landscape
        What is drawn. Of more than four states those are shown along which the wells lie apart, with the
        others held at the lowest saddle.

    Returns
    -------
    markupsafe.Markup or None
        A ``<section>`` with its style, controls, data and script, to be put into a page once.
    """
    if len(landscape.names) < 2:
        return None
    shown = _shown(landscape)
    values = _on_a_grid(landscape, shown)
    known = values[np.isfinite(values)]
    if not len(known):
        return None
    low, top = float(known.min()), landscape.top
    high = float(known.max()) if top is None or not top > low else top + ROOM * (top - low)
    high = high if high > low else low + 1.0
    low = 0.0 if abs(low) < 1e-3 * (high - low) else low  # the bottom is zero, but for the grid
    data = _data(landscape, shown, values, (low, high))
    lowest = _lowest_pass(landscape)
    share = 0.5 if lowest is None or not low < lowest < high else SURFACE * (lowest - low) / (high - low)
    plane = [shown.index(state) for state in chosen_states(landscape, None)]
    environment = Environment(
        loader=PackageLoader("siq.report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    names = data["names"]
    return Markup(
        environment.get_template("interactive.html.j2").render(
            text=_text(landscape, shown),
            flat=len(shown) == 2,
            level=round(1000 * share),
            names=names,
            plane=plane,
            wells=[one.label for one in landscape.wells],
            ways=bool(landscape.ways),
            solid=f"U over {', '.join(names[:3])}, in three dimensions; the controls below turn it",
            section="A map of U over two of the states; the controls below choose them",
            data=Markup(_safe(data)),
            script=Markup(script()),
        )
    )


def script() -> str:
    """The script of the view."""
    return (files("siq.report") / "templates" / "interactive.js").read_text(encoding="utf-8")


def _safe(data: dict[str, Any]) -> str:
    """JSON that ends no element of a page, whatever a state is called."""
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _shown(landscape: DrawnLandscape) -> list[int]:
    """Places of the states that are shown, the two of the picture among them."""
    count = len(landscape.names)
    first = list(chosen_states(landscape, None))
    return sorted([*first, *(place for place in range(count) if place not in first)][:MOST_STATES])


def _on_a_grid(landscape: DrawnLandscape, shown: Sequence[int]) -> np.ndarray:
    """U on a grid of the states that are shown."""
    count = min(int(NODES ** (1 / len(shown)) + 1e-9), MOST_NODES)
    axes = [landscape.along(place, count) for place in shown]
    mesh = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(shown))
    values = []
    for start in range(0, len(mesh), BLOCK_OF_POINTS):
        part = mesh[start : start + BLOCK_OF_POINTS]
        points = np.tile(landscape.lowest_pass, (len(part), 1))
        points[:, list(shown)] = part
        values.append(landscape.potential(points))
    return np.concatenate(values).reshape((count,) * len(shown))


def _data(
    landscape: DrawnLandscape, shown: Sequence[int], values: np.ndarray, limits: tuple[float, float]
) -> dict[str, Any]:
    """What the script draws, as plain data."""
    low, high = limits
    steps = np.full(values.shape, UNKNOWN)
    known = np.isfinite(values)
    steps[known] = np.clip(np.round(253 * (values[known] - low) / (high - low)), 0, ABOVE)
    units = [unit_text(landscape.units[place]) for place in shown]
    names = [landscape.names[place] for place in shown]
    unit = unit_text(landscape.energy_unit)

    def thinned(path: np.ndarray) -> list[list[float]]:
        rows = np.unique(np.linspace(0, len(path) - 1, min(PATH_POINTS, len(path))).astype(int))
        return [[_short(value) for value in row] for row in path[rows][:, list(shown)]]

    def marks(points: Sequence[Any]) -> list[dict[str, Any]]:
        return [
            {"label": one.label, "position": [_short(value) for value in one.position[list(shown)]],
             "U": _short(one.height if np.isfinite(one.height) else low)}
            for one in points
        ]  # fmt: skip

    return {
        "names": names,
        "units": units,
        "labels": [f"{name} ({each})" if each else name for name, each in zip(names, units, strict=True)],
        "unit": unit,
        "energy": f"U ({unit})" if unit else "U (unit of ε)",
        "box": [[_short(value) for value in landscape.box[place]] for place in shown],
        "shape": list(values.shape),
        "grid": base64.b64encode(steps.astype(np.uint8).tobytes()).decode("ascii"),
        "low": _short(low),
        "high": _short(high),
        "bands": BANDS,
        "wells": marks(landscape.wells),
        "saddles": marks(landscape.saddles),
        "ways": [
            {"uphill": thinned(way.uphill), "downhill": thinned(way.downhill)} for way in landscape.ways
        ],
        "pass": [_short(value) for value in landscape.lowest_pass[list(shown)]],
    }


def _short(value: float) -> float:
    return float(f"{value:.6g}")


def _lowest_pass(landscape: DrawnLandscape) -> float | None:
    tops = [landscape.wells[way.start].height + way.barrier for way in landscape.ways]
    known = [top for top in tops if np.isfinite(top)]
    return min(known) if known else None


def _text(landscape: DrawnLandscape, shown: Sequence[int]) -> str:
    rest = [place for place in range(len(landscape.names)) if place not in shown]
    text = (
        "Circles are stable states, diamonds saddles. The solid line is the most probable way out of a well,"
    )
    text += " the dashed line the way on without noise. Where U is not known, nothing is drawn."
    if len(shown) == 2:
        return "Drag the first picture to turn it. " + text
    text = "The first picture is the surface on which U has one value: raise it until the wells join. " + text
    if rest:
        held = ", ".join(f"{landscape.names[k]} = {landscape.lowest_pass[k]:.3g}" for k in rest)
        text += f" The other states are held at the lowest saddle: {held}."
    return text
