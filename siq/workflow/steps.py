"""The tasks of a study: what each step reads, which settings it depends on, and what it gives.

In the order of the science: `draw` trajectories, `identify` f, `train` two networks, `regress` and `refine`
formulas of V, `score` and `collect` them; then the `landscape` of every run, what it is held against, and
landscapes of equations. A task imports what it needs when it runs, so that a job loads no more.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from siq.workflow.tasks import Given, task

if TYPE_CHECKING:
    from siq.quasipotential.wells import Well
    from siq.workflow.scoring import ModelFiles
    from siq.workflow.study import PipelineSettings
    from siq.workflow.training import TrainedRun


# The published method, and ours.


@task(
    "source", "files",
    options=("seed", "space", "sampling", "simulation", "identification.hidden_velocities", "card"),
)  # fmt: skip
def draw(given: Given, settings: PipelineSettings) -> Any:
    """Trajectories of a run: a simulation of the card, or recordings resampled."""
    from siq.workflow import results

    path = given.path("source")
    assert path is not None
    return results.draw_run(settings, results.source_of(path, settings), number=given.number)


@task("recordings", options=("seed", "space", "sampling", "identification", "certificate"))
def identify(given: Given, settings: PipelineSettings) -> Any:
    """The vector field f from pairs of samples, with the test of its predictions."""
    from siq.workflow import results

    return results.identify_run(settings, given.recordings, number=given.number)


@task("recordings", "field", options=("seed", "space", "sampling", "training"))
def train(given: Given, settings: PipelineSettings) -> Any:
    """The decomposition f = -D∇V + g by two networks; runs of a block train side by side."""
    import torch
    import torch._dynamo  # the first optimiser loads it: once for all runs

    from siq.workflow import training

    torch.set_num_threads(given.threads)
    pairs = zip(given.recordings, given.field, strict=True)
    runs = {
        number: training.RunToTrain(recordings, record)
        for number, (recordings, record) in enumerate(pairs, start=given.number)
    }
    folder = Path(given.outputs["networks"]).parent if given.outputs else None
    if folder is not None:
        given.afterwards.append(partial(training.clean, folder))
    return training.train_block(settings, runs, folder=folder, device=given.device)


@task("recordings", "networks", "train_outcome", options=("space", "sampling", "regression"))
def regress(given: Given, settings: PipelineSettings) -> Any:
    """Sparse formulas of V, g and f from the networks, as published."""
    import pysindy  # noqa: F401 (once for all runs: it takes seconds)

    from siq.workflow import results

    return results.regress_run(settings, given.recordings, _trained(given))


@task(
    "recordings", "field", "identify_outcome", "networks", "train_outcome", "regression",
    options=("seed", "sampling", "refinement", "certificate"),
)  # fmt: skip
def refine(given: Given, settings: PipelineSettings) -> Any:
    """V and g refined on the Hamilton–Jacobi equation, and the certificate of every formula."""
    from siq.workflow import results
    from siq.workflow.tables import Method

    regressed = {} if given.regression is None else given.regression[0]
    run = results.RunToRefine(
        given.recordings,
        results.Identified(given.field, given.identify_outcome[0]),
        _trained(given),
        regressed.get(Method.REGRESSION),
    )
    return results.refine_run(settings, run)


@task(
    "model", "networks", "train_outcome", "card",
    options=("seed", "regression", "simulation", "published_method", "card", "exact"),
)  # fmt: skip
def score(given: Given, settings: PipelineSettings) -> Any:
    """How close a run comes to exact answers, where these are known."""
    from siq.workflow import scoring
    from siq.workflow.scoring import exact_answer

    card = given.path("card")
    exact = None if card is None else exact_answer(card)
    formulas, certificates = given.model
    run = scoring.RunToScore(formulas, certificates, _trained(given), given.card, exact)
    return scoring.score_run(settings, run)


@task(
    "coefficients", "rrmse", "prediction", "certificates", "record", "record_density", "landscape", "degrees",
    "training", "outcomes", "published",
)  # fmt: skip
def collect(given: Given, settings: PipelineSettings) -> Any:
    """All runs of a study as tables."""
    from siq.workflow import scoring
    from siq.workflow.tables import read_outcomes

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
    from siq.workflow import results

    refined = given.refined  # known in memory alone
    return results.landscape_of_run(
        settings, given.recordings, given.field, wells=_wells(given.model), number=given.number,
        certificate=None if refined is None else refined.certificate,
        visits=() if refined is None or refined.record is None else refined.record.visits,
    )  # fmt: skip


@task(
    "rrmse", "model", "field", "recordings", "quasipotential",
    options=("seed", "space", "sampling", "refinement", "landscape", "every_run"),
)  # fmt: skip
def overview(given: Given, settings: PipelineSettings) -> Any:
    """The landscape that the page opens with, found for this run alone where the study asks for none."""
    from siq.workflow import scoring

    models = _models(given)
    shown = scoring.shown_formula(given.rrmse, models)
    number = shown.run if shown.run is not None else models.first_wells().run
    found = None
    if given.options["every_run"]:
        stored = given.quasipotential
        readers = [partial(stored.__getitem__, run) for run in range(len(stored))]
        chosen = scoring.choose(number, readers)
        if chosen is not None:
            found = {"run": chosen} | stored[chosen]
    elif number is not None:
        run = scoring.RunToShow(
            number, given.recordings[number], given.field[number], _wells(given.model[number])
        )
        found = scoring.overview_of_run(settings, run)
    return {"overview": found}


@task("card", options=("seed", "card"))
def reference(given: Given, settings: PipelineSettings) -> Any:
    """What methods say of the card's settings vector field that share no code with ours."""
    from siq.workflow import comparison

    return {"reference": comparison.reference_of_card(settings, given.card)}


