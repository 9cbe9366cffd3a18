"""The fit of a simulation to recordings, against dense linear algebra and simulated truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import sympy

from siq.inference.kalman_filter import Grid, Linearisation, Noise, linearise, whiten
from siq.inference.maximum_likelihood import (
    Fit,
    _estimate_noise,
    first_noise,
    fit_by_multiple_shooting,
)
from siq.inference.measurements import (
    Measurements,
    course_of_input,
    expectations,
    first_states,
    with_expectations,
)
from siq.numerics.files import Document, validate
from siq.systems.cards import SystemCard, build_system
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter

pytestmark = pytest.mark.portable

OSCILLATOR = {
    "name": "oscillator",
    "time_unit": "s",
    "states": {"x": {"unit": "m", "domain": [-2, 2]}, "v": {"unit": "m/s", "domain": [-2, 2]}},
    "parameters": {"k": {"value": 1.3}, "d": {"value": 0.2}},
    "equations": {"x": "v", "v": "-k*x - d*v"},
    "outputs": {"x": "x"},
}
STEP = 0.25


def log_likelihood(line: Linearisation, data: Measurements, noise: Noise) -> float:
    return line.log_likelihood(data.first, data.step, noise)


def model_of(card: dict) -> Dynamics:
    document = Document("card.yaml", card, {})
    return build_system(document, validate(document, SystemCard))


def oscillations(
    *,
    recordings: int,
    samples: int,
    noise: float,
    seed: int,
    drive: float = 0.0,
    k: float = 1.0,
    d: float = 0.1,
) -> Measurements:
    """Free decays of a linear oscillator, sampled exactly; with process noise of the intensity `drive`."""
    generator = np.random.default_rng(seed)
    matrix = np.array([[0.0, 1.0], [-k, -d]])
    carry = scipy.linalg.expm(matrix * STEP)
    # Van Loan: the covariance that white noise on v adds in a step.
    block = np.block([[-matrix, np.diag([0.0, drive])], [np.zeros((2, 2)), matrix.T]]) * STEP
    covariance = carry @ scipy.linalg.expm(block)[:2, 2:]
    root = np.linalg.cholesky(covariance) if drive > 0 else np.zeros((2, 2))
    outputs, times = [], []
    for _ in range(recordings):
        x = generator.normal(size=2)
        for sample in range(samples):
            outputs.append([x[0] + noise * generator.normal()])
            times.append(sample * STEP)
            x = carry @ x + root @ generator.normal(size=2)
    return Measurements(
        labels=tuple(f"r{index}" for index in range(recordings)),
        first=np.arange(recordings + 1) * samples,
        t=np.array(times),
        outputs=np.array(outputs),
        courses=tuple(() for _ in range(recordings)),
    )


def fitted(data: Measurements, *, estimate_process: bool) -> Fit:
    model = model_of(OSCILLATOR)
    x = first_states(model, data)
    loose = fit_by_multiple_shooting(
        model, data, x=x, noise=first_noise(model, data, x), estimate_process=True
    )
    if estimate_process:
        return loose
    noise = loose.noise.without_process()
    return fit_by_multiple_shooting(loose.model, data, x=loose.x, noise=noise, estimate_process=False)


def test_states_are_read_off_sensors_with_a_gain_and_an_offset() -> None:
    data = oscillations(recordings=2, samples=12, noise=0.05, seed=1)
    parameters = {**OSCILLATOR["parameters"], "g": {"value": 2.0}, "o": {"value": 0.5}}
    model = model_of({**OSCILLATOR, "parameters": parameters, "outputs": {"y": "g*x + o"}})
    seen = replace(data, outputs=2 * data.outputs + 0.5)
    np.testing.assert_allclose(first_states(model, seen), first_states(model_of(OSCILLATOR), data))


@pytest.fixture(scope="module")
def linearised() -> tuple[Measurements, object, Noise]:
    data = oscillations(recordings=2, samples=12, noise=0.05, seed=1)
    data.outputs[5, 0] = np.nan
    model = model_of(OSCILLATOR)
    x = first_states(model, data) + 0.05
    return (
        data,
        linearise(model, Grid(data, 2), model.values, x),
        Noise(np.array([0.01]), np.array([0.0, 0.03])),
    )


def process_covariance(transition: np.ndarray, step: np.ndarray, intensity: np.ndarray) -> np.ndarray:
    """What noise adds over each interval, by Simpson's rule from Φ at its ends."""
    unit = np.eye(transition.shape[1])
    ends = [one @ intensity @ one.transpose(0, 2, 1) for one in (transition, transition + unit)]
    return (ends[0] + ends[1] + intensity) * (step / 6)[:, None, None]


