"""Transitions between attractors: barriers with their uncertainty, paths, and mean escape times.

A barrier of U is what the formula of V says of the path of least action, from the attractor to where the
formula is believed for the last time, and the action of the path from there to the saddle, where formulas
are at their worst. The action of the whole path, which knows no formula, stands beside it. Where the terms of
f are in doubt, the mean over rival terms moves the barrier (`siq.inference.selection`).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from siq.errors import NumericalFailure
from siq.inference.field_estimate import AnyField, GivenField, defined_states
from siq.quasipotential.paths import (
    MinimumActionPath,
    TransitionPath,
    both_sides,
    descent,
    minimum_action_path,
    transition_path,
    way_about_cycles,
)
from siq.quasipotential.rates import EscapeRate, Exit, PrefactorError, escape_rate, prefactor_error
from siq.quasipotential.wells import Well
from siq.systems.basins import leads_back, neighbours
from siq.systems.cycles import Cycle
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import Equilibrium, measure_at
from siq.systems.phase_portrait import PhasePortrait

logger = logging.getLogger(__name__)

WORTH_A_WORD = 0.5  # of its standard error, by which rival terms move a barrier (a choice)
DIFFERENT = 0.02  # share of a barrier by which two ways to it may differ without a word
FEW_STATES = 8  # up to which first guesses of a path bend to all sides
GUESSED = 200  # points of one that is a way down taken backwards
OUTWARDS = "behind the saddle f leads out of the region"
PATH_TOLERANCE = 1e-5  # of the action; prefactors follow the end of the path and need more than barriers


@dataclass(frozen=True)
class Transition:
    """The way out of one well over one saddle.

    Attributes
    ----------
    start, end
        Indices of the attractors; `end` is None where the saddle leads back, or out of the recorded region.
    saddle
        The saddle, or the unstable cycle.
    path
        The path of least action and the way down, None where none was found.
    barrier
        ΔU by the formula and the end of the path; NaN where neither is known.
    formula_share
        Share of the barrier that the formula accounts for.
    standard_error
        Of the barrier, from the uncertainty of f.
    by_rivals
        What other terms of f that fit nearly as well have added to the barrier, in the mean.
    rate
        Law of the mean escape time, None where it fails.
    notes
        What is not known, in words.
    prefactor_error
        Of that law, from the uncertainty of f; None where not known.
    leverage
        Relative standard error of ΔU/ε from an estimated D over that of ε.
    """

    start: int
    end: int | None
    saddle: Equilibrium | Cycle
    path: TransitionPath | None
    barrier: float
    formula_share: float
    standard_error: float
    rate: EscapeRate | None
    notes: tuple[str, ...] = ()
    prefactor_error: PrefactorError | None = None
    leverage: float = 1.0
    by_rivals: float = 0.0

    @property
    def place(self) -> np.ndarray:
        """Where the path ends: at the saddle, or at a state of the unstable cycle. Shape ``(d,)``."""
        over_cycle = isinstance(self.saddle, Cycle) and self.path is not None
        return self.path.uphill.points[-1] if over_cycle and self.path else self.saddle.position

    @property
    def error(self) -> float:
        """Standard error of the barrier: from f, and by how much the formula and the path alone differ."""
        if self.path is None:
            return self.standard_error
        return float(np.hypot(self.standard_error, self.barrier - self.by_rivals - self.path.uphill.action))

    @property
    def exit(self) -> Exit:
        """What the time of this way out follows from."""
        known, rate = self.prefactor_error, self.rate
        prefactor, turn = (None, None) if rate is None else (rate.prefactor, rate.turn)
        if known is None:
            return Exit(self.barrier, self.error, prefactor, leverage=self.leverage, turn=turn)
        return Exit(
            self.barrier, self.error, prefactor, known.standard_error, known.covariance, self.leverage, turn
        )  # fmt: skip


@dataclass(frozen=True)
class WayOut:
    """The path of least action out of one well over one saddle, before any formula.

    Attributes
    ----------
    start, end, saddle
        As of a `Transition`.
    path
        None where none was found.
    note
        Why not, in words.
    from_cycle
        Whether the attractor is a cycle.
    """

    start: int
    end: int | None
    saddle: Equilibrium | Cycle
    path: TransitionPath | None
    note: str = ""
    from_cycle: bool = False

    @property
    def about_cycles(self) -> bool:
        """Whether the path begins on a cycle, or leads over one."""
        return self.from_cycle or isinstance(self.saddle, Cycle)


def ways_out(dynamics: Dynamics, portrait: PhasePortrait, *, beyond_region: bool = False) -> list[WayOut]:
    """Every way out of every well over the saddles next to it, from f alone.

    Parameters
    ----------
    dynamics
        f and D.
    portrait
        Attractors and saddles.
    beyond_region
        Whether a saddle behind which lies no attractor of the region is a way out, too: of a given f the
        path up to it is as good as any other. Of an identified one nothing is known beyond.
    """
    ways = _ways_over_cycles(dynamics, portrait)
    points = len(portrait.attractors)
    for index in range(points + len(portrait.cycles)):
        for saddle in portrait.saddles[index]:
            beyond = neighbours(
                dynamics, saddle, portrait.attractors, box=portrait.box, cycles=portrait.cycles
            ) - {index}
            if not beyond and beyond_region:
                ways += _way_beyond(dynamics, portrait, index, saddle)
                continue
            if not beyond:
                note = "behind the saddle lies no other attractor of the recorded region"
                ways.append(WayOut(index, None, saddle, None, note))
                continue
            end = min(beyond)
            try:
                if max(index, end) >= points:
                    path = way_about_cycles(dynamics, portrait, index, saddle, end, tolerance=PATH_TOLERANCE)
                    ways.append(WayOut(index, end, saddle, path))
                    continue
                attractor = portrait.attractors[index]
                path = transition_path(
                    dynamics, attractor.position, saddle.position, portrait.attractors[end].position,
                    tolerance=PATH_TOLERANCE, initial=_first_guesses(dynamics, attractor, saddle),
                )  # fmt: skip
                ways.append(WayOut(index, end, saddle, path))
            except NumericalFailure as error:
                ways.append(WayOut(index, end, saddle, None, str(error)))
    return [replace(way, from_cycle=way.start >= points) for way in ways]


def _ways_over_cycles(dynamics: Dynamics, portrait: PhasePortrait) -> list[WayOut]:
    """The ways over unstable cycles, from both sides of each."""
    ways = []
    for cycle in portrait.parting:
        sides = [int(one) for one in both_sides(dynamics, cycle, portrait)]
        if sides[0] == sides[1]:
            continue
        for start, beyond in (sides, sides[::-1]):
            if start < 0:
                continue
            end, note = (None, OUTWARDS.replace("saddle", "unstable cycle")) if beyond < 0 else (beyond, "")
            try:
                path = way_about_cycles(dynamics, portrait, start, cycle, end, tolerance=PATH_TOLERANCE)
                ways.append(WayOut(start, end, cycle, path, note))
            except NumericalFailure as error:
                ways.append(WayOut(start, end, cycle, None, str(error)))
    return ways


def _first_guesses(
    dynamics: Dynamics, attractor: Equilibrium, saddle: Equilibrium
) -> list[np.ndarray] | None:
    """Of many states the way down taken backwards, and the straight line; of few None, for the usual ones."""
    if dynamics.dimension <= FEW_STATES:
        return None
    down = descent(dynamics, saddle.position, attractor.position, GUESSED)
    return [down[::-1], np.stack([attractor.position, saddle.position])]


def _way_beyond(dynamics: Dynamics, portrait: PhasePortrait, index: int, saddle: Equilibrium) -> list[WayOut]:
    """The way over a saddle from which f leads out of the region; none where it leads back on both sides."""
    if leads_back(dynamics, saddle, portrait.attractors, box=portrait.box, cycles=portrait.cycles):
        return []
    settled: list[np.ndarray | Cycle] = [*(one.position for one in portrait.attractors), *portrait.cycles]
    try:
        uphill = minimum_action_path(dynamics, settled[index], saddle.position, tolerance=PATH_TOLERANCE)
    except NumericalFailure as error:
        return [WayOut(index, None, saddle, None, str(error))]
    return [WayOut(index, None, saddle, TransitionPath(uphill, saddle.position[None]), OUTWARDS)]


def missing_diffusion(dynamics: Dynamics) -> str | None:
    """Why there are no escape times for want of D, in words; None where nothing speaks against them.

    No noise drives ``dx/dt = v``, where one state is but the derivative of another; a D that is the unit
    matrix says that it does, and mostly nobody has said so.
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
    found: AnyField,
    ways: Sequence[WayOut],
    wells: Sequence[Well | None],
) -> list[Transition]:
    """Ways out with their barriers and escape times.

    Parameters
    ----------
    found
        f with its uncertainty.
    ways
        See `ways_out`.
    wells
        The formula about each attractor, None where there is none.
    """
    return [_transition(found, way, wells[way.start]) for way in ways]


