"""A landscape in words and tables: as text, and as HTML for a notebook."""

from __future__ import annotations

import html

import pandas as pd

from siq.landscape.landscape import Landscape
from siq.landscape.storage import landscape_data
from siq.report.certificate_text import certificate_line
from siq.report.landscape_answer import headline, remarks, wells_table
from siq.report.record_answer import with_seen_states
from siq.report.said_landscape import well_name


def landscape_text(landscape: Landscape) -> str:
    """The report of a landscape as text: the answer, whether it may be believed, wells, ways out, notes."""
    parts = [*_opening(landscape)]
    for heading, table in _tables(landscape):
        parts += ["", heading, table.to_string(index=False, na_rep="-")]
    parts += ["", *landscape.notes] if landscape.notes else []
    return "\n".join(parts)


def landscape_html(landscape: Landscape) -> str:
    """The same as HTML, without scripts or styles."""
    parts = [f"<p>{html.escape(line)}</p>" for line in _opening(landscape)]
    for heading, table in _tables(landscape):
        parts += [f"<p>{html.escape(heading)}</p>", table.to_html(index=False, na_rep="-", border=0)]
    parts += [f"<p>{html.escape(note)}</p>" for note in landscape.notes]
    return "\n".join(parts)


def _opening(landscape: Landscape) -> list[str]:
    """What the page of a study opens with, too: the sentence, the verdict, what has to be known of it."""
    data = landscape_data(landscape, dynamics=landscape.dynamics)
    certificate = None if landscape.certificate is None else landscape.certificate.as_data()
    answer, *further = with_seen_states(
        [headline(data), *remarks(data)], data, landscape.seen,
        certified=certificate is not None and bool(certificate["certified"]),
    )  # fmt: skip
    written = certificate is not None or any(well is not None for well in landscape.wells)
    verdict = certificate_line(certificate) if written else "U is not written as a formula."
    return [answer, verdict, *further]


def _tables(landscape: Landscape) -> list[tuple[str, pd.DataFrame]]:
    data = landscape_data(landscape, dynamics=landscape.dynamics)
    tables = [("Stable states:", wells_table(data)[0])] if data["wells"] else []
    if landscape.transitions:
        ways = landscape.barriers().rename(columns={"start": "from", "end": "to"})
        for end in ("from", "to"):
            ways[end] = [None if pd.isna(well) else well_name(int(well)) for well in ways[end]]
        tables.append(("Ways out, and their barriers of U:", ways))
    return tables
