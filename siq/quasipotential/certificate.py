"""The certificate: which tests a formula of V has to pass, and what they come to.

One function certifies formulas, be it one for the recorded region or one for each attractor: each is a
candidate for some points and for some attractors, the worst of them decides, and the tests stand in
`siq.quasipotential.certificate_tests`. No formula is certified without a test that shares nothing with its
fit but f and D: `INDEPENDENT` names those.

That test is by characteristics of the Hamilton–Jacobi equation, which leave an attractor along its
linearisation: no ansatz of V, no network, no recorded state enters (`siq.quasipotential.characteristics`).
Along each V is integrated, and on the lowest sheet it is the quasipotential. Recorded states only say where
to compare: within the box of the recordings, among states that lead to the attractor, and up to a share of
the level at which the first characteristic leaves these.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from siq.data.recordings import SnapshotPairs
from siq.data.states import RecordStates
from siq.errors import NumericalFailure
from siq.inference.field_estimate import AnyField, Verdict
from siq.networks.decomposition import AnyNetworks, NetworksByWell
from siq.numerics.randomness import representative_subset
from siq.numerics.text import place_text
from siq.quasipotential.certificate_tests import (
    ERROR_POINTS,
    LEVEL_SHARE,
    MAX_ERROR_FROM_FIELD,
    MIN_POINTS,
    STATED_SIGMAS,
    Candidate,
    CertificateOptions,
    Reference,
    check_existence,
)
from siq.quasipotential.characteristics import (
    SHEET_MARGIN,
    End,
    Fan,
    adapted_fan,
    relative_error as field_error,
)
from siq.quasipotential.formulas import SymbolicDecomposition
from siq.quasipotential.transitions import Transition
from siq.quasipotential.wells import MIN_EXPLAINED_ERROR, Well
from siq.remarks import Remark, sentence
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at
from siq.systems.formulas import compile_formulas
from siq.systems.phase_portrait import PhasePortrait, RecordedRegion

OF_TIMES = ("times", "regular_clock")  # what answers on times rest on, and nothing else does
# What f and D rest on: the record, and no formula of V.
OF_DYNAMICS = (
    "prediction", "one_system", "unchanged", "state_complete", "gaussian_increments", "existence", "record",
    "connected",
)  # fmt: skip
INDEPENDENT = ("characteristics",)  # tests of V that share nothing with a fit of V but f and D
GO_WITHOUT = "or do without them: 'refinement: {routes: [local]}'"
ALONE = f"only one of the two routes that the study names led to V; train other networks, {GO_WITHOUT}"
COMPARED_POINTS = 100  # on which the error of networks is known to a tenth, and that is enough
MIN_DIFFERENCE = 1e-6  # a difference of the routes that no error needs to explain
MIN_CLAIMED_SHARE = 0.5  # of the states in a well: a formula that holds at fewer is none of it (a choice)


@dataclass(frozen=True)
class Certificate:
    """Whether a method's formulas may be believed, and why."""

    tests: Mapping[str, Verdict]  #: by name
    error: float  #: relative error of V that has to be stated; infinite where unknown
    reason: str  #: what refused it, or what to know of it, in words
    #: ``region``: one formula for the recorded region; ``wells``: one for each attractor.
    scope: str = "region"
    tested_on: str = ""  #: the points, in words

    @property
    def independent(self) -> tuple[str, ...]:
        """The tests made that share nothing with the fit of V but f and D."""
        return tuple(name for name in INDEPENDENT if name in self.tests)

    @property
    def certified(self) -> bool:
        """Whether every claim was tested and passed, one test an independent one; times apart.

        Where the record is too short to test times, these are not `times_certified`, and the rest may be.
        """
        needed = [one for name, one in self.tests.items() if one.tested or name not in OF_TIMES]
        return bool(self.independent) and all(verdict.passed for verdict in needed)

    @property
    def times_certified(self) -> bool:
        """Whether times are: the record could have shown that they are wrong, and did not."""
        return self.certified and all(self.tests[name].passed for name in OF_TIMES if name in self.tests)

    @staticmethod
    def rung(certificate: Certificate | None, seen: RecordStates | None, *, hidden: bool = False) -> int:
        """The rung of the ladder of answers that a record supports, from 0 of one state to 6 of formulas.

        Up to 3 it is that of the states that the record shows by itself. With f and D that passed every test
        against the record it is 4, or 5 where they have a `hidden` state; with all formulas certified,
        times between states included, 6. Of a record that changes it is no more than that of its states,
        whatever was certified.
        """
        own = 0 if seen is None else seen.rung
        apart = seen is not None and seen.limit is not None and seen.limit.code == "data.not_stationary"
        if certificate is None or apart or "prediction" not in certificate.tests:
            return own
        tests = certificate.tests
        known = all(tests[name].passed for name in OF_DYNAMICS if name in tests)
        asked = [tests[name] for name in (*OF_TIMES, "gaussian_force") if name in tests]
        if not known or any(one.tested and not one.passed for one in asked):
            return own
        if hidden:
            return 5
        return 6 if certificate.times_certified else 4

    def with_tests(self, tests: Mapping[str, Verdict]) -> Certificate:
        """With further tests; the reason says which of them refused it, or could not be made."""
        refusing = (one for name, one in tests.items() if one.tested or name not in OF_TIMES)
        further = [one.reason for one in refusing if not one.passed]
        reason = "; ".join(dict.fromkeys(one for one in (self.reason, *further) if one))
        return replace(self, tests={**self.tests, **tests}, reason=reason)

    def as_data(self) -> dict[str, Any]:
        """As it stands in model.json."""
        return {
            "certified": self.certified, "times_certified": self.times_certified, "scope": self.scope,
            "stated_error": float(self.error) if np.isfinite(self.error) else None, "reason": self.reason,
            "tested_on": self.tested_on, "independent": list(self.independent),
            "tests": {name: verdict.as_data() for name, verdict in self.tests.items()},
        }  # fmt: skip

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> Certificate:
        """A certificate as `as_data` stored it."""
        tests = {name: Verdict.from_data(one) for name, one in data["tests"].items()}
        error = np.inf if data["stated_error"] is None else data["stated_error"]
        return cls(tests, error, data["reason"], data["scope"], data["tested_on"])


