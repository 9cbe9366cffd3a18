"""Record tables: visits and densities as counted on the record and as foreseen, in rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from siq.landscape.record_test import RecordTest
from siq.numerics.measured_text import place_text
from siq.study.tables import as_table


def visit_rows(run: int, found: RecordTest | None, attractors: Sequence[np.ndarray]) -> pd.DataFrame:
    """One row for each well; none where there is no test."""
    rows = []
    for one in () if found is None else found.visits:
        lowest, highest = one.whole.limits
        rows.append(
            {
                "run": run,
                "attractor": place_text(attractors[one.well]),
                "visits": one.whole.visits,
                "time": one.whole.time,
                "counted": one.whole.mean,
                "lowest": lowest,
                "highest": highest if np.isfinite(highest) else np.nan,
                "held_out_visits": one.held_out.visits,
                "held_out_time": one.held_out.time,
                "held_out_counted": one.held_out.mean,
                "predicted": one.predicted,
                "predicted_error": one.predicted * one.error,
                "method": one.method,
                "probability": one.probability,
            }
        )
    return as_table("record", rows)


def density_rows(
    run: int, found: RecordTest | None, attractors: Sequence[np.ndarray], states: Sequence[str]
) -> pd.DataFrame:
    """One row for each bin of each histogram."""
    rows = [
        {
            "run": run,
            "attractor": place_text(attractors[one.well]),
            "state": states[one.state],
            "lower": one.edges[place],
            "upper": one.edges[place + 1],
            "counted": one.counted[place],
            "predicted": one.predicted[place],
            "distance": one.distance,
            "independent": one.independent,
            "probability": one.probability,
        }
        for one in (() if found is None else found.densities)
        for place in range(len(one.counted))
    ]
    return as_table("record_density", rows)
