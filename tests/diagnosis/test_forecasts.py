"""Forecasts of parts left out: how they are counted, and what they name where forces at random act, too."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from homes_of_mechanisms import (
    HOMES,
    Resident,
    candidates,
    model_of,
    numbers,
    recorded as recorded_at_home,
    states,
    truth_of,
)

from siq.data.recordings import Recordings
from siq.diagnosis import forecasts, mechanisms
from siq.diagnosis.dictionary import roles_of, standard_dictionary
from siq.diagnosis.evidence import FittedCandidate, NotFitted
from siq.diagnosis.forecasts import (
    FOLDS,
    Horizon,
    _exchanged,
    _fold_of,
    _Foreseen,
    _gained,
    _gains,
    _horizons_of,
    _Leader,
    _log_priors,
    _needed,
    _next_rung,
    _on_top,
    _Rung,
    _Site,
    _sites,
    _takes_most,
    _thinned,
    climb,
)
from siq.diagnosis.holdout import preferred_recalibration
from siq.diagnosis.mechanisms import MechanismCandidate, candidates_of
from siq.diagnosis.screening import Probe, Term, linearised_with
from siq.diagnosis.search import AcceptedMechanism, FitContext
from siq.diagnosis.terms import Place
from siq.errors import NumericalFailure
from siq.inference.budget import Budget
from siq.inference.kalman_filter import Linearisation, Noise, Whitened, whiten
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements, measurements
from siq.inference.recalibration import recalibrate
from siq.systems.dynamics import Dynamics
from tests.diagnosis.decays import DECAY

SAMPLES, FINE, DURATION, LASTING, NOISE = 120, 10, 8.0, 0.5, 0.001
CLOSE = ("linear damping", "quadratic drag", "cubic stiffness", "constant bias")  # near the truth, or far off


def pendulum(scale: float = 1.0, *, linear: bool = False) -> Dynamics:
    """Without damping; angles are in units of so many per radian. One that is linear is a spring."""
    card = {
        "time_unit": "s",
        "states": states(a="1", w="1/s"),
        "parameters": numbers(k=8.5),
        "equations": {"a": "w", "w": "-k*a" if linear else f"-k*{scale}*sin(a/{scale})"},
        "outputs": {"q": "a"},
    }
    return model_of(card)


def recorded(
    damping: float,
    force: float,
    *,
    scale: float = 1.0,
    count: int = 6,
    seed: int = 3,
    bias: float | None = None,
) -> Measurements:
    """Pendulums of another swing each, by Heun's rule, with forces at random that last for a while.

    Or springs, on which a constant force acts.
    """
    draw = np.random.default_rng(seed)
    h = DURATION / (SAMPLES - 1) / FINE
    state = np.stack([np.linspace(0.6, 2.2, count), draw.normal(size=count)])
    push, memory = draw.normal(size=count), np.exp(-h / LASTING)
    seen = np.empty((count, SAMPLES))

    def rate(y: np.ndarray) -> np.ndarray:
        back = -9.0 * np.sin(y[0]) if bias is None else bias - 9.0 * y[0]
        return np.stack([y[1], back - damping * y[1] + force * push])

    for sample in range(SAMPLES):
        seen[:, sample] = state[0]
        for _ in range(FINE):
            first = rate(state)
            state = state + h / 2 * (first + rate(state + h * first))
            push = memory * push + np.sqrt(1 - memory**2) * draw.normal(size=count)
    seen = scale * (seen + NOISE * draw.normal(size=seen.shape))
    return laid_out(seen, pendulum(scale, linear=bias is not None))


def laid_out(seen: np.ndarray, model: Dynamics) -> Measurements:
    count, samples = seen.shape
    table = Recordings(
        ("q",), (None,), tuple(f"r{place}" for place in range(count)), np.repeat(np.arange(count), samples),
        np.tile(np.linspace(0, DURATION, samples), count), seen.reshape(-1, 1),
    )  # fmt: skip
    return measurements(table, model)


def context_of(model: Dynamics, data: Measurements, among: tuple[str, ...] = ()) -> FitContext:
    roles = roles_of(model)
    dictionary = [each for each in standard_dictionary() if not among or each.name in among]
    return FitContext(model, data, roles, tuple(candidates_of(model, roles, dictionary)))


def first_rung(context: FitContext) -> _Rung | None:
    fit, _ = recalibrate(context.model, context.data)
    assert fit.has_process_noise
    return _next_rung(_horizons_of(fit, context), context.candidates, context, {})


@cache
def damped() -> _Rung:
    """What is found first where linear damping is missing."""
    found = first_rung(context_of(pendulum(), recorded(0.15, 0.2), CLOSE))
    assert found is not None
    return found


# Priors


def member(name: str, family: str, weight: float = 1.0) -> MechanismCandidate:
    like = next(iter(candidates_of(pendulum(), roles_of(pendulum()), standard_dictionary())))
    return replace(like, name=name, family=family, weight=weight)


def test_names_share_what_is_left_to_them_and_a_family_counts_once() -> None:
    crowd = [member(f"spring {place}", "stiffness") for place in range(5)]
    given = [*crowd, member("drag", "resistance"), member("bias", "bias", 2.0), member("bias", "bias", 2.0)]
    priors = np.exp(_log_priors(given, 0.1))
    assert priors.sum() == pytest.approx(0.9)
    # A family has the weight of its likeliest member, however many these are.
    assert priors[:5].sum() == pytest.approx(priors[5])
    # One that could act in two places is divided between them, and weighs twice as much together.
    assert priors[6] == pytest.approx(priors[7]) and priors[6:].sum() == pytest.approx(2 * priors[5])


def test_members_share_their_family_by_weight() -> None:
    given = [member("drag", "resistance", 5.0), member("odd", "resistance", 0.2), member("bias", "bias")]
    usual, odd, bias = np.exp(_log_priors(given, 0.1))
    assert usual == pytest.approx(25 * odd)
    assert usual + odd == pytest.approx(5 * bias)
    assert usual + odd + bias == pytest.approx(0.9)


def test_priors_of_the_dictionary_are_probabilities() -> None:
    context = context_of(pendulum(), recorded(0.0, 0.2))
    assert np.exp(_log_priors(context.candidates, 0.3)).sum() == pytest.approx(0.7)


# Horizons and parts


def test_a_thinned_recording_has_every_so_manieth_sample_from_its_first() -> None:
    data = laid_out(np.random.default_rng(1).normal(size=(3, 30)), pendulum())
    for every in (1, 4, 16):
        known = np.isfinite(_thinned(data, every).outputs[:, 0]).reshape(3, 30)
        np.testing.assert_array_equal(known, np.tile(np.arange(30) % every == 0, (3, 1)))
    assert np.isfinite(data.outputs).all()


@pytest.mark.parametrize(("count", "parts"), [(1, 8), (2, 8), (3, 9), (4, 4), (8, 8), (11, 8)])
def test_parts_are_whole_stretches_and_each_row_is_in_one(count: int, parts: int) -> None:
    data = laid_out(np.zeros((count, 40)), pendulum())
    fold = _fold_of(data)
    assert len(fold) == data.outputs.size and set(fold) == set(range(parts)) and parts < FOLDS + count
    for begin, end in itertools.pairwise(data.first):
        part = fold[begin:end]
        # A stretch begins where another ends; where there are enough recordings nobody divides one.
        stretches = 1 + int((np.diff(part) != 0).sum())
        assert stretches == len(set(part)) and (stretches == 1 or count < FOLDS // 2)


def test_parts_do_not_depend_on_the_order_of_recordings() -> None:
    data = laid_out(np.zeros((11, 40)), pendulum())
    other = replace(data, labels=data.labels[::-1])
    pairs = [sorted(zip(each.labels, _fold_of(each)[::40], strict=True)) for each in (data, other)]
    assert pairs[0] == pairs[1]


def test_horizons_end_where_too_few_samples_tell_of_the_parameters() -> None:
    context = context_of(pendulum(), recorded(0.0, 0.2), CLOSE)
    horizons = _horizons_of(recalibrate(context.model, context.data)[0], context)
    known = [int(np.isfinite(each.data.outputs).sum()) for each in horizons]
    assert known == [6 * -(-SAMPLES // every) for every in (1, 4, 16)]
    assert all(each.fit.has_process_noise and each.correlated >= 1 for each in horizons)


# Densities


@pytest.mark.parametrize("width", [0, 3])
@pytest.mark.parametrize("expected", [False, True])
def test_the_density_of_each_part_is_that_of_a_fit_to_the_others(width: int, *, expected: bool) -> None:
    draw = np.random.default_rng(6)
    rows, fold = 90, np.repeat([0, 1, 2, 1, 0, 3], 15)
    own, columns = draw.normal(size=(rows, 2)), draw.normal(size=(rows, width))
    target = own @ [1.0, -2.0] + columns @ np.ones(width) + draw.normal(size=rows)
    known = draw.random(rows) < 0.9
    target[~known], own[~known], columns[~known] = 0.0, 0.0, 0.0
    root = draw.normal(size=(width, width))
    precision = root @ root.T + np.eye(width) if expected else None
    white = Whitened(target, own, np.zeros(rows, dtype=int), known, int(known.sum()), 0.0)
    problem = _Foreseen(white, target, own, fold)
    found = problem.log_density(problem.sums(columns), precision)
    everything = np.concatenate([own, columns], axis=1)
    for part in range(4):
        out, rest = fold == part, fold != part
        x, y = everything[rest], target[rest]
        if precision is not None:
            prior = np.concatenate([np.zeros((width, 2)), np.linalg.cholesky(precision).T], axis=1)
            x, y = np.concatenate([x, prior]), np.concatenate([y, np.zeros(width)])
        coefficients = np.linalg.lstsq(x, y, rcond=None)[0]
        learned = ((y - x @ coefficients) ** 2).sum()
        variance = learned / (known[rest].sum() - 2 - width)
        missed = ((target - everything @ coefficients)[out] ** 2).sum()
        direct = -0.5 * (missed / variance + known[out].sum() * np.log(variance))
        assert found[part] == pytest.approx(direct, rel=1e-6)


def test_the_density_does_not_depend_on_units_of_columns() -> None:
    draw = np.random.default_rng(9)
    own, columns, target = draw.normal(size=(60, 2)), draw.normal(size=(60, 2)), draw.normal(size=60)
    white = Whitened(target, own, np.zeros(60, dtype=int), np.ones(60, dtype=bool), 60, 0.0)
    fold = np.arange(60) // 15
    one, other = _Foreseen(white, target, own, fold), _Foreseen(white, target, own * [1e6, 1.0], fold)
    densities = (
        one.log_density(one.sums(columns), np.eye(2)),
        other.log_density(other.sums(columns * 1e-5), 1e-10 * np.eye(2)),
    )
    np.testing.assert_allclose(*densities, rtol=1e-8)


# Names


@pytest.mark.slow
def test_damping_is_named_beside_forces_that_last() -> None:
    model, data = pendulum(), recorded(0.15, 0.2)
    context = context_of(model, data)
    alone, rungs, *_ = climb(recalibrate(model, data)[0], context)
    (found,) = rungs
    best = found.accepted.best
    assert (best.candidate.name, best.candidate.family) == ("linear damping", "resistance to motion")
    assert found.log_odds >= context.study.search.least_log_odds
    assert len(alone) == len(found.horizons) >= 2
    c = next(each for each in best.fit.model.parameters if each.name in best.candidate.amplitudes)
    assert c.value == pytest.approx(0.15, rel=0.3)


def test_what_nothing_tells_from_a_name_is_named_with_it_and_a_gain_that_does_no_more_is_not() -> None:
    """A constant force on a spring is an offset of its sensor, to which a gain adds what an error may be."""
    model = pendulum(linear=True)
    context = context_of(model, recorded(0.0, 0.2, bias=0.8), ("constant bias", "sensor gain or offset"))
    found = first_rung(context)
    assert found is not None and found.accepted.best.candidate.name == "constant bias"
    alike = [each.candidate for each in found.accepted.others["same"]]
    assert [(each.name, len(each.new)) for each in alike] == [("sensor gain or offset", 1)]


def test_what_was_fitted_with_a_sign_that_it_cannot_have_is_no_rival(monkeypatch: pytest.MonkeyPatch) -> None:
    context = context_of(pendulum(), recorded(0.15, 0.2), ("linear damping", "sensor lag"))
    horizons, untried = (
        _horizons_of(recalibrate(context.model, context.data)[0], context)[:1],
        dict[str, NotFitted](),
    )
    (lag,) = [each for each in context.candidates if each.name == "sensor lag"]
    monkeypatch.setattr(MechanismCandidate, "admits", lambda one, *_: one.name != lag.name)
    told = _gains

    def promised(*given: object) -> tuple:
        sites, gains = told(*given)
        return sites, np.where(
            [each.candidate is not None and each.candidate.name == lag.name for each in sites], 1e6, gains
        )

    monkeypatch.setattr(forecasts, "_gains", promised)
    found = _next_rung(horizons, context.candidates, context, untried)
    assert found is not None and found.accepted.best.candidate.name == "linear damping"
    assert lag.label in untried


def test_to_take_most_surely_is_more_than_to_do_so_typically() -> None:
    """Of free runs whose blocks have very different errors, as where some come near a saddle point."""
    data, best = recorded(0.15, 0.2), damped().accepted.best
    before, spread = np.full(12, 0.05), np.exp(np.linspace(-2.5, 2.5, 12))
    for share, surely, typically in ((0.3, False, True), (0.02, True, True), (0.7, False, False)):
        after = share * before * spread
        assert _takes_most(before, after, best.fit, data) == surely
        assert _takes_most(before, after, best.fit, data, surely=False) == typically
    once = before.copy()
    once[0] *= 1e-9  # of which chance makes one
    assert not _takes_most(before, once, best.fit, data, surely=False)
    assert _takes_most(None, before, best.fit, data) and not _takes_most(before, None, best.fit, data)


def test_a_last_mechanism_that_makes_no_free_run_better_is_taken_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    context = context_of(pendulum(), recorded(0.15, 0.2), CLOSE)
    rungs = iter([damped(), damped(), None])  # the second changes nothing
    monkeypatch.setattr(forecasts, "_next_rung", lambda *_: next(rungs))
    fit, _ = recalibrate(context.model, context.data)
    _, found, _, taken_back = climb(fit, context)
    assert found == taken_back == [damped()]
    # One that makes free runs better stays, with those that it stands on.
    rungs = iter([damped(), damped(), None])
    monkeypatch.setattr(forecasts, "_takes_most", lambda *_, **__: True)
    assert climb(fit, context)[1] == [damped(), damped()]


def test_a_name_is_needed_where_free_runs_are_worse_without_it() -> None:
    context = context_of(pendulum(), recorded(0.15, 0.2), CLOSE)
    best = damped().accepted.best
    assert _needed(best.candidate, best.fit, [best.candidate], context)
    undamped = context_of(pendulum(), recorded(0.0, 0.2), CLOSE)
    names = [each.name for each in best.fit.model.parameters]
    values = best.fit.model.values.copy()
    values[names.index(best.candidate.amplitudes[0])] = 1e-6
    assert not _needed(
        best.candidate, replace(best.fit, model=best.fit.model.with_values(values)), [], undamped
    )


def test_one_that_those_after_it_make_needless_is_climbed_without(monkeypatch: pytest.MonkeyPatch) -> None:
    """As an eddy-current brake that was named for the dry friction that came second."""
    context = context_of(pendulum(), recorded(0.15, 0.2), CLOSE)
    rungs, asked = iter([damped(), damped(), None, damped(), None] * 2), list[bool]()

    def rung(_: object, candidates: list[MechanismCandidate], *__: object) -> _Rung | None:
        asked.append(damped().accepted.best.candidate.label in {each.label for each in candidates})
        return next(rungs)

    monkeypatch.setattr(forecasts, "_next_rung", rung)
    monkeypatch.setattr(forecasts, "_takes_most", lambda *_, **__: True)
    monkeypatch.setattr(forecasts, "_needed", lambda *_: False)
    fit, _ = recalibrate(context.model, context.data)
    assert climb(fit, context)[1] == [damped()]
    assert asked[0] and not asked[3]
    # Not if it foresees worse without it.
    monkeypatch.setattr(forecasts, "typically_better", lambda *_: True)
    assert climb(fit, context)[1] == [damped(), damped()]


@pytest.mark.parametrize(("truth", "values"), [("actuator lag", {"tau": 0.5}), ("input delay", {"tau": 0.5})])
def test_what_came_first_is_exchanged_for_what_foresees_better_beside_the_rest(
    truth: str, values: dict[str, float]
) -> None:
    """A delay and a lag of what drives look alike as long as damping is missing, too."""
    data = recorded_at_home(Resident(truth, "mass", values))
    card = {
        "time_unit": "s", "states": states(x="m", v="m/s"), "inputs": {"u": {"unit": "N"}},
        "parameters": numbers(k=4.0, m_=1.0), "equations": {"x": "v", "v": "(-k*x + u)/m"},
        "outputs": {"x": "x"},
    }  # fmt: skip
    context = context_of(model_of(card), data, ("actuator lag", "input delay", "linear damping"))
    alone = _horizons_of(recalibrate(context.model, data)[0], context)

    def rung(horizons: Sequence[Horizon], name: str, *same: FittedCandidate) -> _Rung:
        candidate = next(each for each in context.candidates if each.name == name)
        best = replace(damped().accepted.best, candidate=candidate)
        accepted = AcceptedMechanism(best, {"same": same, "less": ()})
        found = _on_top(horizons, replace(damped(), accepted=accepted), context)
        assert found is not None
        return found

    other = rung(alone, "actuator lag")
    first = rung(alone, "input delay", other.accepted.best)
    found = [first, rung(first.horizons, "linear damping")]
    names = [each.accepted.best.candidate.name for each in _exchanged(found, alone, context)]
    assert names == (["linear damping", truth] if truth == "actuator lag" else [truth, "linear damping"])


def test_a_state_that_a_mechanism_brings_may_be_faster_than_the_simulation() -> None:
    """Bouc and Wen's z forgets at the rate b|v|: up to 8 times a step, where the simulation needs one."""
    resident = Resident("hysteresis", "mass", {"c": 2.0, "b": 1.5, "g": 0.0})
    candidate, data = truth_of(resident), recorded_at_home(resident)
    fit, _ = recalibrate(HOMES["mass"].model, data)
    steep = 8.0 / float(np.median(data.step) * np.abs(fit.x[:, 1]).max())
    _, x = Probe(candidate, (("b_1", steep), ("g_1", 0.0))).begin(fit, data, fit.x)
    assert np.isfinite(x).all() and np.abs(x[:, 2]).max() < 2 / steep  # |z| is 1/b at most in the long run
    model = candidate.begun(fit.model, {"b_1": steep / 4, "g_1": 0.0, "c_1": 2.0})
    found = forecasts._fitted(model, data, fit, x, data.roughness, budget=Budget())
    assert found.substeps > fit.substeps


