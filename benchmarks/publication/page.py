"""Every table, figure and number of the paper, in its order, with ours and the difference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.publication import ReproductionSettings
from benchmarks.publication.publication import (
    HEADINGS,
    REPRODUCED_METHODS,
    Parameters,
    Place,
    attractor_rows,
    gradient_coefficients,
    numbers,
    own_equations,
    parameter_table,
    published_decomposition,
    shown,
)
from siq.inference.field_estimate import read_field
from siq.networks.regression import points_below
from siq.numerics.randomness import Purpose, generator
from siq.numerics.text import number_text
from siq.report.formatting import texts
from siq.report.landscape import in_words
from siq.report.page import ReportFigure, ReportSection, ReportTable, render_report
from siq.report.study_page import errors_over_runs
from siq.systems.dynamics import Dynamics
from siq.workflow.tables import Method, ModelFiles, as_table
from workflow.files import read_table
from workflow.published import PublishedFigure
from workflow.scoring import summary_row, summary_table

POINTS = 20_000  # of the domain, on which published formulas are held against their own equations
SHOWN = 60  # rows of a table
EXPLAINED = {
    "ours": "mean and standard deviation over the runs, of formulas that solve the Hamilton–Jacobi equation",
    "regression": "the same by the published method, from our short training",
}


@dataclass(frozen=True)
class ReproductionContent:
    """All that the page of a reproduction says.

    Attributes
    ----------
    title, introduction
        Title, and paragraphs below it.
    overview
        Tables over everything.
    contradictions
        Sentences.
    sections
        The places of the publication, in its order, each with its numbers and ours, and our figures.
    commands
        Command lines that make everything again.
    language
        Language of the page, for hyphenation and screen readers.
    """

    title: str
    introduction: Sequence[str] = ()
    overview: Sequence[ReportTable] = ()
    contradictions: Sequence[str] = ()
    sections: Sequence[ReportSection] = ()
    commands: Sequence[str] = ()
    language: str = "en"


def render_reproduction(content: ReproductionContent) -> str:
    """Render a reproduction as one HTML page; all text is escaped."""
    return render_report(content, template="page.html.j2", folder=Path(__file__).parent)


@dataclass(frozen=True)
class Results:
    """What a study left behind, with what was published of it."""

    name: str
    folder: Path
    settings: ReproductionSettings
    figures: Mapping[str, PublishedFigure]
    system: Dynamics

    def table(self, name: str) -> pd.DataFrame:
        """One of its tables."""
        return read_table(self.folder / "tables" / f"{name}.parquet")

    @cached_property
    def models(self) -> ModelFiles:
        """Formulas of every run."""
        return ModelFiles(tuple(str(path) for path in sorted(self.folder.glob("runs/*/model.json"))))

    @cached_property
    def summary(self) -> pd.DataFrame:
        """Every figure over the runs, those included that the study's own summary leaves out."""
        gradient = gradient_coefficients(self.table("coefficients"), self.system.states)
        further = summary_table(gradient, self.table("rrmse"), as_table("prediction", []), self.figures)
        further = further[further["quantity"].str.startswith("dV_")]
        records = map(read_field, sorted(self.folder.glob("runs/*/vector_field.json")))
        fields = [record.dynamics for record in records if record is not None]
        rows = [*attractor_rows(self.figures, fields, self.system), *self._counts(), *self._constants()]
        return pd.concat([self.table("summary"), further, as_table("summary", rows)], ignore_index=True)

    def _counts(self) -> list[dict[str, object]]:
        simulation = self.settings.simulation
        assert simulation is not None  # what is reproduced is simulated
        states = 2.0 * simulation.trajectories * simulation.pairs
        hours = self.table("timings")["seconds"].sum() / 3600
        return [
            summary_row(str(Method.REFINED), name, pd.Series([value]), self.figures)
            for name, value in (("data_points", states), ("processor_hours", hours))
        ]

    def _constants(self) -> list[dict[str, object]]:
        invariant = self.table("invariant")
        return [
            summary_row(row["method"], f"Z:{row['intensity']:g}", pd.Series([row["bessel"]]), self.figures)
            for _, row in invariant.iterrows()
        ]


