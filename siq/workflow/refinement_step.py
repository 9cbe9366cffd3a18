"""The step that refines V by both routes and certifies it.

How the method works, steps 6 to 8. The formulas of the regression are certified beside the refined ones, and
so is a control: what the same refinement makes of a network with its weights in random order. All of it is
done in `siq.quasipotential.refinement`; here stand the settings, the outcome and the files of the step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass as plain_dataclass
from typing import Any

import numpy as np
import pandas as pd
from pydantic.dataclasses import dataclass

from siq.data.recordings import Recordings
from siq.errors import NumericalFailure
from siq.numerics.text import place_text
from siq.quasipotential.certificate import Certificate, certify, uncertified
from siq.quasipotential.certificate_tests import CertificateOptions
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.quasipotential.occupancy import RecordTest
from siq.quasipotential.refinement import (
    Refinement,
    RefinementContext,
    RefinementOptions,
    control,
    refine_and_certify,
)
from siq.quasipotential.wells import Well
from siq.systems.phase_portrait import PhasePortrait
from siq.workflow.identification_step import Identified
from siq.workflow.outcomes import Method, Outcome, Status, Step
from siq.workflow.settings import STRICT, Sampling
from siq.workflow.tables import as_table
from siq.workflow.training_step import TrainedRun


@dataclass(frozen=True, config=STRICT)
class RefineSettings:
    """What refinement and certificate depend on."""

    seed: int
    sampling: Sampling
    refinement: RefinementOptions
    certificate: CertificateOptions


@plain_dataclass(frozen=True)
class RunToRefine:
    """What the steps before have left of a run.

    Attributes
    ----------
    recordings
        Its trajectories.
    identified
        Its f.
    trained
        Its networks.
    regressed
        The formulas of the networks, None where there are none.
    """

    recordings: Recordings | None
    identified: Identified
    trained: TrainedRun
    regressed: SymbolicDecomposition | None = None


@plain_dataclass(frozen=True)
class RefinedRun:
    """Formulas of a run by method, with a certificate for each and for the control, and the outcome.

    Certificates are plain data, as they stand in `model.json`. `refinement` has the refined formulas with
    their certificate as an object, the test against the record and the phase portrait; `portrait` stands
    also where refinement failed.
    """

    formulas: Mapping[Method, SymbolicDecomposition]
    certificates: Mapping[Method, Mapping[str, Any]]
    outcome: Outcome
    refinement: Refinement | None = None
    portrait: PhasePortrait | None = None
    states: tuple[str, ...] = ()

    def files(self) -> dict[str, Any]:
        """By the names of the rule."""
        number = self.outcome.run
        attractors = () if self.portrait is None else [one.position for one in self.portrait.attractors]
        return {
            "model": (self.formulas, self.certificates),
            "refine_outcome": [self.outcome],
            "record": _visit_rows(number, self.record, attractors),
            "record_density": _density_rows(number, self.record, attractors, self.states),
        }

    @property
    def wells(self) -> tuple[Well, ...]:
        """V about the attractors, as refined."""
        return () if self.refinement is None else self.refinement.formulas.wells

    @property
    def certificate(self) -> Certificate | None:
        """That of the refined formulas."""
        return None if self.refinement is None else self.refinement.certificate

    @property
    def record(self) -> RecordTest | None:
        """The test of f against the hops and the histogram of the recordings."""
        return None if self.refinement is None else self.refinement.record


def run(settings: RefineSettings, given: RunToRefine) -> RefinedRun:
    """V about every attractor of the identified f, or over the region, with its certificate."""
    identified, trained = given.identified, given.trained
    number, networks = identified.outcome.run, trained.networks
    formulas = {} if given.regressed is None else {Method.REGRESSION: given.regressed}
    certificates: dict[Method, Mapping[str, Any]] = {}
    context: RefinementContext | None = None
    refinement: Refinement | None = None
    # Networks that were asked for and are not there are the first cause of whatever follows.
    routes = settings.refinement.routes or ()
    asked = trained.outcome.status == Status.FAILED or "network" in routes
    lost = [trained.missing] if networks is None and asked else []
    if identified.record is None or given.recordings is None:
        missing = f"no vector field was identified ({identified.outcome.reason})"
        outcome = Outcome(number, Step.REFINE, Status.SKIPPED, missing)
    elif networks is None and routes == ("network",):
        outcome = Outcome(number, Step.REFINE, Status.SKIPPED, trained.missing)
    else:
        try:
            context = RefinementContext(
                given.recordings, identified.record, networks, number=number, seed=settings.seed,
                pair_step=settings.sampling.pair_step, refinement=settings.refinement,
                limits=settings.certificate,
            )  # fmt: skip
            if given.regressed is not None:
                certificates[Method.REGRESSION] = certify(given.regressed, context.evidence).as_data()
            refinement = refine_and_certify(context, given.regressed)
            certificate = refinement.certificate
            formulas[Method.REFINED] = refinement.formulas
            certificates[Method.REFINED] = certificate.as_data() | {
                "notes": [*lost, *refinement.notes], "no_record_test": refinement.record.missing or ""
            }  # fmt: skip
            status = Status.OK if certificate.certified else Status.WARNING
            reason = [] if certificate.certified else [*lost, f"not certified: {certificate.reason}"]
            outcome = Outcome(number, Step.REFINE, status, "; ".join(reason))
        except (NumericalFailure, np.linalg.LinAlgError) as error:
            outcome = Outcome(number, Step.REFINE, Status.FAILED, "; ".join([*lost, str(error)]))
    if context is not None and networks is not None:
        theirs = (None, None) if refinement is None else (refinement.formulas, refinement.certificate)
        certificates[Method.CONTROL] = control(context, *theirs)
    for method in formulas.keys() - certificates.keys():
        certificates[method] = uncertified(f"no test was made: {outcome.reason}")
    states = () if given.recordings is None else given.recordings.names
    portrait = None if context is None else context.portrait
    return RefinedRun(formulas, certificates, outcome, refinement, portrait, states)


def _visit_rows(run: int, found: RecordTest | None, attractors: Sequence[np.ndarray]) -> pd.DataFrame:
    """One row for each well; none where there is no test."""
    rows = []
    for one in () if found is None else found.visits:
        lowest, highest = one.whole.limits
        rows.append(
            {
                "run": run,
                "attractor": place_text(attractors[one.well]),
                "visits": one.whole.visits,
                "time": one.whole.time,
                "counted": one.whole.mean,
                "lowest": lowest,
                "highest": highest if np.isfinite(highest) else np.nan,
                "held_out_visits": one.held_out.visits,
                "held_out_time": one.held_out.time,
                "held_out_counted": one.held_out.mean,
                "predicted": one.predicted,
                "predicted_error": one.predicted * one.error,
                "method": one.method,
                "probability": one.probability,
            }
        )
    return as_table("record", rows)


def _density_rows(
    run: int, found: RecordTest | None, attractors: Sequence[np.ndarray], states: Sequence[str]
) -> pd.DataFrame:
    """One row for each bin of each histogram."""
    rows = [
        {
            "run": run,
            "attractor": place_text(attractors[one.well]),
            "state": states[one.state],
            "lower": one.edges[place],
            "upper": one.edges[place + 1],
            "counted": one.counted[place],
            "predicted": one.predicted[place],
            "distance": one.distance,
            "independent": one.independent,
            "probability": one.probability,
        }
        for one in (() if found is None else found.densities)
        for place in range(len(one.counted))
    ]
    return as_table("record_density", rows)