def test_two_that_are_certain_only_beside_each_other_are_both_found() -> None:
    """An oven that radiates, behind a thermocouple that lags: neither foresees much without the other."""
    draw, t, h = np.random.default_rng(4), np.arange(0, 2000, 10.0), 0.5
    tables = []
    for place in range(2):
        power, seen = np.repeat(draw.choice([0.0, 0.4, 0.8, 1.2, 1.6], 8), 25), np.empty((len(t), 2))
        state = np.array([295.0, 295.0])
        for row in range(len(t)):
            seen[row] = state
            for _ in range(20):
                warm = 2.4 * power[row] - 0.0012 * (state[0] - 295) - 2.2e-12 * (state[0] ** 4 - 295**4)
                state = state + h * np.array([warm, (state[0] - state[1]) / 35])
        shown = seen[:, 1] + 0.7 * draw.normal(size=len(t))
        tables.append(pd.DataFrame({"recording": f"r{place}", "t": t, "T": shown, "q": power}))
    card = {
        "time_unit": "s", "states": {"T": {"unit": "K"}},
        "inputs": {"q": {"unit": "kW", "interpolation": "zero_order"}},
        "parameters": numbers(a=0.003, b=2.5), "equations": {"T": "b*q - a*(T - 295)"},
    }  # fmt: skip
    model = model_of(card)
    data = measurements(Recordings.from_frame(pd.concat(tables), columns=["T", "q"]), model)
    some = ("thermal radiation", "sensor lag", "exchange with a flow", "constant bias")
    context = context_of(model, data, some)
    assert first_rung(context) is None
    _, found, *_ = climb(recalibrate(model, data)[0], context)
    names = {each.accepted.best.candidate.name for each in found}
    assert names == {"thermal radiation", "sensor lag"}
    assert all(each.log_odds > context.study.search.least_log_odds for each in found)
    fit = found[-1].accepted.best.fit
    values = {parameter.name: parameter.value for parameter in fit.model.parameters}
    assert values["tau_1"] == pytest.approx(35, rel=0.02) and values["b"] == pytest.approx(2.4, rel=0.01)
    assert fit.model.states == ("T", "z_1")


