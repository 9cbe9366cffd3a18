"""Recurrence: where f leads what comes to rest nowhere, to a limit cycle or to motion that never repeats.

A trajectory is followed from return to return through a section, the plane across f at its start. From a
close return Newton's method seeks the periodic orbit,

    Φ_T(x) = x,    f(x₀)·(x - x₀) = 0,

whose stability the eigenvalues of ``∂Φ_T/∂x`` decide: one of them is 1, and on a limit cycle all others lie
within the unit circle. Chaos has periodic orbits too, but unstable ones; what tells it is that small
differences grow from return to return, at the rate of the largest Lyapunov exponent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.integrate import solve_ivp

from siq.dynamics.dynamics import Dynamics

RETURNS = 40  # through the section, within which chaos has to have lost what was known at the start
LOOKED = (4, 12, RETURNS)  # returns after which a cycle is sought: most are told long before chaos can be
CLOSE = 2.0  # times the distance of the closest return: one as close may be earlier, and the period shorter
SAME = 1e-6  # of the recorded box: returns as close are at the same place; chaos tears them a box apart
STARTS = 3  # trajectories that are followed until one returns
WAITED = 50.0  # crossings of the box, in which there has to be a return
MOST_EVALUATIONS = 1_000_000  # of f, in all: some ten times what the equations of Lorenz and Rössler need
FAR = 1.5  # of the box from its middle: what comes so far has escaped, as in `siq.dynamics.descents.follow`
LONGEST = 12  # returns of one period: longer cycles than the doubled ones of doubled ones are not looked for
NEWTON_STEPS = 12
LOST = 2.0  # times the first gap: from there Newton's method no longer leads to what is close by
CLOSED = 1e-8  # of the recorded box: by so much a periodic orbit may fail to close, with integrals to 1e-10
NEUTRAL = 1e-6  # of 1: closer to it a multiplier is not told from 1 by these integrals
RESTING = 1e-4  # of the rate: a trajectory so slow at its end is coming to rest

Kind = Literal["cycle", "chaos", "aperiodic", "none"]


@dataclass(frozen=True)
class Recurrence:
    """What becomes of a trajectory that comes to rest nowhere.

    Attributes
    ----------
    kind
        ``cycle``: it ends on a limit cycle. ``chaos``: it returns, never to the same place, and small
        differences grow. ``aperiodic``: it returns, and neither can be said. ``none``: it does not return.
    period
        Of the cycle, in units of time; NaN of anything else.
    exponent
        Mean rate at which small differences grow, per unit of time: the largest Lyapunov exponent. NaN where
        it was not asked for.
    place
        A state on the cycle, shape ``(d,)``; None of anything else.
    """

    kind: Kind
    period: float = float("nan")
    exponent: float = float("nan")
    place: np.ndarray | None = field(default=None, compare=False)

    def sentence(self) -> str:
        """In words that follow a colon."""
        if self.kind == "cycle":
            return f"they end on a limit cycle of period {self.period:.4g}"
        if self.kind == "chaos":
            return (
                "they settle neither on an equilibrium nor on a cycle: aperiodic motion, as of chaos (small"
                f" differences grow at a rate of {self.exponent:.3g} per unit of time)"
            )
        if self.kind == "aperiodic":
            return "they settle neither on an equilibrium nor on a cycle: aperiodic motion"
        return "within the time for which they were followed they neither rest nor return"


class _TooLongError(Exception):
    """f was evaluated so often that the trajectory is given up."""


def recurrence_of(dynamics: Dynamics, starts: np.ndarray, *, box: np.ndarray, rate: float) -> Recurrence:
    """What becomes of the first of some trajectories that returns.

    Parameters
    ----------
    dynamics
        f.
    starts
        Shape ``(n, d)``, n ≥ 1: where trajectories are that have come to rest for a long time nowhere.
    box
        Shape ``(d, 2)``: the recorded region.
    rate
        At which f crosses it, per unit of time. What is far slower is coming to rest.
    """
    chosen = np.linspace(0, len(starts) - 1, min(STARTS, len(starts))).astype(int)
    found = Recurrence("none")
    for start in starts[chosen]:
        found = _Motion(dynamics, start, box, rate).recurrence()
        if found.kind != "none":
            break
    return found


class _Motion:
    """One trajectory, in units of the box, so that states of any size count alike."""

    def __init__(self, dynamics: Dynamics, start: np.ndarray, box: np.ndarray, rate: float) -> None:
        self.dynamics, self.dimension = dynamics, len(start)
        self.width = box[:, 1] - box[:, 0]
        self.middle = box.mean(axis=1) / self.width
        self.start = start / self.width
        self.across = self.drift(self.start)
        self.speed, self.rate, self.evaluations = float(np.linalg.norm(self.across)), rate, 0

    def drift(self, y: np.ndarray) -> np.ndarray:
        return np.asarray(self.dynamics.drift((y * self.width)[None])[0] / self.width)

    def count(self) -> None:
        """Give up what takes too long: f may be too stiff to be followed so."""
        self.evaluations += 1
        if self.evaluations > MOST_EVALUATIONS:
            raise _TooLongError

    def jacobian(self, y: np.ndarray) -> np.ndarray:
        jacobian = self.dynamics.jacobian((y * self.width)[None])[0]
        return np.asarray(jacobian * self.width / self.width[:, None])

    def recurrence(self) -> Recurrence:
        """From return to return, until there are enough of them."""
        if not self.speed > RESTING * self.rate:
            return Recurrence("none")
        try:
            return self._followed()
        except _TooLongError:
            return Recurrence("none")

    def _followed(self) -> Recurrence:
        draw = np.random.default_rng(0)  # any direction grows as the fastest does
        state, tangent = self.start, draw.standard_normal(self.dimension)
        tangent /= np.linalg.norm(tangent)
        growth, times, places = [], [], []
        for _ in range(RETURNS):
            step = self._next(state, tangent)
            if step is None:
                break
            state, grown, time = step
            size = float(np.linalg.norm(grown))
            tangent = grown / size
            growth.append(np.log(size))
            times.append(time)
            places.append(state)
            if len(places) in LOOKED and (found := self._cycle(places, np.cumsum(times))) is not None:
                return Recurrence("cycle", found[1], place=found[0] * self.width)
        if not places:
            return Recurrence("none")
        exponent = float(np.sum(growth) / np.sum(times))
        # Regular motion tears two states apart in proportion to the time, forty returns by some forty times.
        chaotic = np.sum(growth) > -np.log(SAME)
        return Recurrence("chaos" if chaotic else "aperiodic", exponent=exponent)

    def _next(self, state: np.ndarray, tangent: np.ndarray) -> tuple[np.ndarray, np.ndarray, float] | None:
        """State, tangent and time at the next return through the section; None where there is none."""
        d = self.dimension

        def rates(_: float, z: np.ndarray) -> np.ndarray:
            self.count()
            return np.concatenate([self.drift(z[:d]), self.jacobian(z[:d]) @ z[d:]])

        def returns(_: float, z: np.ndarray) -> float:
            return float(self.across @ (z[:d] - self.start))

        def escapes(_: float, z: np.ndarray) -> float:
            return float(FAR - np.abs(z[:d] - self.middle).max())

        returns.terminal, returns.direction = True, 1.0  # type: ignore[attr-defined]
        escapes.terminal = True  # type: ignore[attr-defined]
        # Away from the section first, on which it begins: what is zero there would be taken for a return.
        away = CLOSED / self.speed
        begin = np.concatenate([state + away * self.drift(state), tangent])
        way = solve_ivp(
            rates, (0.0, WAITED / self.rate), begin, method="DOP853", rtol=1e-8, atol=1e-10,
            events=[returns, escapes],
        )  # fmt: skip
        if not len(way.t_events[0]):
            return None
        end = way.y_events[0][0]
        return end[:d], end[d:], float(way.t_events[0][0]) + away

    def _cycle(self, places: Sequence[np.ndarray], times: np.ndarray) -> tuple[np.ndarray, float] | None:
        """A state and the period of a stable periodic orbit close by, None where there is none."""
        # Backwards from the last place, where a trajectory is closest to the cycle on which it ends.
        away = np.array([np.linalg.norm(place - places[-1]) for place in places[-2 : -2 - LONGEST : -1]])
        first = int(np.flatnonzero(away <= max(CLOSE * away.min(), SAME))[0])
        return self._closed(places[-1], float(times[-1] - times[-2 - first]))

    def _closed(self, base: np.ndarray, period: float) -> tuple[np.ndarray, float] | None:
        d, x, longest, widest = self.dimension, base, 2 * period, np.inf
        across = self.drift(base)
        for _ in range(NEWTON_STEPS):
            flowed = self._flowed(x, period)
            if flowed is None:
                return None
            end, monodromy = flowed
            gap = end - x
            away = float(np.abs(gap).max())
            if away < CLOSED:
                return (x, period) if self._stable(monodromy) else None
            if away > widest:
                return None
            widest = min(widest, LOST * away)
            matrix = np.zeros((d + 1, d + 1))
            matrix[:d, :d], matrix[:d, d], matrix[d, :d] = monodromy - np.eye(d), self.drift(end), across
            step = np.linalg.lstsq(matrix, -np.append(gap, across @ (x - base)), rcond=None)[0]
            step *= min(1.0, 0.2 / max(float(np.abs(step[:d]).max()), 1e-300))  # a fifth of the box at most
            x, period = x + step[:d], period + float(step[d])
            if not 0 < period < longest:
                return None
        return None

    def _flowed(self, x: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray] | None:
        d = self.dimension

        def rates(_: float, z: np.ndarray) -> np.ndarray:
            self.count()
            return np.concatenate([self.drift(z[:d]), (self.jacobian(z[:d]) @ z[d:].reshape(d, d)).ravel()])

        begin = np.concatenate([x, np.eye(d).ravel()])
        way = solve_ivp(rates, (0.0, period), begin, method="DOP853", rtol=1e-10, atol=1e-12)
        if not way.success or not np.isfinite(way.y[:, -1]).all():
            return None
        return way.y[:d, -1], way.y[d:, -1].reshape(d, d)

    def _stable(self, monodromy: np.ndarray) -> bool:
        """Whether all multipliers but the one of the motion along the orbit lie within the unit circle."""
        multipliers = np.linalg.eigvals(monodromy)
        others = np.delete(multipliers, np.argmin(np.abs(multipliers - 1)))
        return bool((np.abs(others) < 1 - NEUTRAL).all())
