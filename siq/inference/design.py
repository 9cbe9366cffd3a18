"""Experiments that tell two models apart: which recording to take next.

Two fits that explain recordings alike differ elsewhere. An experiment is worth the logarithm of the odds that
it is expected to give: with the difference Δ of what the two foresee, in units of what free runs are off by,
the derivatives J of the model that is wrong by its parameters, and their covariance C from the recordings so
far,

    L = ½ min over δ of (|Δ - J δ|² / τ + δᵀ C⁻¹ δ),

since the wrong model is fitted to the new recording as well (T-optimality; Atkinson and Fedorov 1975,
Biometrika 62). Errors last for τ samples, of which one counts. Any of the models may be the right one: the
smallest L counts, of one against each other and of each other against it.

Experiments are first states within the domain of the card, or within where recordings were; or, for a system
with inputs, constant and periodic courses of one input within its recorded range, the others being at rest.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.interpolate
import scipy.stats

from siq.errors import NumericalFailure
from siq.inference.kalman_filter import Grid
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements, course_of_input
from siq.inference.trajectories import run
from siq.numerics.randomness import positive
from siq.remarks import Remark

FIRST_STATES = 64  # tried, evenly spread; a choice
PERIODS = 12  # tried of an input, from the whole recording to eight samples each; a choice
SAMPLES_PER_PERIOD = 8
MOST_LOG_ODDS = np.log(1e6)  # no model is believed more than that
NUDGE = 0.1  # numerical: of a standard error, for derivatives by a parameter
MOST_SAMPLES = 1000  # of a proposed recording: predictions of more are hardly better known

Plan = Mapping[str, Any]


def next_experiment(
    one: Fit, others: Sequence[Fit], data: Measurements, *, variance: np.ndarray, correlated: float,
    enough: float,
) -> Remark | None:  # fmt: skip
    """The experiment that is expected to tell a model from others best; None where nothing can be predicted.

    Parameters
    ----------
    one, others
        The models, fitted to the recordings, with as many states each.
    data
        The recordings; the proposed one is as long as the longest of them, and sampled alike.
    variance
        Of what free runs are off by, for each output; shape ``(m,)``.
    correlated
        How many samples such an error lasts, 1 at least.
    enough
        Logarithm of odds that suffice; of experiments that give them the one nearest to the recordings is
        taken.

    Returns
    -------
    Remark or None
        The plan, and ``odds``: those that it is expected to give for the model that is right. The plan has
        ``states``, the values to begin with by name, or the ``input`` with its ``level``, ``amplitude`` and
        ``period``, which is 0 for a constant course.
    """
    plans, proposed, begin = _plans(one, data)
    known, *further = ((fit, *_predicted(fit, proposed, begin)) for fit in (one, *others))
    usual, width = one.x[data.first[:-1]].mean(axis=0), positive(np.ptp(begin, axis=0))
    far = (((begin - usual) / width) ** 2).sum(axis=1)
    found: list[tuple[float, float, Plan]] = []
    rows, scale = np.split(np.arange(len(proposed.t)), proposed.first[1:-1]), np.sqrt(variance * correlated)
    for plan, own, distance in zip(plans, rows, far.tolist(), strict=True):
        gains = []
        pairs = (pair for each in further for pair in ((known, each), (each, known)))
        for (_, right, _), (fit, wrong, slopes) in pairs:
            apart = ((right[own] - wrong[own]) / scale).ravel()
            columns = (slopes[:, own] / scale).reshape(len(slopes), -1).T
            if not (np.isfinite(apart).all() and np.isfinite(columns).all()):
                break
            # In units of standard errors, so that what is expected of each change is of the size of one.
            errors = fit.standard_errors
            correlation = fit.covariance / np.outer(errors, errors)
            precision = columns.T @ columns + np.linalg.pinv(correlation, hermitian=True)
            overlap = columns.T @ apart
            gains.append(0.5 * float(apart @ apart - overlap @ np.linalg.solve(precision, overlap)))
        else:
            found.append((distance, min(gains), plan))
    if not found:
        return None
    # Of those that suffice the one that is most like what was recorded: models hold best near there.
    sufficient = [each for each in found if each[1] >= enough]
    if sufficient:
        _, gain, plan = min(sufficient, key=lambda each: (each[0], -each[1]))
    else:
        _, gain, plan = max(found, key=lambda each: each[1])
    return Remark("inference.next_experiment", dict(plan) | {"odds": float(np.exp(min(gain, MOST_LOG_ODDS)))})


def _plans(fit: Fit, data: Measurements) -> tuple[list[Plan], Measurements, np.ndarray]:
    """Experiments with their samples, each as a recording, and their first states ``(experiments, d)``."""
    model, lengths = fit.model, np.diff(data.first)
    count = min(int(lengths.max()), MOST_SAMPLES)
    step = float(np.median(data.step[data.begins]))
    t, seen = step * np.arange(count), np.stack([fit.x.min(axis=0), fit.x.max(axis=0)])
    limits = np.where(np.isfinite(model.limits.T), model.limits.T, seen)
    plans: list[Plan] = []
    courses: list[tuple[scipy.interpolate.PPoly, ...]] = []
    if model.inputs:
        signals = data.signals(data.t, data.recording, delays=()).inputs
        rest = np.median(signals, axis=1)
        lows, highs = np.quantile(signals, [0.0, 1.0], axis=1)
        own = [
            k for k, each in enumerate(model.inputs) if not each.name.startswith("_") and highs[k] > lows[k]
        ]
        periods = np.geomspace(SAMPLES_PER_PERIOD * step, step * count, PERIODS)
        waves = [(0.0, 0.0), (1.0, 0.0), *((0.5, period) for period in periods)]
        for k, (share, period) in itertools.product(own, waves):
            level, amplitude = lows[k] + share * (highs[k] - lows[k]), 0.5 * (highs[k] - lows[k])
            amplitude = amplitude if period else 0.0
            values = np.repeat(rest[:, None], count, axis=1)
            values[k] = level + amplitude * np.sin(2 * np.pi * t / (period or 1.0))
            courses.append(tuple(course_of_input(t, each, "linear") for each in values))
            entry = model.inputs[k]
            sizes = {"level": float(level), "amplitude": float(amplitude), "period": float(period)}
            plans.append({"input": entry.name, "unit": entry.unit, "time_unit": model.time_unit} | sizes)
        begin = np.repeat(fit.x[data.first[:-1]].mean(axis=0)[None], len(plans), axis=0)
    else:
        corners = np.array(list(itertools.product([0.0, 1.0], repeat=min(model.dimension, 6))))
        spread = scipy.stats.qmc.Halton(model.dimension, scramble=False).random(FIRST_STATES)
        shares = spread if corners.shape[1] < model.dimension else np.concatenate([corners, spread])
        begin = limits[0] + shares * (limits[1] - limits[0])
        units = dict(zip(model.states, model.units, strict=True))
        plans = [
            {"states": dict(zip(model.states, each.tolist(), strict=True)), "units": units} for each in begin
        ]
        courses = [()] * len(plans)
    proposed = replace(
        data, labels=tuple(str(k) for k in range(len(plans))), first=count * np.arange(len(plans) + 1),
        t=np.tile(t, len(plans)), outputs=np.zeros((count * len(plans), data.outputs.shape[1])),
        courses=tuple(courses),
    )  # fmt: skip
    return plans, proposed, begin


def _predicted(fit: Fit, proposed: Measurements, begin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outputs ``(n, m)`` that a fit foresees, and their changes by a standard error of each parameter."""
    grid = Grid(proposed, max(fit.substeps, 1))

    def outputs(values: np.ndarray) -> np.ndarray:
        model = fit.model.with_values(values)
        signals = proposed.signals(proposed.t, proposed.recording, delays=model.lags(values))
        with np.errstate(all="ignore"):
            x = run(model, grid, begin)
            return np.asarray(model.functions.outputs(np.ascontiguousarray(x.T), signals, values).T)

    values, errors = fit.model.values, fit.standard_errors
    if not (np.isfinite(errors).all() and (errors > 0).all()):
        raise NumericalFailure("the errors of its parameters are not known")
    still, slopes = outputs(values), []
    for place, error in zip(fit.model.free, errors, strict=True):
        nudged = values.copy()
        nudged[place] += NUDGE * error
        slopes.append((outputs(nudged) - still) / NUDGE)
    return still, np.array(slopes).reshape(len(slopes), *still.shape)
