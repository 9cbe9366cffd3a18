"""Steps in time for many states at once, and loops as machine code.

Library integrators take one trajectory, or many with the step that the most difficult of them needs. In
`dormand_prince_step` every row of a state array has its own step, so that a whole fan costs hardly more than
one trajectory. The rules for simulations take components first, ``(d, n)``, so that each is contiguous:

- `runge_kutta_step`: the classical rule of order 4, without noise;
- `euler_maruyama_step`: ``x + f(x) Δt + ξ``, of weak order 1;
- `heun_step`: ``x̂ = x + f(x) Δt + ξ``, ``x + (f(x) + f(x̂)) Δt/2 + ξ``, of weak order 2 for additive noise ξ.

`FlowMap` is the map of a state over a longer step, such as that from a sample to the next, and
`TransitionDensity` the law that noise gives one state by then.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar, cast

import numba
import numpy as np
from scipy.integrate import DOP853

Rates = Callable[[np.ndarray], np.ndarray]
"""Time derivative of states: ``(n, s)`` to ``(n, s)``, row by row."""
Field = Callable[[np.ndarray], np.ndarray]
"""f, mapping components ``(d, n)`` to components ``(d, n)``."""

# Of step control, the usual values: Hairer, Nørsett, Wanner, Solving Ordinary Differential Equations I, II.4.
SAFETY = 0.9
SMALLEST_FACTOR, LARGEST_FACTOR = 0.2, 5.0
ORDER = 8  # of the rule
MAX_REFINEMENT = 64  # Runge–Kutta steps within one step of a map


def dormand_prince_step(
    rates: Rates, state: np.ndarray, step: np.ndarray, *, first: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Advance every row by its own step ``(n,)`` with the rule of Dormand and Prince of order 8.

    Gives the new state, and the estimate of its local error by component, both of shape ``(n, s)``. The
    coefficients, and the estimate from embedded rules of order 5 and 3, are those of Hairer, Nørsett and
    Wanner as `scipy.integrate.DOP853` holds them. `first` is the time derivative at the state, if known.
    """
    h = step[:, None]
    stages = np.empty((DOP853.n_stages + 1, state.size))

    def combine(weights: np.ndarray) -> np.ndarray:
        return (weights @ stages[: len(weights)]).reshape(state.shape)

    stages[0] = (rates(state) if first is None else first).ravel()
    for index in range(1, DOP853.n_stages):
        stages[index] = rates(state + h * combine(DOP853.A[index, :index])).ravel()
    new = state + h * combine(DOP853.B)
    stages[-1] = rates(new).ravel()
    fifth, third = combine(DOP853.E5), combine(DOP853.E3)
    norm = np.hypot(fifth, 0.1 * third)
    return new, h * fifth * np.abs(fifth) / np.where(norm == 0, 1, norm)


