"""Where do trajectories end, and which attractors lie below a saddle?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from siq.dynamics.cycles import Cycle
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import Equilibrium
from siq.errors import NumericalFailure
from siq.numerics.integration import dormand_prince_step, next_step

SLOWEST_TIMES = 200.0  # trajectories are followed for so many of the slowest relaxation times, ...
UNSETTLED_TIMES = 25.0  # ... or times to cross the box where there is no attractor
MOST_STEPS = 3000
SPACING = 0.04  # of the recorded box: longest step
ACCURACY = 1e-7  # of the recorded box: local error of a step
NEXT_TO = 0.02  # of the domain: a trajectory that has been followed for long is so close to its cycle
ARRIVED_ON = 1e-3  # of the domain: and one so close to a cycle stays with it
ASKED = 10  # steps after which trajectories are asked whether they are on a cycle
ARRIVED = 1e-4  # of the recorded box: trajectories so close to an attractor end there


@dataclass(frozen=True)
class Descents:
    """Trajectories of f from recorded points to where they end.

    Attributes
    ----------
    paths
        Shape ``(n, k, d)``: k states along each of the n trajectories, the first being the start.
    ends
        Shape ``(n,)``: index of the attractor at which each ends, -1 where it ends at none.
    escaped
        Shape ``(n,)``: whether it left the recorded box for good.
    """

    paths: np.ndarray
    ends: np.ndarray
    escaped: np.ndarray


def follow(
    dynamics: Dynamics,
    starts: np.ndarray,
    attractors: Sequence[Equilibrium],
    *,
    box: np.ndarray,
    states: int = 48,
    patience: int = 1,
    cycles: Sequence[Cycle] = (),
) -> Descents:
    """Follow f from some points to the attractors.

    Parameters
    ----------
    dynamics
        f.
    starts
        Shape ``(n, d)``.
    attractors
        Where trajectories may end.
    box
        Shape ``(d, 2)``: the recorded region. What leaves a box of three times this size has escaped.
    states
        States kept along each trajectory, about evenly spread.
    patience
        How many times longer than usual trajectories are followed: what spreads from one state to the next
        takes as long in each.
    cycles
        Stable cycles on which trajectories may end, too: their numbers follow on those of the attractors.

    Raises
    ------
    NumericalFailure
        When nothing moves: f is zero at most of the starts.
    """
    width = box[:, 1] - box[:, 0]
    middle = box.mean(axis=1)
    rates = [-one.eigenvalues.real.max() for one in attractors]
    slowest = (
        min(rates) if rates else float(np.median(np.linalg.norm(dynamics.drift(starts) / width, axis=1)))
    )
    if not slowest > 0:
        raise NumericalFailure("f is zero at most of the states: nothing moves, and there is no landscape")
    horizon = patience * (SLOWEST_TIMES if rates else UNSETTLED_TIMES) / slowest
    count = len(starts)
    x, times, steps = starts.copy(), np.zeros(count), np.full(count, 0.01 / slowest)
    ends, escaped = np.full(count, -1), np.zeros(count, dtype=bool)
    passed, whose = [starts], [np.arange(count)]
    running = np.arange(count)
    for number in range(patience * MOST_STEPS):
        speed = np.abs(dynamics.drift(x[running]) / width).max(axis=1)
        step = np.minimum(steps[running], np.minimum(0.5 / slowest, SPACING / np.maximum(speed, 1e-300)))
        with np.errstate(over="ignore", invalid="ignore"):
            moved, error = dormand_prince_step(dynamics.drift, x[running], step)
            relative = np.abs(error / width).max(axis=1) / ACCURACY
        steps[running] = next_step(step, relative)
        on, moved, step = running[relative <= 1], moved[relative <= 1], step[relative <= 1]
        inside = (np.abs((moved - middle) / width) < 1.5).all(axis=1)
        escaped[on[~inside]] = True
        on, moved, step = on[inside], moved[inside], step[inside]
        x[on] = moved
        times[on] += step
        passed.append(moved)
        whose.append(on)
        for index, one in enumerate(attractors):
            ends[on[np.abs((moved - one.position) / width).max(axis=1) < ARRIVED]] = index
        if cycles and number % ASKED == 0:
            near = settled_on(moved, cycles, box=box, distance=ARRIVED_ON)
            ends[on[near >= 0]] = len(attractors) + near[near >= 0]
        running = running[~escaped[running] & (ends[running] < 0) & (times[running] < horizon)]
        if not len(running):
            break
    order = np.argsort(np.concatenate(whose), kind="stable")
    last = np.cumsum(np.bincount(np.concatenate(whose), minlength=count)) - 1
    first = np.append(0, last[:-1] + 1)
    kept = np.round(np.linspace(first, last, states, axis=1)).astype(int)
    return Descents(np.concatenate(passed)[order][kept], ends, escaped)


def settled_on(
    x: np.ndarray, cycles: Sequence[Cycle], *, box: np.ndarray, distance: float = NEXT_TO
) -> np.ndarray:
    """The first of some cycles next to which each state lies, -1 where there is none: shape ``(n,)``."""
    width = np.ptp(box, axis=1)
    near = np.full(len(x), -1)
    for index, one in enumerate(cycles):
        near[(near < 0) & (one.distances(x, scale=width) < distance)] = index
    return near


def neighbours(
    dynamics: Dynamics,
    saddle: Equilibrium,
    attractors: Sequence[Equilibrium],
    *,
    box: np.ndarray,
    cycles: Sequence[Cycle] = (),
) -> set[int]:
    """The attractors below a saddle, on either side of its unstable directions; cycles after points."""
    return {int(end) for end in _sides(dynamics, saddle, attractors, box=box, cycles=cycles) if end >= 0}


def leads_back(
    dynamics: Dynamics,
    saddle: Equilibrium,
    attractors: Sequence[Equilibrium],
    *,
    box: np.ndarray,
    cycles: Sequence[Cycle] = (),
) -> bool:
    """Whether f leads from all sides of a saddle to one and the same attractor: it parts no wells."""
    ends = _sides(dynamics, saddle, attractors, box=box, cycles=cycles)
    return bool(ends[0] >= 0 and (ends == ends[0]).all())


def _sides(
    dynamics: Dynamics,
    saddle: Equilibrium,
    attractors: Sequence[Equilibrium],
    *,
    box: np.ndarray,
    cycles: Sequence[Cycle],
) -> np.ndarray:
    """Where f leads from both sides of each unstable direction of a saddle: attractors, cycles, or -1."""
    values, vectors = np.linalg.eig(dynamics.jacobian(saddle.position[None])[0])
    width = box[:, 1] - box[:, 0]
    starts = []
    for vector in vectors[:, values.real > 0].T:
        direction = vector.real / np.abs(vector.real / width).max()
        starts += [saddle.position + 1e-3 * direction, saddle.position - 1e-3 * direction]
    return ends_of(dynamics, np.array(starts), attractors, cycles, box=box)


def ends_of(
    dynamics: Dynamics,
    starts: np.ndarray,
    attractors: Sequence[Equilibrium],
    cycles: Sequence[Cycle],
    *,
    box: np.ndarray,
) -> np.ndarray:
    """Where f leads from some states: the number of an attractor, or of a cycle after these; -1 elsewhere."""
    ways = follow(dynamics, starts, attractors, box=box, states=2, cycles=cycles, patience=dynamics.dimension)
    near = settled_on(ways.paths[:, -1], cycles, box=box)
    return np.where((ways.ends < 0) & ~ways.escaped & (near >= 0), len(attractors) + near, ways.ends)
