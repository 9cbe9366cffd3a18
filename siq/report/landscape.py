"""A landscape for readers: the answer in a sentence, its certificate, its tables, as text and in a notebook.

The answer is `templates/answer.j2`, filled from `siq.report.summary.LandscapeSummary`. Times are written with
their errors, or as a range ``value · exp(±error)`` where the error is as large as the time. Each table comes
as it is shown, units in its headings, and, where that is more, as the numbers to be downloaded.
"""

from __future__ import annotations

import html
import itertools
import math
from collections.abc import Sequence

import numpy as np
import pandas as pd

from siq.data.states import RecordStates
from siq.numerics.text import MINUS, range_text, unit_text, value_text
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.rates import NoiseStrength
from siq.remarks import sentence
from siq.report.formatting import (
    counted_text,
    paragraphs,
    percent_text,
    predicted_text,
    texts,
    time_text,
    with_unit,
)
from siq.report.summary import LandscapeSummary, settled, summarise, visits_of, well_name
from siq.systems.cycles import Cycle

MOST_COLUMNS = 4  # wells that are columns of a table; more are rows


def answer_lines(summary: LandscapeSummary, *, seen: RecordStates | None = None, rung: int = 4) -> list[str]:
    """The answer, and what is to be known of it; `seen` states lead up to `rung` 3, and are left out at 6."""
    elsewhere = seen is not None and rung < 6 and _stays_elsewhere(summary, seen)
    said = "" if seen is None else seen.sentence() or (sentence(seen.rest()) if rung < 4 else "")
    changes = seen is not None and seen.limit is not None and seen.limit.code == "data.not_stationary"
    return paragraphs("answer.j2", s=summary, seen=said, rung=rung, elsewhere=elsewhere, changes=changes)


def _stays_elsewhere(summary: LandscapeSummary, seen: RecordStates) -> bool:
    """Whether the record has other states than the wells: more, fewer, or off by half of what parts them."""
    if not seen.supported or summary.cycles:
        return seen.supported and len(summary.wells) == 1
    if len(seen.levels) != len(summary.wells):
        return True
    if not len(seen.places) or not set(seen.columns) <= set(summary.names):
        return False
    columns = [summary.names.index(name) for name in seen.columns]
    size = np.ptp(seen.places, axis=0)
    wells, states = (
        rows / np.where(size > 0, size, np.inf)
        for rows in (np.array([well.position for well in summary.wells])[:, columns], seen.places)
    )
    apart = np.linalg.norm(states[:, None] - states, axis=2)
    off = np.linalg.norm(wells[:, None] - states, axis=2)
    return bool(
        len(set(off.argmin(axis=1))) < len(wells) or off.min(axis=1).max() > apart[apart > 0].min() / 2
    )


def _complex_text(value: complex) -> str:
    """A complex number to four digits: ``−1.000 + 2.000 i``."""
    if not value.imag:
        return value_text(value.real)
    return f"{value_text(value.real)} {MINUS if value.imag < 0 else '+'} {value_text(abs(value.imag))} i"


def landscape_tables(
    summary: LandscapeSummary | None, noises: Sequence[float] = ()
) -> dict[str, tuple[pd.DataFrame, pd.DataFrame | None]]:
    """The tables of a landscape, each as it is shown and as numbers; empty of one without stable states.

    ``wells`` have a column each, and as numbers a row; ``exits`` are the ways out of every well,
    ``equilibria`` all states at which f vanishes, with the eigenvalues of f there, ``cycles`` the unstable
    ones. ``times`` are how long each well lasts under the noise strengths ε, and ``checked`` the same by the
    law, by the operator and by a simulation, where that was asked for.
    """
    if summary is None or not summary.wells:
        names = ("wells", "exits", "equilibria", "cycles", "times", "checked")
        return dict.fromkeys(names, (pd.DataFrame(), None))
    return {
        "wells": _wells_table(summary), "exits": _exits_table(summary),
        "equilibria": (_equilibria_table(summary), None), "cycles": (_cycles_table(summary), None),
        "times": (_times_table(summary, noises if summary.has_times else ()), None),
        "checked": (_checked_table(summary), summary.checked_times),
    }  # fmt: skip


