"""How a figure is written to files."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from matplotlib.figure import Figure

from siq.plots.style import drawing_style

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
    stem.parent.mkdir(parents=True, exist_ok=True)
    # Date and Software would make the same figure differ between days and versions.
    return _save(figure, stem, ".svg", {"Date": None}), _save(figure, stem, ".png", {"Software": None})


def _save(figure: Figure, stem: Path, suffix: str, metadata: dict[str, None]) -> Path:
    path = stem.with_name(stem.name + suffix)
    handle, temporary = tempfile.mkstemp(suffix=suffix, prefix=f".{stem.name}-", dir=stem.parent)
    os.close(handle)
    try:
        with drawing_style():
            figure.savefig(temporary, dpi=DOTS_PER_INCH[suffix], metadata=metadata)
        Path(temporary).chmod(0o644)  # mkstemp's files are for their owner alone
        Path(temporary).replace(path)
    finally:
        Path(temporary).unlink(missing_ok=True)
    return path
