"""The phase portrait of equations of many states: attractors from trajectories, saddles from edges.

In many states no search covers the domain. Attractors are where f leads from states all over it, and saddles
are found between each two of them by following the edge of their basins (`siq.dynamics.edge_tracking`). What
follows from paths needs no more; there are no basins in which V could be fitted.
"""

from __future__ import annotations

import itertools

import numpy as np

from siq.dynamics.descents import follow
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.edge_tracking import edge_saddle
from siq.dynamics.equilibria import Equilibrium, classified, distinct_roots
from siq.dynamics.equilibrium_search import spread_evenly
from siq.dynamics.phase_portrait import (
    PhasePortrait,
    reached_attractors,
    recurrence_beyond,
    saddles_beside,
)

MOST_SEARCHED = 8  # states up to which Newton's method searches the whole domain
STARTS = 64  # independent in each state
ALIKE = 33  # with every state at the same share of its range
TRACKED = 2  # edges for each two attractors, from different first ways
MOST_PAIRS = 15  # of attractors
SAME = 1e-6  # of the domain
SEARCHED = (
    "in so many states equilibria were not searched for over the whole domain: attractors are those to which"
    " f leads from {starts} states, and saddles those at which edges between each two of their basins end"
)


def portrait_of_many(dynamics: Dynamics, *, seed: int = 0) -> PhasePortrait:
    """Attractors, and the saddles between them.

    Parameters
    ----------
    dynamics
        f and D, with the domain.
    seed
        Of the states that are followed, and of the first ways between attractors.
    """
    generator = np.random.default_rng(seed)
    box = dynamics.box
    width = np.ptp(box, axis=1)
    # Of many independent states the mean is always about the same: some starts have all states high, or low.
    alike = np.linspace(0, 1, ALIKE)[:, None] * width + box[:, 0]
    points = np.concatenate([spread_evenly(box, STARTS, generator=generator), alike])
    rate = float(np.median(np.linalg.norm(dynamics.drift(points) / width, axis=1)))
    resting = follow(dynamics, points, [], box=box, states=2).paths[:, -1]
    found = classified(dynamics, distinct_roots(dynamics, resting, box=box, margin=SAME), box=box, rate=rate)
    stable = [one for one in found if one.kind == "attractor"]
    attractors, descents = reached_attractors(stable, follow(dynamics, points, stable, box=box))
    saddles: list[Equilibrium] = []
    pairs = list(itertools.combinations(range(len(attractors)), 2))
    for (one, two), _ in itertools.product(pairs[:MOST_PAIRS], range(TRACKED)):
        top = edge_saddle(dynamics, one, two, attractors, box=box, generator=generator)
        if top is not None and all(
            np.abs((top.position - other.position) / width).max() > SAME for other in saddles
        ):
            saddles.append(top)
    notes = [SEARCHED.format(starts=len(points))]
    if len(attractors) > 1 and not saddles:
        notes.append("edges between the basins were followed, and led to no saddle: there are no barriers")
    if len(pairs) > MOST_PAIRS:
        notes.append(f"saddles were sought between {MOST_PAIRS} of {len(pairs)} pairs of attractors")
    return PhasePortrait(
        points, box, (*attractors, *saddles), tuple(attractors),
        saddles_beside(dynamics, saddles, attractors, box=box), (), descents,
        recurrence_beyond(dynamics, descents, box=box, rate=rate), (), tuple(notes),
    )  # fmt: skip
