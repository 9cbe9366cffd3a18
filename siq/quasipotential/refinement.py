"""Refinement: V from the identified f and the recorded states, with its certificate.

V is grown from each attractor of the identified f, and one formula is sought for the whole recorded region.
Networks take no part: where there are some, they are a second route to V from the same recordings. The
certificate compares their own V with the refined one, within the errors of both
(`siq.quasipotential.certificate.check_agreement`). As a control it also compares networks whose weights were
put in random order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as pydantic_dataclass

from siq.data.recordings import Recordings, SnapshotPairs, parent_recordings, snapshot_pairs
from siq.errors import NumericalFailure
from siq.inference.claims import check_claims
from siq.inference.field_estimate import FieldEstimate
from siq.inference.kalman_identification import filtered_recordings
from siq.inference.library import CandidateLibrary, candidate_library
from siq.inference.regression import coarse_pairs, lagged_pairs, refit
from siq.networks.decomposition import AnyNetworks, shuffled
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.certificate import (
    Certificate,
    Evidence,
    caustics_below,
    certify,
    certify_wells,
    check_agreement,
    references_about,
    uncertified,
)
from siq.quasipotential.certificate_tests import MAX_PAIRS, MIN_POINTS, CertificateOptions
from siq.quasipotential.formulas import SymbolicDecomposition, decomposition_from_coefficients
from siq.quasipotential.global_formula import GlobalFormula, fit_values, refine_globally
from siq.quasipotential.hamilton_jacobi import MAX_POWERS, affordable_degree
from siq.quasipotential.occupancy import OccupancyCheck, check_occupancy
from siq.quasipotential.path_chains import evenly
from siq.quasipotential.rates import NoiseStrength
from siq.quasipotential.transitions import Transition, ways_out
from siq.quasipotential.wells import MIN_OUTLIER_RESIDUAL, RESIDUAL_TOLERANCE, Well, local_well
from siq.remarks import Remark
from siq.systems.basins import basin_of, follow
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at
from siq.systems.phase_portrait import (
    LEVEL_BEYOND_SADDLE,
    STARTS_NEAR_ATTRACTOR,
    PhasePortrait,
    RecordedRegion,
    evenly_spread,
    phase_portrait,
)

STATES_ALONG_PATH = 300  # from the neighbourhood of which further descents start
PATH_NEIGHBOURHOOD = (0.02, 0.05, 0.1)  # of the extent of the well: how far from the path
OF_FORMULAS = {"hamilton_jacobi", "descent", "characteristics", "error"}  # tests of V alone, given f

Route = Literal["network", "local"]
Degree = Annotated[int, Field(ge=2, le=16)]


@pydantic_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class RefinementOptions:
    """How V is refined, about each attractor and over the whole region."""

    #: Highest powers about an attractor that are tried, one after the other
    degrees: Annotated[tuple[Degree, ...], Field(min_length=1)] = (4, 6, 8, 10, 12)
    #: Relative Hamilton–Jacobi residual below which no higher power is tried
    accuracy: Annotated[float, Field(gt=0)] = MIN_OUTLIER_RESIDUAL
    #: Functions of V about an attractor: ``powers``, random tanh ``units``, or ``auto``, units where powers
    #: leave an error of more than 0.1 % and units a smaller one
    about: Literal["auto", "powers", "units"] = "auto"
    #: Level up to which a formula is sought, as a share of V at the lowest saddle
    reach: Annotated[float, Field(gt=0, le=3)] = 1.2
    #: Largest relative Hamilton–Jacobi residual at a point where a formula is believed
    tolerance: Annotated[float, Field(gt=0, lt=1)] = RESIDUAL_TOLERANCE
    #: V always comes from the ``local`` one. With ``network`` that of the networks has to agree with it, or
    #: no formula is certified; so it is by default where networks are asked for, see `with_routes`.
    routes: Annotated[tuple[Route, ...], Field(min_length=1)] | None = None
    #: Highest power of one formula for the whole region; by default what the identified f allows: one more
    #: than that of f, and at least four
    formula_degree: Annotated[int, Field(ge=1, le=12)] | None = None
    #: Further functions that such a formula may use, as formulas of the states, beside those of f
    functions: tuple[str, ...] = ()
    #: Largest relative Hamilton–Jacobi residual with which one formula stands for the whole region
    single_formula: Annotated[float, Field(gt=0)] = 0.005
    #: Probability that the uncertainty of f brings any false term into V
    false_terms: Annotated[float, Field(gt=0, lt=0.5)] = 0.01
    #: Terms that contribute less than this share are dropped in any case
    precision: Annotated[float, Field(gt=0, lt=0.1)] = 1e-7

    def with_routes(self, *, networks: bool) -> RefinementOptions:
        """These options with the routes named, where none were named: those that there are."""
        there: tuple[Route, ...] = ("network", "local") if networks else ("local",)
        return self if self.routes is not None else replace(self, routes=there)


@dataclass(frozen=True)
class _Refined:
    """V about the attractors and over the region."""

    found: FieldEstimate  #: over the functions of a formula for the region: those of f and of V together
    wells: tuple[Well, ...]  #: one for each attractor
    remarks: tuple[Remark, ...] = ()  #: what could not be done
    formula: GlobalFormula | None = None  #: V and g where one formula holds over the whole region


def _formula_library(found: FieldEstimate, options: RefinementOptions) -> CandidateLibrary:
    """The functions in which one formula of V is sought for the whole region: all of f's are among them.

    No polynomial V has a higher degree than f has, and one: of ``∇V·(f + D∇V) = 0`` the highest powers would
    be those of ``∇V·D∇V``, which cannot vanish where D is regular. A quartic is the least that has two wells.
    """
    own, degree = found.library, options.formula_degree
    if degree is None:
        highest = max(own.total_degree(term) for _, term in found.support)
        degree = affordable_degree(own.dimension, max(4, highest + 1))
    named = (
        name for name, term in zip(own.names, own.terms, strict=True) if not term.is_polynomial(*own.symbols)
    )
    further = tuple(dict.fromkeys((*options.functions, *named)))  # V may use those that are no monomials
    whole = max(degree, *(own.total_degree(k) for k in range(own.size)))
    return candidate_library(own.states, degree=whole, potential_degree=degree, further=further)


def refine(
    found: FieldEstimate, portrait: PhasePortrait, ways: Sequence[Transition], *, points: np.ndarray,
    options: RefinementOptions, seed: int = 0,
) -> _Refined:  # fmt: skip
    """V about each attractor, and one formula over the recorded states ``(n, d)`` where one holds.

    The `ways` out say how deep wells are. The seed decides which points are used where there are too many.
    """
    draw = np.random.default_rng(seed)
    local, _, remarks = local_wells(found.dynamics, portrait, ways, options=options, seed=seed, draw=draw)
    wells = tuple(well for well in local if well is not None)
    if found.library.angles:  # one formula of V that is periodic, or not, would have to be chosen
        return _Refined(found, wells, (*remarks, Remark("quasipotential.no_single_formula")))
    library = _formula_library(found, options)
    found = _over_library(found, library)
    # The errors of f make some of the residual with which one formula is believed to hold.
    errors = np.abs(np.sqrt(np.diag(found.covariance)) / found.values)
    noise = 0.0 if found.noise_free else 3 * float(np.sqrt((errors**2).mean()))

    def starts() -> Iterator[np.ndarray]:
        """Where one formula may begin; none is asked for once a formula is good enough."""
        if found.diffusion.constant and found.diffusion.regular:
            # Solved for one by one, the wells may turn out to share one formula. All of them together make
            # the start: one alone does not tell an odd power from an even one, and goes on wrongly elsewhere.
            for some in (wells, *([well] for well in wells if len(wells) > 1)) if wells else ():
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
            whole = best.with_circulation(found, points, single_formula=options.single_formula, **accepted)
            if whole is not None:
                if not (whole.joint or found.noise_free):
                    remarks.append(Remark("quasipotential.not_orthogonal"))
                return _Refined(found, wells, tuple(remarks), whole)
        remarks.append(Remark("quasipotential.no_single_formula"))
    return _Refined(found, wells, tuple(remarks))


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
    dynamics: Dynamics, portrait: PhasePortrait, ways: Sequence[Transition], *, options: RefinementOptions,
    seed: int, draw: np.random.Generator,
) -> tuple[list[Well | None], PhasePortrait, list[Remark]]:  # fmt: skip
    """V about each attractor, the portrait with states along paths, and where there is no V, and why.

    Of each well the way out with the least action, where there is one, says how deep the well is.
    """
    known = sorted((way for way in ways if way.path), key=lambda way: way.path.action if way.path else 0.0)
    least = {way.start: way for way in reversed(known)}
    lowest = [least.get(index) for index in range(len(portrait.attractors))]
    portrait = _with_states_along_paths(dynamics, portrait, lowest, draw)
    wells, remarks = list[Well | None](), list[Remark]()
    for index, way in enumerate(lowest):
        saddle, path = (None, None) if way is None else (way.saddle, way.path)
        try:
            wells.append(
                local_well(dynamics, portrait, index, options=options, seed=seed, saddle=saddle, path=path)
            )
        except NumericalFailure as error:
            place = portrait.attractors[index].position.round(4).tolist()
            remarks.append(Remark("quasipotential.no_formula", {"place": place, "reason": str(error)}))
            wells.append(None)
    return wells, portrait, remarks


def _with_states_along_paths(
    system: Dynamics, portrait: PhasePortrait, lowest: Sequence[Transition | None], draw: np.random.Generator
) -> PhasePortrait:
    """The portrait with more states about the lowest way out of each well, where it may be narrow."""
    basins = list(portrait.basins)
    for index, (one, way) in enumerate(zip(portrait.attractors, lowest, strict=True)):
        if way is None or way.path is None or system.dimension == 1:
            continue
        metric = np.linalg.cholesky(hessian_at(system, one.position))
        depth, places = way.path.action / 2, basins[index].points(np.arange(len(basins[index].chosen)))
        heights = np.sum(((places - one.position) @ metric) ** 2, axis=1) / 2
        if (heights < depth).sum() < 2 * MAX_POWERS:  # V at the saddle is far lower than M alone had it
            near = (STARTS_NEAR_ATTRACTOR, LEVEL_BEYOND_SADDLE * depth)
            basins[index] = basin_of(
                system, portrait.descents, index, portrait.attractors, box=portrait.box, generator=draw,
                near=near,
            )  # fmt: skip
        extent = np.linalg.inv(metric) * np.sqrt(way.path.action)
        along = evenly(way.path.points, STATES_ALONG_PATH)
        starts = [along + share * draw.standard_normal(along.shape) @ extent for share in PATH_NEIGHBOURHOOD]
        ways = follow(system, np.concatenate(starts), portrait.attractors, box=portrait.box)
        basins[index] = basins[index].enlarged(ways.paths[ways.ends == index], one.position, generator=draw)
    return replace(portrait, basins=tuple(basins))


def _refined_decomposition(refined: _Refined, points: np.ndarray) -> SymbolicDecomposition:
    """V, g and f of a refinement, V zero at its minimum within the box of recorded states ``(n, d)``.

    f is that which was identified, so that f = -D∇V + g is a statement and no definition. Where there is
    one attractor only, its well's formula stands for the whole where no other was found.
    """
    found, formula = refined.found, refined.formula
    library, wells = found.library, refined.wells

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
        self, recordings: Recordings, found: FieldEstimate, networks: AnyNetworks | None, *, number: int,
        seed: int, pair_step: float | None, refinement: RefinementOptions, limits: CertificateOptions,
    ) -> None:  # fmt: skip
        self.found, self.networks = found, networks
        self.number, self.seed, self.limits = number, seed, limits
        self.options = refinement.with_routes(networks=networks is not None)
        mask = recordings.held_out(generator=generator(seed, number, Purpose.HOLD_OUT))
        self.measured, self.pair_step = recordings, pair_step
        if found.sensor_variance is not None or found.hidden_states:
            # Of measured values the increments do not have the mean of f.
            recordings = filtered_recordings(found, recordings, pair_step=pair_step)
        pairs = found.wrapped(snapshot_pairs(recordings, pair_step=pair_step))
        held, x = mask[pairs.recording], pairs.x0
        if held.all() or not held.any():
            raise NumericalFailure(
                "the samples of some recordings are so much closer than those of others that these make no"
                " pairs, and nothing is held out; give recordings of one time between samples"
            )
        draw = generator(seed, number, Purpose.REFINE)
        self.points = x[~held][evenly_spread(x[~held], generator=draw)]
        self.held_out = x[held][evenly_spread(x[held], generator=draw)]
        if (memory := found.memory) is not None:
            pairs = found.wrapped(coarse_pairs(recordings, memory[0], lost=memory[1]))
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

    def refine_and_certify(self) -> Refinement:
        """Refined formulas of the run with their certificate."""
        refined, formulas, certificate = self._certified()
        found, caustics = self.found, caustics_below(self.evidence.references, certificate.error)
        # Hops and histogram of the record, compared with those that f predicts.
        strength = found.noise_strength
        try:
            record = check_occupancy(
                found, self.portrait,
                None if strength is None else NoiseStrength(*strength, source="estimated"),
                self.recordings, self._halves(), measured=self.measured, seed=self.number,
            )  # fmt: skip
        except (NumericalFailure, np.linalg.LinAlgError) as error:
            record = OccupancyCheck(missing=Remark("quasipotential.reason", {"reason": str(error)}))
        if not found.noise_free:
            each = self.limits.each
            states = self.measured if found.flow.by_density else self.recordings
            claims = check_claims(found, states, self.measured, pair_step=self.pair_step, false_alarms=each)
            certificate = certificate.with_tests(claims | record.verdicts(false_alarms=each))
        return Refinement(formulas, certificate, record, (*refined.remarks, *caustics))

    def _halves(self) -> list[tuple[FieldEstimate, np.ndarray]]:
        """Each half of the recordings with the terms of f fitted to the other one.

        Of hidden velocities f follows from whole recordings alone: all of them have the f of all.
        """
        # The densities of noisy samples are of measured values.
        found = self.found
        recordings = self.measured if found.flow.by_density else self.recordings
        parents = parent_recordings(recordings.labels)
        second = np.searchsorted(np.unique(parents), parents) % 2 == 1
        if found.noise_free or found.hidden_states or second.all() or not second.any():
            return [(found, np.ones(len(second), dtype=bool))]
        halves = []
        for mask in (second, ~second):
            other = recordings.select(np.flatnonzero(~mask))
            try:
                if (memory := found.memory) is not None:
                    fit = refit(found, lagged_pairs(other, memory[0]))
                else:
                    fit = refit(found, snapshot_pairs(other, pair_step=self.pair_step))
            except (NumericalFailure, np.linalg.LinAlgError, ValueError):
                fit = found
            halves.append((fit, mask))
        return halves

    def control(self, refined: SymbolicDecomposition | None) -> dict[str, Any]:
        """What the comparison with the refined V says of networks with their weights in random order.

        It stands in `model.json` as a certificate with one test, which has to refuse them.
        """
        assert self.networks is not None
        randomised = shuffled(self.networks, generator=generator(self.seed, self.number, Purpose.SHUFFLE))
        if refined is None or not (refined.wells or refined.potential is not None):
            return uncertified("there is no refined V to compare with")
        formulas = refined if refined.potential is not None else refined.wells
        verdict = check_agreement(randomised, formulas, self.evidence)
        reason = (
            "networks with their weights in random order agree with the refined V: agreement is no evidence"
        )
        reason = reason if verdict.passed else verdict.reason
        return uncertified(reason) | {"tests": {"agreement": verdict.as_data()}}

    def _certified(self) -> tuple[_Refined, SymbolicDecomposition, Certificate]:
        """V about the attractors and over the region, with the certificate of what is to stand.

        Formulas that grow by themselves are the shortest. Where they are refused as formulas, they are sought
        once more, up to where paths of least action say that wells end.
        """
        first = self._certified_up_to((), self.evidence)
        refused = {name for name, test in first[2].tests.items() if test.tested and not test.passed}
        if first[2].certified or not refused <= OF_FORMULAS:
            return first
        ways = ways_out(self.found.dynamics, self.portrait)
        references = references_about(self.found.dynamics, self.portrait, ways=ways, seed=self.number)
        evidence = replace(self.evidence, references=references)
        again = self._certified_up_to(ways, evidence)
        if not again[2].certified:
            return first
        self.evidence = evidence
        return again

    def _certified_up_to(
        self, ways: Sequence[Transition], evidence: Evidence
    ) -> tuple[_Refined, SymbolicDecomposition, Certificate]:
        refined = refine(
            self.found, self.portrait, ways, points=self.points, options=self.options, seed=self.number
        )
        formulas, whole = _refined_decomposition(refined, self.points), refined.formula
        told: dict[str, Any] = {
            "networks": self.networks,
            "compared": "network" in (self.options.routes or ()),
        }
        alone = refined
        if formulas.potential is not None:
            error = 0.0
            if whole is not None and not self.found.noise_free:
                error = whole.relative_error(refined.found.library.evaluate(self.points))
            certificate = certify(formulas, evidence, relative_error=error, **told)
            if certificate.certified or not refined.wells:
                return refined, formulas, certificate
            # One formula for all wells is an extra. What refuses it is no word against the wells.
            refused = Remark("quasipotential.single_formula_refused", {"reason": certificate.reason})
            alone = replace(refined, formula=None, remarks=(*refined.remarks, refused))
        wells, of_wells = certify_wells(refined.wells, evidence, **told)
        if formulas.potential is not None and not of_wells.certified:
            return refined, formulas, certificate
        alone = replace(alone, wells=tuple(well for well in wells if well is not None))
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
