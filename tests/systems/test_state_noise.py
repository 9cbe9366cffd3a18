from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import sympy

from siq.errors import InputError, NumericalFailure
from siq.systems.cards import load_system
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.simulation import noise_source, simulate_stationary

pytestmark = pytest.mark.portable

Write = Callable[..., Path]
X, Y = sympy.symbols("x y", real=True)
ROWS = ((1 + X**2 / 2, X * Y / 4), (X * Y / 4, 2 + sympy.sin(Y) / 2))
NOISE = Diffusion.of_formulas((X, Y), ROWS)
DRAW = np.random.default_rng(0)
POINTS, MOMENTA = DRAW.normal(size=(2, 5, 2))
CENTER, UNITS = np.array([0.3, -0.2]), np.array([[0.5, 0.2], [-0.1, 3.0]])


@pytest.mark.parametrize("noise", [NOISE, NOISE.in_units(CENTER, UNITS, 0.7)])
def test_derivatives_are_those_of_d(noise: Diffusion) -> None:
    for k in range(2):
        step = 1e-5 * np.eye(2)[k]
        first = (noise.at(POINTS + step) - noise.at(POINTS - step)) / 2e-5
        second = (noise.derivatives(POINTS + step) - noise.derivatives(POINTS - step)) / 2e-5
        np.testing.assert_allclose(noise.derivatives(POINTS)[..., k], first, atol=1e-7)
        np.testing.assert_allclose(noise.derivatives(POINTS, 2)[..., k], second, atol=1e-7)


def test_what_characteristics_need_follows_from_the_derivatives() -> None:
    first, second = NOISE.derivatives(POINTS), NOISE.derivatives(POINTS, 2)
    for n, p in enumerate(MOMENTA):
        for k in range(2):
            assert NOISE.contract(POINTS, MOMENTA, 1)[n, k] == pytest.approx(p @ first[n, :, :, k] @ p)
            np.testing.assert_allclose(NOISE.turn(POINTS, MOMENTA)[n, :, k], first[n, :, :, k] @ p)
            assert NOISE.contract(POINTS, MOMENTA, 2)[n, k, 1] == pytest.approx(p @ second[n, :, :, k, 1] @ p)
    np.testing.assert_allclose(NOISE.divergence(POINTS)[:, 0], first[:, 0, 0, 0] + first[:, 0, 1, 1])


def test_products_roots_and_inverses_belong_to_the_d_of_the_point() -> None:
    for n, matrix in enumerate(NOISE.at(POINTS)):
        one = Diffusion(matrix)
        np.testing.assert_allclose(NOISE.push(POINTS, MOMENTA)[n], matrix @ MOMENTA[n], rtol=1e-13)
        np.testing.assert_allclose(NOISE.precision_at(POINTS)[n], one.precision, rtol=1e-12)
        np.testing.assert_allclose(NOISE.root_at(POINTS)[n], one.root, rtol=1e-13)
        np.testing.assert_allclose(NOISE.frozen(POINTS[n]).matrix, matrix, rtol=1e-15)
    many = DRAW.normal(size=(5, 3, 2))
    np.testing.assert_allclose(NOISE.contract(POINTS, many)[:, 1], NOISE.contract(POINTS, many[:, 1]))
    squares = NOISE.squared_speed(POINTS, NOISE.push(POINTS, MOMENTA))
    np.testing.assert_allclose(squares, NOISE.contract(POINTS, MOMENTA), rtol=1e-12)


def test_who_needs_a_constant_d_is_refused() -> None:
    for ask in (lambda: NOISE.matrix, lambda: NOISE.root, lambda: NOISE.precision, lambda: NOISE.scale):
        with pytest.raises(NumericalFailure, match="the same everywhere"):
            ask()


def test_a_d_that_is_negative_somewhere_is_refused_there() -> None:
    noise = Diffusion.of_formulas((X,), ((1 + X,),))
    noise.root_at(np.array([[0.0], [1.0]]))
    assert noise.positive_at(np.array([[0.0], [-1.0], [-2.0], [np.nan]])).tolist() == [
        True,
        False,
        False,
        False,
    ]
    for ask in (
        lambda: noise.root_at(np.array([[0.0], [-2.0], [-3.0]])),
        lambda: noise.frozen(np.array([-3.0])),
        lambda: noise.kicks(np.array([[0.0, -3.0]]), np.ones((1, 2))),
    ):
        with pytest.raises(NumericalFailure, match=r"not positive definite at \(-3\)"):
            ask()
    with pytest.raises(NumericalFailure, match="not positive definite at"):
        Diffusion.of_formulas((X, Y), ((1, X), (X, 1))).kicks(np.array([[2.0], [0.0]]), np.ones((2, 1)))


