"""Basins of attraction: where trajectories end, and the saddles on the edges between basins.

Two states on either side of the boundary between two basins are bisected until they all but agree, and
followed until they have come apart; then they are bisected again. What they approach is a state on the
boundary that attracts along it: mostly a saddle with one unstable direction, at which Newton's method ends.

References
----------
J. D. Skufca, J. A. Yorke, B. Eckhardt, Phys. Rev. Lett. 96 (2006) 174101: edge tracking.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from siq.errors import NumericalFailure
from siq.numerics.integration import dormand_prince_step, next_step
from siq.numerics.randomness import representative_subset
from siq.systems.cycles import Cycle, states_on_both_sides
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import Equilibrium, classify, crossing_rate, distinct_roots, hessian_at

SLOWEST_TIMES = 200.0  # trajectories are followed for so many of the slowest relaxation times, ...
UNSETTLED_TIMES = 25.0  # ... or times to cross the box where there is no attractor
MAX_STEPS = 3000
LONGEST_STEP = 0.04  # of the recorded box: longest step
STEP_ACCURACY = 1e-7  # of the recorded box: local error of a step
SETTLED_DISTANCE = 0.02  # of the domain: so close to its cycle is what has been followed for long
CYCLE_DISTANCE = 1e-3  # of the domain: and one so close to a cycle stays with it
STEPS_PER_CHECK = 10  # steps after which trajectories are asked whether they are on a cycle, or at rest
INWARDS = 1e-6  # of the distance to the middle of the domain: beside an invariant boundary
ATTRACTOR_DISTANCE = 1e-4  # of the recorded box: trajectories so close to an attractor end there


@dataclass(frozen=True)
class Descents:
    """Trajectories of f from recorded points to where they end."""

    paths: np.ndarray  #: (n, k, d): k states along each of the n trajectories, the first being the start
    ends: np.ndarray  #: (n,): index of the attractor at which each ends, -1 where it ends at none
    escaped: np.ndarray  #: (n,): whether it left the recorded box for good


def follow(
    dynamics: Dynamics, starts: np.ndarray, attractors: Sequence[Equilibrium], *, box: np.ndarray,
    states: int = 48, patience: int = 1, cycles: Sequence[Cycle] = (),
) -> Descents:  # fmt: skip
    """Follow f from starts ``(n, d)`` to where trajectories may end.

    Parameters
    ----------
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
    width, middle = np.ptp(box, axis=1), box.mean(axis=1)
    rates = [-one.eigenvalues.real.max() for one in attractors]
    slowest = min(rates) if rates else crossing_rate(dynamics, starts, width)
    if not slowest > 0:
        raise NumericalFailure("f is zero at most of the states: nothing moves, and there is no landscape")
    horizon = patience * (SLOWEST_TIMES if rates else UNSETTLED_TIMES) / slowest
    count = len(starts)
    x, times, steps = starts.copy(), np.zeros(count), np.full(count, 0.01 / slowest)
    ends, escaped, resting = np.full(count, -1), np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    passed, whose = [starts], [np.arange(count)]
    running = np.arange(count)
    for number in range(patience * MAX_STEPS):
        speed = np.abs(dynamics.drift(x[running]) / width).max(axis=1)
        step = np.minimum(steps[running], np.minimum(0.5 / slowest, LONGEST_STEP / np.maximum(speed, 1e-300)))
        with np.errstate(over="ignore", invalid="ignore"):
            moved, error = dormand_prince_step(dynamics.drift, x[running], step)
            relative = np.abs(error / width).max(axis=1) / STEP_ACCURACY
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
            ends[on[np.abs((moved - one.position) / width).max(axis=1) < ATTRACTOR_DISTANCE]] = index
        if cycles and number % STEPS_PER_CHECK == 0:
            near = settled_on(moved, cycles, box=box, distance=CYCLE_DISTANCE)
            ends[on[near >= 0]] = len(attractors) + near[near >= 0]
        if number % STEPS_PER_CHECK == 0:
            slow = running[speed < ATTRACTOR_DISTANCE * slowest]
            for one, slope in zip(slow, dynamics.jacobian(x[slow]), strict=True):
                # Next to a stable equilibrium one step of Newton's method tells so.
                if np.isfinite(slope).all() and (np.linalg.eigvals(slope).real < 0).all():
                    ahead = np.linalg.solve(slope, dynamics.drift(x[one]))
                    resting[one] = np.abs(ahead / width).max() < ATTRACTOR_DISTANCE / 2
        running = running[~(escaped | resting)[running] & (ends[running] < 0) & (times[running] < horizon)]
        if not len(running):
            break
    order = np.argsort(np.concatenate(whose), kind="stable")
    last = np.cumsum(np.bincount(np.concatenate(whose), minlength=count)) - 1
    kept = np.round(np.linspace(np.append(0, last[:-1] + 1), last, states, axis=1)).astype(int)
    return Descents(np.concatenate(passed)[order][kept], ends, escaped)


