"""Snakemake in forks of one process that has imported what is nobody's own: four of its five seconds."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

# Neither siq nor the workflow, which are those of the folder in which Snakemake runs.
IMPORTED = [
    *("snakemake.cli", "snakemake.workflow", "snakemake.persistence.file", "filelock", "jinja2", "pydantic"),
    *(
        "numba",
        "pandas",
        "pyarrow.parquet",
        "scipy.integrate",
        "scipy.interpolate",
        "scipy.optimize",
        "sympy",
    ),
]

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(IMPORTED)


class Snakemake:
    """``python -m snakemake`` in a folder, to be asked as a `subprocess.Popen` is."""

    def __init__(self, arguments: Sequence[str], *, folder: Path, path: Sequence[Path], output: Path) -> None:
        own = [str(folder), *map(str, path)]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(own)}
        self.args, self._output = ["snakemake", *arguments], output
        self._process = _CONTEXT.Process(
            target=_run, args=(self.args, str(folder), own, environment, str(output))
        )
        self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid

    @property
    def returncode(self) -> int | None:
        """None while it runs; minus the signal that ended it."""
        return self._process.exitcode

    def send_signal(self, signal: int) -> None:
        os.kill(self.pid, signal)

    def output(self, *, timeout: float) -> str:
        """What it has written, once it has ended."""
        self._process.join(timeout)
        assert self.returncode is not None, f"it has not ended within {timeout} s"
        return self._output.read_text(encoding="utf-8")


def _run(
    arguments: list[str], folder: str, own: list[str], environment: Mapping[str, str], output: str
) -> None:
    """Be that process: its session, folder, environment, streams and modules."""
    os.setsid()
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    written = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(written, 1)
    os.dup2(written, 2)
    given = [place for place in sys.path if place and "tests" not in Path(place).parts]
    sys.path[:], sys.argv = [*own, *given], arguments
    from snakemake.cli import main

    main()
