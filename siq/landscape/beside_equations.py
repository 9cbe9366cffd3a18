"""How far is a landscape of trajectories from that of the equations behind them?

Where the equations of a simulated system are known, their own landscape (`siq.steps.equations`) tells every
barrier, prefactor and mean time without any trajectory. It scores the landscape that was learned, and is no
input of it. Both are taken as plain data (`siq.landscape.storage`).

An attractor of the trajectories is that attractor of the equations to which it is nearest among all their
equilibria, in shares of the domain; of several, the nearest one. Ways out have the same two ends, and the
nearest saddle where there are several.

U is in the unit of D, so that only landscapes of one D can be compared: of the D of both no more may differ
than the errors of one that was estimated leave open.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics
from siq.identify.diffusion import STANDARD_ERRORS
from siq.identify.identified_field import IdentifiedField
from siq.landscape.dwell_times import NoiseStrength, dwell_time
from siq.landscape.storage import exits_of
from siq.numerics.measured_text import place_text

MISSED = "the trajectories do not show it"
FURTHER = "the equations have no such"
CYCLE = "limit cycles are not compared"

ROUNDING = 1e-9  # numerical, of D: two formulas of the same matrix

Plain = Mapping[str, Any]


@dataclass(frozen=True)
class Difference:
    """One number of the equations beside that of the trajectories.

    Attributes
    ----------
    item
        ``A1`` for the first attractor of the equations, ``A1 to A2`` for a way out of it.
    quantity
        ``barrier``, ``prefactor`` or ``mean time``.
    equations, trajectories
        The number by either, NaN where it is not known.
    standard_error
        Of that of the trajectories, as these state it; NaN where they state none.
    noise
        ε of a mean time, NaN of the others.
    note
        What is missing, in words.
    """

    item: str
    quantity: str
    equations: float
    trajectories: float
    standard_error: float = np.nan
    noise: float = np.nan
    note: str = ""

    @property
    def relative_difference(self) -> float:
        """By which share the trajectories are off."""
        return self.trajectories / self.equations - 1 if self.equations else np.nan

    @property
    def in_errors(self) -> float:
        """The same in standard errors; NaN where there are none."""
        known = self.standard_error > 0
        return (self.trajectories - self.equations) / self.standard_error if known else np.nan


def differences(
    equations: Plain, trajectories: Plain, *, box: np.ndarray, noises: Sequence[float] = ()
) -> list[Difference]:
    """Every barrier, prefactor and mean time of two landscapes beside each other.

    Parameters
    ----------
    equations, trajectories
        The landscapes, as `siq.landscape.storage.landscape_data` has them.
    box
        The domain of the equations, shape ``(d, 2)``.
    noises
        ε for which mean times are compared.

    Raises
    ------
    ValueError
        When the states are not the same.
    """
    if list(equations["states"]) != list(trajectories["states"]):
        raise ValueError("the landscapes are of different states")
    pairs = _pairs(equations, trajectories, np.ptp(np.asarray(box, dtype=float), axis=1))
    found: list[Difference] = []
    for index, one in enumerate(equations["wells"]):
        for noise in noises:
            found.append(_time(equations, trajectories, index, pairs.get(index), noise))
        if "cycle" in one or index not in pairs:
            found.append(_absent(f"A{index + 1}", CYCLE if "cycle" in one else MISSED))
    return [*_of_ways(equations, trajectories, pairs), *found]


def check_same_noise(
    equations: Dynamics, trajectories: Dynamics, x: np.ndarray, *, found: IdentifiedField | None
) -> None:
    """Refuse two landscapes whose D are not the same, and U in different units with them.

    Parameters
    ----------
    equations, trajectories
        Of the same states.
    x
        States at which D is compared, shape ``(n, d)``.
    found
        The identified f, whose D may have been estimated and has errors then; None where f is given.

    Raises
    ------
    ValueError
        With both D and the remedy.
    """
    one, other, d = equations.diffusion, trajectories.diffusion, equations.dimension
    # Unit vectors and their sums tell a symmetric matrix; in the unit of the noise, or states would differ.
    sides = np.array([np.eye(d)[[i, j]].sum(axis=0) for i, j in zip(*np.triu_indices(d), strict=True)])
    size = np.sqrt(np.diagonal(one.at(x), axis1=1, axis2=2))
    momenta = (sides / np.where(size > 0, size, 1.0)[:, None]).reshape(-1, d)
    places = np.repeat(x, len(sides), axis=0)
    difference = np.sum(momenta * (other.push(places, momenta) - one.push(places, momenta)), axis=1)
    errors = np.zeros(len(places))
    if found is not None:
        errors = np.sqrt(found.noise_variance(found.noise_slopes(places, momenta)))
    apart = ~(np.abs(difference) <= ROUNDING + STANDARD_ERRORS * errors)
    if apart.any():
        place = places[[np.argmax(apart)]]
        where = "" if one.constant and other.constant else f" at {place_text(place[0])}"
        raise ValueError(
            f"U is in the unit of D, and D is not the same: the equations have {_rows(one, place)}{where},"
            f" the trajectories {_rows(other, place)}; give both the same, recordings by"
            " StateSpace(diffusion=...), or compare ΔU/ε"
        )


def _rows(noise: Diffusion, place: np.ndarray) -> list[list[float]]:
    """D at a state, ``(1, d)``, to four digits."""
    return [[float(f"{each:.4g}") for each in row] for row in noise.at(place)[0]]


def difference_rows(found: Sequence[Difference]) -> list[dict[str, object]]:
    """Differences as rows of a table."""
    return [
        {
            "item": one.item,
            "quantity": one.quantity,
            "noise": one.noise,
            "equations": one.equations,
            "trajectories": one.trajectories,
            "standard_error": one.standard_error,
            "relative_difference": one.relative_difference,
            "in_errors": one.in_errors,
            "note": one.note,
        }
        for one in found
    ]


def _absent(item: str, note: str) -> Difference:
    return Difference(item, "", np.nan, np.nan, note=note)


def _pairs(equations: Plain, trajectories: Plain, width: np.ndarray) -> dict[int, int]:
    """For each attractor of the equations that the trajectories show, its place among theirs."""
    wells = [one for one in equations["wells"] if "cycle" not in one]  # cycles follow after points
    others = [one["position"] for one in equations["equilibria"] if one["kind"] != "attractor"]
    places = np.array([*(one["attractor"] for one in wells), *others], dtype=float)
    nearest: dict[int, tuple[float, int]] = {}
    for place, well in enumerate(trajectories["wells"]):
        if "cycle" in well or not len(places):
            continue
        distance = np.linalg.norm((places - np.array(well["attractor"])) / width, axis=1)
        index = int(distance.argmin())
        if index < len(wells):
            nearest[index] = min(nearest.get(index, (np.inf, -1)), (float(distance[index]), place))
    return {index: place for index, (_, place) in nearest.items()}


def _of_ways(equations: Plain, trajectories: Plain, pairs: Mapping[int, int]) -> Iterator[Difference]:
    """Barrier and prefactor of every way out, first those of the equations, then what these have not."""
    left = list(trajectories["transitions"])
    for way in equations["transitions"]:
        item = _named(way["start"], way["end"])
        ends = (pairs.get(way["start"]), None if way["end"] is None else pairs.get(way["end"], -1))
        same = [one for one in left if (one["start"], one["end"]) == ends]
        if not same:
            yield Difference(item, "barrier", _number(way["barrier"]), np.nan, note=MISSED)
            continue
        own = min(same, key=lambda one: float(np.linalg.norm(np.subtract(one["saddle"], way["saddle"]))))
        left.remove(own)
        error = _number(own.get("error", own["standard_error"]))
        yield Difference(item, "barrier", _number(way["barrier"]), _number(own["barrier"]), error)
        factor = _number(own["prefactor"])
        error = factor * _number(own.get("prefactor_error"))  # which is that of its logarithm
        why = "" if way["prefactor"] is not None else "; ".join(way["notes"])
        yield Difference(item, "prefactor", _number(way["prefactor"]), factor, error, note=why)
    back = {place: index for index, place in pairs.items()}
    for own in left:
        item = _named(back.get(own["start"]), None if own["end"] is None else back.get(own["end"], -1))
        yield Difference(item, "barrier", np.nan, _number(own["barrier"]), note=FURTHER)


def _named(start: int | None, end: int | None) -> str:
    """A way out by the attractors of the equations."""
    first = "a further state" if start is None else f"A{start + 1}"
    return f"{first} to " + ("outside" if end is None else "a further state" if end < 0 else f"A{end + 1}")


def _time(equations: Plain, trajectories: Plain, well: int, own: int | None, noise: float) -> Difference:
    """How long a well lasts; the law is the same for both, so that its error is not counted."""
    exact = dwell_time(exits_of(equations, well), NoiseStrength(noise))
    found = None if own is None else dwell_time(exits_of(trajectories, own), NoiseStrength(noise))
    return Difference(
        f"A{well + 1}", "mean time",
        np.nan if exact is None else exact.value,
        np.nan if found is None else found.value,
        np.nan if found is None else found.value * found.data_error,
        noise,
    )  # fmt: skip


def _number(value: float | None) -> float:
    return np.nan if value is None else float(value)
