"""The diagnosis of a simulation, and the tables that its figures are drawn from.

A mechanism may explain the recordings that it was found in, and nothing else: it stands in for something that
goes on differently elsewhere. Where the simulation with it predicts recordings held out worse than without
it, by more than appears by chance, or is off by most of what it was off by, it keeps no name.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import sympy

from siq.diagnosis.evidence import NUMERICAL_ERRORS
from siq.diagnosis.investigation import HeldOutRuns, held_out_runs, investigate
from siq.diagnosis.mechanisms import MECHANISM
from siq.diagnosis.naming import Investigation
from siq.diagnosis.residual_structure import Remainder
from siq.diagnosis.search import Search
from siq.diagnosis.statement import Location, StatedTerm, Statement
from siq.diagnosis.study import Comparison, MismatchStudy, MismatchVerdict, comparison_of
from siq.diagnosis.unnamed_models import AugmentedModel, fit_unnamed_models
from siq.diagnosis.verdict import statement_of
from siq.errors import InputError, NumericalFailure
from siq.inference.budget import Budget, BudgetSpent
from siq.inference.kalman_filter import MAX_SUBSTEPS
from siq.inference.measurements import first_states, with_expectations
from siq.inference.recalibration import fit_with_process_noise_as_needed, most_varying, recalibrate
from siq.inference.trajectories import scored_rows
from siq.remarks import Remark
from siq.systems.cards import load_system
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, symbol
from siq.systems.simulation import Step, with_simulator

if TYPE_CHECKING:
    from siq.data.recordings import Recordings

LOGGER = logging.getLogger(__name__)


def _withdrawn(found: Investigation) -> Investigation:
    """An investigation without its names, and with models of what has none.

    Where nothing else speaks of a mismatch there is none: evidence that recordings held out refute is no
    evidence. Process noise that is needed speaks of one, structure that the recalibrated simulation leaves,
    or a function without a name that is certain by the odds that a name takes.
    """
    names = [each.best.candidate.label for each in found.search.found]
    LOGGER.info("%s: not named, since held-out recordings are predicted worse", names)
    context, recalibrated = found.context, found.search.recalibrated
    options, budget = context.study.search, context.budget
    models = fit_unnamed_models(found.search, context)
    certain = any(
        each.log_evidence >= options.least_log_odds
        and all(part.candidate.kind != MECHANISM for part in each.parts)
        for each in models
    )
    if not (
        recalibrated.has_process_noise
        or certain
        or Remainder.of(context.data, recalibrated, recalibrated, context.roles).structured
    ):
        return replace(
            found, verdict=found.quiet_verdict, search=replace(found.search, found=(), fit=recalibrated),
            log_odds=(),
            remarks=(*found.remarks, Remark("diagnosis.refuted", {"names": " and ".join(names)})),
            account=budget.account(),
        )  # fmt: skip
    return replace(
        found, verdict=MismatchVerdict.UNEXPLAINED, models=models, withdrawn=True, account=budget.account()
    )


def _is_what_was_found(described: AugmentedModel | None, search: Search) -> bool:
    """Whether a function without a name, that foresees best, is the same everywhere, as what was found is."""
    if described is None or len(search.found) != 1 or len(described.parts) != 1:
        return False
    part, mechanism = described.parts[0].candidate, search.found[0].best.candidate
    constant = not any(unit.free_symbols for _, unit in part.terms)
    return constant and mechanism.terms == part.terms and not (mechanism.shapes or part.shapes)


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
    def mechanisms(self) -> tuple[StatedTerm, ...]:
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
    system: Dynamics | Mapping[str, Any] | str | Path, recordings: Recordings | pd.DataFrame | str | Path,
    *, simulate: Step | None = None, step: float | None = None, settings: MismatchStudy | None = None,
) -> Diagnosis:  # fmt: skip
    """Say whether, where and in which way a simulation differs from recordings of the system.

    Main arguments
    --------------
    system
        The simulation, such as `siq.load_system` reads from a card, or the card. Its parameters are
        recalibrated, unless they are fixed.
    recordings
        What was measured, with a column for each output and each input: recordings, a table with the columns
        ``recording`` and ``t``, or the path of one.

    Other arguments
    ---------------
    simulate
        A simulator in the place of the card's equations, but for definitions such as ``x: v``; the card may
        then leave them out. It is called as ``simulate(states, inputs, parameters, dt)``, arrays in the order
        of the card, and returns the states a time dt later. See `siq.systems.simulation.with_simulator` for
        what it is taken for, and what nobody can locate without equations.
    step
        dt, in the card's unit of time, by default a sixteenth of the shortest time between samples. A
        simulator with a step of its own needs a multiple of it.
    settings
        What is held out (by default a quarter), what is known of the sensors' noise, further mechanisms, and
        what counts as found.

    Raises
    ------
    InputError
        For recordings or settings that cannot be used, and for a simulator that has no answer, or two, where
        recordings were.
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
    if not isinstance(system, Dynamics):
        system = load_system(system, simulated=simulate is not None)
    case = comparison_of(system, recordings, settings)
    if simulate is not None:
        data = case.learn
        inputs = data.signals(data.t, data.recording, delays=()).inputs
        x = first_states(system, data).T
        step = float(data.step[data.begins].min()) / MAX_SUBSTEPS if step is None else step
        case = replace(case, system=with_simulator(system, simulate, step=step, x=x, inputs=inputs))
    return solve_case(case)


