"""`quasipotential.json`: what is written comes back as the object that it was."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import sympy
from known_systems import exact_field, maier_stein, portrait_of

from siq.data.states import DwellCount
from siq.errors import InputError
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.landscape_assembly import find_landscape, landscape_from_equations
from siq.quasipotential.landscape_files import landscape_data, read_landscape, write_landscape
from siq.quasipotential.occupancy import VisitTest
from siq.quasipotential.rates import EscapeRate, NoiseStrength
from siq.quasipotential.refinement import RefinementOptions
from siq.remarks import Remark
from siq.systems.cycles import Cycle
from siq.systems.dynamics import Dynamics

X, Y = sympy.symbols("x y", real=True)


@cache
def learned() -> Landscape:
    known = maier_stein(3)
    found = find_landscape(
        exact_field(known, 3, relative_error=1e-3), portrait_of(known, 250, share=0.8),
        options=RefinementOptions(degrees=(4,)), noise=NoiseStrength(0.1, 0.01, "estimated"),
    )  # fmt: skip
    visits = (VisitTest(1, DwellCount(0, 3.5), DwellCount(4, 80.0), 21.0, 0.25, "operator", 0.6),)
    return replace(found.in_units(["m", "m"], time="s"), visits=visits)


def with_cycles() -> Landscape:
    """A stable cycle in the place of one attractor, and an unstable one in that of a saddle."""
    phase = np.linspace(0, 2 * np.pi, 30, endpoint=False)
    circle = np.stack([np.cos(phase), np.sin(phase)], axis=1)
    stable, unstable = Cycle(circle, 6.0, np.array([0.2])), Cycle(circle / 3, 5.0, np.array([3.0]))
    point = learned()
    first, second = point.transitions
    remarks = (Remark("quasipotential.leads_out", {"over": "unstable cycle"}),)
    return replace(
        point, given=True, field_estimate=None, attractors=(point.attractors[0], stable),
        wells=(point.wells[0], None), remarks=(Remark("quasipotential.cycle_beside_formulas"),),
        parting=(unstable, Cycle(circle / 2, 7.0, np.array([-2.0 + 1j]))), certificate=None,
        transitions=(
            replace(first, saddle=unstable, rate=None, end=None, remarks=remarks),
            replace(
                second, cycle=stable, barrier=0.5,
                rate=EscapeRate(0.5, np.nan, power=-0.5, phases=np.array([[0.0, 0.1], [0.2, 0.3]])),
            ),
        ),
    )  # fmt: skip


def with_certificate() -> Landscape:
    return landscape_from_equations(Dynamics.of((X,), (X - X**3,), domain=[(-2, 2)]))


@pytest.mark.parametrize("made", [learned, with_cycles, with_certificate])
def test_a_landscape_comes_back_as_the_object_that_it_was(made, tmp_path: Path) -> None:
    landscape, file = made(), tmp_path / "quasipotential.json"
    write_landscape(file, landscape)
    again = read_landscape(file, dynamics=landscape.dynamics)
    assert again is not None
    assert landscape_data(again) == landscape_data(landscape) == json.loads(file.read_text("utf-8"))
    for one, other in zip(landscape.attractors, again.attractors, strict=True):
        np.testing.assert_array_equal(other.position.round(7), one.position.round(7))
        assert isinstance(other, Cycle) == isinstance(one, Cycle) and other.kind == one.kind
        np.testing.assert_array_equal(other.eigenvalues, one.eigenvalues)
    assert again.noise == landscape.noise and again.remarks == landscape.remarks
    assert (again.visits, again.given, again.notes) == (landscape.visits, landscape.given, landscape.notes)
    pd.testing.assert_frame_equal(again.barriers(), landscape.barriers())
    pd.testing.assert_frame_equal(again.escape_times(noise=0.1), landscape.escape_times(noise=0.1))
    pd.testing.assert_frame_equal(again.dwell_times(noise=0.1), landscape.dwell_times(noise=0.1))
    for way, back in zip(landscape.transitions, again.transitions, strict=True):
        assert (back.end, back.remarks) == (way.end, way.remarks)
        assert (back.cycle is None) == (way.cycle is None)
        np.testing.assert_array_equal([back.barrier, back.error], [way.barrier, way.error])
        assert (way.path is None) == (back.path is None)
        if way.path is None or back.path is None:
            continue
        np.testing.assert_array_equal(back.path.points, way.path.points)
        np.testing.assert_array_equal(back.path.downhill, way.path.downhill)
        np.testing.assert_allclose(back.path.momenta, way.path.momenta, rtol=1e-7)
        np.testing.assert_allclose(back.path.values, way.path.values, rtol=1e-7)
    if (whole := landscape.global_quasipotential) is not None:
        assert again.global_quasipotential is not None
        x = np.concatenate([well.points[::50] for well in whole.wells])
        known = np.isfinite(whole(x)) & np.isfinite(again.quasipotential(x))
        assert known.mean() > 0.9
        np.testing.assert_array_equal(again.quasipotential(x)[known], whole(x)[known])
    if landscape.given and (certificate := landscape.certificate) is not None:
        assert again.certificate is not None
        assert again.certificate.as_data() == certificate.as_data()


def test_what_is_no_landscape_is_refused_and_an_empty_file_is_none(tmp_path: Path) -> None:
    dynamics, file = Dynamics.of((X,), (-X,)), tmp_path / "quasipotential.json"
    file.touch()
    assert read_landscape(file, dynamics=dynamics) is None
    for text in ("{", "{}", "[]", json.dumps({"states": ["y"]})):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match="no landscape"):
            read_landscape(file, dynamics=dynamics)
