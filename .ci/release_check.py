"""The checklist before a release, walked by a machine: `make release-check`. Nothing is published.

    python .ci/release_check.py               # all of it
    python .ci/release_check.py versions docs # some of it

Each item is a function that raises `Missing` with what to do. What cannot be checked here counts as not done.
"""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]


class Missing(Exception):
    """What is not done, in one sentence with a remedy."""


def _text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def _project() -> dict[str, Any]:
    return tomllib.loads(_text("pyproject.toml"))["project"]


def _run(*command: str | Path, remedy: str) -> str:
    done = subprocess.run([str(part) for part in command], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise Missing(f"{remedy}:\n{(done.stdout + done.stderr)[-2000:].strip()}")
    return done.stdout


def versions(installed: str | None = None) -> None:
    """Version: pyproject.toml, CITATION.cff, CHANGELOG.md and the installed package have the same."""
    version = _project()["version"]
    cited = str(yaml.safe_load(_text("CITATION.cff"))["version"])
    if cited != version:
        raise Missing(f"CITATION.cff has version {cited}, pyproject.toml {version}")
    latest = re.search(r"^## \[([^\]]+)\]", _text("CHANGELOG.md"), flags=re.MULTILINE)
    if latest is None or latest[1] != version:
        raise Missing(f"the first heading of CHANGELOG.md is not '## [{version}]'")
    installed = installed or metadata.version(_project()["name"])
    if installed != version:
        raise Missing(f"version {installed} is installed, not {version}; remove .venv/installed")


def dates() -> None:
    """Dates: the changelog has one, and CITATION.cff the same."""
    heading = re.search(r"^## \[[^\]]+\] - (.+)$", _text("CHANGELOG.md"), flags=re.MULTILINE)
    if heading is None or not re.fullmatch(r"\d{4}-\d{2}-\d{2}", heading[1]):
        raise Missing(f"CHANGELOG.md says '{heading[1] if heading else ''}'; write the day of the release")
    cited = str(yaml.safe_load(_text("CITATION.cff"))["date-released"])
    if cited != heading[1]:
        raise Missing(f"CITATION.cff is of {cited}, CHANGELOG.md of {heading[1]}")


def recipe() -> None:
    """Recipe for conda: version, dependencies and constraints are those of pyproject.toml."""
    project, written = _project(), yaml.safe_load(_text("recipe/recipe.yaml"))
    if written["context"]["version"] != project["version"]:
        raise Missing(f"recipe/recipe.yaml has version {written['context']['version']}")
    needed = {line.replace(">", " >", 1) for line in project["dependencies"]}
    needed.add(f"python {project['requires-python']}")
    if needed != set(written["requirements"]["run"]):
        other = sorted(needed ^ set(written["requirements"]["run"]))
        raise Missing(f"recipe/recipe.yaml and pyproject.toml differ in: {', '.join(other)}")
    called = {"matplotlib-base": "matplotlib", "pytorch": "torch", "snakemake-minimal": "snakemake"}
    extras = {line for lines in project["optional-dependencies"].values() for line in lines}
    for line in written["requirements"]["run_constraints"]:
        name, limits = line.split(" ", 1)
        if not any(re.sub(r"\[.*\]", "", one) == called.get(name, name) + limits for one in extras):
            raise Missing(f"recipe/recipe.yaml says '{line}', and no extra does")


def schemas() -> None:
    """Schemas: workflow/schemas/ is what the classes say."""
    spec = importlib.util.spec_from_file_location("schemas", ROOT / "docs" / "make" / "schemas.py")
    assert spec is not None and spec.loader is not None
    written = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(written)
    files = {name: f"workflow/schemas/{name}.schema.yaml" for name in written.MODELS}
    stale = [name for name, file in files.items() if _text(file) != written.text(name)]
    if stale:
        raise Missing(f"schemas of {', '.join(stale)} are stale; run `make schemas`")


def packages() -> None:
    """Packages: wheel and sdist build, pass twine's check, and hold what they should."""
    with tempfile.TemporaryDirectory() as folder:
        python = Path(folder, "env", "bin", "python")
        _run(sys.executable, "-m", "venv", Path(folder, "env"), remedy="no environment could be made")
        tools = ("install", "--quiet", "build", "twine")
        _run(python, "-m", "pip", *tools, remedy="build and twine cannot be had here")
        _run(python, "-m", "build", "--outdir", Path(folder, "dist"), remedy="wheel or sdist does not build")
        built = sorted(Path(folder, "dist").iterdir())
        _run(python, "-m", "twine", "check", "--strict", *built, remedy="twine refuses what was built")
        if [file.name.endswith(".whl") for file in built].count(True) != 1 or len(built) != 2:
            raise Missing(f"one wheel and one sdist were expected, not {[file.name for file in built]}")
        for file in built:
            if f"-{_project()['version']}" not in file.name:
                raise Missing(f"{file.name} is of another version")
            if file.suffix == ".whl":
                with zipfile.ZipFile(file) as archive:
                    names = archive.namelist()
            else:
                with tarfile.open(file) as archive:
                    names = archive.getnames()
            for needed in ("mechanisms.yaml", "LICENSE", "schemas/study.schema.yaml", "Snakefile"):
                if not any(name.endswith(needed) for name in names):
                    raise Missing(f"{file.name} lacks {needed}")
            print(f"   {file.name}: {len(names)} files, {file.stat().st_size / 1e6:.1f} MB")


def docs() -> None:
    """Documentation: it builds without a warning."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.rmtree(ROOT / "docs" / "api", ignore_errors=True)
        options = ("--fail-on-warning", "--keep-going", "--quiet", "-b", "html")
        _run(sys.executable, "-m", "sphinx", *options, "docs", folder, remedy="the documentation has faults")


def worktree() -> None:
    """Worktree: everything is committed."""
    changed = _run("git", "status", "--porcelain", remedy="this is no repository")
    if changed:
        raise Missing(f"commit or remove these first:\n{changed.rstrip()}")


CHECKS = (versions, dates, recipe, schemas, packages, docs, worktree)


def main(wanted: list[str]) -> int:
    """Walk through the list; the exit code is the number of items that are not done."""
    left = 0
    for check in CHECKS:
        if wanted and check.__name__ not in wanted:
            continue
        print(f".. {check.__doc__}", flush=True)
        try:
            check()
        except Missing as missing:
            left += 1
            print(f"NO {missing}", flush=True)
        else:
            print("ok", flush=True)
    print("ready" if not left else f"{left} to do")
    return left


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
