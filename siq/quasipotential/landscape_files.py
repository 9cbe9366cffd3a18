"""`quasipotential.json`: a landscape as a file that anything can evaluate without this library.

Powers stand as in `siq.quasipotential.formulas`. Each well has the points of its fit, away from which nothing
is claimed; the vector field, which tells where a formula solves the Hamilton–Jacobi equation, stands in
`vector_field.json`. `read_landscape` gives the `Landscape` back.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from siq.data.two_states import DwellCount
from siq.errors import InputError
from siq.numerics.files import whole_file
from siq.quasipotential.certificate import Certificate
from siq.quasipotential.hamilton_jacobi import PowerBasis
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.occupancy import VisitTest
from siq.quasipotential.path_chains import MinimumActionPath
from siq.quasipotential.rates import EscapeRate, NoiseStrength
from siq.quasipotential.transitions import Transition
from siq.quasipotential.wells import Well
from siq.remarks import Remark
from siq.systems.cycles import Cycle
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import Equilibrium

DIGITS = 8  # of points of a fit and of a path, which tell where a formula holds and where to draw
# Keys of the file, and the fields that they are: of a transition, of its law, of a cycle's loss, of its path.
NUMBERS = {
    "barrier": "barrier", "formula_share": "formula_share", "standard_error": "standard_error",
    "by_rivals": "by_rivals", "noise_leverage": "leverage",
}  # fmt: skip
NUMBERS_OF_LAW = {
    "prefactor": "prefactor", "prefactor_error": "prefactor_error", "prefactor_covariance": "covariance",
    "exponent": "exponent",
}  # fmt: skip
TURN = {"own": "loss", "beyond": "loss_beyond", "exact": "particle"}
PATH_FIGURES = ("error", "residual", "converged", "smooth")


def landscape_data(landscape: Landscape) -> dict[str, Any]:
    """A landscape as plain data, as it stands in the file (docs/reference/tables.md)."""
    errors, noise, certificate = landscape.position_errors, landscape.noise, landscape.certificate
    data: dict[str, Any] = {
        "states": [symbol.name for symbol in landscape.dynamics.symbols],
        "units": list(landscape.dynamics.units),
        "time_unit": landscape.dynamics.time_unit,
        "noise": None if noise is None else asdict(noise),
        "equilibria": [
            {"position": one.position.tolist(), "kind": one.kind, "eigenvalues": _pairs(one.eigenvalues)}
            for one in landscape.equilibria
        ],
        "wells": [
            {
                "attractor": attractor.position.tolist(),
                "standard_errors": None if errors is None else [_number(one) for one in errors[index]],
                "basin": float(basin),
                "height": _number(height),
                "V": None if well is None else _well_data(well),
            }
            | ({"cycle": _cycle_data(attractor)} if isinstance(attractor, Cycle) else {})
            for index, (attractor, basin, height, well) in enumerate(
                zip(landscape.attractors, landscape.basins, landscape.heights, landscape.wells, strict=True)
            )
        ],
        "transitions": [_transition_data(one) for one in landscape.transitions],
        "visits": [
            {
                "well": one.well,
                "visits": one.whole.visits,
                "time": one.whole.time,
                "counted": _number(one.whole.mean),
                "lowest": one.whole.limits[0],
                "highest": _number(one.whole.limits[1]),
                "predicted": one.predicted,
                "error": one.predicted * one.error,
                "method": one.method,
                "held_out": asdict(one.held_out),
                "probability": one.probability,
            }
            for one in landscape.visits
        ],
        "remarks": [one.as_data() for one in landscape.remarks],
    }
    if landscape.given:  # no other file could hold its certificate
        data |= {"given": True, "certificate": None if certificate is None else certificate.as_data()}
        data |= {"parting": list(map(_cycle_data, landscape.parting))} if landscape.parting else {}
    return data


def _transition_data(one: Transition) -> dict[str, Any]:
    rate, path = one.rate or EscapeRate(np.nan, np.nan, np.nan), one.path
    data = {
        "start": one.start,
        "end": one.end,
        "saddle": one.place.tolist(),
        **{key: _number(getattr(one, name)) for key, name in (NUMBERS | {"error": "error"}).items()},
        **{key: _number(getattr(rate, name)) for key, name in NUMBERS_OF_LAW.items()},
        "turn": None
        if rate.loss is None
        else {key: getattr(rate, name) for key, name in TURN.items()},
        "minimum_action": None, "uphill": None, "downhill": None, "path": None,
        "remarks": [remark.as_data() for remark in one.remarks],
        "law_remarks": [remark.as_data() for remark in rate.remarks],
    }  # fmt: skip
    if path is not None:
        data |= {"minimum_action": path.action, "uphill": path.points.tolist()}
        data["downhill"] = None if path.downhill is None else path.downhill.tolist()
        data["path"] = {name: getattr(path, name) for name in PATH_FIGURES} | {
            "momenta": _rounded(path.momenta), "values": _rounded(path.values[None])[0],
            "rivals": list(path.rivals),
        }  # fmt: skip
    return data | ({"over_cycle": one.saddle.period} if isinstance(one.saddle, Cycle) else {})


def _cycle_data(one: Cycle) -> dict[str, Any]:
    return {"period": one.period, "multipliers": _pairs(one.multipliers), "points": _rounded(one.points)}


def _well_data(well: Well) -> dict[str, Any]:
    return well.powers | {
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


def _pairs(values: np.ndarray) -> list[list[float]]:
    """Complex numbers as real and imaginary parts."""
    return [[value.real, value.imag] for value in values.astype(complex).tolist()]


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)


def _known(value: float | None) -> float:
    return np.nan if value is None else float(value)


def landscape_from_data(data: Mapping[str, Any], dynamics: Dynamics) -> Landscape:
    """The landscape that `landscape_data` wrote, of an f that stands elsewhere.

    What is rounded there comes back rounded. The estimate of f, the certificate of a landscape from
    recordings, and the states of the record have files of their own.
    """
    if list(data["states"]) != [symbol.name for symbol in dynamics.symbols]:
        raise ValueError("the landscapes are of different states")
    units = tuple(data.get("units") or ("1",) * dynamics.dimension)
    dynamics = replace(dynamics, units=units, time_unit=data.get("time_unit") or "1")
    equilibria = tuple(
        Equilibrium(np.array(one["position"]), _complex(one["eigenvalues"]), one["kind"])
        for one in data["equilibria"]
    )

    def cycle(one: Mapping[str, Any], first: Sequence[float] | None = None) -> Cycle:
        points = np.array(one["points"])
        points[0] = points[0] if first is None else first
        return Cycle(points, one["period"], _complex(one["multipliers"]))

    def equilibrium(place: Sequence[float]) -> Equilibrium:
        same = (one for one in equilibria if np.array_equal(one.position, place))
        return next(same, Equilibrium(np.array(place), np.full(len(place), np.nan), "degenerate"))

    parting = tuple(map(cycle, data.get("parting", ())))
    transitions = []
    for one in data["transitions"]:
        saddle: Equilibrium | Cycle = equilibrium(one["saddle"])
        if "over_cycle" in one:
            saddle = min(parting, key=lambda each: abs(each.period - one["over_cycle"]))
        transitions.append(_transition_from_data(one, saddle, "cycle" in data["wells"][one["start"]]))
    wells = data["wells"]
    errors = [one["standard_errors"] for one in wells]
    return Landscape(
        dynamics,
        equilibria,
        tuple(
            cycle(one["cycle"], one["attractor"]) if "cycle" in one else equilibrium(one["attractor"])
            for one in wells
        ),
        np.array([one["basin"] for one in wells]),
        tuple(_well_from_data(one, dynamics) for one in wells),
        tuple(transitions),
        np.array([_known(one["height"]) for one in wells]),
        tuple(map(Remark.from_data, data["remarks"])),
        None if data.get("certificate") is None else Certificate.from_data(data["certificate"]),
        np.array(errors, dtype=float) if errors and None not in errors else None,
        None if data.get("noise") is None else NoiseStrength(**data["noise"]),
        visits=tuple(
            VisitTest(
                one["well"],
                DwellCount(**one["held_out"]),
                DwellCount(one["visits"], one["time"]),
                one["predicted"],
                one["error"] / one["predicted"],
                one["method"],
                one["probability"],
            )
            for one in data.get("visits") or ()
        ),
        given=bool(data.get("given")),
        parting=parting,
    )


def _transition_from_data(
    one: Mapping[str, Any], saddle: Equilibrium | Cycle, from_cycle: bool
) -> Transition:
    path, rate, kept = None, None, one["path"]
    if kept is not None:
        path = MinimumActionPath(
            np.array(one["uphill"]), np.array(kept["momenta"]), np.array(kept["values"]),
            one["minimum_action"], rivals=tuple(kept["rivals"]), downhill=np.array(one["downhill"]),
            **{name: kept[name] for name in PATH_FIGURES},
        )  # fmt: skip
    if one["prefactor"] is not None:
        rate = EscapeRate(
            one["minimum_action"], remarks=tuple(map(Remark.from_data, one["law_remarks"])),
            **{name: one[key] for key, name in NUMBERS_OF_LAW.items()},
            **{name: one["turn"][key] for key, name in TURN.items() if one["turn"]},
        )  # fmt: skip
    return Transition(
        one["start"], one["end"], saddle, path, rate=rate, from_cycle=from_cycle,
        remarks=tuple(map(Remark.from_data, one["remarks"])),
        **{name: _known(one[key]) for key, name in NUMBERS.items()},
    )  # fmt: skip


def _well_from_data(data: Mapping[str, Any], dynamics: Dynamics) -> Well | None:
    powers, d = data["V"], dynamics.dimension
    if powers is None:
        return None
    return Well(
        PowerBasis.from_data(powers, dynamics.symbols), np.array(powers["coefficients"]),
        dynamics, np.array(data["attractor"]), powers["depth"],
        None if powers["saddle"] is None else np.array(powers["saddle"]), powers["residual"],
        np.array(powers["points"]).reshape(-1, d), powers["level"], powers["tolerance"],
        np.array(powers["elsewhere"]).reshape(-1, d),
    )  # fmt: skip


def _complex(pairs: Sequence[Sequence[float]]) -> np.ndarray:
    values = np.array([complex(*one) for one in pairs])
    return values if values.imag.any() else values.real


def write_landscape(path: str | Path, landscape: Landscape) -> None:
    """Write a landscape as `quasipotential.json`, whole or not at all."""
    data = landscape_data(landscape)
    with whole_file(path) as partial:
        partial.write_text(json.dumps(data, allow_nan=False) + "\n", encoding="utf-8")


def read_landscape(path: str | Path, *, dynamics: Dynamics) -> Landscape | None:
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
        return landscape_from_data(json.loads(text), dynamics) if text else None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(path, "", f"it is no landscape ({type(error).__name__})", "make it again") from None
