"""Verification: right results agree, and a wrong number anywhere is told."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy

from siq.data.recordings import read_recordings, write_recordings
from siq.errors import InputError
from siq.inference.field_estimate import write_field
from siq.quasipotential.formulas import write_model
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.landscape_assembly import landscape_from_equations
from siq.quasipotential.landscape_files import read_landscape, write_landscape
from siq.systems.cards import load_system
from siq.systems.dynamics import Dynamics
from siq.systems.simulation import SimulationOptions, simulate_snapshots
from siq.workflow import verification
from siq.workflow.answers import Provenance
from siq.workflow.pipeline import draw_run, identify_run, landscape_of_run, refine_run, source_of
from siq.workflow.study import Study, settings_of
from siq.workflow.tables import Method, not_trained
from siq.workflow.verification import verify

CARD = """\
name: wells
states: {x: {domain: [-1.8, 1.8]}}
equations: {x: "x - x**3"}
diffusion: identity
"""
EQUATIONS = Study.model_validate({"name": "mine", "system": "wells.yaml", "from": "equations"})
TRAJECTORIES = Study.model_validate(
    {"name": "mine", "recordings": {"file": "record.parquet", "pair_step": 0.01}}
)


def kinds(findings: Iterable[verification.Finding]) -> dict[str, set[str]]:
    """What was found of claims of each kind."""
    found: dict[str, set[str]] = {}
    for kind, remark in findings:
        found.setdefault(remark.values.get("what", remark.code.removeprefix("workflow.")), set()).add(kind)
    return found


def edit(file: Path, change: Callable[[Any], Any]) -> None:
    """Change the data of a file of JSON."""
    data = json.loads(file.read_text())
    change(data)
    file.write_text(json.dumps(data))


def kept(folder: Path, study: Study, task: str, source: str, *files: str) -> None:
    """Record files of a folder as a job has written them."""
    outputs = {name: str(folder / name) for name in files}
    said = {"study": study.model_dump(mode="json", by_alias=True)}
    Provenance(folder).record(task, inputs={"source": source}, outputs=outputs, said=said)


def turned(dimension: int) -> Dynamics:
    """``f = (A - 1)∇Φ`` with two wells that are 1/4 deep, and A antisymmetric: U = 2Φ, barriers of 1/2."""
    first, *others = symbols = sympy.symbols(f"x:{dimension}", real=True)
    potential = (first**2 - 1) ** 2 / 4 + sum(((one - first / 3) ** 2 / 2 for one in others), 0)
    turning = sympy.Matrix(dimension, dimension, lambda i, j: sympy.sign(i - j) / 2)
    gradient = sympy.Matrix([potential.diff(one) for one in symbols])
    equations = tuple((turning - sympy.eye(dimension)) * gradient)
    return Dynamics.of(symbols, equations, domain=[(-1.8, 1.8)] * dimension)


@pytest.fixture(scope="module")
def equations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of equations."""
    folder = tmp_path_factory.mktemp("equations")
    (folder / "wells.yaml").write_text(CARD)
    (folder / "mine").mkdir()
    found = landscape_from_equations(load_system(folder / "wells.yaml"))
    write_landscape(folder / "mine" / "quasipotential.json", found)
    kept(folder / "mine", EQUATIONS, "equations", str(folder / "wells.yaml"), "quasipotential.json")
    return folder / "mine"


