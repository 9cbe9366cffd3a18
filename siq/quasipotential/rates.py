"""Mean escape times: the Eyring–Kramers law with its prefactor, for drifts without a potential.

The law of Eyring, Kramers and Langer takes states about the saddle to be those of the stationary density.
Where friction is weak they are not: what turns at the height of the saddle comes back to it after one turn,
having lost ΔU_turn by friction, and leaves the well before noise has replaced it. The law holds if ``ΔU_turn
≫ ε``.

For a damped particle in one dimension, ``dx = c v dt``, ``dv = (F(x) - γ v) dt + √(εD) dW``, the rate is
known for any friction. That of Kramers is multiplied by

    Υ(δ) = exp(∫ ln(1 - exp(-δ (y² + ¼))) / (y² + ¼) dy/2π),    δ = ΔU_turn/ε,

if what has left does not come back, and by ``Υ(δ₁)Υ(δ₂)/Υ(δ₁ + δ₂)`` if beyond the saddle lies a second
well. The loss is that of an orbit without friction at the height of the saddle, ``ΔU_turn = 2γ²/D ∮ v² dt``.

References
----------
V. I. Mel'nikov and S. V. Meshkov, J. Chem. Phys. 85 (1986) 1018: the rate for any friction.
P. Hänggi, P. Talkner and M. Borkovec, Rev. Mod. Phys. 62 (1990) 251, sections IV and VI.

For ``dx = f dt + sqrt(ε) D^(1/2) dW`` and an attractor A whose lowest way out leads over the saddle S,

    E[τ] = (2π/λ) (|det M_S| / det M_A)^(1/2) exp(∫ c dt) exp(ΔU/ε) (1 + O(ε)),    c = ∇·g + (∇·D)·p,

where λ is the positive eigenvalue of the Jacobian at S, M are the Hessians of V (not of U = 2V), and the
integral runs along the path ``ẋ = f + 2Dp`` from A to S, where ``∇·g = ∇·f + ∇·(D∇V)``; c vanishes at both
ends. For a constant D it is Bouchet and Reygner's formula (their ε is ε/2 here), and for g = 0 that of Eyring
and Kramers.

Where D depends on the state, the noise being Itô's, the stationary density ``C exp(-U/ε)`` obeys at the next
order of ``½ε ∂_i∂_j(D_ij ρ) = ∂_i(f_i ρ)`` along the path ``d ln C/dt = -(∇·f + 2(∇·D)·p + tr D∇²V)``, with
``(∇·D)_j = Σ_i ∂_i D_ij``. The escapes are the flux over S, ``C_S λ/2π (πε)^(d/2) |det M_S|^(-1/2)``, of what
is about A, ``C_A (πε)^(d/2) (det M_A)^(-1/2)``. In one dimension C = 1/D.

*Escape* means to have reached the neighbourhood of the attractor beyond S. A trajectory at S itself comes
back half of the time, so that S, or the separatrix, is reached in half of E[τ].

Where V has second derivatives, its Hessian obeys one equation at every equilibrium: of the second derivatives
of ``∇V·(f + D∇V) = 0`` remains ``JᵀM + MJ + 2MDM = 0``, or for ``W = M⁻¹``

    J W + W Jᵀ = -2D.

By the inertia theorem W has as many negative eigenvalues as J has unstable ones: at A it is positive
definite, at S one eigenvalue is negative, as it must be for a pass of V. Along the path M follows

    Ṁ = -GᵀM - MG - 2MDM - Σ_k p_k ∇²f_k - p·∇²D p,    M ẋ = ṗ,

with ``G_ik = J_ik + 2 ((∂_k D)p)_i``, where the second equation, which the first one conserves, has to be
imposed: errors along the path grow. Where S attracts as fast as it repels, ``J W + W Jᵀ`` leaves M_S open,
and it is taken from the end of the path.

D may be singular, where noise acts on velocities alone: all of this holds as it stands, and for a damped
particle λ is that of Kramers, ``√(γ²/4 + ω²) - γ/2``. But the law is that of spatial diffusion. Where
damping is weak the rate is lower (`siq.quasipotential.rates`).

References
----------
F. Bouchet and J. Reygner, Ann. Henri Poincaré 17 (2016) 3499.
R. S. Maier and D. L. Stein, SIAM J. Appl. Math. 57 (1997) 752: where V is not smooth at the saddle.

K follows from f by determinants at both ends of the path and by an integral along it, and the path itself
moves with f. So f is changed by standard deviations along the axes of its covariance, the path found again
from the old one, forwards and back: half of what then differs in ln K and in ΔU, axis by axis, makes their
variances and their covariance. A D that was found as a formula of the state is changed with f.

A well is left over every one of its saddles, and the rates add. Over one saddle the mean time is

    E[τ] = K exp(ΔU/ε)

(`siq.quasipotential.rates`; longer where damping is weak, `siq.quasipotential.rates`), from the well to the
neighbourhood of the next attractor; the saddle itself is reached in half of it. The relative error of E[τ]
has three parts:

- from f: the standard errors of ΔU/ε and of ln K, which follow from the same f and err together
  (`siq.quasipotential.rates`). Where that of K is not known it is taken to be relatively as uncertain
  as ΔU, since both follow from f to the first order;
- from the noise: ΔU/ε times the relative error of ε. Where D itself is estimated, the error of its parts is
  larger than that of their mean, and a path that runs along one of them has the larger one: `leverage`;
- from the law itself, the leading order for small ε: about ε/ΔU.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.linalg
import sympy
from scipy.integrate import quad, simpson
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from siq.errors import NumericalFailure
from siq.inference.field_estimate import AnyField, GivenField, IdentifiedField
from siq.quasipotential.paths import MinimumActionPath, minimum_action_path
from siq.quasipotential.power_series import cubic_series, quasipotential_series
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import classify, hessian_at, measure_at

KNOWN = 0.9  # Υ below which the law of many degrees of freedom is refused: it is off by more than a tenth
RETURNED = 0.5  # of the farthest distance from the saddle: a path that has come back so close has made a turn
SEARCHED = 2000  # steps in search of the turning point beyond the saddle
FARTHEST = 20.0  # distances from the saddle to the attractor, up to which it is sought


@dataclass(frozen=True)
class TurnLoss:
    """How much of U is lost by friction in one turn at the height of the saddle.

    Attributes
    ----------
    own
        In the well that is left.
    beyond
        In the well beyond the saddle; None where there is none, or it is not known.
    exact
        Whether the system is a damped particle in one dimension, so that the rate is known for any noise.
    """

    own: float
    beyond: float | None = None
    exact: bool = False

    def factor(self, intensity: float) -> float:
        """By how much the rate of escape is lower than by the law; NaN where that is not known.

        Examples
        --------
        >>> round(TurnLoss(1.0, exact=True).factor(0.01), 3)
        1.0
        >>> round(TurnLoss(1.0, 1.0, exact=True).factor(1.0), 3)
        0.306
        """
        own = depopulation(self.own / intensity)
        if not self.exact:
            return 1.0 if own >= KNOWN else np.nan
        if self.beyond is None:
            return own
        both = depopulation((self.own + self.beyond) / intensity)
        return own * depopulation(self.beyond / intensity) / both


def depopulation(loss: float) -> float:
    """Υ of Mel'nikov and Meshkov for a loss in units of ε: from the loss itself, where small, to 1."""

    def integrand(y: float) -> float:
        return float(np.log(-np.expm1(-loss * (y * y + 0.25))) / (y * y + 0.25))

    return float(np.exp(quad(integrand, 0, np.inf, limit=200)[0] / np.pi))


