"""Studies of two lines, carried out in memory as the workflow carries them out."""

from __future__ import annotations

from pathlib import Path

from siq.systems.cards import load_system
from siq.workflow import pipeline
from siq.workflow.pipeline import Analysis, analyse, source_of
from siq.workflow.study import load_study, settings_of
from workflow.places import named_file


def analysed(data: str, folder: Path) -> Analysis:
    """All that comes of a study of a name and of one line of data, with every default."""
    path = folder / "study.yaml"
    path.write_text(f"name: study\n{data}\n", encoding="utf-8")
    study = load_study(path)
    card = None if study.system is None else named_file(study.system, "systems", start=folder)
    system = None if card is None else load_system(card)
    settings = settings_of(study, system)
    source = card if study.recordings is None else study.recordings.file
    assert source is not None
    drawn = pipeline.draw_run(settings, source_of(source, settings), number=0)
    assert drawn.result is not None
    return analyse(drawn.result, settings)
