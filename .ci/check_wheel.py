"""What an installation without extras can do, from a folder that is not the repository's."""

import subprocess
import sys
from dataclasses import replace
from importlib import metadata, resources
from pathlib import Path

import numpy as np
import sympy

import siq
from siq.data.recordings import snapshot_pairs
from siq.inference.library import IdentificationOptions
from siq.inference.regression import identify_vector_field

installed = Path(siq.__file__).resolve()
assert not installed.is_relative_to(Path(sys.argv[1]).resolve()), f"{installed} is not the installed one"
assert siq.__version__ == metadata.version("quasipotential")
for package, name in (
    ("diagnosis", "mechanisms.yaml"),
    ("report", "templates/base.html.j2"),
    (".", "py.typed"),
    ("workflow/shipped", "Snakefile"),
    ("workflow/shipped", "config/systems/archetype3d.yaml"),
    ("workflow/shipped", "workflow/rules/common.smk"),
    ("workflow/shipped", "benchmarks/proof/tasks.py"),
    ("workflow/shipped", "benchmarks/publication/page.html.j2"),
    ("workflow/shipped", "profiles/default/config.yaml"),
):
    assert resources.files("siq").joinpath(package, name).is_file(), f"{package}/{name} is not in the wheel"

# A double well, simulated, written as CSV, read back, and identified.
x, y = sympy.symbols("x y", real=True)
domain = np.array([[-2.0, 2.0], [-1.0, 1.0]])
well = replace(siq.Dynamics.of((x, y), (x - x**3, -y)), domain=domain)
options = siq.SimulationOptions(trajectories=20, pairs=10)
made = siq.simulate_snapshots(well, options=options, generator=np.random.default_rng(0))
rows = np.column_stack([made.recording, made.t, made.values])
np.savetxt("trajectories.csv", rows, delimiter=",", header="recording,t,x,y", comments="", fmt="%.17g")
pairs = snapshot_pairs(siq.read_recordings("trajectories.csv"), pair_step=options.pair_step)
library = siq.candidate_library(["x", "y"], degree=3)
found = identify_vector_field(library, pairs, options=IdentificationOptions(degree=3))
terms = {library.names[k]: round(float(found.coefficients[k, i]), 5) for i, k in found.support if i == 0}
assert terms == {"x": 1.0, "x**3": -1.0}, terms

# Its landscape, of recordings and of equations; a formula of a mechanism takes numbers and arrays.
recorded = siq.Landscape.from_recordings(made)
assert len(recorded.transitions) == 2 and np.allclose(recorded.barriers().barrier, 0.5, rtol=0.02), recorded
landscape = siq.Landscape.from_equations(well)
assert landscape.certificate.certified and len(landscape.transitions) == 2, landscape.report()
limited = siq.Dynamics.of((x,), (sympy.Min(x, 1) - x,))
assert np.array_equal(limited.drift(np.array([[0.5], [3.0]])), [[0.0], [-2.0]])


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The command as it was installed."""
    return subprocess.run([Path(sys.executable).parent / "siq", *arguments], capture_output=True, text=True)


assert command("--version").stdout == f"siq {siq.__version__}\n"
assert "siq run my-recordings.csv" in command("--help").stdout
looked_at = command("inspect", "trajectories.csv")
assert looked_at.returncode == 0 and "20 recordings" in looked_at.stdout, looked_at
assert command("init", "trajectories.csv").returncode == 0 and Path("trajectories.yaml").is_file()
refused = command("run", "trajectories.csv")
assert refused.returncode == 1 and refused.stderr.count("\n") == 1, refused
assert "pip install 'quasipotential[workflow]'" in refused.stderr, refused

try:
    siq.train  # noqa: B018
except siq.MissingExtra as error:
    assert "pip install 'quasipotential[networks]'" in str(error), error
else:
    raise AssertionError("torch is in the core")
print(f"siq {siq.__version__} identifies dx/dt = {terms} from an installation without extras")
