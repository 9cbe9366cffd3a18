"""Where does the workflow find its own files, and the files that you name?

The workflow's files lie beside the Snakefile: in a checkout that is the folder in which you work, in an
installation it is a folder of the package. A file of the same name where you work comes first.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterator
from pathlib import Path

from siq.errors import InputError
from siq.numerics.files import given_path

BASE = Path(__file__).resolve().parents[1]
"""The folder of the Snakefile."""

MADE = "results/"
"""What rules make lies in this folder of the folder in which you work."""

RESOURCES = ("SIQ_RESOURCES", "SIQ_RECORDINGS")
"""Environment variables that name folders of files; the second is the first one's earlier name."""


def config_path(*parts: str) -> Path:
    """A file or folder of ``config/``: yours where you have it, otherwise the one beside the Snakefile.

    Parameters
    ----------
    parts
        Its path within ``config/``: ``"systems", "resonator.yaml"``.
    """
    own = Path("config", *parts)
    return own if own.exists() or not (BASE / own).exists() else BASE / own


def configuration(given: bool) -> str:
    """The workflow's configuration, on which a file given by ``--configfile`` builds.

    Parameters
    ----------
    given
        Whether one is given: then what it leaves out is the workflow's own, whatever lies in the folder.
    """
    own = Path("config", "config.yaml")
    return str(own if own.exists() and not given else _within(BASE / own))


def names_in(folder: str) -> list[str]:
    """The names of the YAML files in a folder of ``config/``, yours and those beside the Snakefile."""
    both = (Path("config", folder), BASE / "config" / folder)
    return sorted({path.stem for place in both for path in place.glob("*.yaml")})


def named_file(name: str, folder: str, *, start: Path) -> Path:
    """The file that a study means: a path as it stands, or a name in a folder of ``config/``."""
    if name.endswith((".yaml", ".yml")):
        return Path(find_file(name, start=start) or name)
    return config_path(folder, f"{name}.yaml")


def find_file(file: str, *, start: Path | None = None) -> str | None:
    """A file that you named, wherever it is found first; None where it is nowhere.

    Parameters
    ----------
    file
        As you wrote it. A relative path starts from the folder of the file that you wrote it in, then from
        the folder in which you work, then from the one that ``SIQ_RESOURCES`` names.
    start
        Folder of the file in which it stands; by default the folder in which you work.
    """
    return next((str(place) for place in _places(file, start) if place.exists()), None)


def needed_file(file: str, *, start: Path, where: tuple[str, str]) -> str:
    """The same, for a file that has to be there; one that a rule makes may come later.

    Parameters
    ----------
    file, start
        As `find_file` takes them.
    where
        The file in which it stands, and its place in it, for the message.

    Raises
    ------
    InputError
        With every place where it was looked for, and a name that is much like it.
    """
    found = find_file(file, start=start)
    if found is not None:
        return found
    if file.startswith(MADE):
        return file
    places = list(dict.fromkeys(Path(os.path.normpath(place.absolute())) for place in _places(file, start)))
    fault = f"there is no file {places[0]}"
    if len(places) > 1:
        fault = f"there is no file '{file}', neither at " + " nor at ".join(map(str, places))
    near = [name for place in places for name in _like(place)]
    remedy = (
        f"perhaps you meant '{near[0]}'"
        if near
        else "correct the path; it starts from the folder of this file"
    )
    raise InputError(*where, fault, remedy)


def _places(file: str, start: Path | None) -> Iterator[Path]:
    """Everywhere that a file is looked for, in this order."""
    path = given_path(file)
    if path.is_absolute():
        yield path
        return
    if start is not None:
        yield _within(start / path)
    yield path
    for variable in RESOURCES:
        if folder := os.environ.get(variable):
            yield Path(folder) / path


def _within(path: Path) -> Path:
    """The path from the folder in which you work where it lies in it, so that results may move along."""
    plain = Path(os.path.normpath(path))
    return plain.relative_to(Path.cwd()) if plain.is_relative_to(Path.cwd()) else plain


def _like(place: Path) -> list[str]:
    """Names beside a missing file that are much like its own."""
    try:
        beside = [path.name for path in place.parent.iterdir()]
    except OSError:
        return []
    return difflib.get_close_matches(place.name, beside, n=1)
