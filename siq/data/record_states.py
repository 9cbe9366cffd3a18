"""What does a record say by itself, without any formula: which two states, how long do they last?

This holds where no f is found, or none is certified: it is counted, and rests on no model but that of two
levels (`siq.data.transitions`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from siq.data.recordings import Recordings
from siq.data.transitions import Switching
from siq.data.visits import DwellCount
from siq.numerics.measured_text import range_text, unit_text, value_text

if TYPE_CHECKING:
    import pandas as pd

BINS = 40  # of the histogram, as for the test against the record


@dataclass(frozen=True, eq=False)
class RecordStates:
    """The two states that recordings show by themselves.

    Attributes
    ----------
    state
        The measured quantity that shows them best, as its file calls it.
    unit, time_unit
        None where the file does not say.
    supported
        Whether the record supports two states at all.
    probability
        Of as much with a single state over a slowly drifting background.
    levels
        The two, the lower first, in the unit of the state.
    counts
        How long each lasts, the lower first.
    edges, density
        Histogram of the state: edges ``(b + 1,)`` and, per unit of the state, ``(b,)``.
    """

    state: str
    unit: str | None
    time_unit: str | None
    supported: bool
    probability: float
    levels: tuple[float, float]
    counts: tuple[DwellCount, DwellCount]
    edges: np.ndarray
    density: np.ndarray

    @property
    def transitions(self) -> int:
        """How many were seen, both ways."""
        return self.counts[0].visits + self.counts[1].visits

    def dwell_times(self) -> pd.DataFrame:
        """How long each state lasts, a row for each.

        Returns
        -------
        pandas.DataFrame
            Columns ``level visits mean_time lowest highest``: the level of the state; how many visits were
            seen to end; their mean in the unit of time, NaN where none ended, with its interval of 95 %.
        """
        import pandas as pd

        return pd.DataFrame(
            [
                (level, one.visits, one.mean, *one.limits)
                for level, one in zip(self.levels, self.counts, strict=True)
            ],
            columns=["level", "visits", "mean_time", "lowest", "highest"],
        )

    def sentence(self) -> str:
        """The same in a sentence; empty where two states are not supported."""
        if not self.supported:
            return ""
        low, high = (value_text(level, unit=self.unit or "", digits=3) for level in self.levels)
        time = unit_text(self.time_unit) or "time units"
        means = " and ".join(map(_mean_text, self.counts))
        return (
            f"The recordings hop between two states of {self.state}, at {low} and {high}: {self.transitions}"
            f" transition{'s were' if self.transitions > 1 else ' was'} seen, from level to level, and the"
            f" states last {means} {time} in the mean."
        )

    def as_data(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "state": self.state,
            "unit": self.unit,
            "time_unit": self.time_unit,
            "supported": self.supported,
            "probability": self.probability,
            "levels": list(self.levels),
            "counts": [{"visits": one.visits, "time": one.time} for one in self.counts],
            "edges": self.edges.tolist(),
            "density": self.density.tolist(),
        }

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> RecordStates:
        """What `as_data` gave."""
        low, high = data["levels"]
        first, second = (DwellCount(int(one["visits"]), float(one["time"])) for one in data["counts"])
        return cls(
            data["state"], data["unit"], data["time_unit"], bool(data["supported"]),
            float(data["probability"]), (float(low), float(high)), (first, second),
            np.array(data["edges"], dtype=float), np.array(data["density"], dtype=float),
        )  # fmt: skip


def states_of_record(recordings: Recordings, found: Switching | None) -> RecordStates | None:
    """What `siq.data.transitions.switching` found in recordings; None where it found nothing.

    Where a background drifts slowly it is taken off the histogram, as it is off the levels.
    """
    if found is None:
        return None
    values = recordings.values[:, found.state] - found.background.values
    density, edges = np.histogram(values, bins=BINS, density=True)
    return RecordStates(
        recordings.titles[found.state], recordings.units[found.state], recordings.time_unit,
        found.supported, found.probability, found.levels, found.counts, edges, density,
    )  # fmt: skip


def _mean_text(one: DwellCount) -> str:
    low, high = one.limits
    if not one.visits:
        return f"more than {value_text(low, digits=2)}"
    return f"{value_text(one.mean, digits=3)} ({range_text(low, high)})"
