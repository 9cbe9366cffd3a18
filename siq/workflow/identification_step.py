"""The step that identifies f and checks its prediction of held-out recordings."""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass
from functools import partial
from typing import Any

import numpy as np
from pydantic.dataclasses import dataclass

from siq.data.recordings import Recordings
from siq.errors import NumericalFailure
from siq.inference.checks import PredictionLimits
from siq.inference.field_estimate import FieldEstimate
from siq.inference.identify import identify
from siq.inference.library import IdentificationOptions
from siq.numerics.randomness import generator
from siq.report.remarks import sentence
from siq.workflow.study import STRICT, Sampling, StateSpace
from siq.workflow.tables import Outcome, Status, Step


@dataclass(frozen=True, config=STRICT)
class IdentifySettings:
    """What the identification depends on; `prediction` has the certificate's limits for f."""

    seed: int
    space: StateSpace
    sampling: Sampling
    identification: IdentificationOptions
    prediction: PredictionLimits


@plain_dataclass(frozen=True)
class Identified:
    """The identified f of a run with the test of its predictions, None where none was found."""

    record: FieldEstimate | None
    outcome: Outcome

    def files(self) -> dict[str, Any]:
        """By the names of the rule."""
        return {"field": self.record, "identify_outcome": [self.outcome]}


def run(settings: IdentifySettings, recordings: Recordings | None, *, number: int) -> Identified:
    """f of run `number`, from its recordings; None where drawing them failed."""
    if recordings is None:
        reason = "the run has no trajectories"
        return Identified(None, Outcome(number, Step.IDENTIFY, Status.SKIPPED, reason))
    named = zip(recordings.names, recordings.units, strict=True)
    try:
        found = identify(
            recordings, options=settings.identification, limits=settings.prediction,
            draw=partial(generator, settings.seed, number), diffusion=settings.space.noise(recordings.names),
            units=[unit or settings.space.unit(name) or None for name, unit in named],
            pair_step=settings.sampling.pair_step, integrator_step=settings.sampling.integrator_step,
        )  # fmt: skip
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        return Identified(None, Outcome(number, Step.IDENTIFY, Status.FAILED, str(error)))
    assert found.diagnosis is not None and found.prediction is not None
    remarks = [sentence(remark) for remark in found.diagnosis.remarks]
    if found.prediction.passed:
        status, first = Status.OK, found.diffusion_source.note
    else:
        status, first = Status.WARNING, found.prediction.reason
    reasons = "; ".join(one for one in (first, *remarks) if one)
    return Identified(found, Outcome(number, Step.IDENTIFY, status, reasons))
