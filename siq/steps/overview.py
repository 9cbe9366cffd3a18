"""Overview: the landscape of the run that stands for all, which the page opens with.

Where the study finds the landscape of every run, it is that of the run that is shown. Where it finds none,
as for many runs with one formula each, it is found for that run alone.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass as plain_dataclass
from pathlib import Path
from typing import Any

from siq.data.recordings import Recordings
from siq.files.whole import whole_file
from siq.identify.storage import FieldRecord
from siq.landscape.storage import landscape_data
from siq.potential.well import Well
from siq.steps import landscape
from siq.steps.landscape import LandscapeSettings


@plain_dataclass(frozen=True)
class RunToShow:
    """A run: its number, its trajectories, its f, and V about its attractors, as far as they are known."""

    number: int
    recordings: Recordings | None
    record: FieldRecord | None
    wells: tuple[Well, ...] = ()


def choose(shown: int | None, stored: Sequence[Callable[[], Mapping[str, Any] | None]]) -> int | None:
    """The run whose stored landscape is shown: that of the formulas, or else the first that has an attractor.

    Parameters
    ----------
    shown
        The run whose formulas are shown, None where there is none.
    stored
        Reads `quasipotential.json` of each run; None where it is empty.
    """
    order = [*([] if shown is None else [shown]), *range(len(stored))]
    return next((run for run in order if run < len(stored) and _has_wells(stored[run]())), None)


def _has_wells(data: Mapping[str, Any] | None) -> bool:
    return bool(data) and bool((data or {}).get("wells"))


def of_stored(run: int, data: Mapping[str, Any]) -> dict[str, Any]:
    """The overview of a run whose landscape was found."""
    return {"run": run} | dict(data)


def run(settings: LandscapeSettings, given: RunToShow) -> dict[str, Any] | None:
    """The overview of a run whose landscape nobody asked for; None where it has none."""
    found = landscape.run(
        settings, given.recordings, given.record,
        number=given.number, wells=given.wells, seek_wells=False,
    )  # fmt: skip
    if found.landscape is None or found.record is None or not found.landscape.attractors:
        return None
    data = landscape_data(found.landscape, dynamics=found.record.found.dynamics)
    # No formula about a single well was sought, so that none is missed.
    data["notes"] = [note for note in data["notes"] if "refinement found no formula" not in note]
    return {"run": given.number} | data


def write(path: str | Path, overview: Mapping[str, Any] | None) -> None:
    """Write `overview.json`, an empty file where there is nothing to show."""
    with whole_file(path) as partial:
        text = "" if overview is None else json.dumps(overview, allow_nan=False) + "\n"
        partial.write_text(text, encoding="utf-8")
