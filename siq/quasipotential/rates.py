"""Mean escape times: the law of Eyring and Kramers with its prefactor, and what limits it.

For ``dx = f dt + sqrt(ε) D^(1/2) dW`` and an attractor A whose lowest way out leads over the saddle S,

    E[τ] = K exp(ΔU/ε) (1 + O(ε)),    K = (2π/λ) (|det M_S| / det M_A)^(1/2) exp(∫ c dt),

with the positive eigenvalue λ of the Jacobian J at S, the Hessians M of V (not of U = 2V), and the integral
of ``c = ∇·g + (∇·D)·p = ∇·f + tr D∇²V + 2 (∇·D)·p`` along the path ``ẋ = f + 2Dp`` from A to S, where
``(∇·D)_j = Σ_i ∂_i D_ij``. c is the rate at which the logarithm of the density's prefactor falls along the
path; it vanishes at both ends. For a constant D this is Bouchet and Reygner's formula (their ε is ε/2 here),
for g = 0 that of Eyring and Kramers.

*Escape* means to have reached the neighbourhood of the attractor beyond S. A trajectory at S itself comes
back half of the time, so that S, or the separatrix, is reached in half of E[τ].

**Hessians.** At every equilibrium ``JᵀM + MJ + 2MDM = 0``, so that ``W = M⁻¹`` solves ``J W + W Jᵀ = -2D``.
Along the path

    Ṁ = -GᵀM - MG - 2MDM - Σ_k p_k ∇²f_k - p·∇²D p,    M ẋ = ṗ,    G_ik = J_ik + 2 ((∂_k D)p)_i,

where the second equation, which the first one conserves, is imposed: errors along the path grow. Where S
attracts as fast as it repels, M_S is left open, and is taken from the end of the path.

**Weak damping.** D may be singular, where noise acts on velocities alone; for a damped particle λ is that of
Kramers, ``√(γ²/4 + ω²) - γ/2``. The law takes states about the saddle to be those of the stationary density.
Where friction is weak they are not, and it holds only if the energy loss per cycle at the height of the
saddle, ΔU_c, is far above ε. For ``dx = c v dt``, ``dv = (F(x) - γ v) dt + √(εD) dW`` the rate is known for
any friction: that of Kramers times

    Υ(δ) = exp(∫ ln(1 - exp(-δ (y² + ¼))) / (y² + ¼) dy/2π),    δ = ΔU_c/ε,    ΔU_c = 2γ²/D ∮ v² dt,

or times ``Υ(δ₁)Υ(δ₂)/Υ(δ₁ + δ₂)`` if a second well lies beyond the saddle.

**Errors.** f is changed by standard deviations along the axes of its covariance, and the path is found again:
half of what then differs in ln K and in ΔU, axis by axis, makes their variances and their covariance. The
relative error of E[τ] has three parts: that from f; ΔU/ε times the relative error of ε, or more where D was
estimated and the path runs along one state (`EscapeRate.leverage`); and that of the law itself. A well
is left over every one of its saddles, and the rates add.

**Correction.** For a constant D and ``f = -D∇V`` the next order is Laplace's, with C = (∇²U)⁻¹ and

    c = -⅛ ∇⁴U_iikk + ⅛ ∇³U_iik ∇³U_jjk + ¹⁄₁₂ ∇³U_ijk ∇³U_ijk    (indices contracted by C):

E[τ] gains ``exp(ε (c(A) - c(S)))``, 0.28 ε/ΔU for a cubic V, 0.375 for a quartic, 0.5 for a cosine. In one
state that is exact, and what is left is about ε/ΔU of it. In several λ changes to the same order, by what
couples the unstable direction of S to others: the error is as large as the correction. Where f is not of this
kind its antisymmetric share s takes as much of the correction away, and leaves ``s ε/ΔU``.

References
----------
F. Bouchet and J. Reygner, Ann. Henri Poincaré 17 (2016) 3499.
R. S. Maier and D. L. Stein, SIAM J. Appl. Math. 57 (1997) 752: where V is not smooth at the saddle.
V. I. Mel'nikov and S. V. Meshkov, J. Chem. Phys. 85 (1986) 1018: the rate for any friction.
P. Hänggi, P. Talkner and M. Borkovec, Rev. Mod. Phys. 62 (1990) 251, sections IV and VI.
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

from siq.errors import NumericalFailure
from siq.inference.field_estimate import AnyField
from siq.quasipotential.characteristics import norm
from siq.quasipotential.path_chains import MinimumActionPath, PathProblem, Tube
from siq.quasipotential.paths import minimum_action_path
from siq.quasipotential.power_series import MOST_STATES_OF_DEGREE_4, local_series
from siq.remarks import Remark
from siq.systems.cycles import Cycle
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import classify, hessian_at, measure_at

MIN_BARRIER_OVER_NOISE = 3.0  # the error of the law is a third there; below, it gives orders of magnitude

LEAST_DEPOPULATION = 0.9  # Υ below which the law of many degrees of freedom is refused: off by over a tenth
RETURN_DISTANCE = 0.5  # of the farthest distance from the saddle: a path come back so close has made a turn
ORBIT_STEPS = 2000  # in each distance from saddle to attractor, in search of the turning point beyond
ORBIT_REACH = 20.0  # of these distances, up to which it is sought

SERIES_RADIUS = {4: 0.01, 3: 0.003}  # of the distance from A to S, in the metric of M: V is its power series
SERIES_ERROR = 0.01  # of ∇V to the momenta of the path, up to which the series is used
SERIES_FAILURE = 0.1  # of the best: from there on the prefactor would be off by as much
TUBE_LEVEL = 1e-5  # of the action, U where the density about a cycle is no longer that of its tube
SADDLE_RADIUS = 0.003  # of the distance: from there at the latest the integrand is continued to S
RICCATI_STEP = 0.2  # in units of the largest rate
MOST_RICCATI_STEPS = 1e6  # numerical, a guard
CAUSTIC_GROWTH = 1e5  # of ∇²V to its size at the attractor: beyond lies a caustic
RESONANCE = 0.1  # of λ: as close to it, with the other sign, other eigenvalues leave M_S undecided
SKEW, SLIGHT_SKEW = 0.1, 0.01  # |p - M_S (x - S)| to its parts at the saddle
SAME_ACTION = 1e-3  # of the action: for closer paths the law has no single prefactor

MAX_COVARIANCE_AXES = 6  # of more, as many random ones stand for all: the error is good to 20 %
DERIVATIVE_STEP = 1e-3  # numerical, of the distance from A to S
LEAST_SHARE_OF_AXES = 0.5  # on which the law has to hold: otherwise its error is not known
DIFFERENCE_TOLERANCE = 1e-3  # of the action: both ends of a difference have the same error, and lose it
DIFFERENCE_NODES = 60
NEWTON_STEPS = 12
NEWTON_TOLERANCE = 1e-9  # of the distance from attractor to saddle
EQUILIBRIUM_REACH = 0.5  # of that distance: an equilibrium that moves by more is another one


def _depopulation_factor(loss: float) -> float:
    """Υ of Mel'nikov and Meshkov for a loss in units of ε: the loss itself, where it is small, up to 1."""

    def integrand(y: float) -> float:
        return float(np.log(-np.expm1(-loss * (y * y + 0.25))) / (y * y + 0.25))

    return float(np.exp(quad(integrand, 0, np.inf, limit=200)[0] / np.pi))


