"""Which tests has a formula of either scope, and what do all tests of a run come to?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from siq.certificate.certificates import Certificate
from siq.certificate.characteristics import SHARE, Reference, check_characteristics
from siq.certificate.descent import check_descent
from siq.certificate.held_out import HeldOut
from siq.certificate.tests import (
    Candidate,
    CertificateOptions,
    Verdict,
    check_branch,
    check_hamilton_jacobi,
    stated_error,
)
from siq.dynamics.phase_portrait import PhasePortrait
from siq.identify.given_field import AnyField, GivenField
from siq.identify.identified_field import IdentifiedField
from siq.potential.well import Well

ALONE = "only one of the two routes that the study names led to a formula"
HARMLESS = 1e-6  # a difference of the routes that no error needs to explain


def common_tests(
    candidate: Candidate,
    found: AnyField,
    held_out: HeldOut,
    references: Sequence[Reference],
    options: CertificateOptions,
    error: float,
    level: float,
    seed: int,
) -> tuple[dict[str, Verdict], float]:
    """The tests of either scope, and the error to be stated after them."""
    followed, error, _ = check_characteristics(
        candidate, found, references, error=error, options=options, level=level, seed=seed
    )
    tests = {
        "hamilton_jacobi": check_hamilton_jacobi(candidate, found, limit=options.hamilton_jacobi),
        "branch": check_branch(candidate, found, limit=options.branch, seed=seed),
    }
    if held_out.pairs is not None and not isinstance(found, GivenField):
        tests["descent"] = check_descent(candidate, found, held_out.pairs, options=options, error=error)
    tests["characteristics"] = followed
    return tests, error


def concluded(
    tests: dict[str, Verdict], error: float, portrait: PhasePortrait, scope: str, tested_on: str
) -> Certificate:
    """The certificate of tests by name, with whatever is wrong with the phase portrait as a fault of them."""
    fault = portrait.fault()
    if fault is not None:
        limit = tests["branch"].limit if "branch" in tests else 0.0
        tests["branch"] = Verdict(np.inf, limit, False, fault)
    refused = [verdict.reason for verdict in tests.values() if not verdict.passed]
    return Certificate(tests, error, "; ".join(dict.fromkeys(refused)), scope, tested_on)


def worse_of(one: Verdict | None, two: Verdict) -> Verdict:
    """Of two verdicts of one test the one that decides."""
    if one is None:
        return two
    return max(one, two, key=lambda verdict: (not verdict.passed, verdict.value / (verdict.limit or 1.0)))


def same_place(one: np.ndarray, two: np.ndarray) -> bool:
    """Whether two attractors are one: both are the same root of the same f."""
    return np.array_equal(one, two)


def candidate_of_well(well: Well, portrait: PhasePortrait, points: np.ndarray) -> Candidate:
    """V of a well, to be tested on points ``(n, d)``."""
    mine = [one for one in portrait.attractors if same_place(one.position, well.attractor)]
    return Candidate(well.values, well.gradients, well.hessians, None, points, mine)


def sublevel_points(wells: Sequence[Well]) -> list[np.ndarray]:
    """Points of the fit of each well, below a share of its level: where two routes are compared."""
    return [well.points[well.values(well.points) < SHARE * well.level] for well in wells]


def error_of_well(well: Well, found: IdentifiedField, portrait: PhasePortrait, seed: int) -> float:
    """The error of V that is stated of a well, over the points of its fit."""
    return stated_error(candidate_of_well(well, portrait, sublevel_points([well])[0]), found, seed=seed)[0]


def explained_difference(options: CertificateOptions, *errors: float) -> float:
    """Difference of two routes that their errors explain; one that cannot be stated explains nothing."""
    return HARMLESS + sum(min(error, options.error) for error in errors)
