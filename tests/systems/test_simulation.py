from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.linalg
import sympy
from pydantic import ValidationError

from siq.data.recordings import snapshot_pairs
from siq.errors import NumericalFailure
from siq.numerics.integration import euler_maruyama_step, runge_kutta_step
from siq.numerics.randomness import generator
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.simulation import (
    SimulationOptions,
    _sampling_stride,
    noise_source,
    simulate_snapshots,
    simulate_stationary,
)

pytestmark = pytest.mark.portable

SMALL = SimulationOptions(trajectories=6, pairs=4, pair_step=0.02, interval=0.1, substeps=5)


def linear_system(matrix: np.ndarray) -> Dynamics:
    symbols = tuple(sympy.Symbol(f"x{index}", real=True) for index in range(len(matrix)))
    equations = sympy.Matrix(matrix) * sympy.Matrix(symbols)
    return dataclasses.replace(
        Dynamics.of(symbols, tuple(equations)),
        name="linear",
        time_unit="s",
        units=("m",) * len(symbols),
        domain=np.array([[-1.0, 1.0]] * len(symbols)),
    )


def test_halving_the_step_divides_the_error_by_sixteen() -> None:
    def error(steps: int) -> float:
        x = np.array([[0.1, 0.5, 0.8]])
        exact = x * np.exp(2.0) / (1 - x + x * np.exp(2.0))  # the logistic equation
        for _ in range(steps):
            x = runge_kutta_step(lambda x: x * (1 - x), x, 2.0 / steps)
        return float(np.abs(x - exact).max())

    ratios = [error(steps) / error(2 * steps) for steps in (8, 16, 32)]
    np.testing.assert_allclose(ratios, 16, rtol=0.1)


def test_a_step_leaves_its_argument_alone() -> None:
    x = np.array([[1.0, 2.0]])
    runge_kutta_step(np.sin, x, 0.1)
    np.testing.assert_array_equal(x, [[1.0, 2.0]])


@pytest.mark.parametrize("substeps", [2, 5])
def test_snapshots_of_a_linear_system_are_those_of_the_matrix_exponential(substeps: int) -> None:
    matrix = np.array([[-0.3, 1.0, 0.0], [-1.0, -0.3, 0.2], [0.0, 0.1, -0.5]])
    options = dataclasses.replace(SMALL, pair_step=0.02, substeps=substeps)
    result = simulate_snapshots(linear_system(matrix), options=options, generator=generator(0, 0, "a"))
    initial = generator(0, 0, "a").uniform(-1, 1, size=(3, 6))
    for index in range(6):
        mine = result.recording == index
        for t, value in zip(result.t[mine], result.values[mine], strict=True):
            np.testing.assert_allclose(value, scipy.linalg.expm(matrix * t) @ initial[:, index], atol=1e-9)


def test_snapshots_are_taken_at_t_j_and_t_j_plus_h(archetype: Dynamics) -> None:
    result = simulate_snapshots(archetype, options=SMALL, generator=generator(0))
    expected = [0.1, 0.12, 0.2, 0.22, 0.3, 0.32, 0.4, 0.42]
    for index in range(6):
        np.testing.assert_allclose(result.t[result.recording == index], expected, rtol=1e-12)
    pairs = snapshot_pairs(result, pair_step=0.02)
    assert len(pairs.h) == 6 * 4
    np.testing.assert_allclose(pairs.h, 0.02, rtol=1e-9)


def test_the_result_carries_names_and_units_of_the_card() -> None:
    result = simulate_snapshots(linear_system(-np.eye(2)), options=SMALL, generator=generator(0))
    assert (result.names, result.units) == (("x0", "x1"), ("m", "m"))
    assert len(set(result.labels)) == 6


def test_the_first_pairs_do_not_depend_on_how_many_follow(archetype: Dynamics) -> None:
    short = simulate_snapshots(archetype, options=SMALL, generator=generator(3))
    longer = simulate_snapshots(
        archetype, options=dataclasses.replace(SMALL, pairs=7), generator=generator(3)
    )
    width = len(archetype.states)
    np.testing.assert_array_equal(
        short.values.reshape(6, 8, width), longer.values.reshape(6, 14, width)[:, :8]
    )


