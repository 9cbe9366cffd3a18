"""Comparison of landscapes: with independent references, and with that of given equations.

References are characteristics of the Hamilton–Jacobi equation (any dimension), an ordered line integral
method on a mesh (two states), and minimum action paths. None has an ansatz for V; none sees recordings,
networks or formulas.

Where the equations of a simulated system are known, their own landscape tells every barrier, prefactor and
mean time without any trajectory. It scores the landscape that was learned, and is no input of it. An
attractor of the trajectories is that attractor of the equations to which it is nearest among all their
equilibria, in shares of the domain; of several, the nearest one. Ways out have the same two ends, and the
nearest saddle where there are several. U is in the unit of D, so that only landscapes of one D can be
compared: of the D of both no more may differ than the errors of one that was estimated leave open.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pandas as pd

from siq.errors import InputError, NumericalFailure
from siq.inference.field_estimate import STANDARD_ERRORS, FieldEstimate
from siq.numerics.files import whole_file
from siq.numerics.text import place_text
from siq.quasipotential.characteristics import adapted_fan
from siq.quasipotential.global_formula import heights_of_attractors
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.paths import minimum_action_path
from siq.quasipotential.rates import NoiseStrength, mean_residence_time
from siq.remarks import Remark, sentence
from siq.systems.cycles import Cycle
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.phase_portrait import PhasePortrait

GRID_POINTS = 161  # along each of two states
SCATTERED_POINTS = 4000  # of a fan where there are more states
MOST_CURVES = 400
CURVE_GAP = 0.04  # between the ends of neighbouring curves, in units in which the level is at about 1
CURVE_DISTANCE = 0.06  # of a point of a curve, in the same units: V is told from its nearest
BOX_MARGIN = 0.25  # of the box, by which curves may leave it

WELL_SHARE = 0.9  # of its barrier: below it a well is compared
OVERALL_LEVEL = 1.1  # of the highest saddle of U
ATTRACTOR_MATCH_TOLERANCE = 0.02  # of the region: attractors so close to the reference's are the same

DIFFUSION_ROUNDING = 1e-9  # numerical, of D: two formulas of the same matrix
NOT_SHOWN = Remark("quasipotential.not_shown_by_trajectories")

Potential = Callable[[np.ndarray], np.ndarray]
"""U at points ``(n, d)``, NaN where it is not known; up to a constant."""


@dataclass(frozen=True)
class ReferenceLandscape:
    """U at points, and barriers, by independent methods.

    U about each attractor is NaN where the method does not tell. The mesh is NaN throughout where there are
    not two states, or somewhere in the box f is not finite or D not positive definite.
    """

    attractors: np.ndarray  #: shape (k, d)
    points: np.ndarray  #: shape (n, d)
    characteristics: np.ndarray  #: U about each attractor, zero there, shape (k, n)
    mesh: np.ndarray  #: the same on a mesh
    barriers: np.ndarray  #: lowest of U out of each well, by minimum action, (k,); infinite without a saddle
    mesh_barriers: np.ndarray  #: the same on the mesh
    heights: np.ndarray  #: U at the attractors, shape (k,)
    reason: str = ""  #: why there is no reference, in words; then k and n are zero

    def below(self, index: int, share: float) -> np.ndarray:
        """Mask of the points of one well below a share of its barrier."""
        return np.nan_to_num(self.characteristics[index], nan=np.inf) < share * self.barriers[index]

    @property
    def values(self) -> np.ndarray:
        """The global U by characteristics, shape ``(n,)``, NaN where no curve tells."""
        return np.fmin.reduce(self.characteristics + self.heights[:, None])

    @property
    def mesh_values(self) -> np.ndarray:
        """The global U on the mesh, shape ``(n,)``."""
        return np.fmin.reduce(self.mesh + self.heights[:, None])

    @property
    def level(self) -> float:
        """The level below which landscapes are compared by default: somewhat above the highest saddle."""
        tops = self.heights + self.barriers
        return float(OVERALL_LEVEL * tops[np.isfinite(tops)].max(initial=0.0))

    def compare_mesh(self, *, below: float | None) -> list[dict[str, object]]:
        """Its own mesh against its characteristics, and its barriers against the least action."""
        errors = np.abs(self.mesh_barriers / self.barriers - 1)
        overall = compare_overall(self.values, self.mesh_values, below or self.level)
        barriers = [
            _row(f"barrier from A{index + 1}", 1, 1.0, float(one)) for index, one in enumerate(errors)
        ]
        return [overall, *barriers]

    @classmethod
    def missing(cls, dimension: int, reason: str) -> ReferenceLandscape:
        """An empty reference, with the reason why there is none."""
        of_none, nothing, none = np.zeros((0, dimension)), np.zeros(0), np.zeros((0, 0))
        return cls(of_none, of_none, none, none, nothing, nothing, nothing, reason)

    def write(self, path: str | Path) -> None:
        """Write the references as a NumPy archive of plain arrays, whole or not at all."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        with whole_file(path) as partial, partial.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    @classmethod
    def read(cls, path: str | Path) -> ReferenceLandscape:
        """Read what `write` wrote, or refuse the file with an `InputError`."""
        try:
            with np.load(path, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
                return cls(**arrays | {"reason": str(arrays["reason"])})
        except (OSError, ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile):
            raise InputError(path, "", "it is no reference landscape", "make it again") from None


def reference_landscape(
    dynamics: Dynamics, portrait: PhasePortrait, *, box: np.ndarray, reach: float,
    generator: np.random.Generator, mesh: Callable[[np.ndarray, float], Potential | None] | None = None,
) -> ReferenceLandscape:  # fmt: skip
    """Compute the references.

    Parameters
    ----------
    dynamics, portrait, box
        The exact f, its attractors and saddles, and the region of interest, shape ``(d, 2)``.
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
    # Least action from each attractor to each saddle next to it, (k, s), infinite elsewhere.
    saddles = list(dict.fromkeys(tuple(one.position) for row in portrait.saddles for one in row))
    count = len(attractors)
    actions = np.full((count, max(len(saddles), 1)), np.inf)
    for index, attractor in enumerate(attractors):
        for top in portrait.saddles[index]:
            path = minimum_action_path(dynamics, attractor, top.position)
            actions[index, saddles.index(tuple(top.position))] = path.action
    barriers = actions.min(axis=1)
    lowest = np.where(np.isfinite(barriers), barriers, np.nan)
    if np.isnan(lowest).all():
        raise NumericalFailure("no saddle parts the attractors, so that no level tells where to compare")
    levels = reach * np.where(np.isnan(lowest), np.nanmax(lowest), lowest)
    wide = box + BOX_MARGIN * np.ptp(box, axis=1)[:, None] * np.array([-1.0, 1.0])
    fans = [
        adapted_fan(
            dynamics, one, level=level / 2, box=wide, generator=generator, most=MOST_CURVES, gap=CURVE_GAP,
        )
        for one, level in zip(attractors, levels, strict=True)
    ]  # fmt: skip
    sheets = [fan.lowest_sheet() for fan in fans]
    if dynamics.dimension <= 2:
        axes = [np.linspace(low, high, GRID_POINTS) for low, high in box]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dynamics.dimension)
    else:
        known = np.concatenate([fan.points[sheet] for fan, sheet in zip(fans, sheets, strict=True)])
        points = known[generator.permutation(len(known))[:SCATTERED_POINTS]]
    pairs = zip(fans, sheets, strict=True)
    values = np.stack(
        [2 * fan.value_near(points, sheet=sheet, distance=CURVE_DISTANCE) for fan, sheet in pairs]
    )
    on_mesh, mesh_barriers = np.full(values.shape, np.nan), np.full(count, np.nan)
    for index, one in enumerate(attractors if dynamics.dimension == 2 else ()):
        potential = None if mesh is None else mesh(one, levels[index] / 2)
        if potential is None:
            continue
        on_mesh[index] = 2 * potential(points)
        tops = np.array([saddle.position for saddle in portrait.saddles[index]]).reshape(-1, 2)
        if len(tops):
            mesh_barriers[index] = np.nanmin(2 * potential(tops), initial=np.inf)
    # From i to j over the lowest saddle that is next to both.
    between = np.where(np.isfinite(actions), actions[:, None], np.inf).min(axis=2)
    np.fill_diagonal(between, np.inf)
    try:
        heights = heights_of_attractors(between)
    except NumericalFailure:
        heights = np.full(count, np.nan)
    return ReferenceLandscape(attractors, points, values, on_mesh, barriers, mesh_barriers, heights)


def compare_estimate(
    reference: ReferenceLandscape, potential: Potential, *, below: float | None
) -> list[dict[str, object]]:
    """One estimate of U: in each well from its attractor upwards, and over all wells below a level.

    A constant means nothing to U. In a well the estimate is zero at the attractor; over all wells it is
    shifted by the median of its difference, so that no single point decides.

    The rows have the columns ``region points covered error error_everywhere``: the region in words and its
    number of points; the share of them at which the estimate says something, and its relative L2 error there;
    and that of the formula at every point, whether it is to be believed or not, NaN of others.
    """
    rows, values = [], potential(reference.points)
    for index, attractor in enumerate(reference.attractors):
        inside = reference.below(index, WELL_SHARE)
        at = float(potential(attractor[None])[0])
        exact = reference.characteristics[index][inside]
        rows.append(_compared(_well_region(index), values[inside] - at, exact))
    rows.append(compare_overall(reference.values, values, below or reference.level, shifted=True))
    return rows


def compare_landscape(
    reference: ReferenceLandscape, landscape: Landscape, *, below: float | None
) -> list[dict[str, object]]:
    """Local formulas, their minimum over all wells below a level, and barriers; rows as `compare_estimate`.

    A well without a formula counts as not covered.
    """
    width, pairs = np.ptp(reference.points, axis=0), dict[int, int]()
    for place, one in enumerate(landscape.attractors):
        distance = np.abs((reference.attractors - one.position) / width).max(axis=1)
        if distance.min() < ATTRACTOR_MATCH_TOLERANCE:
            pairs[int(np.argmin(distance))] = place
    rows = []
    for index in range(len(reference.attractors)):
        inside = reference.below(index, WELL_SHARE)
        exact = reference.characteristics[index][inside]
        values, everywhere = np.full(len(exact), np.nan), np.nan
        if index in pairs and (well := landscape.wells[pairs[index]]) is not None:
            x = reference.points[inside]
            values = 2 * well.known_values(x)
            everywhere = _relative_l2(2 * well.values(x), exact)
        rows.append(_compared(_well_region(index), values, exact, everywhere))
    if (whole := landscape.global_quasipotential) is not None:
        rows.append(compare_overall(reference.values, whole(reference.points), below or reference.level))
    for index, place in pairs.items():
        barriers = [way.barrier for way in landscape.transitions if way.start == place]
        lowest = min((one for one in barriers if np.isfinite(one) and one), default=np.nan)
        error = float(abs(lowest / reference.barriers[index] - 1))
        rows.append(_row(f"barrier from A{index + 1}", 1, float(np.isfinite(error)), error))
    return rows


def compare_overall(
    exact: np.ndarray, values: np.ndarray, level: float, *, shifted: bool = False
) -> dict[str, object]:
    """Values of U over all wells below a level; `shifted` where they are known up to a constant."""
    inside = np.nan_to_num(exact, nan=np.inf) < level
    own = values[inside]
    if shifted:
        own = own - np.nanmedian(own - exact[inside])
    return _compared(f"U < {level:.4g}", own, exact[inside])


def _relative_l2(values: np.ndarray, exact: np.ndarray) -> float:
    """``‖u - u*‖ / ‖u*‖``, NaN for no points."""
    size = float(np.linalg.norm(exact))
    return float(np.linalg.norm(values - exact)) / size if size > 0 else float("nan")


def _well_region(index: int) -> str:
    return f"A{index + 1}, below {WELL_SHARE:g} of its barrier"


def _compared(
    region: str, values: np.ndarray, exact: np.ndarray, everywhere: float = np.nan
) -> dict[str, object]:
    known = np.isfinite(values)
    covered, error = float(known.mean()) if len(values) else 0.0, _relative_l2(values[known], exact[known])
    return _row(region, len(exact), covered, error, everywhere)


def _row(
    region: str, points: int, covered: float, error: float, everywhere: float = np.nan
) -> dict[str, object]:
    row = {"region": region, "points": points, "covered": covered}
    return row | {"error": error, "error_everywhere": everywhere}


COLUMNS = (
    "item", "quantity", "noise", "equations", "trajectories", "standard_error", "relative_difference",
    "in_errors", "note",
)  # fmt: skip
"""Of the table that compares a landscape with that of its equations."""


def compare_with(equations: Landscape, learned: Landscape, *, noise: float | None = None) -> pd.DataFrame:
    """The table of `siq.Landscape.compare_with`."""
    rows = differences(equations, learned, noises=() if noise is None else (noise,))
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    places = np.array([one.position for one in (*equations.attractors, *equations.equilibria)])
    _check_same_noise(equations.dynamics, learned.dynamics, places, found=learned.field_estimate)
    return table.fillna({"note": ""})


def differences(
    equations: Landscape, trajectories: Landscape, *, noises: Sequence[float] = ()
) -> list[dict[str, object]]:
    """Every barrier, prefactor and mean time of two landscapes beside each other, as rows of a table.

    ``item`` is ``A1`` for the first attractor of the equations, ``A1 to A2`` for a way out of it, and
    ``quantity`` is ``barrier``, ``prefactor`` or ``mean time``; of a row that is missed it is empty, and
    ``note`` says what is missing. Numbers that are not known are NaN.

    The equations have a domain; `noises` are the ε for which mean times are compared. Landscapes of other
    states are refused with a `ValueError`.
    """
    if equations.dynamics.states != trajectories.dynamics.states:
        raise ValueError("the landscapes are of different states")
    pairs = _matched_attractors(equations, trajectories)
    back = {place: index for index, place in pairs.items()}

    def named(start: int | None, end: int | None) -> str:
        first = "a further state" if start is None else f"A{start + 1}"
        last = "outside" if end is None else "a further state" if end < 0 else f"A{end + 1}"
        return f"{first} to {last}"

    # Barrier and prefactor of every way out, first those of the equations, then what these have not.
    left, rows = list(trajectories.transitions), []
    for way in equations.transitions:
        item = named(way.start, way.end)
        ends = (pairs.get(way.start), None if way.end is None else pairs.get(way.end, -1))
        same = [one for one in left if (one.start, one.end) == ends]
        if not same:
            rows.append(_difference(item, "barrier", way.barrier, note=sentence(NOT_SHOWN)))
            continue
        nearest = min(same, key=lambda one: float(np.linalg.norm(one.place - way.place)))
        left = [one for one in left if one is not nearest]
        rows.append(_difference(item, "barrier", way.barrier, nearest.barrier, nearest.error))
        law, learned, error = way.exit.prefactor, nearest.exit.prefactor, nearest.exit.prefactor_error
        error = np.nan if error is None else learned * error  # it is that of ln K
        note = "; ".join(way.notes) if np.isnan(law) else ""
        rows.append(_difference(item, "prefactor", law, learned, error, note=note))
    for way in left:
        item = named(back.get(way.start), None if way.end is None else back.get(way.end, -1))
        further = Remark("quasipotential.not_of_the_equations")
        rows.append(_difference(item, "barrier", np.nan, way.barrier, note=sentence(further)))
    for index, one in enumerate(equations.attractors):
        for noise in noises:
            exact, found = (
                None if place is None else mean_residence_time(of.exits(place), NoiseStrength(noise))
                for of, place in ((equations, index), (trajectories, pairs.get(index)))
            )
            numbers = [np.nan if exact is None else exact.value]
            # The law is the same for both, so that its error is not counted.
            numbers += [] if found is None else [found.value, found.value * found.data_error]
            rows.append(_difference(f"A{index + 1}", "mean time", *numbers, noise=noise))
        if isinstance(one, Cycle) or index not in pairs:
            not_compared = Remark("quasipotential.limit_cycle_not_compared")
            remark = not_compared if isinstance(one, Cycle) else NOT_SHOWN
            rows.append(_difference(f"A{index + 1}", "", note=sentence(remark)))
    return rows


def _difference(
    item: str, quantity: str, equations: float = np.nan, trajectories: float = np.nan,
    standard_error: float = np.nan, *, noise: float = np.nan, note: str = "",
) -> dict[str, object]:  # fmt: skip
    """One number by the equations and by the trajectories; the standard error is that of the latter."""
    relative = trajectories / equations - 1 if equations else np.nan
    in_errors = (trajectories - equations) / standard_error if standard_error > 0 else np.nan
    row = (item, quantity, noise, equations, trajectories, standard_error, relative, in_errors, note)
    return dict(zip(COLUMNS, row, strict=True))


def _matched_attractors(equations: Landscape, trajectories: Landscape) -> dict[int, int]:
    """For each attractor of the equations that the trajectories show, its place among theirs."""
    width = np.ptp(equations.dynamics.box, axis=1)
    points = [one for one in equations.attractors if not isinstance(one, Cycle)]  # cycles follow after points
    others = [one for one in equations.equilibria if one.kind != "attractor"]
    places = np.array([one.position for one in (*points, *others)], dtype=float)
    nearest: dict[int, tuple[float, int]] = {}
    for place, one in enumerate(trajectories.attractors):
        if isinstance(one, Cycle) or not len(places):
            continue
        distance = np.linalg.norm((places - one.position) / width, axis=1)
        index = int(distance.argmin())
        if index < len(points):
            nearest[index] = min(nearest.get(index, (np.inf, -1)), (float(distance[index]), place))
    return {index: place for index, (_, place) in nearest.items()}


def _check_same_noise(
    equations: Dynamics, trajectories: Dynamics, x: np.ndarray, *, found: FieldEstimate | None
) -> None:
    """Refuse two landscapes whose D are not the same at states ``(n, d)``, but for the errors of `found`."""
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
    apart = ~(np.abs(difference) <= DIFFUSION_ROUNDING + STANDARD_ERRORS * errors)
    if apart.any():
        place = places[[np.argmax(apart)]]

        def rows(noise: Diffusion) -> list[list[float]]:
            return [[float(f"{each:.4g}") for each in row] for row in noise.at(place)[0]]

        where = "" if one.constant and other.constant else f" at {place_text(place[0])}"
        raise ValueError(
            f"U is in the unit of D, and D is not the same: the equations have {rows(one)}{where},"
            f" the trajectories {rows(other)}; give both the same, recordings by"
            " StateSpace(diffusion=...), or compare ΔU/ε"
        )
