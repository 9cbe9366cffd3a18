"""Continuation of equilibria along a parameter, and of their folds and Hopf points in a plane of two.

All lengths are shares of the domain of each state and of the range of each parameter λ. A branch
``f(x(s), λ(s)) = 0`` is followed along its own length s, not along λ, so that it passes through its folds: a
step along the tangent, then Newton's method across it. Between two of its points, with A = ∂f/∂x,

- a *fold* lies where the tangent turns back in λ (det A = 0, while ∂f/∂λ leaves the range of A): two
  equilibria meet there and vanish;
- a *Hopf point* lies where a pair of complex eigenvalues of A crosses the imaginary axis: an oscillation
  begins;
- a *branch point* lies where det A = 0 and ∂f/∂λ is in the range of A: another branch crosses this one.

They are solved for by Newton's method with exact second derivatives:

    f = 0,   A q = 0,   |q| = 1                                              (a fold)
    f = 0,   A (u + iw) = iω (u + iw),   |u|² + |w|² = 1,   c·w = 0          (a Hopf point)
    f + βe = 0,   ψA = 0,   ψ·∂f/∂λ = 0,   e·ψ = 1                           (a branch point)

These systems are regular at such points, which are then found to rounding. With two parameters the first two
have one equation fewer than unknowns, and folds and Hopf points lie on curves, which are followed as branches
are. In all of these unknowns a curve has no corner at a cusp, at which two curves of folds meet in the plane,
and one of folds passes a point of Bogdanov and Takens. A curve of Hopf points ends there, with ω = 0.

References
----------
H. B. Keller, in Applications of Bifurcation Theory (1977) 359: pseudo-arclength continuation.
G. Moore, A. Spence, SIAM J. Numer. Anal. 17 (1980) 567: folds.
G. Moore, Numer. Funct. Anal. Optim. 2 (1980) 441: branch points.
A. Griewank, G. Reddien, IMA J. Numer. Anal. 3 (1983) 295: Hopf points.
Yu. A. Kuznetsov, Elements of Applied Bifurcation Theory (2004), chapter 10: curves of both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import brentq

from siq.errors import Fault
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, symbol
from siq.systems.formulas import exact_number

NEWTON_STEPS = 12
NEWTON_TOLERANCE = 1e-12  # last step of Newton's method, numerical
DOMAIN_MARGIN = 1e-6  # by which a branch may run outside the domain: as equilibria are sought
NEWTON_RADIUS = 0.01  # so far from its first place Newton's method may end: the longest step
BIFURCATION_MERGE_TOLERANCE = 1e-5
FOLD_MARGIN = 1e-6  # |ψ·∂f/∂λ| to |∂f/∂λ| below which a singular point is no fold
LONGEST_STEP = 0.01  # along a branch: a curve of a hundred chords looks smooth
SHORTEST_STEP = 1e-9  # a branch that asks for shorter steps is given up
MIN_TANGENT_COSINE = 0.98  # of the angle between the tangents of a step's ends: 11 degrees
ON_CURVE_TOLERANCE = 1e-6
MAX_POINTS = 20_000  # of one branch, a guard

CurveKind = Literal["fold", "Hopf"]
BifurcationKind = Literal["fold", "Hopf", "branch point"]


class ParameterFamily:
    """f against some of its parameters, in shares z of the domain and of their ranges.

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
        self.d, self.count = dynamics.dimension, len(box)
        self.low, self.width = box[:, 0], np.ptp(box, axis=1)
        # Parameters as states that stay where they are: all derivatives are those of Dynamics.
        self._of_both = Dynamics.of(
            (*dynamics.symbols, *map(symbol, limits)), (*formulas, *[0] * len(limits)),
            diffusion=Diffusion.identity(self.count),
        )  # fmt: skip

    def shares(self, states: np.ndarray, values: np.ndarray) -> np.ndarray:
        """States ``(n, d)`` and values, ``(n,)`` or ``(n, p)``, as shares, ``(n, d + p)``."""
        return (np.column_stack([states, values]) - self.low) / self.width

    def natural(self, z: np.ndarray) -> np.ndarray:
        """Shares as states and, last, the values."""
        return np.asarray(self.low + z * self.width)

    def flow(self, z: np.ndarray) -> np.ndarray:
        """f in shares of the domain per unit of time, at one point ``(d + p,)``: shape ``(d,)``."""
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

    def eigenvalues(self, z: np.ndarray) -> np.ndarray:
        """Of A, by falling real part, shape ``(d,)``."""
        values = np.linalg.eigvals(self.slopes(z)[:, : self.d])
        return values[np.argsort(-values.real)]


