"""From recordings to the certificate: an honest one that hops, and two that look like it."""

from __future__ import annotations

import numpy as np

from siq.data.recordings import Recordings
from siq.quasipotential.certificate import Certificate
from siq.workflow.pipeline import PipelineSettings, analyse

STEP, WITHIN = 0.05, 5
CLAIMS = {"one_system", "unchanged", "state_complete", "gaussian_increments", "connected", "times"}


def hopping(intensity: float, *, swing: float = 0.0, samples: int = 2500, recordings: int = 6) -> np.ndarray:
    """``dx = (x - x³ + swing cos(2πt/8)) dt + √ε dW``: shape ``(recordings, samples, 1)``."""
    generator, h = np.random.default_rng(5), STEP / WITHIN
    x, seen = np.where(np.arange(recordings) % 2, 1.0, -1.0), np.empty((recordings, samples, 1))
    for k in range(samples):
        seen[:, k, 0] = x
        for part in range(WITHIN):
            push = swing * np.cos(2 * np.pi * (k * STEP + part * h) / 8)
            kick = np.sqrt(intensity * h) * generator.standard_normal(recordings)
            x = x + h * (x - x**3 + push) + kick
    return seen


def certificate_of(values: np.ndarray) -> Certificate:
    recordings = Recordings.from_arrays(STEP * np.arange(values.shape[1]), values, names=["x"])
    found = analyse(recordings, PipelineSettings()).refined.certificate
    assert found is not None
    return found


def test_an_honest_record_that_hops_is_certified() -> None:
    found = certificate_of(hopping(0.25))
    assert found.certified and found.times_certified and not CLAIMS - set(found.tests)
    assert Certificate.from_data(found.as_data()) == found


def test_two_instruments_without_a_hop_are_no_landscape() -> None:
    values = hopping(0.05, samples=1500)
    values[::2] -= 0.3  # another offset
    found = certificate_of(values)
    assert not found.certified
    assert not found.tests["connected"].tested and not found.tests["one_system"].passed
    assert "no recording passed" in found.reason


def test_a_tilt_that_swings_is_no_landscape() -> None:
    found = certificate_of(hopping(0.25, swing=0.25))
    assert not found.certified and not found.tests["unchanged"].passed
