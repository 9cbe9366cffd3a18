"""Errors of free runs on held-out recordings, cross-validation, and the adoption of a model.

Two simulations of the same recordings are off by the same noise. Whether one is better is therefore asked of
pairs: of the ratio of their errors, whose own error is known from leaving out one block of samples at a time
(the jackknife). Errors of a simulation last; blocks are long, and few.

In cross-validation every part of the recordings to learn from is left out in turn: whole recordings, or
stretches of a single one. All parameters are fitted to the others, so that what is left out had no part in
them. Of several models of what has no name the one that foresees what is left out best becomes part of the
new card, if it predicts recordings held out better than they are predicted without it.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import scipy.stats

from siq.diagnosis.mechanisms import MechanismCandidate
from siq.errors import NumericalFailure
from siq.inference.budget import Budget
from siq.inference.kalman_filter import Noise
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements, cross_validation_folds
from siq.inference.recalibration import fit_with_process_noise_as_needed
from siq.inference.trajectories import free_run, scored_rows, squared_errors
from siq.numerics.randomness import positive

LOGGER = logging.getLogger(__name__)
Change = Literal["better", "same", "worse", "unknown"]
Run = Literal["before", "recalibrated", "augmented", "named", "without"]
# Of an effect, of what is gained, or of squared errors: a choice, made when two cases had been seen, 0.93 for
# the linear damping of a pendulum arm, and 0.46 for a preload in the place of a bump.
NEARLY_ALL = 0.9
ABOVE_BY_CHANCE = 0.025  # probability that noise alone lies above: of 95 %, on one side
BLOCKS = 12  # as many as tell an error of a ratio; fewer leave more samples that belong together in one
CHANGE_BY_CHANCE = 0.05  # probability of a gain, or a loss, where there is none


def simulated(fit: Fit, data: Measurements, *, noise: Noise, substeps: int) -> np.ndarray:
    """A fit's free run of recordings, told how they begin and where it usually is.

    Parameters
    ----------
    fit, data
        Of the simulation, and the recordings.
    noise
        See `siq.inference.trajectories.free_run`.
    substeps
        Runge–Kutta steps between samples at least; a fit that needed more is run with its own.
    """
    return free_run(fit.model, data, noise=noise, substeps=max(substeps, fit.substeps), usual=fit.x)


@dataclass(frozen=True)
class HeldOutErrors:
    """Normalised errors on held-out recordings; None where a simulation ran away."""

    before: float | None = None  #: of the simulation as it is, ...
    recalibrated: float | None = None  #: ... with its parameters refitted, ...
    augmented: float | None = None  #: ... and with what was found
    noise_floor: float | None = None  #: what measurement noise alone amounts to
    values: int = 0  #: number of measured values that the errors are means over; 0 where it is not known
    #: With what has a name only, where something without a name describes the rest.
    named: float | None = None
    #: Mean squared errors of blocks of samples, by simulation: what changes are told by.
    squares: Mapping[str, tuple[float, ...]] = field(default_factory=dict, repr=False)
    #: With the first mechanism that is named, with the first two, and so on.
    rungs: tuple[float | None, ...] = ()
    #: As `noise_floor`, with the error of the model that described the rest (`siq.diagnosis.investigation`).
    floor: float | None = None
    #: Of a single output: what errors of 1 amount to; None of several, or without a unit.
    spread: float | None = None
    unit: str = "1"  #: of a single output

    @classmethod
    def of(
        cls, runs: Mapping[str, np.ndarray | None], *, noise_floor: float | None = None, **further: Any
    ) -> HeldOutErrors:
        """From normalised squared errors of the same values, shape ``(values,)``, by the names above.

        They are None where the simulation ran away (`siq.inference.trajectories.squared_errors`).
        """
        known = {name: each for name, each in runs.items() if each is not None}
        further |= {name: float(np.sqrt(each.mean())) for name, each in known.items()}
        return cls(
            noise_floor=noise_floor, values=max(map(len, known.values()), default=0),
            squares={name: in_blocks(each) for name, each in known.items()}, **further,
        )  # fmt: skip

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

    def _blocks(self, run: Run) -> tuple[float, ...] | None:
        return self.squares.get(self.better_without if run == "without" else run)

    def change(self, first: Run, second: Run) -> Change:
        """Whether the second of two simulations is better, by more than appears by chance."""
        return _change_between(self._blocks(first), self._blocks(second))

    @property
    def share_gained(self) -> float:
        """What was found gains, as a share of what could be gained down to the floor.

        A simulation that is off by more than the spread is no better than the recordings' mean.
        """
        if self.augmented is None or self.floor is None:
            return 0.0
        without = self.error("without")
        before = 1.0 if without is None else min(without, 1.0)
        return (before - self.augmented) / max(before - self.floor, 1e-300)

    def typical(self, run: Run) -> float | None:
        """The geometric mean of a simulation's errors in blocks; None where they are not known.

        One that lands in another well, or on another tooth, is off from there on, however right it is.
        """
        blocks = self._blocks(run)
        return float(np.exp(0.5 * np.log(positive(np.array(blocks))).mean())) if blocks else None

    def falls_typically(self, first: Run, second: Run) -> bool:
        """Whether the second of two simulations is better in most blocks, if not in the mean of all."""
        one, other = self._blocks(first), self._blocks(second)
        return bool(one and other) and typically_better(one or (), other or ())

    @property
    def no_better(self) -> bool:
        """Whether what was found foresees no better than what lacks it, neither in the mean nor typically."""
        without = self.error("without")
        if without is None or self.augmented is None:
            return without is not None
        return self.augmented >= without and not self.falls_typically("without", "augmented")

    @property
    def takes_most(self) -> bool:
        """Whether names take more than they leave of the squared errors, beyond the sensors' noise."""
        before, after = self.error("without"), self.augmented if self.named is None else self.named
        if before is None or after is None:
            return after is not None
        return before**2 - after**2 >= after**2 - (self.noise_floor or 0.0) ** 2

    def at_noise(self, run: Run, *, random: bool = False) -> bool:
        """Whether an error is that of measurement noise alone, or with the error of the model at random.

        The mean square of n independent values, in units of the variance, has the distribution χ²(n)/n.
        """
        error, floor = self.error(run), self.floor if random else self.noise_floor
        if error is None or floor is None:
            return False
        limit = scipy.stats.chi2.isf(ABOVE_BY_CHANCE, self.values) / self.values if self.values else 1.0
        return bool(error**2 <= limit * floor**2)