def uncertified(reason: str) -> dict[str, Any]:
    """The certificate, as data, of formulas that could not be tested."""
    return {"certified": False, "scope": "region", "stated_error": None, "reason": reason, "tests": {}}


@dataclass(frozen=True)
class Evidence:
    """Everything that formulas of V are tested with."""

    found: AnyField  #: f and D, identified without V or given
    portrait: PhasePortrait  #: which follows from them
    points: np.ndarray  #: evenly spread states that no fit saw, shape (n, d)
    pairs: SnapshotPairs | None = None  #: of held-out recordings; None where no motion was recorded
    references: Sequence[Reference] = ()  #: V by characteristics about every attractor
    options: CertificateOptions = field(default_factory=CertificateOptions)  #: the limits
    seed: int = 0  #: draws f, and the points on which the error is estimated


def certify(
    formulas: SymbolicDecomposition | Sequence[Well], evidence: Evidence, *,
    networks: AnyNetworks | None = None, compared: bool = False, relative_error: float = 0.0,
) -> Certificate:  # fmt: skip
    """Certificate of one formula for the region, or of one for each attractor, the worst of them deciding.

    The Hessian of the local route is M by construction, so that its branch test passes by itself; what tests
    it are the characteristics. A formula about an attractor is tested on held-out states of its own well
    where it claims to hold, and it has to claim more than half of them. Where f is given nothing was
    recorded, and what tests predictions, motion, and whether uncertain wells exist has no object.

    Where networks are to be `compared`, their own V has to agree; without networks that is refused.
    `relative_error` is the relative standard error of a V of the region from the uncertainty of f.
    """
    found, portrait, options, seed = evidence.found, evidence.portrait, evidence.options, evidence.seed
    wells = () if isinstance(formulas, SymbolicDecomposition) else tuple(formulas)
    if isinstance(formulas, SymbolicDecomposition):
        scope, symbols, d = "region", formulas.symbols, len(formulas.symbols)
        second = compile_formulas([one.diff(x) for one in formulas.gradient for x in symbols], symbols)
        candidates = [Candidate(
            formulas.values, lambda x: formulas.evaluate_gradient(np.ascontiguousarray(x.T)).T,
            lambda x: second(np.ascontiguousarray(x.T)).T.reshape(-1, d, d),
            lambda x: formulas.evaluate(np.ascontiguousarray(x.T))[1 : d + 1].T,
            evidence.points, portrait.attractors, relative_error, evidence.pairs, evidence.references,
            tested_on=f"{len(evidence.points)} held-out states",
        )]  # fmt: skip
    else:
        scope, candidates = "wells", [_candidate_in_well(well, evidence) for well in wells]
    verdicts: dict[str, list[Verdict]] = {}
    error = own_error = 0.0 if candidates else np.inf
    from_field = 0.0
    for number, candidate in enumerate(candidates):
        if candidate.claimed < MIN_CLAIMED_SHARE:
            advice = "" if isinstance(found, Dynamics) else "record more there, or "
            reason = (
                f"V claims to hold at {candidate.claimed:.0%} of the held-out states in the well about"
                f" {place_text(wells[number].attractor)}: {advice}raise refinement.degrees"
            )
            verdicts["hamilton_jacobi"] = [Verdict.refused(reason, options.hamilton_jacobi)]
            error = own_error = np.inf
            continue
        made, its = candidate.check(found, options, seed=seed)
        for name, verdict in made.items():
            verdicts.setdefault(name, []).append(verdict)
        uncertain = STATED_SIGMAS * candidate.relative_error
        own_error = max(own_error, its - uncertain)
        if wells:
            well, generator, count = wells[number], np.random.default_rng(seed), len(candidate.points)
            x = candidate.points[generator.choice(count, min(ERROR_POINTS, count), replace=False)]
            uncertain = STATED_SIGMAS * field_error(found, well.gradients, well.attractor, x, well.values(x))
            its += uncertain
        error, from_field = max(error, its), max(from_field, uncertain)
    tests = {name: Verdict.worst(made) for name, made in verdicts.items()}
    missing = len(portrait.attractors) - len(wells)
    if scope == "wells" and (missing or not wells):
        reason = f"{missing} of {len(portrait.attractors)} attractors have no formula"
        tests["branch"] = Verdict.refused(reason, options.branch)
    # A formula is no solution if the error that its own residual leaves open is too large. What the
    # uncertainty of f adds is no fault of the formula, and stated as long as a first order tells it.
    known, small = from_field <= MAX_ERROR_FROM_FIELD, own_error <= options.error
    reason = "" if known else "f is not known well enough to tell V: record more"
    reason = reason if small else "the error of V that its residual leaves open is too large"
    tests["error"] = Verdict(own_error if known else from_field, options.error, not reason, reason)
    if not isinstance(found, Dynamics):
        if portrait.attractors:
            tests["existence"] = check_existence(found, portrait, seed=seed)
        if compared and networks is None:
            tests["agreement"] = Verdict.refused(ALONE)
        elif compared and networks is not None:
            # Beyond the standard errors that are stated: the networks' f has errors of its own.
            tests["agreement"] = check_agreement(
                networks, formulas, evidence, error=error + 3 * relative_error
            )
        if found.prediction is not None:
            tests["prediction"] = found.prediction
    if (fault := portrait.fault()) is not None:
        limit = tests["branch"].limit if "branch" in tests else 0.0
        tests["branch"] = Verdict.refused(sentence(fault), limit)
    refused = [verdict.reason for verdict in tests.values() if not verdict.passed]
    tested_on = "; ".join(dict.fromkeys(candidate.tested_on for candidate in candidates))
    return Certificate(tests, error, "; ".join(dict.fromkeys(refused)), scope, tested_on)