def turn_loss(dynamics: Dynamics, path: MinimumActionPath, *, beyond: bool) -> TurnLoss | None:
    """The loss in one turn, None where nothing turns, or noise acts on every state.

    Parameters
    ----------
    dynamics
        f and D.
    path
        From the attractor to the saddle.
    beyond
        Whether beyond the saddle lies a well, from which states may come back.
    """
    if dynamics.diffusion.regular:
        return None
    particle = _particle(dynamics)
    if particle is not None:
        own = _loss(particle, path.points[-1], path.points[0])
        mirrored = 2 * path.points[-1] - path.points[0]
        return TurnLoss(own, _loss(particle, path.points[-1], mirrored) if beyond else None, exact=True)
    away = np.linalg.norm((path.points - path.points[-1]) / np.ptp(path.points, axis=0), axis=1)[::-1]
    back = np.flatnonzero((away < RETURNED * np.maximum.accumulate(away)) & (np.arange(len(away)) > 0))
    if not len(back):
        return None
    nearest = int(back[0])
    while nearest + 1 < len(away) and away[nearest + 1] < away[nearest]:
        nearest += 1
    return TurnLoss(float(path.action - path.values[::-1][nearest]))


@dataclass(frozen=True)
class _Particle:
    """``dx = c v dt``, ``dv = (F(x) - γ v) dt + √(εD) dW``; `place` is the index of x, `force` F(x)."""

    place: int
    speed: float
    friction: float
    noise: float
    force: sympy.Expr
    symbol: sympy.Symbol


