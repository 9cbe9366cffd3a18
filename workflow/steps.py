"""The tasks of a study: what each step reads, which settings it depends on, and what it gives.

In the order of the science: `draw` trajectories, `identify` f, `train` two networks, `regress` and `refine`
formulas of V, `score` and `collect` them; then the `landscape` of every run, what it is held against, and
landscapes of equations. A task imports what it needs when it runs, so that a job loads no more.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from workflow.task import Given, task

if TYPE_CHECKING:
    from siq.networks.decomposition import AnyNetworks
    from siq.quasipotential.wells import Well
    from siq.workflow.study import PipelineSettings
    from siq.workflow.tables import ModelFiles, StepResult

# The published method, and ours.


@task(
    "source", "files",
    options=(
        "seed", "space", "sampling", "simulation", "card", "identification.hidden_velocities",
        "identification.angles", "identification.degree", "identification.functions",
    ),
)  # fmt: skip
def draw(given: Given, settings: PipelineSettings) -> Any:
    """Trajectories of a run: a simulation of the card, or recordings resampled."""
    from siq.workflow.pipeline import draw_run, source_of

    drawn = draw_run(settings, source_of(given.files["source"], settings), number=given.number)
    return {"recordings": drawn.result, "draw_outcome": [drawn.outcome]}


@task("recordings", options=("seed", "space", "sampling", "identification", "certificate"))
def identify(given: Given, settings: PipelineSettings) -> Any:
    """The vector field f from pairs of samples, with the test of its predictions."""
    from siq.workflow.pipeline import identify_run

    found = identify_run(settings, given.recordings, number=given.number)
    return {"field": found.result, "identify_outcome": [found.outcome]}


@task("recordings", "field", options=("seed", "space", "sampling", "training"))
def train(given: Given, settings: PipelineSettings) -> Any:
    """The decomposition f = -D∇V + g by two networks; runs of a block train side by side."""
    import torch
    import torch._dynamo  # the first optimiser loads it: once for all runs

    from siq.workflow import training

    torch.set_num_threads(given.threads)
    runs = dict(enumerate(zip(given.recordings, given.field, strict=True), start=given.number))
    folder, version = Path(given.outputs["networks"]).parent, given.options["version"]
    given.afterwards.append(partial(training.clean, folder, settings.training))
    found = training.train_block(settings, runs, folder=folder, device=given.device, version=version)
    outcomes = [one.outcome for one in found[0].values()]
    return {"networks": found[1] or None, "history": found[2], "train_outcome": outcomes}


UNCERTIFIED = {
    "certified": False,
    "tests": {},
    "reason": "no certificate is computed for this method; the formula may belong to a false decomposition",
}


@task("recordings", "networks", "train_outcome", options=("space", "sampling", "regression"))
def regress(given: Given, settings: PipelineSettings) -> Any:
    """Sparse formulas of V, g and f from the networks, as published."""
    import pysindy  # noqa: F401 (once for all runs: it takes seconds)

    from siq.workflow.pipeline import regress_run
    from siq.workflow.tables import Method

    found = regress_run(settings, given.recordings, trained_run(given))
    formulas = {} if found.result is None else {Method.REGRESSION: found.result}
    certificates = dict.fromkeys(formulas, UNCERTIFIED)
    return {"regression": (formulas, certificates), "regress_outcome": [found.outcome]}


@task(
    "recordings", "field", "identify_outcome", "networks", "train_outcome", "regression",
    options=("seed", "sampling", "refinement", "certificate"),
)  # fmt: skip
def refine(given: Given, settings: PipelineSettings) -> Any:
    """V and g refined on the Hamilton–Jacobi equation, and the certificate of every formula."""
    from siq.workflow.pipeline import refine_run
    from siq.workflow.tables import Method, StepResult
    from workflow.rows import density_rows, visit_rows

    recordings = given.recordings
    regressed = {} if given.regression is None else given.regression[0]
    identified = StepResult(given.field, given.identify_outcome[0])
    run = refine_run(settings, recordings, identified, trained_run(given), regressed.get(Method.REGRESSION))
    attractors = () if run.portrait is None else [one.position for one in run.portrait.attractors]
    states = () if recordings is None else recordings.names
    return {
        "model": (run.formulas, run.certificates),
        "refine_outcome": [run.outcome],
        "record": visit_rows(given.number, run.record, attractors),
        "record_density": density_rows(given.number, run.record, attractors, states),
    }


@task(
    "model", "networks", "train_outcome", "card",
    options=("seed", "regression", "simulation", "published_method", "card", "exact"),
)  # fmt: skip
def score(given: Given, settings: PipelineSettings) -> Any:
    """How close a run comes to exact answers, where these are known."""
    from workflow.scoring import exact_answer, score_run

    card = given.path("card")
    exact = None if card is None else exact_answer(card)
    formulas, certificates = given.model
    return score_run(
        settings, formulas, certificates, trained_run(given).result,
        number=given.number, system=given.card, exact=exact,
    )  # fmt: skip


@task(
    "coefficients", "rrmse", "prediction", "certificates", "record", "record_density", "landscape", "degrees",
    "training", "outcomes", "published",
)  # fmt: skip
def collect(given: Given, settings: PipelineSettings) -> Any:
    """All runs of a study as tables."""
    from workflow import scoring
    from workflow.files import read_outcomes

    return scoring.collect_runs(
        {name: list(getattr(given, name) or ()) for name in scoring.OF_RUNS},
        [one for path in given.files["outcomes"] for one in read_outcomes(path)],
        {} if given.published is None else given.published.figures,
        benchmarks=Path(given.options["benchmarks"]),
    )


# The landscape of each run, and what it is held against.


@task("recordings", "field", "model", options=("seed", "space", "sampling", "refinement", "landscape"))
def landscape(given: Given, settings: PipelineSettings) -> Any:
    """Equilibria of the identified f, a formula for each well, barriers, paths and times."""
    from siq.workflow.pipeline import landscape_of_run
    from workflow.rows import degree_rows, landscape_rows

    number, field = given.number, given.field
    found = landscape_of_run(settings, given.recordings, field, wells=_wells(given.model), number=number)
    note = None if field is None else field.diffusion_source.note
    return {
        "quasipotential": found.result,
        "landscape": landscape_rows(number, found.result, note),
        "degrees": degree_rows(number, found.result),
        "landscape_outcome": [found.outcome],
    }


@task(
    "rrmse", "model", "field", "recordings", "quasipotential",
    options=("seed", "space", "sampling", "refinement", "landscape", "every_run"),
)  # fmt: skip
def overview(given: Given, settings: PipelineSettings) -> Any:
    """The landscape that the page opens with, found for this run alone where the study asks for none."""
    from siq.quasipotential.landscape_files import landscape_data
    from siq.workflow.pipeline import landscape_of_run

    models = model_files(given)
    number = models.representative(given.rrmse)[0]
    number = number if number is not None else models.first_wells()[0]
    if given.options["every_run"]:  # that of the formulas, or else the first that has an attractor
        stored = given.quasipotential
        order = [*([] if number is None else [number]), *range(len(stored))]
        chosen = next((run for run in order if run < len(stored) and (stored[run] or {}).get("wells")), None)
        return {"overview": None if chosen is None else {"run": chosen} | stored[chosen]}
    if number is None:
        return {"overview": None}
    found = landscape_of_run(
        settings, given.recordings[number], given.field[number],
        number=number, wells=_wells(given.model[number]), seek_wells=False,
    ).result  # fmt: skip
    if found is None or not found.attractors:
        return {"overview": None}
    data = landscape_data(found)
    # No formula about a single well was sought, so that none is missed.
    missed = "quasipotential.no_refined_formula"
    data["remarks"] = [one for one in data["remarks"] if one["code"] != missed]
    return {"overview": {"run": number} | data}


@task("card", options=("seed", "card"))
def reference(given: Given, settings: PipelineSettings) -> Any:
    """The answers of methods that share no code with ours, for the vector field of the card."""
    from workflow import comparison

    return {"reference": comparison.reference_of_card(settings, given.card)}


@task(
    "reference", "field", "quasipotential", "model", "networks", "train_outcome", "published", "mesh",
    options=("seed", "space", "landscape"),
)  # fmt: skip
def landscape_errors(given: Given, settings: PipelineSettings) -> Any:
    """The landscapes of all runs against the references, networks, formulas, and what was published."""
    from workflow import comparison

    runs = [
        (
            comparison.read_stored(given.files["field"][number], given.files["quasipotential"][number]),
            given.model[number][0],
            trained_run(given, number).result,
        )
        for number in range(len(given.model))
    ]
    figures, mesh = (
        ({}, None) if given.published is None else (given.published.figures, published_mesh(given))
    )
    return {"table": comparison.run_landscape_errors(settings, given.reference, runs, figures, mesh)}


@task("quasipotential", "card", options=("seed", "landscape", "card"))
def beside_equations(given: Given, settings: PipelineSettings) -> Any:
    """The landscape of the card's equations, to compare those of the runs with: scoring alone."""
    from workflow import comparison

    table = comparison.run_beside_equations(settings, given.card, list(given.quasipotential))
    return {"table": table}


