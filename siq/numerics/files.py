"""Files that appear whole or not at all, YAML files read as data with the line of every entry, and folders.

Both system cards and studies are such documents. A document is never code: only YAML's plain types are
built, a key that stands twice is refused, and whatever the schema refuses is told with its line.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from siq.errors import Fault, InputError, suggestion


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place once the block has ended without an error.

    A killed process leaves the old file, or none, and perhaps the temporary one, which the next attempt
    overwrites. The folder is made if need be. The temporary path keeps the suffix, by which some writers
    choose their format.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{path.name}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def given_path(text: str | Path) -> Path:
    """The path as a user wrote it: as it stands where that is there, and ``~`` for a home otherwise."""
    path = Path(text)
    with suppress(OSError, ValueError, RuntimeError):  # no such user, or no path at all
        return path if path.exists() else path.expanduser()
    return path


LARGEST_DOCUMENT = 1_000_000  # bytes: the largest card that comes with siq has 6,000
DEEPEST = 20  # levels of brackets: the deepest key of a schema lies five deep

UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")
Keys = tuple[str | int, ...]
Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True)
class Document:
    """A YAML mapping with the line on which every entry stands."""

    file: str  #: as the user named it
    data: dict[str, Any]  #: of plain types only
    lines: dict[Keys, int]  #: number, from 1, of every entry by its path of keys: ``("equations", "x")``

    def place(self, keys: Keys) -> str:
        """Say where an entry stands, in words; the nearest parent's line where it has none."""
        for length in range(len(keys), 0, -1):
            if keys[:length] in self.lines:
                return f"line {self.lines[keys[:length]]} ({'.'.join(str(key) for key in keys)})"
        return ".".join(str(key) for key in keys)


