"""Where do a simulation and recordings differ, and which physics was left out?"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from siq.dynamics.dynamics import Dynamics
from siq.errors import InputError, NumericalFailure
from siq.estimation.budget import Budget
from siq.mismatch.augmented import completed
from siq.mismatch.case import Comparison, comparison_of
from siq.mismatch.held_out import HeldOutRuns, held_out_runs
from siq.mismatch.investigation import Investigation, investigate
from siq.mismatch.location import Location
from siq.mismatch.possible_verdicts import MismatchVerdict
from siq.mismatch.stated_parts import StatedMechanism
from siq.mismatch.statement import Statement
from siq.mismatch.study import MismatchStudy
from siq.mismatch.tried import UNFORESEEN
from siq.mismatch.verdict import statement_of
from siq.mismatch.withdrawal import misleads, withdrawn

if TYPE_CHECKING:
    import pandas as pd

    from siq.data.recordings import Recordings

LOGGER = logging.getLogger(__name__)


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
        from siq.report.diagnosis_report import diagnosis_text  # which stands above this module

        return diagnosis_text(self.statement, self.case.system)

    def __repr__(self) -> str:
        """One line; `report` says the rest."""
        return f"<Diagnosis: {self.statement.sentence or self.verdict}>"

    def _repr_html_(self) -> str:
        """The report for a notebook."""
        from siq.report.diagnosis_report import diagnosis_html  # which stands above this module

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
    >>> from siq.dynamics.dynamics import Parameter
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
