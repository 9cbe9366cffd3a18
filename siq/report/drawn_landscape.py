"""What of a landscape is drawn? Wells by letters, saddles, ways out, recorded states, and U as a function.

Figures and the interactive view start from here, whether the landscape is in memory, in a file, or known as
one formula alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from string import ascii_uppercase

import numpy as np
from scipy.integrate import cumulative_trapezoid

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import find_equilibria
from siq.dynamics.formulas import compile_formulas
from siq.dynamics.parametric import symbol
from siq.landscape.global_quasipotential import least_over_wells
from siq.landscape.landscape import Landscape
from siq.landscape.storage import StoredLandscape
from siq.potential.symbolic import SymbolicDecomposition
from siq.potential.well import Well

Potential = Callable[[np.ndarray], np.ndarray]
"""U at points ``(n, d)``, NaN where it is not known: shape ``(n,)``."""

MARGIN = 0.05  # of what is shown: left free around it
STARTS = 400  # recorded states from which the equilibria of a formula are sought
BOTTOM = 1e-6  # of the largest U among recorded states: an attractor so low is the deepest one


@dataclass(frozen=True)
class DrawnPoint:
    """An equilibrium: its kind, where it lies, and U there, NaN where that is not known.

    Attributes
    ----------
    kind
        ``attractor``, ``saddle``, ``repeller`` or ``degenerate``.
    position
        Shape ``(d,)``.
    height
        U there.
    label
        The letter of a well; empty for others.
    """

    kind: str
    position: np.ndarray
    height: float
    label: str = ""


@dataclass(frozen=True)
class DrawnWay:
    """The way out of a well over a saddle.

    Attributes
    ----------
    start, end
        Places of the wells; the end is None where the way leads out of the recorded region.
    saddle
        Shape ``(d,)``.
    barrier, standard_error
        ΔU and its error, NaN where not known.
    uphill, downhill
        The path of least action and the way down without noise, shape ``(n, d)``; empty where there is none.
    """

    start: int
    end: int | None
    saddle: np.ndarray
    barrier: float
    standard_error: float
    uphill: np.ndarray
    downhill: np.ndarray


@dataclass(frozen=True)
class DrawnLandscape:
    """What is drawn of a landscape.

    Main attributes
    ---------------
    names, units
        Of the states.
    potential
        U as a function of points.
    wells
        The attractors in the order of the tables, as A, B, C and so on.
    others
        The other equilibria.
    ways
        The ways out of the wells.
    box
        Shape ``(d, 2)``: what is shown.

    Other attributes
    ----------------
    energy_unit
        Unit of U; empty where it is that of ε and has no other name.
    points
        Recorded states, shape ``(n, d)``; there may be none.
    formulas
        V about each attractor, None where there is none.
    dynamics
        f and D.
    matched
        Whether U is known over all wells; otherwise each well is drawn from its own bottom.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    potential: Potential
    wells: tuple[DrawnPoint, ...]
    others: tuple[DrawnPoint, ...]
    ways: tuple[DrawnWay, ...]
    box: np.ndarray
    energy_unit: str = ""
    points: np.ndarray | None = None
    formulas: tuple[Well | None, ...] = ()
    dynamics: Dynamics | None = None
    matched: bool = True

    @property
    def saddles(self) -> tuple[DrawnPoint, ...]:
        """The passes between the wells."""
        return tuple(one for one in self.others if one.kind == "saddle")

    @property
    def top(self) -> float | None:
        """U at the highest pass out of a well, None where none is known."""
        tops = [self.wells[way.start].height + way.barrier for way in self.ways]
        tops += [one.height for one in self.saddles] if not tops else []
        known = [top for top in tops if np.isfinite(top)]
        return max(known) if known else None

    @property
    def lowest_pass(self) -> np.ndarray:
        """Where the lowest pass lies; the deepest well where there is none."""
        known = [way for way in self.ways if np.isfinite(self.wells[way.start].height + way.barrier)]
        if known:
            return min(known, key=lambda way: self.wells[way.start].height + way.barrier).saddle
        places = self.saddles or self.wells or self.others
        heights = [np.inf if np.isnan(one.height) else one.height for one in places]
        return places[int(np.argmin(heights))].position

    def standard_error(self, x: np.ndarray) -> np.ndarray | None:
        """Standard error of U of one state at ``(n,)``, against the deepest well; None where not known."""
        if self.dynamics is None or len(self.names) > 1 or not self.wells or not self.matched:
            return None
        deepest = min(self.wells, key=lambda one: np.nan_to_num(one.height, nan=np.inf))
        return _error_of_one_state(self.dynamics, x, float(deepest.position[0]))


