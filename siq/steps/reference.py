"""Reference: what do characteristics, a mesh and least action say of a card's own vector field?"""

from __future__ import annotations

import numpy as np
from pydantic.dataclasses import dataclass

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.phase_portrait import evenly_spread, phase_portrait
from siq.errors import NumericalFailure
from siq.landscape.reference import ReferenceLandscape, no_reference, reference_landscape
from siq.numerics.randomness import Purpose, generator
from siq.steps.settings import STRICT

STARTS = 4000  # states over the domain, from which those are taken that cover it evenly
REACH = 1.2  # of the lowest barrier out of a well: landscapes are compared up to 1.1 of it


@dataclass(frozen=True, config=STRICT)
class ReferenceSettings:
    """What a reference depends on beside the card."""

    seed: int


def run(settings: ReferenceSettings, system: Dynamics) -> ReferenceLandscape:
    """The reference for the landscape of a card; an empty one that says why where there is none."""
    draw = generator(settings.seed, Purpose.REFERENCE)
    low, high = system.box.T
    x = draw.uniform(low, high, size=(STARTS, system.dimension))
    points = x[evenly_spread(x, generator=draw)]
    try:
        portrait = phase_portrait(system, points)
        if not portrait.attractors and (fault := portrait.fault()) is not None:
            return no_reference(system.dimension, fault)
        return reference_landscape(system, portrait, box=system.box, reach=REACH, generator=draw)
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        return no_reference(system.dimension, str(error))
