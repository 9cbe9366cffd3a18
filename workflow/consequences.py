"""What left-out physics, or other parameters, do to wells, barriers and escape times of a system."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import sympy

from siq.errors import NumericalFailure
from siq.inference.field_estimate import FieldEstimate
from siq.inference.library import CandidateLibrary
from siq.numerics.integration import FlowMap
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.landscape_assembly import find_landscape
from siq.quasipotential.refinement import RefinementOptions
from siq.remarks import sentence
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import TIME, Dynamics, symbol
from siq.systems.phase_portrait import evenly_spread, phase_portrait

ROUGH = (sympy.sign, sympy.Abs, sympy.Max, sympy.Min, sympy.Heaviside, sympy.Piecewise)
DEGREES = (4, 6, 8)
LEVELS = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)  # barriers over ε at which escape times are given
TINY = 1e-100  # what remains of a zero that Newton's method found
WELL_SHIFT_TOLERANCE = 0.5  # of the spread of the states: how far a well may move and keep its name
WELLS_COLUMNS = ("simulation", "item", "kind", "position", "U", "barrier", "prefactor", "note")
ESCAPE_COLUMNS = ("transition", "intensity", "simulation", "time")


def obstacle(models: Sequence[Dynamics]) -> str:
    """Why there are no landscapes to compare, in a sentence; empty where nothing speaks against it."""
    for model in models:
        formulas = list(model.equations)
        if model.inputs:
            return "The system is driven by inputs; a driven system has no quasipotential."
        if any(TIME in formula.free_symbols for formula in formulas):
            return "The equations change with time; such a system has no quasipotential."
        if any(formula.has(*ROUGH) for formula in formulas):
            return "The equations are not smooth; landscapes are worked out for smooth ones only."
    noise = np.diag(models[0].diffusion.matrix)
    pushed = [
        name
        for name, follows, size in zip(models[0].states, models[0].kinematic, noise, strict=True)
        if follows and size > 0
    ]
    if pushed:
        return (
            f"The noise of the card acts on {', '.join(pushed)}, and no random force moves what only follows"
            " from another state; 'diffusion' with a zero there would say what does drive the system."
        )
    if not models[0].diffusion.regular:
        return "The noise does not reach every state directly; landscapes are compared only where it does."
    if len({model.dimension for model in models}) > 1:
        return "What was left out has states of its own, so that the two landscapes lie in different spaces."
    return ""


def identified(model: Dynamics) -> FieldEstimate:
    """The vector field of a model at its parameters' values; its errors are not known."""
    symbols = tuple(symbol(name) for name in model.states)
    values = {symbol(entry.name): sympy.Float(entry.value, 17) for entry in model.parameters}
    components = []
    for formula in model.equations:
        sum_of = sympy.Add.make_args(sympy.expand(formula.xreplace(values)))
        components.append([term.as_coeff_Mul() for term in sum_of])
    terms = tuple(dict.fromkeys(term for component in components for _, term in component))
    coefficients = np.zeros((len(terms), len(symbols)))
    for i, component in enumerate(components):
        for value, term in component:
            coefficients[terms.index(term), i] += float(value)
    support = np.argwhere(coefficients.T)
    everywhere = np.ones(len(terms), dtype=bool)
    library = CandidateLibrary(
        model.states, symbols, terms, everywhere, everywhere,
        np.zeros((len(terms), len(symbols), len(terms))),
    )  # fmt: skip
    return FieldEstimate(
        library, coefficients, support, np.zeros((len(support), len(support))),
        np.zeros((len(symbols), len(symbols))), 0.0, FlowMap(), model.diffusion,
    )  # fmt: skip


