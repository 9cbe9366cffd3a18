"""What a card says of parameters and first states that recordings do not tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import sympy

from siq.diagnosis.study import comparison_of
from siq.inference.budget import Budget, BudgetSpent
from siq.inference.kalman_filter import Noise, Whitened
from siq.inference.measurements import Measurements, expectations, with_expectations
from siq.inference.recalibration import recalibrate
from siq.inference.trajectories import (
    _initial_states,
    fit_trajectories,
    free_run,
    normalised_rms,
)
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter

A, B, C, K, Z, X = sympy.symbols("a b c k z x", real=True)


def model(*, a: float = 1.0, b: float = 0.5, c: float = 2.0, outputs: tuple = (("x", X),)) -> Dynamics:
    """A state z that nobody measures drives x: only the product of two of the parameters can be told."""
    return Dynamics(
        ("x", "z"), (-A * X + B * C * Z, -K * Z), Diffusion.identity(2), outputs=outputs,
        parameters=(Parameter("a", a), Parameter("b", b), Parameter("c", c), Parameter("k", 0.3, fixed=True)),
    )  # fmt: skip


def recordings(system: Dynamics, *, count: int = 4, noise: float = 0.01) -> Measurements:
    draw = np.random.default_rng(5)
    a, b, c, k = system.values
    t = np.arange(0, 6, 0.1)
    frames = []
    for label in range(count):
        x, z = draw.uniform(-1, 1), draw.uniform(0.5, 1.5)
        forced = b * c * z / (a - k)
        y = (x - forced) * np.exp(-a * t) + forced * np.exp(-k * t)
        y = y + noise * draw.normal(size=len(t))
        frames.append(pd.DataFrame({"recording": f"r{label}", "t": t, "x": y}))
    return comparison_of(system, pd.concat(frames)).learn


def test_what_recordings_tell_is_found_although_the_card_expects_something_else() -> None:
    data = recordings(model(a=1.0))
    card = model(a=1.7)
    fit, _ = recalibrate(with_expectations(card), data)
    plain, _ = recalibrate(card, data)
    assert fit.model.values[0] == pytest.approx(1.0, abs=4 * fit.standard_errors[0])
    assert fit.model.values[0] == pytest.approx(plain.model.values[0], abs=0.3 * fit.standard_errors[0])


def test_what_they_do_not_tell_stays_near_the_card() -> None:
    # z starts anywhere, so that not even the product of b and c can be told.
    fit, _ = recalibrate(with_expectations(model(b=0.5, c=2.0)), recordings(model()))
    assert (np.abs(fit.model.values[1:3] - [0.5, 2.0]) < [0.05, 0.2]).all()
    # And is stated as known no better than within its own size.
    assert (fit.standard_errors[1:3] > [0.3, 1.2]).all() and (fit.standard_errors[1:3] < [0.6, 2.5]).all()


def test_an_error_says_how_near() -> None:
    entries = (Parameter("a", 1.0), Parameter("b", 0.5, error=0.01), Parameter("c", 2.0))
    near = with_expectations(replace(model(), parameters=(*entries, Parameter("k", 0.3, fixed=True))))
    rows, short = expectations(near, np.array([1.0, 0.48, 3.0, 0.3]))
    np.testing.assert_allclose(np.diag(rows), [1.0, 100.0, 0.5])
    np.testing.assert_allclose(short, [0.0, 2.0, -0.5])
    fit, _ = recalibrate(near, recordings(model()))
    assert fit.model.values[1] == pytest.approx(0.5, abs=0.01)
    assert fit.standard_errors[1] == pytest.approx(0.01, rel=0.2)


def test_whole_trajectories_end_where_steps_at_all_samples_do() -> None:
    data = recordings(model())
    fit, strict = recalibrate(with_expectations(model(a=1.2)), data)
    again = fit_trajectories(
        with_expectations(model(a=1.2)), data, begin=strict.x[data.first[:-1]], noise=fit.noise,
        substeps=strict.substeps,
    )  # fmt: skip
    np.testing.assert_allclose(again.model.values, strict.model.values, rtol=0.02)
    # Either may stop short along what is hardly told, by as much as a machine's rounding decides.
    assert again.sum_of_squares == pytest.approx(strict.sum_of_squares, rel=0.02)


def test_nothing_is_expected_of_fixed_parameters_and_of_zeros() -> None:
    named = with_expectations(model(b=0.0))
    rows, deviations = expectations(named, np.array([0.0, 7.0, 4.0]))
    np.testing.assert_array_equal(rows, [[1.0, 0.0, 0.0], [0.0, 0.0, 0.5]])
    np.testing.assert_array_equal(deviations, [1.0, -1.0])
    white = Whitened(np.ones(5), np.ones((5, 3)), np.zeros(5, int), np.ones(5, bool), 5, 0.0)
    for one, other in zip(white.solve(expectations(model())), white.solve(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_expectations_do_not_depend_on_units() -> None:
    data = recordings(model())
    one, _ = recalibrate(with_expectations(model(b=0.5, c=2.0)), data)
    other, _ = recalibrate(with_expectations(model(b=5e-4, c=2e3)), data)
    np.testing.assert_allclose(other.model.values[1:3] * [1e3, 1e-3], one.model.values[1:3], rtol=0.02)


def test_a_hidden_state_begins_where_it_usually_is_unless_the_prefix_tells() -> None:
    data = recordings(model())
    noise = Noise(np.array([1e-4]), np.zeros(2))
    usual = np.array([[-1.0, 0.6], [1.0, 1.0]])
    # Nothing tells z where it does nothing.
    begin = _initial_states(model(b=0.0), data, noise=noise, substeps=2, usual=usual)
    np.testing.assert_allclose(begin[:, 1], 0.8, atol=1e-3)
    # Where the prefix does tell it, a wrong expectation as wide as that does no harm.
    known = free_run(model(), data, noise=noise, substeps=2)
    expected = free_run(model(), data, noise=noise, substeps=2, usual=usual)
    one, other = (normalised_rms(each, data) for each in (known, expected))
    assert one is not None and other == pytest.approx(one, rel=0.1)


def test_a_state_that_rests_is_expected_nowhere_else_and_does_no_harm() -> None:
    data = recordings(model())
    noise = Noise(np.array([1e-4]), np.zeros(2))
    usual = np.array([[0.0, 1.0], [4.0, 1.0], [2.0, 1.0]])
    begin, alone = (
        _initial_states(model(), data, noise=noise, substeps=2, usual=one) for one in (usual, None)
    )
    np.testing.assert_allclose(begin, alone, rtol=0.05, atol=0.01)


def test_a_part_of_the_budget_can_be_kept_for_later() -> None:
    budget = Budget(work=100.0)
    with budget.keeping(0.4):
        budget.charge(60.0)
        with pytest.raises(BudgetSpent):
            budget.charge(1.0)
    assert budget.stopped_by == "work"
    budget.charge(40.0)
    with pytest.raises(BudgetSpent):
        budget.charge(1.0)
