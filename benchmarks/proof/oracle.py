"""The oracle: the best that a diagnosis could do, the fit with the concealed effect in place.

The key's formulas are built into the simulation, and the fit starts from the true parameters.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import sympy

from benchmarks.proof.keys import CaseKey
from siq.diagnosis.dictionary import Form, FurtherState, Mechanism, MechanismParameter, Role as RoleKind
from siq.diagnosis.mechanisms import MechanismCandidate, _build_candidate
from siq.diagnosis.study import Comparison
from siq.errors import NumericalFailure
from siq.inference.recalibration import fit_with_process_noise_as_needed, recalibrate
from siq.inference.trajectories import free_run, normalised_rms, sharpened
from siq.systems.dynamics import Dynamics, symbol
from siq.systems.formulas import compile_values, delay

POINTS = 24
SAME = 1e-7
MOST_PAIRINGS = 4000


@dataclass(frozen=True)
class Oracle:
    """What the true simulation does with the recordings.

    Attributes
    ----------
    delta_chi2
        Twice what it gains in log-likelihood over the recalibrated simulation; NaN for nulls and shifts.
    error
        Its normalised error on held-out recordings, NaN where it has none.
    note
        Why something is not known.
    model
        The true simulation as fitted, None where there is none.
    """

    delta_chi2: float
    error: float
    note: str = ""
    model: Dynamics | None = None


def oracle_of(case: Comparison, key: CaseKey) -> Oracle:
    """Fit the true simulation, and compare it with the recalibrated one.

    Parameters
    ----------
    case
        As the diagnosis had it.
    key
        What it conceals.
    """
    try:
        return _oracle(case, key)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        return Oracle(np.nan, np.nan, f"no oracle: {error}")


def _oracle(case: Comparison, key: CaseKey) -> Oracle:
    recalibrated, strict = recalibrate(case.system, case.learn)
    if key.kind == "process noise":
        return Oracle(float(2 * (recalibrated.log_likelihood - strict.log_likelihood)), np.nan)
    true, _ = true_model(case.system, key)
    further = true.dimension - case.system.dimension
    x = np.concatenate([recalibrated.x, np.zeros((len(recalibrated.x), further))], axis=1)
    best = fit_with_process_noise_as_needed(true, case.learn, recalibrated, x=x)
    if not best.converged:
        # A sensor's fault moves all states: begun further from them, or from the recalibrated parameters.
        near = true.with_values(own_values(true, recalibrated.model))
        trials = [best, fit_with_process_noise_as_needed(near, case.learn, recalibrated, x=x)]
        trials.append(fit_with_process_noise_as_needed(true, case.learn, recalibrated, level=100.0, x=x))
        best = max(trials, key=lambda each: (each.converged, each.log_likelihood))
    if not best.converged and not best.log_likelihood > recalibrated.log_likelihood:
        raise NumericalFailure("the fit of the true simulation did not settle")
    unsettled = "" if best.converged else "the oracle's fit did not settle; its Δχ² is a lower bound"
    best = sharpened(best, case.learn)
    gained = 2 * (best.log_likelihood - recalibrated.log_likelihood)
    run = free_run(
        best.model, case.kept, noise=recalibrated.noise, substeps=max(best.substeps, recalibrated.substeps)
    )
    error = normalised_rms(run, case.kept)
    return Oracle(
        float(gained) if key.effect.changes_equations else np.nan,
        np.nan if error is None else error,
        unsettled or ("" if error is not None else "the oracle's free run ran away"),
        best.model,
    )


def true_model(model: Dynamics, key: CaseKey) -> tuple[Dynamics, Mapping[str, str]]:
    """The simulation with the concealed effect and the true parameters.

    Returns
    -------
    Dynamics
        The effect's parameters are the last ones.
    dict
        The key's name of each of them, by the model's name.
    """
    shifts = {name: shift.true for name, shift in key.shifts.items()}
    right = replace(
        model,
        parameters=tuple(replace(each, value=shifts.get(each.name, each.value)) for each in model.parameters),
    )
    if not key.effect.changes_equations:
        return right, {}
    candidate = built(right, key)
    names = dict(zip(candidate.amplitudes, key.effect.parameters, strict=True))
    values = [
        key.effect.parameters[names[each.name]] if each.name in names else each.value
        for each in candidate.model.parameters
    ]
    return candidate.model.with_values(np.array(values)), names


def own_values(system: Dynamics, other: Dynamics) -> np.ndarray:
    """The values that another simulation has of a system's parameters; its own where it has none."""
    known = {each.name: each.value for each in other.parameters}
    return np.array([known.get(each.name, each.value) for each in system.parameters])