def _completed(model: Dynamics, x: np.ndarray, *, process: np.ndarray | None = None) -> Dynamics:
    """A fitted simulation as a dynamics of its own.

    A state without a domain gets the range of the states ``(n, d)`` along the recordings; process noise with
    intensities ``(d,)`` becomes its D, with zeros for states that nothing drives. Parameters that differ
    from recording to recording have their means.
    """
    limits = np.stack([x.min(axis=0), x.max(axis=0)], axis=1)
    limits[limits[:, 0] == limits[:, 1]] = np.nan  # of a state that rests nothing is known
    domain = np.where(np.isfinite(model.limits), model.limits, limits)
    noise = model.diffusion
    if process is not None and (process > 0).any():
        noise = Diffusion(np.diag(process))
    mean = {symbol(each.name): sympy.S.Zero for each in model.inputs if each.name.startswith("_")}
    return replace(
        model, domain=domain, diffusion=noise,
        equations=tuple(each.xreplace(mean) for each in model.equations),
        outputs=tuple((name, formula.xreplace(mean)) for name, formula in model.outputs),
        inputs=tuple(each for each in model.inputs if not each.name.startswith("_")),
        parameters=tuple(each for each in model.parameters if not each.name.startswith("_")),
        expected_together=() if mean else model.expected_together,
        covariance=None if mean else model.covariance,
    )  # fmt: skip


def _judged(case: Comparison, budget: Budget) -> tuple[Investigation, HeldOutRuns, Statement]:
    """What the recordings to learn from say, what those held out leave of it, and both in words."""
    found = investigate(case, budget=budget)
    shown = held_out_runs(found, case.kept)
    named = found.verdict.names and not found.process_noise
    # Tests of somebody else may be among the recordings held out, and decide nothing.
    incomplete = found.remainder.doubtful or found.search.fit.has_process_noise
    refuted = shown.errors.no_better or (incomplete and not shown.errors.takes_most)
    if named and refuted and not case.settings.tests:
        found = _withdrawn(found)
        shown = held_out_runs(found, case.kept)
    elif found.too_faint and _is_what_was_found(shown.described, found.search):
        others = (one for one in found.remarks if one.code != "diagnosis.not_certain")
        verdict, remarks = MismatchVerdict.MISSING_PHYSICS, (*others, Remark("diagnosis.same_formula"))
        found = replace(found, verdict=verdict, models=(), too_faint=False, remarks=remarks)
        shown = held_out_runs(found, case.kept)
    statement = statement_of(found, shown)
    return found, shown, replace(statement, remarks=(*case.remarks, *statement.remarks))


