"""The diagnosis of a simulation, and the tables that its figures are drawn from.

A mechanism may explain the recordings that it was found in, and nothing else: it stands in for something that
goes on differently elsewhere. Where the simulation with it predicts recordings held out worse than without
it, by more than appears by chance, it keeps no name.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from siq.diagnosis.evidence import NUMERICAL_ERRORS
from siq.diagnosis.investigation import HeldOutRuns, Investigation, held_out_runs, investigate, quiet_verdict
from siq.diagnosis.mechanisms import completed
from siq.diagnosis.residual_structure import remainder_of
from siq.diagnosis.search import Search
from siq.diagnosis.smooth_functions import MECHANISM
from siq.diagnosis.statement import Location, StatedMechanism, Statement
from siq.diagnosis.study import Comparison, MismatchStudy, MismatchVerdict, comparison_of
from siq.diagnosis.unnamed_models import FitContext, fit_unnamed_models
from siq.diagnosis.verdict import statement_of
from siq.errors import InputError, NumericalFailure
from siq.inference.budget import Budget
from siq.inference.maximum_likelihood import Fit
from siq.remarks import Remark
from siq.systems.dynamics import Dynamics

if TYPE_CHECKING:
    from siq.data.recordings import Recordings

LOGGER = logging.getLogger(__name__)


def withdrawn(found: Investigation, case: Comparison, budget: Budget) -> Investigation:
    """An investigation without its names, and with models of what has none.

    Where nothing else speaks of a mismatch there is none: evidence that recordings held out refute is no
    evidence. Process noise that is needed speaks of one, and so does structure that the recalibrated
    simulation leaves, or a function without a name that is certain by the odds that a name takes.

    Parameters
    ----------
    found
        What was found.
    case
        The recordings and the settings.
    budget
        Charged for the models; those that it does not reach are left out.
    """
    names = [each.best.candidate.label for each in found.search.found]
    LOGGER.info("%s: not named, since held-out recordings are predicted worse", names)
    options, recalibrated = case.settings.search, found.search.recalibrated
    context = FitContext(
        case.learn, found.roles, case.settings.degree, options.blocks, len(found.candidates), budget
    )
    models = fit_unnamed_models(found.search, context)
    certain = any(
        each.log_evidence >= options.least_log_odds and all(part.kind != MECHANISM for part in each.parts)
        for each in models
    )
    if not (
        recalibrated.has_process_noise
        or certain
        or remainder_of(found.model, case.learn, recalibrated, recalibrated, found.roles).structured
    ):
        return replace(
            found,
            verdict=quiet_verdict(found.p_shift, options),
            search=replace(found.search, found=(), fit=recalibrated),
            naming=None,
            remarks=(*found.remarks, Remark("diagnosis.refuted", {"names": " and ".join(names)})),
            account=budget.account(),
        )
    return replace(
        found, verdict=MismatchVerdict.UNEXPLAINED, models=models, withdrawn=True, account=budget.account()
    )


@dataclass(frozen=True, repr=False)
class Diagnosis:
    """What a simulation lacks, as far as recordings tell.

    Main attributes
    ---------------
    statement
        The verdict in a sentence, mechanisms with parameters, errors and evidence, place, fit and bounds.
    augmented
        The simulation with what was found, its parameters fitted; with a function where what is missing has
        no name; the recalibrated one where nothing is missing, or nothing that was added helped.
    recalibrated
        The simulation with its own parameters fitted and nothing added.

    Other attributes
    ----------------
    case
        What was compared.
    investigation
        The fits that the statement rests on.
    held_out
        Free runs on recordings that had no part in the fits.
    """

    statement: Statement
    augmented: Dynamics
    recalibrated: Dynamics
    case: Comparison
    investigation: Investigation
    held_out: HeldOutRuns

    @property
    def verdict(self) -> MismatchVerdict:
        """No mismatch, a parameter shift, missing physics, or a mismatch that is unexplained."""
        return self.statement.verdict

    @property
    def mechanisms(self) -> tuple[StatedMechanism, ...]:
        """What is named."""
        return self.statement.mechanisms

    @property
    def location(self) -> Location | None:
        """In which equation the mismatch sits, along which coordinate, in which recordings."""
        return self.statement.location

    def report(self) -> str:
        """All of it as text: verdict, mechanisms with their errors, place, and the fit before and after."""
        from siq.report.diagnosis_page import diagnosis_text  # which stands above this module

        return diagnosis_text(self.statement, self.case.system)

    def __repr__(self) -> str:
        """One line; `report` says the rest."""
        return f"<Diagnosis: {self.statement.sentence or self.verdict}>"

    def _repr_html_(self) -> str:
        """The report for a notebook."""
        from siq.report.diagnosis_page import diagnosis_html  # which stands above this module

        return diagnosis_html(self.statement, self.case.system)

    def to_card(self) -> str:
        """The text of a system card of the augmented simulation."""
        return self.augmented.to_card()


def diagnose(
    system: Dynamics,
    recordings: Recordings | pd.DataFrame | str | Path,
    *,
    settings: MismatchStudy | None = None,
) -> Diagnosis:
    """Say whether, where and in which way a simulation differs from recordings of the system.

    Main arguments
    --------------
    system
        The simulation, such as `siq.load_system` reads from a card. Its parameters are recalibrated, unless
        they are fixed.
    recordings
        What was measured, with a column for each output and each input: recordings, a table with the columns
        ``recording`` and ``t``, or the path of one.

    Other arguments
    ---------------
    settings
        What is held out (by default a quarter), what is known of the sensors' noise, further mechanisms, and
        what counts as found.

    Raises
    ------
    InputError
        For recordings or settings that cannot be used.
    NumericalFailure
        When the simulation cannot be fitted to the recordings at all, since it runs away along them.

    Examples
    --------
    A population that levels off, and a simulation in which it grows without end:

    >>> import numpy as np, pandas as pd, sympy
    >>> import siq
    >>> from siq.systems.dynamics import Parameter
    >>> n, r = sympy.symbols("n r", real=True)
    >>> growth = siq.Dynamics(("n",), (r * n,), siq.Diffusion.identity(1), parameters=(Parameter("r", 1.0),))
    >>> t, noise = np.arange(0, 8, 0.4), np.random.default_rng(1)
    >>> recordings = pd.concat(
    ...     pd.DataFrame({"recording": f"r{k}", "t": t, "n": 2 / (1 + (2 / start - 1) * np.exp(-0.9 * t))})
    ...     for k, start in enumerate([0.05, 0.2, 1.0, 5.0])
    ... )
    >>> recordings["n"] += 0.005 * noise.normal(size=len(recordings))
    >>> diagnosis = siq.diagnose(growth, recordings)
    >>> print(diagnosis.verdict, [each.label for each in diagnosis.mechanisms])
    missing physics ['self-limitation in n']
    >>> diagnosis.augmented.equations
    (-c_1*n**2 + n*r,)
    """
    return solve_case(comparison_of(system, recordings, settings))


def solve_case(
    case: Comparison,
    *,
    tell: Callable[[str], None] = LOGGER.info,
    clock: Callable[[], float] = time.monotonic,
) -> Diagnosis:
    """Diagnose what `siq.read_case` has read; see `diagnose`.

    Parameters
    ----------
    case
        What is compared with what.
    tell
        Called with what is being done, whenever something new begins; by default it is logged.
    clock
        Seconds by which the budget is kept, such as `time.process_time` where others share the core.

    Raises
    ------
    NumericalFailure
        When the simulation cannot be fitted at all.
    """
    allowed = case.settings.budget
    budget = Budget(work=allowed.evaluations, seconds=allowed.seconds, tell=tell, clock=clock)
    try:
        found = investigate(case.system, case.learn, case.dictionary, case.settings, budget=budget)
        certain = case.settings.search.least_log_odds
        shown = held_out_runs(found, case.learn, case.kept, certain=certain, tests=case.settings.tests)
        named = found.verdict.names and not found.process_noise
        # Tests of somebody else may be among the recordings held out, and decide nothing.
        if named and not case.settings.tests and shown.errors.change("without", "augmented") == "worse":
            found = withdrawn(found, case, budget)
            shown = held_out_runs(found, case.learn, case.kept, certain=certain)
        statement = statement_of(found, case.learn, shown)
    except InputError:
        raise
    except NUMERICAL_ERRORS as error:
        raise NumericalFailure(f"the simulation cannot be fitted to the recordings: {error}") from error
    final, model = found.final, found.final.model
    if shown.described_fit is not None and shown.adopted:
        final, model = shown.described_fit, shown.model
    elif found.verdict.names:
        model = shown.model
    process = final.noise.process if found.process_noise else None
    recalibrated = found.search.recalibrated
    return Diagnosis(
        statement=statement,
        augmented=completed(model, final.x, process=process),
        recalibrated=completed(recalibrated.model, recalibrated.x),
        case=case,
        investigation=found,
        held_out=shown,
    )


CURVE_COLUMNS = [
    "equation", "coordinate", "across", "at", "missing", "standard_error", "gain", "p_value", "stage",
]  # fmt: skip
CANDIDATE_COLUMNS = ["mechanism", "label", "shapes", "gain", "process_noise_level", "stage", "beside"]
HELD_OUT_COLUMNS = [
    "recording", "t", "output", "measured", "before", "recalibrated", "augmented", "scored",
]  # fmt: skip
NOISE_COLUMNS = ["stage", "kind", "name", "variance"]


def tables_of(diagnosis: Diagnosis) -> dict[str, pd.DataFrame]:
    """The tables that figures are drawn from.

    Returns
    -------
    dict
        ``curves``: what is missing against each coordinate, in the unit of the equation.
        ``candidates``: every mechanism that was fitted, and every probe that was only screened, with what it
        gains ``beside`` the mechanisms that were in place. Stages: ``found``; fitted in its place: ``same``,
        ``needless`` and ``less`` (see `siq.diagnosis.statement.Rival`); screened: ``further``, on top of
        all that was found, and ``instead``, in the place of the last that was found.
        ``held_out``: recordings and their three simulations.
        ``forces``: what the recalibrated simulation lacks at each sample, as far as random forces were
        admitted.
        ``noise``: of the sensors by output, and of random forces by state.
    """
    case, found, shown = diagnosis.case, diagnosis.investigation, diagnosis.held_out
    curves = [
        {
            "equation": ", ".join(curve.direction.names),
            "coordinate": curve.direction.coordinate,
            "across": curve.direction.across,
            "at": at,
            "missing": value,
            "standard_error": error,
            "gain": curve.gain,
            "p_value": curve.p_value,
            "stage": stage,
        }
        for stage, structure in (("before", found.remainder.before), ("after", found.remainder.after))
        for curve in structure.curves
        for at, value, error in zip(curve.direction.knots, curve.values, curve.standard_errors, strict=True)
    ]
    candidates = _candidate_rows(found.search)
    data = case.kept
    rows = []
    for place, name in enumerate(case.system.output_names):
        rows.append(
            pd.DataFrame(
                {
                    "recording": np.array(data.labels)[data.recording],
                    "t": data.t,
                    "output": name,
                    "measured": data.outputs[:, place],
                    "before": shown.before.outputs[:, place],
                    "recalibrated": shown.recalibrated.outputs[:, place],
                    "augmented": shown.augmented.outputs[:, place],
                    "scored": shown.before.scored,
                }
            )
        )
    return {
        "curves": pd.DataFrame(curves, columns=CURVE_COLUMNS),
        "candidates": pd.DataFrame(candidates, columns=CANDIDATE_COLUMNS),
        "held_out": pd.concat(rows, ignore_index=True),
        "forces": _forces_table(case, found),
        "noise": _noise_table(case.system, found.search.recalibrated, found.final),
    }


def tables_of_failure(case: Comparison) -> dict[str, pd.DataFrame]:
    """The same tables where no fit has a result: empty, but for what the recordings show of their noise."""
    data, system = case.learn, case.system
    noise = pd.DataFrame({"name": system.output_names, "variance": data.with_known_noise(data.roughness)})
    return {
        "curves": pd.DataFrame(columns=CURVE_COLUMNS),
        "candidates": pd.DataFrame(columns=CANDIDATE_COLUMNS),
        "held_out": pd.DataFrame(columns=HELD_OUT_COLUMNS),
        "forces": pd.DataFrame(columns=["recording", "t", *system.states]),
        "noise": noise.assign(stage="recalibrated", kind="measurement")[NOISE_COLUMNS],
    }


def _candidate_rows(search: Search) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    labels = [each.best.candidate.label for each in search.found]
    fitted: set[tuple[str, str]] = set()
    for place, each in enumerate(search.found):
        beside = ", ".join(labels[:place])
        for stage, trials in (
            ("found", (each.best,)), ("same", each.indistinguishable), ("needless", each.needless),
            ("less", each.lesser),
        ):  # fmt: skip
            fitted |= {(trial.candidate.label, beside) for trial in trials}
            rows += [
                {
                    "mechanism": trial.candidate.name, "label": trial.candidate.label, "shapes": "",
                    "gain": trial.delta_chi2, "process_noise_level": 1.0, "stage": stage, "beside": beside,
                }
                for trial in trials
            ]  # fmt: skip
    beside = ", ".join(search.screened_beside)
    stage = "further" if list(search.screened_beside) == labels else "instead"
    return rows + [
        {
            "mechanism": probe.candidate.name,
            "label": probe.candidate.label,
            "shapes": ", ".join(f"{name}={value:.4g}" for name, value in probe.shapes),
            "gain": result.gain,
            "process_noise_level": result.level,
            "stage": stage,
            "beside": beside,
        }
        for probe, result in search.screened
        # Of what was fitted, what the screening had promised is of no interest.
        if (probe.candidate.label, beside) not in fitted
    ]


def _noise_table(model: Dynamics, recalibrated: Fit, final: Fit) -> pd.DataFrame:
    """Both kinds of noise, of the recalibrated simulation and of the one that the verdict stands on."""
    return pd.DataFrame(
        [
            {"stage": stage, "kind": kind, "name": name, "variance": float(value)}
            for stage, fit in (("recalibrated", recalibrated), ("final", final))
            for kind, names, values in (
                ("measurement", model.output_names, fit.noise.measurement),
                ("process", fit.model.states, fit.noise.process),
            )
            for name, value in zip(names, values, strict=False)
        ],
        columns=NOISE_COLUMNS,
    )


def _forces_table(case: Comparison, found: Investigation) -> pd.DataFrame:
    """What must be added to f in each interval for the states to follow the recordings."""
    fit, data = found.search.recalibrated, case.learn
    rows = data.begins
    step = data.t[rows + 1] - data.t[rows]
    frame: dict[str, Any] = {
        "recording": np.array(data.labels)[data.recording[rows]],
        "t": data.t[rows],
    }
    for place, name in enumerate(case.system.states):
        frame[name] = fit.x[rows, place]
    for place, name in enumerate(case.system.states):
        if name in found.roles.states:
            frame[f"missing_in_{name}"] = -fit.linearisation.gap[rows, place] / step
    return pd.DataFrame(frame)
