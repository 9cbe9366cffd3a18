"""Which tests has one formula for each attractor to pass, and on which points?

`siq.certificate.tests` has the tests themselves; one formula for the whole region is certified by
`siq.certificate.certify`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from siq.certificate.certificates import Certificate, position_text
from siq.certificate.characteristics import Reference
from siq.certificate.common_tests import (
    ALONE,
    candidate_of_well,
    common_tests,
    concluded,
    error_of_well,
    explained_difference,
    same_place,
    sublevel_points,
    worse_of,
)
from siq.certificate.existence import check_existence
from siq.certificate.held_out import HeldOut, part_of
from siq.certificate.regions import basin_region
from siq.certificate.tests import (
    ERROR_POINTS,
    STATED,
    CertificateOptions,
    Verdict,
    check_agreement,
    check_error,
    stated_error,
)
from siq.dynamics.phase_portrait import PhasePortrait
from siq.identify.given_field import AnyField, GivenField
from siq.potential.refinement import Refined
from siq.potential.uncertainty import relative_error
from siq.potential.well import Well

LEAST_CLAIMED = 0.5  # of the states in a well: a formula that holds at fewer is none of the well (a choice)


def certify_wells(
    refined: Refined,
    portrait: PhasePortrait,
    held_out: HeldOut,
    *,
    options: CertificateOptions,
    prediction: Verdict,
    references: Sequence[Reference],
    compared: bool = True,
    seed: int = 0,
) -> Certificate:
    """Certificate of one formula for each attractor, the worst of them deciding.

    The Hessian of the local route is M by construction, so that its branch test passes by itself; what tests
    it are the characteristics. Each formula is tested on held-out states of its own well where it claims to
    hold, and it has to claim more than half of them.
    """
    found = refined.found
    wells = refined.wells or refined.network_wells
    each = _of_each(wells, found, portrait, held_out, options, references, seed)
    tests, error = each.tests, each.error
    if portrait.attractors:
        tests["existence"] = check_existence(found, portrait, seed=seed)
    if refined.wells and refined.network_wells:
        pairs = [
            (one, two)
            for one in refined.network_wells
            for two in refined.wells
            if same_place(one.attractor, two.attractor)
        ]
        for one, two in pairs:
            its = error_of_well(one, found, portrait, seed)
            verdict = check_agreement(
                one.values, [two], sublevel_points([two]), limit=explained_difference(options, error, its)
            )
            tests["agreement"] = worse_of(tests.get("agreement"), verdict)
        if len(pairs) < len(portrait.attractors):
            tests["agreement"] = Verdict(
                np.inf, 0.0, False, "the network route found no formula for some well"
            )
    elif compared:
        tests["agreement"] = Verdict(np.inf, 0.0, False, ALONE)
    tests["prediction"] = prediction
    return concluded(tests, error, portrait, "wells", each.tested_on)


def certify_given_wells(
    wells: Sequence[Well],
    found: GivenField,
    portrait: PhasePortrait,
    points: np.ndarray,
    *,
    options: CertificateOptions,
    references: Sequence[Reference],
    seed: int = 0,
) -> Certificate:
    """Certificate of one formula for each attractor of given equations, the worst of them deciding.

    Nothing was recorded: what tests predictions, motion, and whether uncertain wells exist has no object. The
    others are those of `certify_wells`.

    Parameters
    ----------
    wells
        V about the attractors.
    found, portrait
        f and D, and what follows from them.
    points
        States of the domain that no fit saw, shape ``(n, d)``.
    options, references, seed
        As for `certify_wells`.
    """
    each = _of_each(wells, found, portrait, HeldOut(points, None), options, references, seed)
    return concluded(each.tests, each.error, portrait, "wells", each.tested_on)


@dataclass(frozen=True)
class _OfEach:
    """Tests of one formula for each attractor, the worst verdict of each test, and the error to be stated."""

    tests: dict[str, Verdict]
    error: float
    tested_on: str


def _of_each(
    wells: Sequence[Well],
    found: AnyField,
    portrait: PhasePortrait,
    held_out: HeldOut,
    options: CertificateOptions,
    references: Sequence[Reference],
    seed: int,
) -> _OfEach:
    tests: dict[str, Verdict] = {}
    error = 0.0 if wells else np.inf
    own_error, from_field = error, 0.0
    tested = []
    advice = "" if isinstance(found, GivenField) else "record more there, or "
    for well in wells:
        own = [
            place for place, one in enumerate(portrait.attractors) if same_place(one.position, well.attractor)
        ]
        mine = [one for one in references if same_place(one.attractor, well.attractor)]
        part = part_of(held_out, well, basin_region(portrait, own[0]), mine[0] if mine else None)
        tested.append(part.described)
        if part.claimed < LEAST_CLAIMED:
            reason = (
                f"V claims to hold at {part.claimed:.0%} of the held-out states in the well about"
                f" {position_text(well.attractor)}: {advice}raise refinement.degrees"
            )
            tests["hamilton_jacobi"] = Verdict(np.inf, options.hamilton_jacobi, False, reason)
            error = own_error = np.inf
            continue
        candidate = candidate_of_well(well, portrait, part.points)
        its, _ = stated_error(candidate, found, seed=seed)
        # Characteristics follow the same f: what f's uncertainty adds explains no difference from them.
        made, its = common_tests(candidate, found, part, mine, options, its, well.level, seed)
        uncertain = STATED * _error_from_field(well, found, part.points, seed)
        own_error, from_field = max(own_error, its), max(from_field, uncertain)
        its += uncertain
        for name, verdict in made.items():
            tests[name] = worse_of(tests.get(name), verdict)
        error = max(error, its)
    missing = len(portrait.attractors) - len(wells)
    if missing or not wells:
        reason = f"{missing} of {len(portrait.attractors)} attractors have no formula"
        tests["branch"] = Verdict(np.inf, options.branch, False, reason)
    tests["error"] = check_error(own_error, limit=options.error, from_field=from_field)
    return _OfEach(tests, error, "; ".join(dict.fromkeys(tested)))


def _error_from_field(well: Well, found: AnyField, points: np.ndarray, seed: int) -> float:
    """Relative standard error of V over points, from what is not known of f."""
    generator = np.random.default_rng(seed)
    x = points[generator.choice(len(points), min(ERROR_POINTS, len(points)), replace=False)]
    return relative_error(found, well.gradients, well.attractor, x, well.values(x))