def test_of_two_causes_the_first_on_trial_may_be_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """A is on trial and b certain on top of it, c on top of b, and b on top of c: b and c are the answer."""

    def candidate(label: str) -> Any:
        return SimpleNamespace(label=label, generalises=())

    def rung(label: str) -> Any:
        best = SimpleNamespace(candidate=candidate(label), fit=fit)
        made = SimpleNamespace(accepted=SimpleNamespace(best=best), horizons=(horizon(label),))
        made.placed = lambda candidate, _: rung(candidate.label)
        return made

    def horizon(label: str) -> Any:
        return SimpleNamespace(fit=fit, alone=label)

    def next_rung(horizons: Any, _: Any, __: Any, ___: Any, on_trial: Any = None, asked: str = "") -> Any:
        below = horizons[0].alone
        calls.append((below, asked))
        if on_trial is not None:
            on_trial.append(SimpleNamespace(candidate=candidate("a"), horizons=[horizon("a")]))
        return {"a": rung("b"), "b": rung("c"), "c": rung("b")}.get(below) if len(calls) < 5 else None

    fit: Any = SimpleNamespace(model=pendulum(), noise=None)
    calls: list[tuple[str, str]] = []
    monkeypatch.setattr(forecasts, "_next_rung", next_rung)
    monkeypatch.setattr(forecasts, "_horizons_of", lambda *_: [horizon("")])
    monkeypatch.setattr(forecasts, "_below", lambda above, _: rung(above.accepted.best.candidate.label))
    monkeypatch.setattr(forecasts, "_kind_of", lambda one, _: one.label)
    monkeypatch.setattr(forecasts, "_left_out", lambda *_: None)
    monkeypatch.setattr(forecasts, "_takes_most", lambda *_, **__: True)
    monkeypatch.setattr(forecasts, "_needed", lambda *_: True)
    monkeypatch.setattr(forecasts, "_exchanged", lambda found, *_: found)
    context = replace(context_of(pendulum(), recorded(0.15, 0.2), CLOSE), candidates=())
    _, found, *_ = climb(fit, context)
    assert [each.accepted.best.candidate.label for each in found] == ["b", "c"]
    assert calls[:4] == [("", ""), ("a", ""), ("b", "a"), ("c", "b")]


