"""V by characteristics about an attractor, and which V it refuses."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    double_well,
    exact_field,
    maier_stein,
    portrait_of,
    potential_gradient,
    potential_values,
)

from siq.quasipotential.certificate import Certificate, _follow_well
from siq.quasipotential.certificate_tests import (
    FEWEST,
    SHARE,
    Candidate,
    CertificateOptions,
    Reference,
    Verdict,
    check_characteristics,
)

OPTIONS = CertificateOptions()
SYSTEMS = {
    "archetype": archetype(3), "Maier-Stein": maier_stein(1), "gradient system": double_well(2),
    "one state": double_well(1),
}  # fmt: skip
SADDLES = {"archetype": 0.5, "Maier-Stein": 0.25}


@functools.cache
def reference_of_name(name: str) -> Reference:
    known = SYSTEMS[name]
    return _follow_well(known.dynamics, portrait_of(known, 300, share=0.6), 0)


def candidate_of(
    known: KnownSystem, *references: Reference, factor: float = 1.0, level: float = np.inf
) -> Candidate:
    portrait = portrait_of(known, 300, share=0.6)
    return Candidate(
        values=lambda at: factor * potential_values(known, at),
        gradients=lambda at: factor * potential_gradient(known, at),
        hessians=lambda at: np.zeros((*at.shape, at.shape[1])),
        circulatory=None,
        points=portrait.points,
        attractors=portrait.attractors[:1],
        references=references,
        level=level,
    )


@pytest.mark.parametrize("name", SYSTEMS)
def test_they_carry_the_exact_v_to_within_their_own_error(name: str) -> None:
    known = SYSTEMS[name]
    found = reference_of_name(name)
    exact = potential_values(known, found.points) - potential_values(known, found.attractor[None])
    assert not found.fault and len(found.values) >= FEWEST
    assert np.linalg.norm(found.values - exact) < found.error * np.linalg.norm(exact)
    assert found.error < 2e-5
    assert (found.values <= SHARE * found.level * (1 + 1e-9)).all()


@pytest.mark.parametrize("name", SADDLES)
def test_their_level_is_v_of_the_saddle_that_nobody_told_them(name: str) -> None:
    assert reference_of_name(name).level == pytest.approx(SADDLES[name], rel=0.05)


@pytest.mark.parametrize(("factor", "passes"), [(1.0, True), (1.01, True), (1.03, False), (-1.0, False)])
def test_v_has_to_be_theirs_within_the_error_that_is_stated(factor: float, passes: bool) -> None:
    known = maier_stein(1)
    # What is stated is 0.02 or, where V is off by more, what its own residual tells; that may be 0.15.
    options = replace(OPTIONS, error=0.02)
    candidate = candidate_of(known, reference_of_name("Maier-Stein"), factor=factor)
    verdict, error = check_characteristics(candidate, exact_field(known, 3), options, error=0.02)
    assert verdict.passed is passes and error >= 0.02
    assert verdict.value == pytest.approx(abs(factor - 1), abs=1e-5)
    assert ("most of all at" in verdict.reason) is not passes


def test_an_error_that_a_region_hides_is_stated() -> None:
    known = maier_stein(1)
    candidate = candidate_of(known, reference_of_name("Maier-Stein"), factor=1.01)
    verdict, error = check_characteristics(candidate, exact_field(known, 3), OPTIONS, error=1e-6)
    assert verdict.passed
    assert error >= 0.01


def test_a_formula_answers_up_to_the_level_that_it_claims() -> None:
    known = maier_stein(1)
    low = reference_of_name("Maier-Stein").below(0.1)[1]
    assert len(low) and low.max() <= SHARE * 0.1
    candidate = candidate_of(known, reference_of_name("Maier-Stein"), level=1e-9)
    verdict, _ = check_characteristics(candidate, exact_field(known, 3), OPTIONS, error=1e-6)
    assert not verdict.passed and "the level is too low" in verdict.reason


def test_what_is_too_stiff_is_told() -> None:
    x, y = sympy.symbols("x y", real=True)
    known = double_well(2)
    stiff = replace(known.dynamics, equations=(known.dynamics.equations[0], -20_000 * (y - x / 2)))
    found = _follow_well(stiff, portrait_of(known, 300, share=0.6), 0)
    assert "characteristics" in found.fault and "from the attractor [-" in found.fault
    verdict, _ = check_characteristics(candidate_of(known, found), exact_field(known, 3), OPTIONS, error=1e-6)
    assert not verdict.passed and verdict.reason == found.fault


def test_nothing_is_certified_without_them() -> None:
    others = {name: Verdict(0.0, 0.01, True) for name in ("identity", "branch", "agreement", "prediction")}
    without = Certificate(others, 1e-9, "")
    assert not without.certified and without.independent == ()
    passed = Certificate(others | {"characteristics": Verdict(0.0, 0.01, True)}, 1e-9, "")
    assert passed.certified and passed.as_data()["independent"] == ["characteristics"]
    refused = Certificate(others | {"characteristics": Verdict(1.0, 0.01, False)}, 1e-9, "")
    assert not refused.certified


def test_an_attractor_that_none_left_is_refused() -> None:
    known = maier_stein(1)
    verdict, error = check_characteristics(candidate_of(known), exact_field(known, 3), OPTIONS, error=1e-6)
    assert not verdict.passed and error == 1e-6
