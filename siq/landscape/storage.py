"""`quasipotential.json`: a landscape as a file that anything can evaluate without this library.

Powers stand as in `siq.model`. Each well has the points of its fit, away from which nothing is claimed; the
vector field, which tells where a formula solves the Hamilton–Jacobi equation, stands in `vector_field.json`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from siq.bases import PowerBasis
from siq.errors import InputError
from siq.files import whole_file
from siq.landscape.combined import GlobalQuasipotential, matched
from siq.landscape.landscape import Landscape
from siq.landscape.local import LocalQuasipotential
from siq.landscape.transitions import Transition
from siq.local_route import Well
from siq.vector_field import VectorField

DIGITS = 8  # of points of a fit, which only tell where a formula holds


@dataclass(frozen=True)
class StoredLandscape:
    """What `write_landscape` keeps.

    Attributes
    ----------
    quasipotential
        U over all wells, None where it is not known.
    local
        The formula about each attractor, None where there is none.
    data
        Everything, as plain data: equilibria, wells, transitions with their paths, notes.
    """

    quasipotential: GlobalQuasipotential | None
    local: tuple[LocalQuasipotential | None, ...]
    data: Mapping[str, Any]


def write_landscape(path: str | Path, landscape: Landscape, *, field: VectorField) -> None:
    """Write a landscape whole or not at all."""
    data = {
        "states": [symbol.name for symbol in field.symbols],
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
                "basin": float(basin),
                "height": _number(height),
                "V": None if local is None else _formula(local),
            }
            for attractor, basin, height, local in zip(
                landscape.attractors, landscape.basins, landscape.heights, landscape.local, strict=True
            )
        ],
        "transitions": [_transition(one) for one in landscape.transitions],
        "notes": list(landscape.notes),
    }
    with whole_file(path) as partial:
        partial.write_text(json.dumps(data, allow_nan=False) + "\n", encoding="utf-8")


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _formula(local: LocalQuasipotential) -> dict[str, Any]:
    well = local.well
    return {
        "center": well.basis.center.tolist(),
        "scale": well.basis.scale.tolist(),
        "exponents": well.basis.exponents.tolist(),
        "coefficients": well.coefficients.tolist(),
        "level": well.level,
        "saddle": None if well.saddle is None else well.saddle.tolist(),
        "tolerance": local.tolerance,
        "residual": well.residual,
        "points": _rounded(well.points),
        "elsewhere": [] if local.elsewhere is None else _rounded(local.elsewhere),
    }


def _rounded(points: np.ndarray) -> list[list[float]]:
    return [[float(f"{value:.{DIGITS}g}") for value in row] for row in points]


def _transition(one: Transition) -> dict[str, Any]:
    rate, path = one.rate, one.path
    return {
        "start": one.start,
        "end": one.end,
        "saddle": one.saddle.position.tolist(),
        "barrier": _number(one.barrier),
        "by_formula": _number(one.by_formula),
        "standard_error": _number(one.standard_error),
        "minimum_action": None if path is None else path.uphill.action,
        "prefactor": None if rate is None else rate.prefactor,
        "exponent": None if rate is None else rate.exponent,
        "uphill": None if path is None else path.uphill.points.tolist(),
        "downhill": None if path is None else path.downhill.tolist(),
        "notes": list(one.notes),
    }


def read_landscape(path: str | Path, *, field: VectorField, diffusion: np.ndarray) -> StoredLandscape | None:
    """Read what `write_landscape` wrote; None where the file is empty since there was nothing to write.

    Parameters
    ----------
    path
        The file.
    field
        f, as it was identified beside it.
    diffusion
        D.

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
        local = tuple(_local(well, field, diffusion) for well in data["wells"])
        heights = np.array([well["height"] for well in data["wells"]], dtype=float)
        return StoredLandscape(matched(local, heights), local, data)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(path, "", f"it is no landscape ({type(error).__name__})", "make it again") from None


def _local(data: Mapping[str, Any], field: VectorField, diffusion: np.ndarray) -> LocalQuasipotential | None:
    powers = data["V"]
    if powers is None:
        return None
    basis = PowerBasis(
        field.symbols, np.array(powers["center"]), np.array(powers["scale"]), np.array(powers["exponents"])
    )
    saddle = None if powers["saddle"] is None else np.array(powers["saddle"])
    well = Well(
        np.array(data["attractor"]), basis, np.array(powers["coefficients"]), powers["level"], saddle,
        powers["residual"], np.array(powers["points"]),
    )  # fmt: skip
    elsewhere = np.array(powers["elsewhere"]).reshape(-1, len(field.symbols))
    return LocalQuasipotential(well, field, diffusion, powers["tolerance"], elsewhere)
