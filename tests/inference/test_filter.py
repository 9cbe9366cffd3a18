"""The filter with both kinds of noise: unbiased at every ratio, and its errors are as large as it says."""

from __future__ import annotations

import numpy as np
import pytest
import sympy

from siq.data.recordings import Recordings
from siq.inference import kalman_filter
from siq.inference.identify import identify
from siq.inference.kalman_filter import ClosedFunctions, Noise
from siq.inference.library import IdentificationOptions
from siq.inference.maximum_likelihood import Fit, fit_by_filter, noise_uncertainty
from siq.inference.measurements import Measurements, measurements
from siq.systems.dynamics import Dynamics, Parameter, Signals

pytestmark = pytest.mark.portable

STEP, FORCES = 0.02, 0.3
WELLS = np.array([0.0, 1.0, 0.0, -1.0])  # x - x³, by powers


def polynomial(values: np.ndarray) -> Dynamics:
    """One state, whose f is a polynomial with free coefficients."""
    x = sympy.Symbol("x", real=True)
    names = [f"c{power}" for power in range(len(values))]
    formula = sum(sympy.Symbol(name, real=True) * x**power for power, name in enumerate(names))
    parameters = tuple(Parameter(name, float(value)) for name, value in zip(names, values, strict=True))
    return Dynamics(
        states=("x",),
        equations=(formula,),
        diffusion=Dynamics.of((x,), (x,)).diffusion,
        parameters=parameters,
    )


def double_well(seed: int, *, sensor: float, samples: int, records: int = 4) -> Recordings:
    """Records of dx = (x - x³) dt + √0.3 dW, with the variance of a sensor's noise."""
    generator = np.random.default_rng(seed)
    within = 10
    x = np.empty((samples, records))
    now = np.sign(generator.standard_normal(records))
    for row in range(samples):
        x[row] = now
        for _ in range(within):
            push = np.sqrt(FORCES * STEP / within) * generator.standard_normal(records)
            now = now + STEP / within * (now - now**3) + push
    x += np.sqrt(sensor) * generator.standard_normal(x.shape)
    return Recordings.from_arrays(STEP * np.arange(samples), x.T[:, :, None], names=["x"])


def fitted(recordings: Recordings, *, sensor: float) -> tuple[Fit, Measurements]:
    """From f = 0, and the noise as an expert would guess it."""
    model = polynomial(np.zeros(4))
    data = measurements(recordings, model)
    start = Noise(np.array([3 * sensor]), np.array([FORCES / 3]))
    return fit_by_filter(model, data, x=recordings.values, noise=start), data


@pytest.mark.parametrize("ratio", [0.1, 1.0, 10.0])
def test_coefficients_and_both_noises_are_found(ratio: float) -> None:
    sensor = ratio * FORCES * STEP
    fit, data = fitted(double_well(7, sensor=sensor, samples=2500), sensor=sensor)
    assert fit.converged
    measurement, process, covariance, _ = noise_uncertainty(fit, data)
    errors = np.sqrt(np.diag(covariance))
    assert (np.abs(fit.model.values - WELLS) < 3.5 * errors).all()
    assert (errors >= fit.standard_errors * (1 - 1e-9)).all()
    assert abs(np.log(fit.noise.measurement[0] / sensor)) < 3.5 * measurement[0]
    assert abs(np.log(fit.noise.process[0] / FORCES)) < 3.5 * process[0]


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.01, 0.1, 1.0, 10.0, 100.0])
def test_errors_cover_the_truth(ratio: float) -> None:
    """The bar is 90 to 98 % over 200 seeds of four coefficients."""
    sensor, inside = ratio * FORCES * STEP, []
    for seed in range(200):
        fit, data = fitted(double_well(1000 + seed, sensor=sensor, samples=2500), sensor=sensor)
        assert fit.converged
        errors = np.sqrt(np.diag(noise_uncertainty(fit, data)[2]))
        inside.append(np.abs(fit.model.values - WELLS) < 1.96 * errors)
    covered = np.mean(inside, axis=0)
    print(f"ratio {ratio}: covered {covered.round(3)}, {np.mean(inside):.3f}")
    assert 0.90 <= np.mean(inside) <= 0.98


def test_missing_samples_and_uneven_steps_are_no_matter() -> None:
    sensor = FORCES * STEP
    whole = double_well(3, sensor=sensor, samples=3000)
    kept = np.random.default_rng(0).random(len(whole.t)) < 0.7
    thinned = Recordings(
        whole.names, whole.units, whole.labels, whole.recording[kept], whole.t[kept], whole.values[kept]
    )
    fit, data = fitted(thinned, sensor=sensor)
    errors = np.sqrt(np.diag(noise_uncertainty(fit, data)[2]))
    assert fit.converged and (np.abs(fit.model.values - WELLS) < 3.5 * errors).all()
    # A sample that is there and says nothing is as good as none.
    said = np.where(kept[:, None], whole.values, np.nan)
    model = polynomial(np.zeros(4))
    silent = measurements(whole, model)
    silent = Measurements(silent.labels, silent.first, silent.t, said, silent.courses)
    filled = np.interp(np.arange(len(kept)), np.flatnonzero(kept), whole.values[kept, 0])[:, None]
    again = fit_by_filter(model, silent, x=filled, noise=fit.noise)
    assert again.converged
    np.testing.assert_allclose(again.model.values, fit.model.values, atol=0.3 * errors.min())


