"""Cases like those that others bring: small laboratories whose recordings the method has never seen.

Each is written with numbers of its own, in numpy alone, and shares nothing with what it is to test: neither
formulas nor integrators, nor draws. A case is a card as text, a table of recordings, and settings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from siq.diagnosis.study import Comparison, read_case
from siq.systems.cards import load_system

Rate = Callable[[float, np.ndarray], np.ndarray]
GRAVITY = 9.81


@dataclass(frozen=True)
class ForeignCase:
    """A simulation and recordings of what it is a simulation of.

    Attributes
    ----------
    card
        Content of ``system.yaml``.
    table
        The recordings, as ``recordings.csv`` has them.
    study
        Content of ``study.yaml``.
    """

    card: dict[str, Any]
    table: pd.DataFrame
    study: dict[str, Any] = field(default_factory=dict)

    def written(self, folder: Path) -> Path:
        """The folder with the case in it, as `siq diagnose` takes it."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "system.yaml").write_text(yaml.safe_dump(self.card, sort_keys=False), encoding="utf-8")
        (folder / "study.yaml").write_text(yaml.safe_dump(self.study), encoding="utf-8")
        self.table.to_parquet(folder / "recordings.parquet")
        return folder

    def read(self, folder: Path) -> Comparison:
        """The case, read and checked from files in a folder."""
        self.written(folder)
        load_system(folder / "system.yaml")
        return read_case(folder / "system.yaml", folder / "recordings.parquet", folder / "study.yaml")


def course(rate: Rate, begin: np.ndarray, t: np.ndarray, *, within: int) -> np.ndarray:
    """States at times ``(n,)`` by the Runge–Kutta rule with so many steps in between; shape ``(n, ...)``."""
    states = np.empty((len(t), *np.shape(begin)))
    states[0] = now = np.asarray(begin, dtype=float)
    for row in range(1, len(t)):
        h = (t[row] - t[row - 1]) / within
        for part in range(within):
            at = t[row - 1] + part * h
            k1 = rate(at, now)
            k2 = rate(at + h / 2, now + h / 2 * k1)
            k3 = rate(at + h / 2, now + h / 2 * k2)
            k4 = rate(at + h, now + h * k3)
            now = now + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        states[row] = now
    return states


def table_of(t: np.ndarray, columns: dict[str, np.ndarray]) -> pd.DataFrame:
    """A long table of recordings that share their times: columns of shape ``(recordings, n)``."""
    count = len(next(iter(columns.values())))
    labels = np.repeat([f"r{place}" for place in range(count)], len(t))
    return pd.DataFrame(
        {"recording": labels, "t": np.tile(t, count)} | {name: np.ravel(c) for name, c in columns.items()}
    )


def falling_ball(
    drag: float, *, linear: bool = False, fixed: bool = True, sensor: float = 0.02, seed: int = 1
) -> ForeignCase:
    """Two drops of 45 heights each; the card falls freely.

    Parameters
    ----------
    drag
        Per mass: of v∣v∣ in 1/m, or of v in 1/s where it is linear. Of 0.005 (a heavy ball) to 0.5 1/m.
    linear
        Which of the two.
    fixed
        Whether the card believes in its gravity.
    sensor
        Standard deviation of a height, m.
    """
    t = np.arange(45) / 15
    generator = np.random.default_rng(seed)

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        return np.stack([y[1], -GRAVITY - drag * y[1] * (1.0 if linear else np.abs(y[1]))])

    begin = np.stack([np.array([47.0, 46.6]), generator.normal(0, 0.3, size=2)])
    heights = course(rate, begin, t, within=20)[:, 0].T
    card = {
        "name": "falling-ball",
        "time_unit": "s",
        "states": {"h": {"unit": "m"}, "w": {"unit": "m/s"}},
        "parameters": {"g": {"value": GRAVITY, "unit": "m/s**2", "fixed": fixed}},
        "equations": {"h": "w", "w": "-g"},
        "outputs": {"h": "h"},
    }
    measured = heights + sensor * generator.normal(size=heights.shape)
    return ForeignCase(card, table_of(t, {"h": measured}), {"held_out": ["r1"]})


