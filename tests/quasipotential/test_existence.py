from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy
from known_systems import KnownSystem, exact_field, uniform_points
from scipy.special import ndtr

from siq.inference.field_estimate import IdentifiedField
from siq.inference.selection import RivalTerms
from siq.quasipotential.certificate_tests import _lost_shares, check_existence
from siq.systems.dynamics import Dynamics
from siq.systems.phase_portrait import PhasePortrait, phase_portrait

X, Y = sympy.symbols("x y", real=True)
CHANCE = 4 / np.sqrt(4 * 200)  # four standard deviations of a share of 200 draws, at most


def two_wells(height: float, error: float) -> tuple[IdentifiedField, PhasePortrait]:
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
        replace(found, rivals=RivalTerms(0 * doubt[0], doubt)), portrait.attractors, box=portrait.box
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
