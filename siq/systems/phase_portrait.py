"""The phase portrait: attractors, saddles, cycles and basins, from recorded states or over a domain.

Of an identified f it follows from f and the recorded states. Both routes to V start from it, and so does the
check that ends a training. Of equations it follows from states that are spread evenly over the domain, with
more of them about each attractor, as its linearisation tells how far: a well may be small in its domain.

Stable cycles are sought where trajectories end that come to rest nowhere. In two states unstable ones are
where trajectories come from. In more a cycle that separates two basins attracts along their boundary, which
is tracked.

In many states no search covers the domain. Attractors are then where f leads from states all over it, and
saddles are found between each two of them by tracking the edge of their basins (`siq.systems.basins`). There
are no basins in which V could be fitted, and what follows from paths needs none.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
from scipy.spatial import cKDTree

from siq.errors import NumericalFailure
from siq.numerics.randomness import positive, representative_subset
from siq.remarks import Remark
from siq.systems.basins import (
    Basin,
    Descents,
    basin_of,
    edge_saddle,
    follow,
    settled_on,
    sides_of,
    tracked_edge,
)
from siq.systems.cycles import PARTS, Cycle, Recurrence, closed_orbit, recurrence_of
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import (
    BOUNDARY_TOLERANCE,
    Equilibrium,
    all_equilibria,
    classify,
    crossing_rate,
    find_equilibria,
    hessian_at,
    spread_evenly,
)

UNSETTLED = 0.02  # share of the states: as many may be slow, on the ridge between two wells
NEIGHBOUR_SPACINGS = 2.5  # of the spacing of recorded states: further away nothing was recorded
SPACING = 0.04  # of each state's range: states that cover the recorded region evenly
MOST_SPREAD = 4000  # of these states
# From recorded states.
RECORDED_STARTS = 1500  # from which f is followed
NEWTON_STARTS = 400
# Over a domain.
MOST_SEARCHED = 8  # states up to which Newton's method searches the whole domain
DOMAIN_STARTS = 1024  # in one and two states, twice as many for each further one: shares of basins to 1 %
MAX_DOMAIN_STARTS = 4096
STARTS_NEAR_ATTRACTOR = 1024
LEVEL_BEYOND_SADDLE = 4.0  # of the quadratic V at the lowest saddle: V may differ from it by that
RESTING_SPEED = 1e-3  # of the rate: what is so slow outside the domain does not come back
DIRECTIONS = 64  # in which the neighbourhood of a degenerate equilibrium is asked where it leads
NEIGHBOURHOOD = 0.02  # of the domain: so far from it
MIN_DECIDED_SHARE = 0.5  # of these, that has to have led somewhere: f is slow where it is degenerate
# Cycles of a domain.
MAX_TRIED_TRAJECTORIES = 12  # asked for their cycle: there are rarely more cycles than a few
BACKWARD_STARTS = 256  # states of the domain that are followed backwards
CYCLE_MERGE_TOLERANCE = 1e-3  # of the domain: closer cycles are one
MAX_CYCLE_PAIRS = 6  # of attractors, between which a boundary is tracked in three states and more
TRACKING_ROUNDS = 40  # of tracking a boundary
ROUNDS_BEFORE_SEARCH = 4  # before a cycle is looked for on it
RETURN_RADIUS = 0.05  # of the domain: a state on the boundary that has come back, as a guess
# In many states.
INDEPENDENT_STARTS = 64  # independent in each state
DIAGONAL_STARTS = 33  # with every state at the same share of its range
EDGES_PER_PAIR = 2  # of attractors, from different first ways
MAX_PAIRS = 15  # of attractors
MERGE_TOLERANCE = 1e-6  # of the domain


@dataclass(frozen=True)
class PhasePortrait:
    """Attractors, saddles, cycles and basins of f in a region."""

    points: np.ndarray  #: (n, d): evenly spread recorded states
    box: np.ndarray  #: (d, 2): their limits
    equilibria: tuple[Equilibrium, ...]  #: all that were found
    attractors: tuple[Equilibrium, ...]  #: those that are stable and that recorded points lead to
    saddles: tuple[tuple[Equilibrium, ...], ...]  #: next to each attractor, and each cycle after these
    basins: tuple[Basin, ...]  #: for each attractor, what leads to it
    descents: Descents  #: from recorded points, to whatever end; cycles are numbered after attractors
    recurrence: Recurrence | None = None  #: where those lead that come to rest nowhere; None where few
    harmless: tuple[Equilibrium, ...] = ()  #: degenerate equilibria that take no part in the landscape
    remarks: tuple[Remark, ...] = ()  #: what is not known
    cycles: tuple[Cycle, ...] = ()  #: stable cycles that states of the domain lead to
    parting: tuple[Cycle, ...] = ()  #: unstable cycles, which part basins
    #: Share of the points from which f leads to each attractor, and each cycle after these.
    shares: np.ndarray = field(default_factory=lambda: np.zeros(0))
    #: Where states are periodic: the portrait of three periods, of which this is what lies in the middle one;
    #: and of each attractor there, and each cycle, the number here and by how many periods it is off.
    cover: PhasePortrait | None = None
    homes: tuple[tuple[int | None, tuple[int, ...]], ...] = ()

    @property
    def unsettled(self) -> float:
        """Share of the recorded points from which f leads to no attractor although it stays in reach."""
        return float(((self.descents.ends < 0) & ~self.descents.escaped).mean())

    def states_elsewhere(self, index: int) -> np.ndarray | None:
        """Recorded states from which f leads to other attractors, shape ``(m, d)``; None for none."""
        others = [one for number, one in enumerate(self.basins) if number != index]
        return np.concatenate([one.points(np.arange(len(one.chosen))) for one in others]) if others else None

    def fault(self) -> Remark | None:
        """Why this landscape has no wells; None where it has."""
        degenerate = [one for one in self.equilibria if one.kind == "degenerate" and one not in self.harmless]
        if degenerate:
            place = np.array2string(degenerate[0].position, precision=4)
            return Remark("systems.degenerate_equilibrium", {"place": place})
        alone = not (self.attractors or self.cycles)
        instead = [one for one in self.remarks if one.code in ("systems.running", "systems.absorbing")]
        if alone and instead:
            return instead[0]
        if self.unsettled <= UNSETTLED:
            return Remark("systems.no_stable_equilibrium") if alone else None
        values: dict[str, object] = {"share": None if alone else self.unsettled, "kind": None}
        if (ends := self.recurrence) is not None:
            values["kind"] = ends.kind
            values |= {"exponent": ends.exponent} if ends.kind == "chaos" else {}
            values |= {"period": ends.cycle.period} if ends.cycle else {}
        return Remark("systems.unsettled", values)


def evenly_spread(x: np.ndarray, *, generator: np.random.Generator) -> np.ndarray:
    """Rows of states that cover the recorded region evenly, about a twentieth of each state's range apart.

    One state has so many as two have, several hundred: a twentieth apart they would be too few to tell V.
    """
    width, dimension = np.ptp(x, axis=0), x.shape[1]
    rows = representative_subset(
        x / positive(width),
        distance=max(SPACING ** max(1.0, 2 / dimension), 0.5 * MOST_SPREAD ** (-1 / dimension)),
        generator=generator,
    )
    return np.sort(generator.choice(rows, MOST_SPREAD, replace=False)) if len(rows) > MOST_SPREAD else rows


def phase_portrait(dynamics: Dynamics, points: np.ndarray | None = None, *, seed: int = 0) -> PhasePortrait:
    """Find the attractors, their saddles, and what leads to them.

    Parameters
    ----------
    dynamics
        f and D; with the domain where no points are given.
    points
        Evenly spread recorded states, shape ``(n, d)``, see `evenly_spread`; by default states of the domain.
    seed
        Decides which states stand for the others.

    Raises
    ------
    ValueError
        Without points, where no domain is known, or the equations are driven.
    NumericalFailure
        When f has no value in a part of the domain, or nothing moves.
    """
    if dynamics.periodic:
        if points is not None:
            points = (dynamics.wrapped(points) + dynamics.shifts[:, None]).reshape(-1, dynamics.dimension)
        return _at_home(phase_portrait(dynamics.unwrapped(), points, seed=seed), dynamics)
    generator = np.random.default_rng(seed)
    d, recorded = dynamics.dimension, points is not None
    searched = not recorded and d <= MOST_SEARCHED  # the whole domain
    if points is not None:
        box = np.stack([points.min(axis=0), points.max(axis=0)], axis=1)
    else:
        box = dynamics.box
        count = min(DOMAIN_STARTS * 2 ** max(d - 2, 0), MAX_DOMAIN_STARTS)
        points = spread_evenly(box, count if searched else INDEPENDENT_STARTS, generator=generator)
    width = positive(np.ptp(box, axis=1))
    if not recorded and not searched:
        # Of many independent states the mean is always about the same: some have all states high, or low.
        points = np.concatenate([points, np.linspace(0, 1, DIAGONAL_STARTS)[:, None] * width + box[:, 0]])
    if searched and not np.isfinite(dynamics.drift(points)).all():
        raise NumericalFailure("f has no value in a part of the domain: choose one in which it has")
    rate = crossing_rate(dynamics, points, width)

    starts, remarks = points, list[Remark]()
    if recorded:
        few = generator.permutation(len(points))
        equilibria = tuple(find_equilibria(dynamics, points[few[:NEWTON_STARTS]]))
        starts = points[few[:RECORDED_STARTS]]
    elif searched:
        equilibria, remarks = all_equilibria(dynamics, generator=generator)
    else:
        resting = follow(dynamics, points, [], box=box, states=2).paths[:, -1]
        equilibria = tuple(find_equilibria(dynamics, resting, box=box, margin=MERGE_TOLERANCE, rate=rate))

    stable = [one for one in equilibria if one.kind == "attractor"]
    descents = follow(dynamics, starts, stable, box=box)
    if searched:  # what comes to rest outside the domain has left it
        last = descents.paths[:, -1]
        resting_there = np.linalg.norm(dynamics.drift(last) / width, axis=1) < RESTING_SPEED * rate
        outside = ((last < box[:, 0]) | (last > box[:, 1])).any(axis=1) & resting_there
        descents = replace(descents, escaped=descents.escaped | (outside & (descents.ends < 0)))
    # What noise does not move away from again, such as extinction, is no well: who comes there has left.
    absorbing = list[int]()
    for index, one in enumerate(() if recorded or dynamics.diffusion.constant else stable):
        try:
            hessian_at(dynamics, one.position)
        except NumericalFailure:
            absorbing.append(index)
    descents = replace(descents, escaped=descents.escaped | np.isin(descents.ends, absorbing))
    ended = np.unique(descents.ends)
    reached = [index for index in range(len(stable)) if index in ended and index not in absorbing]
    renumbered = np.full(len(stable) + 1, -1)
    renumbered[reached] = np.arange(len(reached))
    descents = replace(descents, ends=renumbered[descents.ends])
    attractors = [stable[index] for index in reached]

    cycles: tuple[Cycle, ...] = ()
    unstable_cycles: tuple[Cycle, ...] = ()
    if searched:
        cycles, descents = _stable_cycles(dynamics, descents, first=len(attractors), box=box, rate=rate)
        if d == 2:
            unstable_cycles = _cycles_backwards(dynamics, equilibria, box=box, generator=generator)
        elif cycles:
            unstable_cycles = _separatrix_cycles(dynamics, attractors, cycles, box=box, generator=generator)
    elif not recorded:
        saddles, further = _edge_saddles(dynamics, attractors, box, generator)
        equilibria = (*attractors, *saddles)
        remarks = [Remark("systems.domain_not_searched", {"states": len(points)}), *further]
    around: list[list[Equilibrium]] = [[] for _ in (*attractors, *cycles)]
    # Over a saddle of a domain with several unstable directions no way is lowest.
    crossed = [one for one in equilibria if one.kind == "saddle" and (one.unstable == 1 or not searched)]
    crossed = [one for one in crossed if recorded or _crossed_by_noise(dynamics, one.position, width)]
    sides = sides_of(dynamics, crossed, attractors, box=box, cycles=cycles)
    for one, ends in zip(crossed, sides, strict=True):
        for index in set(ends.tolist()) - {-1}:
            around[index].append(one)

    basins: list[Basin] = []
    for index, one in enumerate(attractors if recorded or searched else ()):
        near = None
        if searched:
            # Up to a level of ½ (x - A)·M (x - A); without a saddle, half of the basin.
            tops = np.array([each.position for each in around[index]])
            offset = (tops if len(tops) else descents.paths[descents.ends == index][:, 0]) - one.position
            heights = 0.5 * np.einsum("ni,ij,nj->n", offset, hessian_at(dynamics, one.position), offset)
            level = LEVEL_BEYOND_SADDLE * float(heights.min()) if len(tops) else float(np.median(heights))
            near = (STARTS_NEAR_ATTRACTOR if d > 1 else 0, level)
        basins.append(
            basin_of(dynamics, descents, index, attractors, box=box, generator=generator, near=near)
        )
    harmless: tuple[Equilibrium, ...] = ()
    if searched:
        harmless, further = _harmless(dynamics, equilibria, attractors, box, generator)
        remarks += further
        remarks += [
            Remark(
                "systems.attractor_left_out", {"states": len(points), "place": one.position.round(4).tolist()}
            )
            for index, one in enumerate(stable)
            if index not in (*reached, *absorbing)
        ]
    remarks += [
        Remark("systems.absorbing", {"place": stable[index].position.round(4).tolist()})
        for index in absorbing
    ]
    recurrence = None
    unsettled = np.flatnonzero((descents.ends < 0) & ~descents.escaped)
    if len(unsettled) > UNSETTLED * len(descents.ends):
        recurrence = recurrence_of(dynamics, descents.paths[unsettled, -1], box=box, rate=rate)
    return PhasePortrait(
        points, box, equilibria, tuple(attractors), tuple(map(tuple, around)), tuple(basins), descents,
        recurrence, harmless, tuple(remarks), cycles, unstable_cycles,
        np.array([float((descents.ends == index).mean()) for index in range(len(around))]),
    )  # fmt: skip


def _crossed_by_noise(dynamics: Dynamics, saddle: np.ndarray, width: np.ndarray) -> bool:
    """Whether noise leads over a saddle with one unstable direction, in a domain of a width ``(d,)``.

    With l for the left eigenvector, ``s = l·(x - saddle)`` grows as ``λs + l·noise``. If ``l·D l`` vanishes
    like s², as of populations with noise in proportion to their number, ``∫ λs/(l·D l) ds`` is infinite.
    """
    values, left, right = scipy.linalg.eig(dynamics.jacobian(saddle[None])[0], left=True)
    if dynamics.diffusion.constant or (values.real > 0).sum() != 1:
        return True
    place = int(np.argmax(values.real))
    across, along = left[:, place].real, right[:, place].real
    along = along / (across @ along)
    noise, off = dynamics.diffusion, BOUNDARY_TOLERANCE * float(np.abs(across) @ width)
    size = noise.contract(saddle[None], across[None])[0]
    slope = abs(noise.contract(saddle[None], across[None], 1)[0] @ along)
    bend = abs(along @ noise.contract(saddle[None], across[None], 2)[0] @ along)
    return not (size <= off**2 * bend < np.inf and slope <= off * bend)


def _at_home(cover: PhasePortrait, dynamics: Dynamics) -> PhasePortrait:
    """Of a portrait of three periods what lies in the middle one, in the order that it has there."""
    settled = [one.position for one in cover.attractors] + [one.points.mean(axis=0) for one in cover.cycles]
    turns = [tuple(map(int, dynamics.turns(place[None])[0])) for place in settled]
    home = [index for index, turn in enumerate(turns) if not any(turn)]
    homes, width = list[tuple[int | None, tuple[int, ...]]](), np.ptp(cover.box, axis=1)
    for place, turn in zip(settled, turns, strict=True):
        moved = place - turn * dynamics.periods
        away = [np.abs((moved - settled[index]) / width).max() for index in home]
        near = int(np.argmin(away)) if away else 0
        homes.append((near if away and away[near] < CYCLE_MERGE_TOLERANCE else None, turn))
    points = [index for index in home if index < len(cover.attractors)]
    around = [cover.saddles[index] for index in home]
    inside = [
        one
        for one in cover.equilibria
        if not dynamics.turns(one.position[None]).any() or any(one in saddles for saddles in around)
    ]
    # Other wells are elsewhere: to the descents that lead there nothing is at rest here.
    numbers = np.full(len(settled) + 1, -1)
    numbers[home] = np.arange(len(home))
    ends, starts = cover.descents.ends, cover.descents.paths[:, 0]
    begun = ~dynamics.turns(starts).any(axis=1)
    away = (numbers[ends] < 0) & ((ends >= 0) | ~begun)
    descents = replace(cover.descents, ends=numbers[ends], escaped=cover.descents.escaped | away)
    middle, last = ends[begun], cover.descents.paths[begun, -1]
    remarks, gone = list(cover.remarks), (last < cover.box[:, 0]) | (last > cover.box[:, 1])
    running = (gone & (dynamics.periods > 0)).any(axis=1) & cover.descents.escaped[begun]
    if running.mean() > UNSETTLED:
        values = {"states": list(dynamics.periodic), "share": float(running.mean())}
        remarks.append(Remark("systems.running", values))
    whose = np.array([-1 if number is None else number for number, _ in homes] + [-1])[middle]
    parting = [one for one in cover.parting if not dynamics.turns(one.points.mean(axis=0)[None]).any()]
    return replace(
        cover, equilibria=tuple(inside), attractors=tuple(cover.attractors[index] for index in points),
        saddles=tuple(around), basins=tuple(cover.basins[index] for index in points if cover.basins),
        cycles=tuple(cover.cycles[index - len(cover.attractors)] for index in home[len(points) :]),
        parting=tuple(parting), descents=descents,
        shares=np.array([float((whose == index).mean()) for index in range(len(home))]),
        cover=cover, homes=tuple(homes), remarks=tuple(remarks),
    )  # fmt: skip


def _stable_cycles(
    dynamics: Dynamics, descents: Descents, *, first: int, box: np.ndarray, rate: float
) -> tuple[tuple[Cycle, ...], Descents]:
    """Stable cycles on which descents end, and the descents with the numbers of these, from `first` on."""
    ends, last, asked = descents.ends.copy(), descents.paths[:, -1], np.zeros(len(descents.ends), dtype=bool)
    cycles: list[Cycle] = []
    for _ in range(MAX_TRIED_TRAJECTORIES):
        left = np.flatnonzero((ends < 0) & ~descents.escaped)
        if asked[left].all():
            break
        one = left[~asked[left]][0]
        asked[one] = True
        cycle = recurrence_of(dynamics, last[one][None], box=box, rate=rate).cycle
        if cycle is None:
            continue
        index = _place_among(cycles, cycle, box)
        near = settled_on(last[left], cycles, box=box)
        ends[left[near >= 0]] = first + near[near >= 0]
        ends[one] = first + index
    return tuple(cycles), replace(descents, ends=ends)


def _place_among(cycles: list[Cycle], new: Cycle, box: np.ndarray) -> int:
    """The place of a cycle among those that are known; it is added where it is not known yet."""
    width = np.ptp(box, axis=1)
    for index, one in enumerate(cycles):
        if one.distances(new.points[:1], scale=width)[0] < CYCLE_MERGE_TOLERANCE:
            return index
    cycles.append(new)
    return len(cycles) - 1


def _cycles_backwards(
    dynamics: Dynamics, equilibria: Sequence[Equilibrium], *, box: np.ndarray, generator: np.random.Generator
) -> tuple[Cycle, ...]:
    """Cycles of two states that are left on both sides: stable ones of the equations backwards in time."""
    backwards = Dynamics.of(dynamics.symbols, [-one for one in dynamics.formulas])
    sources = [classify(backwards, one.position) for one in equilibria if one.kind == "repeller"]
    starts = spread_evenly(box, BACKWARD_STARTS, generator=generator)
    width = np.ptp(box, axis=1)
    try:
        with np.errstate(all="ignore"):
            rate, ways = crossing_rate(dynamics, starts, width), follow(backwards, starts, sources, box=box)
            gone = ((ways.paths[:, -1] < box[:, 0]) | (ways.paths[:, -1] > box[:, 1])).any(axis=1)
            ways = replace(ways, escaped=ways.escaped | gone)  # what stays at a pole, say, is on no cycle
            found, _ = _stable_cycles(backwards, ways, first=len(sources), box=box, rate=rate)
    except NumericalFailure:
        return ()
    inside = [one for one in found if ((one.points > box[:, 0]) & (one.points < box[:, 1])).all()]
    return tuple(closed_orbit(dynamics, one.points[::-1], one.period, scale=width) for one in inside)


def _separatrix_cycles(
    dynamics: Dynamics, attractors: Sequence[Equilibrium], cycles: Sequence[Cycle], *, box: np.ndarray,
    generator: np.random.Generator,
) -> tuple[Cycle, ...]:  # fmt: skip
    """Cycles with one unstable direction on boundaries of basins, where a cycle is on one side of them."""
    pairs = itertools.combinations(range(len(attractors) + len(cycles)), 2)
    with_cycle = [pair for pair in pairs if max(pair) >= len(attractors)]
    found: list[Cycle] = []
    for one, two in with_cycle[:MAX_CYCLE_PAIRS]:
        edge = tracked_edge(dynamics, one, two, attractors, cycles, box=box, generator=generator)
        times, states = np.zeros(0), np.zeros((0, len(box)))
        for number, (passed, along, _) in enumerate(itertools.islice(edge, TRACKING_ROUNDS + 1)):
            times = np.append(times, times[-1:].sum() + passed)
            states = np.concatenate([states, along])
            cycle = _closed(dynamics, times, states, box) if number > ROUNDS_BEFORE_SEARCH else None
            if cycle is not None and cycle.unstable == 1:
                _place_among(found, cycle, box)
                break
    return tuple(found)


def _closed(dynamics: Dynamics, times: np.ndarray, states: np.ndarray, box: np.ndarray) -> Cycle | None:
    """A periodic orbit next to the last return of a trajectory; None where there is none."""
    width = np.ptp(box, axis=1)
    away = np.linalg.norm((states - states[-1]) / width, axis=1)
    gone = np.flatnonzero(away > 2 * RETURN_RADIUS)
    if not len(gone):
        return None
    before = np.flatnonzero(away[: gone[-1]] < RETURN_RADIUS)
    if not len(before):
        return None
    last = before[-1]  # of the latest visit, the closest state
    visit = last - np.flatnonzero(away[last::-1] > RETURN_RADIUS)[:1].sum() + 1
    closest = visit + int(np.argmin(away[visit : last + 1]))
    begin, period = times[closest], float(times[-1] - times[closest])
    at = begin + np.linspace(0, period, PARTS, endpoint=False)
    guess = np.stack([np.interp(at, times, column) for column in states.T], axis=1)
    try:
        return closed_orbit(dynamics, guess, period, scale=width)
    except NumericalFailure:
        return None


def _edge_saddles(
    dynamics: Dynamics, attractors: Sequence[Equilibrium], box: np.ndarray, generator: np.random.Generator
) -> tuple[list[Equilibrium], list[Remark]]:
    """Saddles on the edges between each two basins, and what is not known."""
    width = np.ptp(box, axis=1)
    saddles: list[Equilibrium] = []
    pairs = list(itertools.combinations(range(len(attractors)), 2))
    for (one, two), _ in itertools.product(pairs[:MAX_PAIRS], range(EDGES_PER_PAIR)):
        top = edge_saddle(dynamics, one, two, attractors, box=box, generator=generator)
        if top is not None and all(
            np.abs((top.position - other.position) / width).max() > MERGE_TOLERANCE for other in saddles
        ):
            saddles.append(top)
    remarks = []
    if len(attractors) > 1 and not saddles:
        remarks.append(Remark("systems.no_saddle_on_edges"))
    if len(pairs) > MAX_PAIRS:
        remarks.append(Remark("systems.pairs_without_edges", {"some": MAX_PAIRS, "pairs": len(pairs)}))
    return saddles, remarks


def _harmless(
    dynamics: Dynamics, equilibria: Sequence[Equilibrium], attractors: Sequence[Equilibrium], box: np.ndarray,
    generator: np.random.Generator,
) -> tuple[tuple[Equilibrium, ...], list[Remark]]:  # fmt: skip
    """Degenerate equilibria from all about which f leads to one attractor: they part no wells."""
    found, remarks, width = [], [], np.ptp(box, axis=1)
    for one in equilibria:
        if one.kind != "degenerate" or not attractors:
            continue
        directions = generator.standard_normal((DIRECTIONS, len(box)))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        starts = one.position + NEIGHBOURHOOD * width * directions
        starts = starts[((starts > box[:, 0]) & (starts < box[:, 1])).all(axis=1)]
        if not len(starts):
            continue
        ways = follow(dynamics, starts, attractors, box=box)
        creeping = (np.abs((ways.paths[:, -1] - one.position) / width) < 2 * NEIGHBOURHOOD).all(axis=1)
        ends = ways.ends[(ways.ends >= 0) | ~creeping]
        if len(ends) > MIN_DECIDED_SHARE * len(starts) and ends[0] >= 0 and (ends == ends[0]).all():
            found.append(one)
            values = {
                "place": one.position.round(4).tolist(),
                "attractor": attractors[ends[0]].position.round(4).tolist(),
            }
            remarks.append(Remark("systems.degenerate_equilibrium_without_part", values))
    return tuple(found), remarks


class RecordedRegion:
    """The neighbourhood of recorded states ``(n, d)`` that lead to one attractor.

    f leads elsewhere or nowhere from others, ``(m, d)``; distances are shares of a width ``(d,)``.
    """

    def __init__(self, states: np.ndarray, elsewhere: np.ndarray | None, width: np.ndarray) -> None:
        self._width = positive(width)
        places = states / self._width
        self._tree = cKDTree(places)
        # Of the 2d-th neighbour: states on one descent lie closer to each other than descents do.
        neighbours = min(2 * len(width) + 1, len(states))
        self._spacing = np.atleast_2d(self._tree.query(places, k=neighbours)[0])[:, -1]
        self._elsewhere = cKDTree((states[:0] if elsewhere is None else elsewhere) / self._width)

    @classmethod
    def of_basin(cls, portrait: PhasePortrait, index: int) -> RecordedRegion:
        """The region of ``portrait.attractors[index]``, in shares of the recorded box."""
        descents, others = portrait.descents, portrait.states_elsewhere(index)
        away = [descents.paths[descents.ends != index][:, 0], *([] if others is None else [others])]
        basin, box = portrait.basins[index], portrait.box
        return cls(basin.points(np.arange(len(basin.chosen))), np.concatenate(away), np.ptp(box, axis=1))

    def across(self, x: np.ndarray) -> np.ndarray:
        """Mask of points ``(n, d)`` that lie closer to states which lead elsewhere."""
        places = x / self._width
        return np.asarray(self._elsewhere.query(places)[0] < self._tree.query(places)[0])

    def recorded(self, x: np.ndarray) -> np.ndarray:
        """Mask of points ``(n, d)`` among the states that lead to the attractor."""
        places = x / self._width
        distance, nearest = self._tree.query(places)
        near = distance <= NEIGHBOUR_SPACINGS * self._spacing[nearest]
        return np.asarray(near & ~(self._elsewhere.query(places)[0] < distance))
