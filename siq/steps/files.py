"""Trajectories of a run as the steps after drawing read them."""

from __future__ import annotations

from pathlib import Path

from siq.data.recordings import Recordings, read_recordings
from siq.identify.filtered_states import of_all_states
from siq.identify.storage import read_field


def read_run(path: str | Path) -> Recordings | None:
    """The trajectories of a run, or None where drawing them failed and left an empty file."""
    return read_recordings(path) if Path(path).stat().st_size else None


def read_states(path: str | Path, field: str | Path) -> Recordings | None:
    """The same with velocities that were not recorded, as the identified f of the run has them."""
    recordings, record = read_run(path), read_field(field)
    if recordings is None or record is None:
        return recordings
    return of_all_states(recordings, record, pair_step=None)