def test_a_lag_and_a_hidden_capacity_each_with_a_state_are_found_one_on_the_other() -> None:
    """A room whose walls take up heat, and a sensor that follows late."""
    draw, t, h = np.random.default_rng(6), np.arange(150) / 12, 1 / 120
    tables = []
    for place in range(2):
        heat, seen = np.repeat(draw.choice([0.0, 2.0, 4.0], 15), 10), np.empty(len(t))
        room, wall, shown = 12.0, 12.0, 12.0
        for row in range(len(t)):
            seen[row] = shown
            for _ in range(10):
                change = np.array([(5 - room) / 8 + heat[row] - (room - wall), (room - wall) / 1.5])
                shown += h * (room - shown) / 0.15
                room, wall = np.array([room, wall]) + h * change
        shown_with_noise = seen + 0.01 * draw.normal(size=len(t))
        tables.append(pd.DataFrame({"recording": f"r{place}", "t": t, "T": shown_with_noise, "q": heat}))
    card = {
        "time_unit": "h", "states": {"T": {"unit": "degC"}},
        "inputs": {"q": {"unit": "kW", "interpolation": "zero_order"}},
        "parameters": numbers(tau=10.0, C=2.0), "equations": {"T": "(5 - T)/tau + q/C"},
    }  # fmt: skip
    model = model_of(card)
    data = measurements(Recordings.from_frame(pd.concat(tables), columns=["T", "q"]), model)
    some = ("hidden capacity", "sensor lag", "input delay", "constant bias")
    _, found, *_ = climb(recalibrate(model, data)[0], context_of(model, data, some))
    assert {each.accepted.best.candidate.name for each in found} == {"hidden capacity", "sensor lag"}
    values = {each.name: each.value for each in found[-1].accepted.best.fit.model.parameters}
    lags = sorted(value for name, value in values.items() if name.startswith("tau_"))
    assert lags == pytest.approx([0.15, 1.5], rel=0.05)
    assert values["C"] == pytest.approx(1.0, rel=0.02) and values["tau"] == pytest.approx(8.0, rel=0.1)


