"""Tasks: the jobs of the workflow, each a function from files and settings to files.

A task is a function ``run(given, settings)`` under the decorator `task`. It names what it reads and the parts
of the settings that it depends on; what it returns is written by name (`workflow.files`). A rule names its
task.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from siq.workflow.study import PipelineSettings

TASKS: dict[str, Task] = {}
"""Every task by its name, as soon as its module is imported."""


@dataclass(frozen=True)
class Task:
    """One kind of job.

    Attributes
    ----------
    name
        Of the task, and of its rule.
    needs
        Files that it reads, by the names that the rule has for them; some may be absent.
    options
        Parts of the settings that it depends on, see `siq.workflow.study.PipelineSettings.parts`.
    run
        The function: of what is given and of settings, its results by the names of the rule's outputs. When
        they may change for the same input, its version is raised (``python -m workflow.versions --raise
        TASK``), which makes them anew.
    """

    name: str
    needs: tuple[str, ...]
    options: tuple[str, ...]
    run: Callable[[Given, PipelineSettings], Mapping[str, Any]]


Run = Callable[..., Mapping[str, Any]]


def task(*needs: str, options: Sequence[str] = ()) -> Callable[[Run], Run]:
    """Make a task of a function, which keeps its name; rules and tasks share it."""

    def register(run: Run) -> Run:
        TASKS[run.__name__] = Task(run.__name__, needs, tuple(options), run)
        return run

    return register


class _Stored(Sequence[Any]):
    """Files of one kind, such as one of each run; each is read when it is asked for."""

    def __init__(self, name: str, paths: Sequence[str]) -> None:
        self.name, self.paths = name, tuple(map(str, paths))

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, place: Any) -> Any:
        from workflow.files import read

        return read(self.name, self.paths[place])

    def __iter__(self) -> Iterator[Any]:
        return (self[place] for place in range(len(self)))


@dataclass
class Given:
    """What a job was given; a need is an attribute, read when it is asked for, None where it is absent.

    Attributes
    ----------
    files
        Paths by name: one, or several where each run has one.
    number
        Of the run, or of the first run of a block.
    options
        What the rule says beside the settings.
    wildcards
        Of the rule.
    outputs
        Where results go, by name.
    device, threads
        Where networks are trained, and on how many threads.
    tell
        Passes on what a long job is doing.
    afterwards
        What a task wants called when its results are written.
    """

    files: Mapping[str, Any] = field(default_factory=dict)
    number: int = 0
    options: Mapping[str, Any] = field(default_factory=dict)
    wildcards: Mapping[str, str] = field(default_factory=dict)
    outputs: Mapping[str, str] = field(default_factory=dict)
    device: str = "auto"
    threads: int = 1
    tell: Callable[[str], None] = lambda text: None
    afterwards: list[Callable[[], None]] = field(default_factory=list)
    _read: dict[str, Any] = field(default_factory=dict)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        if name not in self._read:
            from workflow.files import read

            path = self.files.get(name) or None
            several = path is not None and not isinstance(path, str)
            self._read[name] = _Stored(name, path or ()) if several else path and read(name, path)
        return self._read[name]

    def path(self, name: str) -> str | None:
        """A file as such, None where it is absent."""
        return self.files.get(name) or None
