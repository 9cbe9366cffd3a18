"""Functions of two coordinates without a name: found, fitted, stated and drawn."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.stats
import sympy

from siq.diagnosis import unnamed_models
from siq.diagnosis.diagnosis import solve_case
from siq.diagnosis.dictionary import standard_dictionary
from siq.diagnosis.evidence import _log_evidence_of, evidences_by_size
from siq.diagnosis.holdout import preferred_model
from siq.diagnosis.smooth_functions import (
    LENGTH_SCALES,
    SmoothFunction,
    _Bumps,
    _product_of,
    _triangle_of,
)
from siq.diagnosis.terms import Place
from siq.inference.budget import Budget, BudgetSpent
from siq.inference.kalman_filter import Noise
from siq.inference.maximum_likelihood import fit_by_multiple_shooting
from siq.inference.measurements import Measurements
from siq.report.plots.diagnosis import plot_described
from siq.systems.dynamics import TIME, Diffusion, Dynamics, Signals
from tests.diagnosis.foreign_cases import ForeignCase, course, table_of

X, V = sympy.symbols("x v", real=True)
ONE = sympy.Integer(1)
MODEL = Dynamics(("x", "v"), (V, -X), Diffusion.identity(2))


def courses_of(count: int) -> np.ndarray:
    """So many coordinates along recordings that have been everywhere."""
    return np.random.default_rng(3).uniform(-1, 3, size=(count, 400))


def bumps(*coordinates: sympy.Symbol, shares: tuple[float, ...], deviation: float = 1.0) -> _Bumps:
    return _Bumps.along(coordinates, courses_of(len(coordinates)), shares, deviation=deviation)


def function_of(*factors: _Bumps) -> SmoothFunction:
    coordinates = tuple(each for factor in factors for each in factor.coordinates)
    place = Place((("v", ONE),), (), coordinates, tuple(map(str, coordinates)))
    return SmoothFunction(place, factors, np.ones(sum(each.width for each in factors)))


@pytest.mark.parametrize(
    "function",
    [
        function_of(bumps(X, V, shares=(0.25, 0.5))),
        function_of(bumps(X, shares=(0.25,)), bumps(V, shares=(0.25,))),
    ],
)
def test_a_formula_says_what_the_function_does(function: SmoothFunction) -> None:
    candidate = function.added_to(MODEL)
    assert candidate.equations == ("v",) and candidate.coordinate == "x, v"
    heights = np.random.default_rng(1).normal(size=function.width)
    known = dict(zip(candidate.amplitudes, heights, strict=True))
    values = np.array([known.get(each.name, each.value) for each in candidate.model.parameters])
    states = np.random.default_rng(3).normal(size=(2, 40))
    empty = np.zeros((0, 40))
    rates = candidate.model.functions.rates(states, Signals(empty, empty, empty, np.zeros(40)), values)
    found, derivatives = function.along(heights, states)
    np.testing.assert_allclose(rates[1] + states[0], found, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(rates[0], states[1])
    for place, moved in enumerate(1e-6 * np.eye(function.width)):
        slope = (function.along(heights + moved, states)[0] - found) / 1e-6
        np.testing.assert_allclose(slope, derivatives[:, place], atol=1e-4)


@pytest.mark.parametrize(
    ("coordinates", "shares", "off"), [((X,), (0.25,), 1e-4), ((X, V), (0.5, 0.25), 0.05)]
)
def test_a_sum_of_bumps_is_the_process_where_the_recordings_have_been(
    coordinates: tuple[sympy.Symbol, ...], shares: tuple[float, ...], off: float
) -> None:
    function, courses = bumps(*coordinates, shares=shares, deviation=1.7), courses_of(len(coordinates))
    expected = function.expected(tuple(f"b{k}" for k in range(function.width)))
    along = np.linalg.solve(expected.roots.T, function.values(courses))
    scaled = courses / function.lengths[:, None]
    away = ((scaled[:, :, None] - scaled[:, None, :]) ** 2).sum(axis=0)
    np.testing.assert_allclose(along.T @ along, 1.7**2 * np.exp(-0.5 * away), atol=off * 1.7**2)


def test_a_length_beyond_the_recordings_a_function_is_zero() -> None:
    function = bumps(X, shares=(0.125,))
    values = function.heights_of(np.ones(function.width)) @ function.values(np.array([[1.0, 2.9, 3.5, 5.0]]))
    np.testing.assert_allclose(values[:2], 1.0, atol=0.03)
    assert 0.5 < values[2] < 0.9 and abs(values[3]) < 0.01


def test_length_and_size_of_a_function_are_told() -> None:
    """Of functions that are such processes, over lengths from a sixteenth of the range to half of it."""
    draw = np.random.default_rng(7)
    courses, noise, found = courses_of(1), 0.05, []
    fine = bumps(X, shares=(1 / 32,))
    for share in np.repeat([1 / 16, 1 / 8, 1 / 4, 1 / 2], 5):
        lengths = share * np.ptp(courses, axis=1)
        heights = fine.heights_of(_triangle_of(fine.centres, lengths) @ draw.normal(size=fine.width))
        left = heights @ fine.values(courses) / noise + draw.normal(size=400)
        told = []
        for each in LENGTH_SCALES:
            function = bumps(X, shares=(each,))
            along = np.linalg.solve(function.triangle, function.values(courses)).T / noise
            total = float(left @ left)
            odds, variance, rest = evidences_by_size(along.T @ along, along.T @ left, total, freedom=400)
            best = int(np.argmax(odds))
            told.append((odds[best], each / share, np.sqrt(variance[best] * rest[best] / 400)))
        found.append(max(told)[1:])
    ratios, sizes = np.array(found).T
    assert (np.abs(np.log2(ratios)) <= 1).all() and (ratios == 1).mean() >= 0.75
    assert 0.5 < np.exp(np.log(sizes).mean()) < 2.0


def test_a_product_is_told_where_both_coordinates_were_never_large_at_a_time() -> None:
    draw = np.random.default_rng(5)
    x, y = draw.uniform(-1, 3, size=(2, 600))
    seen = (x < 1) | (y < 1)
    place, courses = Place((("v", ONE),), (), (X, V), ("x", "v")), np.stack([x, y])[:, seen]

    def true(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.tanh(2 * x - 2) * np.exp(-((y - 1.5) ** 2))

    told = true(*courses) + 0.02 * draw.normal(size=seen.sum())
    weights = np.eye(len(told)) / 0.02**2
    found = _product_of(
        place, courses, LENGTH_SCALES, points=courses.T, gram=weights, overlap=weights @ told, deviation=1.0
    )
    corner = draw.uniform(1.2, 2.8, size=(2, 200))
    values, _ = found.along(found.begin, corner)
    np.testing.assert_allclose(values, true(*corner), atol=0.08)


def test_evidence_of_parameters_expected_together_is_the_marginal_likelihood() -> None:
    """Exact for a linear model with normal errors: log N(y; 0, ΦKΦᵀ + σ²)."""
    t, noise = np.arange(0, 8, 0.1), 0.1**2
    bell = _Bumps.along((TIME,), t[None], (0.125,), deviation=0.8)
    function = SmoothFunction(Place((), (("y", ONE),), (TIME,), ("t",)), (bell,), np.zeros(bell.width))
    still = Dynamics(("y",), (sympy.Integer(0),), Diffusion.identity(1))
    along = 0.8 * np.linalg.solve(bell.triangle, bell.values(t[None]))
    exact = [along.T @ along + noise * np.eye(len(t)), noise * np.eye(len(t))]
    y = np.random.default_rng(2).multivariate_normal(np.zeros(len(t)), exact[0])
    data = Measurements(("r",), np.array([0, len(t)]), t, y[:, None], ((),), sensor_noise=np.array([noise]))
    found = []
    for model in (function.added_to(still).model, still):
        fit = fit_by_multiple_shooting(
            model, data, x=np.zeros((len(t), 1)), noise=Noise(np.array([noise]), np.zeros(1)),
            estimate_process=False, substeps=1,
        )  # fmt: skip
        found.append(_log_evidence_of(fit, data))
    # The first state is a constant of any size; what is the same for both does not count.
    wide = [scipy.stats.multivariate_normal(np.zeros(len(t)), each + 1e4).logpdf(y) for each in exact]
    constant = [np.log(np.linalg.solve(each, np.ones(len(t))).sum()) / 2 for each in exact]
    wanted = wide[0] + constant[0] - wide[1] - constant[1]
    assert found[0] - found[1] == pytest.approx(wanted, abs=0.02 * abs(wanted))


def test_what_is_beyond_all_numbers_ends_a_function_and_not_the_case(monkeypatch: pytest.MonkeyPatch) -> None:
    def singular(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("singular matrix")

    where = SimpleNamespace(words=("x",))
    fit, context = SimpleNamespace(model=MODEL, x=np.zeros((3, 2))), SimpleNamespace(data=None)
    monkeypatch.setattr(unnamed_models.Smoothness, "of", singular)
    assert unnamed_models._with_smooth_term((), fit, where, 0.0, context) == []
    asked = SimpleNamespace(considered=9, level=1.0, function=singular)
    monkeypatch.setattr(unnamed_models.Smoothness, "of", lambda *_, **__: asked)
    assert unnamed_models._with_smooth_term((), fit, where, 0.0, context, product=True) == []


def test_the_model_is_taken_that_foresees_parts_left_out_best_and_of_those_alike_the_simplest() -> None:
    draw = np.random.default_rng(3)
    errors = 0.1 * draw.chisquare(1, 400)
    other = errors * np.exp(0.1 * draw.normal(size=400))
    assert preferred_model([errors, 0.3 * other, 2 * other], [1, 2, 1]) == 1
    assert preferred_model([errors, other], [2, 1]) == 1  # as good, and of fewer parameters
    assert preferred_model([errors, other], [1, 1]) == 0  # the first of as many
    assert preferred_model([None, errors], [0, 2]) == 1  # one that runs away is none
    assert preferred_model([None, None], [1, 1]) == 0


def test_a_fit_takes_no_more_than_its_part_of_the_budget() -> None:
    budget = Budget(work=100.0)
    with pytest.raises(BudgetSpent), budget.part(0.25):
        for _ in range(100):
            budget.charge(1.0)
    assert budget.spent == 25
    budget.charge(1.0)  # what comes after has the rest


CARD = {
    "name": "swirl",
    "states": {"x": {"unit": "mm"}, "y": {"unit": "mm"}},
    "parameters": {"a": {"value": 0.2, "unit": "1/s"}, "w": {"value": 2.0, "unit": "1/s"}},
    "equations": {"x": "-a*x + w*y", "y": "-a*y - w*x"},
}


def two_bumps(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Two bumps in x and y, which are no function of x times y, nor one of y times x."""
    return 1.5 * np.exp(-(((x - 0.4) / 0.5) ** 2) - ((y - 0.5) / 0.4) ** 2) - 1.2 * np.exp(
        -(((x + 0.5) / 0.4) ** 2) - ((y - 0.3) / 0.5) ** 2
    )