def _energy_loss_per_cycle(
    dynamics: Dynamics, path: MinimumActionPath, *, beyond: bool
) -> tuple[float | None, float | None, bool]:
    """The losses of U in one cycle, as `EscapeRate` has them; nothing turns where noise acts on every state.

    `beyond` says whether beyond the saddle lies a well, from which states may come back.
    """
    if dynamics.diffusion.regular:
        return None, None, False
    saddle, attractor = path.points[-1], path.points[0]
    if (loss := _particle_loss(dynamics, saddle, attractor)) is not None:
        try:
            further = _particle_loss(dynamics, saddle, 2 * saddle - attractor) if beyond else None
        except NumericalFailure:  # it runs on downhill, and nothing comes back from there
            further = None
        return loss, further, True
    away = np.linalg.norm((path.points - path.points[-1]) / np.ptp(path.points, axis=0), axis=1)[::-1]
    back = np.flatnonzero((away < RETURN_DISTANCE * np.maximum.accumulate(away)) & (np.arange(len(away)) > 0))
    if not len(back):
        return None, None, False
    nearest = int(back[0])
    while nearest + 1 < len(away) and away[nearest + 1] < away[nearest]:
        nearest += 1
    return float(path.action - path.values[::-1][nearest]), None, False


def _particle_loss(dynamics: Dynamics, saddle: np.ndarray, towards: np.ndarray) -> float | None:
    """Of a damped particle in one dimension ``2γ²/D ∮ v² dt`` of the orbit from a saddle to one side."""
    if dynamics.dimension != 2 or not dynamics.diffusion.constant:
        return None
    noise = np.diag(dynamics.diffusion.matrix)
    for place in (0, 1):
        x, v = dynamics.symbols[place], dynamics.symbols[1 - place]
        speed, rest = dynamics.formulas[place].as_coeff_Mul()
        friction = -sympy.simplify(dynamics.formulas[1 - place].diff(v))
        if noise[place] == 0 and rest == v and friction.is_number and friction > 0:
            force = sympy.lambdify(x, dynamics.formulas[1 - place].subs(v, 0), "numpy")
            break
    else:
        return None
    top, step = saddle[place], towards[place] - saddle[place]
    places = top + step * np.linspace(0, ORBIT_REACH, ORBIT_STEPS * int(ORBIT_REACH) + 1)
    forces = np.broadcast_to(np.asarray(force(places), dtype=float), places.shape)
    # The height of the potential above the saddle, by Simpson's rule on pairs of steps.
    pairs = (forces[:-2:2] + 4 * forces[1:-1:2] + forces[2::2]) / 6
    height = -np.r_[0.0, np.cumsum(pairs)] * 2 * (places[1] - top)
    higher = np.flatnonzero(height[1:] > 0)
    if not len(higher) or higher[0] == 0:
        raise NumericalFailure("an orbit at the height of the saddle does not turn back within reach")
    last = higher[0] + 1
    turning = last - height[last] / (height[last] - height[last - 1])
    speeds = np.sqrt(np.maximum(-2 * height[:last] / float(speed), 0.0))
    # v vanishes as a root at the turning point: of the last piece two thirds of its height count.
    area = abs(places[2] - top) * (np.trapezoid(speeds) + 2 / 3 * speeds[-1] * (turning - (last - 1)))
    return float(4 * float(friction) ** 2 / (float(noise[1 - place]) * float(speed)) * area)