def settled_on(
    x: np.ndarray, cycles: Sequence[Cycle], *, box: np.ndarray, distance: float = SETTLED_DISTANCE
) -> np.ndarray:
    """The first of some cycles next to which each state lies, -1 where there is none: shape ``(n,)``."""
    width, near = np.ptp(box, axis=1), np.full(len(x), -1)
    for index, one in enumerate(cycles):
        near[(near < 0) & (one.distances(x, scale=width) < distance)] = index
    return near


def sides_of(
    dynamics: Dynamics, over: Sequence[Equilibrium | Cycle], attractors: Sequence[Equilibrium], *,
    box: np.ndarray, cycles: Sequence[Cycle] = (),
) -> list[np.ndarray]:  # fmt: skip
    """Where f leads from both sides of saddles, or unstable cycles, followed together; see `_ends_of`."""
    if not over:
        return []
    places = [one if isinstance(one, Cycle) else one.position for one in over]
    pairs = [states_on_both_sides(dynamics, place, width=np.ptp(box, axis=1)) for place in places]
    starts = np.concatenate(pairs)
    ends = _ends_of(dynamics, starts, attractors, cycles, box=box)
    if (nowhere := ends < 0).any():
        # On an invariant boundary, such as that of no predators, f leads to a further saddle; beside it, on.
        inner = starts[nowhere] + INWARDS * (box.mean(axis=1) - starts[nowhere])
        ends[nowhere] = _ends_of(dynamics, inner, attractors, cycles, box=box)
    return np.split(ends, np.cumsum([len(each) for each in pairs])[:-1])


