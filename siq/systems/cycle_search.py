"""Which cycles has a system: stable ones, as trajectories end on them, and unstable ones, which part basins?

Stable cycles are where trajectories end that come to rest nowhere. In two states unstable cycles are where
they come from: the same, backwards in time. In more states a cycle that parts two basins attracts along
their boundary, and is found by tracking that (`siq.systems.basins`).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.integrate import solve_ivp

from siq.errors import NumericalFailure
from siq.systems.basins import Descents, apart_of, bisected, ends_of, follow, recurrence_of, settled_on
from siq.systems.cycles import PARTS, Cycle, closed_orbit
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import Equilibrium, classify, spread_evenly

TRIES = 12  # trajectories of a domain that are asked for their cycle: there are rarely more cycles than a few
BACKWARDS = 256  # states of the domain that are followed backwards
SAME = 1e-3  # of the domain: closer cycles are one
MOST_PAIRS = 6  # of attractors, between which a boundary is tracked in three states and more
ROUNDS = 40  # of tracking a boundary
QUIET_ROUNDS = 4  # before a cycle is looked for on it
RETURNED = 0.05  # of the domain: a state on the boundary that has come back, as a guess for Newton's method


def cycles_reached(
    dynamics: Dynamics, descents: Descents, *, first: int, box: np.ndarray, rate: float
) -> tuple[tuple[Cycle, ...], Descents]:
    """Stable cycles on which descents end, and the descents with the numbers of these.

    Parameters
    ----------
    dynamics
        f.
    descents
        Of which some have come to rest nowhere.
    first
        The number of the first cycle: that of the attractors.
    box
        Shape ``(d, 2)``: the domain.
    rate
        At which f crosses it.
    """
    ends, last, asked = descents.ends.copy(), descents.paths[:, -1], np.zeros(len(descents.ends), dtype=bool)
    cycles: list[Cycle] = []
    for _ in range(TRIES):
        left = np.flatnonzero((ends < 0) & ~descents.escaped)
        if asked[left].all():
            break
        one = left[~asked[left]][0]
        asked[one] = True
        found = recurrence_of(dynamics, last[one][None], box=box, rate=rate)
        if found.place is None:
            continue
        try:
            index = _place_among(cycles, _orbit(dynamics, found.place, found.period, box), box)
        except NumericalFailure:
            continue
        near = settled_on(last[left], cycles, box=box)
        ends[left[near >= 0]] = first + near[near >= 0]
        ends[one] = first + index
    return tuple(cycles), replace(descents, ends=ends)


def _orbit(dynamics: Dynamics, place: np.ndarray, period: float, box: np.ndarray) -> Cycle:
    width = np.ptp(box, axis=1)
    times = np.linspace(0, period, PARTS, endpoint=False)
    way = solve_ivp(
        lambda _, y: dynamics.drift((y * width)[None])[0] / width, (0.0, period), place / width,
        method="DOP853", rtol=1e-9, atol=1e-11, t_eval=times,
    )  # fmt: skip
    if not way.success:
        raise NumericalFailure("f cannot be followed around the cycle")
    return closed_orbit(dynamics, way.y.T * width, period, scale=width)


def _place_among(cycles: list[Cycle], new: Cycle, box: np.ndarray) -> int:
    """The place of a cycle among those that are known; it is added where it is not known yet."""
    width = np.ptp(box, axis=1)
    for index, one in enumerate(cycles):
        if one.distances(new.points[:1], scale=width)[0] < SAME:
            return index
    cycles.append(new)
    return len(cycles) - 1


def cycles_left(
    dynamics: Dynamics, equilibria: Sequence[Equilibrium], *, box: np.ndarray, generator: np.random.Generator
) -> tuple[Cycle, ...]:
    """Cycles of two states that are left on both sides: stable ones of the same equations backwards in time.

    Parameters
    ----------
    dynamics
        f.
    equilibria
        All of the domain.
    box
        Shape ``(2, 2)``: the domain.
    generator
        Scrambles the states that are followed backwards.
    """
    backwards = Dynamics.of(dynamics.symbols, [-one for one in dynamics.formulas])
    sources = [classify(backwards, one.position) for one in equilibria if one.kind == "repeller"]
    starts = spread_evenly(box, BACKWARDS, generator=generator)
    width = np.ptp(box, axis=1)
    rate = float(np.median(np.linalg.norm(dynamics.drift(starts) / width, axis=1)))
    try:
        with np.errstate(all="ignore"):
            ways = follow(backwards, starts, sources, box=box)
            found, _ = cycles_reached(backwards, ways, first=len(sources), box=box, rate=rate)
    except NumericalFailure:
        return ()
    inside = [one for one in found if ((one.points > box[:, 0]) & (one.points < box[:, 1])).all()]
    return tuple(closed_orbit(dynamics, one.points[::-1], one.period, scale=width) for one in inside)


def cycles_between(
    dynamics: Dynamics,
    attractors: Sequence[Equilibrium],
    cycles: Sequence[Cycle],
    *,
    box: np.ndarray,
    generator: np.random.Generator,
) -> tuple[Cycle, ...]:
    """Cycles with one unstable direction on the boundaries of basins, where a cycle is on one side of them.

    Parameters
    ----------
    dynamics
        f.
    attractors, cycles
        What is stable.
    box
        Shape ``(d, 2)``: the domain.
    generator
        Bends the first ways between them.
    """

    def ends(x: np.ndarray) -> np.ndarray:
        return ends_of(dynamics, x, attractors, cycles, box=box)

    places = [*(one.position for one in attractors), *(one.position for one in cycles)]
    pairs = [pair for pair in itertools.combinations(range(len(places)), 2) if max(pair) >= len(attractors)]
    found: list[Cycle] = []
    for one, two in pairs[:MOST_PAIRS]:
        cycle = _edge_cycle(dynamics, one, (places[one], places[two]), ends, box, generator)
        if cycle is not None:
            _place_among(found, cycle, box)
    return tuple(found)


def _edge_cycle(
    dynamics: Dynamics,
    one: int,
    places: tuple[np.ndarray, np.ndarray],
    ends: Callable[[np.ndarray], np.ndarray],
    box: np.ndarray,
    generator: np.random.Generator,
) -> Cycle | None:
    """What a boundary is tracked to, if it is a cycle."""
    width = np.ptp(box, axis=1)
    pair = bisected(*places, one, ends, width=width, generator=generator)
    times, states = [0.0], [pair.mean(axis=0)]
    for number in range(ROUNDS):
        tracked = apart_of(dynamics, pair, width)
        if tracked is None:
            return None
        pair, passed, along = tracked
        times += (times[-1] + passed).tolist()
        states += list(along)
        pair = bisected(pair[0], pair[1], one, ends, width=width)
        if number >= QUIET_ROUNDS:
            cycle = _closed(dynamics, np.array(times), np.array(states), box)
            if cycle is not None and cycle.unstable == 1:
                return cycle
    return None


def _closed(dynamics: Dynamics, times: np.ndarray, states: np.ndarray, box: np.ndarray) -> Cycle | None:
    """A periodic orbit next to the last return of a trajectory; None where there is none."""
    width = np.ptp(box, axis=1)
    away = np.linalg.norm((states - states[-1]) / width, axis=1)
    gone = np.flatnonzero(away > 2 * RETURNED)
    if not len(gone):
        return None
    before = np.flatnonzero(away[: gone[-1]] < RETURNED)
    if not len(before):
        return None
    last = before[-1]  # of the latest visit, the closest state
    visit = last - np.flatnonzero(away[last::-1] > RETURNED)[:1].sum() + 1
    closest = visit + int(np.argmin(away[visit : last + 1]))
    begin, period = times[closest], float(times[-1] - times[closest])
    at = begin + np.linspace(0, period, PARTS, endpoint=False)
    guess = np.stack([np.interp(at, times, column) for column in states.T], axis=1)
    try:
        return closed_orbit(dynamics, guess, period, scale=width)
    except NumericalFailure:
        return None
