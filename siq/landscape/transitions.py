"""Transitions between attractors: barriers with their uncertainty, paths, and mean escape times.

A barrier of U is what the formula of V says of the path of least action, from the attractor to where the
formula is believed for the last time, and the action of the path from there to the saddle, where formulas
are at their worst. The action of the whole path, which knows no formula, stands beside it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from siq.equilibria import Equilibrium, neighbours
from siq.errors import NumericalFailure
from siq.identification import IdentifiedField
from siq.landscape.local import LocalQuasipotential
from siq.landscape.paths import TransitionPath, transition_path
from siq.landscape.rates import EscapeRate, escape_rate
from siq.outline import Outline
from siq.vector_field import VectorField

logger = logging.getLogger(__name__)

DIFFERENT = 0.02  # share of a barrier by which two ways to it may differ without a word
PATH_TOLERANCE = 1e-5  # of the action; prefactors follow the end of the path and need more than barriers


@dataclass(frozen=True)
class Transition:
    """The way out of one well over one saddle.

    Attributes
    ----------
    start, end
        Indices of the attractors; `end` is None where the saddle leads back, or out of the recorded region.
    saddle
        The saddle.
    path
        The path of least action and the way down, None where none was found.
    barrier
        ΔU by the formula and the end of the path; NaN where neither is known.
    by_formula
        Share of the barrier that the formula accounts for.
    standard_error
        Of the barrier, from the uncertainty of f.
    rate
        Law of the mean escape time, None where it fails.
    notes
        What is not known, in words.
    """

    start: int
    end: int | None
    saddle: Equilibrium
    path: TransitionPath | None
    barrier: float
    by_formula: float
    standard_error: float
    rate: EscapeRate | None
    notes: tuple[str, ...] = ()


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
    """

    start: int
    end: int | None
    saddle: Equilibrium
    path: TransitionPath | None
    note: str = ""


def ways_out(field: VectorField, outline: Outline, *, diffusion: np.ndarray) -> list[WayOut]:
    """Every way out of every well over the saddles next to it, from f alone.

    Parameters
    ----------
    field
        f.
    outline
        Attractors and saddles.
    diffusion
        D.
    """
    ways = []
    for index, attractor in enumerate(outline.attractors):
        for saddle in outline.saddles[index]:
            beyond = neighbours(field, saddle, outline.attractors, box=outline.box) - {index}
            if not beyond:
                note = "behind the saddle lies no other attractor of the recorded region"
                ways.append(WayOut(index, None, saddle, None, note))
                continue
            end = min(beyond)
            try:
                path = transition_path(
                    field, attractor.position, saddle.position, outline.attractors[end].position,
                    diffusion=diffusion, tolerance=PATH_TOLERANCE,
                )  # fmt: skip
                ways.append(WayOut(index, end, saddle, path))
            except NumericalFailure as error:
                ways.append(WayOut(index, end, saddle, None, str(error)))
    return ways


def lowest_barrier(ways: Sequence[WayOut], index: int) -> float | None:
    """The least action out of one well, that is the lowest barrier of U; None where no way out is known."""
    actions = [way.path.uphill.action for way in ways if way.start == index and way.path is not None]
    return min(actions, default=None)


def transitions(
    found: IdentifiedField,
    ways: Sequence[WayOut],
    local: Sequence[LocalQuasipotential | None],
    *,
    diffusion: np.ndarray,
) -> list[Transition]:
    """Ways out with their barriers and escape times.

    Parameters
    ----------
    found
        The identified f with its uncertainty.
    ways
        See `ways_out`.
    local
        The formula about each attractor, None where there is none.
    diffusion
        D.
    """
    return [_transition(found, way, local[way.start], diffusion) for way in ways]


def _transition(
    found: IdentifiedField, way: WayOut, local: LocalQuasipotential | None, diffusion: np.ndarray
) -> Transition:
    path = way.path
    if path is None:
        return Transition(way.start, way.end, way.saddle, None, np.nan, np.nan, np.nan, None, (way.note,))
    notes: list[str] = []
    if not path.uphill.converged:
        notes.append("the minimum action path is not converged")
    rate = None
    try:
        rate = escape_rate(found.field, path.uphill, diffusion=diffusion)
        notes += rate.notes
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        notes.append(f"no escape time: {error}")
    barrier, share = path.uphill.action, 0.0
    if local is not None:
        barrier, share = barrier_by_formula(path, local)
        if abs(barrier / path.uphill.action - 1) > DIFFERENT:
            notes.append("the formula and the path alone give different barriers")
    logger.info("barrier of U from attractor %d: %.5g by formula, %.5g by the path", way.start, barrier,
                path.uphill.action)  # fmt: skip
    spread = barrier_standard_error(path, found, diffusion=diffusion)
    return Transition(
        way.start, way.end, way.saddle, path, barrier, share, spread, rate, tuple(dict.fromkeys(notes))
    )


def barrier_by_formula(path: TransitionPath, local: LocalQuasipotential) -> tuple[float, float]:
    """The barrier of U by a formula and the end of the path, and the share that the formula accounts for."""
    points, action = path.uphill.points, path.uphill.values
    formula = 2 * local.values(points)
    known = np.flatnonzero(np.isfinite(formula))
    if not len(known):
        return float(path.uphill.action), 0.0
    last = known[-1]
    barrier = formula[last] + path.uphill.action - action[last]
    return float(barrier), float(formula[last] / barrier)


def barrier_standard_error(path: TransitionPath, found: IdentifiedField, *, diffusion: np.ndarray) -> float:
    """Standard error of a barrier of U from that of f, to first order.

    The action ``½∫∣ẋ - f∣² dt`` is minimal along the path, so that a change of f changes it by

        ∂U/∂c = -2 ∫ p·∂f/∂c dt.
    """
    points, momenta = path.uphill.points, path.uphill.momenta
    middle = (points[1:] + points[:-1]) / 2
    force = (momenta[1:] + momenta[:-1]) / 2
    precision = np.linalg.inv(diffusion)
    flow, move = found.field(middle), np.diff(points, axis=0)
    speed = np.sqrt(np.einsum("ni,ij,nj->n", flow, precision, flow))
    length = np.sqrt(np.einsum("ni,ij,nj->n", move, precision, move))
    spent = np.where(speed > 0, length / np.where(speed > 0, speed, 1.0), 0.0)
    terms = found.library.evaluate(middle)[:, found.support[:, 1]]
    slope = -2 * (spent[:, None] * force[:, found.support[:, 0]] * terms).sum(axis=0)
    return float(np.sqrt(max(slope @ found.covariance @ slope, 0.0)))
