"""Whole trajectories by damped least squares, and inputs that are held and lag."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import sympy

from siq.data.recordings import Recordings
from siq.diagnosis.study import _measurements_of
from siq.inference import trajectories
from siq.inference.kalman_filter import (
    MAX_SUBSTEPS,
    Grid,
    Noise,
    integrate_intervals,
    linearise,
    substeps_needed,
)
from siq.inference.maximum_likelihood import fit_by_multiple_shooting, fit_of_states
from siq.inference.measurements import (
    Measurements,
    course_of_input,
    expectations,
    first_states,
    measurements,
)
from siq.inference.recalibration import fit_with_and_without_process_noise
from siq.inference.trajectories import (
    _NormalEquations,
    _run_side_by_side,
    fit_trajectories,
    free_run,
    run,
    spread_edges,
)
from siq.numerics.files import Document, validate
from siq.systems.cards import SystemCard, build_system
from siq.systems.dynamics import Dynamics, Parameter

pytestmark = pytest.mark.portable

PENDULUM = {
    "name": "pendulum",
    "time_unit": "s",
    "states": {"x": {"unit": "1", "domain": [-3, 3]}, "v": {"unit": "1/s", "domain": [-3, 3]}},
    "inputs": {"u": {"unit": "1/s**2", "interpolation": "zero_order"}},
    "parameters": {"k": {"value": 1.0}, "d": {"value": 0.1}, "c": {"value": 0.0}},
    "equations": {"x": "v", "v": "-k*sin(x) - d*v - c*sign(v) + u"},
    "outputs": {"x": "x"},
}
STEP, SAMPLES = 0.2, 80


def model_of(card: dict) -> Dynamics:
    document = Document("card.yaml", card, {})
    return build_system(document, validate(document, SystemCard))


def driven(model: Dynamics, *, noise: float = 0.0, substeps: int = 48) -> tuple[Measurements, np.ndarray]:
    """Two recordings of a model's own motion, and the states."""
    generator = np.random.default_rng(4)
    t = np.arange(SAMPLES) * STEP
    pushes = generator.normal(size=(2, SAMPLES)) * 0.6
    data = Measurements(
        labels=("a", "b"),
        first=np.array([0, SAMPLES, 2 * SAMPLES]),
        t=np.tile(t, 2),
        outputs=np.zeros((2 * SAMPLES, 1)),
        courses=tuple((course_of_input(t, push, "zero_order"),) for push in pushes),
    )
    sharp = spread_edges(model, data, np.ones((2 * SAMPLES, 2)), substeps=substeps)
    states = run(sharp, Grid(data, substeps), np.array([[0.5, 0.0], [-1.0, 0.4]]))
    measured = states[:, :1] + noise * generator.normal(size=(2 * SAMPLES, 1))
    return replace(data, outputs=measured), states


def with_values(model: Dynamics, **values: float) -> Dynamics:
    return model.with_values(np.array([values.get(each.name, each.value) for each in model.parameters]))


def test_the_normal_equations_are_those_of_differences_of_trajectories() -> None:
    model = with_values(
        model_of({**PENDULUM, "equations": {"x": "v", "v": "-k*sin(x) - d*v + c*x + u"}}), c=0.1
    )
    data, states = driven(model, substeps=2)
    grid, begin = Grid(data, 2), states[data.first[:-1]]
    data = replace(data, outputs=data.outputs + np.random.default_rng(0).normal(size=data.outputs.shape))
    columns = []
    for place in range(7):
        shift = np.zeros(7)
        shift[place] = 1e-5
        ends = []
        for sign in (1, -1):
            moved = model.with_values(model.values + sign * shift[:3])
            ends.append(run(moved, grid, begin + sign * shift[3:].reshape(2, 2))[:, 0])
        columns.append((ends[0] - ends[1]) / 2e-5 / 0.5)
    whole = np.stack(columns, axis=1)
    left = (data.outputs - states[:, :1])[:, 0] / 0.5
    gram, target = whole.T @ whole, whole.T @ left
    along = linearise(model, Grid(data, 2), model.values, states)
    found = _NormalEquations(along, data, np.array([0.25]), expectations(model))
    size = np.abs(gram).max()
    assert found.shared == pytest.approx(gram[:3, :3], abs=1e-3 * size)
    assert found.own == pytest.approx(np.stack([gram[3:5, 3:5], gram[5:, 5:]]), abs=1e-3 * size)
    assert found.between == pytest.approx(np.stack([gram[:3, 3:5], gram[:3, 5:]]), abs=1e-3 * size)
    assert found.shared_target == pytest.approx(target[:3], abs=1e-2 * np.abs(target).max())
    # One undamped step solves them, and a damped one gains less.
    change, moved, gained = found.step(0.0)
    exact = np.linalg.solve(gram, target)
    assert np.concatenate([change, moved.ravel()]) == pytest.approx(exact, rel=0.05, abs=0.01)
    assert gained == pytest.approx(target @ exact, rel=1e-2)
    assert found.step(1.0)[2] < gained


