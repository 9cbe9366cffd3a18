"""Parts of the search: blocks for clustered errors, and what tells most where nothing has a name."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from siq.mismatch.clusters import blocks_of, correlation_time
from siq.mismatch.location import most_telling
from siq.mismatch.roles import Roles
from siq.mismatch.search import SearchOptions, accepted
from siq.mismatch.structure import Curve, Direction, Structure
from siq.mismatch.trials import Trial


def autoregressive(memory: float, size: int) -> np.ndarray:
    kicks = np.random.default_rng(3).normal(size=size)
    series = np.empty(size)
    now = 0.0
    for place, kick in enumerate(kicks):
        now = memory * now + kick
        series[place] = now
    return series


@pytest.mark.parametrize("memory", [0.0, 0.5, 0.9])
def test_the_correlation_time_of_an_autoregressive_series(memory: float) -> None:
    found = correlation_time(autoregressive(memory, 40_000))
    assert found == pytest.approx((1 + memory) / (1 - memory), rel=0.15)


def test_blocks_are_long_compared_with_correlations_and_never_span_recordings() -> None:
    recording = np.repeat([0, 1], [3000, 6000])
    block = blocks_of(recording, autoregressive(0.9, 9000), least=10)
    count = block.max() + 1
    assert sorted(set(block)) == list(range(count))
    assert 10 < count < 9000 / (3 * 19)
    for place in range(count):
        rows = np.flatnonzero(block == place)
        assert len(set(recording[rows])) == 1 and (np.diff(rows) == 1).all()


def test_there_are_at_least_so_many_blocks() -> None:
    assert blocks_of(np.zeros(400, dtype=int), autoregressive(0.99, 400), least=10).max() == 9


def structure(excess: float, *gains: tuple[str, str, float]) -> Structure:
    curves = [
        Curve(Direction((equation,), coordinate, False, np.zeros(4)), np.zeros(4), np.ones(4), gain, 0.0)
        for equation, coordinate, gain in gains
    ]
    return Structure(tuple(curves), 0.0, 0.0, excess + 100, 100)


MOTION = Roles((("x", "v"),), (), (), (), ("v",))
POPULATIONS = Roles((), (), ("prey", "predator"), (), ("prey", "predator"))


@pytest.mark.parametrize(
    ("roles", "found", "expected"),
    [
        # The best coordinate is that of the motion itself.
        (MOTION, structure(1000, ("v", "x", 700.0), ("v", "u", 400.0)), "x"),
        # The input tells hardly more than the velocity.
        (MOTION, structure(1000, ("v", "u", 990.0), ("v", "v", 950.0)), "v"),
        # The input tells nearly all, and the motion does not.
        (MOTION, structure(1000, ("v", "u", 990.0), ("v", "v", 400.0)), "u"),
        # No coordinate tells nearly all.
        (MOTION, structure(1000, ("v", "u", 500.0), ("v", "v", 200.0)), "x, v"),
        (POPULATIONS, structure(1000, ("prey", "t", 990.0), ("prey", "prey", 985.0)), "prey"),
        (POPULATIONS, structure(1000, ("prey", "predator", 500.0), ("prey", "prey", 200.0)), "predator"),
    ],
)
def test_the_coordinate_that_tells_most(roles: Roles, found: Structure, expected: str) -> None:
    equations, coordinate = most_telling(found, roles)
    assert equations == (found.curves[0].direction.equations)
    assert coordinate == expected


@pytest.mark.parametrize(("random_forces", "expected"), [(False, "better"), (True, "steadier")])
def test_of_equals_the_one_that_all_recordings_ask_for_where_white_errors_mean_little(
    random_forces: bool, expected: str
) -> None:
    def trial(name: str, gain: float, p_cluster: float) -> Trial:
        fit = SimpleNamespace(has_process_noise=random_forces)
        return Trial(SimpleNamespace(name=name, new=("c",)), fit, gain, 7.0 - gain, 0.0, p_cluster)

    trials = [trial("better", 331, 1e-9), trial("steadier", 325, 1e-49), trial("worse", 276, 1e-60)]
    found = accepted(trials, 50, 1e-4, options=SearchOptions())
    assert found is not None and found.best.candidate.name == expected
    assert {each.candidate.name for each in found.indistinguishable} == {"better", "steadier"} - {expected}
