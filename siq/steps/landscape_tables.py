"""The landscape of a run as rows of the tables `landscape` and `degrees`."""

from __future__ import annotations

import numpy as np
import pandas as pd

from siq.dynamics.cycles import Cycle
from siq.landscape.dwell_times import MeanTime, dwell_time, exit_time
from siq.landscape.landscape import Landscape
from siq.potential.local_wells import best_trial
from siq.study.tables import as_table


def place(position: np.ndarray) -> str:
    """A state as text."""
    return "(" + ", ".join(f"{value:.6g}" for value in position) + ")"


def landscape_rows(run: int, found: Landscape, remark: str | None = None) -> pd.DataFrame:
    """One row for each equilibrium, cycle and way out; `remark` is of what all barriers hang on.

    Mean times are for the noise of the landscape: of an attractor the time in its well, of a transition that
    over its saddle alone; the error is that of data and law together.
    """
    names = [f"A{index + 1}" for index in range(len(found.attractors))]
    heights = {place(one.position): index for index, one in enumerate(found.attractors)}
    tops: dict[str, float] = {}
    for way in found.transitions:
        top = found.heights[way.start] + way.barrier
        tops[place(way.saddle.position)] = min(top, tops.get(place(way.saddle.position), np.inf))
    noise = found.noise
    rows: list[dict[str, object]] = []
    for one in found.equilibria:
        index = heights.get(place(one.position))
        eigenvalues = ", ".join(_complex(value) for value in one.eigenvalues)
        rows.append(
            {
                "run": run,
                "item": "" if index is None else names[index],
                "kind": one.kind,
                "position": place(one.position),
                "eigenvalues": eigenvalues,
                "U": tops.get(place(one.position), np.nan) if index is None else found.heights[index],
                "basin": np.nan if index is None else found.basins[index],
            }
            | ({} if index is None else _time(found, dwell_time(found.exits(index), found.noise)))
        )
    rows += [_cycle_row(run, found, one, names, tops) for one in (*found.cycles, *found.parting)]
    for way in found.transitions:
        beyond = "outside" if way.end is None else names[way.end]
        rows.append(
            {
                "run": run,
                "item": f"{names[way.start]} to {beyond}",
                "kind": "transition",
                "position": place(way.place),
                "U": found.heights[way.start] + way.barrier,
                "barrier": way.barrier,
                "standard_error": way.standard_error,
                "formula_share": way.formula_share,
                "minimum_action": np.nan if way.path is None else way.path.uphill.action,
                "prefactor": np.nan if way.rate is None else way.rate.prefactor,
                "barrier_over_noise": np.nan if noise is None else way.barrier / noise.intensity,
                "note": "; ".join([*way.notes, *([] if remark is None else [remark])]),
            }
            | _time(found, None if noise is None else exit_time(way.exit, noise))
        )
    return as_table("landscape", rows)


def _cycle_row(
    run: int, found: Landscape, one: Cycle, names: list[str], tops: dict[str, float]
) -> dict[str, object]:
    """Of a cycle, one of its states, the Floquet exponents, and a note with period and multipliers."""
    index = next((at for at, other in enumerate(found.attractors) if other is one), None)
    multipliers = ", ".join(_complex(value) for value in one.multipliers)
    return {
        "run": run,
        "item": "" if index is None else names[index],
        "kind": one.kind,
        "position": place(one.position),
        "eigenvalues": ", ".join(_complex(value) for value in one.eigenvalues),
        "U": tops.get(place(one.position), np.nan) if index is None else found.heights[index],
        "basin": np.nan if index is None else found.basins[index],
        "note": f"period {one.period:.8g}, Floquet multipliers {multipliers}",
    }


def _complex(value: complex) -> str:
    return f"{value.real:.4g}" + (f"{value.imag:+.4g}i" if value.imag else "")


def _time(found: Landscape, mean: MeanTime | None) -> dict[str, object]:
    noise = np.nan if found.noise is None else found.noise.intensity
    if mean is None:
        return {"noise": noise}
    return {"noise": noise, "mean_time": mean.value, "mean_time_error": mean.value * mean.error}


def degree_rows(run: int, found: Landscape) -> pd.DataFrame:
    """Accuracy against number of terms, about each attractor."""
    rows = [
        {
            "run": run, "attractor": f"A{index + 1}", "degree": trial.degree, "terms": trial.terms,
            "residual": trial.residual, "covered": trial.covered, "chosen": number == best_trial(well.trials),
        }
        for index, well in enumerate(found.wells)
        if well is not None
        for number, trial in enumerate(well.trials)
    ]  # fmt: skip
    return as_table("degrees", rows)
