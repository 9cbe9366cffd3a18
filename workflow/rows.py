"""Rows of the tables of a run, in the columns of the contract (`siq.workflow.tables.COLUMNS`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from siq.numerics.text import place_text
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.occupancy import OccupancyCheck
from siq.quasipotential.rates import MeanTime, mean_residence_time
from siq.quasipotential.wells import best_trial
from siq.systems.cycles import Cycle
from siq.systems.equilibria import Equilibrium
from siq.workflow.tables import as_table


def concatenate(name: str, tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Tables of one kind below each other, in the order given; also of none."""
    filled = [table for table in tables if len(table)]
    return as_table(name, pd.concat(filled, ignore_index=True) if filled else [])


def visit_rows(run: int, found: OccupancyCheck | None, attractors: Sequence[np.ndarray]) -> pd.DataFrame:
    """One row for each well; none where there is no test."""
    rows = []
    for one in () if found is None else found.visits:
        lowest, highest = one.whole.limits
        rows.append(
            {
                "run": run,
                "attractor": place_text(attractors[one.well]),
                "visits": one.whole.visits,
                "time": one.whole.time,
                "counted": one.whole.mean,
                "lowest": lowest,
                "highest": highest if np.isfinite(highest) else np.nan,
                "held_out_visits": one.held_out.visits,
                "held_out_time": one.held_out.time,
                "held_out_counted": one.held_out.mean,
                "predicted": one.predicted,
                "predicted_error": one.predicted * one.error,
                "method": one.method,
                "probability": one.probability,
            }
        )
    return as_table("record", rows)


def density_rows(
    run: int, found: OccupancyCheck | None, attractors: Sequence[np.ndarray], states: Sequence[str]
) -> pd.DataFrame:
    """One row for each bin of each histogram."""
    rows = [
        {
            "run": run,
            "attractor": place_text(attractors[one.well]),
            "state": states[one.state],
            "lower": one.edges[place],
            "upper": one.edges[place + 1],
            "counted": one.counted[place],
            "predicted": one.predicted[place],
            "distance": one.distance,
            "independent": one.independent,
            "probability": one.probability,
        }
        for one in (() if found is None else found.densities)
        for place in range(len(one.counted))
    ]
    return as_table("record_density", rows)


def place(position: np.ndarray) -> str:
    """A state as text."""
    return "(" + ", ".join(f"{value:.6g}" for value in position) + ")"


def landscape_rows(run: int, found: Landscape | None, remark: str | None = None) -> pd.DataFrame:
    """One row for each equilibrium, cycle and way out; `remark` is of what all barriers hang on.

    Mean times are for the noise of the landscape: of an attractor the time in its well, of a transition that
    over its saddle alone; the error is that of data and law together.
    """
    if found is None:
        return as_table("landscape", [])
    names = [f"A{index + 1}" for index in range(len(found.attractors))]
    heights = {place(one.position): index for index, one in enumerate(found.attractors)}
    tops: dict[str, float] = {}
    for way in found.transitions:
        top = found.heights[way.start] + way.barrier
        tops[place(way.saddle.position)] = min(top, tops.get(place(way.saddle.position), np.inf))
    noise = found.noise
    rows: list[dict[str, object]] = []
    rest: list[Equilibrium | Cycle] = [*found.equilibria, *found.cycles, *found.parting]
    for one in rest:
        further: dict[str, object] = {}
        if isinstance(one, Cycle):  # one of its states, the Floquet exponents
            index = next((at for at, other in enumerate(found.attractors) if other is one), None)
            multipliers = ", ".join(_complex(value) for value in one.multipliers)
            further = {"note": f"period {one.period:.8g}, Floquet multipliers {multipliers}"}
        else:
            index = heights.get(place(one.position))
            if index is not None:
                further = _time(found, mean_residence_time(found.exits(index), noise))
        rows.append(
            {
                "run": run,
                "item": "" if index is None else names[index],
                "kind": one.kind,
                "position": place(one.position),
                "eigenvalues": ", ".join(_complex(value) for value in one.eigenvalues),
                "U": tops.get(place(one.position), np.nan) if index is None else found.heights[index],
                "basin": np.nan if index is None else found.basins[index],
            }
            | further
        )
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
                "minimum_action": np.nan if way.path is None else way.path.action,
                "prefactor": np.nan if way.rate is None else way.rate.prefactor,
                "barrier_over_noise": np.nan if noise is None else way.barrier / noise.intensity,
                "note": "; ".join([*way.notes, *([] if remark is None else [remark])]),
            }
            | _time(found, None if noise is None else way.exit.mean_exit_time(noise))
        )
    return as_table("landscape", rows)


def _complex(value: complex) -> str:
    return f"{value.real:.4g}" + (f"{value.imag:+.4g}i" if value.imag else "")


def _time(found: Landscape, mean: MeanTime | None) -> dict[str, object]:
    noise = np.nan if found.noise is None else found.noise.intensity
    if mean is None:
        return {"noise": noise}
    return {"noise": noise, "mean_time": mean.value, "mean_time_error": mean.value * mean.error}


def degree_rows(run: int, found: Landscape | None) -> pd.DataFrame:
    """Accuracy against number of terms, about each attractor."""
    rows = [
        {
            "run": run, "attractor": f"A{index + 1}", "degree": trial.degree, "terms": trial.terms,
            "residual": trial.residual, "covered": trial.covered,
            "chosen": not len(well.basis.units) and number == best_trial(well.trials),
        }
        for index, well in enumerate(() if found is None else found.wells)
        if well is not None
        for number, trial in enumerate(well.trials)
    ]  # fmt: skip
    return as_table("degrees", rows)


def certificate_rows(run: int, certificates: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Every test of every formula, with its figure; certificates are plain data by method."""
    rows = [
        {"run": run, "method": method, "test": test} | verdict
        for method, one in certificates.items()
        for test, verdict in one["tests"].items()
    ]
    return as_table("certificates", rows)
