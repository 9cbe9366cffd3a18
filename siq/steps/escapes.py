"""Escapes: does a direct simulation of the card leave the wells as the law says, from what a run found?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from pydantic.dataclasses import dataclass

from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.landscape.options import LandscapeOptions
from siq.numerics.randomness import Purpose, generator
from siq.reference.escapes import Neighbourhood, neighbourhood, simulate_escapes
from siq.steps.settings import STRICT
from siq.study.tables import as_table

WALKERS = 400
FOLLOWED = 1.5  # predicted mean times, after which who is left counts as censored
NEIGHBOURHOOD = 0.2  # of the barrier out of the well that is reached


@dataclass(frozen=True, config=STRICT)
class EscapesSettings:
    """What the simulations of escapes depend on beside the card."""

    seed: int
    landscape: LandscapeOptions


def run(
    settings: EscapesSettings, system: Dynamics, landscapes: Sequence[Mapping[str, Any] | None]
) -> pd.DataFrame:
    """The table `escape`, of the first run that knows the height of all its wells.

    Parameters
    ----------
    settings
        Noise intensities, and the seed.
    system
        The card that is simulated.
    landscapes
        `quasipotential.json` of every run, None where there is none.
    """
    complete = [
        one
        for one in landscapes
        if one is not None and all(well["height"] is not None for well in one["wells"])
    ]
    rows = []
    for way in complete[0]["transitions"] if complete else []:
        if way["prefactor"] is None or way["barrier"] is None or way["end"] is None:
            continue
        for number, intensity in enumerate(settings.landscape.noise_intensities):
            draw = generator(settings.seed, Purpose.ESCAPE, str(way["start"]), str(number))
            row = _simulated(system, complete[0], way, intensity, draw)
            name = f"A{way['start'] + 1} to A{way['end'] + 1}"
            rows.append({"transition": name, "intensity": intensity} | row)
    return as_table("escape", rows)


def _simulated(
    system: Dynamics,
    landscape: Mapping[str, Any],
    way: Mapping[str, Any],
    intensity: float,
    draw: np.random.Generator,
) -> dict[str, object]:
    """The simulated mean time of one way out, at one intensity."""
    starts = [np.array(well["attractor"]) for well in landscape["wells"]]
    targets: list[Neighbourhood] = []
    for index, position in enumerate(starts):
        barriers = [
            one["barrier"] for one in landscape["transitions"] if one["start"] == index and one["barrier"]
        ]
        if index != way["start"] and barriers:
            targets.append(neighbourhood(system, position, level=NEIGHBOURHOOD * min(barriers) / 2))
    predicted = way["prefactor"] * np.exp(way["barrier"] / intensity)
    try:
        found = simulate_escapes(
            system, starts[way["start"]], targets, intensity=intensity,
            longest=FOLLOWED * predicted, generator=draw, walkers=WALKERS,
        )  # fmt: skip
    except (NumericalFailure, ValueError) as error:
        return {"predicted": predicted, "escapes": 0, "note": str(error)}
    return {
        "predicted": predicted, "simulated": found.mean, "simulated_error": found.standard_error,
        "escapes": found.escapes, "note": "",
    }  # fmt: skip
