"""Landscapes found: of a vector field that was identified from recordings, and of given equations.

Of an identified f the wells are those of the refinement, or local formulas about the attractors that recorded
states lead to. Of given equations equilibria are sought over the domain, the paths of least action lead from
each attractor to the saddles next to it, and these tell how deep each well is before V about it is sought,
degree by degree. V is certified by characteristics, as that of recordings is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import sympy
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from siq.errors import InputError, NumericalFailure
from siq.inference.field_estimate import AnyField, FieldEstimate, dynamics_of
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.certificate import (
    Certificate,
    Evidence,
    caustics_below,
    certify_wells,
    references_about,
)
from siq.quasipotential.certificate_tests import CertificateOptions
from siq.quasipotential.global_formula import heights_of_attractors
from siq.quasipotential.landscape import Landscape, LandscapeOptions, NoLandscape
from siq.quasipotential.rates import NoiseStrength
from siq.quasipotential.refinement import RefinementOptions, local_wells
from siq.quasipotential.transitions import Transition, position_standard_errors, transitions, ways_out
from siq.quasipotential.wells import Well
from siq.remarks import Remark, sentence
from siq.systems.cards import load_system
from siq.systems.cycles import Cycle
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import Equilibrium, spread_evenly, unreached_states
from siq.systems.formulas import FormulaError, compile_formulas, formulas_in_time
from siq.systems.phase_portrait import MOST_SEARCHED, PhasePortrait, phase_portrait

ATTRACTOR_MATCH_TOLERANCE = 1e-6  # of the recorded box: one attractor, from different starts
TRIED_STATES = 400  # of the domain, at which equations must have a value
UNSEEN_STATES = 1024  # of the domain, and of the box of each well, that no fit sees


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class EquationSettings:
    """What the landscape of equations depends on, beside the equations."""

    seed: int = 0  #: Of the sequences of states that stand for the domain
    #: How V about an attractor is sought: degrees, functions, accuracy, reach and tolerance.
    refinement: RefinementOptions = RefinementOptions()
    certificate: CertificateOptions = CertificateOptions()  #: the limits of its tests
    #: ε for which escape times are given: the first of `noise_intensities`.
    landscape: LandscapeOptions = LandscapeOptions()


def find_landscape(
    found: FieldEstimate,
    portrait: PhasePortrait,
    *,
    wells: Sequence[Well] | None = None,
    certificate: Certificate | None = None,
    options: RefinementOptions = RefinementOptions(),  # noqa: B008 (frozen)
    noise: NoiseStrength | None = None,
    seed: int = 0,
) -> Landscape:
    """Find the landscape of an identified vector field.

    Parameters
    ----------
    found, portrait
        The identified f with its uncertainty, and its attractors, saddles and basins.
    wells, certificate
        V about the attractors as refinement found it, and its certificate; by default the local route finds V
        here, by the options.
    noise
        That drives the system, where it is known.
    seed
        Decides which points are used where there are too many.
    """
    fault, kept = portrait.fault(), list[Well | None]()
    remarks = [] if fault is None else [fault]
    width = portrait.box[:, 1] - portrait.box[:, 0]
    paths = ways_out(found.dynamics, portrait)
    if wells is None:
        draw = generator(seed, Purpose.LANDSCAPE)
        kept, _, more = local_wells(found.dynamics, portrait, paths, options=options, seed=seed, draw=draw)
        remarks += more
    else:
        for index, one in enumerate(portrait.attractors):
            away = [np.abs((well.attractor - one.position) / width).max() for well in wells]
            same = [well for well, far in zip(wells, away, strict=True) if far < ATTRACTOR_MATCH_TOLERANCE]
            kept.append(same[0].surveyed(found.dynamics, portrait, index) if same else None)
            if not same:
                place = one.position.round(4).tolist()
                remarks.append(Remark("quasipotential.no_refined_formula", {"place": place}))
    # What no certificate vouches for says nothing of barriers: paths of least action alone do.
    test = None if certificate is None else certificate.tests.get("error")
    ways = transitions(found, paths, kept if test is None or test.passed else [None] * len(kept))
    return _assembled(found, portrait, kept, ways, remarks, certificate=certificate, noise=noise)


def landscape_from_equations(
    system: str | Path | Dynamics, settings: EquationSettings | None = None, *, formulas: bool = True
) -> Landscape:
    """The landscape of given equations; see `siq.Landscape.from_equations`.

    Without `formulas` U is not written as a formula: barriers and times follow from the paths alone, which
    takes a small part of the time.
    """
    system, settings = usable_system(system), settings or EquationSettings()
    many = system.dimension > MOST_SEARCHED
    try:
        portrait = phase_portrait(system, seed=settings.seed)
    except NumericalFailure as error:
        raise NoLandscape(str(error), None, system) from None
    fault, points = portrait.fault(), len(portrait.attractors)
    if not (portrait.attractors or portrait.cycles):
        why = "f has no stable equilibrium in the domain" if fault is None else sentence(fault)
        raise NoLandscape(why, None, system)
    remarks = [] if fault is None else [fault]
    remarks += portrait.remarks
    if portrait.cycles:
        beside_points = Remark("quasipotential.cycle_beside_formulas")
        remarks.append(beside_points if points else Remark("quasipotential.cycles_alone"))
        if not system.diffusion.regular:
            remarks.append(Remark("quasipotential.cycles_need_noise_on_every_state"))
        elif system.dimension > 2:
            remarks.append(Remark("quasipotential.unstable_cycles_sought_along_boundaries"))
    ways = ways_out(system, portrait, beyond_region=True)
    wells: list[Well | None] = [None] * points
    certificate = None
    if many and formulas and points:
        remarks.append(Remark("quasipotential.too_many_states", {"states": system.dimension}))
    elif formulas and points:
        draw, seed = generator(settings.seed, Purpose.LANDSCAPE), settings.seed
        wells, portrait, more = local_wells(
            system, portrait, ways, options=settings.refinement, seed=seed, draw=draw
        )
        remarks += more
        sought = [well for well in wells if well is not None]
        boxes = [np.stack([well.points.min(axis=0), well.points.max(axis=0)], axis=1) for well in sought]
        unseen = [spread_evenly(box, UNSEEN_STATES, generator=draw) for box in (system.box, *boxes)]
        evidence = Evidence(
            system, portrait, np.concatenate(unseen), options=settings.certificate, seed=seed,
            references=references_about(system, portrait, ways=ways, seed=seed),
        )  # fmt: skip
        wells, certificate = certify_wells(wells, evidence)
        remarks += caustics_below(evidence.references, certificate.error)
    wells += [None] * len(portrait.cycles)
    noises = settings.landscape.noise_intensities
    found = _assembled(
        system, portrait, wells, transitions(system, ways, wells), remarks, certificate=certificate,
        noise=NoiseStrength(noises[0]) if noises else None,
    )  # fmt: skip
    return found.with_checked_times(settings.landscape, seed=settings.seed)


def usable_system(system: str | Path | Dynamics) -> Dynamics:
    """A system whose landscape can be worked out, read from its card; an `InputError` where there is none."""
    given = system if isinstance(system, Dynamics) else load_system(system)
    if (fault := fault_for_landscape(given, directly=False)) is not None:
        keys, what, remedy = fault
        named = given.name or "the system" if isinstance(system, Dynamics) else system
        raise InputError(named, ".".join(keys), what, remedy)
    return given


def fault_for_landscape(system: Dynamics, *, directly: bool) -> tuple[tuple[str, ...], str, str] | None:
    """Why no landscape of a system can be worked out: the place in its card, the fault and the remedy.

    `directly` is whether noise has to act on every state, as trajectories ask for, or may reach it by way of
    others.
    """
    if not system.autonomous:
        key, what = ("inputs", "inputs") if system.inputs else ("equations", "time")
        remedy = f"leave the {what} out, or use the card in a study of mismatch"
        return (key,), "a driven system has no quasipotential", remedy
    for name, limits in zip(system.states, system.limits, strict=True):
        if np.isnan(limits).any():
            what = f"the state '{name}' has no domain, in which a simulation could begin"
            return ("states", name), what, "add 'domain: [lower, upper]' to it"
    if directly and not system.diffusion.regular:
        what = "the noise does not reach every state directly, as it has to where f comes from trajectories"
        remedy = (
            "give a positive definite matrix, or ask for the landscape of these equations: 'from: equations'"
        )
        return ("diffusion",), what, remedy
    if still := unreached_states(system):
        what = f"the noise does not reach {' and '.join(still)}, neither directly nor by way of other states"
        remedy = f"let it act on {still[0]} or on a state in its equation, or leave it out"
        return ("diffusion",), what, remedy
    if (found := _fault_over_domain(system)) is not None:
        remedy = "choose a domain in which it has a value"
        return ("equations", found[0]), f"the equation {found[1]}", remedy
    return None


def _fault_over_domain(dynamics: Dynamics) -> tuple[str, str] | None:
    """A state whose equation has no value somewhere in the domain, with what is wrong; None for none.

    States at random and the corners tell what overflows; a divisor that changes its sign between them is zero
    somewhere, though no state of a sample meets it.
    """
    low, high = dynamics.box.T
    x = np.random.default_rng(0).uniform(low, high, size=(TRIED_STATES, dynamics.dimension))
    x = np.concatenate([x, low[None], high[None]])
    with np.errstate(all="ignore"):
        try:
            with formulas_in_time("the derivatives"):
                flow, slopes = dynamics.drift(x), dynamics.jacobian(x)
                dynamics.hessian(x[:1])  # on which paths and series depend
        except FormulaError as error:
            raise error.at(dynamics.name or "the system", "equations") from None
        for index, (name, formula) in enumerate(zip(dynamics.states, dynamics.formulas, strict=True)):
            bases = [one.base for one in formula.atoms(sympy.Pow) if one.exp.is_negative]
            divisors = compile_formulas(bases, dynamics.symbols)(np.ascontiguousarray(x.T))
            if any(values.min() <= 0 <= values.max() for values in divisors):
                return name, "divides by zero within the domain"
            if not (np.isfinite(flow[:, index]).all() and np.isfinite(slopes[:, index]).all()):
                return name, "is too large for a number, or not defined, in a part of the domain"
    return None


def _assembled(
    found: AnyField, portrait: PhasePortrait, wells: Sequence[Well | None], ways: Sequence[Transition],
    remarks: list[Remark], *, certificate: Certificate | None, noise: NoiseStrength | None,
) -> Landscape:  # fmt: skip
    """The landscape of what was found, with the heights of its attractors."""
    left = None if certificate is None else certificate.tests.get("error")
    if left is not None and np.isfinite(left.value):
        ways = [replace(way, of_residual=left.value * abs(way.formula_share * way.barrier)) for way in ways]
    settled: tuple[Equilibrium | Cycle, ...] = (*portrait.attractors, *portrait.cycles)
    barriers = np.full((len(settled), len(settled)), np.inf)
    for way in ways:
        if way.end is not None and np.isfinite(way.barrier):
            barriers[way.start, way.end] = min(barriers[way.start, way.end], way.barrier)
    try:
        heights = heights_of_attractors(barriers) if settled else np.zeros(0)
    except NumericalFailure as error:
        remarks.append(Remark("quasipotential.reason", {"reason": str(error)}))
        heights = np.full(len(settled), np.nan)
    return Landscape(
        dynamics_of(found), portrait.equilibria, settled, portrait.shares,
        tuple(wells), tuple(ways), heights, tuple(remarks), certificate,
        np.array([position_standard_errors(found, one.position) for one in settled]),
        noise, None if isinstance(found, Dynamics) else found,
        given=isinstance(found, Dynamics), parting=portrait.parting,
    )  # fmt: skip
