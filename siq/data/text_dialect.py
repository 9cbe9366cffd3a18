"""How is a table of text written: which encoding, separator and decimal mark, and where does it begin?

Laboratories write CSV in many ways: a German Excel separates by semicolons and writes decimal commas, a
logger puts comments above the table, ``numpy.savetxt`` the headings behind ``#``, other programs the units
into a second line. What was recognised is said, so that a wrong guess is seen.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Callable
from dataclasses import dataclass

from siq.data.headings import is_unit
from siq.errors import InputError

LOOKED_AT = 200  # lines of the table from which its separator and decimal mark are recognised
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf(inity)?)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_GROUPED = re.compile(r"[+-]?\d{1,3}(\.\d{3})+,\d+")
_SEPARATORS = {";": "semicolons", "\t": "tabs", ",": "commas", "|": "vertical bars", " ": "spaces"}
_MARKS = ("#", "%", "//")  # with which a line of comment begins


@dataclass(frozen=True)
class TextTable:
    """A table of text, with its headings apart from its rows.

    Attributes
    ----------
    headings, units
        Of each column; a unit is None where no second line of headings says one.
    body
        The rows, in UTF-8.
    separator, decimal_mark
        How cells are separated, and how decimals are.
    notes
        What was recognised that is not usual.
    """

    headings: tuple[str, ...]
    units: tuple[str | None, ...]
    body: bytes
    separator: str
    decimal_mark: str
    notes: tuple[str, ...]


def read_text_table(file: str, content: bytes) -> TextTable:
    """Recognise how a table is written.

    Parameters
    ----------
    file
        For messages.
    content
        Of the file.

    Raises
    ------
    InputError
        When it is no text, has no headings, or can be read in two ways.
    """
    content, notes = _in_utf8(file, content)
    begin, comments, separator = _skip_comments(content)
    sample = content[begin : begin + 200_000].decode("utf-8", errors="ignore").splitlines()[:LOOKED_AT]
    lines = [line for line in sample if line.strip() and not line.lstrip().startswith(_MARKS)]
    if not lines:
        raise InputError(file, "", "the table has no headings and no rows", "write the recordings again")
    separator = separator or _separator(lines)
    split = _splitter(separator)
    cells = split(lines[0])
    if all(_is_number(cell) for cell in cells):
        above = split(comments[-1]) if comments else []
        if len(above) != len(cells):
            example = ",".join(["t", *"xyzuvw"][: len(cells)])
            raise InputError(
                file,
                "line 1" if begin == 0 else "",
                "the first line holds numbers where the headings should stand",
                f"add a first line that names the columns, such as {example}",
            )
        headings, rows = above, lines
    else:
        headings, rows = cells, lines[1:]
        begin = _after_line(content, begin)
    units: list[str | None] = [None] * len(headings)
    if rows and (found := _line_of_units(split(rows[0]), len(headings))) is not None:
        units, rows = found, rows[1:]
        begin = _after_line(content, begin)
        notes.append("the second line of headings was read as the units")
    mark = _decimal_mark(file, [split(row) for row in rows], len(headings), separator)
    if separator != ",":
        notes.append(f"the columns are separated by {_SEPARATORS[separator]}" + (
            ", and decimals by a comma" if mark == "," else ""
        ))  # fmt: skip
    body = _without_comments(content[begin:])
    if separator == " ":
        body = b"\n".join(b"\t".join(line.split()) for line in body.splitlines())
    return TextTable(
        tuple(headings), tuple(units), body, "\t" if separator == " " else separator, mark, tuple(notes)
    )


def _in_utf8(file: str, content: bytes) -> tuple[bytes, list[str]]:
    for mark, encoding in ((codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16")):
        if content.startswith(mark):
            try:
                return content.decode(encoding).encode(), ["the text is UTF-16"]
            except UnicodeDecodeError:
                break
    content = content.removeprefix(codecs.BOM_UTF8)
    if b"\0" in content[:100_000]:
        raise InputError(file, "", "the file is no text", "save the table as CSV in UTF-8")
    try:
        content.decode()
    except UnicodeDecodeError:
        # What Windows writes in western Europe; five bytes have no meaning there.
        try:
            return content.decode("cp1252").encode(), ["the text is not UTF-8 and was read as Windows-1252"]
        except UnicodeDecodeError:
            raise InputError(file, "", "the text is not UTF-8", "save it as CSV in UTF-8") from None
    return content, []


def _skip_comments(content: bytes) -> tuple[int, list[str], str | None]:
    """Where the table begins, the comments above it, and the separator, where a line ``sep=;`` says it."""
    begin, comments, separator = 0, [], None
    while begin < len(content):
        end = _after_line(content, begin)
        line = content[begin:end].decode("utf-8", errors="ignore").strip()
        mark = next((each for each in _MARKS if line.startswith(each)), None)
        if match := re.fullmatch(r'"?sep=(.)"?', line):
            separator = match[1]
        elif mark is not None:
            comments.append(line.lstrip(mark).strip())
        elif line.strip(',;\t "|'):
            break
        begin = end
    return begin, comments, separator


def _after_line(content: bytes, begin: int) -> int:
    ends = [end for end in (content.find(b"\n", begin), content.find(b"\r", begin)) if end >= 0]
    if not ends:
        return len(content)
    end = min(ends)
    return end + (2 if content[end : end + 2] == b"\r\n" else 1)


def _without_comments(body: bytes) -> bytes:
    if not any(b"\n" + mark.encode() in body or body.startswith(mark.encode()) for mark in _MARKS):
        return body
    marks = tuple(mark.encode() for mark in _MARKS)
    return b"\n".join(line for line in body.splitlines() if not line.startswith(marks))


def _separator(lines: list[str]) -> str:
    """The separator that the headings and the rows share."""
    heading = re.sub(r'"[^"]*"', "", lines[0])
    for separator in (";", "\t", ",", "|"):
        if separator in heading and (separator != "," or not any(";" in line for line in lines[1:2])):
            return separator
    row = lines[1] if len(lines) > 1 else lines[0]
    if any(separator in row for separator in ";\t,|") or len(row.split()) == 1:
        return next((separator for separator in ";\t,|" if separator in row), ",")
    return " "


def _splitter(separator: str) -> Callable[[str], list[str]]:
    def split(line: str) -> list[str]:
        if separator == " ":
            # "t (s)" is one heading, not two.
            joined = re.sub(r"\s+(?=[\[(])", "\0", line.strip())
            return [cell.replace("\0", " ") for cell in joined.split()]
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]

    return split


def _is_number(cell: str) -> bool:
    return bool(_NUMBER.fullmatch(cell) or _DECIMAL_COMMA.fullmatch(cell))


def _line_of_units(cells: list[str], width: int) -> list[str | None] | None:
    """Units from the second line of headings, if that is what it is: no number, and a unit at least."""
    units: list[str | None] = []
    for cell in cells:
        inner = cell.strip("[]() ")
        if cell and not is_unit(inner):
            return None
        units.append(inner if inner not in ("", "-") else None)
    if len(cells) != width or not any(units) or any(_is_number(cell) for cell in cells):
        return None
    return units


def _decimal_mark(file: str, rows: list[list[str]], width: int, separator: str) -> str:
    if separator == ",":
        if rows and all(len(row) > width for row in rows) and all(len(row) == len(rows[0]) for row in rows):
            fault = f"the headings name {width} columns and the rows have {len(rows[0])} cells"
            remedy = "write decimal points, or separate the columns by semicolons if decimals have commas"
            raise InputError(file, "", fault, remedy)
        return "."
    cells = [cell for row in rows for cell in row]
    if any(_GROUPED.fullmatch(cell) for cell in cells):
        cell = next(cell for cell in cells if _GROUPED.fullmatch(cell))
        raise InputError(
            file,
            "",
            f"'{cell}' has both a point and a comma",
            "write numbers without marks between thousands",
        )
    commas = next((cell for cell in cells if _DECIMAL_COMMA.fullmatch(cell)), None)
    points = next((cell for cell in cells if "." in cell and _NUMBER.fullmatch(cell)), None)
    if commas is not None and points is not None:
        raise InputError(
            file, "", f"decimals are written with commas ('{commas}') and with points ('{points}')",
            "write all numbers in the same way",
        )  # fmt: skip
    return "." if commas is None else ","
