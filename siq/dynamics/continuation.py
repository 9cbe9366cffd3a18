"""Where do equilibria go when a parameter changes?

A branch ``f(x(s), λ(s)) = 0`` is followed along its own length s, not along λ, so that it passes through its
folds: a step along the tangent, then Newton's method across it (`siq.dynamics.parameter_family`). What
happens between its points is in `siq.dynamics.bifurcations`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from siq.dynamics.bifurcations import Bifurcation, bifurcations_between, distinct
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.parameter_family import (
    BranchPoint,
    ParameterFamily,
    corrected,
    outside,
    pinned,
    point_on,
)

LONGEST = 0.01  # step along a branch: a curve of a hundred chords looks smooth
SHORTEST = 1e-9  # a branch that asks for shorter steps is given up
BENT = 0.98  # least cosine of the angle between the tangents of a step's ends: 11 degrees
SAME = 1e-6  # closer points are one
MOST_POINTS = 20_000  # of one branch, a guard


@dataclass(frozen=True, eq=False)
class Branch:
    """Equilibria along a branch.

    Attributes
    ----------
    values
        Of the parameter, shape ``(n,)``.
    states
        Shape ``(n, d)``.
    eigenvalues
        Of ∂f/∂x, by falling real part, shape ``(n, d)``.
    tangents
        In shares of the domain and of the range, the parameter last: shape ``(n, d + 1)``.
    """

    values: np.ndarray
    states: np.ndarray
    eigenvalues: np.ndarray
    tangents: np.ndarray

    @property
    def unstable(self) -> np.ndarray:
        """Number of unstable directions of each, shape ``(n,)``."""
        return np.asarray((self.eigenvalues.real > 0).sum(axis=1))


@dataclass(frozen=True, eq=False)
class Branches:
    """All branches that pass through given equilibria.

    Attributes
    ----------
    branches
        Each once.
    bifurcations
        By the value of the parameter.
    notes
        What could not be followed, in words.
    """

    branches: tuple[Branch, ...]
    bifurcations: tuple[Bifurcation, ...]
    notes: tuple[str, ...] = ()


def follow_branches(
    dynamics: Dynamics,
    parameter: str,
    limits: tuple[float, float],
    seeds: Sequence[tuple[float, np.ndarray]],
) -> Branches:
    """Branches of equilibria within a range of a parameter and within the domain of the states.

    Parameters
    ----------
    dynamics
        f with its domain and parameters.
    parameter
        Name of the parameter λ.
    limits
        The range of λ, lower before upper.
    seeds
        Known equilibria: the value of λ and the state, shape ``(d,)``. A branch through none of them is not
        found.

    Examples
    --------
    A cusp, ``ẋ = h + x - x³``, folds at ``h = ±2/(3√3)``:

    >>> import sympy
    >>> h, x = sympy.symbols("h x", real=True)
    >>> cusp = Dynamics.of((x,), (h + x - x**3,), domain=[(-2, 2)], parameters={h: 0.0})
    >>> found = follow_branches(cusp, "h", (-1.0, 1.0), [(0.0, np.array([1.0]))])
    >>> [(one.kind, round(one.value, 10)) for one in found.bifurcations]
    [('fold', -0.3849001795), ('fold', 0.3849001795)]
    """
    family = ParameterFamily(dynamics, {parameter: limits})
    branches: list[Branch] = []
    found: list[Bifurcation] = []
    notes: list[str] = []
    for value, state in seeds:
        start = pinned(family, family.shares(np.atleast_2d(state), np.array([value]))[0], family.d)
        if start is None or outside(start) is not None:
            continue
        if any(place_on(family, branch, start) is not None for branch in branches):
            continue
        points, fault = _both_ways(family, start)
        if fault:
            notes.append(
                f"the branch through {np.round(state, 4).tolist()} at {parameter} = {value:g} {fault}"
            )
        if len(points) < 2:
            continue
        branch = _as_branch(family, points)
        found += bifurcations_between(family, points, len(branches))
        branches.append(branch)
    return Branches(
        tuple(branches), tuple(sorted(distinct(family, found), key=lambda one: one.value)), tuple(notes)
    )


def place_on(family: ParameterFamily, branch: Branch, z: np.ndarray) -> int | None:
    """The point of a branch next to a state and value in shares ``(d + 1,)``; None where it is not on it."""
    along = family.shares(branch.states, branch.values)
    distance = np.linalg.norm(along - z, axis=1)
    for index in np.argsort(distance)[:4]:
        if distance[index] > 2 * LONGEST:
            break
        tangent = branch.tangents[index]
        moved = corrected(family, along[index] + (z - along[index]) @ tangent * tangent, tangent)
        if moved is not None and np.abs(moved - z).max() < SAME:
            return int(index)
    return None


def _both_ways(family: ParameterFamily, start: np.ndarray) -> tuple[list[BranchPoint], str]:
    """A branch from end to end through a point, and what stopped it before its end, in words."""
    ahead = np.append(np.zeros(family.d), 1.0)
    first = point_on(family, start, ahead)
    forwards, closed, fault = _one_way(family, first)
    if closed:
        return forwards, fault
    turned = replace(first, tangent=-first.tangent)
    backwards, _, other = _one_way(family, turned)
    backwards = [replace(one, tangent=-one.tangent) for one in backwards[:0:-1]]
    return [*backwards, *forwards], fault or other


def _one_way(family: ParameterFamily, start: BranchPoint) -> tuple[list[BranchPoint], bool, str]:
    """Points of a branch from one on, whether it came back to it, and what stopped it, in words."""
    points, length = [start], LONGEST / 4
    while len(points) < MOST_POINTS:
        last = points[-1]
        z = corrected(family, last.z + length * last.tangent, last.tangent)
        new = None if z is None else point_on(family, z, last.tangent)
        if new is None or not _smooth(last, new, length):
            length /= 2
            if length < SHORTEST:
                return points, False, "could not be followed to its end"
            continue
        if (component := outside(new.z)) is not None:
            points += _last_point(family, last, new, component)
            return points, False, ""
        points.append(new)
        if len(points) > 4 and _passes(last, new, start):
            return [*points[:-1], replace(start)], True, ""
        length = min(1.5 * length, LONGEST)
    return points, False, f"has more than {MOST_POINTS} points"


def _smooth(last: BranchPoint, new: BranchPoint, length: float) -> bool:
    """Whether a step stayed on its branch, and no two changes of stability can hide in it."""
    apart = np.linalg.norm(new.z - last.z)
    bent = last.tangent @ new.tangent
    changed = abs(new.unstable - last.unstable)
    resolved = changed < 2 or (changed == 2 and _oscillating(last) and _oscillating(new))
    return bool(bent > BENT and apart < 1.5 * length and (resolved or length < 1e3 * SHORTEST))


def _oscillating(point: BranchPoint) -> bool:
    """Whether the eigenvalues next to the imaginary axis are a pair of complex ones."""
    return bool(point.eigenvalues[np.abs(point.eigenvalues.real).argmin()].imag != 0)


def _passes(last: BranchPoint, new: BranchPoint, start: BranchPoint) -> bool:
    """Whether a step passed the point from which the branch began, in the same direction."""
    step = new.z - last.z
    share = (start.z - last.z) @ step / (step @ step)
    across = np.linalg.norm(start.z - last.z - share * step)
    return bool(0 < share <= 1 and across < 0.1 * np.linalg.norm(step) and new.tangent @ start.tangent > 0.9)


def _last_point(
    family: ParameterFamily, last: BranchPoint, new: BranchPoint, component: int
) -> list[BranchPoint]:
    """Where a step crosses the limit of a component; nothing where that cannot be found."""
    limit = float(new.z[component] > 0.5)
    share = (limit - last.z[component]) / (new.z[component] - last.z[component])
    guess = last.z + share * (new.z - last.z)
    guess[component] = limit
    z = pinned(family, guess, component)
    if z is None or np.linalg.norm(z - guess) > LONGEST:
        return []
    return [point_on(family, z, last.tangent)]


def _as_branch(family: ParameterFamily, points: Sequence[BranchPoint]) -> Branch:
    both = family.natural(np.array([one.z for one in points]))
    return Branch(
        both[:, -1], both[:, :-1],
        np.array([one.eigenvalues for one in points]), np.array([one.tangent for one in points]),
    )  # fmt: skip
