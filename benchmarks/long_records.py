"""f and D of records of 10⁶, 10⁷ and 10⁸ samples, streamed from Parquet: time and memory.

    python -m benchmarks.long_records --samples 1e6 1e7

A hopping particle in a double well, ``dx = (x - x³) dt + √ε dW``, is written block by block, and identified
by `siq.inference.regression.identify_vector_field` in a process of its own. ``--in-memory`` does the same
with all pairs at once, for the difference.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numba
import numpy as np
import pyarrow as pa
from pyarrow import parquet

from siq.data.recordings import SnapshotPairs, StreamedPairs, read_recordings, snapshot_pairs
from siq.inference.diffusion_model import estimated_diffusion, with_process_noise_rate
from siq.inference.library import IdentificationOptions, field_library
from siq.inference.regression import identify_vector_field

STEP, INTENSITY, BLOCK = 0.02, 0.25, 1_000_000


@numba.njit(cache=True)
def _walk(x: float, kicks: np.ndarray, inner: int, out: np.ndarray) -> float:
    """Heun's rule, so many steps between two samples: Euler's is off by more than 10⁸ samples show."""
    h = STEP / inner
    for k in range(len(out)):
        out[k] = x
        for i in range(inner):
            rate = x - x * x * x
            ahead = x + h * rate + kicks[k, i]
            x += h / 2 * (rate + ahead - ahead * ahead * ahead) + kicks[k, i]
    return x


def write(path: Path, samples: int) -> None:
    """The record, with ten steps of the simulation between two samples."""
    draw, inner, x = np.random.default_rng(0), 10, 1.0
    schema = pa.schema([("t", pa.float64()), ("x", pa.float64())])
    with parquet.ParquetWriter(path, schema, compression="none") as writer:
        for begin in range(0, samples, BLOCK):
            out = np.empty(min(BLOCK, samples - begin))
            kicks = draw.standard_normal((len(out), inner)) * np.sqrt(INTENSITY * STEP / inner)
            x = _walk(x, kicks, inner, out)
            writer.write_table(pa.table({"t": STEP * np.arange(begin, begin + len(out)), "x": out}, schema))


def identified(path: Path, *, in_memory: bool) -> dict[str, object]:
    """What is found, with the seconds of processor time and the largest memory of this process."""
    begin = time.process_time()
    pairs: SnapshotPairs | StreamedPairs
    pairs = snapshot_pairs(read_recordings(path)) if in_memory else StreamedPairs(path)
    options = IdentificationOptions()
    library = field_library(["x"], options)
    found = with_process_noise_rate(identify_vector_field(library, pairs, options=options), pairs)
    terms = {
        library.names[k]: (float(value), float(error))
        for (_, k), value, error in zip(
            found.support, found.values, np.sqrt(np.diag(found.covariance)), strict=True
        )
    }
    noise = estimated_diffusion(found, pairs=len(pairs))
    return {
        "pairs": len(pairs), "terms": terms, "noise_rate": float(found.noise_rate[0, 0]),
        "error": float(found.noise_rate[0, 0]) * (2 / len(pairs)) ** 0.5,
        "D": None if noise is None else noise.matrix.tolist(),
        "seconds": time.process_time() - begin,
        "GiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }  # fmt: skip


def main() -> None:
    """One line for each length."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--samples", type=float, nargs="+", default=[1e6, 1e7])
    parser.add_argument("--folder", type=Path, default=None, help="for records: 16 bytes a sample")
    parser.add_argument("--in-memory", action="store_true")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(identified(arguments.one, in_memory=arguments.in_memory)))
        return
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        for samples in map(int, arguments.samples):
            path = Path(folder, "record.parquet")
            write(path, samples)
            command = [sys.executable, "-m", "benchmarks.long_records", "--one", str(path)]
            command += ["--in-memory"] if arguments.in_memory else []
            subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
