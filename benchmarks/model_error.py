"""Does the diagnosis name what is missing where no formula reaches the sensor's noise?

    .venv/bin/python -m benchmarks.model_error [CASES] [--seed SEED] [--table FILE]

Cases of six systems: one effect that their card lacks, or none, and beside it an error of the model that
no card mentions: a coloured force of its own in every recording, or a small term of an odd shape. It
makes 0.3 to 10 % of the motion. A small term that goes by an angle may be a cogging, which is no wrong name
then. The table has a row for each case, written as soon as it is known; begun again, it goes on. Counted are
right families, right members (or such as are not told apart), wrong families, and names where nothing but the
error of the model is there.
"""

from __future__ import annotations

import argparse
import csv
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
import scipy.integrate
import scipy.interpolate
import yaml

import siq
from siq.diagnosis.dictionary import standard_dictionary

Rates = Callable[[np.ndarray, float], np.ndarray]
RECORDINGS, SAMPLES, SUBSTEPS = 8, 240, 4
NOISE = 1e-3  # of the spread of what is measured, or ten times less, or ten times more
COLUMNS = (
    "case", "system", "effect", "family", "error", "noise", "verdict", "named", "families", "right_family",
    "right_member", "wrong_family", "error_name", "before", "recalibrated", "augmented", "seconds",
)  # fmt: skip


@dataclass(frozen=True)
class System:
    """A system: its card without the effect, its time, where recordings begin, and what drives it."""

    card: dict[str, Any]
    rates: Callable[[np.ndarray, float], list[float]]
    force: tuple[int, float]  # the state that forces act on, and the size of its own
    begins: tuple[tuple[float, float], ...]
    duration: float
    effects: dict[str, Callable[[np.ndarray, float], float]]
    drive: Callable[[np.random.Generator], Callable[[np.ndarray], np.ndarray]] | None = None
    measured: int = 0


def _card(name: str, states: dict[str, str], parameters: dict[str, float], **rest: Any) -> dict[str, Any]:
    return {
        "name": name, "time_unit": "s", "states": {key: {"unit": unit} for key, unit in states.items()},
        "parameters": {key: {"value": value} for key, value in parameters.items()}, **rest,
    }  # fmt: skip


