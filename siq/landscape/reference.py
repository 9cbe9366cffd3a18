"""References for a landscape whose vector field is known exactly, by methods that share no code with ours.

Characteristics of the Hamilton–Jacobi equation (any dimension), an ordered line integral method on a mesh
(two states), and minimum action paths. None has an ansatz for V; none sees recordings, networks or formulas.
"""

from __future__ import annotations

import logging
import zipfile
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import hessian_at
from siq.dynamics.phase_portrait import PhasePortrait
from siq.errors import InputError, NumericalFailure
from siq.files.whole import whole_file
from siq.landscape.global_quasipotential import heights_of_attractors, least_over_wells
from siq.landscape.paths import minimum_action_path
from siq.reference.mesh import mesh_quasipotential
from siq.reference.mesh_values import MeshQuasipotential
from siq.reference.sheets import adapted_fan, lowest_sheet, value_near

LOGGER = logging.getLogger(__name__)
GRID = 161  # points along each of two states
SCATTERED = 4000  # points of a fan where there are more states
MESH = 512
CURVES = 400
GAP = 0.04  # between the ends of neighbouring curves, in units in which the level is at about 1
NEAR = 0.06  # of a point of a curve, in the same units: V is told from its nearest
WIDER = 0.25  # of the box, by which curves may leave it


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
    for index, one in enumerate(attractors if dynamics.dimension == 2 else ()):
        mesh = _mesh(dynamics, one, box, level=levels[index] / 2)
        if mesh is None:
            continue
        on_mesh[index] = 2 * mesh.evaluate(points)
        tops = np.array([saddle.position for saddle in portrait.saddles[index]]).reshape(-1, 2)
        if len(tops):
            mesh_barriers[index] = np.nanmin(2 * mesh.evaluate(tops), initial=np.inf)
    return ReferenceLandscape(
        attractors, points, values, on_mesh, barriers, mesh_barriers, _heights(actions, len(attractors))
    )


def _mesh(
    dynamics: Dynamics, attractor: np.ndarray, box: np.ndarray, *, level: float
) -> MeshQuasipotential | None:
    """V of two states on a mesh; none where f is not finite, or D not positive definite, in the whole box."""
    try:
        return mesh_quasipotential(
            dynamics.drift, attractor, hessian=hessian_at(dynamics, attractor), box=box,
            shape=(MESH, MESH), diffusion=dynamics.diffusion, level=level, stop_at_boundary=False,
        )  # fmt: skip
    except NumericalFailure as reason:
        LOGGER.info("no mesh about %s: %s", attractor, reason)
        return None


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
