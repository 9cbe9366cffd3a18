"""All steps of a run in memory, on systems whose answer is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from known_settings import PAPER
from known_systems import as_system, double_well, potential_gradient, potential_values

from siq.data.recordings import Recordings
from siq.errors import NumericalFailure
from siq.networks import training as networks_training
from siq.networks.decomposition import CheckOptions, NetworksByWell, TrainedNetworks, TrainingOptions, pack
from siq.networks.regression import RegressionOptions
from siq.networks.training import start
from siq.quasipotential import refinement as quasipotential_refinement
from siq.quasipotential.certificate import references_about
from siq.quasipotential.certificate_tests import CertificateOptions, Reference
from siq.quasipotential.formulas import _decomposition_data, exact_decomposition
from siq.quasipotential.refinement import RefinementOptions
from siq.quasipotential.transitions import Transition
from siq.systems.dynamics import Dynamics
from siq.systems.phase_portrait import PhasePortrait
from siq.systems.simulation import SimulationOptions
from siq.workflow import pipeline, training
from siq.workflow.pipeline import Analysis, PipelineSettings, analyse
from siq.workflow.study import Sampling, StateSpace
from siq.workflow.tables import COLUMNS, Method, Outcome, Status, Step, StepResult
from workflow import scoring

KNOWN = double_well(2)
SYSTEM = as_system(KNOWN)
SIMULATION = SimulationOptions(trajectories=60, pairs=20, pair_step=0.01, interval=0.05)
SETTINGS = PipelineSettings(
    seed=3,
    space=StateSpace(diffusion=KNOWN.diffusion.tolist()),
    sampling=Sampling(pair_step=0.01),
)
BRIEF = replace(
    PAPER,
    widths=(6,),
    steps=20,
    batch_size=32,
    matching="symmetric",
    thinning_distance=0.3,
    precision="float32",
)
CHECKED = replace(
    BRIEF, thinning_distance=None, check=CheckOptions(first=20, every=20, attempts=1), output_weights=100
)


FAILED: StepResult[TrainedNetworks] = StepResult(
    None, Outcome(0, Step.TRAIN, Status.FAILED, "the loss became infinite")
)


def drawn(*, number: int = 0) -> StepResult[Recordings]:
    settings = replace(SETTINGS, simulation=SIMULATION)
    return pipeline.draw_run(settings, SYSTEM, number=number)


@pytest.fixture(scope="module")
def recordings() -> Recordings:
    found = drawn().result
    assert found is not None
    return found


@pytest.fixture(scope="module")
def analysis(recordings: Recordings) -> Analysis:
    return analyse(recordings, SETTINGS)


@pytest.fixture(scope="module")
def known_references() -> dict[Any, Any]:
    return {}


@pytest.fixture
def followed_once(known_references: dict[Any, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Characteristics of the same f from the same attractors, which no networks change: once for all."""

    def references(
        dynamics: Dynamics, portrait: PhasePortrait, *, seed: int, ways: Sequence[Transition] = ()
    ) -> tuple[Reference, ...]:
        attractors = [one.position.tobytes() for one in portrait.attractors]
        key = (seed, len(ways), *map(str, dynamics.formulas), portrait.box.tobytes(), *attractors)
        if key not in known_references:
            known_references[key] = references_about(dynamics, portrait, ways=ways, seed=seed)
        return known_references[key]

    monkeypatch.setattr(quasipotential_refinement, "references_about", references)


def test_every_step_that_was_asked_for_has_an_outcome(analysis: Analysis) -> None:
    said = {one.step: one.status for one in analysis.outcomes}
    assert said == {
        Step.IDENTIFY: Status.OK, Step.TRAIN: Status.SKIPPED, Step.REFINE: said[Step.REFINE],
        Step.LANDSCAPE: Status.OK,
    }  # fmt: skip
    assert said[Step.REFINE] in (Status.OK, Status.WARNING) and analysis.regressed is None


def test_v_and_its_barriers_are_right(analysis: Analysis) -> None:
    refined = analysis.refined.formulas[Method.REFINED]
    assert refined.potential is not None
    x = np.random.default_rng(0).uniform(-1, 1, size=(50, 2))
    ours = refined.evaluate_gradient(np.ascontiguousarray(x.T)).T
    assert np.abs(ours - potential_gradient(KNOWN, x)).max() < 1e-5
    assert analysis.landscape is not None and analysis.landscape.result is not None
    found = analysis.landscape.result
    for way in found.transitions:
        saddle, bottom = way.saddle.position, found.attractors[way.start].position
        top, low = potential_values(KNOWN, np.stack([saddle, bottom]))
        assert way.barrier == pytest.approx(2 * (top - low), rel=1e-4)