def _transition(found: AnyField, way: WayOut, well: Well | None) -> Transition:
    path = way.path
    if path is None:
        return Transition(way.start, way.end, way.saddle, None, np.nan, np.nan, np.nan, None, (way.note,))
    notes = [way.note] if way.note else []
    if not path.uphill.converged:
        notes.append("the minimum action path is not converged")
    rate, missing = None, missing_diffusion(found.dynamics)
    of_prefactor: PrefactorError | None = None
    try:
        if way.about_cycles:
            raise NumericalFailure("no law is implemented for ways that begin or end on a cycle")
        if missing is not None:
            raise NumericalFailure(missing)
        rate = escape_rate(found.dynamics, path.uphill, beyond=way.end is not None)
        notes += rate.notes
        of_prefactor = prefactor_error(found, path.uphill)
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        notes.append(f"no escape time: {error}")
    barrier, share = path.uphill.action, 0.0
    if well is not None:
        barrier, share = barrier_by_formula(path, well)
        if abs(barrier / path.uphill.action - 1) > DIFFERENT:
            notes.append("the formula and the path alone give different barriers")
        if isinstance(found, GivenField) and path.uphill.converged:  # nothing about f is to be averaged over
            barrier, share = path.uphill.action, 0.0
    logger.info("barrier of U from attractor %d: %.5g by formula, %.5g by the path", way.start, barrier,
                path.uphill.action)  # fmt: skip
    spread, by_rivals = barrier_uncertainty(path, found)
    if abs(by_rivals) > WORTH_A_WORD * spread:
        notes.append(f"{by_rivals:+.2g} of the barrier is due to other terms of f that fit nearly as well")
    return Transition(
        way.start, way.end, way.saddle, path, barrier + by_rivals, share, spread, rate,
        tuple(dict.fromkeys(notes)), of_prefactor, noise_leverage(path.uphill, found.dynamics), by_rivals,
    )  # fmt: skip


