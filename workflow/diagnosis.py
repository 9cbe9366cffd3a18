"""The tasks of a diagnosis: what a simulation lacks, what follows from it, its figures and its page."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from siq.workflow.answers import Provenance
from workflow.task import Given, task

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from matplotlib.figure import Figure

    from siq.systems.dynamics import Dynamics
    from siq.workflow.study import PipelineSettings

LOGGER = logging.getLogger(__name__)
COMPARED = {"missing physics": ("recalibrated", "augmented"), "parameter shift": ("before", "recalibrated")}
"""Which two simulations have landscapes to be compared, by the verdict."""


@task("card", "recordings", "study")
def diagnosis(given: Given, settings: PipelineSettings) -> Any:
    """Where a simulation and recordings differ, and what was left out; no fit is a verdict, too."""
    from siq.diagnosis.diagnosis import solve_case, tables_of, tables_of_failure
    from siq.diagnosis.study import read_case
    from siq.diagnosis.verdict import statement_of_failure
    from siq.errors import NumericalFailure

    case = read_case(given.files["card"], given.files["recordings"], given.path("study"))
    try:
        found = solve_case(case, tell=given.tell)
        statement, tables = found.statement, tables_of(found)
        after, recalibrated = found.augmented, found.recalibrated
    except NumericalFailure as error:
        LOGGER.exception("no fit has a result")
        statement, tables = statement_of_failure(str(error)), tables_of_failure(case)
        after = recalibrated = case.system
    cards = {"system": after.to_card(), "recalibrated": recalibrated.to_card()}
    return {"verdict": statement.as_data(), **tables, **cards}


@task("verdict", "card", "recalibrated", "system", "forces")
def mismatch_landscape(given: Given, settings: PipelineSettings) -> Any:
    """What left-out physics, or other parameters, do to the wells of a system."""
    import numpy as np
    import pandas as pd

    from siq.errors import NumericalFailure
    from workflow.consequences import ESCAPE_COLUMNS, WELLS_COLUMNS, compare_landscapes, obstacle

    wells, escape = (pd.DataFrame(columns=list(names)) for names in (WELLS_COLUMNS, ESCAPE_COLUMNS))
    verdict = given.verdict["verdict"]
    if verdict not in COMPARED:
        notes = [f"The verdict is “{verdict}”: there are no two landscapes to compare."]
        return {"wells": wells, "escape": escape, "notes": notes}
    files = {"before": "card", "recalibrated": "recalibrated", "augmented": "system"}
    models = {name: getattr(given, files[name]) for name in COMPARED[verdict]}
    if reason := obstacle(list(models.values())):
        return {"wells": wells, "escape": escape, "notes": [reason]}
    states = given.forces[list(next(iter(models.values())).states)].to_numpy(dtype=float)
    try:
        wells, escape, notes = compare_landscapes(models, states[np.isfinite(states).all(axis=1)])
    except NumericalFailure as error:
        notes = [f"There is no landscape to compare: {error}."]
    return {"wells": wells, "escape": escape, "notes": notes}


@task(
    "verdict", "card", "system", "curves", "candidates", "held_out", "forces", "noise", "escape",
)  # fmt: skip
def mismatch_figures(given: Given, settings: PipelineSettings) -> Any:
    """The fit, what is missing and where, the candidates, and escape times."""
    from siq.diagnosis.statement import Statement
    from siq.report.plots import diagnosis as plots

    verdict, before, curves = given.verdict, given.card, given.curves
    place, noise = verdict["location"], given.noise
    named = None if place is None else (", ".join(place["equations"]), place["coordinate"])
    units, time_unit = _units(before), before.time_unit
    sensors = noise[(noise["stage"] == "final") & (noise["kind"] == "measurement")]
    variances = dict(zip(sensors["name"], sensors["variance"], strict=True))
    statement = Statement.from_data(verdict)
    after = statement.final_simulation
    drawn = {
        "before_after": plots.plot_before_after(
            given.held_out, after=after, noise=variances, units=units, time_unit=time_unit
        ),
        "ladder": plots.plot_ladder(statement),
        "held_out": plots.plot_held_out(given.held_out, units=units, time_unit=time_unit),
        "curves": None,
        "described": plots.plot_described(verdict["described"], units=units, time_unit=time_unit),
        "map": _missing_map(before, given.system, given.forces, curves, verdict),
        "candidates": plots.plot_candidates(given.candidates),
        "escapes": plots.plot_escapes(given.escape, time_unit=time_unit),
    }
    if place is not None:
        drawn["curves"] = plots.plot_curves(curves, named=named, units=units, time_unit=time_unit)
    return {"folder": drawn}  # which figures there are depends on what was found


def _units(model: Dynamics) -> dict[str, str]:
    """Units of states, inputs and outputs, as far as they are known."""
    units = dict(zip(model.states, model.units, strict=True))
    units |= {entry.name: entry.unit for entry in model.inputs}
    return units | {name: units[str(formula)] for name, formula in model.outputs if str(formula) in units}


def _missing_map(
    before: Dynamics, after: Dynamics, forces: pd.DataFrame, curves: pd.DataFrame, verdict: dict[str, Any]
) -> Figure | None:
    """The missing part over the plane of the two most relevant states, where there are two."""
    import numpy as np

    from siq.report.plots.diagnosis import plot_missing

    place = verdict["location"]
    if place is None or before.dimension < 2:
        return None
    best = curves[curves["stage"] == "before"].sort_values("gain") if len(curves) else curves
    # Of several curves along one coordinate the last, which is the best, counts.
    gains = dict(zip(best["coordinate"], best["gain"], strict=True)) if len(best) else {}
    ranked = sorted(before.states, key=lambda name: -float(gains.get(name, 0.0)))
    wanted = [name for name in (place["coordinate"], *place["equations"]) if name in before.states]
    first, second, *_ = dict.fromkeys([*wanted, *ranked])
    known = forces.dropna(subset=[first, second])
    missing = {
        name.removeprefix("missing_in_"): known[name].to_numpy(float)
        for name in known.columns
        if name.startswith("missing_in_")
    }
    source = "forces by which the recalibrated simulation follows the recordings"
    if not any(np.nan_to_num(values).any() for values in missing.values()):
        # Where no process noise was admitted, the fit has none to show.
        missing, source = _added_terms(after, before, known), "terms that were found, at the recorded states"
    return plot_missing(
        known[[first, second]].to_numpy(float), missing, names=(first, second), units=_units(before),
        time_unit=before.time_unit, source=source,
    )  # fmt: skip


def _added_terms(after: Dynamics, before: Dynamics, table: pd.DataFrame) -> dict[str, np.ndarray]:
    """Terms of the final simulation beyond the model file's, where they are functions of the states."""
    import numpy as np
    import sympy

    from siq.systems.dynamics import symbol
    from siq.systems.formulas import compile_formulas

    values = {symbol(entry.name): sympy.Float(entry.value, 17) for entry in after.parameters}
    symbols = [symbol(name) for name in before.states]
    found = {}
    for name, new, old in zip(before.states, after.equations, before.equations, strict=False):
        change = sympy.expand(new - old).xreplace(values)
        if change != 0 and change.free_symbols <= set(symbols):
            with np.errstate(all="ignore"):
                result = compile_formulas([change], symbols)(table[list(before.states)].to_numpy(float).T)
            found[name] = result[0]
    return found


