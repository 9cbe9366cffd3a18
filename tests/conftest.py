from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from siq.systems import System, load_system

ROOT = Path(__file__).parents[1]


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Writes a text to a file and returns its path."""

    def to_file(text: str, name: str = "file.yaml") -> Path:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return to_file


@pytest.fixture(scope="session")
def archetype() -> System:
    """The paper's archetypal system, from its card."""
    return load_system(ROOT / "config" / "systems" / "archetype3d.yaml")
