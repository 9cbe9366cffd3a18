"""Recorded motion against V: it falls from sample to sample, or in the mean over the noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from known_systems import (
    KnownSystem,
    archetype,
    exact_field,
    maier_stein,
    portrait_of,
    potential_gradient,
    potential_values,
    uniform_points,
)

from siq.data.recordings import SnapshotPairs
from siq.quasipotential.certificate_tests import Candidate, CertificateOptions, check_descent

pytestmark = pytest.mark.portable

OPTIONS = CertificateOptions()
NOISE = 0.02  # ε: the noise per unit of time is ε D


def candidate_of(known: KnownSystem, pairs: SnapshotPairs, factor: float = 1.0) -> Candidate:
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
    verdict = check_descent(candidate_of(known, pairs_of(known)), exact_field(known, 3), OPTIONS)
    assert verdict.passed and verdict.value == 0


def test_it_is_the_recorded_motion_that_counts_and_not_the_identified_f() -> None:
    known = maier_stein(1)
    # f is the right one, and ∇V·f < 0 everywhere; the recordings go the other way.
    verdict = check_descent(candidate_of(known, pairs_of(known, sign=-1.0)), exact_field(known, 3), OPTIONS)
    assert not verdict.passed and verdict.value > 0.9
    assert verdict.reason == "V does not fall along the recordings"


def test_a_share_of_the_pairs_may_rise() -> None:
    known = maier_stein(1)
    down, up = pairs_of(known), pairs_of(known, sign=-1.0)
    xh = np.where((np.arange(len(down.h)) % 50 == 0)[:, None], up.xh, down.xh)
    mixed = SnapshotPairs(down.x0, xh, down.h, down.recording)
    for limit, passes in [(0.05, True), (0.01, False)]:
        verdict = check_descent(
            candidate_of(known, mixed), exact_field(known, 3), CertificateOptions(descent=limit)
        )
        assert verdict.value == pytest.approx(0.02, abs=2e-3)
        assert verdict.passed is passes


@pytest.mark.parametrize(
    ("factor", "passes"), [(1.0, True), (0.5, False), (2.0, False), (-1.0, False), (0.0, False)]
)
def test_with_noise_v_falls_in_the_mean_as_fast_as_it_has_to(factor: float, passes: bool) -> None:
    known = maier_stein(1)
    found = exact_field(known, 3, relative_error=np.sqrt(NOISE))
    verdict = check_descent(
        candidate_of(known, pairs_of(known, noise=NOISE), factor), found, OPTIONS, error=1e-3
    )
    assert verdict.passed is passes, (verdict.value, verdict.limit)
    assert (verdict.value <= verdict.limit) is passes


def test_longer_steps_change_the_mean_by_as_much_as_is_allowed_for() -> None:
    known = maier_stein(1)
    found = exact_field(known, 3, relative_error=np.sqrt(NOISE))
    pairs = pairs_of(known, h=0.1, noise=NOISE, count=10_000)
    assert check_descent(candidate_of(known, pairs), found, OPTIONS).passed


def test_too_few_pairs_are_no_test() -> None:
    known = maier_stein(1)
    verdict = check_descent(candidate_of(known, pairs_of(known, count=20)), exact_field(known, 3), OPTIONS)
    assert not verdict.passed and "only 20 pairs" in verdict.reason
