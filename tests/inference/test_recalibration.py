"""Recalibration where steps at all samples at once lead away, elsewhere, or to and fro."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import sympy

from siq.diagnosis.study import _measurements_of
from siq.inference import maximum_likelihood, recalibration
from siq.inference.kalman_filter import Noise
from siq.inference.maximum_likelihood import Fit, _Shooting, fit_by_multiple_shooting
from siq.inference.measurements import Measurements
from siq.inference.trajectories import fit_trajectories, spread_edges
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Input, Parameter


def decays() -> tuple[Dynamics, Measurements]:
    """Three decays at a rate of 0.7, and a simulation that has it at 1."""
    n, r = sympy.symbols("n r", real=True)
    decay = Dynamics(("n",), (-r * n,), Diffusion.identity(1), parameters=(Parameter("r", 1.0),))
    t, generator = np.arange(0, 4, 0.1), np.random.default_rng(3)
    data = _measurements_of(
        pd.concat(
            pd.DataFrame(
                {"recording": str(k), "t": t, "n": k * np.exp(-0.7 * t) + generator.normal(0, 0.01, len(t))}
            )
            for k in (1.0, 2.0, 3.0)
        ),
        decay,
    )
    return decay, data


def test_a_fit_that_leads_away_is_made_again_by_damped_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    decay, data = decays()
    shooting = recalibration.fit_by_multiple_shooting

    def led_away(model: Dynamics, *given: Any, **named: Any) -> Fit:
        fit = shooting(model, *given, **named)
        return replace(fit, model=model.with_values(np.array([1e6])), converged=False, log_likelihood=-1e9)

    monkeypatch.setattr(recalibration, "fit_by_multiple_shooting", led_away)
    fit, exact = recalibration.recalibrate(decay, data)
    assert fit.converged and exact.converged and not fit.has_process_noise
    assert fit.model.values == pytest.approx([0.7], abs=0.01)
    assert np.sqrt(fit.noise.measurement) == pytest.approx([0.01], rel=0.2)


def test_of_two_basins_the_likelier_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    decay, data = decays()
    from_states_of_the_recordings = recalibration.fit_with_and_without_process_noise

    def elsewhere(model: Dynamics, *given: Any, **named: Any) -> tuple[Fit | None, Fit]:
        _, fit = from_states_of_the_recordings(model, *given, **named)
        far = replace(fit, model=model.with_values(np.array([9.0])), log_likelihood=fit.log_likelihood - 40)
        return None, far

    monkeypatch.setattr(recalibration, "fit_with_and_without_process_noise", elsewhere)
    fit, exact = recalibration.recalibrate(decay, data)
    assert not fit.has_process_noise
    assert [fit.model.values[0], exact.model.values[0]] == pytest.approx([0.7, 0.7], abs=0.01)


def test_a_fit_has_not_settled_while_it_foresees_more_than_it_has() -> None:
    decay, data = decays()
    x = data.outputs.copy()
    noise = Noise(np.array([1e-4]), np.zeros(1))
    fit = fit_by_multiple_shooting(decay, data, x=x, noise=noise, estimate_process=False)
    assert fit.converged

    def idle(self: _Shooting, now: Fit, change: np.ndarray) -> tuple[Fit, float]:
        return now, 1.0  # a whole step that does nothing of what it promised

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_Shooting, "stepped", idle)
        patch.setattr(maximum_likelihood, "_stands_still", lambda totals: False)
        stuck = fit_by_multiple_shooting(decay, data, x=x, noise=noise, estimate_process=False)
        settled = fit_by_multiple_shooting(fit.model, data, x=fit.x, noise=noise, estimate_process=False)
    assert not stuck.converged and settled.converged


def test_trajectories_are_not_followed_where_no_simulation_comes_near_the_sensor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Kicks a hundred times the sensor's noise: without process noise all is missed by as much."""
    decay, calm = decays()
    kicks = np.random.default_rng(5).normal(0, 0.3, len(calm.t)) * np.sqrt(0.1)
    pushed = replace(calm, outputs=calm.outputs + np.cumsum(kicks)[:, None])
    shooting, followed = recalibration.fit_by_multiple_shooting, recalibration.fit_trajectories
    calls = []

    def unsettled(model: Dynamics, *given: Any, **named: Any) -> Fit:
        fit = shooting(model, *given, **named)
        return fit if named["estimate_process"] else replace(fit, converged=False)

    def counted(*given: Any, **named: Any) -> Fit:
        calls.append(1)
        return followed(*given, **named)

    for data, expected in ((pushed, 0), (calm, 1)):
        begin = shooting(
            decay,
            data,
            x=data.outputs,
            noise=Noise(np.array([1e-4]), np.array([1e-2])),
            estimate_process=True,
        )
        with monkeypatch.context() as changed:
            changed.setattr(recalibration, "fit_by_multiple_shooting", unsettled)
            changed.setattr(recalibration, "fit_trajectories", counted)
            fit = recalibration.fit_with_process_noise_as_needed(decay, data, begin)
        assert sum(calls) == expected and fit.has_process_noise == (data is pushed)


