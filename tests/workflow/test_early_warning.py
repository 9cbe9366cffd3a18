"""Early warning: exact times and probabilities of drawn equations, and records whose equation is known."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import scipy.integrate
import scipy.special

import siq
from siq.errors import Fault
from siq.workflow import tipping


def drawn(coefficients, *, noise=1.0, x=None) -> tipping._DrawnProcess:
    """The process of one equation, or of several ``(draws, 6)``."""
    coefficients = np.atleast_2d(np.array(coefficients, dtype=float))
    x = np.linspace(-6, 6, 1200) if x is None else x
    return tipping._DrawnProcess(x, coefficients, np.full(len(coefficients), noise))


def recorded(f, a, *, noise, step, start, seed, fine=5) -> pd.DataFrame:
    """A record of ``dx = f(x, a) dt + √noise dW`` with a parameter at each sample."""
    kicks = np.sqrt(noise * step / fine) * np.random.default_rng(seed).normal(size=(len(a), fine))
    x, states = start, []
    for parameter, row in zip(a, kicks, strict=True):
        for kick in row:
            x += f(x, parameter) * step / fine + kick
        states.append(x)
    return pd.DataFrame({"t": np.arange(len(a)) * step, "x": states})


def test_barrier_and_mean_time_are_those_of_a_quadrature():
    """f = 1 - x², Q = 0.5: ΔU/ε = 8/3/Q, and ``T = (2/Q) ∫ e^{U(y)} ∫_y e^{-U(z)} dz dy``."""
    process = drawn([1, 0, -1, 0, 0, 0], noise=0.5, x=np.linspace(-3, 6, 2000))
    barrier, time, rate = process.frozen(0.0, 1.0)[:, 0]
    assert rate == pytest.approx(2, rel=5e-3)  # at the nearest cell
    assert barrier == pytest.approx(8 / 3 / 0.5, rel=1e-5)
    grid = np.linspace(-3, 4, 200_001)
    u = -(2 / 0.5) * (grid - grid**3 / 3)
    rim = grid[(grid < -1) & (u < 2 * 2 / 3 / 0.5 - tipping.BEHIND)].max()
    grid, u = grid[grid >= rim], u[grid >= rim]
    inner = -scipy.integrate.cumulative_trapezoid(np.exp(-u[::-1]), grid[::-1], initial=0)[::-1]
    outer = scipy.integrate.cumulative_trapezoid(np.exp(u) * inner, grid, initial=0) * 2 / 0.5
    assert time == pytest.approx(np.interp(1.0, grid, outer), rel=0.01)


def test_a_steady_well_is_left_at_its_mean_time():
    """Beyond the relaxation ``P = 1 - exp(-t/T)``, but for what the first relaxation takes."""
    process = drawn([1, 0, -1, 0, 0, 0], noise=0.5)
    time = process.frozen(0.0, 1.0)[1, 0]
    times = np.linspace(0, 2 * time, 61)
    left = process.left_by(times, 1.0)[:, 0]
    assert left == pytest.approx(-np.expm1(-times / time), abs=0.01)


def test_a_wandering_state_is_absorbed_at_both_ends_as_in_closed_form():
    """No f: from the middle of an interval 2a, ``T = a²/Q``; and P is a theta series."""
    process = drawn(np.zeros(6), noise=2.0, x=np.linspace(-1, 1, 801))
    barrier, time = process.frozen(0.0, 0.0)[:2, 0]
    assert time == pytest.approx(0.5, rel=0.01) and barrier == np.inf  # flat: no saddle on any side
    times = np.linspace(0, 1, 61)
    k = np.arange(200)
    rates = ((2 * k + 1) * np.pi / 2) ** 2
    kept = (4 / np.pi * (-1.0) ** k / (2 * k + 1) * np.exp(-rates * times[:, None])).sum(axis=1)
    assert process.left_by(times, 0.0)[1:, 0] == pytest.approx(1 - kept[1:], abs=0.02)


def test_a_well_that_ends_has_been_left_and_one_that_deepens_holds():
    falls, deepens = [1, 0, -1, 0, -0.02, 0], [1, 0, -1, 0, 0.02, 0]
    left = drawn([falls, deepens], noise=0.3).left_by(np.linspace(0, 200, 61), 1.0)
    assert left[-1, 0] == pytest.approx(1, abs=1e-6) and left[-1, 1] < 0.01
    assert (np.diff(left, axis=0) > -1e-9).all()
    ended = drawn([-1, 0, -1, 0, 0, 0], noise=0.3, x=np.linspace(-6, 6, 400)).frozen(0.0, 1.0)
    assert ended[0, 0] == 0 and ended[1, 0] == pytest.approx(np.pi / 4 + np.arctan(6), rel=0.1)


def test_conditioning_on_zeros_is_the_fit_without_these_terms():
    """Means of the draws of a family against least squares on its columns alone."""
    draw = np.random.default_rng(0)
    columns, target = draw.normal(size=(400, 6)), draw.normal(size=400)
    covariance = np.linalg.inv(columns.T @ columns)
    whole = covariance @ columns.T @ target
    coefficients, weights = tipping._drawn(whole, covariance, draw)
    small = coefficients[(coefficients[:, [3, 5]] == 0).all(axis=1)][:, [0, 1, 2, 4]]
    alone, *_ = np.linalg.lstsq(columns[:, [0, 1, 2, 4]], target, rcond=None)
    order, slope = (abs(whole[k]) / np.sqrt(covariance[k, k]) for k in (3, 5))
    assert weights[4, 1] / weights[4, 2] == pytest.approx(np.exp(1 - slope**2 / 2))
    assert weights[3, 2] / weights[4, 2] == pytest.approx(np.exp(1 - order**2 / 2))
    assert small.mean(axis=0) == pytest.approx(alone, abs=5 * 0.05 / np.sqrt(len(small)))
    assert small.std(axis=0) == pytest.approx(0.05, rel=0.25)


def test_a_finite_record_seems_to_be_held_more_strongly_than_it_is():
    """A linear state for 300 relaxation times: a rate alone would be off by ``4/300``."""
    draw = np.random.default_rng(4)
    t = np.arange(-3000, 0) * 0.1
    values = np.array([0, -1.0, 0, 0, 0, 0])
    rounds = [
        tipping._bias(values, 2.0, t, 3 * draw.normal(size=len(t)), np.array([0]), draw) for _ in range(5)
    ]
    found = np.mean(rounds, axis=0)
    # Over a normal density the slope of c₃x³ is 3c₃ in the mean.
    assert -0.1 < found[1] + 3 * found[3] < -4 / 300 / 2
    assert abs(found[0]) < 0.02 and abs(found[2]) < 0.01


@pytest.fixture(scope="module")
def nearing() -> tipping._EarlyWarning:
    """A fold that nears: ΔU/ε = 8/3 a^1.5/Q from 10.7 to 4.9."""
    a = np.linspace(1.0, 0.6, 12_000)
    record = recorded(lambda x, a: a - x * x, a, noise=0.25, step=0.05, start=1.0, seed=5)
    return siq.early_warning(record, until=720)


def test_a_record_that_nears_a_fold(nearing):
    first, last = nearing.course.iloc[0], nearing.course.iloc[-1]
    for now, truth in ((first, 8 / 3 / 0.25), (last, 8 / 3 * 0.6**1.5 / 0.25)):
        # One record: how often the intervals hold is a matter of the benchmark.
        assert 0.8 * now["barrier_lower"] < truth < 1.25 * now["barrier_upper"]
        assert now["mean_time_lower"] < now["mean_time"] < now["mean_time_upper"]
    assert nearing.falling > 0.85 and not nearing.notes
    said = nearing.probability
    assert said["time"].iloc[[0, -1]].tolist() == pytest.approx([599.95, 720])
    assert (np.diff(said["probability"]) >= 0).all() and said["probability"].iloc[0] == 0
    assert (said["lower"] <= said["upper"]).all()
    assert len(nearing.plot().axes) == 3


def test_seconds_or_years_and_an_offset_change_nothing(nearing):
    a = np.linspace(1.0, 0.6, 12_000)
    record = recorded(lambda x, a: a - x * x, a, noise=0.25, step=0.05, start=1.0, seed=5)
    moved = pd.DataFrame({"t": 2000 + record["t"] / 60, "level": 300 + 20 * record["x"]})
    again = siq.early_warning(moved, until=2000 + 720 / 60)
    assert again.probability["probability"].to_numpy() == pytest.approx(
        nearing.probability["probability"].to_numpy(), abs=1e-3
    )


@pytest.mark.slow
def test_a_record_with_a_memory_and_one_that_bends_are_told():
    draw = np.random.default_rng(2)
    coloured = np.zeros(6000)
    force = 0.0
    for k in range(1, 6000):
        force += -0.5 * force * 0.1 + 0.4 * np.sqrt(0.1) * draw.normal()
        coloured[k] = coloured[k - 1] + 0.1 * (-coloured[k - 1] + force) + 0.05 * draw.normal()
    said = siq.early_warning(pd.DataFrame({"t": np.arange(6000) * 0.1, "x": coloured}), until=700)
    assert "workflow.warning_with_memory" in [one.code for one in said.remarks]
    a = 1 - 0.45 * np.linspace(-1, 1, 12_000) ** 2
    bent = recorded(lambda x, a: a - x * x, a, noise=0.1, step=0.05, start=0.7, seed=3)
    codes = [one.code for one in siq.early_warning(bent, until=700).remarks]
    assert codes == ["workflow.warning_uneven"]


def test_what_cannot_be_asked_is_refused():
    record = pd.DataFrame(
        {"t": np.arange(500) * 0.1, "x": np.sin(np.arange(500)), "y": np.cos(np.arange(500))}
    )
    with pytest.raises(Fault, match="several columns; name the one that tips, x or y"):
        siq.early_warning(record, until=60)
    with pytest.raises(Fault, match="the column 'z' is not there"):
        siq.early_warning(record, until=60, state="z")
    with pytest.raises(Fault, match="not after the record"):
        siq.early_warning(record, until=40, state="x")
    with pytest.raises(Fault, match="too short"):
        siq.early_warning(record[:20], until=40, state="x")
