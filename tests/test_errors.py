"""What is said when something from outside is missing."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from siq.errors import DISTRIBUTION, MissingExtra, needs_extra

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

# Packages whose modules import without any extra. `networks` needs its own, `report.plots` matplotlib.
LIGHT = ("numerics", "data", "systems", "inference", "validation", "quasipotential", "diagnosis")
ABSENT = ("torch", "pysindy", "sklearn", "cvxpy", "matplotlib", "snakemake", "pygments", "pyarrow", "h5py")
# Of files of recordings: these are pyarrow's.
READERS = tuple(f"siq.data.{name}" for name in ("cells", "formats", "layout", "tables"))


BLOCK = """
import sys
class Nowhere:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {packages}:
            raise ModuleNotFoundError(f"No module named '{{name}}'", name=name)
sys.meta_path.insert(0, Nowhere())
"""


def run_without(packages: tuple[str, ...], program: str) -> subprocess.CompletedProcess[str]:
    """Run a program to which these packages are not installed."""
    program = BLOCK.format(packages=packages) + program
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT)


def test_the_extra_that_is_missing_is_named_in_one_sentence() -> None:
    with pytest.raises(MissingExtra) as caught, needs_extra("networks"):
        import torch_that_nobody_has  # noqa: F401
    assert str(caught.value) == (
        f"'torch_that_nobody_has' is not installed; install it by: pip install '{DISTRIBUTION}[networks]'."
    )
    assert caught.value.extra == "networks"
    assert caught.value.__cause__ is None


def test_a_module_of_siq_that_is_missing_is_no_extra() -> None:
    with pytest.raises(ModuleNotFoundError) as caught, needs_extra("networks"):
        import siq.that_nobody_wrote  # noqa: F401
    assert not isinstance(caught.value, MissingExtra)


def test_the_mathematics_needs_no_extra() -> None:
    modules = [
        ".".join(file.relative_to(ROOT).with_suffix("").parts)
        for package in LIGHT
        for file in sorted((ROOT / "siq" / package).glob("*.py"))
    ]
    assert len(modules) > 50
    modules = [name for name in modules if name not in READERS]
    program = f"import importlib\nfor name in {modules!r}: importlib.import_module(name)"
    done = run_without(ABSENT, program)
    assert done.returncode == 0, done.stderr


def test_recordings_become_a_landscape_and_an_estimator_without_networks() -> None:
    modules = [f"siq.workflow.{file.stem}" for file in sorted((ROOT / "siq" / "workflow").glob("*.py"))]
    assert "siq.workflow.pipeline" in modules
    modules = [name for name in modules if name != "siq.workflow.training"] + ["siq.sklearn"]
    program = f"import importlib\nfor name in {modules!r}: importlib.import_module(name)"
    done = run_without(("torch", "pysindy", "cvxpy", "matplotlib", "snakemake", "pygments"), program)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "statement, package, extra",
    [
        ("import siq; siq.train", "torch", "networks"),
        ("import siq.networks.training", "torch", "networks"),
        ("import siq.report.plots.style", "matplotlib", "plots"),
        ("import siq.sklearn", "sklearn", "sklearn"),
        ("import siq; siq.Recordings.to_xarray(None)", "xarray", "netcdf"),
    ],
)
def test_what_an_extra_is_for_names_it(statement: str, package: str, extra: str) -> None:
    done = run_without((package,), statement)
    assert done.returncode
    assert done.stderr.splitlines()[-1].endswith(
        f"'{package}' is not installed; install it by: pip install '{DISTRIBUTION}[{extra}]'."
    )


def test_the_extras_are_those_of_the_distribution() -> None:
    assert PROJECT["name"] == DISTRIBUTION
    extras = {"networks", "plots", "workflow", "sklearn", "netcdf", "docs", "pages", "slurm", "dev"}
    assert extras == set(PROJECT["optional-dependencies"])
