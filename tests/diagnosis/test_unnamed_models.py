"""Models of what has no name: memories are found as such, and nothing added makes a fit less likely."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import sympy

from siq.data.recordings import Recordings
from siq.diagnosis import unnamed_models
from siq.diagnosis.dictionary import roles_of
from siq.diagnosis.search import FitContext, Search
from siq.diagnosis.terms import Place, _with_formula
from siq.diagnosis.unnamed_models import (
    _fitted_term,
    _memories_of,
    _memory_suspected,
    _weighed,
    _with_memories,
    fit_unnamed_models,
)
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements, measurements
from siq.inference.recalibration import recalibrate
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter, symbol
from tests.diagnosis.decays import DECAY, X

pytestmark = pytest.mark.portable

COUNT = 80
FLOW = np.array([[-1.0, 0.8], [0.5, -0.5]])  # of x and of what is remembered


@pytest.fixture(scope="module")
def fading() -> Measurements:
    """Decays that are held back by what x was: ``x' = -x + 0.8 z`` and ``z' = (x - z)/2``."""
    t = np.linspace(0, 6, COUNT)
    draw = np.random.default_rng(3)
    begins = draw.normal(size=(6, 2))
    x = [[(scipy.linalg.expm(FLOW * each) @ begin)[0] for each in t] for begin in begins]
    labels = tuple("abcdef")
    table = Recordings(
        ("x",), (None,), labels, np.repeat(np.arange(6), COUNT), np.tile(t, 6),
        (np.concatenate(x) + 0.003 * draw.normal(size=6 * COUNT))[:, None],
    )  # fmt: skip
    return measurements(table, DECAY)


@pytest.fixture(scope="module")
def alone(fading: Measurements) -> Fit:
    return recalibrate(DECAY, fading)[0]


def context(data: Measurements) -> FitContext:
    return FitContext(DECAY, data, roles_of(DECAY))


def test_what_x_was_is_likelier_than_any_function(fading: Measurements, alone: Fit) -> None:
    models = fit_unnamed_models(Search(alone, (), alone, ()), context(fading))
    (part,) = models[0].parts
    assert part.candidate.name == "a memory of x"
    found = {each.name: each.value for each in models[0].fit.model.parameters}
    # A decay with a memory is a sum of two; of k, c and τ their rates tell two combinations.
    k, c, tau = found["k"], found["c_1"], found["tau_1"]
    rates = np.sort(np.linalg.eigvals(np.array([[-k, c], [1 / tau, -1 / tau]])))
    np.testing.assert_allclose(rates, np.sort(np.linalg.eigvals(FLOW)), rtol=0.05)
    assert not models[0].fit.has_process_noise


def test_a_memory_whose_fit_leads_away_begins_again(
    fading: Measurements, alone: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    still = replace(alone, noise=alone.noise.without_process(), log_likelihood=0.0)
    usual = unnamed_models.fit_with_process_noise_as_needed

    def leading_away(*given: Any, **options: Any) -> Fit:
        return replace(usual(*given, **options), log_likelihood=-1e3)

    monkeypatch.setattr(unnamed_models, "fit_with_process_noise_as_needed", leading_away)
    found = _with_memories(still, [], context(fading))
    kept = {each.parts[0].candidate.label: each.fit.log_likelihood for each in found}
    assert kept["a memory of x in x"] > 2000 and kept["a memory of x in x, as a rate"] > -1e3
    # Nothing rings here: how much it is damped no recording tells, and such a fit may lead away once more.
    assert min(kept.values()) >= -1e3


def test_a_hidden_state_pays_for_its_beginnings(fading: Measurements, alone: Fit) -> None:
    (model,) = _weighed(_with_memories(alone, [], context(fading))[:1], alone, fading)
    gained = model.fit.log_likelihood - alone.log_likelihood
    assert model.log_evidence < gained - 0.5 * 6 * np.log(COUNT / 10)


def test_every_coordinate_and_equation_has_its_memories() -> None:
    labels = [each.label for each in _memories_of(DECAY, roles_of(DECAY))]
    assert labels == ["a memory of x in x", "a memory of x in x, as a rate", "a memory of x in x, that rings"]


def test_the_intensity_of_a_rotating_frame_has_its_own_unit() -> None:
    p, q = symbol("P"), symbol("Q")
    frame = Dynamics(
        ("P", "Q"),
        (-symbol("k") * p + q, -symbol("k") * q - p),
        Diffusion.identity(2),
        parameters=(Parameter("k", 0.3),),
        outputs=(("P", p), ("Q", q)),
        units=("mV", "mV"),
        time_unit="s",
    )
    found = _memories_of(frame, roles_of(frame))
    (shift, _) = (each for each in found if each.coordinate == "amplitude")
    assert shift.label == "a memory of amplitude in P, Q, across the state"
    assert shift.model.units == ("mV", "mV", "mV**2")
    assert shift.model.parameters[1].unit == "1/(mV**2*s)"


@pytest.mark.parametrize(("words", "suspected"), [(("t",), True), (("x", "t"), True), (("x",), False)])
def test_the_time_is_suspected_of_standing_in_for_what_was(
    words: tuple[str, ...], *, suspected: bool, fading: Measurements, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("siq.diagnosis.unnamed_models.has_structure", lambda *_: False)
    place = Place((("x", sympy.Integer(1)),), (), (X,), words)
    model = SimpleNamespace(parts=(SimpleNamespace(candidate=SimpleNamespace(place=place)),), fit=None)
    assert _memory_suspected([model], fading) is suspected
    assert _memory_suspected([], fading)


def bent_decays() -> Measurements:
    """Decays of a rate 1 + 0.3 x."""
    t = np.linspace(0, 2, 60)
    begins = np.array([0.5, 1.0, 2.0])
    x = [begin * np.exp(-t) / (1 + 0.3 * begin * (1 - np.exp(-t))) for begin in begins]
    draw = np.random.default_rng(8)
    table = Recordings(
        ("x",), (None,), ("a", "b", "c"), np.repeat(np.arange(3), 60), np.tile(t, 3),
        (np.concatenate(x) + 0.01 * draw.normal(size=180))[:, None],
    )  # fmt: skip
    return measurements(table, DECAY)


def test_a_function_whose_fit_leads_away_begins_again(monkeypatch: pytest.MonkeyPatch) -> None:
    data = bent_decays()
    _, alone = recalibrate(DECAY, data)
    assert not alone.has_process_noise
    place = Place((("x", sympy.Integer(1)),), (), (X,), ("x",))
    candidate = _with_formula(alone.model, place, [(X**2, 2, 0)])
    context = FitContext(DECAY, data, SimpleNamespace())

    def fitted() -> Fit:
        (part,) = _fitted_term(candidate, 1.0, alone, context)
        return part.fit

    right = fitted()
    away = replace(right, log_likelihood=alone.log_likelihood - 50, model=right.model.with_values(np.ones(2)))
    monkeypatch.setattr(unnamed_models, "fit_with_process_noise_as_needed", lambda *_, **__: away)
    again = fitted()
    assert again.log_likelihood == pytest.approx(right.log_likelihood, abs=0.5)
    np.testing.assert_allclose(again.model.values, right.model.values, atol=0.02)
