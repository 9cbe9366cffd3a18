"""What is left beside a name: correlated errors, and parts that are left out."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from siq.data.correlation import correlation_time_of
from siq.data.recordings import Recordings
from siq.diagnosis import naming
from siq.diagnosis.holdout import errors_left_out, predicts_better
from siq.diagnosis.mechanisms import MECHANISM
from siq.diagnosis.naming import Investigation, _MissingEffect, _one_cause_or_two, _with_models
from siq.diagnosis.study import MismatchStudy, MismatchVerdict
from siq.diagnosis.unnamed_models import _runs_freely
from siq.inference.budget import Budget
from siq.inference.kalman_filter import Whitened
from siq.inference.measurements import Measurements, cross_validation_folds, measurements
from siq.inference.recalibration import recalibrate
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter, symbol

DECAY = Dynamics(
    ("x",),
    (-symbol("k") * symbol("x"),),
    Diffusion.identity(1),
    parameters=(Parameter("k", 1.2),),
    outputs=(("x", symbol("x")),),
)


def autoregressive(memory: float, shape: tuple[int, ...]) -> np.ndarray:
    kicks = np.random.default_rng(7).normal(size=shape)
    for before, now in itertools.pairwise(kicks):
        now += memory * before
    return kicks


@pytest.mark.parametrize("memory", [0.0, 0.5, 0.9])
def test_the_correlation_time_is_that_of_all_recordings_and_outputs(memory: float) -> None:
    series = autoregressive(memory, (200, 100, 2))  # samples, recordings, outputs
    recording = np.repeat(np.arange(100), 400)
    found = correlation_time_of(np.swapaxes(series, 0, 1).ravel(), recording, outputs=2)
    # Up to where autocorrelations are those of noise: a little less than the whole sum.
    assert found == pytest.approx((1 + memory) / (1 - memory), rel=0.1)


@pytest.mark.parametrize("seed", range(4))
def test_white_errors_of_many_short_recordings_count_in_full(seed: int) -> None:
    left = np.random.default_rng(seed).normal(size=40 * 30)
    assert correlation_time_of(left, np.repeat(np.arange(30), 40), outputs=1) < 1.2


def test_evidence_counts_errors_that_hang_together_as_one() -> None:
    """Each error ten times over tells no more than once."""
    draw = np.random.default_rng(3)
    course = draw.uniform(-1, 1, size=300)
    columns = np.stack([course, course**3], axis=1)
    target = draw.normal(size=300) + columns @ [0.0, 3.0]

    def evidence(times: int) -> float:
        rows = np.repeat(np.arange(300), times)
        white = Whitened(
            target[rows], columns[rows], np.zeros(len(rows), dtype=int), np.ones(len(rows), dtype=bool),
            len(rows), 0.0,
        )  # fmt: skip
        parameters = (Parameter("k", 0.0), Parameter("c", 0.0))
        values = np.zeros(2)
        fit = SimpleNamespace(
            model=SimpleNamespace(free=(0, 1), parameters=parameters, values=values, outputs=("x",))
        )
        cubic = SimpleNamespace(amplitudes=("c",), shapes=())
        return _MissingEffect(white, fit, [cubic]).log_evidence_of_mechanisms()

    alone, repeated = evidence(1), evidence(10)
    assert alone > 2
    assert repeated == pytest.approx(alone, rel=0.25)


def decays(count: int, samples: int, *, rate: float = 1.0) -> Measurements:
    draw = np.random.default_rng(5)
    t = np.linspace(0, 2, samples)
    x = np.concatenate([np.exp(-rate * t) * start for start in np.geomspace(0.5, 2.0, count)])
    table = Recordings(
        ("x",), (None,), tuple(f"r{place}" for place in range(count)), np.repeat(np.arange(count), samples),
        np.tile(t, count), (x + 0.01 * draw.normal(size=len(x)))[:, None],
    )  # fmt: skip
    return measurements(table, DECAY)


@pytest.mark.parametrize(("count", "samples", "parts"), [(1, 203, 4), (2, 20, 2), (7, 20, 4)])
def test_every_row_is_left_out_once_and_never_fitted_then(count: int, samples: int, parts: int) -> None:
    data = decays(count, samples)
    seen = []
    every = list(cross_validation_folds(data))
    for out, rest, rows in every:
        np.testing.assert_array_equal(rest.outputs, data.outputs[rows])
        assert len(out.t) + len(rest.t) == len(data.t)
        others = np.setdiff1d(np.arange(len(data.t)), rows)
        np.testing.assert_array_equal(out.outputs, data.outputs[others])
        assert out.first[-1] == len(out.t) and rest.first[-1] == len(rest.t)
        # A stretch of time that was cut out is no gap that the rest runs across.
        steps = [np.diff(rest.t[a:b]) for a, b in itertools.pairwise(rest.first)]
        assert np.concatenate(steps).max() < 1.5 * (data.t[1] - data.t[0])
        seen.append(others)
    assert len(every) == parts
    np.testing.assert_array_equal(np.sort(np.concatenate(seen)), np.arange(len(data.t)))


def test_what_is_left_out_is_foreseen_up_to_noise_and_parameters_are_fitted_to_the_rest() -> None:
    data = decays(4, 60)
    fit, _ = recalibrate(DECAY, data)
    squares = errors_left_out(fit, data, noise=fit.noise)
    assert squares is not None and len(squares) > 150
    right = np.sqrt(squares.mean())
    # A fifth of each tells where it begins.
    spread = np.concatenate([data.outputs[a + 12 : b] for a, b in itertools.pairwise(data.first)]).std()
    assert right == pytest.approx(0.01 / spread, rel=0.3)
    # From wrong parameters it ends the same, since they are fitted again, but where they may not be.
    off = replace(fit, model=fit.model.with_values(np.array([1.3])))
    again = errors_left_out(off, data, noise=fit.noise)
    assert again is not None and np.sqrt(again.mean()) == pytest.approx(right, rel=1e-3)
    fixed = replace(off.model, parameters=(replace(off.model.parameters[0], fixed=True),))
    wrong = errors_left_out(replace(off, model=fixed), data, noise=fit.noise)
    assert wrong is not None and np.sqrt(wrong.mean()) > 2 * right


def test_a_sign_that_cannot_be_is_nothing_where_the_rest_alone_would_have_it() -> None:
    x = symbol("x")
    faster = replace(
        DECAY,
        equations=(DECAY.equations[0] - symbol("c") * x**2,),
        parameters=(*DECAY.parameters, Parameter("c", 0.1)),
    )
    fixed = replace(faster, parameters=(DECAY.parameters[0], Parameter("c", 0.0, fixed=True)))
    data = decays(4, 60)
    loses = SimpleNamespace(positive=frozenset({"c"}), amplitudes=("c",))
    # A sensor that grows by its square bends a decay as a loss does, and one that falls short as a gain does.
    for bend, bound in ((-0.1, True), (0.1, False)):
        bent = replace(data, outputs=data.outputs + bend * data.outputs**2)
        fit, _ = recalibrate(faster, bent)
        free = errors_left_out(fit, bent, noise=fit.noise)
        signed = errors_left_out(fit, bent, noise=fit.noise, candidates=[loses])
        without = errors_left_out(replace(fit, model=fixed), bent, noise=fit.noise)
        assert free is not None and signed is not None and without is not None
        np.testing.assert_allclose(signed, without if bound else free, rtol=1e-3, atol=1e-9)
        assert abs(free.mean() - without.mean()) > 0.01 * free.mean()


def test_a_model_that_runs_away_from_where_it_is_held_is_none() -> None:
    data = decays(2, 40)
    fit, _ = recalibrate(DECAY, data)
    steeper = replace(fit, model=fit.model.with_values(np.array([-40.0])))
    assert _runs_freely(fit, replace(fit, model=fit.model.with_values(np.array([1.3]))), data)
    assert not _runs_freely(steeper, fit, data)


def squares(draw: np.random.Generator, size: float) -> np.ndarray:
    return size * draw.chisquare(1, 400)


@pytest.mark.parametrize(
    ("without", "model", "certain", "adopted"),
    [
        (1.0, 0.5, False, True),
        (1.0, 0.95, False, False),  # no better than by chance
        (1.0, 0.95, True, True),  # what is certain where it was found has to be better, by however little
        (1.0, 1.2, True, False),
        (1.0, None, True, False),  # one that runs away is none
        (None, 3.0, False, True),  # without, it runs away
    ],
)
def test_a_model_is_adopted_that_foresees_better(
    without: float | None, model: float | None, certain: bool, adopted: bool
) -> None:
    draw = np.random.default_rng(1)
    before, after = (None if size is None else squares(draw, size) for size in (without, model))
    assert predicts_better(before, after, limit=before.mean() if certain else 0.0) is adopted


@pytest.mark.parametrize(
    ("ahead", "forced", "named"),
    [(20.0, False, True), (5.0, False, False), (-9.0, False, False), (-9.0, True, True)],
)
def test_a_name_that_leaves_something_has_to_be_likelier_than_one_cause_without_a_name(
    ahead: float, forced: bool, named: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten mechanisms and a cost of 2 take log(10) + 2, and odds of 19 to 1 another 2.9; 0.1 have no name."""

    def model(kind: str, forced: bool, cost: float) -> SimpleNamespace:
        part = SimpleNamespace(candidate=SimpleNamespace(kind=kind))
        return SimpleNamespace(parts=(part,), fit=SimpleNamespace(has_process_noise=forced), cost=cost)

    alone = [model(MECHANISM, False, 0.0), model("curve", forced, 0.0)]
    monkeypatch.setattr(naming, "fit_unnamed_models", lambda *_, **__: tuple(alone))
    monkeypatch.setattr(naming, "has_structure", lambda fit, _: fit.has_process_noise)
    monkeypatch.setattr(naming, "log_evidences", lambda *_: [ahead, 0.0])
    found = SimpleNamespace(best=SimpleNamespace(candidate=SimpleNamespace(name="dry friction")))
    context = SimpleNamespace(data=None, study=MismatchStudy(), candidates=range(10))
    decision = Investigation(
        context, SimpleNamespace(found=(found,)), None, MismatchVerdict.MISSING_PHYSICS, None,
        models=(model("curve", False, 2.0),),
    )  # fmt: skip
    after = _one_cause_or_two(decision, context)
    assert (after is decision) == named and after.verdict.names == named
    if not named:
        assert [each.code for each in after.remarks] == ["diagnosis.not_certain"] and after.too_faint
        assert after.models == tuple(alone)


@pytest.mark.parametrize("by_forecasts", [True, False])
def test_a_name_that_forecasts_found_is_not_held_against_functions_again(
    by_forecasts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = SimpleNamespace(has_process_noise=True)
    decision = Investigation(
        None, SimpleNamespace(found=(None,), fit=fit), SimpleNamespace(doubtful=False),
        MismatchVerdict.MISSING_PHYSICS, None,
        finals=(SimpleNamespace(),) if by_forecasts else (),
    )  # fmt: skip
    withdrawn = replace(decision, verdict=MismatchVerdict.UNEXPLAINED)
    rest = (SimpleNamespace(fit=SimpleNamespace(has_process_noise=False)),)
    monkeypatch.setattr(naming, "fit_models_of_remainder", lambda *_: rest)
    monkeypatch.setattr(naming, "_one_cause_or_two", lambda *_: withdrawn)
    monkeypatch.setattr(naming, "exact_fit", lambda *_: None)
    context = SimpleNamespace(budget=Budget(), data=None)
    after = _with_models(decision, decision.search, context)
    assert after.verdict.names == by_forecasts
    assert (after.models == rest) == by_forecasts
