"""A small part of the tries of `benchmarks.fuzz`: any file is read, or refused in a sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import fuzz


@pytest.mark.skipif(not hasattr(fuzz.os, "fork"), reason="this system cannot fork")
@pytest.mark.filterwarnings("ignore")
def test_mutated_files_are_read_or_refused(tmp_path: Path) -> None:
    told = fuzz.run(list(range(100_000, 100_200)), tmp_path / "log.jsonl")
    assert len(told) == 200
    assert [one for one in told if one["fault"]] == []
    assert sum(one["how"] == "refused" for one in told) > 50