def next_step(step: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Steps after the ones whose errors, relative to what is allowed, are given: ``(n,)`` to ``(n,)``.

    An error that is not finite counts as a very large one.
    """
    error = np.where(np.isfinite(error), error, np.inf)
    with np.errstate(divide="ignore"):
        factor = SAFETY * error ** (-1 / ORDER)
    return step * np.clip(factor, SMALLEST_FACTOR, LARGEST_FACTOR)


Function = TypeVar("Function", bound=Callable[..., object])


def machine_code(function: Function) -> Function:
    """The function as machine code, kept on disk where there is a folder to write to."""
    try:
        return cast(Function, numba.njit(cache=True)(function))
    except RuntimeError:  # neither beside the module nor in the user's own folder
        return cast(Function, numba.njit(function))


def runge_kutta_step(drift: Rates, x: np.ndarray, step: float | np.ndarray) -> np.ndarray:
    """One step of the classical fourth-order Runge–Kutta rule for f of components ``(d, n)``.

    States ``(d, n)`` one step later; the step is one for all or one for each, ``(n,)``, and the local error
    is O(step⁵).
    """
    k1 = drift(x)
    k2 = drift(x + (step / 2) * k1)
    k3 = drift(x + (step / 2) * k2)
    k4 = drift(x + step * k3)
    k2 += k3
    k2 *= 2
    k2 += k1
    k2 += k4
    k2 *= step / 6
    k2 += x
    return k2


def euler_maruyama_step(drift: Rates, x: np.ndarray, step: float, increments: np.ndarray) -> np.ndarray:
    """One step of the Euler–Maruyama rule, ``x + f(x) Δt + sqrt(ε) D^(1/2) ΔW``, for states ``(d, n)``.

    The increments ``sqrt(ε) D^(1/2) ΔW`` are the noise over the step, see `noise_source`. The rule is of
    strong order 1 where the noise is additive, and of ½ where D depends on the state; its weak order is 1.
    """
    result = step * drift(x)
    result += x
    result += increments
    return result


def heun_step(drift: Rates, x: np.ndarray, step: float, noise: np.ndarray) -> np.ndarray:
    """One step of Heun's rule; `noise` is ``sqrt(ε) D^(1/2) ΔW``, shape ``(d, walkers)``.

    The noise is the same in both of its stages, so that it is one of Itô.
    """
    first = drift(x)
    predicted = x + step * first
    predicted += noise
    first += drift(predicted)
    first *= step / 2
    first += x
    first += noise
    return first


@dataclass(frozen=True)
class FlowMap:
    """The map of a state over the step of a pair, by so many steps of an integrator.

    By Euler's rule for pairs that an Euler–Maruyama simulation made with as many steps; otherwise by the
    classical Runge–Kutta rule, for everything that is continuous in time. Of a `coarse` step noise is not
    allowed for by the first order in h, but by `moments`; or, of one state, by its `TransitionDensity`.
    """

    steps: int = 1
    euler: bool = False
    coarse: bool = False
    by_density: bool = False

    def __call__(self, field: Field, x0: np.ndarray, h: np.ndarray) -> np.ndarray:
        """The state after h without noise: components ``(d, n)`` and steps ``(n,)`` to ``(d, n)``."""
        step, x = h / self.steps, x0
        with np.errstate(over="ignore", invalid="ignore"):  # a trial f may run away
            for _ in range(self.steps):
                x = x + step * field(x) if self.euler else runge_kutta_step(field, x, step)
        return x

    @classmethod
    def of(
        cls, field: Field, x0: np.ndarray, h: np.ndarray, *, integrator_step: float | None, tolerance: float
    ) -> FlowMap:
        """The map that fits the data: as many steps as the accuracy needs, or as the simulation made.

        The tolerance of increments of states ``(d, n)`` over steps ``(n,)`` is relative to their root mean
        square, state by state; `integrator_step` is that of the Euler–Maruyama simulation that made the data,
        None elsewhere.
        """
        if integrator_step is not None:
            return cls(steps=max(round(float(np.median(h)) / integrator_step), 1), euler=True)
        flow = cls()
        coarse = flow(field, x0, h)
        while flow.steps < MAX_REFINEMENT:
            fine = (finer := cls(2 * flow.steps))(field, x0, h)
            with np.errstate(over="ignore", invalid="ignore"):  # a trial f may run away
                size, error = (np.sqrt((one**2).mean(axis=1)) for one in (fine - x0, fine - coarse))
            # The error of the coarse result; that of the fine one is sixteen times smaller.
            if not (error > tolerance * size).any():
                break
            flow, coarse = finer, fine
        return flow

    def moments(
        self, field: Field, x0: np.ndarray, h: np.ndarray, rate: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean ``(d, n)`` and covariance ``(n, d, d)`` after h, with noise of the covariance `rate` per time.

        The rate is one for all states, ``(d, d)``, or that of each, ``(n, d, d)``.
        ``dm/dt = E f,  dP/dt = E[f (x-m)ᵀ] + E[(x-m) fᵀ] + εD`` are closed by the normal law ``N(m, P)``:
        means are by ``2d + 1`` points, exact for cubic f (Julier and Uhlmann, Proc. IEEE 92 (2004) 401).
        """
        d, n = x0.shape
        step, least, away = h / self.steps, 1e-12 * np.eye(d) * rate * h[:, None, None], np.sqrt(3.0)

        def rates(mean: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            known = np.nan_to_num(spread, posinf=0.0, neginf=0.0)
            try:  # of one state a factor is a root, which takes a tenth of the time
                root = np.sqrt(np.maximum(known + least, 0)) if d == 1 else np.linalg.cholesky(known + least)
            except np.linalg.LinAlgError:  # of a trial f
                levels, vectors = np.linalg.eigh(known)
                root = vectors * np.sqrt(np.maximum(levels, 0.0))[:, None, :]
            root = np.moveaxis(root, 0, 2)  # (d, d, n)
            middle, gain = (3 - d) / 3 * field(mean), np.zeros((n, d, d))
            for direction in root.transpose(1, 0, 2):
                ahead, behind = field(mean + away * direction), field(mean - away * direction)
                middle = middle + (ahead + behind) / 6
                gain += (away / 6 * (ahead - behind)).T[:, :, None] * direction.T[:, None, :]
            return middle, gain + gain.transpose(0, 2, 1) + rate

        mean, spread, wide = x0, np.zeros((n, d, d)), step[:, None, None]
        with np.errstate(over="ignore", invalid="ignore"):  # a trial f may run away
            for _ in range(self.steps):
                first = rates(mean, spread)
                second = rates(mean + step / 2 * first[0], spread + wide / 2 * first[1])
                third = rates(mean + step / 2 * second[0], spread + wide / 2 * second[1])
                fourth = rates(mean + step * third[0], spread + wide * third[1])
                parts = zip(first, second, third, fourth, strict=True)
                moved, wider = ((a + 2 * b + 2 * c + e) / 6 for a, b, c, e in parts)
                mean, spread = mean + step * moved, spread + wide * wider
        return mean, spread

    @property
    def response_share(self) -> float:
        """The mean time, as a share of a step, for which the system goes on after a kick within the step.

        Half of it times h² is the weight with which noise shifts the mean, ``Σ(εD)_jk ∂²f/∂x_j∂x_k``. Euler's
        rule sees the noise only after each of its steps.
        """
        return (1 - 1 / self.steps) / 2 if self.euler else 0.5