@dataclass(frozen=True)
class NoiseStrength:
    """The strength ε of ``√ε σ dW``, in the unit of U, estimated from recordings or given."""

    intensity: float
    standard_error: float = 0.0
    source: Literal["estimated", "given"] = "given"


@dataclass(frozen=True)
class EscapeRate:
    """The law ``E[τ] = K exp(ΔU/ε)`` of escape over one saddle, with its errors."""

    #: ΔU = 2ΔV, in the unit of ε, NaN where it is not known; and its standard error
    barrier: float
    #: K, in time units, the exponential of the integral included; NaN where the law does not hold
    prefactor: float
    #: ``∫ c dt`` along the path; zero if D is constant and g has no divergence there
    exponent: float = 0.0
    #: What speaks against the law here without refuting it
    remarks: tuple[Remark, ...] = ()
    #: What one cycle at the height of the saddle loses of U by friction, where noise acts on some states only
    #: and they turn: in the well that is left, and in the well beyond, if any. None where not known.
    loss: float | None = None
    loss_beyond: float | None = None
    #: Whether the system is a damped particle in one dimension, so that the rate is known for any noise
    particle: bool = False
    standard_error: float = 0.0
    #: Standard error of ln K, None where not known, and its covariance with ΔU
    prefactor_error: float | None = None
    covariance: float = 0.0
    #: Relative standard error of ΔU/ε from an estimated D over that of ε
    leverage: float = 1.0
    #: By how much ln E[τ] grows with ε, in the unit of 1/U; what is not known of that, in ε/ΔU; and by which
    #: share ∇V is off M_S (x - S) where the path ends askew: the law errs by about twice that
    correction: float = 0.0
    unknown: float = 1.0
    skew: float = 0.0
    #: Of ways from or over a cycle K depends on ε, ``K = ε^power / Σ r exp(-δ/ε)``: δ, by how much more the
    #: path through another phase costs, and r, its part of the rate, shape ``(2, n)``. The prefactor is NaN
    #: then; of all other ways these are None and 0.
    power: float = 0.0
    phases: np.ndarray | None = None

    def prefactor_at(self, intensity: float) -> float:
        """K for the noise intensity ε, in time units; NaN where the law does not hold.

        Examples
        --------
        >>> phases = np.array([[0.0, 10.0], [0.25, 0.25]])
        >>> round(EscapeRate(1.0, np.nan, power=-0.5, phases=phases).prefactor_at(0.25), 6)
        8.0
        """
        if self.phases is None:
            return self.prefactor
        excess, rates = self.phases
        return float(intensity**self.power / (rates @ np.exp(-excess / intensity)))

    def slowing(self, intensity: float) -> float:
        """By which factor weak damping makes escape rarer than by the law; NaN where that is not known.

        Examples
        --------
        >>> round(EscapeRate(2.0, 4.0, loss=1.0, particle=True).slowing(0.01), 3)
        1.0
        >>> round(EscapeRate(2.0, 4.0, loss=1.0, loss_beyond=1.0, particle=True).slowing(1.0), 3)
        0.306
        """
        if self.loss is None:
            return 1.0
        own = _depopulation_factor(self.loss / intensity)
        if not self.particle:
            return 1.0 if own >= LEAST_DEPOPULATION else np.nan
        if self.loss_beyond is None:
            return own
        both = _depopulation_factor((self.loss + self.loss_beyond) / intensity)
        return own * _depopulation_factor(self.loss_beyond / intensity) / both

    def mean_time(self, intensity: float) -> float:
        """E[τ] for the noise intensity ε, corrected as far as that is known.

        Raises `NumericalFailure` when the law has no prefactor; when ε is not below the barrier, so that
        there is nothing to escape from; or when damping is too weak for ε.
        """
        if np.isnan(self.prefactor_at(intensity)):
            raise NumericalFailure("the law of escape does not hold")
        if not 0 < intensity < self.barrier:
            raise NumericalFailure(
                f"the escape law holds for ε far below the barrier of U, {self.barrier:.4g}, not for"
                f" {intensity:.4g}"
            )
        with np.errstate(over="ignore"):
            slower = self.slowing(intensity)
            known = np.clip(self.correction * intensity, -1, 1)  # beyond, the series says nothing
            time = float(self.prefactor_at(intensity) * np.exp(self.barrier / intensity + known) / slower)
        if not np.isfinite(slower):
            raise NumericalFailure(
                f"damping is too weak for the escape law: in one turn U = {self.loss:.3g} is lost, and"
                f" ε = {intensity:.4g} is not far below; simulate, or give a smaller ε"
            )
        return time

    def mean_exit_time(self, noise: NoiseStrength) -> MeanTime | None:
        """The mean time over one saddle with its errors; None where the law gives none.

        Where the error of the prefactor is not known it is taken to be relatively as uncertain as ΔU, since
        both follow from f to the first order.

        Examples
        --------
        >>> rate = EscapeRate(barrier=0.5, prefactor=4.0, standard_error=0.01)
        >>> found = rate.mean_exit_time(NoiseStrength(0.1))
        >>> round(found.value, 1), round(found.data_error, 3), found.law_error
        (593.7, 0.102, 0.2)
        """
        try:
            value = self.mean_time(noise.intensity)
        except NumericalFailure:
            return None
        if not np.isfinite(value):
            return None
        height = self.barrier / noise.intensity
        relative = self.standard_error / self.barrier
        of_prefactor = relative if self.prefactor_error is None else self.prefactor_error
        of_noise = height * self.leverage * noise.standard_error / noise.intensity
        squares = float(np.nansum(np.square((height * relative, of_prefactor, of_noise))))
        together = 2 * self.covariance / noise.intensity
        # By rounding, or by what is in one error alone, the two could cancel by more than there is.
        error = float(np.sqrt(max(squares + together, np.nan_to_num(of_noise) ** 2)))
        of_order = np.hypot(self.correction * noise.intensity, self.unknown) / height
        return MeanTime(value, error, float(np.hypot(of_order, 2 * self.skew)))


