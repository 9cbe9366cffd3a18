"""Files that appear whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place once the block has ended without an error.

    A killed process leaves the old file, or none, and perhaps the temporary one, which the next attempt
    overwrites. The folder is made if need be.

    Parameters
    ----------
    path
        The file to be written.

    Yields
    ------
    pathlib.Path
        Where to write; it keeps the suffix of `path`, which some writers choose their format by.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{path.name}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
