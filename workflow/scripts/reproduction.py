"""One page that lists the paper's tables, figures and numbers, with ours beside them and the difference."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from siq.files import whole_file
from siq.report import ReportContent, ReportFigure, ReportTable, render_report
from siq.tables import read_table
from step import job

FIGURES = {
    "components": "Fig. 1, Fig. 5 (a, b)",
    "coefficients_refined": "Fig. 2, and Appendix D",
    "error_distribution": "Fig. 3",
    "prediction": "Fig. 4 (a), Fig. 6 (a)",
    "invariant": "Fig. 4 (b-d), Fig. 6 (b-d)",
    "landscape_errors": "Fig. 5 (c-e), and Appendix E",
    "landscape": "none; U over all wells, with paths and validity",
}


def comparison(summary: pd.DataFrame, method: str) -> pd.DataFrame:
    """Every published figure, with ours by one method and the difference."""
    rows = summary[(summary["method"] == method) & summary["published"].notna()]
    difference = rows["mean"] - rows["published"]
    return pd.DataFrame(
        {
            "quantity": rows["quantity"],
            "published": rows["published"],
            "ours": rows["mean"],
            "ours, standard deviation": rows["standard_deviation"],
            "exact": rows["exact"],
            "difference": difference,
            "relative": difference / rows["published"].abs().replace(0, np.nan),
            "runs": rows["runs"],
            "source": rows["source"],
        }
    )


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    tables, figures, answer = [], [], []
    contradictions = yaml.safe_load(Path(snakemake.input.contradictions).read_text(encoding="utf-8"))
    for name, path in zip(snakemake.params.studies, snakemake.input.summaries, strict=True):
        summary = read_table(path)
        for method in dict.fromkeys(summary["method"]):
            rows = comparison(summary, method)
            if len(rows):
                title = f"{name}, method “{method}”"
                tables.append(ReportTable(title, rows, {}, str(Path(path).with_suffix(".csv")), 80))
        rrmse = read_table(Path(path).with_name("rrmse.parquet"))
        mine = rrmse[rrmse["method"] == "refined"]
        answer.append(f"{name}: {int(mine['certified'].sum())} of {len(mine)} runs are certified.")
        for figure, number in FIGURES.items():
            image = Path(path).parents[1] / "figures" / f"{figure}.png"
            if image.exists():
                caption = f"{name}: {figure.replace('_', ' ')}. In the paper: {number}."
                figures.append(ReportFigure(caption, caption, image.read_bytes(), "png"))
    content = ReportContent(
        title="Everything in the paper, and ours beside it",
        question=[
            "Lin and Belardinelli, Sparse identification of quasipotentials via a combined data-driven"
            " method: every table, figure and number of it that a study has, with ours beside it and the"
            " difference."
        ],
        answer=[*answer, "Where the paper contradicts itself or its published code:", *contradictions],
        tables=tables,
        figures=figures,
        commands=["snakemake --cores 2 reproduce"],
    )
    with whole_file(snakemake.output.html) as partial:
        partial.write_text(render_report(content), encoding="utf-8")


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
