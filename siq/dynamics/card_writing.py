"""A dynamics as the text of a system card; `siq.dynamics.cards` reads it back as the same dynamics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.state_noise import diffusion_rows_of

if TYPE_CHECKING:
    from siq.dynamics.dynamics import Dynamics

UNNAMED = "system"
WIDTH = 110  # of a line of the card


def card_of(dynamics: Dynamics) -> str:
    """Write a dynamics as a system card.

    Parameters
    ----------
    dynamics
        Its parameters' values are those of the card; a domain that nobody knows is left out.

    Returns
    -------
    str
        YAML.
    """
    name = dynamics.name or UNNAMED
    data: dict[str, Any] = {
        "name": name,
        "title": "" if dynamics.title == name else dynamics.title,
        "time_unit": dynamics.time_unit,
        "states": {
            state: {"unit": unit} | _domain(limits)
            for state, unit, limits in zip(dynamics.states, dynamics.units, dynamics.limits, strict=True)
        },
    }
    if dynamics.inputs:
        data["inputs"] = {
            entry.name: {"unit": entry.unit, "interpolation": entry.interpolation}
            for entry in dynamics.inputs
        }
    if dynamics.parameters:
        data["parameters"] = {
            entry.name: {"value": float(entry.value), "unit": entry.unit}
            | ({"fixed": True} if entry.fixed else {})
            for entry in dynamics.parameters
        }
    data["equations"] = {
        state: str(formula) for state, formula in zip(dynamics.states, dynamics.equations, strict=True)
    }
    data["outputs"] = {output: str(formula) for output, formula in dynamics.outputs}
    data["diffusion"] = _diffusion(dynamics.diffusion)
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=WIDTH)


def _domain(limits: np.ndarray) -> dict[str, list[float]]:
    return {"domain": [float(limit) for limit in limits]} if limits[0] < limits[1] else {}


def _diffusion(diffusion: Diffusion) -> str | list[str | float] | list[list[str | float]]:
    """``identity``, the diagonal, or the whole matrix."""
    rows = diffusion_rows_of(diffusion)
    places = range(len(rows))
    if any(rows[i][j] not in (0.0, "0") for i in places for j in places if i != j):
        return rows
    diagonal = [rows[i][i] for i in places]
    return "identity" if all(entry == 1.0 for entry in diagonal) else diagonal
