"""The phase portrait of given equations over their domain: no trajectory is needed that somebody recorded.

The same `PhasePortrait` as that of recorded states, from states that are spread evenly over the domain. About
each attractor there are more of them, as its linearisation tells how far: a well may be small in its domain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from siq.dynamics.basins import Basin, Focus, basin_of
from siq.dynamics.cycle_search import cycles_between, cycles_left, cycles_reached
from siq.dynamics.descents import Descents, follow
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import Equilibrium, hessian_at
from siq.dynamics.equilibrium_search import all_equilibria, spread_evenly
from siq.dynamics.phase_portrait import (
    PhasePortrait,
    reached_attractors,
    recurrence_beyond,
    saddles_beside,
)
from siq.errors import NumericalFailure

STARTS = 1024  # in one and two states, and twice as many for each further one; shares of basins to 1 %
MOST_STARTS = 4096
NEAR = 1024  # starts about each attractor
FAR = (
    4.0  # of the quadratic V at the lowest saddle: V may differ from it by that, and wells are fitted beyond
)
AROUND = 64  # directions in which the neighbourhood of a degenerate equilibrium is asked where it leads
RESTING = 1e-3  # of the rate: what is so slow outside the domain does not come back
CLOSE = 0.02  # of the domain: so far from it
DECIDED = 0.5  # share of these directions that has to have led somewhere: f is slow where it is degenerate


def domain_portrait(dynamics: Dynamics, *, seed: int = 0) -> PhasePortrait:
    """Equilibria, basins, and what leads to each attractor, from equations and their domain.

    Parameters
    ----------
    dynamics
        f and D, with the domain.
    seed
        Scrambles the states that stand for the domain.

    Raises
    ------
    ValueError
        Where no domain is known, or the equations are driven.
    NumericalFailure
        When f has no value in a part of the domain, or nothing moves.
    """
    generator = np.random.default_rng(seed)
    box, d = dynamics.box, dynamics.dimension
    points = spread_evenly(box, min(STARTS * 2 ** max(d - 2, 0), MOST_STARTS), generator=generator)
    flow = dynamics.drift(points)
    if not np.isfinite(flow).all():
        raise NumericalFailure("f has no value in a part of the domain: choose one in which it has")
    width = np.ptp(box, axis=1)
    rate = float(np.median(np.linalg.norm(flow / width, axis=1)))
    search = all_equilibria(dynamics, generator=generator)
    stable = [one for one in search.equilibria if one.kind == "attractor"]
    descents = _left(dynamics, follow(dynamics, points, stable, box=box), box=box, rate=rate)
    attractors, descents = reached_attractors(stable, descents)
    cycles, descents = cycles_reached(dynamics, descents, first=len(attractors), box=box, rate=rate)
    if d == 2:
        parting = cycles_left(dynamics, search.equilibria, box=box, generator=generator)
    elif cycles:
        parting = cycles_between(dynamics, attractors, cycles, box=box, generator=generator)
    else:
        parting = ()
    around = saddles_beside(dynamics, search.equilibria, attractors, box=box, cycles=cycles)
    # Over a saddle with several unstable directions no way is lowest.
    passes = tuple(tuple(one for one in saddles if one.unstable == 1) for saddles in around)
    basins: list[Basin] = []
    for index, one in enumerate(attractors):
        starts = descents.paths[descents.ends == index][:, 0]
        focus = Focus(NEAR if d > 1 else 0, _level(dynamics, one, passes[index], starts))
        basins.append(
            basin_of(dynamics, descents, index, attractors, box=box, generator=generator, focus=focus)
        )
    harmless, notes = _harmless(dynamics, search.equilibria, attractors, box, generator)
    unseen = [one.position for one in stable if all(one is not other for other in attractors)]
    notes += [
        f"fewer than one in {len(points)} states of the domain lead to the stable equilibrium"
        f" {place.round(4).tolist()}: it is left out"
        for place in unseen
    ]
    return PhasePortrait(
        points, box, search.equilibria, tuple(attractors), passes, tuple(basins), descents,
        recurrence_beyond(dynamics, descents, box=box, rate=rate),
        harmless, (*search.notes, *notes), cycles, parting,
    )  # fmt: skip


def _left(dynamics: Dynamics, descents: Descents, *, box: np.ndarray, rate: float) -> Descents:
    """The same, with those that come to rest outside the domain counted among those that left it."""
    last, width = descents.paths[:, -1], np.ptp(box, axis=1)
    speed = np.linalg.norm(dynamics.drift(last) / width, axis=1)
    outside = ((last < box[:, 0]) | (last > box[:, 1])).any(axis=1) & (speed < RESTING * rate)
    return replace(descents, escaped=descents.escaped | (outside & (descents.ends < 0)))


def _level(
    dynamics: Dynamics, attractor: Equilibrium, saddles: Sequence[Equilibrium], starts: np.ndarray
) -> float:
    """Up to which ``½ (x - A)·M (x - A)`` there are further starts; without a saddle, half of the basin."""
    hessian = hessian_at(dynamics, attractor.position)
    places = np.array([one.position for one in saddles]) if saddles else starts
    offset = places - attractor.position
    heights = 0.5 * np.einsum("ni,ij,nj->n", offset, hessian, offset)
    return FAR * float(heights.min()) if saddles else float(np.median(heights))


def _harmless(
    dynamics: Dynamics,
    equilibria: Sequence[Equilibrium],
    attractors: Sequence[Equilibrium],
    box: np.ndarray,
    generator: np.random.Generator,
) -> tuple[tuple[Equilibrium, ...], list[str]]:
    """Degenerate equilibria from all about which f leads to one attractor: they part no wells."""
    found, notes, width = [], [], np.ptp(box, axis=1)
    for one in equilibria:
        if one.kind != "degenerate" or not attractors:
            continue
        directions = generator.standard_normal((AROUND, len(box)))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        starts = one.position + CLOSE * width * directions
        starts = starts[((starts > box[:, 0]) & (starts < box[:, 1])).all(axis=1)]
        if not len(starts):
            continue
        ways = follow(dynamics, starts, attractors, box=box)
        creeping = (np.abs((ways.paths[:, -1] - one.position) / width) < 2 * CLOSE).all(axis=1)
        ends = ways.ends[(ways.ends >= 0) | ~creeping]
        if len(ends) > DECIDED * len(starts) and ends[0] >= 0 and (ends == ends[0]).all():
            found.append(one)
            notes.append(
                f"the equilibrium {one.position.round(4).tolist()} is neither stable nor unstable to first"
                f" order; all states about it lead to the attractor"
                f" {attractors[ends[0]].position.round(4).tolist()}, and it takes no part in the landscape"
            )
    return tuple(found), notes
