"""D that nobody gave: estimated from the noise, the unit matrix in words, or asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy
from known_systems import as_system, linear_system

from siq.data.recordings import Recordings, SnapshotPairs, snapshot_pairs
from siq.errors import NumericalFailure
from siq.inference.diffusion_model import check_units, estimated_diffusion, process_noise_increments
from siq.inference.field_estimate import DiffusionSource, FieldEstimate, read_field, write_field
from siq.inference.library import IdentificationOptions, field_library
from siq.inference.regression import ResidualLikelihood, identify_vector_field, residuals
from siq.numerics.integration import FlowMap
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.landscape_comparison import _check_same_noise
from siq.systems.diffusion import Diffusion
from siq.systems.simulation import SimulationOptions, simulate_snapshots
from siq.workflow import pipeline
from siq.workflow.pipeline import PipelineSettings
from siq.workflow.study import Sampling, StateSpace
from siq.workflow.tables import Status, StepResult

pytestmark = pytest.mark.portable

D = np.array([[1.0, 0.3], [0.3, 0.5]])
NORMALISED = D / np.sqrt(np.linalg.det(D))
LINEAR = IdentificationOptions(degree=1)


def recorded(
    *, noise: float, units: tuple[str | None, str | None] = (None, None), diffusion: np.ndarray = D
) -> Recordings:
    options = SimulationOptions(
        trajectories=40, pairs=100, pair_step=0.01, interval=0.02, noise_intensity=noise
    )
    known = as_system(linear_system(2).with_diffusion(diffusion))
    found = simulate_snapshots(known, options=options, generator=np.random.default_rng(4))
    return replace(found, units=units)


def identified(recordings: Recordings, space: StateSpace | None = None) -> StepResult[FieldEstimate]:
    sampling = Sampling(integrator_step=0.002)
    settings = PipelineSettings(space=space or StateSpace(), sampling=sampling, identification=LINEAR)
    return pipeline.identify_run(settings, recordings, number=0)


def test_an_estimated_d_is_compared_within_its_errors() -> None:
    """With the D behind the recordings it agrees, scaled alike; with any other, or another scale, not."""
    field, states = field_of(identified(recorded(noise=0.02))), np.zeros((1, 2))
    learned = field.dynamics
    assert np.abs(field.diffusion.matrix - NORMALISED).max() > 1e-3  # by far more than rounding
    _check_same_noise(learned.with_diffusion(Diffusion(NORMALISED)), learned, states, found=field)
    for other in (D, 1.2 * NORMALISED, np.eye(2)):
        with pytest.raises(ValueError, match="D is not the same"):
            _check_same_noise(learned.with_diffusion(Diffusion(other)), learned, states, found=field)


def field_of(found: StepResult[FieldEstimate]) -> FieldEstimate:
    assert found.result is not None
    return found.result


def test_d_is_estimated_from_white_noise_at_determinant_one() -> None:
    # Of units that differ, too: noise shows what a unit matrix could not.
    found = identified(recorded(noise=0.02, units=("m", "s")))
    assert found.outcome.status == Status.OK and found.result is not None
    assert found.outcome.reason == DiffusionSource.ESTIMATED.note
    own = field_of(found).diffusion.matrix
    assert np.linalg.det(own) == pytest.approx(1, rel=1e-12)
    # 4000 pairs: a relative standard error of √(2/4000) = 2 % in each entry of the diagonal.
    np.testing.assert_allclose(own, NORMALISED, atol=0.1)
    assert found.result.diagnosis.intensity == pytest.approx(0.02 * np.sqrt(np.linalg.det(D)), rel=0.1)


def test_noises_without_a_significant_correlation_have_none() -> None:
    own = field_of(identified(recorded(noise=0.02, diffusion=np.diag([1.0, 0.5])))).diffusion.matrix
    assert own[0, 1] == own[1, 0] == 0
    assert own[0, 0] / own[1, 1] == pytest.approx(2, rel=0.1)


def test_a_change_of_units_changes_the_estimate_as_a_covariance() -> None:
    first = recorded(noise=0.02)
    units = np.array([1e3, 1e-2])
    one = field_of(identified(first)).diffusion.matrix
    other = field_of(identified(replace(first, values=first.values * units))).diffusion.matrix
    scaled = one * np.outer(units, units)
    np.testing.assert_allclose(other, scaled / np.sqrt(np.linalg.det(scaled)), rtol=1e-6)


@pytest.mark.parametrize("given", ["identity", [2.0, 3.0]])
def test_d_that_is_given_is_used_and_nothing_is_said(given: str | list[float]) -> None:
    found = identified(recorded(noise=0.0, units=("m", "s")), StateSpace(diffusion=given))
    expected = np.eye(2) if given == "identity" else np.diag([2.0, 3.0])
    np.testing.assert_array_equal(field_of(found).diffusion.matrix, expected)
    assert found.outcome.reason == ""


@pytest.mark.parametrize("units", [(None, None), ("m", None), ("m", "m")])
def test_without_noise_units_that_are_alike_or_unknown_have_the_unit_matrix_and_it_is_said(
    units: tuple[str | None, str | None],
) -> None:
    found = identified(recorded(noise=0.0, units=units))
    np.testing.assert_array_equal(field_of(found).diffusion.matrix, np.eye(2))
    assert found.outcome.status == Status.OK and found.outcome.reason == DiffusionSource.UNIT.note


def test_without_noise_d_of_different_units_is_asked_for() -> None:
    found = identified(recorded(noise=0.0, units=("m", "s")))
    assert found.result is None and found.outcome.status == Status.FAILED
    assert "x is in m and y is in s" in found.outcome.reason
    assert "'recordings.diffusion'" in found.outcome.reason
    settings = PipelineSettings(identification=LINEAR)
    with pytest.raises(NumericalFailure, match="D is not known"):
        Landscape.from_recordings(recorded(noise=0.0, units=("m", "s")), settings)


def test_units_that_nobody_knows_are_not_compared() -> None:
    check_units(["x", "y", "z"], [None, "m", ""])
    with pytest.raises(NumericalFailure, match="y is in m and z is in s"):
        check_units(["x", "y", "z"], [None, "m", "s"])


def test_the_derivative_of_another_state_shows_no_noise_of_its_own() -> None:
    draw = np.random.default_rng(0)
    t, x, path = 0.02 * np.arange(3001), np.array([0.5, 0.0]), []
    for _ in range(10 * 3000 + 1):
        path.append(x)
        push = draw.normal() * np.sqrt(0.1 * 0.002)
        x = x + 0.002 * np.array([x[1], -x[0] - x[1]]) + np.array([0.0, push])
    recordings = Recordings.from_arrays(t, np.array(path[::10]), names=["x", "v"])
    pairs = snapshot_pairs(recordings)
    found = identify_vector_field(field_library(["x", "v"], LINEAR), pairs, options=LINEAR)
    assert not found.noise_free and estimated_diffusion(found, pairs=3000) is None


def test_where_d_is_from_is_kept_with_the_field_and_said_of_the_landscape(tmp_path) -> None:
    recordings = recorded(noise=0.0)
    found = identified(recordings)
    assert found.result is not None
    write_field(tmp_path / "vector_field.json", found.result, LINEAR)
    kept = read_field(tmp_path / "vector_field.json")
    assert kept is not None and kept.diffusion_source == DiffusionSource.UNIT
    settings = PipelineSettings(identification=LINEAR)
    seen = pipeline.landscape_of_run(settings, recordings, kept, number=0)
    assert seen.result is not None and seen.outcome.status == Status.OK
    assert DiffusionSource.UNIT.note in seen.result.notes


def test_steps_whose_covariance_is_off_feign_no_dependence_of_d() -> None:
    """A tenth of a step at relaxation rates up to two: to first order in h two of twelve had p ≤ 0.01."""
    generator, step, samples, within, rate = np.random.default_rng(0), 0.1, 2000, 20, 0.22
    x, seen = np.sign(generator.standard_normal(12)), np.empty((samples, 12))
    for row in range(samples):
        seen[row] = x
        for _ in range(within):
            push = np.sqrt(rate * step / within) * generator.standard_normal(12)
            x = x + step / within * (x - x**3) + push
    options = IdentificationOptions()
    for record in (8, 11):
        recordings = Recordings.from_arrays(
            step * np.arange(samples), seen.T[record, None, :, None], names=["x"]
        )
        pairs = snapshot_pairs(recordings)
        found = identify_vector_field(field_library(("x",), options), pairs, options=options)
        assert found.flow.coarse
        assert ResidualLikelihood(found, pairs, residuals(found, pairs)).constant_probability() > 0.1
        assert found.noise_rate[0, 0] == pytest.approx(rate, rel=0.1)


def test_of_a_pair_from_which_f_leads_far_away_the_noise_is_told_without_its_step() -> None:
    x = sympy.Symbol("x", real=True)
    draw, count = np.random.default_rng(0), 200
    begins = np.append(draw.uniform(-1, 1, count - 1), 50.0)[:, None]
    pairs = SnapshotPairs(begins, begins, np.full(count, 0.1), np.zeros(count, dtype=int))
    library = field_library(("x",), IdentificationOptions(degree=3))
    coefficients = np.array([[1.0 if term == x else -1.0 if term == x**3 else 0.0] for term in library.terms])
    support = np.argwhere(coefficients.T)
    found = FieldEstimate(
        library, coefficients, support, np.eye(len(support)), np.array([[0.2]]), 1.0,
        FlowMap(steps=2, coarse=True), Diffusion.identity(1),
    )  # fmt: skip
    rest = draw.standard_normal((count, 1))
    told = process_noise_increments(found, pairs, rest)
    assert np.isfinite(told).all()
    assert told[-1, 0] == pytest.approx(rest[-1, 0] / np.sqrt(0.1))
    strays = pairs.take(np.full(count, count - 1))
    with pytest.raises(NumericalFailure, match="sample more often"):
        process_noise_increments(found, strays, rest)
