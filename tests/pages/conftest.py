"""A browser, and every kind of page, made once as people make them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import laboratories
import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Chromium, of the system or of the environment variable CHROMIUM; skipped where there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    program = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        pytest.skip("there is no Chromium; install the package chromium, or name one in CHROMIUM")
    # Inside a container root has no sandbox to enter.
    with playwright.sync_playwright() as playing:
        running = playing.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield running
        running.close()


@pytest.fixture(scope="session")
def made_pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Every kind of page, by the name of its results. ``SIQ_PAGES`` names a folder that has them already."""
    folder = os.environ.get("SIQ_PAGES")
    work = Path(folder) if folder else tmp_path_factory.mktemp("laboratory")
    if not folder:
        for given in laboratories.write_studies(work / "given").values():
            siq("run", str(given), folder=work)
        siq("diagnose", str(laboratories.write_cases(work / "cases")), folder=work)
    pages = sorted(work.glob("results/**/report.html"))
    return {str(page.parent.relative_to(work / "results")): page for page in pages}


def siq(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run the command as a reader of the README does. What it says of the science is not judged here."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, "-m", "siq", *arguments],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=1500,
    )  # fmt: skip
