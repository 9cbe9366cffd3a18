"""How are points laid along a curve, so that the action of their chain is accurate?

About an attractor or a cycle a path may wind for long, and a chain is continued there as linear dynamics
goes, to where its level is as small as is asked for.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
from scipy.integrate import solve_ivp
from scipy.interpolate import Akima1DInterpolator

from siq.landscape.discretised_paths import PathProblem
from siq.landscape.tubes import Tube

START_SHARE = 1e-6  # of the action: U on the ellipsoid where a chain begins
CENTRAL = 0.005  # of the distance to the end: nearer to the attractor points lie no closer together
COINCIDING = 1e-14  # numerical, of the length: neighbours so close are one point
MOST_NODES = 60_000  # numerical, a guard on memory: 60 000 blocks of d × d
MOST_TURNS, STEPS_OF_A_TURN = 300, 64  # of a path from or to a cycle, within linear dynamics
SPIRAL_STEP = 0.15  # of the shortest time of the linear dynamics


def spaced(problem: PathProblem, y: np.ndarray, count: int, level: float) -> np.ndarray:
    """A chain along another one, which begins where the level is as given and is spaced for accuracy.

    Near an attractor the segments are in proportion to the distance from it, in the metric of M, since the
    path may wind.
    """
    if problem.hessian is not None and problem.level(y[:1])[0] > level > 0:
        y = np.vstack([spiral(problem, y[0], level / problem.level(y[:1])[0]), y])
    if level > 0 and isinstance(problem.begin, Tube):
        y = np.vstack([_winding(problem, problem.begin, y[0], level, -1.0)[::-1], y])
    if level > 0 and problem.finish is not None:
        y = np.vstack([y, _winding(problem, problem.finish, y[-1], level, 1.0)])
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(y, axis=0), axis=1))]
    apart = np.append(np.diff(length) > COINCIDING * length[-1], True)
    length, y = length[apart], y[apart]
    curve = Akima1DInterpolator(length, y)
    dense = np.interp(np.arange(0, len(y) - 0.95, 0.1), np.arange(len(y)), length)
    y = curve(dense)
    if problem.begin is not None:
        first = max(int(np.flatnonzero(problem.level(y) <= level).max(initial=0)), 0)
        dense, y = dense[first:], y[first:]
    if problem.finish is not None:
        beyond = np.flatnonzero(problem.finish.level(y) > level).max(initial=len(y) - 3) + 2
        dense, y = dense[:beyond], y[:beyond]
    measure = np.r_[0, np.cumsum(relative_lengths(problem, y))]
    return curve(np.interp(np.linspace(0, measure[-1], count), measure, dense))


def relative_lengths(problem: PathProblem, y: np.ndarray) -> np.ndarray:
    """Lengths of the segments, relative to what they should be."""
    forward, middles = np.diff(y, axis=0), (y[1:] + y[:-1]) / 2
    if problem.hessian is None:
        return np.linalg.norm(forward, axis=1)
    near = np.sqrt(problem.level(middles)) + CENTRAL * np.sqrt(problem.level(problem.end[None]))
    return np.sqrt(problem.level(forward)) / near


def spiral(problem: PathProblem, last: np.ndarray, share: float) -> np.ndarray:
    """The way that linear dynamics takes to a point from where its level is a share of the one there."""
    assert problem.hessian is not None
    flow = problem.jacobian(np.zeros((1, len(last))))[0] + 2 * problem.hessian
    back = scipy.linalg.expm(-SPIRAL_STEP * flow / np.abs(np.linalg.eigvals(flow)).max())
    lowest = share * problem.level(last[None])[0]
    y = [back @ last]
    while y[-1] @ problem.hessian @ y[-1] > lowest and len(y) < MOST_NODES:
        y.append(back @ y[-1])
    return np.array(y[::-1])


def _winding(problem: PathProblem, tube: Tube, last: np.ndarray, level: float, sense: float) -> np.ndarray:
    """The way by linear dynamics from a point onwards to a tube, or back to where it left one.

    ``ẏ = F + 2Dp`` with ``p`` as the quadratic cost has it, with or against time.
    """

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        slope, force = tube.slope(y), problem.force(y[None])[0]
        push = slope if problem.constant else problem.noise.at(y[None])[0] @ slope
        return np.asarray(sense * force - push)

    def arrives(_: float, y: np.ndarray) -> float:
        return float(tube.level(y[None])[0] - level)

    arrives.terminal = True  # type: ignore[attr-defined]
    if not arrives(0.0, last) > 0:
        return np.zeros((0, len(last)))
    way = solve_ivp(
        rates, (0.0, MOST_TURNS * tube.period), last, rtol=1e-4, atol=1e-6,
        max_step=tube.period / STEPS_OF_A_TURN, events=arrives,
    )  # fmt: skip
    return np.asarray(way.y[:, 1:].T)


def evenly(points: np.ndarray, count: int) -> np.ndarray:
    """Evenly spaced points on a polygon."""
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    places = np.linspace(0, along[-1], count)
    return np.stack([np.interp(places, along, column) for column in points.T], axis=1)
