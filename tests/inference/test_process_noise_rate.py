"""The strength of process noise from residuals of a whole step, against linear systems, where it is exact."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm
from scipy.special import exprel

import siq
from siq.data.recordings import snapshot_pairs
from siq.errors import NumericalFailure
from siq.inference.diffusion_model import with_process_noise_rate
from siq.inference.identify import identify
from siq.inference.library import IdentificationOptions, field_library
from siq.inference.regression import identify_vector_field
from siq.numerics.integration import FlowMap
from siq.numerics.randomness import generator

SYSTEMS = {
    "one state, relaxing twice a second": (np.array([[-2.0]]), np.array([[0.25]])),
    "a spiral under correlated noise": (
        np.array([[-1.0, -3.0], [3.0, -2.0]]),
        np.array([[0.3, 0.1], [0.1, 0.2]]),
    ),
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_forces_of_a_linear_system_are_found_at_any_step(name: str) -> None:
    drift, forces = SYSTEMS[name]
    rng = np.random.default_rng(7)
    step, samples = 0.1, 60_000
    forward = expm(drift * step)
    forgotten = quad_vec(lambda s: expm(drift * s) @ forces @ expm(drift * s).T, 0, step)[0]
    kicks = rng.standard_normal((samples, len(drift))) @ np.linalg.cholesky(forgotten).T
    states = np.zeros((samples, len(drift)))
    for sample in range(1, samples):
        states[sample] = forward @ states[sample - 1] + kicks[sample]
    names = ["x", "y"][: len(drift)]
    recordings = siq.Recordings.from_arrays(np.arange(samples) * step, states[None], names=names)
    found = _forces(recordings)
    # Per time, the residuals themselves are short by up to a third here.
    assert np.abs(forgotten / step - forces).max() > 0.15 * np.abs(forces).max()
    # A variance of n residuals is known to 1/√(n/2): four standard errors.
    np.testing.assert_allclose(found, forces, atol=4 * np.sqrt(2 / samples) * np.abs(forces).max())


def test_a_simulation_forgets_nothing_within_its_own_step() -> None:
    rng = np.random.default_rng(7)
    step, samples = 0.1, 60_000
    states = np.zeros((samples, 1))
    for sample in range(1, samples):
        states[sample] = (1 - 2 * step) * states[sample - 1] + np.sqrt(0.25 * step) * rng.standard_normal(1)
    recordings = siq.Recordings.from_arrays(np.arange(samples) * step, states[None], names=["x"])
    assert _forces(recordings, integrator_step=step)[0, 0] == pytest.approx(
        0.25, rel=4 * np.sqrt(2 / samples)
    )


def _transition(step: float) -> tuple[np.ndarray, np.ndarray]:
    """States, and the probabilities of all of them a step later, of ``dx = (x - x³) dt + √0.25 dW``."""
    x = np.linspace(-2.5, 2.5, 501)
    width, half = x[1] - x[0], 0.125
    moved = ((x[1:] + x[:-1]) / 2 - ((x[1:] + x[:-1]) / 2) ** 3) * width / half
    rates = np.diag(half / width**2 / exprel(-moved), 1) + np.diag(half / width**2 / exprel(moved), -1)
    return x, expm(step * (rates - np.diag(rates.sum(axis=1))))


@pytest.mark.parametrize("step", [0.1, 0.2, 0.4])
def test_moments_of_a_coarse_step_are_those_of_the_transition_density(step: float) -> None:
    x, later = _transition(step)
    rows = np.arange(100, 401, 20)  # from -1.5 to 1.5
    mean = later[rows] @ x
    variance = later[rows] @ x**2 - mean**2
    flow, starts = FlowMap(8), x[rows][None]
    closed, spread = flow.moments(lambda x: x - x**3, starts, np.full(len(rows), step), np.array([[0.25]]))
    # The law is skewed, and the normal one only closes what follows from it: of third order in the step.
    np.testing.assert_allclose(closed[0], mean, atol=0.006 * np.sqrt(variance.min()))
    np.testing.assert_allclose(spread[:, 0, 0], variance, rtol=0.004 + step**3)


def test_a_well_that_relaxes_within_three_samples_has_its_own_terms() -> None:
    # Rate 2 in the wells, 6 beyond: of first order in the step f had a term x⁵, and D depended on x.
    step, pairs = 0.2, 20_000
    x, later = _transition(step)
    generator = np.random.default_rng(5)  # of seeds 4 to 8 it is so in all but the first
    whole = _transition(50.0)[1][250]
    start = generator.choice(len(x), pairs, p=whole / whole.sum())
    end = (generator.random(pairs)[:, None] > np.cumsum(later, axis=1)[start]).sum(axis=1)
    found_at = np.stack([x[start], x[np.minimum(end, len(x) - 1)]], axis=1)[:, :, None]
    recordings = siq.Recordings.from_arrays(np.array([0.0, step]), found_at, names=["x"])
    options = IdentificationOptions(degree=5)
    library, seen = field_library(["x"], options), snapshot_pairs(recordings)
    found = with_process_noise_rate(identify_vector_field(library, seen, options=options), seen)
    assert found.flow.coarse and [library.names[k] for _, k in found.support] == ["x", "x**3"]
    errors = np.sqrt(np.diag(found.covariance))
    assert (np.abs(found.values - [1.0, -1.0]) < 3 * errors).all()
    assert found.noise_rate[0, 0] == pytest.approx(0.25, rel=4 * np.sqrt(2 / pairs))


@pytest.mark.parametrize("seed", range(3))
def test_samples_that_know_nothing_of_each_other_are_no_motion(seed: int) -> None:
    # Any fast f explains white noise: it was certified as one well, without a barrier or a time.
    draw = np.random.default_rng(seed)
    values = 2.0 + 3.0 * draw.standard_normal((1, 2000, 1))
    recordings = siq.Recordings.from_arrays(0.1 * np.arange(2000), values, names=["x"])
    options = IdentificationOptions(degree=3)
    library = field_library(["x"], options)
    with pytest.raises(NumericalFailure, match="forgets where it was"):
        identify_vector_field(library, snapshot_pairs(recordings), options=options)


def _forces(recordings: siq.Recordings, *, integrator_step: float | None = None) -> np.ndarray:
    pairs = snapshot_pairs(recordings, pair_step=None)
    options = IdentificationOptions(degree=1)
    library = field_library(list(recordings.names), options)
    found = identify_vector_field(library, pairs, options=options, integrator_step=integrator_step)
    return with_process_noise_rate(found, pairs).noise_rate


@pytest.mark.parametrize("parts", [1, pytest.param(2, marks=pytest.mark.slow), 40])
def test_steps_of_a_simulation_are_known_by_their_noise(parts: int) -> None:
    # dx = (x - x³) dt + √0.25 dW by Euler's rule, each step or second a sample; or as good as continuous.
    step, x, samples = 0.06, np.linspace(-1.5, 1.5, 200), []
    draw = np.random.default_rng(7)
    for _ in range(200):
        samples.append(x)
        for _ in range(parts):
            x = x + (x - x**3) * step / parts + np.sqrt(0.25 * step / parts) * draw.standard_normal(len(x))
    recordings = siq.Recordings.from_arrays(
        step * np.arange(200), np.array(samples).T[:, :, None], names=["x"]
    )
    options = IdentificationOptions(degree=3)
    found = identify(recordings, options=options, draw=partial(generator, 0, 0))
    assert found.diagnosis is not None and found.noise is None
    of_rule = [one for one in found.diagnosis.remarks if one.code == "inference.simulated"]
    assert found.flow.euler == (parts < 3) == bool(of_rule)
    if of_rule:
        assert of_rule[0].values["step"] == pytest.approx(step / parts)
    assert (np.abs(found.values - [1.0, -1.0]) < 3 * np.sqrt(np.diag(found.covariance))).all()
