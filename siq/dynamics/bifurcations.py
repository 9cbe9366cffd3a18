"""Where do equilibria fold, begin to oscillate, or meet another branch?

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
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.optimize import brentq

from siq.dynamics.parameter_family import BranchPoint, ParameterFamily, corrected, point_on, solved

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
