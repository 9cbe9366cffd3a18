"""Saddles between two attractors, found without being told, in as many states as there are.

Two states on either side of the boundary between two basins are bisected until they all but agree, and
followed until they have come apart; then they are bisected again. What they approach is a state on the
boundary that attracts along it: mostly a saddle with one unstable direction, at which Newton's method ends.

References
----------
J. D. Skufca, J. A. Yorke, B. Eckhardt, Phys. Rev. Lett. 96 (2006) 174101: edge tracking.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import scipy.optimize

from siq.dynamics.descents import follow
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import Equilibrium, classify, distinct_roots
from siq.numerics.integration import dormand_prince_step, next_step

SECTIONS = 16  # of a segment, whose ends are followed side by side
CLOSE, APART = 1e-7, 1e-3  # of the box: when two states all but agree, and when they have come apart
ROUNDS = 40
BENT = 0.05  # of the box, by which the first way leaves the straight line, where symmetry may hold it
MOST_STEPS = 20_000  # of integration, until two states have come apart
ACCURACY = 1e-9  # of the box: local error of a step
# Of the box: how far beside a root with two unstable directions saddles are sought. Enough in chains of 24
# and 50 units, coupling 2 and tilt 0.1; with a tilt of 0.03 not always.
ASIDE = (0.02, 0.05, 0.1)
LEVENBERG_STEPS = 200
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
        # Where a front has to cross a chain, states are still on their way after any relaxation time.
        return follow(dynamics, x, attractors, box=box, states=2, patience=dynamics.dimension).ends

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
    """The saddle with one unstable direction beside a state of the edge; None where none is found.

    A front in a long chain may stand at every site: then the edge hardly moves, and the root next to it may
    have a second direction that is all but neutral. Along this lie the saddles on either side.
    """

    def beside(start: np.ndarray) -> Equilibrium | None:
        for place in _roots_near(dynamics, start, box, width):
            if (np.abs(place - x) / width).max() < BESIDE:
                return classify(dynamics, place)
        return None

    one = beside(x)
    if one is None or one.unstable == 1:
        return one if one is not None and one.kind == "saddle" else None
    values, vectors = np.linalg.eig(dynamics.jacobian(one.position[None])[0] * width / width[:, None])
    weakest = np.argmin(np.where(values.real > 0, values.real, np.inf))
    along = vectors[:, weakest].real
    along *= width / np.abs(along).max()
    for size, sign in itertools.product(ASIDE, (1, -1)):
        other = beside(one.position + sign * size * along)
        if other is not None and other.kind == "saddle" and other.unstable == 1:
            return other
    return None


def _roots_near(dynamics: Dynamics, x: np.ndarray, box: np.ndarray, width: np.ndarray) -> list[np.ndarray]:
    """Where Newton's method comes from a state, or else Levenberg and Marquardt's, which may not run away."""
    found = distinct_roots(dynamics, x[None], box=box, margin=0.0)
    if found:
        return found
    with np.errstate(all="ignore"):  # a step may lead to where f is beyond all numbers, and is taken back
        solved = scipy.optimize.root(
            lambda share: dynamics.drift((share * width)[None])[0] / width,
            x / width,
            jac=lambda share: dynamics.jacobian((share * width)[None])[0] * width / width[:, None],
            method="lm",
            options={"xtol": 1e-12, "ftol": 1e-12, "maxiter": LEVENBERG_STEPS},
        )
    return distinct_roots(dynamics, (solved.x * width)[None], box=box, margin=0.0)


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
        with np.errstate(over="ignore", invalid="ignore"):  # a step that is too long is taken again
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
