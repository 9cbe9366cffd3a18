"""Write the report of a study: one page that needs nothing else."""

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from invariant_page import invariant_tables
from landscape_page import landscape_figures, landscape_tables
from siq.answer import answer_sentences
from siq.files import whole_file
from siq.formatting import formula_mathml, vector_mathml
from siq.model import read_model
from siq.report import FormulaRow, ReportContent, ReportFigure, ReportTable, render_report
from siq.symbolic import SymbolicDecomposition, exact_decomposition
from siq.systems import load_system
from siq.tables import read_table
from step import METHODS, job, shown_formula

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


def summary_shown(summary: pd.DataFrame) -> pd.DataFrame:
    """Errors, U and g; the headings in words, so that they wrap."""
    shown = summary[~summary["quantity"].str.match("V:|f_")]
    columns = [name for name in SUMMARY_COLUMNS if shown[name].notna().any()]
    return shown[columns].rename(columns=lambda name: name.replace("_", " "))


def formula_rows(
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
                f"U about {place(well.attractor)}, up to {2 * well.level:.4g}": formula_mathml(
                    2 * well.potential
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
            reason=certificate_sentence(certificate),
        )
        for name, formula in typeset(identified).items()
    ]


def place(position: tuple[float, ...]) -> str:
    """A point as text."""
    return "(" + ", ".join(f"{value:.4g}" for value in position) + ")"


def certificate_sentence(certificate: dict[str, Any]) -> str:
    """What a certificate says, in words."""
    said = [certificate["reason"]] if certificate["reason"] else []
    if certificate["certified"]:
        said.append(f"all tests passed; stated relative error of V {certificate['stated_error']:.1e}")
    return "; ".join([*said, *certificate.get("notes", [])])


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
        f"Each run identified f from the pairs alone, and trained two tanh networks for at most"
        f" {training['steps']} steps on batches of {training['batch_size']}. The published method,"
        f" “regression”, seeks formulas of the networks, of degree {regression['degree']} at most, dropping"
        f" terms below {regression['threshold']} (acting on the {regression['threshold_on']}). “Refined” are"
        f" the formulas that solve the Hamilton–Jacobi equation of f, by the"
        f" {' and the '.join(study['refinement']['routes'])} route, and that have to pass a certificate.",
    ]


def first_wells(models: list[str]) -> tuple[int | None, str]:
    """The first run that has a formula about each attractor, where none has a single one."""
    for run, path in enumerate(models):
        for method, one in read_model(path)[0].items():
            if one.wells:
                return run, method
    return None, METHODS[0]


def refusals(rrmse: pd.DataFrame, certificates: pd.DataFrame) -> pd.DataFrame:
    """Every refined formula that is not certified, with the tests that refused it."""
    refused = certificates[(certificates["method"] == "refined") & ~certificates["passed"]]
    reasons = refused.groupby("run")["reason"].agg(lambda texts: "; ".join(dict.fromkeys(texts)))
    rows = rrmse[(rrmse["method"] == "refined") & ~rrmse["certified"]]
    return pd.DataFrame(
        {
            "run": rows["run"],
            "step": "certify",
            "status": "not certified",
            "reason": rows["run"].map(reasons).fillna("there is no refined formula"),
        }
    )


def certificate_tables(
    certificates: pd.DataFrame, coefficients: pd.DataFrame, run: int | None, method: str, folder: Path
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
            "The certificate: how many runs passed each test. The U of a randomised network is the control,"
            " and has to be refused.",
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
    certificates = read_table(source.certificates)
    run, method = shown_formula(rrmse, source.models)
    if run is None:
        run, method = first_wells(source.models)
    formulas: list[FormulaRow] = []
    if run is not None:
        decompositions, verdicts = read_model(source.models[run])
        system = load_system(source.card) if source.get("card") else None
        exact = exact_decomposition(system) if system is not None else None
        for name in reversed(METHODS):
            if name in decompositions:
                formulas += formula_rows(name, decompositions[name], exact, verdicts[name])
    answer = answer_sentences(rrmse, outcomes, summary, runs=study["runs"], method=method)
    if run is not None:
        which = ", the median of the runs by error" if rrmse["rrmse"].notna().any() else ""
        answer.append(f"The formulas below are those of run {run}{which}.")
    coefficients = read_table(source.coefficients)
    tables = Path(source.summary).parent
    figures = {Path(path).stem: Path(path).read_bytes() for path in source.figures}
    troubled = outcomes[outcomes["status"].isin(["failed", "warning"])]
    failures = pd.concat([troubled, refusals(rrmse, certificates)])[["run", "step", "status", "reason"]]
    chosen = {key: study[key] for key in study if key not in ("metric", "dynamics", "exact")}
    content = ReportContent(
        title=study["title"] or study["name"],
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
            *certificate_tables(certificates, coefficients, run, method, tables),
            *landscape_tables(source, tables),
            *invariant_tables(read_table(source.invariant), read_table(source.well_shares), tables),
            ReportTable("Errors by run.", rrmse, {}, f"{tables}/rrmse.csv", rows_shown=50),
            ReportTable("What became of each step of each run.", outcomes, {}, f"{tables}/outcomes.csv", 12),
        ],
        figures=[
            *(ReportFigure(caption, caption, figures[name], "png") for name, caption in CAPTIONS.items()),
            *landscape_figures(list(source.landscape_figures)),
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