def test_no_pole_is_put_among_the_states() -> None:
    """Of an enzyme that much substrate inhibits: what a fit without that asks for lies beyond a pole."""
    n, m, k = sympy.symbols("n m K", real=True)
    parameters = (Parameter("m", 1.0, expected=1.0), Parameter("K", 1.0, expected=1.0))
    enzyme = Dynamics(("n",), (-m * n / (k + n),), Diffusion.identity(1), parameters=parameters)
    t, generator, step = np.arange(0, 12, 0.1), np.random.default_rng(3), 0.005
    tables = []
    for begin in (2.0, 3.0, 4.0):
        course = [begin]
        for _ in range(round(12 / step)):
            s = course[-1]
            course.append(s - step * 2 * s / (0.1 + s + s**2))
        values = np.array(course)[:-1:20] + generator.normal(0, 0.02, len(t))
        tables.append(pd.DataFrame({"recording": str(begin), "t": t, "n": values}))
    data = _measurements_of(pd.concat(tables), enzyme)
    x = recalibration.first_states(enzyme, data)
    noise = Noise(np.full(1, 4e-4), np.zeros(1))
    damped = fit_trajectories(enzyme, data, begin=x[data.first[:-1]], noise=noise, substeps=4)
    for fit in (*recalibration.recalibrate(enzyme, data), damped):
        assert np.isfinite(fit.log_likelihood) and (fit.model.values > 0).all()
        assert (fit.model.values[1] + fit.x > 0).all()


@pytest.mark.parametrize("level", ["h", "Max(h, 0)", "Abs(h)"])
def test_a_tank_that_runs_empty_is_recalibrated(level: str) -> None:
    """A root begins with an infinite slope, however it is written, and noise brings levels below zero."""
    h, u, k, a = sympy.symbols("h u k a", real=True)
    outflow = a * sympy.sqrt(sympy.sympify(level, {"h": h}))
    parameters = (Parameter("k", 0.1), Parameter("a", 0.05))
    tank = Dynamics(
        ("h",), (k * u - outflow,), Diffusion.identity(1), parameters=parameters, inputs=(Input("u", "1"),)
    )
    generator, tables = np.random.default_rng(4), []
    for number in range(3):
        pumped, x, course = np.repeat(generator.choice([0.0, 0.3, 1.0], 12), 200), 0.5, []
        for now in pumped:
            course.append(x)
            x = max(x + 0.5 * (0.12 * now - 0.055 * np.sqrt(x)), 0.0)
        seen = np.array(course)[::10] + generator.normal(0, 0.01, 240)
        tables.append(
            pd.DataFrame({"recording": number, "t": 5.0 * np.arange(240), "h": seen, "u": pumped[::10]})
        )
    data = _measurements_of(pd.concat(tables), tank)
    assert (data.outputs < 0.02).mean() > 0.1
    fit, exact = recalibration.recalibrate(tank, data)
    assert exact.converged and not fit.has_process_noise
    assert exact.model.values == pytest.approx([0.12, 0.055], rel=0.01)
    never_empty = replace(data, outputs=data.outputs + 1.0)
    assert not spread_edges(tank, never_empty, never_empty.outputs, substeps=12).edges
    below_zero = replace(data, outputs=data.outputs - 1.0)
    assert len(spread_edges(tank, below_zero, below_zero.outputs, substeps=12).edges) == (level != "h")
