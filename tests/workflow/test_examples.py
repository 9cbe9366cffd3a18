"""Studies that are written for a file of recordings, and examples."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from siq.data.recordings import read_recordings
from siq.diagnosis.study import read_case
from siq.errors import InputError
from siq.systems.cards import load_system
from siq.workflow.examples import (
    _spring_recordings,
    double_well_recordings,
    init_study,
    name_for,
    write_example,
    write_generated,
)
from siq.workflow.study import load_study


@pytest.mark.parametrize(
    ("path", "name"),
    [("bead.csv", "bead"), ("my data (1).csv", "my-data-1"), ("a.b.parquet", "a.b"), ("µ.csv", "recordings")],
)
def test_results_are_named_as_the_file(path: str, name: str) -> None:
    assert name_for(Path(path)) == name


def test_the_shortest_study_names_the_file_from_its_own_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "my: bead.csv").write_text(double_well_recordings(1, 20))
    monkeypatch.chdir(tmp_path)
    study, origin = write_generated(Path("data/my: bead.csv"), "my-bead")
    assert origin == "data/my: bead.csv"
    options = load_study(study).recordings
    assert options is not None
    assert (study.parent / options.file).resolve() == tmp_path / "data" / "my: bead.csv"
    turns = "".join(f"{0.1 * k:.1f},{(7 * k) % 360},{k % 7}\n" for k in range(200))
    (tmp_path / "motor.csv").write_text("t,angle,x\n" + turns)
    study, _ = write_generated(Path("motor.csv"), "motor")
    assert load_study(study).identification.angles == {"angle": (0.0, 360.0)}


def test_a_study_that_was_begun_runs_as_it_is_and_with_every_comment_taken_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "spring.csv").write_text(_spring_recordings(2, 20))
    monkeypatch.chdir(tmp_path)
    study = init_study(Path("spring.csv"))
    text = study.read_text(encoding="utf-8")
    assert load_study(study).name == "spring" and "2 recordings" in text and "different units" in text
    free = re.sub(r"^( *)# (\w+: [\w\[{].*)$", r"\1\2", text, flags=re.MULTILINE)
    study.write_text(free.replace("landscape: false\n", ""), encoding="utf-8")
    full = load_study(study)
    assert full.recordings is not None and full.recordings.states == ("x", "v") and full.runs == 5
    assert full.recordings.pair_step == pytest.approx(0.15) and full.training is not None
    with pytest.raises(InputError, match="the file is there already"):
        init_study(Path("spring.csv"))
    assert load_study(init_study(Path("spring.csv"), replace=True)).runs == 1


@pytest.mark.parametrize("name", ["double-well", "mismatch"])
def test_an_example_can_be_read_and_is_not_written_twice(tmp_path: Path, name: str) -> None:
    files, command = write_example(name, tmp_path)
    assert str(tmp_path) in command
    if name == "double-well":
        recordings = read_recordings(files[0])
        assert recordings.time_unit == "s" and set(recordings.units) == {"um"}
        assert load_study(files[1]).name == "double-well"
    else:
        assert read_case(files[1], files[0], None).system.name == load_system(files[1]).name == "spring"
    before = files[0].stat().st_mtime_ns
    with pytest.raises(InputError, match="--force"):
        write_example(name, tmp_path)
    assert files[0].stat().st_mtime_ns == before


def test_a_name_that_is_too_long_is_cut_and_stays_apart_from_others() -> None:
    names = {name_for(Path(f"{'long-' * 40}{end}.csv")) for end in "ab"}
    assert len(names) == 2 and all(len(name) < 30 for name in names)
