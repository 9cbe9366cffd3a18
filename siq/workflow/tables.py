"""Tables of results and their columns; what became of the steps of a run; the formulas of all runs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import pandas as pd
import yaml

if TYPE_CHECKING:
    from siq.quasipotential.formulas import SymbolicDecomposition


class Step(StrEnum):
    """The steps of a run, in the order of the table `outcomes`; a run either simulates or resamples."""

    SIMULATE = "simulate"
    RESAMPLE = "resample"
    IDENTIFY = "identify"
    TRAIN = "train"
    REGRESS = "regress"
    REFINE = "refine"
    SCORE = "score"
    LANDSCAPE = "landscape"


class Status(StrEnum):
    """How a step ended: a result, one with a reservation, none, or never begun as a step before failed."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"
    SKIPPED = "skipped"


class Method(StrEnum):
    """Whose formulas they are.

    ``regression`` is the published method, ``refined`` ours. ``randomised network`` is no method but the
    control, networks with their weights in random order, whose V must not agree with the refined one.
    """

    REGRESSION = "regression"
    REFINED = "refined"
    CONTROL = "randomised network"


METHODS = (Method.REGRESSION, Method.REFINED)
"""The paper's formulas, and ours, in the order of the tables."""


@dataclass(frozen=True)
class Outcome:
    """What became of one step of one run."""

    run: int  #: its number
    #: Which step, and how it ended.
    step: Step
    status: Status = Status.OK
    reason: str = ""  #: why it is not ``ok``, in words; of one that is, what has to be known of it
    #: What else the step says of itself, as plain data.
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def usable(self) -> bool:
        """Whether the step left a result, be it with a reservation."""
        return self.status in (Status.OK, Status.WARNING)

    def as_data(self) -> dict[str, Any]:
        """As it stands in the file."""
        plain = {"run": self.run, "step": str(self.step), "status": str(self.status), "reason": self.reason}
        return plain | dict(self.details)

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> Outcome:
        """The outcome that `as_data` gave."""
        details = {
            key: value for key, value in data.items() if key not in ("run", "step", "status", "reason")
        }
        return cls(int(data["run"]), Step(data["step"]), Status(data["status"]), data["reason"], details)


POSITION = "position"
"""In the details of an outcome: where the run stands among the networks of its block."""
Result = TypeVar("Result", covariant=True)


@dataclass(frozen=True)
class StepResult(Generic[Result]):
    """What a step of a run found, None where it failed, and what became of it."""

    result: Result | None
    outcome: Outcome


def not_trained(number: int) -> StepResult[Any]:
    """A run for which no networks were asked."""
    return StepResult(None, Outcome(number, Step.TRAIN, Status.SKIPPED, "no networks were asked for"))


def why_no_landscape(outcomes: Iterable[Outcome]) -> str:
    """Why steps left no landscape: what the one said that came as far as any, without a full stop."""
    outcomes = [one for one in outcomes if one.reason]
    for status in (Status.FAILED, Status.WARNING, Status.SKIPPED):
        mine = [one for one in outcomes if one.status == status]
        for one in sorted(mine, key=lambda each: each.step != Step.LANDSCAPE):
            return one.reason.rstrip(".")
    return "the recorded states lead to no stable state"


_SCHEMA = yaml.safe_load(Path(__file__).with_name("tables.yaml").read_text(encoding="utf-8"))
_KINDS = {name: kind for kind, names in _SCHEMA["types"].items() for name in names.split()}

COLUMNS: Mapping[str, Mapping[str, str]] = {
    table: {
        name: kind or _KINDS.get(name, "float64")
        for name, _, kind in (column.partition(":") for column in columns.split())
    }
    for table, columns in _SCHEMA["tables"].items()
}
"""Columns of every table, in order, with their types: the contract with whoever reads the results."""


def as_table(name: str, rows: pd.DataFrame | list[dict[str, object]]) -> pd.DataFrame:
    """Rows in the columns and types of a table of the contract; further columns are refused."""
    columns = COLUMNS[name]
    frame = pd.DataFrame(rows, columns=None if len(rows) else list(columns))
    unknown = set(frame.columns) - set(columns)
    if unknown:
        raise ValueError(
            f"the table '{name}' has no columns {sorted(unknown)}; see siq.workflow.tables.COLUMNS"
        )
    return frame.reindex(columns=list(columns)).astype(dict(columns)).reset_index(drop=True)


Shown = tuple[int | None, Method]
"""A run, and the method of it whose formula is shown; None where no run has a formula."""


@dataclass(frozen=True)
class ModelFiles:
    """The `model.json` of every run; formulas are parsed for the runs that are shown alone."""

    paths: tuple[str, ...]

    @cached_property
    def _methods(self) -> list[dict[str, Any]]:
        return [json.loads(Path(path).read_text(encoding="utf-8"))["methods"] for path in self.paths]

    def with_formula(self, method: Method, *scopes: str) -> list[int]:
        """The runs with a formula in one of the scopes: ``V``, for the whole region, and ``wells``."""
        return [run for run, one in enumerate(self._methods) if any(map(one.get(method, {}).get, scopes))]

    def representative(self, rrmse: pd.DataFrame) -> Shown:
        """The formula that is shown: refined where any run has one, otherwise as published.

        Of the runs with such a formula it is the median by error where errors are known, otherwise the first.
        """
        for method in reversed(METHODS):
            with_formula = self.with_formula(method, "V")
            if with_formula:
                mine = rrmse[(rrmse["method"] == method) & rrmse["run"].isin(with_formula)]
                ranked = mine.dropna(subset="rrmse").sort_values("rrmse")
                if len(ranked):
                    return int(ranked["run"].iloc[(len(ranked) - 1) // 2]), method
                return with_formula[0], method
        return None, METHODS[0]

    def first_wells(self) -> Shown:
        """The first run that has a formula about each attractor, where none has a single one."""
        for run, methods in enumerate(self._methods):
            for method, one in methods.items():
                if one.get("wells"):
                    return run, Method(method)
        return None, METHODS[0]

    def formulas(self, run: int) -> dict[str, SymbolicDecomposition]:
        """The formulas of a run by method."""
        from siq.quasipotential.formulas import read_model

        return read_model(self.paths[run])[0]
