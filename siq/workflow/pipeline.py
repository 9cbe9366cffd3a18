"""All that a run of recordings gives, in memory: f, networks, V with its certificate, landscape.

The tasks of the workflow, chained without its files.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from siq.data.inspection import seen_states
from siq.data.preparation import in_stretches, joined, without_slow_drift
from siq.data.recordings import Recordings, recordings_of
from siq.quasipotential.landscape import Landscape, NoLandscape
from siq.systems.dynamics import Dynamics
from siq.workflow import results, steps
from siq.workflow.study import PipelineSettings
from siq.workflow.tables import Outcome, why_no_landscape
from siq.workflow.tasks import Given, outputs_of
from siq.workflow.training import TrainedRun, trained_run

__all__ = ["Analysis", "PipelineSettings", "analyse", "landscape_from_recordings"]


@dataclass(frozen=True)
class Analysis:
    """What the steps found; each has its outcome, and says why where it has no result.

    Attributes
    ----------
    identified
        f, and the test of its predictions.
    trained, regressed
        The networks, and the published method's formulas of them; `regressed` is None where not asked for.
    refined
        Formulas by method, with their certificates.
    landscape
        Wells, barriers, ways; None where not asked for.
    """

    identified: results.Identified
    trained: TrainedRun
    regressed: results.Regressed | None
    refined: results.RefinedRun
    landscape: results.FoundLandscape | None

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """What became of each step."""
        steps = (self.identified, self.trained, self.regressed, self.refined, self.landscape)
        return tuple(one.outcome for one in steps if one is not None)

    @property
    def dynamics(self) -> Dynamics | None:
        """What was identified, None where nothing was."""
        record = self.identified.record
        return None if record is None else record.dynamics


def analyse(
    recordings: Recordings, settings: PipelineSettings | None = None, *, number: int = 0, device: str = "auto"
) -> Analysis:
    """All that recordings give.

    Parameters
    ----------
    recordings
        Trajectories.
    settings
        What the steps are told.
    number
        Of the run: another one has other random numbers.
    device
        On which networks are trained: ``auto``, ``cpu``, ``cuda``.

    Returns
    -------
    Analysis
        Also where a step failed, which its outcome then says.
    """
    settings = settings or PipelineSettings()
    networks, hidden = settings.training is not None, settings.identification.hidden_velocities
    settings = replace(settings, refinement=settings.refinement.with_routes(networks=networks))
    made: dict[str, Any] = {
        "recordings": in_stretches(without_slow_drift(recordings), hidden_velocities=hidden)
    }

    def run(one: Callable[[Given, PipelineSettings], Any]) -> Any:
        block = one is steps.train  # whose runs train side by side; here there is one
        values = {name: [value] for name, value in made.items()} if block else dict(made)
        found = one(Given(values=values, number=number, device=device), settings)
        made.update(outputs_of(found))
        return found

    identified = run(steps.identify)
    if networks:
        run(steps.train)
    trained = trained_run(made.get("networks"), made.get("train_outcome"), number=number)
    regressed = run(steps.regress) if networks and settings.published_method else None
    made["refined"] = refined = run(steps.refine)
    landscape = run(steps.landscape) if settings.landscape is not None else None
    return Analysis(identified, trained, regressed, refined, landscape)


def landscape_from_recordings(
    recordings: str | Path | Recordings | pd.DataFrame,
    settings: PipelineSettings | None = None,
    *,
    hidden_velocities: bool = False,
) -> Landscape:
    """The landscape that recordings show; see `siq.Landscape.from_recordings`."""
    settings, trajectories = settings or PipelineSettings(), recordings_of(recordings)
    if hidden_velocities:
        settings = replace(settings, identification=replace(settings.identification, hidden_velocities=True))
    analysis = analyse(trajectories, settings)
    found = None if analysis.landscape is None else analysis.landscape.landscape
    certified = found is not None and found.certificate is not None and found.certificate.certified
    whole = certified and found is not None and len(found.attractors) > 1
    seen = None if whole else seen_states(joined(trajectories))
    if found is None:
        raise NoLandscape(why_no_landscape(analysis.outcomes), seen, analysis.dynamics)
    return replace(found, recorded_states=seen)
