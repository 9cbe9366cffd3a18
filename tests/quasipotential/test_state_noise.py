"""V by the local route where D depends on the state."""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from known_noise import multiplicative, one_state, potential_of_one_state
from known_systems import portrait_of, potential_values, uniform_points

from siq.quasipotential.refinement import RefinementOptions
from siq.quasipotential.wells import local_well
from siq.systems.equilibria import hessian_at

pytestmark = pytest.mark.portable


@pytest.mark.parametrize("dimension", [2, 3, pytest.param(4, marks=pytest.mark.slow)])
def test_the_given_potential_is_found(dimension: int) -> None:
    known = multiplicative(dimension)
    portrait = portrait_of(known, 300, share=0.8)
    assert len(portrait.attractors) == 2
    well = local_well(known.dynamics, portrait, 1, options=RefinementOptions(degrees=(4,)))
    assert well.level == pytest.approx(0.25, rel=1e-6)  # of V at the saddle
    x = uniform_points(known, 2000, seed=3, share=0.8)
    x = x[well.reaches(x)]
    expected = potential_values(known, x) - potential_values(known, well.attractor[None])
    assert len(x) > 20
    np.testing.assert_allclose(well.values(x), expected, atol=1e-6 * expected.max())
    assert well.residual < 1e-6


def test_of_one_state_it_is_the_quadrature() -> None:
    known = one_state()
    portrait = portrait_of(known, 600)  # with half as many, rounding decides about the powers of degree 10
    for index, attractor in enumerate(portrait.attractors):
        well = local_well(known.dynamics, portrait, index, options=RefinementOptions())
        start = float(attractor.position[0])
        for share in (0.3, 0.6, 0.9):
            expected = potential_of_one_state(known, start, (1 - share) * start)
            value = well.values(np.array([[(1 - share) * start]]))[0]
            assert value == pytest.approx(expected, rel=2e-5)


def test_the_hessian_is_that_of_the_given_potential() -> None:
    known = multiplicative(3)
    center = known.attractors[0]
    expected = np.array([[2 + 2 / 16, -1 / 4, -1 / 4], [-1 / 4, 1, 0], [-1 / 4, 0, 1]])
    np.testing.assert_allclose(hessian_at(known.dynamics, center), expected, atol=1e-10)


def test_the_decomposition_is_one_of_formulas() -> None:
    known = multiplicative(2)
    assert known.potential is not None
    slopes = [known.potential.diff(symbol) for symbol in known.dynamics.symbols]
    down = sympy.Matrix(known.dynamics.diffusion.formulas) * sympy.Matrix(slopes)
    circulation = [(f + part).expand() for f, part in zip(known.dynamics.formulas, down, strict=True)]
    product = sum(slope * part for slope, part in zip(slopes, circulation, strict=True))
    assert product.expand() == 0
