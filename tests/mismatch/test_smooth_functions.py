"""Functions of two coordinates without a name: found, fitted, stated and drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import sympy
from siq.mismatch.surfaces import Surface, needed, with_surface

from siq.dynamics.dynamics import Diffusion, Dynamics
from siq.dynamics.parametric import Signals
from siq.mismatch.diagnosis import solve_case
from siq.report.plots.described import plot_described
from tests.mismatch.foreign_cases import ForeignCase, course, table_of

CENTRES = np.array([[0.0, 0.0], [1.0, 0.5], [-0.5, 2.0]])
WIDTHS = np.array([[1.0, 2.0], [0.5, 0.5], [2.0, 1.0]])


def test_a_surface_is_the_sum_of_its_bumps() -> None:
    x, v = sympy.symbols("x v", real=True)
    model = Dynamics(("x", "v"), (v, -x), Diffusion.identity(2))
    surface = Surface("v", ("x", "v"), CENTRES, WIDTHS)
    candidate = with_surface(model, surface)
    assert candidate.equations == ("v",) and candidate.coordinate == "x, v"
    heights = np.array([0.7, -1.3, 2.0])
    known = dict(zip(candidate.amplitudes, heights, strict=True))
    values = np.array([known.get(each.name, each.value) for each in candidate.model.parameters])
    states = np.random.default_rng(3).normal(size=(2, 40))
    empty = np.zeros((0, 40))
    rates = candidate.model.functions.rates(states, Signals(empty, empty, empty, np.zeros(40)), values)
    np.testing.assert_allclose(rates[1] + states[0], heights @ surface.values(states), rtol=1e-5)
    np.testing.assert_array_equal(rates[0], states[1])


def test_bumps_of_two_surfaces_are_taken_once() -> None:
    surface = Surface("v", ("x", "v"), CENTRES, WIDTHS)
    both = surface.some([2, 0]).with_bumps(surface.some([0, 1]))
    np.testing.assert_array_equal(both.centres, CENTRES[[2, 0, 1]])
    np.testing.assert_array_equal(both.widths, WIDTHS[[2, 0, 1]])


def test_columns_are_taken_as_long_as_they_earn_their_place() -> None:
    rng = np.random.default_rng(5)
    columns = rng.normal(size=(400, 60))
    left = 3.0 * columns[:, 17] - 2.0 * columns[:, 4] + rng.normal(size=400)
    chosen, odds = needed(left, columns, count=400)
    assert chosen == [17, 4] and odds > 100


def test_noise_asks_for_next_to_nothing() -> None:
    rng = np.random.default_rng(6)
    found = [len(needed(rng.normal(size=300), rng.normal(size=(300, 80)), count=300)[0]) for _ in range(100)]
    assert np.mean(found) < 0.05


CARD = {
    "name": "swirl",
    "states": {"x": {"unit": "mm"}, "y": {"unit": "mm"}},
    "parameters": {"a": {"value": 0.2, "unit": "1/s"}, "w": {"value": 2.0, "unit": "1/s"}},
    "equations": {"x": "-a*x + w*y", "y": "-a*y - w*x"},
}


def bumps(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Two bumps in x and y, which are no function of x times y, nor one of y times x."""
    return 1.5 * np.exp(-(((x - 0.4) / 0.5) ** 2) - ((y - 0.5) / 0.4) ** 2) - 1.2 * np.exp(
        -(((x + 0.5) / 0.4) ** 2) - ((y - 0.3) / 0.5) ** 2
    )


def test_what_depends_on_two_coordinates_gets_a_surface(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    t = np.arange(0, 6, 0.1)
    begin = rng.uniform(-1.5, 1.5, size=(2, 10))
    x, y = course(
        lambda t, s: np.stack([-0.2 * s[0] + 2.0 * s[1] + bumps(*s), -0.2 * s[1] - 2.0 * s[0]]), begin, t,
        within=8,
    ).transpose(1, 2, 0)  # fmt: skip
    noisy = {name: each + 0.01 * rng.normal(size=each.shape) for name, each in (("x", x), ("y", y))}
    case = ForeignCase(CARD, table_of(t, noisy), {"generic": False}).read(tmp_path)
    verdict = solve_case(case).statement.as_data()
    assert verdict["verdict"] == "unexplained"
    (part,) = verdict["described"]
    assert part["kind"] == "surface" and part["coordinates"] == ["x", "y"]
    assert verdict["location"]["coordinate"] == "x, y" and list(verdict["location"]["equations"]) == ["x"]
    assert verdict["fit"]["augmented"] < 0.3 * verdict["fit"]["recalibrated"]
    surface = part["surface"]
    x, y = np.meshgrid(*map(np.array, surface["at"]), indexing="ij")
    value = np.array(surface["value"])
    near = (np.abs(x) < 0.8) & (np.abs(y) < 0.8)
    assert np.sqrt(np.mean((value - bumps(x, y))[near] ** 2)) < 0.15
    figure = plot_described(verdict["described"], units={"x": "mm"}, time_unit="s")
    assert figure is not None
    assert figure.axes[0].get_xlabel() == "$x$ (mm)"
    assert figure.axes[1].get_ylabel() == "added in the equation of $x$"
