"""Which certificate counts, what is held out, and the control of networks."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import sympy

from siq.data.recordings import SnapshotPairs
from siq.inference.field_estimate import Verdict
from siq.quasipotential import refinement
from siq.quasipotential.certificate import Certificate, Evidence
from siq.quasipotential.global_formula import GlobalFormula
from siq.quasipotential.refinement import (
    RefinementContext,
    RefinementOptions,
    _every_well_held_out,
    _Refined,
)
from siq.systems.dynamics import Dynamics
from siq.systems.phase_portrait import phase_portrait

PASSED, REFUSED = Verdict(0.0, 1.0, True), Verdict(2.0, 1.0, False, "it is no solution")


def certificate(verdict: Verdict, scope: str) -> Certificate:
    return Certificate({"characteristics": verdict}, 0.01, verdict.reason, scope)


@pytest.mark.parametrize(
    ("formula", "wells", "scope", "whole"),
    [
        (PASSED, PASSED, "region", True),
        (REFUSED, PASSED, "wells", False),
        (REFUSED, REFUSED, "region", True),
    ],
)
def test_the_wells_carry_the_certificate_where_one_formula_is_refused(
    monkeypatch: pytest.MonkeyPatch, formula: Verdict, wells: Verdict, scope: str, whole: bool
) -> None:
    well: Any = object()
    one = GlobalFormula(np.ones(1), np.eye(1), joint=True)
    found = _Refined(SimpleNamespace(noise_free=True), (well,), formula=one)  # type: ignore[arg-type]
    monkeypatch.setattr(refinement, "refine", lambda *_, **__: found)
    monkeypatch.setattr(refinement, "_formula_library", lambda *_: None)
    monkeypatch.setattr(
        refinement, "_refined_decomposition", lambda one, _: SimpleNamespace(potential=one.formula)
    )

    monkeypatch.setattr(refinement, "certify", lambda *_, **__: certificate(formula, "region"))
    monkeypatch.setattr(
        refinement, "certify_wells", lambda given, *_, **__: (list(given), certificate(wells, "wells"))
    )
    context: Any = SimpleNamespace(
        found=found.found, portrait=None, points=None, number=0, evidence=None, networks=None,
        options=RefinementOptions(),
    )  # fmt: skip
    refined, formulas, made = RefinementContext._certified_up_to(context, (), context.evidence)
    assert made.scope == scope
    assert (formulas.potential is not None) == whole
    assert made.certified == (PASSED in (formula, wells))
    told = {one.code for one in refined.remarks}
    assert ("quasipotential.single_formula_refused" in told) == (not whole)


def test_recordings_of_every_well_are_held_out_where_they_stay_in_theirs() -> None:
    x, y = sympy.symbols("x y", real=True)
    draw = np.random.default_rng(0)
    states = draw.uniform([-1.6, -0.8], [1.6, 0.8], (600, 2))
    portrait = phase_portrait(Dynamics.of((x, y), (x - x**3, -y)), states)
    places = np.repeat([-1.0, -1.0, 1.0, 1.0, 1.0], 200)
    x0 = np.stack([places, np.zeros(1000)], axis=1) + 0.1 * draw.standard_normal((1000, 2))
    recording = np.repeat(np.arange(5), 200)
    pairs = SnapshotPairs(x0=x0, xh=x0, h=np.full(1000, 0.1), recording=recording)
    mask = np.array([True, False, False, False, False])
    found = _every_well_held_out(portrait, pairs, mask)
    assert found.tolist()[:2] == [True, False] and found[2:].sum() == 1
    assert _every_well_held_out(portrait, pairs, found).tolist() == found.tolist()


@pytest.mark.parametrize(("fault", "tried"), [("characteristics", 2), ("prediction", 1)])
def test_what_is_refused_as_a_formula_alone_is_sought_up_to_the_paths(
    fault: str, tried: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[object]()

    def certified_up_to(context: object, ways: object, evidence: Evidence) -> tuple[str, str, Certificate]:
        asked.append((ways, evidence.references))
        tests = {"characteristics": PASSED, fault: PASSED if ways else REFUSED}
        return "refined", "formulas", Certificate(tests, 0.0, "")

    context = object.__new__(RefinementContext)
    found: Any = SimpleNamespace(dynamics=None)
    context.found, context.portrait, context.number = found, found, 0
    context.evidence = Evidence(found, found, np.zeros((0, 2)))
    monkeypatch.setattr(refinement, "ways_out", lambda *_: ["a way"])
    monkeypatch.setattr(refinement, "references_about", lambda *_, ways, seed: ways)
    monkeypatch.setattr(RefinementContext, "_certified_up_to", certified_up_to)
    assert context._certified()[2].certified == (tried == 2)
    assert asked == [((), ()), (["a way"], ["a way"])][:tried]
    assert context.evidence.references == (["a way"] if tried == 2 else ())