def _change_between(
    first: Sequence[float] | np.ndarray | None, second: Sequence[float] | np.ndarray | None
) -> Change:
    """Whether the second of two simulations is better, by mean squared errors of the same blocks of samples.

    They are None where the simulation ran away.
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
    limit = scipy.stats.t.isf(CHANGE_BY_CHANCE, count - 1) * deviation
    return "same" if abs(middle) <= limit else "better" if middle < 0 else "worse"


def in_blocks(squares: np.ndarray) -> tuple[float, ...]:
    """Mean squared errors of blocks of values that follow each other."""
    return tuple(float(each.mean()) for each in np.array_split(squares, max(min(BLOCKS, len(squares)), 1)))


def _refits_left_out(
    fit: Fit, learned: Measurements, *, noise: Noise, candidates: Iterable[MechanismCandidate] = (),
    shown: Measurements | None = None, budget: Budget | None = None,
) -> list[tuple[Fit, np.ndarray]] | None:  # fmt: skip
    """Fits without each part in turn, and their errors on it, see `errors_left_out`."""
    signed = {name for each in candidates for name in each.positive.intersection(each.amplitudes)}
    spread, found = np.nanvar(learned.outputs[scored_rows(learned)], axis=0), []
    for out, rest, rows in cross_validation_folds(learned):
        model, wrong = fit.model, {""}
        rest = rest if shown is None else replace(rest, outputs=shown.outputs[rows])
        try:
            while wrong:
                begin = replace(fit, x=fit.x[rows])
                again = fit_with_process_noise_as_needed(model, rest, begin, budget=budget)
                wrong = {p.name for p in again.model.parameters if p.name in signed and p.value < 0}
                if wrong:
                    LOGGER.info("without rows of one part, %s would be negative", ", ".join(sorted(wrong)))
                    model = model.held(wrong, zero=wrong)
            own = squared_errors(simulated(again, out, noise=noise, substeps=fit.substeps), out, spread)
        except NumericalFailure:
            return None
        # One that does not quite settle, as where a reading is cut off, is judged by what it predicts.
        if own is None or again.fault:
            return None
        found.append((again, own))
    return found


def errors_left_out(
    fit: Fit, learned: Measurements, *, noise: Noise, candidates: Iterable[MechanismCandidate] = (),
    budget: Budget | None = None,
) -> np.ndarray | None:  # fmt: skip
    """Normalised squared errors of free runs of the parts left out, one behind the other, ``(values,)``.

    The fit to all of the recordings is made again without each part, from where it is. Amplitudes of
    candidates that cannot be negative, and would be, are zero: the part left out may be the only one that
    tells of them.

    Returns
    -------
    numpy.ndarray or None
        None where a fit has no result, or a simulation runs away.
    """
    refits = _refits_left_out(fit, learned, noise=noise, candidates=candidates, budget=budget)
    return None if refits is None else np.concatenate([squares for _, squares in refits])


def typically_better(before: Sequence[float] | np.ndarray, after: Sequence[float] | np.ndarray) -> bool:
    """Whether errors of blocks fall, and not only in one in which a saddle point multiplies them.

    Other than `_change_between` this asks for the typical ratio of errors, not for that of their sums.
    """
    falls = np.log(np.maximum(before, np.finfo(float).tiny) / np.maximum(after, np.finfo(float).tiny))
    chance = scipy.stats.ttest_1samp(falls, 0.0, alternative="greater").pvalue
    return bool(chance < CHANGE_BY_CHANCE) and _change_between(before, after) != "worse"


def preferred_recalibration(
    card: Fit, refits: Sequence[tuple[Fit, Measurements]], learned: Measurements, *, noise: Noise
) -> Fit:
    """The fit whose free runs of parts left out are the best by more than appears by chance.

    Where the model is wrong a refit bends its parameters to the parts that it learned from, and may be far
    off elsewhere. So the simulation as it is stays, unless the parameters θ of a refit are farther from those
    of the card, θ₀, than they are from each other without one of the n parts (delete-one jackknife; Efron and
    Stein 1981, Ann. Stat. 9), and it foresees parts left out no worse. With the covariance C of p parameters
    the ratio

        (θ − θ₀)ᵀC⁻¹(θ − θ₀) / ((n − 1)/n · Σ (θᵢ − θ̄)ᵀC⁻¹(θᵢ − θ̄))

    has Fisher's distribution with p and, at the least, n − 1 degrees of freedom if nothing but the model's
    error moved them.

    Parameters
    ----------
    card
        With the parameters of the simulation as it is.
    refits
        Each with the recordings that it was shown, of which some samples may be missing; of those that are
        as good the first is preferred.
    learned, noise
        What is left out in turn, and how much is trusted in where free runs begin.
    """
    model = card.model.held([each.name for each in card.model.parameters])
    alone = errors_left_out(replace(card, model=model, noise=noise.without_process()), learned, noise=noise)
    chosen, least = card, None if alone is None else in_blocks(alone)
    for fit, shown in refits:
        known = _refits_left_out(fit, learned, noise=noise, shown=shown)
        free = list(fit.model.free)
        if known is None or not np.isfinite(fit.covariance).all():
            continue
        values = np.array([again.model.values[free] for again, _ in known])
        scale = positive(np.sqrt(np.diag(fit.covariance)))
        inverse = np.linalg.pinv(fit.covariance / np.outer(scale, scale), rcond=1e-9, hermitian=True)
        apart, among = (
            float(np.einsum("kp,pq,kq->", each / scale, inverse, each / scale))
            for each in ((fit.model.values - card.model.values)[None, free], values - values.mean(axis=0))
        )
        count = len(known)
        ratio = apart / max((count - 1) / count * among, np.finfo(float).tiny)
        squares = np.concatenate([each for _, each in known])
        moved = scipy.stats.f.sf(ratio, len(free), count - 1) < CHANGE_BY_CHANCE / len(refits)
        after = in_blocks(squares)
        if moved and (least is None or typically_better(least, after)):
            chosen, least = fit, after
    return chosen


def preferred_model(errors: Sequence[np.ndarray | None], parameters: Sequence[int]) -> int:
    """The place of the model that foresees parts left out best.

    Of those whose errors are larger by less than a tenth, and by no more than chance, it is one of the fewest
    parameters, and of these the first. Errors are squares over the recordings' variance, None where a fit has
    no result or runs away. Where the best of them foresees no better than the recordings' mean, as
    where runs take another way past a saddle point, they tell nothing, and it is the first.
    """
    known = {place: each for place, each in enumerate(errors) if each is not None}
    if not known:
        return 0
    least = min(known.values(), key=np.mean)
    if least.mean() >= 1.0:
        return min(known)
    alike = [
        place
        for place, each in known.items()
        if each is least
        or (
            NEARLY_ALL**2 * each.mean() <= least.mean()
            and _change_between(in_blocks(least), in_blocks(each)) != "worse"
        )
    ]
    return min(alike, key=lambda place: (parameters[place], place))


def predicts_better(without: np.ndarray | None, squares: np.ndarray | None, *, limit: float = 0.0) -> bool:
    """Whether squared errors are smaller than without a model, by more than chance or below a limit."""
    if squares is None:
        return False
    change = _change_between(None if without is None else in_blocks(without), in_blocks(squares))
    return change == "better" or bool(change == "same" and squares.mean() < limit)
