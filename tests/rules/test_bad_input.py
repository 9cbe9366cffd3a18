"""Bad input: one clear sentence with file, place and remedy, exit code not 0, nothing written."""

import pytest

from siq.errors import InputError
from siq.numerics.files import read_document
from workflow.settings import Studies

pytestmark = pytest.mark.workflow

RECORDINGS = "system: archetype3d\nrecordings: {file: measured.csv}"
ROWS = "recording,t,x,y,z\na,0,1,2,3\na,1,1,2,3\nb,0,1,2,3\nb,1,1,2,3\n"


def spoilt(project, *, study=None, card=None, recordings=None):
    """The project with a fault."""
    project.write_study()
    for name, change in (("study.yaml", study), ("config/systems/archetype3d.yaml", card)):
        if change is not None:
            text = project.path(name).read_text()
            assert change[0] in text
            project.path(name).write_text(text.replace(*change))
    if recordings is not None:
        project.path("measured.csv").write_text(recordings)
    return project


def refused(project):
    done = project.run("results/mini/report.html")
    assert done.returncode != 0
    assert "Traceback" not in done.stdout
    assert not project.path("results").exists()
    lines = [line for line in done.stdout.splitlines() if ": the " in line or ": '" in line]
    assert len(lines) == 1, done.stdout[-2000:]
    return lines[0]


WHAT_IS_WRITTEN = {
    "misspelt key": (
        {"study": ("threshold: 0.1", "treshold: 0.1")},
        ("study.yaml", "line", "treshold", "perhaps you meant 'threshold'"),
    ),
    "bad value": (
        {"study": ("seed: 7", "seed: -7")},
        ("study.yaml", "line 5 (seed)", "-7", "greater than or equal to 0"),
    ),
    "unknown parameter": (
        {"card": ("- y - z", "- y - kappa*z")},
        ("archetype3d.yaml", "line 12 (equations.x)", "'kappa' is not declared"),
    ),
    "hostile formula": (
        {"card": ('"-y + 2*(x**3 - x)"', """'__import__("os").system("ls")'""")},
        ("archetype3d.yaml", "line 13 (equations.y)", "__import__", "not allowed in a formula"),
    ),
}
RECORDED = {
    "missing column": (
        {"study": ("system: archetype3d", RECORDINGS), "recordings": ROWS.replace(",z\n", ",w\n")},
        ("measured.csv", "z"),
    ),
    "no time": (
        {"study": ("system: archetype3d", RECORDINGS), "recordings": ROWS.replace("b,0,1,2", "b,nan,1,2")},
        ("measured.csv", "row 3, column t", "remove the row"),
    ),
}


@pytest.mark.parametrize("fault", ["misspelt key", "no time"])
def test_bad_input_is_told_in_one_sentence_and_nothing_is_written(fresh_project, fault):
    changes, parts = (WHAT_IS_WRITTEN | RECORDED)[fault]
    sentence = refused(spoilt(fresh_project, **changes))
    for part in parts:
        assert part in sentence


@pytest.mark.parametrize("fault", [*WHAT_IS_WRITTEN, *RECORDED])
def test_every_fault_is_found_before_any_job(fresh_project, monkeypatch, fault):
    """By what the workflow asks when it starts, without starting it."""
    changes, parts = (WHAT_IS_WRITTEN | RECORDED)[fault]
    spoilt(fresh_project, **changes)
    monkeypatch.chdir(fresh_project.folder)
    with pytest.raises((InputError, ValueError)) as told:
        Studies(read_document("study.yaml").data, configfiles=["study.yaml"])["mini"].check_recordings()
    for part in parts:
        assert part in str(told.value)
