"""The examples in the docstrings, run as they stand."""

from __future__ import annotations

import doctest
import importlib
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import siq

ROOT = Path(__file__).parents[1]
WITH_EXAMPLES = [
    ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for file in sorted((ROOT / "siq").rglob("*.py"))
    if ">>> " in file.read_text(encoding="utf-8")
]


MADE: dict[bytes, Any] = {}


def once(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that is called once for the same arguments: examples of plots make what others have made."""

    def same(*given: Any, **named: Any) -> Any:
        key = pickle.dumps((function.__qualname__, given, named))
        if key not in MADE:
            MADE[key] = function(*given, **named)
        return MADE[key]

    return same


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_examples_give_what_they_say(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # an example may write a file
    monkeypatch.setattr(siq, "diagnose", once(siq.diagnose), raising=False)
    monkeypatch.setattr(siq.Landscape, "from_equations", once(siq.Landscape.from_equations))
    outcome = doctest.testmod(
        importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    )
    assert outcome.attempted and not outcome.failed
