"""References for the landscape of a card: characteristics, a mesh, and minimum action paths."""

from typing import Any

from siq.landscape.reference import reference_landscape, write_reference
from siq.outline import evenly_spread, outline
from siq.randomness import generator
from siq.systems import load_system
from siq.vector_field import VectorField
from step import job

STARTS = 4000


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    system, study = load_system(snakemake.input.card), snakemake.params.study
    field = VectorField(system.symbols, system.equations)
    draw = generator(study["seed"], "reference")
    low, high = system.domain.T
    x = draw.uniform(low, high, size=(STARTS, len(system.domain)))
    points = x[evenly_spread(x, generator=draw)]
    reference = reference_landscape(
        field, outline(field, points, diffusion=system.diffusion), diffusion=system.diffusion,
        box=system.domain, reach=study["landscape"]["reach"], generator=draw,
    )  # fmt: skip
    write_reference(snakemake.output[0], reference)


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
