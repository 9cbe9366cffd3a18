"""The strength of process noise from residuals of a whole step, against linear systems, where it is exact."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm

import siq
from siq.data.recordings import snapshot_pairs
from siq.inference.diffusion_model import with_process_noise_rate
from siq.inference.library import IdentificationOptions, field_library
from siq.inference.regression import identify_vector_field

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


def _forces(recordings: siq.Recordings, *, integrator_step: float | None = None) -> np.ndarray:
    pairs = snapshot_pairs(recordings, pair_step=None)
    options = IdentificationOptions(degree=1)
    library = field_library(list(recordings.names), options)
    found = identify_vector_field(library, pairs, options=options, integrator_step=integrator_step)
    return with_process_noise_rate(found, pairs).noise_rate
