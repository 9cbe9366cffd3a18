"""What recordings tell that no fit saw, and which part of it a formula about one attractor has to answer."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from siq.certificate.characteristics import FEWEST, SHARE, Reference
from siq.certificate.regions import BasinRegion
from siq.data.recordings import SnapshotPairs
from siq.potential.well import Well


@dataclass(frozen=True)
class HeldOut:
    """States and pairs of held-out recordings.

    Attributes
    ----------
    points
        Evenly spread states, shape ``(n, d)``.
    pairs
        Consecutive samples; None where f is given, and no motion was recorded.
    described
        What the points are, in words.
    claimed
        Share of the states of the region at which the formula claims to hold.
    """

    points: np.ndarray
    pairs: SnapshotPairs | None
    described: str = ""
    claimed: float = 1.0

    def __post_init__(self) -> None:
        if not self.described:
            object.__setattr__(self, "described", f"{len(self.points)} held-out states")


def part_of(held_out: HeldOut, well: Well, region: BasinRegion, reference: Reference | None) -> HeldOut:
    """What lies in a well below `SHARE` of its level: at the saddle itself V is stationary.

    Parameters
    ----------
    held_out
        Of all recordings.
    well
        The formula and its level.
    region
        Which states lead to its attractor.
    reference
        Points of characteristics, which no fit saw either: they are added where fewer than `FEWEST`
        held-out states lie in the well.

    Returns
    -------
    HeldOut
        States where the formula claims to hold: it makes no claim where its own residual is large, as at a
        caustic. `claimed` has their share. Pairs count by their first sample: to ask where the second one
        lies would be to choose the noise.
    """

    def inside(x: np.ndarray) -> np.ndarray:
        mask = (well.values(x) < SHARE * well.level) & well.reaches(x)
        mask[mask] = ~region.across(x[mask])
        return np.asarray(mask)

    points, pairs = held_out.points[inside(held_out.points)], held_out.pairs
    further = ""
    if len(points) < FEWEST and reference is not None:
        own = len(points)
        points = np.concatenate([points, reference.below(well.level)[0]])
        further = f", {own} of them held out and, as these are few, the others reached by characteristics"
    believed = well.believed(points)
    described = f"{believed.sum()} of {len(points)} states of a well, where V claims to hold"
    described += further or ", all held out"
    share = float(believed.mean()) if len(points) else 0.0
    if pairs is None:
        return HeldOut(points[believed], None, described, share)
    rows = inside(pairs.x0)
    rows[rows] = well.believed(pairs.x0[rows])
    kept = replace(
        pairs, x0=pairs.x0[rows], xh=pairs.xh[rows], h=pairs.h[rows], recording=pairs.recording[rows]
    )
    return HeldOut(points[believed], kept, described, share)
