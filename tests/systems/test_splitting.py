"""Mean times by splitting: quadrature in one state, and a landscape's own check."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
import sympy

from benchmarks.splitting import prepared
from siq.quasipotential.fokker_planck import CellProcess
from siq.quasipotential.landscape import Landscape, LandscapeOptions
from siq.quasipotential.landscape_assembly import landscape_from_equations
from siq.quasipotential.landscape_files import landscape_data, landscape_from_data
from siq.remarks import Remark, sentence
from siq.systems.dynamics import Dynamics
from siq.systems.escapes import split_escapes

x, y, v = sympy.symbols("x y v", real=True)


def height(place: np.ndarray) -> np.ndarray:
    """A coordinate that is no committor: the place itself, in units in which p falls by about e."""
    return 8 * place[0]


@pytest.mark.slow
def test_a_time_in_one_state_is_that_of_quadrature_with_any_coordinate() -> None:
    dynamics, intensity, cores, exact = prepared(4.0)
    found = split_escapes(
        dynamics, cores[0], cores[1:], intensity=intensity, progress=height,
        generator=np.random.default_rng(5),
    )  # fmt: skip
    assert found.relative_error < 0.15
    assert np.log(found.value / exact) == pytest.approx(0.0, abs=3.5 * found.relative_error)
    assert found.lower < found.value < found.upper


@pytest.fixture(scope="module")
def landscape() -> Landscape:
    """Two wells in a plane with a force that circulates, exact barriers of 0.5."""
    slope = (x**3 - x, y)
    equations = (-slope[0] - 0.8 * slope[1], -slope[1] + 0.8 * slope[0])
    system = Dynamics.of((x, y), equations, domain=[(-1.8, 1.8), (-1.4, 1.4)])
    return landscape_from_equations(system, formulas=False)


def test_law_operator_and_check_agree(landscape: Landscape) -> None:
    table = landscape.verify_times(noise=0.1)
    assert table["attractor"].tolist() == [0, 1]
    assert (table["relative_error"] < 0.15).all() and (table["operator_error"] < 0.01).all()
    apart = np.log(table["check"] / table["operator"]) / table["relative_error"]
    assert apart.abs().max() < 3.5
    assert np.log(table["law"] / table["operator"]).abs().max() < table["law_error"].max()


def test_where_the_path_arrives_askew_the_error_of_the_law_says_so() -> None:
    """FitzHugh and Nagumo's equations, of which the law gives times too short by a third."""
    flow = (x - x**3 - v - sympy.Rational(43, 1000), sympy.Rational(73, 200) * x - 1.133 * v + 0.004)
    system = Dynamics.of((x, v), flow, diffusion=np.diag([1.0, 0.53]), domain=[(-1.8, 1.8), (-1.2, 1.2)])
    found = landscape_from_equations(system, formulas=False)
    noise = min(way.barrier for way in found.transitions) / 5
    law, cores = found.dwell_times(noise=noise), found._cores(noise)
    exact = [CellProcess(system, noise, found._box).mean_time(cores[k], [cores[1 - k]])[0] for k in (0, 1)]
    apart = np.abs(np.log(law["mean_time"] / exact))
    assert apart.min() > 0.2 and (apart < 1.3 * law["law_error"]).all()


def test_a_committor_and_a_dissipation_of_a_landscape(landscape: Landscape) -> None:
    flow = landscape.committor(0, 1, noise=0.1)
    middle = flow.process.interpolated(flow.committor)(np.zeros((2, 1)))[0]
    assert middle == pytest.approx(0.5, abs=0.01)  # by symmetry
    assert flow.mean_time == pytest.approx(landscape.committor(1, 0, noise=0.1).mean_time, rel=1e-3)
    # ∇·g = 0, so that Σ̇ = (2/ε) ⟨g²⟩ with the density exp(-2V/ε).
    axes = np.meshgrid(np.linspace(-1.8, 1.8, 400), np.linspace(-1.4, 1.4, 400))
    weight = np.exp(-20 * (axes[0] ** 4 / 4 - axes[0] ** 2 / 2 + axes[1] ** 2 / 2))
    squares = 0.64 * ((axes[0] ** 3 - axes[0]) ** 2 + axes[1] ** 2)
    found = landscape.dissipation(noise=0.1)
    assert found.value == pytest.approx(20 * np.average(squares, weights=weight), rel=0.02)


@pytest.mark.slow
def test_noise_on_one_state_is_split_along_paths() -> None:
    system = Dynamics.of((x, v), (v, x - x**3 - v), diffusion=np.diag([0.0, 1.0]), domain=[(-2, 2), (-2, 2)])
    table = landscape_from_equations(system, formulas=False).verify_times(noise=0.2)
    assert table["operator"].isna().all()
    assert np.log(table["check"] / table["law"]).abs().max() < 0.5  # the law is off by a third or so


def test_a_study_may_ask_for_checked_times_and_finds_them_in_file_and_report(landscape: Landscape) -> None:
    asked = LandscapeOptions(noise_intensities=(0.2,), verify_times=True)
    found = landscape.with_checked_times(asked)
    table = found.checked_times
    assert table is not None and table["noise"].tolist() == [0.2, 0.2]
    data = json.loads(json.dumps(landscape_data(found), allow_nan=False))
    stored = landscape_from_data(data, landscape.dynamics).checked_times
    pd.testing.assert_frame_equal(stored, table, check_dtype=False)
    assert "by three ways" in found.report() and "simulated" in found.report()
    assert landscape.with_checked_times(LandscapeOptions()).checked_times is None
    text = sentence(Remark("quasipotential.times_not_checked", {"noise": 0.2, "reason": "no path"}))
    assert text == "the times for ε = 0.2 were not checked: no path"
