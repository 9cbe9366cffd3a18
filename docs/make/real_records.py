"""Draw the pictures of the page on real records: `python docs/make/real_records.py [RESULTS]`.

`SIQ_RESOURCES` names the folder of the recordings, which are no part of the project; the page says whose they
are. Their studies have to be run before, `siq run greenland-ice` and `siq run neuromorphic-chip`, in the
folder that has the results.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import numpy as np
import pandas as pd
from matplotlib import pyplot

import siq
from siq.data.states import RecordStates

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "images" / "real-records"
COLOURS = ("#c1553b", "#3d5a80")
GREY = "0.6"

Mean = tuple[str, float, float, float]
"""Who says so, the mean, and the ends of its interval; NaN where nobody says."""


@dataclass(frozen=True)
class Drawn:
    """What a picture shows: a column of a file, between two times, and what its states are called."""

    file: str
    column: str
    label: str
    time: str
    shown: tuple[float, float]
    states: tuple[str, str]


ICE = Drawn(
    "greenland-ice/ngrip.csv", "lnCa", "ln of Ca (ng/g)", "years, towards the present", (0, 48_290),
    ("warm", "cold"),
)  # fmt: skip
CHIP = Drawn("neuromorphic-chip/activity.csv", "rate", "rate (Hz)", "time (s)", (0, 20), ("quiet", "active"))


def drawn(
    one: Drawn, means: tuple[list[Mean], list[Mean]], said: RecordStates, record: siq.Recordings
) -> None:
    """One picture: the record with its visits, and mean visits by everybody who says something of them."""
    figure, (course, times) = pyplot.subplots(
        2, 1, figsize=(9.5, 5.0), layout="constrained", height_ratios=(1.3, 1)
    )
    t, x = record.t, record.values[:, 0]
    inside = (t >= one.shown[0]) & (t <= one.shown[1])
    course.plot(t[inside], x[inside], color=GREY, linewidth=0.5)
    for state, colour in enumerate(COLOURS):
        mine = inside & (said.visits == state)
        course.plot(t[mine], x[mine], ".", color=colour, markersize=1.6, label=one.states[state])
        course.axhline(said.levels[state], color=colour, linewidth=0.8, linestyle="--")
    course.set(xlabel=one.time, ylabel=one.label, xlim=one.shown)
    course.legend(markerscale=6, loc="upper right", ncols=2)
    names = [name for name, *_ in means[0]]
    for state, (colour, rows) in enumerate(zip(COLOURS, means, strict=True)):
        for place, (_, mean, low, high) in enumerate(rows):
            y = -place - 0.15 + 0.3 * (1 - state)
            if np.isfinite(low):
                times.plot([low, high], [y, y], color=colour, linewidth=1.5)
            times.plot([mean], [y], "o", color=colour)
    times.set_xscale("log")
    for axis_ticks in (times.xaxis.set_major_formatter, times.xaxis.set_minor_formatter):
        axis_ticks("{x:g}")
    times.set_yticks([-place for place in range(len(names))], names)
    times.set_xlabel(f"mean visit ({record.time_unit or one.time.partition('(')[2].rstrip(')') or 'years'})")
    figure.savefig(FOLDER / f"{Path(one.file).parts[0]}.png", dpi=110)


def counted(said: RecordStates) -> tuple[Mean, Mean]:
    """From level to level, with the intervals of 95 %."""
    low, high = (("counted, level to level", one.mean, *one.limits) for one in said.counts)
    return low, high


def main(results: Path) -> None:
    """Draw both."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    place = Path(os.environ["SIQ_RESOURCES"])
    nothing = (np.nan, np.nan)
    record = siq.read_recordings(place / ICE.file, columns=[ICE.column])
    said = siq.inspect(record).switching
    assert said is not None
    rows = pd.read_parquet(results / "greenland-ice" / "tables" / "record.parquet").to_dict("records")
    means: tuple[list[Mean], list[Mean]] = ([], [])
    for state, (own, row) in enumerate(zip(counted(said), rows, strict=True)):
        low, high = (row["predicted"] + side * 1.96 * row["predicted_error"] for side in (-1, 1))
        means[state].extend(
            [
                own,
                ("counted, core to core", row["counted"], row["lowest"], row["highest"]),
                ("by f and D, core to core", row["predicted"], low, high),
            ]
        )
    drawn(ICE, means, said, record)
    record = siq.read_recordings(place / CHIP.file, columns=[CHIP.column])
    said = siq.inspect(record).switching
    assert said is not None
    quiet, active = counted(said)
    theirs = [("the authors' hidden Markov model", mean, *nothing) for mean in (1.51, 0.313)]
    drawn(CHIP, ([quiet, theirs[0]], [active, theirs[1]]), said, record)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else ROOT / "results")
