"""The landscape as an object."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import sympy
from known_systems import (
    double_well,
    exact_field,
    maier_stein,
    portrait_of,
    potential_values,
    uniform_points,
)
from matplotlib.figure import Figure

from siq.errors import NumericalFailure
from siq.inference.field_estimate import Verdict
from siq.quasipotential.certificate import Certificate
from siq.quasipotential.characteristics import _potential_errors
from siq.quasipotential.formulas import read_model, write_model
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.landscape_assembly import find_landscape
from siq.quasipotential.landscape_files import read_landscape, write_landscape
from siq.quasipotential.rates import NoiseStrength
from siq.quasipotential.refinement import RefinementOptions, _refined_decomposition, refine
from siq.quasipotential.transitions import ways_out
from siq.remarks import Remark
from siq.report.summary import summarise
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics


@functools.cache
def double() -> Landscape:
    """Two wells of different depth, from the exact f as if it were known to a thousandth."""
    known = double_well(2)
    return find_landscape(
        exact_field(known, 3, relative_error=1e-3), portrait_of(known, 250, share=0.8),
        options=RefinementOptions(degrees=(4,)),
    )  # fmt: skip


def said(reason: str) -> Remark:
    return Remark("quasipotential.reason", {"reason": reason})


def test_the_wells_of_both_files_are_the_same(tmp_path: Path) -> None:
    known = maier_stein(3)
    found, points = exact_field(known, 3), uniform_points(known, 300)
    portrait = portrait_of(known)
    refined = refine(
        found, portrait, ways_out(known.dynamics, portrait), points=points,
        options=RefinementOptions(routes=("local",), degrees=(4, 6)),
    )  # fmt: skip
    model = tmp_path / "model.json"
    write_model(model, {"refined": _refined_decomposition(refined, points)}, {})
    # Another portrait, from other recorded states, as the landscape's own.
    landscape = find_landscape(found, portrait_of(known, 350), wells=read_model(model)[0]["refined"].wells)
    write_landscape(tmp_path / "quasipotential.json", landscape)
    stored = read_landscape(tmp_path / "quasipotential.json", dynamics=found.dynamics)
    assert stored is not None and len(landscape.wells) == 2 and not landscape.notes
    for ours, theirs in zip(refined.wells, stored.wells, strict=True):
        assert theirs is not None
        np.testing.assert_array_equal(theirs.coefficients, ours.coefficients)
        assert (theirs.level, theirs.reach) == (ours.level, ours.reach)
        x = ours.points[::20]
        known_there = np.isfinite(ours.known_values(x)) & np.isfinite(theirs.known_values(x))
        assert known_there.mean() > 0.9


def test_an_attractor_without_a_refined_well_is_said() -> None:
    known = maier_stein(1)
    landscape = find_landscape(exact_field(known, 3), portrait_of(known, 250, share=0.8), wells=())
    assert landscape.wells == (None, None)
    assert "quasipotential.no_refined_formula" in {one.code for one in landscape.remarks}
    assert landscape.notes[0].startswith("refinement found no formula about [")
    assert all(np.isfinite(way.barrier) for way in landscape.transitions)  # by the path alone


def test_barriers_are_a_table_in_the_order_of_the_attractors() -> None:
    known, table = double_well(2), double().barriers()
    assert list(table.columns) == ["start", "end", "barrier", "standard_error"]
    assert list(table["start"]) == [0, 1] and list(table["end"]) == [1, 0]
    saddle = double().transitions[0].saddle.position
    places = np.stack([saddle, *(one.position for one in double().attractors)])
    top, *bottoms = potential_values(known, places)
    np.testing.assert_allclose(table["barrier"], [2 * (top - bottom) for bottom in bottoms], rtol=1e-6)
    assert (table["standard_error"] > 0).all()


def test_a_formula_that_its_certificate_does_not_trust_says_nothing_of_barriers() -> None:
    known = double_well(2)
    options = RefinementOptions(degrees=(4,))
    for passed in (True, False):
        certificate = Certificate({"error": Verdict(1.4, 0.15, passed)}, 1.4, "")
        landscape = find_landscape(
            exact_field(known, 3, relative_error=1e-3), portrait_of(known, 250, share=0.8),
            options=options, certificate=certificate,
        )  # fmt: skip
        for way in landscape.transitions:
            assert way.path is not None
            assert (way.formula_share > 0) == passed
            if not passed:
                assert way.barrier == way.path.action + way.by_rivals
                assert way.error == way.standard_error > 0


def test_errors_of_u_of_barriers_and_of_times_are_one_propagation() -> None:
    known, left = double_well(2), 0.02
    tests = {"characteristics": Verdict(0.0, 1.0, True), "error": Verdict(left, 0.15, True)}
    landscape = find_landscape(
        exact_field(known, 3, relative_error=1e-3), portrait_of(known, 250, share=0.8),
        options=RefinementOptions(degrees=(4,)), noise=NoiseStrength(0.1, 0.001),
        certificate=Certificate(tests, left, ""),
    )  # fmt: skip
    assert landscape.noise is not None and landscape.field_estimate is not None
    for way, row in zip(landscape.transitions, landscape.barriers().itertuples(), strict=True):
        # What the table says is what times rest on, and no less than the share of the formula's own error.
        assert row.standard_error == way.error == way.exit.standard_error
        assert way.error >= left * way.formula_share * way.barrier > 0
        # U just below the saddle is as uncertain as the barrier is by f.
        well = landscape.potential(way.start)
        below = way.uphill[np.isfinite(well.known_values(way.uphill))]
        of_f = 2 * _potential_errors(landscape.field_estimate, well.gradients, well.attractor, below)
        assert of_f[np.isfinite(of_f)][-1] == pytest.approx(way.standard_error, rel=0.05)
        law = way.exit
        time = law.mean_exit_time(landscape.noise)
        assert time is not None and law.prefactor_error is not None
        parts = (way.error / 0.1) ** 2 + law.prefactor_error**2 + 2 * law.covariance / 0.1
        of_noise = way.barrier / 0.1 * way.leverage * 0.01
        assert time.data_error == pytest.approx(np.sqrt(parts + of_noise**2), rel=1e-6)
    stated = summarise(landscape).stating(Certificate(tests, left, "").as_data())
    assert stated is not None
    for way in landscape.transitions:
        assert stated["stated_error"] >= 2 * way.error / way.barrier


def test_u_is_known_over_the_wells_and_nowhere_else() -> None:
    known, landscape = double_well(2), double()
    x = np.concatenate([landscape.potential(well).points[::40] for well in (0, 1)])
    u = landscape.quasipotential(x)
    assert np.isfinite(u).mean() > 0.9
    exact = 2 * potential_values(known, x)
    at = np.isfinite(u)
    np.testing.assert_allclose(u[at], exact[at] - exact[at].min() + u[at].min(), atol=1e-5)
    assert np.isnan(landscape.quasipotential(np.full((1, 2), 50.0))).all()
    with pytest.raises(ValueError, match=r"give \(n, 2\)"):
        landscape.quasipotential(np.zeros(2))


def test_escape_times_follow_the_law_and_say_where_there_is_none() -> None:
    landscape = double()
    barrier = landscape.barriers()["barrier"].to_numpy()
    few, many = (landscape.escape_times(noise=noise) for noise in (barrier.min() / 20, barrier.min() / 10))
    assert list(few.columns) == ["start", "end", "mean_time", "note"]
    # In the leading order; what the correction adds changes by a fortieth at most, 0.375 (1/10 - 1/20).
    np.testing.assert_allclose(
        few["mean_time"] / many["mean_time"], np.exp(10 * barrier / barrier.min()), rtol=0.025
    )
    shown = replace(landscape, noise=NoiseStrength(barrier.min() / 10, source="estimated"))
    pd.testing.assert_frame_equal(shown.escape_times(), many)
    with pytest.raises(ValueError, match="no noise is known"):
        replace(landscape, noise=None).escape_times()
    loud = landscape.escape_times(noise=2 * barrier.max())
    assert loud["mean_time"].isna().all() and loud["note"].str.contains("far below the barrier").all()


def test_no_escape_times_without_d_of_a_system_of_second_order() -> None:
    x, v = sympy.symbols("x v", real=True)
    motion = Dynamics.of((x, v), (0.999 * v, x - x**3 - v))
    with pytest.raises(ValueError, match=r"the equation of x is of the form dx/dt = v.*give the D"):
        replace(double(), dynamics=motion).escape_times(noise=0.01)
    given = motion.with_diffusion(Diffusion(np.diag([1e-3, 1.0])))
    assert len(replace(double(), dynamics=given).escape_times(noise=0.01)) == 2


def test_a_well_that_was_not_found_is_asked_for_in_vain() -> None:
    nothing = replace(double(), wells=(None, double().wells[1]), remarks=(said("too few states"),))
    with pytest.raises(NumericalFailure, match="about attractor 0: too few states"):
        nothing.potential()
    assert np.isnan(nothing.quasipotential(np.zeros((3, 2)))).all()


def test_the_formula_of_a_well_can_be_taken_elsewhere() -> None:
    well = double().potential(well=1)
    x = well.points[:5]
    module: dict[str, object] = {}
    exec(well.to_numpy(), module)
    assert callable(module["V"])
    np.testing.assert_allclose(module["V"](*x.T), well.values(x), atol=1e-12)
    values = sympy.lambdify(well.basis.symbols, well.to_sympy())(*x.T)
    np.testing.assert_allclose(values, well.values(x), atol=1e-12)
    for source in (well.formula.source("text"), well.to_latex(digits=4), well.to_c(), well.to_julia()):
        assert "V" in source and "nan" not in source


def test_the_report_has_verdict_attractors_and_barriers() -> None:
    certificate = Certificate({"characteristics": Verdict(0.0, 0.01, True)}, 0.01, "")
    text = replace(double(), certificate=certificate, remarks=(said("a limit cycle <x>"),)).report()
    assert "The formulas are certified: U is right to within 1 % of its height." in text
    assert repr(double()) == "<Landscape of (x, y): 2 attractors, 2 ways out>"
    assert "a limit cycle <x>" in text and "Ways out, and their barriers of U:" in text and "A  B" in text
    page = replace(double(), remarks=(said("a limit cycle <x>"),))._repr_html_()
    assert "No test was made" in page and "&lt;x&gt;" in page and page.count("<table") == 2


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_landscape_is_drawn_on_given_axes_and_on_new_ones(dimension: int) -> None:
    axes = Figure().add_subplot()
    known = double_well(dimension)
    landscape = double()
    if dimension == 3:
        landscape = find_landscape(
            exact_field(known, 3), portrait_of(known, 250, share=0.8), options=RefinementOptions(degrees=(4,))
        )
    assert landscape.plot(axes) is axes
    assert axes.get_xlabel() == "$x$" and axes.get_ylabel() in ("$y$", "$z$")
    assert len(axes.collections) >= 1  # contours
    assert bool(axes.get_title(loc="left")) == (dimension == 3)