def read_document(path: str | Path) -> Document:
    """Read a YAML mapping, in UTF-8, and the lines of its entries.

    Raises InputError when the file is missing, is not YAML, is not a mapping, or has a key twice.
    """
    file = str(path)
    try:
        size = Path(path).stat().st_size
        text = Path(path).read_text(encoding="utf-8") if size <= LARGEST_DOCUMENT else ""
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or type(error).__name__
        raise InputError(
            file, "", f"it cannot be read ({reason})", "check the name and permissions"
        ) from None
    if size > LARGEST_DOCUMENT:
        fault = f"the file has {size / 1e6:.1f} MB, too many for a card or a study"
        raise InputError(file, "", fault, f"keep it below {LARGEST_DOCUMENT / 1e6:g} MB")
    try:
        try:  # the loader in C, ten times as fast, for what it can read; the other tells faults in its words
            loader, root = _composed(file, text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        except (yaml.YAMLError, UnicodeError):
            loader, root = _composed(file, text, yaml.SafeLoader)
        data = None if root is None else loader.construct_document(root)
    except InputError:
        raise
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        place = f"line {mark.line + 1}" if mark is not None else ""
        fault = f"it is not valid YAML ({getattr(error, 'problem', None) or 'an entry cannot be read'})"
        raise InputError(file, place, fault, "correct the syntax or the indentation") from None
    if not isinstance(data, dict) or root is None:
        fault = "the file is not a mapping of keys to values"
        raise InputError(file, "line 1", fault, "write it as 'key: value' lines")
    lines: dict[Keys, int] = {}
    _collect_lines(file, root, (), lines)
    return Document(file=file, data=data, lines=lines)


def _composed(file: str, text: str, kind: Any) -> tuple[Any, yaml.Node | None]:
    """A loader, and the nodes of a document, whose keys are written as formulas are read."""
    deep = 0
    for event in yaml.parse(text, Loader=kind):
        place = f"line {event.start_mark.line + 1}" if event.start_mark else ""
        if isinstance(event, yaml.AliasEvent):  # may refer to itself, or multiply without bound
            fault = f"the alias '*{event.anchor}' is not allowed"
            raise InputError(file, place, fault, "write the value out")
        deep += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if deep > DEEPEST:  # to compose it takes a call for each, of which there are only so many
            fault = f"brackets stand in one another more than {DEEPEST} deep"
            raise InputError(file, place, fault, "write it as 'key: value' lines")
    loader = kind(text)
    root = loader.get_single_node()
    _normalise_keys(root)
    return loader, root


def _normalise_keys(node: yaml.Node | None) -> None:
    """Write keys as formulas are read (NFKC): a letter of full width is the letter, the micro sign is mu."""
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            if isinstance(key, yaml.ScalarNode):
                key.value = unicodedata.normalize("NFKC", key.value)
            _normalise_keys(value)
    elif isinstance(node, yaml.SequenceNode):
        for value in node.value:
            _normalise_keys(value)


def validate(document: Document, model: type[Model]) -> Model:
    """Check a document against a pydantic model and return the model's instance.

    Raises InputError for the first entry that is refused; a misspelt key is told with the nearest known one.
    """
    try:
        return model.model_validate(document.data)
    except ValidationError as error:
        # A misspelt key is also a missing one; the misspelling is what to tell.
        faults = error.errors(include_url=False)
        first = next((fault for fault in faults if fault["type"] in UNKNOWN_KEY), faults[0])
    keys = tuple(first["loc"])
    # The loc of a union member ends in the member's name; the document has no such entry.
    while len(keys) > 1 and keys not in document.lines and first["type"] not in ("missing",):
        keys = keys[:-1]
    name = keys[-1] if keys else ""
    if first["type"] in UNKNOWN_KEY:
        known = _known_keys(model, keys[:-1])
        otherwise = f"remove it or use one of {', '.join(sorted(known))}"
        fault = Fault(f"the key '{name}' is unknown", suggestion(str(name), known, otherwise=otherwise))
    elif first["type"] in ("missing", "missing_argument"):
        fault = Fault(f"the key '{name}' is missing", f"add '{name}: ...'")
    else:
        cause = first.get("ctx", {}).get("error")
        message = first["msg"].removeprefix("Value error, ").removeprefix("Assertion failed, ").rstrip(".")
        remedy = message[:1].lower() + message[1:]
        ours = cause if isinstance(cause, Fault) else None
        fault = ours or Fault(f"the value {first['input']!r} cannot be used", remedy)
    raise fault.at(document.file, document.place(keys))


def _known_keys(model: Any, keys: Keys) -> list[str]:
    schema = model.model_json_schema()

    def options_of(node: dict[str, Any]) -> list[dict[str, Any]]:
        options = [node, *node.get("anyOf", []), *node.get("allOf", [])]
        for place, option in enumerate(options):
            while "$ref" in option:
                options[place] = option = schema["$defs"][option["$ref"].rsplit("/", 1)[-1]]
        return options

    node = schema
    for key in keys:
        options = options_of(node)
        found = [option["properties"][key] for option in options if key in option.get("properties", {})]
        # Entries of a mapping of names, such as the states of a card, share one schema.
        found += [option["additionalProperties"] for option in options if option.get("additionalProperties")]
        found += [part for option in options for part in option.get("patternProperties", {}).values()]
        if isinstance(key, int):
            found += [option["items"] for option in options if isinstance(option.get("items"), dict)]
        if not found:
            return []
        node = found[0]
    return [name for option in options_of(node) for name in option.get("properties", {})]


def _collect_lines(file: str, node: yaml.Node, keys: Keys, lines: dict[Keys, int]) -> None:
    if isinstance(node, yaml.MappingNode):
        for key_node, value_node in node.value:
            path = (*keys, key_node.value)
            line = key_node.start_mark.line + 1
            if path in lines:
                fault = f"the key '{key_node.value}' stands twice (first on line {lines[path]})"
                raise InputError(file, f"line {line}", fault, "keep one of the two")
            lines[path] = line
            _collect_lines(file, value_node, path, lines)
    elif isinstance(node, yaml.SequenceNode):
        for index, value_node in enumerate(node.value):
            path = (*keys, index)
            lines[path] = value_node.start_mark.line + 1
            _collect_lines(file, value_node, path, lines)


SUFFIXES = (
    *(".parquet", ".csv", ".tsv", ".txt", ".dat", ".asc", ".rdb"),
    *(".h5", ".hdf5", ".nc", ".mat", ".npz", ".npy"),
)
"""Of files that can be read; `siq.data.formats.READERS` has a reader for each."""


CARD, RECORDINGS = "system.yaml", ("recordings.parquet", "recordings.csv")
"""The files of a case: the equations of a simulation, and what was recorded."""


def case_folders(folder: Path) -> dict[str, Path]:
    """The cases of a folder by name: itself where it has a card, or the folders in it that have one."""
    if (folder / CARD).is_file():
        return {folder.resolve().name: folder}
    return {
        path.name: path
        for path in sorted(folder.iterdir())
        if path.is_dir() and any((path / name).exists() for name in (CARD, *RECORDINGS))
    }


def files_of(folder: Path) -> list[Path]:
    """The files of recordings in a folder, in the order of their names, without hidden and unreadable ones.

    Raises InputError when there are none.
    """
    found = sorted(
        path
        for path in folder.iterdir()
        if path.is_file() and path.suffix.lower() in SUFFIXES and not path.name.startswith((".", "~"))
        and path.stem.casefold() not in ("readme", "notes", "license")
    )  # fmt: skip
    if not found:
        remedy = f"put one file per recording into it, with one of the suffixes {', '.join(SUFFIXES)}"
        raise InputError(folder, "", "the folder holds no recordings", remedy)
    for path in found:
        if "{" in path.name or "}" in path.name:  # to the workflow a blank that is filled in
            raise InputError(path, "", "the name has braces", "rename the file")
    return found
