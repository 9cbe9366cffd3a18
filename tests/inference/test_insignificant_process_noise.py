"""Process noise whose intensity has gone towards zero is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import sympy

from siq.diagnosis.study import comparison_of
from siq.inference.kalman_filter import Linearisation, Noise
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.inference.recalibration import (
    _simpler_fit,
    drop_insignificant_process_noise,
    fit_with_and_without_process_noise,
    recalibrate,
)
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter

RATE, STEP = 0.7, 0.1


def relaxations(*, driven: float) -> Measurements:
    """Ten relaxations with a noisy sensor, driven by process noise or not."""
    rng = np.random.default_rng(3)
    x, frames = rng.uniform(1, 3, size=10), []
    for row in range(60):
        frames.append(pd.DataFrame({"recording": [f"r{k}" for k in range(10)], "t": row * STEP, "x": x}))
        x = x * np.exp(-RATE * STEP) + driven * np.sqrt(STEP) * rng.normal(size=10)
    table = pd.concat(frames).sort_values(["recording", "t"], kind="stable")
    table["x"] += 0.01 * rng.normal(size=len(table))
    x_, rate = sympy.symbols("x rate", real=True)
    model = Dynamics(("x",), (-rate * x_,), Diffusion.identity(1), parameters=(Parameter("rate", 1.0),))
    return comparison_of(model, table).learn


def fitted(data: Measurements) -> Fit:
    x, rate = sympy.symbols("x rate", real=True)
    model = Dynamics(("x",), (-rate * x,), Diffusion.identity(1), parameters=(Parameter("rate", 1.0),))
    return recalibrate(model, data)[0]


def test_what_does_nothing_is_left_out() -> None:
    data = relaxations(driven=0.0)
    fit = fitted(data)
    assert not fit.has_process_noise
    idle = replace(fit, noise=Noise(fit.noise.measurement, np.array([1e-22])))
    without = drop_insignificant_process_noise(idle, data)
    assert without is not None and not without.has_process_noise
    assert without.log_likelihood == pytest.approx(idle.log_likelihood, abs=1e-3)


def test_what_would_be_far_likelier_without_its_noise_is_no_maximum(monkeypatch: pytest.MonkeyPatch) -> None:
    data = relaxations(driven=0.0)
    fit = fitted(data)
    idle = replace(fit, noise=Noise(fit.noise.measurement, np.array([1e-22])))
    known = iter([-5e52, -2e52])  # along a motion that grows beyond all numbers
    monkeypatch.setattr(Linearisation, "log_likelihood", lambda *_: next(known))
    assert drop_insignificant_process_noise(idle, data) is None


def test_what_drives_the_motion_is_kept() -> None:
    data = relaxations(driven=0.05)
    fit = fitted(data)
    assert fit.has_process_noise and drop_insignificant_process_noise(fit, data) is None


def test_idle_forces_are_not_believed_where_another_way_of_fitting_ends_lower() -> None:
    data = relaxations(driven=0.0)
    fit = fitted(data)
    idle = replace(fit, noise=Noise(fit.noise.measurement, np.array([1e-22])))
    loose, strict = fit_with_and_without_process_noise(fit.model, data, idle, settled=True)
    assert loose is idle and not _simpler_fit(loose, strict).has_process_noise
    assert strict.log_likelihood >= idle.log_likelihood - 1e-3
