"""Continuation of equilibria along a parameter, with their folds, Hopf and branch points.

All lengths are shares of the domain of each state and of the range of each parameter λ. A point of a branch
``f(x(s), λ(s)) = 0`` is found by Newton's method across a tangent, which passes folds as well as anything.

References
----------
H. B. Keller, in Applications of Bifurcation Theory (1977) 359: pseudo-arclength continuation.

Between two points of a branch ``f(x(s), λ(s)) = 0``, with A = ∂f/∂x,

- a *fold* lies where the tangent turns back in λ (det A = 0, while ∂f/∂λ leaves the range of A): two
  equilibria meet there and vanish;
- a *Hopf point* lies where a pair of complex eigenvalues of A crosses the imaginary axis: an oscillation
  begins;
- a *branch point* lies where det A = 0 and ∂f/∂λ is in the range of A: another branch crosses this one.

Folds solve ``f = 0, A v = 0, c·v = 1``, Hopf points ``f = 0, A (u + iw) = iω (u + iw), c·u = 1, c·w = 0``,
and branch points ``f + βe = 0, ψA = 0, ψ·∂f/∂λ = 0, e·ψ = 1``, all by Newton's method with exact second
derivatives. These systems are regular at such points, which are then found to rounding.

References
----------
G. Moore, A. Spence, SIAM J. Numer. Anal. 17 (1980) 567: folds.
G. Moore, Numer. Funct. Anal. Optim. 2 (1980) 441: branch points.
A. Griewank, G. Reddien, IMA J. Numer. Anal. 3 (1983) 295: Hopf points.

A branch ``f(x(s), λ(s)) = 0`` is followed along its own length s, not along λ, so that it passes through its
folds: a step along the tangent, then Newton's method across it (`siq.systems.continuation`). What
happens between its points is in `siq.systems.continuation`.

A fold that was found along one line of the plane is a point of a curve: at each of its points

    f(x, λ, μ) = 0,   A q = 0,   |q| = 1          (a fold; A = ∂f/∂x)
    f(x, λ, μ) = 0,   A (u + iw) = iω (u + iw),   |u|² + |w|² = 1,   c·w = 0          (a Hopf point)

which is one equation fewer than unknowns. The curve is followed along its own length in all of them, as a
branch of equilibria is (`siq.systems.continuation`). In these unknowns it has no corner at a cusp, at which
two curves of folds meet in the plane, and a curve of folds passes a point of Bogdanov and Takens. A curve of
Hopf points ends there, with ω = 0.

References
----------
Yu. A. Kuznetsov, Elements of Applied Bifurcation Theory (2004), chapter 10.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.optimize import brentq

from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, symbol
from siq.systems.formulas import exact_number

NEWTON_STEPS = 12
CONVERGED = 1e-12  # last step of Newton's method, numerical
EDGE = 1e-6  # by which a branch may run outside the domain: as equilibria are sought


class ParameterFamily:
    """f against some of its parameters, in shares of the domain and of their ranges.

    Parameters
    ----------
    dynamics
        f with its domain and parameters; those that are not named have their values.
    limits
        For each parameter by its name the range of its values, lower before upper.

    Raises
    ------
    ValueError
        When there is no such parameter, or no domain.
    """

    def __init__(self, dynamics: Dynamics, limits: Mapping[str, tuple[float, float]]) -> None:
        known = [each.name for each in dynamics.parameters]
        for name in limits:
            if name not in known:
                raise ValueError(f"there is no parameter '{name}'")
        others = {
            symbol(each.name): exact_number(each.value)
            for each in dynamics.parameters
            if each.name not in limits
        }
        formulas = [each.xreplace(others) for each in dynamics.equations]
        box = np.vstack([dynamics.box, *limits.values()])
        self.d = dynamics.dimension
        self.low, self.width = box[:, 0], np.ptp(box, axis=1)
        # Parameters as states that stay where they are: all derivatives are those of Dynamics.
        self._of_both = Dynamics.of(
            (*dynamics.symbols, *map(symbol, limits)), (*formulas, *[0] * len(limits)),
            diffusion=Diffusion.identity(self.d + len(limits)),
        )  # fmt: skip

    def shares(self, states: np.ndarray, values: np.ndarray) -> np.ndarray:
        """States ``(n, d)`` and values, ``(n,)`` or ``(n, p)``, as shares, ``(n, d + p)``."""
        return (np.column_stack([states, values]) - self.low) / self.width

    def natural(self, z: np.ndarray) -> np.ndarray:
        """Shares as states and, last, the values."""
        return np.asarray(self.low + z * self.width)

    def flow(self, z: np.ndarray) -> np.ndarray:
        """F in shares of the domain per unit of time, at one point ``(d + p,)``: shape ``(d,)``."""
        with np.errstate(all="ignore"):
            return np.asarray(self._of_both.drift(self.natural(z)[None])[0, : self.d] / self.width[: self.d])

    def slopes(self, z: np.ndarray) -> np.ndarray:
        """Its derivatives by states and parameters, shape ``(d, d + p)``."""
        with np.errstate(all="ignore"):
            found = self._of_both.jacobian(self.natural(z)[None])[0, : self.d]
        return np.asarray(found * self.width / self.width[: self.d, None])

    def bends(self, z: np.ndarray) -> np.ndarray:
        """Its second derivatives, shape ``(d, d + p, d + p)``."""
        with np.errstate(all="ignore"):
            found = self._of_both.hessian(self.natural(z)[None])[0, : self.d]
        return np.asarray(found * self.width[:, None] * self.width / self.width[: self.d, None, None])


@dataclass(frozen=True, eq=False)
class BranchPoint:
    """A point of a branch: where it is in shares, its tangent, and the eigenvalues of ∂f/∂x."""

    z: np.ndarray
    tangent: np.ndarray
    eigenvalues: np.ndarray

    @property
    def unstable(self) -> int:
        """Number of unstable directions."""
        return int((self.eigenvalues.real > 0).sum())


def point_on(family: ParameterFamily, z: np.ndarray, ahead: np.ndarray) -> BranchPoint:
    """A point with its tangent to the side of a direction."""
    slopes = family.slopes(z)
    tangent = np.linalg.svd(slopes)[2][-1]
    values = np.linalg.eigvals(slopes[:, :-1])
    return BranchPoint(z, tangent if tangent @ ahead >= 0 else -tangent, values[np.argsort(-values.real)])


def outside(z: np.ndarray) -> int | None:
    """Which component of a point in shares lies furthest outside its range, None where none does."""
    beyond = np.abs(z - 0.5) - 0.5
    worst = int(beyond.argmax())
    return worst if beyond[worst] > EDGE else None


def solved(
    residual: Callable[[np.ndarray], np.ndarray],
    slope: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
) -> np.ndarray | None:
    """Newton's method; None where it does not converge. A singular slope is taken by least squares."""
    x, last = start.copy(), np.inf
    for _ in range(NEWTON_STEPS):
        value, matrix = residual(x), slope(x)
        if not (np.isfinite(value).all() and np.isfinite(matrix).all()):
            return None
        step = np.linalg.lstsq(matrix, -value, rcond=None)[0]
        x, size = x + step, float(np.abs(step).max())
        if size < CONVERGED * max(1.0, float(np.abs(x).max())):
            return x
        # Rounding may keep the last steps from falling further.
        if size < 1e3 * CONVERGED and size >= last:
            return x
        last = size
    return None