def _particle(dynamics: Dynamics) -> _Particle | None:
    """The system as a damped particle in one dimension, None where it is none."""
    if dynamics.dimension != 2 or not dynamics.diffusion.constant:
        return None
    noise = np.diag(dynamics.diffusion.matrix)
    for place in (0, 1):
        x, v = dynamics.symbols[place], dynamics.symbols[1 - place]
        speed, rest = dynamics.formulas[place].as_coeff_Mul()
        friction = -sympy.simplify(dynamics.formulas[1 - place].diff(v))
        if noise[place] == 0 and rest == v and friction.is_number and friction > 0:
            force = dynamics.formulas[1 - place].subs(v, 0)
            return _Particle(place, float(speed), float(friction), float(noise[1 - place]), force, x)
    return None


def _loss(particle: _Particle, saddle: np.ndarray, towards: np.ndarray) -> float:
    """``2γ²/D ∮ v² dt`` of the orbit without friction that leaves the saddle to one side."""
    top, step = saddle[particle.place], towards[particle.place] - saddle[particle.place]
    force = sympy.lambdify(particle.symbol, particle.force, "numpy")
    places = top + step * np.linspace(0, FARTHEST, SEARCHED * int(FARTHEST) + 1)
    forces = np.broadcast_to(np.asarray(force(places), dtype=float), places.shape)
    # The height of the potential above the saddle, by Simpson's rule on pairs of steps.
    work = (
        np.r_[0.0, np.cumsum((forces[:-2:2] + 4 * forces[1:-1:2] + forces[2::2]) / 6)] * 2 * (places[1] - top)
    )
    height, places = -work, places[::2]
    higher = np.flatnonzero(height[1:] > 0)
    if not len(higher) or higher[0] == 0:
        raise NumericalFailure("an orbit at the height of the saddle does not turn back within reach")
    last = higher[0] + 1
    turning = brentq(lambda share: np.interp(share, np.arange(len(height)), height), last - 1, last)
    inner = height[:last]
    speeds = np.sqrt(np.maximum(-2 * inner / particle.speed, 0.0))
    spacing = abs(places[1] - places[0])
    # v vanishes as a root at the turning point: of the last piece two thirds of its height count.
    area = spacing * (np.trapezoid(speeds) + 2 / 3 * speeds[-1] * (turning - (last - 1)))
    return float(4 * particle.friction**2 / (particle.noise * particle.speed) * area)


NEAR_ATTRACTOR = 0.01  # of the distance from A to S, in the metric of M: up to there V is its power series
NEAR_BY_CUBE = 0.003  # the same where V is known to its third powers only
MOST_STATES = 8  # for a power series of degree 4
NEAR_SADDLE = 0.003  # of the distance: from there at the latest the integrand is continued to S
AT_REST = 1e-5  # f at an equilibrium, in units of the rate and the distance
LONGEST_STEP = 0.2  # of Riccati's equation, in units of the largest rate
MOST_STEPS = 1e6  # numerical, a guard
LARGEST = 1e5  # of ∇²V to its size at the attractor: beyond lies a caustic
RESONANT = 0.1  # of λ: as close to it, with the other sign, other eigenvalues leave M_S undecided
SKEW, SLIGHT_SKEW = 0.1, 0.01  # |p - M_S (x - S)| to its parts at the saddle
SAME_ACTION = 1e-3  # of the action: closer paths are rivals for which the law has no single prefactor


@dataclass(frozen=True)
class EscapeRate:
    """The mean time of escape over one saddle, as a function of the noise.

    Attributes
    ----------
    barrier
        ΔU = 2ΔV, in the unit of ε.
    prefactor
        In time units; what stands before ``exp(ΔU/ε)``, the exponential of the integral included.
    exponent
        ``∫ (∇·g + (∇·D)·p) dt`` along the path; zero if D is constant and g has no divergence there.
    notes
        What speaks against the law here without refuting it.
    turn
        What is lost of U in one turn about the well, where noise acts on some states only and they turn.
    """

    barrier: float
    prefactor: float
    exponent: float
    notes: tuple[str, ...] = ()
    turn: TurnLoss | None = None

    def mean_time(self, intensity: float) -> float:
        """E[τ] for the noise intensity ε, with a relative error of O(ε/ΔU).

        Raises
        ------
        NumericalFailure
            When ε is not below the barrier: then nothing is to be escaped from. Or when damping is too weak
            for ε: noise does not spread states before the saddle (`siq.quasipotential.rates`).
        """
        if not 0 < intensity < self.barrier:
            raise NumericalFailure(
                f"the escape law holds for ε far below the barrier of U, {self.barrier:.4g}, not for"
                f" {intensity:.4g}"
            )
        slower = 1.0 if self.turn is None else self.turn.factor(intensity)
        if not np.isfinite(slower):
            assert self.turn is not None
            raise NumericalFailure(
                f"damping is too weak for the escape law: in one turn U = {self.turn.own:.3g} is lost, and"
                f" ε = {intensity:.4g} is not far below; simulate, or give a smaller ε"
            )
        return float(self.prefactor * np.exp(self.barrier / intensity) / slower)


