"""How good is `siq.early_warning` on laboratories that drift towards a fold, and on some that do not?

Five kinds: the normal form of a fold, a double well that is tilted, the same two without a drift, and two
whose f is none of the polynomials that are fitted, May's grazed pasture and the lake of the gallery. The
barrier at the begin and at the end of the record, its length, and how far ahead is asked are drawn for each;
a record that tips before its end is drawn anew, with all of that. What is true is solved from the equation of
the laboratory on cells of its own.

    python -m benchmarks.early_warning --kind fold --first 0 --count 25 --out results/early-warning/fold.csv
    python -m benchmarks.early_warning --summary results/early-warning

The indicators of the field are Kendall's τ of the variance and of the correlation of neighbours in windows of
half the record, less a Gaussian trend of a tenth of it. Local windows are the same fit of the last third of
the record with nothing that changes in time.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import scipy.ndimage
import scipy.special
import scipy.stats
from scipy.linalg import solve_banded

import siq
from siq.workflow import tipping

KINDS = ("fold", "tilted", "steady", "grazing", "lake")
BEGIN, END = (6.0, 14.0), (2.5, 6.0)  # ΔU/ε
LENGTH, AHEAD = (500.0, 2000.0), (0.1, 0.5)  # relaxation times; and of the record
SAMPLE, SUBSTEPS = 0.1, 4  # relaxation times; steps of the simulation
CELLS, STEPS = 1200, 600
COMPARED = {
    "first_barrier": "begin", "last_barrier": "end", "last_mean_time": "mean_time", "window_barrier": "end",
    "window_mean_time": "mean_time",
}  # fmt: skip


class Laboratory(NamedTuple):
    """An equation ``dx = f(x, a(t)) dt + √Q dW``, a record of it and what is asked."""

    f: Callable[[np.ndarray, float], np.ndarray]
    course: Callable[[float], float]  #: the parameter by the time
    noise: float
    t: np.ndarray
    x: np.ndarray
    until: float
    begin: float
    end: float


def _line(begin: float, slope: float, t: float) -> float:
    return begin + slope * t


def family(kind: str, odd: bool) -> tuple[Callable[..., Any], np.ndarray, np.ndarray, np.ndarray, float]:
    """f, values of the parameter up to the fold, wells and saddles at them, and where it has tipped."""
    kind = {"steady": "fold" if odd else "tilted"}.get(kind, kind)
    if kind == "fold":
        a = np.linspace(1.0, 0.0, 400)
        return lambda x, a: a - x * x, a, np.sqrt(a), -np.sqrt(a), -2.0
    if kind == "tilted":
        a = np.linspace(0.0, 2 / np.sqrt(27), 400)
        roots = [np.sort(np.roots([-1, 0, 1, one]).real) for one in a]
        wells, saddles = (np.array([each[k] for each in roots]) for k in (0, 1))
        return lambda x, a: a + x - x**3, a, wells, saddles, 0.8
    if kind == "lake":
        a = np.linspace(0.5, 0.66, 400)
        places = np.linspace(0.3, 1.2, 200_001)  # the inflow at which each is at rest turns at the fold
        rest = places - places**8 / (1 + places**8)
        top = int(rest.argmax())
        wells = np.interp(a, rest[:top], places[:top])
        saddles = np.interp(-a, -rest[top:], places[top:])
        return lambda x, a: a - x + x**8 / (1 + x**8), a, wells, saddles, 1.3
    a = np.linspace(1.9, 2.6, 400)
    roots = [np.sort(np.roots([-0.1, 1, -0.1 - one, 1]).real) for one in a]
    wells, saddles = (np.array([each[k] for each in roots]) for k in (2, 1))
    return lambda x, a: x * (1 - x / 10) - a * x * x / (1 + x * x), a, wells, saddles, 1.0


def made(kind: str, seed: int) -> Laboratory:
    """A laboratory, with a record that has not tipped."""
    draw = np.random.default_rng([seed, KINDS.index(kind)])
    f, a, wells, saddles, tipped = family(kind, bool(seed % 2))
    across = np.linspace(wells, saddles, 401)
    heights = -np.trapezoid(f(across, a), across, axis=0)
    while True:
        begin, end = draw.uniform(*BEGIN), draw.uniform(*END)
        relaxations, ahead, start = draw.uniform(*LENGTH), draw.uniform(*AHEAD), draw.uniform(0, 0.5)
        if kind == "steady":
            begin = end
        first = int(start * 0.4 * len(a))
        noise = 2 * heights[first] / begin
        last = float(np.interp(-end * noise / 2, -heights, a))
        step = 1e-5
        rate = float(-(f(wells[first] + step, a[first]) - f(wells[first] - step, a[first])) / (2 * step))
        h, n = SAMPLE / rate / SUBSTEPS, int(relaxations / SAMPLE) * SUBSTEPS
        kicks, x = np.sqrt(noise * h) * draw.normal(size=n), np.empty(n + 1)
        x[0], parameter = wells[first], np.linspace(a[first], last, n + 1)
        side = np.sign(tipped - wells[first])
        for k in range(n):
            x[k + 1] = x[k] + f(x[k], parameter[k]) * h + kicks[k]
            if side * (x[k + 1] - tipped) > 0:
                break
        else:
            duration = n * h
            slope = (last - a[first]) / duration
            return Laboratory(
                f, partial(_line, float(a[first]), float(slope)), noise,
                np.arange(0, n + 1, SUBSTEPS) * h, x[::SUBSTEPS], duration * (1 + ahead), begin, end,
            )  # fmt: skip


def truth(lab: Laboratory, tipped: float) -> tuple[np.ndarray, float]:
    """Probabilities that it has tipped by dates evenly spread ahead; and the mean time at the end."""
    well = lab.x[-1]
    side = np.sign(tipped - np.median(lab.x))
    wall = np.median(lab.x) - side * 2 * np.ptp(lab.x)
    x = np.linspace(wall, tipped, CELLS)
    width, times = x[1] - x[0], np.linspace(lab.t[-1], lab.until, STEPS + 1)
    rate = lab.noise / (2 * width**2)

    def bands(t: float, own: float, dt: float) -> np.ndarray:
        fall = -2 / lab.noise * lab.f((x[1:] + x[:-1]) / 2, lab.course(t)) * abs(width) * np.sign(width)
        along, back = (rate / scipy.special.exprel(np.clip(one, -700, 700)) for one in (fall, -fall))
        out = np.append(along, rate) + np.append(0.0, back)  # the last cell leads out, the first is closed
        above, below = np.append(0.0, -dt * back), np.append(-dt * along, 0.0)
        return np.stack([above, own + dt * out, below])

    p = 1.0 * (np.arange(CELLS) == np.abs(x - well).argmin())
    frozen = solve_banded((1, 1), bands(lab.t[-1], 0.0, 1.0), p).sum()
    left = [0.0]
    for one, other in itertools.pairwise(times):
        p = solve_banded((1, 1), bands((one + other) / 2, 1.0, other - one), p)
        left.append(1 - p.sum())
    return np.array(left)[:: STEPS // tipping.DATES], float(frozen)


def indicators(x: np.ndarray) -> tuple[float, float]:
    """Kendall's τ of variance and correlation of neighbours."""
    rest = x - scipy.ndimage.gaussian_filter1d(x, len(x) / 10)
    size = len(x) // 2
    windows = [rest[k : k + size] for k in np.linspace(0, len(x) - size, 50).astype(int)]
    course = [[one.var() for one in windows], [np.corrcoef(one[:-1], one[1:])[0, 1] for one in windows]]
    first, second = (float(scipy.stats.kendalltau(range(50), each).statistic) for each in course)
    return first, second