def motor_axis(
    *, dry: float = 20.0, asymmetry: float = 0.0, samples: int = 4000, recordings: int = 2, seed: int = 1
) -> ForeignCase:
    """A carriage on a screw, moved to and fro by a controller; the card has viscous friction only.

    Parameters
    ----------
    dry, asymmetry
        Dry friction in N, and by how much more of it there is forwards than backwards.
    samples, recordings
        At 200 Hz, each.
    """
    step = 1 / 200
    mass, viscous = 95.0, 200.0
    generator = np.random.default_rng(seed)
    t = np.arange(samples) * step
    x, v = np.zeros(recordings), np.zeros(recordings)
    goal = np.zeros(recordings)
    seen, forces = np.empty((recordings, samples)), np.empty((recordings, samples))
    speed = generator.uniform(0.05, 0.12, size=recordings)
    way = np.ones(recordings)
    for row in range(samples):
        # To and fro between two ends, at a speed that is drawn anew at every turn.
        goal = goal + way * speed * step
        turned = np.abs(goal) > 0.2
        way = np.where(turned, -np.sign(goal), way)
        speed = np.where(turned, generator.uniform(0.02, 0.15, size=recordings), speed)
        u = np.clip(4000 * (goal - x) + 300 * (way * speed - v), -150, 150)
        seen[:, row], forces[:, row] = x, u
        left = np.full(recordings, step)
        for _ in range(2):  # until it stops, and from there on
            x, v, left = _slid(x, v, u, left, (mass, viscous, dry, asymmetry))
    measured = seen + 2e-5 * generator.normal(size=seen.shape)
    card = {
        "name": "motor-axis",
        "time_unit": "s",
        "states": {"x": {"unit": "m"}, "v": {"unit": "m/s"}},
        "inputs": {"u": {"unit": "N", "interpolation": "zero_order"}},
        "parameters": {
            "m": {"value": 90.0, "unit": "kg"},
            "d": {"value": 250.0, "unit": "N*s/m"},
        },
        "equations": {"x": "v", "v": "(u - d*v)/m"},
        "outputs": {"x": "x"},
    }
    held_out = [f"r{recordings - 1}"] if recordings > 1 else 0.25
    return ForeignCase(card, table_of(t, {"x": measured, "u": forces}), {"held_out": held_out})


