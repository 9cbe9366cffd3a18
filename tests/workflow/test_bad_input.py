"""Bad input: one clear sentence with file, place and remedy, exit code not 0, nothing written."""

import pytest

pytestmark = pytest.mark.workflow

RECORDINGS = "system: archetype3d\nrecordings: {file: measured.csv}"
ROWS = "recording,t,x,y,z\na,0,1,2,3\na,1,1,2,3\nb,0,1,2,3\nb,1,1,2,3\n"


def refused(project, *, study=None, card=None, recordings=None):
    project.write_study()
    for name, change in (("study.yaml", study), ("config/systems/archetype3d.yaml", card)):
        if change is not None:
            text = project.path(name).read_text()
            assert change[0] in text
            project.path(name).write_text(text.replace(*change))
    if recordings is not None:
        project.path("measured.csv").write_text(recordings)
    done = project.run("results/mini/report.html")
    assert done.returncode != 0
    assert "Traceback" not in done.stdout
    assert not project.path("results").exists()
    lines = [line for line in done.stdout.splitlines() if ": the " in line or ": '" in line]
    assert len(lines) == 1, done.stdout[-2000:]
    return lines[0]


@pytest.mark.parametrize(
    ("fault", "parts"),
    [
        (
            {"study": ("threshold: 0.1", "treshold: 0.1")},
            ("study.yaml", "line", "treshold", "perhaps you meant 'threshold'"),
        ),
        (
            {"study": ("seed: 7", "seed: -7")},
            ("study.yaml", "line 5 (seed)", "-7", "greater than or equal to 0"),
        ),
        (
            {"card": ("- y - z", "- y - kappa*z")},
            ("archetype3d.yaml", "line 12 (equations.x)", "'kappa' is not declared"),
        ),
        (
            {"card": ('"-y + 2*(x**3 - x)"', """'__import__("os").system("ls")'""")},
            ("archetype3d.yaml", "line 13 (equations.y)", "__import__", "not allowed in a formula"),
        ),
        (
            {"study": ("system: archetype3d", RECORDINGS), "recordings": ROWS.replace(",z\n", ",w\n")},
            ("measured.csv", "z"),
        ),
        (
            {
                "study": ("system: archetype3d", RECORDINGS),
                "recordings": ROWS.replace("b,0,1,2", "b,nan,1,2"),
            },
            ("measured.csv", "row 3, column t", "remove the row"),
        ),
    ],
    ids=["misspelt key", "bad value", "unknown parameter", "hostile formula", "missing column", "no time"],
)
def test_bad_input_is_told_in_one_sentence_and_nothing_is_written(fresh_project, fault, parts):
    sentence = refused(fresh_project, **fault)
    for part in parts:
        assert part in sentence
