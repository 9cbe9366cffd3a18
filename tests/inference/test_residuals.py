from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import sympy
from known_systems import KnownSystem, archetype, as_system, double_well, maier_stein
from scipy.signal import lfilter

from siq.data.preparation import repetitions
from siq.data.recordings import Recordings, snapshot_pairs
from siq.inference.checks import mean_residual_probability, residual_noise
from siq.inference.field_estimate import FieldEstimate, NoiseDiagnosis
from siq.inference.library import IdentificationOptions, field_library
from siq.inference.regression import identify_vector_field
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.simulation import SimulationOptions, simulate_snapshots

x, y = (sympy.Symbol(name, real=True) for name in "xy")
STEP = 0.01


class Setup(NamedTuple):
    """How samples lie in time: as pairs with gaps of 0.01 and 0.09, or one after the other."""

    interval: float
    pairs: int


SETUPS = {"pairs": Setup(0.1, 30), "contiguous": Setup(2 * STEP, 40)}


def recorded(
    known: KnownSystem, *, intensity: float, setup: str = "pairs", trajectories: int = 150, seed: int = 0
) -> Recordings:
    interval, pairs = SETUPS[setup]
    options = SimulationOptions(
        trajectories=trajectories, pairs=pairs, pair_step=STEP, substeps=2, interval=interval,
        noise_intensity=intensity,
    )  # fmt: skip
    return simulate_snapshots(as_system(known), options=options, generator=np.random.default_rng(seed))


def with_errors(recordings: Recordings, size: float | np.ndarray, seed: int = 1) -> Recordings:
    errors = np.random.default_rng(seed).normal(size=recordings.values.shape) * size
    return replace(recordings, values=recordings.values + errors)


def identified(recordings: Recordings, *, degree: int = 3, euler: bool = False) -> FieldEstimate:
    options = IdentificationOptions(degree=degree)
    return identify_vector_field(
        field_library(recordings.names, options), snapshot_pairs(recordings, pair_step=STEP),
        options=options, integrator_step=STEP / 2 if euler else None,
    )  # fmt: skip


def diagnosed(
    recordings: Recordings, diffusion: np.ndarray | None = None, *, degree: int = 3, euler: bool = False
) -> NoiseDiagnosis:
    found = identified(recordings, degree=degree, euler=euler)
    if diffusion is not None:
        found = replace(found, diffusion=Diffusion(diffusion))
    return residual_noise(found, recordings, pair_step=STEP)


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("euler", [False, True])
@pytest.mark.parametrize("known", [maier_stein(1), double_well(2)], ids=["identity", "diagonal"])
def test_process_noise_is_recognised_with_its_intensity(known: KnownSystem, euler: bool, setup: str) -> None:
    recordings = recorded(known, intensity=0.02, setup=setup)
    noise = diagnosed(recordings, known.diffusion, euler=euler)
    assert noise.kind == "process"
    assert noise.intensity == pytest.approx(0.02, rel=0.05)
    np.testing.assert_allclose(noise.covariance, known.diffusion, atol=0.1)
    assert noise.fault(recordings.names) is None
    np.testing.assert_array_equal(noise.measurement, 0.0)


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("known", [maier_stein(1), archetype(3)], ids=["two states", "three states"])
def test_recordings_without_noise_have_none(known: KnownSystem, setup: str) -> None:
    recordings = recorded(known, intensity=0.0, setup=setup, trajectories=40)
    noise = diagnosed(recordings)
    assert (noise.kind, noise.intensity) == ("none", 0.0)
    assert noise.fault(recordings.names) is None


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize(
    ("size", "intensity"),
    [
        (0.01, 0.0),
        (0.01, 0.01),
        (0.04, 0.0),
        pytest.param(0.04, 0.01, marks=pytest.mark.slow),
    ],
)
def test_measurement_noise_is_recognised_with_its_size(size: float, intensity: float, setup: str) -> None:
    recordings = with_errors(recorded(maier_stein(1), intensity=intensity, setup=setup), size)
    noise = diagnosed(recordings)
    assert noise.kind == "measurement"
    np.testing.assert_allclose(noise.measurement, size, rtol=0.2)
    fault = noise.fault(("x", "y"))
    assert fault is not None
    assert "measurement noise, of about" in fault
    assert "smooth or average the recordings first" in fault


def test_measurement_noise_of_one_state_is_told_by_its_name() -> None:
    recordings = with_errors(recorded(maier_stein(1), intensity=0.01), np.array([0.0, 0.03]))
    noise = diagnosed(recordings)
    assert noise.kind == "measurement"
    assert noise.measurement[1] == pytest.approx(0.03, rel=0.2)
    assert noise.measurement[0] < 0.01
    fault = noise.fault(("x", "y"))
    assert fault is not None
    assert "in y" in fault


@pytest.mark.parametrize("setup", SETUPS)
def test_a_wrong_d_is_told_with_the_right_one(setup: str) -> None:
    right = np.array([[1.0, 0.5], [0.5, 2.0]])
    known = maier_stein(1).with_diffusion(right)
    recordings = recorded(known, intensity=0.02, setup=setup)
    assert diagnosed(recordings, right).fault(recordings.names) is None
    noise = diagnosed(recordings)
    assert noise.kind == "process"
    fault = noise.fault(recordings.names)
    assert fault is not None
    assert "not the D of the study" in fault
    # D is known up to a factor, which is the intensity's.
    np.testing.assert_allclose(noise.covariance * noise.intensity, 0.02 * right, rtol=0.1)
    assert np.array2string(noise.covariance, precision=3, separator=", ").replace("\n", "") in fault


