from __future__ import annotations

import gc
import importlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from coverage import Coverage

# Before torch and numpy start their threads: arrays this small take thrice as long on two as on one.
os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

from benchmarks.mutation import MODULES
from siq.systems.cards import load_system
from siq.systems.dynamics import Dynamics

gc.disable()  # What imports make stays; looking through it for garbage takes as long as they do.

ROOT = Path(__file__).parents[1]
FOLDERS = ("inference", "rules", "diagnosis", "quasipotential", "workflow", "")
"""Those whose tests come first, in this order, and all others."""
OF_MODULES_THAT_DECIDE = {ROOT / file for _, tests in MODULES.values() for file in tests.split()}
"""Their tests, in which `pytest --cov` counts branches."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Files of full-size checks alone: without `-m slow` each process would import them in vain."""
    return True if collection_path.name == "slow" and config.option.markexpr.startswith("not slow") else None


@pytest.hookimpl(tryfirst=True)  # before the scheduler reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Folders that take longest first; the tests of a file in one process, which makes what they share once.

    Those that look at the same finished workflow are a group of their own. Inference is one, too: its first
    test has the filter's machine code made, which takes longer than all of its tests beside. The diagnosis,
    which needs that code as well, comes after it.
    """
    items.sort(key=lambda item: min(FOLDERS.index(one) for one in (*item.path.parts, "") if one in FOLDERS))
    for item in items:
        alike = item.path.parent if "inference" in item.path.parts else item.path
        shared = "finished" in getattr(item, "fixturenames", ())
        item.add_marker(pytest.mark.xdist_group("finished" if shared else str(alike)))


def _coverage(config: pytest.Config) -> Any:
    """What counts branches here; None where nothing does, or `--cov=siq` wants it in all tests."""
    plugin = config.pluginmanager.getplugin("_cov")
    alone = plugin is not None and plugin.options.cov_source is None and config.option.dist == "no"
    return plugin.cov_controller if alone else None


def pytest_collection(session: pytest.Session) -> None:
    """Branches are counted in the modules that decide alone, by their own tests: others would slow down."""
    if (coverage := _coverage(session.config)) is not None:
        for module, _ in MODULES.values():
            importlib.import_module(module)
        coverage.pause()
        while (outer := Coverage.current()) is not None:  # pytest-cov 7.1 starts two in a worker
            outer.stop()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Go on counting in the tests of a module that decides, fixtures included."""
    coverage = _coverage(item.config) if item.path in OF_MODULES_THAT_DECIDE else None
    if coverage is not None:
        coverage.resume()
    try:
        return (yield)
    finally:
        if coverage is not None:
            coverage.pause()


def pytest_collection_finish() -> None:
    """From here on garbage is collected, among what tests make."""
    gc.freeze()
    gc.enable()


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Writes a text to a file and returns its path."""

    def to_file(text: str, name: str = "file.yaml") -> Path:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return to_file


@pytest.fixture(scope="session")
def archetype() -> Dynamics:
    """The paper's archetypal system, from its card."""
    return load_system(ROOT / "config" / "systems" / "archetype3d.yaml")
