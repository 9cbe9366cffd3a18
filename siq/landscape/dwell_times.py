"""How long does each well last: from barriers and noise, with errors, and how far is the law to be trusted?

A well is left over every one of its saddles, and the rates add. Over one saddle the mean time is

    E[τ] = K exp(ΔU/ε)

(`siq.landscape.rates`; longer where damping is weak, `siq.landscape.turnover`), from the well to the
neighbourhood of the next attractor; the saddle itself is reached in half of it. The relative error of E[τ]
has three parts:

- from f: the standard errors of ΔU/ε and of ln K, which follow from the same f and err together
  (`siq.landscape.prefactor_errors`). Where that of K is not known it is taken to be relatively as uncertain
  as ΔU, since both follow from f to the first order;
- from the noise: ΔU/ε times the relative error of ε. Where D itself is estimated, the error of its parts is
  larger than that of their mean, and a path that runs along one of them has the larger one: `leverage`;
- from the law itself, the leading order for small ε: about ε/ΔU.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from siq.landscape.turnover import TurnLoss

FEWEST = 3.0  # ΔU/ε: the law's own error is a third there; below it gives no more than an order of magnitude


@dataclass(frozen=True)
class NoiseStrength:
    """The strength ε of ``√ε σ dW``, in the unit of U.

    Attributes
    ----------
    intensity, standard_error
        ε and its standard error.
    source
        Whether the recordings show it, or somebody gave it.
    """

    intensity: float
    standard_error: float = 0.0
    source: Literal["estimated", "given"] = "given"


@dataclass(frozen=True)
class Exit:
    """One way out of a well, as far as its time depends on it.

    Attributes
    ----------
    barrier, standard_error
        ΔU and its standard error.
    prefactor
        K, None where the law does not hold.
    prefactor_error, covariance
        Standard error of ln K, None where not known, and its covariance with ΔU.
    leverage
        Relative standard error of ΔU/ε from an estimated D over that of ε.
    turn
        What is lost of U in one turn about the well, where that matters (`siq.landscape.turnover`).
    """

    barrier: float
    standard_error: float
    prefactor: float | None
    prefactor_error: float | None = None
    covariance: float = 0.0
    leverage: float = 1.0
    turn: TurnLoss | None = None


@dataclass(frozen=True)
class MeanTime:
    """A mean time with its errors.

    Attributes
    ----------
    value
        E[τ], in the recordings' unit of time.
    data_error
        Relative standard error from f and from the noise.
    law_error
        Relative error of the law itself, about ε/ΔU.
    complete
        Whether every way out counts; where one has no rate, the well lasts no longer than `value`.
    """

    value: float
    data_error: float
    law_error: float
    complete: bool = True

    @property
    def error(self) -> float:
        """The relative error as a whole."""
        return float(np.hypot(self.data_error, self.law_error))

    @property
    def limits(self) -> tuple[float, float]:
        """The range that one error spans, as a factor: a time is positive however uncertain it is."""
        factor = float(np.exp(self.error))
        return self.value / factor, self.value * factor


def exit_time(way: Exit, noise: NoiseStrength) -> MeanTime | None:
    """The mean time over one saddle; None where the law does not hold, or the noise is not below the barrier.

    Examples
    --------
    >>> found = exit_time(Exit(barrier=0.5, standard_error=0.01, prefactor=4.0), NoiseStrength(0.1))
    >>> round(found.value, 1), round(found.data_error, 3), found.law_error
    (593.7, 0.102, 0.2)
    """
    if way.prefactor is None or not 0 < noise.intensity < way.barrier:
        return None
    height = way.barrier / noise.intensity
    relative = way.standard_error / way.barrier
    with np.errstate(over="ignore"):
        slower = 1.0 if way.turn is None else way.turn.factor(noise.intensity)
        value = float(way.prefactor * np.exp(height) / slower)
    if not np.isfinite(value):
        return None
    of_prefactor = relative if way.prefactor_error is None else way.prefactor_error
    of_noise = height * way.leverage * noise.standard_error / noise.intensity
    squares = float(np.nansum(np.square((height * relative, of_prefactor, of_noise))))
    together = 2 * way.covariance / noise.intensity
    # By rounding, or by what is in one error alone, the two could cancel by more than there is.
    return MeanTime(value, float(np.sqrt(max(squares + together, np.nan_to_num(of_noise) ** 2))), 1 / height)


def dwell_time(ways: Sequence[Exit], noise: NoiseStrength | None) -> MeanTime | None:
    """The mean time in a well with these ways out; None where no way out has a rate.

    Ways whose rates fall behind by more than the errors change nothing; errors of different ways are added as
    if they were the same, since f and the noise are.
    """
    if noise is None:
        return None
    times = [exit_time(way, noise) for way in ways]
    known = [one for one in times if one is not None]
    if not known:
        return None
    rates = np.array([1 / one.value for one in known])
    shares = rates / rates.sum()
    return MeanTime(
        float(1 / rates.sum()),
        float(sum(share * one.data_error for share, one in zip(shares, known, strict=True))),
        float(sum(share * one.law_error for share, one in zip(shares, known, strict=True))),
        complete=len(known) == len(times),
    )