def judged(kind: str, seed: int) -> dict[str, object]:
    """One laboratory, what is true of it and what is said."""
    lab = made(kind, seed)
    probability, frozen = truth(lab, family(kind, bool(seed % 2))[4])
    row: dict[str, object] = {"kind": kind, "seed": seed, "begin": lab.begin, "end": lab.end}
    row |= {"samples": len(lab.t), "mean_time": frozen, "drifts": kind != "steady"}
    row["tips"] = bool(np.random.default_rng(seed).random() < probability[-1])
    record = pd.DataFrame({"t": lab.t, "x": lab.x})
    said = siq.early_warning(record, until=lab.until, seed=seed)
    for k, place in enumerate((15, 30, 60)):
        now = said.probability.iloc[place]
        row |= {f"truth_{k}": probability[place], f"probability_{k}": now["probability"]}
        row |= {f"lower_{k}": now["lower"], f"upper_{k}": now["upper"]}
    for name, at in (("first", 0), ("last", -1)):
        row |= {f"{name}_{column}": value for column, value in said.course.iloc[at].items()}
    row |= {"falling": said.falling, "remarks": " ".join(one.code for one in said.remarks)}
    row["variance"], row["correlation"] = indicators(lab.x)
    families = tipping.FAMILIES
    try:
        tipping.FAMILIES = ((4, 0), (3, 0))  # type: ignore[assignment]
        last = siq.early_warning(record[-len(record) // 3 :], until=lab.until, seed=seed)
        row |= {f"window_{column}": value for column, value in last.course.iloc[-1].items()}
        row["window_probability"] = last.probability["probability"].iloc[-1]
        row["window_lower"], row["window_upper"] = last.probability[["lower", "upper"]].iloc[-1]
    finally:
        tipping.FAMILIES = families
    return row


def area(score: pd.Series, label: pd.Series) -> float:
    """Area under the curve of a score against a label."""
    rank = scipy.stats.rankdata(score)
    yes = label.to_numpy(bool)
    return float((rank[yes].sum() - yes.sum() * (yes.sum() + 1) / 2) / (yes.sum() * (~yes).sum()))


def summary(rows: pd.DataFrame) -> None:
    """Coverage, errors and areas under the curve."""
    slack = 1e-3  # of a probability: the cells
    for kind, some in [*rows.groupby("kind"), ("all", rows)]:
        below = [some[f"truth_{k}"] < some[f"lower_{k}"] - slack for k in range(3)]
        above = [some[f"truth_{k}"] > some[f"upper_{k}"] + slack for k in range(3)]
        held = [~one & ~other for one, other in zip(below, above, strict=True)]
        print(f"{kind}: {len(some)} laboratories")
        print("  P covered", *(f"{one.mean():.2f}" for one in held), end="; ")
        print(f"at last true below {below[2].mean():.2f}, above {above[2].mean():.2f}")
        for name, truth in COMPARED.items():
            covered = (some[f"{name}_lower"] <= some[truth]) & (some[truth] <= some[f"{name}_upper"])
            value = some[f"{name}_over_noise" if "barrier" in name else name]
            error = np.sqrt(np.mean(np.minimum(np.abs(np.log(value / some[truth])), 10) ** 2))
            print(f"  {name} covered {covered.mean():.2f}, rms of ln {error:.2f}")
        error, window = ((some[one] - some.truth_2) for one in ("probability_2", "window_probability"))
        covered = (some.window_lower - slack <= some.truth_2) & (some.truth_2 <= some.window_upper + slack)
        print(f"  rms error of P {np.sqrt((error**2).mean()):.3f}", end=", ")
        print(f"of the window {np.sqrt((window**2).mean()):.3f} (covered {covered.mean():.2f})")
        print(f"  mean P {some.probability_2.mean():.3f}, true {some.truth_2.mean():.3f}", end=", ")
        print(f"remarks {dict(some.remarks.value_counts())}")
    for label, scores in (("drifts", ("falling", "variance", "correlation")),
                          ("tips", ("probability_2", "falling", "variance", "correlation"))):  # fmt: skip
        print(label, {one: round(area(rows[one], rows[label]), 3) for one in scores})


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--kind", choices=("fold", "tilted", "steady", "grazing", "lake"))
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=1)
    parser.add_argument("--out", type=str)
    parser.add_argument("--summary", type=str)
    given = parser.parse_args()
    if given.summary:
        files = sorted(Path(given.summary).glob("*.csv"))
        rows = pd.concat(map(pd.read_csv, files))
        summary(rows.assign(remarks=rows["remarks"].fillna("").astype(str)))
    else:
        Path(given.out).parent.mkdir(parents=True, exist_ok=True)
        seeds = range(given.first, given.first + given.count)
        pd.DataFrame([judged(given.kind, seed) for seed in seeds]).to_csv(given.out, index=False)
