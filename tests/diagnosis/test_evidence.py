"""Evidence for names and for functions without one, held against what linear algebra and scipy say."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import sympy

from siq.diagnosis.diagnosis import _is_what_was_found
from siq.diagnosis.dictionary import roles_of, standard_dictionary
from siq.diagnosis.evidence import averaged_evidence, evidence_of_function, smooth_prior
from siq.diagnosis.mechanisms import MechanismCandidate, candidates_of, fresh_names
from siq.diagnosis.study import SearchOptions
from siq.diagnosis.terms import Place, _powers, _simplest, _with_formula
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, symbol
from siq.systems.formulas import compile_values

OSCILLATOR = Dynamics(
    ("x", "v"),
    (symbol("v"), -4 * symbol("x")),
    Diffusion.identity(2),
    units=("m", "m/s"),
    time_unit="s",
    outputs=(("x", symbol("x")),),
)
KNOTS = np.array([-2.0, -1.0, -0.2, 0.3, 1.5, 4.0])


def test_the_evidence_is_that_of_a_normal_distribution() -> None:
    """p(y) ∝ det(C)^-½ (yᵀ C⁻¹ y)^-ν/2 with C = 1 + H K Hᵀ, over that with C = 1."""
    draw = np.random.default_rng(4)
    columns, target = draw.normal(size=(40, 3)), 3 * draw.normal(size=40)
    root = draw.normal(size=(3, 3))
    prior = root @ root.T
    covariance = np.eye(40) + columns @ prior @ columns.T
    expected = -0.5 * np.linalg.slogdet(covariance)[1] - 20 * np.log(
        (target @ np.linalg.solve(covariance, target)) / (target @ target)
    )
    found = averaged_evidence(columns.T @ columns, columns.T @ target, [prior], float(target @ target), 40)
    assert found == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("size", [5.0, 20.0, 100.0])
def test_a_smooth_function_is_believed_where_there_is_one_and_not_in_noise(size: float) -> None:
    draw = np.random.default_rng(2)
    course = draw.uniform(-2, 4, size=400)
    hats = np.stack([np.interp(course, KNOTS, row) for row in np.eye(len(KNOTS))], axis=1)
    noise = draw.normal(size=400)
    values = np.sin(KNOTS)
    effect = hats @ values * size / np.linalg.norm(hats @ values)
    assert evidence_of_function(hats, noise, KNOTS, freedom=400) < 0
    found = evidence_of_function(hats, noise + effect, KNOTS, freedom=400)
    # No more than what it explains, and less: it could have been anything.
    assert found < size**2 / 2
    assert found > 0 or size < 10


def test_smooth_functions_are_smooth() -> None:
    prior = smooth_prior(KNOTS, 0.5)
    correlation = prior[0] / prior[0, 0]
    assert (np.diff(correlation) < 0).all() and np.linalg.eigvalsh(prior).min() > 0


def test_odds_of_a_name_follow_from_how_many_may_be_wrong() -> None:
    options = SearchOptions(wrong_names=0.05, unnamed=0.2)
    assert np.exp(options.least_log_odds) == pytest.approx(19)


def place(*words: str) -> Place:
    factor = symbol(words[1]) if len(words) > 1 else sympy.Integer(1)
    return Place((("v", factor),), (), (symbol(words[0]),), words, KNOTS)


@pytest.mark.parametrize(
    ("words", "terms", "unit"),
    [
        (("x",), "c_1*x**3", "1/(s**2*m**2)"),
        (("x", "v"), "c_1*x**2*v", "1/(s*m**2)"),
        (("t", "x"), "c_1*t*x", "s**(-3)"),
    ],
)
def test_coefficients_of_formulas_have_units(words: tuple[str, ...], terms: str, unit: str) -> None:
    where = place(*words)
    wanted = sympy.sympify(terms, {name: symbol(name) for name in ("c_1", "x", "v", "t")})
    term = next(each for each in _powers(where, degree=3) if symbol("c_1") * each[0] == wanted)
    candidate = _with_formula(OSCILLATOR, where, [term])
    assert candidate.model.equations[1] - OSCILLATOR.equations[1] == wanted
    assert candidate.model.parameters[-1].unit == unit
    assert candidate.changes == (("v", wanted),)


def test_a_formula_without_its_first_coordinate_is_one_of_the_second() -> None:
    t, w = symbol("t"), symbol("v")
    alone, terms = _simplest(place("t", "v"), [(w, 0, 1), (w**2, 0, 2)])
    assert (
        alone.words == ("v",) and alone.coordinates == (w,) and alone.equations == (("v", sympy.Integer(1)),)
    )
    assert [first for _, first, _ in terms] == [1, 2]
    both, _ = _simplest(place("t", "v"), [(t * w, 1, 1)])
    assert both.words == ("t", "v")


def test_a_function_that_is_the_same_everywhere_is_the_mechanism_that_adds_a_constant() -> None:
    """Names and signs of parameters are no difference; another state, another power, or a shape are."""
    every = candidates_of(OSCILLATOR, roles_of(OSCILLATOR), standard_dictionary())
    bias, drag = (
        next(each for each in every if each.name == name and each.equations == ("v",))
        for name in ("constant bias", "linear damping")
    )
    powers = _powers(place("v"), degree=2)
    constant, linear, quadratic = (_with_formula(OSCILLATOR, place("v"), [each]) for each in powers[:3])
    assert constant.terms == bias.terms and linear.terms == drag.terms
    assert len({each.terms for each in (constant, linear, quadratic)}) == 3
    elsewhere = replace(place("v"), equations=(("x", sympy.Integer(1)),))
    assert _with_formula(OSCILLATOR, elsewhere, powers[:1]).terms != bias.terms

    def named(function: MechanismCandidate, mechanism: MechanismCandidate, *, parts: int = 1) -> bool:
        found = SimpleNamespace(found=(SimpleNamespace(best=SimpleNamespace(candidate=mechanism)),))
        described = SimpleNamespace(parts=(SimpleNamespace(candidate=function),) * parts)
        return _is_what_was_found(described, found)  # type: ignore[arg-type]

    # A function of v that is linear may be another one; one that is the same everywhere is none of v.
    assert named(constant, bias) and not named(linear, drag) and not named(constant, drag)
    assert not named(constant, bias, parts=2)


def test_new_names_are_new() -> None:
    assert fresh_names("c", 2, OSCILLATOR.names) == ["c_1", "c_2"]
    again = _with_formula(OSCILLATOR, place("x"), _powers(place("x"), degree=2)[:2]).model
    assert fresh_names("c", 1, again.names) == ["c_3"]


def test_derivatives_of_clearances_take_numbers_beside_arrays() -> None:
    """Conditions on a parameter alone stand beside those on a state."""
    x, a = symbol("x"), symbol("a")
    slope = sympy.Max(0, sympy.Min(x, x + a, a)).diff(x) + sympy.Piecewise(
        (1.0, (a > 0) & (x > a)), (0.0, True)
    )
    at = np.array([-1.0, 0.2, 2.0])
    assert np.isfinite(compile_values([slope], [x, a])(at, 0.5)[0]).all()
