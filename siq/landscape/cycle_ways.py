"""Ways out of wells that begin on a cycle, lead over one, or end on one.

A cycle is an attractor as a point is: a path may leave it at any phase. What parts two basins may be a
saddle, or an unstable cycle, on which the path ends at any phase, too. From there f leads on.
"""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp

from siq.dynamics.cycles import Cycle, unstable_direction
from siq.dynamics.descents import ends_of
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import Equilibrium
from siq.dynamics.phase_portrait import PhasePortrait
from siq.errors import NumericalFailure
from siq.landscape.chain_spacing import evenly
from siq.landscape.paths import TransitionPath, minimum_action_path

BESIDE = 1e-3  # of the domain: from where f leads on, beside what parts two basins
ARRIVED = 1e-2  # of the domain: so close to an attractor a way down is drawn
LONGEST = 100.0  # periods, in which it has to be there
POINTS = 200  # of a way down


def both_sides(dynamics: Dynamics, cycle: Cycle, portrait: PhasePortrait) -> np.ndarray:
    """Where f leads from both sides of an unstable cycle: numbers of attractors, -1 elsewhere."""
    starts = _beside(dynamics, cycle, 0, portrait.box)
    return ends_of(dynamics, starts, portrait.attractors, portrait.cycles, box=portrait.box)


def way_about_cycles(
    dynamics: Dynamics,
    portrait: PhasePortrait,
    start: int,
    over: Equilibrium | Cycle,
    end: int | None,
    *,
    tolerance: float,
) -> TransitionPath:
    """The path of least action to what parts two basins, and the way on.

    Parameters
    ----------
    dynamics
        f and D.
    portrait
        What is stable.
    start, end
        Numbers of attractors, of cycles after those of points; the end is None where f leads out of the
        region.
    over
        The saddle, or the unstable cycle.
    tolerance
        Of the action.

    Raises
    ------
    NumericalFailure
        When there is no such path that could be found.
    """
    settled: list[np.ndarray | Cycle] = [*(one.position for one in portrait.attractors), *portrait.cycles]
    last = over if isinstance(over, Cycle) else over.position
    uphill = minimum_action_path(dynamics, settled[start], last, tolerance=tolerance)
    if end is None:
        return TransitionPath(uphill, uphill.points[-1:])
    return TransitionPath(uphill, _downhill(dynamics, over, uphill.points[-1], settled[end], portrait.box))


def _beside(dynamics: Dynamics, over: Equilibrium | Cycle, place: int, box: np.ndarray) -> np.ndarray:
    """Two states on either side of a saddle, or of a point of an unstable cycle."""
    width = np.ptp(box, axis=1)
    if isinstance(over, Cycle):
        direction, position = unstable_direction(dynamics, over, place, scale=width), over.points[place]
    else:
        values, vectors = np.linalg.eig(dynamics.jacobian(over.position[None])[0])
        direction, position = vectors[:, np.argmax(values.real)].real, over.position
    direction = BESIDE * direction / np.abs(direction / width).max()
    return np.stack([position + direction, position - direction])


def _downhill(
    dynamics: Dynamics,
    over: Equilibrium | Cycle,
    begin: np.ndarray,
    target: np.ndarray | Cycle,
    box: np.ndarray,
) -> np.ndarray:
    width = np.ptp(box, axis=1)
    place = 0
    if isinstance(over, Cycle):
        place = int(np.argmin(np.linalg.norm((over.points - begin) / width, axis=1)))
    cycle = target if isinstance(target, Cycle) else over
    if isinstance(cycle, Cycle):
        period = cycle.period
    else:
        raise ValueError("neither end is a cycle")

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        return np.asarray(dynamics.drift((y * width)[None])[0] / width)

    def arrives(_: float, y: np.ndarray) -> float:
        if isinstance(target, Cycle):
            return float(target.distances((y * width)[None], scale=width)[0] - ARRIVED)
        return float(np.linalg.norm(y - target / width) - ARRIVED)

    arrives.terminal = True  # type: ignore[attr-defined]
    for start in _beside(dynamics, over, place, box):
        way = solve_ivp(
            rates, (0.0, LONGEST * period), start / width, rtol=1e-6, atol=1e-8, max_step=period / 40,
            events=arrives,
        )  # fmt: skip
        if len(way.t_events[0]):
            return evenly(np.vstack([begin[None], way.y.T * width]), POINTS)
    raise NumericalFailure("f does not lead on to the attractor behind what parts the basins")
