"""What the rules know of the configuration: studies, their parameters, and where files are."""

from __future__ import annotations

import importlib.util
import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field

from siq.data.preparation import read_pairs
from siq.errors import DISTRIBUTION, InputError, suggestion
from siq.numerics.files import Document, read_document, validate
from siq.systems.cards import check_name, load_exact
from siq.systems.dynamics import Dynamics
from siq.workflow.study import (
    PipelineSettings,
    Study,
    card_content,
    card_content_but_for,
    check_states,
    completed,
    load_study_system,
    settings_of,
)
from workflow.places import BASE, config_path, named_file, names_in, needed_file
from workflow.published import load_published

NETWORKS = ("torch", "pysindy")
"""What a study that asks for networks needs beside the rest."""


class Configuration(BaseModel):
    """What belongs to no study: the keys of ``config/config.yaml``.

    Attributes
    ----------
    statistics
        The studies that are made if you name no target.
    device
        Where networks are trained: ``auto`` takes a GPU where there is one. No result depends on it beyond
        the last bits.
    runs_per_training
        Runs that one job trains side by side: 1 suits a CPU, 50 a GPU.
    mismatch
        The studies that the target ``mismatch`` makes.
    """

    statistics: tuple[str, ...] = ("archetype3d",)
    device: Literal["auto", "cpu", "cuda"] = "auto"
    runs_per_training: Annotated[int, Field(ge=1)] = 1
    mismatch: tuple[str, ...] = ("silverbox", "cascaded-tanks")


WORKFLOW_KEYS = (*Configuration.model_fields, "cases", "keys", "proof", "origin")


@dataclass(frozen=True, eq=False)
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
    origin
        What `siq run` was given where it wrote the study itself: the file of recordings.
    recordings_at
        The place of their name in the study's file, for messages.
    """

    study: Study
    file: str
    system: Dynamics | None
    runs_per_training: int
    origin: str | None = None
    recordings_at: str = "recordings.file"

    @property
    def folder(self) -> Path:
        """Where the relative paths of the study start."""
        return Path(self.file).parent

    def command(self) -> str:
        """How to make this study's report again."""
        if Path(self.file) == config_path("studies", f"{self.study.name}.yaml"):
            return f"snakemake --cores 2 results/{self.study.name}/report.html"
        return f"siq run {self.origin or _from_here(self.file)}"

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
            where = (self.file, self.recordings_at)
            return needed_file(self.study.recordings.file, start=self.folder, where=where)
        card = self.card()
        assert card is not None  # the schema asks for one of the two
        return card

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
        if Path(self.source()).stat().st_mtime > time.time() + 60.0:
            remedy = f"set the clock, or give the file the time of now by: touch {self.source()}"
            raise InputError(self.source(), "", "it is of the future, as where a clock was set back", remedy)
        space = self.settings.space
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
        return self._named(self.study.system, "systems")

    def published(self) -> str | None:
        """The file of published figures, where the study names one."""
        return self._named(self.study.published, "published")

    def _named(self, name: str | None, folder: str) -> str | None:
        return None if name is None else str(named_file(name, folder, start=self.folder))

    def _domain(self) -> list[list[float]] | None:
        """The box that the card gives."""
        return None if self.system is None or self.system.domain is None else self.system.domain.tolist()

    @cached_property
    def settings(self) -> PipelineSettings:
        """The settings of all steps."""
        return settings_of(self.study, self.system)

    @cache  # noqa: B019 (every run asks for the same, and a study lives as long as its workflow)
    def options(self, names: tuple[str, ...]) -> dict[str, Any]:
        """What a task depends on as plain data, which Snakemake compares: parts of the settings, and others.

        ``card`` is what a simulation takes from the card, so that another title makes nothing anew;
        ``card_but_for_swept`` leaves out values that each point of a sweep has of its own; ``exact`` is the
        card's exact answer, on which scoring alone depends; ``study`` is all of it, which the page prints.
        """
        swept = self.study.sweep
        others: dict[str, Callable[[], Any]] = {
            "card": lambda: card_content(self.system),
            "card_but_for_swept": lambda: card_content_but_for(self.card(), swept.names if swept else ()),
            "exact": lambda: None if (card := self.card()) is None else str(load_exact(card)),
            "study": lambda: self.study.model_dump(mode="json"),
            "sweep": lambda: None if swept is None else swept.model_dump(mode="json"),
            "command": self.command,
            "every_run": lambda: self.study.landscape is not None,
            "runs": lambda: self.study.runs,
            "domain": self._domain,
        }
        parts = self.settings.parts([name for name in names if name not in others])
        return parts | {name: others[name]() for name in names if name in others}


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
        self._common = validate(Document("config/config.yaml", dict(config), {}), Configuration)
        self._origin = config.get("origin")
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
        if study.training is not None:
            _need_networks(document)
        card = None if study.system is None else _existing_card(study.system, document)
        system = load_study_system(study, card, file=document.file)
        checked = CheckedStudy(
            completed(study, system),
            document.file,
            system,
            self._common.runs_per_training,
            self._origin,
            document.place(("recordings", "file")),
        )
        if (published := checked.published()) is not None:
            load_published(published)
        self._checked[study.name] = checked
        return study.name

    def default_names(self) -> list[str]:
        """The studies that ``statistics`` makes: the user's own, or those of the configuration."""
        return [self._own] if self._own is not None else list(self._common.statistics)

    def __getitem__(self, name: str) -> CheckedStudy:
        if name not in self._checked:
            self._check(read_document(config_path("studies", f"{name}.yaml")), name)
        return self._checked[name]

    def pattern_of(self, entrance: str) -> str:
        """A regular expression of the names of the studies with an entrance, which matches nothing for none.

        The files alone are read for it, not checked: a fault is told when somebody asks for that study.
        """
        named = [name for name in self if self._entrance(name) == entrance]
        return "|".join(re.escape(name) for name in named) or "(?!)"

    def _entrance(self, name: str) -> str | None:
        if name in self._checked:
            return self._checked[name].study.entrance
        try:
            return read_document(config_path("studies", f"{name}.yaml")).data.get("from")
        except InputError:
            return None

    def __iter__(self):  # type: ignore[no-untyped-def]
        own = [] if self._own is None else [self._own]
        yield from dict.fromkeys([*own, *names_in("studies")])

    def __len__(self) -> int:
        return len(list(iter(self)))