def test_a_general_form_whose_amplitude_is_zero_within_errors_is_its_special_case() -> None:
    best = damped().accepted.best
    fit, (amplitude,) = best.fit, best.candidate.amplitudes
    assert not best.candidate.idle(fit)
    names = [each.name for each in fit.model.parameters]
    small = fit.model.values.copy()
    small[names.index(amplitude)] = fit.standard_errors[
        [names[place] for place in fit.model.free].index(amplitude)
    ]
    assert best.candidate.idle(replace(fit, model=fit.model.with_values(small)))


def test_odds_with_a_flat_prior_are_those_of_mechanisms_that_are_alike() -> None:
    context = context_of(pendulum(), recorded(0.15, 0.2), CLOSE)
    alike = tuple(replace(each, weight=1.0) for each in context.candidates)
    options = context.study.search.model_copy(update={"unnamed": 0.5})
    study = context.study.model_copy(update={"search": options})
    flat = first_rung(replace(context, candidates=alike, study=study))
    assert flat is not None
    assert flat.log_odds == pytest.approx(flat.flat_log_odds)
    assert damped().flat_log_odds == pytest.approx(flat.log_odds, abs=0.05)
    assert damped().log_odds > damped().flat_log_odds  # nearly everything that moves is damped


def test_what_cannot_be_told_promises_nothing_and_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def density(problem: Any, term: Probe | Place, columns: np.ndarray) -> float:
        if isinstance(term, Place):
            raise np.linalg.LinAlgError("Singular matrix")
        return told(problem, term, columns)

    told = forecasts._density
    monkeypatch.setattr(forecasts, "_density", density)
    found = first_rung(context_of(pendulum(), recorded(0.15, 0.2), CLOSE))
    assert found is not None and found.accepted.best.candidate.name == "linear damping"