def mean_escape_time(rates: Sequence[EscapeRate], intensity: float) -> float:
    """E[τ] with several ways out, whose rates add; a way that exists twice by symmetry stands twice."""
    return 1 / sum(1 / rate.mean_time(intensity) for rate in rates)


def escape_rate(
    dynamics: Dynamics,
    path: MinimumActionPath,
    *,
    hessian: Callable[[np.ndarray], np.ndarray] | None = None,
    beyond: bool = True,
) -> EscapeRate:
    """The law of escape along a minimum action path from an attractor to a saddle.

    Parameters
    ----------
    dynamics
        f, twice differentiable.
    path
        From the attractor to the saddle (`siq.quasipotential.paths.minimum_action_path`). With its tolerance
        of 1e-4 the prefactor is good to a percent, with 1e-5 to a few thousandths.
    hessian
        ∇²V of a formula, points ``(n, d)`` to ``(n, d, d)``; by default it is integrated along the path.
    beyond
        Whether beyond the saddle lies another well; it matters where damping is weak.

    Returns
    -------
    EscapeRate
        The law fails, with another power of ε in the prefactor, where V has no second derivatives at the
        saddle: as for Maier and Stein's system with β > 4, and in general where the saddle attracts more
        slowly than it repels. This is looked for and refused. If it attracts less than twice as fast, the law
        holds, but with an error of a small power of ε instead of O(ε), which is noted. It is not looked for
        whether there is a lower saddle, and ε must be far below the barrier.

    Raises
    ------
    NumericalFailure
        When the path does not lead from an attractor, which cannot be a cycle, to a saddle with one unstable
        direction; when it meets a caustic; or when V is not smooth at the saddle.
    """
    frame = _Frame(dynamics, path)
    twins = any(abs(one - path.action) < SAME_ACTION * path.action for one in path.rivals)
    notes, skew = [], frame.skew()
    if not path.converged:
        notes.append("the minimum action path is not converged")
    if frame.resonant:
        notes.append("the stable and the unstable rate at the saddle are nearly equal: the law sets in late")
    elif skew > SLIGHT_SKEW and frame.stable < 2 * frame.unstable:
        notes.append("the path turns until it is close to the saddle: the law sets in late")
    if twins:
        notes.append("a second path leads to the saddle with the same action: the rate may be twice as high")
    if (frame.resonant and twins) or (skew > SKEW and frame.stable < frame.unstable):
        raise NumericalFailure(
            "V is not smooth at the saddle, where the path does not arrive along the direction in which V"
            " would fall; the escape time then has another power of ε in its prefactor"
        )
    curvatures = frame.integrated() if hessian is None else frame.given(hessian, frame.points[::2])
    exponent = frame.exponent(curvatures)
    at_saddle = frame.continued(curvatures) if frame.at_saddle is None else frame.at_saddle
    ratio = abs(np.linalg.det(at_saddle)) / np.linalg.det(frame.at_attractor)
    prefactor = 2 * np.pi / (frame.unstable * frame.rate) * np.sqrt(ratio) * np.exp(exponent)
    turn = turn_loss(dynamics, path, beyond=beyond)
    if turn is not None and not turn.exact:
        notes.append(f"states turn about the well, and the law holds for ε far below {turn.own:.3g}")
    elif turn is not None and turn.own < path.action:
        notes.append(f"one turn before the saddle loses U = {turn.own:.3g}: times by Mel'nikov and Meshkov")
    return EscapeRate(path.action, float(prefactor), exponent, tuple(notes), turn)


