"""A study of two lines gives the right answer: a name, and where the data are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from known_systems import maier_stein, potential_values
from two_lines import analysed

from siq.inference.field_estimate import DiffusionSource
from siq.quasipotential.landscape import Landscape
from siq.workflow.pipeline import Analysis
from siq.workflow.tables import Method


def landscape_of(found: Analysis) -> Landscape:
    assert found.landscape is not None and found.landscape.result is not None
    return found.landscape.result


def test_of_a_system_they_give_the_certified_landscape(tmp_path: Path) -> None:
    found = analysed("system: maier-stein", tmp_path)
    certificate = found.refined.certificates[Method.REFINED]
    assert certificate["certified"], certificate["reason"]
    landscape = landscape_of(found)
    assert landscape.notes == ()
    np.testing.assert_allclose(landscape.barriers()["barrier"], 0.5, rtol=1e-8)
    known = maier_stein(1)
    points = np.random.default_rng(1).uniform(*known.domain.T, (200, 2))
    own = found.refined.formulas[Method.REFINED].evaluate(np.ascontiguousarray(points.T))[0]
    np.testing.assert_allclose(own, potential_values(known, points), atol=1e-8)


def test_of_recordings_they_give_the_certified_landscape_and_say_which_d(tmp_path: Path) -> None:
    # dx/dt = x - x³, dy/dt = -y: the motion in closed form, with 61 samples of 60 recordings.
    t = np.linspace(0, 3, 61)
    starts = np.random.default_rng(0).uniform(-1.5, 1.5, (2, 60, 1))
    x = starts[0] / np.sqrt(starts[0] ** 2 + (1 - starts[0] ** 2) * np.exp(-2 * t))
    table = {
        "recording": np.repeat(np.arange(60), 61), "t": np.tile(t, 60), "x": x.ravel(),
        "y": (starts[1] * np.exp(-t)).ravel(),
    }  # fmt: skip
    pd.DataFrame(table).to_csv(tmp_path / "measured.csv", index=False)
    found = analysed(f"recordings: {{file: {tmp_path / 'measured.csv'}}}", tmp_path)
    certificate = found.refined.certificates[Method.REFINED]
    assert certificate["certified"], certificate["reason"]
    landscape = landscape_of(found)
    assert landscape.notes == (DiffusionSource.UNIT.note,)
    np.testing.assert_allclose(landscape.barriers()["barrier"], 0.5, rtol=1e-6)
