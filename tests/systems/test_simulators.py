"""`with_simulator`: the vector field behind the steps of a simulator, and its derivatives."""

from __future__ import annotations

import numpy as np
import pytest
import sympy

from siq.errors import InputError
from siq.systems.cards import load_system
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Input, Parameter, Signals
from siq.systems.formulas import delay
from siq.systems.simulation import with_simulator

x, v, u, k = sympy.symbols("x v u k", real=True)
EQUATIONS = (v, -k * sympy.sin(x) - x * v + u)
WRITTEN = Dynamics(
    ("x", "v"), EQUATIONS, Diffusion.identity(2),
    inputs=(Input("u", "1", "linear"),), parameters=(Parameter("k", 2.0),),
)  # fmt: skip
POINTS = np.random.default_rng(0).normal(size=(2, 30))
FORCE = np.random.default_rng(1).normal(size=(1, 30))
SIGNALS = Signals(inputs=FORCE, delayed=FORCE[:0], slopes=FORCE[:0], t=np.zeros(30))


def rate(states, inputs, parameters):
    place, speed = states
    return np.array([speed, -parameters[0] * np.sin(place) - place * speed + inputs[0]])


def fine(states, inputs, parameters, dt):
    """Many small steps: the motion of the equations, for all that matters."""
    h = dt / 8
    for _ in range(8):
        a = rate(states, inputs, parameters)
        b = rate(states + h / 2 * a, inputs, parameters)
        c = rate(states + h / 2 * b, inputs, parameters)
        d = rate(states + h * c, inputs, parameters)
        states = states + h / 6 * (a + 2 * b + 2 * c + d)
    return states


def simulated(simulate=fine, *, step: float = 1e-3, model: Dynamics = WRITTEN) -> Dynamics:
    return with_simulator(model, simulate, step=step, x=POINTS, inputs=FORCE)


def test_a_definition_stays_and_the_rest_is_what_the_simulator_does() -> None:
    model = simulated()
    assert model.equations[0] == v
    assert str(model.equations[1]) == "simulated_v(x, v, u, k)"
    assert model.kinematic == (True, False) and model.free == (0,)


@pytest.mark.parametrize("step", [1e-3, 1e-2])
def test_values_and_derivatives_are_those_of_the_equations(step: float) -> None:
    model = simulated(step=step)
    found, true = (each.functions.rates(POINTS, SIGNALS, each.values) for each in (model, WRITTEN))
    assert found == pytest.approx(true, abs=50 * step**3 + 1e-9)
    slopes = (each.functions.slopes(POINTS, SIGNALS, each.values) for each in (model, WRITTEN))
    for ours, theirs in zip(*slopes, strict=True):
        assert ours == pytest.approx(theirs, abs=1e-4)


def test_second_and_third_derivatives_are_good_enough_for_a_filter() -> None:
    for by, error in (((x, x), 1e-3), ((x, v), 1e-3), ((x, x, x), 1e-2), ((x, x, k), 1e-2)):
        found, true = (
            sympy.lambdify([x, v, u, k], each.equations[1].diff(*by))(*POINTS, FORCE[0], 2.0)
            for each in (simulated(), WRITTEN)
        )
        assert found == pytest.approx(np.broadcast_to(true, 30), abs=error), by


def test_the_error_of_the_field_is_of_the_third_order() -> None:
    true = WRITTEN.functions.rates(POINTS, SIGNALS, WRITTEN.values)
    errors = [
        np.abs(each.functions.rates(POINTS, SIGNALS, each.values) - true).max()
        for each in (simulated(step=0.04), simulated(step=0.02))
    ]
    assert errors[0] / errors[1] == pytest.approx(8, rel=0.15)


def test_a_coarse_rule_is_told_as_it_moves() -> None:
    """Euler's rule with the step h moves as f - h/2 f'f + O(h²), its own error included."""

    def euler(states, inputs, parameters, dt):
        return states + dt * np.array([-parameters[0] * states[0]])

    model = Dynamics.of((x,), (-k * x,), parameters={k: 1.0})
    at, none = np.array([[1.0, 2.0, -1.0]]), np.zeros((0, 3))
    found = with_simulator(model, euler, step=0.1, x=at, inputs=none)
    effective = np.log(1 - 0.1) / 0.1
    rates = found.functions.rates(at, Signals(none, none, none, np.zeros(3)), found.values)
    assert rates == pytest.approx(effective * at, rel=5e-4)


