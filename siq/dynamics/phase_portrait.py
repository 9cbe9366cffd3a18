"""The phase portrait: attractors, the saddles next to each, and the recorded points that lead there.

It follows from the identified f and the recorded points alone. Both routes to V start from it, and so does
the check that ends a training.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from siq.dynamics.basins import Basin, basin_of
from siq.dynamics.cycles import Cycle
from siq.dynamics.descents import Descents, follow, neighbours
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import Equilibrium, find_equilibria, rate_of
from siq.dynamics.recurrence import Recurrence, recurrence_of
from siq.numerics.thinning import representative_subset

STARTS = 1500  # recorded points from which f is followed
NEWTON_STARTS = 400
UNSETTLED = 0.02  # share of the recorded points: as many may be slow, on the ridge between two wells
APART = 0.04  # of each state's range: starts that cover the recorded region evenly


@dataclass(frozen=True)
class PhasePortrait:
    """What f says of the recorded region.

    Attributes
    ----------
    points
        Evenly spread recorded states, shape ``(n, d)``.
    box
        Shape ``(d, 2)``: their limits.
    equilibria
        All that were found.
    attractors
        Those that are stable and that recorded points lead to.
    saddles
        For each attractor, and each of the cycles after these, the saddles next to it.
    basins
        For each attractor, what leads to it.
    descents
        From recorded points, to whatever end.
    recurrence
        Where those lead that come to rest nowhere; None where they are few.
    harmless
        Degenerate equilibria that take no part in the landscape.
    notes
        What is not known, in words.
    cycles
        Stable cycles that states of the domain lead to. In `descents` their numbers follow on those of the
        attractors.
    parting
        Unstable cycles, which part basins.
    """

    points: np.ndarray
    box: np.ndarray
    equilibria: tuple[Equilibrium, ...]
    attractors: tuple[Equilibrium, ...]
    saddles: tuple[tuple[Equilibrium, ...], ...]
    basins: tuple[Basin, ...]
    descents: Descents
    recurrence: Recurrence | None = None
    harmless: tuple[Equilibrium, ...] = ()
    notes: tuple[str, ...] = ()
    cycles: tuple[Cycle, ...] = ()
    parting: tuple[Cycle, ...] = ()

    @property
    def unsettled(self) -> float:
        """Share of the recorded points from which f leads to no attractor although it stays in reach."""
        return float(((self.descents.ends < 0) & ~self.descents.escaped).mean())

    def fault(self) -> str | None:
        """Why this landscape has no wells, in words; None where it has."""
        degenerate = [one for one in self.equilibria if one.kind == "degenerate" and one not in self.harmless]
        if degenerate:
            place = np.array2string(degenerate[0].position, precision=4)
            return f"the equilibrium at {place} is neither stable nor unstable to first order"
        ends = "there is another attractor" if self.recurrence is None else self.recurrence.sentence()
        if not (self.attractors or self.cycles) and self.unsettled <= UNSETTLED:
            return "f has no stable equilibrium in the recorded region"
        if self.unsettled <= UNSETTLED:
            return None
        if not (self.attractors or self.cycles):
            return f"no recorded state comes to rest at a stable equilibrium: {ends}"
        return f"{self.unsettled:.0%} of the recorded states lead to no equilibrium: {ends}"


def evenly_spread(x: np.ndarray, *, generator: np.random.Generator, most: int = 4000) -> np.ndarray:
    """Rows of states that cover the recorded region evenly, about a twentieth of each state's range apart.

    One state has so many as two have, several hundred: a twentieth apart they would be too few to tell V.
    """
    width, dimension = np.ptp(x, axis=0), x.shape[1]
    rows = representative_subset(
        x / np.where(width > 0, width, 1.0),
        distance=max(APART ** max(1.0, 2 / dimension), 0.5 * most ** (-1 / dimension)),
        generator=generator,
    )
    return np.sort(generator.choice(rows, most, replace=False)) if len(rows) > most else rows


def phase_portrait(dynamics: Dynamics, points: np.ndarray, *, seed: int = 0) -> PhasePortrait:
    """Find the attractors, their saddles, and what leads to them.

    Parameters
    ----------
    dynamics
        f and D.
    points
        Evenly spread recorded states, shape ``(n, d)``; see `evenly_spread`.
    seed
        Decides which points stand for the others.
    """
    generator = np.random.default_rng(seed)
    box = np.stack([points.min(axis=0), points.max(axis=0)], axis=1)
    few = generator.permutation(len(points))
    equilibria = find_equilibria(dynamics, points[few[:NEWTON_STARTS]])
    stable = [one for one in equilibria if one.kind == "attractor"]
    descents = follow(dynamics, points[few[:STARTS]], stable, box=box)
    attractors, descents = reached_attractors(stable, descents)
    around = saddles_beside(dynamics, equilibria, attractors, box=box)
    basins = [
        basin_of(dynamics, descents, index, attractors, box=box, generator=generator)
        for index in range(len(attractors))
    ]
    return PhasePortrait(
        points, box, tuple(equilibria), tuple(attractors), around, tuple(basins), descents,
        recurrence_beyond(dynamics, descents, box=box, rate=rate_of(dynamics, points)),
    )  # fmt: skip


def reached_attractors(
    stable: Sequence[Equilibrium], descents: Descents
) -> tuple[list[Equilibrium], Descents]:
    """Those stable equilibria at which descents end, and the descents with the numbers of these."""
    reached = [index for index in range(len(stable)) if (descents.ends == index).any()]
    renumbered = np.full(len(stable) + 1, -1)
    renumbered[reached] = np.arange(len(reached))
    return [stable[index] for index in reached], replace(descents, ends=renumbered[descents.ends])


def saddles_beside(
    dynamics: Dynamics,
    equilibria: Sequence[Equilibrium],
    attractors: Sequence[Equilibrium],
    *,
    box: np.ndarray,
    cycles: Sequence[Cycle] = (),
) -> tuple[tuple[Equilibrium, ...], ...]:
    """For each attractor, and each cycle after these, the saddles next to it."""
    around: list[list[Equilibrium]] = [[] for _ in (*attractors, *cycles)]
    for one in equilibria:
        if one.kind == "saddle":
            for index in neighbours(dynamics, one, attractors, box=box, cycles=cycles):
                around[index].append(one)
    return tuple(tuple(saddles) for saddles in around)


def recurrence_beyond(
    dynamics: Dynamics, descents: Descents, *, box: np.ndarray, rate: float
) -> Recurrence | None:
    """Where those descents lead that come to rest nowhere; None where they are few."""
    unsettled = np.flatnonzero((descents.ends < 0) & ~descents.escaped)
    if not len(unsettled) > UNSETTLED * len(descents.ends):
        return None
    return recurrence_of(dynamics, descents.paths[unsettled, -1], box=box, rate=rate)