def certify_wells(
    wells: Sequence[Well | None], evidence: Evidence, **options: Any
) -> tuple[list[Well | None], Certificate]:
    """Wells with their certificate: with powers in the place of units where it refuses these alone.

    `options` are those of `certify`; None stands for an attractor without a formula.
    """
    chosen = list(wells)
    certificate = certify([well for well in chosen if well is not None], evidence, **options)
    if not certificate.certified and any(well is not None and well.instead for well in chosen):
        powers = [well and (well.instead or well) for well in chosen]
        again = certify([well for well in powers if well is not None], evidence, **options)
        if again.certified:
            return powers, again
    return chosen, certificate


def _candidate_in_well(well: Well, evidence: Evidence) -> Candidate:
    """V about an attractor, to be tested on what lies in its well below `LEVEL_SHARE` of its level."""
    portrait, pairs = evidence.portrait, evidence.pairs
    index = [np.array_equal(one.position, well.attractor) for one in portrait.attractors].index(True)
    region = RecordedRegion.of_basin(portrait, index)
    references = [one for one in evidence.references if np.array_equal(one.attractor, well.attractor)]

    def inside(x: np.ndarray) -> np.ndarray:
        mask = (well.values(x) < LEVEL_SHARE * well.level) & well.reaches(x)
        mask[mask] = ~region.across(x[mask])
        return np.asarray(mask)

    # Where few held-out states lie in the well, points of characteristics are added.
    points, further = evidence.points[inside(evidence.points)], ", all held out"
    if len(points) < MIN_POINTS and references:
        further = (
            f", {len(points)} of them held out and, as these are few, the others reached by characteristics"
        )
        points = np.concatenate([points, references[0].below(well.level)[0]])
    believed = well.believed(points)  # no claim is made where its own residual is large, as at a caustic
    if pairs is not None:  # by their first sample: to ask where the second one lies would choose the noise
        rows = inside(pairs.x0)
        rows[rows] = well.believed(pairs.x0[rows])
        pairs = pairs.take(rows)
    return Candidate(
        well.values, well.gradients, well.hessians, None, points[believed], [portrait.attractors[index]],
        pairs=pairs, references=references, level=well.level,
        claimed=float(believed.mean()) if len(points) else 0.0,
        tested_on=f"{believed.sum()} of {len(points)} states of a well, where V claims to hold{further}",
    )  # fmt: skip