def corrected(family: ParameterFamily, guess: np.ndarray, tangent: np.ndarray) -> np.ndarray | None:
    """The point of a branch in the plane across a tangent."""
    return solved(
        lambda z: np.append(family.flow(z), tangent @ (z - guess)),
        lambda z: np.vstack([family.slopes(z), tangent]),
        guess,
    )


def pinned(family: ParameterFamily, guess: np.ndarray, index: int) -> np.ndarray | None:
    """The point of a branch next to a guess at which one component has the value that it has there."""
    return corrected(family, guess, np.eye(len(guess))[index])


BifurcationKind = Literal["fold", "Hopf", "branch point"]

NEAR = 0.01  # so far from its first place Newton's method may end: the longest step along a branch
SAME = 1e-5  # closer points are one
IN_RANGE = 1e-6  # |ψ·∂f/∂λ| to |∂f/∂λ| below which a singular point is no fold


@dataclass(frozen=True, eq=False)
class Bifurcation:
    """A point of a branch at which the number of equilibria or their stability changes.

    Attributes
    ----------
    kind
        ``fold``, ``Hopf`` or ``branch point``.
    value
        Of the parameter.
    state
        Shape ``(d,)``.
    branch
        Index of the branch on which it was found.
    frequency
        ω at a Hopf point, in radian per unit of time; 0 elsewhere.
    residual
        What is left of its equations, in shares of the domain per unit of time.
    """

    kind: BifurcationKind
    value: float
    state: np.ndarray
    branch: int
    frequency: float = 0.0
    residual: float = 0.0


