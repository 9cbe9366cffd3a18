"""Mean escape times by direct simulation of ``dx = f dt + sqrt(ε) D^(1/2) dW``.

Walkers start in one well and are followed until they reach the neighbourhood of another attractor. Nothing is
assumed about V: this is what the laws of `siq.quasipotential.rates` are held against. It takes a time
proportional to exp(ΔU/ε), and so is for moderate barriers, ΔU/ε of ten and less.

The rule is that of Heun for additive noise ξ, ``x̂ = x + f(x) h + ξ``, ``x ← x + (f(x) + f(x̂)) h/2 + ξ``, of
weak order two. States are held components first, ``(d, walkers)``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from siq.errors import NumericalFailure
from siq.numerics.integration import heun_step, runge_kutta_step
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at
from siq.systems.simulation import noise_source

Field = Callable[[np.ndarray], np.ndarray]

STEP = 0.1  # of the shortest time of the linearised equations
SETTLED = 0.1  # of the level of a neighbourhood: without noise, one who has escaped gets so far down
LONGEST_SETTLING = 30.0  # in units of the slowest relaxation time


@dataclass(frozen=True)
class Neighbourhood:
    """An ellipsoid about an attractor: ``½ (x - center)·hessian (x - center) ≤ level``.

    With the Hessian of V (`siq.systems.equilibria.hessian_at`) it approximates a level set of V.
    """

    center: np.ndarray  #: shape (d,)
    hessian: np.ndarray  #: shape (d, d)
    level: float  #: in the unit of V, not of U = 2V; it should be well below that of the saddles

    @classmethod
    def about(cls, dynamics: Dynamics, attractor: np.ndarray, *, level: float) -> Neighbourhood:
        """The ellipsoid on which V, to second order, has a level (of V, not of U = 2V)."""
        return cls(np.asarray(attractor, dtype=float), hessian_at(dynamics, attractor), level)

    def height(self, x: np.ndarray) -> np.ndarray:
        """The quadratic form in units of the level: components ``(d, n)`` to ``(n,)``."""
        y = x - self.center[:, None]
        return np.sum(y * (self.hessian @ y), axis=0) / (2 * self.level)


@dataclass(frozen=True)
class _EscapeTimes:
    """Simulated times of escape, which at weak noise are distributed exponentially."""

    times: np.ndarray  #: of those who escaped, ascending, shape (escapes,)
    targets: np.ndarray  #: index of the neighbourhood that each of them reached
    censored: int  #: number of walkers that had not escaped when the simulation ended
    longest: float  #: how long these were followed, in time units

    @property
    def escapes(self) -> int:
        """Number of walkers that escaped."""
        return len(self.times)

    @property
    def mean(self) -> float:
        """The maximum likelihood estimate, all time spent divided by the number of escapes; inf without any.

        Who has not escaped counts with the time that he was followed. To leave out the censored would
        underestimate the mean.
        """
        spent = float(self.times.sum()) + self.censored * self.longest
        return spent / self.escapes if self.escapes else np.inf

    @property
    def standard_error(self) -> float:
        """Of the mean: ``mean / sqrt(escapes)``."""
        return self.mean / np.sqrt(self.escapes) if self.escapes else np.inf


def simulate_escapes(
    dynamics: Dynamics,
    start: np.ndarray,
    targets: Sequence[Neighbourhood],
    *,
    intensity: float,
    longest: float,
    generator: np.random.Generator,
    walkers: int = 1000,
    step: float | None = None,
    confirm: bool = True,
) -> _EscapeTimes:
    """Follow walkers until they reach one of some neighbourhoods.

    Parameters
    ----------
    dynamics, intensity
        f and D, and ε, in the unit of U.
    start, targets
        Shape ``(d,)``, mostly an attractor, or a start for each walker; and neighbourhoods of the others.
    longest
        Time after which those who are left count as censored; a few of the expected mean times.
    generator, walkers
        Source of the noise, and how many there are.
    step
        Step h; by default a tenth of the shortest time of f at the start and the targets.
    confirm
        Whether one who reaches an ellipsoid must be led on to its attractor by f, and goes on otherwise: an
        ellipsoid may reach out of the basin of its attractor.

    Raises
    ------
    ValueError
        When there is no target, or a number is not positive.
    NumericalFailure
        When walkers run to infinity.
    """
    if not targets or min(walkers, longest, intensity) <= 0:
        raise ValueError("escapes need a target, walkers, and a positive intensity and time")
    starts = np.broadcast_to(np.asarray(start, dtype=float), (walkers, dynamics.dimension))
    centers = np.stack([starts[0], *(one.center for one in targets)])
    if step is None:
        step = STEP / float(np.abs(np.linalg.eigvals(dynamics.jacobian(centers))).max())
    function = dynamics.drift_of_components
    draw = noise_source(dynamics.diffusion, intensity=intensity, step=step, generator=generator)
    slowest = [np.abs(np.linalg.eigvals(one).real).min() for one in dynamics.jacobian(centers[1:])]
    settling = [int(np.ceil(LONGEST_SETTLING / one / step)) if confirm else 0 for one in slowest]
    x = starts.T.copy()
    steps = int(np.ceil(longest / step))
    times, reached = [np.zeros(0)], [np.zeros(0, dtype=int)]
    with np.errstate(over="ignore", invalid="ignore"):  # told below
        for index in range(1, steps + 1):
            x = heun_step(function, x, step, draw(x))
            staying = np.ones(x.shape[1], dtype=bool)
            for number, target in enumerate(targets):
                inside = np.flatnonzero(target.height(x) <= 1)
                if len(inside):
                    arrived = inside[_settles(function, x[:, inside], target, step, settling[number])]
                    staying[arrived] = False
                    times.append(np.full(len(arrived), index * step))
                    reached.append(np.full(len(arrived), number))
            if not staying.all():
                x = x[:, staying]
            if not x.shape[1]:
                break
    lost = int((~np.isfinite(x).all(axis=0)).sum())  # what once is not finite stays so
    if lost:
        raise NumericalFailure(f"{lost} of {walkers} walkers run to infinity; take a smaller step")
    return _EscapeTimes(np.concatenate(times), np.concatenate(reached), x.shape[1], steps * step)


def _settles(function: Field, x: np.ndarray, target: Neighbourhood, step: float, steps: int) -> np.ndarray:
    """Whether f leads from states in a neighbourhood to its middle; all do where no steps are to be made."""
    settled = np.full(x.shape[1], not steps)
    for _ in range(steps):
        x = runge_kutta_step(function, x, step)
        settled |= target.height(x) <= SETTLED
        if settled.all():
            break
    return settled
