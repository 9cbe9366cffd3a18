"""What the rules know of the configuration: studies, their parameters, and where files are."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from siq.data.recordings import read_pairs
from siq.dynamics.cards import check_name, load_exact
from siq.dynamics.dynamics import Dynamics
from siq.errors import InputError
from siq.files.documents import Document, read_document, validate
from siq.steps.of_study import StudyParts, settings_of
from siq.study.study import Study, check_states, completed, load_published, load_study_system, system_path

WORKFLOW_KEYS = ("statistics", "device", "runs_per_training", "mismatch", "cases", "keys", "proof")
SYSTEMS = Path("config/systems")
STUDIES = Path("config/studies")
PUBLISHED = Path("config/published")


@dataclass(frozen=True)
class CheckedStudy:
    """A study with its system, as the rules use it.

    Attributes
    ----------
    study
        The checked study.
    file
        Where it stands.
    system
        Its system, where it names one.
    runs_per_training
        Runs that one training job takes.
    """

    study: Study
    file: str
    system: Dynamics | None
    runs_per_training: int

    def command(self) -> str:
        """How to make this study's report again."""
        own = Path(self.file) != STUDIES / f"{self.study.name}.yaml"
        option = f" --configfile {self.file}" if own else ""
        return f"snakemake --cores 2 results/{self.study.name}/report.html{option}"

    def run_names(self) -> list[str]:
        """``000``, ``001``, …, one for every run."""
        return [f"{run:03d}" for run in range(self.study.runs)]

    def block(self, run: int) -> str:
        """Name of the block of runs that trains a run, such as ``000-049``."""
        first = run - run % self.runs_per_training
        last = min(first + self.runs_per_training, self.study.runs) - 1
        return f"{first:03d}-{max(last, run):03d}"

    def block_names(self) -> list[str]:
        """Every block once."""
        return list(dict.fromkeys(self.block(run) for run in range(self.study.runs)))

    def source(self) -> str:
        """The file that the data come from: the recordings, or the card that is simulated."""
        if self.study.recordings is not None:
            return find_resource(self.study.recordings.file)
        assert self.study.system is not None  # the schema asks for one of the two
        return str(system_path(self.study.system, systems=SYSTEMS))

    def check_recordings(self) -> None:
        """Refuse recordings that cannot be used before any job starts; those that a rule makes come later.

        Raises
        ------
        InputError
            With the file, the row and the column at fault.
        """
        recordings = self.study.recordings
        if recordings is None or recordings.file.startswith("results/"):
            return
        space = StudyParts(self.study, self.system).space
        found, _ = read_pairs(
            self.source(), states=space.names, units=space.units, pair_step=recordings.pair_step
        )
        for name in found.names:
            try:
                check_name(name)
            except ValueError as error:
                fault, remedy = str(error).split("; ", 1)
                raise InputError(
                    self.source(), f"column {name}", fault, f"{remedy}, or name the states in the study"
                ) from None
        check_states(self.study, found.names, file=self.file)

    def card(self) -> str | None:
        """The system card, where the study names one."""
        return None if self.study.system is None else str(system_path(self.study.system, systems=SYSTEMS))

    def published(self) -> str | None:
        """The file of published figures, where the study names one."""
        return None if self.study.published is None else str(PUBLISHED / f"{self.study.published}.yaml")

    def exact(self) -> str | None:
        """The card's exact answer as text, on which scoring alone depends."""
        return None if (card := self.card()) is None else str(load_exact(card))

    def settings(self, cls: type[Any]) -> dict[str, Any]:
        """The settings of a step as plain data, which Snakemake can compare and a script restores."""
        return TypeAdapter(cls).dump_python(settings_of(cls, self.study, self.system), mode="json")