def built(model: Dynamics, key: CaseKey) -> MechanismCandidate:
    """The effect of a key, built into a simulation; every name of the card is a role of its own.

    Raises
    ------
    ValueError
        When it changes nothing, or a formula cannot be read.
    """
    roles: dict[str, RoleKind] = dict.fromkeys(model.output_names, "output")
    roles |= {each.name: "parameter" for each in model.parameters}
    roles |= {each.name: "input" for each in model.inputs}
    roles |= dict.fromkeys(model.states, "state")
    effect = key.effect
    form = Form(
        roles=roles,
        terms=effect.terms,
        replace=effect.replace,
        outputs=effect.outputs,
        states={name: FurtherState(equation=text, scale="1") for name, text in effect.states.items()},
        parameters={name: MechanismParameter() for name in effect.parameters},
        coordinate="t",
    )
    mechanism = Mechanism(name=key.mechanism or "none", sentence="", forms=(form,))
    candidate = _build_candidate(model, mechanism, form, {name: name for name in roles})
    if candidate is None:
        raise ValueError("the key's effect changes nothing in the simulation")
    return candidate


def pairing(augmented: Dynamics, true: Dynamics, base: Dynamics) -> dict[str, tuple[str, int]] | None:
    """Which parameter of the truth each new parameter of an augmented simulation is, and with which sign.

    Parameters
    ----------
    augmented
        The simulation that the diagnosis ended with.
    true
        The simulation with the concealed effect.
    base
        The card's.

    Returns
    -------
    dict or None
        None where the two are not the same formulas of their parameters.
    """
    known = {each.name for each in base.parameters}
    ours = [each.name for each in augmented.parameters if each.name not in known]
    theirs = [each.name for each in true.parameters if each.name not in known]
    shape = (augmented.dimension, len(augmented.outputs))
    if not theirs or len(ours) < len(theirs) or shape != (true.dimension, len(true.outputs)):
        return None
    choices = [(name, sign) for sign in (1, -1) for name in theirs]
    if len(choices) ** len(ours) > MOST_PAIRINGS:
        return None
    rng = np.random.default_rng(0)
    common = sorted(known | set(base.states) | {each.name for each in base.inputs} | {"t"})
    values = {name: rng.uniform(0.2, 2.0, POINTS) for name in common}
    for name in (*base.states, *(each.name for each in base.inputs)):
        values[name] = values[name] * np.where(np.arange(POINTS) % 3 == 0, -1.0, 1.0)
    values |= {f"truth {name}": rng.uniform(0.2, 2.0, POINTS) for name in theirs}
    further = rng.uniform(-1, 1, (true.dimension - base.dimension, POINTS))
    target = _evaluator(true)(values | {name: values[f"truth {name}"] for name in theirs}, further)
    # Signs are changed as seldom as possible.
    options = sorted(
        itertools.product(choices, repeat=len(ours)), key=lambda pairs: sum(sign < 0 for _, sign in pairs)
    )
    evaluate = _evaluator(augmented)
    for pairs in options:
        if {name for name, _ in pairs} != set(theirs):
            continue
        mapped = {own: sign * values[f"truth {name}"] for own, (name, sign) in zip(ours, pairs, strict=True)}
        if np.allclose(evaluate(values | mapped, further), target, rtol=SAME, atol=1e-12, equal_nan=True):
            return dict(zip(ours, pairs, strict=True))
    return None


def _evaluator(model: Dynamics) -> Callable[[Mapping[str, np.ndarray], np.ndarray], np.ndarray]:
    """A model's formulas as one function of named values, and of those of its further states."""
    formulas = [*model.equations, *(formula for _, formula in model.outputs)]
    # For comparison a delay may be any function of its arguments.
    stand_in = {
        each: sympy.sin(sympy.Float(1.3) * each.args[0] + sympy.Float(0.7) * each.args[1])
        for formula in formulas
        for each in formula.atoms(delay)
    }
    compiled = compile_values(
        [formula.xreplace(stand_in) for formula in formulas],
        [symbol(name) for name in model.names],
    )

    def evaluate(values: Mapping[str, np.ndarray], further: np.ndarray) -> np.ndarray:
        own = [name for name in model.states if name not in values]
        at = {**values, **dict(zip(own, further, strict=True))}
        with np.errstate(all="ignore"):
            found = compiled(*(at[name] for name in model.names))
        return np.array([np.broadcast_to(each, POINTS) for each in found])

    return evaluate
