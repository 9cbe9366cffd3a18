"""Mean escape times by the law, from what a run identified, beside direct simulations of the card."""

from typing import Any

import numpy as np

from siq.errors import NumericalFailure
from siq.landscape.escape import Neighbourhood, neighbourhood, simulate_escapes
from siq.randomness import generator
from siq.systems import System, load_system
from siq.tables import as_table, write_table
from siq.vector_field import VectorField
from step import job, read_json

WALKERS = 400
FOLLOWED = 1.5  # predicted mean times, after which who is left counts as censored
NEIGHBOURHOOD = 0.2  # of the barrier out of the well that is reached


def simulated(
    system: System,
    landscape: dict[str, Any],
    way: dict[str, Any],
    intensity: float,
    draw: np.random.Generator,
) -> dict[str, object]:
    """The simulated mean time of one way out, at one intensity."""
    field = VectorField(system.symbols, system.equations)
    starts = [np.array(well["attractor"]) for well in landscape["wells"]]
    targets: list[Neighbourhood] = []
    for index, position in enumerate(starts):
        barriers = [
            one["barrier"] for one in landscape["transitions"] if one["start"] == index and one["barrier"]
        ]
        if index != way["start"] and barriers:
            targets.append(
                neighbourhood(
                    field, position, diffusion=system.diffusion, level=NEIGHBOURHOOD * min(barriers) / 2
                )
            )
    predicted = way["prefactor"] * np.exp(way["barrier"] / intensity)
    try:
        found = simulate_escapes(
            field, starts[way["start"]], targets, diffusion=system.diffusion, intensity=intensity,
            longest=FOLLOWED * predicted, generator=draw, walkers=WALKERS,
        )  # fmt: skip
    except (NumericalFailure, ValueError) as error:
        return {"predicted": predicted, "escapes": 0, "note": str(error)}
    return {
        "predicted": predicted, "simulated": found.mean, "simulated_error": found.standard_error,
        "escapes": found.escapes, "note": "",
    }  # fmt: skip


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    study, rows = snakemake.params.study, []
    system = load_system(snakemake.input.card)
    landscapes = [one for one in map(read_json, snakemake.input.landscapes) if one is not None]
    complete = [one for one in landscapes if all(well["height"] is not None for well in one["wells"])]
    for way in complete[0]["transitions"] if complete else []:
        if way["prefactor"] is None or way["barrier"] is None or way["end"] is None:
            continue
        for number, intensity in enumerate(study["landscape"]["noise_intensities"]):
            draw = generator(study["seed"], "escape", str(way["start"]), str(number))
            row = simulated(system, complete[0], way, intensity, draw)
            name = f"A{way['start'] + 1} to A{way['end'] + 1}"
            rows.append({"transition": name, "intensity": intensity} | row)
    write_table(snakemake.output.table, as_table("escape", rows))


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
