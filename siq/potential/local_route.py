"""The local route: V about one attractor, from f alone, grown outwards to the lowest saddle.

At the attractor the Hessian of V is M, which follows from the Jacobian of f, and it is kept. The higher
powers are found by Gauss–Newton on the Hamilton–Jacobi equation, in a sublevel set that grows from a small
ellipsoid. No network takes part. Beyond the lowest saddle the well ends, and nothing is claimed there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from siq.dynamics.basins import Basin
from siq.dynamics.cycles import Cycle
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import Equilibrium, hessian_at
from siq.errors import NumericalFailure
from siq.potential.bases import PowerBasis, power_basis
from siq.potential.hamilton_jacobi import equation_at, gauss_newton
from siq.potential.well import Well

FIRST_SHARE = 0.05  # of a known depth: the first level
GROWTH = 1.5  # of the level, from one fit to the next
REACH = 0.25  # of the distance at which the level lies: how far new points may be from those of the last fit
MOST_POINTS = 6000  # of one fit
HIGHEST = 0.9  # share of the recorded starts below the level, where no saddle limits it
SETTLED = 0.01  # change of the level, and of the number of points, with which growing ends
REPEATED = 1e-4  # of a level: one that was tried before, and from which the next would follow again
AT_LEVEL = 0.05  # of a level: by so much V of the saddle that set it may change with the next fit
MOST_ROUNDS = 80  # of growing
ON_THE_WAY = 1e-6  # relative change of the coefficients with which Gauss–Newton ends before the last level
STARTS = (0.5, 0.25, 1.0)  # of the networks' level: where the network route starts, one after the other
LOW = 4  # powers up to this one are fitted to a network's V, and those above begin at zero
NO_SOLUTION = 0.2  # relative residual from which on a start has led nowhere
FLAT = 1e-6  # of the largest curvature at an attractor: V with a smaller one has no minimum there
CLOSE = 0.1  # of the recorded box: a saddle so close to the points of the fit has been reached


def grow_well(
    dynamics: Dynamics,
    attractor: Equilibrium,
    basin: Basin,
    saddles: Sequence[Equilibrium | Cycle],
    *,
    degree: int,
    generator: np.random.Generator,
    depth: float | None = None,
) -> Well:
    """V about an attractor up to its lowest saddle.

    Parameters
    ----------
    dynamics
        f and D.
    attractor
        Where V is zero.
    basin
        Recorded points that lead to it; the well cannot reach beyond them.
    saddles
        The saddles next to it.
    degree
        Highest power.
    generator
        Decides which points are used where there are too many.
    depth
        V at the lowest of the saddles, which then is the only one given, where the path of least action has
        told it before; by default V itself has to find its lowest saddle.

    Raises
    ------
    NumericalFailure
        When too few recorded states lead to the attractor, or the powers can follow V neither up to a
        saddle nor to the end of the recorded region.
    """
    hessian = hessian_at(dynamics, attractor.position)
    extent = np.sqrt(np.diag(np.linalg.inv(hessian)))
    flat = basin.states.reshape(-1, basin.states.shape[2])
    offsets = flat - attractor.position
    quadratic = 0.5 * np.einsum("ni,ij,nj->n", offsets, hessian, offsets).reshape(basin.states.shape[:2])
    size = np.quantile(quadratic[:, 0], 0.5) if depth is None else depth
    basis = power_basis(dynamics.symbols, attractor.position, extent * np.sqrt(2 * size), degree=degree)
    order = basis.exponents.sum(axis=1)
    free = order > 2
    coefficients = np.zeros(basis.size)
    for index in np.flatnonzero(~free):
        i, j = np.repeat(np.arange(len(extent)), basis.exponents[index])
        factor = 0.5 if i == j else 1.0
        coefficients[index] = factor * hessian[i, j] * basis.scale[i] * basis.scale[j]
    values = basis.values(flat) @ coefficients
    # The first level has points enough for all coefficients.
    reached = np.sort(basin.highest(values.reshape(basin.states.shape[:2]))[tuple(basin.chosen.T)])
    level = float(reached[min(4 * basis.size, len(reached) - 1)])
    if depth is not None:
        level = min(level, FIRST_SHARE * depth)
    return _grown(
        dynamics, basin, saddles, basis, coefficients, free=free, metric=hessian,
        level=level, fitted=np.zeros(0, dtype=int), generator=generator,
        depth=depth,
    )  # fmt: skip


def _grown(
    dynamics: Dynamics,
    basin: Basin,
    saddles: Sequence[Equilibrium | Cycle],
    basis: PowerBasis,
    coefficients: np.ndarray,
    *,
    free: np.ndarray,
    metric: np.ndarray,
    level: float,
    fitted: np.ndarray,
    generator: np.random.Generator,
    depth: float | None = None,
) -> Well:
    """V grown from a start, level by level, to its lowest saddle or to the end of the recorded region.

    Parameters
    ----------
    basis, coefficients
        The start.
    free
        Which coefficients may change, as a mask.
    metric
        In which distances are measured, shape ``(d, d)``: the Hessian of V at the attractor.
    level
        The first one.
    fitted
        Rows of ``basin.chosen`` on which the start was fitted, as far as it was.
    dynamics, basin, saddles, generator, depth
        As for `grow_well`.
    """
    attractor = basis.center
    flat = basin.states.reshape(-1, len(attractor))
    functions = basis.values(flat)

    def along(current: np.ndarray) -> np.ndarray:
        return (functions @ current).reshape(basin.states.shape[:2])

    tops = np.array([one.position for one in saddles]).reshape(-1, len(attractor))
    width = np.ptp(flat, axis=0)
    values = along(coefficients)
    residual, points, last, recorded = np.inf, np.zeros((0, len(attractor))), False, 0.0
    places = basin.points(np.arange(len(basin.chosen))) @ np.linalg.cholesky(metric)
    spacing = cKDTree(places).query(places, k=2)[0][:, 1]
    ends: list[float] = []
    for _ in range(MOST_ROUNDS):
        rows = basin.below(values, level)
        before = len(fitted)
        if before:  # far from the last fit V is an extrapolation, and may be low by mistake
            away = cKDTree(places[fitted]).query(places[rows])[0]
            rows = rows[away < REACH * np.sqrt(2 * level) + 2 * spacing[rows]]
        fitted = rows
        if len(rows) > MOST_POINTS:
            rows = np.sort(generator.choice(rows, MOST_POINTS, replace=False))
        points = basin.points(rows)
        if len(points) < 2 * basis.size:
            raise NumericalFailure(_too_few(attractor, len(points), before=before, needed=2 * basis.size))
        equation = equation_at(basis, points, dynamics, attractor=attractor)
        steps, tolerance = (40, 1e-13) if last else (8, ON_THE_WAY)
        solution = gauss_newton(equation, coefficients, free=free, steps=steps, tolerance=tolerance)
        coefficients, residual = solution.coefficients, solution.residual
        values = along(coefficients)
        recorded = _recorded(basin.starts(values), len(attractor))
        limit = depth or min(_lowest(basis.values(tops) @ coefficients, tops, points, width, level), recorded)
        if last and abs(limit - level) < SETTLED * level and len(fitted) <= (1 + SETTLED) * before:
            break
        if any(abs(limit - one) < REPEATED * level for one in ends):  # from here on in circles
            break
        if last:
            ends.append(level)
        last = GROWTH * level >= limit
        level = limit if last else GROWTH * level
    if depth is not None:
        saddle = tops[0] if level == depth and residual < NO_SOLUTION else None
    else:
        saddle, level = _end(basis.values(tops) @ coefficients, tops, points, width, level)
    # A V that vanishes is a solution too, and the end of what starts far from any other.
    if not (np.isfinite(residual) and level > 0) or (saddle is None and level < (1 - SETTLED) * recorded):
        degree = int(basis.exponents.sum(axis=1).max())
        raise NumericalFailure(
            f"powers of degree {degree} do not follow V from the attractor near {attractor.round(4)} up to a"
            " saddle"
        )
    return Well(dynamics, attractor, basis, coefficients, level, saddle, residual, points)


def _end(
    heights: np.ndarray, tops: np.ndarray, points: np.ndarray, width: np.ndarray, level: float
) -> tuple[np.ndarray | None, float]:
    """The saddle at which growing has ended, with V there; None where it ended before one."""
    if not len(tops):
        return None, level
    nearest = int(np.argmin(np.abs(heights - level)))
    beside = _distances(tops[nearest : nearest + 1], points, width)[0] < CLOSE
    if abs(heights[nearest] - level) < (4 if beside else 1) * AT_LEVEL * level:
        return tops[nearest], float(heights[nearest])
    return None, level


def _too_few(attractor: np.ndarray, count: int, *, before: int, needed: int) -> str:
    """Why a fit cannot go on, in words: few states lead to the attractor, or V has left them."""
    place = f"the attractor near {attractor.round(4)}"
    if not before:
        return f"only {count} recorded states lead to {place}"
    return f"V about {place} leaves the recorded states: it came from {before} to {count} and needs {needed}"


def _lowest(
    heights: np.ndarray, tops: np.ndarray, points: np.ndarray, width: np.ndarray, level: float
) -> float:
    """V of the lowest saddle, as far as the current V can be believed there.

    Far from the points of the fit it is an extrapolation: a saddle that seems to lie lower than points
    already reached does not count, unless they are close to it.
    """
    believed = (heights > (1 - AT_LEVEL) * level) | (_distances(tops, points, width) < CLOSE)
    return float(heights[believed & (heights > 0)].min(initial=np.inf))


def _recorded(starts: np.ndarray, dimension: int) -> float:
    """The level that recordings reach, of V at the starts of descents, shape ``(n,)``.

    Below it there may be states to every side without a start; but of one state whatever lies below its
    highest start lies on the way down from it.
    """
    return float(np.quantile(starts, HIGHEST if dimension > 1 else 1.0))


def _distances(tops: np.ndarray, points: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Of each saddle from the nearest point of a fit, as a share of the recorded box."""
    return np.array([np.abs((points - top) / width).max(axis=1).min() for top in tops])


