"""What the page of a study says of the landscape of the card's own equations beside the learned one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from siq.numerics.measured_text import value_text
from siq.report.page import ReportTable

CAPTION = (
    "Barriers, prefactors and mean times: by the equations of the card, and by the trajectories alone. This"
    " is scoring, and no input of the method."
)
EXPLAINED = {
    "item": "A1 is the first attractor of the equations, and so on; A1 to A2 is the way out of it",
    "difference": "trajectories / equations − 1",
    "in standard errors": "of the number by the trajectories, as these state it",
}


def beside_sentences(table: pd.DataFrame | None) -> list[str]:
    """The largest difference of a barrier, and what cannot be compared; nothing where nobody asked.

    Parameters
    ----------
    table
        `beside_equations`, None where there is none.
    """
    if table is None or table.empty:
        return []
    barriers = table[table["quantity"] == "barrier"]
    off = barriers["relative_difference"].abs().max()
    said = []
    if np.isfinite(off):
        said.append(
            "The equations of the card, which are no input of the method, have barriers too: those of the"
            f" trajectories are off by {_share(off)} at most."
        )
    for note, some in table[table["note"].fillna("") != ""].groupby("note", sort=False):
        named = ", ".join(item for item in dict.fromkeys(some["item"].fillna("")) if item)
        said.append(f"Beside the equations: {named + ': ' if named else ''}{note}.")
    return said


def beside_table(table: pd.DataFrame, folder: Path) -> ReportTable:
    """Every number by both; of several runs their mean, with the largest difference.

    Parameters
    ----------
    table
        `beside_equations`.
    folder
        Where it lies.
    """
    known = table[table["quantity"].fillna("") != ""]
    rows = []
    for _, some in known.groupby(["item", "quantity", "noise"], sort=False, dropna=False):
        first = some.iloc[0]
        at = f" at ε = {value_text(first['noise'])}" if np.isfinite(first["noise"]) else ""
        several = some["run"].nunique() > 1
        off, sharp = some["relative_difference"], some["in_errors"]
        rows.append(
            {
                "item": first["item"],
                "what": f"{first['quantity']}{at}",
                "by the equations": _text(first["equations"]),
                "by the trajectories": _text(some["trajectories"].mean()),
            }
            | (
                {
                    "runs": int(some["trajectories"].notna().sum()),
                    "largest difference": _share(off.abs().max()),
                    "largest in standard errors": _text(sharp.abs().max(), digits=2),
                }
                if several
                else {
                    "difference": _share(off.iloc[0], sign=True),
                    "in standard errors": _text(sharp.iloc[0], digits=2),
                }
            )
        )
    return ReportTable(
        CAPTION, pd.DataFrame(rows), EXPLAINED, f"{folder}/beside_equations.csv", 40, data=table
    )


def _text(value: float, *, digits: int = 5) -> str:
    return value_text(value, digits=digits) if np.isfinite(value) else ""


def _share(value: float, *, sign: bool = False) -> str:
    """A difference in per cent."""
    if not np.isfinite(value):
        return ""
    text = value_text(100 * value, digits=2)
    return f"+{text} %" if sign and value > 0 else f"{text} %"
