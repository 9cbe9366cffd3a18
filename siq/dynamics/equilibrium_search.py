"""All equilibria of given equations in their domain, without any trajectory.

Newton's method starts from a low-discrepancy sequence over the domain, more and more densely until nothing
new is found; then again with the known roots deflated, which leads to roots with a small neighbourhood of
their own. In one and two dimensions the topological degree of f on the boundary of the domain is the sum of
the indices ``sign det J`` of all roots within: where this fails a root was missed, and that is said. No
search in more dimensions proves that nothing was missed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import Equilibrium, classified, distinct_roots

FIRST = 128  # starts of the first round, times the number of states
ROUNDS = 5  # of search, each with twice as many starts, ...
QUIET = 2  # ... until as many in a row found nothing new
DEFLATED = 256  # starts of each round with deflation
MOST_DEFLATIONS = 8
EDGE = 1e-6  # of the domain, by which a root on its boundary may be off: a double one is found to 1e-8
BOUNDARY = 4096  # points on the boundary, for its degree
TURN = 2.0  # radian: f that turns by more from one of them to the next is not followed
NEAR_EDGE = 1e-3  # of the domain: so close to the boundary a root leaves the degree undefined


@dataclass(frozen=True)
class FoundEquilibria:
    """Equilibria of a domain.

    Attributes
    ----------
    equilibria
        By their position along the first state.
    notes
        What speaks against their being all, in words.
    """

    equilibria: tuple[Equilibrium, ...]
    notes: tuple[str, ...] = ()


def spread_evenly(box: np.ndarray, count: int, *, generator: np.random.Generator) -> np.ndarray:
    """Points of a scrambled Sobol sequence in a box ``(d, 2)``: shape ``(n, d)``, n not below `count`."""
    sequence = qmc.Sobol(len(box), scramble=True, seed=generator)
    share = sequence.random_base2(max(int(np.ceil(np.log2(count))), 1))
    return np.asarray(box[:, 0] + share * (box[:, 1] - box[:, 0]))


def all_equilibria(dynamics: Dynamics, *, generator: np.random.Generator) -> FoundEquilibria:
    """Equilibria in the domain of a system.

    Parameters
    ----------
    dynamics
        f, with its domain.
    generator
        Scrambles the sequences of starts.
    """
    box, d = dynamics.box, dynamics.dimension
    found: list[np.ndarray] = []
    quiet, count, starts = 0, FIRST * d, np.zeros((0, d))
    for _ in range(ROUNDS):
        starts = spread_evenly(box, count, generator=generator)
        new = _new(found, distinct_roots(dynamics, starts, box=box, margin=EDGE), box)
        found, quiet, count = [*found, *new], 0 if new else quiet + 1, 2 * count
        if quiet == QUIET:
            break
    for _ in range(MOST_DEFLATIONS if found else 0):
        some = spread_evenly(box, DEFLATED, generator=generator)
        new = distinct_roots(dynamics, some, box=box, margin=EDGE, known=found)
        if not new:
            break
        found += new
    width = np.ptp(box, axis=1)
    rate = float(np.median(np.linalg.norm(dynamics.drift(starts) / width, axis=1)))
    equilibria = tuple(classified(dynamics, found, box=box, rate=rate))
    degree = boundary_degree(dynamics, equilibria)
    if degree is None or degree == _indices(dynamics, equilibria):
        return FoundEquilibria(equilibria)
    note = (
        "an equilibrium of the domain was missed: the directions of f along the boundary of the domain turn"
        f" {degree} times, which the {len(equilibria)} that were found do not explain"
    )
    return FoundEquilibria(equilibria, (note,))


def boundary_degree(dynamics: Dynamics, equilibria: tuple[Equilibrium, ...]) -> int | None:
    """How often f turns along the boundary of the domain: the sum of the indices of all roots within.

    None in more than two dimensions, and where a root on the boundary, or a degenerate one, leaves it open.
    """
    box, d = dynamics.box, dynamics.dimension
    width = np.ptp(box, axis=1)
    places = [one.position for one in equilibria]
    near = any(
        (np.minimum(place - box[:, 0], box[:, 1] - place) / width < NEAR_EDGE).any() for place in places
    )
    if d > 2 or near or any(one.kind == "degenerate" for one in equilibria):
        return None
    if d == 1:
        low, high = np.sign(dynamics.drift(box.T)[:, 0])
        return round(float(high - low) / 2)
    share = np.linspace(0, 1, BOUNDARY // 4, endpoint=False)
    zero, one = np.zeros_like(share), np.ones_like(share)
    along = [(share, zero), (one, share), (1 - share, one), (zero, 1 - share)]
    around = np.concatenate([np.stack(side, axis=1) for side in along])
    flow = dynamics.drift(box[:, 0] + around * width) / width
    angle = np.arctan2(flow[:, 1], flow[:, 0])
    turn = np.diff(np.append(angle, angle[0]))
    turn -= 2 * np.pi * np.round(turn / (2 * np.pi))
    if not np.abs(turn).max() < TURN:  # also where f is not finite
        return None
    return int(np.round(turn.sum() / (2 * np.pi)))


def _indices(dynamics: Dynamics, equilibria: tuple[Equilibrium, ...]) -> int:
    """Sum of ``sign det J``."""
    jacobians = [dynamics.jacobian(one.position[None])[0] for one in equilibria]
    return int(sum(np.sign(np.linalg.det(one)) for one in jacobians))


def _new(known: list[np.ndarray], found: list[np.ndarray], box: np.ndarray) -> list[np.ndarray]:
    width = np.ptp(box, axis=1)
    return [one for one in found if all(np.abs((one - other) / width).max() > EDGE for other in known)]
