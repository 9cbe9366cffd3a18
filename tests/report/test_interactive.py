"""Views that a reader can change, of U and of mean times: their data, and that they ask nothing of others."""

from __future__ import annotations

import base64
import functools
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from known_systems import double_well, exact_field, portrait_of

from siq.quasipotential.landscape_assembly import find_landscape
from siq.quasipotential.rates import NoiseStrength
from siq.quasipotential.refinement import RefinementOptions
from siq.report.formatting import time_text
from siq.report.page import UNKNOWN, interactive_view
from siq.report.summary import LandscapeSummary, summarise


@functools.cache
def landscape(dimension: int) -> LandscapeSummary:
    known = double_well(dimension)
    found = find_landscape(
        exact_field(known, 3), portrait_of(known, 250, share=0.8), options=RefinementOptions(degrees=(4,))
    )
    return summarise(found)


def data_of(view: str, section: str = "view") -> dict:
    shown = view[view.index(f'id="{section}"') :]
    return json.loads(re.search(r'<script type="application/json">(.*?)</script>', shown, re.S)[1])


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
    assert len(re.findall("<label[> ]", view)) == len(re.findall(r'<input[^>]*type="range"|<select', view))


def test_a_state_with_a_hostile_name_ends_no_element() -> None:
    name = "</script><b>&"
    view = interactive_view(replace(landscape(3), names=(name, "y", "z")))
    assert view is not None and name not in view
    assert data_of(view)["names"][0] == name


def test_there_is_nothing_to_turn_of_one_state_and_of_nothing() -> None:
    for one in (landscape(1), replace(landscape(3), formulas=())):
        assert 'id="view"' not in (interactive_view(one) or "")


def test_a_landscape_without_any_equilibrium_is_drawn_as_far_as_it_goes() -> None:
    empty = replace(landscape(3), wells=(), ways=(), equilibria=())
    assert interactive_view(empty) is None or data_of(interactive_view(empty) or "")["wells"] == []
    np.testing.assert_array_equal(empty.lowest_saddle, empty.box.mean(axis=1))


def kramers(well: float, strength: float) -> float:
    """The mean time in a well of ``V = (x² - 1)²/4 + x/10`` over its only saddle."""
    saddle = np.sort(np.roots([1, 0, -1, 0.1]).real)[1]
    bottom, top = ((x**2 - 1) ** 2 / 4 + x / 10 for x in (well, saddle))
    return (
        2
        * math.pi
        / math.sqrt((3 * well**2 - 1) * (1 - 3 * saddle**2))
        * math.exp(2 * (top - bottom) / strength)
    )


@pytest.mark.parametrize("noise", [None, NoiseStrength(0.1, 0.01)])
def test_the_slider_shows_the_law_at_every_noise(noise: NoiseStrength | None) -> None:
    summary = replace(landscape(1), noise=noise)
    view = interactive_view(summary)
    assert view is not None
    data, barrier = data_of(view, "noise"), min(one.depth for one in summary.wells)
    strengths = [float(one) for one in data["noises"]]
    assert barrier / strengths[0] == pytest.approx(20, rel=0.06)
    assert barrier / strengths[-1] == pytest.approx(2, rel=0.06)
    first = int(re.search(r'type="range"[^>]*value="(\d+)"', view)[1])
    assert noise is None or strengths[first] == noise.intensity
    for strength, row in zip(strengths[::7], data["rows"][::7], strict=True):
        for well, cells in zip(summary.wells, row, strict=True):
            mean = well.time(NoiseStrength(strength))
            assert cells["time"] == time_text(mean)
            if mean is not None and noise is None:
                law = kramers(well.position[0], strength)
                assert mean.value == pytest.approx(law, rel=strength / well.depth)


def test_without_a_law_there_is_no_slider() -> None:
    assert interactive_view(replace(landscape(1), ways=())) is None


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
