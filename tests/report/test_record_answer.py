"""The figure of the record's own hops."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from siq.workflow.tables import as_table
from workflow.figures.prediction import plot_record


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
