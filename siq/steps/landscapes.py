"""The landscapes of all runs, as the steps after `siq.steps.landscape` read them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from siq.identify.storage import read_field
from siq.landscape.storage import StoredLandscape, read_landscape


def read_stored(field: str | Path, landscape: str | Path) -> StoredLandscape | None:
    """The landscape of a run, None where there is none."""
    record = read_field(field)
    if record is None:
        return None
    return read_landscape(landscape, dynamics=record.found.dynamics)


def first_stored(
    fields: Sequence[str | Path], landscapes: Sequence[str | Path]
) -> tuple[int, StoredLandscape] | None:
    """The first run with a U over all wells; those after it are not read."""
    for run, (field, landscape) in enumerate(zip(fields, landscapes, strict=True)):
        stored = read_stored(field, landscape)
        if stored is not None and stored.quasipotential is not None:
            return run, stored
    return None