@np.errstate(over="ignore", divide="ignore", invalid="ignore")  # what overflows shows in its values
def solve_case(
    case: Comparison, *, tell: Callable[[str], None] = LOGGER.info,
    clock: Callable[[], float] = time.monotonic,
) -> Diagnosis:  # fmt: skip
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
        # What a computer writes is held until the next sample: on a line between samples that is late.
        same, other, on_lines = case.settings.search.same, case.with_held_inputs(), True
        if other is not None:
            with contextlib.suppress(*NUMERICAL_ERRORS, BudgetSpent):
                both = ((with_expectations(each.system), each.learn) for each in (case, other))
                lines, steps = (recalibrate(*each, budget=budget)[0] for each in both)
                on_lines = steps.log_likelihood <= lines.log_likelihood + same / 2
                case, other = (case, other) if on_lines else (other, case)
        found, shown, statement = _judged(case, budget)
        if other is not None and statement.verdict.mismatch:
            # What is missing may be what made them look held, or hide that they are: what is held comes late
            # on a line between samples, by less than a sample.
            with contextlib.suppress(*NUMERICAL_ERRORS, BudgetSpent):
                final, step = found.final, float(np.median(case.learn.step))
                late = on_lines and any(lag < step for _, lag in final.model.lags(final.model.values))
                moved = fit_with_process_noise_as_needed(final.model, other.learn, final, budget=budget)
                if late or moved.log_likelihood > final.log_likelihood + on_lines * same / 2:
                    again = fits, _, stated = _judged(other, budget)
                    # A name fewer is worth what candidates that are not told apart may differ by.
                    counts = len(stated.mechanisms), len(statement.mechanisms)
                    least = same * float(np.sign(counts[0] - counts[1])) if all(counts) else 0.0
                    if 2 * (fits.final.log_likelihood - final.log_likelihood) >= least:
                        case, (found, shown, statement) = other, again
        if statement.verdict.mismatch and not (statement.mechanisms or case.settings.varies):
            # Recordings may differ in a parameter. Where a function describes what is missing, that has to be
            # as likely; elsewhere a name may come to light behind it.
            fit, least = found.search.recalibrated, 0.0
            if statement.verdict.names and shown.described is not None:
                gained = 2 * (shown.described.fit.log_likelihood - fit.log_likelihood)
                least = gained - case.settings.search.same
            with contextlib.suppress(*NUMERICAL_ERRORS, BudgetSpent):  # the first answer stands
                name = most_varying(case.system, case.learn, fit, budget=budget, least=least)
                if name is not None:
                    varied = case.with_variation((name,))
                    again = _judged(varied, budget)
                    if again[0].verdict.names or not again[0].verdict.mismatch:
                        case, (found, shown, statement) = varied, again
    except InputError:
        raise
    except NUMERICAL_ERRORS as error:
        raise NumericalFailure(f"the simulation cannot be fitted to the recordings: {error}") from error
    recalibrated, final, model = shown.recalibration, found.final, shown.fit.model
    if shown.described is not None:
        final = shown.fit
    elif not found.verdict.names:
        final, model = recalibrated, recalibrated.model
    return Diagnosis(
        statement=statement,
        augmented=_completed(model, final.x, process=final.noise.process if found.process_noise else None),
        recalibrated=_completed(recalibrated.model, recalibrated.x), case=case, investigation=found,
        held_out=shown,
    )  # fmt: skip


CURVE_COLUMNS = [
    "equation", "coordinate", "across", "at", "missing", "standard_error", "gain", "p_value", "stage",
]  # fmt: skip
CANDIDATE_COLUMNS = ["mechanism", "label", "shapes", "gain", "process_noise_level", "stage", "beside"]
HELD_OUT_COLUMNS = [
    "recording", "t", "output", "measured", "before", "recalibrated", "augmented", "scored",
]  # fmt: skip
NOISE_COLUMNS = ["stage", "kind", "name", "variance"]