class _Frame:
    """A path in units in which D at A, the distance from A to S, and the largest rate are one.

    A D without inverse is replaced there (`siq.systems.equilibria.measure_at`). ``x = A
    + units y``, and V is in units of `unit`. The points, with momenta and velocities, are those from close
    to A to the neighbourhood of S; `at_attractor` and `at_saddle` are the Hessians of V.
    """

    def __init__(self, dynamics: Dynamics, path: MinimumActionPath) -> None:
        start, end = path.points[0], path.points[-1]
        ends = np.stack([start, end])
        at_start = measure_at(dynamics, start).frozen(start)
        root, whitening = at_start.root, at_start.whitening
        distance = float(np.linalg.norm(whitening @ (end - start)))
        jacobians = whitening @ dynamics.jacobian(ends) @ root
        self.rate = float(np.linalg.norm(jacobians, axis=(1, 2)).max())
        speeds = np.linalg.norm(dynamics.drift(ends) @ whitening.T, axis=1)
        resting = speeds < AT_REST * self.rate * distance
        saddle = classify(dynamics, end)
        if not resting[0] or classify(dynamics, start).kind != "attractor":
            raise NumericalFailure(f"the path starts at {start.tolist()}, which is no stable equilibrium")
        if not resting[1] or saddle.kind == "degenerate" or saddle.unstable != 1:
            raise NumericalFailure(f"the path ends at {end.tolist()}, no saddle with one unstable direction")
        self.unstable = float(saddle.eigenvalues[0].real) / self.rate
        sums = np.abs(saddle.eigenvalues[1:] / self.rate + self.unstable)
        self.resonant = bool(sums.min(initial=np.inf) < RESONANT * self.unstable)
        self.stable = float(-saddle.eigenvalues[1:].real.max(initial=-np.inf)) / self.rate
        self.dynamics, self.start, self.units = dynamics, start, distance * root
        self.constant = dynamics.diffusion.constant
        self.white = self.constant and dynamics.diffusion.regular  # then D is the unit matrix
        self.noise = dynamics.diffusion.in_units(start, self.units, distance**2)
        many = dynamics.dimension > MOST_STATES
        self.series = (
            cubic_series(dynamics, start) if many else quasipotential_series(dynamics, start, degree=4)
        )
        self.inverse, self.unit = whitening / distance, distance**2 * self.rate
        self.at_attractor = self.curvature(hessian_at(dynamics, start))
        self.at_saddle = None
        if not self.resonant:
            self.at_saddle = self.curvature(hessian_at(dynamics, end))
        self.end = self.inverse @ (end - start)
        points, momenta = (path.points - start) @ self.inverse.T, path.momenta @ self.units / self.unit
        level = np.einsum("ni,ij,nj->n", points, self.at_attractor, points)
        used = np.linalg.norm(points - self.end, axis=1) > NEAR_SADDLE
        near = NEAR_BY_CUBE if many else NEAR_ATTRACTOR
        used[: int(np.sum(level < near**2 * level[-1]))] = False
        self._lay_grid(points[used], momenta[used])

    def _lay_grid(self, points: np.ndarray, momenta: np.ndarray) -> None:
        """A grid along the path, with the time per unit of it; a step in time is two of its intervals."""
        count, dimension = points.shape
        curve = CubicSpline(np.arange(count), np.column_stack([points, momenta]))

        def along(share: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
            y, p = np.split(curve(share), 2, axis=1)
            v = self.velocity(y, p)
            speed = np.linalg.norm(v, axis=1)
            return y, p, v, np.linalg.norm(curve(share, 1)[:, :dimension], axis=1) / speed

        y, _, _, pace = along(np.arange(count))
        largest = np.linalg.norm(self.jacobian(y), axis=(1, 2)) + 2 * np.linalg.norm(
            self.diffusion(y) @ self.at_attractor, axis=(1, 2)
        )
        # As many steps from one point of the path to the next as its two ends call for.
        parts = np.ceil(np.maximum(pace[1:], pace[:-1]) * largest.max() / LONGEST_STEP)
        if not parts.sum() < MOST_STEPS:
            raise NumericalFailure("the path comes to rest on its way to the saddle: another one lies on it")
        parts = parts.astype(int)
        within = [index + np.arange(2 * n) / (2 * n) for index, n in enumerate(parts)]
        self.grid = np.append(np.concatenate(within), count - 1)
        self.points, self.momenta, self.velocities, self.pace = along(self.grid)

    def curvature(self, hessian: np.ndarray) -> np.ndarray:
        """Hessians of V in these units, from those in the states' units."""
        return self.units.T @ hessian @ self.units / self.unit

    def velocity(self, y: np.ndarray, p: np.ndarray) -> np.ndarray:
        """``ẋ = f + 2Dp``."""
        push = p if self.white else np.einsum("nij,nj->ni", self.diffusion(y), p)
        return self.dynamics.drift(self.start + y @ self.units.T) @ self.inverse.T / self.rate + 2 * push

    def diffusion(self, y: np.ndarray) -> np.ndarray:
        """D, ``(n, d, d)``."""
        if self.white:
            return np.broadcast_to(np.eye(y.shape[1]), (len(y), y.shape[1], y.shape[1]))
        return self.noise.at(y)

    def jacobian(self, y: np.ndarray) -> np.ndarray:
        """J, ``(n, d, d)``."""
        return self.inverse @ self.dynamics.jacobian(self.start + y @ self.units.T) @ self.units / self.rate

    def bend(self, y: np.ndarray, p: np.ndarray) -> np.ndarray:
        """``Σ_k p_k ∇²f_k + p·∇²D p``, ``(n, d, d)``."""
        second = self.dynamics.bend(self.start + y @ self.units.T, p @ self.inverse / self.rate)
        bent = np.asarray(self.units.T @ second @ self.units)
        return bent if self.constant else bent + self.noise.contract(y, p, 2)

    def rise(self, y: np.ndarray, p: np.ndarray, curvatures: np.ndarray) -> np.ndarray:
        """c, by which the logarithm of the density's prefactor falls along the path: shape ``(n,)``."""
        rise = np.trace(self.jacobian(y) + self.diffusion(y) @ curvatures, axis1=1, axis2=2)
        return rise if self.constant else rise + 2 * (self.noise.divergence(y) * p).sum(axis=1)

    def skew(self) -> float:
        """``|p - M_S (x - S)|`` at the end of the path to its parts, zero if V has this Hessian at S.

        If S attracts faster than it repels, every path arrives so in the end. If it attracts more slowly,
        that is the exception: p vanishes before x - S does. In between, where the linearisation leaves M_S
        open, nothing is said.
        """
        if self.at_saddle is None:
            return 0.0
        p, linear = self.momenta[::2], (self.points[::2] - self.end) @ self.at_saddle
        off = np.linalg.norm(p - linear, axis=1)
        off /= np.linalg.norm(p, axis=1) + np.linalg.norm(linear, axis=1)
        return float(self.continued(off))

    def _rest(self) -> tuple[float, int]:
        """How far the last point is from S; and the index, of every other one, of the last twice as far."""
        away = np.linalg.norm(self.points[::2] - self.end, axis=1)
        return float(away[-1]), int(np.flatnonzero(away > 2 * away[-1]).max(initial=0))

    def continued(self, along: np.ndarray) -> np.ndarray:
        """What the values at every other point would be at S, on a straight line through the last ones."""
        rest, before = self._rest()
        far = np.linalg.norm(self.points[2 * before] - self.end)
        return along[-1] + (along[-1] - along[before]) * rest / (far - rest)

    def exponent(self, curvatures: np.ndarray) -> float:
        """∫ c dt over the whole path; near S the integrand per length is continued as a straight line."""
        rise = self.rise(self.points[::2], self.momenta[::2], curvatures)
        density = rise / np.linalg.norm(self.velocities[::2], axis=1)
        outer = self._rest()[0] * (density[-1] + self.continued(density)) / 2
        return float(self.inner_exponent() + simpson(rise * self.pace[::2], x=self.grid[::2]) + outer)

    def inner_exponent(self) -> float:
        """∫ c dt from A to the first point y: with ``ẏ = By`` and ``c = b·y`` it is ``b·B⁻¹y``."""
        here = np.zeros((1, len(self.end)))
        flow = self.jacobian(here)[0] + 2 * self.diffusion(here)[0] @ self.at_attractor
        y = np.linalg.solve(flow, self.points[0]) * np.array([[1.0], [-1.0]])
        p = self.series.gradients(self.start + y @ self.units.T) @ self.units / self.unit
        odd = self.rise(y, p, self.given(self.series.hessians, y))
        return float(odd[0] - odd[1]) / 2

    def given(self, hessian: Callable[[np.ndarray], np.ndarray], y: np.ndarray) -> np.ndarray:
        """∇²V of a formula at points."""
        return self.curvature(hessian(self.start + y @ self.units.T))

    def integrated(self) -> np.ndarray:
        """∇²V at every other point by Riccati's equation, from the power series at A; Runge–Kutta of order 4.

        Raises
        ------
        NumericalFailure
            Where it diverges.
        """
        jacobians, bends = self.jacobian(self.points), self.bend(self.points, self.momenta)
        forces = -np.einsum("nji,nj->ni", jacobians, self.momenta)
        noise = self.diffusion(self.points)
        if not self.constant:
            forces -= self.noise.contract(self.points, self.momenta, 1)
            jacobians = jacobians + 2 * self.noise.turn(self.points, self.momenta)
        largest = LARGEST * np.abs(self.at_attractor).max()

        def rate(m: np.ndarray, index: int) -> np.ndarray:
            product = m @ jacobians[index]
            return -self.pace[index] * (product + product.T + 2 * m @ noise[index] @ m + bends[index])

        m = _imposed(self.given(self.series.hessians, self.points[:1])[0], self.velocities[0], forces[0])
        kept = [m]
        for index in range(0, len(self.points) - 2, 2):
            h = self.grid[index + 2] - self.grid[index]
            with np.errstate(all="ignore"):
                k1 = rate(m, index)
                k2 = rate(m + h / 2 * k1, index + 1)
                k3 = rate(m + h / 2 * k2, index + 1)
                m = m + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(m + h * k3, index + 2))
            if not np.abs(m).max() < largest:
                place = self.start + self.units @ self.points[index]
                raise NumericalFailure(
                    f"the path meets a caustic near {place.tolist()}: V is not smooth there"
                )
            m = _imposed(m, self.velocities[index + 2], forces[index + 2])
            kept.append(m)
        return np.array(kept)