def test_first_states_alone_are_fitted_where_every_parameter_is_known() -> None:
    model = with_values(
        model_of({**PENDULUM, "equations": {"x": "v", "v": "-k*sin(x) - d*v + c*x + u"}}), c=0.1
    )
    data, states = driven(model, substeps=2)
    still = replace(model, parameters=tuple(replace(each, fixed=True) for each in model.parameters))
    begin, noise = states[data.first[:-1]], Noise(np.array([1e-4]), np.zeros(2))
    found = fit_trajectories(still, data, begin=begin + 0.05, noise=noise, substeps=2)
    assert found.converged
    np.testing.assert_allclose(found.x[data.first[:-1]], begin, atol=1e-3)


def test_a_tape_and_numpy_give_the_same_trajectories() -> None:
    x, v, k = sympy.symbols("x v k", real=True)
    smooth = sympy.exp(-(x**2)) * sympy.cos(v) / (2 + sympy.sin(x)) + sympy.log(1 + x**2) + sympy.tan(x / 9)
    rough = sympy.Max(x, v, 0) ** 2 / 9 - sympy.Min(x, v) + sympy.sqrt(sympy.Abs(v)) * sympy.sign(x)
    forces = {
        "every function": rough + smooth - sympy.tanh(x) - sympy.atan(v) - 2 * x - v - x * (1 + x**2) ** k,
        "what runs away": k * x**3 + 1,
        "what no tape knows": -k * sympy.sinh(x),
    }
    for name, force in forces.items():
        model = Dynamics(
            states=("x", "v"), equations=(v, force), diffusion=Dynamics.of((x, v), (v, x)).diffusion,
            parameters=(Parameter("k", 0.7),),
        )  # fmt: skip
        data, _ = driven(model_of(PENDULUM))
        begin, grid = np.array([[0.5, 0.3], [1.5, 0.1]]), Grid(replace(data, courses=((), ())), 3)
        fast = run(model, grid, begin)
        slow = _run_side_by_side(model, grid, begin)
        assert (model.functions.tape is None) == (name == "what no tape knows")
        finite = np.isfinite(slow)
        assert (np.isfinite(fast) <= finite).all() and (name != "what runs away" or not finite.all())
        both = np.isfinite(fast)
        np.testing.assert_allclose(fast[both], slow[both], rtol=1e-9, atol=1e-12)


def test_friction_that_sticks_is_fitted_from_far_away() -> None:
    truth = with_values(model_of(PENDULUM), c=0.25)
    data, states = driven(truth, noise=0.01)
    model = spread_edges(with_values(truth, k=1.2, d=0.3, c=0.0), data, states, substeps=12)
    found = fit_trajectories(
        model,
        data,
        begin=states[data.first[:-1]] + 0.05,
        noise=Noise(np.array([1e-4]), np.zeros(2)),
        substeps=12,
    )
    assert found.converged and not found.has_process_noise
    assert (np.abs(found.model.values - truth.values) < 4 * found.standard_errors).all()
    assert found.noise.measurement[0] == pytest.approx(1e-4, rel=0.3)


def test_both_fits_agree_where_both_settle() -> None:
    card = {**PENDULUM, "parameters": {**PENDULUM["parameters"], "c": {"value": 0.0, "fixed": True}}}
    model = model_of(card)
    data, _ = driven(model, noise=0.02)
    x = first_states(model, data)
    noise = Noise(np.array([4e-4]), np.zeros(2))
    quick = fit_by_multiple_shooting(model, data, x=x, noise=noise, estimate_process=False, substeps=4)
    slow = fit_trajectories(model, data, begin=x[data.first[:-1]], noise=noise, substeps=4)
    assert quick.converged and slow.converged
    assert slow.model.values == pytest.approx(quick.model.values, abs=0.05 * quick.standard_errors.max())
    assert slow.log_likelihood == pytest.approx(quick.log_likelihood, abs=0.1)


def test_a_fit_of_a_mechanism_with_its_own_states_may_be_begun_from() -> None:
    model = model_of({**PENDULUM, "equations": {"x": "v", "v": "-k*sin(x) - d*v - c*v**3 + u"}})
    data, states = driven(model, noise=0.02)
    noise = Noise(np.array([4e-4]), np.array([0.0, 1e-3]))
    begin = fit_by_multiple_shooting(model, data, x=states, noise=noise, estimate_process=True, substeps=2)
    grown = replace(begin, noise=replace(begin.noise, process=np.array([0.0, 1e-3, 0.0])))
    loose, strict = fit_with_and_without_process_noise(model, data, grown, x=begin.x)
    assert loose is not None and len(loose.noise.process) == 2
    assert (
        strict.converged and (np.abs(strict.model.values - model.values) < 4 * strict.standard_errors).all()
    )