@dataclass(frozen=True, eq=False)
class _Equilibria:
    """``f = 0`` for y = z, the states and parameters in shares.

    The other equations have further unknowns, after those. With one parameter more than is needed to solve
    them they are a curve.
    """

    family: ParameterFamily

    def residual(self, y: np.ndarray) -> np.ndarray:
        """Zero on the curve."""
        return self.family.flow(y)

    def slope(self, y: np.ndarray) -> np.ndarray:
        """Derivatives of the residual."""
        return self.family.slopes(y)

    def at(self, y: np.ndarray) -> _Equilibria:
        """The equations with what is chosen anew at a point."""
        return self

    def limit(self, y: np.ndarray) -> tuple[int, float] | None:
        """An unknown that is beyond its limit, with that limit; None where none is."""
        beyond = np.abs(y[: self.family.count] - 0.5) - 0.5
        worst = int(beyond.argmax())
        return (worst, float(y[worst] > 0.5)) if beyond[worst] > DOMAIN_MARGIN else None

    def resolved(self, last: np.ndarray, y: np.ndarray) -> bool:
        """Whether no two changes of stability can hide in a step."""
        one, two = self.family.eigenvalues(last), self.family.eigenvalues(y)
        changed = abs(int((one.real > 0).sum()) - int((two.real > 0).sum()))
        # A pair of complex eigenvalues next to the imaginary axis crosses it together.
        pairs = all(each[np.abs(each.real).argmin()].imag != 0 for each in (one, two))
        return changed < 2 or (changed == 2 and pairs)

    def frequency(self, y: np.ndarray) -> float:
        """ω, in radian per unit of time; zero but at Hopf points."""
        return 0.0


class _Folds(_Equilibria):
    """``f = 0, A q = 0, |q|² = 1`` for (z, q)."""

    def start(self, z: np.ndarray) -> np.ndarray:
        """All unknowns next to a fold."""
        return np.append(z, np.linalg.svd(self.family.slopes(z)[:, : self.family.d])[2][-1])

    def residual(self, y: np.ndarray) -> np.ndarray:
        z, q = y[: self.family.count], y[self.family.count :]
        slopes = self.family.slopes(z)[:, : self.family.d]
        return np.concatenate([self.family.flow(z), slopes @ q, [q @ q - 1]])

    def slope(self, y: np.ndarray) -> np.ndarray:
        d, n = self.family.d, self.family.count
        z, q = y[:n], y[n:]
        slopes = self.family.slopes(z)
        result = np.zeros((2 * d + 1, n + d))
        result[:d, :n] = slopes
        result[d : 2 * d, :n] = np.einsum("ijk,j->ik", self.family.bends(z)[:, :d], q)
        result[d : 2 * d, n:] = slopes[:, :d]
        result[-1, n:] = 2 * q
        return result

    def resolved(self, last: np.ndarray, y: np.ndarray) -> bool:
        return True


@dataclass(frozen=True, eq=False)
class _HopfPoints(_Equilibria):
    """``f = 0, A u = -ωw, A w = ωu, |u|² + |w|² = 1, c·w = 0`` for (z, u, w, ω).

    `scale` is the unit of ω, and `phase` is c. It is chosen anew at each point: with a fixed one the phase of
    u + iw could come to be undetermined.
    """

    scale: float
    phase: np.ndarray

    @classmethod
    def near(cls, family: ParameterFamily, z: np.ndarray) -> tuple[_HopfPoints, np.ndarray] | None:
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
        d, n = self.family.d, self.family.count
        return y[:n], y[n : n + d], y[n + d : -1], self.frequency(y)

    def residual(self, y: np.ndarray) -> np.ndarray:
        z, u, w, frequency = self._parts(y)
        a = self.family.slopes(z)[:, : self.family.d]
        along = [a @ u + frequency * w, a @ w - frequency * u]
        return np.concatenate([self.family.flow(z), *along, [u @ u + w @ w - 1, self.phase @ w]])

    def slope(self, y: np.ndarray) -> np.ndarray:
        d, n = self.family.d, self.family.count
        z, u, w, frequency = self._parts(y)
        slopes, bends, unit = self.family.slopes(z), self.family.bends(z)[:, :d], np.eye(d)
        of_u, of_w = slice(n, n + d), slice(n + d, n + 2 * d)
        result = np.zeros((3 * d + 2, n + 2 * d + 1))
        result[:d, :n] = slopes
        for row, mine, turned, own, other, sign in (
            (d, u, w, of_u, of_w, 1.0), (2 * d, w, u, of_w, of_u, -1.0),
        ):  # fmt: skip
            result[row : row + d, :n] = np.einsum("ijk,j->ik", bends, mine)
            result[row : row + d, own] = slopes[:, :d]
            result[row : row + d, other] = sign * frequency * unit
            result[row : row + d, -1] = sign * self.scale * turned
        result[-2, of_u], result[-2, of_w] = 2 * u, 2 * w
        result[-1, of_w] = self.phase
        return result

    def at(self, y: np.ndarray) -> _HopfPoints:
        # The part of u across w is c, so that the phase of this point is kept.
        _, u, w, _ = self._parts(y)
        across = u - (u @ w) / (w @ w) * w if w.any() else u
        return replace(self, phase=across / np.linalg.norm(across))

    def limit(self, y: np.ndarray) -> tuple[int, float] | None:
        return (len(y) - 1, 0.0) if y[-1] <= 0 else super().limit(y)

    def resolved(self, last: np.ndarray, y: np.ndarray) -> bool:
        return True

    def frequency(self, y: np.ndarray) -> float:
        return self.scale * float(y[-1])


