"""Refine: which V solves the Hamilton–Jacobi equation of the identified f, and may it be believed?

How the method works, steps 6 to 8. The formulas of the regression are certified beside the refined ones, and
so is a control that has to be refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass as plain_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic.dataclasses import dataclass

from siq.certificate.certify import (
    Certificate,
    caustic_notes,
    certify_formulas,
    certify_potential,
    certify_wells,
    uncertified,
)
from siq.certificate.tests import CertificateOptions, Verdict
from siq.data.held_out import held_out_recordings
from siq.data.recordings import Recordings, snapshot_pairs
from siq.dynamics.phase_portrait import PhasePortrait, evenly_spread, phase_portrait
from siq.errors import NumericalFailure
from siq.identify.identification import IdentifiedField
from siq.identify.storage import FieldRecord
from siq.networks.trained import TrainedNetworks, shuffled
from siq.numerics.randomness import Purpose, generator
from siq.potential.global_route import fit_values
from siq.potential.refined_formulas import refined_decomposition, relative_error_of
from siq.potential.refinement import RefinementOptions, formula_library, refine
from siq.potential.storage import model_to_data, write_model
from siq.potential.symbolic import SymbolicDecomposition, term_coefficients
from siq.potential.well import Well
from siq.steps.identify import Identified
from siq.steps.outcomes import Method, Outcome, Status, Step, write_outcomes
from siq.steps.settings import STRICT, Sampling
from siq.steps.trained import TrainedRun


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
    """

    formulas: Mapping[Method, SymbolicDecomposition]
    certificates: Mapping[Method, Mapping[str, Any]]
    outcome: Outcome
    certificate: Certificate | None = None

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
    lost = _lost_networks(settings, given)
    if (missing := _missing(settings, given)) is not None:
        outcome = Outcome(number, Step.REFINE, Status.SKIPPED, missing)
    else:
        try:
            ground = Ground(settings, given)
            if given.regressed is not None:
                certificates[Method.REGRESSION] = ground.certify(given.regressed).as_data()
            if ground.networks is not None:
                certificates[Method.CONTROL] = control(ground, ground.networks).as_data()
            refined, certificate, notes = refine_and_certify(ground, given.regressed)
            formulas[Method.REFINED] = refined
            certificates[Method.REFINED] = certificate.as_data() | {"notes": [*lost, *notes]}
            status = Status.OK if certificate.certified else Status.WARNING
            reason = [] if certificate.certified else [*lost, f"not certified: {certificate.reason}"]
            outcome = Outcome(number, Step.REFINE, status, "; ".join(reason))
        except (NumericalFailure, np.linalg.LinAlgError) as error:
            outcome = Outcome(number, Step.REFINE, Status.FAILED, "; ".join([*lost, str(error)]))
    for method in formulas.keys() - certificates.keys():
        certificates[method] = uncertified(f"no test was made: {outcome.reason}")
    return RefinedRun(formulas, certificates, outcome, certificate)


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


class Ground:
    """What a run has to go by: f, states, V of networks where there is one, and the phase portrait.

    Attributes
    ----------
    points, unseen
        States on which formulas are sought and tested, of recordings that take part and that are held out.
    options
        How V is refined, with the routes that there are.
    portrait
        Attractors of f, saddles, and what leads to them.
    """

    def __init__(self, settings: RefineSettings, given: RunToRefine) -> None:
        recordings, record = given.recordings, given.identified.record
        assert recordings is not None and record is not None  # `run` asked before
        self.settings, self.number = settings, given.identified.outcome.run
        self.record: FieldRecord = record
        self.found: IdentifiedField = record.found
        self.networks = given.trained.networks
        self.options = settings.refinement.with_routes(networks=self.networks is not None)
        draw = generator(settings.seed, self.number, Purpose.HOLD_OUT)
        mask = held_out_recordings(recordings, generator=draw)
        pairs = snapshot_pairs(recordings, pair_step=settings.sampling.pair_step)
        held, x = mask[pairs.recording], pairs.x0
        draw = generator(settings.seed, self.number, Purpose.REFINE)
        self.points = x[~held][evenly_spread(x[~held], generator=draw)]
        self.unseen = x[held][evenly_spread(x[held], generator=draw)]
        self.portrait: PhasePortrait = phase_portrait(self.found.dynamics, self.points, seed=self.number)

    def network(self, x: np.ndarray) -> np.ndarray:
        """V_θ at points."""
        assert self.networks is not None
        return self.networks.evaluate(x).potential

    def certify(self, formulas: SymbolicDecomposition, **details: Any) -> Certificate:
        """Certificate of one formula for the region."""
        return certify_formulas(
            formulas,
            self.found,
            self.portrait,
            self.unseen,
            options=self.settings.certificate,
            prediction=self.prediction(),
            seed=self.number,
            **details,
        )

    def prediction(self) -> Verdict:
        """The verdict on f, from its identification."""
        kept = dict(self.record.prediction)
        kept["value"] = np.inf if kept["value"] is None else kept["value"]
        return Verdict(**kept)


def refine_and_certify(
    ground: Ground, regressed: SymbolicDecomposition | None
) -> tuple[SymbolicDecomposition, Certificate, tuple[str, ...]]:
    """Refined formulas of a run with their certificate, and what could not be done."""
    options = ground.options
    library = formula_library(ground.found, options)
    compared = options.routes is not None and len(options.routes) == 2
    formula = None
    if regressed is not None and regressed.potential is not None:
        named = term_coefficients(regressed.potential)
        formula = np.array([named.get(name, 0.0) for name in library.names])
    refined = refine(
        ground.found, ground.portrait, library=library, formula=formula,
        network=None if ground.networks is None else ground.network,
        points=ground.points, options=options, seed=ground.number,
    )  # fmt: skip
    formulas = refined_decomposition(refined, ground.points)
    if formulas.potential is not None:
        certificate = ground.certify(
            formulas,
            wells=refined.wells,
            relative_error=relative_error_of(refined, ground.points),
            compared=compared,
        )
    else:
        certificate = certify_wells(
            refined, ground.portrait, options=ground.settings.certificate, prediction=ground.prediction(),
            compared=compared, seed=ground.number,
        )  # fmt: skip
    caustics = caustic_notes(refined, ground.portrait, certificate.error, seed=ground.number)
    return formulas, certificate, (*refined.notes, *caustics)


def control(ground: Ground, networks: TrainedNetworks) -> Certificate:
    """Certificate of the U of a randomised network: one that must be refused, or the tests are no tests."""
    draw = generator(ground.settings.seed, ground.number, Purpose.SHUFFLE)
    randomised = shuffled(networks, generator=draw)
    library = ground.found.library
    coefficients = fit_values(library, ground.points, randomised.evaluate(ground.points).potential)
    return certify_potential(
        coefficients, library, ground.found, ground.portrait, ground.unseen,
        options=ground.settings.certificate, prediction=ground.prediction(), seed=ground.number,
    )  # fmt: skip


def write(refined: RefinedRun, *, model: str | Path, outcome: str | Path) -> None:
    """Write `model.json`, and what became of the step."""
    formulas = {str(method): one for method, one in refined.formulas.items()}
    certificates = {str(method): one for method, one in refined.certificates.items()}
    write_model(model, model_to_data(formulas, certificates))
    write_outcomes(outcome, [refined.outcome])
