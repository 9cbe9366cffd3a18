"""Write the report of a study: one page that needs nothing else."""

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from siq.answer import answer_sentences
from siq.files import whole_file
from siq.formatting import formula_mathml, vector_mathml
from siq.model import read_model
from siq.report import FormulaRow, ReportContent, ReportFigure, ReportTable, render_report
from siq.symbolic import SymbolicDecomposition, exact_decomposition
from siq.systems import load_system
from siq.tables import read_table
from step import first_model, job

METHOD = "regression"
CAPTIONS = {
    "components": "Trajectories, downhill component −∇V, circulatory component g, exact and identified U of"
    " the run shown above, projected on the first two states (the paper: Fig. 1).",
    "coefficient_distributions": "Coefficients of U over the runs, one panel for each term that belongs"
    " there; the last panel shows the terms that do not (the paper: Fig. 2).",
    "error_distribution": "Relative root mean square error of the coefficients of U, one dot a run"
    " (the paper: Fig. 3).",
    "inclusion_frequency": "How often each term was found, by component.",
    "training": "Loss on held-out recordings during training, one line a run.",
}
SUMMARY_COLUMNS = (
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


def shown_run(rrmse: pd.DataFrame, models: list[str]) -> int | None:
    """The run whose formulas are shown: the median by error, otherwise the first with formulas."""
    ranked = rrmse[rrmse["method"] == METHOD].dropna(subset="rrmse").sort_values("rrmse")
    if len(ranked):
        return int(ranked["run"].iloc[(len(ranked) - 1) // 2])
    return first_model(models)


def summary_shown(summary: pd.DataFrame) -> pd.DataFrame:
    """Errors, U and g; the headings in words, so that they wrap."""
    shown = summary[~summary["quantity"].str.match("V:|f_")]
    columns = [name for name in SUMMARY_COLUMNS if shown[name].notna().any()]
    return shown[columns].rename(columns=lambda name: name.replace("_", " "))


def formula_rows(
    identified: SymbolicDecomposition, exact: SymbolicDecomposition | None, certificate: dict[str, Any]
) -> list[FormulaRow]:
    """U, ∇V, g and f, exact and identified."""

    def typeset(one: SymbolicDecomposition | None) -> dict[str, Any]:
        if one is None:
            return {}
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
            method=METHOD,
            identified=formula,
            exact=truths.get(name),
            certified=certificate["certified"],
            reason=certificate.get("reason", ""),
        )
        for name, formula in typeset(identified).items()
    ]


def question(study: dict[str, Any]) -> list[str]:
    """What was asked, in words."""
    source = (
        f"the recordings in {study['recordings']['file']}"
        if study["recordings"]
        else f"simulated trajectories of the system {study['system']}"
    )
    training, regression = study["training"], study["regression"]
    return [
        f"From {source} alone: which orthogonal decomposition f = −D∇V + g, with ∇V·g = 0, and which"
        " formula of the quasipotential U = 2V lie behind them, and how much does the answer vary over"
        f" {study['runs']} independent run{'s' if study['runs'] > 1 else ''}?",
        f"Each run trained two tanh networks for {training['steps']} steps on batches of"
        f" {training['batch_size']}, then sought formulas of degree {regression['degree']} at most, dropping"
        f" terms below {regression['threshold']} (acting on the {regression['threshold_on']}).",
    ]


def provenance(timings: pd.DataFrame) -> dict[str, str]:
    """With what, and how long."""
    packages = ("siq", "torch", "numpy", "pysindy", "snakemake")
    versions = {name: importlib.metadata.version(name) for name in packages}
    cores = os.cpu_count()
    total = timings.groupby("step")["seconds"].sum()
    spent = ", ".join(f"{step} {seconds:.0f} s" for step, seconds in total.items())
    return {
        "Versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
        "Python": f"{platform.python_version()} on {platform.system()} {platform.machine()}, {cores} cores",
        "Processor time of all runs": spent,
    }


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    source, study = snakemake.input, snakemake.params.study
    rrmse, outcomes = read_table(source.rrmse), read_table(source.outcomes)
    summary, timings = read_table(source.summary), read_table(source.timings)
    run = shown_run(rrmse, source.models)
    formulas: list[FormulaRow] = []
    if run is not None:
        decompositions, certificates = read_model(source.models[run])
        system = load_system(source.card) if source.get("card") else None
        exact = exact_decomposition(system) if system is not None else None
        formulas = formula_rows(decompositions[METHOD], exact, certificates[METHOD])
    answer = answer_sentences(rrmse, outcomes, summary, runs=study["runs"], method=METHOD)
    if run is not None:
        which = ", the median of the runs by error" if rrmse["rrmse"].notna().any() else ""
        answer.append(f"The formulas below are those of run {run}{which}.")
    name = study["name"]
    tables = Path(source.summary).parent
    figures = {Path(path).stem: Path(path).read_bytes() for path in source.figures}
    troubled = outcomes[outcomes["status"].isin(["failed", "warning"])]
    uncertified = rrmse[~rrmse["certified"]][["run", "method"]]
    failures = pd.concat(
        [
            troubled,
            uncertified.assign(step="certify", status="not certified", reason="no certificate was computed"),
        ]
    )[["run", "step", "status", "reason"]]
    chosen = {key: study[key] for key in study if key not in ("metric", "dynamics", "exact")}
    content = ReportContent(
        title=study["title"] or name,
        question=question(study),
        answer=answer,
        formulas=formulas,
        tables=[
            ReportTable(
                "Every figure over the runs, beside the exact and the published one.",
                summary_shown(summary),
                SUMMARY_HELP,
                f"{tables}/summary.csv",
                rows_shown=60,
            ),
            ReportTable("Errors by run.", rrmse, {}, f"{tables}/rrmse.csv", rows_shown=50),
            ReportTable("What became of each step of each run.", outcomes, {}, f"{tables}/outcomes.csv", 12),
        ],
        figures=[
            ReportFigure(caption, caption, figures[figure], "png") for figure, caption in CAPTIONS.items()
        ],
        failures=failures.sort_values(["run", "step"]),
        commands=[
            snakemake.params.command,
            "# change one parameter of the study and run it again: only what depends on it is made again",
        ],
        study=yaml.safe_dump(chosen, sort_keys=False, allow_unicode=True),
        provenance=provenance(timings),
    )
    with whole_file(snakemake.output.html) as partial:
        partial.write_text(render_report(content), encoding="utf-8")


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