def check_agreement(
    networks: AnyNetworks, formulas: SymbolicDecomposition | Sequence[Well], evidence: Evidence, *,
    error: float = 0.0,
) -> Verdict:  # fmt: skip
    """Whether the networks' own V is that of formulas about every attractor, up to a constant.

    Formulas come from the identified f, networks from pairs of samples. They share the recordings; and where
    networks come by well, also which states lead to which attractor, and how a well grows. The figure is the
    largest relative L2 difference about any attractor. Its limit is what the error of the formulas explains,
    and that of the networks, which their own residual leaves open. Networks of which that is more than a
    certificate may state tell nothing, and are refused. Nothing is said of networks by well above
    `LEVEL_SHARE` of their level, nor of how high one well stands above another.
    """
    found, options = evidence.found, evidence.options
    verdicts = []
    potentials: Sequence[SymbolicDecomposition | Well] = (
        [formulas] if isinstance(formulas, SymbolicDecomposition) else formulas
    )
    for one, potential in itertools.product(evidence.references, potentials):
        attractor = one.attractor
        if isinstance(potential, Well) and not np.array_equal(potential.attractor, attractor):
            continue
        level = potential.level if isinstance(potential, Well) else np.inf
        x = one.below(level)[0]
        if isinstance(networks, NetworksByWell):
            # They end near their saddle, which one formula for all wells does not.
            x = networks.below(LEVEL_SHARE, attractor, x)
            if len(x) < MIN_POINTS:
                x = networks.below(LEVEL_SHARE, attractor, networks.states)
                x = x[potential.values(x) - potential.values(attractor[None]) < LEVEL_SHARE * level]
        if len(x) < MIN_POINTS:
            few = f"the networks' V is known at {len(x)} points about {place_text(attractor)}, too few to"
            verdicts.append(Verdict.refused(f"{few} compare two routes: record more there, {GO_WITHOUT}"))
            continue
        about = [each for each in evidence.portrait.attractors if np.array_equal(each.position, attractor)]
        some, slopes = x[:: max(len(x) // COMPARED_POINTS, 1)], networks.gradients_at
        # No Hessian is asked for where only an error is to be stated.
        theirs = Candidate(networks.potential_at, slopes, slopes, None, some, about)
        its = theirs.stated_error(found, seed=evidence.seed)
        if not its <= options.error:
            size = f"{its:.0%}" if np.isfinite(its) else "any size"
            reason = f"the networks' V is no second route: its own residual leaves an error of {size} open;"
            return Verdict.refused(f"{reason} raise training.output_weights, {GO_WITHOUT}", options.error)
        mine, other = (
            values(x) - values(attractor[None]) for values in (potential.values, networks.potential_at)
        )
        difference = float(np.linalg.norm(mine - other) / np.linalg.norm(mine))
        limit = MIN_DIFFERENCE + min(error, options.error) + its
        worst = place_text(x[int(np.argmax(np.abs(mine - other)))])
        verdicts.append(Verdict.of(difference, limit, f"the two routes disagree most at {worst}"))
    return Verdict.worst(verdicts) if verdicts else Verdict.refused(ALONE)


def caustics_below(references: Sequence[Reference], error: float) -> tuple[Remark, ...]:
    """Where characteristics cross up to `LEVEL_SHARE` of a well's level: no smooth V exists there.

    Only told where the stated error leaves room for one. A kink of V is no fault of the method, but no
    polynomial follows it, and the error that is stated comes from there.
    """
    return tuple(one.caustic for one in references if one.caustic and error > MIN_EXPLAINED_ERROR)


REACHED_SHARE = 0.8  # of what was asked for, up to which a curve has to come where most end before
LEVEL_FAN = {"count": 32, "most": 64, "rounds": 2, "tolerance": 1e-5}  # curves in search of the level
REFERENCE_FAN = {"count": 64, "most": 128, "rounds": 3}  # and for the comparison: cost, not accuracy
END_GAP = 0.15  # of the ends of neighbours, the level being at 1
TOLERANCE = 1e-7  # of the integrator's steps, relative; by so much V may err in each
START_LEVEL = 1e-3  # of the level: the series errs by 10⁻³ to the 5/2; closer, curves bundle
START_DEGREE = 6
MAX_STEPS = 1500  # of a curve, where 30 to 130 are usual; stiff systems take as many as their rates differ
LEVEL_DOUBLINGS = 8  # of the level in search of the saddle
SADDLE_DISTANCE = 0.6  # of a saddle to a curve, the level being at 1: close enough for an estimate of V
OVERSHOOT = 1.2  # of the level of the fan: what lies higher was not reached
REPEAT_RATIO = 1.5  # of the level found: a fan up to more than that has to be followed again, up to less
START_QUANTILE = 0.9  # share of the recorded starts below the first level where no saddle is known


def references_about(
    dynamics: Dynamics, portrait: PhasePortrait, *, ways: Sequence[Transition] = (), seed: int = 0
) -> tuple[Reference, ...]:
    """V by characteristics about every attractor of a phase portrait.

    Above the lowest of the `ways` out of a well, where they are known, nothing is compared. The seed draws
    directions where there are more than two states, and thins the points.
    """
    depths = [np.inf] * len(portrait.attractors)
    for way in ways:
        if way.path is not None and way.start < len(depths):
            depths[way.start] = min(depths[way.start], way.path.action / 2)
    return tuple(_follow_well(dynamics, portrait, *each, seed=seed) for each in enumerate(depths))


def _follow_well(
    dynamics: Dynamics, portrait: PhasePortrait, index: int, depth: float = np.inf, *, seed: int = 0
) -> Reference:
    """V by characteristics about one attractor, as far as they may be believed, or a fault."""
    attractor = portrait.attractors[index].position
    name, region = place_text(attractor), RecordedRegion.of_basin(portrait, index)

    def without(fault: str) -> Reference:
        return Reference(attractor, np.zeros((0, len(attractor))), np.zeros(0), np.nan, np.inf, fault)

    try:
        level = min(_level(dynamics, portrait, index, region, seed), depth)
        fan = _fan(dynamics, portrait, attractor, LEVEL_SHARE * level, seed, **REFERENCE_FAN)
    except (NumericalFailure, ValueError, np.linalg.LinAlgError) as failure:
        return without(f"characteristics cannot be followed from the attractor {name}: {failure}")
    caustic = None
    if (met := fan.first_caustic()) is not None:
        places = {"attractor": name, "place": place_text(met[0], digits=4)}
        caustic = Remark("quasipotential.caustic", places | {"level": 2 * met[1]})
    lowest = fan.lowest_sheet()
    kept = np.flatnonzero(lowest & region.recorded(fan.points))
    if not len(kept):
        return without(f"no characteristic from the attractor {name} stays where states were recorded")
    scaled = (fan.points[kept] - attractor) @ fan.metric.T
    distance = _spacing(len(attractor))
    kept = kept[representative_subset(scaled, distance=distance, generator=np.random.default_rng(seed))]
    x, values, ends = fan.points[kept], fan.values[kept], fan.ends
    error = TOLERANCE * int(np.bincount(fan.curve).max()) + (0.0 if lowest.all() else SHEET_MARGIN)
    stopped = np.isin(ends, (End.STALLED, End.TIME, End.CAUSTIC)).mean() > 0.5
    if len(values) >= MIN_POINTS and (values.max() >= REACHED_SHARE * fan.level or not stopped):
        return Reference(attractor, x, values, level, error, caustic=caustic)
    if np.isin(ends, (End.STALLED, End.TIME)).mean() > 0.5:
        why = "they are too stiff: leave out the fastest states, or record their slow motion alone"
    elif met is not None:
        why = f"they cross at caustics from U = {2 * met[1]:.4g} on: record less far from the attractor"
    elif (ends == End.LEVEL).mean() > 0.5:
        why = "they draw together, its rates being too different: leave out the fastest states"
    else:
        why = "they leave the recorded states: record more of them about the attractor"
    fault = f"characteristics from the attractor {name} give {len(values)} points to compare with, as {why}"
    return Reference(attractor, x, values, level, error, fault, caustic)


def _level(
    dynamics: Dynamics, portrait: PhasePortrait, index: int, region: RecordedRegion, seed: int
) -> float:
    """V at which the first characteristic comes to another basin, or to rest at a saddle."""
    attractor = portrait.attractors[index].position
    hessian = hessian_at(dynamics, attractor)

    def quadratic(x: np.ndarray) -> np.ndarray:
        return np.asarray(0.5 * np.einsum("ni,ij,nj->n", x - attractor, hessian, x - attractor))

    tops = np.array([one.position for one in portrait.saddles[index]]).reshape(-1, len(attractor))
    starts = portrait.descents.paths[portrait.descents.ends == index][:, 0]
    first = float(np.quantile(quadratic(starts), START_QUANTILE))
    level = min(first, float(quadratic(tops).min(initial=np.inf)))
    known: float | None = None
    for _ in range(LEVEL_DOUBLINGS):
        fan = _fan(dynamics, portrait, attractor, level, seed, **LEVEL_FAN)
        across = region.across(fan.points) & (fan.values > 0)
        # One state on the wrong side may be a gap between recorded ones: the next has to lie there too.
        across[:-1] &= across[1:] & (fan.curve[:-1] == fan.curve[1:])
        across[-1] = False
        ends = fan.values[fan.last]
        # Of saddles that curves come close to, to second order: curves turn off before.
        distance, nearest, values, bend = fan.expanded(tops, fan.lowest_sheet())
        heights = np.maximum(values + bend, nearest / 2)[distance < SADDLE_DISTANCE]
        left = np.concatenate([fan.values[across], ends[fan.ends == End.REST], heights])
        if len(left) and left.min() <= OVERSHOOT * level:
            lowest = float(left.min())
            if level <= REPEAT_RATIO * lowest:
                return lowest
            # The same again, where curves lie closer together.
            known, level = lowest, OVERSHOOT * lowest
            continue
        if known is not None:
            return known
        if not len(tops):  # then V, to second order, of most recorded starts, or what any curve comes to
            return min(level, float(ends.max())) / LEVEL_SHARE
        if not (fan.ends == End.LEVEL).any():
            return float(ends.max())
        level *= 2
    raise NumericalFailure("they come to no saddle; record the way there")


def _fan(
    dynamics: Dynamics, portrait: PhasePortrait, attractor: np.ndarray, level: float, seed: int,
    **options: Any,
) -> Fan:  # fmt: skip
    return adapted_fan(
        dynamics, attractor, level=level, box=portrait.box, generator=np.random.default_rng(seed),
        gap=END_GAP, spacing=_spacing(len(attractor)), most_steps=MAX_STEPS, start=START_LEVEL,
        start_degree=START_DEGREE if len(attractor) <= 4 else 4, **{"tolerance": TOLERANCE} | options,
    )  # fmt: skip


def _spacing(dimension: int) -> float:
    """Distance of points along curves, the level being at 1; one state has two curves only."""
    return 0.1 if dimension > 1 else 0.02
