"""What the page says of the record's own hops."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from siq.report.landscape_answer import record_sentences, record_table
from siq.report.plots.prediction import plot_record
from siq.workflow.tables import as_table


def well(**change: Any) -> dict[str, object]:
    row: dict[str, object] = {
        "run": 0, "attractor": "(1)", "visits": 16, "time": 800.0, "counted": 50.0, "lowest": 31.0,
        "highest": 87.0, "held_out_visits": 4, "held_out_time": 180.0, "held_out_counted": 45.0,
        "predicted": 51.0, "predicted_error": 3.0, "method": "operator", "probability": 0.8,
    }  # fmt: skip
    return row | change


def never(**change: Any) -> dict[str, object]:
    return well(
        visits=0, counted=np.nan, highest=np.nan, held_out_visits=0, held_out_counted=np.nan, **change
    )


def test_hops_are_counted_and_what_they_allow_is_said() -> None:
    said = " ".join(record_sentences(as_table("record", [well(), well(attractor="(-1)", visits=25)]), ""))
    assert said.startswith("41 hops") and "8 of them" in said and "25 %" in said


@pytest.mark.parametrize(
    ("rows", "missing", "said"),
    [
        ([], "nothing hops", ["There is no test against the record itself: nothing hops."]),
        ([], "", []),
        ([never()], "", ["No hop from well to well was seen."]),
    ],
)
def test_what_is_not_there_is_said(rows: list[dict[str, object]], missing: str, said: list[str]) -> None:
    assert record_sentences(as_table("record", rows), missing) == said


def test_a_table_says_counts_with_intervals() -> None:
    table = record_table(as_table("record", [well(), never()]), "s", Path("tables"))
    assert table is not None
    counted = table.frame["mean visit, counted (s)"].tolist()
    assert counted[0].startswith("50") and "31 to 87" in counted[0] and counted[1].startswith("above")
    assert table.frame["predicted (s)"].tolist()[0] == "51.0 ± 3.0"
    assert record_table(as_table("record", []), "s", Path("tables")) is None


def test_the_figure_has_a_panel_for_each_histogram() -> None:
    edges = np.linspace(-1, 1, 11)
    rows: list[dict[str, object]] = [
        {
            "run": 0, "attractor": "(1)", "state": state, "lower": low, "upper": high, "counted": 0.5,
            "predicted": 0.4, "distance": 0.1, "independent": 30.0, "probability": 0.5,
        }
        for state in ("x", "y")
        for low, high in itertools.pairwise(edges)
    ]  # fmt: skip
    record = as_table("record", [well(), never(attractor="(-1)")])
    figure = plot_record(record, as_table("record_density", rows), units={"x": "nm", "y": "1"}, time_unit="s")
    assert figure is not None and len(figure.axes) == 3
    assert plot_record(as_table("record", []), as_table("record_density", []), units={}) is None
