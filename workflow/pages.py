"""The tasks that draw and write what people read of a study; the drawing itself is `siq.report`."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from siq.workflow.answers import Provenance
from workflow.steps import model_files, published_mesh, trained_run
from workflow.task import Given, task

if TYPE_CHECKING:
    import pandas as pd

    from siq.quasipotential.landscape import Landscape
    from siq.workflow.study import PipelineSettings, Study

PACKAGES = ("numpy", "snakemake")
OF_NETWORKS = ("torch", "pysindy")


def _versions(*programs: str) -> dict[str, str]:
    import siq

    return {"siq": siq.__version__} | {name: version(name) for name in programs}


def _files(folders: Iterable[str], suffix: str) -> dict[str, bytes]:
    """Drawn figures by name."""
    found = [path for folder in folders for path in sorted(Path(folder).glob(f"*{suffix}"))]
    return {path.stem: path.read_bytes() for path in found}


def _first_stored(given: Given) -> tuple[int, Landscape] | None:
    """The first run with a U over all wells."""
    from workflow.comparison import first_stored

    landscapes = given.files.get("quasipotential") or ()
    return first_stored(given.files["field"][: len(landscapes)], landscapes)


def _study(given: Given) -> Study:
    from siq.workflow.study import Study

    return Study.model_validate(given.options["study"])


def _tables(given: Given) -> dict[str, pd.DataFrame]:
    """Every table of the contract that there is."""
    from siq.workflow.tables import COLUMNS

    return {name: getattr(given, name) for name in COLUMNS if given.path(name) is not None}


def _published(given: Given) -> Any:
    return {} if given.published is None else given.published.figures


@task(
    "coefficients", "rrmse", "training", "prediction", "record", "record_density", "model", "recordings",
    "networks", "train_outcome", "field", "quasipotential", "overview", "card", "published",
    options=("seed", "space", "sampling", "simulation", "regression", "card", "exact"),
)  # fmt: skip
def figures(given: Given, settings: PipelineSettings) -> Any:
    """The figures of a study."""
    from dataclasses import replace

    from siq.quasipotential.landscape_files import read_landscape
    from siq.report.page import inspection_drawn, interactive_view
    from siq.report.summary import summarise
    from siq.workflow.tables import Method
    from workflow.figures import study as report
    from workflow.files import read_states
    from workflow.scoring import exact_answer

    source, models = given.files, model_files(given)
    tables = {name: getattr(given, name) for name in report.DRAWN_TABLES}
    chosen = models.representative(tables["rrmse"])
    of_landscape = chosen[0] is None or chosen[1] == Method.REGRESSION
    shown = report.representative_run(chosen, models, _first_stored(given) if of_landscape else None)
    run, card = shown.number, given.path("card")
    shown = replace(
        shown,
        recordings=read_states(source["recordings"][run], source["field"][run]),
        networks=trained_run(given, run).result,
        exact=None if card is None else exact_answer(card),
    )
    drawn: dict[str, Any] = dict(report.study_figures(settings, tables, shown, given.card, _published(given)))
    overview = given.overview
    first = run if overview is None else overview["run"]
    record, recorded = given.field[first], given.recordings[first]
    folder = Path(given.outputs["drawn"])
    if record is not None and recorded is not None:
        dynamics = record.dynamics
        stored = read_landscape(source["overview"], dynamics=dynamics)
        states = read_states(source["recordings"][first], source["field"][first]) or recorded
        refined = models.formulas(first).get(Method.REFINED)
        summary = summarise(stored, states, dynamics=dynamics, formula=refined)
        drawn |= report.leading_figures(summary, dynamics, states)
        drawn["interactive.html"] = interactive_view(summary, solid=dynamics.dimension > 2)
    if settings.simulation is None and recorded is not None:
        folder.mkdir(parents=True, exist_ok=True)
        drawn |= inspection_drawn(recorded, folder=folder, angles=settings.identification.angles)
    return {"drawn": drawn}


@task(
    "reference", "escape", "degrees", "field", "quasipotential", "model", "recordings", "networks",
    "train_outcome", "published", "mesh",
    options=("space", "landscape"),
)  # fmt: skip
def landscape_figures(given: Given, settings: PipelineSettings) -> Any:
    """The figures of a landscape."""
    import pandas as pd

    from workflow.figures import study as report

    found, formulas, networks = _first_stored(given), None, None
    if found is not None:
        formulas, networks = given.model[found[0]][0], trained_run(given, found[0]).result
    drawn = report.landscape_figures(
        settings.space,
        compare_below=None if settings.landscape is None else settings.landscape.compare_below,
        degrees=given.degrees,
        escape=pd.DataFrame() if given.escape is None else given.escape,
        landscape=None if found is None else found[1],
        reference=given.reference,
        networks=networks,
        formulas=formulas,
        published=None if given.published is None else given.published.figures,
        mesh=None if given.published is None else published_mesh(given),
    )
    return {"drawn": drawn}


@task(
    "rrmse", "model", "field", "quasipotential", "card", "published",
    options=("seed", "space", "invariant", "card"),
)  # fmt: skip
def invariant(given: Given, settings: PipelineSettings) -> Any:
    """The invariant distribution of the formula that is shown, or of the landscape where none holds."""
    from siq.workflow.tables import as_table
    from workflow.comparison import compare_invariant
    from workflow.figures.density import plot_invariant_distribution

    table, shares, drawn = as_table("invariant", []), as_table("well_shares", []), {}
    found = _density_source(given) if settings.invariant and given.card is not None else None
    if found is not None:
        run, method, source = found
        table, shares, densities = compare_invariant(
            settings, given.card, source, _published(given), run=run, method=method
        )
        names = settings.space.names or ()
        units = [settings.space.unit(name) for name in names]
        if densities:
            drawn["invariant"] = plot_invariant_distribution(densities, states=names, units=units)
    return {"table": table, "shares": shares, "drawn": drawn}


def _density_source(given: Given) -> tuple[int, str, Any] | None:
    """Run, method and formulas that the density follows from; equations have one landscape, and nothing else.

    That is a refined formula where one holds over the whole region, otherwise the landscape where there is
    one, otherwise the published method's formula.
    """
    from siq.quasipotential.landscape_files import read_landscape
    from siq.workflow.tables import Method

    if not given.path("model"):
        stored = read_landscape(given.files["quasipotential"], dynamics=given.card)
        return None if stored is None else (0, "local formulas", stored)
    models = model_files(given)
    run, method = models.representative(given.rrmse)
    if run is None or method == Method.REGRESSION:
        complete = _first_stored(given)
        if complete is not None:
            return complete[0], "local formulas", complete[1]
    return None if run is None else (run, method, models.formulas(run)[method])


@task(
    "summary", "rrmse", "certificates", "coefficients", "outcomes", "record", "timings", "model", "invariant",
    "well_shares", "overview", "field", "drawn", "drawn_landscape", "drawn_density", "landscape",
    "landscape_errors", "escape", "beside_equations", "card", "published",
    options=("study", "command", "card", "exact"),
)  # fmt: skip
def page(given: Given, settings: PipelineSettings) -> Any:
    """The page of a study of trajectories."""
    from markupsafe import Markup

    from siq.quasipotential.landscape_files import landscape_from_data
    from siq.report.page import read_inspection, render_report
    from siq.report.study_page import StudyResults, answer_data, study_page
    from siq.report.summary import summarise
    from workflow.scoring import exact_answer

    source, study = given.files, _study(given)
    tables, models, card = _tables(given), model_files(given), given.path("card")
    shown = models.representative(tables["rrmse"])
    shown = shown if shown[0] is not None else models.first_wells()
    overview = given.overview
    run = shown[0] if shown[0] is not None else (overview or {}).get("run", 0)
    landscape = None
    if overview is not None:
        number = overview["run"]
        stored = landscape_from_data(overview, given.field[number].dynamics)
        landscape = summarise(stored, record=tables["record"], run=number)
    view = Path(source["drawn"]) / "interactive.html"
    lines, seen = read_inspection(source["drawn"])
    folders = [source[name] for name in ("drawn", "drawn_landscape", "drawn_density") if given.path(name)]
    images, vectors = _files(folders, ".png"), _files(folders, ".svg")
    results = StudyResults(
        tables,
        Path(source["summary"]).parent,
        landscape=landscape,
        models=models,
        shown=shown,
        exact=None if card is None else exact_answer(card),
        images=images,
        vectors=vectors,
        record=given.field[run],
        inspection=lines,
        seen=seen,
        interactive=Markup(view.read_text(encoding="utf-8")) if view.is_file() else None,
    )
    programs = PACKAGES if study.training is None else (*PACKAGES, *OF_NETWORKS)
    versions, origin = _versions(*programs), Provenance(Path(given.outputs["html"]).parent).origin()
    command = given.options["command"]
    content = study_page(study, results, command=command, versions=versions, origin=origin)
    gathered = {f"{name}.png": one for name, one in images.items()}
    gathered |= {f"{name}.svg": one for name, one in vectors.items()}
    answer = answer_data(content, study, results)
    return {"html": render_report(content), "answer": answer, "figures": gathered}


@task(
    "card", "quasipotential", "landscape", "degrees", "certificates", "outcomes", "sweep", "branches",
    "bifurcations", "bifurcation_curves", "invariant", "well_shares", "density",
    options=("study", "command", "card"),
)  # fmt: skip
def equations_page(given: Given, settings: PipelineSettings) -> Any:
    """The figures and the page of a study of equations."""
    import numpy as np

    from siq.quasipotential.landscape_files import read_landscape
    from siq.report.page import interactive_view, render_report
    from siq.report.plots.style import save_figure
    from siq.report.study_page import StudyResults, answer_data, study_page
    from siq.report.summary import summarise
    from workflow.figures.study import equations_figures

    study, system, tables = _study(given), given.card, _tables(given)
    stored = read_landscape(given.files["quasipotential"], dynamics=system)
    summary = None if stored is None else summarise(stored, np.zeros((0, system.dimension)))
    certificate = None if stored is None else stored.certificate
    folder = Path(given.outputs["figures"])
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in equations_figures(system, summary, tables, study).items():
        if figure is not None:
            save_figure(figure, folder / name)
    density = given.path("density")
    gathered = {} if density is None else {path.name: path.read_bytes() for path in Path(density).iterdir()}
    folders = [str(folder), *([] if density is None else [density])]
    results = StudyResults(
        tables,
        Path(given.files["landscape"]).parent,
        landscape=summary,
        system=system,
        certificate=None if certificate is None else certificate.as_data(),
        images=_files(folders, ".png"),
        vectors=_files(folders, ".svg"),
        interactive=None if summary is None else interactive_view(summary, solid=system.dimension > 2),
    )
    command, versions = given.options["command"], _versions(*PACKAGES)
    origin = Provenance(Path(given.outputs["html"]).parent).origin()
    content = study_page(study, results, command=command, versions=versions, origin=origin)
    answer = answer_data(content, study, results)
    return {"html": render_report(content), "answer": answer, "figures": gathered}
