"""Recalibration where steps at all samples at once lead away."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import sympy

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics, Parameter
from siq.estimation import recalibration
from siq.estimation.estimation import Fit
from siq.mismatch.study import measurements_of


def test_a_fit_that_leads_away_is_made_again_by_damped_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    n, r = sympy.symbols("n r", real=True)
    decay = Dynamics(("n",), (-r * n,), Diffusion.identity(1), parameters=(Parameter("r", 1.0),))
    t, generator = np.arange(0, 4, 0.1), np.random.default_rng(3)
    data = measurements_of(
        pd.concat(
            pd.DataFrame(
                {"recording": str(k), "t": t, "n": k * np.exp(-0.7 * t) + generator.normal(0, 0.01, len(t))}
            )
            for k in (1.0, 2.0, 3.0)
        ),
        decay,
    )
    shooting = recalibration.fit_by_multiple_shooting

    def led_away(model: Dynamics, *given: Any, **named: Any) -> Fit:
        fit = shooting(model, *given, **named)
        return replace(fit, model=model.with_values(np.array([1e6])), converged=False, log_likelihood=-1e9)

    monkeypatch.setattr(recalibration, "fit_by_multiple_shooting", led_away)
    fit, exact = recalibration.recalibrate(decay, data)
    assert fit.converged and exact.converged and not fit.has_process_noise
    assert fit.model.values == pytest.approx([0.7], abs=0.01)
    assert np.sqrt(fit.noise.measurement) == pytest.approx([0.01], rel=0.2)
