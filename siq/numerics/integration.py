"""Steps in time for many states at once, and loops as machine code.

Library integrators take one trajectory, or many with the step that the most difficult of them needs. In
`dormand_prince_step` every row of a state array has its own step, so that a whole fan costs hardly more than
one trajectory. The rules for simulations take components first, ``(d, n)``, so that each is contiguous:

- `runge_kutta_step`: the classical rule of order 4, without noise;
- `euler_maruyama_step`: ``x + f(x) Δt + ξ``, of weak order 1;
- `heun_step`: ``x̂ = x + f(x) Δt + ξ``, ``x + (f(x) + f(x̂)) Δt/2 + ξ``, of weak order 2 for additive noise ξ.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba
import numpy as np
from scipy.integrate import DOP853

Rates = Callable[[np.ndarray], np.ndarray]
"""Time derivative of states: ``(n, s)`` to ``(n, s)``, row by row."""

# Of step control, the usual values: Hairer, Nørsett, Wanner, Solving Ordinary Differential Equations I, II.4.
SAFETY = 0.9
SMALLEST_FACTOR, LARGEST_FACTOR = 0.2, 5.0
ORDER = 8  # of the rule


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
