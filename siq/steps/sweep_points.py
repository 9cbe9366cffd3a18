"""One point of a sweep: which wells and ways out have equations at one value of their parameters?

Equilibria, paths of least action and escape times by `siq.steps.equations`, without formulas of U. A point
knows of no noise and of no other point, so that a change of the range, or of the noise, leaves those that
there are.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import sympy
from pydantic import ConfigDict, TypeAdapter
from pydantic.dataclasses import dataclass

from siq.dynamics.cards import ParameterEntry, SystemCard, build_system
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibrium_search import all_equilibria
from siq.dynamics.many_states import MOST_SEARCHED
from siq.errors import InputError, NumericalFailure
from siq.files.documents import read_document, validate
from siq.files.whole import whole_file
from siq.landscape.dwell_times import Exit
from siq.landscape.refusal import NoLandscape
from siq.landscape.transitions import Transition
from siq.numerics.randomness import Purpose, generator
from siq.steps.equations import EquationSettings, landscape_of_equations, usable_system
from siq.steps.settings import STRICT

PLAIN = ConfigDict(extra="forbid", ser_json_inf_nan="constants")


@dataclass(frozen=True, config=STRICT)
class PointSettings:
    """What a point depends on, beside the equations at its value."""

    seed: int = 0


@dataclass(frozen=True, config=PLAIN)
class SweptWell:
    """An attractor at a point: its state, and the slowest rate at which f leads back to it."""

    state: tuple[float, ...]
    relaxation: float


@dataclass(frozen=True, config=PLAIN)
class SweptWay:
    """A way out: wells by their place, `end` None where it leads out of the domain; barrier and prefactor."""

    start: int
    end: int | None
    barrier: float | None
    prefactor: float | None
    note: str = ""

    def as_exit(self) -> Exit:
        """What its time follows from."""
        return Exit(np.nan if self.barrier is None else self.barrier, 0.0, self.prefactor)


@dataclass(frozen=True, config=PLAIN)
class SweptPoint:
    """The landscape at one value of the parameters.

    Attributes
    ----------
    values
        Of the parameters, in their order.
    equilibria
        All that were found, the unstable ones too.
    wells, ways
        Attractors and the ways out of them.
    settled
        Share of the states of the domain from which f leads to one of the wells.
    reason
        Why there is no landscape, in words; empty where there is one.
    notes
        What could not be done, in words.
    """

    values: tuple[float, ...]
    equilibria: tuple[tuple[float, ...], ...]
    wells: tuple[SweptWell, ...] = ()
    ways: tuple[SweptWay, ...] = ()
    settled: float = 0.0
    reason: str = ""
    notes: tuple[str, ...] = ()


def check_noise(system: Dynamics, names: Iterable[str]) -> None:
    """Refuse parameters on which D depends: a dynamics has it with their values inserted.

    Raises
    ------
    InputError
        With what to give instead.
    """
    if of_noise := sorted(set(names) & set(system.parameters_of_noise)):
        raise InputError(
            system.name or "the system", "diffusion",
            f"D depends on {', '.join(of_noise)}, and was made with the value of the card",
            "give the card instead of the dynamics",
        )  # fmt: skip


def with_parameters(system: str | Path | Dynamics, names: Sequence[str], values: Sequence[float]) -> Dynamics:
    """A system with other values of some parameters, those in D included.

    Raises
    ------
    InputError
        Where the system has no landscape at these values.
    """
    changed = dict(zip(names, map(float, values), strict=True))
    if not isinstance(system, Dynamics):
        document = read_document(system)
        card = validate(document, SystemCard)
        entries = {
            name: ParameterEntry(value=changed.get(name, entry.value), unit=entry.unit, fixed=entry.fixed)
            for name, entry in card.parameters.items()
        }
        return usable_system(build_system(document, card.model_copy(update={"parameters": entries})))
    replaced = np.array([changed.get(each.name, each.value) for each in system.parameters], dtype=float)
    at_values = system.with_values(replaced)
    for name, formula in zip(system.states, at_values.formulas, strict=True):
        if formula.has(sympy.zoo, sympy.nan, sympy.oo):
            raise InputError(
                system.name or "the system", f"equations.{name}", f"the equation of {name} has no value",
                "leave this value of the parameter out",
            )  # fmt: skip
    return usable_system(at_values)


def point_at(
    system: str | Path | Dynamics, names: Sequence[str], values: tuple[float, ...], settings: PointSettings
) -> SweptPoint:
    """The landscape at values of the parameters; where there is none, or f has no value, the reason."""
    try:
        system = with_parameters(system, names, values)
    except InputError as error:
        return SweptPoint(values, (), reason=f"{error.fault}; {error.remedy}")
    try:
        found = landscape_of_equations(system, EquationSettings(seed=settings.seed), formulas=False)
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        reason = error.reason if isinstance(error, NoLandscape) else str(error)
        return SweptPoint(values, _resting(system, settings), reason=reason)
    return SweptPoint(
        values,
        tuple(tuple(map(float, one.position)) for one in found.equilibria),
        tuple(
            SweptWell(tuple(map(float, one.position)), float(-one.eigenvalues.real.max()))
            for one in found.attractors
        ),
        tuple(map(_as_way, found.transitions)),
        settled=float(found.basins.sum()),
        notes=found.notes,
    )


def _resting(system: Dynamics, settings: PointSettings) -> tuple[tuple[float, ...], ...]:
    """Equilibria where there is no landscape: a branch may pass through them all the same."""
    if system.dimension > MOST_SEARCHED:
        return ()
    try:
        draw = generator(settings.seed, Purpose.LANDSCAPE)
        found = all_equilibria(system, generator=draw).equilibria
    except (NumericalFailure, np.linalg.LinAlgError):
        return ()
    return tuple(tuple(map(float, one.position)) for one in found)


def _as_way(way: Transition) -> SweptWay:
    barrier = float(way.barrier) if np.isfinite(way.barrier) else None
    prefactor = None if way.rate is None else float(way.rate.prefactor)
    return SweptWay(way.start, way.end, barrier, prefactor, "; ".join(way.notes))


def write_point(path: str | Path, point: SweptPoint) -> None:
    """Write a point as JSON."""
    with whole_file(path) as partial:
        partial.write_bytes(TypeAdapter(SweptPoint).dump_json(point))


def read_point(path: str | Path) -> SweptPoint:
    """Read what `write_point` wrote."""
    return TypeAdapter(SweptPoint).validate_json(Path(path).read_bytes())
