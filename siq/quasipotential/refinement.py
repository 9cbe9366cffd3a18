"""Refinement: V by both routes, from the identified f and the recorded states, with its certificate.

Two routes lead to V. They share f, the recorded points and Gauss–Newton; and by `training_check` networks are
trained until they agree with the local route, so that their agreement is no evidence from elsewhere. The
*network route* starts from the networks and seeks one formula for the whole recorded region; where no single
formula can hold, since V has a kink between its wells, it takes each well for itself. The *local route* grows
V from each attractor, and needs no network. Whether to believe either is decided by
`siq.quasipotential.certificate`, and a control says what the same refinement makes of a network with its
weights in random order.

The check of a training does in small what will be done in earnest afterwards: V_θ is written in powers,
refined on the Hamilton–Jacobi equation of the identified f, and compared with the local route. Whatever
passes was thereby selected for agreement: that of a certificate is a test of consistency alone.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as pydantic_dataclass

from siq.data.recordings import Recordings, SnapshotPairs, snapshot_pairs
from siq.errors import NumericalFailure
from siq.inference.field_estimate import FieldEstimate, Verdict
from siq.inference.kalman_identification import filtered_recordings
from siq.inference.library import CandidateLibrary, joint_library
from siq.inference.regression import coarse_pairs
from siq.networks.decomposition import CheckOptions, TrainedNetworks, shuffled
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.certificate import (
    MIN_DIFFERENCE,
    Certificate,
    Evidence,
    caustics_below,
    certify,
    references_about,
    uncertified,
)
from siq.quasipotential.certificate_tests import (
    MAX_PAIRS,
    MIN_POINTS,
    CertificateOptions,
    Function,
    Reference,
    check_agreement,
)
from siq.quasipotential.formulas import (
    SymbolicDecomposition,
    decomposition_from_coefficients,
    term_coefficients,
)
from siq.quasipotential.global_formula import GlobalFormula, fit_values, refine_globally, with_circulation
from siq.quasipotential.hamilton_jacobi import LibraryBasis, affordable_degree
from siq.quasipotential.occupancy import OccupancyCheck, check_occupancy
from siq.quasipotential.rates import NoiseStrength
from siq.quasipotential.wells import MIN_OUTLIER_RESIDUAL, RESIDUAL_TOLERANCE, Well, fit_well, local_well
from siq.remarks import Remark, sentence
from siq.systems.phase_portrait import PhasePortrait, RecordedRegion, evenly_spread, phase_portrait

logger = logging.getLogger(__name__)

Route = Literal["network", "local"]
Degree = Annotated[int, Field(ge=2, le=16)]

LOWER_PARTS = (0.7, 0.5, 0.3)  # of the points, by V
NETWORK_DEGREE = 8  # highest power of a well by the network route, whose start knows no more


@pydantic_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class RefinementOptions:
    """How V is refined, about each attractor and over the whole region.

    Attributes
    ----------
    degrees
        Highest powers about an attractor that are tried, one after the other.
    accuracy
        Relative Hamilton–Jacobi residual below which no higher power is tried.
    reach
        Level up to which a formula is sought, as a share of V at the lowest saddle.
    tolerance
        Largest relative Hamilton–Jacobi residual at a point where a formula is believed.
    routes
        ``network``, ``local``, or both, which are then compared with each other. By default both where
        networks are asked for, and otherwise the local one; see `with_routes`.
    formula_degree
        Highest power of one formula for the whole region; by default what the identified f allows: one
        more than that of f, and at least four.
    functions
        Further functions that such a formula may use, as formulas of the states, beside those of f.
    single_formula
        Largest relative Hamilton–Jacobi residual with which one formula stands for the whole region.
    false_terms
        Probability that the uncertainty of f brings any false term into V.
    precision
        Terms that contribute less than this share are dropped in any case.
    """

    degrees: Annotated[tuple[Degree, ...], Field(min_length=1)] = (4, 6, 8, 10, 12)
    accuracy: Annotated[float, Field(gt=0)] = MIN_OUTLIER_RESIDUAL
    reach: Annotated[float, Field(gt=0, le=3)] = 1.2
    tolerance: Annotated[float, Field(gt=0, lt=1)] = RESIDUAL_TOLERANCE
    routes: Annotated[tuple[Route, ...], Field(min_length=1)] | None = None
    formula_degree: Annotated[int, Field(ge=1, le=12)] | None = None
    functions: tuple[str, ...] = ()
    single_formula: Annotated[float, Field(gt=0)] = 0.005
    false_terms: Annotated[float, Field(gt=0, lt=0.5)] = 0.01
    precision: Annotated[float, Field(gt=0, lt=0.1)] = 1e-7

    def with_routes(self, *, networks: bool) -> RefinementOptions:
        """These options with the routes named, where nobody named them: those that there are."""
        there: tuple[Route, ...] = ("network", "local") if networks else ("local",)
        return self if self.routes is not None else replace(self, routes=there)


@dataclass(frozen=True)
class Refined:
    """The V of both routes."""

    found: FieldEstimate  #: over the functions of a formula for the region, those of f and of V
    wells: tuple[Well, ...]  #: by the local route, one for each attractor
    network_wells: tuple[Well, ...] = ()  #: by the network route, where it found no formula for the region
    remarks: tuple[Remark, ...] = ()  #: what could not be done
    formula: GlobalFormula | None = None  #: V and g where one formula holds over the whole region


def _formula_library(found: FieldEstimate, options: RefinementOptions) -> CandidateLibrary:
    """The functions in which one formula of V is sought for the whole region.

    No polynomial V has a higher degree than f has, and one: of ``∇V·(f + D∇V) = 0`` the highest powers would
    be those of ``∇V·D∇V``, which cannot vanish where D is regular. A quartic is the least that has two wells.
    """
    degree = options.formula_degree
    if degree is None:
        highest = max(found.library.total_degree(term) for _, term in found.support)
        degree = affordable_degree(found.library.dimension, max(4, highest + 1))
    return joint_library(found.library, degree=degree, potential_degree=degree, further=options.functions)


def refine(
    found: FieldEstimate,
    portrait: PhasePortrait,
    *,
    formula: np.ndarray | None,
    network: Function | None,
    points: np.ndarray,
    options: RefinementOptions,
    seed: int = 0,
) -> Refined:
    """Follow the routes that the options name.

    The network route starts from `formula`, the regression's coefficients of V over the library of the
    formula, shape ``(q,)``, and where that leads nowhere from `network`, V_θ at points. One formula is sought
    over the recorded states `points`, shape ``(n, d)``. The seed decides which points are used where there
    are too many.
    """
    routes = options.with_routes(networks=network is not None).routes or ()
    library = _formula_library(found, options)
    found = _over_library(found, library)
    wells, remarks = (
        local_wells(found, portrait, options=options, seed=seed) if "local" in routes else ((), [])
    )
    network_wells: list[Well] = []
    # The errors of f make some of the residual with which one formula is believed to hold.
    errors = np.abs(np.sqrt(np.diag(found.covariance)) / found.values)
    noise = 0.0 if found.noise_free else 3 * float(np.sqrt((errors**2).mean()))

    def starts() -> Iterator[np.ndarray]:
        """Where one formula may begin; none is asked for once a formula is good enough."""
        group: Sequence[Well] = wells
        if "network" in routes:
            group = network_wells
            if formula is not None:
                yield formula
            if network is not None:
                values = network(points)
                yield fit_values(library, [points], [values])
                # Networks are worst where recordings are few, far out, and Gauss–Newton may follow them to a
                # false solution; further starts are refined on lower and lower parts of V first.
                for part in (values <= np.quantile(values, share) for share in LOWER_PARTS):
                    if part.sum() > 2 * library.size:
                        start = fit_values(library, [points[part]], [values[part]])
                        yield refine_globally(start, found, points[part], sparse=False).potential
                # In powers no higher than the local route took.
                degree = max((well.degree for well in wells), default=NETWORK_DEGREE)
                degree = affordable_degree(library.dimension, min(degree, NETWORK_DEGREE))
                made, failures = _about_attractors(
                    "network", portrait,
                    lambda at: fit_well(found.dynamics, portrait, at, network, degree=degree, seed=seed),
                )  # fmt: skip
                network_wells.extend(made)
                remarks.extend(failures)
        if found.diffusion.constant and found.diffusion.regular:
            # Refined one by one, the wells may turn out to share one formula. All of them together make the
            # start: one alone does not tell an odd power from an even one, and goes on wrongly in the others.
            for some in (group, *([well] for well in group if len(group) > 1)) if group else ():
                inside = [well.inside() for well in some]
                heights = [well.values(x) for well, x in zip(some, inside, strict=True)]
                yield fit_values(library, inside, heights)

    accepted: dict[str, Any] = {"false_terms": options.false_terms, "precision": options.precision}
    best, good = None, False
    for start in starts():
        trial = refine_globally(start, found, points, **accepted)
        if best is None or trial.residual < best.residual:
            best = trial
        if good := bool(best.potential.any()) and best.residual < options.single_formula + noise:
            break
    if not found.diffusion.constant:  # g = f + D∇V would need functions that no library has
        remarks.append(Remark("quasipotential.no_single_formula_for_noise_of_the_state"))
    elif not found.diffusion.regular:  # the equation of Hamilton and Jacobi is weighed by its inverse
        remarks.append(Remark("quasipotential.noise_on_some_states_only"))
    else:
        if best is not None and good:
            whole = with_circulation(best, found, points, single_formula=options.single_formula, **accepted)
            if whole is not None:
                if not (whole.joint or found.noise_free):
                    remarks.append(Remark("quasipotential.not_orthogonal"))
                return Refined(found, wells, (), tuple(remarks), whole)
        remarks.append(Remark("quasipotential.no_single_formula"))
    return Refined(found, wells, tuple(network_wells), tuple(remarks))


def _over_library(found: FieldEstimate, library: CandidateLibrary) -> FieldEstimate:
    """F over another library that holds all its functions."""
    if found.library is library:
        return found
    position = {term: k for k, term in enumerate(library.terms)}
    places = np.array([position[term] for term in found.library.terms])

    def moved(values: np.ndarray) -> np.ndarray:
        """Numbers by function, the last axis but one, in their new places."""
        new = np.zeros((*values.shape[:-2], library.size, library.dimension))
        new[..., places, :] = values
        return new

    support = np.column_stack([found.support[:, 0], places[found.support[:, 1]]])
    average = found.alternatives and (moved(found.alternatives[0]), moved(found.alternatives[1]))
    coefficients = moved(found.coefficients)
    return replace(found, library=library, coefficients=coefficients, support=support, alternatives=average)


def local_wells(
    found: FieldEstimate, portrait: PhasePortrait, *, options: RefinementOptions, seed: int = 0
) -> tuple[tuple[Well, ...], list[Remark]]:
    """The local route: V about each attractor, and where that was not possible."""
    return _about_attractors(
        "local", portrait, lambda at: local_well(found.dynamics, portrait, at, options=options, seed=seed)
    )


def _about_attractors(
    route: Route, portrait: PhasePortrait, solve: Callable[[int], Well]
) -> tuple[tuple[Well, ...], list[Remark]]:
    wells, remarks = [], []
    for index in range(len(portrait.attractors)):
        try:
            wells.append(solve(index))
        except NumericalFailure as error:
            values = {"route": route, "reason": str(error)}
            remarks.append(Remark("quasipotential.route_failed", values))
    return tuple(wells), remarks


def _refined_decomposition(refined: Refined, points: np.ndarray) -> SymbolicDecomposition:
    """V, g and f of a refinement, V zero at its minimum within the box of recorded states ``(n, d)``.

    f is that which was identified, so that f = -D∇V + g is a statement and no definition. Where there is
    one attractor only, its well's formula stands for the whole where no other was found.
    """
    found, formula = refined.found, refined.formula
    library = found.library
    wells = refined.wells or refined.network_wells

    def named(errors: np.ndarray) -> dict[str, float]:
        return {name: float(one) for name, one in zip(library.names, errors, strict=True) if one > 0}

    def by_component(letter: str, errors: np.ndarray) -> dict[str, dict[str, float]]:
        return {f"{letter}_{state}": named(errors[:, i]) for i, state in enumerate(library.states)}

    errors = by_component("f", found.standard_errors)
    if formula is None:
        return SymbolicDecomposition(library.symbols, None, (), found.dynamics.formulas, wells, errors)
    assert formula.circulatory is not None and formula.circulatory_errors is not None
    formulas = decomposition_from_coefficients(
        library, potential=formula.potential, circulatory=formula.circulatory,
        vector_field=np.zeros_like(formula.circulatory), points=points,
    )  # fmt: skip
    # The constant is minus the minimum; at the minimum its own place does not matter to first order.
    at = library.evaluate(points[np.argmin(library.evaluate(points) @ formula.potential)][None])[0]
    constant = float(np.sqrt(at @ formula.covariance @ at))
    of_potential = named(np.sqrt(np.diag(formula.covariance))) | {"1": constant}
    errors |= {"V": of_potential, "U": {term: 2 * error for term, error in of_potential.items()}}
    errors |= by_component("g", formula.circulatory_errors)
    return replace(formulas, vector_field=found.dynamics.formulas, wells=wells, standard_errors=errors)


class RefinementContext:
    """Everything that the refinement of a run goes by.

    Trajectories, the identified f and the trained networks, if any; the number of the run and the seed of the
    study; the time between the samples of a pair; how V is refined, and the limits of its tests.

    Attributes
    ----------
    points
        States on which formulas are sought, of recordings that take part, shape ``(n, d)``.
    held_out, pairs
        Of recordings that are held out the states, and the pairs of samples, on which they are tested.
    portrait
        Attractors of f, saddles, and what leads to them, from `points`.
    """

    def __init__(
        self,
        recordings: Recordings,
        found: FieldEstimate,
        networks: TrainedNetworks | None,
        *,
        number: int,
        seed: int,
        pair_step: float | None,
        refinement: RefinementOptions,
        limits: CertificateOptions,
    ) -> None:
        self.found, self.networks = found, networks
        self.number, self.seed, self.limits = number, seed, limits
        self.options = refinement.with_routes(networks=networks is not None)
        mask = recordings.held_out(generator=generator(seed, number, Purpose.HOLD_OUT))
        if found.sensor_variance is not None or found.hidden_velocities:
            # Of measured values the increments do not have the mean of f.
            recordings = filtered_recordings(found, recordings, pair_step=pair_step)
        pairs = snapshot_pairs(recordings, pair_step=pair_step)
        held, x = mask[pairs.recording], pairs.x0
        draw = generator(seed, number, Purpose.REFINE)
        self.points = x[~held][evenly_spread(x[~held], generator=draw)]
        self.held_out = x[held][evenly_spread(x[held], generator=draw)]
        if (memory := found.memory) is not None:
            pairs = coarse_pairs(recordings, memory[0], lost=memory[1])
        self.portrait: PhasePortrait = phase_portrait(self.found.dynamics, self.points, seed=number)
        if not self.found.noise_free:
            mask = _every_well_held_out(self.portrait, pairs, mask)
        self.pairs = pairs.take(mask[pairs.recording])
        self.recordings, self.unseen = recordings, mask

    @cached_property
    def evidence(self) -> Evidence:
        """Everything that formulas of the run are tested with."""
        references = references_about(self.found.dynamics, self.portrait, seed=self.number)
        return Evidence(
            self.found, self.portrait, self.held_out, self.pairs, references, self.limits, self.number
        )

    def refine_and_certify(self, regressed: SymbolicDecomposition | None) -> Refinement:
        """Refined formulas of the run with their certificate, from those of a regression, if any."""
        formula = None
        if regressed is not None and regressed.potential is not None:
            named = term_coefficients(regressed.potential)
            library = _formula_library(self.found, self.options)
            formula = np.array([named.get(name, 0.0) for name in library.names])
        network = None if self.networks is None else self.networks.potential_at
        refined, formulas, certificate = self._by_routes(self.options, network, formula)
        wells, found = refined.wells or refined.network_wells, self.found
        caustics = caustics_below(found.dynamics, wells, self.portrait, certificate.error, seed=self.number)
        # Hops and histogram of the record, compared with those that f predicts.
        strength, variance = found.noise_strength, found.sensor_variance
        try:
            record = check_occupancy(
                found, self.portrait,
                None if strength is None else NoiseStrength(*strength, source="estimated"),
                self.recordings, self.unseen,
                sensor=None if variance is None else np.sqrt(variance), seed=self.number,
            )  # fmt: skip
        except (NumericalFailure, np.linalg.LinAlgError) as error:
            record = OccupancyCheck(missing=Remark("quasipotential.reason", {"reason": str(error)}))
        verdict = record.verdict(false_alarms=self.limits.false_alarms)
        if verdict is not None:
            reason = "; ".join(one for one in (certificate.reason, verdict.reason) if one)
            certificate = replace(certificate, tests={**certificate.tests, "record": verdict}, reason=reason)
        return Refinement(formulas, certificate, record, (*refined.remarks, *caustics))

    def control(
        self, refined: SymbolicDecomposition | None, certificate: Certificate | None
    ) -> dict[str, Any]:
        """Refine networks with their weights in random order, and test the result as the real one is.

        Gauss–Newton from a random start ends nowhere, at a false solution that is as exact as the true one,
        or at the true one. The tests have to refuse the first two. Among those of the certificate, as it
        stands in `model.json`, `same_as_refined` has the largest relative difference from the refined V in
        any well; it takes no part in whether it is certified.
        """
        assert self.networks is not None
        draw = generator(self.seed, self.number, Purpose.SHUFFLE)
        randomised = shuffled(self.networks, generator=draw).potential_at
        options = replace(self.options, routes=("network",))
        try:
            _, formulas, made = self._by_routes(options, randomised, None)
        except (NumericalFailure, np.linalg.LinAlgError) as error:
            reason = f"refinement from random weights led to no V: {error}"
            nothing = Verdict.refused(reason, self.limits.hamilton_jacobi)
            return uncertified(reason) | {"tests": {"hamilton_jacobi": nothing.as_data()}}
        data = made.as_data()
        if refined is None or certificate is None:
            return data
        difference = _difference(formulas, refined, self.evidence.references)
        explained = MIN_DIFFERENCE + sum(one.error for one in (made, certificate) if np.isfinite(one.error))
        verdict = Verdict.of(difference, explained, "it is another V than the refined one")
        if made.certified:
            data["reason"] = (
                "refinement from random weights led to the same V" if verdict.passed else
                "a V from random weights was certified that is not the refined one: one of the two is false"
            )  # fmt: skip
        data["tests"]["same_as_refined"] = verdict.as_data()
        return data

    def _by_routes(
        self, options: RefinementOptions, network: Function | None, formula: np.ndarray | None
    ) -> tuple[Refined, SymbolicDecomposition, Certificate]:
        """V as the routes make it of their starts, with its certificate."""
        refined = refine(
            self.found, self.portrait, formula=formula, network=network, points=self.points,
            options=options, seed=self.number,
        )  # fmt: skip
        formulas, whole = _refined_decomposition(refined, self.points), refined.formula
        wells = refined.wells or refined.network_wells
        compared = len(options.routes or ()) == 2
        others = refined.network_wells if refined.wells else ()
        error = 0.0
        if formulas.potential is None:
            return refined, formulas, certify(wells, self.evidence, others=others, compared=compared)
        if whole is not None and not self.found.noise_free:
            error = whole.relative_error(refined.found.library.evaluate(self.points))
        certificate = certify(
            formulas, self.evidence, others=refined.wells, compared=compared, relative_error=error
        )
        if certificate.certified or not refined.wells:
            return refined, formulas, certificate
        # One formula for all wells is an extra. What refuses it is no word against the wells.
        refused = Remark("quasipotential.single_formula_refused", {"reason": certificate.reason})
        alone = replace(refined, formula=None, remarks=(*refined.remarks, refused))
        of_wells = certify(wells, self.evidence, others=others, compared=compared)
        if not of_wells.certified:
            return refined, formulas, certificate
        return alone, _refined_decomposition(alone, self.points), of_wells


def _every_well_held_out(portrait: PhasePortrait, pairs: SnapshotPairs, mask: np.ndarray) -> np.ndarray:
    """Held-out recordings as a mask, more of them where those that there are never come into some well.

    They are chosen by where they are, not by where they go: the fit of V knows no increments.
    """
    mask = mask.copy()
    some = pairs.take(np.arange(0, len(pairs.h), max(len(pairs.h) // MAX_PAIRS, 1)))
    for index in range(len(portrait.attractors)):
        there = some.recording[RecordedRegion.of_basin(portrait, index).recorded(some.x0)]
        counts = np.bincount(there, minlength=len(mask))
        while counts[mask].sum() < MIN_POINTS and counts[~mask].any():
            mask[int(np.argmax(np.where(mask, -1, counts)))] = True
    return mask


@dataclass(frozen=True)
class Refinement:
    """Refined formulas of a run."""

    formulas: SymbolicDecomposition  #: V, g and f
    certificate: Certificate  #: whether to believe them
    record: OccupancyCheck  #: f against hops and histogram of the recordings
    remarks: tuple[Remark, ...] = ()  #: what could not be done, and caustics


def _difference(
    one: SymbolicDecomposition, two: SymbolicDecomposition, references: Sequence[Reference]
) -> float:
    """Largest relative L2 difference of two V about any attractor; infinite where one has none there."""
    worst = 0.0 if references else np.inf
    for reference in references:
        x, at = reference.points, reference.attractor
        potentials = [
            potential.values(x) - potential.values(at[None])
            for formulas in (one, two)
            for potential in (formulas.wells if formulas.potential is None else [formulas])
            if not isinstance(potential, Well) or np.array_equal(potential.attractor, at)
        ]
        if len(potentials) < 2 or not len(x):
            return np.inf
        mine, theirs = potentials
        worst = max(worst, float(np.linalg.norm(mine - theirs) / np.linalg.norm(theirs)))
    return worst


CHECK_STEPS = 15  # of Gauss–Newton: what does not converge quickly is not ready
CHECK_DEGREES = (4, 6, 8)  # of the wells with which networks are compared, to some per cent
CHECK_SHARE = 0.75  # of the recorded points, the lowest in V, on which one formula is tried


class TrainingCheck:
    """Whether refinement will succeed from networks of a run, given its f and recorded states ``(n, d)``."""

    def __init__(self, found: FieldEstimate, x: np.ndarray, *, options: CheckOptions, seed: int) -> None:
        points = x[evenly_spread(x, generator=np.random.default_rng(seed))]
        self.options, self.portrait = options, phase_portrait(found.dynamics, points, seed=seed)
        refinement = RefinementOptions(degrees=CHECK_DEGREES)
        self.wells, _ = local_wells(found, self.portrait, options=refinement, seed=seed)
        self.library = joint_library(found.library, degree=options.degree, potential_degree=options.degree)
        self.found = _over_library(found, self.library)

    def hopeless(self) -> str | None:
        """Why no training can pass, in words; None where one can."""
        if (fault := self.portrait.fault()) is not None:
            return sentence(fault)
        if len(self.wells) < len(self.portrait.attractors):
            return "the local route found no formula about some attractor"
        return None

    def accepted(self, networks: TrainedNetworks) -> TrainedNetworks | None:
        """The networks of one run where refinement will succeed from them."""
        if self.hopeless() is not None:
            return None
        potential = networks.potential_at
        return networks if self._single_formula(potential) or self._by_wells(potential) else None

    def _single_formula(self, potential: Function) -> bool:
        points = self.portrait.points
        values = potential(points)
        below = values <= np.quantile(values, CHECK_SHARE)
        start = fit_values(self.library, [points[below]], [values[below]])
        result = refine_globally(start, self.found, points[below], sparse=False)
        basis = LibraryBasis.of_potential(self.library)
        own = result.potential[basis.chosen]
        worst = check_agreement(lambda x: basis.values(x) @ own, self.wells, limit=0.0).value
        logger.info("check of one formula: residual %.1e, difference %.1e", result.residual, worst)
        return result.residual < self.options.residual / 10 and worst < self.options.difference

    def _by_wells(self, potential: Function) -> bool:
        for index, local in enumerate(self.wells):
            try:
                well = fit_well(
                    self.found.dynamics, self.portrait, index, potential, degree=local.degree,
                    steps=CHECK_STEPS,
                )  # fmt: skip
            except NumericalFailure:
                return False
            difference = check_agreement(well.values, [local], limit=0.0).value
            logger.info("check of a well: residual %.1e, difference %.1e", well.residual, difference)
            allowed = self.options.difference + 2 * (local.residual + well.residual)
            if well.residual > self.options.residual or difference > allowed:
                return False
        return True
