"""The step that finds the landscape of given equations (`siq.quasipotential.landscape_assembly`)."""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass
from typing import Any

import numpy as np

from siq.errors import NumericalFailure
from siq.quasipotential.landscape import Landscape, NoLandscape
from siq.quasipotential.landscape_assembly import EquationSettings, landscape_from_equations
from siq.systems.dynamics import Dynamics
from siq.workflow.landscape_step import degree_rows, landscape_rows
from siq.workflow.outcomes import Method, Outcome, Status, Step
from siq.workflow.tables import as_table


@plain_dataclass(frozen=True)
class FoundOfEquations:
    """The landscape of a study of equations, None where there is none, and what became of the step."""

    landscape: Landscape | None
    outcome: Outcome

    def files(self) -> dict[str, Any]:
        """By the names of the rule."""
        rows = {name: as_table(name, []) for name in ("landscape", "degrees", "certificates")}
        if self.landscape is not None:
            certificate = self.landscape.certificate
            tests = {} if certificate is None else certificate.tests
            rows = {
                "landscape": landscape_rows(0, self.landscape),
                "degrees": degree_rows(0, self.landscape),
                "certificates": as_table(
                    "certificates",
                    [
                        {"run": 0, "method": str(Method.REFINED), "test": name} | verdict.as_data()
                        for name, verdict in tests.items()
                    ],
                ),
            }
        outcome = self.outcome.as_data() | {"step": self.outcome.step, "status": self.outcome.status}
        return {"quasipotential": self.landscape, "outcomes": as_table("outcomes", [outcome])} | rows


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