@pytest.mark.slow
def test_what_depends_on_two_coordinates_gets_a_surface(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    t = np.arange(0, 6, 0.1)
    begin = rng.uniform(-1.5, 1.5, size=(2, 10))
    x, y = course(
        lambda t, s: np.stack([-0.2 * s[0] + 2.0 * s[1] + two_bumps(*s), -0.2 * s[1] - 2.0 * s[0]]), begin, t,
        within=8,
    ).transpose(1, 2, 0)  # fmt: skip
    noisy = {name: each + 0.01 * rng.normal(size=each.shape) for name, each in (("x", x), ("y", y))}
    # Names that act on a state, in the place of all.
    kept = {"linear coupling", "nonlinear coupling", "quadratic drag", "cubic damping", "constant bias"}
    without = [each.name for each in standard_dictionary() if each.name not in {*kept, "process noise"}]
    case = ForeignCase(CARD, table_of(t, noisy), {"without": without}).read(tmp_path)
    verdict = solve_case(case).statement.as_data()
    assert verdict["outcome"] == "modelled"
    (part,) = verdict["described"]
    assert part["kind"] == "surface" and part["coordinates"] == ["x", "y"]
    assert verdict["location"]["coordinate"] == "x, y" and list(verdict["location"]["equations"]) == ["x"]
    assert verdict["fit"]["augmented"] < 0.3 * verdict["fit"]["recalibrated"]
    surface = part["surface"]
    x, y = np.meshgrid(*map(np.array, surface["at"]), indexing="ij")
    value = np.array(surface["value"])
    near = (np.abs(x) < 0.8) & (np.abs(y) < 0.8)
    assert np.sqrt(np.mean((value - two_bumps(x, y))[near] ** 2)) < 0.15
    figure = plot_described(verdict["described"], units={"x": "mm"}, time_unit="s")
    assert figure is not None
    assert figure.axes[0].get_xlabel() == "$x$ (mm)"
    assert figure.axes[1].get_ylabel() == "added in the equation of $x$"
