"""Landscapes as plain data, to be told, and the landscapes that these are of."""

from __future__ import annotations

import math
from typing import Any

import sympy

from siq.quasipotential.landscape import Landscape
from siq.quasipotential.landscape_files import landscape_from_data
from siq.systems.dynamics import Dynamics

NOISE = {"intensity": 0.1, "standard_error": 0.001, "source": "estimated"}


def landscape(
    places: list[list[float]],
    barriers: list[float | None],
    *,
    noise: dict[str, Any] | None = None,
    units: str = "um",
    time: str = "s",
    prefactor: float | None = 4.0,
) -> dict[str, Any]:
    """Plain data of wells in a row, each left to the next over a saddle; None is a barrier nobody knows."""
    d = len(places[0]) if places else 1
    ways = [
        {
            "start": index, "end": (index + 1) % len(places) if len(places) > 1 else None,
            "saddle": [0.0] * d, "barrier": barrier, "standard_error": 0.01,
            "minimum_action": barrier, "prefactor": prefactor, "exponent": 0.0, "remarks": [],
            "formula_share": None, "by_rivals": 0.0, "noise_leverage": 1.0, "path": None, "law_remarks": [],
            "turn": None, "prefactor_error": None, "prefactor_covariance": 0.0, "phases": None,
            "of_residual": 0.0, "correction": 0.0, "unknown": 1.0, "skew": 0.0, "power": 0.0,
        }
        for index, barrier in enumerate(barriers)
    ]  # fmt: skip
    wells = [
        {
            "attractor": place,
            "standard_errors": [0.004] * d,
            "basin": 1 / len(places),
            "height": 0.0,
            "V": None,
        }
        for place in places
    ]
    equilibria = [
        {"position": place, "kind": "attractor", "eigenvalues": [[-1.0, 0.0]] * d} for place in places
    ]
    return {
        "states": ["x", "y", "z"][:d], "units": [units] * d, "time_unit": time, "noise": noise,
        "equilibria": equilibria, "wells": wells, "transitions": ways, "remarks": [],
    }  # fmt: skip


def told(data: dict[str, Any]) -> Landscape:
    """The landscape that plain data are of; of its f nothing is asked."""
    symbols = [sympy.Symbol(name, real=True) for name in data["states"]]
    return landscape_from_data(data, Dynamics.of(symbols, symbols))


def record_row(**change: Any) -> dict[str, object]:
    """A row of the table ``record``: visits to a well, counted and predicted."""
    row: dict[str, object] = {
        "run": 0, "attractor": "(1)", "visits": 16, "time": 800.0, "counted": 50.0, "lowest": 31.0,
        "highest": 87.0, "held_out_visits": 4, "held_out_time": 180.0, "held_out_counted": 45.0,
        "predicted": 51.0, "predicted_error": 3.0, "method": "operator", "probability": 0.8,
    }  # fmt: skip
    return row | change


def unseen_row(**change: Any) -> dict[str, object]:
    """One of a well no visit to which was seen to end."""
    nothing = {"visits": 0, "counted": math.nan, "highest": math.nan}
    return record_row(**nothing, held_out_visits=0, held_out_counted=math.nan, **change)
