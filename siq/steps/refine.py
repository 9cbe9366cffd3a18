"""Refine: which V solves the Hamilton–Jacobi equation of the identified f, and may it be believed?

How the method works, steps 6 to 8. The formulas of the regression are certified beside the refined ones, and
so is a control: what the same refinement makes of a network with its weights in random order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic.dataclasses import dataclass

from siq.certificate.certificates import Certificate, uncertified
from siq.certificate.tests import CertificateOptions
from siq.data.recordings import Recordings
from siq.errors import NumericalFailure
from siq.landscape.record_test import RecordTest
from siq.potential.refinement import RefinementOptions
from siq.potential.storage import model_to_data, write_model
from siq.potential.symbolic import SymbolicDecomposition
from siq.potential.well import Well
from siq.steps.control import control
from siq.steps.ground import Ground
from siq.steps.identify import Identified
from siq.steps.outcomes import Method, Outcome, Status, Step, write_outcomes
from siq.steps.record_tables import density_rows, visit_rows
from siq.steps.refined_routes import refine_and_certify
from siq.steps.settings import STRICT, Sampling
from siq.steps.trained import TrainedRun
from siq.study.tables import write_table


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

    Certificates are plain data, as they stand in `model.json`; `certificate` is that of the refined formulas.
    `record` is the test of f against the hops and the histogram of the recordings, about the `attractors`.
    """

    formulas: Mapping[Method, SymbolicDecomposition]
    certificates: Mapping[Method, Mapping[str, Any]]
    outcome: Outcome
    certificate: Certificate | None = None
    record: RecordTest | None = None
    attractors: tuple[np.ndarray, ...] = ()
    states: tuple[str, ...] = ()

    @property
    def wells(self) -> tuple[Well, ...]:
        """V about the attractors, as refined."""
        return self.formulas[Method.REFINED].wells if Method.REFINED in self.formulas else ()


def run(settings: RefineSettings, given: RunToRefine) -> RefinedRun:
    """V about every attractor of the identified f, or over the region, with its certificate."""
    number = given.identified.outcome.run
    formulas = {} if given.regressed is None else {Method.REGRESSION: given.regressed}
    certificates: dict[Method, Mapping[str, Any]] = {}
    certificate: Certificate | None = None
    ground: Ground | None = None
    record: RecordTest | None = None
    lost = _lost_networks(settings, given)
    if (missing := _missing(settings, given)) is not None:
        outcome = Outcome(number, Step.REFINE, Status.SKIPPED, missing)
    else:
        try:
            ground = _ground(settings, given)
            if given.regressed is not None:
                certificates[Method.REGRESSION] = ground.certify(given.regressed).as_data()
            refined, certificate, notes = refine_and_certify(ground, given.regressed)
            record = ground.record_test()
            certificate = with_record(certificate, record, settings.certificate)
            formulas[Method.REFINED] = refined
            said = {"notes": [*lost, *notes], "no_record_test": record.missing or ""}
            certificates[Method.REFINED] = certificate.as_data() | said
            status = Status.OK if certificate.certified else Status.WARNING
            reason = [] if certificate.certified else [*lost, f"not certified: {certificate.reason}"]
            outcome = Outcome(number, Step.REFINE, status, "; ".join(reason))
        except (NumericalFailure, np.linalg.LinAlgError) as error:
            outcome = Outcome(number, Step.REFINE, Status.FAILED, "; ".join([*lost, str(error)]))
    if ground is not None and ground.networks is not None:
        theirs = (formulas.get(Method.REFINED), certificate)
        certificates[Method.CONTROL] = control(ground, ground.networks, *theirs)
    for method in formulas.keys() - certificates.keys():
        certificates[method] = uncertified(f"no test was made: {outcome.reason}")
    places = () if ground is None else tuple(one.position for one in ground.portrait.attractors)
    states = () if given.recordings is None else given.recordings.names
    return RefinedRun(formulas, certificates, outcome, certificate, record, places, states)


def _ground(settings: RefineSettings, given: RunToRefine) -> Ground:
    """What the run has to go by; `_missing` has been asked."""
    recordings, identified = given.recordings, given.identified
    assert recordings is not None and identified.record is not None
    return Ground(
        recordings, identified.record, given.trained.networks, number=identified.outcome.run,
        seed=settings.seed, sampling=settings.sampling, refinement=settings.refinement,
        certificate=settings.certificate,
    )  # fmt: skip


def with_record(certificate: Certificate, record: RecordTest, options: CertificateOptions) -> Certificate:
    """The certificate with the test `record` among its tests, where there is one."""
    verdict = record.verdict(false_alarms=options.false_alarms)
    if verdict is None:
        return certificate
    reason = certificate.reason
    if not verdict.passed:
        reason = "; ".join(one for one in (reason, verdict.reason) if one)
    return replace(certificate, tests={**certificate.tests, "record": verdict}, reason=reason)


def _missing(settings: RefineSettings, given: RunToRefine) -> str | None:
    """What refinement would need and does not have, in words."""
    if given.identified.record is None or given.recordings is None:
        return f"no vector field was identified ({given.identified.outcome.reason})"
    if given.trained.networks is None and settings.refinement.routes == ("network",):
        return given.trained.missing
    return None


def _lost_networks(settings: RefineSettings, given: RunToRefine) -> list[str]:
    """Why there are no networks although they were asked for: the first cause of whatever follows."""
    asked = given.trained.outcome.status == Status.FAILED or "network" in (settings.refinement.routes or ())
    return [given.trained.missing] if given.trained.networks is None and asked else []


def write(
    refined: RefinedRun,
    *,
    model: str | Path,
    outcome: str | Path,
    record: str | Path,
    record_density: str | Path,
) -> None:
    """Write `model.json`, what became of the step, and the tables of the test against the record."""
    number = refined.outcome.run
    write_table(record, visit_rows(number, refined.record, refined.attractors))
    write_table(record_density, density_rows(number, refined.record, refined.attractors, refined.states))
    formulas = {str(method): one for method, one in refined.formulas.items()}
    certificates = {str(method): one for method, one in refined.certificates.items()}
    write_model(model, model_to_data(formulas, certificates))
    write_outcomes(outcome, [refined.outcome])
