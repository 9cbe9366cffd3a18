import base64
import io
import re
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pandas as pd
import pytest
import sympy
from markupsafe import Markup

from benchmarks.publication.page import ReproductionContent, render_reproduction
from siq.report.formatting import formula_mathml
from siq.report.page import (
    FormulaRow,
    ReportContent,
    ReportFigure,
    ReportSection,
    ReportTable,
    render_report,
)

HOSTILE = "<script>alert('x')</script> & \"quoted\""
EMPTY_ELEMENTS = {"meta", "img"}
PNG = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + (1400).to_bytes(4, "big") + (940).to_bytes(4, "big")
SVG = b"<svg xmlns='http://www.w3.org/2000/svg'/>"


class Reader(HTMLParser):
    """Collects what a page asks for, and checks that its elements are nested."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.tags: list[str] = []
        self.text: list[str] = []
        self.feed(page)
        assert self.open == []

    def handle_starttag(self, tag, attrs) -> None:
        self.tags.append(tag)
        self.addresses += [
            value for name, value in attrs if name in ("src", "href", "srcset", "action", "data")
        ]
        if tag not in EMPTY_ELEMENTS:
            self.open.append(tag)

    def handle_endtag(self, tag) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data) -> None:
        self.text.append(data)


def table(rows: int = 40) -> ReportTable:
    return ReportTable(
        HOSTILE,
        pd.DataFrame(
            {
                "name": [HOSTILE] * rows,
                "error": [8.87e-4, np.nan] * (rows // 2),
                "count": 3,
                "right": [True, None] * (rows // 2),
                "nothing": np.nan,
                "empty": "",
            }
        ),
        {"error": HOSTILE, "absent": "never shown", "nothing": "never shown"},
        "results/table.csv",
        rows_shown=10,
    )


def content(**changes: Any) -> ReportContent:
    x = sympy.Symbol("x")
    formulas = [
        FormulaRow("U", formula_mathml(1.0 * x**2), HOSTILE, whole=formula_mathml(x**2)),
        FormulaRow("V", "<math>plain text</math>"),
    ]
    return replace(
        ReportContent(
            title=HOSTILE,
            answer=["There are two stable states, known to 2.4 × 10⁻⁷.", HOSTILE],
            badge="certified",
            good=True,
            promise=["All tests passed.", HOSTILE],
            figure=ReportFigure("U over both wells. And more.", HOSTILE, PNG, "png", SVG),
            table=ReportTable(
                "Stable states.", pd.DataFrame({"state": ["x"], "A": ["1.0 ± 0.1"]}), rows_named=True
            ),
            sections=[
                ReportSection("Formulas", [HOSTILE], formulas=formulas),
                ReportSection("Evidence", tables=[table()], figures=[ReportFigure("An SVG.", HOSTILE, SVG)]),
                ReportSection(
                    "Workings", tables=[table(2)], folded=True, listing="</pre><script>", notes=[HOSTILE]
                ),
            ],
        ),
        **changes,
    )


@pytest.fixture(scope="module")
def page() -> str:
    return render_report(content())


def test_the_page_asks_nothing_of_other_machines(page: str) -> None:
    addresses = Reader(page).addresses
    assert all(address.startswith(("data:image/", "data:text/csv", "#")) for address in addresses)
    assert not re.search(r"(src|href)\s*=\s*[\"']?(https?:)?//|url\(|@import", page)
    assert "default-src 'none'" in page and "script-src" not in page


def test_a_view_that_can_be_turned_is_the_only_thing_that_may_bring_a_script() -> None:
    page = render_report(content(interactive=Markup("<div id='view'></div>")))
    assert "script-src 'unsafe-inline'" in page and "<div id='view'>" in page


def test_hostile_text_is_escaped_everywhere(page: str) -> None:
    reader = Reader(page)
    assert "script" not in reader.tags
    assert reader.text.count(HOSTILE) >= 5
    assert "&lt;math&gt;plain text" in page  # only markup from siq.report.formatting is markup


def test_the_answer_comes_first_and_then_the_picture_the_table_and_the_promise(page: str) -> None:
    text = page[page.index("<main>") :]
    places = [
        text.index(said)
        for said in (
            "There are two stable states",
            'id="figure-1"',
            'id="table-1"',
            "All tests passed.",
            "Formulas",
        )
    ]
    assert places == sorted(places)
    assert "✓ certified" in page
    refused = render_report(content(badge="not certified", good=False, promise=["No."]))
    assert "✗ not certified" in refused and "✓" not in refused


def test_contents_list_sections_with_their_numbered_tables_and_figures(page: str) -> None:
    contents = page[page.index("<nav") : page.index("</nav>")]
    listed = re.findall(r'href="#([\w-]+)"', contents)
    assert listed == ["answer", "table-1", "figure-1", "s1", "s2", "table-2", "figure-2", "s3", "table-3"]
    for anchor in listed:
        assert page.count(f'id="{anchor}"') == 1
    assert "Figure 1. U over both wells</a>" in contents  # its first sentence
    assert "<details>" in contents


def test_every_table_and_figure_has_a_download_of_all_of_it(page: str) -> None:
    found = re.findall(r'<a download="([^"]+)" href="data:([^;]+);[^,]*base64,([^"]+)"', page)
    kinds = [(name.rsplit(".", 1)[1], kind) for name, kind, _ in found]
    assert sorted(kinds) == sorted([("csv", "text/csv")] * 3 + [("svg", "image/svg+xml")] * 2)
    whole = pd.read_csv(
        io.BytesIO(base64.b64decode(next(code for name, _, code in found if name.startswith("table-2"))))
    )
    assert len(whole) == 40 and whole["error"].iloc[0] == 8.87e-4 and "nothing" in whole.columns


def test_what_is_downloaded_can_be_more_than_what_is_shown() -> None:
    numbers = pd.DataFrame({"depth": [0.25], "depth_error": [0.01]})
    shown = ReportTable("Wells.", pd.DataFrame({"A": ["0.25 ± 0.01"]}), data=numbers)
    page = render_report(ReportContent("A study", table=shown))
    code = re.search(r"data:text/csv[^,]*,([^\"]+)", page)
    assert code is not None
    assert base64.b64decode(code[1]).decode() == "depth,depth_error\n0.25,0.01\n"


def test_tables_are_cut_explained_and_readable(page: str) -> None:
    assert page.count("8.870 × 10⁻⁴") == 6
    assert "The first 10 of 40 rows." in page and "also in results/table.csv" in page
    assert "never shown" not in page  # of a column that is not there, or that holds nothing
    assert ">nothing<" not in page and ">empty<" not in page
    assert "<td>yes</td>" in page
    assert '<td class="number">—</td>' in page
    assert "nan" not in Reader(page).text


def test_whatever_scrolls_can_be_reached_by_keyboard_and_says_so(page: str) -> None:
    regions = re.findall(r'<div class="scroll"[^>]*>', page)
    assert len(regions) == 6  # three tables, two figures, one table of formulas
    assert all('tabindex="0"' in one and 'role="region"' in one and "aria-label=" in one for one in regions)
    assert len(set(regions)) == len(regions)
    assert page.count('<p class="hint') == len(regions)


def test_headers_say_what_they_head(page: str) -> None:
    assert page.count('<th scope="row">x</th>') == 1
    assert all("scope=" in one for one in re.findall(r"<th[ >][^>]*", page))


def test_every_figure_has_an_alternative_and_a_size(page: str) -> None:
    assert len(re.findall(r"<img [^>]*alt=\"[^\"]+\"", page)) == 2
    assert 'width="672"' in page  # 7 inches
    assert "min-width: 510px" in page  # so that its letters can be read on a phone: there it scrolls


def test_folded_parts_are_closed_and_open_in_print(page: str) -> None:
    assert '<details class="section"><summary><h2 id="s3h">Workings</h2></summary>' in page
    assert "details::details-content" in page


def test_a_page_of_nothing_is_a_page() -> None:
    page = render_report(ReportContent("A study"))
    Reader(page)
    assert "There is no answer." in page and "<img" not in page and "<table" not in page


def test_the_same_content_gives_the_same_page() -> None:
    assert render_report(content()) == render_report(content())
    assert '<html lang="de">' in render_report(ReportContent("Eine Studie", language="de"))


@pytest.mark.parametrize(
    ("frame", "screens"),
    [
        (pd.DataFrame({"a": [1.0], "b": [2.0]}), ""),
        (pd.DataFrame({f"quantity {k}": [1.2345] for k in range(8)}), "phone"),
        (pd.DataFrame({f"quantity {k}": [1.2345] for k in range(16)}), "page phone"),
        (pd.DataFrame({"reason": ["one word after another " * 20]}), ""),  # wraps
    ],
)
def test_tables_know_for_which_screens_they_are_too_wide(frame: pd.DataFrame, screens: str) -> None:
    page = render_report(ReportContent("A study", table=ReportTable("T.", frame)))
    assert f'<p class="hint {screens}">' in page


def test_the_page_of_a_reproduction_has_every_place_and_says_nothing_of_runs_that_failed() -> None:
    table = ReportTable(HOSTILE, pd.DataFrame({"published": [8.87e-4], "ours": [3.5e-11]}))
    content = ReproductionContent(
        title=HOSTILE,
        introduction=["What was published is 2.4 × 10⁻⁷ off."],
        overview=[table],
        contradictions=[HOSTILE],
        sections=[
            ReportSection("Table 1", [HOSTILE], tables=[table, table]),
            ReportSection("Fig. 1", ["shown"], figures=[ReportFigure("ours", HOSTILE, PNG, "png")]),
        ],
        commands=["snakemake reproduce"],
    )
    page = render_reproduction(content)
    reader = Reader(page)
    assert "script" not in reader.tags
    assert all(one.startswith(("#", "data:")) for one in reader.addresses)
    text = " ".join(reader.text)
    for said in ("Table 1. ", "Table 3. ", "Figure 1.", "8.870 × 10⁻⁴", "snakemake reproduce"):
        assert said in text
    assert reader.tags.count("h2") == 5 and "failed" not in text
    assert page == render_reproduction(content)
