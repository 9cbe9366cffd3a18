from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    as_system,
    exact_field,
    linear_system,
    maier_stein,
    uniform_points,
)
from scipy.linalg import expm

from siq.data.recordings import Recordings, snapshot_pairs
from siq.inference.checks import predict, prediction_errors, with_work_of_samples
from siq.inference.field_estimate import FieldEstimate
from siq.inference.identify import identify
from siq.inference.library import IdentificationOptions
from siq.systems.dynamics import Dynamics
from siq.systems.simulation import SimulationOptions, simulate_snapshots

x, y = (sympy.Symbol(name, real=True) for name in "xy")


def simulated(known: KnownSystem, trajectories: int = 20, pairs: int = 15) -> Recordings:
    options = SimulationOptions(trajectories=trajectories, pairs=pairs, pair_step=0.01, interval=0.1)
    return simulate_snapshots(as_system(known), options=options, generator=np.random.default_rng(0))


def irregular(known: KnownSystem) -> tuple[Recordings, np.ndarray]:
    """Recordings of a linear system of different lengths, at times of their own, with the exact states."""
    draw = np.random.default_rng(0)
    matrix = known.dynamics.jacobian(np.zeros((1, known.dynamics.dimension)))[0]
    starts, lengths = uniform_points(known, 4), [9, 1, 4, 2]
    times = [np.sort(draw.uniform(0, 1.0, size=length)) + 100 * k for k, length in enumerate(lengths)]
    states = [
        np.array([expm(matrix * (t - each[0])) @ start for t in each])
        for start, each in zip(starts, times, strict=True)
    ]
    d = known.dynamics.dimension
    return Recordings(
        names=tuple(s.name for s in known.dynamics.symbols), units=("1",) * d,
        labels=("a", "b", "c", "d"), recording=np.repeat(np.arange(4), lengths),
        t=np.concatenate(times), values=np.concatenate(states),
    ), np.concatenate(states)  # fmt: skip


@pytest.mark.parametrize("known", [archetype(3), maier_stein(5)], ids=["archetype", "Maier-Stein"])
def test_the_right_f_predicts_recordings(known: KnownSystem) -> None:
    recordings = simulated(known)
    np.testing.assert_allclose(predict(known.dynamics, recordings), recordings.values, atol=1e-4)
    errors = prediction_errors(known.dynamics, recordings)
    assert errors.shape == (20,)
    assert errors.max() < 1e-4


def test_times_and_lengths_are_those_of_each_recording() -> None:
    known = linear_system(2)
    recordings, exact = irregular(known)
    np.testing.assert_allclose(predict(known.dynamics, recordings), exact, atol=1e-5)


def test_the_first_sample_is_taken_as_it_is() -> None:
    known = archetype(2)
    recordings = simulated(known)
    predicted = predict(known.dynamics, recordings)
    starts = np.flatnonzero(np.diff(recordings.recording, prepend=-1))
    np.testing.assert_array_equal(predicted[starts], recordings.values[starts])


def test_errors_are_relative_and_one_for_each_recording() -> None:
    known = linear_system(2)
    recordings, _ = irregular(known)
    wrong = Dynamics.of(
        known.dynamics.symbols, tuple(f * sympy.Rational(11, 10) for f in known.dynamics.formulas)
    )
    found = prediction_errors(wrong, recordings)
    predicted = predict(wrong, recordings)
    for index in range(4):
        rows = recordings.recording == index
        expected = np.linalg.norm((predicted - recordings.values)[rows]) / np.linalg.norm(
            recordings.values[rows]
        )
        assert found[index] == pytest.approx(expected, rel=1e-12, abs=1e-15)
    assert found[0] > 1e-3
    assert found[1] == 0  # one sample only


def test_a_wrong_f_does_not_predict() -> None:
    known = archetype(2)
    recordings = simulated(known)
    found = exact_field(known, 3)
    good, bad = found.values.copy(), found.values.copy()
    bad[0] *= 1.2
    assert prediction_errors(found.dynamics.with_values(good), recordings).max() < 1e-4
    assert np.median(prediction_errors(found.dynamics.with_values(bad), recordings)) > 0.01


def test_a_prediction_that_runs_away_has_an_infinite_error() -> None:
    recordings = simulated(archetype(2)).select([0, 1, 2])
    runaway = Dynamics.of((x, y), (x**3 + 1, y**3 + 5 * y))
    errors = prediction_errors(runaway, recordings)
    assert (errors > 1).all()
    assert np.isinf(errors).any()


