"""The steps that collect what all runs of a study found.

Where the study finds the landscape of every run, it is that of the run that is shown. Where it finds none,
as for many runs with one formula each, it is found for that run alone.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import dataclass as plain_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from siq.data.recordings import Recordings
from siq.inference.identification import FieldRecord
from siq.quasipotential.formulas import SymbolicDecomposition, read_model
from siq.quasipotential.landscape_files import landscape_data
from siq.quasipotential.wells import Well
from siq.workflow import landscape_step
from siq.workflow.landscape_step import LandscapeSettings
from siq.workflow.outcomes import METHODS, Method, Outcome, Step
from siq.workflow.published import PublishedFigure
from siq.workflow.scoring import summary_table
from siq.workflow.tables import as_table, concatenate

OF_RUNS = (
    "coefficients", "rrmse", "prediction", "certificates", "record", "record_density", "landscape", "degrees",
    "training",
)  # fmt: skip
"""Tables that every run, or every block of runs, has a part of."""


def run(
    parts: Mapping[str, Sequence[pd.DataFrame]],
    outcomes: Sequence[Outcome],
    published: Mapping[str, PublishedFigure],
    *,
    benchmarks: Path,
) -> dict[str, pd.DataFrame]:
    """The tables of a study by name.

    Parameters
    ----------
    parts
        The parts of each of the tables `OF_RUNS`.
    outcomes
        Of every step of every run.
    published
        Figures to be set beside ours.
    benchmarks
        Folder of the times that the workflow measured.
    """
    tables = {name: concatenate(name, list(parts[name])) for name in OF_RUNS}
    order = list(Step)
    entries = sorted(outcomes, key=lambda one: (one.run, order.index(one.step)))
    tables["outcomes"] = as_table(
        "outcomes",
        [
            {"run": one.run, "step": str(one.step), "status": str(one.status), "reason": one.reason}
            for one in entries
        ],
    )
    tables["timings"] = timings(benchmarks, {one.run for one in entries}, drawing=str(entries[0].step))
    tables["summary"] = summary_table(
        tables["coefficients"], tables["rrmse"], tables["prediction"], published
    )
    return tables


def timings(folder: Path, runs: Iterable[int], *, drawing: str) -> pd.DataFrame:
    """Seconds of every step of every run; runs that trained side by side share their time evenly.

    `drawing` is what the outcomes call the step that draws trajectories.
    """
    known, rows = set(runs), []
    for path in sorted(folder.glob("*/*.tsv")):
        first, _, last = path.parent.name.partition("-")
        together = [run for run in range(int(first), int(last or first) + 1) if run in known]
        seconds = float(pd.read_csv(path, sep="\t")["s"].iloc[0])
        rows += [
            {
                "run": run,
                "step": drawing if path.stem == "draw" else path.stem,
                "seconds": seconds / len(together),
            }
            for run in together
        ]
    return as_table("timings", rows).sort_values(["run", "step"], ignore_index=True)


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

    def first_wells(self) -> Shown:
        """The first run that has a formula about each attractor, where none has a single one."""
        for run, methods in enumerate(self._methods):
            for method, one in methods.items():
                if one.get("wells"):
                    return Shown(run, Method(method))
        return Shown(None, METHODS[0])

    def formulas(self, run: int) -> dict[str, SymbolicDecomposition]:
        """The formulas of a run by method."""
        return read_model(self.paths[run])[0]

    def certificates(self, run: int) -> dict[str, Any]:
        """Their certificates."""
        return read_model(self.paths[run])[1]


@dataclass(frozen=True)
class Shown:
    """A run, and the method of it whose formula is shown; None where no run has a formula."""

    run: int | None
    method: Method


def shown_formula(rrmse: pd.DataFrame, models: ModelFiles) -> Shown:
    """The run and the method whose formula is shown: refined where any run has one, otherwise as published.

    Of the runs with such a formula it is the median by error where errors are known, otherwise the first.
    """
    for method in reversed(METHODS):
        with_formula = models.with_formula(method)
        if with_formula:
            mine = rrmse[(rrmse["method"] == method) & rrmse["run"].isin(with_formula)]
            ranked = mine.dropna(subset="rrmse").sort_values("rrmse")
            if len(ranked):
                return Shown(int(ranked["run"].iloc[(len(ranked) - 1) // 2]), method)
            return Shown(with_formula[0], method)
    return Shown(None, METHODS[0])


@plain_dataclass(frozen=True)
class RunToShow:
    """A run: its number, its trajectories, its f, and V about its attractors, as far as they are known."""

    number: int
    recordings: Recordings | None
    record: FieldRecord | None
    wells: tuple[Well, ...] = ()


def choose(shown: int | None, stored: Sequence[Callable[[], Mapping[str, Any] | None]]) -> int | None:
    """The run whose stored landscape is shown: that of the formulas, or else the first that has an attractor.

    Parameters
    ----------
    shown
        The run whose formulas are shown, None where there is none.
    stored
        Reads `quasipotential.json` of each run; None where it is empty.
    """
    order = [*([] if shown is None else [shown]), *range(len(stored))]
    return next((run for run in order if run < len(stored) and _has_wells(stored[run]())), None)


def _has_wells(data: Mapping[str, Any] | None) -> bool:
    return bool(data) and bool((data or {}).get("wells"))


def run_overview(settings: LandscapeSettings, given: RunToShow) -> dict[str, Any] | None:
    """The overview of a run whose landscape nobody asked for; None where it has none."""
    found = landscape_step.run(
        settings, given.recordings, given.record,
        number=given.number, wells=given.wells, seek_wells=False,
    )  # fmt: skip
    if found.landscape is None or found.record is None or not found.landscape.attractors:
        return None
    data = landscape_data(found.landscape)
    # No formula about a single well was sought, so that none is missed.
    missed = "quasipotential.no_refined_formula"
    data["remarks"] = [one for one in data["remarks"] if one["code"] != missed]
    return {"run": given.number} | data
