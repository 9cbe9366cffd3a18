"""The tasks that set a publication, and the official tests of public benchmarks, beside our results."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from workflow.task import Given, task

if TYPE_CHECKING:
    from siq.workflow.study import PipelineSettings


@task("summaries", "reports", "published", "card", "contents", "parameters", "contradictions")
def reproduction(given: Given, settings: PipelineSettings) -> Any:
    """Everything in the paper on one page, with ours beside it."""
    import yaml
    from pydantic import TypeAdapter

    from benchmarks.publication import ReproductionSettings
    from benchmarks.publication.page import Paper, Results, render_reproduction, reproduction_page
    from benchmarks.publication.publication import load_contents, load_parameters

    source = given.files
    told = TypeAdapter(dict[str, ReproductionSettings]).validate_python(given.options["studies"])
    rows = zip(given.options["names"], source["summaries"], given.published, given.card, strict=True)
    studies = {
        name: Results(name, Path(summary).parents[1], told[name], published.figures, system)
        for name, summary, published, system in rows
    }
    paper = Paper(
        load_contents(source["contents"]).places,
        load_parameters(source["parameters"]),
        yaml.safe_load(Path(source["contradictions"]).read_text(encoding="utf-8")),
    )
    content, table = reproduction_page(paper, studies, told, command="snakemake --cores 2 reproduce")
    return {"html": render_reproduction(content), "csv": table.to_csv(index=False)}


@task("file")
def benchmark_recordings(given: Given, settings: PipelineSettings) -> Any:
    """The recordings of a public benchmark, from its file as downloaded."""
    from benchmarks.publication.public_recordings import BENCHMARKS

    return {"recordings": BENCHMARKS[given.wildcards["benchmark"]].read(given.files["file"])}


@task("card", "recordings", "study", "recalibrated", "system", "noise")
def official_tests(given: Given, settings: PipelineSettings) -> Any:
    """How far simulations of a public benchmark are off in its official tests, in its own units."""
    from benchmarks.publication.official_scores import official_tables
    from benchmarks.publication.public_recordings import BENCHMARKS
    from siq.diagnosis.study import read_case

    case = read_case(given.files["card"], given.files["recordings"], given.path("study"))
    noise = given.noise
    own = noise[(noise["stage"] == "recalibrated") & (noise["kind"] == "measurement")]
    errors, runs = official_tables(
        BENCHMARKS[given.options["benchmark"]],
        {"recalibrated": given.recalibrated, "augmented": given.system},
        case.kept,
        variance=own["variance"].to_numpy(float),
    )
    return {"table": errors, "runs": runs}


@task("tables", "runs", "verdict", "system")
def official_summary(given: Given, settings: PipelineSettings) -> Any:
    """The official tests of all benchmarks: one table, and a figure of each."""
    import pandas as pd

    from benchmarks.publication.official_tests import official_page, official_rows
    from benchmarks.publication.plots import plot_official_tests
    from benchmarks.publication.public_recordings import BENCHMARKS

    names, drawn = given.options["benchmarks"], {}
    for name, runs, system in zip(names, given.runs, given.system, strict=True):
        unit = BENCHMARKS[name].unit if BENCHMARKS[name].factor == 1 else system.units[0]
        drawn[name] = plot_official_tests(runs, unit=unit, time_unit=system.time_unit)
    rows = [official_rows(name, table) for name, table in zip(names, given.tables, strict=True)]
    table = pd.concat(rows, ignore_index=True)
    verdicts = dict(zip(names, given.verdict, strict=True))
    return {"table": table, "page": official_page(table, verdicts), "figures": drawn}
