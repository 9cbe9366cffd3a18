"""Which files are in a folder of recordings or of cases, and what may a wrong path have meant?"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from pathlib import Path

from siq.errors import InputError

SUFFIXES = (".parquet", ".csv", ".tsv", ".txt", ".dat", ".h5", ".hdf5", ".mat", ".npz", ".npy")
"""Of files that can be read; `siq.data.formats.READERS` has a reader for each."""


CARD, RECORDINGS = "system.yaml", ("recordings.parquet", "recordings.csv")
"""The files of a case: the equations of a simulation, and what was recorded."""


def case_folders(folder: Path) -> dict[str, Path]:
    """The cases of a folder by name: itself where it has a card, or the folders in it that have one.

    Parameters
    ----------
    folder
        Has to be there.
    """
    if (folder / CARD).is_file():
        return {folder.resolve().name: folder}
    return {
        path.name: path
        for path in sorted(folder.iterdir())
        if path.is_dir() and any((path / name).exists() for name in (CARD, *RECORDINGS))
    }


def missing_file(file: str, looked_at: Sequence[Path]) -> InputError:
    """What to say of a file that is not there: where it was looked for, and what has nearly its name.

    Parameters
    ----------
    file
        As the user named it.
    looked_at
        Every path that was tried.
    """
    places = list(dict.fromkeys(str(path.absolute()) for path in looked_at))
    fault = f"No such file; it was looked for at {' and at '.join(places)}"
    for path in looked_at:
        folder = path.parent
        if not folder.is_dir():
            continue
        names = {
            each.name.casefold(): each.name for each in folder.iterdir() if not each.name.startswith(".")
        }
        near = difflib.get_close_matches(path.name.casefold(), names, n=1)
        near = near or [name for name in names if Path(name).stem == path.stem.casefold()]
        if near:
            return InputError(file, "", fault, f"perhaps you meant '{folder / names[near[0]]}'")
    missing = next((path.parent for path in looked_at if not path.parent.is_dir()), None)
    remedy = (
        f"there is no folder '{missing}' either" if missing is not None else "check the name and the folder"
    )
    return InputError(file, "", fault, remedy)


def files_of(folder: Path) -> list[Path]:
    """The files of recordings in a folder, in the order of their names.

    Parameters
    ----------
    folder
        Hidden files in it are left out, and those that cannot be read.

    Raises
    ------
    InputError
        When there are none.
    """
    found = sorted(
        path
        for path in folder.iterdir()
        if path.is_file() and path.suffix.lower() in SUFFIXES and not path.name.startswith((".", "~"))
        and path.stem.casefold() not in ("readme", "notes", "license")
    )  # fmt: skip
    if not found:
        raise InputError(
            str(folder), "", "the folder holds no recordings",
            f"put one file per recording into it, with one of the suffixes {', '.join(SUFFIXES)}",
        )  # fmt: skip
    return found