def test_a_d_that_is_wrong_by_a_factor_only_is_right() -> None:
    recordings = recorded(maier_stein(1), intensity=0.02)
    noise = diagnosed(recordings, 5 * np.eye(2))
    assert noise.fault(recordings.names) is None
    assert noise.intensity == pytest.approx(0.004, rel=0.05)


@pytest.mark.parametrize("memory", [0.03, 0.3])
@pytest.mark.parametrize("setup", SETUPS)
def test_noise_with_a_memory_is_recognised(memory: float, setup: str) -> None:
    # x is driven by an Ornstein–Uhlenbeck process that is then left out of the recordings.
    w = sympy.Symbol("w", real=True)
    rate, size = 1 / memory, 0.5
    known = KnownSystem(
        Dynamics.of(
            (x, y, w), (x - x**3 + sympy.Float(size) * w, -y + x, -sympy.Float(rate) * w),
            diffusion=np.diag([1e-4, 1.0, 2 * rate / 0.01]),
        ),
        None, np.zeros((0, 3)), np.array([[-1.5, 1.5]] * 3),
    )  # fmt: skip
    whole = recorded(known, intensity=0.01, setup=setup)
    recordings = replace(
        whole, names=("x", "y"), units=("1", "1"), values=np.ascontiguousarray(whole.values[:, :2])
    )
    noise = diagnosed(recordings, np.diag([2 * size**2 * memory / 0.01, 1.0]))
    assert noise.kind == "coloured"
    assert noise.correlation > 0.02
    fault = noise.fault(("x", "y"))
    assert fault is not None
    assert "has a memory" in fault


def test_units_do_not_matter() -> None:
    recordings = with_errors(recorded(maier_stein(1), intensity=0.01), 0.02)
    units = np.array([1e-3, 50.0])
    other = replace(recordings, values=recordings.values * units)
    one, two = diagnosed(recordings), diagnosed(other, np.diag(units**2))
    assert one.kind == two.kind == "measurement"
    np.testing.assert_allclose(two.measurement, one.measurement * units, rtol=1e-3)
    assert two.correlation == pytest.approx(one.correlation, rel=1e-3)
    assert two.intensity == pytest.approx(one.intensity, rel=1e-3)


def test_held_out_residuals_have_no_mean_for_the_right_f_and_one_for_a_wrong_f() -> None:
    recordings = recorded(maier_stein(1), intensity=0.02)
    half = np.arange(75)
    fitted = identified(recordings.select(half), euler=True)
    unseen = snapshot_pairs(recordings.select(half + 75), pair_step=STEP)
    assert mean_residual_probability(fitted, unseen) > 0.01
    wrong = fitted.coefficients.copy()
    wrong[fitted.support[0, 1], fitted.support[0, 0]] *= 1.5
    assert mean_residual_probability(replace(fitted, coefficients=wrong), unseen) < 1e-6


def test_the_probability_of_the_mean_is_uniform_for_the_right_f() -> None:
    recordings = recorded(maier_stein(1), intensity=0.02, trajectories=400)
    fitted = identified(recordings.select(np.arange(200)), euler=True)
    found = [
        mean_residual_probability(
            fitted,
            snapshot_pairs(recordings.select(np.arange(200 + k, 400, 10)), pair_step=STEP),
        )
        for k in range(10)
    ]
    assert min(found) > 0.002
    assert np.median(found) > 0.15


def test_what_rounding_repeats_is_no_sign_of_values_filled_in() -> None:
    generator, t = np.random.default_rng(0), np.arange(20_000.0)
    walk = 0.1 * np.cumsum(generator.standard_normal(len(t)))
    inert = 0.1 * np.cumsum(lfilter([1.0], [1.0, -0.95], generator.standard_normal(len(t))))
    filled = walk.copy()
    for begin in range(0, len(t), 1000):
        filled[begin : begin + 6] = np.linspace(*filled[[begin, begin + 5]], 6)

    def chances(x: np.ndarray) -> dict[str, float]:
        found = repetitions(Recordings.from_arrays(t, x[:, None], names=["x"]), 0)
        return {kind: chance for chance, kind, _ in found}

    def straight(x: np.ndarray) -> float:
        return chances(x)["straight"]

    for x in (walk, walk.round(3), walk.round(3) - 1e-4 * t, inert.round(3)):
        assert straight(x) > 0.01
    assert straight(filled) < 1e-9 and straight(filled.round(3)) < 1e-3
    wave = np.abs(np.sin(0.3 * np.cumsum(generator.random(len(t)))))
    five = np.array([float(f"{one:.5g}") for one in wave])
    five *= np.where(five < 0.01, 1.0, 10.0)  # nearly all have one step, and a few a hundred times finer ones
    assert min(chances(five).values()) > 0.01
    # A state in which there is little noise repeats itself more often, for it is written no finer.
    quiet = np.zeros(len(t))
    for k, kick in enumerate(generator.standard_normal(len(t) - 1)):
        quiet[k + 1] = 0.99 * quiet[k] + 0.02 * (1.0 if quiet[k] > 0 else 0.05) * kick
    assert chances(quiet.round(4))["held"] > 0.01
    held = np.where(np.arange(len(t)) % 50 == 7, np.roll(quiet.round(4), 1), quiet.round(4))
    assert chances(held)["held"] < 1e-6
