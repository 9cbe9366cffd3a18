"""Pages: what a page is made from, how a template fills it, which figures it has, and how it becomes HTML.

A page asks nothing of any other machine: style, figures, formulas and downloads stand in it. It has no
scripts, but for two views. One is of U, and can be turned: its data are U on a coarse grid in steps of one
part in 250, wells, saddles and paths. The other shows mean times under the noise that the reader chooses.
Where there is one, tables can be sorted, too. What stands in the page is read and never run.

`compose` fills a page from a template of text, in which ``page.section``, ``page.table`` and so on stand
where they stand on the page. A section, a table or a figure without content is left out.
"""

from __future__ import annotations

import base64
import datetime
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd
from jinja2 import ChoiceLoader, Environment, FileSystemLoader, PackageLoader, StrictUndefined
from markupsafe import Markup
from pandas.api.types import is_bool_dtype, is_numeric_dtype

from siq.data.inspection import inspect
from siq.data.preparation import joined
from siq.data.recordings import Recordings
from siq.data.states import RecordStates
from siq.numerics.text import number_text, unit_text, value_text
from siq.quasipotential.rates import NoiseStrength
from siq.report.formatting import environment, in_paragraphs, time_text, with_unit
from siq.report.summary import LandscapeSummary

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class FormulaRow:
    """One formula."""

    quantity: Markup | str  #: what the formula gives, such as U or f, typeset or as text
    formula: Markup | str  #: typeset by `siq.report.formatting`; plain text is shown as text
    note: str = ""  #: what to know of it, in a sentence
    exact: Markup | str | None = None  #: the exact formula, where one is known
    whole: Markup | str | None = None  #: in full, folded away, where `formula` leaves small terms out


@dataclass(frozen=True)
class ReportTable:
    """A table of the report; it can be downloaded as CSV, with all its rows."""

    caption: str  #: what the table shows, in a sentence
    frame: pd.DataFrame  #: the table; its index is not shown, and neither are columns that hold nothing
    column_help: Mapping[str, str] = field(default_factory=dict)  #: what the columns mean, by name
    whole: str = ""  #: where it lies as a file, for one that is cut
    rows_shown: int = 30  #: after how many rows the table is cut
    data: pd.DataFrame | None = None  #: what is downloaded, where that is more than what is shown
    rows_named: bool = False  #: whether the first column names the rows


@dataclass(frozen=True)
class ReportFigure:
    """A figure of the report; it can be downloaded."""

    caption: str  #: what the figure shows, in sentences
    alternative: str  #: what it shows, for readers who cannot see it
    image: bytes  #: the bytes of the file
    kind: Literal["svg", "png"] = "svg"  #: its format
    vector: bytes | None = None  #: the same as SVG, for the download


@dataclass(frozen=True)
class ReportSection:
    """A section of the report."""

    heading: str  #: its heading
    text: Sequence[str] = ()  #: paragraphs
    formulas: Sequence[FormulaRow] = ()  #: below the text, before tables and figures
    tables: Sequence[ReportTable] = ()
    figures: Sequence[ReportFigure] = ()
    notes: Sequence[str] = ()  #: paragraphs below all of it, in small print
    folded: bool = False  #: whether it is closed until a reader opens it
    listing: str = ""  #: lines of code, such as commands


@dataclass(frozen=True)
class ReportContent:
    """All that a report says, in the order in which it is read."""

    title: str  #: title of the study
    answer: Sequence[str] = ()  #: a sentence that stands alone, and what has to be known of it
    badge: str = ""  #: whether it may be believed, in two words
    good: bool = False  #: the same as a flag
    promise: Sequence[str] = ()  #: what that means, in plain words
    figure: ReportFigure | None = None  #: what it looks like
    table: ReportTable | None = None  #: beside the figure
    figure_first: bool = False  #: whether the figure stands above the answer
    interactive: Markup | None = None  #: views that a reader can change, with their scripts
    sections: Sequence[ReportSection] = ()  #: everything else
    language: str = "en"  #: language of the page, for hyphenation and screen readers