def escape_rate(
    dynamics: Dynamics, path: MinimumActionPath, *, beyond: bool = True, cycle: Cycle | None = None
) -> EscapeRate:
    """The law of escape along a minimum action path from an attractor to a saddle.

    The law fails, with another power of ε in the prefactor, where V has no second derivatives at the saddle:
    as for Maier and Stein's system with β > 4, and in general where the saddle attracts more slowly than it
    repels. This is looked for and refused. If it attracts less than twice as fast, the law holds, but with an
    error of a small power of ε instead of O(ε), which is remarked. It is not looked for whether there is a
    lower saddle, and ε must be far below the barrier.

    Parameters
    ----------
    dynamics
        f, twice differentiable.
    path
        From the attractor to the saddle (`siq.quasipotential.paths.minimum_action_path`). With its tolerance
        of 1e-4 the prefactor is good to a percent, with 1e-5 to a few thousandths.
    beyond
        Whether beyond the saddle lies another well; it matters where damping is weak.
    cycle
        The stable cycle from which the path begins, if it does not begin at a point.

    Raises
    ------
    NumericalFailure
        When the path does not lead from an attractor to a saddle with one unstable direction; when it meets a
        caustic; or when V is not smooth at the saddle.
    """
    frame = _Frame(dynamics, path, cycle)
    twins = any(abs(one - path.action) < SAME_ACTION * path.action for one in path.rivals)
    remarks, skew = list[Remark](), frame.skew()
    if not path.converged:
        remarks.append(Remark("quasipotential.path_not_converged"))
    askew = skew > SLIGHT_SKEW and frame.stable < 2 * frame.unstable
    if frame.resonant:
        remarks.append(Remark("quasipotential.law_sets_in_late_by_resonance"))
    elif askew:
        remarks.append(Remark("quasipotential.law_sets_in_late_by_turning"))
    if twins:
        remarks.append(Remark("quasipotential.second_path_of_same_action"))
    if (frame.resonant and twins) or (skew > SKEW and frame.stable < frame.unstable):
        raise NumericalFailure(
            "V is not smooth at the saddle, where the path does not arrive along the direction in which V"
            " would fall; the escape time then has another power of ε in its prefactor"
        )
    curvatures = frame.integrated()
    exponent = frame.exponent(curvatures)
    at_saddle = frame.continued(curvatures) if frame.at_saddle is None else frame.at_saddle
    volume, power = frame.volume()
    root = np.sqrt(abs(np.linalg.det(at_saddle)))
    prefactor = float(2 * np.pi / (frame.unstable * frame.problem.rate) * root * volume * np.exp(exponent))
    phases = None if power == 0 else np.array([[0.0], [1 / prefactor]])
    loss, loss_beyond, particle = _energy_loss_per_cycle(dynamics, path, beyond=beyond)
    if loss is not None and not particle:
        remarks.append(Remark("quasipotential.law_limited_by_turning", {"loss": loss}))
    elif loss is not None and loss < path.action:
        remarks.append(Remark("quasipotential.law_of_weak_damping", {"loss": loss}))
    correction, unknown = frame.correction()
    return EscapeRate(
        path.action, np.nan if power else prefactor, exponent, tuple(remarks), loss, loss_beyond, particle,
        correction=correction, unknown=unknown, skew=skew if askew else 0.0, power=power, phases=phases,
    )  # fmt: skip


