"""From a card to a model, and back: the simulation with what was missing is a card like any other."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import sympy
import yaml

from siq.documents import Document, read_document, validate
from siq.errors import InputError
from siq.expressions import FormulaError, parse_formula
from siq.mismatch.model import TIME, Input, Model, Parameter, symbol
from siq.systems import Formula, SystemCard


def load_model(path: str | Path) -> Model:
    """Read a system card as a model whose parameters can be fitted.

    Raises
    ------
    InputError
        With the card, the line and the offending name.
    """
    document = read_document(path)
    return build_model(document, validate(document, SystemCard))


def build_model(document: Document, card: SystemCard) -> Model:
    """Build the model that a checked card describes; `document` says where its formulas stand."""
    declared = (*card.states, *card.inputs, *card.parameters)
    names = {name: symbol(name) for name in declared} | {"t": TIME}

    def parse(keys: tuple[str, ...], text: Formula, known: Mapping[str, sympy.Expr]) -> sympy.Expr:
        try:
            return parse_formula(text, known, inputs=tuple(card.inputs))
        except FormulaError as error:
            raise InputError(document.file, document.place(keys), error.fault, error.remedy) from None

    outputs = card.outputs if card.outputs is not None else {name: name for name in card.states}
    return Model(
        name=card.name,
        title=card.title or card.name,
        time_unit=card.time_unit,
        states=tuple(card.states),
        state_units=tuple(entry.unit for entry in card.states.values()),
        domain=np.array([entry.domain for entry in card.states.values()]),
        inputs=tuple(Input(name, entry.unit, entry.interpolation) for name, entry in card.inputs.items()),
        parameters=tuple(
            Parameter(name, entry.value, entry.unit, entry.fixed) for name, entry in card.parameters.items()
        ),
        equations=tuple(parse(("equations", name), card.equations[name], names) for name in card.states),
        outputs=tuple((name, parse(("outputs", name), text, names)) for name, text in outputs.items()),
    )


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
        YAML that `load_model` reads as the same model.
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
