"""Were the recordings rounded when they were written, and does it matter?

A value that was written to three decimals is off by up to half of the last one, evenly: a noise of the
measurement whose strength is known. It enters X0 as well as Xh, and biases the regression by an amount that
follows from it. Where that is well below the standard errors it does no harm, and they contain what rounding
adds to the scatter.
"""

from __future__ import annotations

import numpy as np

from siq.data.quantum import decimals_of, quantum, rounding_error
from siq.data.recordings import Recordings, SnapshotPairs
from siq.dynamics.formulas import compile_formulas
from siq.identify.identified_field import NOISE_FREE, IdentifiedField

HARMLESS = 0.5  # of a standard error: with such a bias an error bar holds 0.95 - 0.02 of the time
LIKE_ROUNDING = (
    0.3,
    1.5,
)  # measured noise over that of rounding; less where steps are as small as the rounding
COARSE = 0.05  # of the rms step of a state: rounding to less than that stops no identification


def rounding_errors(recordings: Recordings) -> np.ndarray:
    """Standard deviation of what rounding did to each state, 0 where none is recognised: shape ``(d,)``."""
    steps = [quantum(values) for values in recordings.values.T]
    return np.array([0.0 if step is None else rounding_error(step) for step in steps])


def is_rounding(measured: np.ndarray, rounding: np.ndarray, *, correlation: float) -> bool:
    """Whether the noise of a measurement is that of rounding, and no other.

    Parameters
    ----------
    measured
        Shape ``(d,)``: standard deviations of the noise that the residuals show.
    rounding
        Shape ``(d,)``: of rounding.
    correlation
        Of neighbouring residuals: -1/2 where nothing but the measurement is noisy.
    """
    low, high = LIKE_ROUNDING
    own = rounding > 0
    known = (measured <= high * rounding) & ((measured >= low * rounding) | (rounding < rounding.max()))
    return bool(
        own.any() and known[own].all() and (measured[~own] <= rounding.max()).all() and correlation < -0.3
    )


def rounding_bias(found: IdentifiedField, pairs: SnapshotPairs, rounding: np.ndarray) -> float:
    """The largest bias that rounding brings into a coefficient of f, in its standard errors.

    The error e of X0 stands in the velocity as ``-e/h``, and in a function θ as ``e ∂θ/∂x``: their product
    does not average out. To first order the coefficients of an equation are off by
    ``-(Σ h θθᵀ)⁻¹ Σ ∂θ/∂x R``, R the variance of the rounding.
    """
    errors = np.sqrt(np.diag(found.covariance))
    largest = 0.0
    for state in range(found.library.dimension):
        own = found.support[:, 0] == state
        terms = [found.library.terms[k] for k in found.support[own, 1]]
        symbol = found.library.symbols[state]
        x = np.ascontiguousarray(pairs.x0.T)
        values = compile_formulas(terms, found.library.symbols)(x)
        slopes = compile_formulas([term.diff(symbol) for term in terms], found.library.symbols)(x)
        scale = np.sqrt((values**2 * pairs.h).sum(axis=1))
        scaled = values / scale[:, None]
        bias = (
            np.linalg.lstsq((scaled * pairs.h) @ scaled.T, slopes.sum(axis=1) / scale, rcond=None)[0] / scale
        )
        largest = max(largest, float((np.abs(bias) * rounding[state] ** 2 / errors[own]).max()))
    return largest


def rounding_text(recordings: Recordings, *, coarse: bool = False) -> str | None:
    """How the recordings were written and what error that means, in words; None where no rounding is seen.

    Parameters
    ----------
    recordings
        Trajectories.
    coarse
        Whether only rounding counts that is not small beside the steps from sample to sample.
    """
    alike: dict[tuple[float, str | None], list[str]] = {}
    for name, unit, values in zip(recordings.titles, recordings.units, recordings.values.T, strict=True):
        step = quantum(values)
        if step is None:
            continue
        if coarse and rounding_error(step) < COARSE * np.sqrt(np.mean(np.diff(values) ** 2)):
            continue
        alike.setdefault((step, unit), []).append(f"'{name}'")
    said = [_written(names, step, unit) for (step, unit), names in alike.items()]
    return ", and ".join(said) or None


def _written(names: list[str], step: float, unit: str | None) -> str:
    decimals, behind = decimals_of(step), f" {unit}" if unit else ""
    how = (
        f"to {decimals} decimal{'s' if decimals > 1 else ''}"
        if decimals
        else f"in steps of {step:.3g}{behind}"
    )
    error = f"{rounding_error(step):.1g}{behind}"
    if len(names) == 1:
        return f"{names[0]} is written {how}, an error of {error} in each value"
    return f"{', '.join(names[:-1])} and {names[-1]} are written {how}, an error of {error} in each value"


def decimals_needed(recordings: Recordings, pairs: SnapshotPairs) -> int:
    """How many decimals leave rounding below everything else: that of a recording without noise."""
    moves = np.sqrt(((pairs.xh - pairs.x0) ** 2).mean(axis=0))
    step = NOISE_FREE * np.sqrt(6.0) * float(moves[moves > 0].min(initial=1.0))
    return max(int(np.ceil(-np.log10(step))), 1)
