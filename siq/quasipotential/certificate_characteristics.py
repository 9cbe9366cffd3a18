"""The test that shares nothing with the fit of V but f and D: characteristics.

Characteristics of the Hamilton–Jacobi equation leave an attractor along its linearisation, by f and D alone:
no ansatz of V, no network, no recorded state enters (`siq.quasipotential.characteristics`). Along each V is
integrated, and on the lowest sheet it is the quasipotential. At these points a formula is held against it.

Recorded states only say where to compare: within the box of the recordings, among states that lead to the
attractor, and up to `SHARE` of the level at which the first characteristic leaves these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from siq.errors import NumericalFailure
from siq.inference.field_estimate import AnyField
from siq.numerics.least_squares import representative_subset
from siq.numerics.text import place_text
from siq.quasipotential.certificate_tests import (
    STATED,
    BasinRegion,
    Candidate,
    CertificateOptions,
    Verdict,
    basin_region,
    stated_error,
)
from siq.quasipotential.characteristics import End, Fan, adapted_fan, lowest_sheet
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at
from siq.systems.phase_portrait import PhasePortrait

SHARE = 0.9  # of the level: at the saddle itself V is stationary, and curves hardly get on
REACHED = 0.8  # of what was asked for, up to which a curve has to come where most end before
FEWEST = 30  # points: the root mean square of n values is known to 1/√(2n), here to 13 %
SCOUTS, CURVES, MOST = (
    32,
    64,
    128,
)  # curves in search of the level, and for the comparison: cost, not accuracy
GAP = 0.15  # of the ends of neighbours, the level being at 1
SPACING = 0.1  # of points along curves; in one dimension, where there are two curves, a fifth of it
TOLERANCE = 1e-7  # of the integrator's steps, relative; by so much V may err in each
ROUGH = 1e-5  # the same in search of the level, which need not be known better than to some per cent
START, START_DEGREE = 1e-3, 6  # of the level: the series errs by 10⁻³ to the power 5/2; closer, curves bundle
MOST_STEPS = 1500  # of a curve, where 30 to 130 are usual; stiff systems take as many as their rates differ
SHEETS = 2e-3  # of the level: the margin with which `lowest_sheet` tells sheets apart
DOUBLINGS = 8  # of the level in search of the saddle
CLOSE = 0.6  # of a saddle to a curve, the level being at 1: close enough for a first estimate of V there
BEYOND = 1.2  # of the level of the fan: what lies higher was not reached
AGAIN = 1.5  # of the level found: a fan up to more than that has to be followed again, up to less
STARTS = 0.9  # share of the recorded starts below the first level where no saddle is known


@dataclass(frozen=True, eq=False)
class Reference:
    """V about one attractor at points that characteristics reach.

    Attributes
    ----------
    attractor
        Shape ``(d,)``; V is zero there.
    points, values
        Shape ``(n, d)`` and ``(n,)``.
    level
        V up to which they were followed, NaN where they could not be.
    error
        Relative error of the values: steps of a curve times their tolerance, and the margin of the sheets
        where there was more than one.
    fault
        Why there is nothing to compare with, and what would help; empty where there is.
    """

    attractor: np.ndarray
    points: np.ndarray
    values: np.ndarray
    level: float
    error: float
    fault: str = ""

    def below(self, level: float) -> tuple[np.ndarray, np.ndarray]:
        """Points and values up to `SHARE` of a level that a formula claims, which may be the lower one."""
        kept = self.values <= SHARE * level
        return self.points[kept], self.values[kept]


def references_about(
    dynamics: Dynamics, portrait: PhasePortrait, *, depths: Sequence[float] | None = None, seed: int = 0
) -> tuple[Reference, ...]:
    """V by characteristics about every attractor of a phase portrait; see `follow_well` for the depths."""
    known = [np.inf] * len(portrait.attractors) if depths is None else depths
    return tuple(
        follow_well(dynamics, portrait, index, depth=depth, seed=seed) for index, depth in enumerate(known)
    )


def follow_well(
    dynamics: Dynamics, portrait: PhasePortrait, index: int, *, depth: float = np.inf, seed: int = 0
) -> Reference:
    """V by characteristics about one attractor, as far as they may be believed.

    Parameters
    ----------
    dynamics
        f, twice differentiable, and D.
    portrait, index
        Where to compare, and which attractor.
    depth
        V at the lowest saddle, where it is known: higher up nothing is compared. Where curves bundle, none
        of a few in search of it may come close.
    seed
        Draws directions where there are more than two states, and thins the points.

    Returns
    -------
    Reference
        With a fault where characteristics give none.
    """
    attractor = portrait.attractors[index].position
    empty = np.zeros((0, len(attractor)))
    shown = np.array2string(attractor, precision=4, suppress_small=True, separator=", ")
    region = basin_region(portrait, index)
    try:
        level = min(_level(dynamics, portrait, index, region, seed), depth)
        fan = _fan(dynamics, portrait, attractor, SHARE * level, seed, count=CURVES, most=MOST, rounds=3)
    except (NumericalFailure, ValueError, np.linalg.LinAlgError) as failure:
        fault = f"characteristics cannot be followed from the attractor {shown}: {failure}"
        return Reference(attractor, empty, np.zeros(0), np.nan, np.inf, fault)
    lowest = lowest_sheet(fan)
    kept = np.flatnonzero(lowest & region.recorded(fan.points))
    if not len(kept):
        fault = f"no characteristic from the attractor {shown} stays where states were recorded"
        return Reference(attractor, empty, np.zeros(0), np.nan, np.inf, fault)
    scaled = (fan.points[kept] - attractor) @ fan.metric.T
    distance = _spacing(len(attractor))
    kept = kept[representative_subset(scaled, distance=distance, generator=np.random.default_rng(seed))]
    x, values = fan.points[kept], fan.values[kept]
    error = TOLERANCE * int(np.bincount(fan.curve).max()) + (0.0 if lowest.all() else SHEETS)
    return Reference(attractor, x, values, level, error, _fault(fan, values, shown))


def check_characteristics(
    candidate: Candidate,
    found: AnyField,
    references: Sequence[Reference],
    *,
    error: float,
    options: CertificateOptions,
    level: float = np.inf,
    seed: int = 0,
) -> tuple[Verdict, float, np.ndarray | None]:
    """Whether V is the one that characteristics carry, within the error that its certificate states.

    Parameters
    ----------
    candidate
        V, with its gradient.
    found
        f and D.
    references
        V by characteristics about every attractor for which the candidate claims to hold.
    error
        The relative error of V that the candidate's own residual leaves open, over its region.
    options
        The largest error that may be stated.
    level
        V up to which the candidate claims to hold.
    seed
        Draws points on which the error is estimated.

    Returns
    -------
    verdict
        Largest relative L2 difference about any attractor, and what the errors of both explain.
    error
        The error to be stated: where V differs by more than the region's, at least that which its residual
        leaves open about this attractor.
    worst
        Where the difference is largest, shape ``(d,)``; None where nothing was compared.
    """
    if not references or len(references) < len(candidate.attractors):
        reason = "characteristics were not followed from every attractor, or there is none"
        return Verdict(np.inf, 0.0, False, reason), error, None
    verdicts, worst = [], None
    for one in references:
        x, expected = one.below(level)
        fault = one.fault
        if not fault and len(x) < FEWEST:
            fault = f"only {len(x)} points of characteristics lie below the level of V: the level is too low"
        if fault:
            verdicts.append(Verdict(np.inf, 0.0, False, fault))
            continue
        difference = candidate.values(x) - candidate.values(one.attractor[None]) - expected
        value = float(np.linalg.norm(difference) / np.linalg.norm(expected))
        if not value <= error + one.error:  # a mean over a region says little of its deepest part
            error = max(error, stated_error(replace(candidate, points=x), found, seed=seed)[0])
        # An error that cannot be stated explains nothing: a false solution, whose ascending paths run away.
        from_field = STATED * candidate.relative_error  # of a formula that was fitted together with f
        own = error - from_field
        limit = (
            (own if own <= options.error else 0.0) + (from_field if np.isfinite(error) else 0.0) + one.error
        )
        place = x[int(np.argmax(np.abs(difference)))]
        shown = place_text(place)
        passed = bool(value <= limit)
        reason = "" if passed else f"V is not what characteristics give, most of all at {shown}"
        worst = place if worst is None or not passed else worst
        verdicts.append(Verdict(value, limit, passed, reason))
    decisive = max(verdicts, key=lambda one: (not one.passed, one.value / (one.limit or 1.0)))
    return decisive, error, worst


def _level(dynamics: Dynamics, portrait: PhasePortrait, index: int, region: BasinRegion, seed: int) -> float:
    """V at which the first characteristic comes to another basin, or to rest at a saddle.

    Where there is neither, 1.1 times as much as most recorded starts have of V in the quadratic
    approximation, so that `SHARE` of it is about that.
    """
    attractor = portrait.attractors[index].position
    hessian = hessian_at(dynamics, attractor)

    def quadratic(x: np.ndarray) -> np.ndarray:
        return np.asarray(0.5 * np.einsum("ni,ij,nj->n", x - attractor, hessian, x - attractor))

    tops = np.array([one.position for one in portrait.saddles[index]]).reshape(-1, len(attractor))
    starts = portrait.descents.paths[portrait.descents.ends == index][:, 0]
    first = float(np.quantile(quadratic(starts), STARTS))
    level = min(first, float(quadratic(tops).min(initial=np.inf)))
    known: float | None = None
    for _ in range(DOUBLINGS):
        fan = _fan(
            dynamics,
            portrait,
            attractor,
            level,
            seed,
            count=SCOUTS,
            most=2 * SCOUTS,
            rounds=2,
            tolerance=ROUGH,
        )
        across = region.across(fan.points) & (fan.values > 0)
        # One state on the wrong side may be a gap between recorded ones: the next has to lie there too.
        across[:-1] &= across[1:] & (fan.curve[:-1] == fan.curve[1:])
        across[-1] = False
        ends = fan.values[fan.last]
        left = np.concatenate([fan.values[across], ends[fan.ends == End.REST], _heights(fan, tops)])
        if len(left) and left.min() <= BEYOND * level:
            lowest = float(left.min())
            if level <= AGAIN * lowest:
                return lowest
            known, level = lowest, BEYOND * lowest  # the same again, where curves lie closer together
            continue
        if known is not None:
            return known
        if not len(tops):
            return level / SHARE
        if not (fan.ends == End.LEVEL).any():
            return float(ends.max())
        level *= 2
    raise NumericalFailure("they come to no saddle; record the way there")


def _heights(fan: Fan, tops: np.ndarray) -> np.ndarray:
    """V at the saddles that curves come close to, to second order, shape ``(m,)``: curves turn off before."""
    lowest = lowest_sheet(fan)
    tree = cKDTree((fan.points[lowest] - fan.attractor) @ fan.metric.T)
    distance, nearest = tree.query((tops - fan.attractor) @ fan.metric.T)
    nearest = np.flatnonzero(lowest)[nearest[distance < CLOSE]]
    offset = tops[distance < CLOSE] - fan.points[nearest]
    slope = np.sum(offset * fan.momenta[nearest], axis=1)
    bend = np.einsum("ni,nij,nj->n", offset, fan.hessians[nearest], offset) / 2
    return np.maximum(fan.values[nearest] + slope + bend, fan.values[nearest] / 2)


def _fan(
    dynamics: Dynamics, portrait: PhasePortrait, attractor: np.ndarray, level: float, seed: int, **told: Any
) -> Fan:
    return adapted_fan(
        dynamics, attractor, level=level, box=portrait.box, generator=np.random.default_rng(seed),
        gap=GAP, spacing=_spacing(len(attractor)), most_steps=MOST_STEPS, start=START,
        start_degree=START_DEGREE if len(attractor) <= 4 else 4, **{"tolerance": TOLERANCE} | told,
    )  # fmt: skip


def _spacing(dimension: int) -> float:
    return SPACING if dimension > 1 else SPACING / 5


def _fault(fan: Fan, values: np.ndarray, shown: str) -> str:
    """Why the points of a fan are no test, in words; empty where they are."""
    ends = fan.ends
    stopped = np.isin(ends, (End.STALLED, End.TIME, End.CAUSTIC)).mean() > 0.5
    if len(values) >= FEWEST and (values.max() >= REACHED * fan.level or not stopped):
        return ""
    if np.isin(ends, (End.STALLED, End.TIME)).mean() > 0.5:
        why = "they are too stiff: leave out the fastest states, or record their slow motion alone"
    elif (ends == End.CAUSTIC).any():
        lowest = 2 * float(fan.caustic_values.min())
        why = f"they cross at caustics from U = {lowest:.4g} on: record less far from the attractor"
    elif (ends == End.LEVEL).mean() > 0.5:
        why = "they draw together, its rates being too different: leave out the fastest states"
    else:
        why = "they leave the recorded states: record more of them about the attractor"
    return f"characteristics from the attractor {shown} give {len(values)} points to compare with, as {why}"