@task(
    "reference", "field", "quasipotential", "model", "networks", "train_outcome", "published", "mesh",
    options=("seed", "space", "landscape"),
)  # fmt: skip
def landscape_errors(given: Given, settings: PipelineSettings) -> Any:
    """The landscapes of all runs against the references, networks, formulas, and what was published."""
    from siq.workflow import comparison

    runs = [
        comparison.RunToCompare(
            number,
            comparison.read_stored(given.files["field"][number], given.files["quasipotential"][number]),
            given.model[number][0],
            _trained(given, number).networks,
        )
        for number in range(len(given.model))
    ]
    published = None
    if given.published is not None:
        published = comparison.PublishedAnswers(given.published.figures, published_mesh(given))
    return {"table": comparison.run_landscape_errors(settings, given.reference, runs, published)}


@task("quasipotential", "card", options=("seed", "landscape", "card"))
def beside_equations(given: Given, settings: PipelineSettings) -> Any:
    """The landscape of the card's settings equations beside those of the runs: scoring alone."""
    from siq.workflow import comparison

    table = comparison.run_beside_equations(settings, given.card, list(given.quasipotential))
    return {"table": table}


@task("quasipotential", "card", options=("seed", "landscape", "card"))
def escapes(given: Given, settings: PipelineSettings) -> Any:
    """Simulated escapes beside the law."""
    from siq.workflow import comparison

    return {"table": comparison.run_escapes(settings, given.card, list(given.quasipotential))}


# Landscapes of equations.


@task("card", options=("seed", "refinement", "certificate", "landscape", "card"))
def equations(given: Given, settings: PipelineSettings) -> Any:
    """The landscape of equations."""
    from siq.quasipotential.landscape import LandscapeOptions
    from siq.quasipotential.landscape_assembly import EquationSettings
    from siq.workflow import results

    own = EquationSettings(
        settings.seed, settings.refinement, settings.certificate, settings.landscape or LandscapeOptions()
    )
    return results.landscape_of_equations(own, given.card)


@task("card", options=("seed", "card_but_for_swept"))
def sweep_point(given: Given, settings: PipelineSettings) -> Any:
    """The landscape at one point of a sweep, in a file of its name: another range makes new values only."""
    from siq.workflow.study import point_values
    from siq.workflow.sweep import point_at

    names, values = point_values(given.wildcards["point"])
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
    return collected(given.card, names, points, noise=next(iter(noises), None))


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


def _trained(given: Given, run: int | None = None) -> TrainedRun:
    """The networks of a run; of one of several where `run` says which."""
    from siq.workflow.training import trained_run

    if not given.networks:
        return trained_run(None, None, number=given.number if run is None else run)
    if run is None:
        return trained_run(given.networks, given.train_outcome, number=given.number)
    return trained_run(given.networks[run], given.train_outcome[run], number=run)


def _wells(model: Any) -> tuple[Well, ...]:
    """V about the attractors, as refined."""
    from siq.workflow.tables import Method

    return model[0][Method.REFINED].wells if Method.REFINED in model[0] else ()


def _models(given: Given) -> ModelFiles:
    from siq.workflow.scoring import ModelFiles

    return ModelFiles(tuple(given.files["model"]))


def published_mesh(given: Given) -> Any:
    """U on the mesh that was published, None where it is not at hand."""
    from siq.workflow.published import mesh_potential

    path, mesh = given.path("mesh"), given.published.mesh
    return None if path is None or mesh is None else mesh_potential(path, mesh)