def test_forces_that_last_have_no_name_in_the_dictionary() -> None:
    model, data = pendulum(), recorded(0.0, 0.2)
    alone, rungs, *_ = climb(recalibrate(model, data)[0], context_of(model, data))
    assert len(alone) == 3 and rungs == []


def test_the_order_of_recordings_says_nothing() -> None:
    data, model = recorded(0.15, 0.2), pendulum()
    turned = laid_out(data.outputs.reshape(-1, SAMPLES)[::-1], model)
    same_as_before(first_rung(context_of(model, turned, CLOSE)))


def test_units_of_the_state_say_nothing() -> None:
    scale = 57.3
    same_as_before(first_rung(context_of(pendulum(scale), recorded(0.15, 0.2, scale=scale), CLOSE)))


def same_as_before(found: _Rung | None) -> None:
    assert found is not None
    assert found.accepted.best.candidate.label == damped().accepted.best.candidate.label
    assert found.log_odds == pytest.approx(damped().log_odds, rel=1e-3)


def kicked_decays(count: int = 4, samples: int = 60) -> Measurements:
    """Decays as their card has them, kicked at random about as far as they go."""
    draw = np.random.default_rng(4)
    step = DURATION / (samples - 1)
    (rate,) = DECAY.values
    left = np.exp(-rate * step)
    x = draw.normal(size=(count, samples))
    for before, now in itertools.pairwise(x.T):
        now[:] = left * before + np.sqrt(1 - left**2) * now
    return laid_out(x + 0.01 * draw.normal(size=x.shape), DECAY)


def test_a_sensor_gains_nothing_from_what_a_filter_learned_from_it(monkeypatch: pytest.MonkeyPatch) -> None:
    # Another unit of x, so that it is none of the candidates.
    monkeypatch.setattr(mechanisms, "_beyond_parameters", lambda _, candidates: candidates)
    data = kicked_decays()
    context = context_of(DECAY, data, ("sensor gain or offset",))
    horizons = _horizons_of(recalibrate(DECAY, data)[0], context)
    x = horizons[0].fit.x
    # Each form that has a gain; a constant offset was never mistaken for innovations.
    faults = [each for each in context.candidates if any(name.startswith("g") for name in each.amplitudes)]
    terms = [term for each in faults for term in Probe.all_of(each, data, DECAY, x)]
    assert len(terms) == 2 and len(horizons) == 2
    assert all((_gained(each, terms, None, Budget()) < 0).all() for each in horizons)

    def at_filtered(
        fit: Fit, data: Measurements, some: Sequence[Term], **_: object
    ) -> tuple[Linearisation, list[slice]]:
        # Where a fit has no process noise nothing is foreseen other than what is known.
        return linearised_with(replace(fit, noise=fit.noise.without_process()), data, some)

    # At the states that the filter knows a gain explains the kicks, and this test would fail.
    monkeypatch.setattr(forecasts, "linearised_with", at_filtered)
    assert all((_gained(each, terms, None, Budget()) > 9).all() for each in horizons)
    assert (_gained(horizons[0], terms, None, Budget()) > 500).all()


def test_the_gain_of_a_sensor_is_another_unit_of_the_state(monkeypatch: pytest.MonkeyPatch) -> None:
    """To first order in the gain g, x/(1 + g) decays as x does: nothing that is foreseen may change by it."""
    monkeypatch.setattr(mechanisms, "_beyond_parameters", lambda _, candidates: candidates)
    data = kicked_decays()
    fit = recalibrate(DECAY, data)[0]
    gain = context_of(DECAY, data, ("sensor gain or offset",)).candidates[1]
    assert gain.amplitudes == ("g_1",)
    response, groups = linearised_with(fit, data, [Probe(gain, ())])
    white = whiten(response, data, fit.noise)
    effect = white.columns[:, len(DECAY.values) :][:, groups[0]]
    assert np.sqrt(np.mean(effect**2)) < 0.1  # 0.78 without the change of the filter's gain


def refitted(start: float, *, force: float, seed: int) -> bool:
    """Whether a pendulum's frequency is refitted, where it begins at a value and 9 is right."""
    data = recorded(0.0, force, seed=seed, count=4)
    model = pendulum().with_values(np.array([start]))
    loose, strict = recalibrate(model, data)
    card = replace(loose, model=model)
    refits = [(strict, data), (loose, data)]
    return preferred_recalibration(card, refits, data, noise=loose.noise) is not card


@pytest.mark.slow
def test_values_of_the_card_stay_where_a_refit_follows_nothing_but_forces_at_random() -> None:
    kept = [not refitted(9.0, force=0.3, seed=seed) for seed in range(12)]
    assert sum(kept) >= 10  # each is another with a probability of 5 % at the most, so three with 2 %


def test_values_of_the_card_are_refitted_where_they_are_wrong() -> None:
    assert all(refitted(8.0, force=0.3, seed=seed) for seed in range(4))