@task(
    "verdict", "card", "study", "system", "candidates", "wells", "escape", "notes", "scores", "held_out",
    "figures",
)  # fmt: skip
def mismatch_page(given: Given, settings: PipelineSettings) -> Any:
    """The page of a diagnosis, which needs nothing else."""
    import pandas as pd

    from siq.diagnosis.dictionary import dictionary_of
    from siq.diagnosis.statement import Statement
    from siq.diagnosis.study import MismatchStudy, load_mismatch_study
    from siq.report.diagnosis_page import Findings, mismatch_answer, mismatch_page as rendered

    file, title = given.path("study"), given.options["title"]
    study = load_mismatch_study(file) if file else MismatchStudy()
    drawn = sorted(Path(given.files["figures"]).glob("*.svg"))
    findings = Findings(
        statement=Statement.from_data(given.verdict),
        before=given.card,
        after=given.system,
        dictionary=dictionary_of(without=study.without, further=study.mechanisms, file="the study"),
        candidates=given.candidates,
        figures={path.stem: path.read_bytes() for path in drawn},
        wells=given.wells,
        escape=given.escape,
        notes=given.notes,
        scores=pd.DataFrame() if given.scores is None else given.scores,
        held_out=given.held_out,
        folder=str(Path(given.files["candidates"]).parent),
    )
    found = f"# the simulation with what was found, a system card like any other: {given.files['system']}"
    commands = [given.options["command"], found]
    origin = Provenance(Path(given.outputs["html"]).parent).origin()
    html = rendered(findings, title=title, commands=commands, origin=origin)
    return {"html": html, "answer": mismatch_answer(findings.statement, title=title)}
