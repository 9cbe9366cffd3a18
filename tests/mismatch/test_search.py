"""Parts of the search: blocks for clustered errors, and what tells most where nothing has a name."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from siq.mismatch.clusters import blocks_of, correlation_time
from siq.mismatch.investigation import named_or_not
from siq.mismatch.location import most_telling
from siq.mismatch.remainder import Remainder, without_patches
from siq.mismatch.roles import Roles
from siq.mismatch.search import Found, Search, accepted
from siq.mismatch.search_options import SearchOptions
from siq.mismatch.structure import Curve, Direction, Structure
from siq.mismatch.trials import TriedMechanism


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


def remainder(share: float, p_curves: float = 1.0) -> Remainder:
    """What is left, of which only the share and the probability count here."""
    return Remainder(structure(0), Structure((), p_curves, 1.0, 100, 100), share)


def found_with(*gains: float) -> Search:
    """A search that found one mechanism after the other, each with what it gained."""

    def found(place: int, gain: float) -> Found:
        candidate = SimpleNamespace(name=f"mechanism {place}")
        return Found(TriedMechanism(candidate, SimpleNamespace(number=place), gain, -gain, 0.0, 0.0), ())

    each = tuple(found(place, gain) for place, gain in enumerate(gains, start=1))
    return Search(SimpleNamespace(number=0), each, each[-1].best.fit, ())


MOTION = Roles((("x", "v"),), (), (), (), ("v",))
FRAME = Roles((), (("P", "Q"),), (), (), ("P", "Q"))
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
        # The time tells less than a third more than a state, of whatever equation.
        (POPULATIONS, structure(1000, ("prey", "t", 155.0), ("prey", "predator", 122.0)), "predator"),
        (POPULATIONS, structure(1000, ("prey", "t", 155.0), ("prey", "predator", 100.0)), "t"),
        (POPULATIONS, structure(1000, ("prey", "t", 155.0), ("predator", "prey", 150.0)), "t"),
        (POPULATIONS, structure(1000, ("prey", "predator", 500.0), ("prey", "prey", 200.0)), "predator"),
    ],
)
def test_the_coordinate_that_tells_most(roles: Roles, found: Structure, expected: str) -> None:
    equations, coordinate = most_telling(found, roles)
    assert equations == (found.curves[0].direction.equations)
    assert coordinate == expected


def test_of_a_rotating_frame_the_motion_is_its_amplitude() -> None:
    across = Curve(Direction(("P", "Q"), "amplitude", True, np.zeros(4)), np.zeros(4), np.ones(4), 128.0, 0.0)
    found = structure(370, ("Q", "t", 150.0))
    found = replace(found, curves=(*found.curves, across))
    assert most_telling(found, FRAME) == (("P", "Q"), "amplitude")


@pytest.mark.parametrize(
    ("gains", "shares", "kept"),
    [
        ((900.0, 300.0), (0.998, 0.9999), 2),
        ((900.0, 40.0), (0.998, 0.9999), 1),  # too faint
        ((900.0, 300.0), (0.9993, 0.9991), 1),  # leaves more than without it
        ((900.0, 40.0, 300.0), (0.998, 0.999, 0.9999), 1),  # what came after a patch goes with it
    ],
)
def test_further_mechanisms_stay_as_long_as_each_gains_enough_and_leaves_less(
    gains: tuple[float, ...], shares: tuple[float, ...], kept: int
) -> None:
    search, left = without_patches(found_with(*gains), [remainder(share) for share in shares], least=100)
    assert len(search.found) == kept
    assert search.fit.number == kept
    assert left.share == shares[kept - 1]


@pytest.mark.parametrize(
    ("gains", "verdict", "said"),
    [
        ((900.0,), "missing physics", None),
        ((900.0, 300.0), "missing physics", None),
        ((60.0,), "unexplained", "It looks like mechanism 1, but is too faint"),
        ((900.0, 23.0), "unexplained", "mechanism 1 and mechanism 2, but mechanism 2 is too faint"),
    ],
)
def test_what_is_named_has_to_be_strong_each_of_it(
    gains: tuple[float, ...], verdict: str, said: str | None
) -> None:
    found, remarks = named_or_not(found_with(*gains), remainder(0.9999), False, True, least=100)
    assert found == verdict
    assert said is None or said in remarks[-1]


def test_a_name_has_to_leave_less_than_what_speaks_of_a_mismatch_by_itself() -> None:
    clear, hardly, noise = remainder(0.9, 1e-6), remainder(0.9, 3e-4), remainder(0.9, 0.2)
    assert (clear.structured, clear.doubtful) == (True, True)
    assert (hardly.structured, hardly.doubtful) == (False, True)
    assert (noise.structured, noise.doubtful) == (False, False)


@pytest.mark.parametrize(("random_forces", "expected"), [(False, "better"), (True, "steadier")])
def test_of_equals_the_one_that_all_recordings_ask_for_where_white_errors_mean_little(
    random_forces: bool, expected: str
) -> None:
    def trial(name: str, gain: float, p_cluster: float) -> TriedMechanism:
        fit = SimpleNamespace(has_process_noise=random_forces)
        return TriedMechanism(SimpleNamespace(name=name, new=("c",)), fit, gain, 7.0 - gain, 0.0, p_cluster)

    trials = [trial("better", 331, 1e-9), trial("steadier", 325, 1e-49), trial("worse", 276, 1e-60)]
    found = accepted(trials, 50, 1e-4, options=SearchOptions())
    assert found is not None and found.best.candidate.name == expected
    assert {each.candidate.name for each in found.indistinguishable} == {"better", "steadier"} - {expected}
