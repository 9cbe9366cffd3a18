"""Draw the pictures of the page on what is in recordings: `python docs/make/inspection.py`.

Each is of the same two wells: with white forces, with forces that have a memory, seen through an exposure,
and with measurement noise. So nobody has to guess what such a record looks like.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")

import numpy as np
from matplotlib import pyplot

import siq
from siq.data.inspection import Inspection

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "images" / "inspection"
sys.path.insert(0, str(ROOT / "tests"))

from remembering import STEP, double_wells  # noqa: E402  # the records of the tests

CASES: dict[str, dict[str, Any]] = {
    "white forces": {},
    "forces with a memory of 5 steps": {"memory": 5.0},
    "an exposure of 3 steps": {"exposure": 3.0},
    "measurement noise": {"sensor": 0.03},
}
BLUE, BAND = "#3d5a80", "0.85"


def inspected(given: dict[str, Any]) -> Inspection:
    """The inspection of one record."""
    values = double_wells(1, samples=10_000, **given)
    t = np.arange(values.shape[1]) * STEP
    return siq.inspect(siq.Recordings.from_arrays(t, values, names=["x"], units=["nm"], time_unit="s"))


def main() -> None:
    """Draw all."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    figure, panels = pyplot.subplots(2, 2, figsize=(9.5, 5.2), layout="constrained", sharex=True)
    for axes, (title, given) in zip(panels.ravel(), CASES.items(), strict=True):
        found = inspected(given)
        memory = found.memory
        shown = slice(0, 30)
        lags, band = memory.lags[shown], 2 * memory.errors[shown, 0]
        axes.fill_between(lags, -band, band, color=BAND)
        axes.plot(lags, memory.correlations[shown, 0], "o-", color=BLUE, markersize=3, linewidth=0.8)
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, -0.1), max(high, 0.1))
        if memory.remembers:
            axes.axvline(memory.lag, color="black", linestyle="--", linewidth=0.9)
        axes.set_title(f"{title}: “{memory.kind}”")
    for axes in panels[-1]:
        axes.set_xlabel("steps between two increments")
    for axes in panels[:, 0]:
        axes.set_ylabel("correlation")
    figure.savefig(FOLDER / "memory.png", dpi=110)
    found = inspected(CASES["an exposure of 3 steps"])
    found.plot().savefig(FOLDER / "record.png", dpi=110)
    print(found.text())


if __name__ == "__main__":
    main()
