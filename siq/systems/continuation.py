"""Continuation of equilibria and cycles along a parameter, and of folds and Hopf points in a plane of two.

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

A *cycle* begins at a Hopf point, with the period 2π/ω and an amplitude that grows as the root of the distance
in λ, or it was found at some value. It is followed likewise, in its state on a section and its period T,

    φ_T(x, λ) = x,    c·(x - x₀) = 0                                         (a cycle)

with c along f at the last point x₀. It ends where it shrinks to an equilibrium, leaves the domain or becomes
so slow that it nears a homoclinic orbit; where its tangent turns back in λ is a *fold of cycles*.

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
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from siq.errors import Fault
from siq.numerics.integration import runge_kutta_step
from siq.remarks import Remark
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
LONGEST_STEP_OF_CYCLES = 0.03  # which take long, and bend no more
FIRST_AMPLITUDE = 0.01  # of a cycle next to a Hopf point
LONGEST_PERIOD = 30.0  # of the first one: a cycle so slow nears a homoclinic orbit, where the branch ends
COURSE = 400  # numerical: steps around a cycle
SHORTEST_STEP = 1e-9  # a branch that asks for shorter steps is given up
MIN_TANGENT_COSINE = 0.98  # of the angle between the tangents of a step's ends: 11 degrees
ON_CURVE_TOLERANCE = 1e-6
MAX_POINTS = 20_000  # of one branch, a guard


class _Family:
    """f against some of its parameters, in shares z of the domain and of their ranges."""

    def __init__(self, dynamics: Dynamics, limits: Mapping[str, tuple[float, float]]) -> None:
        others = {each.name: exact_number(each.value) for each in dynamics.parameters}
        for name in limits:
            if others.pop(name, None) is None:
                raise ValueError(f"there is no parameter '{name}'")
        inserted = {symbol(name): value for name, value in others.items()}
        formulas = [each.xreplace(inserted) for each in dynamics.equations]
        box = np.vstack([dynamics.box, *limits.values()])
        self.d, self.count = dynamics.dimension, len(box)
        self.low, self.width = box[:, 0], np.ptp(box, axis=1)
        # Parameters as states that stay where they are: all derivatives are those of Dynamics.
        self._of_both = Dynamics.of(
            (*dynamics.symbols, *map(symbol, limits)), (*formulas, *[0] * len(limits)),
            diffusion=Diffusion.identity(self.count),
        )  # fmt: skip

    def whole(self, x: np.ndarray) -> np.ndarray:
        """f of components in natural units, with parameters that rest: ``(d + p, n)`` to the same."""
        with np.errstate(all="ignore"):
            return self._of_both.drift_of_components(x)

    def shares(self, state: np.ndarray, values: float | np.ndarray) -> np.ndarray:
        """A state and the values of the parameters as shares, shape ``(d + p,)``."""
        return np.asarray((np.append(state, values) - self.low) / self.width)

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


class _Equilibria:
    """``f = 0`` for y = z, the states and parameters in shares.

    The other equations have further unknowns, after those. With one parameter more than is needed to solve
    them they are a curve.
    """

    kind: str = "equilibrium"
    longest: float = LONGEST_STEP

    def __init__(self, family: _Family) -> None:
        self.family, self.d, self.count = family, family.d, family.count

    @classmethod
    def near(cls, family: _Family, z: np.ndarray) -> tuple[Self, np.ndarray] | None:
        """The equations next to a point, and all unknowns there; None where there are none."""
        return cls(family), z

    def residual(self, y: np.ndarray) -> np.ndarray:
        """Zero on the curve."""
        return self.family.flow(y)

    def slope(self, y: np.ndarray) -> np.ndarray:
        """Derivatives of the residual."""
        return self.family.slopes(y)

    def at(self, y: np.ndarray) -> Self:
        """The equations with what is chosen anew at a point."""
        return self

    def limit(self, y: np.ndarray) -> tuple[int, float] | None:
        """An unknown that is beyond its limit, with that limit; None where none is."""
        beyond = np.abs(y[: self.count] - 0.5) - 0.5
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
        """ω, in radian per unit of time; zero but at Hopf points and of cycles."""
        return 0.0

    def eigenvalues(self, y: np.ndarray) -> np.ndarray:
        """Of A, by falling real part; of a cycle its Floquet exponents."""
        return self.family.eigenvalues(y[: self.count])


class _Folds(_Equilibria):
    """``f = 0, A q = 0, |q|² = 1`` for (z, q)."""

    kind = "fold"

    @classmethod
    def near(cls, family: _Family, z: np.ndarray) -> tuple[Self, np.ndarray] | None:
        return cls(family), np.append(z, np.linalg.svd(family.slopes(z)[:, : family.d])[2][-1])

    def residual(self, y: np.ndarray) -> np.ndarray:
        z, q = y[: self.count], y[self.count :]
        return np.concatenate([self.family.flow(z), self.family.slopes(z)[:, : self.d] @ q, [q @ q - 1]])

    def slope(self, y: np.ndarray) -> np.ndarray:
        d, z, q = self.d, y[: self.count], y[self.count :]
        slopes = self.family.slopes(z)
        turned = np.einsum("ijk,j->ik", self.family.bends(z)[:, :d], q)
        return np.block([[slopes, np.zeros((d, d))], [turned, slopes[:, :d]], [np.zeros(self.count), 2 * q]])

    def resolved(self, last: np.ndarray, y: np.ndarray) -> bool:
        return True


class _HopfPoints(_Folds):
    """``f = 0, A v = iω v, |v|² = 1, c·w = 0`` with v = u + iw, for (z, u, w, ω).

    `scale` is the unit of ω, and `phase` is c. It is chosen anew at each point: with a fixed one the phase of
    v could come to be undetermined.
    """

    kind = "Hopf"

    def __init__(self, family: _Family, scale: float, phase: np.ndarray) -> None:
        super().__init__(family)
        self.scale, self.phase = scale, phase

    @classmethod
    def near(cls, family: _Family, z: np.ndarray) -> tuple[Self, np.ndarray] | None:
        values, vectors = np.linalg.eig(family.slopes(z)[:, : family.d])
        turning = np.flatnonzero(values.imag > 0)
        if not len(turning):
            return None
        chosen = turning[np.abs(values[turning].real).argmin()]
        vector = vectors[:, chosen] / np.linalg.norm(vectors[:, chosen])
        y = np.concatenate([z, vector.real, vector.imag, [1.0]])
        return cls(family, float(values[chosen].imag), vector.real).at(y), y

    def _vector(self, y: np.ndarray) -> np.ndarray:
        return np.asarray(y[self.count : -1].reshape(2, -1).T @ [1.0, 1j])

    def residual(self, y: np.ndarray) -> np.ndarray:
        z, v = y[: self.count], self._vector(y)
        rest = self.family.slopes(z)[:, : self.d] @ v - 1j * self.frequency(y) * v
        size = (v.conj() @ v).real - 1
        return np.concatenate([self.family.flow(z), rest.real, rest.imag, [size, self.phase @ v.imag]])

    def slope(self, y: np.ndarray) -> np.ndarray:
        d, z, v = self.d, y[: self.count], self._vector(y)
        slopes = self.family.slopes(z)
        turned = np.einsum("ijk,j->ik", self.family.bends(z)[:, :d], v)
        by_v = slopes[:, :d] - 1j * self.frequency(y) * np.eye(d)
        rest = np.hstack([turned, by_v, 1j * by_v, -1j * self.scale * v[:, None]])
        none = np.zeros(self.count)
        return np.block([
            [slopes, np.zeros((d, 2 * d + 1))], [rest.real], [rest.imag],
            [none, 2 * v.real, 2 * v.imag, 0.0], [none, 0 * self.phase, self.phase, 0.0],
        ])  # fmt: skip

    def at(self, y: np.ndarray) -> Self:
        # The part of u across w is c, so that the phase of this point is kept.
        u, w = self._vector(y).real, self._vector(y).imag
        across = u - (u @ w) / (w @ w) * w if w.any() else u
        return type(self)(self.family, self.scale, across / np.linalg.norm(across))

    def limit(self, y: np.ndarray) -> tuple[int, float] | None:
        return (len(y) - 1, 0.0) if y[-1] <= 0 else super().limit(y)

    def frequency(self, y: np.ndarray) -> float:
        return self.scale * float(y[-1])


class _BranchPoints(_Equilibria):
    """``f + βe = 0, ψA = 0, ψ·∂f/∂λ = 0, e·ψ = 1`` for (z, β, ψ); e is the first ψ."""

    kind = "branch point"

    def __init__(self, family: _Family, left: np.ndarray) -> None:
        super().__init__(family)
        self.left = left

    @classmethod
    def near(cls, family: _Family, z: np.ndarray) -> tuple[Self, np.ndarray] | None:
        left = np.linalg.svd(family.slopes(z)[:, : family.d])[0][:, -1]
        return cls(family, left), np.concatenate([z, [0.0], left])

    def residual(self, y: np.ndarray) -> np.ndarray:
        z, share, psi = y[: self.count], y[self.count], y[self.count + 1 :]
        return np.concatenate(
            [self.family.flow(z) + share * self.left, psi @ self.family.slopes(z), [self.left @ psi - 1]]
        )

    def slope(self, y: np.ndarray) -> np.ndarray:
        z, psi = y[: self.count], y[self.count + 1 :]
        slopes, turned = self.family.slopes(z), np.einsum("i,ijk->jk", psi, self.family.bends(z))
        none = np.zeros((self.count, 1))
        return np.block([
            [slopes, self.left[:, None], np.zeros((self.d, self.d))],
            [turned, none, slopes.T], [none.T, 0.0, self.left],
        ])  # fmt: skip


class _Cycles(_Equilibria):
    """``φ_T(x) = x, c·(x - x₀) = 0`` for (z, T), with T in units of the first period."""

    kind, longest = "cycle", LONGEST_STEP_OF_CYCLES

    def __init__(self, family: _Family, unit: float, place: np.ndarray, section: np.ndarray) -> None:
        super().__init__(family)
        self.unit, self.place, self.section = unit, place, section
        self._around: tuple[bytes, np.ndarray, np.ndarray] = (b"", place, section)

    @classmethod
    def from_hopf(cls, family: _Family, z: np.ndarray) -> tuple[Self, np.ndarray, np.ndarray] | None:
        """Of small cycles about a Hopf point, with a first guess and the direction in which they grow."""
        if (near := _HopfPoints.near(family, z)) is None:
            return None
        hopf, y = near
        u, w = y[family.count : -1].reshape(2, -1)
        across = w / np.linalg.norm(w)
        turn = np.arctan2(u @ across, np.linalg.norm(w))  # where the ellipse u cos - w sin is on the section
        grows = u * np.cos(turn) - w * np.sin(turn)
        ahead = np.append(grows / np.linalg.norm(grows), [0.0, 0.0])
        equations = cls(family, 2 * np.pi / hopf.frequency(y), z[: family.d], across)
        return equations, np.append(z, 1.0) + FIRST_AMPLITUDE * ahead, ahead

    def flow_of_period(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``φ_T`` in shares, ``(d,)``, and its derivatives by states and parameter; NaN where none."""
        d, key = self.d, y.tobytes()
        if self._around[0] == key:
            return self._around[1:]

        def rates(_: float, s: np.ndarray) -> np.ndarray:
            at = np.append(s[:d], y[d])
            slopes = self.family.slopes(at)
            change = slopes[:, :d] @ s[d:].reshape(d, d + 1)
            change[:, d] += slopes[:, d]
            return np.concatenate([self.family.flow(at), change.ravel()])

        end = np.full(d * (d + 2), np.nan)
        if 0 < y[-1] < 2 * LONGEST_PERIOD:
            start = np.concatenate([y[:d], np.eye(d, d + 1).ravel()])
            with np.errstate(all="ignore"):
                way = solve_ivp(
                    rates, (0.0, y[-1] * self.unit), start, method="DOP853", rtol=1e-9, atol=1e-11
                )
            end = way.y[:, -1] if way.success else end
        self._around = key, end[:d], end[d:].reshape(d, d + 1)
        return self._around[1:]

    def residual(self, y: np.ndarray) -> np.ndarray:
        return np.append(self.flow_of_period(y)[0] - y[: self.d], self.section @ (y[: self.d] - self.place))

    def slope(self, y: np.ndarray) -> np.ndarray:
        end, change = self.flow_of_period(y)
        speed = self.family.flow(np.append(end, y[self.d])) * self.unit
        closing = np.column_stack([change - np.eye(self.d, self.d + 1), speed])
        return np.vstack([closing, np.append(self.section, [0.0, 0.0])])

    def at(self, y: np.ndarray) -> Self:
        flow = self.family.flow(y[: self.count])
        return type(self)(self.family, self.unit, y[: self.d], flow / np.linalg.norm(flow))

    def limit(self, y: np.ndarray) -> tuple[int, float] | None:
        if y[-1] > LONGEST_PERIOD:
            return len(y) - 1, LONGEST_PERIOD
        if self.length(y) < FIRST_AMPLITUDE:
            return 0, float(y[0])  # it has shrunk to an equilibrium
        return super().limit(y)

    def length(self, y: np.ndarray) -> float:
        """About that of the cycle, in shares: of a small one 2π times its amplitude."""
        return float(np.linalg.norm(self.family.flow(y[: self.count])) * y[-1] * self.unit)

    def resolved(self, last: np.ndarray, y: np.ndarray) -> bool:
        return True

    def frequency(self, y: np.ndarray) -> float:
        return float(2 * np.pi / (self.unit * y[-1]))

    def eigenvalues(self, y: np.ndarray) -> np.ndarray:
        values = np.linalg.eigvals(self.flow_of_period(y)[1][:, : self.d])
        values = np.delete(values, np.abs(values - 1).argmin())  # that of a displacement along the cycle
        exponents = np.log(np.maximum(np.abs(values), np.finfo(float).tiny)) / (self.unit * y[-1])
        return np.asarray(np.sort(exponents)[::-1] + 0j)

    def course(self, points: np.ndarray) -> np.ndarray:
        """States in natural units around each of some cycles ``(n, d + 2)``: shape ``(k, n, d)``."""
        x, whole = self.family.natural(points[:, : self.count]).T, self.family.whole
        step, kept = points[:, -1] * self.unit / COURSE, [x]
        for _ in range(COURSE):
            kept.append(runge_kutta_step(whole, kept[-1], step))
        return np.array(kept)[:, : self.d].transpose(0, 2, 1)