def _wells_table(summary: LandscapeSummary) -> tuple[pd.DataFrame, pd.DataFrame]:
    wells, noise, time_unit = summary.wells, summary.noise, summary.time_unit
    rows: dict[str, list[str]] = {}
    numbers = []
    for well in wells:
        (ratio, ratio_error), mean, cycle = well.relative_depth(noise), well.time(noise), well.cycle
        numbers.append(
            {"well": well.label}
            | dict(zip(summary.names, well.position.tolist(), strict=True))
            | {f"{name}_error": error
               for name, error in zip(summary.names, well.position_errors.tolist(), strict=True)}
            | {
                "depth": well.depth, "depth_error": well.depth_error, "depth_over_noise": ratio,
                "depth_over_noise_error": ratio_error, "mean_time": math.nan if mean is None else mean.value,
                "mean_time_relative_error": math.nan if mean is None else mean.error,
                "next": well.beyond or "",
                "share_of_domain" if summary.given else "share_of_recorded_states": well.basin,
            }
        )  # fmt: skip
        cells = {}
        for place, (name, unit) in enumerate(zip(summary.names, summary.units, strict=True)):
            cells[with_unit(name, unit)] = (
                value_text(well.position[place], well.position_errors[place])
                if cycle is None
                else range_text(cycle.points[:, place].min(), cycle.points[:, place].max())
            )
        cells[with_unit("period", time_unit)] = "" if cycle is None else value_text(cycle.period, digits=4)
        multipliers = [] if cycle is None else cycle.multipliers.tolist()
        cells["Floquet multipliers"] = ", ".join(_complex_text(one) for one in multipliers)
        deep = math.isfinite(well.depth)
        cells[with_unit("depth ΔU", summary.energy_unit)] = (
            value_text(well.depth, well.depth_error) if deep else ""
        )
        cells["ΔU/ε"] = value_text(ratio, ratio_error) if math.isfinite(ratio) else ""
        cells[with_unit("lasts", time_unit)] = time_text(mean)
        seen = well.visits
        cells[with_unit("mean visit, counted", time_unit)] = "" if seen is None else counted_text(seen)
        cells[with_unit("mean visit, by f and D", time_unit)] = "" if seen is None else predicted_text(seen)
        cells["next well"] = well.beyond or ""
        if len(wells) > 1:
            cells["share of the domain" if summary.given else "recorded states"] = f"{100 * well.basin:.0f} %"
        for name, text in cells.items():
            rows.setdefault(name, []).append(text)
    kept, names = {name: row for name, row in rows.items() if any(row)}, [well.label for well in wells]
    if len(names) > MOST_COLUMNS:  # as many columns would be too wide: a row for each
        table = pd.DataFrame({"stable state": names} | kept)
    else:
        table = pd.DataFrame([[name, *row] for name, row in kept.items()], columns=["stable state", *names])
    return table, pd.DataFrame(numbers).dropna(axis=1, how="all")


def _exits_table(summary: LandscapeSummary) -> tuple[pd.DataFrame, pd.DataFrame]:
    rows, numbers = [], []
    for way in summary.ways:
        known = math.isfinite(way.barrier)
        law, action = way.exit, None if way.path is None else way.path.action
        mean = None if summary.noise is None or not known else law.mean_exit_time(summary.noise)
        start, end = well_name(way.start), "" if way.end is None else well_name(way.end)
        place = _place(summary, way.place)
        if isinstance(way.saddle, Cycle):
            period = value_text(way.saddle.period, unit=summary.time_unit, digits=4)
            place += f", on an unstable cycle of period {period}"
        row = {
            "way": f"{start} to {end or f'out of the {summary.region}'}",
            "over the saddle at": place,
            with_unit("barrier ΔU", summary.energy_unit): value_text(way.barrier, way.error) if known else "",
        }
        if not summary.given:
            row["the same by the path alone"] = "" if action is None else value_text(action)
        row[with_unit("mean time", summary.time_unit)] = time_text(mean)
        rows.append(row | {"to be known": "; ".join(way.notes)})
        numbers.append(
            {
                "start": start, "end": end,
                **{f"saddle_{name}": value for name, value in zip(summary.names, way.place, strict=True)},
                "barrier": way.barrier, "barrier_error": way.error, "minimum_action": action,
                "prefactor": law.prefactor, "mean_time": np.nan if mean is None else mean.value,
                "data_error": np.nan if mean is None else mean.data_error,
                "law_error": np.nan if mean is None else mean.law_error,
            }
        )  # fmt: skip
    return pd.DataFrame(rows), pd.DataFrame(numbers)


