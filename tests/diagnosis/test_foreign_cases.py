"""An answer to everything, within what a case may take: recordings like those that others bring."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from siq.diagnosis import forecasts, screening
from siq.diagnosis.diagnosis import Diagnosis, solve_case, tables_of
from siq.diagnosis.study import Allowance, read_case
from siq.errors import NumericalFailure
from siq.inference.budget import Budget, BudgetSpent
from siq.systems.cards import load_system
from tests.diagnosis.foreign_cases import (
    ForeignCase,
    chain_of_masses,
    double_pendulum,
    falling_ball,
    long_relaxation,
    motor_axis,
    polynomial_on_the_brink,
)

SMALL: dict[str, Callable[[], ForeignCase]] = {
    "falling ball, gravity free": lambda: falling_ball(0.3, fixed=False),
    "falling ball, linear drag": lambda: falling_ball(0.3, linear=True),
    "polynomial on the brink": lambda: polynomial_on_the_brink(samples=60, recordings=3),
    "eight states": lambda: chain_of_masses(samples=150, recordings=3),
}
MINUTES = ("eight states", "polynomial on the brink")
LARGE: dict[str, Callable[[], ForeignCase]] = {
    "motor axis, one recording": lambda: motor_axis(recordings=1),
    "motor axis, asymmetric": lambda: motor_axis(asymmetry=6.0),
    "double pendulum": double_pendulum,
    "double pendulum, fast camera": lambda: double_pendulum(rate_of_camera=400.0),
    "eight states, 10⁵ samples": chain_of_masses,
    "process noise, 10⁵ samples": long_relaxation,
}


def answered(
    case: ForeignCase, folder: Path, *, tell: Callable[[str], object] | None = None, **allowance: float
) -> Diagnosis:
    """A diagnosis, with everything that files have of it."""
    read = case.read(folder)
    settings = read.settings.model_copy(update={"budget": Allowance(**allowance)})
    found = solve_case(replace(read, settings=settings), tell=tell)
    said = found.statement.as_data()
    json.dumps(said, allow_nan=False)
    assert said["sentence"] and said["partial"] == bool(said["budget"]["stopped_by"])
    assert all(len(table.columns) for table in tables_of(found).values())
    (folder / "augmented.yaml").write_text(found.to_card(), encoding="utf-8")
    load_system(folder / "augmented.yaml")
    return found


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in MINUTES else name for name in SMALL]
)
def test_there_is_an_answer(name: str, tmp_path: Path) -> None:
    found = answered(SMALL[name](), tmp_path)
    assert found.verdict.mismatch and not found.statement.partial


@pytest.mark.slow
@pytest.mark.parametrize("name", LARGE)
def test_there_is_an_answer_to_what_is_large(name: str, tmp_path: Path) -> None:
    found = answered(LARGE[name](), tmp_path)
    account = found.statement.account
    print(f"{name}: {found.verdict}, {account.spent / account.allowed:.0%}, {account.seconds:.0f} s")
    assert found.verdict.mismatch


@pytest.mark.slow
def test_dry_friction_of_a_motor_is_named(tmp_path: Path) -> None:
    found = answered(motor_axis(samples=800), tmp_path)
    names = [each.name for each in found.mechanisms]
    assert names == ["dry friction"] or "dry friction" in found.mechanisms[0].indistinguishable_from
    assert found.mechanisms[0].parameters["c_1"].estimate == pytest.approx(20 / 95, rel=2e-3)


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Diagnosis, list[str]]:
    """A diagnosis with all that was told while it was made."""
    told: list[str] = []
    found = answered(falling_ball(0.3), tmp_path_factory.mktemp("followed"), tell=told.append)
    return found, told


def test_there_is_an_answer_to_a_ball_that_falls(followed: tuple[Diagnosis, list[str]]) -> None:
    found, _ = followed
    assert found.verdict.mismatch and not found.statement.partial


@pytest.mark.slow
def test_what_the_budget_does_not_reach_is_named(
    tmp_path: Path, followed: tuple[Diagnosis, list[str]]
) -> None:
    whole, _ = followed
    work = whole.statement.account.spent
    shares = {"little": 0.01, "half": 0.5}
    parts = [answered(falling_ball(0.3), tmp_path / name, evaluations=s * work) for name, s in shares.items()]
    for part in parts:
        said = part.statement.as_data()
        assert said["partial"] and said["budget"]["stopped_by"] == "work"
        assert any(each.startswith("This answer is partial") for each in said["remarks"])
    labels = {each.label for each in whole.investigation.context.candidates}
    # Of the first only the simulation's own parameters were fitted; the second had half of what it takes.
    assert len(parts[1].statement.not_tried) < len(parts[0].statement.not_tried) <= len(labels)
    assert not parts[0].investigation.search.screened and parts[1].investigation.search.screened
    # Work is counted, not timed: the same case takes the same.
    again = answered(falling_ball(0.3), tmp_path / "again", evaluations=0.5 * work)
    assert again.statement.account.spent == parts[1].statement.account.spent


def test_a_clock_that_runs_out_is_said(tmp_path: Path) -> None:
    found = answered(falling_ball(0.3), tmp_path, seconds=1e-3)
    assert found.statement.as_data()["budget"]["stopped_by"] == "clock"
    assert found.statement.remarks[-1].code == "diagnosis.partial"
    assert "the time allowed" in found.statement.as_data()["remarks"][-1]


def test_progress_is_told(followed: tuple[Diagnosis, list[str]]) -> None:
    told = followed[1]
    assert told[0].startswith("fitting the simulation's own parameters; 0% of the budget")
    assert any(text.startswith("candidate 2 of at most") for text in told)
    shares = [int(text.rpartition("; ")[2].partition("%")[0]) for text in told]
    assert shares == sorted(shares)


def test_a_budget_ends_what_exceeds_it_and_lets_pass_what_is_exempt() -> None:
    now = [0.0]
    budget = Budget(work=10.0, seconds=5.0, clock=lambda: now[0])
    budget.charge(8.0)
    budget.charge(8.0)  # begun while something was left
    with pytest.raises(BudgetSpent):
        budget.charge(1.0)
    assert budget.stopped_by == "work" and budget.account().partial
    with budget.exempt():
        budget.charge(1.0)
    assert budget.spent == 17.0
    late = Budget(seconds=5.0, clock=lambda: now[0])
    now[0] = 6.0
    with pytest.raises(BudgetSpent):
        late.charge(1.0)
    assert late.stopped_by == "clock"


def test_a_candidate_that_overflows_ends_itself_and_not_the_case(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Screening that has no numbers leaves what can be said without it."""

    def overflow(*_: object, **__: object) -> None:
        raise NumericalFailure("it runs away")

    monkeypatch.setattr(screening, "by_likelihood", overflow)
    monkeypatch.setattr(forecasts, "_gains", overflow)
    found = answered(falling_ball(0.3), tmp_path)
    assert {each.reason for each in found.statement.not_fitted} == {"it runs away"}
    assert not found.statement.partial and np.isfinite(found.statement.errors.recalibrated or 0.0)


def test_a_spent_budget_leaves_what_a_shift_is_judged_by(tmp_path: Path) -> None:
    """The census of the United States and the logistic equation: a prediction that a refit ruins."""
    people = "3.93 5.31 7.24 9.64 12.9 17.1 23.2 31.4 39.8 50.2 62.9 76 92 105.7 122.8 131.7 151.3 179.3"
    rows = [f"a,{1790 + 10 * place},{value}" for place, value in enumerate(people.split())]
    (tmp_path / "census.csv").write_text("\n".join(["recording,t,n", *rows]), encoding="utf-8")
    (tmp_path / "card.yaml").write_text(
        "name: census\ntime_unit: year\nstates: {N: {unit: '1'}}\noutputs: {n: N}\n"
        "parameters: {r: {value: 0.03, unit: 1/year}, K: {value: 200, unit: '1'}}\n"
        "equations: {N: r*N*(1 - N/K)}\n",
        encoding="utf-8",
    )
    read = read_case(tmp_path / "card.yaml", tmp_path / "census.csv", None)
    settings = read.settings.model_copy(update={"budget": Allowance(evaluations=1000)})
    assert solve_case(replace(read, settings=settings)).statement.partial
