"""Comparison of landscapes: with references, and with that of given equations.

Characteristics of the Hamilton–Jacobi equation (any dimension), an ordered line integral method on a mesh
(two states), and minimum action paths. None has an ansatz for V; none sees recordings, networks or formulas.

Where the equations of a simulated system are known, their own landscape (`siq.workflow.equations_step`) tells
every barrier, prefactor and mean time without any trajectory. It scores the landscape that was learned, and
is no input of it. Both are taken as plain data (`siq.quasipotential.landscape_files`).

An attractor of the trajectories is that attractor of the equations to which it is nearest among all their
equilibria, in shares of the domain; of several, the nearest one. Ways out have the same two ends, and the
nearest saddle where there are several.

U is in the unit of D, so that only landscapes of one D can be compared: of the D of both no more may differ
than the errors of one that was estimated leave open.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from siq.errors import InputError, NumericalFailure
from siq.inference.field_estimate import STANDARD_ERRORS, IdentifiedField
from siq.numerics.files import whole_file
from siq.numerics.text import place_text
from siq.quasipotential.characteristics import adapted_fan, lowest_sheet, value_near
from siq.quasipotential.landscape import heights_of_attractors, least_over_wells
from siq.quasipotential.landscape_files import exits_of
from siq.quasipotential.paths import minimum_action_path
from siq.quasipotential.rates import NoiseStrength, dwell_time
from siq.quasipotential.wells import Well
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.phase_portrait import PhasePortrait

GRID = 161  # points along each of two states
SCATTERED = 4000  # points of a fan where there are more states
CURVES = 400
GAP = 0.04  # between the ends of neighbouring curves, in units in which the level is at about 1
NEAR = 0.06  # of a point of a curve, in the same units: V is told from its nearest
WIDER = 0.25  # of the box, by which curves may leave it

Potential = Callable[[np.ndarray], np.ndarray]
"""U at points ``(n, d)``, NaN where it is not known; up to a constant."""


@dataclass(frozen=True)
class ReferenceLandscape:
    """U at points, and barriers, by independent methods.

    Attributes
    ----------
    attractors
        Shape ``(k, d)``.
    points
        Shape ``(n, d)``.
    characteristics, mesh
        U about each attractor, zero there, shape ``(k, n)``; NaN where the method does not tell. The mesh is
        NaN throughout where there are not two states, or somewhere in the box f is not finite or D not
        positive definite.
    barriers
        Lowest barrier of U out of each well, by minimum action, shape ``(k,)``; infinite without a saddle.
    mesh_barriers
        The same on the mesh.
    heights
        U at the attractors, shape ``(k,)``.
    reason
        Why there is no reference, in words; then k and n are zero. Empty where there is one.
    """

    attractors: np.ndarray
    points: np.ndarray
    characteristics: np.ndarray
    mesh: np.ndarray
    barriers: np.ndarray
    mesh_barriers: np.ndarray
    heights: np.ndarray
    reason: str = ""

    def below(self, index: int, share: float) -> np.ndarray:
        """Mask of the points of one well below a share of its barrier."""
        return np.nan_to_num(self.characteristics[index], nan=np.inf) < share * self.barriers[index]

    @property
    def values(self) -> np.ndarray:
        """The global U by characteristics, shape ``(n,)``, NaN where no curve tells."""
        return least_over_wells(self.characteristics + self.heights[:, None])

    @property
    def mesh_values(self) -> np.ndarray:
        """The global U on the mesh, shape ``(n,)``."""
        return least_over_wells(self.mesh + self.heights[:, None])


def reference_landscape(
    dynamics: Dynamics,
    portrait: PhasePortrait,
    *,
    box: np.ndarray,
    reach: float,
    generator: np.random.Generator,
    mesh: Callable[[np.ndarray, float], Potential | None] | None = None,
) -> ReferenceLandscape:
    """Compute the references.

    Parameters
    ----------
    dynamics
        The exact f.
    portrait
        Its attractors and saddles.
    box
        Shape ``(d, 2)``: the region of interest.
    reach
        Level up to which curves are followed, as a share of each well's lowest barrier.
    generator
        Draws first directions and points in more than two dimensions.
    mesh
        Of two states, V (not U) about an attractor up to a level by a method that shares no code with the
        others (`siq.validation.mesh.mesh_potential`).

    Raises
    ------
    NumericalFailure
        When there is no attractor, or an attractor has no saddle to compare a barrier at.
    """
    attractors = np.array([one.position for one in portrait.attractors])
    if not len(attractors):
        raise NumericalFailure("f has no attractor, so that there is no landscape to compare with")
    actions = _actions(dynamics, portrait)
    barriers = actions.min(axis=1)
    lowest = np.where(np.isfinite(barriers), barriers, np.nan)
    if np.isnan(lowest).all():
        raise NumericalFailure("no saddle parts the attractors, so that no level tells where to compare")
    levels = reach * np.where(np.isnan(lowest), np.nanmax(lowest), lowest)
    wide = box + WIDER * np.ptp(box, axis=1)[:, None] * np.array([-1.0, 1.0])
    fans = [
        adapted_fan(
            dynamics, one, level=level / 2, box=wide, generator=generator,
            most=CURVES, gap=GAP,
        )
        for one, level in zip(attractors, levels, strict=True)
    ]  # fmt: skip
    sheets = [lowest_sheet(fan) for fan in fans]
    if dynamics.dimension <= 2:
        axes = [np.linspace(low, high, GRID) for low, high in box]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dynamics.dimension)
    else:
        known = np.concatenate([fan.points[sheet] for fan, sheet in zip(fans, sheets, strict=True)])
        points = known[generator.permutation(len(known))[:SCATTERED]]
    values = np.stack(
        [
            2 * value_near(fan, points, sheet=sheet, distance=NEAR)
            for fan, sheet in zip(fans, sheets, strict=True)
        ]
    )
    on_mesh, mesh_barriers = np.full(values.shape, np.nan), np.full(len(attractors), np.nan)
    for index, one in enumerate(attractors if dynamics.dimension == 2 and mesh is not None else ()):
        potential = mesh(one, levels[index] / 2) if mesh is not None else None
        if potential is None:
            continue
        on_mesh[index] = 2 * potential(points)
        tops = np.array([saddle.position for saddle in portrait.saddles[index]]).reshape(-1, 2)
        if len(tops):
            mesh_barriers[index] = np.nanmin(2 * potential(tops), initial=np.inf)
    return ReferenceLandscape(
        attractors, points, values, on_mesh, barriers, mesh_barriers, _heights(actions, len(attractors))
    )


def no_reference(dimension: int, reason: str) -> ReferenceLandscape:
    """What stands in the place of a reference where there is none, with the reason."""
    of_none, nothing = np.zeros((0, dimension)), np.zeros(0)
    return ReferenceLandscape(
        of_none, of_none, np.zeros((0, 0)), np.zeros((0, 0)), nothing, nothing, nothing, reason
    )


def _actions(dynamics: Dynamics, portrait: PhasePortrait) -> np.ndarray:
    """Least action from each attractor to each saddle next to it, shape ``(k, s)``, infinite elsewhere."""
    saddles = list({tuple(one.position): one for row in portrait.saddles for one in row}.values())
    actions = np.full((len(portrait.attractors), max(len(saddles), 1)), np.inf)
    for index, one in enumerate(portrait.attractors):
        beside = {tuple(saddle.position) for saddle in portrait.saddles[index]}
        for column, saddle in enumerate(saddles):
            if tuple(saddle.position) in beside:
                path = minimum_action_path(dynamics, one.position, saddle.position)
                actions[index, column] = path.action
    return actions


def _heights(actions: np.ndarray, count: int) -> np.ndarray:
    between = np.full((count, count), np.inf)
    for i in range(count):
        for j in range(count):
            shared = np.isfinite(actions[i]) & np.isfinite(actions[j])
            if i != j and shared.any():
                between[i, j] = actions[i][shared].min()
    try:
        return heights_of_attractors(between)
    except NumericalFailure:
        return np.full(count, np.nan)


def write_reference(path: str | Path, reference: ReferenceLandscape) -> None:
    """Write references as a NumPy archive of plain arrays, whole or not at all."""
    arrays = {field.name: getattr(reference, field.name) for field in fields(reference)}
    with whole_file(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def read_reference(path: str | Path) -> ReferenceLandscape:
    """Read what `write_reference` wrote, or refuse the file with an `InputError`."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
            return ReferenceLandscape(**arrays | {"reason": str(arrays["reason"])})
    except (OSError, ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile):
        raise InputError(path, "", "it is no reference landscape", "make it again") from None