def test_the_closure_is_the_mean_over_a_spread() -> None:
    """For a cubic f and a Gaussian spread the second order is exact."""
    x, y = sympy.symbols("x y", real=True)
    system = Dynamics.of((x, y), (x - x**3 - x * y**2, -(1 + x**2) * y))
    generator = np.random.default_rng(1)
    root = np.array([[0.3, 0.0], [0.1, 0.2]])
    mean = np.array([[0.4], [-0.3]])
    nothing = Signals(np.zeros((0, 1)), np.zeros((0, 1)), np.zeros((0, 1)), np.zeros(1))
    closed = ClosedFunctions(system).at((root @ root.T)[None])
    exact = closed.rates(mean, nothing, np.zeros(0))[:, 0]
    # Gauss and Hermite's rule of five points is exact up to the ninth degree.
    nodes, weights = np.polynomial.hermite_e.hermegauss(5)
    weights = np.outer(weights, weights).ravel() / (2 * np.pi)
    deviations = np.stack(np.meshgrid(nodes, nodes, indexing="ij")).reshape(2, -1)
    values = system.drift((mean + root @ deviations).T)
    np.testing.assert_allclose(exact, weights @ values, rtol=1e-12)
    by_state, _ = closed.slopes(mean, nothing, np.zeros(0))
    step = 1e-6 * generator.standard_normal((2, 1))
    moved = closed.rates(mean + step, nothing, np.zeros(0))[:, 0] - exact
    np.testing.assert_allclose(moved, by_state[:, :, 0] @ step[:, 0], rtol=1e-4)


def test_correlated_forces_are_found_beside_a_sensor() -> None:
    generator = np.random.default_rng(5)
    rate, forces = np.diag([-1.0, -2.0]), np.array([[0.5, 0.3], [0.3, 0.4]])
    sensor, step, samples = np.array([4e-3, 1e-3]), 0.02, 20_000
    root = np.linalg.cholesky(forces * step / 10)
    x, now = np.empty((samples, 2)), np.zeros(2)
    pushes = generator.standard_normal((samples, 10, 2)) @ root.T
    for row in range(samples):
        x[row] = now
        for push in pushes[row]:
            now = now + step / 10 * rate @ now + push
    x += np.sqrt(sensor) * generator.standard_normal(x.shape)
    a, b = sympy.symbols("a b", real=True)
    x_, y_ = sympy.symbols("x y", real=True)
    model = Dynamics(
        states=("x", "y"), equations=(a * x_, b * y_), diffusion=Dynamics.of((x_, y_), (x_, y_)).diffusion,
        parameters=(Parameter("a", 0.0), Parameter("b", 0.0)),
    )  # fmt: skip
    recordings = Recordings.from_arrays(step * np.arange(samples), x, names=["x", "y"])
    data = measurements(recordings, model)
    start = Noise(np.full(2, 2e-3), np.ones(2), np.eye(2)[None])
    fit = fit_by_filter(model, data, x=x, noise=start)
    assert fit.converged
    assert (np.abs(fit.model.values - np.diag(rate)) < 3.5 * fit.standard_errors).all()
    np.testing.assert_allclose(fit.noise.intensity[0], forces, rtol=0.08)
    np.testing.assert_allclose(fit.noise.measurement, sensor, rtol=0.15)


def test_intervals_taken_some_at_a_time_give_the_same_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = FORCES * STEP
    recordings = double_well(5, sensor=sensor, samples=200)
    whole, _ = fitted(recordings, sensor=sensor)
    monkeypatch.setattr(kalman_filter, "INTERVALS", 37)
    parts, _ = fitted(recordings, sensor=sensor)
    assert whole.converged
    np.testing.assert_allclose(parts.model.values, whole.model.values, rtol=1e-9)
    np.testing.assert_allclose(parts.covariance, whole.covariance, rtol=1e-9)


def test_a_sensor_that_is_doubtful_is_no_answer_and_counts_in_the_error() -> None:
    """Of records without a noisy sensor the eleventh shows one by a little more than a standard error."""
    errors = []
    for seed in (0, 10):
        recordings = double_well(seed, sensor=0.0, samples=400)
        noise = identify(
            recordings, options=IdentificationOptions(), draw=lambda _: np.random.default_rng(0)
        ).diagnosis
        assert noise is not None and noise.intensity_error is not None and not noise.measurement.any()
        errors.append(noise.intensity_error / noise.intensity)
    assert errors[0] == pytest.approx(np.sqrt(2 / (4 * 399)), rel=0.05) and errors[1] > 1.3 * errors[0]
