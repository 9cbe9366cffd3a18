"""Results of the steps of a run: what was drawn, identified, regressed, refined, and its landscape.

Each result has its object, None where a step failed, and an outcome that says why; ``files()`` gives what
is written, by the names of the rule's outputs. The formulas of the regression are certified beside the
refined ones, and so is a control: what the same refinement makes of a network with its weights in random
order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from siq.data.preparation import in_stretches, read_pairs, without_slow_drift
from siq.data.recordings import Recordings, resample_recordings, snapshot_pairs
from siq.errors import NumericalFailure
from siq.inference.field_estimate import FieldEstimate
from siq.inference.identify import identify
from siq.inference.kalman_identification import of_all_states
from siq.inference.library import candidate_library
from siq.networks.decomposition import TrainedNetworks
from siq.networks.regression import RegressionResult, points_below, sparse_decomposition
from siq.numerics.randomness import Purpose, generator
from siq.numerics.text import place_text
from siq.quasipotential.certificate import Certificate, certify, uncertified
from siq.quasipotential.formulas import SymbolicDecomposition, decomposition_from_coefficients
from siq.quasipotential.landscape import Landscape, NoLandscape
from siq.quasipotential.landscape_assembly import EquationSettings, find_landscape, landscape_from_equations
from siq.quasipotential.occupancy import OccupancyCheck, VisitTest
from siq.quasipotential.rates import MeanTime, NoiseStrength, mean_exit_time, mean_residence_time
from siq.quasipotential.refinement import Refinement, RefinementContext, control, refine_and_certify
from siq.quasipotential.wells import Well, best_trial
from siq.remarks import Remark, sentence
from siq.systems.cards import load_system
from siq.systems.cycles import Cycle
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.phase_portrait import PhasePortrait, evenly_spread, phase_portrait
from siq.systems.simulation import simulate_snapshots
from siq.workflow.files import read
from siq.workflow.study import PipelineSettings, StateSpace
from siq.workflow.tables import Method, Outcome, Status, Step, as_table
from siq.workflow.training import TrainedRun


@plain_dataclass(frozen=True)
class Identified:
    """The identified f of a run with the test of its predictions, None where none was found."""

    record: FieldEstimate | None
    outcome: Outcome

    def files(self) -> dict[str, Any]:
        """By the names of the rule."""
        return {"field": self.record, "identify_outcome": [self.outcome]}


def identify_run(settings: PipelineSettings, recordings: Recordings | None, *, number: int) -> Identified:
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


def read_states(path: str | Path, field: str | Path) -> Recordings | None:
    """Trajectories of a run, with velocities that were not recorded as its identified f has them."""
    recordings, record = read("recordings", path), read("field", field)
    if recordings is None or record is None:
        return recordings
    return of_all_states(recordings, record, pair_step=None)


@plain_dataclass(frozen=True)
class Drawn:
    """The trajectories of a run, None where its simulation failed."""

    recordings: Recordings | None
    outcome: Outcome

    def files(self) -> dict[str, Any]:
        """By the names of the rule."""
        return {"recordings": self.recordings, "draw_outcome": [self.outcome]}


def draw_run(settings: PipelineSettings, source: Dynamics | Recordings, *, number: int) -> Drawn:
    """The trajectories of run `number`.

    Parameters
    ----------
    settings
        What is drawn.
    source
        The system to be simulated, or the recordings: run 0 takes them all, further runs resample them.
    number
        Of the run.
    """
    if isinstance(source, Recordings):
        hidden = settings.identification.hidden_velocities
        source = in_stretches(without_slow_drift(source), hidden_velocities=hidden)
        if number > 0:
            draw = generator(settings.seed, number, Purpose.RESAMPLE)
            source = resample_recordings(source, generator=draw)
        return Drawn(source, Outcome(number, Step.RESAMPLE, reason="; ".join(source.notes)))
    assert settings.simulation is not None  # a system is simulated
    try:
        draw = generator(settings.seed, number, Purpose.SIMULATE)
        recordings = simulate_snapshots(source, options=settings.simulation, generator=draw)
        return Drawn(recordings, Outcome(number, Step.SIMULATE))
    except NumericalFailure as error:
        return Drawn(None, Outcome(number, Step.SIMULATE, Status.FAILED, str(error)))


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
        path,
        states=settings.space.names,
        units=settings.space.units,
        pair_step=settings.sampling.pair_step,
        hidden_velocities=settings.identification.hidden_velocities,
    )
    space = settings.space
    units = tuple(
        unit or space.unit(name, unknown="") or None
        for name, unit in zip(recordings.names, recordings.units, strict=True)
    )
    return replace(
        recordings, units=units, time_unit=recordings.time_unit or space.unit("t", unknown="") or None
    )


UNCERTIFIED = {
    "certified": False,
    "tests": {},
    "reason": "no certificate is computed for this method; the formula may belong to a false decomposition",
}


@plain_dataclass(frozen=True)
class Regressed:
    """The formulas of a run, None where there are none."""

    formulas: SymbolicDecomposition | None
    outcome: Outcome

    def files(self) -> dict[str, Any]:
        """By the names of the rule."""
        models = {} if self.formulas is None else {Method.REGRESSION: self.formulas}
        return {"regression": (models, dict.fromkeys(models, UNCERTIFIED)), "regress_outcome": [self.outcome]}


def regress_run(settings: PipelineSettings, recordings: Recordings | None, trained: TrainedRun) -> Regressed:
    """Formulas of the networks of one run."""
    number = trained.outcome.run
    if trained.networks is None or recordings is None:
        return Regressed(None, Outcome(number, Step.REGRESS, Status.SKIPPED, trained.missing))
    try:
        formulas, found = _regressed(settings, recordings, trained.networks)
    except NumericalFailure as error:
        return Regressed(None, Outcome(number, Step.REGRESS, Status.FAILED, str(error)))
    status = Status.OK if found.converged else Status.WARNING
    reason = "" if found.converged else f"SR3 did not settle in {found.iterations - 1} iterations"
    return Regressed(formulas, Outcome(number, Step.REGRESS, status, reason, _quality(found)))


def _regressed(
    settings: PipelineSettings, recordings: Recordings, networks: TrainedNetworks
) -> tuple[SymbolicDecomposition, RegressionResult]:
    options = settings.regression
    points = snapshot_pairs(recordings, pair_step=settings.sampling.pair_step).x0
    values = networks.evaluate(points)
    below = points_below(values.potential, level=options.level)
    library = candidate_library(
        recordings.names,
        degree=options.degree,
        potential_degree=options.potential_degree,
        circulatory_degree=options.circulatory_degree,
        further=options.functions,
    )
    result = sparse_decomposition(
        library,
        points[below],
        values.potential[below],
        values.circulatory[below],
        values.vector_field[below],
        # D that nobody gave is that of the networks, in their precision.
        diffusion=settings.space.constant_noise(points.shape[1]) or Diffusion(networks.diffusion),
        options=options,
    )
    formulas = decomposition_from_coefficients(
        library,
        potential=result.potential,
        circulatory=result.circulatory,
        vector_field=result.vector_field,
        points=points[below],
    )
    return formulas, result


def _quality(result: RegressionResult) -> dict[str, Any]:
    """What the regression says of itself, for the outcome."""
    return {
        "points": result.points,
        "converged": result.converged,
        "iterations": result.iterations,
        "constraint_residual": result.constraint_residual,
        "sparse_constraint_residual": result.sparse_constraint_residual,
        "misfit": np.round(result.misfit, 12).tolist(),
    }


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
    def record(self) -> OccupancyCheck | None:
        """The test of f against the hops and the histogram of the recordings."""
        return None if self.refinement is None else self.refinement.record


def refine_run(settings: PipelineSettings, given: RunToRefine) -> RefinedRun:
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
            reason = [] if certificate.certified else [*lost, certificate.reason]
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


def _visit_rows(run: int, found: OccupancyCheck | None, attractors: Sequence[np.ndarray]) -> pd.DataFrame:
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
    run: int, found: OccupancyCheck | None, attractors: Sequence[np.ndarray], states: Sequence[str]
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


def place(position: np.ndarray) -> str:
    """A state as text."""
    return "(" + ", ".join(f"{value:.6g}" for value in position) + ")"


def _landscape_rows(run: int, found: Landscape, remark: str | None = None) -> pd.DataFrame:
    """One row for each equilibrium, cycle and way out; `remark` is of what all barriers hang on.

    Mean times are for the noise of the landscape: of an attractor the time in its well, of a transition that
    over its saddle alone; the error is that of data and law together.
    """
    names = [f"A{index + 1}" for index in range(len(found.attractors))]
    heights = {place(one.position): index for index, one in enumerate(found.attractors)}
    tops: dict[str, float] = {}
    for way in found.transitions:
        top = found.heights[way.start] + way.barrier
        tops[place(way.saddle.position)] = min(top, tops.get(place(way.saddle.position), np.inf))
    noise = found.noise
    rows: list[dict[str, object]] = []
    for one in found.equilibria:
        index = heights.get(place(one.position))
        eigenvalues = ", ".join(_complex(value) for value in one.eigenvalues)
        rows.append(
            {
                "run": run,
                "item": "" if index is None else names[index],
                "kind": one.kind,
                "position": place(one.position),
                "eigenvalues": eigenvalues,
                "U": tops.get(place(one.position), np.nan) if index is None else found.heights[index],
                "basin": np.nan if index is None else found.basins[index],
            }
            | ({} if index is None else _time(found, mean_residence_time(found.exits(index), found.noise)))
        )
    rows += [_cycle_row(run, found, one, names, tops) for one in (*found.cycles, *found.parting)]
    for way in found.transitions:
        beyond = "outside" if way.end is None else names[way.end]
        rows.append(
            {
                "run": run,
                "item": f"{names[way.start]} to {beyond}",
                "kind": "transition",
                "position": place(way.place),
                "U": found.heights[way.start] + way.barrier,
                "barrier": way.barrier,
                "standard_error": way.standard_error,
                "formula_share": way.formula_share,
                "minimum_action": np.nan if way.path is None else way.path.uphill.action,
                "prefactor": np.nan if way.rate is None else way.rate.prefactor,
                "barrier_over_noise": np.nan if noise is None else way.barrier / noise.intensity,
                "note": "; ".join([*way.notes, *([] if remark is None else [remark])]),
            }
            | _time(found, None if noise is None else mean_exit_time(way.exit, noise))
        )
    return as_table("landscape", rows)


def _cycle_row(
    run: int, found: Landscape, one: Cycle, names: list[str], tops: dict[str, float]
) -> dict[str, object]:
    """Of a cycle, one of its states, the Floquet exponents, and a note with period and multipliers."""
    index = next((at for at, other in enumerate(found.attractors) if other is one), None)
    multipliers = ", ".join(_complex(value) for value in one.multipliers)
    return {
        "run": run,
        "item": "" if index is None else names[index],
        "kind": one.kind,
        "position": place(one.position),
        "eigenvalues": ", ".join(_complex(value) for value in one.eigenvalues),
        "U": tops.get(place(one.position), np.nan) if index is None else found.heights[index],
        "basin": np.nan if index is None else found.basins[index],
        "note": f"period {one.period:.8g}, Floquet multipliers {multipliers}",
    }


def _complex(value: complex) -> str:
    return f"{value.real:.4g}" + (f"{value.imag:+.4g}i" if value.imag else "")


def _time(found: Landscape, mean: MeanTime | None) -> dict[str, object]:
    noise = np.nan if found.noise is None else found.noise.intensity
    if mean is None:
        return {"noise": noise}
    return {"noise": noise, "mean_time": mean.value, "mean_time_error": mean.value * mean.error}


def _degree_rows(run: int, found: Landscape) -> pd.DataFrame:
    """Accuracy against number of terms, about each attractor."""
    rows = [
        {
            "run": run, "attractor": f"A{index + 1}", "degree": trial.degree, "terms": trial.terms,
            "residual": trial.residual, "covered": trial.covered, "chosen": number == best_trial(well.trials),
        }
        for index, well in enumerate(found.wells)
        if well is not None
        for number, trial in enumerate(well.trials)
    ]  # fmt: skip
    return as_table("degrees", rows)


@plain_dataclass(frozen=True)
class FoundLandscape:
    """The landscape of a run with the f that it is of, None where it could not be found."""

    landscape: Landscape | None
    record: FieldEstimate | None
    outcome: Outcome

    def files(self) -> dict[str, Any]:
        """By the names of the rule."""
        number, stored = self.outcome.run, None
        rows, accuracy = as_table("landscape", []), as_table("degrees", [])
        if self.landscape is not None and self.record is not None:
            stored = self.landscape
            rows = _landscape_rows(number, self.landscape, self.record.diffusion_source.note)
            accuracy = _degree_rows(number, self.landscape)
        return {
            "quasipotential": stored, "landscape": rows, "degrees": accuracy,
            "landscape_outcome": [self.outcome],
        }  # fmt: skip


def landscape_of_run(
    settings: PipelineSettings,
    recordings: Recordings | None,
    record: FieldEstimate | None,
    *,
    number: int,
    wells: Sequence[Well] = (),
    seek_wells: bool = True,
    certificate: Certificate | None = None,
    visits: tuple[VisitTest, ...] = (),
) -> FoundLandscape:
    """The landscape of the identified f within the recorded region.

    The wells are those of the refinement, with their certificate, and `visits` those that its test against
    the record compared; where it found none, the local route is asked once more, within the whole
    recorded region, unless `seek_wells` says that it shall not.
    """
    if recordings is None or record is None:
        reason = "no vector field was identified"
        return FoundLandscape(None, record, Outcome(number, Step.LANDSCAPE, Status.SKIPPED, reason))
    recordings = of_all_states(recordings, record, pair_step=settings.sampling.pair_step)
    x = snapshot_pairs(recordings, pair_step=settings.sampling.pair_step).x0
    draw = generator(settings.seed, number, Purpose.LANDSCAPE)
    points = x[evenly_spread(x, generator=draw)]
    try:
        portrait = phase_portrait(record.dynamics, points, seed=number)
        found = find_landscape(
            record, portrait, wells=wells if wells or not seek_wells else None, certificate=certificate,
            options=settings.refinement, noise=_noise_strength(settings, record), seed=number,
        )  # fmt: skip
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        return FoundLandscape(None, record, Outcome(number, Step.LANDSCAPE, Status.FAILED, str(error)))
    whole = found.global_quasipotential is not None and not found.notes
    status = Status.OK if whole else Status.WARNING
    outcome = Outcome(number, Step.LANDSCAPE, status, "; ".join(found.notes))
    note = record.diffusion_source.note
    if note is not None:
        remark = Remark("quasipotential.reason", {"reason": note})
        found = replace(found, remarks=(*found.remarks, remark))
    # The attractors of both steps are those of one f: where they differ in number, indices mean nothing.
    if visits and max(one.well for one in visits) < len(found.attractors):
        found = replace(found, visits=visits)
    units, time = _units_of(recordings, settings.space)
    found = found.in_units(units, time=time)
    return FoundLandscape(found, record, outcome)


def _noise_strength(settings: PipelineSettings, record: FieldEstimate) -> NoiseStrength | None:
    """The noise that the recordings show, or else the first that the study gives."""
    if (shown := record.noise_strength) is not None:
        return NoiseStrength(*shown, source="estimated")
    given = () if settings.landscape is None else settings.landscape.noise_intensities
    return NoiseStrength(given[0]) if given else None


def _units_of(recordings: Recordings, space: StateSpace) -> tuple[tuple[str, ...], str]:
    """Units of the states and of the time: as the recordings say, or else the card; ``1`` where none does."""
    states = tuple(
        unit or space.unit(name, unknown="1")
        for name, unit in zip(recordings.names, recordings.units, strict=True)
    )
    return states, recordings.time_unit or space.unit("t", unknown="1")


@plain_dataclass(frozen=True)
class _FoundOfEquations:
    """The landscape of a study of equations, None where there is none, and what became of the step."""

    landscape: Landscape | None
    outcome: Outcome

    def files(self) -> dict[str, Any]:
        """By the names of the rule."""
        rows = {name: as_table(name, []) for name in ("landscape", "degrees", "certificates")}
        if self.landscape is not None:
            certificate = self.landscape.certificate
            tests = {} if certificate is None else certificate.tests
            rows = {
                "landscape": _landscape_rows(0, self.landscape),
                "degrees": _degree_rows(0, self.landscape),
                "certificates": as_table(
                    "certificates",
                    [
                        {"run": 0, "method": str(Method.REFINED), "test": name} | verdict.as_data()
                        for name, verdict in tests.items()
                    ],
                ),
            }
        outcome = self.outcome.as_data() | {"step": self.outcome.step, "status": self.outcome.status}
        return {"quasipotential": self.landscape, "outcomes": as_table("outcomes", [outcome])} | rows


def landscape_of_equations(settings: EquationSettings, system: Dynamics) -> _FoundOfEquations:
    """The landscape of a system; where it has none, the outcome says why."""
    try:
        found = landscape_from_equations(system, settings)
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        reason = error.reason if isinstance(error, NoLandscape) else str(error)
        return _FoundOfEquations(None, Outcome(0, Step.LANDSCAPE, Status.FAILED, reason))
    whole = found.global_quasipotential is not None
    outcome = Outcome(0, Step.LANDSCAPE, Status.OK if whole else Status.WARNING, "; ".join(found.notes))
    return _FoundOfEquations(found, outcome)