def dense(data: Measurements, line: object, noise: Noise) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Deviation of outputs, its covariance, and columns of parameters and initial states, written out."""
    rows, dimension = line.gap.shape
    parameters = line.response.shape[2]
    step = np.append(np.diff(data.t), 0.0)
    process = process_covariance(line.transition, step, noise.intensity)
    mean = np.zeros((rows, dimension))
    columns = np.zeros((rows, dimension, parameters + len(data.labels) * dimension))
    spread = np.zeros((rows, dimension, rows, dimension))
    for place, (begin, end) in enumerate(zip(data.first[:-1], data.first[1:], strict=True)):
        at = parameters + place * dimension
        columns[begin, :, at : at + dimension] = np.eye(dimension)
        for k in range(begin, end - 1):
            mean[k + 1] = line.transition[k] @ mean[k] + line.gap[k]
            columns[k + 1] = line.transition[k] @ columns[k]
            columns[k + 1, :, :parameters] += line.response[k]
            spread[k + 1] = np.einsum("ij,jkl->ikl", line.transition[k], spread[k])
            spread[:, :, k + 1] = np.einsum("kli,ji->klj", spread[:, :, k], line.transition[k])
            spread[k + 1, :, k + 1] = line.transition[k] @ spread[k, :, k] @ line.transition[k].T + process[k]
            for before in range(begin, k + 1):
                spread[k + 1, :, before] = line.transition[k] @ spread[k, :, before]
                spread[before, :, k + 1] = spread[k + 1, :, before].T
    shown = np.einsum("ki,kic->kc", line.measured[:, 0], columns)
    shown[:, :parameters] += line.measured_response[:, 0]
    covariance = np.einsum("ki,kilj,lj->kl", line.measured[:, 0], spread, line.measured[:, 0])
    covariance += np.eye(rows) * noise.measurement[0]
    deviation = line.residual[:, 0] - np.einsum("ki,ki->k", line.measured[:, 0], mean)
    known = np.isfinite(deviation)
    return deviation[known], covariance[np.ix_(known, known)], shown[known]


def test_innovations_say_what_dense_least_squares_says(linearised) -> None:
    data, line, noise = linearised
    deviation, covariance, columns = dense(data, line, noise)
    root = np.linalg.cholesky(covariance)
    white, inputs = np.linalg.solve(root, deviation), np.linalg.solve(root, columns)
    estimate = np.linalg.lstsq(inputs, white, rcond=None)[0]
    total = float(((white - inputs @ estimate) ** 2).sum())
    found = whiten(line, data, noise)
    change = np.linalg.lstsq(found.columns, found.innovations, rcond=None)[0]
    np.testing.assert_allclose(change, estimate[:2], rtol=1e-7)
    assert ((found.innovations - found.columns @ change) ** 2).sum() == pytest.approx(total, rel=1e-8)
    assert found.log_determinant == pytest.approx(np.linalg.slogdet(covariance)[1], rel=1e-10)
    assert found.degrees_of_freedom == len(deviation) - 4


def test_the_likelihood_of_a_noise_is_restricted(linearised) -> None:
    data, line, noise = linearised
    deviation, covariance, columns = dense(data, line, noise)
    inverse = np.linalg.inv(covariance)
    initial = columns[:, 2:]
    estimate = np.linalg.solve(columns.T @ inverse @ columns, columns.T @ inverse @ deviation)
    left = deviation - columns @ estimate
    expected = left @ inverse @ left + np.linalg.slogdet(covariance)[1]
    expected += np.linalg.slogdet(initial.T @ inverse @ initial)[1]
    expected += (len(deviation) - 4) * np.log(2 * np.pi)
    assert log_likelihood(line, data, noise) == pytest.approx(-0.5 * expected, rel=1e-9)


def test_smoothed_states_are_the_conditional_means(linearised) -> None:
    data, line, noise = linearised
    begin = np.array([[0.1, -0.2], [0.0, 0.3]])
    process = process_covariance(line.transition, data.step, noise.intensity)
    still = line.with_parameters_changed(np.zeros(2))
    found, _, _ = still.smoothed(data.first, data.step, noise, begin)
    # The same minimum, written as least squares over all realisations of the process noise.
    rows = len(data.t)
    for place, (first, end) in enumerate(zip(data.first[:-1], data.first[1:], strict=True)):
        roots = [np.linalg.cholesky(process[k] + 1e-18 * np.eye(2)) for k in range(first, end - 1)]
        count = 2 * len(roots)

        def states(forces: np.ndarray, roots=roots, first=first, place=place) -> np.ndarray:
            x = [begin[place]]
            for index, root in enumerate(roots):
                k = first + index
                x.append(line.transition[k] @ x[-1] + line.gap[k] + root @ forces[2 * index : 2 * index + 2])
            return np.array(x)

        base = states(np.zeros(count))
        matrix = np.stack([states(unit) - base for unit in np.eye(count)], axis=2)
        shown = line.measured[first:end, 0]
        known = np.isfinite(line.residual[first:end, 0])
        design = np.einsum("ki,kic->kc", shown, matrix)[known] / np.sqrt(noise.measurement[0])
        target = (line.residual[first:end, 0] - np.einsum("ki,ki->k", shown, base))[known]
        target = target / np.sqrt(noise.measurement[0])
        forces = np.linalg.lstsq(
            np.vstack([design, np.eye(count)]), np.concatenate([target, np.zeros(count)]), rcond=None
        )[0]
        np.testing.assert_allclose(found[first:end], states(forces), atol=1e-6)
    assert rows == len(found)


def test_least_squares_where_nothing_is_random() -> None:
    data = oscillations(recordings=4, samples=60, noise=0.02, seed=2)
    found = fitted(data, estimate_process=False)
    assert found.converged
    assert abs(found.model.values - [1.0, 0.1]).max() < 4 * found.standard_errors.max()
    assert np.abs(found.linearisation.gap).max() < 1e-6
    assert np.sqrt(found.noise.measurement[0]) == pytest.approx(0.02, rel=0.15)


def test_standard_errors_cover_the_truth() -> None:
    inside = 0
    for seed in range(40):
        found = fitted(oscillations(recordings=3, samples=40, noise=0.05, seed=seed), estimate_process=False)
        inside += (np.abs(found.model.values - [1.0, 0.1]) < 1.96 * found.standard_errors).sum()
    assert 68 <= inside <= 80  # of 80; fewer than 68 has a probability of 3e-4 at 95 %


def test_random_forces_are_measured_and_do_not_bias_the_parameters() -> None:
    data = oscillations(recordings=10, samples=100, noise=0.02, seed=3, drive=0.04)
    found = fitted(data, estimate_process=True)
    assert found.noise.process[0] == 0  # x' = v holds by definition
    assert found.noise.process[1] == pytest.approx(0.04, rel=0.25)
    assert np.abs(found.model.values - [1.0, 0.1]).max() < 4 * found.standard_errors.max()


def test_the_search_for_noise_ends_where_the_likelihood_is_highest() -> None:
    data = oscillations(recordings=6, samples=60, noise=0.03, seed=4, drive=0.02)
    found = fitted(data, estimate_process=True)
    best = _estimate_noise(found.linearisation, data, found.noise, expected=expectations(found.model))
    top = log_likelihood(found.linearisation, data, best)
    for factor in (0.7, 1.4):
        assert log_likelihood(found.linearisation, data, best.scaled(factor)) < top
        wide = Noise(best.measurement * factor, best.process)
        assert log_likelihood(found.linearisation, data, wide) < top


def test_of_many_samples_some_tell_the_noise_and_all_correct_it() -> None:
    data = oscillations(recordings=6, samples=3000, noise=0.03, seed=4, drive=0.02)
    model = model_of(OSCILLATOR)
    x = first_states(model, data)
    line, start = linearise(model, Grid(data, 1), model.values, x), first_noise(model, data, x)
    work: list[float] = []
    expected = expectations(model)
    best = _estimate_noise(line, data, start, expected=expected, charge=work.append)
    rough = _estimate_noise(line, data, start, expected=expected, coarse=True)
    top = log_likelihood(line, data, best)
    assert log_likelihood(line, data, rough) < top
    assert rough.measurement == pytest.approx(best.measurement, rel=0.1)
    for factor in (0.99, 1.01):
        assert log_likelihood(line, data, best.scaled(factor)) < top
        assert log_likelihood(line, data, Noise(best.measurement * factor, best.process)) < top
    assert sum(each == 1.0 for each in work) <= 4 < sum(each < 0.6 for each in work)


def test_the_order_of_recordings_changes_nothing() -> None:
    data = oscillations(recordings=4, samples=40, noise=0.05, seed=5)
    there, back = (
        fitted(data, estimate_process=False),
        fitted(data.select([2, 0, 3, 1]), estimate_process=False),
    )
    np.testing.assert_allclose(there.model.values, back.model.values, rtol=1e-6)


def test_an_input_between_its_samples() -> None:
    t = np.arange(200) * 0.1
    u = np.sin(2 * np.pi * 1.1 * t) + 0.3 * np.cos(2 * np.pi * 2.3 * t)
    exact = np.sin(2 * np.pi * 1.1 * (t + 0.05)) + 0.3 * np.cos(2 * np.pi * 2.3 * (t + 0.05))
    inside = slice(30, 170)
    smooth = course_of_input(t, u, "band_limited")(t + 0.05)
    np.testing.assert_allclose(smooth[inside], exact[inside], atol=2e-3)
    linear = course_of_input(t, u, "linear")(t[:-1] + 0.05)
    np.testing.assert_allclose(linear, (u[1:] + u[:-1]) / 2, atol=1e-12)
    np.testing.assert_array_equal(course_of_input(t, u, "zero_order")(t[:-1] + 0.099), u[:-1])


def test_a_band_limited_input_needs_regular_sampling() -> None:
    with pytest.raises(ValueError, match="irregularly"):
        course_of_input(np.array([0.0, 1.0, 2.5, 3.0]), np.zeros(4), "band_limited")


def test_the_products_of_columns_are_eliminated_as_by_projection(linearised) -> None:
    data, line, noise = linearised
    total, _, freedom = line.sums(data.first, data.step, noise)
    white = whiten(line, data, noise)
    change = np.linalg.lstsq(white.columns, white.innovations, rcond=None)[0]
    assert total == pytest.approx(float(((white.innovations - white.columns @ change) ** 2).sum()), rel=1e-8)
    assert freedom == white.degrees_of_freedom


TUMOUR = {
    "name": "tumour",
    "time_unit": "d",
    "states": {"n": {"unit": "1", "domain": [0, 1000]}},
    "parameters": {"r": {"value": 0.116}, "K": {"value": 878.0}, "c": {"value": 0.0}},
    "equations": {"n": "r*n*(1 - n/K) - c*n*log(n**2)/2"},
    "outputs": {"n": "n"},
}


def growths(noise: float) -> Measurements:
    """Tumours of Gompertz's law, ``n' = 0.08 n ln(900/n)``, whose solution is known."""
    t, begins = np.arange(60.0), np.array([10.0, 30.0, 80.0, 200.0])
    n = np.concatenate([900 * (begin / 900) ** np.exp(-0.08 * t) for begin in begins])
    n += noise * np.random.default_rng(5).normal(size=len(n))
    return Measurements(
        labels=tuple("abcd"), first=60 * np.arange(5), t=np.tile(t, 4), outputs=n[:, None], courses=((),) * 4
    )


@pytest.mark.parametrize("expected", [False, True])
def test_a_capacity_that_does_not_matter_becomes_infinite(*, expected: bool) -> None:
    # r, K and c do nearly the same: a step that is straight in K, and long enough to matter, leads elsewhere.
    model, data = model_of(TUMOUR), growths(6.0)
    if expected:
        model = with_expectations(model.with_values(np.array([0.2, 800.0, 0.0])))
    model = model.with_values(np.array([0.116, 878.0, 0.0]))
    x = first_states(model, data)
    fit = fit_by_multiple_shooting(model, data, x=x, noise=first_noise(model, data, x), estimate_process=True)
    found = {each.name: each.value for each in fit.model.parameters}
    errors = dict(zip(found, np.sqrt(np.diag(fit.covariance)), strict=True))
    assert fit.converged and found["K"] > 1e5
    assert abs(found["c"] - 0.08) < 3 * errors["c"] and errors["c"] < 0.003
    assert fit.noise.measurement[0] == pytest.approx(36.0, rel=0.25)


def test_a_capacity_and_a_loss_are_expected_alike() -> None:
    x, b, capacity = sympy.symbols("x b K", real=True)
    t = np.arange(0, 2, 0.25)
    exact = np.exp(t) / (1 + np.exp(t))  # of x' = x - x²
    outputs = (exact + 0.1 * np.random.default_rng(2).normal(size=len(t)))[:, None]
    data = Measurements(labels=("a",), first=np.array([0, 8]), t=t, outputs=outputs, courses=((),))
    fits = []
    for rate, parameter in ((x - b * x**2, Parameter("b", 2.0)), (x - x**2 / capacity, Parameter("K", 0.5))):
        model = with_expectations(
            Dynamics(
                ("x",), (rate,), Diffusion.identity(1), domain=np.array([[0.0, 2.0]]), parameters=(parameter,)
            )
        )
        begin = first_states(model, data)
        noise = Noise(np.array([0.01]), np.zeros(1))
        fits.append(fit_by_multiple_shooting(model, data, x=begin, noise=noise, estimate_process=False))
    one, other = (each.model.values[0] for each in fits)
    assert all(each.converged for each in fits) and one == pytest.approx(1 / other, rel=1e-3)
    assert abs(one - 1) > 0.02  # the prior draws it towards 2
