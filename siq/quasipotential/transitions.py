"""Transitions between attractors: barriers with their uncertainty, paths, and mean escape times.

A barrier of U is what the formula of V says of the path of least action, from the attractor to where the
formula is believed for the last time, and the action of the path from there to the saddle, where formulas
are at their worst. The action of the whole path, which knows no formula, stands beside it.

A change of f by coefficients c, and one of D, change the action by

    ∂U/∂c = -2 ∫ p·∂f/∂c dt,    ∂U/∂D = -2 ∫ p·∂D p dt

along the path, on which it is least. Where the terms of f are in doubt, the mean over alternative terms moves
the barrier (`siq.inference.selection`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from siq.errors import NumericalFailure
from siq.inference.diffusion_model import defined_states
from siq.inference.field_estimate import AnyField, dynamics_of
from siq.quasipotential.path_chains import MinimumActionPath
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
PATH_TOLERANCE = 1e-5  # of the action; prefactors follow the end of the path and need more than barriers


@dataclass(frozen=True)
class Transition:
    """The way out of one well over one saddle.

    Attributes
    ----------
    start, end, from_cycle
        Indices of the attractors, `end` None where the saddle leads back, or out of the recorded region; and
        whether the first is a cycle.
    saddle, path
        The saddle, or the unstable cycle; and the path of least action with the way down, None where none was
        found.
    barrier, standard_error, formula_share
        ΔU by the formula and the end of the path, NaN where neither is known; its standard error from that of
        f; and the share of it that the formula accounts for.
    by_rivals
        What other terms of f that fit nearly as well have added to the barrier, in the mean.
    rate
        Law of the mean escape time at the action of the path, with the error of its prefactor; None where it
        fails.
    leverage
        Relative standard error of ΔU/ε from an estimated D over that of ε.
    of_residual
        What the residual of V leaves open of the part of the barrier that the formula accounts for.
    turns
        Of each state, how many of its periods it has gained at the end; empty where no state is periodic.
    remarks
        What is not known.
    """

    start: int
    end: int | None
    saddle: Equilibrium | Cycle
    path: MinimumActionPath | None
    barrier: float = np.nan
    formula_share: float = np.nan
    standard_error: float = np.nan
    rate: EscapeRate | None = None
    remarks: tuple[Remark, ...] = ()
    leverage: float = 1.0
    by_rivals: float = 0.0
    from_cycle: bool = False
    of_residual: float = 0.0
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
            Transition(number, target, over, path, remarks=remarks, from_cycle=start >= points, turns=turns)
        )

    for cycle in whole.parting:
        ends = sides_of(dynamics, cycle, whole.attractors, box=box, cycles=cycles).tolist()
        for start, beyond in (ends, ends[::-1]) if ends[0] != ends[1] else ():
            if start >= 0:
                add(start, cycle, None if beyond < 0 else beyond)
    for index, (number, away) in enumerate(homes):
        if number is None or any(away):
            continue
        for saddle in whole.saddles[index]:
            reached = sides_of(dynamics, saddle, whole.attractors, box=box, cycles=cycles)
            end = min(set(reached[reached >= 0].tolist()) - {index}, default=None)
            if end is None and not beyond_region:
                remarks = (Remark("quasipotential.nothing_beyond_saddle"),)
                ways.append(
                    Transition(number, None, saddle, None, remarks=remarks, from_cycle=index >= points)
                )
            elif end is not None or not (reached == index).all():  # else it parts no wells
                add(index, saddle, end)
    return ways


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
            if way.from_cycle or isinstance(way.saddle, Cycle):
                raise NumericalFailure("no law is implemented for ways that begin or end on a cycle")
            if (missing := missing_diffusion(dynamics)) is not None:
                raise NumericalFailure(missing)
            rate = escape_rate(dynamics, path, beyond=way.end is not None)
            remarks += rate.remarks
            error, covariance = prefactor_error(found, path)
            rate = replace(rate, prefactor_error=error, covariance=covariance)
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
                leverage=noise_leverage(path, dynamics),
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
    terms = found.library.evaluate(middle)
    slope = -2 * np.einsum("n,nq,nd->qd", spent, terms, force)
    variance, by_rivals = float(found.variance(slope, of_mean=True)), float(found.bias(slope))
    if found.noise is not None:
        slope = -2 * (spent[:, None] * found.noise.push_slopes(middle, force)).sum(axis=0) / found.intensity
        variance += float(slope @ found.noise.covariance @ slope)
    return float(np.sqrt(max(variance, 0.0))), by_rivals


def noise_leverage(path: MinimumActionPath, dynamics: Dynamics) -> float:
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

    Beyond a saddle it rises by one more. A `NumericalFailure` where no path is known.
    """
    known = [(way.path, way.downhill) for way in ways if way.path is not None]
    if not known:
        raise NumericalFailure("no path leads out of the well, along which a simulation could be split")
    points = np.concatenate([np.concatenate([path.points, down]) for path, down in known])
    beyond = [path.action / intensity + np.linspace(0, 1, len(down)) for path, down in known]
    pairs = zip(known, beyond, strict=True)
    along = np.concatenate([np.append(path.values / intensity, last) for (path, _), last in pairs])
    # Near is what the noise about the attractor makes so.
    root = np.diag(1 / np.ptp(points, axis=0))
    if isinstance(attractor, Equilibrium):
        root = np.linalg.cholesky(hessian_at(dynamics, attractor.position))
    tree = cKDTree(points @ root)
    return lambda x: np.asarray(along[tree.query(x.T @ root)[1]])
