"""Tests of a certificate one by one: characteristics, descent, existence, and the error that is stated."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import sympy
from known_systems import (
    KnownSystem,
    archetype,
    double_well,
    exact_field,
    linear_system,
    maier_stein,
    portrait_of,
    potential_gradient,
    potential_values,
    uniform_points,
)
from scipy.special import ndtr

from siq.data.recordings import SnapshotPairs
from siq.inference.field_estimate import FieldEstimate, Verdict
from siq.quasipotential.certificate import Certificate, _follow_well
from siq.quasipotential.certificate_tests import (
    LEVEL_SHARE,
    MIN_POINTS,
    SAFETY_FACTOR,
    Candidate,
    CertificateOptions,
    Reference,
    _check_characteristics,
    _check_descent,
    _lost_shares,
    _residual_integral,
    check_existence,
)
from siq.systems.dynamics import Dynamics
from siq.systems.phase_portrait import PhasePortrait, phase_portrait

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
    assert not found.fault and len(found.values) >= MIN_POINTS
    assert np.linalg.norm(found.values - exact) < found.error * np.linalg.norm(exact)
    assert found.error < 2e-5
    assert (found.values <= LEVEL_SHARE * found.level * (1 + 1e-9)).all()


@pytest.mark.parametrize("name", SADDLES)
def test_their_level_is_v_of_the_saddle_that_nobody_told_them(name: str) -> None:
    assert reference_of_name(name).level == pytest.approx(SADDLES[name], rel=0.05)


@pytest.mark.parametrize(("factor", "passes"), [(1.0, True), (1.01, True), (1.03, False), (-1.0, False)])
def test_v_has_to_be_theirs_within_the_error_that_is_stated(factor: float, passes: bool) -> None:
    known = maier_stein(1)
    # What is stated is 0.02 or, where V is off by more, what its own residual tells; that may be 0.15.
    options = replace(OPTIONS, error=0.02)
    candidate = candidate_of(known, reference_of_name("Maier-Stein"), factor=factor)
    verdict, error = _check_characteristics(candidate, exact_field(known, 3), options, error=0.02)
    assert verdict.passed is passes and error >= 0.02
    assert verdict.value == pytest.approx(abs(factor - 1), abs=1e-5)
    assert ("most of all at" in verdict.reason) is not passes


def test_an_error_that_a_region_hides_is_stated() -> None:
    known = maier_stein(1)
    candidate = candidate_of(known, reference_of_name("Maier-Stein"), factor=1.01)
    verdict, error = _check_characteristics(candidate, exact_field(known, 3), OPTIONS, error=1e-6)
    assert verdict.passed
    assert error >= 0.01


def test_a_formula_answers_up_to_the_level_that_it_claims() -> None:
    known = maier_stein(1)
    low = reference_of_name("Maier-Stein").below(0.1)[1]
    assert len(low) and low.max() <= LEVEL_SHARE * 0.1
    candidate = candidate_of(known, reference_of_name("Maier-Stein"), level=1e-9)
    verdict, _ = _check_characteristics(candidate, exact_field(known, 3), OPTIONS, error=1e-6)
    assert not verdict.passed and "the level is too low" in verdict.reason


def test_what_is_too_stiff_is_told() -> None:
    x, y = sympy.symbols("x y", real=True)
    known = double_well(2)
    stiff = replace(known.dynamics, equations=(known.dynamics.equations[0], -20_000 * (y - x / 2)))
    found = _follow_well(stiff, portrait_of(known, 300, share=0.6), 0)
    assert "characteristics" in found.fault and "from the attractor (−1.05, " in found.fault
    verdict, _ = _check_characteristics(
        candidate_of(known, found), exact_field(known, 3), OPTIONS, error=1e-6
    )
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
    verdict, error = _check_characteristics(candidate_of(known), exact_field(known, 3), OPTIONS, error=1e-6)
    assert not verdict.passed and error == 1e-6


pytestmark = pytest.mark.portable

NOISE = 0.02  # ε: the noise per unit of time is ε D


def with_pairs(known: KnownSystem, pairs: SnapshotPairs, factor: float = 1.0) -> Candidate:
    portrait = portrait_of(known, 300, share=0.6)
    return Candidate(
        values=lambda at: factor * potential_values(known, at),
        gradients=lambda at: factor * potential_gradient(known, at),
        hessians=lambda at: np.zeros((*at.shape, at.shape[1])),
        circulatory=None,
        points=uniform_points(known, 200, share=0.6),
        attractors=portrait.attractors,
        pairs=pairs,
    )


def pairs_of(
    known: KnownSystem, *, h: float = 0.01, noise: float = 0.0, count: int = 4000, sign: float = 1.0
) -> SnapshotPairs:
    """Pairs from all over the region, by a hundred small steps each; `sign` -1 is a motion uphill."""
    x0 = uniform_points(known, count, seed=3, share=0.6)
    draw, x, steps = np.random.default_rng(4), x0, 100
    factor = np.linalg.cholesky(known.diffusion)
    for _ in range(steps):
        x = x + sign * known.dynamics.drift(x) * h / steps
        if noise:
            x = x + np.sqrt(noise * h / steps) * draw.normal(size=x.shape) @ factor.T
    return SnapshotPairs(x0, x, np.full(count, h), np.arange(count))


@pytest.mark.parametrize("build", [lambda: archetype(2), lambda: maier_stein(1)])
def test_without_noise_the_true_v_falls_along_every_pair(build: Callable[[], KnownSystem]) -> None:
    known = build()
    verdict = _check_descent(with_pairs(known, pairs_of(known)), exact_field(known, 3), OPTIONS)
    assert verdict.passed and verdict.value == 0


def test_it_is_the_recorded_motion_that_counts_and_not_the_identified_f() -> None:
    known = maier_stein(1)
    # f is the right one, and ∇V·f < 0 everywhere; the recordings go the other way.
    verdict = _check_descent(with_pairs(known, pairs_of(known, sign=-1.0)), exact_field(known, 3), OPTIONS)
    assert not verdict.passed and verdict.value > 0.9
    assert verdict.reason == "V does not fall along the recordings"


def test_a_share_of_the_pairs_may_rise() -> None:
    known = maier_stein(1)
    down, up = pairs_of(known), pairs_of(known, sign=-1.0)
    xh = np.where((np.arange(len(down.h)) % 50 == 0)[:, None], up.xh, down.xh)
    mixed = SnapshotPairs(down.x0, xh, down.h, down.recording)
    for limit, passes in [(0.05, True), (0.01, False)]:
        verdict = _check_descent(
            with_pairs(known, mixed), exact_field(known, 3), CertificateOptions(descent=limit)
        )
        assert verdict.value == pytest.approx(0.02, abs=2e-3)
        assert verdict.passed is passes


@pytest.mark.parametrize(
    ("factor", "passes"), [(1.0, True), (0.5, False), (2.0, False), (-1.0, False), (0.0, False)]
)
def test_with_noise_v_falls_in_the_mean_as_fast_as_it_has_to(factor: float, passes: bool) -> None:
    known = maier_stein(1)
    found = exact_field(known, 3, relative_error=np.sqrt(NOISE))
    verdict = _check_descent(
        with_pairs(known, pairs_of(known, noise=NOISE), factor), found, OPTIONS, error=1e-3
    )
    assert verdict.passed is passes, (verdict.value, verdict.limit)
    assert (verdict.value <= verdict.limit) is passes


def test_longer_steps_change_the_mean_by_as_much_as_is_allowed_for() -> None:
    known = maier_stein(1)
    found = exact_field(known, 3, relative_error=np.sqrt(NOISE))
    pairs = pairs_of(known, h=0.1, noise=NOISE, count=10_000)
    assert _check_descent(with_pairs(known, pairs), found, OPTIONS).passed


def test_too_few_pairs_are_no_test() -> None:
    known = maier_stein(1)
    verdict = _check_descent(with_pairs(known, pairs_of(known, count=20)), exact_field(known, 3), OPTIONS)
    assert not verdict.passed and "only 20 pairs" in verdict.reason


X, Y = sympy.symbols("x y", real=True)
CHANCE = 4 / np.sqrt(4 * 200)  # four standard deviations of a share of 200 draws, at most


def two_wells(height: float, error: float) -> tuple[FieldEstimate, PhasePortrait]:
    """f = (a x - x³, -y) with a = `height` ± `error`: two wells for a > 0 and one for a < 0."""
    dynamics = Dynamics.of((X, Y), (height * X - X**3, -Y))
    known = KnownSystem(dynamics, None, np.zeros((2, 2)), np.array([[-1.0, 1.0], [-1.0, 1.0]]))
    found = exact_field(known, degree=3, relative_error=0.01)
    covariance = found.covariance.copy()
    place = next(row for row, (i, k) in enumerate(found.support) if i == 0 and found.library.terms[k] == X)
    covariance[place, place] = error**2
    portrait = phase_portrait(dynamics, uniform_points(known, 500))
    return replace(found, covariance=covariance), portrait


@pytest.mark.parametrize("ratio", [1.0, 1.5, 3.0])
def test_the_share_of_lost_wells_is_the_probability_that_there_is_none(ratio: float) -> None:
    found, portrait = two_wells(0.2, 0.2 / ratio)
    shares = _lost_shares(found, portrait.equilibria, box=portrait.box)
    assert len(shares) == 3
    assert shares == pytest.approx(np.full(3, ndtr(-ratio)), abs=CHANCE / 2)


def test_wells_that_the_data_may_do_without_are_not_certified() -> None:
    found, portrait = two_wells(0.2, 0.15)
    verdict = check_existence(found, portrait)
    assert not verdict.passed
    assert "record more" in verdict.reason


def test_wells_that_are_sure_pass() -> None:
    found, portrait = two_wells(0.2, 0.04)
    assert check_existence(found, portrait).passed


def test_rivals_of_the_terms_count() -> None:
    found, portrait = two_wells(0.2, 0.01)
    doubt = np.zeros((1, found.library.size, 2))
    doubt[0, list(found.library.terms).index(X), 0] = 0.2
    shares = _lost_shares(
        replace(found, alternatives=(0 * doubt[0], doubt)), portrait.attractors, box=portrait.box
    )
    assert shares == pytest.approx(np.full(2, ndtr(-1.0)), abs=CHANCE / 2)


def test_without_noise_everything_exists() -> None:
    found, portrait = two_wells(0.2, 0.2)
    sure = replace(found, residual_ratio=1e-9)
    assert check_existence(sure, portrait).value == 0


def test_without_equilibria_nothing_is_asked() -> None:
    found, portrait = two_wells(0.2, 0.2)
    empty = replace(portrait, attractors=(), saddles=())
    assert check_existence(found, empty).passed


Gradient = Callable[[np.ndarray], np.ndarray]


def integral(known: KnownSystem, gradient: Gradient, x: np.ndarray) -> np.ndarray:
    rates = [np.linalg.eigvals(known.dynamics.jacobian(one[None])[0]).real for one in known.attractors]
    return _residual_integral(
        gradient, known.dynamics, x, box=known.domain,
        slowest=-max(rate.max() for rate in rates),
        fastest=float(np.linalg.norm(known.dynamics.jacobian(x), axis=(1, 2)).max()),
    )  # fmt: skip


def right_well(known: KnownSystem, count: int = 150) -> np.ndarray:
    """Points below nine tenths of the saddle of the archetype or of Maier–Stein, on the right."""
    x = uniform_points(known, 4000)
    top = potential_values(known, np.zeros((1, x.shape[1])))[0]
    return x[(potential_values(known, x) < 0.9 * top) & (x[:, 0] > 0)][:count]


@pytest.mark.parametrize("known", [archetype(3), maier_stein(1)], ids=["archetype", "Maier-Stein"])
def test_the_exact_v_has_no_error(known: KnownSystem) -> None:
    found = integral(known, lambda x: potential_gradient(known, x), right_well(known))
    assert found.max() < 1e-9


@pytest.mark.parametrize("dimension", [2, 3, 4])
def test_linear_systems_have_no_error(dimension: int) -> None:
    known = linear_system(dimension)
    found = integral(known, lambda x: potential_gradient(known, x), uniform_points(known, 100))
    assert found.max() < 1e-8 * potential_values(known, uniform_points(known, 100)).max()


@pytest.mark.parametrize("size", [0.003, 0.01, 0.03])
@pytest.mark.parametrize("known", [archetype(3), maier_stein(1)], ids=["archetype", "Maier-Stein"])
def test_the_bound_lies_above_the_true_error(known: KnownSystem, size: float) -> None:
    x = right_well(known)

    def wrong(points: np.ndarray) -> np.ndarray:
        y, slope = points - known.attractors[1], potential_gradient(known, points)
        # The gradient of size·(sin(2y₁) - 2y₁ + y₁²y₂), which is flat at the attractor.
        bump = np.zeros_like(points)
        bump[:, 0] = 2 * np.cos(2 * y[:, 0]) - 2 + 2 * y[:, 0] * y[:, 1]
        bump[:, 1] = y[:, 0] ** 2
        return slope + size * bump

    y = x - known.attractors[1]
    error = size * np.abs(np.sin(2 * y[:, 0]) - 2 * y[:, 0] + y[:, 0] ** 2 * y[:, 1])
    bound = SAFETY_FACTOR * integral(known, wrong, x)
    assert np.linalg.norm(bound) > np.linalg.norm(error)
    assert (bound > 0.9 * error).mean() > 0.9
    assert np.linalg.norm(bound) < 40 * np.linalg.norm(error)


@pytest.mark.parametrize("factor", [0.98, 1.02, 1.1])
@pytest.mark.parametrize("known", [linear_system(2), archetype(3)], ids=["linear", "archetype"])
def test_a_v_that_is_wrong_by_a_factor_is_bounded(known: KnownSystem, factor: float) -> None:
    x = right_well(known) if len(known.attractors) == 2 else uniform_points(known, 150)
    bound = SAFETY_FACTOR * integral(known, lambda points: factor * potential_gradient(known, points), x)
    error = np.abs(factor - 1) * potential_values(known, x)
    assert np.linalg.norm(bound) > np.linalg.norm(error)
    assert np.linalg.norm(bound) < 20 * np.linalg.norm(error)


def test_paths_that_run_away_are_infinite() -> None:
    known = maier_stein(1)
    found = integral(known, lambda x: -potential_gradient(known, x), right_well(known))
    assert not np.isfinite(found).any()


@pytest.mark.parametrize("known", [linear_system(2), archetype(3)], ids=["linear", "archetype"])
@pytest.mark.parametrize("shift", [0.003, 0.03, 0.1])
def test_a_minimum_beside_the_attractor_does_not_count_for_as_long_as_paths_rest_there(
    known: KnownSystem, shift: float
) -> None:
    """V moved as a whole, as by noise: the bound is of the size of the shift, and no multiple of time."""
    attractor = portrait_of(known, 300, share=0.6).attractors[-1]
    x = right_well(known) if len(known.attractors) == 2 else uniform_points(known, 150)
    moved = Candidate(
        lambda at: potential_values(known, at - shift), lambda at: potential_gradient(known, at - shift),
        lambda at: at, None, x, [attractor],
    )  # fmt: skip
    exact = potential_values(known, x) - potential_values(known, attractor.position[None])
    error = moved.values(x) - moved.values(attractor.position[None]) - exact
    true = np.linalg.norm(error) / np.linalg.norm(exact)
    assert true < moved.stated_error(exact_field(known, 3)) < 8 * true


def test_other_units_give_the_same_bound() -> None:
    known, units = maier_stein(1), np.array([1e-3, 50.0])
    x = right_well(known)
    x = np.concatenate([x, [[0.9, 1.4]]])
    back = {s: s / float(u) for s, u in zip(known.dynamics.symbols, units, strict=True)}
    scaled = Dynamics.of(
        known.dynamics.symbols,
        tuple(
            u * f.subs(back, simultaneous=True) for u, f in zip(units, known.dynamics.formulas, strict=True)
        ),
        diffusion=np.diag(units**2),
    )

    def wrong(points: np.ndarray) -> np.ndarray:
        return 1.1 * potential_gradient(known, points) * [1.0, 0.8]

    options = {"slowest": 2.0, "fastest": 10.0}
    one = _residual_integral(wrong, known.dynamics, x, box=known.domain, **options)
    two = _residual_integral(
        lambda points: wrong(points / units) / units,
        scaled,
        x * units,
        box=known.domain * units[:, None],
        **options,
    )
    np.testing.assert_allclose(two, one, rtol=1e-6)


@pytest.mark.parametrize("units", [np.ones(2), np.array([1.0, 1e4])], ids=["one", "ten thousand"])
def test_a_path_has_run_away_in_whatever_units_the_other_state_is(units: np.ndarray) -> None:
    # Upwards in time x falls by x' = -x as it should, and y drifts off by 2 a unit of time.
    x, y = sympy.symbols("x y", real=True)
    dynamics = Dynamics.of((x, y), (-x * float(units[0]) / float(units[0]), y * 0 + 2 * float(units[1])))
    starts = np.array([[0.5, 0.5], [0.2, -0.5]]) * units
    found = _residual_integral(
        lambda points: np.column_stack([points[:, 0], np.zeros(len(points))]), dynamics, starts,
        box=np.array([[-1.0, 1.0], [-1.0, 1.0]]) * units[:, None], slowest=1.0, fastest=1.0,
    )  # fmt: skip
    assert not np.isfinite(found).any()