# Newton's method, and curves of one equation fewer than unknowns.


def _solved(
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
        if size < NEWTON_TOLERANCE * max(1.0, float(np.abs(x).max())):
            return x
        # Rounding may keep the last steps from falling further.
        if size < 1e3 * NEWTON_TOLERANCE and size >= last:
            return x
        last = size
    return None


def _across(equations: _Equilibria, guess: np.ndarray, normal: np.ndarray) -> np.ndarray | None:
    """The point of the curve in the plane through a guess across a direction."""
    return _solved(
        lambda y: np.append(equations.residual(y), normal @ (y - guess)),
        lambda y: np.vstack([equations.slope(y), normal]),
        guess,
    )


def _tangent(equations: _Equilibria, y: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Of unit length, to the side of a direction."""
    tangent = np.linalg.svd(equations.slope(y))[2][-1]
    return np.asarray(tangent if tangent @ ahead >= 0 else -tangent)


def _followed(
    equations: _Equilibria, start: np.ndarray, ahead: np.ndarray
) -> tuple[np.ndarray, np.ndarray, str]:
    """A curve from end to end through a point: points and tangents ``(n, k)``, and what stopped it.

    The tangent at the starting point is to the side of `ahead`.
    """
    forwards, closed, fault = _one_way(equations, start, ahead)
    backwards = [start]
    if not closed:
        backwards, _, other = _one_way(equations, start, -ahead)
        fault = fault or other
    points = [*backwards[:0:-1], *forwards]
    tangents, middle = [_tangent(equations.at(start), start, ahead)], len(backwards) - 1
    for y in points[middle + 1 :]:
        tangents.append(_tangent(equations.at(y), y, tangents[-1]))
    for y in points[:middle][::-1]:
        tangents.insert(0, _tangent(equations.at(y), y, tangents[0]))
    if closed:
        tangents[-1] = tangents[0]
    return np.array(points), np.array(tangents), fault


def _one_way(
    equations: _Equilibria, start: np.ndarray, ahead: np.ndarray
) -> tuple[list[np.ndarray], bool, str]:
    """Points of a curve from one on, whether it came back to it, and what stopped it, in words."""
    count = equations.family.count
    points, tangent, length = [start], ahead, LONGEST_STEP / 4
    first = _tangent(equations.at(start), start, ahead)[:count]
    while len(points) < MAX_POINTS:
        last = points[-1]
        here = equations.at(last)
        tangent = _tangent(here, last, tangent)
        y = _across(here, last + length * tangent, tangent)
        after = None if y is None else _tangent(here, y, tangent)
        if (
            y is None or after is None or after @ tangent <= MIN_TANGENT_COSINE
            or np.linalg.norm(y - last) >= 1.5 * length
            or not (length < 1e3 * SHORTEST_STEP or here.resolved(last, y))
        ):  # fmt: skip
            length /= 2
            if length < SHORTEST_STEP:
                return points, False, "could not be followed to its end"
            continue
        if (limit := here.limit(y)) is not None:
            component, value = limit
            guess = last + (value - last[component]) / (y[component] - last[component]) * (y - last)
            met = _across(here, guess, np.eye(len(y))[component])
            near = met is not None and np.linalg.norm(met - guess) <= LONGEST_STEP
            return [*points, met] if met is not None and near else points, False, ""
        points.append(y)
        # Whether the step passed the point from which the curve began, in the same direction.
        step = (y - last)[:count]
        share = (start - last)[:count] @ step / (step @ step)
        beside = np.linalg.norm((start - last)[:count] - share * step) < 0.1 * np.linalg.norm(step)
        same = after[:count] @ first > 0.9 * np.linalg.norm(after[:count]) * np.linalg.norm(first)
        if len(points) > 4 and 0 < share <= 1 and beside and same:
            return [*points[:-1], start], True, ""
        length = min(1.5 * length, LONGEST_STEP)
    return points, False, f"has more than {MAX_POINTS} points"


def _place_on(equations: _Equilibria, points: np.ndarray, z: np.ndarray) -> int | None:
    """The point of a curve next to z; None where z, of states and parameters in shares, is not on it."""
    distance = np.linalg.norm(points[:, : len(z)] - z, axis=1)
    for index in np.argsort(distance)[:4]:
        if distance[index] > 2 * LONGEST_STEP:
            break
        here, y = equations.at(points[index]), points[index]
        tangent = _tangent(here, y, np.ones(len(y)))
        pinned = int(np.abs(tangent[: len(z)]).argmax())  # the curve runs along it, and is met there once
        guess = y + (z[pinned] - y[pinned]) / tangent[pinned] * tangent
        met = _across(here, guess, np.eye(len(y))[pinned])
        if met is not None and np.abs(met[: len(z)] - z).max() < ON_CURVE_TOLERANCE:
            return int(index)
    return None


# Branches of equilibria, and what happens along them.


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
        Largest component of f there, in shares of the domain per unit of time.
    """

    kind: BifurcationKind
    value: float
    state: np.ndarray
    branch: int
    frequency: float = 0.0
    residual: float = 0.0


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
    equations, along = _Equilibria(family), np.eye(family.count)[-1]
    branches: list[Branch] = []
    found: list[Bifurcation] = []
    notes: list[str] = []
    for value, state in seeds:
        guess = family.shares(np.atleast_2d(state), np.array([value]))[0]
        start = _across(equations, guess, along)
        if start is None or equations.limit(start) is not None:
            continue
        if any(place_on(family, branch, start) is not None for branch in branches):
            continue
        points, tangents, fault = _followed(equations, start, along)
        if fault:
            notes.append(
                f"the branch through {np.round(state, 4).tolist()} at {parameter} = {value:g} {fault}"
            )
        if len(points) < 2:
            continue
        both = family.natural(points)
        eigenvalues = np.array([family.eigenvalues(one) for one in points])
        branch = Branch(both[:, -1], both[:, :-1], eigenvalues, tangents)
        for one in _bifurcations(family, points, branch, len(branches)):
            # A branch point lies on every branch that crosses there.
            place = family.shares(one.state[None], np.array([one.value]))
            others = [family.shares(each.state[None], np.array([each.value]))
                      for each in found if each.kind == one.kind]  # fmt: skip
            if all(np.abs(place - other).max() > BIFURCATION_MERGE_TOLERANCE for other in others):
                found.append(one)
        branches.append(branch)
    found.sort(key=lambda one: one.value)
    return Branches(tuple(branches), tuple(found), tuple(notes))


def place_on(family: ParameterFamily, branch: Branch, z: np.ndarray) -> int | None:
    """The point of a branch next to a state and value in shares ``(d + 1,)``; None where it is not on it."""
    return _place_on(_Equilibria(family), family.shares(branch.states, branch.values), z)


def _bifurcations(
    family: ParameterFamily, points: np.ndarray, branch: Branch, number: int
) -> list[Bifurcation]:
    """Folds, branch points and Hopf points between the points of a branch."""
    equations, found = _Equilibria(family), []

    def determinant(z: np.ndarray) -> float:
        return float(np.linalg.det(family.slopes(z)[:, :-1]))

    def growth(z: np.ndarray) -> float:
        """Real part of the complex eigenvalues next to the imaginary axis; NaN where none are complex."""
        values = family.eigenvalues(z)
        turning = values[values.imag > 0].real
        return float(turning[np.abs(turning).argmin()]) if len(turning) else np.nan

    def zero(k: int, test: Callable[[np.ndarray], float]) -> np.ndarray:
        """Where a function changes its sign between points k and k + 1."""
        last, new, tangent = points[k], points[k + 1], branch.tangents[k]
        whole = (new - last) @ tangent

        def at(share: float) -> np.ndarray:
            if share in (0.0, 1.0):
                return last if share == 0.0 else new
            moved = _across(equations, last + share * whole * tangent, tangent)
            return last + share * (new - last) if moved is None else moved

        if test(last) * test(new) >= 0:  # zero at an end, up to rounding
            return min((last, new), key=lambda z: abs(test(z)))
        return at(float(brentq(lambda share: test(at(share)), 0.0, 1.0, xtol=1e-15, rtol=1e-14)))

    def add(kind: BifurcationKind, z: np.ndarray, frequency: float = 0.0) -> None:
        both = family.natural(z)
        residual = float(np.abs(family.flow(z)).max())
        found.append(Bifurcation(kind, float(both[-1]), both[:-1], number, frequency, residual))

    for k in range(len(points) - 1):
        turns = branch.tangents[k, -1] * branch.tangents[k + 1, -1] < 0
        if turns or determinant(points[k]) * determinant(points[k + 1]) < 0:
            ahead = branch.tangents[k]
            z = zero(k, lambda z: float(_tangent(equations, z, ahead)[-1]) if turns else determinant(z))  # noqa: B023
            slopes = family.slopes(z)
            left = np.linalg.svd(slopes[:, :-1])[0][:, -1]
            if turns and abs(left @ slopes[:, -1]) > FOLD_MARGIN * np.linalg.norm(slopes):
                folds = _Folds(family)
                solved = _solved(folds.residual, folds.slope, folds.start(z))
                if solved is not None and np.linalg.norm(solved[: family.count] - z) < NEWTON_RADIUS:
                    add("fold", solved[: family.count])
                    continue
            solved = _branch_point(family, z, left)
            close = solved is not None and np.linalg.norm(solved - z) < NEWTON_RADIUS
            add("branch point", solved if solved is not None and close else z)
        elif abs(branch.unstable[k + 1] - branch.unstable[k]) == 2:
            if not (np.isfinite(growth(points[k])) and np.isfinite(growth(points[k + 1]))):
                continue
            z = zero(k, growth)
            near = _HopfPoints.near(family, z)
            if near is None:
                continue
            hopf, y = near
            solved = _solved(hopf.residual, hopf.slope, y)
            if solved is None or np.linalg.norm(solved[: family.count] - z) > NEWTON_RADIUS:
                solved = y
            add("Hopf", solved[: family.count], abs(hopf.frequency(solved)))
    return found


def _branch_point(family: ParameterFamily, z: np.ndarray, left: np.ndarray) -> np.ndarray | None:
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

    found = _solved(residual, slope, np.concatenate([z, [0.0], left]))
    return None if found is None else found[: d + 1]


# Curves of folds and of Hopf points.


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


def follow_curves(
    dynamics: Dynamics,
    limits: Mapping[str, tuple[float, float]],
    seeds: Sequence[tuple[CurveKind, np.ndarray, np.ndarray]],
) -> list[BifurcationCurve]:
    """Curves of folds and of Hopf points within the ranges of two parameters and the domain of the states.

    Parameters
    ----------
    dynamics
        f with its domain and parameters.
    limits
        The range of each of the two parameters by its name, lower before upper.
    seeds
        Known points of curves: the kind, the values of the two parameters ``(2,)``, and the state ``(d,)``. A
        curve through none of them is not found.

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
    >>> seed = ("fold", np.array([2 / 27**0.5, 1.0]), np.array([-(3**-0.5)]))
    >>> (curve,) = follow_curves(cusp, {"a": (-1.0, 1.0), "b": (-1.0, 2.0)}, [seed])
    >>> bool(np.abs(27 * curve.values[:, 0] ** 2 - 4 * curve.values[:, 1] ** 3).max() < 1e-10)
    True
    """
    if len(limits) != 2:
        raise Fault("a curve lies in the plane of two parameters", f"{len(limits)} are named")
    family = ParameterFamily(dynamics, limits)
    followed: list[tuple[CurveKind, _Equilibria, np.ndarray]] = []
    curves = []
    for kind, values, state in seeds:
        guess = family.shares(state[None], values[None])[0]
        folds = _Folds(family)
        near = (folds, folds.start(guess)) if kind == "fold" else _HopfPoints.near(family, guess)
        if near is None:
            continue
        equations, y = near
        start = _across(equations, y, _tangent(equations, y, np.eye(len(y))[family.d]))
        if start is None or np.linalg.norm(start[: family.count] - guess) > NEWTON_RADIUS:
            continue
        z = start[: family.count]
        if _Equilibria(family).limit(z) is not None:
            continue
        if any(
            other == kind and _place_on(known, points, z) is not None for other, known, points in followed
        ):
            continue
        points, _, fault = _followed(equations.at(start), start, np.ones(len(start)))
        if len(points) < 2:
            continue
        followed.append((kind, equations, points))
        both = family.natural(points[:, : family.count])
        frequencies = np.array([equations.frequency(one) for one in points])
        curves.append(BifurcationCurve(kind, both[:, -2:], both[:, :-2], frequencies, fault))
    return curves