def test_sensors_begin_with_what_their_recordings_show(monkeypatch: pytest.MonkeyPatch) -> None:
    """A simulation that lacks much takes the noise of its sensors for forces; what comes after must not."""
    data = recorded(0.15, 0.0, count=3)
    context = context_of(pendulum(), data, CLOSE[:1])
    fit, _ = recalibrate(context.model, data)
    blind = replace(fit, noise=replace(fit.noise, measurement=1e-9 * data.roughness))
    begun = []

    def settled(*_: object, noise: Noise, **__: object) -> Fit:
        begun.append(noise.measurement)
        return replace(blind, converged=len(begun) > 1)

    monkeypatch.setattr(forecasts, "fit_by_multiple_shooting", settled)
    forecasts._fitted(pendulum(), data, blind, blind.x, data.roughness, budget=Budget())
    # From where the fit before ended only where that leads nowhere.
    np.testing.assert_allclose(begun, [data.roughness, blind.noise.measurement])


def test_another_shape_is_begun_with_where_the_best_one_leads_nowhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    context = context_of(pendulum(), recorded(0.15, 0.2), ("Stribeck friction",))
    fit, _ = recalibrate(context.model, context.data)
    horizons, begun = _horizons_of(fit, context)[:1], []

    def fitted(horizons: list[Horizon], site: _Site, budget: Budget, untried: dict) -> tuple | None:
        assert site.candidate is not None
        begun.append(site.terms)
        if len(begun) == 1:
            untried[site.label] = NotFitted.of(site.candidate, NumericalFailure(forecasts.UNSETTLED))
            return None
        untried.pop(site.label, None)
        return list(horizons), 0.0

    monkeypatch.setattr(forecasts, "_fitted_at", fitted)
    monkeypatch.setattr(forecasts, "_gains", lambda horizons, sites, *_: (sites, np.ones(len(sites))))
    _next_rung(horizons, context.candidates, context, {})
    assert len(begun) == 2 and begun[0] != begun[1] and len(begun[0]) == 1