def test_a_stiff_simulator_has_no_rate_above_eleven_sixths_of_a_step() -> None:
    def implicit(states, inputs, parameters, dt):
        return (states + dt * parameters[0] * inputs[0]) / (1 + dt * parameters[0])

    relaxing = (k * (u - x),)
    fast = (Parameter("k", 1e9),)
    card = Dynamics(("x",), relaxing, Diffusion.identity(1), inputs=WRITTEN.inputs, parameters=fast)
    at = POINTS[:1]
    found = with_simulator(card, implicit, step=0.01, x=at, inputs=FORCE)
    rates = found.functions.rates(at, SIGNALS, found.values)
    assert rates == pytest.approx(11 / 6 / 0.01 * (FORCE - at), rel=1e-6)


def test_columns_are_asked_for_together_where_that_is_the_same() -> None:
    calls: list[int] = []

    def counted(states, inputs, parameters, dt):
        calls.append(states.ndim)
        return fine(states, inputs, parameters, dt)

    model = simulated(counted)
    calls.clear()
    model.functions.rates(POINTS, SIGNALS, model.values)
    assert calls == [2, 2, 2]
    # One that branches takes states one by one, with the same result.
    branching = simulated(lambda s, i, p, dt: fine(s, i, p, dt) if s[0] < 9 else s)
    ours, theirs = (each.functions.rates(POINTS, SIGNALS, each.values) for each in (branching, model))
    assert ours == pytest.approx(theirs)


def test_what_acts_on_an_input_or_a_parameter_can_be_put_in() -> None:
    model = simulated()
    late = model.equations[1].subs(u, delay(u, sympy.Symbol("tau", real=True)))
    assert str(late) == "simulated_v(x, v, delay(u, tau), k)"
    slope = late.diff(k)
    assert str(slope) == "simulated_v_by_k(x, v, delay(u, tau), k)"


def test_two_simulators_of_the_same_names_are_not_confused() -> None:
    other = simulated(lambda s, i, p, dt: fine(s, i, 2 * p, dt))
    first, second = (each.functions.rates(POINTS, SIGNALS, each.values) for each in (simulated(), other))
    assert np.abs(first - second).max() > 0.1


def test_a_simulator_that_fails_far_away_has_no_number_there() -> None:
    def fails(states, inputs, parameters, dt):
        if np.max(np.abs(states)) > 50:
            raise OverflowError("too far")
        return fine(states, inputs, parameters, dt)

    far = POINTS.copy()
    far[0, 3] = 100.0
    model = simulated(fails)
    rates = model.functions.rates(far, SIGNALS, model.values)
    assert np.isnan(rates[1, 3]) and np.isfinite(np.delete(rates, 3, axis=1)).all()


def drawn(states, inputs, parameters, dt):
    return fine(states, inputs, parameters, dt) + np.random.default_rng().normal(size=np.shape(states))


@pytest.mark.parametrize(
    ("simulate", "words"),
    [
        (lambda s, i, p, dt: 1 / 0, "it raises ZeroDivisionError: division by zero"),
        (lambda s, i, p, dt: s * np.nan, "the next x is no number"),
        (lambda s, i, p, dt: [s[0], np.inf], "the next v is no number"),
        (lambda s, i, p, dt: [0.0], r"it answers with numbers of the shape \(1,\), and states have \(2,\)"),
        (lambda s, i, p, dt: None, "it answers with numbers of the shape"),
        (lambda s, i, p, dt: "next", "it raises ValueError"),
        (drawn, "asked twice it gives two answers"),
    ],
)  # fmt: skip
def test_one_that_has_no_answer_is_refused_in_one_sentence(simulate, words: str) -> None:
    with pytest.raises(InputError, match=words) as refusal:
        simulated(simulate)
    sentence = str(refusal.value)
    assert sentence.startswith("the simulator, at x = 0.12573, v = ")
    assert ", u = " in sentence and ", k = 2: " in sentence and "\n" not in sentence


def test_a_card_needs_no_equations_and_no_name_but_units() -> None:
    card = {"states": {"x": {"unit": "m"}, "v": {"unit": "m/s"}}, "equations": {"x": "v"}}
    model = load_system(card, simulated=True)
    assert model.kinematic == (True, False) and model.units == ("m", "m/s")
    with pytest.raises(InputError, match=r"the card, states.v: 'v' has no unit; give it"):
        load_system({"states": {"x": {"unit": "m"}, "v": {}}}, simulated=True)
    with pytest.raises(InputError, match="the key 'states' is missing"):
        load_system({"time_unit": "s"}, simulated=True)
    with pytest.raises(InputError, match="has no equation"):
        load_system(card | {"name": "two"})