def test_a_simulation_that_runs_away_gives_no_fit() -> None:
    model = model_of({**PENDULUM, "equations": {"x": "v", "v": "x**5 + k - d*v - c + u"}})
    data, _ = driven(model_of(PENDULUM))
    noise = Noise(np.array([1e-4]), np.zeros(2))
    found = fit_trajectories(model, data, begin=np.full((2, 2), 3.0), noise=noise, substeps=2)
    assert not found.converged and found.log_likelihood == -np.inf


def test_states_beyond_all_squares_are_no_fit() -> None:
    model = model_of({**PENDULUM, "equations": {"x": "v", "v": "-k*x - d*v - c*v + u"}})
    data, states = driven(model)
    noise = Noise(np.array([1e-4]), np.zeros(2))
    found = fit_of_states(model, data, x=1e200 * (1 + states**2), noise=noise, substeps=2, converged=True)
    assert not found.converged and found.fault and found.log_likelihood == -np.inf


def delayed(tau: float) -> Dynamics:
    equations = {"x": "v", "v": "-k*x - d*v + c*0 + delay(u, tau)"}
    parameters = {**PENDULUM["parameters"], "tau": {"value": tau}}
    return model_of({**PENDULUM, "parameters": parameters, "equations": equations})


def test_a_held_input_that_lags_has_a_derivative() -> None:
    model = delayed(0.13)
    data, states = driven(model_of(PENDULUM))
    grid = Grid(data, 4)
    response = linearise(model, grid, model.values, states).response[data.begins, :, -1]
    change = [
        integrate_intervals(model, Grid(data, 4), model.values + np.eye(4)[3] * side, states[data.begins].T)
        for side in (1e-4, -1e-4)
    ]
    assert np.abs(response).max() > 0.5
    assert response == pytest.approx((change[0] - change[1]).T / 2e-4, abs=1e-3)


def test_a_held_input_that_lags_pushes_as_much_as_it_should() -> None:
    still = {**PENDULUM, "equations": {"x": "v", "v": "0*k + 0*d + 0*c + delay(u, tau)"}}
    still["parameters"] = {**PENDULUM["parameters"], "tau": {"value": 0.07}}
    model = model_of(still)
    data, _ = driven(model_of(PENDULUM))
    one = data.select([0])
    at = np.linspace(0, (SAMPLES - 1) * STEP, 40 * (SAMPLES - 1) + 1)
    middle = (at[1:] + at[:-1]) / 2
    push = one.courses[0][0](np.clip(middle - 0.07, 0, None))
    states = run(model, Grid(one, 3), np.zeros((1, 2)))
    exact = np.concatenate([[0], np.cumsum(push * np.diff(at))])[::40]
    # A jump within a step is spread over it: at a sample part of it may still be to come.
    assert states[:, 1] == pytest.approx(exact, abs=STEP / 3 / 2 * 1.5)
    assert abs(np.mean(states[:, 1] - exact)) < 2e-3


@pytest.mark.parametrize(
    ("formula", "arguments"),
    [("-sign(v) - sign(x)*v", ["v", "x"]), ("-design*(x + v)", []), ("-Abs(v)", []), ("-tanh(v/sigma)", []),
     ("-sqrt(v) + sqrt(x + 3) + sqrt(x) + x**2 + sqrt(2)*v", ["v"])],
)  # fmt: skip
def test_jumps_and_roots_are_found_in_formulas_and_not_in_their_spelling(
    formula: str, arguments: list[str]
) -> None:
    x, v = sympy.symbols("x v", real=True)
    names = {"design": sympy.Symbol("design", real=True), "sigma": sympy.Symbol("sigma", positive=True)}
    force = sympy.sympify(formula, {"x": x, "v": v, **names})
    moving = Dynamics.of((x, v), (v, force), parameters=dict.fromkeys(names.values(), 1.0))
    rising = np.linspace([-1, 0], [1, 1], 50)  # only v comes no further than to zero
    table = pd.DataFrame({"recording": "r", "t": np.arange(50.0), "x": rising[:, 0], "v": rising[:, 1]})
    edges = spread_edges(moving, _measurements_of(table, moving), rising, substeps=12).edges
    assert [str(each) for each, _ in edges] == arguments


STORES = {
    "name": "stores",
    "time_unit": "h",
    "states": {"A": {"unit": "1"}, "C": {"unit": "1"}},
    "parameters": {"k": {"value": 2.5}},
    "equations": {"A": "-k*A", "C": "k*A"},
    "outputs": {"c": "C"},
}