class _PageWriter:
    """The parts of a page, as a template tells them; see `compose`."""

    def __init__(self) -> None:
        self.parts: dict[str, Any] = {"sections": []}
        self._section: dict[str, list[Any]] = {}  # that is being written

    def answer(self, caller: Callable[[], str]) -> str:
        """The answer: a sentence that stands alone, and what has to be known of it."""
        self.parts["answer"] = in_paragraphs(caller())
        return ""

    def badge(self, label: str, *, good: bool, caller: Callable[[], str]) -> str:
        """Whether the answer may be believed, and what that means."""
        self.parts |= {"badge": label, "good": good, "promise": in_paragraphs(caller())}
        return ""

    def section(
        self, heading: str, *, folded: bool = False, listing: str = "", caller: Callable[[], str]
    ) -> str:
        """A section; one without content is left out."""
        parts: dict[str, list[Any]] = {"formulas": [], "tables": [], "figures": [], "notes": []}
        self._section = parts
        text = in_paragraphs(caller())
        if text or listing or any(parts.values()):
            made = ReportSection(heading, text, folded=folded, listing=listing, **parts)
            self.parts["sections"].append(made)
        self._section = {}
        return ""

    def formulas(self, rows: Sequence[FormulaRow]) -> str:
        """Formulas of a section."""
        self._section["formulas"] += rows
        return ""

    def notes(self, caller: Callable[[], str]) -> str:
        """Paragraphs in small print at the end of a section."""
        self._section["notes"] += in_paragraphs(caller())
        return ""

    def table(
        self, caption: str, frame: pd.DataFrame | None, *, data: pd.DataFrame | None = None,
        file: str = "", rows: int = 30, named: bool = False, help: Mapping[str, str] | None = None,
    ) -> str:  # fmt: skip
        """A table of a section, or that of the answer; left out if it has no rows.

        `help` says what columns mean, by their names without units.
        """
        if frame is None or frame.empty:
            return ""
        told = {str(name): (help or {}).get(str(name).partition(" (")[0], "") for name in frame.columns}
        meaning = {name: text for name, text in told.items() if text}
        made = ReportTable(caption, frame, meaning, file, rows, data, named)
        if self._section:
            self._section["tables"].append(made)
        else:
            self.parts["table"] = made
        return ""

    def figures(self, figures: Sequence[ReportFigure]) -> str:
        """Figures of a section."""
        self._section["figures"] += figures
        return ""

    def lead(self, figure: ReportFigure | None, *, first: bool = False) -> str:
        """The figure of the answer; `first` puts it above the sentence."""
        self.parts |= {"figure": figure, "figure_first": first}
        return ""


def compose(template: str, *, title: str, interactive: Markup | None = None, **values: Any) -> ReportContent:
    """Fill a page from a template of text, which reads `values` and has the writer as ``page``.

    `interactive` are the views that a reader can change.
    """
    writer = _PageWriter()
    environment().get_template(template).render(page=writer, **values)
    return ReportContent(title, interactive=interactive, **writer.parts)


LARGEST_VECTOR = 400_000  # bytes: a larger SVG is offered as the PNG that is shown
DOTS_PER_INCH = 200  # of the PNG files; pages have 96
CHARACTER = 7.6  # pixels, about: the width of a figure in a table
CELL = 18.0  # pixels around it
SHORT_TEXT, LINE = 24, 34  # characters: longer texts wrap, to lines no shorter than the latter
PHONE, PAGE = 360, 950  # pixels that a table may fill


