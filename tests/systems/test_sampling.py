"""How a system is simulated where nobody says it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy
from known_systems import archetype, as_system, limit_cycle

from siq.systems.dynamics import Dynamics
from siq.systems.simulation import MOST_STEPS, SimulationEntry, _rates, _round_down

X, Y = sympy.symbols("x y", real=True)


def two_rates(fast: float, slow: float, *, length: float = 1.0) -> Dynamics:
    """x' = -fast x, y' = -slow y on a box of a length, in which every rate is known."""
    box = np.array([[-length, length], [-length, length]])
    return replace(Dynamics.of((X, Y), (-fast * X, -slow * Y)), domain=box)


def test_the_rates_of_a_linear_system_are_its_eigenvalues_in_any_unit() -> None:
    assert _rates(two_rates(8.0, 0.5)) == pytest.approx((8.0, 0.5))
    assert _rates(two_rates(8.0, 0.5, length=1e-9)) == pytest.approx((8.0, 0.5))


def test_step_and_length_follow_from_the_rates() -> None:
    entry = SimulationEntry(pairs=30).completed(two_rates(8.0, 0.5))
    assert entry.pair_step == 0.01  # a tenth of 1/8, rounded down
    assert entry.interval == pytest.approx(0.2)  # 30 of them are three times 1/0.5
    assert entry.options().pairs == 30


def test_a_system_in_other_units_of_time_is_sampled_alike() -> None:
    one, other = (SimulationEntry().completed(two_rates(8.0 * c, 0.5 * c)) for c in (1.0, 1e-3))
    assert other.pair_step == 1000 * one.pair_step and other.interval == pytest.approx(1000 * one.interval)


def test_what_a_study_says_stays() -> None:
    said = SimulationEntry(pair_step=0.03)
    assert said.completed(two_rates(8.0, 0.5)).pair_step == 0.03
    said = SimulationEntry(interval=0.05)
    entry = said.completed(two_rates(8.0, 0.5))
    assert entry.interval == 0.05 and entry.options().pair_step == pytest.approx(0.01)
    said = SimulationEntry(pair_step=0.01, interval=0.1)
    assert said.completed(two_rates(8.0, 0.5)) is said


def test_a_very_slow_system_takes_no_more_than_so_many_steps() -> None:
    entry = SimulationEntry().completed(two_rates(8.0, 1e-4))
    assert entry.interval == pytest.approx(MOST_STEPS * entry.pair_step)


@pytest.mark.parametrize("known", [archetype(3), limit_cycle()], ids=["two wells", "no attractor"])
def test_every_system_can_be_sampled(known) -> None:
    options = SimulationEntry().completed(as_system(known)).options()
    assert 2 * options.pair_step <= options.interval


def test_numbers_are_rounded_down_to_what_people_read() -> None:
    assert [_round_down(value) for value in (0.0123, 0.0099, 0.05, 7.3, 2.0)] == [0.01, 0.005, 0.05, 5.0, 2.0]


def test_without_a_system_a_step_left_out_is_not_known() -> None:
    with pytest.raises(ValueError, match="not known without the system"):
        SimulationEntry().options()
