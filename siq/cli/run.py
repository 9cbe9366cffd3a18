"""How does a study, a file of recordings or a folder of cases become a page?"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from siq.cli.answers import Exit, Told, answer_of_page
from siq.cli.studies import is_study, name_for, own_path, write_generated
from siq.cli.workflow import Ended, Request, known_studies, need_workflow, run_workflow
from siq.errors import InputError, suggestion
from siq.numerics.files import CARD, case_folders, read_document
from siq.workflow.study import load_study

RESULTS = Path("results")


def run_study(given: str, asked: Request) -> Exit:
    """Answer a study, recordings without a study, or a study that comes with the workflow.

    Parameters
    ----------
    given
        Path of a study (YAML) or of recordings (a file, or a folder of files), or the name of a study in
        ``config/studies``.
    asked
        How to run it; what to make is added.

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
    request = replace(asked, targets=(page.as_posix(),), study=study, settings=settings)
    return _told(run_workflow(request), request, [page])


def diagnose_cases(folder: str, asked: Request) -> Exit:
    """Compare simulations with recordings: every case of a folder, or the one that the folder is.

    Parameters
    ----------
    folder
        With ``system.yaml`` and recordings, or with folders that have them.
    asked
        How to run it; what to make is added.

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
    pages = [RESULTS / "mismatch" / name / "report.html" for name in case_folders(place)]
    request = replace(asked, targets=("diagnose",), settings=(f"cases={place.as_posix()}",))
    return _told(run_workflow(request), request, pages)


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
    otherwise = suggestion(given, known_studies(), otherwise="correct the path")
    remedy = suggestion(place.name, beside, otherwise=otherwise)
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
