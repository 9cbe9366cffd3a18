"""What do all candidates promise, each screened with its shapes wherever these are looked for?"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.budget import Budget, BudgetSpent, evaluation
from siq.estimation.fit import Fit
from siq.estimation.jumps import EDGE_SUBSTEPS, spread_edges
from siq.estimation.linearisation import Grid
from siq.estimation.measurements import Measurements
from siq.mismatch.building import MechanismCandidate
from siq.mismatch.probes import Probe, ProbeColumns, probes_of
from siq.mismatch.screening import Screened, in_portions, probe_response, screen
from siq.mismatch.tried import BUDGET_SPENT, UNFORESEEN, UntriedMechanism, in_words

PROBE_SUBSTEPS = 2  # what a little of a mechanism does need not be known to many digits
OVERFLOWS = "its effect along the recorded motion is beyond all numbers"


def screen_all(
    model: Dynamics,
    data: Measurements,
    current: Fit,
    candidates: Sequence[MechanismCandidate],
    *,
    fruitless: Collection[str] = (),
    budget: Budget | None = None,
) -> tuple[list[tuple[Probe, Screened]], list[UntriedMechanism]]:
    """Screen every candidate, with its shapes at all places where they are looked for.

    One whose shape the recordings themselves show promises as much as the best, unless it was fitted before
    and gained nothing: see `Probe.recorded`.

    Parameters
    ----------
    model, data, current
        The simulation, the recordings, and the fit that is to be improved.
    candidates
        What may be missing.
    fruitless
        Labels of those that gained nothing when they were fitted.
    budget
        Charged for the work; what it does not reach is not screened.

    Returns
    -------
    list of (Probe, Screened), list of UntriedMechanism
        What each probe would gain; and candidates of which no probe could be screened, with the reason.
    """
    budget = budget or Budget()
    substeps = current.substeps
    untried: dict[str, UntriedMechanism] = {}
    probes = []
    for candidate in candidates:
        try:
            sharp = max(substeps, EDGE_SUBSTEPS)
            spread = replace(candidate, model=spread_edges(candidate.model, data, current.x, substeps=sharp))
            probes += probes_of(spread, data, model, current.x)
        except UNFORESEEN as error:
            untried[candidate.label] = UntriedMechanism(candidate, in_words(error))
    grid = Grid(data, min(substeps, PROBE_SUBSTEPS))
    screened: list[tuple[Probe, Screened]] = []
    for portion in in_portions([probe.width for probe in probes], model, data):
        some = probes[portion]
        columns = sum(probe.width for probe in some)
        try:
            budget.says(f"screening {len(candidates)} candidates")
            budget.charge(grid.substeps * evaluation(model, data, columns=columns))
            screened += _screened(model, data, current, grid, some)
        except BudgetSpent:
            break
        except UNFORESEEN as error:
            for probe in some:
                reason = in_words(error)
                untried[probe.candidate.label] = UntriedMechanism(probe.candidate, reason)
    most = max((result.gain for _, result in screened), default=0.0)
    screened = [
        (probe, replace(result, gain=max(most, result.gain)))
        if probe.recorded and result.finite and probe.candidate.label not in fruitless
        else (probe, result)
        for probe, result in screened
    ]
    finite = {probe.candidate.label for probe, result in screened if result.finite}
    seen = {probe.candidate.label for probe, _ in screened}
    for candidate in (probe.candidate for probe in probes):  # some have no place where they could be
        if candidate.label not in finite:
            why = OVERFLOWS if candidate.label in seen else BUDGET_SPENT
            untried.setdefault(candidate.label, UntriedMechanism(candidate, why))
    return screened, [each for label, each in untried.items() if label not in finite]


def _screened(
    model: Dynamics, data: Measurements, current: Fit, grid: Grid, probes: Sequence[Probe]
) -> list[tuple[Probe, Screened]]:
    columns = ProbeColumns(model, grid, probes, current.x, current.model.values)
    response = probe_response(model, grid, current, columns)
    ends = np.cumsum([probe.width for probe in probes])
    groups = [slice(end - probe.width, end) for probe, end in zip(probes, ends, strict=True)]
    positive = [
        np.array([name in probe.candidate.positive for name in probe.candidate.amplitudes] or [True])
        for probe in probes
    ]
    return list(zip(probes, screen(response, data, current, groups, positive=positive), strict=True))
