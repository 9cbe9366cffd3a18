"""Tables of every key of a schema, written from the schema itself when the pages are built.

`{schema} siq.workflow.study:Study` becomes a table: key, type, default, meaning. Types and limits come from
the annotations, meanings from the `Attributes` of the docstring, or from a comment ``#:`` at or above the
field. A key without a meaning is a warning, and `make docs` makes that an error: whoever adds a key has to
say what it is.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
import types
import typing
from collections.abc import Iterator
from typing import Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MinLen
from docutils import nodes
from docutils.parsers.rst import directives
from pydantic import BaseModel, TypeAdapter
from pydantic.fields import FieldInfo
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

LOG = logging.getLogger(__name__)
WORDS = {int: "whole number", float: "number", str: "text", bool: "yes or no", type(None): "nothing"}


def fields(schema: type) -> dict[str, FieldInfo]:
    """Fields by key, of a model or of a dataclass with pydantic's checks."""
    if issubclass(schema, BaseModel):
        return {field.alias or name: field for name, field in schema.model_fields.items()}
    return dict(schema.__pydantic_fields__)  # type: ignore[attr-defined]


def meanings(schema: type) -> dict[str, str]:
    """What docstrings and comments ``#:`` of a class, and of those that it extends, say of each key."""
    said: dict[str, str] = {}
    for cls in reversed(schema.__mro__):
        said |= dict(_attributes(inspect.cleandoc(cls.__dict__.get("__doc__") or "")))
        if cls.__module__.startswith("siq."):
            said |= dict(_beside_fields(inspect.getsource(cls), schema))
    return said


def _beside_fields(source: str, schema: type) -> Iterator[tuple[str, str]]:
    above: list[str] = []
    keys = {name: field.alias for name, field in getattr(schema, "model_fields", {}).items()}
    for line in map(str.strip, source.splitlines()):
        code, mark, text = line.partition("#:")
        if mark and not code:
            above.append(text.strip())
        else:
            words = " ".join([*above, text.strip()]).strip()
            if words and (found := re.match(r"(\w+):", code)):
                yield keys.get(found[1]) or found[1], f"{words[0].upper()}{words[1:].removesuffix('.')}."
            above = []


def _attributes(text: str) -> Iterator[tuple[str, str]]:
    lines = iter(text.split("\n"))
    for line in lines:
        if line.strip() in ("Attributes", "Main attributes", "Other attributes"):
            next(lines, None)
            break
    names, words = "", []
    for line in [*lines, "end"]:
        if line and not line.startswith(" "):
            yield from ((name.strip(), " ".join(words)) for name in names.split(",") if words)
            names, words = line, []
        elif line.strip():
            words.append(line.strip())