def test_units_do_not_change_the_work_or_the_prediction() -> None:
    known = archetype(2)
    recordings = simulated(known, trajectories=5)
    units = np.array([1e-4, 1e4])
    back = {s: s / sympy.Float(u) for s, u in zip(known.dynamics.symbols, units, strict=True)}
    scaled = Dynamics.of(
        known.dynamics.symbols,
        tuple(
            sympy.Float(u) * f.subs(back, simultaneous=True)
            for u, f in zip(units, known.dynamics.formulas, strict=True)
        ),
    )
    calls = []

    class Counting(Dynamics):
        def drift(self, x: np.ndarray) -> np.ndarray:
            calls.append(len(x))
            assert len(calls) < 20_000
            return super().drift(x)

    other = Recordings(
        recordings.names, recordings.units, recordings.labels, recordings.recording, recordings.t,
        recordings.values * units,
    )  # fmt: skip
    counting = Counting.of(scaled.symbols, scaled.equations)
    np.testing.assert_allclose(
        predict(counting, other) / units, predict(known.dynamics, recordings), atol=1e-5
    )


def test_an_f_too_fast_for_the_samples_is_given_up() -> None:
    recordings = simulated(linear_system(2), trajectories=3)
    fast = Dynamics.of((x, y), (-1e9 * x, -1e9 * y))
    assert np.isinf(prediction_errors(fast, recordings)).all()


def hopping(
    force: Callable[[np.ndarray], np.ndarray], *, seed: int, samples: int = 7500, states: int = 1
) -> Recordings:
    """Eight recordings of states pushed by a force ``(8, d)`` and by noise of intensity 0.4, begun at ±1."""
    draw, step, within = np.random.default_rng(seed), 0.02, 5
    state = np.zeros((8, states))
    state[:, 0] = np.sign(draw.standard_normal(8))
    path = np.empty((samples, 8, states))
    for sample in range(samples):
        for _ in range(within):
            kick = np.sqrt(0.4 * step / within) * draw.standard_normal(state.shape)
            state = state + step / within * force(state) + kick
        path[sample] = state
    times = [step * np.arange(samples)] * 8
    return Recordings.from_arrays(times, list(path.transpose(1, 0, 2)), names=["x", "y"][:states])


def identified(recordings: Recordings, degree: int = 5) -> FieldEstimate:
    options = IdentificationOptions(degree=degree)
    return identify(recordings, options=options, draw=lambda purpose: np.random.default_rng(0))


def heights(found: FieldEstimate) -> list[tuple[float, float]]:
    """ΔU/ε from either well to the top between them, moved by what else f may be, and its standard error."""
    grid = np.linspace(-1.5, 1.5, 3002)[:, None]
    force, found_heights = found.dynamics.drift(grid)[:, 0], []
    left, top, right = grid[1:][force[1:] * force[:-1] < 0, 0]
    for well in (left, right):
        x, rate = np.linspace(well, top, 1001)[:, None], found.noise_rate[0, 0]
        slope = -2 * np.trapezoid(found.library.evaluate(x), x[:, 0], axis=0)[:, None] / rate
        own = -2 * np.trapezoid(found.dynamics.drift(x)[:, 0], x[:, 0]) / rate
        error = np.sqrt(found.variance(slope, of_mean=True))
        found_heights.append((float(own + found.bias(slope)), float(error)))
    return found_heights


def test_samples_between_wells_mend_the_work_of_an_f_that_is_no_polynomial() -> None:
    """Two springs that meet about x = 0, where U has an edge."""
    recordings = hopping(lambda x: np.tanh(6 * x) - x, seed=1)
    true = 2 / 0.4 * (np.log(np.cosh(6.0)) / 6 - 0.5)
    found = identified(recordings)
    assert found.prediction is not None and not found.prediction.passed
    assert "has a shape that no function" in found.prediction.reason
    for (height, error), (plain, _) in zip(
        heights(found), heights(replace(found, alternatives=None)), strict=True
    ):
        assert abs(height - true) < 2.5 * error < 0.7
        assert plain < true - 0.7


def test_samples_between_wells_agree_with_an_f_of_the_library() -> None:
    chances, scores = [], []
    for seed in range(6):
        recordings = hopping(lambda x: x - x**3, seed=seed, samples=2500)
        found = identified(recordings, degree=3)
        chances.append(with_work_of_samples(found, snapshot_pairs(recordings))[1])
        scores += [(height - 0.5 / 0.4) / error for height, error in heights(found)]
    assert min(chances) > 1e-3
    assert 0.2 < np.median(chances) < 0.9
    assert np.sqrt(np.mean(np.square(scores))) < 1.5


@pytest.mark.parametrize("force", [lambda x: np.tanh(6 * x) - x, lambda x: x - x**3], ids=["edge", "cubic"])
def test_a_function_of_a_state_that_f_lacks_shows_among_several_states(
    force: Callable[[np.ndarray], np.ndarray],
) -> None:
    def both(state: np.ndarray) -> np.ndarray:
        x, y = state.T
        return np.column_stack([force(x) + 0.5 * y, -0.5 * force(x) - y])

    found = identified(hopping(both, seed=3, samples=2000, states=2), degree=3)
    assert found.prediction is not None
    right = force(np.array(2.0)) == -6.0
    assert found.prediction.passed == right
    assert ("as a function of a state" in found.prediction.reason) == (not right)
