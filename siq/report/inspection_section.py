"""What does the first section of a page say: what is in the recordings?"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from siq.data.inspection import inspection_of
from siq.data.record_states import RecordStates
from siq.data.recordings import Recordings
from siq.data.selection import joined
from siq.report.page import ReportFigure, ReportSection

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEADING = "What is in the recordings"
CAPTIONS: Mapping[str, str] = {
    "record": "The states in the course of time; of long recordings from the lowest to the highest value.",
    "visited": "How often states were visited: what was never visited, no formula knows.",
    "memory": "Correlation of what increments leave once their mean is taken off, over the steps between"
    " them; within the band they know nothing of each other. The mean is that which earlier states tell.",
}


FILE, SEEN = "inspection.json", "seen.json"


def inspection_drawn(recordings: Recordings, *, folder: Path) -> dict[str, Figure]:
    """The figures of an inspection by name; what it says is written into the folder."""
    from siq.report.plots.inspection import inspection_figures  # matplotlib

    found = inspection_of(joined(recordings))
    (folder / FILE).write_text(json.dumps(found.lines(), ensure_ascii=False) + "\n", encoding="utf-8")
    (folder / SEEN).write_text(
        json.dumps(None if found.seen is None else found.seen.as_data(), ensure_ascii=False, allow_nan=False)
        + "\n",
        encoding="utf-8",
    )
    return inspection_figures(found)


def read_seen(folder: str | Path) -> RecordStates | None:
    """What `inspection_drawn` wrote of two states; None where recordings were simulated."""
    file = Path(folder) / SEEN
    data = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else None
    return None if data is None else RecordStates.from_data(data)


def read_inspection(folder: str | Path) -> list[str] | None:
    """What `inspection_drawn` wrote, line by line; None where recordings were simulated."""
    file = Path(folder) / FILE
    return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else None


def inspection_section(
    lines: Sequence[str], images: Mapping[str, bytes], vectors: Mapping[str, bytes]
) -> ReportSection:
    """The section, from the lines of an inspection and its figures, PNG and SVG by name."""
    sentences = [line if line.endswith((".", ":")) else f"{line}." for line in lines]
    figures = [
        ReportFigure(caption, caption, images[name], "png", vectors.get(name))
        for name, caption in CAPTIONS.items()
        if name in images
    ]
    # The name of a state stays as it is: X is not x.
    named = [line.partition(" ")[0].endswith(":") for line in sentences]
    capital = [
        line if is_state else f"{line[0].upper()}{line[1:]}"
        for line, is_state in zip(sentences, named, strict=True)
    ]
    return ReportSection(HEADING, capital, figures=figures)
