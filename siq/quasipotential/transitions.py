"""Transitions between attractors: barriers with their uncertainty, paths, and mean escape times.

A barrier of U is what the formula of V says of the path of least action, from the attractor to where the
formula is believed for the last time, and the action of the path from there to the saddle, where formulas
are at their worst. The action of the whole path, which knows no formula, stands beside it.

A change of f by coefficients c, and one of D, change the action by

    ∂U/∂c = -2 ∫ p·∂f/∂c dt,    ∂U/∂D = -2 ∫ p·∂D p dt

along the path, on which it is least. Where the terms of f are in doubt, the mean over alternative terms moves
the barrier (`siq.inference.selection`).

What no function of the library is shows where it matters, along the path. There ``ΔU/ε`` follows from f and
D, and without formulas from mean and spread of the steps that samples about the path make. If the formulas
are of their libraries both are right, and the variance of their difference is that of the second less that of
the first (Hausman, Econometrica 46 (1978) 1251).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy import special
from scipy.interpolate import CubicSpline, interp1d
from scipy.spatial import cKDTree

from siq.data.recordings import SnapshotPairs
from siq.errors import NumericalFailure
from siq.inference.diffusion_model import defined_states, process_noise_increments
from siq.inference.field_estimate import AnyField, FieldEstimate, dynamics_of
from siq.inference.regression import residuals
from siq.inference.selection import triangle_of
from siq.numerics.integration import Rates, dormand_prince_step, next_step
from siq.numerics.randomness import positive
from siq.quasipotential.characteristics import norm
from siq.quasipotential.path_chains import LevelSet, LimitSet, MinimumActionPath, PathProblem, Tube
from siq.quasipotential.paths import descent, transition_path
from siq.quasipotential.rates import EscapeRate, escape_rate, prefactor_error
from siq.quasipotential.wells import Well
from siq.remarks import Remark, sentence
from siq.systems.basins import sides_of
from siq.systems.cycles import Cycle
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import Equilibrium, hessian_at, measure_at
from siq.systems.phase_portrait import PhasePortrait

logger = logging.getLogger(__name__)

NOTEWORTHY_CHANGE = 0.5  # of its standard error, by which alternative terms move a barrier (a choice)
NOTEWORTHY_DIFFERENCE = 0.02  # share of a barrier by which formula and path may differ without a remark
MOST_STATES_OF_BENT_GUESSES = 8  # up to which first guesses of a path bend to all sides
GUESS_POINTS = 200  # of one that is a way down taken backwards
FAN = 64  # trajectories at different phases
FAN_LEVEL = 1e-6  # of the action, where they begin
MEETING = 0.25  # of the action: W on the curve on which trajectories from both ends meet
COUNTED = 1.0  # of the action: what costs so much more than the best phase does not count
SAME_WAY = 0.01  # of the action: of the chain and of trajectories
FAN_ACCURACY, MOST_FAN_STEPS = 1e-8, 5_000  # numerical: of one step, in units of the problem; a guard
FAN_SPENT = 0.01  # of its largest momentum: below, a trajectory goes where f leads
FAN_REACH = 6.0  # in units of the distance of both ends: what is so far away does not come back
FIRST_STEP, ARRIVAL_STEPS, SHIFT = 1e-3, 8, 1e-6  # numerical, in units of the shortest time
PATH_TOLERANCE = 1e-5  # of the action; prefactors follow the end of the path and need more than barriers
WAY_PARTS = 20, 10, 5  # numerical: of a path, as many as have samples enough
FEWEST_IN_PART = 6  # samples, by which 1/χ² has a variance
# Of the length of a path, in units of the noise: samples so near are about it. A choice, made on one f that
# is no polynomial: half of it was less exact, and twice of it smoothed too much.
TUBE_RADIUS = 0.2
WAY_PLACES = 1401  # numerical: of a path and its extensions
# How far off ΔU/ε is expected of an f of another shape: half, one or two factors e in times, or half of it
# where that is less (a choice).
MISSED_SCALES, MISSED_WORK, MISSED_SHARE = (0.5, 1.0, 2.0), 1.0, 0.5
ONE_DIRECTION = 0.01  # of the largest variance: ways of which f of its library moves only both are one


@dataclass(frozen=True)
class Transition:
    """The way out of one well over one saddle."""

    #: Indices of the attractors, `end` None where the saddle leads back, or out of the recorded region; and
    #: the first itself if it is a cycle
    start: int
    end: int | None
    #: The saddle, or the unstable cycle; and the path of least action with the way down, None where none was
    #: found
    saddle: Equilibrium | Cycle
    path: MinimumActionPath | None
    #: ΔU by the formula and the end of the path, NaN where neither is known; its standard error from that of
    #: f; and the share of it that the formula accounts for
    barrier: float = np.nan
    formula_share: float = np.nan
    standard_error: float = np.nan
    #: Law of the mean escape time at the action of the path, with the error of its prefactor; None where it
    #: fails
    rate: EscapeRate | None = None
    #: What is not known
    remarks: tuple[Remark, ...] = ()
    #: Relative standard error of ΔU/ε from an estimated D over that of ε
    leverage: float = 1.0
    #: What other terms of f that fit nearly as well have added to the barrier, in the mean
    by_rivals: float = 0.0
    cycle: Cycle | None = None
    #: What the residual of V leaves open of the part of the barrier that the formula accounts for
    of_residual: float = 0.0
    #: Of each state, how many of its periods it has gained at the end; empty where no state is periodic
    turns: tuple[int, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """The remarks as sentences."""
        return tuple(map(sentence, self.remarks))

    @property
    def place(self) -> np.ndarray:
        """Where the path ends: at the saddle, or at a state of the unstable cycle. Shape ``(d,)``."""
        over_cycle = isinstance(self.saddle, Cycle) and self.path is not None
        return self.path.points[-1] if over_cycle and self.path else self.saddle.position

    @property
    def uphill(self) -> np.ndarray:
        """The path of least action up to the saddle, shape ``(n, d)``; empty where none was found."""
        return np.zeros((0, len(self.saddle.position))) if self.path is None else self.path.points

    @property
    def downhill(self) -> np.ndarray:
        """The way down from there without noise, shape ``(n, d)``; empty where none was found."""
        down = None if self.path is None else self.path.downhill
        return np.zeros((0, len(self.saddle.position))) if down is None else down

    @property
    def error(self) -> float:
        """Standard error of the barrier: from f, the residual of V, and how far formula and path differ."""
        apart = 0.0 if self.path is None else self.barrier - self.by_rivals - self.path.action
        return float(np.linalg.norm([self.standard_error, self.of_residual, apart]))

    @property
    def exit(self) -> EscapeRate:
        """The law at the barrier, with all errors; without a prefactor where it fails."""
        return replace(
            self.rate or EscapeRate(self.barrier, np.nan),
            barrier=self.barrier, standard_error=self.error, leverage=self.leverage,
        )  # fmt: skip


def ways_out(dynamics: Dynamics, portrait: PhasePortrait, *, beyond_region: bool = False) -> list[Transition]:
    """Every way out of every well over the saddles next to it, from f alone: without barriers and rates.

    `beyond_region` says whether a saddle behind which lies no attractor of the region is a way out, too: of a
    given f the path up to it is as good as any other. Of an identified one nothing is known beyond.
    """
    whole = portrait.cover or portrait  # on which wells of all periods have a number
    points, box, cycles = len(whole.attractors), whole.box, whole.cycles
    settled: list[np.ndarray | Cycle] = [*(one.position for one in whole.attractors), *cycles]
    at_cycle: list[Cycle | None] = [*(None for _ in range(points)), *cycles]
    homes = portrait.homes or tuple((number, ()) for number in range(len(settled)))
    ways: list[Transition] = []

    def add(start: int, over: Equilibrium | Cycle, end: int | None) -> None:
        number, away = homes[start]
        if number is None or any(away):
            return
        target, turns = (None, ()) if end is None else homes[end]
        first, last = settled[start], over if isinstance(over, Cycle) else over.position
        beyond = None if end is None else settled[end]
        kind = "unstable cycle" if isinstance(over, Cycle) else "saddle"
        remarks = () if end is not None else (Remark("quasipotential.leads_out", {"over": kind}),)
        about_points = all(isinstance(one, np.ndarray) for one in (first, last, beyond))
        guesses, path = None, None
        try:
            if about_points and dynamics.dimension > MOST_STATES_OF_BENT_GUESSES:
                assert isinstance(first, np.ndarray) and isinstance(last, np.ndarray)
                # The way down taken backwards, and the straight line.
                guesses = [descent(dynamics, last, first, GUESS_POINTS)[::-1], np.stack([first, last])]
            path = transition_path(
                dynamics, first, last, beyond, box=box, tolerance=PATH_TOLERANCE, initial=guesses
            )
        except NumericalFailure as error:
            remarks = (Remark("quasipotential.no_path", {"reason": str(error)}),)
        ways.append(
            Transition(number, target, over, path, remarks=remarks, turns=turns, cycle=at_cycle[start])
        )

    sides = partial(sides_of, dynamics, attractors=whole.attractors, box=box, cycles=cycles)
    for cycle, away_from in zip(whole.parting, sides(whole.parting), strict=True):
        ends = away_from.tolist()
        for start, beyond in (ends, ends[::-1]) if ends[0] != ends[1] else ():
            if start >= 0:
                add(start, cycle, None if beyond < 0 else beyond)
    for index, (number, away) in enumerate(homes):
        if number is None or any(away):
            continue
        for saddle, reached in zip(whole.saddles[index], sides(whole.saddles[index]), strict=True):
            end = min(set(reached[reached >= 0].tolist()) - {index}, default=None)
            if end is None and not beyond_region:
                remarks = (Remark("quasipotential.nothing_beyond_saddle"),)
                ways.append(Transition(number, None, saddle, None, remarks=remarks, cycle=at_cycle[index]))
            elif end is not None or not (reached == index).all():  # else it parts no wells
                add(index, saddle, end)
    return ways


def _escape_rate_over_cycle(
    dynamics: Dynamics, path: MinimumActionPath, start: LimitSet, over: Cycle
) -> EscapeRate:
    """The law of escape of two states over an unstable cycle, from a stable point or cycle.

    The density of those who come, ``C exp(-U/ε)``, and the probability ``B exp(-W/ε)`` that one who is there
    leaves make a current. Through any closed curve about the unstable cycle it is

        1/E[τ] = ∮ C B |dx × ẋ| exp(-(U + W)/ε).

    U and C follow from trajectories of Hamilton's equations that leave the start at all phases, W and B from
    such as end on the unstable cycle, which are followed back. With J for the area between neighbours per
    phase and time, and ``e = ½∫ ∇·f + 2 (∇·D)·p dt``, ``C √J exp(e)`` and ``B √J exp(-e)`` are constant along
    them. About a stable cycle C is that of `siq.quasipotential.path_chains.Tube.density`; close to the
    unstable one B is ``½ √(ε/πW)``, as of an error function. The curve is a level of W.

    Where all phases are as good, as on circles, U + W is constant, and K goes as ε^½ from a point, and as ε⁰
    from a cycle; where one is best by far, Laplace's method makes ε⁰ and ε^(-½) of that. The integral is
    taken as a whole, and holds in between. At which phase the unstable cycle is crossed depends on ln ε
    periodically; the rate, a sum over all phases, does not to this order. It is a `NumericalFailure` where
    trajectories next to the best one do not meet, as beyond a caustic.

    J. Lehmann, P. Reimann, P. Hänggi, Phys. Rev. Lett. 84 (2000) 1639: one state that is driven. R. S. Maier,
    D. L. Stein, Phys. Rev. Lett. 77 (1996) 4860: the current on the unstable cycle itself. N. Berglund,
    B. Gentz, SIAM J. Math. Anal. 46 (2014) 310: at which phase it is crossed.
    """
    if dynamics.dimension != 2:
        raise NumericalFailure("the law of ways over an unstable cycle is known for two states only")
    problem = PathProblem(dynamics, start, over)
    first, last = problem.begin, problem.finish
    if first is None or last is None:
        raise NumericalFailure("a way over an unstable cycle has to begin at an attractor")
    height, every = path.action / problem.unit, np.arange(float(FAN))
    level, met = FAN_LEVEL * height, MEETING * height
    inwards = _side(last, first.closest(np.zeros((1, 2)))[0])
    outwards = _side(first, last.curve(np.zeros(1))[0]) if isinstance(first, Tube) else 1.0
    z, areas, done = _fan(problem, last, inwards, every, level, -1.0, lambda z: met - z[:, 8])
    if not done.all():
        raise NumericalFailure("paths that end on the unstable cycle meet a caustic next to it")
    curve = Tube(z[:, :2], np.zeros((FAN, 2, 2)), 1.0)
    likely = np.log(areas[0] / areas[1] / (4 * np.pi * level)) / 2 + z[:, 9]
    likely = CubicSpline(np.arange(FAN + 1), np.append(likely, likely[0]), bc_type="periodic")

    def short_of(z: np.ndarray) -> np.ndarray:
        """Distance from the curve where the two meet, negative beyond it."""
        place = curve.place(z[:, :2])
        along = curve.curve(place, 1)
        away = _cross(along, z[:, :2] - curve.curve(place))
        return np.asarray(inwards * away / np.linalg.norm(along, axis=1))

    def through(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """U + W and the current per phase, of paths that leave at places."""
        z, areas, done = _fan(problem, first, outwards, places, level, 1.0, short_of)
        if isinstance(first, Tube):
            on = places * (first.count / FAN)
            dense = first.density(on, problem.force(first.curve(on))) / np.sqrt(np.pi)
        else:
            dense = np.full(len(places), np.sqrt(np.linalg.det(first.hessian)) / np.pi)
        with np.errstate(all="ignore"):
            current = dense * np.sqrt(areas[0] * areas[1]) * np.exp(likely(curve.place(z[:, :2])) - z[:, 9])
        return np.where(done, z[:, 8] + met, np.inf), np.where(done, current, 0.0)

    costs, currents = through(every)
    close = costs < (1 + COUNTED) * height
    if not close.all():  # runs of phases that count, each resolved by as many trajectories
        begins = np.flatnonzero(close & ~np.roll(close, 1))
        lengths = [int(np.argmin(np.roll(close, -begin))) for begin in begins]
        runs = [
            (np.linspace(begin - 1, begin + length, FAN), (length + 1) / (FAN - 1))
            for begin, length in zip(begins, lengths, strict=True)
        ]
        found = [(*through(places), share) for places, share in runs]
        costs = np.concatenate([np.full(1, np.inf), *(one[0] for one in found)])
        currents = np.concatenate([np.zeros(1), *(one[1] * one[2] for one in found)])
    if not abs(costs.min() / height - 1) < SAME_WAY:
        raise NumericalFailure("trajectories from the attractor do not come to the path over the cycle")
    known = currents > 0
    excess = (costs[known] - costs[known].min()) * problem.unit
    power = 0.0 if isinstance(first, Tube) else 0.5
    parts = currents[known] * problem.rate * problem.unit**power
    return EscapeRate(path.action, np.nan, power=power, phases=np.array([excess, parts]))


def _fan(
    problem: PathProblem, begin: LevelSet, side: float, places: np.ndarray, level: float, sense: float,
    short_of: Callable[[np.ndarray], np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Trajectories of Hamilton's equations from where the cost is as given, until they come somewhere.

    They begin on one side of a tube, or on an ellipse, at places that are counted from 0 to `FAN` around it,
    and run backwards in time from an unstable cycle, with the sense -1. Gives states, momenta, their changes
    from place to place, the cost, and e, shape ``(n, 10)``; the areas J at begin and end, ``(2, n)``; and
    which came there.
    """  # fmt: skip
    around = np.arange(FAN)
    if isinstance(begin, Tube):
        on = around * (begin.count / FAN)
        along = begin.curve(on, 1)
        across = side * np.stack([-along[:, 1], along[:, 0]], axis=1)
        across /= np.linalg.norm(along, axis=1)[:, None]
        steep = np.einsum("ni,nij,nj->n", across, begin.costs(on), across)[:, None]
        y, q = begin.curve(on) + np.sqrt(level / steep) * across, sense * np.sqrt(level * steep) * across
    else:
        angle = 2 * np.pi * around / FAN
        circle = np.stack([np.cos(angle), np.sin(angle)])
        y = np.sqrt(level) * np.linalg.solve(np.linalg.cholesky(begin.hessian).T, circle).T
        q = y @ begin.hessian
    ring = np.column_stack([y, q])
    ring = CubicSpline(np.arange(FAN + 1), np.vstack([ring, ring[:1]]), bc_type="periodic")
    z = np.column_stack([ring(places), ring(places, 1), np.full(len(places), level), 0 * places])

    def rates(z: np.ndarray) -> np.ndarray:
        y, q, x_moved, q_moved = z[:, :2], z[:, 2:4], z[:, 4:6, None], z[:, 6:8, None]
        turned = problem.turned(y, q)
        velocity, pull, cost = problem.velocities(y, q, turned)
        spread = turned @ x_moved + 2 * problem.noise.at(y) @ q_moved
        bent = -turned.transpose(0, 2, 1) @ q_moved - problem.bend(y, q) @ x_moved
        thins = np.trace(problem.jacobian(y), axis1=1, axis2=2) / 2
        thins += (problem.noise.divergence(y) * q).sum(axis=1)
        return sense * np.column_stack([velocity, pull, spread[:, :, 0], bent[:, :, 0], sense * cost, thins])

    def area(z: np.ndarray) -> np.ndarray:
        return _cross(rates(z)[:, :2], z[:, 4:6])

    begun, alive = area(z), np.arange(len(z))
    strength = np.asarray(norm(z[:, 2:4]))
    done, steps = np.zeros(len(z), dtype=bool), np.full(len(z), FIRST_STEP)
    for _ in range(MOST_FAN_STEPS):
        with np.errstate(all="ignore"):
            last, step = z[alive], steps[alive]
            moved, error = dormand_prince_step(rates, last, step)
            relative = np.abs(error[:, :4]).max(axis=1) / FAN_ACCURACY
        steps[alive] = next_step(step, relative)
        taken = np.isfinite(moved).all(axis=1) & (relative <= 1)
        z[alive[taken]] = moved[taken]
        arrived = np.flatnonzero(taken)[short_of(moved[taken]) <= 0]
        if len(arrived):
            z[alive[arrived]] = _arrived(rates, last[arrived], step[arrived], short_of)
            done[alive[arrived]] = True
        crossed = area(z[alive]) * begun[alive] <= 0  # a caustic
        away = norm(z[alive, :2]) > FAN_REACH
        strength[alive] = np.maximum(strength[alive], norm(z[alive, 2:4]))
        spent = norm(z[alive, 2:4]) < FAN_SPENT * strength[alive]
        dear = z[alive, 8] > (1 + COUNTED) * level / FAN_LEVEL
        alive = alive[~(done[alive] | crossed | away | spent | dear)]
        if not len(alive):
            break
    with np.errstate(all="ignore"):
        return z, np.abs(np.stack([begun, area(z)])), done


