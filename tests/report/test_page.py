import re
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
import sympy

from siq.report.formatting import formula_mathml
from siq.report.page import (
    FormulaRow,
    ReportContent,
    ReportFigure,
    ReportTable,
    ReproductionContent,
    ReproductionSection,
    render_report,
    render_reproduction,
)

HOSTILE = "<script>alert('x')</script> & \"quoted\""
SECTIONS = [
    "What was asked",
    "The answer in words",
    "Formulas",
    "Tables",
    "Figures",
    "Runs that failed or are not certified",
    "How to run it again",
    "Provenance",
]
EMPTY_ELEMENTS = {"meta", "img"}
PNG = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + (1400).to_bytes(4, "big") + (940).to_bytes(4, "big")


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


@pytest.fixture
def page() -> str:
    x = sympy.Symbol("x")
    return render_report(
        ReportContent(
            title=HOSTILE,
            question=[HOSTILE],
            answer=["U is known to 2.4 × 10⁻⁷.", HOSTILE],
            formulas=[
                FormulaRow(
                    "U",
                    "regression",
                    formula_mathml(1.0 * x**2),
                    formula_mathml(x**2),
                    False,
                    "branch: " + HOSTILE,
                ),
                FormulaRow("V", "regression", "<math>plain text</math>", None, False, "branch: " + HOSTILE),
                FormulaRow("U", "refined", formula_mathml(0.999 * x**2), None, True),
            ],
            tables=[
                ReportTable(
                    HOSTILE,
                    pd.DataFrame(
                        {
                            "name": [HOSTILE] * 40,
                            "error": [8.87e-4, np.nan] * 20,
                            "count": 3,
                            "right": [True, None] * 20,
                        }
                    ),
                    {"error": HOSTILE, "absent": "never shown"},
                    "results/table.csv",
                    rows_shown=10,
                )
            ],
            figures=[
                ReportFigure("An SVG.", HOSTILE, b"<svg xmlns='http://www.w3.org/2000/svg'/>"),
                ReportFigure("A PNG.", "what it shows", PNG, "png"),
            ],
            failures=pd.DataFrame({"run": [7], "step": ["train"], "status": ["failed"], "reason": [HOSTILE]}),
            commands=["snakemake --cores 2 statistics"],
            study="name: '</pre><script>'",
            provenance={"siq": "0.1.0", HOSTILE: HOSTILE},
        )
    )


def test_the_page_asks_nothing_of_other_machines(page: str) -> None:
    addresses = Reader(page).addresses
    assert all(address.startswith(("data:image/", "#")) for address in addresses)
    assert len([address for address in addresses if address.startswith("data:")]) == 2
    assert not re.search(r"(src|href)\s*=\s*[\"']?(https?:)?//|url\(|@import", page)


def test_hostile_text_is_escaped_everywhere(page: str) -> None:
    reader = Reader(page)
    assert "script" not in reader.tags
    assert reader.text.count(HOSTILE) >= 5
    assert "&lt;math&gt;plain text" in page  # only markup from siq.report.formatting is markup


def test_all_sections_stand_in_order(page: str) -> None:
    assert re.findall(r"<h2 id=\"\w+\">(.*?)</h2>", page) == SECTIONS
    assert re.findall(r"<h2 id=\"\w+\">(.*?)</h2>", render_report(ReportContent("Nothing"))) == SECTIONS


def test_certificates_are_labelled_once_for_every_method(page: str) -> None:
    assert page.count("✗ not certified") == 1
    assert page.count("✓ certified") == 1
    assert (
        page.index("regression")
        < page.index("✗ not certified")
        < page.index("branch: ")
        < page.index("refined")
    )


def test_tables_are_cut_explained_and_readable(page: str) -> None:
    assert page.count("8.870 × 10⁻⁴") == 5
    assert "The first 10 of 40 rows; the whole table is in results/table.csv." in page
    assert "never shown" not in page
    assert "<td>yes</td>" in page
    assert '<td class="number">—</td>' in page
    assert "nan" not in Reader(page).text


def test_every_figure_has_an_alternative_and_a_print_size(page: str) -> None:
    assert len(re.findall(r"<img [^>]*alt=\"[^\"]+\"", page)) == 2
    assert 'width="672"' in page  # 7 inches


def test_no_failure_is_told_in_words() -> None:
    page = render_report(ReportContent("A study"))
    assert "None: no run failed, and every run is certified." in page
    Reader(page)


def test_the_same_content_gives_the_same_page() -> None:
    assert render_report(ReportContent("A study")) == render_report(ReportContent("A study"))
    assert '<html lang="de">' in render_report(ReportContent("Eine Studie", language="de"))


def test_the_page_of_a_reproduction_has_every_place_and_says_nothing_of_runs_that_failed() -> None:
    table = ReportTable(HOSTILE, pd.DataFrame({"published": [8.87e-4], "ours": [3.5e-11]}))
    content = ReproductionContent(
        title=HOSTILE,
        introduction=["What was published is 2.4 × 10⁻⁷ off."],
        overview=[table],
        contradictions=[HOSTILE],
        sections=[
            ReproductionSection("Table 1", [HOSTILE], [table, table]),
            ReproductionSection("Fig. 1", ["shown"], [], [ReportFigure("ours", HOSTILE, PNG, "png")]),
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
