"""Every kind of page in a real browser, on a desk and on a phone (`make test-pages`)."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from looked_at import SMALLEST_TEXT, Seen, look_at

from siq import Landscape, reference_systems
from siq.report.page import ReportContent, ReportTable, interactive_view, render_report
from siq.report.summary import summarise

pytestmark = pytest.mark.pages

DESK, PHONE = 1280, 400
STUDIES = ("two-states", "three-states", "one-state", "cycle", "several-runs")
CASES = ("missing-friction", "missing-cubic", "wrong-stiffness", "nothing-missing")
KINDS = (*STUDIES, *(f"mismatch/{case}" for case in CASES))
ROOT = Path(__file__).parents[2]
SITE = ROOT / "docs" / "_build" / "html"


@pytest.mark.parametrize("width", [DESK, PHONE])
@pytest.mark.parametrize("kind", KINDS)
def test_a_page_is_sound(browser: Any, made_pages: dict[str, Path], kind: str, width: int) -> None:
    assert kind in made_pages, f"no page was made: {sorted(made_pages)}"
    _assert_sound(look_at(browser, made_pages[kind], width=width))


@pytest.mark.parametrize("width", [DESK, PHONE])
def test_the_documentation_is_sound(browser: Any, width: int) -> None:
    pages = sorted(SITE.glob("*.html")) + sorted(SITE.glob("gallery/*.html"))
    if not pages:
        pytest.skip("the documentation is not built; run `make docs`")
    for page in pages:
        seen = look_at(browser, page, width=width)
        assert not seen.overflowing, f"{page.name}: {seen.overflowing}"
        assert not seen.requests, f"{page.name}: {seen.requests}"
        assert not seen.faults, f"{page.name}: {seen.faults}"


@pytest.mark.parametrize("kind", ["two-states", "three-states"])
def test_the_first_screen_answers(browser: Any, made_pages: dict[str, Path], kind: str) -> None:
    seen = look_at(browser, made_pages[kind], width=DESK)
    said = seen.first_screen.lower()
    assert "stable state" in said
    assert "certified" in said
    assert "barrier" in said or "deep" in said


@pytest.mark.parametrize("kind", [f"mismatch/{case}" for case in CASES])
def test_the_first_screen_gives_the_verdict(browser: Any, made_pages: dict[str, Path], kind: str) -> None:
    said = look_at(browser, made_pages[kind], width=DESK).first_screen.lower()
    assert "held out" in said or "held-out" in said


def test_the_slider_changes_the_times_and_a_heading_sorts(browser: Any, tmp_path: Path) -> None:
    lasts = ["1750 ± 280", "(2.0 ± 0.1) × 10⁵", "0.3"]
    well = pd.DataFrame({"well": ["A", "C", "B"], "lasts": lasts, "": ["seen", "", "seen"]})
    summary = summarise(
        Landscape.from_equations(reference_systems()["double-well"].dynamics), np.zeros((0, 1))
    )
    content = ReportContent("t", table=ReportTable("wells", well), interactive=interactive_view(summary))
    (tmp_path / "page.html").write_text(render_report(content), encoding="utf-8")
    page = browser.new_page()
    page.goto((tmp_path / "page.html").as_uri())

    def texts(place: str) -> list[str]:
        return page.eval_on_selector_all(place, "all => all.map(one => one.textContent)")

    assert texts("#table-1 th button") == ["well", "lasts"]  # a button without a name cannot be read out
    before = texts("[data-part=ratio]")
    page.focus("#noise input")
    page.keyboard.press("ArrowLeft")
    assert all(
        float(one) > float(other) for one, other in zip(texts("[data-part=ratio]"), before, strict=True)
    )
    for sort, wells in (("ascending", "BAC"), ("descending", "CAB")):
        page.click("#table-1 th:nth-child(2) button")
        assert page.get_attribute("#table-1 th:nth-child(2)", "aria-sort") == sort
        assert "".join(texts("#table-1 td:first-child")) == wells
    page.close()


def test_bad_pages_are_seen(browser: Any, tmp_path: Path) -> None:
    """What the tests above refuse, they can refuse."""
    page = tmp_path / "bad.html"
    page.write_text(
        "<!doctype html><title>bad</title><body>"  # no language
        "<p style='width: 2000px'>wide</p>"
        "<img src='https://example.org/x.png'>"  # outside, and without a text
        "<script>null.nothing</script>",
        encoding="utf-8",
    )
    seen = look_at(browser, page, width=PHONE)
    assert seen.overflowing
    assert seen.requests == ["https://example.org/x.png"]
    assert any("nothing" in error for error in seen.errors)
    assert any("html-has-lang" in fault for fault in seen.faults)
    assert any("image-alt" in fault for fault in seen.faults)


def test_small_letters_of_a_picture_are_seen(browser: Any, tmp_path: Path) -> None:
    drawing = (
        "<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 1000 100'>"
        "<text style='font: 12px sans-serif' y='50'>a</text></svg>"
    )
    encoded = base64.b64encode(drawing.encode()).decode()
    page = tmp_path / "small.html"
    page.write_text(
        f"<!doctype html><html lang=en><title>t</title><img alt=wide width=300"
        f" src='data:image/svg+xml;base64,{encoded}'>",
        encoding="utf-8",
    )
    assert look_at(browser, page, width=PHONE).letters == {"wide": pytest.approx(3.6)}


def _assert_sound(seen: Seen) -> None:
    assert not seen.errors
    assert not seen.requests
    assert not seen.overflowing
    assert not seen.faults
    small = {name: size for name, size in seen.letters.items() if size < SMALLEST_TEXT}
    assert not small, f"letters below {SMALLEST_TEXT} pixels: {small}"
