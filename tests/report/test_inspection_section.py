from __future__ import annotations

from pathlib import Path

import numpy as np
from remembering import STEP, double_wells

from siq.data.recordings import Recordings
from siq.report.formatting import texts
from siq.report.page import inspection_drawn, read_inspection


def test_an_inspection_leaves_its_lines_and_three_figures(tmp_path: Path) -> None:
    values = double_wells(1, states=2, samples=1_000)
    recordings = Recordings.from_arrays(np.arange(values.shape[1]) * STEP, values, names=["x", "y"])
    figures = inspection_drawn(recordings, folder=tmp_path)
    assert list(figures) == list(texts("captions")["inspection"])
    lines, seen = read_inspection(tmp_path)
    assert lines is not None and seen is not None
    assert any(line.startswith("x: ") for line in lines)


def test_simulated_studies_have_none(tmp_path: Path) -> None:
    assert read_inspection(tmp_path) == (None, None)
