"""Templates of sentences: each can be read, and has words for every code that is asked of it."""

from __future__ import annotations

from importlib.resources import files

import pytest

from siq.inference.field_estimate import DiffusionSource
from siq.report.formatting import environment, in_paragraphs, texts

FOLDER = files("siq.report") / "templates"
TEXT = sorted(
    file.name for file in FOLDER.iterdir() if file.name.endswith(".j2") and ".html" not in file.name
)
PARTS = {"lead", "states", "evidence", "record", "landscape", "sweep", "runs", "published", "workings"}


@pytest.mark.parametrize("name", TEXT)
def test_a_template_uses_filters_and_tests_that_there_are(name: str) -> None:
    if name != "diagnosis.j2":  # which has some of its own, see siq.report.diagnosis_page
        environment().get_template(name)


def test_blank_lines_part_paragraphs_and_nothing_else_does() -> None:
    assert in_paragraphs("one\n  line\n\n \nanother\u00a0one\n") == ["one line", "another\u00a0one"]


def test_there_are_words_for_every_code() -> None:
    assert set(texts("formulas")["D"]) == {str(source) for source in DiffusionSource}
    certificate = texts("certificate")
    assert set(certificate["failures"]) == set(certificate["asks"])
    assert {caption["part"] for caption in texts("captions")["figures"].values()} <= PARTS