def fit_well(
    dynamics: Dynamics,
    attractor: Equilibrium,
    basin: Basin,
    saddles: Sequence[Equilibrium],
    potential: Callable[[np.ndarray], np.ndarray],
    *,
    degree: int,
    generator: np.random.Generator,
    steps: int = 60,
) -> Well:
    """V about an attractor by the network route: from values of V, refined without M.

    Where one formula cannot hold over several wells, the network route takes each for itself. It starts on
    the states where the network says that V is low, since networks are worst far out, and which are low is
    all that it has of them in the end: from there V grows by itself, as in the local route, but with all
    powers free. Were it fitted on what the network takes for the well, it would have to be compared with the
    local route at states beyond, where it says nothing.

    Parameters
    ----------
    potential
        V_θ, points ``(n, d)`` to values ``(n,)``, up to a constant.
    dynamics, attractor, basin, saddles, degree, generator
        As for `grow_well`.
    steps
        Most steps of Gauss–Newton at the start.

    Raises
    ------
    NumericalFailure
        When the networks leave too few states for a start, or no start grows to a well.
    """
    lowest = float(potential(attractor.position[None])[0])
    flat = basin.states.reshape(-1, basin.states.shape[2])
    along = (potential(flat) - lowest).reshape(basin.states.shape[:2])
    tops = np.array([one.position for one in saddles]).reshape(-1, flat.shape[1])
    highest = _recorded(basin.starts(along), flat.shape[1])
    level = min(float((potential(tops) - lowest).min(initial=np.inf)), highest)
    failure: NumericalFailure | None = None
    for share in STARTS:
        rows = basin.below(along, share * level)
        if len(rows) > MOST_POINTS:
            rows = np.sort(generator.choice(rows, MOST_POINTS, replace=False))
        points = basin.points(rows)
        scale = np.abs(points - attractor.position).max(axis=0, initial=0.0)
        basis = power_basis(
            dynamics.symbols, attractor.position, np.where(scale > 0, scale, 1.0), degree=degree
        )
        if len(points) < 2 * basis.size:
            failure = failure or NumericalFailure(
                f"the networks leave only {len(points)} recorded states below the saddle of the attractor"
                f" near {attractor.position.round(4)}"
            )
            continue
        # The low powers first: what points on slow manifolds leave open of the high ones would run away.
        low = basis.exponents.sum(axis=1) <= LOW
        start = np.zeros(basis.size)
        start[low] = np.linalg.lstsq(basis.values(points)[:, low], potential(points) - lowest, rcond=1e-10)[0]
        equation = equation_at(basis, points, dynamics)
        start = gauss_newton(equation, start, free=low, steps=steps).coefficients
        solution = gauss_newton(equation, start, steps=steps)
        start = solution.coefficients
        metric = basis.hessians(attractor.position[None])[0] @ start
        curvature = np.linalg.eigvalsh(metric * np.outer(basis.scale, basis.scale))
        # Up to half of these states, but no fewer than the coefficients need: a start that just has enough of
        # them would otherwise be refused for want of states.
        ways = basin.highest((basis.values(flat) @ start).reshape(along.shape))
        heights = np.sort(ways[tuple(basin.chosen[rows].T)])
        enough = max(len(heights) // 2, 2 * basis.size)
        first = float(heights[min(enough, len(heights) - 1)]) * (1 + ON_THE_WAY)
        # V = 0 is a solution too, and what tends to it has a residual as large as itself.
        if not solution.residual < NO_SOLUTION or curvature[0] <= FLAT * curvature[-1] or first <= 0:
            failure = NumericalFailure(
                f"the networks' V leads to none with a minimum at the attractor near"
                f" {attractor.position.round(4)}"
            )
            continue
        try:
            return _grown(
                dynamics, basin, saddles, basis, start,
                free=np.ones(basis.size, dtype=bool), metric=metric, level=first, fitted=rows,
                generator=generator,
            )  # fmt: skip
        except NumericalFailure as error:
            failure = error
    assert failure is not None  # there is at least one start
    raise failure