def _multisine(generator: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    rates, phases = generator.uniform(0.3, 4.0, 6), generator.uniform(0, 2 * np.pi, 6)
    return lambda t: np.sin(np.multiply.outer(np.asarray(t), rates) + phases).sum(axis=-1) / 2


SYSTEMS = {
    "pendulum": System(
        _card("pendulum", {"a": "rad", "w": "rad/s"}, {"k": 9.0}, equations={"a": "w", "w": "-k*sin(a)"},
              outputs={"q": "a"}),
        lambda x, u: [x[1], -9.0 * np.sin(x[0])], (1, 6.0), ((-2.0, 2.0), (-2.0, 2.0)), 12.0,
        {
            "linear damping": lambda x, u: -0.15 * x[1],
            "quadratic drag": lambda x, u: -0.06 * x[1] * abs(x[1]),
            "dry friction": lambda x, u: -0.25 * np.tanh(x[1] / 0.02),
        },
    ),
    "driven spring": System(
        _card("driven", {"x": "m", "v": "m/s"}, {"k": 4.0, "c": 0.3}, inputs={"u": {"unit": "m/s^2"}},
              equations={"x": "v", "v": "u - k*x - c*v"}, outputs={"q": "x"}),
        lambda x, u: [x[1], u - 4.0 * x[0] - 0.3 * x[1]], (1, 3.0), ((-1.0, 1.0), (-1.0, 1.0)), 30.0,
        {
            "cubic stiffness": lambda x, u: -1.2 * x[0] ** 3,
            "quadratic drag": lambda x, u: -0.25 * x[1] * abs(x[1]),
            "dry friction": lambda x, u: -0.25 * np.tanh(x[1] / 0.02),
            "constant bias": lambda x, u: 0.4,
        }, _multisine,
    ),
    "falling ball": System(
        _card("falling", {"y": "m", "v": "m/s"}, {}, equations={"y": "v", "v": "-9.81"}, outputs={"h": "y"}),
        lambda x, u: [x[1], -9.81], (1, 9.81), ((20.0, 40.0), (-5.0, 5.0)), 2.0,
        {
            "quadratic drag": lambda x, u: -0.02 * x[1] * abs(x[1]),
            "linear damping": lambda x, u: -0.25 * x[1],
        },
    ),
    "motor": System(
        _card("motor", {"p": "rad", "w": "rad/s"}, {"K": 5.0, "b": 0.8}, inputs={"u": {"unit": "V"}},
              equations={"p": "w", "w": "K*u - b*w"}, outputs={"q": "p"}),
        lambda x, u: [x[1], 5.0 * u - 0.8 * x[1]], (1, 5.0), ((0.0, 0.0), (0.0, 0.0)), 20.0,
        {
            "dry friction": lambda x, u: -1.0 * np.tanh(x[1] / 0.05),
            "quadratic drag": lambda x, u: -0.12 * x[1] * abs(x[1]),
            "gravity": lambda x, u: -1.5 * np.sin(x[0]),
        }, _multisine,
    ),
    "population": System(
        _card("population", {"n": "g"}, {"r": 0.6}, equations={"n": "r*n"}, outputs={"m": "n"}),
        lambda x, u: [0.6 * x[0]], (0, 1.0), ((0.1, 3.0),), 10.0,
        {
            "self-limitation": lambda x, u: -0.15 * x[0] ** 2,
            "harvest": lambda x, u: -0.5 * x[0] / (0.5 + x[0]),
        },
    ),
    "heated room": System(
        _card("room", {"T": "K"}, {"c": 0.4}, inputs={"u": {"unit": "K/s"}}, equations={"T": "c*u"},
              outputs={"S": "T"}),
        lambda x, u: [0.4 * u], (0, 0.4), ((-1.0, 1.0),), 40.0,
        {"decay or leakage": lambda x, u: -0.25 * x[0]}, _multisine,
    ),
}  # fmt: skip


def made(number: int, seed: int) -> tuple[dict[str, Any], pd.DataFrame, dict[str, Any]]:
    """The card, the recordings and the key of a case."""
    generator = np.random.default_rng([seed, number])
    name = list(SYSTEMS)[number % len(SYSTEMS)]
    system = SYSTEMS[name]
    effects = [*system.effects, "none"]
    effect = effects[(number // len(SYSTEMS)) % len(effects)]
    error = float(np.exp(generator.uniform(np.log(0.003), np.log(0.1))))
    noise = NOISE * 10.0 ** generator.integers(-1, 2)
    place, size = system.force
    odd = generator.random() < 0.5
    kind, rate = generator.integers(3), generator.uniform(0.5, 3.0)
    frames = []
    for recording in range(RECORDINGS):
        t = np.linspace(0, system.duration, SAMPLES)
        begin = [generator.uniform(*each) for each in system.begins]
        course = system.drive(generator) if system.drive else None
        # A coloured force of its own, with a correlation time of a thirtieth to a third of the recording.
        knots = np.arange(-2, 60)
        last = system.duration / 50
        steps = generator.normal(size=len(knots))
        tau = generator.uniform(1.5, 15)
        for k in range(1, len(steps)):
            steps[k] = np.exp(-1 / tau) * steps[k - 1] + np.sqrt(1 - np.exp(-2 / tau)) * steps[k]
        force = scipy.interpolate.CubicSpline(knots * last, steps)

        def f(time_: float, x: np.ndarray, course: Any = course, force: Any = force) -> np.ndarray:
            u = 0.0 if course is None else float(course(time_))
            rates = np.array(system.rates(x, u))
            strange = [
                np.sin(7 * x[place] * rate),
                np.cos(5 * x[0] * rate),
                abs(np.sin(3 * x[0] * rate)) - 2 / np.pi,  # a constant force is a mechanism
            ]
            rates[place] += error * size * (strange[kind] if odd else force(time_))
            if effect != "none":
                rates[place] += system.effects[effect](x, u)
            return rates

        run = scipy.integrate.solve_ivp(
            f, (0, system.duration), begin, t_eval=t, rtol=1e-8, atol=1e-10, max_step=last
        )
        frame = pd.DataFrame({"recording": f"r{recording}", "t": t})
        frame[next(iter(system.card["outputs"]))] = run.y[system.measured]
        if course is not None:
            frame["u"] = course(t)
        frames.append(frame)
    table = pd.concat(frames, ignore_index=True)
    output = next(iter(system.card["outputs"]))
    table[output] += noise * table[output].std() * generator.normal(size=len(table))
    families = {each.name: each.family or each.name for each in standard_dictionary()}
    # Of the odd terms one is a mechanism of its own, where it goes by an angle.
    turns = next(iter(system.card["states"].values()))["unit"] == "rad"
    card = yaml.safe_load(yaml.safe_dump(system.card))
    for parameter in card["parameters"].values():
        parameter["value"] = float(parameter["value"] * np.exp(generator.uniform(-0.1, 0.1)))
    key = {
        "system": name,
        "effect": effect,
        "family": families.get(effect, ""),
        "error": error,
        "noise": noise,
        "error_name": "cogging or gear ripple" if odd and kind == 1 and turns else "",
    }
    return card, table, key


def judged(number: int, seed: int) -> dict[str, Any]:
    """The row of a case."""
    card, table, key = made(number, seed)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "system.yaml"
        path.write_text(yaml.safe_dump(card), encoding="utf-8")
        system = siq.load_system(path)
    began = time.process_time()
    found = siq.diagnose(system, table)
    names = [each.name for each in found.mechanisms]
    said = {each.family or each.name for each in found.mechanisms}
    members = {*names, *(one for each in found.mechanisms for one in each.indistinguishable_from or ())}
    errors = found.statement.errors
    return {
        **key, "case": number, "verdict": found.statement.outcome, "named": "; ".join(names),
        "families": "; ".join(sorted(said)), "right_family": key["family"] in said,
        "right_member": key["effect"] in members,
        "wrong_family": any(
            (each.family or each.name) not in {key["family"], "process noise"}
            for each in found.mechanisms
            if each.name != key["error_name"]
        ),
        "before": errors.before, "recalibrated": errors.recalibrated, "augmented": errors.augmented,
        "seconds": time.process_time() - began,
    }  # fmt: skip


def main() -> None:
    """Judge cases and print the counts."""
    parser = argparse.ArgumentParser(
        prog="benchmarks.model_error", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("cases", nargs="?", type=int, default=60)
    parser.add_argument("--seed", type=int, default=463899328127)
    parser.add_argument("--table", type=Path, default=Path("model_error.csv"))
    chosen = parser.parse_args()
    logging.disable(logging.INFO)
    known = pd.read_csv(chosen.table)["case"].tolist() if chosen.table.exists() else []
    for number in range(chosen.cases):
        if number in known:
            continue
        try:
            row = judged(number, chosen.seed)
        except siq.NumericalFailure as failure:
            row = {**made(number, chosen.seed)[2], "case": number, "verdict": f"failed: {failure}"}
        fresh = not chosen.table.exists()
        with chosen.table.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            if fresh:
                writer.writeheader()
            writer.writerow(row)
        print(
            {
                name: row.get(name)
                for name in ("case", "system", "effect", "error", "verdict", "named", "seconds")
            },
            flush=True,
        )
    table = pd.read_csv(chosen.table)
    effect, none = table[table["effect"] != "none"], table[table["effect"] == "none"]
    print(
        f"{len(effect)} effects: family right {effect['right_family'].mean():.0%}, member right or in the set"
        f" {effect['right_member'].mean():.0%}, a wrong family {effect['wrong_family'].mean():.0%}"
    )
    print(f"{len(none)} without: named {none['wrong_family'].mean():.0%}")


if __name__ == "__main__":
    main()
