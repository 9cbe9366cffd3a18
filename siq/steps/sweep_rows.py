"""Rows of a sweep: how deep is each well of a point, how long does it last, and what share of time has it?

Barriers and prefactors are those of the point; times and shares follow from them for a noise
(`siq.landscape.dwell_times`, `siq.landscape.ensembles`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from siq.dynamics.phase_portrait import UNSETTLED
from siq.landscape.dwell_times import NoiseStrength, dwell_time
from siq.landscape.ensembles import shares_by_rates
from siq.steps.sweep_points import SweptPoint
from siq.steps.sweep_wells import position_text

ALONE = "it is the only stable state, and no way leads out of it"
UNKNOWN = "no way out was found"


def well_rows(point: SweptPoint, number: Sequence[int], noise: float | None) -> list[dict[str, object]]:
    """One row for every well of a point; one that says why where there is none.

    Parameters
    ----------
    point
        What was found there.
    number
        Of each of its wells along their branches.
    noise
        ε; None for neither times nor weights.
    """
    if not point.wells:
        return [_place(point) | {"well": -1, "noise": noise, "note": point.reason or "; ".join(point.notes)}]
    weights = _weights(point, noise)
    return [
        _place(point)
        | {"well": number[index], "attractor": position_text(well.state), "relaxation": well.relaxation}
        | _exits(point, index, number, noise)
        | {"noise": noise, "weight": weights[index]}
        for index, well in enumerate(point.wells)
    ]


def way_rows(point: SweptPoint, number: Sequence[int]) -> list[dict[str, object]]:
    """One row for every way out of a well, the arguments as `well_rows` has them."""
    return [
        _place(point)
        | {
            "well": number[way.start],
            "exit": None if way.end is None else number[way.end],
            "barrier": way.barrier,
            "prefactor": way.prefactor,
            "relaxation": point.wells[way.start].relaxation,
            "note": way.note,
        }
        for way in point.ways
    ]


def _place(point: SweptPoint) -> dict[str, object]:
    first, second = (*point.values, np.nan)[:2]
    return {"value": first, "second_value": second}


def _weights(point: SweptPoint, noise: float | None) -> np.ndarray:
    """Shares of time in the long run; NaN where a rate is not known, or the noise is not below a barrier."""
    count = len(point.wells)
    between = [way for way in point.ways if way.end is not None]
    known = noise is not None and all(way.barrier is not None and noise < way.barrier for way in between)
    # What leads elsewhere has a share of the time, too.
    if noise is None or not known or point.settled < 1 - UNSETTLED:
        return np.full(count, np.nan)
    if count == 1:
        return np.ones(1)
    listed = [
        {"start": way.start, "end": way.end, "barrier": way.barrier, "prefactor": way.prefactor}
        for way in between
    ]
    return shares_by_rates(listed, count, intensity=noise)


def _exits(point: SweptPoint, index: int, number: Sequence[int], noise: float | None) -> dict[str, object]:
    """The lowest way out of a well, and its time over all ways."""
    mine = [way for way in point.ways if way.start == index]
    known = [way for way in mine if way.barrier is not None]
    if not known:
        # Beside a limit cycle, or another well, it can be left although nobody knows how.
        alone = len(point.wells) == 1 and not point.notes and not mine
        told = "; ".join(dict.fromkeys(way.note for way in mine if way.note))
        return {"note": ALONE if alone else told or "; ".join(point.notes) or UNKNOWN}
    lowest = min(known, key=lambda way: np.inf if way.barrier is None else way.barrier)
    notes = [way.note for way in mine if way.note]
    time = dwell_time([way.as_exit() for way in mine], None if noise is None else NoiseStrength(noise))
    if noise is not None and time is None:
        notes.append(f"no time: the noise {noise:g} is not below the barrier, or the law has no prefactor")
    if time is not None and not time.complete:
        notes.append("a way out has no rate: the well lasts no longer than this")
    return {
        "barrier": lowest.barrier,
        "exit": None if lowest.end is None else number[lowest.end],
        "mean_time": np.nan if time is None else time.value,
        "law_error": np.nan if time is None else time.law_error,
        "note": "; ".join(dict.fromkeys(notes)),
    }
