"""The figures of a study: which there are, where they stand, and what they are drawn from.

Their captions are in `templates/captions.yaml`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from siq.data.inspection import inspection_of
from siq.data.preparation import joined
from siq.data.recordings import Recordings
from siq.data.two_states import RecordStates
from siq.report.formatting import texts
from siq.report.page import ReportFigure
from siq.report.plots.recordings import inspection_figures

OF_NETWORKS = ("coefficients_regression", "inclusion_regression", "training")
"""Figures that say nothing where no networks were asked for."""

OF_RUNS = ("coefficients_refined", "inclusion_refined", "coefficients_regression", "inclusion_regression",
           "error_distribution")  # fmt: skip
"""Figures of a scatter over runs, of which there is none in one."""

INSPECTION, SEEN = "inspection.json", "seen.json"
"""Files beside the figures of an inspection: its lines, and the two states that it shows."""

LEADING = ("quasipotential", "landscape")
"""Figures that a page can open with, the best first."""


def shown_figures(names: set[str], *, runs: int, networks: bool, published: bool) -> set[str]:
    """Which figures a page shows of those that exist.

    Parameters
    ----------
    names
        Of the figures that were drawn.
    runs
        Number of runs.
    networks
        Whether networks were asked for.
    published
        Whether the study names published figures.
    """
    names = names - set(texts("captions")["inspection"])
    if not published:
        names = names - {"landscape_published"}
    if not networks:
        names = names - set(OF_NETWORKS)
    if runs == 1:
        names = names - set(OF_RUNS)
    return names - {"landscape"} if "quasipotential" in names else names


def figures_of(
    part: str, images: Mapping[str, bytes], vectors: Mapping[str, bytes], *, beside_paper: bool = False
) -> list[ReportFigure]:
    """The figures of a part of the page, in the order of their captions.

    Parameters
    ----------
    part
        Of the page; figures without a caption stand last, with the workings.
    images, vectors
        PNG and SVG by name.
    beside_paper
        Whether to name the figures of the paper.
    """
    captions = texts("captions")["figures"]
    names = [name for name, caption in captions.items() if caption["part"] == part and name in images]
    if part == "workings":
        names += sorted(set(images) - set(captions) - set(texts("captions")["inspection"]))
    return [figure_of(name, images, vectors, beside_paper=beside_paper) for name in names]


def figure_of(
    name: str, images: Mapping[str, bytes], vectors: Mapping[str, bytes], *, beside_paper: bool = False
) -> ReportFigure:
    """One figure with its caption."""
    caption = texts("captions")["figures"].get(name, {"text": f"{name.replace('_', ' ').capitalize()}."})
    text = caption["text"]
    if beside_paper and "paper" in caption:
        text += f" In the paper: {caption['paper']}."
    return ReportFigure(text, caption["text"], images[name], "png", vectors.get(name))


def inspection_drawn(recordings: Recordings, *, folder: Path) -> dict[str, Figure]:
    """The figures of an inspection by name; what it says is written into the folder."""
    found = inspection_of(joined(recordings))
    seen = None if found.seen is None else found.seen.as_data()
    for file, data in ((INSPECTION, found.lines()), (SEEN, seen)):
        text = json.dumps(data, ensure_ascii=False, allow_nan=False)
        (folder / file).write_text(text + "\n", encoding="utf-8")
    return inspection_figures(found)


def read_seen(folder: str | Path) -> RecordStates | None:
    """What `inspection_drawn` wrote of two states; None where recordings were simulated."""
    file = Path(folder) / SEEN
    data = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else None
    return None if data is None else RecordStates.from_data(data)


def read_inspection(folder: str | Path) -> list[str] | None:
    """What `inspection_drawn` wrote, line by line; None where recordings were simulated."""
    file = Path(folder) / INSPECTION
    return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else None