def compare_landscapes(
    models: dict[str, Dynamics], states: np.ndarray, *, seed: int = 0
) -> tuple[pd.DataFrame, pd.DataFrame, list[str]]:
    """Find the landscapes of simulations of one system, and put them beside each other.

    Parameters
    ----------
    models
        Two simulations of the same states by name, the one to compare with first. Its D serves for both.
    states
        Recorded states, shape ``(n, d)``: where landscapes are looked for.
    seed
        Decides which points are used where there are too many.

    Returns
    -------
    wells
        Attractors, saddles and ways out of wells, with the columns `WELLS_COLUMNS`.
    escape
        Mean escape times, with the columns `ESCAPE_COLUMNS`; ε in the unit of U.
    notes
        What is not known, in sentences.

    Raises
    ------
    NumericalFailure
        When the first simulation has no wells in the recorded region.
    """
    noise = next(iter(models.values())).diffusion
    chosen = states[evenly_spread(states, generator=np.random.default_rng(seed))]
    spread = states.std(axis=0)
    wells: list[dict[str, object]] = []
    barriers: dict[str, dict[str, tuple[float, float]]] = {}
    known: list[np.ndarray] = []
    notes: list[str] = []
    for name, model in models.items():
        found, note = _landscape(model, noise, chosen, seed)
        notes += [f"{name}: {each}" for each in note]
        if found is None:
            if not known:
                raise NumericalFailure(note[-1])
            continue
        labels = _labels(found, known, spread)
        wells += _rows(name, found, labels)
        barriers[name] = {
            f"{labels[way.start]} to {labels[way.end]}": (way.barrier, way.rate.prefactor)
            for way in found.transitions
            if way.end is not None and way.rate is not None and np.isfinite(way.barrier * way.rate.prefactor)
        }
    if all(len([row for row in wells if row["simulation"] == name and row["kind"] == "attractor"]) < 2
           for name in models):  # fmt: skip
        notes.append("there is one well only, which noise does not leave for another")
    return (
        pd.DataFrame(wells, columns=list(WELLS_COLUMNS)),
        pd.DataFrame(_escapes(barriers), columns=list(ESCAPE_COLUMNS)),
        notes,
    )


def _landscape(
    model: Dynamics, noise: Diffusion, points: np.ndarray, seed: int
) -> tuple[Landscape | None, list[str]]:
    try:
        field = identified(model.with_diffusion(noise))
        setting = phase_portrait(field.dynamics, points, seed=seed)
        if not setting.attractors:
            fault = setting.fault()
            return None, ["no well is found" if fault is None else sentence(fault)]
        found = find_landscape(field, setting, seed=seed, options=RefinementOptions(degrees=DEGREES))
    except (NumericalFailure, np.linalg.LinAlgError, ValueError) as error:
        return None, [str(error)]
    return found, list(found.notes)


def _labels(found: Landscape, known: list[np.ndarray], spread: np.ndarray) -> list[str]:
    """Names of attractors, the same for one that has only moved a little; `known` grows by new ones."""
    labels = []
    taken: set[int] = set()
    for one in found.attractors:
        distance = [
            float(np.linalg.norm((one.position - place) / spread)) if number not in taken else np.inf
            for number, place in enumerate(known)
        ]
        if distance and min(distance) < WELL_SHIFT_TOLERANCE:
            number = int(np.argmin(distance))
        else:
            number = len(known)
            known.append(one.position)
        taken.add(number)
        labels.append(f"A{number + 1}")
    return labels


def _rows(name: str, found: Landscape, labels: list[str]) -> list[dict[str, object]]:
    rows: list[dict[str, object]] = [
        {
            "simulation": name, "item": label, "kind": "attractor", "position": _place(one.position),
            "U": float(height), "barrier": np.nan, "prefactor": np.nan, "note": "",
        }
        for label, one, height in zip(labels, found.attractors, found.heights, strict=True)
    ]  # fmt: skip
    for way in found.transitions:
        beyond = "outside" if way.end is None else labels[way.end]
        rows.append(
            {
                "simulation": name,
                "item": f"{labels[way.start]} to {beyond}",
                "kind": "way out",
                "position": _place(way.saddle.position),
                "U": float(found.heights[way.start] + way.barrier),
                "barrier": float(way.barrier),
                "prefactor": np.nan if way.rate is None else float(way.rate.prefactor),
                "note": "; ".join(way.notes),
            }
        )
    return rows


def _escapes(barriers: dict[str, dict[str, tuple[float, float]]]) -> list[dict[str, object]]:
    """Mean times at intensities at which the first simulation's lowest barrier is a few ε high."""
    lowest = [barrier for ways in barriers.values() for barrier, _ in ways.values()]
    if not lowest:
        return []
    return [
        {"transition": item, "intensity": min(lowest) / level, "simulation": name,
         "time": prefactor * float(np.exp(barrier * level / min(lowest)))}
        for name, ways in barriers.items()
        for item, (barrier, prefactor) in ways.items()
        for level in LEVELS
    ]  # fmt: skip


def _place(position: np.ndarray) -> str:
    return "(" + ", ".join(f"{value if abs(value) > TINY else 0:.4g}" for value in position) + ")"