def barrier_by_formula(path: TransitionPath, well: Well) -> tuple[float, float]:
    """The barrier of U by a formula and the end of the path, and the share that the formula accounts for."""
    points, action = path.uphill.points, path.uphill.values
    formula = 2 * well.known_values(points)
    known = np.flatnonzero(np.isfinite(formula))
    if not len(known):
        return float(path.uphill.action), 0.0
    last = known[-1]
    barrier = formula[last] + path.uphill.action - action[last]
    return float(barrier), float(formula[last] / barrier)


def barrier_uncertainty(path: TransitionPath, found: AnyField) -> tuple[float, float]:
    """Standard error of a barrier of U from that of f, to first order, and what the mean over rivals adds.

    The action ``½∫∣ẋ - f∣² dt`` is minimal along the path, so that a change of f changes it by

        ∂U/∂c = -2 ∫ p·∂f/∂c dt.
    """
    if isinstance(found, GivenField):
        return 0.0, 0.0
    middle, force, spent = _along(path.uphill, found.dynamics)
    terms = found.library.evaluate(middle)
    slope = -2 * np.einsum("n,nq,nd->qd", spent, terms, force)
    variance, by_rivals = float(found.variance(slope, of_mean=True)), float(found.mean_change(slope))
    if found.noise is not None:  # and by ∂U/∂D = -2 ∫ p·∂D p dt
        slope = -2 * (spent[:, None] * found.noise.push_slopes(middle, force)).sum(axis=0) / found.intensity
        variance += float(slope @ found.noise.covariance @ slope)
    return float(np.sqrt(max(variance, 0.0))), by_rivals


def noise_leverage(path: MinimumActionPath, dynamics: Dynamics) -> float:
    """Relative standard error of ΔU/ε from an estimated εD, over that of ε, the mean of its parts.

    A change of εD changes ``ΔU/ε = 2∫p·dx/ε`` by ``-2∫ p·δ(εD)p dt/ε²``. With the covariance of a matrix that
    is estimated from n residuals of d states, and A = ∫ p pᵀ dt, that makes ``2 √(d tr (AD)²)/ΔU``: 1 where
    the path spends its action on all states alike, and √d where on one of them.
    """
    middle, force, spent = _along(path, dynamics)
    pushed = np.einsum("n,ni,nj->ij", spent, dynamics.diffusion.push(middle, force), force)
    total = float(np.trace(pushed))
    if not total > 0:
        return 1.0
    return float(np.sqrt(dynamics.dimension * max(np.trace(pushed @ pushed), 0.0)) / total)


def _along(path: MinimumActionPath, dynamics: Dynamics) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States, momenta and times of the pieces of a path."""
    middle = (path.points[1:] + path.points[:-1]) / 2
    force = (path.momenta[1:] + path.momenta[:-1]) / 2
    flow, move = (
        dynamics.drift(middle) + 2 * dynamics.diffusion.push(middle, force),
        np.diff(path.points, axis=0),
    )
    measure = measure_at(dynamics, path.points[0])
    speed, length = (np.sqrt(measure.squared_speed(middle, one)) for one in (flow, move))
    spent = np.where(speed > 0, length / np.where(speed > 0, speed, 1.0), 0.0)
    return middle, force, spent


def position_standard_errors(found: AnyField, position: np.ndarray) -> np.ndarray:
    """Standard errors of an equilibrium's position, shape ``(d,)``: of f = 0 follows δx = -J⁻¹ δf."""
    if isinstance(found, GivenField):
        return np.zeros(len(position))
    terms = found.library.evaluate(position[None])[0]
    try:
        moved = np.linalg.inv(found.dynamics.jacobian(position[None])[0])
    except np.linalg.LinAlgError:
        return np.full(found.library.dimension, np.nan)
    return np.sqrt(found.variance(np.einsum("k,ij->ikj", terms, moved)))
