"""Where do a simulation and recordings held out differ most?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd


@dataclass(frozen=True)
class LargestDifference:
    """The recording and the output in which a simulation is off the furthest.

    Attributes
    ----------
    recording, output
        Which.
    before, after
        Root mean square difference there, in the unit of the output, of the simulation as given and of the
        one that the verdict ends with; infinite where it runs away.
    recordings
        How many were held out.
    """

    recording: str
    output: str
    before: float
    after: float
    recordings: int


def largest_difference(table: pd.DataFrame, *, after: str) -> LargestDifference | None:
    """The held-out recording to begin with; None where nothing was held out.

    The output is the one in which the simulation as given is off the furthest, in units of its spread, in
    the middle of all recordings, so that a single runaway does not decide. Of its recordings it is the one
    in which the difference is largest.

    Parameters
    ----------
    table
        Columns ``recording output measured before recalibrated augmented scored``.
    after
        The simulation that the verdict ends with: ``"augmented"``, ``"recalibrated"``, or ``"before"``.
    """
    scored = table[table["scored"].astype(bool) & table["measured"].notna()]
    if scored.empty:
        return None
    squares = {
        name: ((scored[name] - scored["measured"]) ** 2).fillna(np.inf)
        for name in dict.fromkeys(("before", after))
    }
    places = [scored["output"], scored["recording"].astype(str)]
    errors = {name: each.groupby(places, sort=False).mean() for name, each in squares.items()}
    spread = scored.groupby("output", sort=False)["measured"].var()
    middle = errors["before"].groupby(level="output", sort=False).median()
    output = str((middle / spread.where(spread > 0, 1.0)).idxmax())
    recording = str(errors["before"].loc[output].idxmax())
    return LargestDifference(
        recording,
        output,
        before=float(np.sqrt(errors["before"].loc[output, recording])),
        after=float(np.sqrt(errors[after].loc[output, recording])),
        recordings=scored["recording"].nunique(),
    )