def _existing_card(system: str, document: Document) -> Path:
    """The card that a study names, which has to be there."""
    card = named_file(system, "systems", start=Path(document.file).parent)
    if card.is_file():
        return card
    where = (document.file, document.place(("system",)))
    if system.endswith((".yaml", ".yml")):
        return Path(needed_file(system, start=Path(document.file).parent, where=where))
    known = names_in("systems")
    otherwise = f"give the path of one, or use one of {', '.join(known)}"
    remedy = suggestion(system, known, otherwise=otherwise)
    raise InputError(*where, f"there is no card of a system '{system}'", remedy)


def _need_networks(document: Document) -> None:
    """Refuse a study that asks for networks where the packages for them are not installed."""
    missing = [name for name in NETWORKS if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            document.file, document.place(("training",)),
            f"the study asks for networks, which need {' and '.join(missing)}",
            f"install them by: pip install '{DISTRIBUTION}[networks]', or leave the key 'training' out",
        )  # fmt: skip


def _from_here(file: str) -> str:
    """A file as you would write it in the folder in which you work."""
    path = Path(file)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else file


def prepare_environment() -> None:
    """Set what every job inherits.

    Jobs run side by side, each on the threads that its rule names and the same whatever ``--cores`` says;
    the numerical libraries' own threads would only be in each other's way. Training takes and frees arrays
    of some 100 kB all the time, which glibc would return to the system each time: a fifth of every step.
    Scripts import modules of the workflow by their full names, as the rules do.
    """
    root = str(BASE)
    paths = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    if root not in paths:
        os.environ["PYTHONPATH"] = os.pathsep.join([root, *paths])
    os.environ["OMP_NUM_THREADS"] = "1"
    os.environ.setdefault("MALLOC_MMAP_THRESHOLD_", str(2**30))
    os.environ.setdefault("MALLOC_TRIM_THRESHOLD_", str(2**33))