def well_letter(place: int) -> str:
    """The letter by which text, tables and figures call a well: A, B, C, and after Z A1, B1."""
    turn, letter = divmod(place, len(ascii_uppercase))
    return ascii_uppercase[letter] + (str(turn) if turn else "")


def unit_of_u(units: Sequence[str], time_unit: str, dynamics: Dynamics) -> str:
    """The unit of U: unit²/time where all states have one unit and D is the unit matrix; otherwise that of ε.

    ``U/ε`` is a number, and ``εD`` is a squared state per time. A given D may carry its own unit, which
    nobody says.
    """
    unit = units[0] if units else ""
    if unit in ("", "1") or set(units) != {unit} or time_unit in ("", "1"):
        return ""
    if not np.array_equal(dynamics.diffusion.matrix, np.eye(dynamics.dimension)):
        return ""
    return f"{unit}²/{time_unit}"


def drawn(
    landscape: Landscape, *, points: np.ndarray | None = None, time_unit: str | None = None
) -> DrawnLandscape:
    """What is drawn of a landscape in memory.

    Parameters
    ----------
    landscape
        The landscape.
    points
        Recorded states, shape ``(n, d)``; by default those to which its formulas were fitted.
    time_unit
        In which time was recorded; by default that of its dynamics.
    """
    kinds = [(one.kind, one.position) for one in landscape.equilibria]
    dynamics = landscape.dynamics
    places = [one.position for one in landscape.attractors]
    none = np.zeros((0, dynamics.dimension))
    ways = [
        DrawnWay(
            way.start, way.end, way.saddle.position, way.barrier, way.standard_error,
            none if way.path is None else way.path.uphill.points,
            none if way.path is None else way.path.downhill,
        )
        for way in landscape.transitions
    ]  # fmt: skip
    if points is None:
        fitted = [well.points for well in landscape.wells if well is not None]
        points = np.concatenate([none, *fitted])
    unit = unit_of_u(dynamics.units, time_unit or dynamics.time_unit, dynamics)
    labels = (dynamics.units, unit)
    return _assembled(dynamics, labels, landscape.wells, landscape.heights, (places, kinds, ways), points)


def drawn_stored(
    stored: StoredLandscape,
    *,
    dynamics: Dynamics,
    units: Sequence[str],
    time_unit: str = "1",
    points: np.ndarray | None = None,
) -> DrawnLandscape:
    """What is drawn of a landscape from a file; for the parameters see `drawn`."""
    data = stored.data
    none = np.zeros((0, dynamics.dimension))
    ways = [
        DrawnWay(
            way["start"], way["end"], np.array(way["saddle"]), _number(way["barrier"]),
            _number(way["standard_error"]), np.array(way["uphill"]) if way["uphill"] else none,
            np.array(way["downhill"]) if way["downhill"] else none,
        )
        for way in data["transitions"]
    ]  # fmt: skip
    places = [np.array(well["attractor"]) for well in data["wells"]]
    kinds = [(one["kind"], np.array(one["position"])) for one in data["equilibria"]]
    return _assembled(
        dynamics, (tuple(units), unit_of_u(units, time_unit, dynamics)), stored.wells,
        np.array([_number(well["height"]) for well in data["wells"]]), (places, kinds, ways), points,
    )  # fmt: skip


