"""Settings of steps from studies, and through the parameters of a rule back again."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields
from operator import attrgetter
from pathlib import Path

import pytest
from pydantic import TypeAdapter, ValidationError

from siq.systems.dynamics import Dynamics
from siq.workflow.study import (
    PipelineSettings,
    Sampling,
    StateSpace,
    Study,
    card_content,
    load_study,
    settings_of,
)
from workflow.tasks import TASKS

Write = Callable[..., Path]
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


KNOWN = {field.name for field in fields(PipelineSettings)}


@pytest.mark.parametrize("task", TASKS)
def test_settings_survive_the_parameters_of_a_rule(task: str, study: tuple[Study, Dynamics | None]) -> None:
    settings = settings_of(*study)
    names = [name for name in TASKS[task].options if name.partition(".")[0] in KNOWN]
    plain = json.loads(json.dumps(settings.parts(names)))
    again = PipelineSettings(**plain)
    for name in names:
        assert attrgetter(name)(again) == attrgetter(name)(settings)


def test_recordings_are_drawn_with_the_angles_of_the_study(write: Write) -> None:
    text = "name: turns\nrecordings: {file: turns.csv}\nidentification: {angles: {phi: [0, 360]}}\n"
    settings = settings_of(load_study(write(text)), None)
    options = [name for name in TASKS["draw"].options if name.partition(".")[0] in KNOWN]
    again = PipelineSettings(**json.loads(json.dumps(settings.parts(options))))
    assert again.identification.angles == settings.identification.angles == {"phi": (0.0, 360.0)}


def test_sampling_is_that_of_the_simulation_or_of_the_recordings(write: Write, archetype: Dynamics) -> None:
    simulated = settings_of(load_study(write(SIMULATED)), archetype)
    assert simulated.sampling == Sampling(0.01, 0.002)
    recorded = settings_of(load_study(write(RECORDED)), None)
    assert recorded.sampling == Sampling(0.5, None)
    assert recorded.simulation is None  # nothing is simulated, and nothing runs again for it


def test_the_states_are_those_of_the_card_or_of_the_study(write: Write, archetype: Dynamics) -> None:
    space = settings_of(load_study(write(SIMULATED)), archetype).space
    assert space.names == ("x", "y", "z") and space.unit("t") == archetype.time_unit
    assert space.noise("xyz").matrix.tolist() == archetype.diffusion.matrix.tolist()
    assert settings_of(load_study(write(RECORDED)), None).space.noise("xy").matrix.tolist() == [
        [1, 0],
        [0, 4],
    ]


def test_what_a_card_says_does_not_change_with_its_title(archetype: Dynamics) -> None:
    from dataclasses import replace

    said = card_content(archetype)
    assert card_content(replace(archetype, title="Renamed")) == said
    assert card_content(replace(archetype, domain=2 * archetype.box)) != said


def test_an_unknown_setting_is_refused() -> None:
    with pytest.raises(ValidationError):
        TypeAdapter(StateSpace).validate_python({"diffusions": "identity"})
