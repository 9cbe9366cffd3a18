"""Paths, barriers and escape times where D depends on the state."""

from __future__ import annotations

import numpy as np
import pytest
from known_noise import exit_time, multiplicative, one_state, potential_of_one_state
from known_systems import KnownSystem, portrait_of, potential_gradient, potential_values

from siq.quasipotential.global_formula import GlobalQuasipotential
from siq.quasipotential.invariant_density import SampledPotential
from siq.quasipotential.path_chains import PathProblem, _Across
from siq.quasipotential.paths import minimum_action_path
from siq.quasipotential.rates import _Frame, escape_rate
from siq.quasipotential.refinement import RefinementOptions
from siq.quasipotential.wells import local_well
from siq.systems.equilibria import find_equilibria

pytestmark = pytest.mark.portable


def saddle_of(known: KnownSystem) -> np.ndarray:
    points = np.random.default_rng(0).uniform(*known.domain.T, size=(200, len(known.domain)))
    between = [one for one in find_equilibria(known.dynamics, points) if one.kind == "saddle"]
    assert len(between) == 1
    return between[0].position


@pytest.mark.parametrize("dimension", [2, 3])
def test_moves_of_a_chain_have_the_slope_and_the_curvature_of_its_action(dimension: int) -> None:
    known = multiplicative(dimension)
    problem = PathProblem(known.dynamics, known.attractors[0], known.attractors[1])
    draw = np.random.default_rng(1)
    y = np.linspace(0.1, 1.0, 6)[:, None] * problem.end + 0.05 * draw.normal(size=(6, dimension))
    across, size = _Across(problem, y), (5 * (dimension - 1),)
    band, matrix = across.exact, np.zeros(size * 2)
    for offset, diagonal in enumerate(band):
        for column in range(size[0] - offset):
            matrix[column + offset, column] = matrix[column, column + offset] = diagonal[column]
    one, other = draw.normal(size=(2, *size))

    def action(a: float, b: float) -> float:
        return problem.action(across.moved(a * one + b * other))

    h = 1e-4
    assert (action(h, 0) - action(-h, 0)) / (2 * h) == pytest.approx(across.slope @ one, rel=1e-5)
    mixed = (action(h, h) - action(h, -h) - action(-h, h) + action(-h, -h)) / (4 * h**2)
    assert mixed == pytest.approx(one @ matrix @ other, rel=1e-4)


def test_the_barrier_of_one_state_is_the_quadrature() -> None:
    known = one_state()
    for start in known.attractors:
        path = minimum_action_path(known.dynamics, start, np.zeros(1), tolerance=1e-5)
        expected = 2 * potential_of_one_state(known, float(start[0]), 0.0)
        assert path.action == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("dimension", [2, *(pytest.param(d, marks=pytest.mark.slow) for d in (3, 4))])
def test_barriers_and_momenta_are_those_of_the_given_potential(dimension: int) -> None:
    known = multiplicative(dimension)
    saddle = saddle_of(known)
    for start in known.attractors:
        path = minimum_action_path(known.dynamics, start, saddle, tolerance=1e-5)
        expected = 2 * np.diff(potential_values(known, np.stack([start, saddle])))[0]
        assert path.converged
        assert path.action == pytest.approx(expected, rel=1e-6)
        slopes = potential_gradient(known, path.points)
        np.testing.assert_allclose(path.momenta, slopes, atol=1e-4 * np.abs(slopes).max())


@pytest.mark.parametrize("which", [0, 1])
def test_the_escape_time_of_one_state_tends_to_the_exact_one(which: int) -> None:
    known = one_state()
    start = float(known.attractors[which, 0])
    if which:  # seen from the right well everything is mirrored
        known = known._replace(dynamics=_mirrored(known))
    path = minimum_action_path(known.dynamics, np.array([-1.0]), np.zeros(1), tolerance=1e-6)
    rate = escape_rate(known.dynamics, path)
    left, right = -1.0, 1.0
    shares = []
    for part in (0.1, 0.05):
        intensity = part * rate.barrier
        exact = exit_time(known, left, right, intensity=intensity, wall=-1.9)
        shares.append(rate.mean_time(intensity) / exact - 1)
    assert abs(start) == 1.0
    # The law's own error is of the order of ε: without it, next to nothing is left.
    assert abs(shares[1]) < 0.06
    assert abs(2 * shares[1] - shares[0]) < 0.012


def _mirrored(known: KnownSystem):  # type: ignore[no-untyped-def]
    from siq.systems.dynamics import Dynamics

    (x,) = known.dynamics.symbols
    back = {x: -x}
    drift = [-known.dynamics.formulas[0].subs(back)]
    return Dynamics.of((x,), drift, diffusion=((known.dynamics.diffusion.formulas[0][0].subs(back),),))


@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_the_prefactor_has_the_corrections_of_itô_in_several_states(dimension: int) -> None:
    """∇²V and the divergences are known: the law can be worked out by hand along the path."""
    known = multiplicative(dimension)
    saddle = saddle_of(known)
    path = minimum_action_path(known.dynamics, known.attractors[0], saddle, tolerance=1e-6)
    integrated = escape_rate(known.dynamics, path)

    def hessian(x: np.ndarray) -> np.ndarray:
        step = 1e-5 * np.eye(dimension)
        rows = [
            (potential_gradient(known, x + one) - potential_gradient(known, x - one)) / 2e-5 for one in step
        ]
        return np.stack(rows, axis=1)

    frame = _Frame(known.dynamics, path, None)
    given = frame.exponent(frame.curvature(hessian, frame.points[::2]))
    assert integrated.exponent == pytest.approx(given, abs=2e-3)
    assert abs(integrated.exponent) > 0.05


def test_the_density_of_one_state_is_exact() -> None:
    """``p ~ exp(∫ 2f/(εD) dx)/D`` for Itô's noise, at any ε."""
    known, intensity = one_state(), 0.1
    portrait = portrait_of(known, 600)  # with half as many, rounding decides about the powers of degree 10
    options = RefinementOptions(degrees=(10,))
    wells = tuple(local_well(known.dynamics, portrait, index, options=options) for index in (0, 1))
    to_top = [2 * potential_of_one_state(known, float(one.attractor[0]), 0.0) for one in wells]
    heights = max(to_top) - np.array(to_top)
    potential = GlobalQuasipotential(wells, heights)
    box = np.array([[-1.4, 1.4]])
    fine, coarse = (SampledPotential.of(potential, box, cells=cells) for cells in (2000, 1000))
    lowest = coarse.lowest_possible(known.dynamics)
    density = fine.density(coarse, lowest, intensity=intensity)
    seen, x = fine.known, fine.axes[0]
    heights_at = np.array([2 * potential_of_one_state(known, 0.0, float(one)) for one in x[seen]])
    exact = np.exp(-heights_at / intensity) / known.dynamics.diffusion.at(x[seen][:, None])[:, 0, 0]
    np.testing.assert_allclose(density.probabilities[seen], exact / exact.sum(), rtol=2e-3)
    assert seen.mean() > 0.7