def _ends_of(
    dynamics: Dynamics, starts: np.ndarray, attractors: Sequence[Equilibrium], cycles: Sequence[Cycle], *,
    box: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Where f leads from some states: the number of an attractor, or of a cycle after these; -1 elsewhere."""
    ways = follow(dynamics, starts, attractors, box=box, states=2, cycles=cycles, patience=dynamics.dimension)
    near = settled_on(ways.paths[:, -1], cycles, box=box)
    return np.where((ways.ends < 0) & ~ways.escaped & (near >= 0), len(attractors) + near, ways.ends)


BISECTION_STATES = 16  # of a segment, whose ends are followed side by side
BISECTED_DISTANCE = 1e-7  # of the box: when two states all but agree, ...
DIVERGED_DISTANCE = 1e-3  # ... and when they have come apart
MAX_TRACKING_ROUNDS = 40
FIRST_WAY_BEND = 0.05  # of the box, by which the first way leaves the straight line: symmetry may hold it
MAX_TRACKING_STEPS = 20_000  # of integration, until two states have come apart
TRACKING_ACCURACY = 1e-9  # of the box: local error of a step
# Of the box: how far beside a root with two unstable directions saddles are sought. Enough in chains of 24
# and 50 units, coupling 2 and tilt 0.1; with a tilt of 0.03 not always.
SADDLE_OFFSETS = (0.02, 0.05, 0.1)
LEVENBERG_STEPS = 200
SADDLE_DISTANCE = 0.2  # of the box: so close to the edge a root of f has to be its saddle


def tracked_edge(
    dynamics: Dynamics, one: int, two: int, attractors: Sequence[Equilibrium],
    cycles: Sequence[Cycle] = (), *, box: np.ndarray, generator: np.random.Generator,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:  # fmt: skip
    """States on the boundary of a basin as f moves along it, from a way to another attractor on.

    `one` is the number of the basin, `two` of the other attractor; those of cycles follow on. The generator
    bends the first way between both, which symmetry may hold otherwise.

    Yields
    ------
    tuple
        Of each stretch the times that have passed since the last one ended, ``(n,)``, the states there,
        ``(n, d)``, and the state from which the next one begins, ``(d,)``; first a single state alone. It
        ends where two states do not come apart.
    """
    width = np.ptp(box, axis=1)
    share = np.linspace(0, 1, BISECTION_STATES + 2)[:, None]

    def bisected(low: np.ndarray, high: np.ndarray, bend: np.ndarray | float = 0.0) -> np.ndarray:
        """Two states on either side of the boundary that all but agree, on a bent way: ``(2, d)``."""
        way = low + share * (high - low) + np.sin(np.pi * share) * bend
        while True:
            # Where a front has to cross a chain, states are still on their way after any relaxation time.
            other = np.flatnonzero(_ends_of(dynamics, way[1:-1], attractors, cycles, box=box) != one)
            last = int(other[0]) if len(other) else len(way) - 2
            low, high = way[last], way[last + 1]
            if (np.abs(high - low) / width).max() <= BISECTED_DISTANCE:
                return np.stack([low, high])
            way = low + share * (high - low)

    places = [*(each.position for each in attractors), *(each.position for each in cycles)]
    bend = FIRST_WAY_BEND * width * generator.standard_normal(len(width))
    pair = bisected(places[one], places[two], bend)
    yield np.zeros(1), pair.mean(axis=0)[None], pair.mean(axis=0)
    while True:
        step = 1e-3 / max(float(np.abs(dynamics.drift(pair) / width).max()), 1e-300)
        now, times, middles = 0.0, [], []
        for _ in range(MAX_TRACKING_STEPS):
            with np.errstate(over="ignore", invalid="ignore"):  # a step that is too long is taken again
                moved, error = dormand_prince_step(dynamics.drift, pair, np.full(2, step))
            relative = np.abs(error / width).max(axis=1) / TRACKING_ACCURACY
            if relative.max() <= 1:
                pair, now = moved, now + step
                times.append(now)
                middles.append(pair.mean(axis=0))
                if (np.abs(pair[1] - pair[0]) / width).max() > DIVERGED_DISTANCE:
                    break
            step = float(next_step(np.full(2, step), relative).min())
        else:
            return
        pair = bisected(*pair)
        yield np.array(times), np.array(middles), pair.mean(axis=0)


def edge_saddle(
    dynamics: Dynamics, one: int, two: int, attractors: Sequence[Equilibrium], *, box: np.ndarray,
    generator: np.random.Generator,
) -> Equilibrium | None:  # fmt: skip
    """A saddle on the boundary of the basin of `one`, towards `two`; None where tracking comes to none.

    Both are numbers of attractors; the box is the domain. See `tracked_edge`, which the generator is for.
    """
    edge = tracked_edge(dynamics, one, two, attractors, box=box, generator=generator)
    for _, _, state in itertools.islice(edge, MAX_TRACKING_ROUNDS):
        if (found := _saddle_near(dynamics, state, box)) is not None:
            return found
    return None


def _saddle_near(dynamics: Dynamics, x: np.ndarray, box: np.ndarray) -> Equilibrium | None:
    """The saddle with one unstable direction beside a state of the edge; None where none is found.

    A front in a long chain may stand at every site: then the edge hardly moves, and the root next to it may
    have a second direction that is all but neutral. Along this lie the saddles on either side.
    """
    width = np.ptp(box, axis=1)

    def beside(start: np.ndarray) -> Equilibrium | None:
        """Where Newton's method comes to, or else Levenberg and Marquardt's, which may not run away."""
        roots = distinct_roots(dynamics, start[None], box=box, margin=0.0)
        if not roots:
            with np.errstate(all="ignore"):  # a step to where f is beyond all numbers is taken back
                solved = scipy.optimize.root(
                    lambda share: dynamics.drift((share * width)[None])[0] / width, start / width,
                    jac=lambda share: dynamics.jacobian((share * width)[None])[0] * width / width[:, None],
                    method="lm", options={"xtol": 1e-12, "ftol": 1e-12, "maxiter": LEVENBERG_STEPS},
                )  # fmt: skip
            roots = distinct_roots(dynamics, (solved.x * width)[None], box=box, margin=0.0)
        for place in roots:
            if (np.abs(place - x) / width).max() < SADDLE_DISTANCE:
                return classify(dynamics, place)
        return None

    one = beside(x)
    if one is None or one.unstable == 1:
        return one if one is not None and one.kind == "saddle" else None
    values, vectors = np.linalg.eig(dynamics.jacobian(one.position[None])[0] * width / width[:, None])
    along = vectors[:, np.argmin(np.where(values.real > 0, values.real, np.inf))].real
    along *= width / np.abs(along).max()
    for size, sign in itertools.product(SADDLE_OFFSETS, (1, -1)):
        other = beside(one.position + sign * size * along)
        if other is not None and other.kind == "saddle" and other.unstable == 1:
            return other
    return None


STARTS_NEAR_ATTRACTOR = 600  # descents from close to it, where recordings leave directions out
BASIN_POINTS = 6000  # chosen in a basin, about: as many as a fit of V takes


@dataclass(frozen=True)
class Basin:
    """Points along descents to one attractor; what follows each point on its way is known.

    The first descents start evenly over the region, others close to the attractor.
    """

    states: np.ndarray  #: (n, k, d): descents that end at the attractor
    chosen: np.ndarray  #: (s, 2): descent and place of evenly spread points among them
    spread: int | None = None  #: how many start evenly over the region; None for all

    def starts(self, values: np.ndarray) -> np.ndarray:
        """Of values along descents, ``(n, k)``, those at the starts that are evenly spread."""
        return np.asarray(values[: self.spread, 0])

    def below(self, values: np.ndarray, level: float) -> np.ndarray:
        """Rows of `chosen` from which the way down stays below a level of V, along descents ``(n, k)``."""
        return np.flatnonzero(self.highest(values)[self.chosen[:, 0], self.chosen[:, 1]] < level)

    @staticmethod
    def highest(values: np.ndarray) -> np.ndarray:
        """The highest of the values from each place of a descent on, ``(n, k)`` to ``(n, k)``."""
        return np.maximum.accumulate(values[:, ::-1], axis=1)[:, ::-1]

    def points(self, rows: np.ndarray) -> np.ndarray:
        """The states of some rows of `chosen`."""
        return self.states[self.chosen[rows, 0], self.chosen[rows, 1]]

    def enlarged(self, further: np.ndarray, center: np.ndarray, *, generator: np.random.Generator) -> Basin:
        """The basin with further descents, ``(n, k, d)``, to its attractor, which begin at any states."""
        if not len(further):
            return self
        # Points lie about as dense as before, also where the new ones are.
        width = np.ptp(further.reshape(-1, further.shape[2]), axis=0)
        added = _chosen(further, center, width, generator) + np.array([len(self.states), 0])
        spread = len(self.states) if self.spread is None else self.spread
        return Basin(np.concatenate([self.states, further]), np.concatenate([self.chosen, added]), spread)


def basin_of(
    dynamics: Dynamics, descents: Descents, index: int, attractors: Sequence[Equilibrium], *,
    box: np.ndarray, generator: np.random.Generator, near: tuple[int, float] | None = None,
) -> Basin:  # fmt: skip
    """The points from which f leads to an attractor.

    Parameters
    ----------
    dynamics
        f and D.
    descents
        From recorded points.
    index, attractors
        Which of the attractors.
    box
        Shape ``(d, 2)``: the recorded region.
    generator
        Draws further starts close to the attractor.
    near
        How many of these, and up to which level of ``½ (x - A)·M (x - A)``; by default as recordings need it.
    """
    center, width, d = attractors[index].position, np.ptp(box, axis=1), len(box)
    recorded = descents.paths[descents.ends == index]
    # Recordings approach an attractor along its slow directions; V needs all of them. Of one state there is
    # but one, and more starts close by would only make light of those far out.
    hessian = hessian_at(dynamics, center)
    offsets = recorded[:, 0] - center
    if near is None:
        reach = np.quantile(np.einsum("ni,ij,nj->n", offsets, hessian, offsets), 0.3)
        count = STARTS_NEAR_ATTRACTOR if d > 1 else 0
    else:
        reach, count = 2 * near[1], near[0]
        # A well may be small in its domain.
        width = np.minimum(width, 2 * np.sqrt(reach * np.diag(np.linalg.inv(hessian))))
    directions = generator.standard_normal((count, d))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = np.sqrt(reach) * generator.uniform(0.02, 1.0, (count, 1))
    starts = center + (radii * directions) @ np.linalg.inv(np.linalg.cholesky(hessian))
    starts = starts[((starts > box[:, 0]) & (starts < box[:, 1])).all(axis=1)]
    close = follow(dynamics, starts, attractors, box=box)
    states = np.concatenate([recorded, close.paths[close.ends == index]])
    return Basin(states, _chosen(states, center, width, generator), None if near is None else len(recorded))


def _chosen(
    states: np.ndarray, center: np.ndarray, width: np.ndarray, generator: np.random.Generator
) -> np.ndarray:
    """Descent and place of points of descents, evenly spread, and denser towards the attractor."""
    d = states.shape[2]
    flat = (states.reshape(-1, d) - center) / width
    warped = flat / np.sqrt(np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-6))
    rows = representative_subset(warped, distance=0.6 * BASIN_POINTS ** (-1 / d), generator=generator)
    return np.stack(np.divmod(rows, states.shape[1]), axis=1)
