"""Resampled recordings: terms that all ask for stay, and one that a single recording asks for goes."""

from __future__ import annotations

import numpy as np
import pytest

from siq.inference.selection import (
    MAX_BLOCKS,
    MIN_RECORDINGS,
    PARTS,
    LinearProblem,
    all_coefficients,
    blocks_of,
    stability,
    triangles,
)


def test_blocks_are_recordings_or_parts_of_few() -> None:
    np.testing.assert_array_equal(blocks_of(np.repeat(np.arange(5), 3)), np.repeat(np.arange(5), 3))
    assert blocks_of(np.repeat(np.arange(50), 3)).max() == MAX_BLOCKS - 1
    few = blocks_of(np.repeat(np.arange(MIN_RECORDINGS - 1), 40))
    assert few.max() == PARTS - 1 and (np.diff(few) >= 0).all()


def test_what_one_recording_alone_asks_for_is_not_stable() -> None:
    generator = np.random.default_rng(4)
    block = np.repeat(np.arange(12), 200)
    columns = generator.standard_normal((len(block), 4))
    goal = 0.5 * columns[:, 0] + generator.standard_normal(len(block))
    goal[block == 3] += 2.0 * columns[block == 3, 2]
    parts = triangles(columns, goal, block)
    critical = np.full(4, 3.0)
    labels = all_coefficients([0], 4)
    shares = stability(
        parts, lambda drawn: [LinearProblem(drawn[:, :-1], drawn[:, -1], 1.0, critical, labels)],
        labels[[0, 2]], generator=generator,
    )  # fmt: skip
    assert shares[0] == 1.0
    # A bootstrap sample lacks a recording with the probability 1/e.
    assert shares[1] == pytest.approx(1 - np.exp(-1), abs=0.2)
