from __future__ import annotations

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

from siq.data.recordings import Recordings
from siq.inference.checks import predict, prediction_errors
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
