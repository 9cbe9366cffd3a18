"""Visits and densities by the Fokker–Planck operator: quadrature in one state, simulation in two."""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from scipy.integrate import cumulative_trapezoid

from siq.data.kinetics import continued_visits
from siq.data.recordings import Recordings
from siq.data.states import DwellCount
from siq.data.stationarity import runs_of
from siq.errors import NumericalFailure
from siq.quasipotential.fokker_planck import CellProcess
from siq.quasipotential.occupancy import _core_of, _VisitProcess
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.escapes import Neighbourhood

pytestmark = pytest.mark.portable

x, y = sympy.symbols("x y", real=True)
TILTED = Dynamics(("x",), (x - x**3 + sympy.Rational(1, 10),), Diffusion.identity(1))
WELLS = np.sort(np.roots([-1, 0, 1, 0.1]).real)[[0, 2]]
BOX = np.array([[-2.0, 2.0]])
HALF = 0.1  # width of a core


CORES = [Neighbourhood(well, np.eye(1), HALF**2 / 2) for well in WELLS[:, None]]


@pytest.mark.parametrize("intensity", [0.05, 0.15, 0.4])
@pytest.mark.parametrize("graded", [False, True])
def test_one_state_by_quadrature(intensity: float, graded: bool) -> None:
    graded_noise = Diffusion.of_formulas((x,), (((1 + x**2 / 2) ** 2,),))
    system = TILTED.with_diffusion(graded_noise) if graded else TILTED
    process = _VisitProcess(system, intensity, BOX, CORES)
    grid = np.linspace(*BOX[0], 200_001)
    spread = (1 + grid**2 / 2) ** 2 if graded else np.ones_like(grid)
    force = 2 * (grid - grid**3 + 0.1) / (intensity * spread)
    scale = np.exp(cumulative_trapezoid(force, grid, initial=0))  # of p D
    density = scale / spread
    below = cumulative_trapezoid(density, grid, initial=0)
    width = process.points[1, 0] - process.points[0, 0]
    expected = np.interp(process.points[:, 0], grid, density / below[-1])
    assert np.abs(process.density / width - expected).max() < 1e-4 * expected.max()
    between = (grid >= WELLS[0] + HALF) & (grid <= WELLS[1] - HALF)
    for well, mass in enumerate((below, below[-1] - below)):
        exact = 2 / intensity * np.trapezoid((mass / scale)[between], grid[between])
        assert process.means[well] == pytest.approx(exact, rel=3e-3)


def test_cells_where_a_formula_of_the_noise_is_none_are_left_out() -> None:
    """D = 1 - x² on a wider box: Jacobi's process, with the density (1 - x²)^(1/ε - 1)."""
    system = Dynamics(("x",), (-x,), Diffusion.of_formulas((x,), ((1 - x**2,),)))
    intensity = 0.4
    process = _VisitProcess(system, intensity, BOX, [])
    place = process.points[:, 0]
    assert np.abs(place).max() < 1 and np.abs(place).max() > 0.99
    expected = (1 - place**2) ** (1 / intensity - 1)
    assert process.density == pytest.approx(expected / expected.sum(), rel=1e-3, abs=1e-6)
    beyond = system.with_diffusion(Diffusion.of_formulas((x,), ((x**2 - 9,),)))
    with pytest.raises(NumericalFailure, match="does not reach every state"):
        _VisitProcess(beyond, intensity, BOX, [])


@pytest.mark.parametrize("mixed", [0.0, 0.5])
def test_two_states_with_mixed_noise_have_the_density_of_a_linear_system(mixed: float) -> None:
    matrix = np.array([[1.0, mixed], [mixed, 1.0]])
    system = Dynamics(("x", "y"), (-x, -y), Diffusion(matrix))
    process = _VisitProcess(system, 0.5, np.array([[-2.5, 2.5], [-2.5, 2.5]]), [], cells=80)
    covariance = np.cov(process.points.T, aweights=process.density)
    assert np.abs(covariance - 0.25 * matrix).max() < 0.005


def test_two_states_against_a_simulation() -> None:
    system = Dynamics(("x", "y"), (x - x**3 - x * y**2, -(1 + x**2) * y), Diffusion.identity(2))
    intensity, step, steps, walkers = 0.4, 0.01, 20_000, 100
    generator = np.random.default_rng(3)
    state = np.stack([np.sign(generator.standard_normal(walkers)), np.zeros(walkers)], axis=1)
    seen = np.empty((steps, walkers, 2))
    for k in range(steps):
        seen[k] = state
        kick = np.sqrt(intensity * step) * generator.standard_normal(state.shape)
        state = state + step * system.drift(state) + kick
    about = [Neighbourhood(well, 2 * np.eye(2), 0.2) for well in np.array([[-1.0, 0.0], [1.0, 0.0]])]
    recordings = Recordings.from_arrays(step * np.arange(steps), seen.transpose(1, 0, 2), names=["x", "y"])
    visits = continued_visits(_core_of(about, recordings.values), runs_of(recordings))
    counts = DwellCount.of_visits(recordings.t, visits, runs_of(recordings))
    process = _VisitProcess(system, intensity, np.array([[-2.4, 2.4], [-2.2, 2.2]]), about, cells=100)
    for well, count in enumerate(counts):
        error = np.hypot(count.visits**-0.5, 0.03)  # of the simulation's own step, and of the cells
        assert process.means[well] == pytest.approx(count.mean, rel=3 * error)


def test_noise_that_is_too_weak_is_refused() -> None:
    with pytest.raises(NumericalFailure, match="too weak"):
        _VisitProcess(TILTED, 1e-9, BOX, [])


def test_noise_that_does_not_reach_a_state_is_refused() -> None:
    system = Dynamics(("x", "y"), (y, x - x**3 - y), Diffusion(np.diag([0.0, 1.0])))
    with pytest.raises(NumericalFailure, match="does not reach"):
        _VisitProcess(system, 0.1, np.array([[-2.0, 2.0], [-2.0, 2.0]]), [])


@pytest.mark.parametrize(
    ("intensity", "which", "box", "reason"),
    [
        (0.03, 1, BOX, "rounding"),
        (0.015, 1, BOX, "rounding"),
        (0.1, 0, np.array([[-1.1, 2.0]]), "edge of the domain"),
    ],
)
def test_times_lost_in_rounding_and_wells_at_a_wall_are_no_numbers(
    intensity: float, which: int, box: np.ndarray, reason: str
) -> None:
    """ΔU/ε is 24 and 47 for the second well; cells gave 10¹⁶ for 10²², and took a wall for nature's."""
    with pytest.raises(NumericalFailure, match=reason):
        CellProcess(TILTED, intensity, box).mean_time(CORES[which], [CORES[1 - which]])


def test_long_times_of_one_state_are_those_of_quadrature() -> None:
    intensity = 0.06
    time, error = CellProcess(TILTED, intensity, BOX).mean_time(CORES[1], CORES[:1])
    grid = np.linspace(*BOX[0], 400_001)
    u = 2 * (grid**4 / 4 - grid**2 / 2 - 0.1 * grid) / intensity
    beyond = cumulative_trapezoid(np.exp(u[-1] - u[::-1]), -grid[::-1], initial=0)[::-1]
    within = (grid > WELLS[0] + HALF) & (grid < WELLS[1])
    exact = np.trapezoid((np.exp(u - u[-1]) * beyond)[within], grid[within]) * 2 / intensity
    assert time == pytest.approx(exact, rel=5e-3) and error < 1e-3
