"""Landscapes against a parameter: exact barriers, times, weights and names of wells; what has no answer."""

import numpy as np
import pytest
import sympy
from pydantic import TypeAdapter

from siq.errors import InputError
from siq.quasipotential import transitions
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.path_chains import MinimumActionPath
from siq.systems.cards import load_system
from siq.systems.cycles import Cycle
from siq.systems.dynamics import Dynamics
from siq.workflow.study import PipelineSettings
from siq.workflow.sweep import Sweep, SweptPoint, _with_parameters, collected, point_at, sweep
from workflow.files import write

h, a, x, y = sympy.symbols("h a x y", real=True)
FOLD = 2 / (3 * np.sqrt(3))
CARD = """\
name: tilted
states: {x: {domain: [-2, 2]}}
parameters:
  h: {value: 0}
  s: {value: 1}
equations: {x: "h + x - x**3"}
diffusion: ["s**2"]
"""


def cusp(**options) -> Dynamics:
    return Dynamics.of((x,), (h + x - x**3,), domain=[(-2, 2)], parameters={h: 0.0}, **options)


def exact(value: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Equilibria, and U = 2V at them, of ẋ = h + x - x³; and f' there."""
    roots = np.sort(np.roots([-1, 0, 1, value]).real)
    return roots, 2 * (roots**4 / 4 - roots**2 / 2 - value * roots), 1 - 3 * roots**2


@pytest.fixture(scope="module")
def found() -> Sweep:
    return sweep(cusp(), "h", [-0.5, -0.2, 0.1, 0.2, 0.5], noise=0.04)


def test_barriers_times_and_weights_are_those_of_the_integral(found):
    for value in (-0.2, 0.1, 0.2):
        rows = found.table[found.table["value"] == value].sort_values("well")
        _, heights, slopes = exact(value)
        barriers = heights[1] - heights[[0, 2]]
        assert rows["barrier"].to_numpy() == pytest.approx(barriers, rel=1e-5)
        times = 2 * np.pi / np.sqrt(slopes[1] * -slopes[[0, 2]]) * np.exp(barriers / 0.04)
        known = barriers > 0.04
        assert rows["mean_time"].to_numpy()[known] == pytest.approx(times[known], rel=1e-3)
        weights = np.exp(-heights[[0, 2]] / 0.04) / np.sqrt(-slopes[[0, 2]])
        assert rows["weight"].to_numpy() == pytest.approx(weights / weights.sum(), rel=1e-3)
        assert rows["relaxation"].to_numpy() == pytest.approx(-slopes[[0, 2]], rel=1e-8)


def test_a_well_keeps_its_number_until_it_folds(found):
    wells = {value: set(rows["well"]) for value, rows in found.table.groupby("value")}
    assert wells == {-0.5: {0}, -0.2: {0, 1}, 0.1: {0, 1}, 0.2: {0, 1}, 0.5: {1}}
    assert list(found.bifurcations["kind"]) == ["fold", "fold"]
    assert found.bifurcations["value"].to_numpy() == pytest.approx([-FOLD, FOLD], abs=1e-10)
    branch = found.branches
    assert branch[branch["well"] == 0]["value"].max() == pytest.approx(FOLD, abs=0.01)
    assert set(branch[branch["well"] < 0]["unstable"]) == {1}


def test_a_point_is_the_landscape_at_its_value(found):
    alone = Landscape.from_equations(_with_parameters(cusp(), ["h"], [0.2]))
    row = found.table[(found.table["value"] == 0.2) & (found.table["well"] == 0)].iloc[0]
    assert row["barrier"] == alone.barriers()["barrier"].min()


def test_two_wells_that_meet_in_a_pitchfork_are_two():
    fork = Dynamics.of((x, y), (a * x - x**3, -y), domain=[(-2, 2), (-1, 1)], parameters={a: 1.0})
    found = sweep(fork, "a", [-0.5, 0.5, 1.0])
    assert list(found.bifurcations["kind"]) == ["branch point"]
    assert found.bifurcations["value"].iloc[0] == pytest.approx(0, abs=1e-10)
    both = found.table[found.table["value"] > 0]
    assert [len(set(rows["well"])) for _, rows in both.groupby("value")] == [2, 2]
    assert both["barrier"].to_numpy() == pytest.approx(both["value"] ** 2 / 2, rel=1e-5)
    alone = set(found.table[found.table["value"] < 0]["well"])
    assert len(alone) == 1 and not alone & set(both["well"])


def test_a_bad_value_has_a_row_that_says_why_and_the_others_go_on():
    """At a = 0 nothing rests; at h = 0 the equation has no value."""
    poor = Dynamics.of((x,), (a - sympy.exp(-x),), domain=[(-5, 5)], parameters={a: 1.0})
    table = sweep(poor, "a", [-1.0, 1.0]).table
    assert list(table["well"]) == [-1, -1] and "no stable equilibrium" in table["note"].iloc[0]
    gone = Dynamics.of((x,), (1 / h - x,), domain=[(0, 5)], parameters={h: 1.0})
    table = sweep(gone, "h", [0.0, 0.5, 1.0]).table
    assert list(table["well"]) == [-1, 0, 0] and "has no value" in table["note"].iloc[0]


def test_a_second_parameter_gives_a_map():
    both = Dynamics.of((x,), (h + a * x - x**3,), domain=[(-2, 2)], parameters={h: 0.0, a: 1.0})
    found = sweep(both, "h", [0.0, 0.1], second=("a", [-0.5, 1.0]))
    counts = found.table.groupby(["value", "second_value"]).size().to_dict()
    assert counts == {(0.0, -0.5): 1, (0.0, 1.0): 2, (0.1, -0.5): 1, (0.1, 1.0): 2}
    assert found.branches.empty and found.bifurcations.empty


def test_the_curves_of_a_map_are_found_between_its_values():
    brusselator = Dynamics.of(
        (x, y), (a - (h + 1) * x + x**2 * y, h * x - x**2 * y), domain=[(0.1, 5), (0.1, 5)],
        parameters={a: 1.0, h: 2.0},
    )  # fmt: skip
    curves = sweep(brusselator, "a", [0.8, 1.2], second=("h", [1.2, 3.0])).curves
    assert set(curves["kind"]) == {"Hopf"} and set(curves["curve"]) == {0}
    assert curves["second_value"].to_numpy() == pytest.approx(1 + curves["value"].to_numpy() ** 2, abs=1e-9)
    assert curves["frequency"].to_numpy() == pytest.approx(curves["value"].to_numpy(), abs=1e-9)


def test_parameters_in_d_follow_from_the_card(write):
    """D = s²: U and its barriers are as 1/s², at every value."""
    card = write(CARD, "tilted.yaml")
    table = sweep(card, "s", [1.0, 2.0]).table
    assert table["barrier"].to_numpy() == pytest.approx([0.5, 0.5, 0.125, 0.125], rel=1e-5)
    with pytest.raises(InputError, match=r"D depends on s.*give the card"):
        sweep(load_system(card), "s", [1.0, 2.0])


def test_a_parameter_that_is_not_there_is_told_with_those_that_are():
    with pytest.raises(InputError, match="no parameter 'k'; use one of h"):
        sweep(cusp(), "k", [1.0])
    with pytest.raises(ValueError, match="finite"):
        sweep(cusp(), "h", [])


def test_a_point_is_read_as_it_was_written(tmp_path):
    point = point_at(cusp(), ("h",), (0.2,), seed=0)
    adapter = TypeAdapter(SweptPoint)
    write("point", tmp_path / "h=0.2.json", point, PipelineSettings())
    assert adapter.validate_json((tmp_path / "h=0.2.json").read_bytes()) == point
    again = collected(cusp(), ("h",), [point], noise=0.04)
    assert len(again.table) == 2 and len(again.ways) == 2


def straight(_, start, over, *further, **options):
    """A path in the place of that of least action, which takes ten times as long to find as all else."""
    points = np.linspace(*(one.points[0] if isinstance(one, Cycle) else one for one in (start, over)), 3)
    return MinimumActionPath(points, 0 * points, np.linspace(0, 1, 3), 1.0, 0.0, 0.0, converged=True)


def test_beside_a_limit_cycle_nobody_says_that_a_well_is_never_left(monkeypatch):
    """r' = r (r² - 1) (4 - r²), about a focus: an unstable cycle parts it from a stable one."""
    monkeypatch.setattr(transitions, "transition_path", straight)
    r = x**2 + y**2
    ring = Dynamics.of(
        (x, y), (x * (r - a) * (4 - r) - y, y * (r - a) * (4 - r) + x), domain=[(-3, 3), (-3, 3)],
        parameters={a: 1.0},
    )  # fmt: skip
    row = sweep(ring, "a", [1.0], noise=0.01).table.iloc[0]
    assert (
        np.isnan(row["weight"]) and row["well"] == 0 and "cycle" in row["note"] and row["barrier"] != np.inf
    )
    assert sweep(cusp(), "h", [0.5]).table["barrier"].iloc[0] == np.inf
