"""Whoever looks a message up finds the one that the program says: none there is made up or out of date."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
GAP = "\0"  # where a message has a name or a number


@cache
def sentences() -> list[str]:
    """All text in the code and in the templates of remarks, what is filled in replaced by `GAP`."""
    found = []
    for file in [*(ROOT / "siq").rglob("*.py"), *(ROOT / "workflow").rglob("*.py")]:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = [each.value if isinstance(each, ast.Constant) else GAP for each in node.values]
                found.append("".join(map(str, parts)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    for file in (ROOT / "siq").rglob("templates/**/*.yaml"):
        found.append(re.sub(r"\{[{%].*?[%}]\}", GAP, " ".join(file.read_text(encoding="utf-8").split())))
    return found


MESSAGES = re.findall(r"^\| `([^`]+)` \|", PAGE, flags=re.MULTILINE)


def test_the_page_has_messages() -> None:
    assert len(MESSAGES) > 25


@pytest.mark.parametrize("message", MESSAGES)
def test_a_message_on_the_page_is_one_that_the_code_says(message: str) -> None:
    pattern = re.compile(".*".join(re.escape(part) for part in message.split("…")), flags=re.DOTALL)
    assert any(pattern.search(sentence) for sentence in sentences())
