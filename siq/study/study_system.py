"""Which system has a study, and does what the study asks fit that system?"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from siq.dynamics.cards import SystemCard, build_system, read_diffusion
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import FormulaError
from siq.dynamics.parametric import symbol
from siq.dynamics.reach import unreached_states
from siq.dynamics.sampling import fault_over_domain
from siq.errors import InputError, suggestion
from siq.files.documents import read_document, validate
from siq.identify.library import candidate_library
from siq.identify.velocities import velocity_names
from siq.study.study import Study
from siq.study.sweep import SweepOptions


def load_study_system(study: Study, *, file: str, systems: Path) -> Dynamics | None:
    """The system of a study, checked together with what the study asks of it.

    Parameters
    ----------
    study
        The study.
    file
        Its file, for messages.
    systems
        Folder of the cards that studies name.

    Raises
    ------
    InputError
        When the card is missing or refused, inputs or the time drive the system, or the study's library or D
        does not fit the states.
    """
    directly = study.entrance != "equations"
    system = None
    if study.system is not None:
        system = _with_landscape(system_path(study.system, systems=systems), directly=directly)
    states = system.states if system is not None else None
    if study.recordings is not None and study.recordings.states is not None:
        if system is not None and study.recordings.states != system.states:
            raise InputError(
                file, "recordings.states", f"the states are not those of the system '{system.name}'",
                f"name {', '.join(system.states)}, in this order, or leave them out",
            )  # fmt: skip
        states = study.recordings.states
    if states is not None:
        check_states(study, states, file=file)
    if study.sweep is not None and system is not None:
        check_sweep(study.sweep, system, file=file)
    return system


def check_sweep(sweep: SweepOptions, system: Dynamics, *, file: str) -> None:
    """Whether a system has the parameters that a study sweeps.

    Raises
    ------
    InputError
        When it has not.
    """
    known = [each.name for each in system.parameters]
    places = ("sweep.parameter", "sweep.second.parameter")
    for name, place in zip(sweep.names, places, strict=False):
        if name not in known:
            otherwise = f"use one of {', '.join(known)}" if known else "write it on the card as a parameter"
            fault = f"the card of '{system.name}' has no parameter '{name}'"
            raise InputError(file, place, fault, suggestion(name, known, otherwise=otherwise))


def _with_landscape(path: Path, *, directly: bool) -> Dynamics:
    """The system of a card that can be simulated by itself, and has a landscape that we can work out."""
    document = read_document(path)
    system = build_system(document, validate(document, SystemCard))
    if (fault := fault_for_landscape(system, directly=directly)) is not None:
        keys, what, remedy = fault
        raise InputError(document.file, document.place(keys), what, remedy)
    return system


def fault_for_landscape(system: Dynamics, *, directly: bool) -> tuple[tuple[str, ...], str, str] | None:
    """Why no landscape of a system can be worked out: the place in its card, the fault and the remedy.

    Parameters
    ----------
    system
        As its card says.
    directly
        Whether noise has to act on every state, as trajectories ask for, or may reach it by way of others.
    """
    if not system.autonomous:
        key, what = ("inputs", "inputs") if system.inputs else ("equations", "time")
        remedy = f"leave the {what} out, or use the card in a study of mismatch"
        return (key,), "a driven system has no quasipotential", remedy
    for name, limits in zip(system.states, system.limits, strict=True):
        if np.isnan(limits).any():
            what = f"the state '{name}' has no domain, in which a simulation could begin"
            return ("states", name), what, "add 'domain: [lower, upper]' to it"
    if directly and not system.diffusion.regular:
        what = "the noise does not reach every state directly, as it has to where f comes from trajectories"
        remedy = (
            "give a positive definite matrix, or ask for the landscape of these equations: 'from: equations'"
        )
        return ("diffusion",), what, remedy
    if still := unreached_states(system):
        what = f"the noise does not reach {' and '.join(still)}, neither directly nor by way of other states"
        return (
            ("diffusion",),
            what,
            f"let it act on {still[0]} or on a state in its equation, or leave it out",
        )
    if (found := fault_over_domain(system)) is not None:
        remedy = "choose a domain in which it has a value"
        return ("equations", found[0]), f"the equation {found[1]}", remedy
    return None


def check_states(study: Study, states: Sequence[str], *, file: str) -> None:
    """Check what a study says of its states, once these are known.

    Raises
    ------
    InputError
        When the library's functions or D do not fit the states.
    """
    try:
        if study.recordings is not None and study.recordings.diffusion is not None:
            noise = read_diffusion(study.recordings.diffusion, [symbol(name) for name in states], None)
            if not noise.regular:
                raise ValueError("the noise does not reach every state; give a positive definite matrix")
    except ValueError as error:
        fault, remedy = str(error).split("; ", 1)
        raise InputError(file, "recordings.diffusion", fault, remedy) from None
    for step, functions in (
        ("identification", study.identification.functions),
        ("regression", study.regression.functions),
    ):
        try:
            hidden = step == "identification" and study.identification.hidden_velocities
            known = (*states, *velocity_names(states)) if hidden else states
            candidate_library(known, degree=1, further=functions)
        except FormulaError as error:
            raise InputError(file, f"{step}.functions", error.fault, error.remedy) from None


def system_path(system: str, *, systems: Path) -> Path:
    """The card that a study means: a path as it stands, a name within the folder of cards."""
    if system.endswith((".yaml", ".yml")):
        return Path(system)
    return systems / f"{system}.yaml"
