"""A landscape in words and tables: as text, and as HTML for a notebook."""

from __future__ import annotations

import html

import numpy as np
import pandas as pd

from siq.landscape.landscape import Landscape


def landscape_text(landscape: Landscape) -> str:
    """The report of a landscape as text: verdict, attractors, barriers, notes."""
    parts = [_verdict(landscape)]
    for heading, table in _tables(landscape):
        parts += ["", heading, table.to_string(index=False, na_rep="-")]
    parts += ["", *landscape.notes] if landscape.notes else []
    return "\n".join(parts)


def landscape_html(landscape: Landscape) -> str:
    """The same as HTML, without scripts or styles."""
    parts = [f"<p>{html.escape(_verdict(landscape))}</p>"]
    for heading, table in _tables(landscape):
        parts += [f"<p>{html.escape(heading)}</p>", table.to_html(index=False, na_rep="-", border=0)]
    parts += [f"<p>{html.escape(note)}</p>" for note in landscape.notes]
    return "\n".join(parts)


def _verdict(landscape: Landscape) -> str:
    certificate = landscape.certificate
    if certificate is None:
        return "No test was made of these formulas."
    if certificate.certified:
        return f"The formulas are certified, with a stated error of V of {certificate.error:.2g}."
    return f"The formulas are not certified: {certificate.reason}."


def _tables(landscape: Landscape) -> list[tuple[str, pd.DataFrame]]:
    dynamics = landscape.dynamics
    places = np.array([one.position for one in landscape.attractors]).reshape(-1, dynamics.dimension)
    attractors = pd.DataFrame({"attractor": np.arange(len(places))})
    for name, unit, column in zip(dynamics.states, dynamics.units, places.T, strict=True):
        attractors[name if unit == "1" else f"{name} [{unit}]"] = column
    attractors["U"] = landscape.heights
    attractors["basin"] = landscape.basins
    attractors["degree"] = pd.array(
        [None if well is None else well.degree for well in landscape.wells], dtype="Int64"
    )
    tables = [("Attractors, U in the unit of the noise intensity ε:", attractors)]
    if landscape.transitions:
        tables.append(("Barriers of U, by the attractors that they part:", landscape.barriers()))
    return tables