def bifurcations_between(
    family: ParameterFamily, points: Sequence[BranchPoint], branch: int
) -> list[Bifurcation]:
    """What happens between the points of a branch."""
    found = []
    for last, new in pairwise(points):
        turns = last.tangent[-1] * new.tangent[-1] < 0
        odd = _determinant(family, last.z) * _determinant(family, new.z) < 0
        if turns or odd:
            found.append(_singular(family, last, new, branch, turns=turns))
        elif abs(new.unstable - last.unstable) == 2:
            found.append(_hopf(family, last, new, branch))
    return [one for one in found if one is not None]


def _determinant(family: ParameterFamily, z: np.ndarray) -> float:
    return float(np.linalg.det(family.slopes(z)[:, :-1]))


def _zero_between(
    family: ParameterFamily, last: BranchPoint, new: BranchPoint, test: Callable[[np.ndarray], float]
) -> np.ndarray:
    """Where a function changes its sign on a branch, between two of its points."""
    whole = (new.z - last.z) @ last.tangent

    def at(share: float) -> np.ndarray:
        if share in (0.0, 1.0):
            return last.z if share == 0.0 else new.z
        moved = corrected(family, last.z + share * whole * last.tangent, last.tangent)
        return last.z + share * (new.z - last.z) if moved is None else moved

    if test(last.z) * test(new.z) >= 0:  # zero at an end, up to rounding
        return min((last.z, new.z), key=lambda z: abs(test(z)))
    return at(float(brentq(lambda share: test(at(share)), 0.0, 1.0, xtol=1e-15, rtol=1e-14)))


def _singular(
    family: ParameterFamily, last: BranchPoint, new: BranchPoint, branch: int, *, turns: bool
) -> Bifurcation | None:
    """A fold or a branch point."""

    def turning(z: np.ndarray) -> float:
        return float(point_on(family, z, last.tangent).tangent[-1])

    z = _zero_between(family, last, new, turning if turns else lambda z: _determinant(family, z))
    slopes = family.slopes(z)
    left, _, right = np.linalg.svd(slopes[:, :-1])
    by_parameter = slopes[:, -1]
    if turns and abs(left[:, -1] @ by_parameter) > IN_RANGE * np.linalg.norm(slopes):
        solved = _fold(family, z, right[-1])
        if solved is not None and np.linalg.norm(solved - z) < NEAR:
            return _as_bifurcation(family, "fold", solved, branch)
    solved = _crossing(family, z, left[:, -1])
    close = solved is not None and np.linalg.norm(solved - z) < NEAR
    return _as_bifurcation(family, "branch point", solved if solved is not None and close else z, branch)


def _as_bifurcation(
    family: ParameterFamily, kind: BifurcationKind, z: np.ndarray, branch: int, frequency: float = 0.0
) -> Bifurcation:
    both, left = family.natural(z), float(np.abs(family.flow(z)).max())
    return Bifurcation(kind, float(both[-1]), both[:-1], branch, frequency, left)


