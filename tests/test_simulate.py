from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.linalg
import sympy

from siq.errors import NumericalFailure
from siq.randomness import generator
from siq.recordings import snapshot_pairs
from siq.simulate import SimulationOptions, runge_kutta_step, simulate_snapshots
from siq.systems import System

SMALL = SimulationOptions(trajectories=6, pairs=4, pair_step=0.02, interval=0.1, substeps=5)


def linear_system(matrix: np.ndarray) -> System:
    symbols = tuple(sympy.Symbol(f"x{index}", real=True) for index in range(len(matrix)))
    equations = sympy.Matrix(matrix) * sympy.Matrix(symbols)
    return System(
        name="linear",
        title="linear",
        time_unit="s",
        states=tuple(symbol.name for symbol in symbols),
        units=("m",) * len(symbols),
        domain=np.array([[-1.0, 1.0]] * len(symbols)),
        symbols=symbols,
        equations=tuple(equations),
        diffusion=np.eye(len(symbols)),
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


def test_snapshots_are_taken_at_t_j_and_t_j_plus_h(archetype: System) -> None:
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


def test_the_first_pairs_do_not_depend_on_how_many_follow(archetype: System) -> None:
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
def test_an_interval_that_does_not_fit_the_steps_is_refused(archetype: System, interval: float) -> None:
    options = dataclasses.replace(SMALL, interval=interval)
    with pytest.raises(ValueError, match="not a multiple"):
        simulate_snapshots(archetype, options=options, generator=generator(0))


def test_defaults_are_those_of_the_paper() -> None:
    assert SimulationOptions() == SimulationOptions(5000, 50, 0.01, 0.1, 5)
