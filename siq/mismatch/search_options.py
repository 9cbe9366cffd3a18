"""What counts as found?"""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class SearchOptions:
    """What counts as found.

    Attributes
    ----------
    false_alarms
        Probability of a mechanism where none is missing, over all candidates together, for each test.
    same
        Candidates whose χ² is within this of the best are indistinguishable from it.
    fitted
        Most candidates that are fitted after each screening.
    mechanisms
        Most mechanisms that are looked for.
    named
        χ² that a mechanism must gain to be named. What gains less is detected, and described, but too
        faint for its shape to be tried: much that no dictionary has looks the same.
    blocks
        Least number of blocks into which recordings are cut for clustered errors, where there are fewer than
        half as many recordings.
    """

    false_alarms: Annotated[float, Field(gt=0, lt=1)] = 0.002
    same: Annotated[float, Field(gt=0)] = 10.0
    fitted: Annotated[int, Field(ge=1)] = 6
    mechanisms: Annotated[int, Field(ge=1, le=5)] = 3
    named: Annotated[float, Field(ge=0)] = 100.0
    blocks: Annotated[int, Field(ge=4)] = 10