def test_steps_are_fine_enough_for_a_state_of_which_nothing_is_known_yet() -> None:
    # A store that feeds another rests empty where a fit begins. Within a step of 12 h it would grow beyond
    # all numbers, and no fit could fill it.
    model, t = model_of(STORES), np.array([0.0, 0.5, 1, 2, 4, 8, 12, 24])
    x = np.stack([np.zeros(8), 1 - np.exp(-2.5 * t)], axis=1)
    data = Measurements(labels=("a",), first=np.array([0, 8]), t=t, outputs=x[:, 1:], courses=((),))
    assert substeps_needed(model, data, model.values, x, tolerance=1e-3) == MAX_SUBSTEPS


def test_a_fit_to_few_samples_that_never_settles_has_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trajectories, "ACCURACY", 0.0)
    monkeypatch.setattr(trajectories, "SETTLED", 0.0)
    monkeypatch.setattr(trajectories, "MOST_DAMPING", np.inf)
    model, t, runs = model_of(STORES), np.linspace(0, 1, 8), []
    monkeypatch.setattr(trajectories, "run", lambda *options: runs.append(0) or run(*options))
    data = Measurements(labels=("a",), first=np.array([0, 8]), t=t, outputs=t[:, None] ** 2, courses=((),))
    noise = Noise(np.ones(1), np.zeros(2))
    found = fit_trajectories(model, data, begin=np.array([[1.0, 0.0]]), noise=noise, substeps=1)
    assert not found.converged and len(runs) <= 501


def course_of(u: np.ndarray, **entry: str) -> str:
    """How an input runs between its samples, in two recordings of half the length each."""
    half = len(u) // 2
    values = [np.stack([0 * one, one], axis=1) for one in (u[:half], u[half : 2 * half])]
    recordings = Recordings.from_arrays([np.arange(half) * STEP] * 2, values, names=["x", "u"])
    card = PENDULUM | {"inputs": {"u": {"unit": "1/s**2", **entry}}}
    (one,), (other,) = measurements(recordings, model_of(card)).courses
    assert one.c.shape[0] == other.c.shape[0]
    return {1: "held", 2: "joined"}[one.c.shape[0]]


def test_an_input_that_was_recorded_as_a_staircase_is_held_between_samples() -> None:
    generator, t = np.random.default_rng(7), np.arange(400)
    stairs = np.repeat(generator.normal(size=40), 10)
    assert course_of(stairs) == course_of(np.sign(np.sin(t / 7))) == "held"
    assert course_of(stairs + 0.1 * generator.normal(size=400)) == "held"  # as a voltmeter reads it
    coarse = np.round(20 * np.sin(t / 40)) / 20  # where it matters little
    assert course_of(coarse) == "held"
    # One recording may end far from where the next begins, which is no step.
    assert course_of(np.where(t < 200, np.sin(t / 7), 30.0 + np.sin(t / 5))) == "joined"
    # What drifts between its jumps, as the sun between clouds does, was not held.
    assert course_of(10 * stairs + np.sin(t / 7)) == "joined"
    for smooth in (np.sin(t / 7), generator.normal(size=400), np.abs(t % 40 - 20.0), np.ones(400) * t):
        assert course_of(smooth) == "joined"
    assert course_of(stairs, interpolation="linear") == "joined"
    assert course_of(np.sin(t / 7), interpolation="zero_order") == "held"


def test_a_tank_that_empties_in_a_free_run_and_never_did_before_stays_empty() -> None:
    card = {
        "name": "tank", "time_unit": "s", "states": {"h": {"unit": "cm"}},
        "inputs": {"u": {"unit": "cm/s", "interpolation": "zero_order"}},
        "parameters": {"c": {"value": 0.2}}, "equations": {"h": "u - c*sqrt(h)"},
    }  # fmt: skip
    model, t = model_of(card), np.arange(0, 100, 0.5)
    drained = np.clip(np.sqrt(4.0) - 0.1 * t, 0, None) ** 2  # from 4 cm: √h falls by c/2 a second
    table = Recordings.from_frame(
        pd.DataFrame({"recording": "a", "t": t, "h": drained, "u": 0.0}), columns=["h", "u"]
    )
    data = measurements(table, model)
    assert not model.edges
    seen = free_run(model, data, noise=Noise(np.array([1e-6]), np.zeros(1)), substeps=2)
    np.testing.assert_allclose(seen[:, 0], drained, atol=0.01)
    # Nothing helps what runs away for another reason.
    explosive = model_of(card | {"equations": {"h": "c*h**3 + u"}})
    ran = free_run(
        explosive, measurements(table, explosive), noise=Noise(np.array([1.0]), np.zeros(1)), substeps=2
    )
    assert not np.isfinite(ran).all()
