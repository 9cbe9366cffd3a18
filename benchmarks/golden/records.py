"""Noisy records that hop, and some that do not: what is seen in them, and their landscape or none.

Maier and Stein's system with β = 1, whose barriers of U are 1/2, in eight records of 200 s; and small ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import siq
from benchmarks.golden.landscapes import landscape, support_of
from benchmarks.golden.table import tolerated

# f is fitted to noise, and rules that stop leave more open than where f is given.
TOLERANCES = {
    **tolerated("attractors saddles coefficients curvature", 1e-5, 1e-8),
    **tolerated("barrier path_barrier heights U_between epsilon memory relaxation sensor", 1e-4, 1e-9),
    **tolerated("mean_time dwell_time position_errors epsilon_error probability", 1e-3, 1e-9),
    **tolerated("barrier_error stated_error", 0.05, 1e-6),
    **tolerated("levels visit_times", 1e-6),
    **tolerated("basins", 0.0, 0.01),
}
RECORDS, WITHIN = 8, 10  # steps of Euler and Maruyama a sample


def maier_stein(state: np.ndarray) -> np.ndarray:
    """The force on states ``(n, 2)``."""
    x, y = state.T
    return np.stack([x - x**3 - x * y**2, -(1 + x**2) * y], axis=1)


def double_well(x: np.ndarray) -> np.ndarray:
    """The force of (x² - 1)²/4."""
    return x - x**3


def noisy(
    seed: int, force: Callable[[np.ndarray], np.ndarray] = maier_stein, *, intensity: float = 0.1,
    sensor: float = 0.0, grows: bool = False, samples: int = 20_000, step: float = 0.01,
) -> pd.DataFrame:  # fmt: skip
    """Records that begin at x = ±1, with the same noise in every state, which may grow with x."""
    draw, d, short = np.random.default_rng(seed), 2 if force is maier_stein else 1, step / WITHIN
    state, states = np.zeros((RECORDS, d)), np.empty((samples, RECORDS, d))
    state[:, 0] = np.sign(draw.standard_normal((2, RECORDS))[0])
    for sample in range(samples):
        states[sample] = state
        for _ in range(WITHIN):
            local = np.maximum(0.05, 1 + 0.8 * state[:, :1]) if grows else 1.0
            push = np.sqrt(intensity * short * local) * draw.standard_normal((RECORDS, d))
            state = state + short * force(state) + push
    return table(states + sensor * draw.standard_normal(states.shape), step)


def relaxing(seed: int) -> pd.DataFrame:
    """Sixty records without noise: x' = x - x³, y' = -y."""
    t, starts = np.linspace(0, 3, 61), np.random.default_rng(seed).uniform(-1.5, 1.5, (2, 60, 1))
    x = starts[0] / np.sqrt(starts[0] ** 2 + (1 - starts[0] ** 2) * np.exp(-2 * t))
    return table(np.stack([x.T, (starts[1] * np.exp(-t)).T], axis=2), t[1])


def turning(seed: int) -> pd.DataFrame:
    """Four circles of different radii, without noise: no state is stable."""
    radii, t = np.random.default_rng(seed).uniform(0.5, 2.0, (1, 4, 1)), np.arange(400) * 0.05
    return table(radii * np.stack([np.cos(t), np.sin(t)], axis=1)[:, None], 0.05)


def table(states: np.ndarray, step: float) -> pd.DataFrame:
    """States ``(samples, records, d)`` as a table."""
    t, names = np.arange(len(states)) * step, "xy"[: states.shape[2]]
    return pd.concat(
        pd.DataFrame({"recording": f"r{k}", "t": t} | dict(zip(names, states[:, k].T, strict=True)))
        for k in range(states.shape[1])
    )


of_one_state = partial(noisy, force=double_well, intensity=0.15, samples=2_500, step=0.05)
MADE: dict[str, Callable[[], pd.DataFrame]] = {
    "hop": partial(noisy, 1),
    "hop-often": partial(noisy, 5, intensity=0.2),
    "hop-005": partial(noisy, 3, sensor=0.005),
    "hop-02": partial(noisy, 2, sensor=0.02),
    "hop-multiplicative": partial(noisy, 4, grows=True),
    "relaxing": partial(relaxing, 0),
    "one state": partial(of_one_state, 11),
    "one state, sensor noise": partial(of_one_state, 12, sensor=0.05),
    "one well": partial(of_one_state, 13, force=np.negative),
    "few samples": partial(of_one_state, 14, samples=20),
    "short hops": partial(noisy, 15, sensor=0.005, intensity=0.2, samples=3_000),
    "hardly any samples": partial(of_one_state, 16, samples=4),
    "errors alone": partial(of_one_state, 17, force=np.zeros_like, intensity=0.0, sensor=0.1),
    "random walk": partial(of_one_state, 18, force=np.zeros_like),
    "turning": partial(turning, 19),
}


def items(results: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every record: its inspection, and its landscape."""
    for name, make in MADE.items():
        record = make()
        yield f"{name}: inspected", inspected(record)
        yield f"{name}: landscape", analysed(record)


def inspected(record: pd.DataFrame) -> dict[str, Any]:
    """What a record shows by itself."""
    try:
        found = siq.inspect(record)
    except siq.InputError as error:
        return {"refused": type(error).__name__}
    names = ("kind", "lag", "memory", "relaxation", "sensor")
    said = {name: getattr(found.memory, name) for name in names}
    return said | {"pairs": found.pairs, "gaps": found.gaps} | states_of(found.seen)


def states_of(seen: Any) -> dict[str, Any]:
    """The two states between which a record hops by itself."""
    if seen is None:
        return {"two_states": None}
    said = {name: getattr(seen, name) for name in ("state", "probability", "levels")}
    counts = {"visits": [one.visits for one in seen.counts], "visit_times": [one.time for one in seen.counts]}
    return {"two_states": seen.supported} | said | counts


def analysed(record: pd.DataFrame) -> dict[str, Any]:
    """The landscape of a record with f and the noise, or how it was refused."""
    try:
        found = siq.Landscape.from_recordings(record)
    except siq.InputError as error:
        return {"refused": type(error).__name__}
    except siq.NoLandscape as error:
        field = {} if error.dynamics is None else support_of(error.dynamics)
        return {"refused": type(error).__name__, **field, **states_of(error.states)}
    said = {"refused": None, **support_of(found.dynamics), **landscape(found)}
    if found.noise is not None:
        said |= {"epsilon": found.noise.intensity, "epsilon_error": found.noise.standard_error}
        said |= {"dwell_time recorded": found.dwell_times()["mean_time"]}
    return said | {"position_errors": found.position_errors} | states_of(found.seen)