def _solved(
    residual: Callable[[np.ndarray], np.ndarray], slope: Callable[[np.ndarray], np.ndarray], start: np.ndarray
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


_Stop = dict[str, int | None]
"""What stopped a curve before its end, as a remark says it: its points were too many, or none was found."""


def _one_way(
    equations: _Equilibria, start: np.ndarray, ahead: np.ndarray
) -> tuple[list[np.ndarray], bool, _Stop]:
    """Points of a curve from one on, whether it came back to it, and what stopped it: nothing at an end."""
    count = equations.count
    points, tangent, length = [start], ahead, equations.longest / 4
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
                return points, False, {"most": None}
            continue
        if (limit := here.limit(y)) is not None:
            component, value = limit
            guess = last + (value - last[component]) / (y[component] - last[component]) * (y - last)
            met = _across(here, guess, np.eye(len(y))[component])
            near = met is not None and np.linalg.norm(met - guess) <= equations.longest
            return [*points, met] if met is not None and near else points, False, {}
        points.append(y)
        # Whether the step passed the point from which the curve began, in the same direction.
        step = (y - last)[:count]
        share = (start - last)[:count] @ step / (step @ step)
        aligned = np.linalg.norm((start - last)[:count] - share * step) < 0.1 * np.linalg.norm(step)
        same = after[:count] @ first > 0.9 * np.linalg.norm(after[:count]) * np.linalg.norm(first)
        if len(points) > 4 and 0 < share <= 1 and aligned and same:
            return [*points[:-1], start], True, {}
        length = min(1.5 * length, equations.longest)
    return points, False, {"most": MAX_POINTS}


@dataclass(frozen=True, eq=False)
class Bifurcation:
    """A point of a branch at which the number of equilibria or their stability changes."""

    kind: str  #: ``fold``, ``Hopf``, ``branch point`` or ``fold of cycles``
    value: float  #: of the parameter
    state: np.ndarray  #: (d,)
    branch: int  #: on which it was found
    frequency: float = 0.0  #: ω at a Hopf point, in radian per unit of time; 0 elsewhere
    residual: float = 0.0  #: largest component of f there, in shares of the domain per unit of time


class Branch:
    """Equilibria or cycles against a parameter; or folds, or Hopf points, along a curve over two."""

    def __init__(self, equations: _Equilibria, points: np.ndarray, tangents: np.ndarray) -> None:
        self._equations, self._points = equations, points
        self.kind = equations.kind  #: ``equilibrium``, ``cycle``, ``fold`` or ``Hopf``
        #: In shares of the domain and of the range, the parameter last: shape ``(n, d + 1)``. Those of curves
        #: go on with their further unknowns.
        self.tangents = tangents
        both = equations.family.natural(points[:, : equations.count])
        states, values = np.split(both, [equations.d], axis=1)
        self.states = states  #: (n, d)
        self.values = values[:, 0] if values.shape[1] == 1 else values  #: of one, (n,), or of both, (n, 2)

    @cached_property
    def eigenvalues(self) -> np.ndarray:
        """Of ∂f/∂x, by falling real part, shape ``(n, d)``; of cycles Floquet exponents, ``(n, d - 1)``."""
        return np.array([self._equations.eigenvalues(each) for each in self._points])

    @property
    def unstable(self) -> np.ndarray:
        """Number of unstable directions of each, shape ``(n,)``."""
        return np.asarray((self.eigenvalues.real > 0).sum(axis=1))

    @property
    def frequencies(self) -> np.ndarray:
        """ω at Hopf points and 2π/T of cycles, in radian per unit of time; else zero. Shape ``(n,)``."""
        return np.array([self._equations.frequency(each) for each in self._points])

    @cached_property
    def extents(self) -> np.ndarray:
        """The least and the largest of each state, around cycles: shape ``(2, n, d)``."""
        if not isinstance(self._equations, _Cycles):
            return np.stack([self.states, self.states])
        course = self._equations.course(self._points)
        return np.stack([course.min(axis=0), course.max(axis=0)])

    def index_of_cycle(self, state: np.ndarray, value: float) -> int | None:
        """The point before a cycle that passes a state ``(d,)`` at a value; None where none of these does."""
        assert isinstance(self._equations, _Cycles)
        family, nearest, found = self._equations.family, LONGEST_STEP_OF_CYCLES / 2, None
        for k in np.flatnonzero((self.values[:-1] - value) * (self.values[1:] - value) <= 0):
            share = (value - self.values[k]) / ((self.values[k + 1] - self.values[k]) or 1.0)
            y = self._points[k] + share * (self._points[k + 1] - self._points[k])
            away = (self._equations.course(y[None])[:, 0] - state) / family.width[: family.d]
            if (distance := float(np.linalg.norm(away, axis=1).min())) < nearest:
                nearest, found = distance, int(k)
        return found

    def index_of(self, state: np.ndarray, values: float | np.ndarray) -> int | None:
        """The point next to a state ``(d,)`` at values of the parameters; None where it is not on it."""
        z = self._equations.family.shares(state, values)
        distance = np.linalg.norm(self._points[:, : len(z)] - z, axis=1)
        for index in np.argsort(distance)[:4]:
            if distance[index] > 2 * LONGEST_STEP:
                break
            here, y = self._equations.at(self._points[index]), self._points[index]
            tangent = _tangent(here, y, np.ones(len(y)))
            pinned = int(np.abs(tangent[: len(z)]).argmax())  # the curve runs along it, and is met there once
            guess = y + (z[pinned] - y[pinned]) / tangent[pinned] * tangent
            met = _across(here, guess, np.eye(len(y))[pinned])
            if met is not None and np.abs(met[: len(z)] - z).max() < ON_CURVE_TOLERANCE:
                return int(index)
        return None


def _branch_through(
    equations: _Equilibria, start: np.ndarray | None, ahead: np.ndarray, known: Sequence[Branch]
) -> tuple[Branch | None, _Stop]:
    """The branch through a point from end to end, unless it is known or lies outside; and what stopped it.

    The tangent at the starting point is to the side of `ahead`.
    """
    if start is None or _Equilibria.limit(equations, start) is not None:
        return None, {}
    state, values = np.split(equations.family.natural(start[: equations.count]), [equations.d])
    if any(each.kind == equations.kind and each.index_of(state, values) is not None for each in known):
        return None, {}
    forwards, closed, stop = _one_way(equations, start, ahead)
    backwards = [start]
    if not closed:
        backwards, _, other = _one_way(equations, start, -ahead)
        stop = stop or other
    points, middle = [*backwards[:0:-1], *forwards], len(backwards) - 1
    tangents = [_tangent(equations.at(start), start, ahead)]
    for y in points[middle + 1 :]:
        tangents.append(_tangent(equations.at(y), y, tangents[-1]))
    for y in points[:middle][::-1]:
        tangents.insert(0, _tangent(equations.at(y), y, tangents[0]))
    if closed:
        tangents[-1] = tangents[0]
    return Branch(equations, np.array(points), np.array(tangents)) if len(points) > 1 else None, stop


def follow_branches(
    dynamics: Dynamics, parameter: str, limits: tuple[float, float],
    seeds: Sequence[tuple[float, np.ndarray]], *,
    cycles: Sequence[tuple[float, np.ndarray, float]] | None = None,
) -> tuple[list[Branch], list[Bifurcation], list[Remark]]:  # fmt: skip
    """Branches of equilibria, and of cycles if asked for, within a range of a parameter λ and the domain.

    Seeds are known equilibria: the value of λ and the state, shape ``(d,)``. A branch through none of them is
    not found. Each branch is given once; the bifurcations, by the value of λ; and what could not be followed.

    Branches of cycles come after those of equilibria, from Hopf points and from the `cycles` that are known:
    value of λ, a state of the cycle, and its period. Each fold of cycles is given at the state whose first
    component is largest.

    Raises
    ------
    ValueError
        When there is no such parameter, or no domain.

    Examples
    --------
    A cusp, ``ẋ = h + x - x³``, folds at ``h = ±2/(3√3)``:

    >>> import sympy
    >>> h, x = sympy.symbols("h x", real=True)
    >>> cusp = Dynamics.of((x,), (h + x - x**3,), domain=[(-2, 2)], parameters={h: 0.0})
    >>> _, found, _ = follow_branches(cusp, "h", (-1.0, 1.0), [(0.0, np.array([1.0]))])
    >>> [(one.kind, round(one.value, 10)) for one in found]
    [('fold', -0.3849001795), ('fold', 0.3849001795)]
    """
    family = _Family(dynamics, {parameter: limits})
    equations, along = _Equilibria(family), np.eye(family.count)[-1]
    branches: list[Branch] = []
    found: list[Bifurcation] = []
    remarks: list[Remark] = []
    for value, state in seeds:
        start = _across(equations, family.shares(state, value), along)
        branch, stop = _branch_through(equations, start, along, branches)
        if stop:
            place = {"state": np.round(state, 4).tolist(), "parameter": parameter, "value": value}
            remarks.append(Remark("systems.branch_not_followed", place | stop))
        if branch is None:
            continue
        for one in _bifurcations(equations, branch, len(branches)):
            # A branch point lies on every branch that crosses there.
            place_of_one = family.shares(one.state, one.value)
            others = [family.shares(each.state, each.value) for each in found if each.kind == one.kind]
            if all(np.abs(place_of_one - other).max() > BIFURCATION_MERGE_TOLERANCE for other in others):
                found.append(one)
        branches.append(branch)
    if cycles is not None:
        _follow_cycles(family, parameter, branches, found, remarks, cycles)
    found.sort(key=lambda one: one.value)
    return branches, found, remarks


def _follow_cycles(
    family: _Family, parameter: str, branches: list[Branch], found: list[Bifurcation],
    remarks: list[Remark], seeds: Sequence[tuple[float, np.ndarray, float]],
) -> None:  # fmt: skip
    """Add branches of cycles to those of equilibria, folds of cycles to what was found, and remarks."""
    first = len(branches)
    starts: list[tuple[_Cycles, np.ndarray, np.ndarray]] = []
    for one in found:
        z = family.shares(one.state, one.value)
        if one.kind == "Hopf" and (start := _Cycles.from_hopf(family, z)) is not None:
            starts.append(start)
    for known, passed, period in seeds:
        z = family.shares(passed, known)
        cycles = _Cycles(family, period, z[: family.d], z[: family.d])
        starts.append((cycles.at(z), np.append(z, 1.0), np.eye(family.count + 1)[family.d]))
    for equations, guess, ahead in starts:
        state, value = np.split(family.natural(guess[: family.count]), [family.d])
        ends = [one._points[place] for one in branches[first:] for place in (0, -1)]
        begun = any(np.linalg.norm((end - guess)[: family.count]) < 5 * FIRST_AMPLITUDE for end in ends)
        if begun or any(one.index_of_cycle(state, float(value[0])) is not None for one in branches[first:]):
            continue
        branch, stop = _branch_through(equations, _across(equations, guess, ahead), ahead, [])
        if branch is None or stop:
            place = {"state": np.round(state, 4).tolist(), "parameter": parameter, "value": float(value[0])}
            remarks.append(Remark("systems.branch_not_followed", place | (stop or {"most": None})))
        if branch is None:
            continue
        for k in np.flatnonzero(branch.tangents[:-1, family.d] * branch.tangents[1:, family.d] < 0):
            y = _fold_of_cycles(equations, branch, int(k))
            if equations.length(y) < 2 * np.pi * FIRST_AMPLITUDE:
                continue  # at a Hopf point λ turns back, too, as the cycle goes on with its other side
            states = equations.course(y[None])[:, 0]
            fold = family.natural(y[: family.count])[-1]
            place_of_fold = states[np.argmax(states[:, 0])]
            gap = float(np.abs(equations.at(y).residual(y)).max())
            found.append(
                Bifurcation("fold of cycles", float(fold), place_of_fold, len(branches),
                            equations.frequency(y), gap)
            )  # fmt: skip
        branches.append(branch)


def _fold_of_cycles(equations: _Cycles, branch: Branch, k: int) -> np.ndarray:
    """Where the tangent turns back in λ between points k and k + 1."""
    last, tangent = branch._points[k], branch.tangents[k]
    whole, here = (branch._points[k + 1] - last) @ tangent, equations.at(last)

    def at(share: float) -> np.ndarray:
        moved = _across(here, last + share * whole * tangent, tangent)
        return last + share * (branch._points[k + 1] - last) if moved is None else moved

    def turning(share: float) -> float:
        y = at(share)
        return float(_tangent(equations.at(y), y, tangent)[equations.d])

    if turning(0.0) * turning(1.0) >= 0:
        return at(0.5)
    return at(float(brentq(turning, 0.0, 1.0, xtol=1e-6)))  # λ is stationary there: it is known to 1e-12


def _bifurcations(equations: _Equilibria, branch: Branch, number: int) -> list[Bifurcation]:
    """Folds, branch points and Hopf points between the points of a branch."""
    family, points, found = equations.family, branch._points, list[Bifurcation]()

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

    def add(kind: type[_Equilibria], z: np.ndarray, *, surely: bool = True) -> bool:
        """Add the solution of equations next to a point; `surely` takes the point where there is none."""
        if (near := kind.near(family, z)) is None:
            return False
        system, guess = near
        y = _solved(system.residual, system.slope, guess)
        if y is None or np.linalg.norm((y - guess)[: family.count]) >= NEWTON_RADIUS:
            if not surely:
                return False
            y = guess
        state, value = np.split(family.natural(y[: family.count]), [family.d])
        residual = float(np.abs(family.flow(y[: family.count])).max())
        frequency = abs(system.frequency(y))
        found.append(Bifurcation(kind.kind, float(value[0]), state, number, frequency, residual))
        return True

    unstable = branch.unstable
    for k in range(len(points) - 1):
        turns = branch.tangents[k, -1] * branch.tangents[k + 1, -1] < 0
        if turns or determinant(points[k]) * determinant(points[k + 1]) < 0:
            ahead = branch.tangents[k]
            z = zero(k, lambda z: float(_tangent(equations, z, ahead)[-1]) if turns else determinant(z))  # noqa: B023
            slopes = family.slopes(z)
            left = np.linalg.svd(slopes[:, :-1])[0][:, -1]
            fold = turns and abs(left @ slopes[:, -1]) > FOLD_MARGIN * np.linalg.norm(slopes)
            if not (fold and add(_Folds, z, surely=False)):
                add(_BranchPoints, z)
        elif abs(unstable[k + 1] - unstable[k]) == 2 and np.isfinite([*map(growth, points[k : k + 2])]).all():
            add(_HopfPoints, zero(k, growth))
    return found


def follow_curves(
    dynamics: Dynamics, limits: Mapping[str, tuple[float, float]],
    seeds: Sequence[tuple[str, np.ndarray, np.ndarray]],
) -> tuple[list[Branch], list[Remark]]:  # fmt: skip
    """Curves of folds and of Hopf points within the ranges of two parameters and the domain of the states.

    Seeds are known points of curves: the kind, ``fold`` or ``Hopf``, the values of the two parameters
    ``(2,)``, and the state ``(d,)``. A curve through none of them is not found. Each is given once, in the
    order of the seeds; and what could not be followed.

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
    >>> (curve,), _ = follow_curves(cusp, {"a": (-1.0, 1.0), "b": (-1.0, 2.0)}, [seed])
    >>> bool(np.abs(27 * curve.values[:, 0] ** 2 - 4 * curve.values[:, 1] ** 3).max() < 1e-10)
    True
    """
    if len(limits) != 2:
        raise Fault("a curve lies in the plane of two parameters", f"{len(limits)} are named")
    family = _Family(dynamics, limits)
    curves: list[Branch] = []
    remarks: list[Remark] = []
    for kind, values, state in seeds:
        near = (_Folds if kind == "fold" else _HopfPoints).near(family, family.shares(state, values))
        if near is None:
            continue
        equations, y = near
        start = _across(equations, y, _tangent(equations, y, np.eye(len(y))[family.d]))
        if start is None or np.linalg.norm((start - y)[: family.count]) > NEWTON_RADIUS:
            continue
        curve, stop = _branch_through(equations, start, np.ones(len(start)), curves)
        if curve is None:
            continue
        curves.append(curve)
        if stop:
            place = {"kind": kind, "names": list(limits), "values": curve.values[0].tolist()}
            remarks.append(Remark("systems.curve_not_followed", place | stop))
    return curves, remarks
