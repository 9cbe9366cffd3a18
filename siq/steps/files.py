"""Trajectories of a run as the steps after drawing read them."""

from __future__ import annotations

from pathlib import Path

from siq.data.recordings import Recordings, read_recordings


def read_run(path: str | Path) -> Recordings | None:
    """The trajectories of a run, or None where drawing them failed and left an empty file."""
    return read_recordings(path) if Path(path).stat().st_size else None