def test_initial_states_lie_in_the_domain_and_follow_the_generator() -> None:
    still = linear_system(np.zeros((2, 2)))
    still = dataclasses.replace(still, domain=np.array([[-2.0, -1.0], [3.0, 7.0]]))
    options = dataclasses.replace(SMALL, trajectories=400, pairs=1)
    one, again, other = (
        simulate_snapshots(still, options=options, generator=generator(*keys)).values
        for keys in ((0, 1), (0, 1), (0, 2))
    )
    np.testing.assert_array_equal(one, again)
    assert not np.isin(one, other).any()
    assert (one >= [-2, 3]).all()
    assert (one <= [-1, 7]).all()
    np.testing.assert_allclose(one.mean(axis=0), [-1.5, 5], atol=0.3)
    np.testing.assert_allclose(one.std(axis=0), [1 / 12**0.5, 4 / 12**0.5], rtol=0.15)


def test_runaway_trajectories_are_counted_and_told() -> None:
    system = dataclasses.replace(linear_system(np.eye(1)), equations=(sympy.Symbol("x0", real=True) ** 3,))
    system = dataclasses.replace(system, domain=np.array([[50.0, 60.0]]))
    with pytest.raises(NumericalFailure, match=r"6 of 6 trajectories of linear run to infinity"):
        simulate_snapshots(system, options=SMALL, generator=generator(0))


@pytest.mark.parametrize("interval", [0.013, 0.02, 0.01])
def test_an_interval_that_does_not_fit_the_steps_is_refused(archetype: Dynamics, interval: float) -> None:
    options = dataclasses.replace(SMALL, interval=interval)
    with pytest.raises(ValueError, match="not a multiple"):
        simulate_snapshots(archetype, options=options, generator=generator(0))


def test_defaults_are_those_of_the_paper() -> None:
    assert SimulationOptions() == SimulationOptions(5000, 50, 0.01, 0.1, 5)


COUPLED = np.array([[-1.0, 2.0], [-0.5, -1.5]])  # not symmetric: its noise circulates
UNEQUAL = np.array([[1.0, 0.3], [0.3, 0.5]])


def test_without_noise_the_snapshots_are_those_of_the_runge_kutta_rule_to_the_last_bit(
    archetype: Dynamics,
) -> None:
    source = generator(5)
    lower, upper = archetype.domain.T
    x = source.uniform(lower[:, None], upper[:, None], size=(3, SMALL.trajectories))
    expected = []
    for pair in range(SMALL.pairs):
        for _ in range(_sampling_stride(SMALL) - (SMALL.substeps if pair else 0)):
            x = runge_kutta_step(archetype.drift_of_components, x, SMALL.pair_step / SMALL.substeps)
        expected.append(x)
        for _ in range(SMALL.substeps):
            x = runge_kutta_step(archetype.drift_of_components, x, SMALL.pair_step / SMALL.substeps)
        expected.append(x)
    result = simulate_snapshots(archetype, options=SMALL, generator=generator(5))
    np.testing.assert_array_equal(
        result.values.reshape(6, 8, 3), np.stack(expected, axis=2).transpose(1, 2, 0)
    )


def test_noise_starts_from_the_same_states_and_follows_the_generator(archetype: Dynamics) -> None:
    options = dataclasses.replace(SMALL, pairs=1, pair_step=1e-6, interval=2e-6, substeps=1)
    calm = simulate_snapshots(archetype, options=options, generator=generator(1)).values
    noisy = dataclasses.replace(options, noise_intensity=0.02)
    one, again, other = (
        simulate_snapshots(archetype, options=noisy, generator=generator(seed)).values for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one, again)
    assert not np.isin(one, other).any()
    assert (one != calm).all()
    np.testing.assert_allclose(one, calm, atol=5 * (0.02 * 3e-6) ** 0.5)


