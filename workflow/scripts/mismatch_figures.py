"""Figures of a diagnosis: the fit, what is missing and where, the candidates, and escape times."""

from workflow.warm import run_warm

run_warm()

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import sympy
from matplotlib.figure import Figure

from siq.report.diagnosis_sections import final_simulation
from siq.report.plots.diagnosis import (
    plot_before_after,
    plot_candidates,
    plot_curves,
    plot_described,
    plot_escapes,
    plot_held_out,
    plot_missing,
)
from siq.report.plots.style import save_figure
from siq.systems.cards import load_system
from siq.systems.dynamics import Dynamics, symbol
from siq.systems.formulas import compile_formulas
from siq.workflow.tables import read_table
from step import job, read_json


def units_of(model: Dynamics) -> dict[str, str]:
    """Units of states, inputs and outputs, as far as they are known."""
    units = dict(zip(model.states, model.units, strict=True))
    units |= {entry.name: entry.unit for entry in model.inputs}
    return units | {name: units[str(formula)] for name, formula in model.outputs if str(formula) in units}


def plane(states: list[str], curves: pd.DataFrame, place: dict[str, Any] | None) -> tuple[str, str]:
    """The two states along which most of what is missing can be seen, the first by its location."""
    best = curves[curves["stage"] == "before"].sort_values("gain") if len(curves) else curves
    # Of several curves along one coordinate the last, which is the best, counts.
    gains = dict(zip(best["coordinate"], best["gain"], strict=True)) if len(best) else {}
    ranked = sorted(states, key=lambda name: -float(gains.get(name, 0.0)))
    wanted = [place["coordinate"], *place["equations"]] if place is not None else []
    order = list(dict.fromkeys([*(name for name in wanted if name in states), *ranked]))
    return order[0], order[1]


def added_terms(after: Dynamics, before: Dynamics, table: pd.DataFrame) -> dict[str, np.ndarray]:
    """What the final simulation has beyond the card's, at states, where that is a function of them alone."""
    values = {symbol(entry.name): sympy.Float(entry.value, 17) for entry in after.parameters}
    symbols = [symbol(name) for name in before.states]
    found = {}
    for name, new, old in zip(before.states, after.equations, before.equations, strict=False):
        change = sympy.expand(new - old).xreplace(values)
        if change != 0 and change.free_symbols <= set(symbols):
            with np.errstate(all="ignore"):
                result = compile_formulas([change], symbols)(table[list(before.states)].to_numpy(float).T)
            found[name] = result[0]
    return found


def missing_map(
    before: Dynamics, after: Dynamics, forces: pd.DataFrame, curves: pd.DataFrame, verdict: dict[str, Any]
) -> Figure | None:
    """The missing part over the plane of the two most relevant states, where there are two."""
    if verdict["location"] is None or before.dimension < 2:
        return None
    names = plane(list(before.states), curves, verdict["location"])
    known = forces.dropna(subset=list(names))
    missing = {
        name.removeprefix("missing_in_"): known[name].to_numpy(float)
        for name in known.columns
        if name.startswith("missing_in_")
    }
    source = "forces by which the recalibrated simulation follows the recordings"
    if not any(np.nan_to_num(values).any() for values in missing.values()):
        # Where no random forces were admitted, the fit has none to show.
        missing, source = added_terms(after, before, known), "terms that were found, at the recorded states"
    return plot_missing(
        known[list(names)].to_numpy(float), missing, names=names, units=units_of(before),
        time_unit=before.time_unit, source=source,
    )  # fmt: skip


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    source, folder = snakemake.input, Path(snakemake.output.folder)
    verdict, before, after = read_json(source.verdict), load_system(source.card), load_system(source.system)
    curves, place = read_table(source.curves), verdict["location"]
    named = None if place is None else (", ".join(place["equations"]), place["coordinate"])
    units, time_unit = units_of(before), before.time_unit
    held_out, noise = read_table(source.held_out), read_table(source.noise)
    sensors = noise[(noise["stage"] == "final") & (noise["kind"] == "measurement")]
    final = final_simulation(verdict)
    figures = {
        "before_after": plot_before_after(
            held_out, after=final, noise=dict(zip(sensors["name"], sensors["variance"], strict=True)),
            units=units, time_unit=time_unit,
        ),
        "held_out": plot_held_out(held_out, units=units, time_unit=time_unit),
        "curves": plot_curves(curves, named=named, units=units, time_unit=time_unit)
        if verdict["location"] is not None else None,
        "described": plot_described(verdict["described"], units=units, time_unit=time_unit),
        "map": missing_map(before, after, read_table(source.forces), curves, verdict),
        "candidates": plot_candidates(read_table(source.candidates)),
        "escapes": plot_escapes(read_table(source.escape), time_unit=time_unit),
    }  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        if figure is not None:
            save_figure(figure, folder / name)


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
