"""A sensor whose own noise lasts some samples: it is in what is recorded, and not in the state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
import sympy

from benchmarks.hostile.records import STEP, Scene, double_wells, relaxation
from siq.data.preparation import in_stretches
from siq.data.recordings import Recordings
from siq.inference.field_estimate import FieldEstimate
from siq.inference.kalman_filter import Noise
from siq.inference.kalman_identification import filtered_recordings
from siq.inference.library import IdentificationOptions
from siq.inference.maximum_likelihood import fit_by_filter
from siq.inference.observation import ObservationModel, unbroken
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.workflow.pipeline import PipelineSettings, identify_run

TIME, SIZE, INTENSITY = 0.5, 0.2, 0.25
SETTINGS = PipelineSettings(identification=IdentificationOptions(degree=3))


def recorded(noise: str, *, unit: float = 1.0) -> tuple[Recordings, np.ndarray]:
    """A double well behind a sensor, and its states ``(n,)``."""
    draw = np.random.default_rng(1)
    scene = Scene(0.5 / INTENSITY, 0.0, 1.0, 0.0, 1.0, 1, 20_000)
    x = double_wells(draw, scene, 1)[0][::10]
    slow = relaxation(draw, len(x), TIME, step=STEP)
    added = {"slow": SIZE * slow, "white": SIZE / 2 * draw.standard_normal(len(x)), "none": 0.0}[noise]
    values = unit * (x + added)[:, None]
    recordings = Recordings.from_arrays([scene.times], [values], names=["x"], time_unit="s")
    return in_stretches(recordings), unit * x


def identified(recordings: Recordings) -> FieldEstimate:
    found = identify_run(SETTINGS, recordings, number=0).result
    assert found is not None
    return found


def test_its_noise_is_told_from_the_state() -> None:
    recordings, x = recorded("slow")
    found = identified(recordings)
    assert found.slow_sensor is not None and found.diagnosis is not None
    size, time, error = found.slow_sensor
    assert abs(time - TIME) < 3 * error < TIME and abs(size - SIZE) < 0.2 * SIZE
    assert found.library.states == ("x",) and not found.hidden_states
    # dx = (x - x³) dt + √ε dW, and not the noise that differences of samples have.
    errors = np.sqrt(np.diag(found.covariance))
    terms = [str(found.library.terms[place]) for place in found.support[:, 1]]
    assert set(terms) >= {"x", "x**3"}
    for term, true in (("x", 1.0), ("x**3", -1.0)):
        assert abs(found.values[terms.index(term)] - true) < 3 * errors[terms.index(term)]
    strength, spread = found.noise_strength or (np.nan, np.nan)
    assert abs(strength - INTENSITY) < 3 * spread
    assert np.diff(recordings.values[:, 0]).var() / STEP > 1.3 * INTENSITY
    assert [one.code for one in found.diagnosis.remarks] == ["inference.slow_sensor"]
    states = filtered_recordings(found, recordings)
    assert states.names == ("x",)
    assert np.std(states.values[:, 0] - x) < 0.9 * SIZE
    view = ObservationModel.of(found)
    assert view.sensor_time == time and view.gain(found, recordings, pair_step=None) > 10


@pytest.mark.slow
def test_a_sensor_with_white_noise_has_none() -> None:
    found = identified(recorded("white")[0])
    assert found.slow_sensor is None and found.sensor_variance is not None


def test_where_it_may_as_well_be_white_nothing_is_certified(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ObservationModel, "gain", lambda *_, **__: -1.0)  # odds of 2.7 to 1
    found = identified(recorded("slow")[0])
    assert found.slow_sensor is not None and found.prediction is not None
    assert not found.prediction.passed and found.prediction.reason


@pytest.mark.slow
def test_a_stage_that_wanders_is_told_from_what_it_carries() -> None:
    recordings, x = recorded("none")
    wandered = np.cumsum(np.random.default_rng(3).standard_normal(len(x))) * 0.4 / np.sqrt(len(x))
    found = identified(replace(recordings, values=recordings.values + wandered[:, None]))
    assert found.slow_sensor is not None and found.slow_sensor[1] > 1000 * STEP
    # Where the stage is in the mean is not known: of a shifted f the highest power is the same.
    assert str(found.library.terms[found.support[-1, 1]]) == "x**3"
    assert abs(found.values[-1] + 1) < 3 * np.sqrt(found.covariance[-1, -1])


@pytest.mark.slow
def test_units_change_nothing_but_units() -> None:
    one, other = (identified(recorded("slow", unit=unit)[0]).slow_sensor for unit in (1.0, 300.0))
    assert one is not None and other is not None
    assert (other[0] / 300, other[1]) == pytest.approx((one[0], one[1]), rel=0.02)


def test_what_is_stationary_begins_as_noise_leaves_it() -> None:
    """The likelihood of noise alone is that of a normal distribution with its correlations."""
    draw, rate, sensor, intensity = np.random.default_rng(2), 0.7, 0.04, 0.3
    t = np.cumsum(np.full(40, 0.05))
    z = sympy.Symbol("z", real=True)
    model = Dynamics(("z",), (-rate * z,), Diffusion.identity(1), outputs=(("z", z),))
    values = [draw.standard_normal((len(t), 1)) for _ in range(2)]
    data = unbroken(Recordings.from_arrays([t, t], values, names=["z"]))
    fit = fit_by_filter(
        model, replace(data, stationary=(0,)), x=np.zeros_like(data.outputs),
        noise=Noise(np.array([sensor]), np.array([intensity])), estimate_process=False,
        estimate_sensor=False,
    )  # fmt: skip
    apart = np.exp(-rate * np.abs(t[:, None] - t))
    covariance = intensity / (2 * rate) * apart + sensor * np.eye(len(t))
    true = scipy.stats.multivariate_normal(cov=covariance)
    expected = sum(true.logpdf(one[:, 0]) for one in values)
    assert fit.restricted_likelihood(data) == pytest.approx(expected, rel=1e-4)
