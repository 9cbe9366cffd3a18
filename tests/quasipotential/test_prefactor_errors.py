from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy
from known_systems import KnownSystem, exact_field

from siq.inference.field_estimate import FieldEstimate
from siq.quasipotential.path_chains import MinimumActionPath
from siq.quasipotential.paths import minimum_action_path
from siq.quasipotential.rates import (
    MAX_COVARIANCE_AXES,
    EscapeRate,
    NoiseStrength,
    _covariance_axes,
    prefactor_error,
)
from siq.quasipotential.transitions import _noise_leverage
from siq.systems.dynamics import Dynamics

X, Y = sympy.symbols("x y", real=True)
ERROR = 0.02


@pytest.fixture(scope="module")
def well() -> tuple[FieldEstimate, MinimumActionPath]:
    """f = (ax - bx³, -cy), each coefficient 1 ± 0.02."""
    dynamics = Dynamics.of((X, Y), (X - X**3, -Y))
    known = KnownSystem(dynamics, None, np.zeros((1, 2)), np.array([[-2.0, 2.0], [-1.0, 1.0]]))
    path = minimum_action_path(dynamics, np.array([1.0, 0.0]), np.zeros(2))
    return exact_field(known, degree=3, relative_error=ERROR), path


def test_the_error_is_that_of_the_law(well: tuple[FieldEstimate, MinimumActionPath]) -> None:
    # K = 2π/(a √2) and ΔU = a²/2b: ln K errs as ln a does, and against ΔU.
    error, covariance = prefactor_error(*well)
    assert error == pytest.approx(ERROR, rel=0.05)
    assert covariance == pytest.approx(-(ERROR**2), rel=0.05)


def test_without_noise_there_is_none(well: tuple[FieldEstimate, MinimumActionPath]) -> None:
    found, path = well
    assert prefactor_error(replace(found, residual_ratio=1e-9), path) == (0, 0)


def test_axes_make_up_the_covariance() -> None:
    draw = np.random.default_rng(0)
    few, many = (np.cov(draw.standard_normal((3 * count, count)).T) for count in (5, 20))
    axes = np.array(_covariance_axes(few, draw))
    assert axes.T @ axes == pytest.approx(few)
    drawn = [np.array(_covariance_axes(many, draw)) for _ in range(800)]
    assert all(one.shape == (MAX_COVARIANCE_AXES, 20) for one in drawn)
    assert sum(one.T @ one for one in drawn) / 800 == pytest.approx(many, abs=0.1)


def test_barrier_and_prefactor_err_together() -> None:
    rate = EscapeRate(0.5, 4.0, standard_error=0.01, prefactor_error=0.08)
    apart = rate.mean_exit_time(NoiseStrength(0.1))
    against = replace(rate, covariance=-0.01 * 0.08).mean_exit_time(NoiseStrength(0.1))
    assert apart is not None and against is not None
    assert apart.data_error == pytest.approx(np.hypot(0.1, 0.08))
    assert against.data_error == pytest.approx(0.02)


def test_an_estimated_noise_counts_by_the_states_that_the_path_takes(
    well: tuple[FieldEstimate, MinimumActionPath],
) -> None:
    found, path = well
    assert _noise_leverage(path, found.dynamics) == pytest.approx(np.sqrt(2), rel=1e-3)
    way = EscapeRate(0.5, 4.0, prefactor_error=0.0, leverage=float(np.sqrt(2)))
    time = way.mean_exit_time(NoiseStrength(0.1, 0.001))
    assert time is not None and time.data_error == pytest.approx(5 * 0.01 * np.sqrt(2))


def test_one_state_has_the_error_of_its_noise() -> None:
    dynamics = Dynamics.of((X,), (X - X**3,))
    path = minimum_action_path(dynamics, np.array([1.0]), np.zeros(1))
    assert _noise_leverage(path, dynamics) == pytest.approx(1.0)
