"""What is recorded of results: any change of any file is seen, and what is damaged is set aside."""

from __future__ import annotations

from pathlib import Path

import pytest

from siq.errors import InputError
from siq.workflow.answers import PROVENANCE, Provenance


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Results of two steps, the second of which reads what the first has made."""
    monkeypatch.chdir(tmp_path)
    folder = Path("results", "mine")
    (folder / "figures").mkdir(parents=True)
    Path("record.csv").write_text("t,x\n0,1\n")
    for name in ("table.parquet", "table.csv", "answer.json", "figures/one.svg"):
        (folder / name).write_text(f"what {name} says\n")
    kept = Provenance(folder)
    kept.record(
        "draw",
        inputs={"source": "record.csv"},
        outputs={"table": str(folder / "table.parquet")},
        said={"seed": 7},
    )
    made = [str(folder / name) for name in ("answer.json", "figures")]
    kept.record(
        "page", inputs={"table": [str(folder / "table.parquet")], "none": []}, outputs={"made": made}, said={}
    )
    return folder


def test_every_flipped_byte_is_seen(results: Path) -> None:
    files = [file for file in results.rglob("*") if file.is_file()]
    assert Provenance(results).changed() == [] and Provenance(results).broken == 0
    for file in files:
        whole = file.read_bytes()
        for place in range(0, len(whole), 7):
            file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
            kept = Provenance(results)
            assert kept.changed() or kept.broken, (file, place)
        file.write_bytes(whole)
    (results / "figures" / "another.svg").touch()
    assert Provenance(results).changed() == ["figures"]


def test_what_is_damaged_is_told_and_set_aside_with_all_that_the_step_made(results: Path) -> None:
    (results / "table.csv").write_text("another number\n")
    planned = Provenance(results).set_aside(remove=False)
    assert planned == [f"{results / 'table.csv'} is not as it was written; it is made again."]
    assert (results / "table.parquet").exists()
    assert Provenance(results).set_aside() == planned
    left = sorted(file.name for file in results.rglob("*") if file.is_file())
    assert left == ["answer.json", "one.svg", PROVENANCE]


def test_nothing_is_built_upon_a_damaged_file(results: Path) -> None:
    table = results / "table.parquet"
    Provenance.check({"table": str(table), "source": "record.csv"})
    table.write_text("forged")
    with pytest.raises(InputError, match=r"table.parquet: the file is not as it was written; give"):
        Provenance.check({"table": [str(table)]})


def test_half_a_line_of_a_killed_process_harms_no_other(results: Path) -> None:
    with (results / PROVENANCE).open("a") as file:
        file.write('{"task": "dr')
    Provenance(results).record("score", inputs={}, outputs={"answer": str(results / "answer.json")}, said={})
    kept = Provenance(results)
    assert kept.broken == 1 and kept.changed() == []
    assert kept.made["answer.json"]["task"] == "score"


def test_one_line_says_what_results_came_from(results: Path) -> None:
    digest = Provenance.digest_of(Path("record.csv"))
    assert digest is not None
    assert Provenance(results).origin() == f"record.csv (SHA-256 {digest[:16]}), seed 7"
    assert {"siq", "python"} <= set(Provenance(results).made["answer.json"]["versions"])
