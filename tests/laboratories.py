"""Recordings, studies and cards as people have them, one for every kind of page.

Made with numpy and scipy alone: nothing here knows of the library that reads them.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp

FloatArray = np.ndarray


def ring_downs(
    field: Callable[[FloatArray], FloatArray],
    *,
    names: list[str],
    box: list[float],
    recordings: int,
    duration: float,
    step: float,
    seed: int,
) -> pd.DataFrame:
    """Noise-free recordings that begin anywhere in a box about the origin.

    Parameters
    ----------
    field
        The vector field, of one state.
    names
        Headings of the states, with their units.
    box
        Half widths of the box, one for each state.
    recordings
        How many.
    duration, step
        In seconds.
    seed
        Of the first states.
    """
    draw = np.random.default_rng(seed)
    times = np.arange(0, duration, step)
    parts = []
    for number in range(recordings):
        start = draw.uniform(-np.array(box), box)
        solved = solve_ivp(
            lambda _, state: field(state), (0, duration), start, t_eval=times, rtol=1e-11, atol=1e-13
        )
        columns = {"recording": f"r{number:03d}", "t [s]": times} | dict(zip(names, solved.y, strict=True))
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts)


def hopping(*, intensity: float, samples: int, step: float, traces: int, seed: int) -> pd.DataFrame:
    """Long traces of one state in the double well ``x' = x - x**3`` with process noise."""
    draw = np.random.default_rng(seed)
    within = 5
    state = np.sign(draw.standard_normal(traces))
    states = np.empty((samples, traces))
    for sample in range(samples):
        states[sample] = state
        for _ in range(within):
            kick = np.sqrt(intensity * step / within) * draw.standard_normal(traces)
            state = state + step / within * (state - state**3) + kick
    times = np.arange(samples) * step
    return pd.concat(
        pd.DataFrame({"recording": f"trace-{one}", "t [s]": times, "x [nm]": states[:, one]})
        for one in range(traces)
    )


def double_well(state: FloatArray) -> FloatArray:
    """A bead in two traps at x = ±0.5: U = x⁴ − x²/2 + y², so that the barrier is 1/16; rates in 1/s."""
    x, y = state
    gradient = np.array([2 * x**3 - 0.5 * x, y])  # of V = U / 2
    return -gradient + np.array([-gradient[1], gradient[0]])  # a circulation along the contours


def three_states(state: FloatArray) -> FloatArray:
    """The same two traps with a third state, which relaxes by itself."""
    return np.append(double_well(state[:2]), -state[2])


def rotation(state: FloatArray) -> FloatArray:
    """An oscillator that runs on a cycle: no well that a formula could be about."""
    x, y = state
    return np.array([x - y - x * (x**2 + y**2), x + y - y * (x**2 + y**2)])


def write_studies(folder: Path) -> dict[str, Path]:
    """Write recordings and studies of every kind into a folder.

    Returns
    -------
    dict of str to Path
        By the name of the results, what to give to ``siq run``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {"duration": 2.0, "step": 0.02, "seed": 3}
    tables = {
        "two-states": ring_downs(
            double_well, names=["x [um]", "y [um]"], box=[0.9, 0.6], recordings=120, **options
        ),
        "three-states": ring_downs(
            three_states, names=["a", "b", "c"], box=[1.5, 1.0, 1.0], recordings=150, **options
        ),
        "cycle": ring_downs(rotation, names=["x", "y"], box=[1.5, 1.5], recordings=60, **options),
        "one-state": hopping(intensity=0.25, samples=20_000, step=0.02, traces=4, seed=5),
    }
    files = {}
    for name, table in tables.items():
        files[name] = folder / f"{name}.csv"
        table.to_csv(files[name], index=False, float_format="%.12g")
    # Several runs of a card with an exact answer, with networks: tables over runs, and the published method.
    files["several-runs"] = folder / "several-runs.yaml"
    files["several-runs"].write_text(
        "name: several-runs\nsystem: archetype3d\nruns: 2\nsimulation: {trajectories: 300}\n"
        "training: {steps: 60}\n",
        encoding="utf-8",
    )
    return files


CARD = """\
name: {name}
title: {title}
time_unit: s
states:
  x: {{unit: m}}
  v: {{unit: m/s}}
parameters:
  stiffness: {{value: {stiffness}, unit: 1/s**2}}
  damping: {{value: 0.1, unit: 1/s}}
equations:
  x: v
  v: -stiffness*x - damping*v
outputs:
  position: x
"""


def vibrations(*, cubic: float, friction: float, seed: int) -> pd.DataFrame:
    """Eight decays of an oscillator, its position measured with noise, under forces that its card lacks."""
    draw = np.random.default_rng(seed)
    times = np.arange(0, 12, 0.04)
    parts = []
    for number in range(8):
        start = [draw.uniform(0.6, 1.4), draw.uniform(-0.3, 0.3)]
        solved = solve_ivp(
            lambda _, state: [state[1], -4 * state[0] - 0.1 * state[1] - cubic * state[0] ** 3
                              - friction * np.tanh(state[1] / 1e-3)],
            (0, 12), start, t_eval=times, rtol=1e-9, atol=1e-11, max_step=0.02,
        )  # fmt: skip
        position = solved.y[0] + 0.003 * draw.standard_normal(times.size)
        parts.append(pd.DataFrame({"recording": f"decay-{number}", "t": times, "position": position}))
    return pd.concat(parts)


def write_cases(folder: Path) -> Path:
    """Write cases whose verdicts differ: physics that is missing, a parameter that is wrong, and nothing.

    Returns
    -------
    Path
        The folder of cases, what to give to ``siq diagnose``.
    """
    cases = {
        "missing-friction": ({"cubic": 0.0, "friction": 0.15}, 4.0),
        "missing-cubic": ({"cubic": 1.5, "friction": 0.0}, 4.0),
        "wrong-stiffness": ({"cubic": 0.0, "friction": 0.0}, 3.2),
        "nothing-missing": ({"cubic": 0.0, "friction": 0.0}, 4.0),
    }
    for seed, (name, (concealed, stiffness)) in enumerate(cases.items()):
        case = folder / name
        case.mkdir(parents=True, exist_ok=True)
        vibrations(**concealed, seed=seed).to_csv(case / "recordings.csv", index=False, float_format="%.9g")
        card = CARD.format(name=name, title=f"An oscillator, {name.replace('-', ' ')}", stiffness=stiffness)
        (case / "system.yaml").write_text(card, encoding="utf-8")
    return folder
