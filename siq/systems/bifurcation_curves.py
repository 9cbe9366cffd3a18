"""Where in the plane of two parameters do equilibria fold, or begin to oscillate?

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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from siq.systems.continuation import (
    BENT,
    CONTINUATION_SAME,
    LONGEST,
    MOST_POINTS,
    NEAR,
    SHORTEST,
    ParameterFamily,
    outside,
    solved,
)
from siq.systems.dynamics import Dynamics

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
        if any(other.kind == seed.kind and _passes(other, points, z) for other, points in followed):
            continue
        points, fault = _both_ways(conditions, y)
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


def _passes(conditions: _Conditions, points: Sequence[np.ndarray], z: np.ndarray) -> bool:
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


def _both_ways(conditions: _Conditions, start: np.ndarray) -> tuple[list[np.ndarray], str]:
    """A curve from end to end through a point, and what stopped it before its end, in words."""
    ahead = _tangent(conditions, start, np.ones(len(start)))
    forwards, closed, fault = _one_way(conditions, start, ahead)
    if closed:
        return forwards, fault
    backwards, _, other = _one_way(conditions, start, -ahead)
    return [*backwards[:0:-1], *forwards], fault or other


def _one_way(
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
            return [*points, *_last_point(conditions, last, y, limit)], False, ""
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


def _last_point(
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