def test_the_same_seed_gives_the_same_and_another_run_another_answer(
    recordings: Recordings, analysis: Analysis
) -> None:
    same = analyse(recordings, replace(SETTINGS, landscape=None))
    assert same.landscape is None
    assert same.refined.certificates == analysis.refined.certificates
    first, second = drawn(number=0).result, drawn(number=1).result
    assert first is not None and second is not None and not np.array_equal(first.values, second.values)


@pytest.mark.usefixtures("followed_once")
@pytest.mark.parametrize(
    ("training", "agrees"),
    [
        pytest.param(CHECKED, True, id="with output weights", marks=pytest.mark.slow),
        pytest.param(
            replace(CHECKED, thinning_distance=0.3),
            True,
            id="with fewer points than units",
            marks=pytest.mark.slow,
        ),
        pytest.param(replace(CHECKED, learning_rate=1e30), True, id="with lost networks"),
        pytest.param(BRIEF, False, id="as trained, far too briefly"),
    ],
)
def test_networks_have_to_agree_where_settings_ask_for_them_and_random_ones_never_do(
    recordings: Recordings, analysis: Analysis, training: TrainingOptions, agrees: bool
) -> None:
    settings = replace(SETTINGS, training=training, published_method=False, landscape=None)
    found = analyse(recordings, settings, device="cpu")
    assert found.trained.result is not None and found.trained.outcome.status == Status.OK
    # This V has a kink between its wells, which no single set of output weights follows.
    assert isinstance(found.trained.result, NetworksByWell) == agrees
    certificate, control = (found.refined.certificates[one] for one in (Method.REFINED, Method.CONTROL))
    assert certificate["certified"] is certificate["tests"]["agreement"]["passed"] is agrees
    assert [name for name, test in certificate["tests"].items() if not test["passed"]] == (
        [] if agrees else ["agreement"]
    )
    assert control["certified"] is False and list(control["tests"]) == ["agreement"]
    assert control["tests"]["agreement"]["passed"] is False
    assert control["reason"] == control["tests"]["agreement"]["reason"]
    # Networks are compared with the refined V, and take no part in it.
    refined, alone = (one.refined.formulas[Method.REFINED] for one in (found, analysis))
    assert _decomposition_data(refined) == _decomposition_data(alone)


@pytest.mark.parametrize(
    "training",
    [
        pytest.param(None, id="without networks"),
        pytest.param(BRIEF, id="with networks", marks=pytest.mark.slow),
    ],
)
def test_the_regression_does_not_steer_the_refined_formulas(
    recordings: Recordings, training: TrainingOptions | None
) -> None:
    # Of a degree too low for V, of one that is high enough, and where hardly a point is below the level.
    told = (RegressionOptions(degree=2, level=1e6), RegressionOptions(degree=5, level=0.5))
    settings = replace(SETTINGS, training=training, landscape=None)
    one, other = (
        analyse(recordings, replace(settings, regression=each), device="cpu").refined for each in told
    )
    first, second = (_decomposition_data(each.formulas[Method.REFINED]) for each in (one, other))
    assert first == second
    assert one.certificates[Method.REFINED] == other.certificates[Method.REFINED]


def test_networks_are_trained_with_the_d_that_the_noise_shows() -> None:
    noisy = replace(SIMULATION, pairs=40, noise_intensity=0.02)
    found = pipeline.draw_run(PipelineSettings(seed=3, simulation=noisy), SYSTEM, number=0).result
    assert found is not None
    settings = PipelineSettings(
        sampling=Sampling(0.01, 0.002), training=replace(BRIEF, matching="explicit", steps=2)
    )
    record = pipeline.identify_run(settings, found, number=0).result
    networks = training.train_block(settings, {0: (found, record)}, device="cpu")[0][0].result
    assert record is not None and networks is not None
    np.testing.assert_allclose(networks.diffusion, record.diffusion.matrix, rtol=1e-6)
    shape = KNOWN.diffusion / np.sqrt(np.linalg.det(KNOWN.diffusion))
    np.testing.assert_allclose(networks.diffusion, shape, atol=0.2)


def test_a_run_without_trajectories_is_skipped_by_every_step_after() -> None:
    settings = SETTINGS
    nothing = pipeline.identify_run(settings, None, number=5)
    assert (nothing.outcome.run, nothing.outcome.status) == (5, Status.SKIPPED)
    told = replace(SETTINGS, training=BRIEF)
    trained, networks, _ = training.train_block(told, {5: (None, None)})
    assert not networks and trained[5].result is None
    assert trained[5].outcome.reason == "the run has no trajectories"


def test_a_simulation_that_runs_to_infinity_fails_and_says_so() -> None:
    away = replace(SYSTEM, equations=tuple(symbol**3 for symbol in SYSTEM.symbols))
    settings = PipelineSettings(simulation=replace(SIMULATION, interval=2.0))
    found = pipeline.draw_run(settings, away, number=2)
    assert found.result is None
    assert (found.outcome.step, found.outcome.status) == (Step.SIMULATE, Status.FAILED)