def type_in_words(hint: Any) -> str:
    """A type as a person would write it: `list of numbers > 0`."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is typing.Annotated:
        return (type_in_words(arguments[0]) + limits_in_words(_limits(arguments[1:]))).strip()
    if origin is Literal:
        return " or ".join(f"`{one}`" for one in arguments)
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(type_in_words(one) for one in arguments if one is not type(None)))
    if origin in (tuple, list) and (len(arguments) == 1 or arguments[1:] == (Ellipsis,)):
        return f"list of: {type_in_words(arguments[0])}"
    if origin is tuple:
        return f"{len(arguments)} numbers" if set(map(type_in_words, arguments)) == {"number"} else "list"
    if origin is dict:
        return f"mapping of names to: {type_in_words(arguments[1])}"
    if isinstance(hint, type) and (issubclass(hint, BaseModel) or dataclasses.is_dataclass(hint)):
        return "mapping"
    return WORDS.get(hint, "text")


def _limits(metadata: Any) -> list[Any]:
    return [one for part in metadata for one in getattr(part, "metadata", [part])]


def limits_in_words(limits: Any) -> str:
    """Limits of a number, as they are written beside it."""
    signs = {Gt: (">", "gt"), Ge: ("≥", "ge"), Lt: ("<", "lt"), Le: ("≤", "le")}
    found = [(signs[type(one)][0], getattr(one, signs[type(one)][1])) for one in limits if type(one) in signs]
    words = [f"{sign} {value:g}" if value < 1e4 else f"{sign} {value:,.0f}" for sign, value in found]
    words += ["at least one" for one in limits if isinstance(one, MinLen)]
    return "".join(f", {word}" if number else f" {word}" for number, word in enumerate(words))


def default_in_words(field: FieldInfo) -> str:
    """The default as YAML has it; empty where the key has to be given or its absence is told in words."""
    if field.is_required() or field.default is None or field.default == "":
        return "required" if field.is_required() else ""
    value = field.default
    if isinstance(value, BaseModel) or dataclasses.is_dataclass(value):
        return "`{}`"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple | list):
        return f"`[{', '.join(map(str, value))}]`"
    return f"`{TypeAdapter(Any).dump_python(value)}`"


def rows(schema: type, prefix: str = "") -> list[tuple[str, str, str, str]]:
    """Key, type, default, meaning of every key of a schema."""
    said, result = meanings(schema), []
    for key, field in fields(schema).items():
        meaning = said.get(key, "")
        if not meaning:
            LOG.warning(
                "%s.%s has no meaning: say it under Attributes in the docstring", schema.__name__, key
            )
        words = (type_in_words(field.annotation) + limits_in_words(_limits(field.metadata))).strip()
        result.append((f"`{prefix}{key}`", words, default_in_words(field), markdown(meaning)))
    return result


def markdown(text: str) -> str:
    """Literals of a docstring as those of a page."""
    return text.replace("``", "`").replace("|", "∣")


class SchemaTable(SphinxDirective):
    """The table of a schema, named as `module:Class`."""

    required_arguments = 1
    option_spec: typing.ClassVar = {"prefix": directives.unchanged}

    def run(self) -> list[nodes.Node]:
        """Write the table as Markdown, and have it read."""
        module, name = self.arguments[0].split(":")
        schema = getattr(importlib.import_module(module), name)
        self.env.note_dependency(inspect.getfile(schema))
        table = ["| key | type | default | meaning |", "|---|---|---|---|"]
        table += [f"| {' | '.join(row)} |" for row in rows(schema, self.options.get("prefix", ""))]
        return self.parse_text_to_nodes("\n".join(table))


class ColumnsTable(SphinxDirective):
    """A table of the tables: which columns each has, and of which type."""

    def run(self) -> list[nodes.Node]:
        """Write it from `siq.workflow.tables.COLUMNS`."""
        from siq.workflow import tables

        self.env.note_dependency(inspect.getfile(tables))
        text = ["| table | columns |", "|---|---|"]
        for name, columns in tables.COLUMNS.items():
            text.append(f"| `tables/{name}` | {', '.join(f'`{column}`' for column in columns)} |")
        return self.parse_text_to_nodes("\n".join(text))


class CommandLine(SphinxDirective):
    """What `siq --help` and the help of each subcommand say, where the library has a command."""

    def run(self) -> list[nodes.Node]:
        """Ask the parser of the command itself."""
        try:
            parser = importlib.import_module("siq.workflow.command").parser()
        except ImportError:
            return self.parse_text_to_nodes("`siq --help` prints every command with its options.")
        result: list[nodes.Node] = [_code(parser.format_help())]
        for action in parser._actions:
            for name, sub in (getattr(action, "choices", None) or {}).items():
                if hasattr(sub, "format_help"):
                    result += self.parse_text_to_nodes(f"**`siq {name}`**")
                    result.append(_code(sub.format_help()))
        return result


def _code(text: str) -> nodes.Node:
    return nodes.literal_block(text, text, language="text")


def setup(app: Sphinx) -> dict[str, bool]:
    """Make the directives known."""
    app.add_directive("schema", SchemaTable)
    app.add_directive("columns-of-tables", ColumnsTable)
    app.add_directive("command-line", CommandLine)
    return {"parallel_read_safe": True}
