"""What all runs of a study say together."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from siq.workflow.tables import COLUMNS, Outcome, Status, Step
from workflow import scoring


def benchmark(folder: Path, name: str, seconds: float) -> None:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"s\th:m:s\n{seconds}\t0:00:01\n")


def test_runs_that_trained_side_by_side_share_their_time(tmp_path: Path) -> None:
    benchmark(tmp_path, "000-001/train.tsv", 10.0)
    benchmark(tmp_path, "000/draw.tsv", 1.0)
    benchmark(tmp_path, "001/draw.tsv", 2.0)
    table = scoring.timings(tmp_path, [0, 1], drawing="resample")
    assert table[["run", "step"]].to_numpy().tolist() == [
        [0, "resample"], [0, "train"], [1, "resample"], [1, "train"]
    ]  # fmt: skip
    assert table["seconds"].tolist() == pytest.approx([1.0, 5.0, 2.0, 5.0])


def test_outcomes_stand_by_run_in_the_order_of_the_steps(tmp_path: Path) -> None:
    said = [
        Outcome(1, Step.SIMULATE),
        Outcome(0, Step.REFINE, Status.FAILED, "no attractor", {"detail": 1}),
        Outcome(0, Step.SIMULATE),
        Outcome(1, Step.REFINE, Status.WARNING, "not certified"),
    ]
    parts: dict[str, list[pd.DataFrame]] = {name: [] for name in scoring.OF_RUNS}
    tables = scoring.collect_runs(parts, said, {}, benchmarks=tmp_path)
    assert set(tables) == {*scoring.OF_RUNS, "outcomes", "timings", "summary"}
    for name, table in tables.items():
        assert list(table.columns) == list(COLUMNS[name])
    assert tables["outcomes"].to_numpy().tolist() == [
        [0, "simulate", "ok", ""],
        [0, "refine", "failed", "no attractor"],
        [1, "simulate", "ok", ""],
        [1, "refine", "warning", "not certified"],
    ]
