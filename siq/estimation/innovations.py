"""Innovations: what a filter does not foresee, in units of its standard deviation.

Along the trajectories of a fit everything is linear. The innovations, and what a unit of each parameter
explains of them, the unknown initial states projected out, are all that estimation, screening and tests need.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from siq.errors import NumericalFailure
from siq.estimation.kernels import whitened_innovations
from siq.estimation.linearisation import Linearisation
from siq.estimation.measurements import Measurements
from siq.numerics.triangle import triangle_of

RANK = 1e-9  # numerical: singular values below this share of the largest are rounding


class NoiseField(Protocol):
    """How strong random forces are at the states at which a filter is."""

    def over(self, x: np.ndarray, spread: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Their mean intensity over intervals.

        Parameters
        ----------
        x, spread
            Mean state in the middle of each, ``(n, d)``, and its covariance at the begin, ``(n, d, d)``.
        step
            Their lengths, shape ``(n,)``.

        Returns
        -------
        numpy.ndarray
            Shape ``(n, d, d)``, per time.
        """


@dataclass(frozen=True)
class Noise:
    """Variances of the two kinds of noise.

    Attributes
    ----------
    measurement
        R, per sample, shape ``(m,)``.
    process
        Q, per time, shape ``(d,)``; zero where nothing drives the state.
    shape
        Of the random forces, where they are no independent ones of constant strength: ``(1, d, d)``, or
        ``(n, d, d)`` for one at each sample. The intensity is then ``√Q_i shape_ij √Q_j``.
    field
        What the shape is at each sample, where it depends on the state; a fit keeps the shape up with it.
    """

    measurement: np.ndarray
    process: np.ndarray
    shape: np.ndarray | None = None
    field: NoiseField | None = None

    def along(self, x: np.ndarray, spread: np.ndarray | None, step: np.ndarray) -> Noise:
        """The same noise with the shape that its field has at states; see `NoiseField.over`."""
        if self.field is None:
            return self
        spread = np.zeros((*x.shape, x.shape[1])) if spread is None else spread
        return replace(self, shape=self.field.over(x, spread, step))

    def without_process(self) -> Noise:
        """The same measurement noise, and states that follow their equations exactly."""
        return replace(self, process=np.zeros_like(self.process))

    def of_states(self, dimension: int) -> Noise:
        """The same noise where there are more states, or fewer: what is added has none of its own."""
        if len(self.process) == dimension:
            return self
        driven = self.process[:dimension]
        return replace(self, process=np.append(driven, np.zeros(dimension - len(driven))))

    def scaled(self, factor: float) -> Noise:
        """The same measurement noise, with the process noise multiplied."""
        return replace(self, process=self.process * factor)

    @property
    def intensity(self) -> np.ndarray:
        """Intensity of the random forces, per time: shape ``(1, d, d)``, or ``(n, d, d)``."""
        if self.shape is None:
            return np.diag(self.process)[None]
        return self.shape * np.sqrt(np.outer(self.process, self.process))


def profile_likelihood(total: float, freedom: int, log_determinant: float) -> float:
    """Log-likelihood, up to a constant, with the common scale of both kinds of noise at its best."""
    return -0.5 * (freedom * np.log(max(total, 1e-300) / freedom) + log_determinant)


@dataclass(frozen=True)
class Whitened:
    """Innovations in units of their standard deviation, initial states projected out.

    Attributes
    ----------
    innovations
        Shape ``(n·m,)``.
    columns
        What a unit of each parameter explains of them, shape ``(n·m, p)``.
    recording
        The recording of each, shape ``(n·m,)``.
    known
        Which of them were measured, shape ``(n·m,)``.
    degrees_of_freedom
        Measured values less initial states.
    log_determinant
        Of the innovations' covariance.
    """

    innovations: np.ndarray
    columns: np.ndarray
    recording: np.ndarray
    known: np.ndarray
    degrees_of_freedom: int
    log_determinant: float

    def log_likelihood(self, sum_of_squares: float) -> float:
        """Log-likelihood where the innovations have the given sum of squares."""
        return -0.5 * (sum_of_squares + self.log_determinant + self.known.sum() * np.log(2 * np.pi))


