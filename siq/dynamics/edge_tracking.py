"""Saddles between two attractors, found without being told, in as many states as there are.

Two states on either side of the boundary between two basins are bisected until they all but agree, and
followed until they have come apart; then they are bisected again. What they approach is a state on the
boundary that attracts along it: mostly a saddle with one unstable direction, at which Newton's method ends.

References
----------
J. D. Skufca, J. A. Yorke, B. Eckhardt, Phys. Rev. Lett. 96 (2006) 174101: edge tracking.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import Equilibrium, classify, distinct_roots, follow
from siq.numerics.integration import dormand_prince_step, next_step

SECTIONS = 16  # of a segment, whose ends are followed side by side
CLOSE, APART = 1e-7, 1e-3  # of the box: when two states all but agree, and when they have come apart
ROUNDS = 40
BENT = 0.05  # of the box, by which the first way leaves the straight line, where symmetry may hold it
MOST_STEPS = 20_000  # of integration, until two states have come apart
ACCURACY = 1e-9  # of the box: local error of a step
BESIDE = 0.2  # of the box: so close to the edge a root of f has to be its saddle


def edge_saddle(
    dynamics: Dynamics,
    one: int,
    two: int,
    attractors: Sequence[Equilibrium],
    *,
    box: np.ndarray,
    generator: np.random.Generator,
) -> Equilibrium | None:
    """A saddle on the boundary of a basin, between two attractors; None where tracking comes to none.

    Parameters
    ----------
    dynamics
        f.
    one, two, attractors
        Which of the attractors; the boundary is that of the basin of `one`.
    box
        Shape ``(d, 2)``: the domain.
    generator
        Bends the first way.
    """
    width = np.ptp(box, axis=1)

    def ends(x: np.ndarray) -> np.ndarray:
        return follow(dynamics, x, attractors, box=box, states=2).ends

    start, end = attractors[one].position, attractors[two].position
    pair = bisected(start, end, one, ends, width=width, generator=generator)
    for _ in range(ROUNDS):
        found = _saddle_near(dynamics, pair.mean(axis=0), box, width)
        if found is not None:
            return found
        tracked = apart_of(dynamics, pair, width)
        if tracked is None:
            return None
        pair = bisected(tracked[0][0], tracked[0][1], one, ends, width=width)
    return None


def bisected(
    low: np.ndarray,
    high: np.ndarray,
    one: int,
    ends: Callable[[np.ndarray], np.ndarray],
    *,
    width: np.ndarray,
    generator: np.random.Generator | None = None,
) -> np.ndarray:
    """Two states on either side of the boundary of a basin that all but agree, shape ``(2, d)``.

    Parameters
    ----------
    low, high
        Shape ``(d,)``: a state within the basin, and one beyond it.
    one
        The number of the basin.
    ends
        At which attractor each of some states ends.
    width
        Shape ``(d,)``: of the domain.
    generator
        Bends the way between both; without it, it is straight.
    """
    share = np.linspace(0, 1, SECTIONS + 2)[:, None]
    bend = np.zeros(len(width)) if generator is None else BENT * width * generator.standard_normal(len(width))
    way = low + share * (high - low) + np.sin(np.pi * share) * bend
    while True:
        other = np.flatnonzero(ends(way[1:-1]) != one)
        last = int(other[0]) if len(other) else len(way) - 2
        low, high = way[last], way[last + 1]
        if (np.abs(high - low) / width).max() <= CLOSE:
            return np.stack([low, high])
        way = low + share * (high - low)


def _saddle_near(dynamics: Dynamics, x: np.ndarray, box: np.ndarray, width: np.ndarray) -> Equilibrium | None:
    for place in distinct_roots(dynamics, x[None], box=box, margin=0.0):
        one = classify(dynamics, place)
        if one.kind == "saddle" and one.unstable == 1 and (np.abs(place - x) / width).max() < BESIDE:
            return one
    return None


def apart_of(
    dynamics: Dynamics, pair: np.ndarray, width: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Two states followed for the same time until they have come apart; None where they do not.

    Returns
    -------
    tuple
        The two states, shape ``(2, d)``; the times that have passed at each step, ``(n,)``, and their
        middles there, ``(n, d)``.
    """
    speed = float(np.abs(dynamics.drift(pair) / width).max())
    step, now = 1e-3 / max(speed, 1e-300), 0.0
    times, middles = [], []
    for _ in range(MOST_STEPS):
        moved, error = dormand_prince_step(dynamics.drift, pair, np.full(2, step))
        relative = np.abs(error / width).max(axis=1) / ACCURACY
        if relative.max() <= 1:
            pair, now = moved, now + step
            times.append(now)
            middles.append(pair.mean(axis=0))
            if (np.abs(pair[1] - pair[0]) / width).max() > APART:
                return pair, np.array(times), np.array(middles)
        step = float(next_step(np.full(2, step), relative).min())
    return None
