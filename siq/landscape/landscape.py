"""The whole landscape of an identified vector field: equilibria, local formulas, transitions, global U."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.equilibria import Equilibrium
from siq.errors import NumericalFailure
from siq.identification import IdentifiedField
from siq.landscape.combined import GlobalQuasipotential, heights_of_attractors, matched
from siq.landscape.local import LocalQuasipotential, Trial, local_quasipotential
from siq.landscape.options import LandscapeOptions
from siq.landscape.transitions import Transition, lowest_barrier, transitions, ways_out
from siq.outline import Outline


@dataclass(frozen=True)
class Landscape:
    """What is known of a landscape.

    Attributes
    ----------
    equilibria
        All that were found in the recorded region.
    attractors
        Those that recorded states lead to, in the order of everything below.
    basins
        Share of the evenly spread recorded states from which f leads to each attractor, shape ``(k,)``.
    local
        The formula about each attractor, None where none was found.
    trials
        The degrees that were tried about each attractor.
    transitions
        Every way out of every well.
    heights
        U at the attractors, shape ``(k,)``; NaN where transitions do not connect them.
    notes
        What could not be done, in words; limit cycles among it.
    """

    equilibria: tuple[Equilibrium, ...]
    attractors: tuple[Equilibrium, ...]
    basins: np.ndarray
    local: tuple[LocalQuasipotential | None, ...]
    trials: tuple[tuple[Trial, ...], ...]
    transitions: tuple[Transition, ...]
    heights: np.ndarray
    notes: tuple[str, ...]

    @property
    def quasipotential(self) -> GlobalQuasipotential | None:
        """U over all wells, None where a well has no formula or no height."""
        return matched(self.local, self.heights)


def find_landscape(
    found: IdentifiedField,
    outline: Outline,
    *,
    diffusion: np.ndarray,
    options: LandscapeOptions,
    seed: int = 0,
) -> Landscape:
    """Find the landscape of an identified vector field.

    Parameters
    ----------
    found
        The identified f with its uncertainty.
    outline
        Attractors, saddles and regions of f; see `siq.outline.outline`.
    diffusion
        D.
    options
        Degrees, reach and tolerance of the formulas.
    seed
        Decides which points are used where there are too many.
    """
    notes = [fault] if (fault := outline.fault()) is not None else []
    ways_over = ways_out(found.field, outline, diffusion=diffusion)
    local: list[LocalQuasipotential | None] = []
    trials: list[tuple[Trial, ...]] = []
    for index, one in enumerate(outline.attractors):
        try:
            formula, tried = local_quasipotential(
                found.field, outline, index, diffusion=diffusion, options=options, seed=seed,
                barrier=lowest_barrier(ways_over, index),
            )  # fmt: skip
        except NumericalFailure as error:
            notes.append(f"no formula about {one.position.round(4).tolist()}: {error}")
            formula, tried = None, ()
        local.append(formula)
        trials.append(tried)
    ways = transitions(found, ways_over, local, diffusion=diffusion)
    ends = outline.descents.ends
    return Landscape(
        outline.equilibria,
        outline.attractors,
        np.array([float((ends == index).mean()) for index in range(len(outline.attractors))]),
        tuple(local),
        tuple(trials),
        tuple(ways),
        _heights(len(outline.attractors), ways, notes),
        tuple(notes),
    )


def _heights(count: int, ways: list[Transition], notes: list[str]) -> np.ndarray:
    barriers = np.full((count, count), np.inf)
    for way in ways:
        if way.end is not None and np.isfinite(way.barrier):
            barriers[way.start, way.end] = min(barriers[way.start, way.end], way.barrier)
    try:
        return heights_of_attractors(barriers) if count else np.zeros(0)
    except NumericalFailure as error:
        notes.append(str(error))
        return np.full(count, np.nan)