def _imposed(m: np.ndarray, velocity: np.ndarray, force: np.ndarray) -> np.ndarray:
    """The symmetric matrix that maps a velocity to a force, and is m across the velocity."""
    speed = np.linalg.norm(velocity)
    u, w = velocity / speed, force / speed
    across = np.eye(len(u)) - np.outer(u, u)
    mixed = np.outer(u, w)
    return across @ m @ across + mixed + mixed.T - (u @ w) * np.outer(u, u)


MOST_AXES = 6  # of the covariance; of more, as many random ones stand for all: the error is good to 20 %
FEWEST = 0.5  # of the axes, on which the law has to hold: otherwise its error is not known
TOLERANCE = 1e-3  # of the action: both ends of a difference have the same error, and lose it
NODES = 60
NEWTON = 12
SETTLED = 1e-9  # of the distance from attractor to saddle, by which Newton's last step may still move
PREFACTOR_ERRORS_FARTHEST = 0.5  # of that distance: an equilibrium that moves by more is another one


@dataclass(frozen=True)
class PrefactorError:
    """The uncertainty of ln K from that of f and D.

    Attributes
    ----------
    standard_error
        Of ln K: relative, of K.
    covariance
        Of ln K and ΔU, in the unit of ε.
    """

    standard_error: float
    covariance: float


