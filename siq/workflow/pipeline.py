"""Pipeline: all that a run of recordings gives, in memory: f, networks, V with its certificate, landscape.

The same functions as in the workflow, without its files.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import pandas as pd
from pydantic.dataclasses import dataclass

from siq.data.inspection import seen_states
from siq.data.recordings import Recordings, recordings_of
from siq.data.selection import in_stretches, joined
from siq.data.two_states import without_slow_drift
from siq.inference.identification import IdentificationOptions
from siq.networks.decomposition import TrainingOptions
from siq.networks.regression import RegressionOptions
from siq.quasipotential.certificate_tests import CertificateOptions, PredictionLimits
from siq.quasipotential.landscape import Landscape, LandscapeOptions, NoLandscape
from siq.quasipotential.refinement import RefinementOptions
from siq.systems.dynamics import Dynamics
from siq.workflow import identification_step, landscape_step, refinement_step, regression_step, training_step
from siq.workflow.outcomes import Outcome, why_no_landscape
from siq.workflow.settings import STRICT, Sampling, StateSpace
from siq.workflow.training_step import TrainedRun, not_trained

Settings = TypeVar("Settings")


@dataclass(frozen=True, config=STRICT)
class PipelineSettings:
    """What the analysis of recordings depends on; the defaults need no networks.

    Attributes
    ----------
    seed
        Of everything random.
    space
        The states, and D.
    sampling
        How samples make pairs.
    identification, regression, refinement, certificate
        The parameters of the steps.
    training
        How two networks are trained; None trains none, and V comes from the local route alone.
    published_method
        Whether the published regression is made of the networks, beside the refined formulas.
    landscape
        How the landscape is found; None finds none.
    """

    seed: int = 0
    space: StateSpace = StateSpace()
    sampling: Sampling = Sampling()
    identification: IdentificationOptions = IdentificationOptions()
    training: TrainingOptions | None = None
    published_method: bool = True
    regression: RegressionOptions = RegressionOptions()
    refinement: RefinementOptions = RefinementOptions()
    certificate: CertificateOptions = CertificateOptions()
    landscape: LandscapeOptions | None = LandscapeOptions()

    def __post_init__(self) -> None:
        if self.training is not None and self.identification.hidden_velocities:
            raise ValueError(
                "networks know recorded states only, and velocities are hidden; leave 'training' out"
            )

    @property
    def prediction(self) -> PredictionLimits:
        """The certificate's limits for f."""
        return self.certificate.of_f

    def of(self, cls: type[Settings]) -> Settings:
        """The settings of one step."""
        named: dict[str, Any] = {
            field.name: getattr(self, field.name)
            for field in dataclasses.fields(cls)  # type: ignore[arg-type]
        }
        return cls(**named)


@plain_dataclass(frozen=True)
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

    identified: identification_step.Identified
    trained: TrainedRun
    regressed: regression_step.Regressed | None
    refined: refinement_step.RefinedRun
    landscape: landscape_step.FoundLandscape | None

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """What became of each step."""
        steps = (self.identified, self.trained, self.regressed, self.refined, self.landscape)
        return tuple(one.outcome for one in steps if one is not None)

    @property
    def dynamics(self) -> Dynamics | None:
        """What was identified, None where nothing was."""
        record = self.identified.record
        return None if record is None else record.found.dynamics


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
    recordings = in_stretches(
        without_slow_drift(recordings), hidden_velocities=settings.identification.hidden_velocities
    )
    identified = identification_step.run(
        settings.of(identification_step.IdentifySettings), recordings, number=number
    )
    trained, regressed = not_trained(number), None
    refinement = settings.refinement.with_routes(networks=settings.training is not None)
    settings = replace(settings, refinement=refinement)
    if settings.training is not None:
        given = {number: training_step.RunToTrain(recordings, identified.record)}
        trained = training_step.run(settings.of(training_step.TrainSettings), given, device=device).of(number)
        if settings.published_method:
            regressed = regression_step.run(settings.of(regression_step.RegressSettings), recordings, trained)
    formulas = None if regressed is None else regressed.formulas
    to_refine = refinement_step.RunToRefine(recordings, identified, trained, formulas)
    refined = refinement_step.run(settings.of(refinement_step.RefineSettings), to_refine)
    found = None
    if settings.landscape is not None:
        found = landscape_step.run(
            settings.of(landscape_step.LandscapeSettings), recordings, identified.record, number=number,
            wells=refined.wells, certificate=refined.certificate,
            visits=() if refined.record is None else refined.record.visits,
        )  # fmt: skip
    return Analysis(identified, trained, regressed, refined, found)


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