def drawn_formula(
    formula: SymbolicDecomposition,
    *,
    points: np.ndarray,
    units: Sequence[str],
    time_unit: str = "1",
    dynamics: Dynamics | None = None,
) -> DrawnLandscape:
    """What is drawn of a single formula of V: U where states were recorded, and the equilibria of f.

    Parameters
    ----------
    formula
        With V, or with V about each attractor.
    points
        Recorded states, shape ``(n, d)``. Away from their box nothing is drawn.
    units, time_unit
        As recorded.
    dynamics
        f and D; by default f of the formula, with D = 1.
    """
    dynamics = dynamics or Dynamics.of(formula.symbols, formula.vector_field)
    unit = unit_of_u(units, time_unit, dynamics)
    low, high = points.min(axis=0), points.max(axis=0)
    few = points[:: max(len(points) // STARTS, 1)]
    if formula.potential is None:
        places = [well.attractor for well in formula.wells]
        heights = np.zeros(len(places)) if len(places) == 1 else np.full(len(places), np.nan)
        kinds = [(one.kind, one.position) for one in find_equilibria(dynamics, few)]
        return _assembled(dynamics, (tuple(units), unit), formula.wells, heights, (places, kinds, []), points)

    def everywhere(x: np.ndarray) -> np.ndarray:
        inside = ((x >= low) & (x <= high)).all(axis=1)
        return np.where(inside, 2 * formula.evaluate(np.ascontiguousarray(x.T))[0], np.nan)

    def at(position: np.ndarray) -> float:
        return float(2 * formula.evaluate(position[:, None])[0, 0])

    found = find_equilibria(dynamics, few)
    attractors = [one for one in found if one.kind == "attractor"]
    margin = MARGIN * np.where(high > low, high - low, 1.0)
    wells = tuple(
        DrawnPoint(one.kind, one.position, at(one.position), well_letter(place))
        for place, one in enumerate(attractors)
    )
    others = (one for one in found if one.kind != "attractor")
    return DrawnLandscape(
        dynamics.states, tuple(units), everywhere, wells,
        tuple(DrawnPoint(one.kind, one.position, at(one.position)) for one in others), (),
        np.stack([low - margin, high + margin], axis=1), unit, points, (), dynamics,
    )  # fmt: skip


def _assembled(
    dynamics: Dynamics,
    labels: tuple[tuple[str, ...], str],
    formulas: Sequence[Well | None],
    heights: np.ndarray,
    found: tuple[Sequence[np.ndarray], Sequence[tuple[str, np.ndarray]], Sequence[DrawnWay]],
    points: np.ndarray | None,
) -> DrawnLandscape:
    """A landscape of wells, each with its formula, at their heights where these are known.

    The labels are the units of the states and of U; what was found are attractors, equilibria, ways out.
    """
    (units, energy_unit), (places, kinds, ways) = labels, found
    matched = bool(len(heights)) and bool(np.isfinite(heights).all())
    lifts = heights if matched else np.zeros(len(places))
    known = [(lift, well) for lift, well in zip(lifts, formulas, strict=True) if well is not None]

    def potential(x: np.ndarray) -> np.ndarray:
        if not known:
            return np.full(len(x), np.nan)
        return least_over_wells(np.stack([lift + 2 * well.known_values(x) for lift, well in known]))

    tops: dict[tuple[float, ...], float] = {}
    for way in ways:
        key, top = tuple(way.saddle), lifts[way.start] + way.barrier
        tops[key] = top if np.isnan(tops.get(key, np.nan)) else min(top, tops[key])
    stable = {tuple(place) for place in places}
    wells = tuple(
        DrawnPoint("attractor", place, float(lift), well_letter(index))
        for index, (place, lift) in enumerate(zip(places, lifts, strict=True))
    )
    others = tuple(
        DrawnPoint(kind, place, tops.get(tuple(place), np.nan))
        for kind, place in kinds
        if tuple(place) not in stable
    )
    seen = [np.asarray(well.points).reshape(-1, dynamics.dimension) for _, well in known]
    seen += [np.array(places).reshape(-1, dynamics.dimension)]
    seen += [way.saddle[None] for way in ways]
    if not any(map(len, seen)) and points is not None:
        seen.append(points)
    seen += [one.position[None] for one in others] if not any(map(len, seen)) else []
    box = _limits(np.concatenate(seen))
    return DrawnLandscape(
        dynamics.states, units, potential, wells, others, tuple(ways), box, energy_unit, points,
        tuple(formulas), dynamics, matched,
    )  # fmt: skip


def _limits(points: np.ndarray) -> np.ndarray:
    if not len(points):
        raise ValueError("the landscape has neither wells nor equilibria: there is nothing to draw")
    low, high = points.min(axis=0), points.max(axis=0)
    margin = MARGIN * np.where(high > low, high - low, 1.0)
    return np.stack([low - margin, high + margin], axis=1)


def _number(value: float | None) -> float:
    return np.nan if value is None else float(value)


def _error_of_one_state(dynamics: Dynamics, x: np.ndarray, start: float) -> np.ndarray | None:
    """Standard error of ``U(x) - U(start) = -2 ∫ f/D dx``, to first order in the parameters of f."""
    covariance, noise = dynamics.covariance, dynamics.diffusion
    if covariance is None or len(covariance) != len(dynamics.parameters) or not noise.regular:
        return None
    values = {symbol(each.name): each.value for each in dynamics.parameters}
    slopes = [dynamics.equations[0].diff(symbol(each.name)).xreplace(values) for each in dynamics.parameters]
    if not slopes or not np.isfinite(covariance).all() or not covariance.any():
        return None
    rates = compile_formulas(slopes, dynamics.symbols)(x[None]) / noise.matrix[0, 0]
    change = -2 * cumulative_trapezoid(rates, x, axis=1, initial=0.0)
    change -= np.array([np.interp(start, x, row) for row in change])[:, None]
    return np.sqrt(np.maximum(np.einsum("pn,pq,qn->n", change, covariance, change), 0.0))