@task("quasipotential", "card", options=("seed", "landscape", "card"))
def escapes(given: Given, settings: PipelineSettings) -> Any:
    """Simulated escapes beside the law."""
    from workflow import comparison

    return {"table": comparison.run_escapes(settings, given.card, list(given.quasipotential))}


# Landscapes of equations.


@task("card", options=("seed", "refinement", "certificate", "landscape", "card"))
def equations(given: Given, settings: PipelineSettings) -> Any:
    """The landscape of equations; where there is none, the outcome says why."""
    import numpy as np

    from siq.errors import NumericalFailure
    from siq.quasipotential.landscape import LandscapeOptions, NoLandscape
    from siq.quasipotential.landscape_assembly import EquationSettings, landscape_from_equations
    from siq.workflow.tables import Method, Outcome, Status, Step, as_table
    from workflow.rows import certificate_rows, degree_rows, landscape_rows

    own = EquationSettings(
        settings.seed, settings.refinement, settings.certificate, settings.landscape or LandscapeOptions()
    )
    found, certificate = None, None
    try:
        found = landscape_from_equations(given.card, own)
        certificate = found.certificate
        status = Status.WARNING if found.global_quasipotential is None else Status.OK
        outcome = Outcome(0, Step.LANDSCAPE, status, "; ".join(found.notes))
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        reason = error.reason if isinstance(error, NoLandscape) else str(error)
        outcome = Outcome(0, Step.LANDSCAPE, Status.FAILED, reason)
    tests = {} if certificate is None else {str(Method.REFINED): certificate.as_data()}
    return {
        "quasipotential": found,
        "outcomes": as_table("outcomes", [outcome.as_data()]),
        "landscape": landscape_rows(0, found),
        "degrees": degree_rows(0, found),
        "certificates": certificate_rows(0, tests),
    }


