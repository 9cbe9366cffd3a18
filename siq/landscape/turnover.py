"""Does noise have the time to spread states before the saddle? Escapes of what turns about its well.

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
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sympy
from scipy.integrate import quad
from scipy.optimize import brentq

from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.landscape.paths import MinimumActionPath

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
