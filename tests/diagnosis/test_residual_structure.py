"""Rounding that can be seen explains what it does, and nothing else."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from siq.data.correlation import resolution_step
from siq.diagnosis.diagnosis import diagnose
from siq.diagnosis.dictionary import roles_of
from siq.diagnosis.residual_structure import (
    Remainder,
    explained_by_quantisation,
    remaining_forces,
)
from siq.diagnosis.study import MismatchVerdict, _measurements_of
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements, with_expectations
from siq.inference.recalibration import _before_rounding, recalibrate
from siq.remarks import sentence
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter, symbol

STEP, NOISE = 0.1, 0.012


def decaying(*, quadratic: float) -> Dynamics:
    x, rate, c = symbol("x"), symbol("rate"), symbol("c")
    parameters = (Parameter("rate", 0.8), *((Parameter("c", quadratic),) if quadratic else ()))
    return Dynamics(
        ("x",), (-rate * x - (c * x**2 if quadratic else 0),), Diffusion.identity(1), parameters=parameters
    )


def readings(*, quadratic: float, step: float = STEP) -> pd.DataFrame:
    """Six slow decays, read in steps eight times as wide as the noise."""
    rng, t, frames = np.random.default_rng(5), np.arange(0, 4, 0.05), []
    for place, begin in enumerate((1.1, 1.43, 1.78, 2.05, 2.49, 2.9)):
        over = np.exp(0.7 * t)
        # The exact solution of Bernoulli's equation x' = -0.7 x - c x².
        exact = begin / (over + quadratic * begin / 0.7 * (over - 1))
        read = exact + NOISE * rng.normal(size=len(t))
        read = step * np.rint(read / step) if step else read
        frames.append(pd.DataFrame({"recording": f"r{place}", "t": t, "x": read}))
    return pd.concat(frames)


def asked(model: Dynamics, data: Measurements) -> tuple[Fit, Remainder, tuple[str, ...]] | None:
    model = with_expectations(model)
    _, strict = recalibrate(model, data)
    return explained_by_quantisation(data, strict, roles_of(model))


def test_values_before_rounding_are_means_of_a_normal_distribution_cut_off() -> None:
    model = decaying(quadratic=0.0)
    data = _measurements_of(readings(quadratic=0.0), model)
    step = resolution_step(data.outputs[:, 0])
    assert step == pytest.approx(STEP)
    exact = np.concatenate(
        [b * np.exp(-0.7 * np.arange(0, 4, 0.05)) for b in (1.1, 1.43, 1.78, 2.05, 2.49, 2.9)]
    )[:, None]
    values, deviation = _before_rounding(data, exact, np.array([step]), np.array([NOISE]))
    left = (values.outputs - exact)[:, 0] / NOISE
    # Independent, about zero, and as the truth goes the noise comes out as it was.
    assert abs(left.mean()) < 4 * left.std() / np.sqrt(len(left))
    assert abs(left[1:] @ left[:-1]) < 4 * left @ left / np.sqrt(len(left))
    assert deviation == pytest.approx([NOISE], rel=0.15)
    row = int(np.abs(data.outputs[:, 0] - exact[:, 0]).argmax())
    low, high = ((data.outputs[row, 0] + side * STEP / 2 - exact[row, 0]) / NOISE for side in (-1, 1))
    expected = scipy.stats.norm.expect(lambda u: u, lb=low, ub=high, conditional=True)
    assert left[row] == pytest.approx(expected, rel=1e-6)


def test_the_right_simulation_is_cleared_and_a_wrong_one_is_not() -> None:
    model = decaying(quadratic=0.0)
    cleared = asked(model, _measurements_of(readings(quadratic=0.0), model))
    assert cleared is not None and cleared[2] == ("x",)
    assert cleared[0].model.values == pytest.approx([0.7], abs=0.005)
    assert asked(model, _measurements_of(readings(quadratic=0.1), model)) is None


def test_without_steps_there_is_nothing_to_explain() -> None:
    model = decaying(quadratic=0.0)
    assert asked(model, _measurements_of(readings(quadratic=0.0, step=0.0), model)) is None


@pytest.mark.slow
def test_a_diagnosis_raises_no_alarm_where_sensors_round() -> None:
    diagnosis = diagnose(decaying(quadratic=0.0), readings(quadratic=0.0))
    assert not diagnosis.verdict.mismatch or [each.name for each in diagnosis.mechanisms] == ["quantisation"]
    diagnosis = diagnose(decaying(quadratic=0.0), readings(quadratic=0.1))
    assert diagnosis.verdict is not MismatchVerdict.NO_MISMATCH


@pytest.mark.parametrize("lasts", [0.0, 0.8])
def test_what_remains_has_the_size_and_the_time_of_the_force_that_is_not_known(lasts: float) -> None:
    rng, t, size, step = np.random.default_rng(2), np.arange(0, 30, 0.05), 0.3, 0.05
    keep = np.exp(-step / lasts) if lasts else 0.0
    frames = []
    for place in range(4):
        x, force, values = 1.0 + 0.3 * place, size * rng.normal(), []
        for _ in t:
            values.append(x)
            x = x * np.exp(-0.7 * step) + force * (1 - np.exp(-0.7 * step)) / 0.7
            force = keep * force + size * np.sqrt(1 - keep**2) * rng.normal()
        read = np.array(values) + 0.0005 * rng.normal(size=len(t))
        frames.append(pd.DataFrame({"recording": f"r{place}", "t": t, "x": read}))
    model = with_expectations(decaying(quadratic=0.0))
    data = _measurements_of(pd.concat(frames), model)
    fit, _ = recalibrate(model, data)
    (remark,) = remaining_forces(fit, data, roles_of(model))
    values = remark.values
    assert values["state"] == "x" and values["size"] == pytest.approx(size, rel=0.25)
    if lasts:  # the integral of the autocorrelation over both sides
        assert values["lasts"] == pytest.approx(2 * lasts, rel=0.5)
        assert "at a time" in sentence(remark)
    else:
        assert values["samples"] < 2 and values["intensity"] == pytest.approx(size**2 * step, rel=0.2)
