"""`quasipotential.json`: a landscape as a file that anything can evaluate without this library.

Powers stand as in `siq.quasipotential.formulas`. Each well has the points of its fit, away from which nothing
is claimed; the vector field, which tells where a formula solves the Hamilton–Jacobi equation, stands in
`vector_field.json`. `read_landscape` gives the `Landscape` back.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from siq.data.states import DwellCount
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

Codec = tuple[Callable[[Any], Any], Callable[[Any], Any]]
"""How a value is written as plain data, and read."""


def _fields(codec: Codec, *same: str, **renamed: str) -> dict[str, tuple[str, Codec]]:
    """Keys of the file with the fields that they are."""
    return {key: (name, codec) for key, name in ({each: each for each in same} | renamed).items()}


def _written(one: Any, fields: Mapping[str, tuple[str, Codec]]) -> dict[str, Any]:
    return {key: write(getattr(one, name)) for key, (name, (write, _)) in fields.items()}


def _read(data: Mapping[str, Any], fields: Mapping[str, tuple[str, Codec]]) -> dict[str, Any]:
    return {name: read(data[key]) for key, (name, (_, read)) in fields.items()}


def _maybe(read: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """That encoder or decoder, with None for None."""
    return lambda value: None if value is None else read(value)


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)


def _rounded(values: np.ndarray) -> list[Any]:
    return [float(f"{one:.{DIGITS}g}") if np.ndim(one) == 0 else _rounded(one) for one in values]


def _complex(pairs: Sequence[Sequence[float]]) -> np.ndarray:
    """Numbers of their real and imaginary parts."""
    values = np.array([complex(*one) for one in pairs])
    return values if values.imag.any() else values.real


PLAIN: Codec = (lambda value: value, lambda value: value)
NUMBER: Codec = (_number, lambda value: np.nan if value is None else float(value))
KNOWN: Codec = (_number, lambda value: value)
ARRAY: Codec = (_maybe(np.ndarray.tolist), _maybe(np.array))
ROUNDED: Codec = (_rounded, np.array)
COMPLEX: Codec = (lambda values: [[one.real, one.imag] for one in values.astype(complex).tolist()], _complex)
REMARKS: Codec = (
    lambda remarks: [one.as_data() for one in remarks], lambda data: tuple(map(Remark.from_data, data))
)  # fmt: skip

EQUILIBRIUM = _fields(ARRAY, "position") | _fields(PLAIN, "kind") | _fields(COMPLEX, "eigenvalues")
CYCLE = _fields(PLAIN, "period") | _fields(COMPLEX, "multipliers") | _fields(ROUNDED, "points")
WELL = (
    _fields(PLAIN, "tolerance", "residual", level="reach", depth="level")
    | _fields(ARRAY, "saddle")
    | _fields(ROUNDED, "points")
)
TRANSITION = (
    _fields(PLAIN, "start", "end")
    | _fields(
        NUMBER,
        "barrier",
        "formula_share",
        "standard_error",
        "by_rivals",
        "of_residual",
        noise_leverage="leverage",
    )
    | _fields(REMARKS, "remarks")
)
LAW = (
    _fields(NUMBER, "prefactor")
    | _fields(KNOWN, "prefactor_error", "exponent", prefactor_covariance="covariance")
    | _fields(PLAIN, "correction", "unknown", "skew", "power")
    | _fields(ARRAY, "phases")
    | _fields(REMARKS, law_remarks="remarks")
)
TURN = _fields(PLAIN, own="loss", beyond="loss_beyond", exact="particle")
WAY = _fields(PLAIN, minimum_action="action") | _fields(ARRAY, "downhill", uphill="points")
PATH = (
    _fields(PLAIN, "error", "residual", "converged", "smooth")
    | _fields((list, tuple), "rivals")
    | _fields(ROUNDED, "momenta", "values")
)
VISIT = _fields(PLAIN, "well", "predicted", "method", "probability") | _fields(
    (asdict, lambda count: DwellCount(**count)), "held_out"
)


def landscape_data(landscape: Landscape) -> dict[str, Any]:
    """A landscape as plain data, as it stands in the file (docs/reference/tables.md)."""
    errors, noise, certificate = landscape.position_errors, landscape.noise, landscape.certificate
    data: dict[str, Any] = {
        "states": [symbol.name for symbol in landscape.dynamics.symbols],
        "units": list(landscape.dynamics.units),
        "time_unit": landscape.dynamics.time_unit,
        "noise": None if noise is None else asdict(noise),
        "equilibria": [_written(one, EQUILIBRIUM) for one in landscape.equilibria],
        "wells": [
            {
                "attractor": attractor.position.tolist(),
                "standard_errors": None if errors is None else [_number(one) for one in errors[index]],
                "basin": float(basin),
                "height": _number(height),
                "V": None
                if well is None
                else well.powers
                | _written(well, WELL)
                | {"elsewhere": [] if well.elsewhere is None else _rounded(well.elsewhere)},
            }
            | ({"cycle": _written(attractor, CYCLE)} if isinstance(attractor, Cycle) else {})
            for index, (attractor, basin, height, well) in enumerate(
                zip(landscape.attractors, landscape.basins, landscape.heights, landscape.wells, strict=True)
            )
        ],
        "transitions": [_transition_data(one) for one in landscape.transitions],
        "visits": [
            _written(one, VISIT)
            | {"visits": one.whole.visits, "time": one.whole.time, "counted": _number(one.whole.mean)}
            | {"lowest": one.whole.limits[0], "highest": _number(one.whole.limits[1])}
            | {"error": one.predicted * one.error}
            for one in landscape.visits
        ],
        "remarks": REMARKS[0](landscape.remarks),
    }
    if (checked := landscape.checked_times) is not None:
        data["checked_times"] = {name: list(map(_number, checked[name])) for name in checked.columns}
    if landscape.given:  # no other file could hold its certificate
        data |= {"given": True, "certificate": None if certificate is None else certificate.as_data()}
        parting = [_written(one, CYCLE) for one in landscape.parting]
        data |= {"parting": parting} if parting else {}
    return data


def _transition_data(one: Transition) -> dict[str, Any]:
    rate, path = one.rate or EscapeRate(np.nan, np.nan, np.nan), one.path
    data = _written(one, TRANSITION) | _written(rate, LAW)
    data |= {"saddle": one.place.tolist(), "error": _number(one.error)}
    data |= {"turn": None if rate.loss is None else _written(rate, TURN)}
    data |= dict.fromkeys((*WAY, "path")) if path is None else _written(path, WAY)
    data |= {} if path is None else {"path": _written(path, PATH)}
    data |= {"turns": list(one.turns)} if one.turns else {}
    return data | ({"over_cycle": one.saddle.period} if isinstance(one.saddle, Cycle) else {})


def landscape_from_data(data: Mapping[str, Any], dynamics: Dynamics) -> Landscape:
    """The landscape that `landscape_data` wrote, of an f that stands elsewhere.

    What is rounded there comes back rounded. The estimate of f, the certificate of a landscape from
    recordings, and the states of the record have files of their own.
    """
    if list(data["states"]) != [symbol.name for symbol in dynamics.symbols]:
        raise ValueError("the landscapes are of different states")
    dynamics = replace(dynamics, units=tuple(data["units"]), time_unit=data["time_unit"])
    equilibria = tuple(Equilibrium(**_read(one, EQUILIBRIUM)) for one in data["equilibria"])
    parting = tuple(Cycle(**_read(one, CYCLE)) for one in data.get("parting", ()))
    wells = data["wells"]

    def equilibrium(place: Sequence[float]) -> Equilibrium:
        same = (one for one in equilibria if np.array_equal(one.position, place))
        return next(same, Equilibrium(np.array(place), np.full(len(place), np.nan), "degenerate"))

    def attractor(one: Mapping[str, Any]) -> Equilibrium | Cycle:
        if "cycle" not in one:
            return equilibrium(one["attractor"])
        cycle = Cycle(**_read(one["cycle"], CYCLE))
        cycle.points[0] = one["attractor"]  # the others are rounded
        return cycle

    attractors, transitions = tuple(map(attractor, wells)), []
    for one in data["transitions"]:
        saddle: Equilibrium | Cycle = equilibrium(one["saddle"])
        if "over_cycle" in one:
            saddle = min(parting, key=lambda each: abs(each.period - one["over_cycle"]))
        path = rate = None
        if one["path"] is not None:
            path = MinimumActionPath(**_read(one, WAY), **_read(one["path"], PATH))
        if one["prefactor"] is not None or one.get("phases") is not None:
            turn = {} if one["turn"] is None else _read(one["turn"], TURN)
            rate = EscapeRate(one["minimum_action"], **_read(one, LAW), **turn)
        start = attractors[one["start"]]
        own = _read(one, TRANSITION) | {"turns": tuple(one.get("turns", ()))}
        cycle = start if isinstance(start, Cycle) else None
        transitions.append(Transition(saddle=saddle, path=path, rate=rate, cycle=cycle, **own))
    errors = [one["standard_errors"] for one in wells]
    return Landscape(
        dynamics, equilibria, attractors, np.array([one["basin"] for one in wells]),
        tuple(_well_from_data(one, dynamics) for one in wells), tuple(transitions),
        np.array([NUMBER[1](one["height"]) for one in wells]), REMARKS[1](data["remarks"]),
        None if data.get("certificate") is None else Certificate.from_data(data["certificate"]),
        np.array(errors, dtype=float) if errors and None not in errors else None,
        None if data["noise"] is None else NoiseStrength(**data["noise"]),
        visits=tuple(
            VisitTest(
                whole=DwellCount(one["visits"], one["time"]), error=one["error"] / one["predicted"],
                **_read(one, VISIT),
            )
            for one in data.get("visits", ())
        ),
        given=bool(data.get("given")), parting=parting,
        checked_times=pd.DataFrame(data["checked_times"], dtype=float) if "checked_times" in data else None,
    )  # fmt: skip


def _well_from_data(data: Mapping[str, Any], dynamics: Dynamics) -> Well | None:
    if (powers := data["V"]) is None:
        return None
    well = Well(
        PowerBasis.from_data(powers, dynamics.symbols), np.array(powers["coefficients"]), dynamics,
        np.array(data["attractor"]), **_read(powers, WELL),
    )  # fmt: skip
    points, elsewhere = (
        np.array(each).reshape(-1, dynamics.dimension) for each in (well.points, powers["elsewhere"])
    )
    return replace(well, points=points, elsewhere=elsewhere)


def write_landscape(path: str | Path, landscape: Landscape) -> None:
    """Write a landscape as `quasipotential.json`, whole or not at all."""
    data = landscape_data(landscape)
    with whole_file(path) as partial:
        partial.write_text(json.dumps(data, allow_nan=False) + "\n", encoding="utf-8")


def read_landscape(path: str | Path, *, dynamics: Dynamics) -> Landscape | None:
    """Read what `write_landscape` wrote, of an f that was identified beside it; None of an empty file."""
    try:
        text = Path(path).read_text(encoding="utf-8")
        return landscape_from_data(json.loads(text), dynamics) if text else None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(path, "", f"it is no landscape ({type(error).__name__})", "make it again") from None