@task("card", options=("seed", "card_but_for_swept"))
def sweep_point(given: Given, settings: PipelineSettings) -> Any:
    """The landscape at one point of a sweep, in a file of its name: another range makes new values only."""
    from siq.workflow.study import SweepOptions
    from siq.workflow.sweep import point_at

    names, values = SweepOptions.of_point(given.wildcards["point"])
    card = given.path("card")
    assert card is not None
    return {"point": point_at(card, names, values, seed=settings.seed)}


@task("card", "points", options=("landscape", "sweep", "card_but_for_swept"))
def sweep(given: Given, settings: PipelineSettings) -> Any:
    """Branches, barriers and times against the parameter."""
    from pydantic import TypeAdapter

    from siq.workflow.study import SweepOptions
    from siq.workflow.sweep import SweptPoint, collected

    adapter = TypeAdapter(SweptPoint)
    points = [adapter.validate_json(Path(path).read_bytes()) for path in given.files["points"]]
    names = SweepOptions.model_validate(given.options["sweep"]).names
    noises = () if settings.landscape is None else settings.landscape.noise_intensities
    found = collected(given.card, names, points, noise=next(iter(noises), None))
    return {
        "sweep": found.table, "sweep_ways": found.ways, "branches": found.branches,
        "bifurcations": found.bifurcations, "bifurcation_curves": found.curves,
    }  # fmt: skip


# Recordings to try things with.


@task("card")
def example_recordings(given: Given, settings: PipelineSettings) -> Any:
    """Trajectories of a card, as if they were measured."""
    from siq.numerics.randomness import Purpose, generator
    from siq.systems.simulation import SimulationOptions, simulate_snapshots

    options = SimulationOptions(**given.options["simulation"])
    draws = generator(given.options["seed"], given.options["run"], Purpose.SIMULATE)
    return {"recordings": simulate_snapshots(given.card, options=options, generator=draws)}


@task()
def example_hopping(given: Given, settings: PipelineSettings) -> Any:
    """Hopping recordings of a noisy camera: those that `siq example` writes."""
    from siq.workflow.examples import double_well_recordings

    return {"text": double_well_recordings()}


# What several tasks read.


def trained_run(given: Given, run: int | None = None) -> StepResult[AnyNetworks]:
    """The networks of a run; of one of several where `run` says which."""
    from siq.workflow.tables import POSITION, StepResult, not_trained

    number = given.number if run is None else run
    networks, outcomes = given.networks, given.train_outcome
    if not outcomes:
        return not_trained(number)
    if run is not None:
        networks, outcomes = networks[run], outcomes[run]
    outcome = next(one for one in outcomes if one.run == number)
    return StepResult(networks[outcome.details[POSITION]] if outcome.usable else None, outcome)


def _wells(model: Any) -> tuple[Well, ...]:
    """V about the attractors, as refined."""
    from siq.workflow.tables import Method

    return model[0][Method.REFINED].wells if Method.REFINED in model[0] else ()


def model_files(given: Given) -> ModelFiles:
    """The formulas of all runs."""
    from siq.workflow.tables import ModelFiles

    return ModelFiles(tuple(given.files["model"]))


def published_mesh(given: Given) -> Any:
    """U on the mesh that was published, None where it is not at hand."""
    from workflow.published import mesh_potential

    path, mesh = given.path("mesh"), given.published.mesh
    return None if path is None or mesh is None else mesh_potential(path, mesh)
