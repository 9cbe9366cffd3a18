"""Committors, currents, rates and dissipation against quadrature, detailed balance and linear systems."""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from scipy.integrate import cumulative_trapezoid
from scipy.linalg import solve_continuous_lyapunov

from siq import Landscape, Recordings
from siq.errors import NumericalFailure
from siq.quasipotential.fokker_planck import CellProcess, Dissipation
from siq.systems.dynamics import Dynamics
from siq.systems.escapes import Neighbourhood

pytestmark = pytest.mark.portable

x, y, z = sympy.symbols("x y z", real=True)
HALF = 0.1  # width of a core


def about(*place: float) -> Neighbourhood:
    return Neighbourhood(np.array(place), np.eye(len(place)), HALF**2 / 2)


@pytest.mark.parametrize("intensity", [0.05, 0.2])
@pytest.mark.parametrize("graded", [False, True])
def test_one_state_by_quadrature(intensity: float, graded: bool) -> None:
    squared = 1 + x**2 / 2 if graded else sympy.Integer(1)
    system = Dynamics.of((x,), (x - x**3 + sympy.Rational(1, 10),), diffusion=((squared,),))
    process = CellProcess(system, intensity, np.array([[-2.0, 2.0]]))
    flow = process.between(about(-1.0), [about(1.0)])
    grid = np.linspace(-2.0, 2.0, 200_001)
    noise = sympy.lambdify(x, squared, "numpy")(grid) * np.ones_like(grid)
    exponent = cumulative_trapezoid(2 * (grid - grid**3 + 0.1) / (intensity * noise), grid, initial=0)
    density = np.exp(exponent) / noise
    density /= np.trapezoid(density, grid)
    between = np.abs(grid) <= 1 - HALF
    up = cumulative_trapezoid(np.where(between, np.exp(-exponent), 0.0), grid, initial=0)
    committor = up / up[-1]
    assert flow.committor == pytest.approx(np.interp(process.points[:, 0], grid, committor), abs=3e-3)
    flux = intensity / 2 * (density * noise * np.exp(exponent))[0] / up[-1]
    spent = np.trapezoid(density * (1 - committor), grid)
    assert flow.rate == pytest.approx(flux / spent, rel=5e-3)
    middle = np.abs(process.points[:, 0]) < 0.8
    assert flow.current[middle, 0] == pytest.approx(np.full(middle.sum(), flux), rel=5e-3)
    share = np.trapezoid(density * committor * (1 - committor), grid)
    assert flow.density.sum() * process.volume == pytest.approx(share, rel=5e-3)
    times = process.mean_times([about(1.0)])
    inner = cumulative_trapezoid(density, grid, initial=0)
    within = (grid >= -1.0) & (grid <= 1 - HALF)
    exact = 2 / intensity * np.trapezoid((inner / (density * noise))[within], grid[within])
    assert process.interpolated(times)(np.array([[-1.0]]))[0] == pytest.approx(exact, rel=5e-3)


def test_two_states_in_detailed_balance() -> None:
    """Back and forth are the same, the current is (ε/2) π ∇q, and as much arrives as leaves."""
    system = Dynamics.of((x, y), (x - x**3 - x * y**2, -(1 + x**2) * y))
    process = CellProcess(system, 0.2, np.array([[-2.0, 2.0], [-1.5, 1.5]]), cells=100)
    flow = process.between(about(-1.0, 0.0), [about(1.0, 0.0)])
    back = process.between(about(1.0, 0.0), [about(-1.0, 0.0)])
    assert flow.committor + back.committor == pytest.approx(np.ones(len(process.points)), abs=1e-9)
    assert flow.rate == pytest.approx(back.rate, rel=1e-6)
    assert flow.current == pytest.approx(-back.current, abs=1e-6 * np.abs(flow.current).max())
    committor = flow.committor.reshape(100, 100)
    slope = np.stack(np.gradient(committor, 0.04, 0.03), axis=-1).reshape(-1, 2)
    expected = 0.1 * process.density[:, None] / process.volume * slope
    between = (np.abs(process.points[:, 0]) < 0.7) & (np.abs(process.points[:, 1]) < 0.7)
    assert np.abs(flow.current - expected)[between].max() < 0.02 * np.abs(expected).max()
    # Through each line across passes what leaves.
    passing = flow.current[:, 0].reshape(100, 100).sum(axis=1)[30:70] * 0.03
    leaving = flow.rate * float(process.density @ back.committor)
    assert passing == pytest.approx(np.full(40, leaving), rel=1e-3)
    lines = Dissipation.of(system, 0.2, np.array([[-2.0, 2.0], [-1.5, 1.5]]))
    assert lines.value < 1e-3 and lines.lower < 1e-6


def exact_dissipation(matrix: np.ndarray, noise: np.ndarray, intensity: float) -> float:
    """Of ``dx = A x dt + √ε σ dW``: u = (A + (ε/2) D C⁻¹) x with the covariance C."""
    covariance = solve_continuous_lyapunov(matrix, -intensity * noise)
    current = matrix + intensity / 2 * noise @ np.linalg.inv(covariance)
    return float(2 / intensity * np.trace(np.linalg.inv(noise) @ current @ covariance @ current.T))


