"""All that a run of recordings gives, step by step: f, networks, V with its certificate, landscape.

Each step gives what it found, None where it failed, and an outcome that says why. The formulas of the
regression are certified beside the refined ones. As a control, the networks with their weights in random
order are compared with the refined V. `analyse` chains the steps in memory; the tasks of the workflow
call the same functions, and add files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from siq.data.preparation import (
    in_stretches,
    joined,
    read_pairs,
    unusual,
    without_background,
    without_faults,
    without_velocity,
)
from siq.data.recordings import Recordings, snapshot_pairs
from siq.data.states import RecordStates
from siq.errors import NumericalFailure
from siq.inference.field_estimate import FieldEstimate
from siq.inference.identify import identify
from siq.inference.kalman_identification import filtered_recordings, of_all_states
from siq.inference.library import candidate_library
from siq.networks.decomposition import AnyNetworks, NetworksByWell
from siq.networks.regression import points_below, sparse_decomposition
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.certificate import Certificate, certify, uncertified
from siq.quasipotential.formulas import SymbolicDecomposition, decomposition_from_coefficients
from siq.quasipotential.hamilton_jacobi import affordable_degree
from siq.quasipotential.landscape import Landscape, NoLandscape
from siq.quasipotential.landscape_assembly import find_landscape
from siq.quasipotential.occupancy import OccupancyCheck, VisitTest
from siq.quasipotential.output_weights import formulas_by_well
from siq.quasipotential.rates import NoiseStrength
from siq.quasipotential.refinement import Refinement, RefinementContext
from siq.quasipotential.transitions import ways_out, with_work_of_samples
from siq.quasipotential.wells import Well
from siq.remarks import Remark, sentence
from siq.systems.cards import load_system
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.phase_portrait import PhasePortrait, evenly_spread, phase_portrait
from siq.systems.simulation import simulate_snapshots
from siq.workflow.study import PipelineSettings
from siq.workflow.tables import Method, Outcome, Status, Step, StepResult, not_trained, why_no_landscape

__all__ = ["Analysis", "PipelineSettings", "analyse", "landscape_from_recordings"]


def draw_run(
    settings: PipelineSettings, source: Dynamics | Recordings, *, number: int
) -> StepResult[Recordings]:
    """The trajectories of run `number`: of a system simulated, of recordings all in run 0, then resampled."""
    if isinstance(source, Recordings):
        source = _prepared(settings, source)
        if number > 0:
            draw = generator(settings.seed, number, Purpose.RESAMPLE)
            source = source.resampled(generator=draw)
        return StepResult(source, Outcome(number, Step.RESAMPLE, reason="; ".join(source.notes)))
    assert settings.simulation is not None  # a system is simulated
    try:
        draw = generator(settings.seed, number, Purpose.SIMULATE)
        recordings = simulate_snapshots(source, options=settings.simulation, generator=draw)
        return StepResult(recordings, Outcome(number, Step.SIMULATE))
    except NumericalFailure as error:
        return StepResult(None, Outcome(number, Step.SIMULATE, Status.FAILED, str(error)))


def _prepared(settings: PipelineSettings, recordings: Recordings) -> Recordings:
    """Recordings whose angles count turns, less what drifts slowly or the sensor adds, in stretches."""
    options = settings.identification
    recordings = recordings.unwrapped(options.angles)
    if settings.sampling.background and not options.angles:  # an angle that turns on drifts by itself
        recordings = without_background(without_faults(recordings))
    if settings.space.names is None and not options.functions:  # which know states by their names
        if options.hidden_velocities == "auto" and settings.space.diffusion is None:
            recordings = without_velocity(recordings)
        recordings = recordings.centred(degree=options.degree)
    return in_stretches(recordings, hidden_velocities=options.hidden_velocities)


def source_of(path: str | Path, settings: PipelineSettings) -> Dynamics | Recordings:
    """The card that is simulated, or the recordings in its place.

    Raises
    ------
    InputError
        When the file is refused.
    """
    if settings.simulation is not None:
        return load_system(path)
    recordings, _ = read_pairs(
        path, states=settings.space.names, units=settings.space.units, pair_step=settings.sampling.pair_step
    )
    space = settings.space
    units = tuple(
        unit or space.unit(name, unknown="") or None
        for name, unit in zip(recordings.names, recordings.units, strict=True)
    )
    return replace(
        recordings, units=units, time_unit=recordings.time_unit or space.unit("t", unknown="") or None
    )


def identify_run(
    settings: PipelineSettings, recordings: Recordings | None, *, number: int
) -> StepResult[FieldEstimate]:
    """f of run `number`, from its recordings; None where drawing them failed."""
    if recordings is None:
        return StepResult(None, Outcome(number, Step.IDENTIFY, Status.SKIPPED, "the run has no trajectories"))
    named, options = zip(recordings.names, recordings.units, strict=True), settings.identification
    for one in unusual(recordings):
        if one.code == "data.wrapped_angle":
            return StepResult(None, Outcome(number, Step.IDENTIFY, Status.FAILED, sentence(one)))
    try:
        found = identify(
            recordings, options=options, limits=settings.certificate,
            draw=partial(generator, settings.seed, number), diffusion=settings.space.noise(recordings.names),
            units=[unit or settings.space.unit(name) or None for name, unit in named],
            pair_step=settings.sampling.pair_step, integrator_step=settings.sampling.integrator_step,
        )  # fmt: skip
        found = _with_work(settings, found, recordings, number=number)
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        details = {"claim": error.claim} if isinstance(error, NumericalFailure) and error.claim else {}
        return StepResult(None, Outcome(number, Step.IDENTIFY, Status.FAILED, str(error), details))
    assert found.diagnosis is not None and found.prediction is not None
    remarks = [sentence(remark) for remark in found.diagnosis.remarks]
    if found.prediction.passed:
        status, first = Status.OK, found.diffusion_source.note
    else:
        status, first = Status.WARNING, found.prediction.reason
    reasons = "; ".join(one for one in (first, *remarks) if one)
    return StepResult(found, Outcome(number, Step.IDENTIFY, status, reasons))


def _with_work(
    settings: PipelineSettings, found: FieldEstimate, recordings: Recordings, *, number: int
) -> FieldEstimate:
    """f with what samples about its paths of least action tell without a formula; they may refute it."""
    # Behind slow noise the state is known so little that f there is not what moves it in the mean.
    untold = found.noise_free or found.memory is not None or found.has_hidden_state or found.library.angles
    if untold or not found.diffusion.regular:
        return found
    pair_step = settings.sampling.pair_step
    if found.sensor_variance is not None and not found.flow.by_density:
        recordings = filtered_recordings(found, recordings, pair_step=pair_step)
    pairs = snapshot_pairs(recordings, pair_step=pair_step)
    points = pairs.x0[evenly_spread(pairs.x0, generator=generator(settings.seed, number, Purpose.LANDSCAPE))]
    try:
        portrait = phase_portrait(found.dynamics, points, seed=number)
        paths = [way.path for way in ways_out(found.dynamics, portrait) if way.path is not None]
        found, chance = with_work_of_samples(found, pairs, paths)
    except (NumericalFailure, np.linalg.LinAlgError):
        return found  # the landscape will say what is amiss
    return found.with_shape_tested(chance, limit=settings.certificate.each, along="way")


def regress_run(
    settings: PipelineSettings, recordings: Recordings | None, trained: StepResult[AnyNetworks]
) -> StepResult[SymbolicDecomposition]:
    """Formulas of the networks of one run."""
    number, networks, options = trained.outcome.run, trained.result, settings.regression
    if networks is None or recordings is None:
        return StepResult(None, Outcome(number, Step.REGRESS, Status.SKIPPED, _no_networks(trained.outcome)))
    try:
        points = snapshot_pairs(recordings, pair_step=settings.sampling.pair_step).x0
        potential, circulatory, vector_field = networks.evaluate(points)
        below = points_below(potential, level=options.level)
        library = candidate_library(
            recordings.names, degree=options.degree, potential_degree=options.potential_degree,
            circulatory_degree=options.circulatory_degree, further=options.functions,
        )  # fmt: skip
        # A D that was not given is that of the networks, in their precision.
        noise = settings.space.constant_noise(points.shape[1]) or Diffusion(networks.diffusion)
        parts = (points[below], potential[below], circulatory[below], vector_field[below])
        found = sparse_decomposition(library, *parts, diffusion=noise, options=options)
        formulas = decomposition_from_coefficients(
            library, potential=found.potential, circulatory=found.circulatory,
            vector_field=found.vector_field, points=points[below],
        )  # fmt: skip
        if isinstance(networks, NetworksByWell):
            dynamics = Dynamics.of(
                formulas.symbols, formulas.vector_field, diffusion=Diffusion(networks.diffusion)
            )
            degree = affordable_degree(len(formulas.symbols), options.well_degree)
            formulas = replace(formulas, wells=formulas_by_well(networks, dynamics, degree=degree))
    except NumericalFailure as error:
        return StepResult(None, Outcome(number, Step.REGRESS, Status.FAILED, str(error)))
    status = Status.OK if found.converged else Status.WARNING
    reason = "" if found.converged else f"SR3 did not settle in {found.iterations - 1} iterations"
    details = {
        "points": found.points, "converged": found.converged, "iterations": found.iterations,
        "constraint_residual": found.constraint_residual,
        "sparse_constraint_residual": found.sparse_constraint_residual,
        "misfit": np.round(found.misfit, 12).tolist(),
    }  # fmt: skip
    return StepResult(formulas, Outcome(number, Step.REGRESS, status, reason, details))


def _no_networks(outcome: Outcome) -> str:
    return f"the training gave no networks ({outcome.reason})"


@dataclass(frozen=True)
class _RefinedRun:
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

    @property
    def wells(self) -> tuple[Well, ...]:
        """V about the attractors, as refined."""
        return () if self.refinement is None else self.refinement.formulas.wells

    @property
    def certificate(self) -> Certificate | None:
        """That of the refined formulas."""
        return None if self.refinement is None else self.refinement.certificate

    @property
    def record(self) -> OccupancyCheck | None:
        """The test of f against the hops and the histogram of the recordings."""
        return None if self.refinement is None else self.refinement.record


def refine_run(
    settings: PipelineSettings, recordings: Recordings | None, identified: StepResult[FieldEstimate],
    trained: StepResult[AnyNetworks], regressed: SymbolicDecomposition | None = None,
) -> _RefinedRun:  # fmt: skip
    """V about every attractor of the identified f, or over the region, with its certificate.

    It follows from trajectories and f alone; networks are a second route, which has to agree.

    Parameters
    ----------
    settings
        Routes, degrees, and the limits of the certificate.
    recordings, identified, trained
        Trajectories, f and networks of the run.
    regressed
        The formulas of the networks, which are certified beside the refined ones; None where there are none.
    """
    number, networks = identified.outcome.run, trained.result
    formulas = {} if regressed is None else {Method.REGRESSION: regressed}
    certificates: dict[Method, Mapping[str, Any]] = {}
    context: RefinementContext | None = None
    refinement: Refinement | None = None
    # Networks that were asked for and are not there are the first cause of whatever follows.
    asked = trained.outcome.status == Status.FAILED or "network" in (settings.refinement.routes or ())
    lost = [_no_networks(trained.outcome)] if networks is None and asked else []
    if identified.result is None or recordings is None:
        missing = f"no vector field was identified ({identified.outcome.reason})"
        outcome = Outcome(number, Step.REFINE, Status.SKIPPED, missing)
    else:
        try:
            context = RefinementContext(
                recordings, identified.result, networks, number=number, seed=settings.seed,
                pair_step=settings.sampling.pair_step, refinement=settings.refinement,
                limits=settings.certificate,
            )  # fmt: skip
            if regressed is not None:
                certificates[Method.REGRESSION] = certify(regressed, context.evidence).as_data()
            refinement = context.refine_and_certify()
            certificate = refinement.certificate
            formulas[Method.REFINED] = refinement.formulas
            certificates[Method.REFINED] = certificate.as_data() | {
                "notes": [*lost, *map(sentence, refinement.remarks)],
                "no_record_test": "" if (none := refinement.record.missing) is None else sentence(none),
            }  # fmt: skip
            status = Status.OK if certificate.certified else Status.WARNING
            reason = [] if certificate.certified else [*lost, certificate.reason]
            outcome = Outcome(number, Step.REFINE, status, "; ".join(reason))
        except (NumericalFailure, np.linalg.LinAlgError) as error:
            outcome = Outcome(number, Step.REFINE, Status.FAILED, "; ".join([*lost, str(error)]))
    if context is not None and networks is not None:
        certificates[Method.CONTROL] = context.control(formulas.get(Method.REFINED))
    for method in formulas.keys() - certificates.keys():
        certificates[method] = uncertified(f"no test was made: {outcome.reason}")
    portrait = None if context is None else context.portrait
    return _RefinedRun(formulas, certificates, outcome, refinement, portrait)


def landscape_of_run(
    settings: PipelineSettings, recordings: Recordings | None, record: FieldEstimate | None, *,
    number: int, wells: Sequence[Well] = (), seek_wells: bool = True,
    certificate: Certificate | None = None, visits: tuple[VisitTest, ...] = (),
) -> StepResult[Landscape]:  # fmt: skip
    """The landscape of the identified f within the recorded region.

    The wells are those of the refinement, with their certificate, and `visits` those that its test against
    the record compared; where it found none, the local route is asked once more, within the whole
    recorded region, unless `seek_wells` says that it shall not.
    """
    if recordings is None or record is None:
        reason = "no vector field was identified"
        return StepResult(None, Outcome(number, Step.LANDSCAPE, Status.SKIPPED, reason))
    recordings = of_all_states(recordings, record, pair_step=settings.sampling.pair_step)
    x = record.wrapped(snapshot_pairs(recordings, pair_step=settings.sampling.pair_step)).x0
    points = x[evenly_spread(x, generator=generator(settings.seed, number, Purpose.LANDSCAPE))]
    noise = NoiseStrength(settings.noises[0]) if settings.noises else None
    if (shown := record.noise_strength) is not None:  # what the recordings show, before what the study gives
        noise = NoiseStrength(*shown, source="estimated")
    try:
        portrait = phase_portrait(record.dynamics, points, seed=number)
        found = find_landscape(
            record, portrait, wells=wells if wells or not seek_wells else None, certificate=certificate,
            options=settings.refinement, noise=noise, seed=number,
        ).with_checked_times(settings.landscape, seed=number)  # fmt: skip
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        return StepResult(None, Outcome(number, Step.LANDSCAPE, Status.FAILED, str(error)))
    whole = found.global_quasipotential is not None and not found.notes
    outcome = Outcome(number, Step.LANDSCAPE, Status.OK if whole else Status.WARNING, "; ".join(found.notes))
    note = record.diffusion_source.note
    if note is not None:
        found = replace(found, remarks=(*found.remarks, Remark("quasipotential.reason", {"reason": note})))
    # The attractors of both steps are those of one f: where they differ in number, indices mean nothing.
    if visits and max(one.well for one in visits) < len(found.attractors):
        found = replace(found, visits=visits)
    # Units are as the recordings say, or else the card; 1 where none does.
    space = settings.space
    named = zip(recordings.names, recordings.units, strict=True)
    units = tuple(unit or space.unit(name, unknown="1") for name, unit in named)
    found = found.in_units(units, time=recordings.time_unit or space.unit("t", unknown="1"))
    return StepResult(found, outcome)


@dataclass(frozen=True)
class Analysis:
    """What the steps found; each has its outcome, and says why where it has no result."""

    identified: StepResult[FieldEstimate]  #: f, and the test of its predictions
    trained: StepResult[AnyNetworks]  #: the networks
    regressed: StepResult[SymbolicDecomposition] | None  #: the published method's formulas, where asked for
    refined: _RefinedRun  #: formulas by method, with their certificates
    landscape: StepResult[Landscape] | None  #: wells, barriers, ways; None where not asked for

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """What became of each step."""
        steps = (self.identified, self.trained, self.regressed, self.refined, self.landscape)
        return tuple(one.outcome for one in steps if one is not None)

    @property
    def dynamics(self) -> Dynamics | None:
        """What was identified, None where nothing was."""
        return None if self.identified.result is None else self.identified.result.dynamics


def analyse(
    recordings: Recordings, settings: PipelineSettings | None = None, *, number: int = 0, device: str = "auto"
) -> Analysis:
    """All that recordings give, also where a step failed, which its outcome then says.

    A run of another `number` has other random numbers. Networks are trained on the device ``auto``, ``cpu``
    or ``cuda``.
    """
    settings = settings or PipelineSettings()
    networks = settings.training is not None
    settings = replace(settings, refinement=settings.refinement.with_routes(networks=networks))
    recordings = _prepared(settings, recordings)
    identified = identify_run(settings, recordings, number=number)
    trained, regressed, landscape = not_trained(number), None, None
    if networks:
        from siq.workflow.training import train_block

        trained = train_block(settings, {number: (recordings, identified.result)}, device=device)[0][number]
        if settings.published_method:
            regressed = regress_run(settings, recordings, trained)
    formulas = None if regressed is None else regressed.result
    refined = refine_run(settings, recordings, identified, trained, formulas)
    if settings.landscape is not None:
        landscape = landscape_of_run(
            settings, recordings, identified.result, wells=refined.wells, number=number,
            certificate=refined.certificate, visits=() if refined.record is None else refined.record.visits,
        )  # fmt: skip
    return Analysis(identified, trained, regressed, refined, landscape)


def landscape_from_recordings(
    recordings: str | Path | Recordings | pd.DataFrame, settings: PipelineSettings | None = None, *,
    hidden_velocities: bool | Literal["auto"] = "auto",
) -> Landscape:  # fmt: skip
    """The landscape that recordings show; see `siq.Landscape.from_recordings`."""
    settings, trajectories = settings or PipelineSettings(), Recordings.of(recordings)
    if hidden_velocities != "auto":
        identification = replace(settings.identification, hidden_velocities=hidden_velocities)
        settings = replace(settings, identification=identification)
    analysis = analyse(trajectories, settings)
    found = None if analysis.landscape is None else analysis.landscape.result
    # Levels of an angle are the same a turn on, and no levels of a record.
    seen = None if settings.identification.angles else RecordStates.of(joined(trajectories))
    if found is None:
        raise NoLandscape(why_no_landscape(analysis.outcomes), seen, analysis.dynamics)
    return replace(found, recorded_states=seen)
