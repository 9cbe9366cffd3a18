"""A regression of pairs that are read block by block is that of pairs in memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from siq.data.recordings import Recordings, StreamedPairs, snapshot_pairs, write_recordings
from siq.errors import InputError
from siq.inference.diffusion_model import estimated_diffusion, with_process_noise_rate
from siq.inference.library import IdentificationOptions, candidate_library
from siq.inference.regression import identify_vector_field

STEP = 0.02


def recordings(noise: float, *, length: int = 700) -> Recordings:
    """Thirty recordings of two coupled states, one of them with a gap."""
    draw = np.random.default_rng(0)
    x = np.empty((30, length, 2))
    x[:, 0] = draw.uniform(-1.5, 1.5, (30, 2))
    for k in range(length - 1):
        a, b = x[:, k, 0], x[:, k, 1]
        f = np.stack([a - a**3 + 0.5 * b, -b - 0.3 * a], axis=1)
        x[:, k + 1] = x[:, k] + STEP * f + np.sqrt(noise * STEP) * draw.normal(size=(30, 2))
    times = [STEP * np.arange(length)] * 29 + [STEP * np.arange(length) + 3.0 * (np.arange(length) > 99)]
    return Recordings.from_arrays(times, x, names=["x", "y"])


@pytest.mark.parametrize("rows", [999, 1 << 18])
@pytest.mark.parametrize("noise", [0.2, 0.0])
def test_streamed_and_in_memory_are_the_same(noise: float, rows: int, tmp_path: Path) -> None:
    made = recordings(noise)
    write_recordings(tmp_path / "a.parquet", made)
    streamed, kept = StreamedPairs(tmp_path / "a.parquet", rows=rows), snapshot_pairs(made)
    assert len(streamed) == len(kept.h) and streamed.names == made.names
    some = np.array([0, 5, 998, 999, 1000, len(kept) - 1])
    assert np.array_equal(streamed.take(some).xh, kept.xh[some])
    library, options = candidate_library(["x", "y"], degree=3), IdentificationOptions(degree=3)
    step = None if noise else STEP  # without noise Euler's steps are exact
    first, other = (
        identify_vector_field(library, pairs, options=options, integrator_step=step)
        for pairs in (kept, streamed)
    )
    assert first.support.tolist() == other.support.tolist()
    assert other.values == pytest.approx(first.values, rel=1e-9)
    assert np.sqrt(np.diag(other.covariance)) == pytest.approx(np.sqrt(np.diag(first.covariance)), rel=1e-6)
    if noise:
        first, other = with_process_noise_rate(first, kept), with_process_noise_rate(other, streamed)
        assert other.noise_rate == pytest.approx(first.noise_rate, rel=1e-9)
        one, two = (estimated_diffusion(each, pairs=len(kept)) for each in (first, other))
        assert one is not None and two is not None
        assert two.matrix == pytest.approx(one.matrix, rel=1e-9)


def test_a_block_may_hold_no_pair(tmp_path: Path) -> None:
    t, x = np.array([0.0, 1, 2, 50, 90, 91, 92, 93]), np.arange(8.0)
    parquet.write_table(pa.table({"t": t, "x": x}), tmp_path / "a.parquet")
    streamed = StreamedPairs(tmp_path / "a.parquet", pair_step=1.0, rows=1)
    assert streamed.take(slice(None)).x0.ravel().tolist() == [0, 1, 4, 5, 6]


@pytest.mark.parametrize("fault", ["order", "missing"])
def test_what_cannot_be_streamed_is_refused(fault: str, tmp_path: Path) -> None:
    t, x = np.arange(10.0), np.arange(10.0)
    t[4], x[5] = (2.0, x[5]) if fault == "order" else (t[4], np.nan)
    parquet.write_table(pa.table({"t": t, "x": x}), tmp_path / "a.parquet")
    with pytest.raises(InputError, match="rows 4 to 6"):
        StreamedPairs(tmp_path / "a.parquet", rows=3)
