"""How is the landscape of a vector field found, and what is it put together from?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from siq.errors import NumericalFailure
from siq.inference.field_estimate import AnyField, GivenField, IdentifiedField
from siq.quasipotential.certificate import Certificate
from siq.quasipotential.landscape import Landscape, heights_of_attractors
from siq.quasipotential.rates import NoiseStrength
from siq.quasipotential.transitions import Transition, position_standard_errors, transitions, ways_out
from siq.quasipotential.wells import Well, WellOptions, local_well, surveyed
from siq.systems.cycles import Cycle
from siq.systems.equilibria import Equilibrium
from siq.systems.phase_portrait import PhasePortrait

SAME = 1e-6  # of the recorded box: one attractor, from different starts


def find_landscape(
    found: IdentifiedField,
    portrait: PhasePortrait,
    *,
    wells: Sequence[Well] | None = None,
    certificate: Certificate | None = None,
    options: WellOptions | None = None,
    noise: NoiseStrength | None = None,
    seed: int = 0,
) -> Landscape:
    """Find the landscape of an identified vector field.

    Parameters
    ----------
    found
        The identified f with its uncertainty.
    portrait
        Attractors, saddles and basins of f; see `siq.systems.phase_portrait.phase_portrait`.
    wells
        V about the attractors as refinement found it; by default the local route finds it here.
    certificate
        Of these wells.
    options
        Of the local route.
    noise
        That drives the system, where it is known.
    seed
        Decides which points are used where there are too many.
    """
    notes = [fault] if (fault := portrait.fault()) is not None else []
    if wells is None:
        kept = _wells(found, portrait, options or WellOptions(), seed, notes)
    else:
        kept = [_given(wells, found, portrait, index, notes) for index in range(len(portrait.attractors))]
    ways = transitions(found, ways_out(found.dynamics, portrait), kept)
    return assembled(found, portrait, kept, ways, notes, certificate=certificate, noise=noise)


def assembled(
    found: AnyField,
    portrait: PhasePortrait,
    wells: Sequence[Well | None],
    ways: Sequence[Transition],
    notes: list[str],
    *,
    certificate: Certificate | None,
    noise: NoiseStrength | None,
) -> Landscape:
    """The landscape of what was found; the arguments are those of `Landscape` and of `find_landscape`."""
    ends = portrait.descents.ends
    settled: tuple[Equilibrium | Cycle, ...] = (*portrait.attractors, *portrait.cycles)
    return Landscape(
        found.dynamics,
        portrait.equilibria,
        settled,
        np.array([float((ends == index).mean()) for index in range(len(settled))]),
        tuple(wells),
        tuple(ways),
        _heights(len(settled), ways, notes),
        tuple(notes),
        certificate,
        np.array([position_standard_errors(found, one.position) for one in settled]),
        noise,
        None if isinstance(found, GivenField) else found,
        given=isinstance(found, GivenField),
        parting=portrait.parting,
    )


def _wells(
    found: IdentifiedField, portrait: PhasePortrait, options: WellOptions, seed: int, notes: list[str]
) -> list[Well | None]:
    wells: list[Well | None] = []
    for index, one in enumerate(portrait.attractors):
        try:
            wells.append(local_well(found.dynamics, portrait, index, options=options, seed=seed))
        except NumericalFailure as error:
            notes.append(f"no formula about {one.position.round(4).tolist()}: {error}")
            wells.append(None)
    return wells


def _given(
    wells: Sequence[Well], found: IdentifiedField, portrait: PhasePortrait, index: int, notes: list[str]
) -> Well | None:
    """The well of an attractor among those of the refinement."""
    place = portrait.attractors[index].position
    width = portrait.box[:, 1] - portrait.box[:, 0]
    for well in wells:
        if np.abs((well.attractor - place) / width).max() < SAME:
            return surveyed(well, found.dynamics, portrait, index)
    notes.append(f"refinement found no formula about {place.round(4).tolist()}")
    return None


def _heights(count: int, ways: Sequence[Transition], notes: list[str]) -> np.ndarray:
    barriers = np.full((count, count), np.inf)
    for way in ways:
        if way.end is not None and np.isfinite(way.barrier):
            barriers[way.start, way.end] = min(barriers[way.start, way.end], way.barrier)
    try:
        return heights_of_attractors(barriers) if count else np.zeros(0)
    except NumericalFailure as error:
        notes.append(str(error))
        return np.full(count, np.nan)
