"""From which recordings was it worked out, by which steps, and with what?"""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from typing import Any

import yaml

from siq.report.page import ReportSection, ReportTable
from siq.report.study_captions import Part
from siq.report.study_results import ShownStudy
from siq.study.study import Study


def workings_section(page: ShownStudy) -> ReportSection:
    """The recordings, and what became of each step."""
    outcomes = page.results.tables["outcomes"]
    steps = outcomes.drop(columns="run") if page.study.runs == 1 else outcomes
    caption = "What became of each step" + (" of each run." if page.study.runs > 1 else ".")
    return ReportSection(
        "The recordings and the workings", [_source(page), _method_said(page)],
        tables=[ReportTable(caption, steps, {}, f"{page.results.folder}/outcomes.csv", 12)],
        figures=page.figures(Part.WORKINGS), folded=True,
    )  # fmt: skip


def _source(page: ShownStudy) -> str:
    recordings = page.study.recordings
    if recordings is not None:
        return f"The recordings are those in {recordings.file}."
    return f"The recordings are simulated trajectories of the system {page.study.system}."


def _method_said(page: ShownStudy) -> str:
    routes = page.study.refinement.with_routes(networks=page.study.training is not None).routes or ()
    if page.results.record is None:
        return "No f was identified, so that there is no formula."
    return (
        f"f was identified {_identified_by(page)}. The formulas solve the Hamilton–Jacobi"
        " equation of this"
        f" f, by the {' and the '.join(routes)} route, and have to pass the tests of the certificate."
    )


def _identified_by(page: ShownStudy) -> str:
    record = page.results.record
    if record is not None and record.memory is not None:
        return f"from pairs of samples, as seen from {record.memory[0]} steps earlier"
    if record is not None and record.sensor_variance is not None:
        return "by the likelihood of whole recordings, with the noise of the sensor beside it"
    return "from neighbouring samples alone"


def provenance_section(page: ShownStudy, versions: Mapping[str, str]) -> ReportSection:
    """The study as it was asked, with what, and how long."""
    timings = page.results.tables["timings"]
    total = timings.groupby("step")["seconds"].sum()
    spent = ", ".join(f"{step} {seconds:.0f} s" for step, seconds in total.items())
    named = ", ".join(f"{name} {version}" for name, version in versions.items())
    machine = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    text = [f"{named}; {machine}, {os.cpu_count()} cores.", f"Processor time by step: {spent}."]
    printed = yaml.safe_dump(_printed(page.study), sort_keys=False, allow_unicode=True)
    return ReportSection("The study and the versions", text, listing=printed, folded=True)


def _printed(study: Study) -> dict[str, Any]:
    """The study as plain data; of recordings nothing is simulated."""
    data = study.model_dump(mode="json", by_alias=True)
    return data if study.recordings is None else data | {"simulation": None}
