"""`quasipotential.json`: a landscape as a file that anything can evaluate without this library.

Powers stand as in `siq.quasipotential.formulas`. Each well has the points of its fit, away from which nothing
is claimed; the vector field, which tells where a formula solves the Hamilton–Jacobi equation, stands in
`vector_field.json`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from siq.errors import InputError
from siq.numerics.files import whole_file
from siq.quasipotential.formulas import basis_from_data, powers_to_data
from siq.quasipotential.landscape import GlobalQuasipotential, Landscape, matched
from siq.quasipotential.occupancy import VisitTest
from siq.quasipotential.rates import Exit, TurnLoss
from siq.quasipotential.transitions import Transition
from siq.quasipotential.wells import Well
from siq.systems.cycles import Cycle
from siq.systems.dynamics import Dynamics

DIGITS = 8  # of points of a fit, which only tell where a formula holds


@dataclass(frozen=True)
class StoredLandscape:
    """What `write_landscape` keeps.

    Attributes
    ----------
    quasipotential
        U over all wells, None where it is not known.
    wells
        V about each attractor, None where there is none.
    data
        Everything, as plain data: equilibria, wells, transitions with their paths, notes.
    """

    quasipotential: GlobalQuasipotential | None
    wells: tuple[Well | None, ...]
    data: Mapping[str, Any]


def write_landscape(path: str | Path, landscape: Landscape, *, dynamics: Dynamics) -> None:
    """Write a landscape whole or not at all."""
    data = landscape_data(landscape, dynamics=dynamics)
    with whole_file(path) as partial:
        partial.write_text(json.dumps(data, allow_nan=False) + "\n", encoding="utf-8")


def landscape_data(landscape: Landscape, *, dynamics: Dynamics) -> dict[str, Any]:
    """A landscape as plain data, as it stands in the file."""
    errors = landscape.position_errors
    noise = landscape.noise
    return {
        "states": [symbol.name for symbol in dynamics.symbols],
        "units": list(landscape.dynamics.units),
        "time_unit": landscape.dynamics.time_unit,
        "noise": None if noise is None else asdict(noise),
        "equilibria": [
            {
                "position": one.position.tolist(),
                "kind": one.kind,
                "eigenvalues": [[value.real, value.imag] for value in one.eigenvalues.tolist()],
            }
            for one in landscape.equilibria
        ],
        "wells": [
            {
                "attractor": attractor.position.tolist(),
                "standard_errors": None if errors is None else [_number(one) for one in errors[index]],
                "basin": float(basin),
                "height": _number(height),
                "V": None if well is None else _formula(well),
            }
            | ({"cycle": _cycle(attractor)} if isinstance(attractor, Cycle) else {})
            for index, (attractor, basin, height, well) in enumerate(
                zip(landscape.attractors, landscape.basins, landscape.heights, landscape.wells, strict=True)
            )
        ],
        "transitions": [_transition(one) for one in landscape.transitions],
        "visits": [_visits(one) for one in landscape.visits],
        "notes": list(landscape.notes),
    } | _of_given(landscape)


def _cycle(one: Cycle) -> dict[str, Any]:
    return {
        "period": one.period,
        "multipliers": [[value.real, value.imag] for value in one.multipliers.astype(complex).tolist()],
        "points": _rounded(one.points),
    }


def _of_given(landscape: Landscape) -> dict[str, Any]:
    """What a landscape of equations has beside: no other file could hold its certificate."""
    if not landscape.given:
        return {}
    certificate = landscape.certificate
    cycles = {"parting": [_cycle(one) for one in landscape.parting]} if landscape.parting else {}
    return {"given": True, "certificate": None if certificate is None else certificate.as_data()} | cycles


def _visits(one: VisitTest) -> dict[str, Any]:
    lowest, highest = one.whole.limits
    return {
        "well": one.well,
        "visits": one.whole.visits,
        "counted": _number(one.whole.mean),
        "lowest": lowest,
        "highest": _number(highest),
        "predicted": one.predicted,
        "error": one.predicted * one.error,
        "method": one.method,
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _formula(well: Well) -> dict[str, Any]:
    return powers_to_data(well) | {
        "level": well.reach,
        "depth": well.level,
        "saddle": None if well.saddle is None else well.saddle.tolist(),
        "tolerance": well.tolerance,
        "residual": well.residual,
        "points": _rounded(well.points),
        "elsewhere": [] if well.elsewhere is None else _rounded(well.elsewhere),
    }


def _rounded(points: np.ndarray) -> list[list[float]]:
    return [[float(f"{value:.{DIGITS}g}") for value in row] for row in points]


def _transition(one: Transition) -> dict[str, Any]:
    rate, path = one.rate, one.path
    return {
        "start": one.start,
        "end": one.end,
        "saddle": one.place.tolist(),
        "barrier": _number(one.barrier),
        "formula_share": _number(one.formula_share),
        "standard_error": _number(one.standard_error),
        "error": _number(one.error),
        "by_rivals": _number(one.by_rivals),
        "minimum_action": None if path is None else path.uphill.action,
        "prefactor": None if rate is None else rate.prefactor,
        "turn": None if rate is None or rate.turn is None else asdict(rate.turn),
        "prefactor_error": None if one.prefactor_error is None else one.prefactor_error.standard_error,
        "prefactor_covariance": 0.0 if one.prefactor_error is None else one.prefactor_error.covariance,
        "noise_leverage": one.leverage,
        "exponent": None if rate is None else rate.exponent,
        "uphill": None if path is None else path.uphill.points.tolist(),
        "downhill": None if path is None else path.downhill.tolist(),
        "notes": list(one.notes),
    } | ({"over_cycle": one.saddle.period} if isinstance(one.saddle, Cycle) else {})


def read_landscape(path: str | Path, *, dynamics: Dynamics) -> StoredLandscape | None:
    """Read what `write_landscape` wrote; None where the file is empty since there was nothing to write.

    Parameters
    ----------
    path
        The file.
    dynamics
        f, as it was identified beside it.

    Raises
    ------
    InputError
        When the file is no such record.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        if not text:
            return None
        data = json.loads(text)
        wells = tuple(_well(well, dynamics) for well in data["wells"])
        heights = np.array([well["height"] for well in data["wells"]], dtype=float)
        return StoredLandscape(matched(wells, heights), wells, data)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(path, "", f"it is no landscape ({type(error).__name__})", "make it again") from None


