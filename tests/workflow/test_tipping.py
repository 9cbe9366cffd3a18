"""Probabilities of having tipped: closed forms, a simulation, and where they are not to be believed."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import sympy

from siq.systems.dynamics import Dynamics
from siq.workflow.sweep import Sweep, sweep
from siq.workflow.tables import as_table
from siq.workflow.tipping import probability_of_tipping

NOISE = 0.05


def made(barrier, *, values, prefactor=4.0, relaxation=2.0, ways=1) -> Sweep:
    """A sweep of one well with a given barrier."""
    rows = [
        {"value": value, "well": 0, "exit": 1, "barrier": barrier(value), "prefactor": prefactor,
         "relaxation": relaxation, "note": ""}
        for value in values
        for _ in range(ways)
    ]  # fmt: skip
    branches = [
        {"branch": 0, "well": 0, "value": value, "position": "[0.0]", "unstable": 0} for value in values
    ]
    wells = [{"value": value, "well": 0, "barrier": barrier(value), "note": ""} for value in values]
    return Sweep(
        ("h",), ("x",), as_table("sweep", wells), as_table("sweep_ways", rows),
        as_table("branches", pd.DataFrame(branches).assign(growth=-1.0, frequency=0.0)),
        as_table("bifurcations", []),
    )  # fmt: skip


@pytest.mark.parametrize("ways", [1, 2])
def test_a_barrier_that_falls_evenly_gives_the_closed_form(ways):
    """ΔU = 0.5 - h, h = vt: the integral of the rate is ε/(vK) (exp(vt/ε) - 1) exp(-0.5/ε) for each way."""
    found = made(lambda h: 0.5 - h, values=np.linspace(0, 0.4, 5), ways=ways)
    speed, times = 1e-4, np.linspace(0, 3000, 7)
    told = probability_of_tipping(found, lambda t: speed * t, times, well=0, noise=NOISE)
    integral = ways * NOISE / (4 * speed) * np.exp(-0.5 / NOISE) * np.expm1(speed * times / NOISE)
    assert told["probability"].to_numpy() == pytest.approx(1 - np.exp(-integral), rel=1e-6, abs=1e-15)
    assert told["law_error"].to_numpy() == pytest.approx(NOISE / (0.5 - speed * times), rel=0.02)
    assert told["drift_error"].to_numpy() == pytest.approx(speed / NOISE / 2, rel=1e-3)
    # From values at times, linear between them, the same.
    again = probability_of_tipping(found, speed * times, times, well=0, noise=NOISE)
    pd.testing.assert_frame_equal(told, again)


def test_what_is_not_to_be_believed_is_said():
    found = made(lambda h: 0.5 - h, values=np.linspace(0, 0.4, 5))
    slow = probability_of_tipping(found, lambda t: 1e-4 * t, np.array([0, 3000, 3900]), well=0, noise=NOISE)
    assert list(slow["valid"]) == [True, True, False]
    assert "below 3 times the noise" in slow["note"].iloc[-1]
    fast = probability_of_tipping(found, lambda t: 0.1 * t, np.array([0, 1.0]), well=0, noise=NOISE)
    assert not fast["valid"].iloc[-1] and "faster than the well relaxes" in fast["note"].iloc[-1]
    beyond = probability_of_tipping(found, lambda t: 0.1 - t, np.array([0, 0.01, 0.5]), well=0, noise=NOISE)
    assert "knows no rate" in beyond["note"].iloc[-1] and np.isnan(beyond["rate"].iloc[-1])


def test_where_no_law_holds_the_last_rate_is_kept_and_never_believed():
    found = made(lambda h: 0.5 - h, values=np.linspace(0, 0.48, 9))
    told = probability_of_tipping(
        found, lambda t: 0.4 + 1e-4 * t, np.arange(0, 800.0, 100), well=0, noise=NOISE
    )
    assert told["rate"].iloc[-1] == pytest.approx(np.exp(-0.08 / NOISE) / 4, rel=1e-9)
    assert told["law_error"].iloc[-1] == 1 and not told["valid"].iloc[1:].any()
    with pytest.raises(ValueError, match="above the noise"):
        probability_of_tipping(found, lambda t: 0 * t, np.array([0, 1.0]), well=0, noise=1.0)


def test_a_well_without_a_way_out_is_not_left():
    found = made(lambda h: 0.5 - h, values=[0.2, 0.3, 0.4])
    alone = pd.DataFrame([{"value": value, "well": 0, "barrier": np.inf} for value in (0.0, 0.1)])
    found = replace(found, table=as_table("sweep", pd.concat([alone, found.table], ignore_index=True)))
    told = probability_of_tipping(
        found, lambda t: 1e-4 * t, np.array([0, 1000.0, 3000.0]), well=0, noise=NOISE
    )
    assert list(told["probability"][:2]) == [0, 0] and list(told["rate"][:2] > 0) == [False, False]
    assert told["probability"].iloc[-1] > 0 and told["valid"].iloc[-1]


def test_a_well_that_has_ended_has_been_left():
    h, x = sympy.symbols("h x", real=True)
    cusp = Dynamics.of((x,), (h + x - x**3,), domain=[(-2, 2)], parameters={h: 0.0})
    found = sweep(cusp, "h", [0.0, 0.1, 0.2, 0.3, 0.6])
    fold = 2 / (3 * np.sqrt(3))
    times = np.array([0, fold - 1e-3, fold + 1e-3]) * 1e-3
    told = probability_of_tipping(found, lambda t: 1e3 * t, times, well=0, noise=1e-3)
    assert told["probability"].iloc[1] < 0.5 and told["probability"].iloc[2] == 1
    assert told["note"].iloc[2] == "the well has ended" and not told["valid"].iloc[2]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"well": 3}, "the well 3 has no way out"),
        ({"noise": 0.0}, "positive"),
        ({"times": np.array([1.0, 0.0])}, "rise"),
    ],
)
def test_bad_arguments_are_told(options, message):
    found = made(lambda h: 0.5 - h, values=[0.0, 0.1])
    asked = {"well": 0, "noise": NOISE, "times": np.array([0.0, 1.0])} | options
    times = asked.pop("times")
    with pytest.raises(ValueError, match=message):
        probability_of_tipping(found, lambda t: 0 * t, times, **asked)


@pytest.mark.slow
def test_walkers_tip_as_often_as_is_said():
    """ẋ = h(t) + x - x³ with h from 0 to 0.17: the share of 4000 walkers beyond the saddle, within errors."""
    h, x = sympy.symbols("h x", real=True)
    cusp = Dynamics.of((x,), (h + x - x**3,), domain=[(-2, 2)], parameters={h: 0.0})
    found = sweep(cusp, "h", np.linspace(0, 0.2, 9))
    end, last, step = 2000.0, 0.17, 0.01
    times = np.linspace(0, end, 5)
    told = probability_of_tipping(found, lambda t: last * t / end, times, well=0, noise=NOISE)
    generator = np.random.default_rng(1)
    walkers, left, counted = np.full(4000, -1.0), np.zeros(4000, dtype=bool), [0.0]
    for k in range(round(end / step)):
        value = last * k * step / end
        pushes = np.sqrt(NOISE * step) * generator.standard_normal(len(walkers))
        walkers += step * (value + walkers - walkers**3) + pushes
        left |= walkers > 0.8
        if (k + 1) % round(end / step / 4) == 0:
            counted.append(left.mean())
    share, expected = np.array(counted), told["probability"].to_numpy()
    error = np.hypot(np.sqrt(share * (1 - share) / 4000), expected * told["error"].to_numpy())
    assert told["valid"].all() and share[-1] > 0.1
    assert (np.abs(share - expected) <= 2 * error).all()
