"""Errors on recordings held out: how large they are, and which of two simulations foresees them better.

Two simulations of the same recordings are off by the same noise. Whether one is better is therefore asked of
pairs: of the ratio of their errors, whose own error is known from leaving out one block of samples at a time
(the jackknife). Errors of a simulation last; blocks are long, and few.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import scipy.stats

Change = Literal["better", "same", "worse", "unknown"]
Run = Literal["before", "recalibrated", "augmented", "named", "without"]
WIDE = 1.96  # standard errors within which 95 % lie
BLOCKS = 12  # as many as tell an error of a ratio; fewer leave more samples that belong together in one
BY_CHANCE = 0.05  # probability of a gain, or a loss, where there is none


@dataclass(frozen=True)
class HeldOutErrors:
    """Normalised errors on held-out recordings; None where a simulation ran away.

    Attributes
    ----------
    before, recalibrated, augmented
        Of the simulation as it is, with its parameters refitted, and with what was found.
    noise_floor
        What measurement noise alone amounts to.
    values
        Number of measured values that the errors are means over; 0 where it is not known.
    named
        With what has a name only, where something without a name describes the rest.
    squares
        Mean squared errors of blocks of samples, by simulation: what changes are told by.
    """

    before: float | None = None
    recalibrated: float | None = None
    augmented: float | None = None
    noise_floor: float | None = None
    values: int = 0
    named: float | None = None
    squares: Mapping[str, tuple[float, ...]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(
        cls,
        runs: Mapping[str, np.ndarray | None],
        *,
        noise_floor: float | None = None,
    ) -> HeldOutErrors:
        """From squared errors of each simulation.

        Parameters
        ----------
        runs
            By their names above: normalised squared errors of the same values, sample by sample, shape
            ``(values,)``; None where the simulation ran away (`siq.estimation.free_runs.squared_errors`).
        noise_floor
            See above.
        """
        known = {name: each for name, each in runs.items() if each is not None}
        errors = {name: float(np.sqrt(each.mean())) for name, each in known.items()}
        return cls(
            errors.get("before"),
            errors.get("recalibrated"),
            errors.get("augmented"),
            noise_floor,
            max((len(each) for each in known.values()), default=0),
            errors.get("named"),
            {name: in_blocks(each) for name, each in known.items()},
        )

    @property
    def better_without(self) -> Run:
        """The better one of the simulation as it is and with its parameters refitted."""
        if self.before is None:
            return "recalibrated"
        if self.recalibrated is None:
            return "before"
        return "before" if self.before <= self.recalibrated else "recalibrated"

    def error(self, run: Run) -> float | None:
        """The error of a simulation; that ``without`` is the better of those without what was found."""
        known: float | None = getattr(self, self.better_without if run == "without" else run)
        return known

    def change(self, first: Run, second: Run) -> Change:
        """Whether one simulation is better than another, by more than appears by chance.

        Parameters
        ----------
        first, second
            Without and with what is judged.
        """
        names = [self.better_without if each == "without" else each for each in (first, second)]
        if any(self.error(name) is None for name in names):
            runs = [self.error(name) is not None for name in names]
            return "unknown" if not any(runs) else "better" if runs[1] else "worse"
        return change_between(self.squares[names[0]], self.squares[names[1]])

    def at_noise(self, run: Run) -> bool:
        """Whether an error is that of measurement noise alone.

        The root mean square of n independent values has the relative standard error 1/√(2n).
        """
        error = self.error(run)
        if error is None or self.noise_floor is None:
            return False
        tolerance = WIDE / float(np.sqrt(2 * self.values)) if self.values else 0.0
        return error * (1 - tolerance) <= self.noise_floor


def change_between(first: tuple[float, ...] | None, second: tuple[float, ...] | None) -> Change:
    """Whether the second of two simulations is better, by mean squared errors of the same blocks of samples.

    Parameters
    ----------
    first, second
        Without and with what is judged; None where the simulation ran away.
    """
    if first is None or second is None:
        return "unknown" if first is second else "better" if first is None else "worse"
    one, other = np.asarray(first), np.asarray(second)
    if len(one) < 2 or np.array_equal(one, other):
        return "same"
    if not one.any() or not other.any():
        return "worse" if other.any() else "better"
    rest, other_rest = one.sum() - one, other.sum() - other
    if not (rest.all() and other_rest.all()):
        return "same"  # all of it is in one block
    middle, left_out = np.log(other.sum() / one.sum()), np.log(other_rest / rest)
    count = len(one)
    deviation = np.sqrt((count - 1) / count * ((left_out - left_out.mean()) ** 2).sum())
    limit = scipy.stats.t.isf(BY_CHANCE, count - 1) * deviation
    return "same" if abs(middle) <= limit else "better" if middle < 0 else "worse"


def in_blocks(squares: np.ndarray) -> tuple[float, ...]:
    """Mean squared errors of blocks of values that follow each other."""
    return tuple(float(each.mean()) for each in np.array_split(squares, max(min(BLOCKS, len(squares)), 1)))
