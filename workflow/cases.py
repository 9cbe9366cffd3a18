"""Studies of mismatch, as the rules know them: those of the configuration, and the cases of a folder.

A study stands in ``config/mismatch/NAME.yaml``; a case is a folder with ``system.yaml``, with
``recordings.parquet`` or ``recordings.csv``, and perhaps with ``study.yaml``. Each is checked when it is
first asked for, and imports what it needs only then, so that other workflows start without it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.publication.public_recordings import BENCHMARKS
from siq.errors import Fault, InputError
from siq.numerics.files import CARD, RECORDINGS, Document, case_folders, given_path, read_document, validate
from siq.systems.cards import SystemCard, check_title
from workflow.places import config_path, find_file, named_file, needed_file

MADE = "results/recordings"
STUDY = "study.yaml"


@dataclass(frozen=True)
class CheckedCase:
    """A case, checked as far as that is possible before any job.

    Attributes
    ----------
    name
        Of its folder of results.
    card, recordings
        Their files.
    study
        The file of the study, None where the case has none.
    content
        Card and study as plain data, but for titles: what the diagnosis depends on.
    title
        What its page is headed.
    benchmark
        Name of the public benchmark that its recordings are of, None for any other.
    command
        How to make its page again.
    """

    name: str
    card: str
    recordings: str
    study: str | None
    content: dict[str, Any]
    title: str
    benchmark: str | None
    command: str


class Cases:
    """Every study of mismatch and every case by name.

    Parameters
    ----------
    config
        The configuration as Snakemake merged it, with the keys ``mismatch`` and ``cases``.
    """

    def __init__(self, config: Mapping[str, Any]) -> None:
        self._listed = config.get("mismatch") or []
        self._folder = config.get("cases")
        self._checked: dict[str, CheckedCase] = {}
        if not isinstance(self._listed, list):
            raise InputError(
                "config/config.yaml", "mismatch", f"{self._listed!r} is no list", "write it as [NAME, ...]"
            )

    def listed(self) -> tuple[list[str], list[str]]:
        """Names of the configuration's studies that can run, and a sentence for each that cannot.

        Raises
        ------
        InputError
            For one that is at fault; that a benchmark was not downloaded is no fault.
        """
        names, missing = [], []
        for name in map(str, self._listed):
            sentence = self._not_there(self[name])
            missing += [sentence] if sentence else []
            names += [] if sentence else [name]
        return names, missing

    def in_folder(self) -> list[str]:
        """Names of the cases of the folder, all of them checked.

        Raises
        ------
        InputError
            For the first that cannot be used, and where there is none.
        """
        if self._folder is None:
            raise InputError("--config", "cases", "no folder is given", "write --config cases=DIR")
        names = sorted(self._folders())
        if not names:
            raise InputError(
                str(self._folder), "", "no folder in it is a case",
                f"give a folder of folders, each with {CARD} and {' or '.join(RECORDINGS)}",
            )  # fmt: skip
        for name in names:
            self[name]
        return names

    def __getitem__(self, name: str) -> CheckedCase:
        if name not in self._checked:
            folders = self._folders() if self._folder is not None else {}
            made = self._of_folder(name, folders[name]) if name in folders else self._of_study(name)
            self._checked[name] = made
        return self._checked[name]

    def raw_file(self, benchmark: str) -> str:
        """The file of a benchmark as downloaded.

        Raises
        ------
        InputError
            Where it is not there, with what to get and where to put it.
        """
        one = BENCHMARKS[benchmark]
        file = find_file(one.file)
        if file is None:
            raise InputError(
                one.file, "", f"the recordings of the benchmark {benchmark} are not there",
                f"get {one.what} from nonlinearbenchmark.org, put it there below a folder of yours, and name"
                " that folder by the environment variable SIQ_RESOURCES (earlier: SIQ_RECORDINGS)",
            )  # fmt: skip
        return file

    def _not_there(self, case: CheckedCase) -> str:
        if case.benchmark is not None and not Path(case.recordings).is_file():
            try:
                self.raw_file(case.benchmark)
            except InputError as error:
                return str(error)
        return ""

    def _folders(self) -> dict[str, Path]:
        """The cases of the folder: itself, or every folder in it with a card or with recordings."""
        base = given_path(str(self._folder))
        if not base.is_dir():
            raise InputError(str(self._folder), "", "there is no such folder", "correct --config cases=DIR")
        return case_folders(base)

    def _of_folder(self, name: str, folder: Path) -> CheckedCase:
        try:
            check_title(name)
        except Fault as error:
            raise error.at(folder) from None
        if (taken := config_path("mismatch", f"{name}.yaml")).exists():
            raise InputError(folder, "", f"a study of that name is {taken}", "rename the folder of the case")
        found = [str(folder / each) for each in RECORDINGS if (folder / each).is_file()]
        if len(found) != 1:
            fault = "it has no recordings" if not found else "it has two files of recordings"
            raise InputError(folder, "", fault, f"keep one of {' and '.join(RECORDINGS)}")
        if not (folder / CARD).is_file():
            raise InputError(folder, "", "it has no card of the simulation", f"add {CARD}")
        study = str(folder / STUDY) if (folder / STUDY).is_file() else None
        command = f"siq diagnose {self._folder}"
        return _checked(name, str(folder / CARD), found[0], study, command)

    def _of_study(self, name: str) -> CheckedCase:
        from siq.diagnosis.study import MismatchStudy

        file = str(config_path("mismatch", f"{name}.yaml"))
        document = read_document(file)
        study = validate(document, MismatchStudy)
        for key in ("system", "recordings"):
            if getattr(study, key) is None:
                raise InputError(file, "", f"the key '{key}' is missing", f"add '{key}: ...'")
        assert study.system is not None and study.recordings is not None  # just checked
        command = f"snakemake --cores 2 results/mismatch/{name}/report.html"
        start = Path(file).parent
        card = str(named_file(study.system, "systems", start=start))
        recordings = needed_file(study.recordings, start=start, where=(file, document.place(("recordings",))))
        return _checked(name, card, recordings, file, command)


def _checked(name: str, card: str, recordings: str, study: str | None, command: str) -> CheckedCase:
    """Check the files of a case; recordings that a rule makes are checked by their job."""
    from siq.diagnosis.dictionary import dictionary_of
    from siq.diagnosis.study import MismatchStudy, read_case
    from siq.systems.cards import build_system

    document = read_document(card)
    model = build_system(document, validate(document, SystemCard))
    options = read_document(study) if study is not None else Document("the study", {}, {})
    checked = validate(options, MismatchStudy)
    benchmark = Path(recordings).stem if Path(recordings).parent == Path(MADE) else None
    if benchmark is None:
        read_case(card, recordings, study)
    elif benchmark not in BENCHMARKS:
        raise InputError(
            options.file, options.place(("recordings",)), f"no rule makes {recordings}",
            f"name a file of yours, or a benchmark: {', '.join(BENCHMARKS)}",
        )  # fmt: skip
    else:
        dictionary_of(without=checked.without, further=checked.mechanisms, file=options.file)
    content = {
        "card": {key: value for key, value in document.data.items() if key != "title"},
        "study": {key: value for key, value in options.data.items() if key != "title"},
    }
    return CheckedCase(
        name, card, recordings, study, content, checked.title or model.title, benchmark, command
    )
