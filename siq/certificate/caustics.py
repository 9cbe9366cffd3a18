"""Where do characteristics cross below the saddle of a well, so that V has no smooth form?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from siq.certificate.certificates import position_text
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.phase_portrait import PhasePortrait
from siq.potential.refinement import Refined
from siq.potential.well import Well
from siq.reference.sheets import adapted_fan, first_caustic

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
