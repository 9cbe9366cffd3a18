"""A learned landscape beside that of the equations: exact differences, and what one of both has not."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import sympy

from siq.data.recordings import Recordings
from siq.quasipotential.landscape import Landscape, LandscapeOptions
from siq.quasipotential.landscape_assembly import EquationSettings, landscape_from_equations
from siq.quasipotential.landscape_comparison import _check_same_noise, differences
from siq.quasipotential.landscape_files import landscape_data
from siq.remarks import Remark, sentence
from siq.report.landscape import comparison_table
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.workflow.study import PipelineSettings
from siq.workflow.tables import COLUMNS
from workflow import comparison

X, Y = sympy.symbols("x y", real=True)
NOISE = 0.05
MISSED, FURTHER, CYCLE = (
    sentence(Remark(f"quasipotential.{code}"))
    for code in ("not_shown_by_trajectories", "not_of_the_equations", "limit_cycle_not_compared")
)


def paths_of(formulas: tuple[sympy.Expr, ...], domain: list[tuple[float, float]]) -> Landscape:
    """The landscape of equations without formulas of U."""
    states = (X, Y)[: len(formulas)]
    system = Dynamics.of(states, formulas, domain=domain)
    return landscape_from_equations(system, EquationSettings(), formulas=False)


def wells(height: float = 1.0, *, low: float = -2.0) -> Landscape:
    """``ẋ = a x - x³``: a barrier of U of a²/2 and a prefactor of 2π/(√2 a), between ±√a."""
    return paths_of((height * X - X**3,), [(low, 2.0)])


def test_the_differences_are_those_of_the_formulas():
    table = wells(1.1).compare_with(wells(), noise=NOISE).set_index(["item", "quantity"])
    for way in ("A1 to A2", "A2 to A1"):
        assert table.loc[(way, "barrier"), "equations"] == pytest.approx(0.5, rel=1e-6)
        assert table.loc[(way, "barrier"), "relative_difference"] == pytest.approx(1.21 - 1, rel=1e-5)
        assert table.loc[(way, "prefactor"), "relative_difference"] == pytest.approx(1 / 1.1 - 1, rel=1e-3)
    times = table.loc[("A1", "mean time")]
    # The next order of the law, of V = x⁴/4 - a x²/2, is 1 + (3/8) ε/ΔU.
    further = (1 + 3 / 8 * NOISE / 0.605) / (1 + 3 / 8 * NOISE / 0.5)
    assert times["relative_difference"] == pytest.approx(further * np.exp(0.105 / NOISE) / 1.1 - 1, rel=2e-3)
    assert times["noise"] == NOISE and set(table["note"]) == {""}


def test_what_trajectories_do_not_show_is_missed_and_what_they_show_beside_is_told():
    both, one = wells(), wells(low=0.5)
    missed = one.compare_with(both).set_index("item")
    assert list(missed[missed["note"] == MISSED].index) == ["A1 to A2", "A2 to A1", "A1"]
    further = both.compare_with(one)
    assert set(further.loc[further["note"] == FURTHER, "item"]) == {
        "A1 to a further state",
        "a further state to A1",
    }
    assert further["relative_difference"].isna().all()


def test_an_attractor_next_to_the_saddle_of_the_equations_is_none_of_theirs():
    near = wells(0.01)  # at ±0.1, with the saddle of the equations between them
    assert (near.compare_with(wells())["note"] != "").all()


def test_landscapes_of_different_states_are_refused():
    with pytest.raises(ValueError, match="different states"):
        wells().compare_with(paths_of((X - X**3, -Y), [(-2, 2), (-1, 1)]))


@pytest.mark.parametrize(
    ("diffusion", "shown"),
    [
        (np.array([[2.0]]), r"equations have \[\[1\.0\]\], the trajectories \[\[2\.0\]\]; give both"),
        ([[1 + X**2 / 4]], r"equations have \[\[1\.0\]\] at \(.*1\), the trajectories \[\[1\.25\]\]"),
    ],
)
def test_landscapes_of_different_noise_are_refused(diffusion: object, shown: str) -> None:
    system = Dynamics.of((X,), (X - X**3,), diffusion=diffusion, domain=[(-2, 2)])  # type: ignore[arg-type]
    other = landscape_from_equations(system, EquationSettings(), formulas=False)
    with pytest.raises(ValueError, match=shown):
        other.compare_with(wells())
    assert (other.compare_with(other)["relative_difference"] == 0).all()


def test_noise_in_two_states_is_compared_in_its_own_unit() -> None:
    """An entry that is not on the diagonal counts, however small a state's noise is; rounding does not."""
    matrix, states = np.array([[1.0, 3e-5], [3e-5, 1e-8]]), np.zeros((1, 2))
    one = Dynamics.of((X, Y), (-X, -Y), diffusion=matrix)
    _check_same_noise(one, one.with_diffusion(Diffusion(matrix * (1 + 1e-12))), states, found=None)
    for changed in (np.diag(np.diag(matrix)), np.diag([0.0, 1e-8]), np.eye(2)):
        with pytest.raises(ValueError, match="D is not the same"):
            _check_same_noise(one, one.with_diffusion(Diffusion(changed)), states, found=None)


def test_a_limit_cycle_is_named_and_not_compared():
    radius = X**2 + Y**2
    cycle = paths_of((X * (1 - radius) - Y, Y * (1 - radius) + X), [(-1.6, 1.6)] * 2)
    (told,) = differences(cycle, cycle)
    assert told["note"] == CYCLE and told["item"] == "A1"


def test_what_was_learned_is_within_its_errors_and_what_it_states_is_taken():
    t, draw = np.linspace(0, 3, 61), np.random.default_rng(0)
    starts = draw.uniform(-1.5, 1.5, (60, 1))
    x = starts / np.sqrt(starts**2 + (1 - starts**2) * np.exp(-2 * t))  # ẋ = x - x³
    learned = Landscape.from_recordings(Recordings.from_arrays(t, x[:, :, None], names=["x"]))
    barriers = learned.compare_with(wells()).query("quantity == 'barrier'")
    assert (barriers["relative_difference"].abs() < 1e-3).all() and len(barriers) == 2


def test_the_step_names_the_run_and_says_why_there_is_nothing_to_compare():
    settings = PipelineSettings(seed=0, landscape=LandscapeOptions(noise_intensities=(NOISE,)))
    found = wells()
    data = landscape_data(wells(1.1))
    table = comparison.run_beside_equations(settings, found.dynamics, [data, None, data])
    assert list(table.columns) == list(COLUMNS["beside_equations"])
    assert list(table.groupby("run").size()) == [6, 1, 6]
    assert list(table.loc[table["run"] == 1, "note"]) == ["the run has no landscape"]
    nowhere = Dynamics.of((X,), (X,), domain=[(-1, 1)])
    (row,) = comparison.run_beside_equations(settings, nowhere, [data]).itertuples()
    assert row.run == -1 and row.note.startswith("the equations have no landscape: ")


def test_the_page_says_the_largest_difference():
    settings = PipelineSettings(seed=0, landscape=LandscapeOptions(noise_intensities=(NOISE,)))
    found = wells()
    near = landscape_data(wells(1.01))
    far = landscape_data(wells(1.1))
    several = comparison.run_beside_equations(settings, found.dynamics, [near, far])
    shown = comparison_table(several)
    assert len(shown) == 6 and shown["largest difference"].iloc[0] == "21 %"
    alone = comparison_table(several[several["run"] == 0])
    assert alone["difference"].iloc[0] == "+2.0 %"
    assert pd.isna(several["in_errors"]).all()  # equations state no errors
