"""What can be tried without own recordings: a bead in two traps, and a spring with something left out."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from siq.errors import InputError
from siq.numerics.files import whole_file

DOUBLE_WELL = """\
# A bead hops between two optical traps at -0.5 um and 0.5 um, and the camera adds an error of 0.01 um to each
# value. The recordings were simulated, so that the answer is known: dx = (8 x - 32 x**3) dt + noise of
# strength 0.3 um**2/s, and a barrier of 1 um**2/s in U, which is 3.3 times the noise.
name: double-well
title: A bead in two optical traps
recordings:
  file: double-well.csv
"""

SPRING = """\
# A mass on a spring, as a simulation has it. The recordings beside it are of a spring that hardens, and its
# stiffness is a little different, too.
name: spring
title: A mass on a spring
time_unit: s
states:
  x: {unit: mm, domain: [-2, 2]}
  v: {unit: mm/s, domain: [-2, 2]}
parameters:
  stiffness: {value: 1.05, unit: 1/s**2}
  damping: {value: 0.2, unit: 1/s}
equations:
  x: v
  v: -stiffness*x - damping*v
outputs: {x: x, v: v}
"""


def write_example(name: str, folder: Path, *, replace: bool = False) -> tuple[list[Path], str]:
    """Write an example.

    Parameters
    ----------
    name
        ``double-well`` or ``mismatch``.
    folder
        Where to; it is made where it is not there.
    replace
        Whether files that are there may be replaced.

    Returns
    -------
    files
        What was written.
    command
        What to try with it.

    Raises
    ------
    InputError
        When a file is there already; then none is written.
    """
    makers: Mapping[Path, Callable[[], str]]
    if name == "double-well":
        study = folder / "double-well.yaml"
        makers = {folder / "double-well.csv": double_well_recordings, study: lambda: DOUBLE_WELL}
        command = f"siq run {study}"
    else:
        case = folder / "spring"
        makers = {case / "recordings.csv": spring_recordings, case / "system.yaml": lambda: SPRING}
        command = f"siq diagnose {case}"
    for file in makers:
        if file.exists() and not replace:
            raise InputError(file, "", "the file is there already", "name another --folder, or give --force")
    for file, maker in makers.items():
        with whole_file(file) as partial:
            partial.write_text(maker(), encoding="utf-8")
    return list(makers), command


def double_well_recordings(recordings: int = 4, samples: int = 20_000, *, seed: int = 1) -> str:
    """Recordings of a bead in two traps as a CSV file, with the noise of a camera.

    Ten steps of the simulation lead to each sample.
    """
    generator, step, within, strength, camera = np.random.default_rng(seed), 0.0025, 10, 0.3, 0.01
    inner = step / within
    x = generator.choice([-0.5, 0.5], recordings)
    recorded = np.empty((samples, recordings))
    for sample in range(samples):
        recorded[sample] = x
        for push in generator.normal(scale=np.sqrt(strength * inner), size=(within, recordings)):
            x = x + inner * (8 * x - 32 * x**3) + push
    recorded += generator.normal(scale=camera, size=recorded.shape)
    t = np.arange(samples) * step
    return _csv(
        "recording,t [s],x [um]", [(f"trace-{k + 1}", t, recorded[:, k : k + 1]) for k in range(recordings)]
    )


def spring_recordings(recordings: int = 8, samples: int = 120, *, seed: int = 3) -> str:
    """Recordings of a spring that hardens as a CSV file, with the noise of a sensor."""
    generator, step, within = np.random.default_rng(seed), 0.1, 50
    parts = []
    for number in range(recordings):
        x, v = generator.uniform(-1.5, 1.5, 2)
        rows = np.empty((samples, 2))
        for sample in range(samples):
            rows[sample] = (x, v)
            for _ in range(within):
                v += step / within * (-x - 0.2 * v - 0.8 * x**3)
                x += step / within * v
        rows += generator.normal(scale=0.01, size=rows.shape)
        parts.append((f"release-{number + 1}", np.arange(samples) * step, rows))
    return _csv("recording,t [s],x [mm],v [mm/s]", parts)


def _csv(header: str, parts: list[tuple[str, np.ndarray, np.ndarray]]) -> str:
    text = io.StringIO()
    text.write(header + "\n")
    for label, t, values in parts:
        for time, row in zip(t, values, strict=True):
            text.write(f"{label},{time:.6g}," + ",".join(f"{value:.6f}" for value in row) + "\n")
    return text.getvalue()
