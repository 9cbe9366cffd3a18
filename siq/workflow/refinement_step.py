"""The step that refines V by both routes and certifies it.

How the method works, steps 6 to 8. The formulas of the regression are certified beside the refined ones, and
so is a control: what the same refinement makes of a network with its weights in random order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic.dataclasses import dataclass

from siq.data.recordings import Recordings, SnapshotPairs, snapshot_pairs
from siq.data.selection import held_out_recordings
from siq.errors import NumericalFailure
from siq.inference.field_estimate import IdentifiedField
from siq.inference.identification import FieldRecord
from siq.inference.instrumental_variables import coarse_pairs
from siq.inference.noisy_sensor import filtered_recordings, of_all_states
from siq.networks.decomposition import TrainedNetworks, shuffled
from siq.numerics.randomness import Purpose, generator
from siq.numerics.text import place_text
from siq.quasipotential.certificate import (
    HARMLESS,
    Certificate,
    HeldOut,
    caustic_notes,
    certify_formulas,
    certify_wells,
    uncertified,
)
from siq.quasipotential.certificate_characteristics import Reference, references_about
from siq.quasipotential.certificate_tests import (
    FEWEST,
    MOST_PAIRS,
    CertificateOptions,
    Function,
    Verdict,
    basin_region,
)
from siq.quasipotential.formulas import SymbolicDecomposition, model_to_data, term_coefficients, write_model
from siq.quasipotential.occupancy import RecordTest, record_test
from siq.quasipotential.rates import NoiseStrength
from siq.quasipotential.refinement import (
    Refined,
    RefinementOptions,
    formula_library,
    refine,
    refined_decomposition,
    relative_error_of,
)
from siq.quasipotential.wells import Well
from siq.systems.phase_portrait import PhasePortrait, evenly_spread, phase_portrait
from siq.workflow.identification_step import Identified
from siq.workflow.outcomes import Method, Outcome, Status, Step, write_outcomes
from siq.workflow.settings import STRICT, Sampling
from siq.workflow.tables import as_table, write_table
from siq.workflow.training_step import TrainedRun


class Ground:
    """What a run has to go by: f, states, V of networks where there is one, and the phase portrait.

    Attributes
    ----------
    points, held_out
        States on which formulas are sought, of recordings that take part; and of those that are held out the
        states, and pairs of samples, on which they are tested.
    options
        How V is refined, with the routes that there are.
    limits
        Of the tests of V.
    portrait
        Attractors of f, saddles, and what leads to them.
    """

    def __init__(
        self,
        recordings: Recordings,
        record: FieldRecord,
        networks: TrainedNetworks | None,
        *,
        number: int,
        seed: int,
        sampling: Sampling,
        refinement: RefinementOptions,
        certificate: CertificateOptions,
    ) -> None:
        self.record, self.networks = record, networks
        self.found: IdentifiedField = record.found
        self.number, self.seed, self.limits = number, seed, certificate
        self.options = refinement.with_routes(networks=networks is not None)
        draw = generator(seed, number, Purpose.HOLD_OUT)
        mask = held_out_recordings(recordings, generator=draw)
        if (sensor := record.sensor_variance) is not None:
            # Of measured values the increments do not have the mean of f.
            recordings = filtered_recordings(
                self.found,
                sensor,
                recordings,
                pair_step=sampling.pair_step,
                exposure=record.exposure,
            )
        elif record.hidden_velocities:
            recordings = of_all_states(recordings, record, pair_step=sampling.pair_step)
        pairs = snapshot_pairs(recordings, pair_step=sampling.pair_step)
        held, x = mask[pairs.recording], pairs.x0
        draw = generator(seed, number, Purpose.REFINE)
        self.points = x[~held][evenly_spread(x[~held], generator=draw)]
        unseen = x[held][evenly_spread(x[held], generator=draw)]
        if (memory := record.memory) is not None:
            pairs = coarse_pairs(recordings, memory[0], lost=memory[1])
        self.portrait: PhasePortrait = phase_portrait(self.found.dynamics, self.points, seed=self.number)
        if not self.found.noise_free:
            mask = every_well_held_out(self.portrait, pairs, mask)
        self.held_out = HeldOut(unseen, pairs.take(mask[pairs.recording]))
        self.recordings, self.unseen = recordings, mask

    @cached_property
    def references(self) -> tuple[Reference, ...]:
        """V by characteristics about every attractor: the same for all formulas of the run."""
        return references_about(self.found.dynamics, self.portrait, seed=self.number)

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
            self.held_out,
            options=self.limits,
            prediction=self.prediction(),
            references=self.references,
            seed=self.number,
            **details,
        )

    def certify_wells(self, refined: Refined, *, compared: bool) -> Certificate:
        """Certificate of one formula for each attractor."""
        return certify_wells(
            refined,
            self.portrait,
            self.held_out,
            options=self.limits,
            prediction=self.prediction(),
            references=self.references,
            compared=compared,
            seed=self.number,
        )

    def record_test(self) -> RecordTest:
        """What f says of the record's own hops and histogram, beside what is counted on it."""
        shown = self.record.noise_strength
        noise = None if shown is None else NoiseStrength(*shown, source="estimated")
        variance = self.record.sensor_variance
        try:
            return record_test(
                self.found, self.portrait, noise, self.recordings, self.unseen,
                sensor=None if variance is None else np.sqrt(variance), seed=self.number,
            )  # fmt: skip
        except (NumericalFailure, np.linalg.LinAlgError) as error:
            return RecordTest(missing=str(error))

    def prediction(self) -> Verdict:
        """The verdict on f, from its identification."""
        kept = dict(self.record.prediction)
        kept["value"] = np.inf if kept["value"] is None else kept["value"]
        return Verdict(**kept)


