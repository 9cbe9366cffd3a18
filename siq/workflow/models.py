"""The formulas of all runs of a study, and which of them figures and pages show."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from siq.quasipotential.formulas import SymbolicDecomposition, read_model
from siq.workflow.tables import METHODS, Method

Shown = tuple[int | None, Method]
"""A run, and the method of it whose formula is shown; None where no run has a formula."""


@dataclass(frozen=True)
class ModelFiles:
    """The `model.json` of every run; formulas are parsed for the runs that are shown alone."""

    paths: tuple[str, ...]

    @cached_property
    def _methods(self) -> list[dict[str, Any]]:
        return [json.loads(Path(path).read_text(encoding="utf-8"))["methods"] for path in self.paths]

    def with_formula(self, method: Method) -> list[int]:
        """The runs with one formula of V for the whole region."""
        return [run for run, one in enumerate(self._methods) if one.get(method, {}).get("V")]

    def with_any_formula(self, method: Method) -> list[int]:
        """The runs with a formula of V, be it of the whole region or of single wells."""
        have = [one.get(method, {}) for one in self._methods]
        return [run for run, one in enumerate(have) if one.get("V") or one.get("wells")]

    def representative(self, rrmse: pd.DataFrame) -> Shown:
        """The formula that is shown: refined where any run has one, otherwise as published.

        Of the runs with such a formula it is the median by error where errors are known, otherwise the first.
        """
        for method in reversed(METHODS):
            with_formula = self.with_formula(method)
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
        return read_model(self.paths[run])[0]

    def certificates(self, run: int) -> dict[str, Any]:
        """Their certificates."""
        return read_model(self.paths[run])[1]
