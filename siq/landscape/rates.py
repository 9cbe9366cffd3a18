"""Mean escape times: the law of Eyring and Kramers with its prefactor, for drifts that have no potential.

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
damping is weak the rate is lower (`siq.landscape.turnover`).

References
----------
F. Bouchet and J. Reygner, Ann. Henri Poincaré 17 (2016) 3499.
R. S. Maier and D. L. Stein, SIAM J. Appl. Math. 57 (1997) 752: where V is not smooth at the saddle.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import simpson
from scipy.interpolate import CubicSpline

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import classify, hessian_at
from siq.dynamics.reach import measure_at
from siq.errors import NumericalFailure
from siq.landscape.paths import MinimumActionPath
from siq.landscape.turnover import TurnLoss, turn_loss
from siq.reference.cubic_series import cubic_series
from siq.reference.power_series import quasipotential_series

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
            for ε: noise does not spread states before the saddle (`siq.landscape.turnover`).
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
        From the attractor to the saddle: see `siq.landscape.paths.minimum_action_path`. With its tolerance
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

    A D without inverse is replaced there by what stands in for it (`siq.dynamics.reach.measure_at`). ``x = A
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
        return bent if self.constant else bent + self.noise.bend(y, p)

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
        p = self.series.gradient(self.start + y @ self.units.T) @ self.units / self.unit
        odd = self.rise(y, p, self.given(self.series.hessian, y))
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
            forces -= self.noise.pull(self.points, self.momenta)
            jacobians = jacobians + 2 * self.noise.turn(self.points, self.momenta)
        largest = LARGEST * np.abs(self.at_attractor).max()

        def rate(m: np.ndarray, index: int) -> np.ndarray:
            product = m @ jacobians[index]
            return -self.pace[index] * (product + product.T + 2 * m @ noise[index] @ m + bends[index])

        m = _imposed(self.given(self.series.hessian, self.points[:1])[0], self.velocities[0], forces[0])
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
