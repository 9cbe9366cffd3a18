"""The figure of the record's own hops."""

from __future__ import annotations

import itertools

import numpy as np
from told_landscapes import record_row, unseen_row

from siq.workflow.tables import as_table
from workflow.figures.prediction import plot_record


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
    record = as_table("record", [record_row(), unseen_row(attractor="(-1)")])
    figure = plot_record(record, as_table("record_density", rows), units={"x": "nm", "y": "1"}, time_unit="s")
    assert figure is not None and len(figure.axes) == 3
    assert plot_record(as_table("record", []), as_table("record_density", []), units={}) is None
