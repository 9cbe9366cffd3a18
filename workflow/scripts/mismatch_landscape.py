"""What left-out physics, or other parameters, do to the wells of a system."""

from workflow.warm import run_warm

run_warm()

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from siq.errors import NumericalFailure
from siq.numerics.files import whole_file
from siq.systems.cards import load_system
from siq.workflow.tables import read_table, write_table
from step import job, read_json
from workflow.consequences import ESCAPE_COLUMNS, WELLS_COLUMNS, Consequences, compare_landscapes, obstacle

COMPARED = {
    "missing physics": ("recalibrated", "augmented"),
    "parameter shift": ("before", "recalibrated"),
}


def consequences(source: Any) -> Consequences | str:
    """Landscapes, or why there are none."""
    verdict = read_json(source.verdict)["verdict"]
    if verdict not in COMPARED:
        return f"The verdict is “{verdict}”: there are no two landscapes to compare."
    files = {"before": source.card, "recalibrated": source.recalibrated, "augmented": source.system}
    models = {name: load_system(files[name]) for name in COMPARED[verdict]}
    if reason := obstacle(list(models.values())):
        return reason
    names = list(next(iter(models.values())).states)
    states = read_table(source.forces)[names].to_numpy(dtype=float)
    states = states[np.isfinite(states).all(axis=1)]
    try:
        return compare_landscapes(models, states)
    except NumericalFailure as error:
        return f"There is no landscape to compare: {error}."


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    found = consequences(snakemake.input)
    if isinstance(found, str):
        wells, escape = (pd.DataFrame(columns=list(names)) for names in (WELLS_COLUMNS, ESCAPE_COLUMNS))
        found = Consequences(wells, escape, (found,))
    write_table(snakemake.output.wells, found.wells)
    write_table(snakemake.output.escape, found.escape)
    with whole_file(snakemake.output.notes) as partial:
        Path(partial).write_text(json.dumps(list(found.notes), ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
