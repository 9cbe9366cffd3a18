"""Residuals of an identified f, and its long-term prediction.

Process noise is white: the residuals of neighbouring pairs know nothing of each other, and their variance
grows with the time between samples. Measurement noise is shared by the two pairs that a sample belongs to,
which makes their residuals anticorrelated; it enters X0 as well, and biases every regression on X0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy.special

from siq.data.recordings import Recordings, SnapshotPairs, snapshot_pairs
from siq.inference.field_estimate import IdentifiedField
from siq.inference.flow_regression import refit, residuals, weighted_residual_probability, whitened
from siq.inference.noisy_sensor import (
    HARMLESS,
    decimals_needed,
    is_rounding,
    rounding_bias,
    rounding_errors,
    rounding_text,
)
from siq.numerics.integration import runge_kutta_step
from siq.systems.dynamics import Dynamics

NoiseKind = Literal["none", "process", "measurement", "rounding", "coloured"]

LONGEST_GAP = 10.0  # steps of a pair: samples farther apart say little of noise
SIGNIFICANT = 5.0  # standard errors
LARGE = 0.02  # a correlation, or a deviation of D, below this is harmless however significant
PAIRS = 60_000  # numerical: their correlations are known to 1/√60000 = 0.004, a fifth of LARGE


@dataclass(frozen=True)
class NoiseDiagnosis:
    """What is in the residuals.

    Attributes
    ----------
    kind
        ``none``: only the integrator's error and rounding. ``process``: white. ``measurement``:
        neighbouring residuals are anticorrelated. ``rounding``: the same, and no more than the values were
        rounded by when they were written. ``coloured``: they are positively correlated.
    intensity
        ε of ``√ε D^(1/2) dW``, estimated.
    covariance
        Shape ``(d, d)``: the residuals' covariance per time over the intensity; D, if D is right.
    deviation
        Largest entry of ``D^(-1/2) covariance D^(-1/2) - 1``, and ...
    deviation_score
        ... the same in its standard errors.
    correlation, correlation_score
        Of neighbouring residuals, the strongest over the states; and in standard errors.
    measurement
        Shape ``(d,)``: standard deviation of measurement noise; zero where none is recognised.
    rounding
        How the values were written and which error that means, in words; None where it is not seen.
    rounding_bias
        The largest bias that rounding brings into a coefficient of f, in its standard errors.
    decimals
        How many would leave no trace of rounding.
    memory
        How long the recordings remember, and why, in words; None where they do not.
    """

    kind: NoiseKind
    intensity: float
    covariance: np.ndarray
    deviation: float
    deviation_score: float
    correlation: float
    correlation_score: float
    measurement: np.ndarray
    rounding: str | None = None
    rounding_bias: float = 0.0
    decimals: int = 0
    memory: str | None = None

    def as_data(self) -> dict[str, Any]:
        """What is kept of it in `vector_field.json`, without the note."""
        return {
            "kind": self.kind,
            "intensity": self.intensity,
            "covariance": self.covariance.tolist(),
            "correlation": self.correlation,
            "correlation_score": self.correlation_score,
            "measurement": self.measurement.tolist(),
        }

    @property
    def note(self) -> str | None:
        """What a reader has to know of recordings that can be used all the same."""
        if self.memory is not None:
            return self.memory
        if self.kind == "rounding" and self.rounding_bias <= HARMLESS:
            return f"{self.rounding}: the standard errors of the formulas contain it"
        return None

    def fault(self, states: tuple[str, ...]) -> str | None:
        """Why formulas from these recordings would be biased, in words; None where they are not."""
        if self.kind == "measurement":
            worst = int(np.argmax(self.measurement))
            return (
                f"the recordings carry measurement noise, of about {self.measurement[worst]:.2g} in"
                f" {states[worst]}: residuals of neighbouring pairs are anticorrelated"
                f" ({self.correlation:.2f}); smooth or average the recordings first"
            )
        if self.kind == "rounding" and self.rounding_bias > HARMLESS:
            return (
                f"{self.rounding}: that is too much for the formulas, which it biases by"
                f" {self.rounding_bias:.1f} standard errors; write at least {self.decimals} decimals"
            )
        if self.kind == "coloured":
            return (
                f"the residuals of neighbouring pairs are correlated ({self.correlation:.2f}): the noise has"
                " a memory, or a state is missing from the recordings"
            )
        if self.kind == "process" and self.deviation_score > SIGNIFICANT and self.deviation > LARGE:
            shown = np.array2string(self.covariance, precision=3, separator=", ").replace("\n", "")
            return (
                f"the noise in the recordings has the covariance {shown} (times {self.intensity:.3g}), which"
                " is not the D of the study; state this D"
            )
        return None


def residual_noise(
    found: IdentifiedField, recordings: Recordings, *, pair_step: float | None
) -> NoiseDiagnosis:
    """Tell process noise from measurement noise.

    Parameters
    ----------
    found
        The identified f.
    recordings
        The trajectories, whose samples also serve between the pairs.
    pair_step
        Longest step of a pair.
    """
    d = found.library.dimension
    pairs = snapshot_pairs(recordings, pair_step=pair_step)
    sample = snapshot_pairs(recordings, pair_step=LONGEST_GAP * float(pairs.h.max()))
    if len(sample.h) > PAIRS:  # whole stretches, so that neighbours stay neighbours
        sample = SnapshotPairs(
            sample.x0[:PAIRS], sample.xh[:PAIRS], sample.h[:PAIRS], sample.recording[:PAIRS]
        )
    intensity, covariance, excess = _against_diffusion(found, pairs)
    deviation = float(excess.max())
    score = float((excess / np.sqrt((1 + np.eye(d)) / len(pairs.h))).max())
    if found.noise_free:
        return NoiseDiagnosis("none", 0.0, covariance, 0.0, 0.0, 0.0, 0.0, np.zeros(d))
    correlations, scores = _neighbours(found, sample)
    worst = int(np.argmax(np.abs(scores)))
    kind: NoiseKind = "process"
    measurement = np.zeros(d)
    if abs(scores[worst]) > SIGNIFICANT and abs(correlations[worst]) > LARGE:
        kind = "measurement" if scores[worst] < 0 else "coloured"
        if kind == "measurement":
            measurement = _measurement_errors(found, sample)
            rounding = rounding_errors(recordings)
            if is_rounding(measurement, rounding, correlation=float(correlations[worst])):
                return NoiseDiagnosis(
                    "rounding", 0.0, covariance, 0.0, 0.0,
                    float(correlations[worst]), float(scores[worst]), measurement,
                    rounding_text(recordings),
                    rounding_bias(found, pairs, rounding), decimals_needed(recordings, pairs),
                )  # fmt: skip
    return NoiseDiagnosis(
        kind, intensity, covariance, deviation, score,
        float(correlations[worst]), float(scores[worst]), measurement,
    )  # fmt: skip


def shared_errors(
    found: IdentifiedField, recordings: Recordings, *, pair_step: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """What neighbouring residuals share: their correlation state by state, and in standard errors.

    Negative where the sensor is noisy, since the sample in the middle is the later one of the first pair and
    the earlier one of the second.
    """
    return _neighbours(found, snapshot_pairs(recordings, pair_step=pair_step))


def _neighbours(found: IdentifiedField, sample: SnapshotPairs) -> tuple[np.ndarray, np.ndarray]:
    rest = residuals(found, sample)
    if not found.diffusion.constant:
        rest = whitened(found, sample, rest)
    joined = _joined(sample, rest)
    if not joined.any():  # every recording has two samples
        return np.zeros(rest.shape[1]), np.zeros(rest.shape[1])
    first, second = rest[:-1][joined], rest[1:][joined]
    product = first * second
    size = np.sqrt((first**2).mean(axis=0) * (second**2).mean(axis=0))
    scores = product.sum(axis=0) / np.sqrt((product**2).sum(axis=0))
    return product.mean(axis=0) / size, scores


def _against_diffusion(found: IdentifiedField, pairs: SnapshotPairs) -> tuple[float, np.ndarray, np.ndarray]:
    """ε, the covariance of the residuals in its unit, and how far it is from D, where D is the unit."""
    noise, unit = found.diffusion, np.eye(found.library.dimension)
    if noise.constant:
        intensity = noise.intensity(found.noise_rate)
        covariance = found.noise_rate / intensity if intensity > 0 and not found.noise_free else noise.matrix
        return intensity, covariance, np.abs(noise.whitening @ covariance @ noise.whitening.T - unit)
    if found.noise_free:
        return 0.0, unit, np.zeros_like(unit)
    forces = whitened(found, pairs, residuals(found, pairs))
    whole = forces.T @ forces / len(forces)
    intensity = float(np.trace(whole)) / len(unit)
    excess = np.abs(whole / intensity - unit)
    if found.noise is not None:  # its own formula says ε without the chance of the residuals
        intensity = found.intensity
    return intensity, found.noise_rate / intensity, excess


def _joined(sample: SnapshotPairs, rest: np.ndarray) -> np.ndarray:
    """Which pairs share a sample with the next: the later state of one is the earlier one of the other.

    Without the few that an inaccurate f carries far away, by which everything else would be hidden.
    """
    usual = (np.abs(rest) < 20 * np.median(np.abs(rest), axis=0)).all(axis=1)
    same = (sample.recording[1:] == sample.recording[:-1]) & (sample.xh[:-1] == sample.x0[1:]).all(axis=1)
    return np.asarray(same & usual[1:] & usual[:-1])


def _measurement_errors(found: IdentifiedField, sample: SnapshotPairs) -> np.ndarray:
    """Standard deviations of measurement noise, from the covariance of neighbouring residuals.

    Errors of X0 bias f by the inverse of the step, so that f is fitted to the long steps as well. An error
    of the sample that two pairs share is carried on by the flow of the second.
    """
    found = refit(found, sample)
    rest = residuals(found, sample)
    joined = _joined(sample, rest)
    covariance = (rest[:-1][joined] * rest[1:][joined]).mean(axis=0)
    rates = np.einsum("nii->ni", found.dynamics.jacobian(sample.x0[1:][joined]))
    carried = np.exp(np.minimum(rates * sample.h[1:][joined, None], 1.0)).mean(axis=0)
    return np.sqrt(np.maximum(-covariance / carried, 0.0))


def mean_residual_probability(found: IdentifiedField, pairs: SnapshotPairs) -> float:
    """Probability of the held-out residuals having no mean left that f's library could express.

    An F test of the regression of the residuals on the library, the smallest over the states, corrected
    for their number: tiny where f misses a term.
    """
    # Copies of resampled recordings would count as evidence that there is not.
    _, single = np.unique(np.column_stack([pairs.x0, pairs.xh]), axis=0, return_index=True)
    pairs = pairs.take(single)
    if not found.diffusion.constant:
        return weighted_residual_probability(found, pairs)
    rest = residuals(found, pairs) / np.sqrt(pairs.h)[:, None]
    design = found.library.evaluate(pairs.x0) * np.sqrt(pairs.h)[:, None]
    design = design / np.where((size := np.linalg.norm(design, axis=0)) > 0, size, 1.0)
    orthogonal = np.linalg.qr(design)[0]
    explained = ((orthogonal.T @ rest) ** 2).sum(axis=0)
    total = (rest**2).sum(axis=0)
    n, q = design.shape
    ratio = (explained / q) / ((total - explained) / (n - q))
    return float(min(scipy.special.fdtrc(q, n - q, ratio).min() * rest.shape[1], 1.0))


ACCURACY = 0.05  # step times the norm of the Jacobian, per step of the integrator
MOST_STEPS = 5000  # between two samples; what is faster than that between samples is not what was recorded
AWAY = 1e3  # widths of the recorded states: so far off a prediction has run away


def predict(dynamics: Dynamics, recordings: Recordings) -> np.ndarray:
    """Follow f from the first sample of every recording through all its times.

    Parameters
    ----------
    dynamics
        f and D.
    recordings
        The trajectories; each keeps its own times.

    Returns
    -------
    numpy.ndarray
        Predicted states in the order of ``recordings.values``, shape ``(n, d)``; not finite where the
        prediction runs away, or f is too fast to be followed from sample to sample.
    """
    starts = np.flatnonzero(np.diff(recordings.recording, prepend=-1))
    lengths = np.diff(np.append(starts, len(recordings.t)))
    width = np.ptp(recordings.values, axis=0)
    width = np.where(width > 0, width, 1.0)
    center = recordings.values.mean(axis=0)
    jacobian = dynamics.jacobian(recordings.values) * width / width[:, None]
    rate = float(np.quantile(np.linalg.norm(jacobian, axis=(1, 2)), 0.999))
    predicted = np.full_like(recordings.values, np.nan)
    predicted[starts] = recordings.values[starts]
    x = recordings.values[starts].T.copy()

    def velocity(components: np.ndarray) -> np.ndarray:
        return dynamics.drift(components.T).T

    with np.errstate(over="ignore", invalid="ignore"):
        for place in range(1, int(lengths.max())):
            near = (np.abs(x - center[:, None]) < AWAY * width[:, None]).all(axis=0)
            going = (lengths > place) & near
            if not going.any():
                break
            rows = starts[going] + place
            gap = recordings.t[rows] - recordings.t[rows - 1]
            steps = max(int(np.ceil(gap.max() * rate / ACCURACY)), 1)
            if steps > MOST_STEPS:
                break
            part = x[:, going]
            for _ in range(steps):
                part = runge_kutta_step(velocity, part, gap / steps)
            x[:, going] = part
            predicted[rows] = part.T
    return predicted


def prediction_errors(dynamics: Dynamics, recordings: Recordings) -> np.ndarray:
    """``E_k = ‖X_predicted(t) - X_k(t)‖ / ‖X_k(t)‖`` of every recording k (paper, Eq. error), shape ``(K,)``.

    The norms are over all samples of a recording and all states. A prediction that runs away has an
    infinite error.
    """
    difference = ((predict(dynamics, recordings) - recordings.values) ** 2).sum(axis=1)
    size = (recordings.values**2).sum(axis=1)
    count = len(recordings.labels)
    difference = np.where(np.isfinite(difference), difference, np.inf)
    total = np.bincount(recordings.recording, weights=difference, minlength=count)
    return np.sqrt(total / np.bincount(recordings.recording, weights=size, minlength=count))