def _slid(
    x: np.ndarray, v: np.ndarray, u: np.ndarray, time: np.ndarray, constants: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Exact motion under a constant force for a time, or until it stops; and the time that is then left."""
    mass, viscous, dry, asymmetry = constants
    way = np.sign(np.where(v != 0, v, u))
    limit = dry + asymmetry * way
    final = (u - limit * way) / viscous
    rests = (v == 0) & (np.abs(u) <= limit)
    rate = viscous / mass
    with np.errstate(all="ignore"):
        stop = np.log1p(-v / final) / rate  # when v = final (1 - exp(-rate t)) + v exp(-rate t) is zero
    for_now = np.where(np.isfinite(stop) & (stop > 0) & (stop < time), stop, time)
    fading = np.exp(-rate * for_now)
    reached = x + final * for_now + (v - final) * (1 - fading) / rate
    speed = np.where(for_now < time, 0.0, final + (v - final) * fading)
    return np.where(rests, x, reached), np.where(rests, 0.0, speed), np.where(rests, 0.0, time - for_now)


def double_pendulum(
    *, pieces: int = 8, seconds: float = 4.0, rate_of_camera: float = 100.0, seed: int = 1
) -> ForeignCase:
    """Two rods with moments of inertia and friction, filmed; the card has point masses and no friction."""
    masses, lengths, centres = (0.263, 0.136), (0.172, 0.143), (0.109, 0.115)
    inertia = [m * length**2 / 12 for m, length in zip(masses, lengths, strict=True)]
    friction = (1.2e-4, 4.0e-5)
    generator = np.random.default_rng(seed)
    t = np.arange(round(seconds * rate_of_camera)) / rate_of_camera

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        a, b, p, q = y
        one = inertia[0] + masses[0] * centres[0] ** 2 + masses[1] * lengths[0] ** 2
        two = inertia[1] + masses[1] * centres[1] ** 2
        across = masses[1] * lengths[0] * centres[1]
        c, s = np.cos(a - b), np.sin(a - b)
        joint = friction[1] * (q - p)
        left = (
            -across * s * q**2
            - (masses[0] * centres[0] + masses[1] * lengths[0]) * GRAVITY * np.sin(a)
            - friction[0] * p
            + joint
        )
        right = across * s * p**2 - masses[1] * centres[1] * GRAVITY * np.sin(b) - joint
        determinant = one * two - (across * c) ** 2
        return np.stack(
            [p, q, (two * left - across * c * right) / determinant,
             (one * right - across * c * left) / determinant]
        )  # fmt: skip

    begin = np.stack(
        [
            generator.uniform(-2.0, 2.0, size=pieces),
            generator.uniform(-2.5, 2.5, size=pieces),
            generator.normal(0, 2.0, size=pieces),
            generator.normal(0, 2.0, size=pieces),
        ]
    )
    angles = course(rate, begin, t, within=20)[:, :2]
    measured = angles + 2e-3 * generator.normal(size=angles.shape)
    delta, mass = "(a - b)", "(m1 + m2)"
    bottom = f"(m1 + m2*sin{delta}**2)"
    card = {
        "name": "double-pendulum",
        "time_unit": "s",
        "states": {
            "a": {"unit": "rad"}, "b": {"unit": "rad"}, "p": {"unit": "rad/s"}, "q": {"unit": "rad/s"},
        },
        "parameters": {
            "m1": {"value": 0.2, "unit": "kg", "fixed": True},
            "m2": {"value": 0.136, "unit": "kg"},
            "l1": {"value": 0.172, "unit": "m"},
            "l2": {"value": 0.143, "unit": "m"},
            "g": {"value": GRAVITY, "unit": "m/s**2", "fixed": True},
        },
        "equations": {
            "a": "p",
            "b": "q",
            "p": f"(m2*g*sin(b)*cos{delta} - m2*sin{delta}*(l1*p**2*cos{delta} + l2*q**2)"
            f" - {mass}*g*sin(a))/(l1*{bottom})",
            "q": f"({mass}*(l1*p**2*sin{delta} - g*sin(b) + g*sin(a)*cos{delta})"
            f" + m2*l2*q**2*sin{delta}*cos{delta})/(l2*{bottom})",
        },
        "outputs": {"a": "a", "b": "b"},
    }  # fmt: skip
    table = table_of(t, {"a": measured[:, 0].T, "b": measured[:, 1].T})
    return ForeignCase(card, table, {"held_out": [f"r{pieces - 2}", f"r{pieces - 1}"]})


def polynomial_on_the_brink(*, samples: int = 200, recordings: int = 6, seed: int = 1) -> ForeignCase:
    """Two states held by a fifth power that the card lacks: what the card says runs away, and so do guesses.

    The states are in units in which they are large, so that powers of them soon leave the doubles.
    """
    size = 1e3
    generator = np.random.default_rng(seed)
    t = np.arange(samples) * 0.05

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        x, z = y / size
        return size * np.stack([1.5 * x + 2.0 * z + 0.6 * x**3 - 0.9 * x**5, -2.0 * x + 0.3 * z - 0.4 * z**3])

    begin = size * generator.uniform(-1.5, 1.5, size=(2, recordings))
    states = course(rate, begin, t, within=20)
    measured = states + 0.01 * size * generator.normal(size=states.shape)
    card = {
        "name": "brink",
        "states": {"x": {}, "z": {}},
        "parameters": {
            "a": {"value": 1.5}, "b": {"value": 2.0}, "c": {"value": 0.6e-6},
            "e": {"value": 0.3}, "f": {"value": 0.4e-6},
        },
        "equations": {"x": "a*x + b*z + c*x**3", "z": "-b*x + e*z - f*z**3"},
        "outputs": {"x": "x", "z": "z"},
    }  # fmt: skip
    table = table_of(t, {"x": measured[:, 0].T, "z": measured[:, 1].T})
    return ForeignCase(card, table, {"held_out": [f"r{recordings - 1}"]})


def chain_of_masses(
    masses: int = 4, *, samples: int = 100_000, recordings: int = 10, cubic: float = 0.5, seed: int = 1
) -> ForeignCase:
    """Masses between springs, the first one driven: eight states and 10⁵ samples in all by default.

    The spring between the first mass and the wall hardens, which the card does not know.
    """
    step = 0.1
    own = samples // recordings
    generator = np.random.default_rng(seed)
    t = np.arange(own) * step
    omega = generator.uniform(0.3, 2.0, size=(recordings, 6))
    phase = generator.uniform(0, 2 * np.pi, size=(recordings, 6))

    def drive(at: float | np.ndarray) -> np.ndarray:
        return 0.5 * np.cos(omega[..., None] * at + phase[..., None]).sum(axis=1)

    def rate(at: float, y: np.ndarray) -> np.ndarray:
        x, v = y[:masses], y[masses:]
        walls = np.zeros((1, recordings))
        around = np.concatenate([walls, x, walls])
        force = 2.0 * (around[2:] - 2 * x + around[:-2]) - 0.2 * v
        force[0] += drive(at)[:, 0] - cubic * x[0] ** 3
        return np.concatenate([v, force])

    states = course(rate, 0.1 * generator.normal(size=(2 * masses, recordings)), t, within=4)
    measured = states[:, :masses] + 0.01 * generator.normal(size=states[:, :masses].shape)
    names = [f"x{k + 1}" for k in range(masses)]
    speeds = [f"v{k + 1}" for k in range(masses)]
    sides = [["0", *names][k] for k in range(masses)], [[*names, "0"][k + 1] for k in range(masses)]
    card = {
        "name": "chain",
        "time_unit": "s",
        "states": {name: {"unit": "m"} for name in names} | {name: {"unit": "m/s"} for name in speeds},
        "inputs": {"u": {"unit": "m/s**2", "interpolation": "linear"}},
        "parameters": {"k": {"value": 1.9, "unit": "1/s**2"}, "d": {"value": 0.25, "unit": "1/s"}},
        "equations": dict(zip(names, speeds, strict=True))
        | {
            v: f"k*({right} - 2*{x} + {left}) - d*{v}" + (" + u" if x == names[0] else "")
            for x, v, left, right in zip(names, speeds, *sides, strict=True)
        },
        "outputs": {name: name for name in names},
    }
    columns = {name: measured[:, place].T for place, name in enumerate(names)}
    table = table_of(t, columns | {"u": drive(t)})
    return ForeignCase(card, table, {"held_out": [f"r{recordings - 1}"]})


def long_relaxation(*, samples: int = 100_000, recordings: int = 4, seed: int = 1) -> ForeignCase:
    """One state that is pushed at random and seen through a noisy sensor, 10⁵ times; the card is linear."""
    step, within = 0.02, 5
    generator = np.random.default_rng(seed)
    own = samples // recordings
    seen = np.empty((recordings, own))
    now = generator.normal(size=recordings)
    for row in range(own):
        seen[:, row] = now
        for _ in range(within):
            push = np.sqrt(0.3 * step / within) * generator.normal(size=recordings)
            now = now + step / within * (-0.5 * now - 1.0 * now**3) + push
    measured = seen + 0.05 * generator.normal(size=seen.shape)
    card = {
        "name": "relaxation",
        "states": {"x": {}},
        "parameters": {"a": {"value": 1.0}},
        "equations": {"x": "-a*x"},
        "outputs": {"x": "x"},
    }
    table = table_of(np.arange(own) * step, {"x": measured})
    return ForeignCase(card, table, {"held_out": [f"r{recordings - 1}"]})
