"""Parts of a description: what is added to a simulation is never less likely than nothing added."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import sympy

from siq.data.recordings import Recordings
from siq.diagnosis import unnamed_models
from siq.diagnosis.terms import Place, _Power, with_formula
from siq.diagnosis.unnamed_models import FitContext, _fitted_term
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements, measurements
from siq.inference.recalibration import recalibrate
from tests.diagnosis.decays import DECAY, X


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
    place = Place((("x", sympy.Integer(1)),), (), X, ("x",), np.empty(0))
    candidate = with_formula(alone.model, place, [_Power(X**2, 2)])
    context = FitContext(data, SimpleNamespace(), 3, 10, 5)

    def fitted() -> Fit:
        (part,) = _fitted_term(candidate, 1.0, place, alone, 0.0, context)
        return part.trial.fit

    right = fitted()
    away = replace(right, log_likelihood=alone.log_likelihood - 50, model=right.model.with_values(np.ones(2)))
    monkeypatch.setattr(unnamed_models, "fit_with_process_noise_as_needed", lambda *_, **__: away)
    again = fitted()
    assert again.log_likelihood == pytest.approx(right.log_likelihood, abs=0.5)
    np.testing.assert_allclose(again.model.values, right.model.values, atol=0.02)
