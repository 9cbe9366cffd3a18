"""How points are laid along a curve: whatever repeats a point, what is laid along it stays the same."""

from __future__ import annotations

import numpy as np
import pytest
import sympy

from siq.quasipotential.path_chains import PathProblem
from siq.systems.cycles import closed_orbit
from siq.systems.dynamics import Dynamics

pytestmark = pytest.mark.portable

x, y = sympy.symbols("x y", real=True)
ROUNDING = 1e-16  # by which points that are one may differ


@pytest.fixture(scope="module")
def from_a_point() -> PathProblem:
    return PathProblem(Dynamics.of((x, y), (x - x**3, -y)), np.array([-1.0, 0.0]), np.zeros(2))


@pytest.fixture(scope="module")
def to_a_cycle() -> PathProblem:
    """r' = r (r² - 1) (4 - r²), which turns about its resting point, up to its unstable cycle r = 1."""
    radius = x**2 + y**2
    slope = (radius - 1) * (4 - radius)
    system = Dynamics.of((x, y), (x * slope - y, y * slope + x), domain=[(-3, 3)] * 2)
    phase = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    circle = np.stack([np.cos(phase), np.sin(phase)], axis=1)
    return PathProblem(system, np.zeros(2), closed_orbit(system, circle, 2 * np.pi, scale=np.ones(2)))


def bow(problem: PathProblem, count: int = 30) -> np.ndarray:
    share = np.linspace(0, 1, count)[:, None]
    return share * problem.end + 0.2 * np.sin(np.pi * share) * np.array([0.0, 1.0])


@pytest.mark.parametrize("repeated", [[0], [12], [29], [0, 0, 12, 12, 12, 29, 29]])
@pytest.mark.parametrize("moved", [0.0, ROUNDING])
def test_points_that_coincide_are_one(from_a_point: PathProblem, repeated: list[int], moved: float) -> None:
    alone = bow(from_a_point)
    several = np.insert(alone, repeated, alone[repeated] + moved, axis=0)
    for level in (0.0, 1e-6):
        chain = from_a_point.spaced(several, 50, level)
        np.testing.assert_allclose(chain, from_a_point.spaced(alone, 50, level), atol=1e-12)


def test_a_long_chain_may_end_on_a_step_below_its_rounding(from_a_point: PathProblem) -> None:
    """A step of 2e-14 is lost in a length of 400."""
    phase = np.linspace(0, 60, 4000)[:, None]
    wound = from_a_point.end + np.hstack([np.cos(phase), np.sin(phase)]) * phase / 5
    several = np.vstack([wound, wound[-1] + [0.0, 2e-14]])
    chain = from_a_point.spaced(several, 50, 0.0)
    np.testing.assert_allclose(chain, from_a_point.spaced(wound, 50, 0.0), atol=1e-9)


def test_a_way_that_has_arrived_on_a_tube_does_not_wind_on(to_a_cycle: PathProblem) -> None:
    """Its level is above the one asked for by rounding, and the way from there on has no length."""
    assert to_a_cycle.finish is not None
    alone = bow(to_a_cycle)
    alone[-1] = 0.99 * to_a_cycle.end
    level = float(np.nextafter(to_a_cycle.finish.level(alone[-1:])[0], 0))
    chain = to_a_cycle.spaced(alone, 50, level)
    assert np.isfinite(chain).all() and (np.linalg.norm(np.diff(chain, axis=0), axis=1) > 0).all()
    np.testing.assert_allclose(chain[-1], alone[-1], atol=1e-9)
