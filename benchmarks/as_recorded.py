"""Records as laboratories and the field keep them, with what is true of them, and what siq answers.

    python -m benchmarks.as_recorded [--kinds NAME ...] [--seeds 3] [--folder results/as_recorded]

Each is a double well, simulated, seen by a sensor as it is usual somewhere, and written as a file that
`siq.Landscape.from_recordings` reads with default settings. No flaw is put in that should be refused: what is
asked is whether a physicist has an answer, and whether its errors hold. Rules of siq were mended on such
records, so that a new kind is better evidence than new seeds. A table has a row for each record: whether it
is certified, the heights of both barriers over ε with their errors, and what is true.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

import siq

WITHIN = 20  # steps of the simulation in a step between samples


def double_well(
    draw: np.random.Generator, steps: np.ndarray, *, height: float, time_: float, within: int = WITHIN,
    bent: float = 0.0,
) -> np.ndarray:  # fmt: skip
    """Samples of ``U/ε = height (x² - 1)²``, which relaxes in the wells within a time: shape ``(n + 1,)``.

    By Euler's rule, with so many steps `within` each of those between samples; D is in proportion to
    ``1 + bent x²``.
    """
    rate, x, seen = 1 / (8 * height * time_ * (1 + bent)), 1.0, [1.0]
    for step, kicks in zip(steps / within, draw.standard_normal((len(steps), within)), strict=True):
        for kick in np.sqrt(2 * rate * step) * kicks:
            noise = 1 + bent * x * x
            x += -4 * height * rate * noise * x * (x * x - 1) * step + np.sqrt(noise) * kick
        seen.append(x)
    return np.array(seen)


def counted(draw: np.random.Generator) -> tuple[pd.DataFrame, float]:
    """Photons in bins of 2 ms, 120 and 280 in the wells, which relax in 20 ms."""
    x = double_well(draw, np.full(40_000, 0.002), height=3.0, time_=0.02)
    counts = draw.poisson(np.maximum(200 + 80 * x, 0.1))
    return pd.DataFrame({"time_ms": 2.0 * np.arange(len(x)), "counts": counts}), 3.0


def frames(draw: np.random.Generator) -> tuple[pd.DataFrame, float]:
    """A bead in two traps, 25 frames a second, localised to 30 nm; it relaxes in 30 ms."""
    x = double_well(draw, np.full(12_000, 0.04), height=2.5, time_=0.03)
    seen = 0.3 * x + 0.03 * draw.standard_normal(len(x))
    return pd.DataFrame({"time (s)": 0.04 * np.arange(len(x)), "x (um)": seen.round(4)}), 2.5


def core(draw: np.random.Generator) -> tuple[pd.DataFrame, float]:
    """The layers of an ice core, thinner with depth and of uneven thickness; a proxy with noise."""
    steps = np.linspace(0.01, 0.04, 8000) * np.maximum(1 + 0.3 * draw.standard_normal(8000), 0.2)
    x = double_well(draw, steps, height=2.2, time_=0.2)
    age = 10 + np.append(0.0, np.cumsum(steps[::-1]))
    seen = -39.5 + 2.5 * x[::-1] + 0.2 * draw.standard_normal(len(x))
    return pd.DataFrame({"age (kyr BP)": age.round(5), "d18O (permil)": seen.round(2)}), 2.2


def clouds(draw: np.random.Generator) -> tuple[pd.DataFrame, float]:
    """An index from images every ten days, of which clouds hide half; it relaxes in 80 days."""
    x = double_well(draw, np.full(9000, 10.0), height=2.5, time_=80.0)
    seen, kept = 0.45 + 0.25 * x + 0.01 * draw.standard_normal(len(x)), draw.random(len(x)) < 0.5
    date = np.datetime64("1800-01-01") + 10 * np.arange(len(x))
    return pd.DataFrame({"date": date, "index": seen.round(3)})[kept], 2.5


def visits(draw: np.random.Generator) -> tuple[pd.DataFrame, float]:
    """Samples taken as they came: times between them spread by a factor of two either way."""
    steps = 0.15 * np.exp(0.7 * draw.standard_normal(6000))
    x = double_well(draw, steps, height=1.5, time_=0.5)
    day = np.append(0.0, np.cumsum(steps))
    return pd.DataFrame({"day": day.round(4), "x": x.round(4)}), 1.5


def faulty(draw: np.random.Generator) -> tuple[pd.DataFrame, float]:
    """A voltmeter with spikes in two samples of a thousand, and one in a hundred missing."""
    x = double_well(draw, np.full(20_000, 0.02), height=1.5, time_=0.25)
    volts, spikes = 3 + 1.5 * x + 0.1 * draw.standard_normal(len(x)), draw.random(len(x)) < 0.002
    volts[spikes] += 8 * draw.standard_normal(spikes.sum())
    table = pd.DataFrame({"t (s)": 0.02 * np.arange(len(x)), "U (V)": volts.round(3)})
    return table[draw.random(len(x)) > 0.01], 1.5


def steps(draw: np.random.Generator) -> tuple[pd.DataFrame, float]:
    """A simulation by Euler's rule, every step of it written down, which relaxes within twelve."""
    x = double_well(draw, np.full(60_000, 0.04), height=2.0, time_=0.5, within=1)
    return pd.DataFrame({"t": (0.04 * np.arange(len(x))).round(4), "x": x}), 2.0


