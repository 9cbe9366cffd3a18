"""Which landscape of a study is shown."""

from collections.abc import Sequence
from typing import Any

from siq.field_file import read_field
from siq.landscape.storage import StoredLandscape, read_landscape
from siq.systems import diffusion_matrix


def first_complete(
    fields: Sequence[str], landscapes: Sequence[str], diffusion: Any
) -> tuple[int, StoredLandscape] | None:
    """The first run with a U over all wells."""
    for run, (field, landscape) in enumerate(zip(fields, landscapes, strict=True)):
        record = read_field(field)
        if record is None:
            continue
        matrix = diffusion_matrix(diffusion, record.found.library.dimension)
        stored = read_landscape(landscape, field=record.found.field, diffusion=matrix)
        if stored is not None and stored.quasipotential is not None:
            return run, stored
    return None
