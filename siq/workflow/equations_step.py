"""Equations: the landscape of given equations, without recordings, sampling or training.

Equilibria are sought over the domain, the paths of least action lead from each attractor to the saddles next
to it, and these tell how deep each well is before V about it is sought, degree by degree. V is certified by
characteristics, as that of recordings is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from pydantic.dataclasses import dataclass

from siq.errors import InputError, NumericalFailure
from siq.inference.field_estimate import GivenField
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.certificate import Evidence, caustics_below, certify, references_about
from siq.quasipotential.certificate_tests import CertificateOptions
from siq.quasipotential.landscape import Landscape, LandscapeOptions, NoLandscape
from siq.quasipotential.landscape_assembly import assembled
from siq.quasipotential.landscape_files import write_landscape
from siq.quasipotential.path_chains import evenly
from siq.quasipotential.rates import NoiseStrength
from siq.quasipotential.refinement import RefinementOptions
from siq.quasipotential.transitions import WayOut, transitions, ways_out
from siq.quasipotential.wells import Depth, Well, local_well
from siq.systems.basins import enlarged
from siq.systems.cards import load_system
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at, spread_evenly
from siq.systems.phase_portrait import (
    MOST_SEARCHED,
    PhasePortrait,
    domain_portrait,
    high_dimensional_portrait,
)
from siq.workflow.landscape_step import degree_rows, landscape_rows
from siq.workflow.outcomes import Method, Outcome, Status, Step
from siq.workflow.settings import STRICT
from siq.workflow.study import fault_for_landscape
from siq.workflow.tables import as_table, write_table

ALONG = 300  # states along a path, from the neighbourhood of which further descents start
BESIDE = (0.02, 0.05, 0.1)  # of the extent of the well: how far from the path
UNSEEN = 1024  # states of the domain, and of the box of each well, that no fit sees


@dataclass(frozen=True, config=STRICT)
class EquationSettings:
    """What the landscape of equations depends on, beside the equations.

    Attributes
    ----------
    seed
        Of the sequences of states that stand for the domain.
    refinement
        How V about an attractor is sought: degrees, accuracy, reach and tolerance.
    certificate
        The limits of its tests.
    landscape
        ε for which escape times are given: the first of `noise_intensities`.
    """

    seed: int = 0
    refinement: RefinementOptions = RefinementOptions()
    certificate: CertificateOptions = CertificateOptions()
    landscape: LandscapeOptions = LandscapeOptions()


def usable_system(system: str | Path | Dynamics) -> Dynamics:
    """A system whose landscape can be worked out, read from its card where a path is given.

    Raises
    ------
    InputError
        In one sentence, for a card that cannot be read and a system that has no landscape.
    """
    given = system if isinstance(system, Dynamics) else load_system(system)
    if (fault := fault_for_landscape(given, directly=False)) is not None:
        keys, what, remedy = fault
        named = given.name or "the system" if isinstance(system, Dynamics) else system
        raise InputError(named, ".".join(keys), what, remedy)
    return given


def landscape_of_equations(
    system: Dynamics, settings: EquationSettings, *, formulas: bool = True
) -> Landscape:
    """Wells, ways out and U of a system that `usable_system` has let pass.

    Parameters
    ----------
    system
        f and D with the domain.
    settings
        Of all steps.
    formulas
        Whether U is written as a formula. Barriers and times follow from the paths alone, which takes a small
        part of the time.

    Raises
    ------
    NoLandscape
        When it has no stable equilibrium in its domain.
    """
    draw = generator(settings.seed, Purpose.LANDSCAPE)
    try:
        many = system.dimension > MOST_SEARCHED
        portrait = (high_dimensional_portrait if many else domain_portrait)(system, seed=settings.seed)
    except NumericalFailure as error:
        raise NoLandscape(str(error), None, system) from None
    fault = portrait.fault()
    if not (portrait.attractors or portrait.cycles):
        raise NoLandscape(fault or "f has no stable equilibrium in the domain", None, system)
    found, notes = GivenField(system), [*([] if fault is None else [fault]), *portrait.notes]
    notes += _about_cycles(system, portrait)
    ways = ways_out(system, portrait, beyond_region=True)
    wells: list[Well | None] = [None] * len(portrait.attractors)
    certificate = None
    if not portrait.attractors:
        pass
    elif many and formulas:
        notes.append(
            f"powers of {system.dimension} states are too many to write V in: barriers and times follow from"
            " the paths of least action, which need f alone"
        )
    elif formulas:
        portrait = _along_paths(system, portrait, ways, draw)
        wells = [
            _well(system, portrait, ways, index, settings, notes) for index in range(len(portrait.attractors))
        ]
        sought = [well for well in wells if well is not None]
        references = references_about(system, portrait, depths=_depths(portrait, ways), seed=settings.seed)
        evidence = Evidence(
            found, portrait, _unseen(system, sought, draw), references=references,
            options=settings.certificate, seed=settings.seed,
        )  # fmt: skip
        certificate = certify(sought, evidence)
        notes += caustics_below(system, sought, portrait, certificate.error, seed=settings.seed)
    wells += [None] * len(portrait.cycles)
    noises = settings.landscape.noise_intensities
    return assembled(
        found, portrait, wells, transitions(found, ways, wells), notes, certificate=certificate,
        noise=NoiseStrength(noises[0]) if noises else None,
    )  # fmt: skip


@plain_dataclass(frozen=True)
class FoundOfEquations:
    """The landscape of a study of equations, None where there is none, and what became of the step."""

    landscape: Landscape | None
    outcome: Outcome


def run(settings: EquationSettings, system: Dynamics) -> FoundOfEquations:
    """The landscape of a system; where it has none, the outcome says why."""
    try:
        found = landscape_of_equations(system, settings)
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        reason = error.reason if isinstance(error, NoLandscape) else str(error)
        return FoundOfEquations(None, Outcome(0, Step.LANDSCAPE, Status.FAILED, reason))
    whole = found.over_wells is not None
    outcome = Outcome(0, Step.LANDSCAPE, Status.OK if whole else Status.WARNING, "; ".join(found.notes))
    return FoundOfEquations(found, outcome)


def write(found: FoundOfEquations, *, quasipotential: str | Path, tables: Mapping[str, str | Path]) -> None:
    """Write `quasipotential.json`, empty where there is no landscape, and the tables by name.

    Parameters
    ----------
    found
        What `run` gave.
    quasipotential
        Its file.
    tables
        Files of ``landscape``, ``degrees``, ``certificates`` and ``outcomes``.
    """
    rows: dict[str, pd.DataFrame] = {name: as_table(name, []) for name in tables}
    kept = found.outcome
    rows["outcomes"] = as_table("outcomes", [kept.as_data() | {"step": kept.step, "status": kept.status}])
    if found.landscape is None:
        Path(quasipotential).touch()
    else:
        write_landscape(quasipotential, found.landscape, dynamics=found.landscape.dynamics)
        rows["landscape"] = landscape_rows(0, found.landscape)
        rows["degrees"] = degree_rows(0, found.landscape)
        certificate = found.landscape.certificate
        made = {} if certificate is None else certificate.tests
        rows["certificates"] = as_table(
            "certificates",
            [
                {"run": 0, "method": str(Method.REFINED), "test": name} | verdict.as_data()
                for name, verdict in made.items()
            ],
        )
    for name, path in tables.items():
        write_table(path, rows[name])


def _about_cycles(system: Dynamics, portrait: PhasePortrait) -> list[str]:
    """What has to be known of a landscape with limit cycles, in words."""
    notes = []
    if portrait.cycles and portrait.attractors:
        notes.append(
            "about a limit cycle U is not written as a formula: barriers out of it and into it are the"
            " actions of paths, and the certificate is of the other attractors"
        )
    elif portrait.cycles:
        notes.append(
            "about a limit cycle U is not written as a formula, and there is nothing to certify: its"
            " barriers are the actions of paths"
        )
    if portrait.cycles and not system.diffusion.regular:
        notes.append(
            "paths from and to cycles are found where noise acts on every state: here it acts on some only,"
            " and the barriers of cycles are not known"
        )
    elif portrait.cycles and system.dimension > 2:
        notes.append(
            "unstable cycles that part basins were sought by following boundaries between attractors; nothing"
            " proves that none was missed"
        )
    return notes


def _lowest(ways: list[WayOut], index: int) -> WayOut | None:
    """The lowest way out of a well, None where there is none."""
    mine = [way for way in ways if way.start == index and way.path is not None]
    return min(mine, key=lambda way: way.path.uphill.action if way.path else np.inf, default=None)


def _depths(portrait: PhasePortrait, ways: list[WayOut]) -> list[float]:
    """V at the lowest saddle of each well; infinite where no way out of it is known."""
    lowest = [_lowest(ways, index) for index in range(len(portrait.attractors))]
    return [np.inf if way is None or way.path is None else way.path.uphill.action / 2 for way in lowest]


def _along_paths(
    system: Dynamics, portrait: PhasePortrait, ways: list[WayOut], draw: np.random.Generator
) -> PhasePortrait:
    """The portrait with more states about the lowest way out of each well, where it may be narrow."""
    basins = list(portrait.basins)
    for index, one in enumerate(portrait.attractors):
        way = _lowest(ways, index)
        if way is None or way.path is None or system.dimension == 1:
            continue
        extent = np.linalg.inv(np.linalg.cholesky(hessian_at(system, one.position)))
        extent *= np.sqrt(way.path.uphill.action)
        along = evenly(way.path.uphill.points, ALONG)
        starts = [along + share * draw.standard_normal(along.shape) @ extent for share in BESIDE]
        basins[index] = enlarged(
            system, basins[index], index, portrait.attractors, np.concatenate(starts), box=portrait.box,
            generator=draw,
        )  # fmt: skip
    return replace(portrait, basins=tuple(basins))


def _well(
    system: Dynamics,
    portrait: PhasePortrait,
    ways: list[WayOut],
    index: int,
    settings: EquationSettings,
    notes: list[str],
) -> Well | None:
    """V about one attractor; a note where none was found."""
    way = _lowest(ways, index)
    depth = None
    if way is not None and way.path is not None:
        path = way.path.uphill
        depth = Depth(way.saddle, path.points, path.values / 2, path.momenta)
    try:
        return local_well(
            system, portrait, index, options=settings.refinement, seed=settings.seed, depth=depth
        )
    except NumericalFailure as error:
        place = portrait.attractors[index].position.round(4).tolist()
        notes.append(f"no formula about {place}: {error}")
        return None


def _unseen(system: Dynamics, wells: list[Well], draw: np.random.Generator) -> np.ndarray:
    """States on which the formulas are tested: of the whole domain, and of the box of each well."""
    boxes = [system.box]
    boxes += [np.stack([well.points.min(axis=0), well.points.max(axis=0)], axis=1) for well in wells]
    return np.concatenate([spread_evenly(box, UNSEEN, generator=draw) for box in boxes])
