"""Held-out recordings: which ones a fit does not see."""

from __future__ import annotations

import numpy as np

from siq.data.labels import sources
from siq.data.learnable import SINGLE_REMEDY
from siq.data.recordings import Recordings
from siq.errors import NumericalFailure

SHARE = 0.2  # a convention: the usual fifth


def held_out_recordings(
    recordings: Recordings, *, generator: np.random.Generator, share: float = SHARE
) -> np.ndarray:
    """A random part of the recordings, as a mask over ``recordings.labels``.

    Copies of a resampled recording stay together: none is held out while another is fitted.

    Raises
    ------
    NumericalFailure
        When all recordings are copies of one, so that none can be held out.
    """
    groups = np.asarray(sources(recordings.labels))
    names = np.unique(groups)
    if len(names) < 2:
        raise NumericalFailure(
            "there is only one recording, and it shows no random forces or is too short to be divided, so"
            f" that none can be held out; {SINGLE_REMEDY}"
        )
    count = min(max(round(share * len(names)), 1), len(names) - 1)
    return np.isin(groups, generator.permutation(names)[:count])
