"""What counts as found?"""

from __future__ import annotations

import math
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
    unnamed
        Probability beforehand that what a simulation lacks is not in the dictionary.
    wrong_names
        Most probability of a name that is wrong, since something without a name looks alike. What is less
        certain is detected, and described.
    blocks
        Least number of blocks into which recordings are cut for clustered errors, where there are fewer than
        half as many recordings.
    """

    false_alarms: Annotated[float, Field(gt=0, lt=1)] = 0.002
    same: Annotated[float, Field(gt=0)] = 10.0
    fitted: Annotated[int, Field(ge=1)] = 6
    mechanisms: Annotated[int, Field(ge=1, le=5)] = 3
    unnamed: Annotated[float, Field(gt=0, lt=1)] = 0.1
    wrong_names: Annotated[float, Field(gt=0, lt=0.5)] = 0.05
    blocks: Annotated[int, Field(ge=4)] = 10

    @property
    def least_log_odds(self) -> float:
        """Logarithm of the odds that a name takes."""
        return math.log((1 - self.wrong_names) / self.wrong_names)

    @property
    def most_alike(self) -> float:
        """Most probability that an effect without a name is explained as well, if a name is to stand.

        By Bayes' rule: where something is left, either the name is right and something without a name is
        missing beside it, (1 - unnamed) unnamed, or there is only the latter, and looks alike.
        """
        return math.exp(-self.least_log_odds) * (1 - self.unnamed)
