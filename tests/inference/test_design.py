"""Experiments that tell models apart: what they are expected to give, and where they are looked for."""

from __future__ import annotations

import numpy as np
import pytest
import sympy

from siq.data.recordings import Recordings
from siq.inference.design import next_experiment
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements, measurements
from siq.inference.recalibration import recalibrate
from siq.remarks import Remark, sentence
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Input, Parameter

X, U, K, C = sympy.symbols("x u k c", real=True)
T, NOISE = np.arange(0, 4, 0.1), 0.02
LIMITS = np.array([[-4.0, 4.0]])


def model_of(rate: sympy.Expr, *names: str, inputs: tuple[Input, ...] = ()) -> Dynamics:
    parameters = tuple(Parameter(name, 0.5) for name in names)
    return Dynamics(
        ("x",), (rate,), Diffusion.identity(1), domain=LIMITS, parameters=parameters, inputs=inputs
    )


LINEAR, QUADRATIC = model_of(-K * X, "k"), model_of(-C * X * sympy.Abs(X), "c")


def decays(model: Dynamics, *, u: float | None = None) -> Measurements:
    """Two decays from about 0.8, over a fraction of their time."""
    rng = np.random.default_rng(3)
    columns = [0.8 * size * np.exp(-0.5 * T) + NOISE * rng.normal(size=len(T)) for size in (1.0, 1.1)]
    values = [
        np.stack([x, np.full(len(T), 0.1) + u * np.sin(T)], axis=1) if u else x[:, None] for x in columns
    ]
    names = ["x", "u"] if u else ["x"]
    return measurements(Recordings.from_arrays([T, T], values, names=names), model)


def plan_of(one: Fit, *others: Fit, data: Measurements, enough: float = 1e9, noise: float = NOISE) -> Remark:
    plan = next_experiment(one, others, data, variance=np.array([noise**2]), correlated=1.0, enough=enough)
    assert plan is not None
    return plan


@pytest.fixture(scope="module")
def fits() -> tuple[Measurements, Fit, Fit]:
    data = decays(LINEAR)
    return data, recalibrate(LINEAR, data)[1], recalibrate(QUADRATIC, data)[1]


def test_where_laws_part_an_experiment_tells_them(fits: tuple[Measurements, Fit, Fit]) -> None:
    data, linear, quadratic = fits
    plan = plan_of(linear, quadratic, data=data)
    assert abs(plan.values["states"]["x"]) > 3.5  # at the ends of the domain they differ most
    near = plan_of(linear, quadratic, data=data, enough=np.log(100))
    assert near.values["odds"] >= 100
    assert abs(near.values["states"]["x"] - 0.84) < abs(plan.values["states"]["x"] - 0.84)
    assert "begin at x =" in sentence(Remark(plan.code, dict(plan.values) | {"name": "a", "others": ["b"]}))


def test_a_model_is_not_told_from_itself_and_from_several_only_as_far_as_from_the_nearest(
    fits: tuple[Measurements, Fit, Fit],
) -> None:
    data, linear, quadratic = fits
    assert plan_of(linear, linear, data=data).values["odds"] == pytest.approx(1.0)
    assert plan_of(linear, quadratic, linear, data=data).values["odds"] == pytest.approx(1.0)


def test_the_odds_are_those_that_the_experiment_gives(fits: tuple[Measurements, Fit, Fit]) -> None:
    """The difference of least sums of squares, of recordings so far and of the new one, in the mean."""
    data, linear, quadratic = fits
    size = 0.1  # of the errors in the new recording
    plan = plan_of(linear, quadratic, data=data, noise=size, enough=2.0)
    begin, noise = plan.values["states"]["x"], np.random.default_rng(8)
    k, c = linear.model.values[0], quadratic.model.values[0]
    # Each law has one parameter: a fine grid of it is all that a fit could do.
    grids = {"linear": k * np.linspace(0.8, 1.2, 401), "quadratic": c * np.linspace(0.6, 1.4, 801)}
    curves = {
        "linear": begin * np.exp(-grids["linear"][:, None] * T),
        "quadratic": begin / (1 + grids["quadratic"][:, None] * abs(begin) * T),
    }
    prior = {
        "linear": ((grids["linear"] - k) / linear.standard_errors[0]) ** 2,
        "quadratic": ((grids["quadratic"] - c) / quadratic.standard_errors[0]) ** 2,
    }
    gains = []
    for right, wrong, value in (("linear", "quadratic", k), ("quadratic", "linear", c)):
        truth = curves[right][np.argmin(np.abs(grids[right] - value))]
        drawn = []
        for _ in range(200):
            y = truth + size * noise.normal(size=len(T))
            least = {
                name: (((y - curve) ** 2).sum(axis=1) / size**2 + prior[name]).min()
                for name, curve in curves.items()
            }
            drawn.append(0.5 * (least[wrong] - least[right]))
        gains.append(np.mean(drawn))
    assert np.log(plan.values["odds"]) == pytest.approx(min(gains), rel=0.25)


def test_of_a_driven_system_the_input_is_proposed_within_its_recorded_range() -> None:
    entry = (Input("u", "N", "linear"),)
    lag, root = (
        model_of(-K * X + U, "k", inputs=entry),
        model_of(-K * X + U - C * U**3, "k", "c", inputs=entry),
    )
    data = decays(lag, u=0.3)
    plan = plan_of(recalibrate(lag, data)[1], recalibrate(root, data)[1], data=data)
    values = plan.values
    assert values["input"] == "u" and abs(values["level"]) + values["amplitude"] <= 0.4 + 1e-9
    assert "let u" in sentence(Remark(plan.code, dict(values) | {"name": "a", "others": ["b"]}))
