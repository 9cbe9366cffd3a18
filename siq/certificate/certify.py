"""Certificates of the formulas of a run: which tests apply to each, and on which points.

`siq.certificate.tests` has the tests themselves. No formula is certified without one that shares nothing with
its fit but f: `INDEPENDENT` names those.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from siq.certificate.characteristics import SHARE, Reference, check_characteristics
from siq.certificate.descent import check_descent
from siq.certificate.existence import check_existence
from siq.certificate.held_out import HeldOut, part_of
from siq.certificate.regions import basin_region
from siq.certificate.tests import (
    ERROR_POINTS,
    STATED,
    Candidate,
    CertificateOptions,
    Verdict,
    check_agreement,
    check_branch,
    check_error,
    check_hamilton_jacobi,
    check_identity,
    stated_error,
)
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import compile_formulas
from siq.dynamics.phase_portrait import PhasePortrait
from siq.identify.given_field import AnyField, GivenField
from siq.identify.identified_field import IdentifiedField
from siq.potential.refinement import Refined
from siq.potential.symbolic import SymbolicDecomposition
from siq.potential.uncertainty import relative_error
from siq.potential.well import Well
from siq.reference.sheets import adapted_fan, first_caustic

INDEPENDENT = ("characteristics",)  # tests of V that share nothing with a fit of V but f and D
ALONE = "only one of the two routes that the study names led to a formula"
NOTICEABLE = 1e-3  # a stated error above this is worth an explanation
FAN = 512  # characteristics in search of a caustic
FAN_TOLERANCE = 1e-7  # of their steps: what is said of a caustic has four digits
FAN_SPACING = 0.1  # of points along them, the level being at 1: a caustic between two of them is located
LEAST_CLAIMED = 0.5  # of the states in a well: a formula that holds at fewer is none of the well (a choice)
HARMLESS = 1e-6  # a difference of the routes that no error needs to explain


@dataclass(frozen=True)
class Certificate:
    """Whether a method's formulas may be believed, and why.

    Attributes
    ----------
    tests
        By name.
    error
        Relative error of V that has to be stated; infinite where unknown.
    reason
        What refused it, or what to know of it, in words.
    scope
        ``region``: one formula for the recorded region; ``wells``: one for each attractor.
    tested_on
        The points, in words.
    """

    tests: Mapping[str, Verdict]
    error: float
    reason: str
    scope: str = "region"
    tested_on: str = ""

    @property
    def independent(self) -> tuple[str, ...]:
        """The tests made that share nothing with the fit of V but f and D."""
        return tuple(name for name in INDEPENDENT if name in self.tests)

    @property
    def certified(self) -> bool:
        """Whether every test passed, one of them an independent one."""
        return bool(self.independent) and all(verdict.passed for verdict in self.tests.values())

    def as_data(self) -> dict[str, Any]:
        """As it stands in model.json."""
        return {
            "certified": self.certified,
            "scope": self.scope,
            "stated_error": float(self.error) if np.isfinite(self.error) else None,
            "reason": self.reason,
            "tested_on": self.tested_on,
            "independent": list(self.independent),
            "tests": {name: verdict.as_data() for name, verdict in self.tests.items()},
        }


def certify_formulas(
    formulas: SymbolicDecomposition,
    found: IdentifiedField,
    portrait: PhasePortrait,
    held_out: HeldOut,
    *,
    options: CertificateOptions,
    prediction: Verdict,
    references: Sequence[Reference],
    relative_error: float = 0.0,
    wells: Sequence[Well] = (),
    compared: bool = False,
    seed: int = 0,
) -> Certificate:
    """Certificate of one formula for the whole region.

    Parameters
    ----------
    formulas
        V and g.
    found, portrait
        F, identified without V, and the phase portrait that follows from it.
    held_out
        States and pairs of the region for which the formula claims to hold.
    options
        The limits.
    prediction
        The verdict on f.
    references
        V by characteristics about every attractor.
    relative_error
        Relative standard error of V from the uncertainty of f.
    wells
        By the local route, to be compared with.
    compared
        Whether both routes were asked for: then a formula that only one of them found is refused.
    seed
        Draws of f, and the points on which the error is estimated.
    """
    candidate = _of_formulas(formulas, held_out.points, portrait, relative_error)
    return _certify(
        candidate, found, portrait, held_out, options=options, prediction=prediction,
        references=references, wells=wells, compared=compared, seed=seed,
    )  # fmt: skip


def _certify(
    candidate: Candidate,
    found: IdentifiedField,
    portrait: PhasePortrait,
    held_out: HeldOut,
    *,
    options: CertificateOptions,
    prediction: Verdict,
    references: Sequence[Reference],
    wells: Sequence[Well],
    compared: bool,
    seed: int,
) -> Certificate:
    error, worst = stated_error(candidate, found, seed=seed)
    tests, error, place = _common(candidate, found, held_out, references, options, error, np.inf, seed)
    worst = worst if place is None else place
    tests["identity"] = check_identity(candidate, found, limit=options.identity)
    from_field = STATED * candidate.relative_error
    tests["error"] = check_error(error - from_field, limit=options.error, from_field=from_field)
    if portrait.attractors:
        tests["existence"] = check_existence(found, portrait, seed=seed)
    if wells:
        # The local route shares the error of f, and has the rest of its own.
        own = [_error_of(well, found, portrait, seed)[0] for well in wells]
        tests["agreement"] = check_agreement(
            candidate.values, wells, _sublevel_points(wells),
            limit=_explained(options, error, max(own)) + 6 * candidate.relative_error,
        )  # fmt: skip
    elif compared:
        tests["agreement"] = Verdict(np.inf, 0.0, False, ALONE)
    tests["prediction"] = prediction
    return _conclude(tests, error, worst, portrait, "region", held_out.described)


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
    tests, error, worst = each.tests, each.error, each.worst
    if portrait.attractors:
        tests["existence"] = check_existence(found, portrait, seed=seed)
    if refined.wells and refined.network_wells:
        pairs = [
            (one, two)
            for one in refined.network_wells
            for two in refined.wells
            if _same(one.attractor, two.attractor)
        ]
        for one, two in pairs:
            its = _error_of(one, found, portrait, seed)[0]
            verdict = check_agreement(
                one.values, [two], _sublevel_points([two]), limit=_explained(options, error, its)
            )
            tests["agreement"] = _worse(tests.get("agreement"), verdict)
        if len(pairs) < len(portrait.attractors):
            tests["agreement"] = Verdict(
                np.inf, 0.0, False, "the network route found no formula for some well"
            )
    elif compared:
        tests["agreement"] = Verdict(np.inf, 0.0, False, ALONE)
    tests["prediction"] = prediction
    return _conclude(tests, error, worst, portrait, "wells", each.tested_on)


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
    return _conclude(each.tests, each.error, each.worst, portrait, "wells", each.tested_on)


@dataclass(frozen=True)
class _OfEach:
    """Tests of one formula for each attractor, the worst verdict of each test, and the error to be stated."""

    tests: dict[str, Verdict]
    error: float
    worst: np.ndarray | None
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
    error, worst = (0.0, None) if wells else (np.inf, None)
    own_error, from_field = error, 0.0
    tested = []
    advice = "" if isinstance(found, GivenField) else "record more there, or "
    for well in wells:
        own = [place for place, one in enumerate(portrait.attractors) if _same(one.position, well.attractor)]
        mine = [one for one in references if _same(one.attractor, well.attractor)]
        part = part_of(held_out, well, basin_region(portrait, own[0]), mine[0] if mine else None)
        tested.append(part.described)
        if part.claimed < LEAST_CLAIMED:
            reason = (
                f"V claims to hold at {part.claimed:.0%} of the held-out states in the well about"
                f" {_place(well.attractor)}: {advice}raise refinement.degrees"
            )
            tests["hamilton_jacobi"] = Verdict(np.inf, options.hamilton_jacobi, False, reason)
            error = own_error = np.inf
            continue
        candidate = _of_well(well, portrait, part.points)
        its, place = stated_error(candidate, found, seed=seed)
        # Characteristics follow the same f: what f's uncertainty adds explains no difference from them.
        made, its, there = _common(candidate, found, part, mine, options, its, well.level, seed)
        uncertain = STATED * _error_from_field(well, found, part.points, seed)
        own_error, from_field = max(own_error, its), max(from_field, uncertain)
        its += uncertain
        for name, verdict in made.items():
            tests[name] = _worse(tests.get(name), verdict)
        if its >= error:
            error, worst = its, place if there is None else there
    missing = len(portrait.attractors) - len(wells)
    if missing or not wells:
        reason = f"{missing} of {len(portrait.attractors)} attractors have no formula"
        tests["branch"] = Verdict(np.inf, options.branch, False, reason)
    tests["error"] = check_error(own_error, limit=options.error, from_field=from_field)
    return _OfEach(tests, error, worst, "; ".join(dict.fromkeys(tested)))


def caustic_notes(
    refined: Refined, portrait: PhasePortrait, error: float, *, seed: int = 0
) -> tuple[str, ...]:
    """Where characteristics cross below the saddle of a well of a refinement; see `caustics_below`."""
    wells = refined.wells or refined.network_wells
    return caustics_below(refined.found.dynamics, wells, portrait, error, seed=seed)


def caustics_below(
    dynamics: Dynamics, wells: Sequence[Well], portrait: PhasePortrait, error: float, *, seed: int = 0
) -> tuple[str, ...]:
    """Where characteristics cross below the saddle of a well, in words: no smooth V exists there.

    Only sought where the stated error leaves room for one. A kink of V is no fault of the method, but no
    polynomial follows it, and the error that is stated comes from there.
    """
    if not error > NOTICEABLE:
        return ()
    notes = []
    for well in wells:
        fan = adapted_fan(
            dynamics, well.attractor, level=0.98 * well.level,
            box=_widened(portrait.box), generator=np.random.default_rng(seed), most=FAN,
            tolerance=FAN_TOLERANCE, spacing=FAN_SPACING,
        )  # fmt: skip
        caustic = first_caustic(fan)
        if caustic is not None:
            where = np.array2string(caustic.position, precision=4, suppress_small=True, separator=", ")
            notes.append(
                f"characteristics from the attractor {_place(well.attractor)} cross at a caustic from {where}"
                f" on, where U = {2 * caustic.value:.4g}: V has no smooth form there, and no formula"
                " follows it"
            )
    return tuple(notes)


def _place(position: np.ndarray) -> str:
    return np.array2string(position, precision=4, suppress_small=True, separator=", ")


def _widened(box: np.ndarray) -> np.ndarray:
    width = box[:, 1] - box[:, 0]
    return np.stack([box[:, 0] - width / 4, box[:, 1] + width / 4], axis=1)


def uncertified(reason: str) -> dict[str, Any]:
    """The certificate of formulas that could not be tested."""
    return {"certified": False, "scope": "region", "stated_error": None, "reason": reason, "tests": {}}


def _common(
    candidate: Candidate,
    found: AnyField,
    held_out: HeldOut,
    references: Sequence[Reference],
    options: CertificateOptions,
    error: float,
    level: float,
    seed: int,
) -> tuple[dict[str, Verdict], float, np.ndarray | None]:
    """The tests of either scope, the error to be stated after them, and where V is worst if they tell."""
    followed, error, place = check_characteristics(
        candidate, found, references, error=error, options=options, level=level, seed=seed
    )
    tests = {
        "hamilton_jacobi": check_hamilton_jacobi(candidate, found, limit=options.hamilton_jacobi),
        "branch": check_branch(candidate, found, limit=options.branch, seed=seed),
    }
    if held_out.pairs is not None and not isinstance(found, GivenField):
        tests["descent"] = check_descent(candidate, found, held_out.pairs, options=options, error=error)
    tests["characteristics"] = followed
    return tests, error, None if followed.passed else place


def _of_formulas(
    formulas: SymbolicDecomposition, points: np.ndarray, portrait: PhasePortrait, relative_error: float
) -> Candidate:
    symbols, d = formulas.symbols, len(formulas.symbols)
    second = [slope.diff(symbol) for slope in formulas.gradient for symbol in symbols]
    hessian = compile_formulas(second, symbols)
    together, gradient = formulas.evaluate, formulas.evaluate_gradient
    return Candidate(
        values=lambda x: together(np.ascontiguousarray(x.T))[0],
        gradients=lambda x: gradient(np.ascontiguousarray(x.T)).T,
        hessians=lambda x: hessian(np.ascontiguousarray(x.T)).T.reshape(-1, d, d),
        circulatory=lambda x: together(np.ascontiguousarray(x.T))[1 : d + 1].T,
        points=points,
        attractors=portrait.attractors,
        relative_error=relative_error,
    )


def _same(one: np.ndarray, two: np.ndarray) -> bool:
    return np.array_equal(one, two)


def _of_well(well: Well, portrait: PhasePortrait, points: np.ndarray) -> Candidate:
    mine = [one for one in portrait.attractors if _same(one.position, well.attractor)]
    return Candidate(well.values, well.gradients, well.hessians, None, points, mine)


def _sublevel_points(wells: Sequence[Well]) -> list[np.ndarray]:
    """Points of the fit of each well, below a share of its level: where two routes are compared."""
    return [well.points[well.values(well.points) < SHARE * well.level] for well in wells]


def _error_of(
    well: Well, found: IdentifiedField, portrait: PhasePortrait, seed: int
) -> tuple[float, np.ndarray | None]:
    return stated_error(_of_well(well, portrait, _sublevel_points([well])[0]), found, seed=seed)


def _error_from_field(well: Well, found: AnyField, points: np.ndarray, seed: int) -> float:
    """Relative standard error of V over points, from what is not known of f."""
    generator = np.random.default_rng(seed)
    x = points[generator.choice(len(points), min(ERROR_POINTS, len(points)), replace=False)]
    return relative_error(found, well.gradients, well.attractor, x, well.values(x))


def _explained(options: CertificateOptions, *errors: float) -> float:
    """Difference of two routes that their errors explain; one that cannot be stated explains nothing."""
    return HARMLESS + sum(min(error, options.error) for error in errors)


def _worse(one: Verdict | None, two: Verdict) -> Verdict:
    if one is None:
        return two
    return max(one, two, key=lambda verdict: (not verdict.passed, verdict.value / (verdict.limit or 1.0)))


def _conclude(
    tests: dict[str, Verdict],
    error: float,
    worst: np.ndarray | None,
    portrait: PhasePortrait,
    scope: str,
    tested_on: str,
) -> Certificate:
    fault = portrait.fault()
    if fault is not None:
        limit = tests["branch"].limit if "branch" in tests else 0.0
        tests["branch"] = Verdict(np.inf, limit, False, fault)
    refused = [verdict.reason for verdict in tests.values() if not verdict.passed]
    return Certificate(tests, error, "; ".join(dict.fromkeys(refused)), scope, tested_on)
