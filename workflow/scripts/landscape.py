"""The landscape of a run: equilibria, one formula for each well, transitions, and U over all wells."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from siq.errors import NumericalFailure
from siq.field_file import read_field
from siq.landscape.landscape import Landscape, find_landscape
from siq.landscape.local import best_trial
from siq.landscape.options import LandscapeOptions
from siq.landscape.storage import write_landscape
from siq.outline import evenly_spread, outline
from siq.randomness import generator
from siq.recordings import snapshot_pairs
from siq.systems import diffusion_matrix
from siq.tables import as_table, write_table
from step import job, outcome, pair_step, read_run, write_outcomes


def place(position: np.ndarray) -> str:
    """A state as text."""
    return "(" + ", ".join(f"{value:.6g}" for value in position) + ")"


def landscape_rows(run: int, found: Landscape) -> pd.DataFrame:
    """One row for each equilibrium and each way out of a well."""
    names = [f"A{index + 1}" for index in range(len(found.attractors))]
    heights = {place(one.position): index for index, one in enumerate(found.attractors)}
    tops: dict[str, float] = {}
    for way in found.transitions:
        top = found.heights[way.start] + way.barrier
        tops[place(way.saddle.position)] = min(top, tops.get(place(way.saddle.position), np.inf))
    rows: list[dict[str, object]] = []
    for one in found.equilibria:
        index = heights.get(place(one.position))
        eigenvalues = ", ".join(
            f"{value.real:.4g}" + (f"{value.imag:+.4g}i" if value.imag else "") for value in one.eigenvalues
        )
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
        )
    for way in found.transitions:
        beyond = "outside" if way.end is None else names[way.end]
        rows.append(
            {
                "run": run,
                "item": f"{names[way.start]} to {beyond}",
                "kind": "transition",
                "position": place(way.saddle.position),
                "U": found.heights[way.start] + way.barrier,
                "barrier": way.barrier,
                "standard_error": way.standard_error,
                "by_formula": way.by_formula,
                "minimum_action": np.nan if way.path is None else way.path.uphill.action,
                "prefactor": np.nan if way.rate is None else way.rate.prefactor,
                "note": "; ".join(way.notes),
            }
        )
    return as_table("landscape", rows)


def degree_rows(run: int, found: Landscape) -> pd.DataFrame:
    """Accuracy against number of terms, about each attractor."""
    rows = [
        {
            "run": run, "attractor": f"A{index + 1}", "degree": trial.degree, "terms": trial.terms,
            "residual": trial.residual, "covered": trial.covered, "chosen": number == best_trial(trials),
        }
        for index, trials in enumerate(found.trials)
        for number, trial in enumerate(trials)
    ]  # fmt: skip
    return as_table("degrees", rows)


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    run, study = int(snakemake.wildcards.run), snakemake.params.study
    source, target = snakemake.input, snakemake.output
    recordings, record = read_run(source.recordings), read_field(source.field)
    table, degrees = as_table("landscape", []), as_table("degrees", [])
    if recordings is None or record is None:
        result = outcome(run, "landscape", "skipped", "no vector field was identified")
    else:
        diffusion = diffusion_matrix(study["metric"]["diffusion"], len(recordings.names))
        x = snapshot_pairs(recordings, pair_step=pair_step(study)).x0
        points = x[evenly_spread(x, generator=generator(study["seed"], run, "landscape"))]
        try:
            setting = outline(record.found.field, points, diffusion=diffusion, seed=run)
            found = find_landscape(
                record.found, setting, diffusion=diffusion, seed=run,
                options=LandscapeOptions(**study["landscape"]),
            )  # fmt: skip
            write_landscape(target.quasipotential, found, field=record.found.field)
            table, degrees = landscape_rows(run, found), degree_rows(run, found)
            status = "ok" if found.quasipotential is not None and not found.notes else "warning"
            result = outcome(run, "landscape", status, "; ".join(found.notes))
        except (NumericalFailure, np.linalg.LinAlgError) as error:
            result = outcome(run, "landscape", "failed", str(error))
    if result["status"] in ("failed", "skipped"):
        Path(target.quasipotential).touch()
    write_table(target.table, table)
    write_table(target.degrees, degrees)
    write_outcomes(target.outcome, [result])


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
