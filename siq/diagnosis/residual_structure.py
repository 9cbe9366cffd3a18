"""Structure in residuals, and what remains of it once mechanisms are found.

What may be missing is described without naming it: in every equation a piecewise linear function of every
coordinate - a state, an input, the amplitude of a rotating frame, time - is let in, and the data say how
large it would be. It tells where a mismatch sits, and whether one is left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from siq.data.correlation import correlation_time_of
from siq.diagnosis.dictionary import Roles, roles_of, unit_of, units_of
from siq.diagnosis.screening import Projection, Ranked, linearised_with, portions
from siq.diagnosis.terms import Place, places_in
from siq.errors import NumericalFailure
from siq.inference.budget import Budget
from siq.inference.kalman_filter import Grid, Noise, solve, whiten
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.inference.recalibration import fit_before_rounding
from siq.remarks import Remark

LAGS = 12  # of autocorrelations


@dataclass(frozen=True)
class Structure:
    """What residuals show."""

    #: What is missing in an equation along a coordinate, for all of them, what explains most first: values at
    #: the knots, less what the parameters can do, in the unit of the equation, and the decrease of the sum of
    #: squared innovations.
    curves: tuple[Ranked[Place], ...]
    p_curves: float  #: probability that the best of them is chance, for as many as were tried
    p_autocorrelation: float  #: the same of innovations that are as correlated in time
    total: float  #: sum of squared innovations, at the measurement noise of the fit
    freedom: int  #: its degrees of freedom

    @property
    def p_value(self) -> float:
        """Probability that nothing is left."""
        return min(1.0, 2 * min(self.p_curves, self.p_autocorrelation))


def _structure_of(data: Measurements, fit: Fit, roles: Roles, *, noise: Noise | None = None) -> Structure:
    """Describe what a fit leaves."""
    places = places_in(fit.model, roles, data, fit.x, linear=True)
    noise = fit.noise if noise is None else noise
    parameters = len(fit.model.free)
    white = whiten(fit.linearisation, data, noise)
    problem = Projection.of(white, parameters)
    left, freedom, total = problem.left, problem.freedom, problem.total
    # Below its measurement noise a fit has no scale of its own; above it errors are as large as they are.
    scale = 1.0 if noise.process.any() or not fit.has_process_noise else max(total / freedom, 1.0)
    curves = []
    for some in portions(fit, data, places):
        response, groups = linearised_with(fit, data, some)
        columns = Projection.of(whiten(response, data, noise), parameters).columns
        for place, group in zip(some, groups, strict=True):
            own = columns[:, group]
            values, covariance = solve(own, left)
            gain = total - float(((left - own @ values) ** 2).sum())
            rank = int((np.linalg.svd(own, compute_uv=False) > 1e-9 * max(np.abs(own).max(), 1e-300)).sum())
            p_value = float(scipy.stats.chi2.sf(max(gain, 0.0) / scale, max(rank, 1)))
            errors = np.sqrt(np.diag(covariance) * scale)
            curves.append(Ranked(place, gain, 1.0, values, errors, finite=True, p_value=p_value))
    curves.sort(key=lambda each: -each.gain)
    best = min((each.p_value for each in curves), default=1.0)
    return Structure(
        curves=tuple(curves), p_curves=min(1.0, best * max(len(curves), 1)),
        p_autocorrelation=_autocorrelation(left, white.recording, white.known, len(fit.model.outputs)),
        total=total, freedom=freedom,
    )  # fmt: skip


def _autocorrelation(left: np.ndarray, recording: np.ndarray, known: np.ndarray, outputs: int) -> float:
    """Ljung–Box test over all recordings, output by output."""
    statistic, count = 0.0, 0
    series, whole = left.reshape(-1, outputs), known.reshape(-1, outputs)
    owner = recording.reshape(-1, outputs)[:, 0]
    for output in range(outputs):
        y = np.where(whole[:, output], series[:, output], 0.0)
        power, size = float(y @ y), int(whole[:, output].sum())
        if power == 0 or size < 4 * LAGS:
            continue
        for lag in range(1, LAGS + 1):
            same = owner[lag:] == owner[:-lag]
            correlation = float((y[lag:] * y[:-lag])[same].sum()) / power
            statistic += correlation**2 * size**2 / max(int(same.sum()), 1)
            count += 1
    return float(scipy.stats.chi2.sf(statistic, count)) if count else 1.0


STRUCTURED = 1e-4  # probability below which residuals are not called random
DOUBTFUL = 2e-3  # the same for what a mechanism leaves: the burden of proof is on a name
RANDOM_RESIDUALS = 0.01  # probability that residuals are random, above which no further mechanism is sought


@dataclass(frozen=True)
class Remainder:
    """Structure of what the recalibrated simulation, and the one with mechanisms, does not explain.

    The share is that of the excess over noise that the mechanisms explain.
    """

    before: Structure
    after: Structure
    share: float

    @property
    def structured(self) -> bool:
        """Whether what is left is certainly no noise, which speaks of a mismatch by itself."""
        return self.after.p_value < STRUCTURED

    @property
    def doubtful(self) -> bool:
        """Whether what is left is hardly noise: a name has to leave less than that."""
        return self.after.p_value < DOUBTFUL

    @classmethod
    def of(cls, data: Measurements, recalibrated: Fit, final: Fit, roles: Roles) -> Remainder:
        """Structure before and after mechanisms were added, and the share of the excess that they explain.

        Parameters
        ----------
        data
            The recordings.
        recalibrated, final
            The fit of the simulation, and that with mechanisms.
        roles
            Of the simulation's states.
        """
        after = _structure_of(data, final, roles)
        # Process noise that stands for missing physics takes measurement noise with it: take the final one.
        still = Noise(final.noise.measurement, np.zeros(recalibrated.model.dimension))
        before = _structure_of(data, recalibrated, roles, noise=still)
        alone = after
        if final.has_process_noise:
            alone = _structure_of(data, final, roles, noise=final.noise.without_process())
        if not before.total > before.freedom:
            return cls(before, after, 1.0)
        # What is left is the excess that remains, or what a function of one coordinate still finds: where a
        # fit without process noise takes a misfit for noise, only the latter shows it.
        best = alone.curves[0] if alone.curves else None
        left = max(alone.total - alone.freedom, 0.0 if best is None else best.gain - 2 * best.term.width, 0.0)
        return cls(before, after, float(np.clip(1 - left / (before.total - before.freedom), 0.0, 1.0)))


def remaining_forces(fit: Fit, data: Measurements, roles: Roles) -> list[Remark]:
    """What process noise stands in for: in each equation its size, how long it lasts, and where it shows.

    A force lasts as long as its autocorrelation, integrated over all lags; process noise proper lasts no
    longer than a sample. Sizes are those of the smoothed states, up to a fifth too small.
    """
    remainder = _structure_of(data, fit, roles)
    rows, step = data.begins, data.step[data.begins]
    forces = -fit.linearisation.gap[rows] / step[:, None]
    signals = Grid(data, fit.substeps).at_samples(fit.model.lags(fit.model.values))
    rates = fit.model.functions.rates(np.ascontiguousarray(fit.x.T), signals, fit.model.values).T
    units, unit_of_time, found = units_of(fit.model), fit.model.time_unit, []
    for place in np.flatnonzero(fit.noise.process > 0):
        name, force = fit.model.states[place], forces[:, place]
        there = (each for each in remainder.curves if each.term.targets == (name,))
        best = max(there, key=lambda each: each.gain, default=None) if remainder.p_curves < DOUBTFUL else None
        size = float(np.sqrt(np.mean(force**2)))
        lasts = correlation_time_of(force, data.recording[rows], outputs=1)
        values = {
            "state": name, "size": size,
            "unit": unit_of("_x/_t", {"_x": units.get(name, "1"), "_t": unit_of_time}),
            "share": size / max(float(np.sqrt(np.mean(rates[:, place] ** 2))), 1e-300),
            "intensity": float(fit.noise.process[place]),
            "intensity_unit": unit_of("_x**2/_t", {"_x": units.get(name, "1"), "_t": unit_of_time}),
            "samples": lasts, "lasts": lasts * float(np.median(step)), "time_unit": unit_of_time,
            "along": "" if best is None else best.term.words[0],
        }  # fmt: skip
        found.append(Remark("diagnosis.remains", values))
    return found


def has_structure(current: Fit, data: Measurements) -> bool:
    """Whether it is worth looking for something on top of a fit."""
    if current.has_process_noise:
        return True
    try:
        return _structure_of(data, current, roles_of(current.model)).p_value < RANDOM_RESIDUALS
    except NumericalFailure:  # a simulation that runs away lacks something, whatever it is
        return True


def explained_by_quantisation(
    data: Measurements, strict: Fit, roles: Roles, *, least: float = STRUCTURED, budget: Budget | None = None
) -> tuple[Fit, Remainder, tuple[str, ...]] | None:
    """The fit to the values that were rounded, if it leaves noise; None where it does not, or nothing rounds.

    Besides the fit without process noise it takes the least probability of structure by chance, below which
    what is left is no noise. With the fit (`siq.inference.recalibration.fit_before_rounding`) come what is
    left of the values, and the names of the outputs that are rounded.
    """
    before = fit_before_rounding(data, strict, budget=budget)
    if before is None:
        return None
    fit, values, names = before
    try:
        left = Remainder.of(values, fit, fit, roles)
    except NumericalFailure:
        return None
    return None if left.after.p_value < least else (replace(strict, model=fit.model, x=fit.x), left, names)