def prefactor_error(found: AnyField, path: MinimumActionPath, *, seed: int = 0) -> PrefactorError | None:
    """The uncertainty of the prefactor of a way out.

    Parameters
    ----------
    found
        f with the covariance of its coefficients.
    path
        Of least action from the attractor to the saddle.
    seed
        Of the axes, where there are more than `MOST_AXES`.

    Returns
    -------
    PrefactorError or None
        Zero where f carries no noise; None where the law holds for too few of the changed f.
    """
    if isinstance(found, GivenField) or found.noise_free:
        return PrefactorError(0.0, 0.0)
    changes = []
    covariance = found.covariance
    if found.noise is not None:
        covariance = scipy.linalg.block_diag(covariance, found.noise.covariance)
    axes = covariance_axes(covariance, np.random.default_rng(seed))
    for axis in axes:
        up, down = (_log_prefactor(_changed(found, one), path) for one in (axis, -axis))
        if up is not None and down is not None:
            changes.append(np.subtract(up, down) / 2)
    if len(changes) < FEWEST * len(axes):
        return None
    logarithm, barrier = np.array(changes).T * np.sqrt(len(axes) / len(changes))
    return PrefactorError(float(np.linalg.norm(logarithm)), float(logarithm @ barrier))


def _changed(found: IdentifiedField, change: np.ndarray) -> Dynamics:
    """The dynamics with the coefficients of f changed, and those of εD where it depends on the state."""
    count = len(found.values)
    dynamics = found.dynamics.with_values(found.values + change[:count])
    if found.noise is None:
        return dynamics
    noise = replace(found.noise, values=found.noise.values + change[count:])
    return replace(dynamics, diffusion=noise.diffusion(found.intensity))


def covariance_axes(covariance: np.ndarray, draw: np.random.Generator) -> Sequence[np.ndarray]:
    """Changes of the p coefficients whose outer products add up to the covariance, at most `MOST_AXES`.

    Of more than that a random rotation is taken of which the first ones, made longer, have it in the mean.
    """
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    root = root[:, root.any(axis=0)]  # what is known exactly, as in dx/dt = v, has no axis
    count = root.shape[1]
    if count <= MOST_AXES:
        return list(root.T)
    turned = np.linalg.qr(draw.standard_normal((count, MOST_AXES)))[0]
    return list((np.sqrt(count / MOST_AXES) * root @ turned).T)


def _log_prefactor(dynamics: Dynamics, path: MinimumActionPath) -> tuple[float, float] | None:
    """Ln K and ΔU of the same way out for a changed f; None where there is none, or the law does not hold."""
    ends = [equilibrium_near(dynamics, path, end) for end in (0, -1)]
    if ends[0] is None or ends[1] is None:
        return None
    try:
        again = minimum_action_path(
            dynamics, ends[0], ends[1], nodes=NODES, tolerance=TOLERANCE, initial=[path.points]
        )
        rate = escape_rate(dynamics, again)
    except (NumericalFailure, ValueError, np.linalg.LinAlgError):
        return None
    return (float(np.log(rate.prefactor)), again.action) if rate.prefactor > 0 else None