def render_report(content: object, *, template: str = "report.html.j2", folder: Path | None = None) -> str:
    """Render a report, or what another template shows, as HTML; the same content gives the same page.

    All text is escaped, but for what is `markupsafe.Markup`. A `folder` may have templates of its own beside
    those of this package.
    """
    package = PackageLoader("siq.report")
    environment = Environment(
        loader=package if folder is None else ChoiceLoader([FileSystemLoader(folder), package]),
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {
        "cell": _cell_text,
        "is_number": lambda column: is_numeric_dtype(column) and not is_bool_dtype(column),
        # Without columns that say nothing: of missing values, or of empty texts.
        "kept_columns": lambda one: one.loc[:, one.empty | (one.notna() & (one.astype(str) != "")).any()],
        # An SVG inside <img> keeps its identifiers to itself and cannot run or load anything.
        "data_address": lambda figure: _address(figure.kind, figure.image),
        "figure_download": lambda figure: (
            ("svg", _address("svg", figure.vector))
            if figure.vector is not None and len(figure.vector) <= LARGEST_VECTOR
            else (figure.kind, _address(figure.kind, figure.image))
        ),
        "table_download": lambda table: _address(
            "csv",
            (table.frame if table.data is None else table.data)
            .to_csv(index=False, lineterminator="\n")
            .encode(),
        ),
        "file_name": lambda caption, number, *, what: "-".join(
            [what, str(number), *re.findall(r"[a-z0-9]+", caption.lower())[:5]]  # "table-3-barriers-of-u"
        ),
        "page_width": _page_width,
        "wide_for": _wide_for,
        "short": _short_caption,
        "unbroken": lambda text: text.replace(" × 10", "\u00a0×\u00a010"),
        "records": lambda frame: list(frame.itertuples(index=False, name=None)),
    }
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return environment.get_template(template).render(content=content)


_KINDS = {"svg": "image/svg+xml", "png": "image/png", "csv": "text/csv;charset=utf-8"}


def _address(kind: str, content: bytes) -> str:
    return f"data:{_KINDS[kind]};base64,{base64.b64encode(content).decode('ascii')}"


def _short_caption(caption: str) -> str:
    """The first sentence, or its first part, for the contents: no more than a line."""
    first = re.split(r"(?<=[a-zà-ÿ)\]])[.:;](?:\s|$)", caption, maxsplit=1)[0].rstrip(".")
    return first if len(first) <= 90 else first[:88].rsplit(" ", 1)[0] + " …"


def _page_width(figure: Any) -> int:
    # The first chunk of every PNG holds its width in dots.
    if figure.kind == "png":
        return round(int.from_bytes(figure.image[16:20], "big") * 96 / DOTS_PER_INCH)
    head = figure.image[:2000].decode("utf-8", errors="replace")
    found = re.search(r"<svg[^>]*\bwidth=\"([\d.]+)(pt|px|in)?\"", head)
    if found is None:
        return 600
    return round(float(found[1]) * {"pt": 96 / 72, "in": 96.0}.get(found[2] or "px", 1.0))


def _wide_for(frame: pd.DataFrame, rows: int) -> str:
    """For which screens a table is about too wide: ``page phone``, ``phone``, or none."""

    def longest_word(text: str) -> int:  # headings wrap, figures do not
        return max((len(word) for word in text.split()), default=0)

    def least_width(text: str) -> int:  # characters on the narrowest line: long texts wrap
        if len(text) <= SHORT_TEXT:
            return len(text)
        return min(LINE, max(longest_word(text), SHORT_TEXT // 2))

    width = 0.0
    for name in frame.columns:
        cells = [least_width(_cell_text(value)) for value in frame[name].head(rows)]
        width += CELL + CHARACTER * max([longest_word(str(name)), *cells])
    return "page phone" if width > PAGE else "phone" if width > PHONE else ""


def _cell_text(value: object) -> str:
    """What stands in a cell."""
    if value is None or value is pd.NA or value is pd.NaT:
        return "—"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return str(value).replace("-", "−")
    if isinstance(value, float | np.floating):
        number = float(value)
        # Counts become floating-point numbers as soon as one of their column is missing.
        whole = number.is_integer() and abs(number) < 1e5
        return str(int(number)).replace("-", "−") if whole else number_text(number)
    if isinstance(value, datetime.datetime):
        return value.isoformat(sep=" ", timespec="seconds")
    return str(value)


INSPECTION, SEEN = "inspection.json", "seen.json"
"""Files beside the figures of an inspection: its lines, and the two states that it shows."""


def inspection_drawn(
    recordings: Recordings, *, folder: Path, angles: Mapping[str, Sequence[float]] | None = None
) -> dict[str, Figure]:
    """The figures of an inspection by name; what it says is written into the folder."""
    from siq.report.plots.recordings import inspection_figures  # matplotlib

    found = inspect(joined(recordings), angles=angles)
    seen = None if found.switching is None else found.switching.as_data()
    for file, data in ((INSPECTION, found.lines()), (SEEN, seen)):
        text = json.dumps(data, ensure_ascii=False, allow_nan=False)
        (folder / file).write_text(text + "\n", encoding="utf-8")
    return inspection_figures(found)


def read_inspection(folder: str | Path) -> tuple[list[str] | None, RecordStates | None]:
    """What `inspection_drawn` wrote: its lines, and the two states; None where recordings were simulated."""
    files = [Path(folder) / name for name in (INSPECTION, SEEN)]
    lines, seen = (json.loads(file.read_text("utf-8")) if file.is_file() else None for file in files)
    return lines, None if seen is None else RecordStates.from_data(seen)


NODES = 64_000  # of the grid: 85 kB in the page
MOST_NODES = 128  # along one state
MOST_STATES = 4  # a grid of more would be too coarse to show a well
ABOVE, UNKNOWN = 254, 255
PATH_POINTS = 80
BANDS = 12  # of colours in a section
HIGHEST_BARRIER, LOWEST_BARRIER = 20.0, 2.0  # in units of ε: where the slider of the noise ends
NOISES = 40  # on the slider
SURFACE = 0.9  # of the height of the lowest saddle: where the surface is at first, a bubble about each well


def interactive_view(landscape: LandscapeSummary, *, solid: bool = True) -> Markup | None:
    """What a reader can change: the noise, and, if `solid`, a view of U that can be turned and cut.

    None where there is neither. Each is a ``<section>`` with its style, controls, data and script, to be put
    into a page once. Of more than four states those are shown along which the wells lie apart, with the
    others held at the lowest saddle; of one state, and where U is known nowhere, there is nothing to turn.
    """
    views = [_times_view(landscape), _solid_view(landscape) if solid else None]
    return Markup("\n").join(one for one in views if one is not None) or None


def _times_view(landscape: LandscapeSummary) -> Markup | None:
    """A slider for ε, with ΔU/ε and the mean time of every well; None where no time is known.

    The strengths lie between those at which the lowest barrier is `HIGHEST_BARRIER` and `LOWEST_BARRIER`
    noise strengths high. The noise of the system is among them if it is known, and the slider begins there.
    """
    depths = [one.depth for one in landscape.wells if 0 < one.depth < np.inf]
    if not landscape.has_times or not depths:
        return None
    low, high = (min(depths) / height for height in (HIGHEST_BARRIER, LOWEST_BARRIER))
    noise = landscape.noise or NoiseStrength(math.sqrt(low * high))
    first = noise.intensity
    even = np.geomspace(min(low, first), max(high, first), NOISES)
    strengths = sorted({first, *(float(f"{one:.4g}") for one in even)})  # as they are shown
    noises = [noise if one == first else NoiseStrength(one) for one in strengths]
    rows = [
        [
            {"ratio": value_text(*well.relative_depth(noise)), "time": time_text(well.time(noise))}
            for well in landscape.wells
        ]
        for noise in noises
    ]
    view = {
        "data": {"noises": [value_text(one) for one in strengths], "rows": rows},
        "first": strengths.index(first), "known": landscape.noise is not None,
        "noise": with_unit("noise strength ε", landscape.energy_unit),
        "time": with_unit("lasts", landscape.time_unit), "wells": [one.label for one in landscape.wells],
    }  # fmt: skip
    return Markup(render_report(view, template="times.html.j2"))


def _solid_view(landscape: LandscapeSummary) -> Markup | None:
    """A view of U that can be turned and cut."""
    count = len(landscape.names)
    if count < 2:
        return None
    first, lowest = list(landscape.plane()), landscape.lowest_saddle
    shown = sorted([*first, *(place for place in range(count) if place not in first)][:MOST_STATES])
    nodes = min(int(NODES ** (1 / len(shown)) + 1e-9), MOST_NODES)
    axes = [landscape.along(place, nodes) for place in shown]
    mesh = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(shown))
    points = np.tile(lowest, (len(mesh), 1))
    points[:, shown] = mesh
    values = landscape.potential(points).reshape((nodes,) * len(shown))
    known = np.isfinite(values)
    if not known.any():
        return None
    low, high = float(values[known].min()), landscape.highest_shown(values)
    high = high if high > low else low + 1.0
    low = 0.0 if abs(low) < 1e-3 * (high - low) else low  # the bottom is zero, but for the grid
    steps = np.full(values.shape, UNKNOWN)
    steps[known] = np.clip(np.round(253 * (values[known] - low) / (high - low)), 0, ABOVE)
    tops = [landscape.wells[way.start].height + way.barrier for way in landscape.ways]
    saddle = min((top for top in tops if np.isfinite(top)), default=np.inf)
    share = SURFACE * (saddle - low) / (high - low) if low < saddle < high else 0.5
    names = [landscape.names[place] for place in shown]
    units, unit = [unit_text(landscape.units[place]) for place in shown], unit_text(landscape.energy_unit)

    def short(numbers: Any) -> Any:
        return [short(one) for one in numbers] if np.ndim(numbers) else float(f"{numbers:.6g}")

    def thinned(path: np.ndarray) -> Any:
        rows = np.unique(np.linspace(0, len(path) - 1, min(PATH_POINTS, len(path))).astype(int))
        return short(path[rows][:, shown])

    def marks(points: Sequence[Any]) -> list[dict[str, Any]]:
        heights = [one.height if np.isfinite(one.height) else low for one in points]
        return [
            {"label": one.label, "position": short(one.position[shown]), "U": short(height)}
            for one, height in zip(points, heights, strict=True)
        ]

    data = {
        "names": names,
        "units": units,
        "labels": [f"{name} ({each})" if each else name for name, each in zip(names, units, strict=True)],
        "unit": unit,
        "energy": f"U ({unit})" if unit else "U (unit of ε)",
        "box": short(landscape.box[shown]),
        "shape": list(values.shape),
        "grid": base64.b64encode(steps.astype(np.uint8).tobytes()).decode("ascii"),
        "low": short(low),
        "high": short(high),
        "bands": BANDS,
        "wells": marks(landscape.wells),
        "saddles": marks(landscape.saddles),
        "ways": [
            {"uphill": thinned(way.uphill), "downhill": thinned(way.downhill)} for way in landscape.ways
        ],
        "pass": short(lowest[shown]),
    }
    rest = [place for place in range(count) if place not in shown]
    view = {
        "names": names, "data": data,
        "held": [f"{landscape.names[place]} = {lowest[place]:.3g}" for place in rest],
        "flat": len(shown) == 2, "level": round(1000 * share),
        "plane": [shown.index(state) for state in first], "wells": [one.label for one in landscape.wells],
        "ways": bool(landscape.ways),
    }  # fmt: skip
    return Markup(render_report(view, template="interactive.html.j2"))
