"""official_tests"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from benchmarks.publication.public_recordings import Benchmark
from siq.inference.kalman_filter import Noise
from siq.inference.measurements import Measurements
from siq.inference.trajectories import free_run, scored_rows
from siq.systems.dynamics import Dynamics

EXACT = 1e-3  # relative change of an error by halving the steps of the integration, below which they are fine
FINEST = 64  # Runge-Kutta steps between samples


@dataclass(frozen=True)
class ScoredRun:
    """A free run over a recording of which a simulation was told no more than how it begins.

    Attributes
    ----------
    simulated
        Outputs, shape ``(n, m)``; NaN from where the simulation ran away.
    errors
        Root mean square error of each output behind what it was told, in its unit, shape ``(m,)``.
    """

    simulated: np.ndarray
    errors: np.ndarray


def scored_run(model: Dynamics, data: Measurements, *, variance: np.ndarray, window: int) -> ScoredRun:
    """Simulate a recording and score it, as official tests of benchmarks ask for.

    Parameters
    ----------
    model
        With the parameters' values to be used.
    data
        One recording.
    variance
        Of the measurement noise, shape ``(m,)``: how outputs weigh when the initial state is estimated.
    window
        Samples at the begin that tell the initial state. They are not scored.
    """
    noise = Noise(np.asarray(variance, dtype=float), np.zeros(model.dimension))
    substeps, before, scored = 2, np.inf, scored_rows(data, window)
    while True:
        run = free_run(model, data, noise=noise, substeps=substeps, told=window)
        with np.errstate(all="ignore"):  # what ran away has no error
            squares = (run[scored] - data.outputs[scored]) ** 2
        measured = np.isfinite(data.outputs[scored])
        errors = np.sqrt([squares[known, place].mean() for place, known in enumerate(measured.T)])
        total = float(np.sqrt((errors**2 / noise.measurement).sum()))
        if abs(total - before) <= EXACT * total or 2 * substeps > FINEST:
            return ScoredRun(run, errors)
        substeps, before = 2 * substeps, total


SCORED = "root mean square error of a free run; its initial state from the first {window} samples, not scored"


def official_tables(
    benchmark: Benchmark, models: Mapping[str, Dynamics], data: Measurements, *, variance: np.ndarray
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Run simulations over the tests of a benchmark.

    Parameters
    ----------
    benchmark
        What its tests are.
    models
        Simulations by what they are called.
    data
        The recordings of the tests, at least.
    variance
        Of the measurement noise, shape ``(m,)``: how outputs weigh when an initial state is estimated.

    Returns
    -------
    pandas.DataFrame, pandas.DataFrame
        Errors, ours and published ones, with columns ``test simulation output error unit scored source``; and
        the runs, with columns ``test output t measured scored`` and one for each simulation.
    """
    errors, runs = [], []
    for test, asked in benchmark.tests.items():
        one = data.select([data.labels.index(test)])
        scored = SCORED.format(window=asked.window)
        simulated: dict[str, np.ndarray] = {}
        outputs: tuple[str, ...] = ()
        for name, model in models.items():
            run = scored_run(model, one, variance=variance, window=asked.window)
            simulated[name], outputs = run.simulated, model.output_names
            errors += [
                {
                    "test": test, "simulation": name, "output": output, "error": benchmark.factor * error,
                    "unit": benchmark.unit, "scored": scored, "source": "this table",
                }
                for output, error in zip(outputs, run.errors, strict=True)
            ]  # fmt: skip
        errors += [
            {
                "test": test, "simulation": each.method, "output": "", "error": each.error,
                "unit": benchmark.unit, "scored": each.scored, "source": each.source,
            }
            for each in asked.published
        ]  # fmt: skip
        runs += [
            pd.DataFrame(
                {
                    "test": test, "output": output, "t": one.t, "measured": one.outputs[:, place],
                    "scored": np.arange(len(one.t)) >= asked.window,
                    **{name: states[:, place] for name, states in simulated.items()},
                }
            )
            for place, output in enumerate(outputs)
        ]  # fmt: skip
    return pd.DataFrame(errors), pd.concat(runs, ignore_index=True)