def steps_of_noisy_states(draw: np.random.Generator) -> tuple[pd.DataFrame, float]:
    """The same, with a noise that is stronger away from the middle."""
    x = double_well(draw, np.full(60_000, 0.04), height=2.0, time_=0.5, within=1, bent=0.5)
    return pd.DataFrame({"t": (0.04 * np.arange(len(x))).round(4), "x": x}), 2.0


def oscillator(draw: np.random.Generator) -> tuple[pd.DataFrame, float]:
    """Duffing's oscillator by the symplectic rule, position and velocity of every step."""
    step, friction, height, seen = 0.03, 0.5, 2.0, []
    x, v = 1.0, 0.0
    for kick in np.sqrt(2 * friction * step / (4 * height)) * draw.standard_normal(120_000):
        seen.append((x, v))
        v += (x - x**3 - friction * v) * step + kick
        x += v * step
    table = pd.DataFrame(seen, columns=["x", "v"])
    return table.assign(t=(step * np.arange(len(table))).round(4)), height


KINDS: dict[str, Callable[[np.random.Generator], tuple[pd.DataFrame, float]]] = {
    one.__name__: one
    for one in (counted, frames, core, clouds, visits, faulty, steps, steps_of_noisy_states, oscillator)
}


def answered(name: str, seed: int, folder: Path) -> dict[str, object]:
    """What siq says of one record: whether it is certified, and the heights of barriers that it certifies."""
    table, height = KINDS[name](np.random.default_rng(seed))
    file = folder / f"{name}-{seed}.csv"
    table.to_csv(file, index=False)
    began = time.perf_counter()
    row: dict[str, object] = {"kind": name, "seed": seed, "samples": len(table), "true": height}
    try:
        found = siq.Landscape.from_recordings(file)
    except (siq.InputError, siq.NumericalFailure):
        return row | {"certified": False, "seconds": time.perf_counter() - began}
    certified = found.certificate is not None and found.certificate.certified
    row |= {"certified": certified, "seconds": time.perf_counter() - began}
    if not certified or found.noise is None:
        return row
    ways = [way for way in found.transitions if way.end is not None]
    for place, way in enumerate(sorted(ways, key=lambda way: way.start), 1):
        value = way.barrier / found.noise.intensity
        error = value * way.leverage * found.noise.standard_error / found.noise.intensity
        row |= {
            f"height {place}": value,
            f"error {place}": float(np.hypot(np.nan_to_num(way.error) / found.noise.intensity, error)),
        }
    return row


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the records, and a table of what was answered."""
    parser = argparse.ArgumentParser(prog="benchmarks.as_recorded")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--folder", type=Path, default=Path("results/as_recorded"))
    chosen = parser.parse_args(arguments)
    chosen.folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for seed in range(chosen.seeds):
        for name in chosen.kinds:
            rows.append(answered(name, seed, chosen.folder))
            print({key: round(one, 2) if isinstance(one, float) else one for key, one in rows[-1].items()})
    found = pd.DataFrame(rows)
    found.to_csv(chosen.folder / "answers.csv", index=False)
    scores = np.array(
        [(found[f"height {k}"] - found.true) / found[f"error {k}"] for k in (1, 2) if f"height {k}" in found]
    )
    scores = scores[np.isfinite(scores)]
    print(f"{int(found.certified.sum())} of {len(found)} certified;", end=" ")
    print(f"{int((np.abs(scores) < 1.96).sum())} of {len(scores)} barriers within 1.96 errors")


if __name__ == "__main__":
    main()