class _Frame:
    """A path with Hessians along it, in units in which D at A, the distance from A to S and ∂f/∂x are one.

    The points, with momenta and velocities, are those from close to A to the neighbourhood of S. A D without
    inverse is replaced in these units (`siq.systems.equilibria.measure_at`).
    """

    def __init__(self, dynamics: Dynamics, path: MinimumActionPath, cycle: Cycle | None) -> None:
        start, end = path.points[0], path.points[-1]
        measure = measure_at(dynamics, start).frozen(start) if cycle is None else None
        problem = PathProblem(dynamics, start if cycle is None else cycle, end, measure=measure)
        saddle = classify(dynamics, end)
        if problem.begin is None:
            raise NumericalFailure(f"the path starts at {start.tolist()}, which is no stable equilibrium")
        if not problem.rests(problem.end) or saddle.kind == "degenerate" or saddle.unstable != 1:
            raise NumericalFailure(f"the path ends at {end.tolist()}, no saddle with one unstable direction")
        rates = saddle.eigenvalues / problem.rate
        self.unstable = float(rates[0].real)
        sums = np.abs(rates[1:] + self.unstable)
        self.resonant = bool(sums.min(initial=np.inf) < RESONANCE * self.unstable)
        self.stable = float(-rates[1:].real.max(initial=-np.inf))
        self.problem, self.height = problem, path.action / problem.unit
        self.at_saddle = None if self.resonant else problem.curvatures(hessian_at(dynamics, end))
        points, momenta = problem.scaled(path.points), problem.slopes(path.momenta)
        level = problem.level(points)
        degree = 3 if dynamics.dimension > MOST_STATES_OF_DEGREE_4 else 4
        least = TUBE_LEVEL * self.height if cycle is not None else SERIES_RADIUS[degree] ** 2 * level[-1]
        used, first = norm(points - problem.end) > SADDLE_RADIUS, int(np.argmax(level >= least))
        if isinstance(problem.begin, Tube):
            self.place = problem.begin.place(points[first : first + 1])
            self.at_attractor = problem.begin.costs(self.place)[0]
        else:
            self.gradients, self.hessians = local_series(dynamics, start)
            self.at_attractor = problem.begin.hessian
            # Where D grows fast the series ends far closer to A: the momenta of the path tell where.
            near = slice(1, max(first, 1) + 1)
            slopes = problem.slopes(self.gradients(path.points[near]))
            off = norm(slopes - momenta[near]) / norm(momenta[near])
            if not off.min() < SERIES_FAILURE:
                raise NumericalFailure(f"near {start.tolist()} D bends too much for the law: simulate")
            first = 1 + int(np.flatnonzero(off <= max(SERIES_ERROR, off.min()))[-1])
        used[:first] = False
        # A grid along the path, with the time per unit of it; a step in time is two of its intervals.
        count = int(used.sum())
        curve = CubicSpline(np.arange(count), np.column_stack([points[used], momenta[used]]))

        def along(share: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
            y, p = np.split(curve(share), 2, axis=1)
            v = problem.force(y) + 2 * problem.noise.push(y, p)
            return y, p, v, norm(curve(share, 1)[:, : dynamics.dimension]) / norm(v)

        y, _, _, pace = along(np.arange(count))
        # As many steps from one point of the path to the next as its two ends call for.
        fastest = pace * np.linalg.norm(problem.jacobian(y), axis=(1, 2))
        parts = np.ceil(np.maximum(fastest[1:], fastest[:-1]) / RICCATI_STEP)
        if not parts.sum() < MOST_RICCATI_STEPS:
            raise NumericalFailure("the path comes to rest on its way to the saddle: another one lies on it")
        within = [index + np.arange(2 * n) / (2 * n) for index, n in enumerate(parts.astype(int))]
        self.grid = np.append(np.concatenate(within), count - 1)
        self.points, self.momenta, self.velocities, self.pace = along(self.grid)

    def curvature(self, hessian: Callable[[np.ndarray], np.ndarray], y: np.ndarray) -> np.ndarray:
        """∇²V of a formula at points, in these units."""
        return self.problem.curvatures(hessian(self.problem.points(y)))

    def rise(self, y: np.ndarray, p: np.ndarray, curvatures: np.ndarray) -> np.ndarray:
        """c, by which the logarithm of the density's prefactor falls along the path: shape ``(n,)``."""
        noise = self.problem.noise
        rise = np.trace(self.problem.jacobian(y) + noise.at(y) @ curvatures, axis1=1, axis2=2)
        return np.asarray(rise + 2 * (noise.divergence(y) * p).sum(axis=1))

    def skew(self) -> float:
        """``|p - M_S (x - S)|`` at the end of the path to its parts, zero if V has this Hessian at S.

        If S attracts faster than it repels, every path arrives so in the end. If it attracts more slowly,
        that is the exception: p vanishes before x - S does. In between, where the linearisation leaves M_S
        open, nothing is said.
        """
        if self.at_saddle is None:
            return 0.0
        p, linear = self.momenta[::2], (self.points[::2] - self.problem.end) @ self.at_saddle
        off = np.linalg.norm(p - linear, axis=1)
        off /= np.linalg.norm(p, axis=1) + np.linalg.norm(linear, axis=1)
        return float(self.continued(off))

    def continued(self, along: np.ndarray) -> np.ndarray:
        """What the values at every other point would be at S, on a straight line through the last ones.

        The line begins at the last point that is more than twice as far from S as the end of the path.
        """
        away = np.linalg.norm(self.points[::2] - self.problem.end, axis=1)
        before = int(np.flatnonzero(away > 2 * away[-1]).max(initial=0))
        return along[-1] + (along[-1] - along[before]) * away[-1] / (away[before] - away[-1])

    def exponent(self, curvatures: np.ndarray) -> float:
        """∫ c dt over the whole path; near S the integrand per length is continued as a straight line."""
        problem, first = self.problem, 0.0
        if problem.hessian is not None:  # from A to the first point y: with ẏ = By and c = b·y it is b·B⁻¹y
            here = np.zeros((1, problem.dimension))
            flow = problem.jacobian(here)[0] + 2 * problem.noise.at(here)[0] @ self.at_attractor
            away = np.linalg.solve(flow, self.points[0])
            short = DERIVATIVE_STEP * float(np.linalg.norm(self.points[0]) / np.linalg.norm(away))
            y = short * away * np.array([[1.0], [-1.0]])
            p = problem.slopes(self.gradients(problem.points(y)))
            up, down = self.rise(y, p, self.curvature(self.hessians, y))
            first = float(up - down) / (2 * short)
        rise = self.rise(self.points[::2], self.momenta[::2], curvatures)
        density = rise / np.linalg.norm(self.velocities[::2], axis=1)
        rest = float(np.linalg.norm(self.points[-1] - problem.end))
        outer = rest * (density[-1] + self.continued(density)) / 2
        return float(first + simpson(rise * self.pace[::2], x=self.grid[::2]) + outer)

    def volume(self) -> tuple[float, float]:
        """The inverse of the density at the start of the path, up to ``(πε)^(d/2)``; and a power of ε.

        About a cycle the density is spread evenly in time, and across the cycle normally (`Tube.density`).
        """
        problem = self.problem
        if not isinstance(problem.begin, Tube):
            return float(1 / np.sqrt(np.linalg.det(self.at_attractor))), 0.0
        density = problem.begin.density(self.place, problem.force(problem.begin.curve(self.place)))
        return float(np.sqrt(problem.unit / np.pi) / density[0]), -0.5

    def correction(self) -> tuple[float, float]:
        """By how much ln E[τ] grows with ε, in the unit of 1/U; and what is not known of it, times ΔU."""
        problem, terms, turning = self.problem, [], 0.0
        if not (problem.noise.constant and problem.noise.regular and problem.hessian is not None):
            return 0.0, 1.0
        for y in (np.zeros(problem.dimension), problem.end):
            jacobian = problem.jacobian(y[None])[0]
            even = jacobian + jacobian.T
            turning = max(turning, float(np.linalg.norm(jacobian - jacobian.T) / np.linalg.norm(even)))
            values, axes = np.linalg.eigh(-even)  # of U, for D is one in these units
            steps = DERIVATIVE_STEP * axes.T
            up, down = (axes.T @ problem.jacobian(y + sign * steps) @ axes for sign in (1, -1))
            third = -(up - down) / DERIVATIVE_STEP  # by the first index along an axis, by the others of f
            fourth = -2 * (up + down - 2 * axes.T @ jacobian @ axes) / DERIVATIVE_STEP**2
            with np.errstate(all="ignore"):
                c = 1 / values
            terms.append(
                -np.einsum("kii,i,k->", fourth, c, c) / 8 + np.einsum("kii,i->k", third, c) ** 2 @ c / 8
                + np.einsum("kij,kij,i,j,k->", third, third, c, c, c) / 12
            )  # fmt: skip
        found = (1 - turning) * (terms[0] - terms[1])
        unknown = float(np.hypot(turning, found * self.height if problem.dimension > 1 else 0.0))
        return (float(found / problem.unit), unknown) if turning < 1 and unknown < 1 else (0.0, 1.0)

    def integrated(self) -> np.ndarray:
        """∇²V at every other point by Riccati's equation, from the power series at A.

        Tangents X of places and P of momenta, of which it is P X⁻¹, follow linear equations. A step is the
        Padé approximant of Magnus' exponential, of order 4 and stable where D is far larger than at A.

        Raises
        ------
        NumericalFailure
            Where it diverges.
        """
        problem, d = self.problem, self.problem.dimension
        turned = problem.turned(self.points, self.momenta)
        forces = problem.pull(self.points, self.momenta, turned)
        rates = self.pace[:, None, None] * problem.tangents(self.points, self.momenta, turned)
        begin, middle, end = rates[:-2:2], rates[1:-1:2], rates[2::2]
        step = (self.grid[2::2] - self.grid[:-2:2])[:, None, None]
        mean, rise, unit = (begin + 4 * middle + end) / 6, end - begin, np.eye(2 * d)
        change = step * mean - step**2 / 12 * (mean @ rise - rise @ mean)
        even = unit + change @ change / 12
        carried = np.linalg.solve(even - change / 2, even + change / 2)
        largest = CAUSTIC_GROWTH * np.abs(self.at_attractor).max()
        m = self.at_attractor
        if problem.hessian is not None:
            m = self.curvature(self.hessians, self.points[:1])[0]
        m = _imposed(m, self.velocities[0], forces[0])
        kept = [m]
        for index, over in enumerate(carried):
            place = 2 * index + 2
            x, p = np.split(over[:, :d] + over[:, d:] @ m, 2)
            m = _imposed(np.linalg.solve(x.T, p.T), self.velocities[place], forces[place])
            if not (np.linalg.det(x) > 0 and np.abs(m).max() < largest):
                where = problem.points(self.points[[2 * index]])[0]
                raise NumericalFailure(
                    f"the path meets a caustic near {where.tolist()}: V is not smooth there"
                )
            kept.append(m)
        return np.array(kept)


def _imposed(m: np.ndarray, velocity: np.ndarray, force: np.ndarray) -> np.ndarray:
    """The symmetric matrix that maps a velocity to a force, and is m across the velocity."""
    speed = np.linalg.norm(velocity)
    u, w = velocity / speed, force / speed
    across, mixed = np.eye(len(u)) - np.outer(u, u), np.outer(u, w)
    return across @ m @ across + mixed + mixed.T - (u @ w) * np.outer(u, u)


def prefactor_error(found: AnyField, path: MinimumActionPath) -> tuple[float | None, float]:
    """Standard error of ln K of a way out from that of f and D, and its covariance with ΔU.

    Both are zero where f carries no noise; the first is None where the law holds for too few of the changed
    f.
    """
    if isinstance(found, Dynamics) or found.noise_free:
        return 0.0, 0.0
    covariance = found.covariance
    if found.noise is not None:
        covariance = scipy.linalg.block_diag(covariance, found.noise.covariance)
    axes = _covariance_axes(covariance, np.random.default_rng(0))
    count = len(found.values)

    def law(change: np.ndarray) -> tuple[float, float] | None:
        """Ln K and ΔU for changed coefficients; None where there is no such way out, or no law."""
        dynamics = found.dynamics.with_values(found.values + change[:count])
        if found.noise is not None:
            noise = replace(found.noise, values=found.noise.values + change[count:])
            dynamics = replace(dynamics, diffusion=noise.diffusion(found.intensity))
        try:
            start, end = (_equilibrium_near(dynamics, path, place) for place in (0, -1))
            again = minimum_action_path(
                dynamics, start, end, nodes=DIFFERENCE_NODES, tolerance=DIFFERENCE_TOLERANCE,
                initial=[path.points],
            )  # fmt: skip
            prefactor = escape_rate(dynamics, again).prefactor
        except (NumericalFailure, ValueError, np.linalg.LinAlgError):
            return None
        return (float(np.log(prefactor)), again.action) if prefactor > 0 else None

    changes = []
    for axis in axes:
        up, down = law(axis), law(-axis)
        if up is not None and down is not None:
            changes.append(np.subtract(up, down) / 2)
    if len(changes) < LEAST_SHARE_OF_AXES * len(axes):
        return None, 0.0
    logarithm, barrier = np.array(changes).T * np.sqrt(len(axes) / len(changes))
    return float(np.linalg.norm(logarithm)), float(logarithm @ barrier)


def _covariance_axes(covariance: np.ndarray, draw: np.random.Generator) -> Sequence[np.ndarray]:
    """Changes of the p coefficients whose outer products add up to the covariance.

    Of many a random rotation is taken of which the first ones, made longer, have the covariance in the mean.
    """
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    root = root[:, root.any(axis=0)]  # what is known exactly, as in dx/dt = v, has no axis
    count = root.shape[1]
    if count <= MAX_COVARIANCE_AXES:
        return list(root.T)
    turned = np.linalg.qr(draw.standard_normal((count, MAX_COVARIANCE_AXES)))[0]
    return list((np.sqrt(count / MAX_COVARIANCE_AXES) * root @ turned).T)


def _equilibrium_near(dynamics: Dynamics, path: MinimumActionPath, end: int) -> np.ndarray:
    """Where f vanishes next to an end of a path, by Newton's method."""
    x, distance = path.points[end], float(np.linalg.norm(path.points[-1] - path.points[0]))
    for _ in range(NEWTON_STEPS):
        step = np.linalg.solve(dynamics.jacobian(x[None])[0], dynamics.drift(x[None])[0])
        x = x - step
        if not np.linalg.norm(x - path.points[end]) < EQUILIBRIUM_REACH * distance:
            break
        if np.linalg.norm(step) < NEWTON_TOLERANCE * distance:
            return x
    raise NumericalFailure("f does not vanish next to the end of the path")


@dataclass(frozen=True)
class MeanTime:
    """A mean time with its errors."""

    value: float  #: E[τ], in the unit of time
    #: Relative errors: the standard error from f and from the noise; and that of the law.
    data_error: float
    law_error: float
    #: Whether every way out counts; where one has no rate, the mean residence time is at most `value`.
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


def mean_residence_time(exits: Sequence[EscapeRate], noise: NoiseStrength | None) -> MeanTime | None:
    """The mean time in a well with these ways out, whose rates add; None where no way out has a rate.

    Errors of different ways are added as if they were the same, since f and the noise are.
    """
    if noise is None:
        return None
    times = [one.mean_exit_time(noise) for one in exits]
    known = np.array([(1 / one.value, one.data_error, one.law_error) for one in times if one is not None])
    if not len(known):
        return None
    rates, errors = known[:, 0], known[:, 1:]
    data_error, law_error = (float(one) for one in rates / rates.sum() @ errors)
    return MeanTime(float(1 / rates.sum()), data_error, law_error, complete=len(known) == len(times))
