"""Files appear whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from siq.numerics.files import whole_file


def test_a_file_takes_its_place_when_the_block_has_ended(tmp_path: Path) -> None:
    path = tmp_path / "new folder" / "table.csv"
    with whole_file(path) as partial:
        partial.write_text("1", encoding="utf-8")
        assert partial.suffix == ".csv"
        assert not path.exists()
    assert path.read_text(encoding="utf-8") == "1"
    assert list(path.parent.iterdir()) == [path]


def test_after_an_error_the_old_file_is_there_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("old", encoding="utf-8")
    with pytest.raises(ZeroDivisionError), whole_file(path) as partial:
        partial.write_text("half", encoding="utf-8")
        _ = 1 / 0
    assert path.read_text(encoding="utf-8") == "old"
    assert list(tmp_path.iterdir()) == [path]
