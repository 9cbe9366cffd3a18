"""Official tests of public benchmarks: how far are simulations off, and what did others reach?"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from siq.data.public_recordings import Benchmark
from siq.dynamics.dynamics import Dynamics
from siq.estimation.measurements import Measurements
from siq.mismatch.scores import scored_run

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