WELL_SHARE = 0.9  # of its barrier: below it a well is compared
OVERALL = 1.1  # of the highest saddle of U


@dataclass(frozen=True)
class ErrorInRegion:
    """One estimate of U against the reference in one region.

    Attributes
    ----------
    region
        In words.
    points
        Number of points of the region.
    covered
        Share of them at which the estimate says something.
    error
        Relative L2 error of U there.
    error_everywhere
        The same of the formula at every point, whether it is to be believed or not; NaN for other estimates.
    """

    region: str
    points: int
    covered: float
    error: float
    error_everywhere: float = float("nan")


def well_region(index: int) -> str:
    """What the region of a well is called in tables."""
    return f"A{index + 1}, below {WELL_SHARE:g} of its barrier"


def compare_wells(reference: ReferenceLandscape, wells: Mapping[int, Well]) -> list[ErrorInRegion]:
    """Formulas of wells against characteristics, each below a share of its barrier.

    Parameters
    ----------
    reference
        The references.
    wells
        Formulas by the index of the reference's attractor; a well without one counts as not covered.
    """
    rows = []
    for index in range(len(reference.attractors)):
        inside = reference.below(index, WELL_SHARE)
        exact = reference.characteristics[index][inside]
        if index not in wells:
            rows.append(ErrorInRegion(well_region(index), len(exact), 0.0, float("nan")))
            continue
        x = reference.points[inside]
        row = _compared(well_region(index), 2 * wells[index].known_values(x), exact)
        everywhere = relative_l2(2 * wells[index].values(x), exact)
        rows.append(ErrorInRegion(row.region, row.points, row.covered, row.error, everywhere))
    return rows


