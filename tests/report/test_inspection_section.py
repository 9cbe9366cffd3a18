from __future__ import annotations

from pathlib import Path

import numpy as np
from remembering import STEP, double_wells

from siq.data.recordings import Recordings
from siq.report.study_page import CAPTIONS, inspection_drawn, inspection_section, read_inspection


def test_the_first_section_has_sentences_and_three_figures(tmp_path: Path) -> None:
    values = double_wells(1, states=2, samples=1_000)
    recordings = Recordings.from_arrays(np.arange(values.shape[1]) * STEP, values, names=["x", "y"])
    figures = inspection_drawn(recordings, folder=tmp_path)
    assert list(figures) == list(CAPTIONS)
    lines = read_inspection(tmp_path)
    assert lines is not None
    section = inspection_section(lines, dict.fromkeys(figures, b"png"), {})
    assert section.heading == "What is in the recordings"
    assert len(section.figures) == 3
    assert all(line.endswith(".") for line in section.text)
    assert any(line.startswith("x: ") for line in section.text)


def test_simulated_studies_have_none(tmp_path: Path) -> None:
    assert read_inspection(tmp_path) is None
