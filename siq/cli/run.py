"""How does a study, a file of recordings or a folder of cases become a page?"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Sequence
from pathlib import Path

from siq.cli.answers import Exit, Told, answer_of_page
from siq.cli.studies import is_study, name_for, own_path, write_generated
from siq.cli.workflow import Ended, Request, known_studies, need_workflow, run_workflow
from siq.errors import InputError
from siq.files.documents import read_document
from siq.study.study import load_study

RESULTS = Path("results")
CARD, RECORDINGS = "system.yaml", ("recordings.parquet", "recordings.csv")


def run_study(
    given: str,
    *,
    cores: str = "all",
    verbose: bool = False,
    dry_run: bool = False,
    further: Sequence[str] = (),
) -> Exit:
    """Answer a study, recordings without a study, or a study that comes with the workflow.

    Parameters
    ----------
    given
        Path of a study (YAML) or of recordings (a file, or a folder of files), or the name of a study in
        ``config/studies``.
    cores
        How many to use.
    verbose
        Show what Snakemake says in the place of one line of progress.
    dry_run
        Only say what would run.
    further
        Options for Snakemake.

    Raises
    ------
    InputError
        When the file cannot be used.
    MissingExtra
        When the workflow is not installed.
    """
    need_workflow()
    path = Path(given).expanduser()
    settings: tuple[str, ...] = ()
    study: Path | None = None
    if not path.exists() and given in known_studies():
        name = given
    elif not path.exists():
        raise _not_there(given)
    elif (path / CARD).is_file():
        raise InputError(
            given, "", f"this is a case of a simulation and its recordings, since it has {CARD}",
            f"compare them by: siq diagnose {given}",
        )  # fmt: skip
    elif is_study(path):
        _refuse_card(path)
        name, study = load_study(path).name, path
    else:
        name = name_for(path)
        study, settings = write_generated(path, name), (f"origin={own_path(path)}",)
    page = RESULTS / name / "report.html"
    request = Request((page.as_posix(),), study, settings, cores, verbose, dry_run, tuple(further))
    return _told(run_workflow(request), request, [page])


def diagnose_cases(
    folder: str,
    *,
    cores: str = "all",
    verbose: bool = False,
    dry_run: bool = False,
    further: Sequence[str] = (),
) -> Exit:
    """Compare simulations with recordings: every case of a folder, or the one that the folder is.

    Parameters
    ----------
    folder
        With ``system.yaml`` and recordings, or with folders that have them.
    cores, verbose, dry_run, further
        As `run_study` takes them.

    Raises
    ------
    InputError
        When there is no such folder.
    MissingExtra
        When the workflow is not installed.
    """
    need_workflow()
    place = Path(folder).expanduser()
    if place.name == CARD and place.is_file():
        place = place.parent
    if not place.is_dir():
        raise _not_there(folder)
    pages = [RESULTS / "mismatch" / name / "report.html" for name in case_names(place)]
    settings = (f"cases={place.as_posix()}",)
    request = Request(("diagnose",), None, settings, cores, verbose, dry_run, tuple(further))
    return _told(run_workflow(request), request, pages)


def case_names(folder: Path) -> list[str]:
    """The names of the cases in a folder, as the workflow has them."""
    if (folder / CARD).is_file():
        return [folder.resolve().name]
    return sorted(
        path.name
        for path in folder.iterdir()
        if path.is_dir() and any((path / name).exists() for name in (CARD, *RECORDINGS))
    )


def _refuse_card(path: Path) -> None:
    data = read_document(path).data
    if "equations" in data:
        raise InputError(
            path, "", "this is the card of a system, not a study",
            f"write a study beside it, of two lines: 'name: {data.get('name', 'my-study')}' and"
            f" 'system: {path.name}'",
        )  # fmt: skip


def _not_there(given: str) -> InputError:
    """A wrong path, with where it was looked for and what is there of a similar name."""
    place = Path(given).expanduser().absolute()
    beside = [entry.name for entry in place.parent.iterdir()] if place.parent.is_dir() else []
    near = difflib.get_close_matches(place.name, beside, n=1) or difflib.get_close_matches(
        given, known_studies(), n=1
    )
    remedy = f"perhaps you meant '{near[0]}'" if near else "correct the path"
    if not place.parent.is_dir():
        return InputError(given, "", f"there is no folder {place.parent}", remedy)
    return InputError(given, "", f"there is no file or folder of that name in {place.parent}", remedy)


def _told(ended: Ended, request: Request, pages: Sequence[Path]) -> Exit:
    """Say how it ended, and name the pages."""
    if ended.interrupted:
        print("Stopped. Give the same command again to go on from here.", file=sys.stderr)
        return Exit.INTERRUPTED
    if ended.code not in (0, Exit.NO_ANSWER):
        return Exit.FAULT
    if request.dry_run:
        for words in ended.planned:
            print(words)
        if not request.verbose:
            print(
                f"{ended.steps} steps would run." if ended.steps else "Nothing would run: all is up to date."
            )
        return Exit.ANSWERED
    told = [answer_of_page(page) for page in pages if page.is_file()]
    if not ended.steps and not request.verbose:
        print("Nothing has changed since the last time; this is the answer that you have.", file=sys.stderr)
    for one in told:
        _say(one, ended.said)
    return max((one.code for one in told), default=Exit.FAULT)


def _say(one: Told, said: Sequence[str]) -> None:
    for line in one.lines:
        if line not in said:
            print(line)
    if (page := f"The page to read: {one.page}") not in said:
        print(page)
