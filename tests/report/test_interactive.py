"""The view of U that can be turned and cut: its data, its size, and that it asks nothing of anybody."""

from __future__ import annotations

import base64
import functools
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from known_systems import double_well, exact_field, portrait_of

from siq.quasipotential.landscape_assembly import find_landscape
from siq.quasipotential.refinement import RefinementOptions
from siq.report.page import UNKNOWN, interactive_view
from siq.report.summary import LandscapeSummary, summarise


@functools.cache
def landscape(dimension: int) -> LandscapeSummary:
    known = double_well(dimension)
    found = find_landscape(
        exact_field(known, 3), portrait_of(known, 250, share=0.8), options=RefinementOptions(degrees=(4,))
    )
    return summarise(found)


def data_of(view: str) -> dict:
    return json.loads(re.search(r'<script type="application/json">(.*?)</script>', view, re.S)[1])


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_grid_is_u_where_it_is_known(dimension: int) -> None:
    shown = landscape(dimension)
    view = interactive_view(shown)
    assert view is not None
    data = data_of(view)
    steps = np.frombuffer(base64.b64decode(data["grid"]), np.uint8).reshape(data["shape"]).astype(float)
    axes = [np.linspace(*box, count) for box, count in zip(data["box"], data["shape"], strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dimension)[::7]
    values, found = shown.potential(points), steps.ravel()[::7]
    assert ((found == UNKNOWN) == np.isnan(values)).mean() > 0.999  # but for limits of six digits
    inside = (found < 254) & np.isfinite(values)
    read = data["low"] + found[inside] / 253 * (data["high"] - data["low"])
    np.testing.assert_allclose(read, values[inside], atol=(data["high"] - data["low"]) / 250)
    assert [one["label"] for one in data["wells"]] == ["A", "B"]


def test_it_is_small_and_whole() -> None:
    view = interactive_view(landscape(3))
    assert view is not None
    assert len(view) < 300_000
    for word in ("http:", "https:", "eval(", "Function(", "import(", "fetch(", "XMLHttpRequest", "innerHTML"):
        assert word not in view
    assert "<noscript>" in view and view.count("<canvas") == view.count('role="img" aria-label=') == 2
    # Every control has its label.
    assert view.count("<label>") == len(re.findall(r'<input[^>]*type="range"|<select', view))


def test_a_state_with_a_hostile_name_ends_no_element() -> None:
    name = "</script><b>&"
    view = interactive_view(replace(landscape(3), names=(name, "y", "z")))
    assert view is not None and name not in view
    assert data_of(view)["names"][0] == name


def test_there_is_none_of_one_state_and_of_nothing() -> None:
    assert interactive_view(landscape(1)) is None
    assert interactive_view(replace(landscape(3), formulas=())) is None


def test_of_many_states_four_are_shown_and_the_others_held_at_the_saddle() -> None:
    three = landscape(3)

    def more(x: np.ndarray) -> np.ndarray:
        return three.potential(x[:, :3]) + (x[:, 3:] ** 2).sum(axis=1)

    def longer(x: np.ndarray) -> np.ndarray:
        return np.concatenate([x, np.zeros((*x.shape[:-1], 3))], axis=-1)

    many = replace(
        three, names=tuple("xyzuvw"), units=("1",) * 6, formulas=(), dynamics=None, points=None,
        wells=tuple(replace(one, position=longer(one.position)) for one in three.wells),
        equilibria=tuple(replace(one, position=longer(one.position)) for one in three.equilibria),
        ways=tuple(
            replace(
                way, saddle=replace(way.saddle, position=longer(way.place)),
                path=replace(way.path, points=longer(way.uphill), downhill=longer(way.downhill)),
            )
            for way in three.ways if way.path is not None
        ),
    )  # fmt: skip
    object.__setattr__(many, "potential", more)
    object.__setattr__(many, "box", np.concatenate([three.box, np.tile([[-1.0, 1.0]], (3, 1))]))
    view = interactive_view(many)
    assert view is not None and len(data_of(view)["names"]) == 4
    assert "held at the lowest saddle: v = 0, w = 0" in view
