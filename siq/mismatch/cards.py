"""The augmented card: the simulation with what was missing, a card like any other."""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml

from siq.documents import Document, validate
from siq.mismatch.model import Model
from siq.systems import SystemCard


def augmented_card(
    card: Document, model: Model, *, process: np.ndarray | None = None, scale: np.ndarray | None = None
) -> str:
    """Write the card of a fitted model, beginning from the card that was diagnosed.

    Parameters
    ----------
    card
        The card as read; its title, units and what else the model does not know are kept.
    model
        The fitted simulation, with the estimates as values.
    process
        Intensity of random forces on each state, per time, where they are part of what was found: they
        become the card's diffusion.
    scale
        Spread of each state, shape ``(d,)``: states that a mechanism brings get their domain from it.

    Returns
    -------
    str
        YAML that `siq.mismatch.model.load_model` reads as the same model.
    """
    checked = validate(card, SystemCard)
    data: dict[str, Any] = {
        "name": checked.name,
        "title": checked.title,
        "time_unit": checked.time_unit,
        "states": {
            name: {"unit": unit, "domain": _domain(model, place, scale)}
            for place, (name, unit) in enumerate(zip(model.states, model.state_units, strict=True))
        },
    }
    if model.inputs:
        data["inputs"] = {
            entry.name: {"unit": entry.unit, "interpolation": entry.interpolation} for entry in model.inputs
        }
    data["parameters"] = {
        entry.name: {"value": float(entry.value), "unit": entry.unit}
        | ({"fixed": True} if entry.fixed else {})
        for entry in model.parameters
    }
    data["equations"] = {
        name: str(formula) for name, formula in zip(model.states, model.equations, strict=True)
    }
    data["outputs"] = {name: str(formula) for name, formula in model.outputs}
    if process is not None and (process > 0).all():
        data["diffusion"] = [float(each) for each in process]
    elif len(model.states) == len(checked.states):
        data["diffusion"] = card.data.get("diffusion", "identity")
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=110)


def _domain(model: Model, place: int, scale: np.ndarray | None) -> list[float]:
    lower, upper = (float(limit) for limit in model.domain[place])
    if (
        scale is not None
        and place < len(scale)
        and np.isfinite(scale[place])
        and (lower, upper) == (-1.0, 1.0)
    ):
        wide = 3 * float(scale[place]) or 1.0
        return [-wide, wide]
    return [lower, upper]