def _equations_table(study: Results) -> ReportTable | None:
    """The published formulas, and ours of one run, against what they should fulfil."""
    published = published_decomposition(study.figures, study.system.symbols, study.system.diffusion)
    if published is None:
        return None
    low, high = study.system.box.T
    x = generator(0, Purpose.EQUATIONS).uniform(low, high, (POINTS, study.system.dimension))
    potential = published.evaluate(np.ascontiguousarray(x.T))[0]
    x = x[points_below(potential, level=study.settings.regression.level)]
    exact = study.system.drift(x)
    found = {"published": own_equations(published, x, exact)}
    run = study.models.representative(study.table("rrmse"))[0] or 0
    for method, one in study.models.formulas(run).items():
        if one.potential is not None:
            found[f"{method}, run {run}"] = own_equations(one, x, exact)
    frame = pd.DataFrame([{"formulas": name} | values for name, values in found.items()])
    return ReportTable(
        f"The formulas against their own equations, where the published V lies below the level of the"
        f" regression: {len(x)} points.",
        frame.rename(columns={"vector_field": "vector field"}),
        {
            "orthogonality": "rms of ∇V·g over the rms of ∣∇V∣∣g∣",
            "vector field": "rms of −D∇V + g − f over the rms of f, the exact one",
        },
    )


def _timing_table(studies: Mapping[str, Results]) -> ReportTable:
    """Processor time of every study, in hours."""
    columns: dict[str, pd.Series] = {}
    for name, study in studies.items():
        seconds = study.table("timings")
        hours = seconds.groupby("step", sort=False)["seconds"].sum() / 3600
        runs = seconds["run"].nunique()
        columns[f"{name}, {runs} runs"] = pd.concat(
            [pd.Series({"all": hours.sum(), "one run": hours.sum() / runs}), hours]
        )
    order = list(dict.fromkeys(step for column in columns.values() for step in column.index))
    table = pd.DataFrame(columns).reindex(order).rename_axis("hours").reset_index()
    return ReportTable("Processor time as measured, in hours, by study and step.", table)


class _Page:
    """What stands beside each place of the paper."""

    def __init__(self, studies: Mapping[str, Results], parameters: pd.DataFrame) -> None:
        self.studies = studies
        self.parameters = parameters

    def further_table(self, name: str, study: Results | None) -> list[ReportTable]:
        """One of the tables that a place asks for beside its numbers."""
        if name == "parameters":
            return [ReportTable("Parameters as stated, and those of our studies.", self.parameters)]
        if name == "timings":
            return [_timing_table(self.studies)]
        assert study is not None  # the schema's other tables are of a study; see the test of the contents
        folder, words = study.folder / "tables", texts("help")
        if name == "own_equations":
            return [one for one in [_equations_table(study)] if one is not None]
        if name in ("invariant", "well_shares"):
            shown_here = in_words(study.table(name).rename(columns=words["headings"]))
            kind = "invariant" if name == "invariant" else "shares"
            table = ReportTable(words[f"{kind}_caption"], shown_here, words[kind], f"{folder}/{name}.csv")
            return [table] if len(shown_here) else []
        if name == "landscape_errors":
            errors = errors_over_runs(study.table(name))
            return [ReportTable(words["errors_caption"], errors, words["errors"], f"{folder}/{name}.csv", 40)]
        if name == "escape":
            caption = "Mean escape times: the law from what was identified, and direct simulations."
            return [ReportTable(caption, in_words(study.table("escape")), {}, f"{folder}/escape.csv")]
        landscape = study.table("landscape")
        wanted = (landscape["kind"] == "transition") == (name == "transitions")
        first = landscape[wanted & (landscape["run"] == landscape["run"].min())]
        caption = f"{name.capitalize()} of run {landscape['run'].min()}."
        shown_here = in_words(first.drop(columns=["run", "kind"] if name == "transitions" else "run"))
        return [ReportTable(caption, shown_here, {}, f"{folder}/landscape.csv")]

    def section(self, place: Place, table: pd.DataFrame) -> ReportSection:
        """A place of the paper with ours beside it."""
        study = self.studies[place.study] if place.study is not None else None
        text = [f"In the paper: {place.says}", *([place.remark] if place.remark else [])]
        tables = []
        if len(table):
            runs = study.settings.runs if study is not None else 0
            caption = (
                f"Published ({'; '.join(table['source'].unique())}), and ours ({place.study}, {runs} runs)."
            )
            tables.append(ReportTable(caption, shown(table), EXPLAINED, "", SHOWN))
        for name in place.tables:
            tables += self.further_table(name, study)
        figures = []
        for picture in place.figures:
            assert study is not None  # as for tables
            file = study.folder / "figures" / f"{picture}.png"
            if not file.is_file():
                continue
            image = file.read_bytes()
            caption = f"Ours, study {place.study}: {picture.replace('_', ' ')}."
            figures.append(ReportFigure(caption, f"{caption} {place.says}", image, "png"))
        return ReportSection(place.place, text, tables=tables, figures=figures)


