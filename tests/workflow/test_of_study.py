"""Settings of steps from studies, and through the parameters of a rule back again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from pydantic import TypeAdapter, ValidationError

from siq.report.figures import FiguresSettings
from siq.report.study_page import PageSettings
from siq.systems.dynamics import Dynamics
from siq.workflow.identification_step import IdentifySettings
from siq.workflow.landscape_step import LandscapeSettings
from siq.workflow.recordings_step import DrawSettings
from siq.workflow.refinement_step import RefineSettings
from siq.workflow.regression_step import RegressSettings
from siq.workflow.scoring_step import ScoreSettings
from siq.workflow.settings import Sampling, StateSpace, StudyParts, card_content, settings_of
from siq.workflow.study import Study, load_study
from siq.workflow.training_step import TrainSettings
from workflow.reproduction import ReproductionSettings

Write = Callable[..., Path]
CLASSES = (
    DrawSettings, IdentifySettings, TrainSettings, RegressSettings, RefineSettings, ScoreSettings,
    LandscapeSettings, FiguresSettings, PageSettings, ReproductionSettings,
)  # fmt: skip
SIMULATED = """\
name: noisy
system: archetype3d
simulation: {noise_intensity: 0.02, pair_step: 0.01, interval: 0.1}
training: {steps: 7, check: {}}
landscape: {}
"""
RECORDED = """\
name: measured
recordings: {file: measured.csv, states: [x, v], diffusion: [1.0, 4.0], pair_step: 0.5}
training: {}
landscape: {}
"""


@pytest.fixture(params=["simulated", "recorded"])
def study(request: pytest.FixtureRequest, write: Write, archetype: Dynamics) -> tuple[Study, Dynamics | None]:
    if request.param == "simulated":
        return load_study(write(SIMULATED)), archetype
    return load_study(write(RECORDED)), None


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_settings_survive_the_parameters_of_a_rule(
    cls: type[object], study: tuple[Study, Dynamics | None]
) -> None:
    settings = settings_of(cls, *study)
    adapter: TypeAdapter[object] = TypeAdapter(cls)
    plain = adapter.dump_json(settings)
    assert adapter.validate_json(plain) == settings


def test_sampling_is_that_of_the_simulation_or_of_the_recordings(write: Write, archetype: Dynamics) -> None:
    simulated = StudyParts(load_study(write(SIMULATED)), archetype)
    assert simulated.sampling == Sampling(0.01, 0.002)
    recorded = StudyParts(load_study(write(RECORDED)), None)
    assert recorded.sampling == Sampling(0.5, None)
    assert recorded.simulation is None  # nothing is simulated, and nothing runs again for it


def test_the_states_are_those_of_the_card_or_of_the_study(write: Write, archetype: Dynamics) -> None:
    space = StudyParts(load_study(write(SIMULATED)), archetype).space
    assert space.names == ("x", "y", "z") and space.unit("t") == archetype.time_unit
    assert space.noise("xyz").matrix.tolist() == archetype.diffusion.matrix.tolist()
    assert StudyParts(load_study(write(RECORDED)), None).space.noise("xy").matrix.tolist() == [[1, 0], [0, 4]]


def test_what_a_card_says_does_not_change_with_its_title(archetype: Dynamics) -> None:
    from dataclasses import replace

    said = card_content(archetype)
    assert card_content(replace(archetype, title="Renamed")) == said
    assert card_content(replace(archetype, domain=2 * archetype.box)) != said


def test_an_unknown_setting_is_refused() -> None:
    with pytest.raises(ValidationError):
        TypeAdapter(StateSpace).validate_python({"diffusions": "identity"})
