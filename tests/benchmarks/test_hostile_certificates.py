"""Records that nobody should certify, and honest ones, from end to end: a few of `make hostile`."""

from __future__ import annotations

import pytest

from benchmarks.hostile.catalogue import KINDS
from benchmarks.hostile.scores import scored

# Chosen for what they are, and a short computing time; a tilt that swings is in `test_certified_records.py`.
REFUSED = ("projected_wells", "white_noise", "brownian_motion")
LONGER = (
    "force_with_memory",
    "popcorn",
    "jittered_clock",
    "hysteresis",
    "growing_noise",
    "duplicated",
    "lost_buffers",
)
NAMED = ("held_values",)  # they are no copies of recordings, and what is right without them may be certified
HONEST, HONEST_LONGER = ("gate",), ("swinging_tilt", "two_offsets")


@pytest.mark.parametrize(
    "name", [*REFUSED, *NAMED, *(pytest.param(one, marks=pytest.mark.slow) for one in LONGER)]
)
def test_nothing_is_certified_that_is_not_so(name: str) -> None:
    score = scored(KINDS[name], 0, 1.0)
    assert not score.false, score.off
    assert not score.certified or name in NAMED
    assert score.certified or name not in NAMED or KINDS[name].named & set(score.codes), score.said


@pytest.mark.parametrize(
    "name", [*HONEST, *(pytest.param(one, marks=pytest.mark.slow) for one in HONEST_LONGER)]
)
def test_an_honest_record_that_looks_alike_is_certified(name: str) -> None:
    score = scored(KINDS[name], 0, 1.0, honest=True)
    assert score.certified, score.said
    assert not score.off