@pytest.mark.parametrize(
    ("unsettled", "gain", "horizons"), [(None, 1.0, 2), (1, 1.0, 2), (0, 1.0, 2), (0, -1.0, 1), (1, -1.0, 2)]
)
def test_a_fit_has_to_settle_one_sample_ahead(
    unsettled: int | None, gain: float, horizons: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Farther ahead few samples tell of the parameters, and what was reached counts."""
    context = context_of(pendulum(), recorded(0.15, 0.2), ("linear damping",))
    fit, _ = recalibrate(context.model, context.data)
    untried: dict[str, NotFitted] = {}
    (site,) = (one for one in _sites(context.candidates, fit, context, untried) if one.candidate is not None)
    before, fits, places = _horizons_of(fit, context)[:2], forecasts._fitted, itertools.count()
    monkeypatch.setattr(
        forecasts, "_fitted",
        lambda *given, **known: replace(fits(*given, **known), converged=next(places) != unsettled),
    )  # fmt: skip
    monkeypatch.setattr(forecasts, "_gain_over", lambda *_: gain)
    found = forecasts._fitted_at(before, site, context.budget, untried)
    assert found is not None and len(found[0]) == horizons
    assert (site.label in untried) == (unsettled == 0)


def test_what_follows_any_motion_is_no_rival_where_something_simple_does_as_much(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As an oscillator that is attached to the recorded pendulum arm, whose limit is linear damping.

    Nor where free runs are hardly better with it: a slow state stands in for forces that last.
    """
    context = context_of(pendulum(), recorded(0.15, 0.2), ("linear damping", "attached oscillator"))
    fit, _ = recalibrate(context.model, context.data)
    horizons, gains = _horizons_of(fit, context)[:1], {"linear damping": 100.0, "attached oscillator": 103.0}

    def fitted(horizons: list[Horizon], site: _Site, *_: object) -> tuple[list[Horizon], float]:
        assert site.candidate is not None
        return list(horizons), gains[site.candidate.name]

    def promised(_: object, sites: Sequence[_Site], leading: object, *__: object) -> tuple:
        if leading is not None:  # in its place
            return list(sites), np.full(len(sites), -50.0)
        return list(sites), np.array([on_top if each.candidate is None else 0.1 for each in sites])

    monkeypatch.setattr(forecasts, "_fitted_at", fitted)
    monkeypatch.setattr(forecasts, "_gains", promised)
    monkeypatch.setattr(forecasts, "_containing", lambda *_: (set(), set()))
    monkeypatch.setattr(forecasts.FittedCandidate, "of", lambda *given, **_: given[3])
    monkeypatch.setattr(forecasts, "_left_out", lambda *_: None)
    for on_top, takes_most in ((50.0, True), (0.0, True), (0.0, False)):
        monkeypatch.setattr(forecasts, "_takes_most", lambda *_, most=takes_most, **__: most)
        rung = _next_rung(horizons, context.candidates, context, {})
        assert (rung is not None) == (on_top > 0 or not takes_most)


@pytest.mark.parametrize("more", [1.0, -1.0])
def test_what_is_likelier_and_hardly_better_explains_the_recordings_as_well(
    more: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a protein that represses its gene, where being washed out by the input does nearly as much."""
    context = context_of(pendulum(), recorded(0.15, 0.2), ("linear damping", "sensor gain or offset"))
    fit, _ = recalibrate(context.model, context.data)
    horizons = _horizons_of(fit, context)[:1]
    weights = {"linear damping": 100.0, "sensor gain or offset": 100.0 + more}

    def fitted(horizons: list[Horizon], site: _Site, *_: object) -> tuple[list[Horizon], float]:
        assert site.candidate is not None
        several = site.candidate.name != "sensor gain or offset" or len(site.candidate.new) > 1
        return list(horizons), (weights[site.candidate.name] if several else -50.0) - site.prior

    def promised(_: object, sites: Sequence[_Site], leading: object, *__: object) -> tuple:
        return list(sites), np.full(len(sites), 1.0 if leading is None else -50.0)

    monkeypatch.setattr(forecasts, "_fitted_at", fitted)
    monkeypatch.setattr(forecasts, "_gains", promised)
    monkeypatch.setattr(forecasts, "_containing", lambda *_: (set(), set()))
    monkeypatch.setattr(forecasts.FittedCandidate, "of", lambda *given, **_: given[3])
    monkeypatch.setattr(forecasts, "_left_out", lambda *_: None)
    monkeypatch.setattr(forecasts, "_takes_most", lambda *_, **__: False)
    rung = _next_rung(horizons, context.candidates, context, {})
    assert rung is not None and rung.accepted.best.name == "linear damping"
    assert [each.name for each in rung.accepted.others["same"]] == ["sensor gain or offset"] * (more > 0)


def test_a_mechanism_on_top_of_another_has_parameters_of_its_own() -> None:
    """Of one name they ended the diagnosis, where the one replaces what the other has changed."""
    model = HOMES["inducible gene"].model
    elimination, repression = (
        next(each for each in candidates(model) if each.name == name and text in each.label)
        for name, text in (("saturated elimination", ""), ("inhibition", "by s itself"))
    )
    probes = [Probe(each, tuple((name, 2.0) for name in each.shapes)) for each in (elimination, repression)]
    leaders = [_Leader(_Site((each,), 0.0, 0.0, ("", ()), each.candidate), [], 0.0) for each in probes]
    site = leaders[1].on_top(model, leaders[0])
    assert site.candidate is not None and isinstance(probe := site.terms[0], Probe)
    assert site.candidate.new == ("w_2", "n_1") and dict(probe.shapes) == {"w_2": 2.0, "n_1": 2.0}
    both, first = site.candidate.model.equations[0], elimination.model.equations[0]
    alone = repression.model.equations[0] - model.equations[0]
    renamed = alone.subs(site.candidate.model.names["w_1"], site.candidate.model.names["w_2"])
    assert (both - first - renamed).simplify() == 0


@pytest.mark.parametrize(("settles", "named"), [(False, True), (True, False)])
def test_a_fit_that_does_not_settle_counts_for_no_more_than_it_promised(
    settles: bool, named: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the gain of a sensor that ran away to 20 000, of a pendulum that hardly moves then."""
    context = context_of(pendulum(), recorded(0.15, 0.2), ("linear damping", "sensor gain or offset"))
    fit, _ = recalibrate(context.model, context.data)

    def fitted(horizons: list[Horizon], site: _Site, _: Budget, untried: dict) -> tuple[list[Horizon], float]:
        assert site.candidate is not None
        damping = site.candidate.name == "linear damping"
        if not (damping or settles):
            untried[site.label] = NotFitted.of(site.candidate, NumericalFailure(forecasts.UNSETTLED))
        return list(horizons), 100.0 if damping else 700.0

    def promised(_: object, sites: Sequence[_Site], leading: object, *__: object) -> tuple:
        one = 10.0 if leading is None else -50.0  # in its place
        return list(sites), np.array([one - 10 * (each.candidate is None) for each in sites])

    monkeypatch.setattr(forecasts, "_fitted_at", fitted)
    monkeypatch.setattr(forecasts, "_gains", promised)
    monkeypatch.setattr(forecasts, "_containing", lambda *_: (set(), set()))
    monkeypatch.setattr(forecasts.FittedCandidate, "of", lambda *given, **_: given[3])
    rung = _next_rung(_horizons_of(fit, context)[:1], context.candidates, context, {})
    best = "" if rung is None else rung.accepted.best.name
    assert (best == "linear damping") == named


@pytest.mark.parametrize(("more", "named"), [(3.0, True), (60.0, False)])
def test_the_general_form_outdoes_a_member_only_if_it_is_likelier(
    more: float, named: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As dry friction that gains 20 nats where an error of the model gives any function of the speed 23."""
    context = context_of(pendulum(), recorded(0.15, 0.2), CLOSE)
    fit, _ = recalibrate(context.model, context.data)
    damping = damped().accepted.best.candidate.label

    def fitted(horizons: list[Horizon], site: _Site, *_: object) -> tuple[list[Horizon], float] | None:
        return (list(horizons), 20.0) if site.label == damping else None

    def promised(_: object, sites: Sequence[_Site], leading: object, *__: object) -> tuple:
        if leading is None:
            return list(sites), np.array([float(each.label == damping) for each in sites])
        general = np.array([each.candidate is None and each.family[0] != "" for each in sites])
        assert general.any()
        return list(sites), np.where(general, more, -50.0)

    monkeypatch.setattr(forecasts, "_fitted_at", fitted)
    monkeypatch.setattr(forecasts, "_gains", promised)
    monkeypatch.setattr(forecasts, "_containing", lambda *_: (set(), set()))
    monkeypatch.setattr(forecasts.FittedCandidate, "of", lambda *given, **_: given[3])
    rung = _next_rung(_horizons_of(fit, context)[:1], context.candidates, context, {})
    assert (rung is not None) == named
