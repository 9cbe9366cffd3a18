"""D(x) beside a noisy sensor: its formula with the right errors, and a constant one given up rarely."""

from __future__ import annotations

import numpy as np
import pytest
import sympy

from siq.data.recordings import Recordings
from siq.inference.diffusion_model import InnovationLikelihood, _all_places
from siq.inference.kalman_filter import Noise, _mean_intensity
from siq.inference.library import candidate_library
from siq.inference.maximum_likelihood import Fit, fit_by_filter
from siq.inference.measurements import Measurements
from siq.inference.observation import ObservationModel
from siq.quasipotential.landscape import Landscape
from siq.systems.diffusion import Diffusion
from siq.workflow import pipeline
from siq.workflow.pipeline import PipelineSettings

STEP, STRENGTH, SENSOR = 0.02, 0.3, 0.1


def records(
    seed: int, *, slope: float = 0.0, sensor: float = SENSOR, samples: int = 1500, count: int = 6
) -> Recordings:
    """``dx = (x - x³) dt + √(0.3 (1 + slope x)) dW``, in the sense of Itô, seen by a noisy sensor."""
    draw = np.random.default_rng(seed)
    x, now = np.empty((samples, count)), np.sign(draw.standard_normal(count))
    for row in range(samples):
        x[row] = now
        for _ in range(10):
            strength = STRENGTH * np.maximum(1 + slope * now, 0.02)
            kick = np.sqrt(strength * STEP / 10) * draw.standard_normal(count)
            now = now + STEP / 10 * (now - now**3) + kick
    measured = x + sensor * draw.standard_normal(x.shape)
    return Recordings.from_arrays(STEP * np.arange(samples), measured.T[:, :, None], names=["x"])


def followed(recordings: Recordings) -> tuple[Fit, Measurements, InnovationLikelihood]:
    library = candidate_library(["x"], degree=3)
    view = ObservationModel(library, Diffusion.identity(1))
    data = view.measured(recordings, None)
    support = np.array([[0, 1], [0, 3]])
    fit = fit_by_filter(
        view.model(support, np.zeros(2)), data, x=view.states(data),
        noise=Noise(np.array([0.003]), np.array([0.5])), closure=False,
    )  # fmt: skip
    assert fit.converged
    return fit, data, InnovationLikelihood(library, fit, data)


def test_scores_are_the_derivatives_of_the_likelihood() -> None:
    _, _, seen = followed(records(1, slope=0.4, samples=200))
    chosen = _all_places(1, len(seen.terms))
    values, sensor = np.array([0.3, 0.02, 0.05]), np.array([0.012])
    _, score, _, _ = seen.reached(chosen, values, sensor)
    for place in range(4):
        change = np.zeros(4)
        change[place] = 1e-5
        up, down = (
            seen.reached(chosen, values + sign * change[:3], sensor * np.exp(sign * change[3]))[0]
            for sign in (1, -1)
        )
        assert score[place] == pytest.approx((up - down) / 2e-5, rel=1e-4)


def test_the_formula_is_found_with_its_errors_and_the_sensor_beside_it() -> None:
    scaled = []
    for seed in range(5):
        _, _, seen = followed(records(seed, slope=0.4))
        probability = seen.constant_probability()
        assert probability < 1e-6
        formula, sensor, covariance = seen.selected(false_terms=0.01, probability=probability)
        assert [str(term) for term in formula.terms] == ["1", "x"]
        scaled.append((formula.values - [STRENGTH, 0.4 * STRENGTH]) / formula.standard_errors)
        error = np.sqrt(covariance[2, 2])
        scaled.append(np.array([np.log(sensor[0] / SENSOR**2) / error]))
    together = np.concatenate(scaled)
    assert np.abs(together).max() < 3.5 and 0.5 < np.sqrt((together**2).mean()) < 1.6


def test_a_constant_noise_is_given_up_as_rarely_as_asked() -> None:
    found = [followed(records(seed, samples=300))[2].constant_probability() for seed in range(20)]
    assert sum(one < 0.05 for one in found) <= 4  # more with a probability of 0.3 %
    assert min(found) > 1e-4


def test_the_field_is_the_mean_over_what_is_known_of_the_state() -> None:
    x, y = sympy.symbols("x y", real=True)
    field = Diffusion.of_formulas((x, y), [[1 + x**2, x * y], [x * y, 2 + y**2]])
    point, spread = np.array([[0.3, -0.2]]), np.array([[[0.05, 0.01], [0.01, 0.08]]])
    found = _mean_intensity(field, point, spread, np.zeros(1))[0]
    assert found == pytest.approx(np.array([[1.09 + 0.05, -0.06 + 0.01], [-0.06 + 0.01, 2.04 + 0.08]]))
    # Forces of half an interval are a part of the spread in its middle; a third state is not driven.
    wider = np.zeros((1, 3, 3))
    found = _mean_intensity(field, np.array([[0.3, -0.2, 9.0]]), wider, np.array([0.1]))[0]
    assert found[0, 0] == pytest.approx(1.09 + 1.09 * 0.05) and not found[2].any()


def test_a_formula_that_is_no_covariance_somewhere_drives_nothing_there() -> None:
    x = sympy.Symbol("x", real=True)
    field = Diffusion.of_formulas((x,), [[1 + x]])
    assert _mean_intensity(
        field, np.array([[-1.5], [1.0]]), np.zeros((2, 1, 1)), np.zeros(2)
    ).ravel() == pytest.approx([0, 2])


def test_the_step_finds_d_of_the_state_beside_the_sensor() -> None:
    done = pipeline.identify_run(
        PipelineSettings(),
        records(3, slope=0.4, samples=2500),
        number=0,
    )
    assert done.result is not None and done.result.prediction.passed
    found = done.result
    assert [found.library.names[k] for _, k in found.support] == ["x", "x**3"]
    assert (np.abs(found.values - [1, -1]) < 3 * np.sqrt(np.diag(found.covariance))).all()
    assert found.noise is not None and found.constant_noise is None
    assert np.sqrt(done.result.sensor_variance) == pytest.approx([SENSOR], rel=0.03)
    strength = done.result.noise_strength
    assert strength is not None and 0 < strength[1] < 0.1 * strength[0]


@pytest.mark.slow
@pytest.mark.parametrize("sensor", [0.01, 0.04])  # 0.005 and 0.02 times the distance of the wells
def test_barriers_behind_d_of_the_state_and_a_noisy_sensor_are_right(sensor: float) -> None:
    landscape = Landscape.from_recordings(records(5, slope=0.4, sensor=sensor, samples=20_000))
    assert landscape.certificate is not None and landscape.certificate.certified
    assert landscape.noise is not None
    nodes, weights = np.polynomial.legendre.leggauss(60)
    for way in landscape.transitions:
        well = landscape.attractors[way.start].position[0]
        side, x = np.sign(well), np.sign(well) * (nodes + 1) / 2
        # U(0) - U(±1) = ∫ 2 f/D dx from the top to the well, in units of the noise.
        known = abs(weights @ (2 * (x - x**3) / (STRENGTH * (1 + 0.4 * x)))) / 2
        error = way.error / landscape.noise.intensity
        assert abs(way.barrier / landscape.noise.intensity - known) < 3 * error, side
