"""The tasks of the proof: conceal, diagnose without knowing what, open the keys, score, write the page."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import TYPE_CHECKING, Any

from workflow.task import Given, task

if TYPE_CHECKING:
    import pandas as pd

    from benchmarks.proof.targets import Target
    from siq.report.page import ReportContent
    from siq.workflow.study import PipelineSettings

LOGGER = logging.getLogger(__name__)
HELP = {
    "target": "What was to be reached.",
    "from": "Lower 95 % bound: by Clopper and Pearson for shares, by order statistics for quantiles.",
    "to": "Upper 95 % bound.",
    "of": "Cases, or intervals, that the figure is of.",
    "met": "Whether the measured figure keeps the target.",
}


def _generator(given: Given) -> ModuleType:
    """The generator of a set of cases."""
    if given.options["foreign"]:
        from benchmarks.proof.foreign import cases as foreign

        return foreign
    from benchmarks.proof.concealment import cases as own

    return own


def _batch(given: Given, *, cases: Path, keys: Path) -> dict[str, str]:
    from benchmarks.proof.batches import write_batch

    number = int(given.wildcards["batch"])
    generator: Any = _generator(given)
    return write_batch(given.options["settings"], number, generator=generator, cases=cases, keys=keys)


@task()
def conceal(given: Given, settings: PipelineSettings) -> Any:
    """The cases of a batch; of their keys only the digests are left."""
    with TemporaryDirectory() as keys:
        return {"digests": _batch(given, cases=Path(given.outputs["cases"]), keys=Path(keys)), "cases": {}}


@task("digests")
def published_digests(given: Given, settings: PipelineSettings) -> Any:
    """The digests of all keys; no case is diagnosed before they are published."""
    joined: dict[str, str] = {}
    for digests in given.digests:
        joined |= digests
    return {"joined": dict(sorted(joined.items()))}


@task("cases", "digests", "dictionary")
def blind_diagnosis(given: Given, settings: PipelineSettings) -> Any:
    """Diagnose the cases of a batch. Nothing here knows of keys, seeds, or how cases are made."""
    folders = [folder for folder in sorted(Path(given.files["cases"]).iterdir()) if folder.is_dir()]
    return {"verdicts": [_diagnosed(folder) for folder in folders]}


def _diagnosed(folder: Path) -> dict[str, Any]:
    """What the diagnosis says of a case; a failure is told in a sentence and stops nothing else."""
    from siq.diagnosis.diagnosis import solve_case
    from siq.diagnosis.study import read_case
    from siq.diagnosis.verdict import statement_of_failure
    from siq.errors import NumericalFailure

    begin = time.perf_counter()
    verdict, card, failure = None, "", ""
    try:
        case = read_case(folder / "system.yaml", folder / "recordings.parquet", folder / "study.yaml")
        try:
            diagnosis = solve_case(case)
            verdict, card = diagnosis.statement.as_data(), diagnosis.to_card()
        except NumericalFailure as error:  # which is a verdict, too, as for every user
            LOGGER.exception("%s: no fit has a result", folder.name)
            failure = str(error)
            verdict, card = statement_of_failure(failure).as_data(), case.system.to_card()
    except Exception as error:
        LOGGER.exception("%s failed", folder.name)
        failure = f"{type(error).__name__}: {error}"
    seconds = time.perf_counter() - begin
    return {"case": folder.name, "verdict": verdict, "card": card, "seconds": seconds, "failure": failure}


@task("digests", "verdicts")
def open_keys(given: Given, settings: PipelineSettings) -> Any:
    """The keys of a batch again, after every diagnosis, held against the published digests."""
    from benchmarks.proof.batches import check_digests

    with TemporaryDirectory() as cases:
        found = _batch(given, cases=Path(cases), keys=Path(given.outputs["folder"]))
    check_digests(found, given.digests, file=given.files["digests"])
    return {"folder": {}}


@task("cases", "opened", "answers")
def score_batch(given: Given, settings: PipelineSettings) -> Any:
    """The diagnoses of a batch against keys and oracle."""
    from benchmarks.proof.scoring import read_answers, score_case

    one = score_case
    if given.options["foreign"]:
        from benchmarks.proof.foreign_scores.scores import score_foreign_case

        one = score_foreign_case
    folder, keys = Path(given.files["cases"]), Path(given.files["opened"])
    answers = read_answers(given.files["answers"])
    rows = [one(name, folder / name, keys, answer) for name, answer in answers.items()]
    return {"table": _score_table(rows, given)}


@task("card", "recordings", "study", "key", "verdict", "system")
def score_case(given: Given, settings: PipelineSettings) -> Any:
    """The diagnosis of a case that somebody else made."""
    from benchmarks.proof.scoring import Answer, score_case as scored

    source, verdict, key = given.files, given.verdict, given.files["key"]
    answer = Answer(None, "", failure="there is no verdict")
    if verdict is not None:
        answer = Answer(verdict, Path(source["system"]).read_text(encoding="utf-8"))
    keys = Path(key if isinstance(key, str) else key[0]).parent
    row = scored(given.wildcards["case"], Path(source["card"]).parent, keys, answer)
    return {"table": _score_table([row], given)}


@task("scores")
def collect_scores(given: Given, settings: PipelineSettings) -> Any:
    """The scores of all batches, or cases, in one table."""
    rows = [{str(name): row[name] for name in row} for one in given.scores for row in one.to_dict("records")]
    return {"table": _score_table(rows, given)}


def _score_table(rows: list[dict[str, Any]], given: Given) -> pd.DataFrame:
    from benchmarks.proof import scoring
    from benchmarks.proof.foreign_scores import scores

    return scoring.score_table(rows, scores.COLUMNS if given.options["foreign"] else scoring.COLUMNS)


@task("scores")
def score_proof(given: Given, settings: PipelineSettings) -> Any:
    """The page of a proof, or of the blind test: every target, what was measured, what counts against it."""
    import pandas as pd

    from benchmarks.proof.plots import plot_proof
    from benchmarks.proof.targets import STRONG, failures_of, targets_of

    scores, told = given.scores, given.options["settings"]
    asked = [
        "Does the diagnosis say rightly whether, where and in which way a simulation lacks physics? Each case"
        " is a simulation and recordings in which an effect was concealed, or nothing. The diagnosis had the"
        " cases alone; the keys were opened when it had ended.",
        "Beside each diagnosis stands the oracle: the fit of the true simulation, begun at the true"
        " parameters. What it gains in χ² over the recalibrated simulation says how much can be known; from"
        f" {STRONG:g} on, a mechanism has to be named.",
    ]
    if told is not None and len(scores) < told["cases"]:
        missing = told["cases"] - len(scores)
        asked.append(
            f"{missing} of the {told['cases']} cases are missing, since their motion was not bounded."
        )
    failed = scores[scores["note"] != ""]
    unfinished = pd.DataFrame(
        {name: failed[name] for name in ("case", "verdict")} | {"reason": failed["note"]}
    )
    caption = (
        "Left: the verdicts on each kind of case, numbers of cases; the right verdict is framed. Right: share"
        " of concealed mechanisms within the reported class, against what the oracle gains; dashed: 100."
    )
    lists = [*failures_of(scores), ("Cases that the diagnosis could not finish.", unfinished)]
    return _page(given, targets_of(scores), asked, plot_proof(scores, strong=STRONG), caption, lists)


@task("scores")
def score_foreign(given: Given, settings: PipelineSettings) -> Any:
    """The page of the proof on random systems."""
    from benchmarks.proof.foreign_scores.scores import ENOUGH, NEAR
    from benchmarks.proof.plots import plot_foreign_proof
    from benchmarks.proof.targets import foreign_failures, foreign_targets

    scores = given.scores
    asked = [
        "What does the diagnosis say where no dictionary has what is missing? Systems are drawn at random,"
        " and so are the functions that they lack: of one coordinate or two, in an equation or a sensor."
        " Sensors round, lose samples, and have clocks that jitter.",
        "Beside each diagnosis stands an oracle: scipy's least squares with the drawn function in place. A"
        " place is asked for where the oracle can tell it, and a gain where that is twice its error. A name"
        f" is right only if the named function is the drawn one within {100 * NEAR:.0f} %, up to what free"
        " parameters do.",
    ]
    caption = (
        "Left: share of the oracle's gain on held-out recordings; dashed: what was to be reached. Right:"
        " share of right places, with the number of cases."
    )
    figure, lists = plot_foreign_proof(scores, enough=ENOUGH), foreign_failures(scores)
    return _page(given, foreign_targets(scores), asked, figure, caption, lists)


def _page(
    given: Given,
    targets: list[Target],
    asked: list[str],
    figure: Any,
    caption: str,
    lists: list[tuple[str, pd.DataFrame]],
) -> dict[str, Any]:
    """The page, its figure and its table of targets."""
    import yaml

    from benchmarks.proof.targets import target_table
    from siq.numerics.text import number_text
    from siq.report.page import (
        ReportContent as Content,
        ReportFigure,
        ReportSection,
        ReportTable,
        render_report,
    )
    from siq.report.plots.style import save_figure

    stem, told = Path(given.outputs["figure"]).with_suffix(""), given.options["settings"]
    save_figure(figure, stem)
    judged = [each for each in targets if each.met is not None]
    missed = [each for each in judged if not each.met]
    answer = [f"{len(judged) - len(missed)} of {len(judged)} targets are met, in {len(given.scores)} cases."]
    answer += [
        f"Not met: {each.name}, {number_text(each.measured)} ({number_text(each.low)} to"
        f" {number_text(each.high)}) instead of {each.limit}."
        for each in missed
    ]
    table = target_table(targets)
    measured = ReportTable("Targets and what was measured.", table, HELP, rows_shown=100)
    drawn = ReportFigure(caption, caption, stem.with_suffix(".png").read_bytes(), "png")
    against = [ReportTable(said, frame, rows_shown=200) for said, frame in lists if len(frame)]
    sections = [
        ReportSection("What was asked, and what was measured", asked, tables=[measured], figures=[drawn]),
        ReportSection("Cases that count against it", tables=against),
        ReportSection("How to run it again", listing=given.options["command"]),
    ]
    if told is not None:
        listing = yaml.safe_dump(told, sort_keys=False)
        sections.append(ReportSection("Settings", listing=listing, folded=True))
    content: ReportContent = Content(title=given.options["title"], answer=answer, sections=sections)
    return {"html": render_report(content), "targets": table}
