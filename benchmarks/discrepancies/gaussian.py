"""Gaussian processes of what a card leaves over of the derivatives, one for each equation.

Squared exponentials with a length for every state and input, and white noise; hyperparameters by the marginal
likelihood. The shortest length, in units of the range, tells the coordinate. Nothing is named.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from benchmarks.discrepancies.added import Kernel, Process, scaled
from benchmarks.discrepancies.answers import Answer
from benchmarks.discrepancies.refit import runs_better
from benchmarks.discrepancies.regression import (
    SURE,
    Equation,
    block_means,
    fitted,
    powers,
    sureness,
)
from benchmarks.discrepancies.sindy import WORSE, plain_equations, values_of
from benchmarks.discrepancies.states import SeenStates, seen_states
from siq.diagnosis.study import Comparison
from siq.inference.recalibration import recalibrate
from siq.systems.dynamics import Dynamics

TOLD = 300  # samples that tell the hyperparameters
POINTS = 800  # that the process is conditioned on, at most
STEPS = 40  # of the search for hyperparameters
LENGTHS = (0.1, 100.0)  # of squared exponentials, in deviations of the coordinate
Report = Callable[[Answer], None]


@dataclass(frozen=True)
class Fitted:
    """A process in one equation.

    Attributes
    ----------
    kernel
        Its mean; of a scaled target.
    evidence
        By how many standard errors it foresees parts left out better than the card.
    lengths
        Of each coordinate, in deviations of it.
    slopes
        Changes of the parameters that go with it, shape ``(p,)``.
    """

    kernel: Kernel
    evidence: float
    lengths: np.ndarray
    slopes: np.ndarray


def gaussian_process(case: Comparison, seconds: float, report: Report) -> Answer:
    """Fit processes to what the recalibrated card leaves of the derivatives of smoothing splines."""
    recalibrated, _ = recalibrate(case.system, case.learn)
    model = recalibrated.model
    seen = seen_states(model, case.learn)
    if seen is None:
        return Answer(
            applied=False, values=values_of(model), fault="a state cannot be had from what was measured"
        )
    report(Answer(values=values_of(model)))
    equations = plain_equations(model, case.learn, seen, powers(len(seen.coordinates), 0))
    found: list[Fitted] = []
    for equation in equations:
        found.append(_process(equation, seen, model))
        answer = _said(model, equations, found, seen)
        report(answer)
    if answer.added is not None:
        values = np.array([answer.values[each.name] for each in model.parameters])
        for mended in (model.with_values(values), model):
            if runs_better(
                model, mended, answer.added, case.learn, seen.first_states(case.learn, recalibrated)
            ):
                return answer.model_copy(update={"values": values_of(mended)})
        answer = answer.model_copy(update={"values": values_of(model), "added": None, "fault": WORSE})
    return answer


def _said(model: Dynamics, equations: list[Equation], found: list[Fitted], seen: SeenStates) -> Answer:
    first = max(range(len(found)), key=lambda k: found[k].evidence)
    if not found[first].evidence > SURE:
        return Answer(evidence=found[first].evidence, values=values_of(model))
    names = (*model.states, *(each.name for each in model.inputs))
    values = model.values
    kept = [one for one in found if one.evidence > SURE]
    # A parameter of several equations changes as in the one that shows most.
    for one in sorted(kept, key=lambda one: one.evidence):
        values[np.array(model.free, dtype=int)[one.slopes != 0]] = (
            model.values[list(model.free)] + one.slopes
        )[one.slopes != 0]
    middle, width = scales(seen)
    return Answer(
        detected=True,
        evidence=found[first].evidence,
        equations=tuple(model.states[one.kernel.equation] for one in kept),
        coordinates=(names[int(found[first].lengths.argmin())],),
        values=values_of(model.with_values(values)),
        added=Process(kernels=[one.kernel for one in kept], middle=middle.tolist(), width=width.tolist()),
    )


def scales(seen: SeenStates) -> tuple[np.ndarray, np.ndarray]:
    """Middle and deviation of states and inputs, shape ``(d + i,)`` each."""
    z = seen.coordinates[:, seen.inside]
    width = z.std(axis=1)
    return z.mean(axis=1), np.where(width > 0, width, 1.0)


def _process(equation: Equation, seen: SeenStates, model: Dynamics) -> Fitted:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    z = scaled(seen.coordinates[:, seen.inside], *scales(seen)).T
    _, slopes = fitted(equation, np.ones(len(z), dtype=bool), np.inf)
    target = equation.left - equation.parameters @ slopes
    size = float(target.std()) or 1.0
    y = target / size
    start = (
        ConstantKernel(0.3, (1e-4, 1e2)) * RBF(np.full(z.shape[1], 2.0), LENGTHS)
        + WhiteKernel(0.7, (1e-6, 10.0))
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a length ends at its bound is an answer
        rows = thinned(np.arange(len(z)), TOLD)
        told = GaussianProcessRegressor(start, optimizer=_searched).fit(z[rows], y[rows]).kernel_
        foreseen = np.zeros(len(z))
        for fold in np.unique(equation.fold):
            others = thinned(np.flatnonzero(equation.fold != fold), POINTS)
            out = equation.fold == fold
            if len(others):
                foreseen[out] = (
                    GaussianProcessRegressor(told, optimizer=None).fit(z[others], y[others]).predict(z[out])
                )
        rows = thinned(np.arange(len(z)), POINTS)
        final = GaussianProcessRegressor(told, optimizer=None).fit(z[rows], y[rows])
    evidence = sureness(block_means(y**2, equation.block), block_means((y - foreseen) ** 2, equation.block))
    lengths = np.atleast_1d(told.k1.k2.length_scale)
    kernel = Kernel(
        equation=equation.state,
        points=z[rows].tolist(),
        weights=(size * told.k1.k1.constant_value * final.alpha_).tolist(),
        lengths=lengths.tolist(),
    )
    return Fitted(kernel, evidence, lengths, slopes)


def thinned(rows: np.ndarray, most: int) -> np.ndarray:
    """At most so many of some rows, evenly."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(int)]


def _searched(
    objective: Callable[..., tuple[float, np.ndarray]], start: np.ndarray, bounds: np.ndarray
) -> tuple[np.ndarray, float]:
    """Hyperparameters by a search of few steps."""
    found = scipy.optimize.minimize(
        objective, start, jac=True, bounds=bounds, method="L-BFGS-B", options={"maxiter": STEPS}
    )
    return found.x, float(found.fun)
