"""The report of a study: one page that needs nothing else."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from siq.potential.symbolic import SymbolicDecomposition
from siq.report.formatting import formula_mathml, vector_mathml
from siq.report.invariant_tables import invariant_tables
from siq.report.landscape_tables import landscape_figures, landscape_sentences, landscape_tables
from siq.report.page import FormulaRow, ReportContent, ReportFigure, ReportTable
from siq.report.sentences import answer_sentences, control_sentences
from siq.steps.outcomes import METHODS, Method, Status
from siq.steps.shown import ModelFiles, Shown
from siq.study.study import Study

CAPTIONS = {
    "dataset": "Trajectories, all recorded states, and those below the level of the regression, by the"
    " networks of the run shown above (the paper: fig2a; fig1_noisy a).",
    "components": "Trajectories, downhill component −∇V, circulatory component g, exact and identified U of"
    " the run shown above, projected on the first two states (the paper: Fig. 1).",
    "coefficients_refined": "Refined: coefficients of U over the runs, one panel for each term that belongs"
    " there; the last panel shows the terms that do not (the paper: Fig. 2).",
    "coefficients_regression": "The same by the published regression, from the networks as they are.",
    "error_distribution": "Relative root mean square error of the coefficients of U, one dot a run"
    " (the paper: Fig. 3).",
    "inclusion_refined": "Refined: how often each term was found, by component.",
    "inclusion_regression": "The same by the published regression.",
    "prediction": "Long-term prediction of unseen trajectories, and its errors (the paper: Fig. 4a).",
    "invariant": "Invariant distribution from the refined U, or from U over all wells where no single formula"
    " holds, and a long simulation (the paper: fig1b and fig2c, b to d).",
    "training": "Loss on held-out recordings during training, one line a run.",
}
OF_NETWORKS = ("coefficients_regression", "inclusion_regression", "training")
"""Figures that say nothing where no networks were asked for."""

SUMMARY_COLUMNS = (
    "method",
    "quantity",
    "exact",
    "mean",
    "standard_deviation",
    "median",
    "inclusion_frequency",
    "published",
    "published_standard_deviation",
    "runs",
)
SUMMARY_HELP = {
    "quantity": "component:term for coefficients; those of V = U/2 and of f are in the file",
    "inclusion frequency": "share of runs in which the term was found",
    "runs": "runs that have a value",
    "published": "the published figure, with its source",
}


@dataclass(frozen=True)
class StudyResults:
    """What a study left behind.

    Attributes
    ----------
    tables
        By name, see `siq.study.tables.COLUMNS`; `landscape_errors` and `escape` with a card only.
    folder
        Where the whole tables are.
    models
        The formulas of all runs.
    shown
        The run whose formulas are printed.
    exact
        The exact ones, where they are known.
    images
        The figures by name, as PNG.
    """

    tables: Mapping[str, pd.DataFrame]
    folder: Path
    models: ModelFiles
    shown: Shown
    exact: SymbolicDecomposition | None
    images: Mapping[str, bytes]


def study_page(
    study: Study, results: StudyResults, *, command: str, versions: Mapping[str, str]
) -> ReportContent:
    """All that the report of a study says.

    Parameters
    ----------
    study
        What was asked.
    results
        What came of it.
    command
        How to make the report again.
    versions
        Of the programs that took part, by name.
    """
    tables, folder, shown = results.tables, results.folder, results.shown
    rrmse, outcomes, certificates = tables["rrmse"], tables["outcomes"], tables["certificates"]
    troubled = outcomes[outcomes["status"].isin([Status.FAILED, Status.WARNING])]
    failures = pd.concat([troubled, _refusals(rrmse, certificates)])[["run", "step", "status", "reason"]]
    return ReportContent(
        title=study.title or study.name,
        question=_question(study),
        answer=_answer(study, results),
        formulas=_formulas(results),
        tables=[
            ReportTable(
                "Every figure over the runs, beside the exact and the published one.",
                _summary_shown(tables["summary"]),
                SUMMARY_HELP,
                f"{folder}/summary.csv",
                rows_shown=60,
            ),
            *_certificate_tables(certificates, tables["coefficients"], shown.run, shown.method, folder),
            *landscape_tables(
                tables["landscape"], tables.get("landscape_errors"), tables.get("escape"), folder
            ),
            *invariant_tables(tables["invariant"], tables["well_shares"], folder),
            ReportTable("Errors by run.", rrmse, {}, f"{folder}/rrmse.csv", rows_shown=50),
            ReportTable("What became of each step of each run.", outcomes, {}, f"{folder}/outcomes.csv", 12),
        ],
        figures=[
            *(
                ReportFigure(caption, caption, results.images[name], "png")
                for name, caption in CAPTIONS.items()
                if study.training is not None or name not in OF_NETWORKS
            ),
            *landscape_figures(results.images),
        ],
        failures=failures.sort_values(["run", "step"]),
        commands=[
            command,
            "# change one parameter of the study and run it again: only what depends on it is made again",
        ],
        study=yaml.safe_dump(_printed(study), sort_keys=False, allow_unicode=True),
        provenance=_provenance(tables["timings"], versions),
    )


def _answer(study: Study, results: StudyResults) -> list[str]:
    """The answer in sentences, and which run is shown."""
    rrmse, shown = results.tables["rrmse"], results.shown
    said = answer_sentences(
        rrmse, results.tables["outcomes"], results.tables["summary"], runs=study.runs, method=shown.method
    )
    said += landscape_sentences(results.tables["landscape"], results.tables["outcomes"])
    if shown.run is not None:
        which = ", the median of the runs by error" if rrmse["rrmse"].notna().any() else ""
        said.append(f"The formulas below are those of run {shown.run}{which}.")
    return said + _remarks(results.tables["outcomes"])


def _remarks(outcomes: pd.DataFrame) -> list[str]:
    """What steps that went well have to say, each once: where D is from, if nobody gave it."""
    texts = outcomes[outcomes["status"] == Status.OK]["reason"].dropna()
    return [f"{text[0].upper()}{text[1:]}." for text in dict.fromkeys(texts) if text]


def _formulas(results: StudyResults) -> list[FormulaRow]:
    """The formulas of the run that is shown, ours first."""
    if results.shown.run is None:
        return []
    formulas = results.models.formulas(results.shown.run)
    certificates = results.models.certificates(results.shown.run)
    return [
        row
        for method in reversed(METHODS)
        if method in formulas
        for row in _formula_rows(method, formulas[method], results.exact, certificates[method])
    ]


def _printed(study: Study) -> dict[str, Any]:
    """The study as plain data; of recordings nothing is simulated."""
    data = study.model_dump(mode="json")
    return data if study.recordings is None else data | {"simulation": None}


def _summary_shown(summary: pd.DataFrame) -> pd.DataFrame:
    """Errors, U and g; the headings in words, so that they wrap."""
    shown = summary[~summary["quantity"].str.match("V:|f_")]
    columns = [name for name in SUMMARY_COLUMNS if shown[name].notna().any()]
    return shown[columns].rename(columns=lambda name: name.replace("_", " "))


def _formula_rows(
    method: str,
    identified: SymbolicDecomposition,
    exact: SymbolicDecomposition | None,
    certificate: dict[str, Any],
) -> list[FormulaRow]:
    """U, ∇V, g and f, exact and identified; U of each well where no single formula holds."""

    def typeset(one: SymbolicDecomposition | None) -> dict[str, Any]:
        if one is None:
            return {}
        if one.potential is None:
            wells = {
                f"U about {_place(well.attractor)}, up to {2 * well.level:.4g}": formula_mathml(
                    2 * well.expression
                )
                for well in one.wells
            }
            return wells | {"f": vector_mathml(one.vector_field)}
        return {
            "U": formula_mathml(one.quasipotential),
            "∇V": vector_mathml(one.gradient),
            "g": vector_mathml(one.circulatory),
            "f": vector_mathml(one.vector_field),
        }

    truths = typeset(exact)
    return [
        FormulaRow(
            quantity=name,
            method=method,
            identified=formula,
            exact=truths.get(name),
            certified=certificate["certified"],
            reason=_certificate_sentence(certificate),
        )
        for name, formula in typeset(identified).items()
    ]


def _place(position: Iterable[float]) -> str:
    """A point as text."""
    return "(" + ", ".join(f"{value:.4g}" for value in position) + ")"


def _certificate_sentence(certificate: dict[str, Any]) -> str:
    """What a certificate says, in words."""
    said = [certificate["reason"]] if certificate["reason"] else []
    if certificate["certified"]:
        said.append(f"all tests passed; stated relative error of V {certificate['stated_error']:.1e}")
    return "; ".join([*said, *certificate.get("notes", [])])


def _question(study: Study) -> list[str]:
    """What was asked, in words."""
    source = (
        f"the recordings in {study.recordings.file}"
        if study.recordings is not None
        else f"simulated trajectories of the system {study.system}"
    )
    refinement = study.refinement.with_routes(networks=study.training is not None)
    return [
        f"From {source} alone: which orthogonal decomposition f = −D∇V + g, with ∇V·g = 0, and which"
        " formula of the quasipotential U = 2V lie behind them, and how much does the answer vary over"
        f" {study.runs} independent run{'s' if study.runs > 1 else ''}?",
        f"Each run identified f from the pairs alone{_networks(study)} “Refined” are the formulas that solve"
        f" the Hamilton–Jacobi equation of f, by the {' and the '.join(refinement.routes or ())} route, and"
        f" that have to pass a certificate.",
    ]


def _networks(study: Study) -> str:
    """What was asked of networks, in words that follow what was asked of the identification."""
    training, regression = study.training, study.regression
    if training is None:
        return "; no networks were asked for."
    return (
        f", and trained two tanh networks for at most {training.steps} steps on batches of"
        f" {training.batch_size}. The published method, “regression”, seeks formulas of the networks, of"
        f" degree {regression.degree} at most, dropping terms below {regression.threshold} (acting on the"
        f" {regression.threshold_on})."
    )


def _refusals(rrmse: pd.DataFrame, certificates: pd.DataFrame) -> pd.DataFrame:
    """Every refined formula that is not certified, with the tests that refused it."""
    refused = certificates[(certificates["method"] == Method.REFINED) & ~certificates["passed"]]
    reasons = refused.groupby("run")["reason"].agg(lambda texts: "; ".join(dict.fromkeys(texts)))
    rows = rrmse[(rrmse["method"] == Method.REFINED) & ~rrmse["certified"]]
    return pd.DataFrame(
        {
            "run": rows["run"],
            "step": "certify",
            "status": "not certified",
            "reason": rows["run"].map(reasons).fillna("there is no refined formula"),
        }
    )


def _certificate_tables(
    certificates: pd.DataFrame, coefficients: pd.DataFrame, run: int | None, method: Method, folder: Path
) -> list[ReportTable]:
    """How often each test passed, and for the run shown its figures and its standard errors."""
    if run is None:
        return []
    counted = certificates.groupby(["method", "test"], sort=False).agg(
        passed=("passed", "sum"), runs=("passed", "size"), median=("value", "median"), worst=("value", "max")
    )
    mine = certificates[certificates["run"] == run].drop(columns="run")
    chosen = coefficients[
        (coefficients["run"] == run)
        & (coefficients["method"] == method)
        & coefficients["component"].str.match("U$|g_")
        & (coefficients["estimate"] != 0)
    ]
    shown = chosen[["component", "term", "estimate", "standard_error", "exact"]].rename(
        columns={"standard_error": "standard error"}
    )
    return [
        ReportTable(
            " ".join([
                "The certificate: how many runs passed each test.", *control_sentences(certificates)
            ]),
            counted.reset_index(), {}, f"{folder}/certificates.csv", rows_shown=40,
        ),
        ReportTable(
            f"The certificate of run {run}, with its limits.", mine, {}, f"{folder}/certificates.csv", 40
        ),
        ReportTable(
            f"Coefficients of run {run} with their standard errors.", shown, {},
            f"{folder}/coefficients.csv", 60,
        ),
    ]  # fmt: skip


def _provenance(timings: pd.DataFrame, versions: Mapping[str, str]) -> dict[str, str]:
    """With what, and how long."""
    cores = os.cpu_count()
    total = timings.groupby("step")["seconds"].sum()
    spent = ", ".join(f"{step} {seconds:.0f} s" for step, seconds in total.items())
    return {
        "Versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
        "Python": f"{platform.python_version()} on {platform.system()} {platform.machine()}, {cores} cores",
        "Processor time of all runs": spent,
    }