def _place(summary: LandscapeSummary, position: np.ndarray) -> str:
    values, _ = settled(position, 0.0, summary.size)
    return "(" + ", ".join(value_text(value) for value in values) + ")"


def _cycles_table(summary: LandscapeSummary) -> pd.DataFrame:
    rows = []
    for one in summary.unstable_cycles:
        row = dict(
            zip(summary.names, map(range_text, one.points.min(axis=0), one.points.max(axis=0)), strict=True)
        )
        row[with_unit("period", summary.time_unit)] = value_text(one.period, digits=4)
        rows.append(row | {"Floquet multipliers": ", ".join(map(_complex_text, one.multipliers.tolist()))})
    return pd.DataFrame(rows)


def _equilibria_table(summary: LandscapeSummary) -> pd.DataFrame:
    kinds = texts("tables")["equilibria"]
    time, names = unit_text(summary.time_unit), [with_unit(name, "1") for name in summary.names]
    position = f"({', '.join(names)})" if len(names) > 1 else names[0]
    if len(set(summary.units)) == 1:
        position = with_unit(position, summary.units[0])
    rows = [
        {
            "name": one.label,
            "what": kinds.get(one.kind, one.kind),
            position: _place(summary, one.position),
            f"rates (1/{time})" if time else "rates": ", ".join(map(_complex_text, one.eigenvalues)),
        }
        for one in summary.equilibria
    ]
    frame = pd.DataFrame(rows)
    return frame if frame.empty or any(frame["name"]) else frame.drop(columns="name")


def _times_table(summary: LandscapeSummary, noises: Sequence[float]) -> pd.DataFrame:
    rows = []
    for strength in noises:
        row = {with_unit("noise strength ε", summary.energy_unit): value_text(strength)}
        for well in summary.wells:
            mean = well.time(NoiseStrength(strength))
            strong = texts("tables")["too_strong"] if strength >= well.depth else ""
            row[with_unit(f"{well.label} lasts", summary.time_unit)] = (
                strong if mean is None else time_text(mean)
            )
        rows.append(row)
    return pd.DataFrame(rows)


def _checked_table(summary: LandscapeSummary) -> pd.DataFrame:
    rows, checked = [], summary.checked_times
    for one in () if checked is None else checked.to_dict("records"):
        times = {
            "by the law": (one["law"], one["law"] * one["law_error"]),
            "by the operator": (one["operator"], one["operator"] * one["operator_error"]),
            "simulated": (one["check"], one["check"] * one["relative_error"]),
        }
        rows.append(
            {"stable state": well_name(int(one["attractor"]))}
            | {with_unit("noise strength ε", summary.energy_unit): value_text(one["noise"])}
            | {
                with_unit(name, summary.time_unit): value_text(value, error) if math.isfinite(value) else ""
                for name, (value, error) in times.items()
            }
            | {"95 % interval of the simulation": range_text(one["lower"], one["upper"])}
        )
    return pd.DataFrame(rows)


def in_words(table: pd.DataFrame) -> pd.DataFrame:
    """A table with headings in words, without columns that say nothing."""
    return table.dropna(axis=1, how="all").rename(columns=lambda name: name.replace("_", " "))


