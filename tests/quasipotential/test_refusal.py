"""Where there is no landscape, what the recordings show by themselves is said all the same."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from told_landscapes import landscape, told

import siq
from siq.data.inspection import inspect
from siq.data.recordings import Recordings
from siq.data.states import RecordStates
from siq.inference.library import IdentificationOptions
from siq.quasipotential.landscape import Landscape, NoLandscape
from siq.remarks import Remark
from siq.report.landscape import answer_lines
from siq.report.summary import summarise
from siq.workflow.pipeline import PipelineSettings
from siq.workflow.tables import Outcome, Status, Step, why_no_landscape

LASTS = 60  # samples, in the mean


def telegraph() -> Recordings:
    """Two levels, hops between them, and about each level values that know nothing of each other."""
    draw = np.random.default_rng(3)
    hops = draw.random(12_000) < 1 / LASTS
    x = 2.0 * (np.cumsum(hops) % 2) - 1 + 0.2 * draw.standard_normal(len(hops))
    table = Recordings.from_arrays(0.5 * np.arange(len(x)), x[:, None], names=["x"])
    return table


@cache
def of_telegraph() -> RecordStates:
    """What is seen of it."""
    seen = inspect(telegraph()).switching
    assert seen is not None
    return seen


@cache
def of_double_well() -> RecordStates:
    """What is seen of the hops of a double well."""
    seen = RecordStates.of(double_well())
    assert seen is not None and seen.supported
    return seen


def double_well() -> Recordings:
    draw = np.random.default_rng(1)
    x = np.empty((8_000, 1))
    x[0] = 1.0
    for before in range(len(x) - 1):
        kick = np.sqrt(0.25 * 0.05) * draw.standard_normal()
        x[before + 1] = x[before] + 0.05 * (x[before] - x[before] ** 3) + kick
    return Recordings.from_arrays(0.05 * np.arange(len(x)), x, names=["x"])


@pytest.mark.parametrize("shift", [0.0, 0.3, 1.2])
def test_states_elsewhere_than_the_wells_come_first(shift: float) -> None:
    seen = of_double_well()
    two = summarise(told(landscape([[-0.5], [0.5]], [0.25, 0.35])))
    wells = np.array([one.position[0] for one in two.wells])
    name = two.names[0]
    moved = replace(
        seen, columns=(name,), places=np.sort(wells)[:, None] + shift * np.ptp(wells) * np.eye(2, 1)
    )
    first = answer_lines(two, seen=moved)[0]
    assert (first == moved.sentence()) == (shift > 0.5)
    assert answer_lines(two, seen=moved, rung=6)[0] == answer_lines(two)[0]


@pytest.mark.filterwarnings("ignore:invalid value")  # the root is what f is refused for
def test_a_refusal_carries_the_states_of_the_record() -> None:
    few = PipelineSettings(identification=IdentificationOptions(functions=("sqrt(x)",)))
    with pytest.raises(NoLandscape) as refused:
        siq.Landscape.from_recordings(telegraph(), few)
    states = refused.value.states
    assert states is not None
    assert states.as_data() == of_telegraph().as_data()  # what the page is made of
    times = states.dwell_times()
    for row in times.itertuples():
        assert row.lowest < LASTS * 0.5 < row.highest
    assert times["visits"].sum() == states.transitions == pytest.approx(200, abs=45)
    assert states.levels == pytest.approx((-1, 1), abs=0.3)
    assert (states.density * np.diff(states.edges)).sum() == pytest.approx(1)
    said = str(refused.value)
    assert said.startswith("The record has two states of x")
    assert "samples closer together" in said and said.endswith("rests on no formula.")
    assert refused.value.reason not in said  # the levels alone say why


@pytest.mark.slow
def test_a_landscape_that_misses_the_states_says_so_as_the_page_does() -> None:
    line = PipelineSettings(identification=IdentificationOptions(degree=1))
    landscape = Landscape.from_recordings(double_well(), line)
    seen = landscape.recorded_states
    assert len(landscape.attractors) == 1 and seen is not None and seen.supported
    first, _, second, *_ = landscape.report().splitlines()
    assert first == seen.sentence()
    assert second.startswith("What was identified misses them: the recordings show one stable state")


def test_states_of_a_record_come_back_from_plain_data() -> None:
    seen = of_telegraph()
    again = RecordStates.from_data(json.loads(json.dumps(seen.as_data())))
    assert again.as_data() == seen.as_data() and again.sentence() == seen.sentence()


def test_nothing_is_added_to_what_is_certified() -> None:
    seen = of_telegraph()
    two = summarise(told(landscape([[-0.5], [0.5]], [0.25, 0.35])))
    (answer, *further) = answer_lines(two, seen=seen, rung=6)
    assert answer_lines(two) == [answer, *further]
    last = answer_lines(two, seen=seen)[-1]
    assert last.startswith("Without any formula: the record has two states of x")
    first, second, *_ = answer_lines(two, seen=replace(seen, levels=(-0.5, 0.5)), rung=3)
    assert first.startswith("The record has two states of x")
    assert second.startswith("What was identified did not pass every test against the record")
    limit = Remark("data.not_stationary", {"period": None, "unit": None})
    _, second, *_ = answer_lines(two, seen=replace(seen, levels=(-0.5, 0.5), rung=1, limit=limit), rung=1)
    assert second.startswith("What was identified knows nothing of that change")
    single, one = replace(seen, supported=False), summarise(told(landscape([[-0.5]], [0.25])))
    for wells in (two, one):
        first, second, *_ = answer_lines(wells, seen=single, rung=0)
        assert first.startswith("By itself the record shows one state of x")
        assert second.startswith("What was identified did not pass every test against the record")
    # Two peaks that may be no states are told, if no linear noise makes them.
    assert "It dwells near" in first and f"{seen.transitions} times" in first
    assert "dwells" not in answer_lines(one, seen=replace(single, probability=0.5), rung=0)[0]
    assert answer_lines(one, seen=single, rung=4)[0] == answer_lines(one)[0]


def test_the_reason_is_that_of_the_step_that_failed() -> None:
    outcomes = [
        Outcome(0, Step.IDENTIFY, Status.FAILED, "no term is significant"),
        Outcome(0, Step.REFINE, Status.SKIPPED, "no vector field was identified (no term is significant)"),
        Outcome(0, Step.LANDSCAPE, Status.SKIPPED, "no vector field was identified"),
    ]
    assert why_no_landscape(outcomes) == "no term is significant"
    later = Outcome(0, Step.LANDSCAPE, Status.FAILED, "no path was found.")
    assert why_no_landscape([Outcome(0, Step.REFINE, Status.FAILED, "no V"), later]) == "no path was found"
    assert why_no_landscape([Outcome(0, Step.IDENTIFY)]) == "the recorded states lead to no stable state"