def tables_of(diagnosis: Diagnosis) -> dict[str, pd.DataFrame]:
    """The tables that figures are drawn from, by name.

    ``curves``: what is missing against each coordinate, in the unit of the equation. ``candidates``: every
    mechanism that was fitted, and every probe that was only screened, with what it gains ``beside`` those in
    place. Stages: ``found``; fitted in its place: ``same``, ``needless`` and ``less`` (see
    `siq.diagnosis.statement.Alternative`); screened: ``further``, on top of all that was found, and
    ``instead``, in the place of the last. ``held_out``: recordings and their three simulations. ``forces``:
    what the recalibrated simulation lacks at each sample, as far as process noise was admitted. ``noise``: of
    the sensors by output, and of process noise by state.
    """
    case, found, shown = diagnosis.case, diagnosis.investigation, diagnosis.held_out
    recalibrated, data = found.search.recalibrated, case.kept
    curves = [
        (", ".join(each.term.targets), each.term.words[0], each.term.across, *point,
         each.gain, each.p_value, stage)
        for stage, structure in (("before", found.remainder.before), ("after", found.remainder.after))
        for each in structure.curves
        for point in zip(each.term.knots, each.amplitudes, each.standard_errors, strict=True)
    ]  # fmt: skip
    held_out = [
        pd.DataFrame(
            {
                "recording": np.array(data.labels)[data.recording], "t": data.t, "output": name,
                "measured": data.outputs[:, place], "before": shown.before[:, place],
                "recalibrated": shown.recalibrated[:, place],
                "augmented": shown.augmented[:, place], "scored": scored_rows(data),
            }
        )
        for place, name in enumerate(case.system.output_names)
    ]  # fmt: skip
    noise = [
        (stage, kind, name, float(value))
        for stage, fit in (("recalibrated", recalibrated), ("final", found.final))
        for kind, names, values in (
            ("measurement", case.system.output_names, fit.noise.measurement),
            ("process", fit.model.states, fit.noise.process),
        )
        for name, value in zip(names, values, strict=False)
    ]
    # What must be added to f in each interval for the states to follow the recordings.
    learn, rows = case.learn, case.learn.begins
    step = learn.t[rows + 1] - learn.t[rows]
    labels = np.array(learn.labels)[learn.recording[rows]]
    forces: dict[str, np.ndarray] = {"recording": labels, "t": learn.t[rows]}
    forces |= {name: recalibrated.x[rows, place] for place, name in enumerate(case.system.states)}
    forces |= {
        f"missing_in_{name}": -recalibrated.linearisation.gap[rows, place] / step
        for place, name in enumerate(case.system.states)
        if name in found.context.roles.states
    }
    return {
        "curves": pd.DataFrame(curves, columns=CURVE_COLUMNS),
        "candidates": pd.DataFrame(_candidate_rows(found.search), columns=CANDIDATE_COLUMNS),
        "held_out": pd.concat(held_out, ignore_index=True),
        "forces": pd.DataFrame(forces),
        "noise": pd.DataFrame(noise, columns=NOISE_COLUMNS),
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


def _candidate_rows(search: Search) -> list[tuple[str | float, ...]]:
    """Every candidate that was fitted, and every probe that was only screened."""
    rows: list[tuple[str | float, ...]] = []
    labels = [each.best.candidate.label for each in search.found]
    fitted: set[tuple[str, str]] = set()
    for place, each in enumerate(search.found):
        beside = ", ".join(labels[:place])
        for stage, trials in (("found", (each.best,)), *each.others.items()):
            for trial in trials:
                name, label = trial.candidate.name, trial.candidate.label
                fitted.add((label, beside))
                rows.append((name, label, "", trial.delta_chi2, 1.0, stage, beside))
    beside = ", ".join(search.screened_with)
    stage = "further" if list(search.screened_with) == labels else "instead"
    for one in search.screened:
        name, label = one.term.candidate.name, one.term.candidate.label
        if (label, beside) not in fitted:  # of what was fitted, what had been promised is of no interest
            shapes = ", ".join(f"{shape}={value:.4g}" for shape, value in one.term.shapes)
            rows.append((name, label, shapes, one.gain, one.level, stage, beside))
    return rows