def record_table(record: pd.DataFrame, time_unit: str) -> pd.DataFrame:
    """Mean visits to each well, counted on the record and predicted, from the rows of one run of `record`."""
    words, rows = texts("tables"), []
    for one in record.to_dict("records"):
        visits = visits_of(one)
        count, lowest = visits.whole.visits, visits.whole.limits[0]
        held_out = one["held_out_counted"]
        rows.append(
            {
                "well about": one["attractor"],
                "visits seen to end": count,
                with_unit("mean visit, counted", time_unit): counted_text(visits)
                if count
                else f"above {value_text(lowest, digits=2)}",
                "held out: visits": int(one["held_out_visits"]),
                with_unit("held out: mean", time_unit): value_text(held_out, digits=3)
                if math.isfinite(held_out)
                else words["none_ended"],
                with_unit("predicted", time_unit): predicted_text(visits),
                "by": words["methods"].get(visits.method, visits.method),
                "probability": f"{one['probability']:.2g}",
            }
        )
    return pd.DataFrame(rows)


def comparison_table(table: pd.DataFrame) -> pd.DataFrame:
    """Numbers by the trajectories with those of the equations; of several runs the largest difference."""

    def text(value: float, digits: int = 5) -> str:
        return value_text(value, digits=digits) if np.isfinite(value) else ""

    rows = []
    known = table[table["quantity"].fillna("") != ""]
    for _, some in known.groupby(["item", "quantity", "noise"], sort=False, dropna=False):
        first, off, sharp = some.iloc[0], some["relative_difference"], some["in_errors"]
        at = f" at ε = {value_text(first['noise'])}" if np.isfinite(first["noise"]) else ""
        row = {
            "item": first["item"],
            "what": f"{first['quantity']}{at}",
            "by the equations": text(first["equations"]),
            "by the trajectories": text(some["trajectories"].mean()),
        }
        if some["run"].nunique() > 1:
            row["runs"] = int(some["trajectories"].notna().sum())
            row["largest difference"] = percent_text(off.abs().max())
            row["largest in standard errors"] = text(sharp.abs().max(), 2)
        else:
            row["difference"] = ("+" if off.iloc[0] > 0 else "") + percent_text(off.iloc[0])
            row["in standard errors"] = text(sharp.iloc[0], 2)
        rows.append(row)
    return pd.DataFrame(rows)


def landscape_report(landscape: Landscape, *, markup: bool = False) -> str:
    """The answer, whether it may be believed, wells, ways out and notes: as text, or as plain HTML."""
    opening, tables = _report(landscape)
    if not markup:
        shown = [("", heading, table.to_string(index=False, na_rep="-")) for heading, table in tables]
        notes = ["", *landscape.notes] if landscape.notes else []
        return "\n".join([*opening, *itertools.chain(*shown), *notes])
    parts = [f"<p>{html.escape(line)}</p>" for line in opening]
    for heading, table in tables:
        parts += [f"<p>{html.escape(heading)}</p>", table.to_html(index=False, na_rep="-", border=0)]
    return "\n".join([*parts, *(f"<p>{html.escape(note)}</p>" for note in landscape.notes)])


def _report(landscape: Landscape) -> tuple[list[str], list[tuple[str, pd.DataFrame]]]:
    summary = summarise(landscape)
    certificate = None if landscape.certificate is None else landscape.certificate.as_data()
    answer, *further = answer_lines(summary, seen=landscape.recorded_states, rung=landscape.rung)
    written = certificate is not None or any(well is not None for well in landscape.wells)
    verdict = "U is not written as a formula."
    if written:
        stated = summary.stating(certificate)
        verdict = paragraphs("certificate.j2", certificate=stated, texts=texts("certificate"))[-1]
    words, found = texts("tables"), landscape_tables(summary)
    wells, checked = found["wells"][0], found["checked"][0]
    tables = [] if wells.empty else [(words["wells"], wells)]
    if landscape.transitions:
        ways = landscape.barriers().rename(columns={"start": "from", "end": "to"})
        for end in ("from", "to"):
            ways[end] = [None if pd.isna(well) else well_name(int(well)) for well in ways[end]]
        tables.append((words["exits"], ways))
    tables += [] if checked.empty else [(words["checked"], checked)]
    return [answer, verdict, *further], tables
