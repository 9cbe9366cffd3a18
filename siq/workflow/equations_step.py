"""The step that finds the landscape of given equations (`siq.quasipotential.landscape_assembly`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass as plain_dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from siq.errors import NumericalFailure
from siq.quasipotential.landscape import Landscape, NoLandscape
from siq.quasipotential.landscape_assembly import EquationSettings, landscape_from_equations
from siq.quasipotential.landscape_files import write_landscape
from siq.systems.dynamics import Dynamics
from siq.workflow.landscape_step import degree_rows, landscape_rows
from siq.workflow.outcomes import Method, Outcome, Status, Step
from siq.workflow.tables import as_table, write_table


@plain_dataclass(frozen=True)
class FoundOfEquations:
    """The landscape of a study of equations, None where there is none, and what became of the step."""

    landscape: Landscape | None
    outcome: Outcome


def run(settings: EquationSettings, system: Dynamics) -> FoundOfEquations:
    """The landscape of a system; where it has none, the outcome says why."""
    try:
        found = landscape_from_equations(system, settings)
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        reason = error.reason if isinstance(error, NoLandscape) else str(error)
        return FoundOfEquations(None, Outcome(0, Step.LANDSCAPE, Status.FAILED, reason))
    whole = found.global_quasipotential is not None
    outcome = Outcome(0, Step.LANDSCAPE, Status.OK if whole else Status.WARNING, "; ".join(found.notes))
    return FoundOfEquations(found, outcome)


def write(found: FoundOfEquations, *, quasipotential: str | Path, tables: Mapping[str, str | Path]) -> None:
    """Write `quasipotential.json`, empty where there is no landscape, and the tables by name.

    Parameters
    ----------
    found
        What `run` gave.
    quasipotential
        Its file.
    tables
        Files of ``landscape``, ``degrees``, ``certificates`` and ``outcomes``.
    """
    rows: dict[str, pd.DataFrame] = {name: as_table(name, []) for name in tables}
    kept = found.outcome
    rows["outcomes"] = as_table("outcomes", [kept.as_data() | {"step": kept.step, "status": kept.status}])
    if found.landscape is None:
        Path(quasipotential).touch()
    else:
        write_landscape(quasipotential, found.landscape)
        rows["landscape"] = landscape_rows(0, found.landscape)
        rows["degrees"] = degree_rows(0, found.landscape)
        certificate = found.landscape.certificate
        made = {} if certificate is None else certificate.tests
        rows["certificates"] = as_table(
            "certificates",
            [
                {"run": 0, "method": str(Method.REFINED), "test": name} | verdict.as_data()
                for name, verdict in made.items()
            ],
        )
    for name, path in tables.items():
        write_table(path, rows[name])
