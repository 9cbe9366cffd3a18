"""The certificate: which tests a formula of V has to pass, and what they come to.

No formula is certified without a test that shares nothing with its fit but f: `INDEPENDENT` names those.

`siq.quasipotential.certificate_tests` has the tests themselves; one formula for each attractor is certified
by `siq.quasipotential.certificate`.

`siq.quasipotential.certificate_tests` has the tests themselves; one formula for the whole region is certified
by `siq.quasipotential.certificate`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from siq.data.recordings import SnapshotPairs
from siq.inference.field_estimate import AnyField, GivenField, IdentifiedField
from siq.quasipotential.certificate_characteristics import FEWEST, SHARE, Reference, check_characteristics
from siq.quasipotential.certificate_tests import (
    ERROR_POINTS,
    STATED,
    BasinRegion,
    Candidate,
    CertificateOptions,
    Verdict,
    basin_region,
    check_agreement,
    check_branch,
    check_descent,
    check_error,
    check_existence,
    check_hamilton_jacobi,
    check_identity,
    stated_error,
)
from siq.quasipotential.characteristics import adapted_fan, first_caustic
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.quasipotential.refinement import Refined
from siq.quasipotential.uncertainty import relative_error
from siq.quasipotential.wells import Well
from siq.systems.dynamics import Dynamics
from siq.systems.formulas import compile_formulas
from siq.systems.phase_portrait import PhasePortrait

INDEPENDENT = ("characteristics",)  # tests of V that share nothing with a fit of V but f and D


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


def uncertified(reason: str) -> dict[str, Any]:
    """The certificate of formulas that could not be tested."""
    return {"certified": False, "scope": "region", "stated_error": None, "reason": reason, "tests": {}}


def position_text(position: np.ndarray) -> str:
    """A state as it stands in the reasons of a certificate."""
    return np.array2string(position, precision=4, suppress_small=True, separator=", ")


NOTICEABLE = 1e-3  # a stated error above this is worth an explanation
FAN = 512  # characteristics in search of a caustic
FAN_TOLERANCE = 1e-7  # of their steps: what is said of a caustic has four digits
FAN_SPACING = 0.1  # of points along them, the level being at 1: a caustic between two of them is located


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
            start, where = position_text(well.attractor), position_text(caustic.position)
            notes.append(
                f"characteristics from the attractor {start} cross at a caustic from {where} on, where"
                f" U = {2 * caustic.value:.4g}: V has no smooth form there, and no formula follows it"
            )
    return tuple(notes)


def _widened(box: np.ndarray) -> np.ndarray:
    width = box[:, 1] - box[:, 0]
    return np.stack([box[:, 0] - width / 4, box[:, 1] + width / 4], axis=1)


@dataclass(frozen=True)
class HeldOut:
    """States and pairs of held-out recordings.

    Attributes
    ----------
    points
        Evenly spread states, shape ``(n, d)``.
    pairs
        Consecutive samples; None where f is given, and no motion was recorded.
    described
        What the points are, in words.
    claimed
        Share of the states of the region at which the formula claims to hold.
    """

    points: np.ndarray
    pairs: SnapshotPairs | None
    described: str = ""
    claimed: float = 1.0

    def __post_init__(self) -> None:
        if not self.described:
            object.__setattr__(self, "described", f"{len(self.points)} held-out states")


def part_of(held_out: HeldOut, well: Well, region: BasinRegion, reference: Reference | None) -> HeldOut:
    """What lies in a well below `SHARE` of its level: at the saddle itself V is stationary.

    Parameters
    ----------
    held_out
        Of all recordings.
    well
        The formula and its level.
    region
        Which states lead to its attractor.
    reference
        Points of characteristics, which no fit saw either: they are added where fewer than `FEWEST`
        held-out states lie in the well.

    Returns
    -------
    HeldOut
        States where the formula claims to hold: it makes no claim where its own residual is large, as at a
        caustic. `claimed` has their share. Pairs count by their first sample: to ask where the second one
        lies would be to choose the noise.
    """

    def inside(x: np.ndarray) -> np.ndarray:
        mask = (well.values(x) < SHARE * well.level) & well.reaches(x)
        mask[mask] = ~region.across(x[mask])
        return np.asarray(mask)

    points, pairs = held_out.points[inside(held_out.points)], held_out.pairs
    further = ""
    if len(points) < FEWEST and reference is not None:
        own = len(points)
        points = np.concatenate([points, reference.below(well.level)[0]])
        further = f", {own} of them held out and, as these are few, the others reached by characteristics"
    believed = well.believed(points)
    described = f"{believed.sum()} of {len(points)} states of a well, where V claims to hold"
    described += further or ", all held out"
    share = float(believed.mean()) if len(points) else 0.0
    if pairs is None:
        return HeldOut(points[believed], None, described, share)
    rows = inside(pairs.x0)
    rows[rows] = well.believed(pairs.x0[rows])
    kept = replace(
        pairs, x0=pairs.x0[rows], xh=pairs.xh[rows], h=pairs.h[rows], recording=pairs.recording[rows]
    )
    return HeldOut(points[believed], kept, described, share)


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
    error, _ = stated_error(candidate, found, seed=seed)
    tests, error = common_tests(candidate, found, held_out, references, options, error, np.inf, seed)
    tests["identity"] = check_identity(candidate, found, limit=options.identity)
    from_field = STATED * candidate.relative_error
    tests["error"] = check_error(error - from_field, limit=options.error, from_field=from_field)
    if portrait.attractors:
        tests["existence"] = check_existence(found, portrait, seed=seed)
    if wells:
        # The local route shares the error of f, and has the rest of its own.
        own = [error_of_well(well, found, portrait, seed) for well in wells]
        tests["agreement"] = check_agreement(
            candidate.values, wells, sublevel_points(wells),
            limit=explained_difference(options, error, max(own)) + 6 * candidate.relative_error,
        )  # fmt: skip
    elif compared:
        tests["agreement"] = Verdict(np.inf, 0.0, False, ALONE)
    tests["prediction"] = prediction
    return concluded(tests, error, portrait, "region", held_out.described)


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