LINEAR = {
    "at rest": ([[-1.0, 0.0], [0.0, -2.0]], [[1.0, 0.0], [0.0, 3.0]], 4.0),
    "turning": ([[-1.0, 2.0], [-2.0, -1.0]], [[1.0, 0.0], [0.0, 1.0]], 3.0),
    "two temperatures": ([[-1.5, 0.5], [0.5, -1.5]], [[1.0, 0.0], [0.0, 4.0]], 5.0),
    "mixed noise": ([[-1.0, 1.0], [-1.0, -1.0]], [[1.0, 0.6], [0.6, 2.0]], 4.0),
    "three": ([[-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [1.0, 0.0, -1.0]], np.eye(3).tolist(), 2.2),
}


@pytest.mark.parametrize("name", LINEAR)
def test_dissipation_of_linear_systems(name: str) -> None:
    rows, noise, reach = LINEAR[name]
    matrix, states = np.array(rows), (x, y, z)[: len(rows)]
    formulas = tuple(sum(a * s for a, s in zip(row, states, strict=True)) for row in rows)
    system = Dynamics.of(states, formulas, diffusion=np.array(noise))
    cells = 24 if len(rows) > 2 else None  # a second instead of eight
    found = Dissipation.of(system, 0.5, np.array([[-reach, reach]] * len(rows)), cells=cells)
    exact = exact_dissipation(matrix, np.array(noise), 0.5)
    assert found.value == pytest.approx(exact, rel=0.04, abs=1e-9)
    assert found.lower - 1e-9 <= exact <= found.upper + 1e-9


def test_dissipation_of_a_ring_driven_around() -> None:
    """``f = -∇Φ + ω J x`` with Φ of the distance alone: u = ω J x, and Σ̇ = (2ω²/ε) ⟨r²⟩."""
    radius, turn, intensity = x**2 + y**2, sympy.Rational(3, 2), 0.3
    system = Dynamics.of((x, y), (x * (1 - radius) + turn * y, y * (1 - radius) - turn * x))
    found = Dissipation.of(system, intensity, np.array([[-2.2, 2.2]] * 2))
    r = np.linspace(0, 4, 100_001)
    weight = r * np.exp(-2 / intensity * (r**4 / 4 - r**2 / 2))
    exact = 2 * 1.5**2 / intensity * np.trapezoid(r**2 * weight, r) / np.trapezoid(weight, r)
    assert found.value == pytest.approx(exact, rel=0.02)
    assert found.lower <= exact <= found.upper
    assert found.density.sum() * np.prod(4.4 / 120 * np.ones(2)) == pytest.approx(found.value)


def test_sets_that_meet_are_refused() -> None:
    process = CellProcess(Dynamics.of((x,), (-x,)), 0.5, np.array([[-2.0, 2.0]]))
    with pytest.raises(NumericalFailure, match="in common"):
        process.between(about(0.0), [about(0.05)])


def test_what_errors_of_f_feign_is_taken_out() -> None:
    """A system at rest, of which a rotation of 0.3 ± 0.3 was estimated, and one that turns, 2 ± 0.1.

    Σ̇ = 2 ω²; an estimate of it by ω + δ is too high by 2 ⟨δ²⟩ in the mean.
    """
    generator, box = np.random.default_rng(1), np.array([[-2.5, 2.5]] * 2)

    def turning(rate: float) -> Dynamics:
        return Dynamics.of((x, y), (-x + rate * y, -y - rate * x))

    for rate, error in ((0.3, 0.3), (2.0, 0.1)):
        draws = [(turning(rate + error * one), 0.5) for one in generator.standard_normal(40)]
        found = Dissipation.of(turning(rate), 0.5, box, draws=draws, cells=60)
        spread = 2 * np.array([one.formulas[0].coeff(y) for one, _ in draws], dtype=float) ** 2
        assert found.value == pytest.approx(max(4 * rate**2 - spread.mean(), 0.0), abs=0.03)
        assert (found.lower == 0) == (rate < 1) and found.upper > found.value


def test_terms_without_a_current_set_no_upper_limit() -> None:
    draws = [(Dynamics.of((x, y), (-rate * x, -y)), 0.5) for rate in (0.9, 1.0, 1.1)]
    found = Dissipation.of(draws[1][0], 0.5, np.array([[-2.5, 2.5]] * 2), draws=draws, cells=60)
    assert found.value == found.lower == 0 and np.isnan(found.upper)


def test_what_a_record_shows_is_the_committor() -> None:
    x = sympy.Symbol("x", real=True)
    system = Dynamics.of([x], [x - x**3], domain=[(-2.2, 2.2)])
    landscape, noise, step = Landscape.from_equations(system), 0.35, 0.02
    flow = landscape.committor(0, 1, noise=noise)
    generator = np.random.default_rng(2)
    state, kept = np.full(20, -1.0), []
    for number in range(60_000):
        state = state + step * (state - state**3) + np.sqrt(noise * step) * generator.standard_normal(20)
        if number % 2 == 0:
            kept.append(state)
    times = 2 * step * np.arange(len(kept))
    table = flow.counted(Recordings.from_arrays(times, np.array(kept).T[:, :, None], names=["x"]))
    assert len(table) == 10 and (table.excursions > 100).all()
    score = (table.counted - table.committor) / np.hypot(table.standard_error, 0.02)
    assert np.abs(score).max() < 3.5
