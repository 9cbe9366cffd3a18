"""What the page says of the record's own hops and histogram, beside what was identified."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from siq.data.record_states import RecordStates
from siq.numerics.measured_text import place_text, range_text, unit_text, value_text
from siq.report.page import ReportTable

METHODS = {"operator": "Fokker–Planck operator", "law": "law of Eyring and Kramers"}
LARGE = 0.5  # relative error from which on a range says more than ±


def with_visits(overview: Mapping[str, Any] | None, record: pd.DataFrame) -> dict[str, Any] | None:
    """A landscape as plain data, with how long visits to its wells last.

    Parameters
    ----------
    overview
        The landscape of a run; None where there is none.
    record
        The table of that name, of all runs.
    """
    if overview is None:
        return None
    rows = {str(one["attractor"]): one for one in record[record["run"] == overview["run"]].to_dict("records")}
    visits = [
        {
            "well": index,
            "visits": int(one["visits"]),
            "counted": one["counted"],
            "lowest": one["lowest"],
            "highest": one["highest"],
            "predicted": one["predicted"],
            "error": one["predicted_error"],
            "method": one["method"],
        }
        for index, well in enumerate(overview["wells"])
        if (one := rows.get(place_text(well["attractor"]))) is not None
    ]
    return {**overview, "visits": visits}


def with_seen_states(
    told: Sequence[str], overview: Mapping[str, Any], seen: RecordStates | None, *, certified: bool
) -> list[str]:
    """What is told of a landscape, with the states that the recordings show by themselves.

    Parameters
    ----------
    told
        The answer in one sentence, and what has to be known of it.
    overview
        The landscape as plain data.
    seen
        The states, None where nothing is known of them.
    certified
        Whether the landscape may be believed: then nothing is added.
    """
    own = "" if seen is None else seen.sentence()
    if own and len(overview["wells"]) == 1:
        # What is seen without any formula comes first where the formula misses it.
        alone = f"What was identified misses them: {told[0][0].lower()}{told[0][1:]}"
        return [own, alone, *told[1:]]
    if own and not certified:
        return [*told, f"Without any formula: {own[0].lower()}{own[1:]}"]
    return list(told)


def record_sentences(record: pd.DataFrame, missing: str) -> list[str]:
    """How many hops were seen, what that allows, and whether it agrees; or why there is no test.

    Parameters
    ----------
    record
        The rows of one run of the table of that name.
    missing
        Why there is no test; empty where there is one.
    """
    if record.empty:
        return [f"There is no test against the record itself: {missing}."] if missing else []
    hops, held = int(record["visits"].sum()), int(record["held_out_visits"].sum())
    if not hops:
        return ["No hop from well to well was seen."]
    fewest = int(record["visits"].min())
    worth = (
        "tells nothing of its mean" if not fewest else f"is known to {100 / math.sqrt(fewest):.0f} % at best"
    )
    seen = f"{hops} hops from well to well were seen" if hops > 1 else "One hop from well to well was seen"
    part = "none" if not held else str(held)
    return [
        f"{seen}, {part} of them on recordings that were held out. A mean time from n visits has a relative"
        f" error of 1/√n: the one of the fewest visits, {fewest}, {worth}."
    ]


def record_table(record: pd.DataFrame, time_unit: str, folder: Path) -> ReportTable | None:
    """Mean visits to each well, counted and predicted; None where there is no test.

    Parameters
    ----------
    record
        The rows of one run of the table of that name.
    time_unit
        Of the recordings.
    folder
        Where the whole tables are.
    """
    if record.empty:
        return None
    unit = f" ({unit_text(time_unit)})" if unit_text(time_unit) else ""
    rows = [
        {
            "well about": one["attractor"],
            "visits seen to end": int(one["visits"]),
            f"mean visit, counted{unit}": _counted(one),
            "held out: visits": int(one["held_out_visits"]),
            f"held out: mean{unit}": value_text(one["held_out_counted"], digits=3)
            if math.isfinite(one["held_out_counted"])
            else "none ended",
            f"predicted{unit}": _predicted(one),
            "by": METHODS.get(str(one["method"]), str(one["method"])),
            "probability": f"{one['probability']:.2g}",
        }
        for one in record.to_dict("records")
    ]
    explained = {
        "visits seen to end": "a visit lasts from where the core of a well is entered until the core of"
        " another one is; what the record cuts counts with its time, and not as a visit",
        f"mean visit, counted{unit}": "on all recordings: time over visits, with its interval of 95 %",
        f"predicted{unit}": "of the same visits, from f, D and ε, with the error that these leave",
        "probability": "of a count on held-out recordings that is as far off, were the prediction true within"
        " its error",
    }
    return ReportTable(
        "How long visits to each well last: counted on the record, and predicted.",
        pd.DataFrame(rows), explained, f"{folder}/record.csv", data=record, rows_named=True,
    )  # fmt: skip


def _counted(one: Mapping[Any, Any]) -> str:
    if not one["visits"]:
        return f"above {value_text(one['lowest'], digits=2)}"
    return f"{value_text(one['counted'], digits=3)} ({range_text(one['lowest'], one['highest'])})"


def _predicted(one: Mapping[Any, Any]) -> str:
    share = one["predicted_error"] / one["predicted"]
    if share > LARGE:
        return range_text(one["predicted"] * math.exp(-share), one["predicted"] * math.exp(share))
    return value_text(one["predicted"], one["predicted_error"])
