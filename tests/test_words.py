"""Words of our own that the field has better ones for, and that may not come back."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = [
    file
    for folder in ("siq", "docs", "config")
    for file in sorted((ROOT / folder).rglob("*"))
    if file.suffix in (".py", ".md", ".yaml", ".j2")
    and not {"decisions", "_build", "api", "outputs"} & set(file.parts)
] + [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]

# What is not to be read any more, and what is written instead.
OURS = {
    r"(?i)random forces?": "process noise",
    r"(?i)(error|noise) of the sensor": "measurement noise",
    r"(?i)hangs? together": "are correlated, autocorrelated, connected",
    r"(?i)booked as": "attributed to",
    r"(?i)kept back": "held out",
    r"(?i)foretell": "predict",
    r"\"\"\"F at": "f at points",
}


@pytest.mark.parametrize("pattern", OURS)
def test_words_of_our_own_do_not_come_back(pattern: str) -> None:
    found = [
        f"{file.relative_to(ROOT)}: {match[0]}"
        for file in FILES
        for match in re.finditer(pattern.replace(" ", r"\s+"), file.read_text(encoding="utf-8"))
    ]
    assert found == [], f"say {OURS[pattern]}"
