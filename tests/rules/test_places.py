"""Where files are found, and what is said where they are not."""

from __future__ import annotations

from pathlib import Path

import pytest

from siq.errors import InputError
from workflow.places import BASE, config_path, configuration, find_file, named_file, names_in, needed_file
from workflow.settings import Studies

ROWS = "recording,t,x\n" + "".join(f"a,{k},{k % 3}\n" for k in range(9))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which one works, with a study in a folder of its own."""
    (tmp_path / "work" / "studies").mkdir(parents=True)
    (tmp_path / "lent").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setenv("SIQ_RESOURCES", str(tmp_path / "lent"))
    monkeypatch.delenv("SIQ_RECORDINGS", raising=False)
    return tmp_path


def test_a_file_is_sought_beside_the_study_then_where_one_works_then_in_the_resources(folder: Path) -> None:
    start = Path("studies")
    assert find_file("a.csv", start=start) is None
    for place in (folder / "lent", folder / "work", folder / "work" / "studies"):
        (place / "a.csv").touch()
        found = find_file("a.csv", start=start)
        assert found is not None and Path(found).resolve() == place / "a.csv"
    assert find_file("a.csv", start=folder / "work" / "studies") == str(Path("studies", "a.csv"))


def test_a_missing_file_is_told_with_every_place_and_the_nearest_name(folder: Path) -> None:
    (folder / "work" / "studies" / "bead.csv").touch()
    with pytest.raises(InputError) as refused:
        needed_file("baed.csv", start=Path("studies"), where=("studies/s.yaml", "line 2"))
    said = str(refused.value)
    for place in (folder / "work" / "studies", folder / "work", folder / "lent"):
        assert str(place / "baed.csv") in said
    assert said.startswith("studies/s.yaml, line 2: ") and "perhaps you meant 'bead.csv'" in said
    assert needed_file("results/made.csv", start=Path("studies"), where=("s", "")) == "results/made.csv"


def test_files_of_the_configuration_are_yours_or_those_beside_the_snakefile(folder: Path) -> None:
    assert config_path("systems", "resonator.yaml") == BASE / "config" / "systems" / "resonator.yaml"
    own = Path("config", "systems", "resonator.yaml")
    own.parent.mkdir(parents=True)
    own.touch()
    (own.parent / "mine.yaml").touch()
    assert config_path("systems", "resonator.yaml") == own
    assert {"mine", "archetype3d"} <= set(names_in("systems"))
    Path("config", "config.yaml").write_text("other: workflow\n")
    assert configuration(given=False) == str(Path("config", "config.yaml"))
    assert configuration(given=True) == str(BASE / "config" / "config.yaml")


def test_everything_that_a_study_names_starts_from_its_folder(folder: Path) -> None:
    studies = folder / "work" / "studies"
    (studies / "rows.csv").write_text(ROWS)
    (studies / "cards").mkdir()
    card = (BASE / "config" / "systems" / "maier-stein.yaml").read_text(encoding="utf-8")
    (studies / "cards" / "own.yaml").write_text(card, encoding="utf-8")
    text = "name: s\nsystem: cards/own.yaml\nrecordings: {file: rows.csv}\n"
    (studies / "s.yaml").write_text(text)
    config = {"name": "s", "system": "cards/own.yaml", "recordings": {"file": "rows.csv"}}
    study = Studies(config, configfiles=["studies/s.yaml"])["s"]
    assert study.source() == str(Path("studies", "rows.csv"))
    assert study.card() == str(Path("studies", "cards", "own.yaml"))
    assert study.command() == "siq run studies/s.yaml"
    assert named_file("cards/own.yaml", "systems", start=Path("studies")) == Path(
        "studies", "cards", "own.yaml"
    )


@pytest.mark.parametrize(
    ("key", "value", "part"),
    [("system", "archetyp3d", "perhaps you meant 'archetype3d'"), ("system", "cards/x.yaml", "cards/x.yaml")],
)
def test_a_missing_card_is_told_with_the_line_of_the_study(
    folder: Path, key: str, value: str, part: str
) -> None:
    Path("studies", "s.yaml").write_text(f"name: s\n{key}: {value}\n")
    with pytest.raises(InputError, match="line 2") as refused:
        Studies({"name": "s", key: value}, configfiles=["studies/s.yaml"])
    assert part in str(refused.value)


def test_networks_are_asked_for_before_anything_runs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("workflow.settings.NETWORKS", ("no_such_package",))
    Path("studies", "s.yaml").write_text("name: s\nsystem: archetype3d\ntraining: {}\n")
    with pytest.raises(InputError, match=r"line 3 \(training\).*quasipotential\[networks\]"):
        Studies({"name": "s", "system": "archetype3d", "training": {}}, configfiles=["studies/s.yaml"])