def test_recordings_are_taken_whole_by_the_first_run_and_resampled_by_others(
    recordings: Recordings,
) -> None:
    settings = PipelineSettings()
    first, second = (pipeline.draw_run(settings, recordings, number=number) for number in (0, 1))
    assert first.result is recordings and second.result is not recordings
    assert first.outcome.step == second.outcome.step == Step.RESAMPLE


def test_a_training_without_a_check_goes_on_when_it_is_given_more_steps(
    recordings: Recordings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts = []

    def counted(*arguments: Any, **named: Any) -> Any:
        starts.append(named)
        return start(*arguments, **named)

    monkeypatch.setattr(networks_training, "start", counted)

    def trained(steps: int, folder: str, *, version: int = 1) -> tuple[TrainedNetworks, list[int]]:
        settings = replace(SETTINGS, training=replace(BRIEF, steps=steps))
        _, found, history = training.train_block(
            settings, {0: (recordings, None)}, folder=tmp_path / folder, device="cpu", version=version
        )
        training.clean(tmp_path / folder, settings.training)
        assert isinstance(found[0], TrainedNetworks)
        return found[0], history["step"].tolist()

    whole, _ = trained(50, "whole")
    trained(20, "parts")
    more, steps = trained(50, "parts")
    assert len(starts) == 2 and steps == list(range(1, 51))
    for one, other in zip(pack([more]).values(), pack([whole]).values(), strict=True):
        assert np.array_equal(one, other)
    trained(20, "parts")  # fewer steps are no more of what there is
    trained(20, "parts", version=2)
    assert len(starts) == 4
    assert len(list((tmp_path / "parts").iterdir())) == 1
    training.clean(tmp_path / "parts")
    assert not list((tmp_path / "parts").iterdir())


def test_why_a_check_could_not_be_prepared_is_the_reason(
    recordings: Recordings, analysis: Analysis, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*arguments: object, **named: object) -> None:
        raise NumericalFailure("the attractors cannot be told apart")

    monkeypatch.setattr(training, "OutputWeights", refuse)
    settings = replace(SETTINGS, training=CHECKED)
    runs = {0: (recordings, analysis.identified.result)}
    said = training.train_block(settings, runs, device="cpu")[0][0].outcome
    assert said.status == Status.WARNING
    assert said.reason.endswith("could not be prepared: the attractors cannot be told apart")


@pytest.mark.usefixtures("followed_once")
@pytest.mark.parametrize(
    "further",
    [
        pytest.param({"certificate": CertificateOptions(error=1e-12)}, id="refused by another test"),
        pytest.param({"refinement": RefinementOptions(routes=("local", "network"))}, id="compared"),
        pytest.param({"refinement": RefinementOptions(routes=("network",))}, id="network alone"),
    ],
)
def test_why_a_training_failed_is_what_refinement_says_first(
    recordings: Recordings, analysis: Analysis, further: dict[str, Any]
) -> None:
    settings = replace(SETTINGS, **further)
    found = pipeline.refine_run(settings, recordings, analysis.identified, FAILED)
    assert found.outcome.status == Status.WARNING
    assert found.outcome.reason.startswith("the training gave no networks (the loss became infinite)")


@pytest.mark.usefixtures("followed_once")
def test_where_refinement_needs_no_networks_their_failure_is_a_note(
    recordings: Recordings, analysis: Analysis
) -> None:
    found = pipeline.refine_run(SETTINGS, recordings, analysis.identified, FAILED)
    assert found.outcome.status == Status.OK
    notes = found.certificates[Method.REFINED]["notes"]
    assert notes[0] == "the training gave no networks (the loss became infinite)"


def test_scores_are_in_the_columns_of_the_contract(analysis: Analysis) -> None:
    settings = SETTINGS
    certificates = {str(name): one for name, one in analysis.refined.certificates.items()}
    formulas = {str(name): one for name, one in analysis.refined.formulas.items()}
    assert KNOWN.potential is not None
    exact = exact_decomposition(SYSTEM, 2 * KNOWN.potential)
    found = scoring.score_run(settings, formulas, certificates, None, number=0, system=SYSTEM, exact=exact)
    assert found["score_outcome"] == [Outcome(0, Step.SCORE)]
    for name in ("coefficients", "rrmse", "prediction", "certificates"):
        assert list(found[name].columns) == list(COLUMNS[name])
    errors = found["rrmse"].set_index("method")["rrmse"]
    assert errors["refined"] < 1e-5 and np.isnan(errors["regression"])
    (skipped,) = scoring.score_run(settings, {}, {}, None, number=0)["score_outcome"]
    assert skipped.reason == "there is no formula to score"
