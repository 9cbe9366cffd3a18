"""The official tests of public benchmarks in one table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd

from siq.numerics.text import value_text

OURS = {
    "recalibrated": "the card’s equations, refitted",
    "augmented": "the card with what the diagnosis found",
}


def official_rows(benchmark: str, table: pd.DataFrame) -> pd.DataFrame:
    """The errors of a benchmark, ready to stand in one table with others.

    Parameters
    ----------
    benchmark
        Its name.
    table
        Of `benchmarks.publication.official_scores.official_tables`.

    Returns
    -------
    pandas.DataFrame
        Columns ``benchmark test by error unit scored source``.
    """
    return pd.DataFrame(
        {
            "benchmark": benchmark,
            "test": table["test"],
            "by": table["simulation"].map(OURS).fillna(table["simulation"]),
            "error": table["error"],
            "unit": table["unit"],
            "scored": table["scored"],
            "source": table["source"],
        }
    )


def official_page(rows: pd.DataFrame, verdicts: Mapping[str, Mapping[str, Any]]) -> str:
    """The table as Markdown, below what the diagnosis says of each benchmark.

    Parameters
    ----------
    rows
        Of `official_rows`, of all benchmarks.
    verdicts
        What ``verdict.json`` says, by benchmark.
    """
    lines = ["# Official tests of public benchmarks", ""]
    for name, verdict in verdicts.items():
        lines += [f"**{name}**: {verdict['sentence']}", ""]
    lines += [
        "| benchmark | test | by | error | how it was scored | who says so |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows.to_dict("records"):
        error = f"{value_text(float(row['error']), digits=3)} {row['unit']}"
        cells = (row["benchmark"], row["test"], row["by"], error, row["scored"], row["source"])
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines) + "\n"