def every_well_held_out(portrait: PhasePortrait, pairs: SnapshotPairs, mask: np.ndarray) -> np.ndarray:
    """Held-out recordings, more of them where those that there are never come into some well.

    Recordings under noise may stay in one well for good, and the test of motion in another would have nothing
    to go by. They are chosen by where they are, not by where they go: the fit of V knows no increments.

    Parameters
    ----------
    portrait
        Attractors with their basins.
    pairs
        Of all recordings.
    mask
        Which recordings are held out, shape ``(r,)``.
    """
    mask = mask.copy()
    some = pairs.take(np.arange(0, len(pairs.h), max(len(pairs.h) // MOST_PAIRS, 1)))
    for index in range(len(portrait.attractors)):
        there = some.recording[basin_region(portrait, index).recorded(some.x0)]
        counts = np.bincount(there, minlength=len(mask))
        while counts[mask].sum() < FEWEST and counts[~mask].any():
            mask[int(np.argmax(np.where(mask, -1, counts)))] = True
    return mask


def refine_and_certify(
    ground: Ground, regressed: SymbolicDecomposition | None
) -> tuple[SymbolicDecomposition, Certificate, tuple[str, ...]]:
    """Refined formulas of a run with their certificate, and what could not be done."""
    library = formula_library(ground.found, ground.options)
    formula = None
    if regressed is not None and regressed.potential is not None:
        named = term_coefficients(regressed.potential)
        formula = np.array([named.get(name, 0.0) for name in library.names])
    network = None if ground.networks is None else ground.network
    refined, formulas, certificate = refined_by_routes(ground, ground.options, network, formula)
    caustics = caustic_notes(refined, ground.portrait, certificate.error, seed=ground.number)
    return formulas, certificate, (*refined.notes, *caustics)


def refined_by_routes(
    ground: Ground, options: RefinementOptions, network: Function | None, formula: np.ndarray | None
) -> tuple[Refined, SymbolicDecomposition, Certificate]:
    """What the routes make of their starts, with its certificate."""
    compared = options.routes is not None and len(options.routes) == 2
    refined = refine(
        ground.found, ground.portrait, library=formula_library(ground.found, options), formula=formula,
        network=network, points=ground.points, options=options, seed=ground.number,
    )  # fmt: skip
    formulas = refined_decomposition(refined, ground.points)
    if formulas.potential is None:
        return refined, formulas, ground.certify_wells(refined, compared=compared)
    error = relative_error_of(refined, ground.points)
    certificate = ground.certify(
        formulas, wells=refined.wells, relative_error=error, compared=compared
    )  # fmt: skip
    if certificate.certified or not refined.wells:
        return refined, formulas, certificate
    # One formula for all wells is an extra. What refuses it is no word against the wells.
    alone = replace(
        refined, potential=None, circulatory=None, potential_covariance=None, circulatory_errors=None,
        joint=False, notes=(*refined.notes, f"no single formula holds over the wells: {certificate.reason}"),
    )  # fmt: skip
    of_wells = ground.certify_wells(alone, compared=compared)
    if not of_wells.certified:
        return refined, formulas, certificate
    return alone, refined_decomposition(alone, ground.points), of_wells


def control(
    ground: Ground,
    networks: TrainedNetworks,
    refined: SymbolicDecomposition | None,
    certificate: Certificate | None,
) -> dict[str, Any]:
    """What becomes of a network with its weights in random order, refined and tested as the real one is.

    Gauss–Newton from a random start ends nowhere, at a false solution that is as exact as the true one, or at
    the true one. The tests have to refuse the first two; `same_as_refined` tells the third.

    Parameters
    ----------
    ground, networks
        What the real refinement had.
    refined, certificate
        What came of it, None where nothing did.

    Returns
    -------
    dict
        A certificate as it stands in `model.json`. `same_as_refined` among its tests has the largest
        relative difference from the refined V in any well; it takes no part in whether it is certified.
    """
    draw = generator(ground.seed, ground.number, Purpose.SHUFFLE)
    randomised = shuffled(networks, generator=draw)
    options = replace(ground.options, routes=("network",))
    limit = ground.limits.hamilton_jacobi
    try:
        _, formulas, made = refined_by_routes(
            ground, options, lambda x: randomised.evaluate(x).potential, None
        )
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        nothing = Verdict(np.inf, limit, False, f"refinement from random weights led to no V: {error}")
        return uncertified(nothing.reason) | {"tests": {"hamilton_jacobi": nothing.as_data()}}
    data = made.as_data()
    if refined is None or certificate is None:
        return data
    difference = _difference(formulas, refined, ground.references)
    explained = HARMLESS + sum(one.error for one in (made, certificate) if np.isfinite(one.error))
    same = bool(difference <= explained)
    if made.certified:
        data["reason"] = (
            "refinement from random weights led to the same V" if same else
            "a V from random weights was certified that is not the refined one: one of the two is false"
        )  # fmt: skip
    verdict = Verdict(difference, explained, same, "" if same else "it is another V than the refined one")
    data["tests"]["same_as_refined"] = verdict.as_data()
    return data


def _difference(
    one: SymbolicDecomposition, two: SymbolicDecomposition, references: Sequence[Reference]
) -> float:
    """Largest relative L2 difference of two V about any attractor; infinite where one has none there."""
    worst = 0.0 if references else np.inf
    for reference in references:
        x, attractor = reference.points, reference.attractor
        first, second = (_about(formulas, attractor) for formulas in (one, two))
        if first is None or second is None or not len(x):
            return np.inf
        mine, theirs = (values(x) - values(attractor[None]) for values in (first, second))
        worst = max(worst, float(np.linalg.norm(mine - theirs) / np.linalg.norm(theirs)))
    return worst


def _about(formulas: SymbolicDecomposition, attractor: np.ndarray) -> Function | None:
    """V about an attractor: of the region, or of that well."""
    if formulas.potential is not None:
        return lambda x: np.asarray(formulas.evaluate(np.ascontiguousarray(x.T))[0])
    return next((one.values for one in formulas.wells if np.array_equal(one.attractor, attractor)), None)


def visit_rows(run: int, found: RecordTest | None, attractors: Sequence[np.ndarray]) -> pd.DataFrame:
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


def density_rows(
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
