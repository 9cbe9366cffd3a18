"""The reference of a card without wells is empty and says why; nothing after it fails."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import sympy
from known_systems import as_system, limit_cycle

from siq.quasipotential.landscape_comparison import ReferenceLandscape
from siq.report.study_page import _without_landscape
from siq.systems.dynamics import Dynamics
from siq.workflow.study import PipelineSettings, StateSpace
from siq.workflow.tables import COLUMNS, Status, Step, as_table
from workflow import comparison
from workflow.figures.study import landscape_figures

X, Y = sympy.symbols("x y", real=True)
SETTINGS = PipelineSettings(seed=1)


def system(formulas: tuple[sympy.Expr, ...], domain: list[list[float]]) -> Dynamics:
    """A system with a domain, as a card gives it."""
    return replace(Dynamics.of((X, Y)[: len(formulas)], formulas), domain=np.array(domain))


CYCLE = as_system(limit_cycle())
VAN_DER_POL = system((Y, (1 - X**2) * Y - X), [[-3.0, 3.0], [-4.0, 4.0]])
ONE_WELL = system((-X, -2 * Y), [[-1.0, 1.0], [-1.0, 1.0]])


@pytest.mark.parametrize(
    ("card", "reason"),
    [
        (CYCLE, "limit cycle of period 3.142"),
        (VAN_DER_POL, "limit cycle of period 6.663"),
        (ONE_WELL, "no saddle parts the attractors"),
        (system((0 * X, 0 * Y), [[-1.0, 1.0], [-1.0, 1.0]]), "nothing moves"),
    ],
)
def test_without_wells_there_is_a_reason_and_no_rows(card: Dynamics, reason: str, tmp_path: Path) -> None:
    comparison.reference_of_card(SETTINGS, card).write(tmp_path / "reference.npz")
    found = ReferenceLandscape.read(tmp_path / "reference.npz")
    assert reason in found.reason and found.attractors.shape == (0, 2)
    settings = PipelineSettings(seed=1)
    table = comparison.run_landscape_errors(settings, found, [], {})
    assert list(table.columns) == list(COLUMNS["landscape_errors"]) and table.empty
    drawn = landscape_figures(
        StateSpace(),
        degrees=as_table("degrees", []), escape=as_table("escape", []), reference=found,
    )  # fmt: skip
    assert "landscape_errors" not in drawn


def test_a_reference_that_exists_has_no_reason(tmp_path: Path) -> None:
    wells = system((X - X**3,), [[-1.6, 1.6]])
    comparison.reference_of_card(SETTINGS, wells).write(tmp_path / "reference.npz")
    found = ReferenceLandscape.read(tmp_path / "reference.npz")
    assert found.reason == "" and len(found.attractors) == 2


def test_the_answer_says_that_there_is_no_landscape_and_why() -> None:
    outcomes = pd.DataFrame(
        {
            "run": [0, 1],
            "step": [Step.LANDSCAPE] * 2,
            "status": [Status.WARNING, Status.OK],
            "reason": ["a cycle", ""],
        }
    )
    wells = as_table("landscape", [{"run": 1, "kind": "attractor"}])
    assert _without_landscape({"landscape": wells, "outcomes": outcomes}) == ("a cycle", 1, 2)
    one = {"landscape": wells.iloc[:0], "outcomes": outcomes.iloc[:1]}
    assert _without_landscape(one) == ("a cycle", 1, 1)
    assert _without_landscape({"landscape": wells, "outcomes": outcomes.iloc[1:]}) is None
