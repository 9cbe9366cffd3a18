"""Beside the equations: how far are the landscapes of all runs from that of the card's own equations?

Scoring alone: what is found here of the card is no input of any other step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from pydantic.dataclasses import dataclass

from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.landscape.beside_equations import check_same_noise, difference_rows, differences
from siq.landscape.landscape import Landscape
from siq.landscape.options import LandscapeOptions
from siq.landscape.refusal import NoLandscape
from siq.landscape.storage import landscape_data
from siq.steps.equations import EquationSettings, landscape_of_equations
from siq.steps.settings import STRICT
from siq.study.tables import as_table

TABLE = "beside_equations"
NO_RUN = -1  # the run of a row that is of the equations alone


@dataclass(frozen=True, config=STRICT)
class BesideEquationsSettings:
    """What the comparison depends on beside the card."""

    seed: int
    landscape: LandscapeOptions


def compared(equations: Landscape, learned: Landscape, *, noise: float | None = None) -> pd.DataFrame:
    """What `siq.landscape.landscape.Landscape.beside` says.

    Parameters
    ----------
    equations, learned
        The landscapes by either.
    noise
        ε of mean times; None for none.

    Raises
    ------
    ValueError
        When the states are not the same, or D is not.
    """
    both = (landscape_data(one, dynamics=one.dynamics) for one in (equations, learned))
    found = differences(*both, box=equations.dynamics.box, noises=() if noise is None else (noise,))
    places = np.array([one.position for one in (*equations.attractors, *equations.equilibria)])
    check_same_noise(equations.dynamics, learned.dynamics, places, found=learned.found)
    return as_table(TABLE, [{"run": 0} | row for row in difference_rows(found)]).drop(columns="run")


def run(
    settings: BesideEquationsSettings, system: Dynamics, runs: Sequence[Mapping[str, Any] | None]
) -> pd.DataFrame:
    """The table `beside_equations`.

    Parameters
    ----------
    settings
        The seed, and ε for mean times: those of the study, or else that of each run.
    system
        The equations, as the card says.
    runs
        The landscape of each run as plain data, None where it has none.

    Returns
    -------
    pandas.DataFrame
        A row for each number of each run. Where the equations have no landscape, a single one that says why.
    """
    try:
        # Barriers and prefactors follow from paths of least action; formulas have references of their own.
        found = landscape_of_equations(system, EquationSettings(seed=settings.seed), formulas=False)
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        reason = error.reason if isinstance(error, NoLandscape) else str(error)
        return as_table(TABLE, [{"run": NO_RUN, "note": f"the equations have no landscape: {reason}"}])
    equations = landscape_data(found, dynamics=system)
    rows: list[dict[str, object]] = []
    for number, one in enumerate(runs):
        if one is None:
            rows.append({"run": number, "note": "the run has no landscape"})
            continue
        shown = one.get("noise")
        noises = settings.landscape.noise_intensities or (() if shown is None else (shown["intensity"],))
        try:
            compared = differences(equations, one, box=system.box, noises=noises)
        except ValueError as error:
            rows.append({"run": number, "note": str(error)})
            continue
        rows += [{"run": number} | row for row in difference_rows(compared)]
    return as_table(TABLE, rows)
