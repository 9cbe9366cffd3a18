"""How long a well lasts, with its errors."""

from functools import partial

import numpy as np
import pytest
import scipy.optimize
from known_systems import double_well, exact_field, portrait_of

from siq.quasipotential.landscape_assembly import find_landscape
from siq.quasipotential.rates import EscapeRate, MeanTime, NoiseStrength, mean_residence_time
from siq.quasipotential.refinement import RefinementOptions
from siq.quasipotential.transitions import position_standard_errors
from siq.systems.dynamics import Dynamics


def test_the_time_over_one_saddle_is_the_law() -> None:
    found = EscapeRate(0.5, 4.0).mean_exit_time(NoiseStrength(0.1))
    assert found is not None
    assert found.value == pytest.approx(4 * np.exp(5))
    assert found.data_error == 0 and found.law_error == pytest.approx(0.2)


def test_its_error_follows_from_the_barrier_and_from_the_noise() -> None:
    of_barrier = EscapeRate(0.5, 4.0, standard_error=0.01).mean_exit_time(NoiseStrength(0.1))
    of_noise = EscapeRate(0.5, 4.0).mean_exit_time(NoiseStrength(0.1, 0.002))
    assert of_barrier is not None and of_noise is not None
    # d ln T = dΔU/ε, and the prefactor's share beside it; d ln T = (ΔU/ε) dε/ε.
    assert of_barrier.data_error == pytest.approx(np.hypot(0.1, 0.02))
    assert of_noise.data_error == pytest.approx(5 * 0.02)
    changed = EscapeRate(0.5, 4.0).mean_exit_time(NoiseStrength(0.1 * 1.0001))
    assert changed is not None
    exact = EscapeRate(0.5, 4.0).mean_exit_time(NoiseStrength(0.1))
    assert exact is not None and np.log(exact.value / changed.value) == pytest.approx(5e-4, rel=1e-3)


def test_rates_of_several_ways_out_add() -> None:
    ways = [EscapeRate(0.5, 4.0), EscapeRate(0.5, 4.0)]
    one, both = (
        mean_residence_time(ways[:1], NoiseStrength(0.1)),
        mean_residence_time(ways, NoiseStrength(0.1)),
    )
    assert one is not None and both is not None
    assert both.value == pytest.approx(one.value / 2) and both.complete


@pytest.mark.parametrize("way", [EscapeRate(0.5, float("nan")), EscapeRate(float("nan"), float("nan"))])
def test_a_way_out_without_a_rate_makes_the_time_an_upper_bound(way: EscapeRate) -> None:
    found = mean_residence_time([EscapeRate(0.5, 4.0), way], NoiseStrength(0.1))
    assert found is not None and not found.complete
    assert mean_residence_time([way], NoiseStrength(0.1)) is None


def test_there_is_no_time_without_noise_and_none_under_a_noise_above_the_barrier() -> None:
    assert mean_residence_time([EscapeRate(0.5, 4.0)], None) is None
    assert EscapeRate(0.5, 4.0).mean_exit_time(NoiseStrength(0.6)) is None
    assert EscapeRate(0.5, 4.0).mean_exit_time(NoiseStrength(1e-6)) is None  # more than a number can hold


def test_a_time_is_positive_however_uncertain() -> None:
    low, high = MeanTime(10.0, 0.8, 0.6).limits
    assert 0 < low < 10 < high and low * high == pytest.approx(100)


def test_a_landscape_gives_the_dwell_times_of_the_noise_it_knows() -> None:
    known = double_well(2)
    found = find_landscape(
        exact_field(known, 3, relative_error=1e-3), portrait_of(known, 250, share=0.8),
        options=RefinementOptions(degrees=(4,)), noise=NoiseStrength(0.05, 0.001, "estimated"),
    )  # fmt: skip
    table = found.dwell_times()
    assert list(table["attractor"]) == [0, 1] and (table["mean_time"] > 0).all()
    assert (table["data_error"] > 0).all()
    given = found.dwell_times(noise=0.05)
    np.testing.assert_allclose(given["mean_time"], table["mean_time"])
    assert (given["data_error"] < table["data_error"]).all()  # a given noise has no error
    # The law of Eyring and Kramers, as `escape_times` has it for the only way out of each well.
    np.testing.assert_allclose(table["mean_time"], found.escape_times(noise=0.05)["mean_time"], rtol=0.02)


def zero_of(dynamics: Dynamics, x: np.ndarray) -> np.ndarray:
    return dynamics.drift(x[None])[0]


def test_an_attractor_moves_as_f_does() -> None:
    known = double_well(2)
    field = exact_field(known, 3, relative_error=1e-3)
    place = portrait_of(known, 250, share=0.8).attractors[0].position
    errors = position_standard_errors(field, place)
    # Against the zeros of f with each coefficient changed in turn.
    slopes = []
    for column, value in enumerate(field.values):
        step = np.zeros(len(field.values))
        step[column] = 1e-5 * max(abs(value), 1.0)
        ends = []
        for sign in (1, -1):
            changed = field.dynamics.with_values(field.values + sign * step)
            ends.append(scipy.optimize.root(partial(zero_of, changed), place).x)
        slopes.append((ends[0] - ends[1]) / (2 * step[column]))
    slope = np.array(slopes).T
    exact = np.sqrt(np.diag(slope @ field.covariance @ slope.T))
    np.testing.assert_allclose(errors, exact, rtol=1e-4, atol=1e-9)
