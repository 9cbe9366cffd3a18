"""A landscape as it is told: wells by letters, with units, errors and times, from plain data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from siq.landscape.dwell_times import Exit, MeanTime, NoiseStrength, dwell_time
from siq.landscape.storage import exits_of
from siq.numerics.measured_text import squared

NOTHING = 1e-6  # of the size of a state


@dataclass(frozen=True)
class SaidVisits:
    """How long visits to a well last, in the unit of time.

    Attributes
    ----------
    count
        How many were seen to end on the recordings.
    counted, lowest, highest
        Their mean with its interval of 95 %; NaN where it is not known.
    predicted, error
        The same mean as f and D say, with its standard error.
    method
        ``operator`` of Fokker and Planck, or ``law`` of Eyring and Kramers.
    """

    count: int
    counted: float
    lowest: float
    highest: float
    predicted: float
    error: float
    method: str


@dataclass(frozen=True)
class SaidWell:
    """A stable state as it is told.

    Attributes
    ----------
    name
        A, B, and so on, in the order of the attractors.
    position, position_errors
        Of the attractor, with standard errors, NaN where not known.
    basin
        Share of the recorded states that lead there.
    depth, depth_error
        The lowest barrier of U out of it, NaN where none is known.
    beyond
        The name of the well behind that barrier, None where it leads out of the recorded region.
    known_up_to
        U up to which the formula holds, NaN where there is none.
    time
        How long the well lasts, None where not known.
    leverage
        Relative standard error of ΔU/ε from an estimated D over that of ε.
    visits
        How long visits to it last, None where this was not compared.
    cycle
        Of a limit cycle, its states, shape ``(n, d)``; None of a point.
    period
        Of a limit cycle, NaN of a point.
    multipliers
        Its Floquet multipliers.
    """

    name: str
    position: np.ndarray
    position_errors: np.ndarray
    basin: float
    depth: float
    depth_error: float
    beyond: str | None
    known_up_to: float
    time: MeanTime | None
    leverage: float = 1.0
    visits: SaidVisits | None = None
    cycle: np.ndarray | None = None
    period: float = math.nan
    multipliers: tuple[complex, ...] = ()


@dataclass(frozen=True)
class SaidLandscape:
    """A landscape as it is told, from plain data."""

    data: Mapping[str, Any]

    @property
    def states(self) -> list[str]:
        """Names of the states."""
        return list(self.data["states"])

    @property
    def units(self) -> list[str]:
        """Of each state, ``1`` where nobody said."""
        return list(self.data.get("units") or ["1"] * len(self.states))

    @property
    def time_unit(self) -> str:
        """Of the recordings, ``1`` where nobody said."""
        return str(self.data.get("time_unit") or "1")

    @property
    def energy_unit(self) -> str:
        """Unit of U and of ε.

        D is read as a matrix of ratios, so that U is in the states' unit squared per time. Of states of
        different units D carries the units, and U is a number.
        """
        if len(set(self.units)) > 1:
            return ""
        length, time = squared(self.units[0]), "" if self.time_unit == "1" else self.time_unit
        if not length:
            return f"{time}^-1" if time else ""
        return f"{length}/{time}" if time else length

    @property
    def given(self) -> bool:
        """Whether f was given as equations, and not identified from recordings."""
        return bool(self.data.get("given"))

    @property
    def region(self) -> str:
        """What the landscape is of: where states were recorded, or the domain of the equations."""
        return "domain" if self.given else "recorded region"

    @property
    def noise(self) -> NoiseStrength | None:
        """That drives the system, None where nobody knows it."""
        noise = self.data.get("noise")
        return None if noise is None else NoiseStrength(**noise)

    @cached_property
    def size(self) -> np.ndarray:
        """How large each state becomes, shape ``(d,)``: what is 10⁻⁶ of it, with its error, reads as zero."""
        places = [one["position"] for one in self.data["equilibria"]]
        places += [one["attractor"] for one in self.data["wells"]]
        places += [place for one in self.data["wells"] if "cycle" in one for place in one["cycle"]["points"]]
        for one in self.data["wells"]:
            places += (one.get("V") or {}).get("points", [])
        return np.abs(np.array(places, dtype=float).reshape(-1, len(self.states))).max(axis=0, initial=0.0)

    def settled(self, position: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A position without what rounding left of zero, and its errors."""
        # In units of the largest state where all states have the same, or a state that is zero has no size.
        size = self.size if len(set(self.units)) > 1 else np.full(len(self.states), self.size.max())
        nothing = np.hypot(position, np.nan_to_num(errors)) < NOTHING * size
        return np.where(nothing, 0.0, position), np.where(nothing, 0.0, errors)

    @cached_property
    def wells(self) -> list[SaidWell]:
        """Every stable state."""
        return [self._well(index, one) for index, one in enumerate(self.data["wells"])]

    def exits(self, well: int) -> list[Exit]:
        """What the times out of a well follow from; of a barrier that nobody knows, NaN."""
        return exits_of(self.data, well)

    def dwell_time(self, well: int, noise: NoiseStrength | None) -> MeanTime | None:
        """How long a well lasts under some noise."""
        return dwell_time(self.exits(well), noise)

    def _well(self, index: int, one: Mapping[str, Any]) -> SaidWell:
        ways = [
            way for way in self.data["transitions"] if way["start"] == index and way["barrier"] is not None
        ]
        lowest = min(ways, key=lambda way: way["barrier"], default=None)
        place = np.array(one["attractor"], dtype=float)
        errors = one.get("standard_errors")
        known = np.full(len(place), np.nan) if errors is None else np.array([_float(each) for each in errors])
        place, known = self.settled(place, known)
        formula, cycle = one.get("V"), one.get("cycle")
        return SaidWell(
            well_name(index),
            place,
            known,
            float(one["basin"]),
            math.nan if lowest is None else lowest["barrier"],
            math.nan if lowest is None else _float(lowest.get("error", lowest["standard_error"])),
            None if lowest is None or lowest["end"] is None else well_name(lowest["end"]),
            math.nan if formula is None else 2 * float(formula.get("depth") or formula["level"]),
            self.dwell_time(index, self.noise),
            1.0 if lowest is None else lowest.get("noise_leverage", 1.0),
            self._visits(index),
            None if cycle is None else np.array(cycle["points"]),
            math.nan if cycle is None else float(cycle["period"]),
            () if cycle is None else tuple(complex(*value) for value in cycle["multipliers"]),
        )

    def _visits(self, well: int) -> SaidVisits | None:
        one = next((each for each in self.data.get("visits") or [] if each["well"] == well), None)
        if one is None:
            return None
        return SaidVisits(
            int(one["visits"]), _float(one["counted"]), _float(one["lowest"]), _float(one["highest"]),
            _float(one["predicted"]), _float(one["error"]), str(one["method"]),
        )  # fmt: skip

    def relative_depth(self, well: SaidWell) -> tuple[float, float]:
        """ΔU/ε with its standard error, NaN where no noise is known."""
        if self.noise is None or not math.isfinite(well.depth):
            return math.nan, math.nan
        ratio = well.depth / self.noise.intensity
        of_noise = well.leverage * self.noise.standard_error / self.noise.intensity
        parts = (well.depth_error / well.depth, of_noise)
        return ratio, abs(ratio) * float(np.sqrt(np.nansum(np.square(parts))))


def _float(value: float | None) -> float:
    return math.nan if value is None else float(value)


def well_name(index: int) -> str:
    """A, B, … Z, A1, B1, … by the place of the attractor.

    Examples
    --------
    >>> [well_name(index) for index in (0, 1, 26)]
    ['A', 'B', 'A1']
    """
    letter, round_ = chr(ord("A") + index % 26), index // 26
    return letter + (str(round_) if round_ else "")
