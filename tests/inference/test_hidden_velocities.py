"""f(x, v) from positions alone: the right terms, unbiased, with errors that hold."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scipy.integrate
from particles import TEMPERATURE, particle

from siq.data.correlation import noise_floors
from siq.data.preparation import FEWEST_STRETCHES
from siq.data.recordings import Recordings, write_recordings
from siq.errors import NumericalFailure
from siq.inference import identify
from siq.inference.field_estimate import DiffusionSource, FieldEstimate, read_field, write_field
from siq.inference.kalman_identification import identify_by_likelihood, of_all_states
from siq.inference.library import IdentificationOptions, candidate_library
from siq.inference.observation import ObservationModel, smoothed_motion, unbroken, velocity_names
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.rates import _covariance_axes
from siq.quasipotential.transitions import _barrier_uncertainty, ways_out
from siq.systems.diffusion import Diffusion
from siq.systems.phase_portrait import evenly_spread, phase_portrait
from siq.workflow import pipeline
from siq.workflow.pipeline import PipelineSettings, source_of
from siq.workflow.study import StateSpace
from siq.workflow.tables import Status, StepResult

FRICTION, SENSOR = 0.3, 0.02
SETTINGS = PipelineSettings(identification=IdentificationOptions(degree=3, hidden_velocities=True))


@cache
def identified() -> tuple[StepResult[FieldEstimate], Recordings, np.ndarray]:
    recordings, velocities = particle(1)
    done = pipeline.identify_run(SETTINGS, recordings, number=0)
    return done, recordings, velocities


def found_by(recordings: Recordings, names: list[str], *, degree: int) -> FieldEstimate:
    library = candidate_library([*names, *velocity_names(names)], degree=degree)
    observation = ObservationModel(library, Diffusion.identity(library.dimension), hidden=True)
    generator = np.random.default_rng(0)
    return identify_by_likelihood(observation, recordings, false_terms=0.02, generator=generator)


@pytest.mark.portable
def test_positions_alone_show_the_force_and_both_noises() -> None:
    done, _, _ = identified()
    assert done.outcome.status == Status.OK and done.result is not None
    assert "velocities were not recorded" in done.outcome.reason
    field = done.result
    assert [field.library.names[k] for _, k in field.support] == ["v_x", "x", "v_x", "x**3"]
    assert field.values[0] == 1 and not field.covariance[0].any()
    errors = np.sqrt(np.diag(field.covariance))[1:]
    assert (np.abs(field.values[1:] - [1, -FRICTION, -1]) < 3.5 * errors).all()
    np.testing.assert_allclose(field.diffusion.matrix, [[0, 0], [0, 1]], rtol=1e-12)
    intensity, error = done.result.diagnosis.intensity, done.result.diagnosis.intensity_error
    assert abs(intensity - 2 * FRICTION * TEMPERATURE) < 3.5 * error < 0.2 * intensity
    assert done.result.diagnosis.measurement[0] == pytest.approx(SENSOR, rel=0.03)


def test_the_filter_knows_the_velocities() -> None:
    done, recordings, velocities = identified()
    assert done.result is not None
    measured = replace(recordings, units=("µm",), time_unit="s")
    states = of_all_states(measured, done.result, pair_step=None)
    assert states.units == ("µm", "µm/s")
    assert states.names == ("x", "v_x")
    error = states.values[:, 1] - velocities
    assert error.std() < 0.4 * velocities.std() and abs(error.mean()) < 0.02 * velocities.std()


def test_barriers_of_the_identified_particle_hold() -> None:
    done, recordings, _ = identified()
    assert done.result is not None
    states = of_all_states(recordings, done.result, pair_step=None).values
    points = states[evenly_spread(states, generator=np.random.default_rng(0))]
    field = done.result
    ways = ways_out(field.dynamics, phase_portrait(field.dynamics, points, seed=0))
    assert len(ways) == 2
    for way in ways:
        assert way.path is not None
        error, _ = _barrier_uncertainty(way.path, field)
        assert abs(way.path.action - FRICTION / 2) < 3.5 * error < 0.1  # ΔU = 2γ ΔΦ


def test_it_is_kept_in_a_file(tmp_path: Path) -> None:
    done, _, _ = identified()
    assert done.result is not None
    write_field(tmp_path / "field.json", done.result, SETTINGS.identification)
    again = read_field(tmp_path / "field.json")
    assert again is not None and again.hidden_states
    assert again.diffusion_source == DiffusionSource.OF_VELOCITIES
    assert str(DiffusionSource.OF_VELOCITIES.note) in done.outcome.reason
    np.testing.assert_array_equal(again.coefficients, done.result.coefficients)
    np.testing.assert_array_equal(again.covariance, done.result.covariance)


def test_two_coupled_positions() -> None:
    """Springs are linear: dv = -(Kx + γv) dt + noise, of which one step is exact."""
    draw = np.random.default_rng(4)
    stiffness, friction, step = np.array([[2.0, -0.5], [-0.5, 1.0]]), 0.4, 0.1
    drift = np.block([[np.zeros((2, 2)), np.eye(2)], [-stiffness, -friction * np.eye(2)]])
    small = np.eye(4) + step / 50 * drift
    x, seen = np.zeros((4, 4)), np.empty((4, 1000, 2))
    for row in range(1000):
        for push in np.sqrt(0.2 * step / 50) * draw.standard_normal((50, 4, 2)):
            x = x @ small.T
            x[:, 2:] += push
        seen[:, row] = x[:, :2]
    seen += 0.02 * draw.standard_normal(seen.shape)
    recordings = Recordings.from_arrays(step * np.arange(1000), seen, names=["x", "y"])
    found = found_by(recordings, ["x", "y"], degree=1)
    named = {
        (found.library.states[i], found.library.names[k]): (value, error)
        for (i, k), value, error in zip(
            found.support, found.values, np.sqrt(np.diag(found.covariance)), strict=True
        )
    }
    true = {
        ("x", "v_x"): 1.0, ("y", "v_y"): 1.0, ("v_x", "x"): -2.0, ("v_x", "y"): 0.5, ("v_x", "v_x"): -0.4,
        ("v_y", "x"): 0.5, ("v_y", "y"): -1.0, ("v_y", "v_y"): -0.4,
    }  # fmt: skip
    assert named.keys() == true.keys()
    assert all(abs(named[one][0] - value) <= 3.5 * named[one][1] for one, value in true.items())


@pytest.mark.parametrize("steps", [1, 20])
def test_of_the_steps_of_a_simulation_fewer_are_used(steps: int) -> None:
    # Duffing's oscillator by Euler's rule, each step or twentieth a sample: its rates differ by h.
    draw, step, samples, runs = np.random.default_rng(3), 0.04, 400, 60
    x, v, kept = np.repeat([-1.0, 1.0], runs // 2), np.zeros(runs), []
    for count in range(samples * steps):
        if count % steps == 0:
            kept.append(x)
        kick = np.sqrt(2 * FRICTION * TEMPERATURE * step / steps) * draw.standard_normal(runs)
        x, v = x + v * step / steps, v + (x - x**3 - FRICTION * v) * step / steps + kick
    positions = np.array(kept).T[:, :, None]
    recordings = Recordings.from_arrays(step * np.arange(samples), positions, names=["x"])
    done = pipeline.identify_run(SETTINGS, recordings, number=0)
    assert done.outcome.status == Status.OK and done.result is not None
    assert done.result.diagnosis is not None and (done.result.diagnosis.thinned > 1) == (steps == 1)
    assert ("samples one was used" in done.outcome.reason) == (steps == 1)
    errors = np.sqrt(np.diag(done.result.covariance))[1:]
    assert (np.abs(done.result.values[1:] - [1, -FRICTION, -1]) < 3.5 * errors + 2 * step).all()


def test_steps_that_blur_the_noise_of_velocities_end_with_a_reason() -> None:
    """At kT = 0.12 and this step, the barrier of x alone was found 11 % too low, and certified."""
    recordings, _ = particle(1, step=0.6, samples=500, within=30, sensor=0.0)
    done = pipeline.identify_run(SETTINGS, recordings, number=0)
    assert done.result is None and "too far apart for velocities" in done.outcome.reason


def test_nothing_but_noise_is_a_spline_through_the_samples() -> None:
    recordings, velocities = particle(2, records=2, samples=1000)
    states, noise = smoothed_motion(unbroken(recordings), ["x"])
    assert (states[:, 1] - velocities).std() < 0.4 * velocities.std()
    assert noise.process[0] == 0 < noise.process[1]


def test_what_cannot_be_done_is_said() -> None:
    short, _ = particle(3, records=2, samples=15)
    with pytest.raises(NumericalFailure, match="fewer than 20 samples"):
        found_by(short, ["x"], degree=1)
    with pytest.raises(NumericalFailure, match="v_x is recorded"):
        velocity_names(["x", "v_x"])
    given = replace(SETTINGS, space=StateSpace(diffusion="identity"))
    done = pipeline.identify_run(given, identified()[1], number=0)
    assert done.result is None and "leave the diffusion out" in done.outcome.reason


def test_one_record_of_smooth_positions_is_enough(tmp_path: Path) -> None:
    """Process noise on velocities leaves positions smooth, so that sample by sample none are seen."""
    recordings, _ = particle(7, records=1, samples=12_000, step=0.02)
    floors = noise_floors(recordings)
    assert floors is not None and floors[0].process == 0
    path = tmp_path / "particle.parquet"
    write_recordings(path, recordings)
    alone, hidden, auto = (
        PipelineSettings(identification=IdentificationOptions(hidden_velocities=key))
        for key in (False, True, "auto")
    )
    seen = pipeline.draw_run(auto, source_of(path, auto), number=0).result
    assert seen is not None and len(seen.labels) >= FEWEST_STRETCHES
    whole = pipeline.draw_run(alone, source_of(path, alone), number=0).result
    assert whole is not None
    refused = pipeline.identify_run(alone, whole, number=0)
    assert refused.result is None
    assert "positions of something that has inertia, set 'identification" in str(refused)
    drawn = pipeline.draw_run(hidden, source_of(path, hidden), number=0).result
    assert drawn is not None and len(drawn.labels) >= FEWEST_STRETCHES
    done = pipeline.identify_run(SETTINGS, drawn, number=0)
    assert done.result is not None and done.result.prediction.passed
    field = done.result
    assert [field.library.names[k] for _, k in field.support] == ["v_x", "x", "v_x", "x**3"]


def ring_downs(positions: int = 1) -> Recordings:
    """Damped Duffing particles that run down, seen by a sensor, without process noise."""
    draw = np.random.default_rng(12)
    t = 0.05 * np.arange(500)
    seen = []
    for begin in draw.uniform(-1.5, 1.5, (10, 2)):
        solved = scipy.integrate.solve_ivp(
            lambda _, y: (y[1], y[0] - y[0] ** 3 - FRICTION * y[1]), (0, t[-1]), begin, t_eval=t, rtol=1e-9
        )
        seen.append(solved.y[:1].repeat(positions, axis=0).T)
    values = np.array(seen) + 0.005 * draw.standard_normal((10, len(t), positions))
    return Recordings.from_arrays(t, values, names=["x", "y"][:positions])


def test_ring_downs_have_no_random_forces_and_the_unit_matrix_of_the_velocities() -> None:
    done = pipeline.identify_run(SETTINGS, ring_downs(), number=0)
    assert done.result is not None and done.result.prediction.passed
    assert done.result.diffusion_source == DiffusionSource.UNIT_OF_VELOCITIES
    assert done.result.noise_strength is None and done.result.diagnosis.kind == "sensor"
    assert done.result.diagnosis.measurement[0] == pytest.approx(0.005, rel=0.05)
    field = done.result
    assert not field.noise_rate.any()
    np.testing.assert_array_equal(field.diffusion.matrix, [[0, 0], [0, 1]])
    errors = np.sqrt(np.diag(field.covariance))[1:]
    assert [field.library.names[k] for _, k in field.support] == ["v_x", "x", "v_x", "x**3"]
    assert (np.abs(field.values[1:] - [1, -FRICTION, -1]) < 3.5 * errors).all() and errors.max() < 2e-3


def test_ring_downs_of_positions_in_different_units_show_no_unit_matrix(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = identified()[0].result
    assert found is not None
    still = replace(found, noise_rate=0 * found.noise_rate)
    monkeypatch.setattr(identify, "identify_by_likelihood", lambda *_, **__: still)
    several = replace(ring_downs(2), units=("m", "rad"))
    done = pipeline.identify_run(SETTINGS, several, number=0)
    assert done.result is None and "scale them to one unit" in done.outcome.reason


def test_what_is_known_exactly_has_no_axis() -> None:
    axes = _covariance_axes(np.diag([0.0, 4.0, 0.0, 9.0]), np.random.default_rng(0))
    np.testing.assert_allclose(sum(np.outer(one, one) for one in axes), np.diag([0.0, 4.0, 0.0, 9.0]))
    assert len(axes) == 2


def test_networks_have_no_use_for_hidden_velocities() -> None:
    from siq.networks.decomposition import TrainingOptions

    with pytest.raises(ValueError, match="velocities are hidden"):
        replace(SETTINGS, training=TrainingOptions())


@pytest.mark.slow
def test_the_errors_cover() -> None:
    deviations = []
    for seed in range(40):
        field = found_by(particle(100 + seed)[0], ["x"], degree=3)
        if [field.library.names[k] for _, k in field.support] == ["v_x", "x", "v_x", "x**3"]:
            errors = np.sqrt(np.diag(field.covariance))[1:]
            deviations.append((field.values[1:] - [1, -FRICTION, -1]) / errors)
    assert len(deviations) >= 36
    scores = np.array(deviations)
    assert (np.abs(scores.mean(axis=0)) < 3.5 / np.sqrt(len(scores))).all()
    assert 0.87 < (np.abs(scores) < 1.96).mean() <= 0.995


@pytest.mark.slow
def test_the_landscape_is_certified_and_right() -> None:
    settings = PipelineSettings(identification=IdentificationOptions(degree=3))
    found = Landscape.from_recordings(particle(5, samples=4000)[0], settings, hidden_velocities=True)
    assert found.certificate is not None and found.certificate.certified
    barriers = found.barriers()
    assert len(barriers) == 2
    assert (abs(barriers["barrier"] - FRICTION / 2) < 3 * barriers["standard_error"]).all()
    assert found.dynamics.states == ("x", "v_x") and found.dynamics.units == ("1", "1")
    assert (found.dwell_times()["mean_time"] > 0).all()