def test_increments_have_the_drift_of_one_step_and_the_covariance_of_the_noise() -> None:
    system = linear_system(COUPLED).with_diffusion(Diffusion(UNEQUAL))
    options = SimulationOptions(
        trajectories=20_000, pairs=1, pair_step=0.01, interval=0.02, substeps=1, noise_intensity=0.3
    )
    values = simulate_snapshots(system, options=options, generator=generator(0)).values.reshape(-1, 2, 2)
    increments = values[:, 1] - values[:, 0] - 0.01 * values[:, 0] @ COUPLED.T
    np.testing.assert_allclose(increments.mean(axis=0), 0, atol=5 * (0.3 * 0.01 / 20_000) ** 0.5)
    np.testing.assert_allclose(np.cov(increments.T) / (0.3 * 0.01), UNEQUAL, atol=0.04)
    draw = noise_source(system, intensity=0.3, step=0.01, generator=generator(1))
    numbers = generator(1).standard_normal((2, 3))
    np.testing.assert_allclose(
        draw(np.zeros((2, 3))), np.linalg.cholesky(0.3 * 0.01 * UNEQUAL) @ numbers, rtol=1e-12
    )


def test_the_euler_maruyama_step_leaves_its_arguments_alone() -> None:
    x = np.array([[1.0, 2.0]])
    result = euler_maruyama_step(lambda x: x, x, 0.1, np.array([[0.5, -0.5]]))
    np.testing.assert_allclose(result, [[1.6, 1.7]])
    np.testing.assert_array_equal(x, [[1.0, 2.0]])


def test_the_stationary_covariance_solves_the_lyapunov_equation() -> None:
    # d<xxᵀ>/dt = J C + C Jᵀ + ε D vanishes, hence C = ε W with J W + W Jᵀ = -D, without a factor of 2.
    intensity = 0.2
    samples = simulate_stationary(
        linear_system(COUPLED).with_diffusion(Diffusion(UNEQUAL)),
        intensity=intensity,
        start=np.zeros((2, 4000)),
        step=0.01,
        burn_in=500,
        steps=1500,
        thin=50,
        generator=generator(0),
    )
    assert samples.shape == (2, 30, 4000)
    expected = intensity * scipy.linalg.solve_continuous_lyapunov(COUPLED, -UNEQUAL)
    measured = np.cov(samples.reshape(2, -1))
    np.testing.assert_allclose(measured, expected, atol=0.03 * expected.max())
    # The quasipotential says the same: M = (W')⁻¹ with J W' + W' Jᵀ = -2D is the Hessian of V, U = 2V.
    hessian = 2 * np.linalg.inv(scipy.linalg.solve_continuous_lyapunov(COUPLED, -2 * UNEQUAL))
    np.testing.assert_allclose(expected, intensity * np.linalg.inv(hessian), rtol=1e-12)


def test_thinning_keeps_every_so_many_steps_after_the_burn_in() -> None:
    def samples(burn_in: int, steps: int, thin: int) -> np.ndarray:
        return simulate_stationary(
            linear_system(np.zeros((1, 1))), intensity=1.0, start=np.zeros((1, 2)), step=0.1,
            burn_in=burn_in, steps=steps, thin=thin, generator=generator(0),
        )  # fmt: skip

    every = samples(0, 10, 1)
    np.testing.assert_array_equal(samples(3, 7, 2), every[:, [4, 6, 8]])
    with pytest.raises(ValueError, match="leaves no sample"):
        samples(0, 3, 4)


def test_negative_noise_is_refused() -> None:
    with pytest.raises(ValidationError, match="noise_intensity"):
        SimulationOptions(noise_intensity=-0.01)
    with pytest.raises(ValueError, match="must not be negative"):
        noise_source(linear_system(COUPLED), intensity=-0.01, step=0.1, generator=generator(0))


def test_noisy_trajectories_and_walkers_that_run_away_are_counted_and_told() -> None:
    system = dataclasses.replace(linear_system(np.eye(1)), equations=(sympy.Symbol("x0", real=True) ** 3,))
    system = dataclasses.replace(system, domain=np.array([[50.0, 60.0]]))
    options = dataclasses.replace(SMALL, noise_intensity=0.1)
    with pytest.raises(NumericalFailure, match=r"6 of 6 trajectories of linear run to infinity"):
        simulate_snapshots(system, options=options, generator=generator(0))
    with pytest.raises(NumericalFailure, match="1 of 2 walkers"):
        simulate_stationary(
            system, intensity=1e-6, start=np.array([[50.0, 0.0]]),
            step=0.1, burn_in=20, steps=1, generator=generator(0),
        )  # fmt: skip
