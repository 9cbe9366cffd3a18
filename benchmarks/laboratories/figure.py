"""Errors of all barriers as a picture: one line for each laboratory, in units of its Cramér–Rao bound."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.laboratories.summary import Row
from siq.numerics.files import whole_file

WIDEST = 6.0  # bounds: what is further off stands at the edge
MARKS = {"siq": "o", "Kramers–Moyal": "x", "PySINDy": "+", "StochasticForceInference": "^"}


def draw(rows: list[Row], path: Path) -> None:
    """Write the picture."""
    names = list(dict.fromkeys(one.laboratory for one in rows))
    methods = list(dict.fromkeys(one.method for one in rows))
    figure, axes = plt.subplots(figsize=(7, 1.2 + 0.8 * len(names)), layout="constrained")
    axes.axvspan(-1, 1, color="0.9", label="one bound")
    draws = np.random.default_rng(0)
    for one in rows:
        errors = np.clip(one.errors[np.isfinite(one.errors)], -WIDEST, WIDEST)
        line, lane = names.index(one.laboratory), methods.index(one.method)
        height = line + 0.7 * (lane + 0.5) / len(methods) - 0.35
        axes.plot(
            errors, height + 0.03 * draws.uniform(-1, 1, errors.shape), MARKS.get(one.method, "s"),
            color=f"C{lane}", markersize=3, alpha=0.6,
            label=one.method if line == 0 or one is next(r for r in rows if r.method == one.method) else None,
        )  # fmt: skip
    axes.set(
        yticks=range(len(names)), yticklabels=names, xlim=(-1.05 * WIDEST, 1.05 * WIDEST),
        xlabel="error of a barrier, in Cramér–Rao bounds (edge: further off)",
    )  # fmt: skip
    axes.invert_yaxis()
    handles, labels = axes.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(unique.values(), unique.keys(), loc="outside lower center", ncols=len(unique))
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=150)
    plt.close(figure)