def equilibrium_near(dynamics: Dynamics, path: MinimumActionPath, end: int) -> np.ndarray | None:
    """Where f vanishes next to an end of a path, by Newton's method; None where it does not."""
    x = path.points[end].copy()
    distance = float(np.linalg.norm(path.points[-1] - path.points[0]))
    for _ in range(NEWTON):
        try:
            step = np.linalg.solve(dynamics.jacobian(x[None])[0], dynamics.drift(x[None])[0])
        except np.linalg.LinAlgError:
            return None
        x = x - step
        if not np.linalg.norm(x - path.points[end]) < PREFACTOR_ERRORS_FARTHEST * distance:
            return None
        if np.linalg.norm(step) < SETTLED * distance:
            return x
    return None


DWELL_TIMES_FEWEST = (
    3.0  # ΔU/ε: the law's own error is a third there; below it gives no more than an order of magnitude
)


@dataclass(frozen=True)
class NoiseStrength:
    """The strength ε of ``√ε σ dW``, in the unit of U.

    Attributes
    ----------
    intensity, standard_error
        ε and its standard error.
    source
        Whether the recordings show it, or somebody gave it.
    """

    intensity: float
    standard_error: float = 0.0
    source: Literal["estimated", "given"] = "given"


@dataclass(frozen=True)
class Exit:
    """One way out of a well, as far as its time depends on it.

    Attributes
    ----------
    barrier, standard_error
        ΔU and its standard error.
    prefactor
        K, None where the law does not hold.
    prefactor_error, covariance
        Standard error of ln K, None where not known, and its covariance with ΔU.
    leverage
        Relative standard error of ΔU/ε from an estimated D over that of ε.
    turn
        What is lost of U in one turn about the well, where that matters (`siq.quasipotential.rates`).
    """

    barrier: float
    standard_error: float
    prefactor: float | None
    prefactor_error: float | None = None
    covariance: float = 0.0
    leverage: float = 1.0
    turn: TurnLoss | None = None


@dataclass(frozen=True)
class MeanTime:
    """A mean time with its errors.

    Attributes
    ----------
    value
        E[τ], in the recordings' unit of time.
    data_error
        Relative standard error from f and from the noise.
    law_error
        Relative error of the law itself, about ε/ΔU.
    complete
        Whether every way out counts; where one has no rate, the well lasts no longer than `value`.
    """

    value: float
    data_error: float
    law_error: float
    complete: bool = True

    @property
    def error(self) -> float:
        """The relative error as a whole."""
        return float(np.hypot(self.data_error, self.law_error))

    @property
    def limits(self) -> tuple[float, float]:
        """The range that one error spans, as a factor: a time is positive however uncertain it is."""
        factor = float(np.exp(self.error))
        return self.value / factor, self.value * factor


def exit_time(way: Exit, noise: NoiseStrength) -> MeanTime | None:
    """The mean time over one saddle; None where the law does not hold, or the noise is not below the barrier.

    Examples
    --------
    >>> found = exit_time(Exit(barrier=0.5, standard_error=0.01, prefactor=4.0), NoiseStrength(0.1))
    >>> round(found.value, 1), round(found.data_error, 3), found.law_error
    (593.7, 0.102, 0.2)
    """
    if way.prefactor is None or not 0 < noise.intensity < way.barrier:
        return None
    height = way.barrier / noise.intensity
    relative = way.standard_error / way.barrier
    with np.errstate(over="ignore"):
        slower = 1.0 if way.turn is None else way.turn.factor(noise.intensity)
        value = float(way.prefactor * np.exp(height) / slower)
    if not np.isfinite(value):
        return None
    of_prefactor = relative if way.prefactor_error is None else way.prefactor_error
    of_noise = height * way.leverage * noise.standard_error / noise.intensity
    squares = float(np.nansum(np.square((height * relative, of_prefactor, of_noise))))
    together = 2 * way.covariance / noise.intensity
    # By rounding, or by what is in one error alone, the two could cancel by more than there is.
    return MeanTime(value, float(np.sqrt(max(squares + together, np.nan_to_num(of_noise) ** 2))), 1 / height)


def dwell_time(ways: Sequence[Exit], noise: NoiseStrength | None) -> MeanTime | None:
    """The mean time in a well with these ways out; None where no way out has a rate.

    Ways whose rates fall behind by more than the errors change nothing; errors of different ways are added as
    if they were the same, since f and the noise are.
    """
    if noise is None:
        return None
    times = [exit_time(way, noise) for way in ways]
    known = [one for one in times if one is not None]
    if not known:
        return None
    rates = np.array([1 / one.value for one in known])
    shares = rates / rates.sum()
    return MeanTime(
        float(1 / rates.sum()),
        float(sum(share * one.data_error for share, one in zip(shares, known, strict=True))),
        float(sum(share * one.law_error for share, one in zip(shares, known, strict=True))),
        complete=len(known) == len(times),
    )