def whiten(linearisation: Linearisation, data: Measurements, noise: Noise) -> Whitened:
    """Innovations of the filter in units of their standard deviation, initial states projected out.

    Raises
    ------
    NumericalFailure
        When the simulation, as linearised, runs away along a recording. Columns of parameters may be infinite
        all the same.
    """
    transition = linearisation.transition
    step = np.append(np.diff(data.t), 0.0)
    process = process_covariance(transition, step, noise.intensity)
    innovations, columns, initial, log_determinant = whitened_innovations(
        data.first,
        transition,
        linearisation.response,
        linearisation.gap,
        process,
        linearisation.measured,
        linearisation.measured_response,
        linearisation.residual,
        noise.measurement,
    )
    outputs = innovations.shape[1]
    known = ~np.isnan(linearisation.residual).ravel()
    innovations = innovations.ravel()
    columns = columns.reshape(len(innovations), -1)
    initial = initial.reshape(len(innovations), -1)
    if not (np.isfinite(innovations).all() and np.isfinite(initial).all() and np.isfinite(log_determinant)):
        raise NumericalFailure("small deviations from the recorded motion grow beyond all numbers")
    used = 0
    for begin, end in zip(data.first[:-1] * outputs, data.first[1:] * outputs, strict=True):
        basis = _orthonormal(initial[begin:end])
        innovations[begin:end] -= basis @ (basis.T @ innovations[begin:end])
        columns[begin:end] -= basis @ (basis.T @ columns[begin:end])
        used += basis.shape[1]
    return Whitened(
        innovations=innovations,
        columns=columns,
        recording=np.repeat(data.recording, outputs),
        known=known,
        degrees_of_freedom=int(known.sum()) - used,
        log_determinant=log_determinant,
    )


def process_covariance(transition: np.ndarray, step: np.ndarray, intensity: np.ndarray) -> np.ndarray:
    """Covariance that noise of the given intensities adds over each interval, by Simpson's rule.

    Parameters
    ----------
    transition
        Φ over the intervals, shape ``(n, d, d)``.
    step
        Their lengths, shape ``(n,)``.
    intensity
        Per time, shape ``(1, d, d)`` or ``(n, d, d)``.
    """
    total = np.zeros_like(transition)
    dimension = transition.shape[1]
    unit = np.eye(dimension)
    for i in range(dimension):
        for j in range(dimension):
            strength = intensity[:, i, j]
            if not strength.any():
                continue
            one, other = transition[:, :, i], transition[:, :, j]
            ends = one[:, :, None] * other[:, None, :] + unit[:, i, None] * unit[None, :, j]
            middle = (one + unit[i])[:, :, None] * (other + unit[j])[:, None, :]
            total += strength[:, None, None] * (ends + middle)
    return total * (step / 6)[:, None, None]


def solve(columns: np.ndarray, target: np.ndarray, *, least: float = RANK) -> tuple[np.ndarray, np.ndarray]:
    """Least squares with columns of any scale; what the data do not tell is left alone.

    Parameters
    ----------
    columns, target
        Shapes ``(n, p)`` and ``(n,)``.
    least
        Singular values below this share of the largest tell nothing.

    Returns
    -------
    estimate, covariance
        Shapes ``(p,)`` and ``(p, p)``, for errors of unit variance.

    Raises
    ------
    NumericalFailure
        When a column or the target is not finite.
    """
    if columns.shape[1] == 0:
        return np.zeros(0), np.zeros((0, 0))
    if not (np.isfinite(columns).all() and np.isfinite(target).all()):
        raise NumericalFailure("the effect of a parameter on what is measured is beyond all numbers")
    scale = np.sqrt(np.einsum("np,np->p", columns, columns))
    scale[scale == 0] = 1.0
    triangle = triangle_of(columns, target)
    left, values, right = np.linalg.svd(triangle[:, :-1] / scale, full_matrices=False)
    kept = values > least * values[0] if values[0] > 0 else np.zeros(len(values), dtype=bool)
    inverse = right[kept].T / values[kept] / scale[:, None]
    return inverse @ (left[:, kept].T @ triangle[:, -1]), inverse @ inverse.T


def with_parameters_changed(linearisation: Linearisation, change: np.ndarray) -> Linearisation:
    """The linearisation after a change of the parameters, which are then no longer free."""
    return replace(
        linearisation,
        gap=linearisation.gap + linearisation.response @ change,
        residual=linearisation.residual - linearisation.measured_response @ change,
        response=np.zeros((*linearisation.gap.shape, 0)),
        measured_response=np.zeros((*linearisation.residual.shape, 0)),
    )


def _orthonormal(columns: np.ndarray) -> np.ndarray:
    """Orthonormal basis of what columns span."""
    scale = np.sqrt((columns**2).sum(axis=0))
    scale[scale == 0] = 1.0
    basis, triangle = np.linalg.qr(columns / scale)
    values = np.abs(np.diag(triangle))
    if values.min(initial=1.0) <= RANK * values.max(initial=0.0):
        basis, values, _ = np.linalg.svd(columns / scale, full_matrices=False)
        basis = basis[:, values > RANK * max(values[0], 1e-300)]
    return basis