def exits_of(data: Mapping[str, Any], well: int) -> list[Exit]:
    """The ways out of a well of a landscape as plain data; a barrier that nobody knows is NaN."""
    return [
        Exit(
            _known(way["barrier"]),
            _known(way.get("error", way["standard_error"])),
            way["prefactor"],
            way.get("prefactor_error"),
            way.get("prefactor_covariance", 0.0),
            way.get("noise_leverage", 1.0),
            TurnLoss(**way["turn"]) if way.get("turn") else None,
        )
        for way in data["transitions"]
        if way["start"] == well
    ]


def _known(value: float | None) -> float:
    return np.nan if value is None else float(value)


def _well(data: Mapping[str, Any], dynamics: Dynamics) -> Well | None:
    powers = data["V"]
    if powers is None:
        return None
    d = dynamics.dimension
    return Well(
        dynamics, np.array(data["attractor"]), basis_from_data(powers, dynamics.symbols),
        np.array(powers["coefficients"]), powers.get("depth", powers["level"]),
        None if powers["saddle"] is None else np.array(powers["saddle"]), powers["residual"],
        np.array(powers["points"]).reshape(-1, d), powers["level"], powers["tolerance"],
        np.array(powers["elsewhere"]).reshape(-1, d),
    )  # fmt: skip