def _fold(family: ParameterFamily, z: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
    """Newton's method on ``f = 0, A v = 0, c·v = 1`` for (x, λ, v), with c the first v."""
    d = family.d

    def residual(y: np.ndarray) -> np.ndarray:
        v = y[d + 1 :]
        return np.concatenate(
            [family.flow(y[: d + 1]), family.slopes(y[: d + 1])[:, :-1] @ v, [direction @ v - 1]]
        )

    def slope(y: np.ndarray) -> np.ndarray:
        slopes, bends = family.slopes(y[: d + 1]), family.bends(y[: d + 1])
        result = np.zeros((2 * d + 1, 2 * d + 1))
        result[:d, : d + 1] = slopes
        result[d : 2 * d, : d + 1] = np.einsum("ijk,j->ik", bends[:, :-1], y[d + 1 :])
        result[d : 2 * d, d + 1 :] = slopes[:, :-1]
        result[-1, d + 1 :] = direction
        return result

    found = solved(residual, slope, np.concatenate([z, direction]))
    return None if found is None else found[: d + 1]


def _crossing(family: ParameterFamily, z: np.ndarray, left: np.ndarray) -> np.ndarray | None:
    """Newton's method on ``f + βe = 0, ψA = 0, ψ·∂f/∂λ = 0, e·ψ = 1`` for (x, λ, β, ψ); e is the first ψ."""
    d = family.d

    def residual(y: np.ndarray) -> np.ndarray:
        z, share, psi = y[: d + 1], y[d + 1], y[d + 2 :]
        return np.concatenate([family.flow(z) + share * left, psi @ family.slopes(z), [left @ psi - 1]])

    def slope(y: np.ndarray) -> np.ndarray:
        z, psi = y[: d + 1], y[d + 2 :]
        slopes = family.slopes(z)
        result = np.zeros((2 * d + 2, 2 * d + 2))
        result[:d, : d + 1], result[:d, d + 1] = slopes, left
        result[d:-1, : d + 1] = np.einsum("i,ijk->jk", psi, family.bends(z))
        result[d:-1, d + 2 :] = slopes.T
        result[-1, d + 2 :] = left
        return result

    found = solved(residual, slope, np.concatenate([z, [0.0], left]))
    return None if found is None else found[: d + 1]


def _hopf(family: ParameterFamily, last: BranchPoint, new: BranchPoint, branch: int) -> Bifurcation | None:
    """A Hopf point: of (x, λ, u, w, ω) with ``A u = -ω w, A w = ω u, c·u = 1, c·w = 0``."""
    d = family.d

    def pair(z: np.ndarray) -> tuple[complex, np.ndarray]:
        values, vectors = np.linalg.eig(family.slopes(z)[:, :-1])
        turning = np.flatnonzero(values.imag > 0)
        if not len(turning):
            return complex(np.nan), vectors[:, 0]
        chosen = turning[np.abs(values[turning].real).argmin()]
        return complex(values[chosen]), vectors[:, chosen]

    if not (np.isfinite(pair(last.z)[0].real) and np.isfinite(pair(new.z)[0].real)):
        return None
    z = _zero_between(family, last, new, lambda z: pair(z)[0].real)
    value, vector = pair(z)
    # Turned so that its real part is longest, which c is: then c·w = 0 holds from the start.
    vector = vector * np.exp(-0.5j * np.angle((vector**2).sum()))
    c = vector.real / (vector.real @ vector.real)
    vector = vector / (c @ vector.real)

    def parts(y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        return y[: d + 1], y[d + 1 : 2 * d + 1], y[2 * d + 1 : 3 * d + 1], float(y[-1])

    def residual(y: np.ndarray) -> np.ndarray:
        z, u, w, frequency = parts(y)
        a = family.slopes(z)[:, :-1]
        return np.concatenate(
            [family.flow(z), a @ u + frequency * w, a @ w - frequency * u, [c @ u - 1, c @ w]]
        )

    def slope(y: np.ndarray) -> np.ndarray:
        z, u, w, frequency = parts(y)
        slopes, bends = family.slopes(z), family.bends(z)
        a, unit = slopes[:, :-1], np.eye(d)
        result = np.zeros((3 * d + 2, 3 * d + 2))
        result[:d, : d + 1] = slopes
        for row, mine, other, sign in ((d, u, w, 1.0), (2 * d, w, u, -1.0)):
            result[row : row + d, : d + 1] = np.einsum("ijk,j->ik", bends[:, :-1], mine)
            result[row : row + d, -1] = sign * other
        result[d : 2 * d, d + 1 : 2 * d + 1] = result[2 * d : 3 * d, 2 * d + 1 : 3 * d + 1] = a
        result[d : 2 * d, 2 * d + 1 : 3 * d + 1] = frequency * unit
        result[2 * d : 3 * d, d + 1 : 2 * d + 1] = -frequency * unit
        result[-2, d + 1 : 2 * d + 1] = result[-1, 2 * d + 1 : 3 * d + 1] = c
        return result

    found = solved(residual, slope, np.concatenate([z, vector.real, vector.imag, [value.imag]]))
    if found is None or np.linalg.norm(found[: d + 1] - z) > NEAR:
        return _as_bifurcation(family, "Hopf", z, branch, value.imag)
    return _as_bifurcation(family, "Hopf", found[: d + 1], branch, abs(float(found[-1])))


def distinct(family: ParameterFamily, found: Sequence[Bifurcation]) -> list[Bifurcation]:
    """Each once: a branch point lies on every branch that crosses there."""
    kept: list[Bifurcation] = []
    for one in found:
        place = family.shares(one.state[None], np.array([one.value]))[0]
        others = (
            family.shares(other.state[None], np.array([other.value]))[0]
            for other in kept
            if other.kind == one.kind
        )
        if all(np.abs(place - other).max() > SAME for other in others):
            kept.append(one)
    return kept


LONGEST = 0.01  # step along a branch: a curve of a hundred chords looks smooth
SHORTEST = 1e-9  # a branch that asks for shorter steps is given up
BENT = 0.98  # least cosine of the angle between the tangents of a step's ends: 11 degrees
CONTINUATION_SAME = 1e-6  # closer points are one
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
        if moved is not None and np.abs(moved - z).max() < CONTINUATION_SAME:
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


CurveKind = Literal["fold", "Hopf"]


@dataclass(frozen=True, eq=False)
class CurveSeed:
    """A fold or a Hopf point from which a curve is followed.

    Attributes
    ----------
    kind
        Which of both.
    values
        Of the two parameters, shape ``(2,)``.
    state
        Shape ``(d,)``.
    """

    kind: CurveKind
    values: np.ndarray
    state: np.ndarray


@dataclass(frozen=True, eq=False)
class BifurcationCurve:
    """Folds, or Hopf points, along a curve in the plane of two parameters.

    Attributes
    ----------
    kind
        Which of both.
    values
        Of the two parameters, shape ``(n, 2)``.
    states
        Shape ``(n, d)``.
    frequencies
        ω, in radian per unit of time; zero along folds. Shape ``(n,)``.
    fault
        What stopped it before its end, in words; empty where nothing did.
    """

    kind: CurveKind
    values: np.ndarray
    states: np.ndarray
    frequencies: np.ndarray
    fault: str = ""


@dataclass(frozen=True, eq=False)
class _Folds:
    """``f = 0, A q = 0, |q|² = 1`` for (x, λ, μ, q)."""

    family: ParameterFamily
    kind: CurveKind = "fold"

    def start(self, z: np.ndarray) -> np.ndarray:
        """All unknowns next to a fold."""
        d = self.family.d
        return np.append(z, np.linalg.svd(self.family.slopes(z)[:, :d])[2][-1])

    def residual(self, y: np.ndarray) -> np.ndarray:
        """What vanishes on the curve."""
        d = self.family.d
        z, q = y[: d + 2], y[d + 2 :]
        return np.concatenate([self.family.flow(z), self.family.slopes(z)[:, :d] @ q, [q @ q - 1]])

    def slope(self, y: np.ndarray) -> np.ndarray:
        """Its derivatives."""
        d = self.family.d
        z, q = y[: d + 2], y[d + 2 :]
        slopes = self.family.slopes(z)
        result = np.zeros((2 * d + 1, 2 * d + 2))
        result[:d, : d + 2] = slopes
        result[d : 2 * d, : d + 2] = np.einsum("ijk,j->ik", self.family.bends(z)[:, :d], q)
        result[d : 2 * d, d + 2 :] = slopes[:, :d]
        result[-1, d + 2 :] = 2 * q
        return result

    def at(self, y: np.ndarray) -> _Folds:
        """The same: nothing is chosen anew at a point."""
        return self

    def frequency(self, y: np.ndarray) -> float:
        """ω, in radian per unit of time."""
        return 0.0


@dataclass(frozen=True, eq=False)
class _HopfPoints:
    """``f = 0, A u = -ωw, A w = ωu, |u|² + |w|² = 1, c·w = 0`` for (x, λ, μ, u, w, ω).

    `scale` is the unit of ω, and `phase` is c. It is chosen anew at each point: with a fixed one the phase of
    u + iw could come to be undetermined.
    """

    family: ParameterFamily
    scale: float
    phase: np.ndarray
    kind: CurveKind = "Hopf"

    @classmethod
    def beside(cls, family: ParameterFamily, z: np.ndarray) -> tuple[_HopfPoints, np.ndarray] | None:
        """The equations next to a Hopf point, and all unknowns; None where no eigenvalues are complex."""
        values, vectors = np.linalg.eig(family.slopes(z)[:, : family.d])
        turning = np.flatnonzero(values.imag > 0)
        if not len(turning):
            return None
        chosen = turning[np.abs(values[turning].real).argmin()]
        vector = vectors[:, chosen] / np.linalg.norm(vectors[:, chosen])
        y = np.concatenate([z, vector.real, vector.imag, [1.0]])
        return cls(family, float(values[chosen].imag), vector.real).at(y), y

    def _parts(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        d = self.family.d
        return y[: d + 2], y[d + 2 : 2 * d + 2], y[2 * d + 2 : -1], self.scale * float(y[-1])

    def residual(self, y: np.ndarray) -> np.ndarray:
        """What vanishes on the curve."""
        z, u, w, frequency = self._parts(y)
        a = self.family.slopes(z)[:, : self.family.d]
        along = [a @ u + frequency * w, a @ w - frequency * u]
        return np.concatenate([self.family.flow(z), *along, [u @ u + w @ w - 1, self.phase @ w]])

    def slope(self, y: np.ndarray) -> np.ndarray:
        """Its derivatives."""
        d = self.family.d
        z, u, w, frequency = self._parts(y)
        slopes, bends, unit = self.family.slopes(z), self.family.bends(z)[:, :d], np.eye(d)
        at, of_u, of_w = slice(0, d + 2), slice(d + 2, 2 * d + 2), slice(2 * d + 2, 3 * d + 2)
        result = np.zeros((3 * d + 2, 3 * d + 3))
        result[:d, at] = slopes
        for row, mine, turned, own, other, sign in (
            (d, u, w, of_u, of_w, 1.0), (2 * d, w, u, of_w, of_u, -1.0),
        ):  # fmt: skip
            result[row : row + d, at] = np.einsum("ijk,j->ik", bends, mine)
            result[row : row + d, own] = slopes[:, :d]
            result[row : row + d, other] = sign * frequency * unit
            result[row : row + d, -1] = sign * self.scale * turned
        result[-2, of_u], result[-2, of_w] = 2 * u, 2 * w
        result[-1, of_w] = self.phase
        return result

    def at(self, y: np.ndarray) -> _HopfPoints:
        """With what of u lies across w as c, so that the phase of this point is kept."""
        _, u, w, _ = self._parts(y)
        across = u - (u @ w) / (w @ w) * w if w.any() else u
        return replace(self, phase=across / np.linalg.norm(across))

    def frequency(self, y: np.ndarray) -> float:
        """ω, in radian per unit of time."""
        return self.scale * float(y[-1])


_Conditions = _Folds | _HopfPoints
"""The equations of a curve: one fewer than unknowns y, of which the first are x, λ, μ in shares."""


def follow_curves(
    dynamics: Dynamics, limits: Mapping[str, tuple[float, float]], seeds: Sequence[CurveSeed]
) -> list[BifurcationCurve]:
    """Curves of folds and of Hopf points within the ranges of two parameters and the domain of the states.

    Parameters
    ----------
    dynamics
        f with its domain and parameters.
    limits
        The range of each of the two parameters by its name, lower before upper.
    seeds
        Known points of curves. A curve through none of them is not found.

    Returns
    -------
    list of BifurcationCurve
        Each once, in the order of the seeds.

    Raises
    ------
    ValueError
        When there are not two parameters, or one is not there.

    Examples
    --------
    The folds of ``ẋ = a + b x - x³`` lie on ``27 a² = 4 b³``, with a cusp at zero:

    >>> import sympy
    >>> a, b, x = sympy.symbols("a b x", real=True)
    >>> cusp = Dynamics.of((x,), (a + b * x - x**3,), domain=[(-2, 2)], parameters={a: 0.0, b: 1.0})
    >>> seed = CurveSeed("fold", np.array([2 / 27**0.5, 1.0]), np.array([-(3**-0.5)]))
    >>> (curve,) = follow_curves(cusp, {"a": (-1.0, 1.0), "b": (-1.0, 2.0)}, [seed])
    >>> bool(np.abs(27 * curve.values[:, 0] ** 2 - 4 * curve.values[:, 1] ** 3).max() < 1e-10)
    True
    """
    if len(limits) != 2:
        raise ValueError(f"a curve lies in the plane of two parameters; {len(limits)} are named")
    family = ParameterFamily(dynamics, limits)
    followed: list[tuple[_Conditions, list[np.ndarray]]] = []
    found = []
    for seed in seeds:
        began = _beginning(family, seed)
        if began is None or outside(began[1][: family.d + 2]) is not None:
            continue
        conditions, y = began
        z = y[: family.d + 2]
        if any(
            other.kind == seed.kind and _passes_bifurcation_curves(other, points, z)
            for other, points in followed
        ):
            continue
        points, fault = _both_ways_bifurcation_curves(conditions, y)
        if len(points) < 2:
            continue
        followed.append((conditions, points))
        both = family.natural(np.array([one[: family.d + 2] for one in points]))
        found.append(
            BifurcationCurve(
                seed.kind, both[:, -2:], both[:, :-2],
                np.array([conditions.frequency(one) for one in points]), fault,
            )
        )  # fmt: skip
    return found


def _beginning(family: ParameterFamily, seed: CurveSeed) -> tuple[_Conditions, np.ndarray] | None:
    """The equations with the point of a curve next to a seed, None where there is none."""
    z = family.shares(seed.state[None], seed.values[None])[0]
    conditions: _Conditions
    if seed.kind == "fold":
        conditions = folds = _Folds(family)
        y = folds.start(z)
    else:
        beside = _HopfPoints.beside(family, z)
        if beside is None:
            return None
        conditions, y = beside
    found = _across(conditions, y, _tangent(conditions, y, np.eye(len(y))[family.d]))
    if found is None or np.linalg.norm(found[: family.d + 2] - z) > NEAR:
        return None
    return conditions.at(found), found


def _tangent(conditions: _Conditions, y: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Of unit length, to the side of a direction."""
    tangent = np.linalg.svd(conditions.slope(y))[2][-1]
    return np.asarray(tangent if tangent @ ahead >= 0 else -tangent)


def _across(conditions: _Conditions, guess: np.ndarray, normal: np.ndarray) -> np.ndarray | None:
    """The point of the curve in the plane through a guess across a direction."""
    return solved(
        lambda y: np.append(conditions.residual(y), normal @ (y - guess)),
        lambda y: np.vstack([conditions.slope(y), normal]),
        guess,
    )


def _passes_bifurcation_curves(conditions: _Conditions, points: Sequence[np.ndarray], z: np.ndarray) -> bool:
    """Whether a curve that was followed passes a point of the plane and of the states, in shares."""
    places = np.array([one[: len(z)] for one in points])
    distance = np.linalg.norm(places - z, axis=1)
    for index in np.argsort(distance)[:4]:
        if distance[index] > 2 * LONGEST:
            break
        own, y = conditions.at(points[index]), points[index]
        tangent = _tangent(own, y, np.ones(len(y)))
        pinned = int(np.abs(tangent[: len(z)]).argmax())  # the curve runs along it, and is met there once
        guess = y + (z[pinned] - y[pinned]) / tangent[pinned] * tangent
        met = _across(own, guess, np.eye(len(y))[pinned])
        if met is not None and np.abs(met[: len(z)] - z).max() < CONTINUATION_SAME:
            return True
    return False


def _both_ways_bifurcation_curves(conditions: _Conditions, start: np.ndarray) -> tuple[list[np.ndarray], str]:
    """A curve from end to end through a point, and what stopped it before its end, in words."""
    ahead = _tangent(conditions, start, np.ones(len(start)))
    forwards, closed, fault = _one_way_bifurcation_curves(conditions, start, ahead)
    if closed:
        return forwards, fault
    backwards, _, other = _one_way_bifurcation_curves(conditions, start, -ahead)
    return [*backwards[:0:-1], *forwards], fault or other


def _one_way_bifurcation_curves(
    conditions: _Conditions, start: np.ndarray, ahead: np.ndarray
) -> tuple[list[np.ndarray], bool, str]:
    """Points of a curve from one on, whether it came back to it, and what stopped it, in words."""
    count = conditions.family.d + 2
    points, tangent, length = [start], ahead, LONGEST / 4
    while len(points) < MOST_POINTS:
        last = points[-1]
        conditions = conditions.at(last)
        tangent = _tangent(conditions, last, tangent)
        y = _across(conditions, last + length * tangent, tangent)
        smooth = y is not None and np.linalg.norm(y - last) < 1.5 * length
        if y is None or not smooth or _tangent(conditions, y, tangent) @ tangent < BENT:
            length /= 2
            if length < SHORTEST:
                return points, False, "could not be followed to its end"
            continue
        limit = _limit(conditions, last, y, count)
        if limit is not None:
            return [*points, *_last_point_bifurcation_curves(conditions, last, y, limit)], False, ""
        points.append(y)
        if len(points) > 4 and _returned(last[:count], y[:count], start[:count]):
            return [*points[:-1], start], True, ""
        length = min(1.5 * length, LONGEST)
    return points, False, f"has more than {MOST_POINTS} points"


def _limit(conditions: _Conditions, last: np.ndarray, y: np.ndarray, count: int) -> tuple[int, float] | None:
    """Which unknown has come to its limit, and at which value; None where none has."""
    if conditions.kind == "Hopf" and y[-1] <= 0:
        return len(y) - 1, 0.0
    component = outside(y[:count])
    return None if component is None else (component, float(y[component] > 0.5))


def _last_point_bifurcation_curves(
    conditions: _Conditions, last: np.ndarray, y: np.ndarray, limit: tuple[int, float]
) -> list[np.ndarray]:
    """Where a step crosses a limit; nothing where that cannot be found."""
    component, value = limit
    guess = last + (value - last[component]) / (y[component] - last[component]) * (y - last)
    met = _across(conditions, guess, np.eye(len(y))[component])
    return [] if met is None or np.linalg.norm(met - guess) > LONGEST else [met]


def _returned(last: np.ndarray, new: np.ndarray, start: np.ndarray) -> bool:
    """Whether a step passed the point from which the curve began."""
    step = new - last
    share = (start - last) @ step / (step @ step)
    return bool(0 < share <= 1 and np.linalg.norm(start - last - share * step) < 0.1 * np.linalg.norm(step))
