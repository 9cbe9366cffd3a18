"""Every remark has its sentence, and every sentence a remark that uses it."""

from __future__ import annotations

import re
from pathlib import Path

import jinja2
import pytest

from siq import remarks
from siq.remarks import Remark

ROOT = Path(__file__).parents[2]
CODES = {
    code
    for file in (ROOT / "siq").rglob("*.py")
    if file.name != "remarks.py"
    for code in re.findall(r"\bRemark\(\s*\"([\w.]+)\"", file.read_text(encoding="utf-8"))
} | {
    f"inference.not_{claim}"
    for claim in ("one_system", "unchanged", "state_complete", "gaussian_increments", "gaussian_force")
}


def test_every_code_has_a_template_and_every_template_a_use() -> None:
    assert set(remarks.templates()) == CODES


def test_a_value_that_is_missing_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    template = jinja2.Environment(undefined=jinja2.StrictUndefined).from_string("Only {{ count }} samples.")
    monkeypatch.setattr(remarks, "templates", lambda: {"data.few": template})
    assert remarks.sentence(Remark("data.few", {"count": 3})) == "Only 3 samples."
    with pytest.raises(jinja2.UndefinedError):
        remarks.sentence(Remark("data.few"))


def test_remarks_come_back_from_plain_data() -> None:
    remark = Remark("data.few", {"count": 3, "name": "x"})
    assert Remark.from_data(remark.as_data()) == remark