@pytest.fixture(scope="module")
def trajectories(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of recordings."""
    folder = tmp_path_factory.mktemp("trajectories")
    source, place = folder / "record.parquet", folder / "mine" / "runs" / "000"
    place.mkdir(parents=True)
    options = SimulationOptions(trajectories=60, pairs=20, pair_step=0.01, interval=0.05)
    write_recordings(
        source, simulate_snapshots(turned(1), options=options, generator=np.random.default_rng(0))
    )
    settings = settings_of(TRAJECTORIES, None)
    drawn = draw_run(settings, source_of(str(source), settings), number=0).result
    assert drawn is not None
    identified = identify_run(settings, drawn, number=0)
    assert identified.result is not None
    refined = refine_run(settings, drawn, identified, not_trained(0))
    wells = refined.formulas[Method.REFINED].wells
    found = landscape_of_run(settings, drawn, identified.result, wells=wells, number=0).result
    assert found is not None
    write_recordings(place / "recordings.parquet", drawn)
    write_field(place / "vector_field.json", identified.result, settings.identification)
    write_model(place / "model.json", refined.formulas, refined.certificates)
    write_landscape(place / "quasipotential.json", found)
    files = ("recordings.parquet", "vector_field.json", "model.json", "quasipotential.json")
    kept(folder / "mine", TRAJECTORIES, "draw", str(source), *(f"runs/000/{name}" for name in files))
    return folder / "mine"


@pytest.fixture(scope="module")
def landscape(equations: Path) -> Landscape:
    """The landscape of those equations."""
    card = load_system(equations.parent / "wells.yaml")
    found = read_landscape(equations / "quasipotential.json", dynamics=card)
    assert found is not None
    return found


DERIVED = ("files_as_made", "verdict", "residual", "branch", "barrier")
LEFT = {"page": {"open"}, "logs": {"open"}}


def agree(*claims: str) -> dict[str, set[str]]:
    """All of them, and what is never derived."""
    return {name: {"agrees"} for name in claims} | LEFT


def test_right_results_agree(equations: Path, trajectories: Path) -> None:
    assert kinds(verify(equations)) == agree(*DERIVED)
    assert kinds(verify(trajectories)) == agree(*DERIVED, "trajectories", "field")


def test_numbers_of_a_forger_who_computes_digests_anew_are_found(trajectories: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(trajectories.parent, tmp_path / "all")) / "mine"
    place = folder / "runs" / "000"
    recordings = read_recordings(place / "recordings.parquet")
    recordings.values[0] += 1e-3
    write_recordings(place / "recordings.parquet", recordings)
    edit(
        place / "model.json",
        lambda model: model["certificate"]["refined"]["tests"]["descent"].update(passed=False),
    )
    edit(place / "quasipotential.json", lambda data: [way.update(barrier=0.6) for way in data["transitions"]])
    (folder / "provenance.jsonl").unlink()
    files = ("recordings.parquet", "vector_field.json", "model.json", "quasipotential.json")
    kept(
        folder,
        TRAJECTORIES,
        "draw",
        str(folder.parent / "record.parquet"),
        *(f"runs/000/{name}" for name in files),
    )
    found = kinds(verify(folder))
    wrong = [name for name, what in found.items() if "differs" in what]
    assert wrong == ["trajectories", "field", "verdict", "barrier"]


def test_files_are_held_against_what_was_recorded(equations: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(equations.parent, tmp_path / "all")) / "mine"
    made, source = folder / "quasipotential.json", folder.parent / "wells.yaml"
    (folder / "logs").mkdir()
    (folder / "logs" / "page.log").touch()  # which nobody records
    whole, card = made.read_bytes(), source.read_text()

    def wrong() -> list[tuple[str, dict[str, Any]]]:
        found = list(verify(folder))
        assert {"numbers_of_damaged_files"} <= kinds(found).keys() and "verdict" not in kinds(found)
        return [(remark.code, dict(remark.values)) for kind, remark in found if kind == "differs"]

    made.write_bytes(whole + b" ")
    assert wrong() == [("workflow.file_changed", {"file": str(made), "missing": False, "holds": False})]
    made.unlink()
    assert wrong() == [("workflow.file_changed", {"file": str(made), "missing": True, "holds": False})]
    made.write_bytes(whole)
    (other := folder / "other.json").touch()
    assert wrong() == [("workflow.file_unknown", {"file": str(other), "holds": False})]
    other.unlink()
    source.write_text(card + "# edited\n")
    assert wrong() == [("workflow.source_changed", {"file": str(source), "missing": False, "holds": False})]
    source.unlink()
    assert wrong() == [("workflow.source_changed", {"file": str(source), "missing": True, "holds": False})]
    source.write_text(card)
    other.write_text("one")
    kept(folder, EQUATIONS, "page", str(made), "other.json")
    made.write_bytes(whole + b" ")
    kept(folder, EQUATIONS, "equations", str(source), "quasipotential.json")
    older = {"file": "other.json", "source": "quasipotential.json", "holds": False}
    assert wrong() == [("workflow.file_older", older)]
    with (folder / "provenance.jsonl").open("a") as file:
        file.write("half a li")
    damaged = {"file": str(folder / "provenance.jsonl"), "missing": False, "holds": False}
    assert wrong() == [("workflow.file_changed", damaged), ("workflow.file_older", older)]


def test_what_is_no_result_is_refused_and_a_diagnosis_is_left_open(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there are no results"):
        next(verify(tmp_path / "none"))
    with pytest.raises(InputError, match=r"there is no provenance\.jsonl in it"):
        next(verify(tmp_path))
    (page := tmp_path / "report.html").write_text("as it is")
    Provenance(tmp_path).record("diagnosis", inputs={}, outputs={"page": str(page)}, said={})
    assert kinds(verify(page)) == {"files_as_made": {"agrees"}, "diagnosis": {"open"}} | LEFT


def test_a_certificate_differs_in_what_it_says_or_in_a_test() -> None:
    one = {"certified": True, "tests": {"branch": {"passed": True}, "descent": {"passed": True}}}
    other = {"certified": True, "tests": {"branch": {"passed": True}, "descent": {"passed": False}}}
    fewer = {"certified": True, "tests": {"descent": {"passed": True}}}

    def found(again: dict[str, Any] | None) -> tuple[str, Any]:
        ((kind, remark),) = verification._verdict(one, again)
        return kind, remark.values.get("tests")

    assert found(one) == ("agrees", "")
    assert found(one | {"certified": False}) == ("differs", "")
    assert found(other) == ("differs", "descent") and found(fewer) == ("differs", "branch")
    assert found(None) == ("open", None)


@pytest.mark.parametrize(
    ("of_f", "of_d", "said"), [(1e-7, 1e-7, "agrees"), (1e-5, 0, "differs"), (0, 1e-5, "differs")]
)
def test_f_and_d_agree_to_rounding(of_f: float, of_d: float, said: str) -> None:
    x, y = sympy.symbols("x y", real=True)
    one = Dynamics.of((x, y), (-x, -2 * y), diffusion=[[1, 0], [0, 0.5]])
    other = Dynamics.of((x, y), (-x, -2 * (1 + of_f) * y), diffusion=[[1 + of_d, 0], [0, 0.5]])
    states = np.array([[0.1, 1.0], [-0.5, 0.2]])
    assert kinds(verification._field(one, other, states)) == {"field": {said}}
    positions = states[:, :1]  # of a record without velocities: formulas are compared
    assert kinds(verification._field(one, one, positions)) == {"field": {"agrees"}}
    assert kinds(verification._field(one, other, positions)) == {"field": {"differs" if of_f else "agrees"}}
    assert kinds(verification._field(one, Dynamics.of((x,), (-x,)), states)) == {"field": {"differs"}}


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (1.0, {"residual": {"agrees"}, "branch": {"agrees"}}),
        (1.2, {"residual": {"differs"}, "branch": {"agrees"}}),
        (0.6, {"residual": {"differs"}, "branch": {"agrees"}}),  # f + 2Dp = -2 + 2·1.2 at the attractor
        (0.4, {"residual": {"differs"}, "branch": {"differs"}}),
        (0.0, {"branch": {"differs"}}),  # V = const solves the equation
        (-1.0, {"branch": {"differs"}}),
    ],
)
def test_a_formula_is_judged_by_residual_and_branch(landscape: Landscape, factor: float, said: Any) -> None:
    well = landscape.wells[0]
    assert well is not None
    other = replace(well, coefficients=factor * well.coefficients)
    assert kinds(verification._formula(0, other, landscape.dynamics, well.points)) == said
    of_others = verification._formula(0, other, landscape.dynamics, np.zeros((3, 2)))
    assert kinds(of_others) == {"residual": {"open"}}


def test_a_formula_is_judged_at_states_of_its_own_well(landscape: Landscape) -> None:
    well = landscape.wells[0]
    assert well is not None and well.attractor[0] < 0
    x = np.linspace(-1.8, 1.8, 361)[:, None]
    own = (x < 0) & ((x**2 - 1) ** 2 / 4 < 0.9 * well.level)
    own[np.argmin(np.abs(x - well.attractor))] = False  # where V rises on the way
    findings = verification._formula(0, well, landscape.dynamics, x)
    counts = [remark.values["count"] for _, remark in findings if remark.code == "workflow.residual"]
    assert counts == [own.sum()]


def lowest(landscape: Landscape, **changed: Any) -> Landscape:
    """With a change of its first exit, and the others higher."""
    first, *others = landscape.transitions
    higher = [replace(way, barrier=3 * way.barrier) for way in others]
    return replace(landscape, transitions=(replace(first, **changed), *higher))


def judged(landscape: Landscape, x: np.ndarray) -> tuple[str, dict[str, Any]]:
    """What is found of the lowest barrier."""
    ((kind, remark),) = verification._barrier(landscape, x)
    return kind, dict(remark.values)


@pytest.mark.parametrize(
    ("barrier", "said"), [(0.48, "agrees"), (0.52, "agrees"), (0.47, "differs"), (0.53, "differs")]
)
def test_a_barrier_of_one_state_agrees_with_a_quadrature(
    landscape: Landscape, barrier: float, said: str
) -> None:
    kind, values = judged(lowest(landscape, barrier=barrier), landscape.dynamics.box.T)
    assert kind == said and values["barrier"] == barrier and values["method"] == "quadrature"
    assert values["other"] == pytest.approx(0.5, rel=1e-6)


def test_a_barrier_that_nothing_else_gives_is_left_open(landscape: Landscape) -> None:
    x = landscape.dynamics.box.T
    assert kinds(verification._barrier(None, x)) == {"barrier": {"open"}}
    assert judged(replace(landscape, transitions=()), x)[0] == "open"
    endless = [replace(way, barrier=np.inf) for way in landscape.transitions]
    assert judged(replace(landscape, transitions=tuple(endless)), x)[0] == "open"


@pytest.mark.parametrize(("dimension", "method", "within"), [(2, "mesh", 1e-3), (3, "path", 1e-4)])
def test_barriers_of_more_states_have_another_method_too(dimension: int, method: str, within: float) -> None:
    found = landscape_from_equations(turned(dimension), formulas=False)
    kind, values = judged(found, turned(dimension).box.T)
    assert kind == "agrees" and values["method"] == method
    assert values["other"] == pytest.approx(0.5, rel=within)
    if dimension == 3:
        assert judged(lowest(found, path=None), turned(dimension).box.T)[0] == "open"


def test_the_action_of_a_chain_is_in_the_metric_of_d() -> None:
    x, y = sympy.symbols("x y", real=True)
    dynamics = Dynamics.of((x, y), (-x, -3 * y), diffusion=[[2, 0], [0, 0.5]])
    chain = np.linspace(0, 1, 200)[:, None]
    # U = x²/2 + 6y², uphill along an axis; downhill it costs nothing.
    for end, expected in (((1.0, 0.0), 0.5), ((0.0, 1.0), 6.0)):
        assert verification._action(dynamics, chain * end) == pytest.approx(expected, rel=1e-4)
        assert verification._action(dynamics, (chain * end)[::-1]) == pytest.approx(0, abs=1e-9)