def _arrived(
    rates: Rates, last: np.ndarray, step: np.ndarray, short_of: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """States at which trajectories arrive within a step, by Newton's method between bounds."""
    low, high = np.zeros(len(step)), step.copy()
    for _ in range(ARRIVAL_STEPS):
        z, _ = dormand_prince_step(rates, last, step)
        left = short_of(z)
        low, high = np.where(left > 0, step, low), np.where(left > 0, high, step)
        ahead = (short_of(z + SHIFT * rates(z)) - left) / SHIFT
        with np.errstate(all="ignore"):
            step = step - left / ahead
        step = np.where((step >= low) & (step <= high), step, (low + high) / 2)
    return z


def _cross(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    return np.asarray(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])


def _side(tube: Tube, point: np.ndarray) -> float:
    """1 if a point lies on the side of a cycle to the left of the motion, -1 to the right."""
    ring = tube.curve(np.arange(tube.count + 1))
    angle = np.unwrap(np.arctan2(*(ring - point).T[::-1]))
    turn = float(np.sign(_cross(ring[:-1] - ring[0], ring[1:] - ring[0]).sum()))
    return turn if abs(angle[-1] - angle[0]) > np.pi else -turn


def missing_diffusion(dynamics: Dynamics) -> str | None:
    """Why there are no escape times for want of D, in words; None where nothing speaks against them.

    No noise drives ``dx/dt = v``, where one state is but the derivative of another; a D that is the unit
    matrix says that it does, and mostly by default.
    """
    defined = defined_states(dynamics)
    noise = dynamics.diffusion
    if not defined or not noise.constant or not np.array_equal(noise.matrix, np.eye(dynamics.dimension)):
        return None
    return (
        f"the equation of {', '.join(defined)} is of the form dx/dt = v, which no noise drives, and D is the"
        " unit matrix: escape times follow from D, so give the D of this system"
    )


def transitions(
    found: AnyField, ways: Sequence[Transition], wells: Sequence[Well | None]
) -> list[Transition]:
    """Ways out with their barriers and escape times.

    `wells` are the formulas about each attractor, cycles after points; None where there is none.
    """
    found_ways, dynamics = [], dynamics_of(found)
    for way in ways:
        path, well = way.path, wells[way.start]
        if path is None:
            found_ways.append(way)
            continue
        remarks, rate = list(way.remarks), None
        if not path.converged:
            remarks.append(Remark("quasipotential.path_not_converged"))
        try:
            if (missing := missing_diffusion(dynamics)) is not None:
                raise NumericalFailure(missing)
            if isinstance(way.saddle, Cycle):
                begin = path.points[0] if way.cycle is None else way.cycle
                rate = _escape_rate_over_cycle(dynamics, path, begin, way.saddle)
            else:
                rate = escape_rate(dynamics, path, beyond=way.end is not None, cycle=way.cycle)
            remarks += rate.remarks
            error, covariance = prefactor_error(found, path)
            rate = replace(rate, prefactor_error=error, covariance=covariance)
            back = [w.path.action for w in ways if w.path and (w.start, w.end) == (way.end, way.start)]
            if rate.unknown == 1 and back:  # from a shallow state behind: the law errs as ε over its depth
                rate = replace(rate, unknown=float(np.hypot(1.0, path.action / min(back))))
        except (NumericalFailure, np.linalg.LinAlgError) as failure:
            remarks.append(Remark("quasipotential.no_escape_time", {"reason": str(failure)}))
        barrier, share = path.action, 0.0
        if well is not None:
            barrier, share = _barrier_by_formula(path, well)
            if abs(barrier / path.action - 1) > NOTEWORTHY_DIFFERENCE:
                remarks.append(Remark("quasipotential.formula_differs_from_path"))
            if isinstance(found, Dynamics) and path.converged:  # nothing about f is to be averaged
                barrier, share = path.action, 0.0
        logger.info("barrier of U from attractor %d: %.5g, %.5g by the path", way.start, barrier, path.action)
        spread, by_rivals = _barrier_uncertainty(path, found)
        if abs(by_rivals) > NOTEWORTHY_CHANGE * spread:
            remarks.append(Remark("quasipotential.barrier_by_alternative_terms", {"change": by_rivals}))
        found_ways.append(
            replace(
                way, barrier=barrier + by_rivals, formula_share=share, standard_error=spread, rate=rate,
                remarks=tuple({str(one): one for one in remarks}.values()), by_rivals=by_rivals,
                leverage=_noise_leverage(path, dynamics),
            )
        )  # fmt: skip
    return found_ways


def _barrier_by_formula(path: MinimumActionPath, well: Well) -> tuple[float, float]:
    """The barrier of U by a formula and the end of the path, and the share that the formula accounts for."""
    formula = 2 * well.known_values(path.points)
    known = np.flatnonzero(np.isfinite(formula))
    if not len(known):
        return float(path.action), 0.0
    barrier = formula[known[-1]] + path.action - path.values[known[-1]]
    return float(barrier), float(formula[known[-1]] / barrier)


def _barrier_uncertainty(path: MinimumActionPath, found: AnyField) -> tuple[float, float]:
    """Standard error of a barrier of U from that of f, to first order, and what alternative terms add."""
    if isinstance(found, Dynamics):
        return 0.0, 0.0
    middle, force, spent = _pieces(path, found.dynamics)
    slope = -2 * np.einsum("n,nq,nd->qd", spent, found.library.evaluate(middle), force)
    variance, by_rivals = float(found.variance(slope, of_mean=True)), float(found.bias(slope))
    if found.noise is not None:
        slope = -2 * (spent[:, None] * found.noise.push_slopes(middle, force)).sum(axis=0) / found.intensity
        variance += float(slope @ found.noise.covariance @ slope)
    return float(np.sqrt(max(variance, 0.0))), by_rivals


def with_work_of_samples(
    found: FieldEstimate, pairs: SnapshotPairs, paths: Sequence[MinimumActionPath]
) -> tuple[FieldEstimate, float]:
    """An f with what samples tell of ΔU/ε along paths of least action, without a formula of f.

    That f has a shape that its library has not, and ΔU/ε is off by one of `MISSED_SCALES`, is as likely as
    not beforehand. What follows from f is moved, and less certain, as likely as samples leave it.

    Parameters
    ----------
    found
        Identified from `pairs`, with noise that drives every state; of no angles.
    pairs
        Of samples of all states; of noisy ones as a filter knows them.
    paths
        From attractors up to saddles; those with few samples about them are passed over.

    Returns
    -------
    found, chance
        f, and the probability of differences as large, were it of its library: 1 without a path that is seen.
    """
    library, diffusion, (components, terms) = found.library, found.diffusion, found.support.T
    rest = process_noise_increments(found, pairs, residuals(found, pairs))
    whitening = diffusion.whitening_at(found.on_the_way(pairs))
    noise = np.einsum("nij,nj->ni", whitening, rest)
    intensity = float((noise**2).mean())
    seen = [one for path in paths if (one := _work_of_samples(found, pairs, noise, intensity, path))]
    if not seen:
        return found, 1.0
    levers, slopes, by_noise, heights = zip(*seen, strict=True)
    # R of the design, the levers and the noise: its last rows are of what the design leaves of the latter.
    functions = library.evaluate(pairs.x0)[:, terms] * np.sqrt(pairs.h)[:, None]
    design = (whitening[:, :, components] * functions[:, None, :]).reshape(-1, len(terms))
    goals = np.stack([*levers, noise / intensity], axis=2) * np.sqrt(intensity)
    left = triangle_of(design, goals.reshape(len(design), -1))[len(terms) :, len(terms) :]
    own, m = left[:, :-1], len(seen)
    slope, (moved, variances) = np.stack(slopes), np.transpose(by_noise)
    difference = own.T @ left[:, -1] + moved
    covariance = (own.T @ own + np.diag(variances)) * pairs.copies
    scales = np.outer((0.0, *MISSED_SCALES), np.minimum(MISSED_WORK, MISSED_SHARE * np.array(heights)))
    wide = covariance + np.einsum("ki,ij->kij", scales**2, np.eye(m))
    shares = covariance @ np.linalg.inv(wide)
    squares = np.einsum("i,kij,j->k", difference, np.linalg.inv(wide), difference)
    prior = np.append(1.0, np.full(len(MISSED_SCALES), 1 / len(MISSED_SCALES)))
    odds = special.softmax(np.log(prior) - (squares + np.linalg.slogdet(wide)[1]) / 2)
    # What an f of another shape does is done by those coefficients of this one that are known the least.
    bias, spread = found.alternatives or (0 * found.coefficients, np.zeros((0, *found.coefficients.shape)))
    moves = difference - shares @ difference - (scales > 0) * found.bias(slope)
    change = odds @ moves
    uncertain = np.einsum("k,kij->ij", odds, covariance - shares @ covariance)
    uncertain += (moves.T * odds) @ moves - np.outer(change, change)
    own_slope = slope[:, terms, components]
    reach = found.covariance @ own_slope.T
    per_work = reach @ np.linalg.pinv(own_slope @ reach, rcond=ONE_DIRECTION, hermitian=True)
    sizes, directions = np.linalg.eigh(uncertain)
    changes = np.zeros((1 + m, *bias.shape))
    changes[0, terms, components] = per_work @ change
    changes[1:, terms, components] = (per_work @ directions * np.sqrt(np.maximum(sizes, 0.0))).T
    average = (bias + changes[0], np.concatenate([spread, changes[1:]]))
    return replace(found, alternatives=average), float(special.chdtrc(m, squares[0]))


def _work_of_samples(
    found: FieldEstimate, pairs: SnapshotPairs, noise: np.ndarray, intensity: float, path: MinimumActionPath
) -> tuple[np.ndarray, np.ndarray, tuple[float, float], float] | None:
    """How ΔU/ε along a path hangs on the noise ``(n, d)`` of steps, in units of √D; None where few are seen.

    The derivatives by that noise ``(n, d)`` and by the coefficients of f ``(q, d)``; what the spread of the
    steps makes of it by itself, with its variance; and ΔU/ε, as f has it.
    """
    diffusion, root_h = found.diffusion, np.sqrt(pairs.h)
    middle, force, spent = _pieces(path, found.dynamics)
    work = 2 * spent * (force * diffusion.push(middle, force)).sum(axis=1) / intensity
    force = -2 * force * spent[:, None] / intensity
    metric = np.linalg.cholesky(diffusion.precision_at(middle).mean(axis=0))
    line = path.points @ metric
    arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    places = np.linspace(-TUBE_RADIUS, 1 + TUBE_RADIUS, WAY_PLACES)
    tube = interp1d(arc / arc[-1], line, axis=0, fill_value="extrapolate")(places)
    _, nearest = cKDTree(tube).query(pairs.x0 @ metric, distance_upper_bound=TUBE_RADIUS * arc[-1])
    along = np.append(places, np.inf)[nearest]
    for parts in WAY_PARTS:
        part = np.floor(np.clip(along * parts, -1, parts)).astype(int)
        (seen,) = np.nonzero((part >= 0) & (part < parts))
        part, count = part[seen], np.bincount(part[seen], minlength=parts)
        if (count < FEWEST_IN_PART).any():
            continue
        of_part, lever = np.zeros((parts, 1 + noise.shape[1])), np.zeros_like(noise)
        pieces = np.floor((arc[1:] + arc[:-1]) / (2 * arc[-1]) * parts).astype(int)
        np.add.at(of_part, pieces, np.column_stack([work, force]))
        pull = np.einsum("nij,ni->nj", diffusion.root_at(pairs.x0[seen]), of_part[part, 1:])
        lever[seen] = pull * (root_h[seen] / np.bincount(part, pairs.h[seen])[part])[:, None]
        sizes = (pull * noise[seen]).sum(axis=1) ** 2 / (intensity * positive((pull**2).sum(axis=1)))
        # 1/χ² of n values has the mean 1/(n - 2), and of that the variance 2/(n - 4).
        moved = float(of_part[:, 0] @ ((count - 2) / positive(np.bincount(part, sizes)) - 1))
        variance = float(2 * of_part[:, 0] ** 2 @ (1 / (count - 4)))
        return lever, found.library.evaluate(middle).T @ force, (moved, variance), float(work.sum())
    return None


def _noise_leverage(path: MinimumActionPath, dynamics: Dynamics) -> float:
    """Relative standard error of ΔU/ε from an estimated εD, over that of ε, the mean of its parts.

    A change of εD changes ``ΔU/ε = 2∫p·dx/ε`` by ``-2∫ p·δ(εD)p dt/ε²``. With the covariance of a matrix that
    is estimated from n residuals of d states, and A = ∫ p pᵀ dt, that makes ``2 √(d tr (AD)²)/ΔU``: 1 where
    the path spends its action on all states alike, and √d where on one of them.
    """
    middle, force, spent = _pieces(path, dynamics)
    pushed = np.einsum("n,ni,nj->ij", spent, dynamics.diffusion.push(middle, force), force)
    total = float(np.trace(pushed))
    if not total > 0:
        return 1.0
    return float(np.sqrt(dynamics.dimension * max(np.trace(pushed @ pushed), 0.0)) / total)


def _pieces(path: MinimumActionPath, dynamics: Dynamics) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States, momenta and times of the pieces of a path."""
    middle = (path.points[1:] + path.points[:-1]) / 2
    force = (path.momenta[1:] + path.momenta[:-1]) / 2
    flow = dynamics.drift(middle) + 2 * dynamics.diffusion.push(middle, force)
    measure = measure_at(dynamics, path.points[0])
    speed, length = (
        np.sqrt(measure.squared_speed(middle, one)) for one in (flow, np.diff(path.points, axis=0))
    )
    return middle, force, np.where(speed > 0, length / np.where(speed > 0, speed, 1.0), 0.0)


def position_standard_errors(found: AnyField, position: np.ndarray) -> np.ndarray:
    """Standard errors of an equilibrium's position, shape ``(d,)``: of f = 0 follows δx = -J⁻¹ δf."""
    if isinstance(found, Dynamics):
        return np.zeros(len(position))
    try:
        moved = np.linalg.inv(found.dynamics.jacobian(position[None])[0])
    except np.linalg.LinAlgError:
        return np.full(found.library.dimension, np.nan)
    return np.sqrt(found.variance(np.einsum("k,ij->ikj", found.library.evaluate(position[None])[0], moved)))


def progress_along(
    ways: Sequence[Transition], attractor: Equilibrium | Cycle, dynamics: Dynamics, intensity: float
) -> Callable[[np.ndarray], np.ndarray]:
    """Progress of states ``(d, n)`` out of a well: U/ε at the nearest state of its paths of least action.

    Beyond a saddle it rises by one more. Over an unstable cycle it is that of the state of the path whose
    distances from there and from the attractor differ by as much, whatever the phase. A `NumericalFailure`
    where no path is known.
    """
    known = [(way.path, way.downhill) for way in ways if way.path is not None]
    if not known:
        raise NumericalFailure("no path leads out of the well, along which a simulation could be split")
    points = np.concatenate([np.concatenate([path.points, down]) for path, down in known])
    beyond = [path.action / intensity + np.linspace(0, 1, len(down)) for path, down in known]
    pairs = zip(known, beyond, strict=True)
    along = np.concatenate([np.append(path.values / intensity, last) for (path, _), last in pairs])
    lowest = min(ways, key=lambda way: way.barrier)
    if isinstance(lowest.saddle, Cycle) and lowest.path is not None:
        near, far = (
            cKDTree(each.points if isinstance(each, Cycle) else each.position[None])
            for each in (attractor, lowest.saddle)
        )
        apart = near.query(lowest.path.points)[0] - far.query(lowest.path.points)[0]
        apart, height = np.maximum.accumulate(apart), lowest.path.values / intensity
        return lambda x: np.interp(near.query(x.T)[0] - far.query(x.T)[0], apart, height)
    # Near is what the noise about the attractor makes so.
    root = np.diag(1 / np.ptp(points, axis=0))
    if isinstance(attractor, Equilibrium):
        root = np.linalg.cholesky(hessian_at(dynamics, attractor.position))
    tree = cKDTree(points @ root)
    return lambda x: np.asarray(along[tree.query(x.T @ root)[1]])