class Studies(Mapping[str, CheckedStudy]):
    """Every study of the configuration by name; each is checked when it is first asked for.

    Parameters
    ----------
    config
        The configuration as Snakemake merged it. A study given by ``--configfile`` stands in it beside
        the workflow's own keys.
    configfiles
        The files that it was merged from, for messages.

    Raises
    ------
    InputError
        When the configuration itself is at fault.
    """

    def __init__(self, config: Mapping[str, Any], *, configfiles: Sequence[str]) -> None:
        self._checked: dict[str, CheckedStudy] = {}
        self._runs_per_training = config.get("runs_per_training", 1)
        if not isinstance(self._runs_per_training, int) or self._runs_per_training < 1:
            raise InputError(
                "config/config.yaml",
                "runs_per_training",
                f"{self._runs_per_training!r} is not a number of runs",
                "write 1 or more",
            )
        self._defaults = config.get("statistics", [])
        self._own: str | None = None
        if any(key not in WORKFLOW_KEYS for key in config):
            self._own = self._user_study(config, configfiles)

    def _user_study(self, config: Mapping[str, Any], configfiles: Sequence[str]) -> str:
        for file in reversed([str(name) for name in configfiles]):
            document = read_document(file)
            data = {key: value for key, value in document.data.items() if key not in WORKFLOW_KEYS}
            if data:
                # What --config adds on the command line wins over the file.
                data = {key: value for key, value in config.items() if key not in WORKFLOW_KEYS}
                return self._check(Document(document.file, data, document.lines), None)
        unknown = next(key for key in config if key not in WORKFLOW_KEYS)
        raise InputError(
            "--config", unknown, f"the key '{unknown}' is unknown without a study",
            "give the study by --configfile, or use one of " + ", ".join(WORKFLOW_KEYS),
        )  # fmt: skip

    def _check(self, document: Document, name: str | None) -> str:
        study = validate(document, Study)
        if name is not None and study.name != name:
            raise InputError(
                document.file, document.place(("name",)), f"the study is named '{study.name}'",
                f"name it '{name}' as its file, or rename the file",
            )  # fmt: skip
        system = load_study_system(study, file=document.file, systems=SYSTEMS)
        checked = CheckedStudy(completed(study, system), document.file, system, self._runs_per_training)
        if (published := checked.published()) is not None:
            load_published(published)
        self._checked[study.name] = checked
        return study.name

    def default_names(self) -> list[str]:
        """The studies that ``statistics`` makes: the user's own, or those of the configuration."""
        return [self._own] if self._own is not None else list(self._defaults)

    def __getitem__(self, name: str) -> CheckedStudy:
        if name not in self._checked:
            self._check(read_document(STUDIES / f"{name}.yaml"), name)
        return self._checked[name]

    def __iter__(self):  # type: ignore[no-untyped-def]
        own = [] if self._own is None else [self._own]
        yield from dict.fromkeys([*own, *sorted(path.stem for path in STUDIES.glob("*.yaml"))])

    def __len__(self) -> int:
        return len(list(iter(self)))


def find_resource(file: str) -> str:
    """A file of the user's: where it says, or else in a folder of ``SIQ_RESOURCES`` or ``SIQ_RECORDINGS``."""
    for variable in ("SIQ_RESOURCES", "SIQ_RECORDINGS"):
        folder = os.environ.get(variable)
        if folder and not Path(file).exists() and (found := Path(folder) / file).exists():
            return str(found)
    return file


def prepare_environment() -> None:
    """Set what every job inherits.

    Jobs run side by side, each on the threads that its rule names and the same whatever ``--cores`` says;
    the numerical libraries' own threads would only be in each other's way. Training takes and frees arrays
    of some 100 kB all the time, which glibc would return to the system each time: a fifth of every step.
    Scripts import modules of the workflow by their full names, as the rules do.
    """
    root = str(Path(__file__).resolve().parents[1])
    paths = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    if root not in paths:
        os.environ["PYTHONPATH"] = os.pathsep.join([root, *paths])
    os.environ["OMP_NUM_THREADS"] = "1"
    os.environ.setdefault("MALLOC_MMAP_THRESHOLD_", str(2**30))
    os.environ.setdefault("MALLOC_TRIM_THRESHOLD_", str(2**33))