def _overview(places: Sequence[Place], tables: Sequence[pd.DataFrame]) -> ReportTable:
    """Every place, with the largest deviation of its numbers from ours."""
    rows = []
    for place, table in zip(places, tables, strict=True):
        names = dict.fromkeys(name.replace("_", " ") for name in (*place.figures, *place.tables))
        row: dict[str, object] = {
            "in the paper": place.place, "study": place.study or "", "shown beside": ", ".join(names),
            "numbers": len(table),
        }  # fmt: skip
        for method, heading in zip(REPRODUCED_METHODS, HEADINGS, strict=True):
            row[heading] = np.nan
            if f"{method} − published" in table:
                away = table[f"{method} − published"].abs() / table["published"].abs().replace(0, np.nan)
                row[heading] = away.max()
        rows.append(row)
    return ReportTable(
        "Everything that the paper has, and what stands beside it below.",
        pd.DataFrame(rows),
        {
            "numbers": "of the paper; all are in reproduction.csv",
            "ours": "largest relative difference of these numbers from ours; exact answers tell whose it is",
            "regression": "the same by the published method, from our short training",
        },
        rows_shown=SHOWN,
    )


def _certified(study: Results) -> str:
    """How many runs are certified, and how far from the truth they are."""
    rrmse = study.table("rrmse")
    mine = rrmse[rrmse["method"] == Method.REFINED]
    said = f"{study.name}: {int(mine['certified'].sum())} of {len(mine)} runs are certified"
    errors = mine["rrmse"].dropna()
    if len(errors):
        mean, worst = (number_text(value, decimals=1) for value in (errors.mean(), errors.max()))
        said += f"; relative error of the coefficients of U {mean} in the mean and {worst} at worst"
    return said + "."


@dataclass(frozen=True)
class Paper:
    """What the paper has: its places, its parameters, and where it contradicts itself."""

    places: Sequence[Place]
    parameters: Parameters
    contradictions: Any


def reproduction_page(
    paper: Paper,
    studies: Mapping[str, Results],
    settings: Mapping[str, ReproductionSettings],
    *,
    command: str,
) -> tuple[ReproductionContent, pd.DataFrame]:
    """The page, and its numbers as one table.

    Parameters
    ----------
    paper
        What is to be reproduced.
    studies
        The studies that reproduce it.
    settings
        Of these and of the paper's own, by study.
    command
        How to make the page again.
    """
    with_card = {name: one for name, one in settings.items() if one.domain is not None}
    page = _Page(studies, parameter_table(paper.parameters, with_card))
    tables = [
        numbers(studies[one.study].summary, one.quantities) if one.study is not None else pd.DataFrame()
        for one in paper.places
    ]
    every = [
        table.assign(place=one.place, study=one.study)
        for one, table in zip(paper.places, tables, strict=True)
        if len(table)
    ]
    content = ReproductionContent(
        title="Everything in the paper, and ours beside it",
        introduction=[
            "Bo Lin and Pierpaolo Belardinelli, Sparse identification of quasipotentials via a combined"
            " data-driven method: every table, figure and number, in the paper's order and numbered as in its"
            " LaTeX source, with ours and the difference. What was published is scored; no method reads it.",
            *(_certified(study) for study in studies.values()),
        ],
        overview=[_overview(paper.places, tables)],
        contradictions=paper.contradictions,
        sections=[page.section(one, table) for one, table in zip(paper.places, tables, strict=True)],
        commands=[command],
    )
    return content, pd.concat(every, ignore_index=True)
