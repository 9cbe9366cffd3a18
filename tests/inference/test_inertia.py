"""Whether positions have inertia is told with its error, and what cannot tell says so."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from particles import particle

from siq.data.recordings import Recordings
from siq.errors import NumericalFailure
from siq.inference.identify import identify
from siq.inference.library import IdentificationOptions
from siq.inference.observation import inertia_test
from siq.numerics.randomness import generator
from siq.systems.diffusion import Diffusion
from siq.workflow import pipeline
from siq.workflow.pipeline import PipelineSettings
from siq.workflow.tables import Status


def overdamped(seed: int, *, step: float, samples: int = 1_000) -> Recordings:
    """dx = (x - x³) dt + √0.2 dW, a sensor of 0.05."""
    draw = np.random.default_rng(seed)
    x, seen = np.ones(4), np.empty((4, samples))
    for row in range(samples):
        seen[:, row] = x
        for push in np.sqrt(0.2 * step / 20) * draw.standard_normal((20, 4)):
            x = x + step / 20 * (x - x**3) + push
    seen += 0.05 * draw.standard_normal(seen.shape)
    return Recordings.from_arrays(step * np.arange(samples), seen[:, :, None], names=["x"])


def test_a_particle_that_swings_has_inertia() -> None:
    test = inertia_test(particle(1, records=4)[0], degree=3)
    assert test.seen and test.needs_velocity and not test.overdamped
    assert test.friction_error is not None
    assert abs(test.friction - 0.3) < 3.5 * test.friction_error
    assert abs(test.frequency - np.sqrt(2)) < 3.5 * test.frequency_error < 0.3
    assert "it swings in its well" in test.sentence("s")


def test_a_particle_that_creeps_has_inertia_all_the_same() -> None:
    test = inertia_test(particle(2, records=4, friction=4.0)[0], degree=3)
    assert test.seen and test.friction_error is not None
    assert abs(test.friction - 4) < 3.5 * test.friction_error
    assert "without a swing" in test.sentence()


def test_what_has_no_inertia_is_not_seen_to_have_any() -> None:
    test = inertia_test(overdamped(3, step=0.02), degree=3)
    assert test.overdamped and not test.seen and test.friction_error is None
    assert test.friction > 10 * test.relaxation > 10  # the wells relax with 2
    assert test.sentence().startswith("no inertia is seen")


def test_a_coarse_record_says_that_it_cannot_tell_and_which_could() -> None:
    test = inertia_test(overdamped(4, step=0.5, samples=250), degree=3)
    assert not (test.seen or test.overdamped)
    assert "cannot be told" in test.sentence("s") and "a step of at most 0.0" in test.sentence("s")


def test_it_is_of_one_position() -> None:
    two = Recordings.from_arrays(np.arange(30.0), np.zeros((30, 2)), names=["x", "y"])
    with pytest.raises(NumericalFailure, match="one position"):
        inertia_test(two)


def test_a_position_with_inertia_gets_a_velocity() -> None:
    settings = PipelineSettings(identification=IdentificationOptions(degree=3))
    done = pipeline.identify_run(settings, particle(1, records=4)[0], number=0)
    assert done.outcome.status is Status.OK and done.result is not None and done.result.hidden_states
    assert "velocities were not recorded" in done.outcome.reason


def test_a_position_alone_is_refused_and_the_option_named() -> None:
    settings = PipelineSettings(identification=IdentificationOptions(degree=3, hidden_velocities=False))
    done = pipeline.identify_run(settings, particle(1, records=4)[0], number=0)
    assert done.outcome.status in (Status.WARNING, Status.FAILED)
    assert "identification.hidden_velocities: true" in done.outcome.reason
    assert "has inertia" in done.outcome.reason


def test_where_d_of_the_position_is_given_the_option_is_named() -> None:
    recordings, draw = particle(1, records=4)[0], partial(generator, 0, 0)
    try:
        found = identify(
            recordings, options=IdentificationOptions(degree=3), draw=draw, diffusion=Diffusion.identity(1)
        )
        said = found.prediction.reason if found.prediction is not None else ""
    except NumericalFailure as error:
        said = str(error)
    assert "has inertia" in said and "identification.hidden_velocities: true" in said


def test_velocities_of_a_position_without_inertia_are_refused_and_the_option_named() -> None:
    settings = PipelineSettings(identification=IdentificationOptions(degree=3, hidden_velocities=True))
    done = pipeline.identify_run(settings, overdamped(3, step=0.02), number=0)
    assert done.result is None
    assert "leave 'identification.hidden_velocities' out" in done.outcome.reason


@pytest.mark.slow
def test_false_alarms_are_rare() -> None:
    assert not any(inertia_test(overdamped(seed, step=0.02), degree=3).seen for seed in range(50, 70))