def compare_estimate(
    reference: ReferenceLandscape, potential: Potential, *, below: float | None
) -> list[ErrorInRegion]:
    """One estimate of U: in each well from its attractor upwards, and over all wells below a level.

    A constant means nothing to U. In a well the estimate is zero at the attractor; over all wells it is
    shifted by the median of its difference, so that no single point decides.
    """
    rows = []
    values = potential(reference.points)
    for index, attractor in enumerate(reference.attractors):
        inside = reference.below(index, WELL_SHARE)
        at = float(potential(attractor[None])[0])
        exact = reference.characteristics[index][inside]
        rows.append(_compared(well_region(index), values[inside] - at, exact))
    rows.append(compare_overall(reference, values, below=below, shifted=True))
    return rows


def compare_overall(
    reference: ReferenceLandscape, values: np.ndarray, *, below: float | None, shifted: bool = False
) -> ErrorInRegion:
    """Values of U at the reference's points, over all wells below a level."""
    exact = reference.values
    level = overall_level(reference) if below is None else below
    inside = np.nan_to_num(exact, nan=np.inf) < level
    own = values[inside]
    if shifted:
        own = own - np.nanmedian(own - exact[inside])
    return _compared(f"U < {level:.4g}", own, exact[inside])


def overall_level(reference: ReferenceLandscape) -> float:
    """The level below which landscapes are compared by default: somewhat above the highest saddle."""
    tops = reference.heights + reference.barriers
    return float(OVERALL * tops[np.isfinite(tops)].max(initial=0.0))


def relative_l2(values: np.ndarray, exact: np.ndarray) -> float:
    """``‖u - u*‖ / ‖u*‖``, NaN for no points."""
    size = float(np.linalg.norm(exact))
    return float(np.linalg.norm(values - exact)) / size if size > 0 else float("nan")


def _compared(region: str, values: np.ndarray, exact: np.ndarray) -> ErrorInRegion:
    known = np.isfinite(values)
    covered = float(known.mean()) if len(values) else 0.0
    return ErrorInRegion(region, len(exact), covered, relative_l2(values[known], exact[known]))


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
        The landscapes, as `siq.quasipotential.landscape_files.landscape_data` has them.
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
