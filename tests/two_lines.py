"""Studies of two lines, carried out in memory as the workflow carries them out."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from siq.systems.cards import load_system
from siq.workflow import recordings_step
from siq.workflow.pipeline import Analysis, PipelineSettings, analyse
from siq.workflow.settings import StudyParts, settings_of
from siq.workflow.study import load_study, system_path

SYSTEMS = Path(__file__).parents[1] / "config" / "systems"


def analysed(data: str, folder: Path) -> Analysis:
    """All that comes of a study of a name and of one line of data, with every default."""
    path = folder / "study.yaml"
    path.write_text(f"name: study\n{data}\n", encoding="utf-8")
    study = load_study(path)
    card = None if study.system is None else system_path(study.system, systems=SYSTEMS)
    system = None if card is None else load_system(card)
    parts = StudyParts(study, system)
    names = [field.name for field in dataclasses.fields(PipelineSettings)]
    settings = PipelineSettings(
        published_method=False, **{name: parts.part(name) for name in names if name != "published_method"}
    )
    own = settings_of(recordings_step.DrawSettings, study, system)
    source = card if study.recordings is None else study.recordings.file
    assert source is not None
    drawn = recordings_step.run(own, recordings_step.read(source, own), number=0)
    assert drawn.recordings is not None
    return analyse(drawn.recordings, settings)