def test_beyond_the_domain_where_d_is_none_noise_is_that_of_the_edge() -> None:
    """Molecules that are made and lost, ``D = 2 + x``: below none of them D(0) goes on."""
    made = Dynamics.of((X,), (2 - X,), diffusion=[[2 + X]], domain=[(0, 10)])
    draw = noise_source(made, intensity=1.0, step=0.01, generator=np.random.default_rng(0))
    numbers = np.random.default_rng(0).standard_normal((1, 3))
    sizes = np.sqrt(0.01 * np.array([2.0, 5.0, 12.0]))
    np.testing.assert_allclose(draw(np.array([[-2.5, 3.0, 10.0]])), sizes * numbers)
    # What is beyond another edge keeps its D, whoever has left.
    assert draw(np.array([[-2.5, 14.0]]))[0, 1] == pytest.approx(
        0.4 * np.random.default_rng(0).standard_normal(5)[4]
    )
    within = Dynamics.of((X,), (2 - X,), diffusion=[[X - 2]], domain=[(0, 10)])
    with pytest.raises(NumericalFailure, match=r"not positive definite at \(1\)"):
        noise_source(within, intensity=1.0, step=0.01, generator=np.random.default_rng(0))(np.ones((1, 1)))


@pytest.mark.parametrize(
    ("rows", "fault"),
    [
        (((X,),), "not a square"),
        (((1, X), (Y, 1)), "not symmetric"),
        (((1, 0), (0, sympy.Symbol("u"))), "depends on u"),
    ],
)
def test_formulas_that_are_no_diffusion_are_refused(rows: object, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        Diffusion.of_formulas((X, Y), rows)  # type: ignore[arg-type]


def test_formulas_without_states_are_a_constant_d() -> None:
    found = Diffusion.of_formulas((X, Y), ((sympy.Rational(1, 2), 0), (0, 2)))
    assert found.constant
    np.testing.assert_array_equal(found.matrix, np.diag([0.5, 2.0]))
    assert not NOISE.constant
    assert NOISE.extended(1).regular is False


CARD = """\
name: multiplied
states:
  x: {domain: [-1, 1]}
  y: {domain: [-1, 1]}
parameters:
  slope: {value: 0.8}
equations:
  x: "x - x**3"
  y: "-y"
diffusion: DIFFUSION
"""


@pytest.mark.parametrize(
    ("diffusion", "expected"),
    [
        ('["1 + slope*x", 2]', [[1 + 0.8 * X, 0], [0, 2]]),
        ('[["1 + x**2", "x*y/4"], ["y*x/4", "1 + y**2"]]', [[1 + X**2, X * Y / 4], [X * Y / 4, 1 + Y**2]]),
    ],
)
def test_a_card_gives_d_as_formulas_and_is_written_so(write: Write, diffusion: str, expected: object) -> None:
    system = load_system(write(CARD.replace("DIFFUSION", diffusion)))
    truth = Diffusion.of_formulas((X, Y), expected)  # type: ignore[arg-type]
    again = load_system(write(system.to_card(), "again.yaml"))
    for one in (system, again):
        np.testing.assert_allclose(one.diffusion.at(POINTS), truth.at(POINTS), rtol=1e-14)


@pytest.mark.parametrize(
    ("diffusion", "fault"),
    [
        ('["1 + x", "t"]', "depends on t"),
        ('["1 + z", 1]', "'z' is not declared"),
        ('[["1 + x", "x"], ["y", 1]]', "not symmetric"),
        ('["1 + x"]', "does not fit 2 states"),
        ('["-slope", 1]', "not positive semi-definite"),
    ],
)
def test_a_card_whose_formulas_are_no_diffusion_is_refused(write: Write, diffusion: str, fault: str) -> None:
    with pytest.raises(InputError) as caught:
        load_system(write(CARD.replace("DIFFUSION", diffusion)))
    assert fault in caught.value.fault
    assert "diffusion" in str(caught.value)


def test_walkers_have_the_density_of_itô() -> None:
    # p ∝ exp(∫ 2f/(εD) dx)/D is here (1 + x²)^-(1 + 1/ε), and <x²> = 1/(2/ε - 1).
    intensity = 0.4
    dynamics = Dynamics.of((X,), (-X,), diffusion=((1 + X**2,),))
    samples = simulate_stationary(
        dynamics, intensity=intensity, start=np.zeros((1, 4000)), step=0.01, burn_in=400, steps=1200,
        thin=50, generator=np.random.default_rng(0),
    )  # fmt: skip
    assert (samples**2).mean() == pytest.approx(1 / (2 / intensity - 1), rel=0.03)
