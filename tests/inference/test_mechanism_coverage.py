"""The errors of mechanisms' parameters cover the truth, at every ratio of the two noises."""

from __future__ import annotations

import numpy as np
import pytest
import sympy

from siq.data.recordings import Recordings
from siq.inference.measurements import measurements
from siq.inference.recalibration import (
    covariance_with_unknown_process_noise,
    fit_with_and_without_process_noise,
    fit_with_process_noise_as_needed,
    recalibrate,
)
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter

STEP, STIFFNESS, DAMPING, CUBIC = 0.25, 1.0, 0.3, 0.5
RATIOS = [0.01, 0.1, 1.0, 10.0, 100.0]


def oscillator(*, mechanism: bool) -> Dynamics:
    """The card, with the cubic stiffness that it lacks or without."""
    x, v, k, d, c = sympy.symbols("x v k d c", real=True)
    values = [Parameter("k", 0.8), Parameter("d", 0.4), *([Parameter("c", 0.0)] if mechanism else [])]
    return Dynamics(
        ("x", "v"), (v, -k * x - d * v - (c * x**3 if mechanism else 0)), Diffusion.identity(2),
        parameters=tuple(values), outputs=(("x", x), ("v", v)),
    )  # fmt: skip


def recorded(seed: int, *, forces: float, sensor: float, samples: int, records: int) -> Recordings:
    """Both states of hardening oscillators under process noise, each with a sensor's variance."""
    generator = np.random.default_rng(seed)
    within = 40
    h = STEP / within
    phase = generator.uniform(0, 2 * np.pi, size=records)
    x, v = 1.5 * np.cos(phase), 1.5 * np.sin(phase)
    seen = np.empty((records, samples, 2))
    for row in range(samples):
        seen[:, row, 0], seen[:, row, 1] = x, v
        for _ in range(within):
            push = np.sqrt(forces * h) * generator.standard_normal(records)
            # Heun's rule, with the same push in both of its halves.
            first = v, -STIFFNESS * x - DAMPING * v - CUBIC * x**3
            y, w = x + h * first[0], v + h * first[1] + push
            second = w, -STIFFNESS * y - DAMPING * w - CUBIC * y**3
            x, v = x + h / 2 * (first[0] + second[0]), v + h / 2 * (first[1] + second[1]) + push
    seen += np.sqrt(sensor) * generator.standard_normal(seen.shape)
    return Recordings.from_arrays(STEP * np.arange(samples), seen, names=["x", "v"])


def covered(seeds: range, *, ratio: float, samples: int, records: int) -> np.ndarray:
    """Which of the parameters k, d, c lie within 95 % of the truth: shape ``(seeds, 3)``.

    The sensors' standard deviation is at most a fifteenth of the motion: the errors are those of a
    linearisation, and a sensor that hides the motion leaves nothing to linearise about.
    """
    forces = min(0.05, 0.01 / (ratio * STEP))
    inside = []
    for seed in seeds:
        recordings = recorded(
            seed, forces=forces, sensor=ratio * forces * STEP, samples=samples, records=records
        )
        data = measurements(recordings, oscillator(mechanism=False))
        recalibrated, _ = recalibrate(oscillator(mechanism=False), data)
        model = oscillator(mechanism=True).with_values(np.append(recalibrated.model.values, 0.0))
        fit = fit_with_process_noise_as_needed(model, data, recalibrated)
        errors = np.sqrt(np.diag(covariance_with_unknown_process_noise(fit, data)))
        inside.append(np.abs(fit.model.values - [STIFFNESS, DAMPING, CUBIC]) < 1.96 * errors)
    return np.array(inside)


def test_what_few_samples_do_not_rule_out_belongs_to_the_errors() -> None:
    """Forces are there that 40 samples do not prove: errors that leave them out cover too little."""
    recordings = recorded(3, forces=0.04, sensor=0.01, samples=40, records=1)
    data = measurements(recordings, oscillator(mechanism=False))
    recalibrated, _ = recalibrate(oscillator(mechanism=False), data)
    model = oscillator(mechanism=True).with_values(np.append(recalibrated.model.values, 0.0))
    _, strict = fit_with_and_without_process_noise(model, data, recalibrated)
    assert not strict.has_process_noise
    errors = np.sqrt(np.diag(covariance_with_unknown_process_noise(strict, data)))
    assert (errors > 1.3 * strict.standard_errors).all()


def test_without_random_forces_many_samples_leave_the_errors_nearly_as_they_are() -> None:
    recordings = recorded(1, forces=0.0, sensor=1e-4, samples=400, records=5)
    data = measurements(recordings, oscillator(mechanism=True))
    fit, _ = recalibrate(oscillator(mechanism=True), data)
    assert not fit.has_process_noise
    errors = np.sqrt(np.diag(covariance_with_unknown_process_noise(fit, data)))
    assert (errors < 1.5 * fit.standard_errors).all()


@pytest.mark.slow
@pytest.mark.parametrize("ratio", RATIOS)
def test_errors_of_a_mechanism_cover_the_truth_with_40_samples(ratio: float) -> None:
    """The bar is 90 to 98 % over 200 seeds of three parameters."""
    share = covered(range(200), ratio=ratio, samples=40, records=1).mean(axis=0)
    print(f"40 samples, ratio {ratio}: covered {share.round(3)}, {share.mean():.3f}")
    assert 0.90 <= share.mean() <= 0.98


@pytest.mark.slow
@pytest.mark.parametrize("ratio", RATIOS)
def test_errors_of_a_mechanism_cover_the_truth_with_2000_samples(ratio: float) -> None:
    """The bar is 90 to 98 % over 100 seeds of three parameters."""
    share = covered(range(100), ratio=ratio, samples=400, records=5).mean(axis=0)
    print(f"2000 samples, ratio {ratio}: covered {share.round(3)}, {share.mean():.3f}")
    assert 0.90 <= share.mean() <= 0.98


@pytest.mark.slow
def test_errors_of_a_mechanism_cover_the_truth_with_a_hundred_thousand_samples() -> None:
    """Over all ratios, since one case takes a minute: 120 parameters, of which 95 % are 114 ± 2.4."""
    inside = [covered(range(8), ratio=ratio, samples=10_000, records=10) for ratio in RATIOS]
    print(
        "100000 samples:",
        *(f"{ratio}: {each.mean():.2f}" for ratio, each in zip(RATIOS, inside, strict=True)),
    )
    assert 0.90 <= np.mean(inside) <= 0.99
