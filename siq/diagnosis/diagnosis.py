"""The diagnosis of a simulation.

A mechanism may explain the recordings that it was found in, and nothing else: it stands in for something that
goes on differently elsewhere. Where the simulation with it foresees recordings held out worse than without
it, by more than appears by chance, it keeps no name.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from siq.diagnosis.held_out_fit import HeldOutRuns, held_out_runs
from siq.diagnosis.hidden_state_terms import models_of_the_nameless
from siq.diagnosis.investigation import Comparison, Investigation, comparison_of, investigate
from siq.diagnosis.location import Location
from siq.diagnosis.mechanisms import completed
from siq.diagnosis.options import MismatchVerdict, quiet_verdict
from siq.diagnosis.residual_structure import what_is_left
from siq.diagnosis.significance import UNFORESEEN
from siq.diagnosis.statement import Statement
from siq.diagnosis.study import MismatchStudy
from siq.diagnosis.unnamed_models import MECHANISM, Material, Model
from siq.diagnosis.verdict import statement_of
from siq.diagnosis.wording import StatedMechanism
from siq.errors import InputError, NumericalFailure
from siq.inference.budget import Budget
from siq.systems.dynamics import Dynamics

REFUTED = (
    "It would be explained a little better with {}. The prediction of recordings held out becomes worse with"
    " that, and nothing else speaks of a mismatch, so that it is taken for chance."
)
LOGGER = logging.getLogger(__name__)


def misleads(found: Investigation, shown: HeldOutRuns) -> bool:
    """Whether the mechanisms that are named make predictions of recordings held out worse.

    Parameters
    ----------
    found
        What was found.
    shown
        Its free runs of the recordings held out; tests of somebody else may not be among them, since they
        decide nothing.
    """
    named = found.verdict is MismatchVerdict.MISSING_PHYSICS and not found.process_noise
    return named and shown.errors.change("without", "augmented") == "worse"


def anything_else(found: Investigation, models: Sequence[Model], case: Comparison) -> bool:
    """Whether anything but mechanisms that recordings held out refute speaks of a mismatch.

    Random forces that are needed do, and so does structure that the recalibrated simulation leaves, or a
    function without a name that is certain by the odds that a name takes.

    Parameters
    ----------
    found
        What was found.
    models
        Of what has no name, the likeliest first.
    case
        The recordings and the settings.
    """
    recalibrated = found.search.recalibrated
    if recalibrated.has_process_noise:
        return True
    functions = [each for each in models if all(part.kind != MECHANISM for part in each.parts)]
    if any(each.log_evidence >= case.settings.search.least_log_odds for each in functions):
        return True
    return what_is_left(found.model, case.learn, recalibrated, recalibrated, found.roles).structured


def withdrawn(found: Investigation, case: Comparison, budget: Budget) -> Investigation:
    """An investigation without its names, and with models of what has none.

    Where nothing else speaks of a mismatch there is none: evidence that recordings held out refute is no
    evidence.

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
    LOGGER.info("%s: not named, since held-out recordings are foreseen worse", names)
    settings = case.settings
    material = Material(
        case.learn, found.roles, settings.degree, settings.search.blocks, len(found.candidates), budget
    )
    models = models_of_the_nameless(found.search, material)
    if not anything_else(found, models, case):
        recalibrated = found.search.recalibrated
        return replace(
            found,
            verdict=quiet_verdict(found.p_shift, settings.search),
            search=replace(found.search, found=(), fit=recalibrated),
            naming=None,
            remarks=(*found.remarks, REFUTED.format(" and ".join(names))),
            account=budget.account(),
        )
    return replace(
        found, verdict=MismatchVerdict.UNEXPLAINED, models=models, withdrawn=True, account=budget.account()
    )


if TYPE_CHECKING:
    import pandas as pd

    from siq.data.recordings import Recordings


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
        if not case.settings.tests and misleads(found, shown):
            found = withdrawn(found, case, budget)
            shown = held_out_runs(found, case.learn, case.kept, certain=certain)
        statement = statement_of(found, case.learn, shown)
    except InputError:
        raise
    except UNFORESEEN as error:
        raise NumericalFailure(f"the simulation cannot be fitted to the recordings: {error}") from error
    final, model = found.final, found.final.model
    if shown.described_fit is not None and shown.adopted:
        final, model = shown.described_fit, shown.model
    elif found.verdict is MismatchVerdict.MISSING_PHYSICS:
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
