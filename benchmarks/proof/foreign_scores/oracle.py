"""The oracle: scipy's least squares of whole trajectories, with the true function in place and without it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.optimize

from benchmarks.proof.foreign_scores.integrator import Integrator
from benchmarks.proof.keys import CaseKey, Truth
from benchmarks.proof.oracle import own_values, true_model
from siq.diagnosis.study import Comparison
from siq.inference.measurements import Measurements
from siq.systems.dynamics import Dynamics

EVALUATIONS = 60  # of a fit, at most
PREFIX, SHORTEST = 0.2, 8  # of a held-out recording, from which its first states are told; samples, at least
WIDE = 3.0  # deviations of the states about their means, within which first states are sought
NUDGE = 1e-5  # of a state in units of this width, for a difference
BLOCKS = 12  # of held-out samples, whose differences tell the error of a gain


@dataclass(frozen=True)
class LeastSquares:
    """A fit of whole trajectories.

    Attributes
    ----------
    model
        With the estimates.
    starts
        First states, shape ``(recordings, d)``.
    chi2
        Sum of the squared residuals, in units of the noise.
    integrator
        What it was made by.
    noise
        Deviation of each output's noise, shape ``(m,)``.
    """

    model: Dynamics
    starts: np.ndarray
    chi2: float
    integrator: Integrator
    noise: np.ndarray

    def jacobian(self) -> np.ndarray:
        """Derivatives of the predicted values, in units of the noise; shape ``(n m, p + recordings d)``."""
        return _jacobian(self.integrator, self.model.values, self.starts, self.noise)


@dataclass(frozen=True)
class TrueSimulation:
    """What the true simulation and the card's do with the recordings.

    Attributes
    ----------
    true, card
        Their fits; of nulls and shifts both are the same.
    delta_chi2
        What the true function gains; NaN where nothing is concealed.
    true_error, card_error
        Normalised errors on held-out recordings; NaN where a simulation runs away.
    gain_error
        Standard error of the difference of the two.
    """

    true: LeastSquares
    card: LeastSquares
    delta_chi2: float
    true_error: float
    card_error: float
    gain_error: float


def true_simulation(case: Comparison, key: CaseKey, truth: Truth, starts: np.ndarray) -> TrueSimulation:
    """Fit the true simulation and the card's.

    Parameters
    ----------
    case
        As the diagnosis had it.
    key, truth
        What it conceals, and where the system was.
    starts
        True first states of the recordings that are learned from, shape ``(recordings, d)``.

    Raises
    ------
    ValueError
        When the true simulation cannot be run along the recordings.
    """
    noise = np.array([key.sensors.noise[name] for name in case.system.output_names])
    steps = np.array([key.sensors.steps.get(name, 0.0) for name in case.system.output_names])
    noise = np.sqrt(noise**2 + steps**2 / 12)
    right, _ = true_model(case.system, key)
    true = least_squares(right, case.learn, noise, starts)
    begin = [case.system.values, own_values(case.system, true.model)]
    fits = [
        least_squares(case.system.with_values(values), case.learn, noise, first)
        for values, first in zip(begin, (starts, true.starts), strict=True)
    ]
    card = min(fits, key=lambda fit: fit.chi2)
    errors = [free_errors(fit.model, case.kept, noise, truth) for fit in (true, card)]
    middle = [_rms(each) for each in errors]
    return TrueSimulation(
        true,
        card,
        card.chi2 - true.chi2 if key.effect.changes_equations else np.nan,
        middle[0],
        middle[1],
        jackknife(*errors),
    )


def least_squares(model: Dynamics, data: Measurements, noise: np.ndarray, starts: np.ndarray) -> LeastSquares:
    """Fit free parameters and first states by scipy's least squares.

    Raises
    ------
    ValueError
        When the first trajectories are not finite.
    """
    integrator = Integrator(model, data)
    free, shape = list(model.free), starts.shape

    def values_of(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = model.values.copy()
        values[free] = z[: len(free)]
        return values, z[len(free) :].reshape(shape)

    def residuals(z: np.ndarray) -> np.ndarray:
        values, first = values_of(z)
        return ((integrator.outputs(integrator.run(values, first), values) - data.outputs) / noise).ravel()

    def jacobian(z: np.ndarray) -> np.ndarray:
        return _jacobian(integrator, *values_of(z), noise)

    found = scipy.optimize.least_squares(
        residuals, np.concatenate([model.values[free], starts.ravel()]), jac=jacobian, x_scale="jac",
        max_nfev=EVALUATIONS, xtol=1e-9, ftol=1e-9, gtol=1e-12,
    )  # fmt: skip
    values, first = values_of(found.x)
    return LeastSquares(model.with_values(values), first, float(2 * found.cost), integrator, noise)


def _jacobian(
    integrator: Integrator, values: np.ndarray, starts: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    states = integrator.run(values, starts)
    along = integrator.sensitivities(values, states)
    by_states, by_parameters = integrator.output_slopes(values, states)
    recordings, d = starts.shape
    n, m = by_states.shape[:2]
    parameters = integrator.chained(along, along.by_parameters)
    first = integrator.chained(
        along, np.zeros((len(integrator.begins), d, d)), np.tile(np.eye(d), (recordings, 1, 1))
    )
    p = parameters.shape[2]
    result = np.zeros((n, m, p + recordings * d))
    result[..., :p] = by_states @ parameters + by_parameters
    own = by_states @ first
    for place in range(recordings):
        rows = slice(integrator.data.first[place], integrator.data.first[place + 1])
        result[rows, :, p + place * d : p + (place + 1) * d] = own[rows]
    flat = (result / noise[None, :, None]).reshape(n * m, -1)
    return np.nan_to_num(flat, nan=0.0, posinf=0.0, neginf=0.0)


class Simulator(Protocol):
    """What runs a model along recordings, such as `Integrator`."""

    model: Dynamics
    data: Measurements

    def run(self, values: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """States at all samples, shape ``(n, d)``, from the first ones ``(recordings, d)``."""

    def outputs(self, states: np.ndarray, values: np.ndarray) -> np.ndarray:
        """What is measured at the samples, ``(n, m)``, for states ``(n, d)``."""


def free_errors(
    model: Dynamics,
    kept: Measurements,
    noise: np.ndarray,
    truth: Truth,
    *,
    simulator: Callable[[Dynamics, Measurements], Simulator] = Integrator,
) -> np.ndarray:
    """Normalised squared errors of a free run of held-out recordings, the mean over outputs at each sample.

    The first states are those that fit the first fifth of a recording best, which is not scored; what it does
    not tell of them is where the system usually is.

    Parameters
    ----------
    model
        With the parameters' values to be used.
    kept
        The recordings.
    noise
        Deviation of each output's noise.
    truth
        Tells where the system usually is.
    simulator
        Makes what runs the model.
    """
    lengths = np.diff(kept.first)
    rows = np.maximum((PREFIX * lengths).astype(int), SHORTEST)
    prefix = simulator(model, kept.until(rows))
    usual, spread = truth.states.mean(axis=0), WIDE * truth.states.std(axis=0)
    added = model.dimension - len(usual)  # states that the truth has none of
    usual, spread = np.append(usual, np.zeros(added)), np.append(spread, np.ones(added))
    shape = (len(lengths), model.dimension)

    def residuals(z: np.ndarray) -> np.ndarray:
        first = usual + spread * z.reshape(shape)
        outputs = prefix.outputs(prefix.run(model.values, first), model.values)
        return np.concatenate([((outputs - prefix.data.outputs) / noise).ravel(), z])

    begin = np.zeros(shape)
    for place, (_, formula) in enumerate(model.outputs):
        if str(formula) in model.states:
            state = model.states.index(str(formula))
            begin[:, state] = (kept.outputs[kept.first[:-1], place] - usual[state]) / spread[state]
    best = _settled(residuals, begin.ravel(), shape, prefix)
    whole = simulator(model, kept)
    outputs = whole.outputs(whole.run(model.values, usual + spread * best.reshape(shape)), model.values)
    scored = np.arange(len(kept.t)) - kept.first[kept.recording] >= rows[kept.recording]
    measured = kept.outputs[scored]
    size = np.nanvar(measured, axis=0)
    squares: np.ndarray = (outputs[scored] - measured) ** 2 / np.where(size > 0, size, 1.0)
    return squares.mean(axis=1)


def _settled(
    residuals: Callable[[np.ndarray], np.ndarray],
    begin: np.ndarray,
    shape: tuple[int, int],
    prefix: Simulator,
) -> np.ndarray:
    """First states by least squares; each recording has its own, so that they are differenced together."""
    recordings, d = shape
    owner = np.concatenate(
        [np.repeat(prefix.data.recording, len(prefix.model.outputs)), np.repeat(np.arange(recordings), d)]
    )

    def jacobian(z: np.ndarray) -> np.ndarray:
        base = residuals(z)
        result = np.zeros((len(base), len(z)))
        for state in range(d):
            moved = z.reshape(shape).copy()
            moved[:, state] += NUDGE
            change = (residuals(moved.ravel()) - base) / NUDGE
            result[np.arange(len(base)), owner * d + state] = change
        return np.nan_to_num(result, nan=0.0, posinf=0.0, neginf=0.0)

    found = scipy.optimize.least_squares(residuals, begin, jac=jacobian, max_nfev=EVALUATIONS)
    best: np.ndarray = found.x
    return best


def _rms(squares: np.ndarray) -> float:
    return float(np.sqrt(squares.mean()))


def jackknife(true: np.ndarray, card: np.ndarray) -> float:
    """Standard error of the difference of two errors, from blocks of samples, since errors last."""
    blocks = np.array_split(np.arange(len(true)), min(BLOCKS, len(true)))
    left = []
    for block in blocks:
        rest = np.setdiff1d(np.arange(len(true)), block)
        left.append(_rms(card[rest]) - _rms(true[rest]))
    return float(np.sqrt((len(left) - 1) / len(left) * np.sum((np.array(left) - np.mean(left)) ** 2)))
