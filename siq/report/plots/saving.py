"""How a figure is written to files."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from siq.files.whole import whole_file
from siq.report.plots.style import drawing_style

DOTS_PER_INCH = {".png": 200, ".svg": 300}  # in an SVG, of the parts drawn as an image


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
    # Date and Software would make the same figure differ between days and versions.
    return _save(figure, stem, ".svg", {"Date": None}), _save(figure, stem, ".png", {"Software": None})


def _save(figure: Figure, stem: Path, suffix: str, metadata: dict[str, None]) -> Path:
    path = stem.with_name(stem.name + suffix)
    with whole_file(path) as partial, drawing_style():
        figure.savefig(partial, dpi=DOTS_PER_INCH[suffix], metadata=metadata)
    return path
