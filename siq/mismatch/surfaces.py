"""Surfaces: smooth functions of two coordinates without a name, as sums of bumps.

What depends on two coordinates need be no product of a function and a coordinate. It is a sum of Gaussian
bumps, as many as earn their place, which stand where the recordings have been, each as wide as a half, a
quarter or an eighth of the range. Where the recordings have not been, it is zero.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import compile_values
from siq.dynamics.parametric import Signals, symbol
from siq.estimation.estimation import Fit
from siq.estimation.linearisation import Grid, Linearisation
from siq.estimation.measurements import Measurements
from siq.mismatch.candidates import MechanismCandidate
from siq.mismatch.evidence import LENGTHS
from siq.mismatch.function_places import NUMBERS, Place, coordinates_of
from siq.mismatch.functions import built, fresh_names, unit_in
from siq.mismatch.screening import probe_response
from siq.mismatch.structure import SUBSTEPS

SURFACE = "surface"
# As shares of the range: those of functions of one coordinate, and one that is wider.
WIDTHS = (*LENGTHS, 2 * LENGTHS[-1])
MOST_CENTRES = 64  # so many lie an eighth of the range apart, if the recordings have been everywhere
MOST_BUMPS = 40  # that are added at a time: a guard on the time of a fit
DISTINCT = 1e-3  # of a column, which the others have to leave of it


@dataclass(frozen=True)
class Surface:
    """Where a function of two coordinates may stand, and the bumps that it may consist of.

    Attributes
    ----------
    target
        The state in whose equation it stands.
    words
        Its coordinates, states or inputs: two, or a single one.
    centres, widths
        Of the bumps, shapes ``(b, c)``.
    """

    target: str
    words: tuple[str, ...]
    centres: np.ndarray
    widths: np.ndarray

    @property
    def place(self) -> Place:
        """The same as a place of the function, whose first coordinate comes first."""
        one = sympy.Integer(1)
        return Place(((self.target, one),), (), symbol(self.words[0]), self.words, np.empty(0))

    @property
    def limits(self) -> np.ndarray:
        """Where it is not nearly zero, as far as it is known: lower and upper, shape ``(2, c)``."""
        return np.stack([(self.centres - self.widths).min(axis=0), (self.centres + self.widths).max(axis=0)])

    def values(self, courses: np.ndarray) -> np.ndarray:
        """Every bump along courses ``(c, n)`` of the coordinates, shape ``(b, n)``."""
        away = (courses[None] - self.centres[:, :, None]) / self.widths[:, :, None]
        return np.exp(-0.5 * (away**2).sum(axis=1))

    def some(self, chosen: Sequence[int]) -> Surface:
        """A surface of some of the bumps."""
        return Surface(self.target, self.words, self.centres[chosen], self.widths[chosen])

    def with_bumps(self, other: Surface) -> Surface:
        """A surface with those of another of the same coordinates, too, each once."""
        bumps = np.concatenate([self.centres, other.centres]), np.concatenate([self.widths, other.widths])
        _, first = np.unique(np.hstack(bumps), axis=0, return_index=True)
        order = np.sort(first)
        return Surface(self.target, self.words, bumps[0][order], bumps[1][order])


def surfaces_in(
    model: Dynamics, data: Measurements, x: np.ndarray, likely: Sequence[Place]
) -> Iterator[Surface]:
    """Surfaces in the equations of likely places: of their coordinates, and of these and one other each.

    Parameters
    ----------
    model
        The simulation.
    data, x
        The recordings and the states along them, shape ``(n, d)``: bumps stand where these have been.
    likely
        The likeliest places of functions of one coordinate, or of one times another.
    """
    names = [name for name in coordinates_of(model) if name != "t"]
    signals = data.signals(data.t, data.recording, delays=())
    courses = dict(zip(names, (*x.T[: model.dimension], *signals.inputs), strict=True))
    room = NUMBERS // (len(data.t) * (model.dimension + len(model.outputs)))
    done = set()
    for place in likely:
        if len(place.equations) != 1:  # of a rotating frame, or in a sensor
            continue
        for words in (*((name,) for name in names), *itertools.combinations(names, 2)):
            if not set(words) & set(place.words) or (place.targets, words) in done:
                continue
            done.add((place.targets, words))
            both = np.stack([courses[name] for name in words])
            ranges = np.ptp(both, axis=1)
            if not (np.isfinite(ranges).all() and (ranges > 0).all()):
                continue
            at = _spread_out(both / ranges[:, None], most=max(min(MOST_CENTRES, room // len(WIDTHS)), 1))
            centres = np.tile(both[:, at].T, (len(WIDTHS), 1))
            widths = np.repeat(WIDTHS, len(at))[:, None] * ranges
            yield Surface(place.targets[0], words, centres, widths)


def _spread_out(points: np.ndarray, *, most: int) -> np.ndarray:
    """Indices of points ``(c, n)`` that are as far from each other as the narrowest bump is wide."""
    away = np.full(points.shape[1], np.inf)
    chosen = [int(np.argmin(((points - np.median(points, axis=1)[:, None]) ** 2).sum(axis=0)))]
    while len(chosen) < most:
        away = np.minimum(away, ((points - points[:, chosen[-1:]]) ** 2).sum(axis=0))
        farthest = int(np.argmax(away))
        if away[farthest] < WIDTHS[0] ** 2:
            break
        chosen.append(farthest)
    return np.array(chosen)


class SurfaceColumns:
    """The bumps of a surface, as `siq.estimation.linearisation.linearise` wants them."""

    def __init__(self, model: Dynamics, grid: Grid, surface: Surface) -> None:
        self._model, self._grid, self._surface = model, grid, surface
        self.width = len(surface.centres)
        arguments = [symbol(name) for name in (*model.states, *(entry.name for entry in model.inputs))]
        self._courses = compile_values([symbol(name) for name in surface.words], arguments, common=False)

    def rates(self, x: np.ndarray, values: np.ndarray, node: int) -> np.ndarray:
        """See `siq.estimation.linearisation.Columns`."""
        signals: Signals = self._grid.signals(node, ())
        courses = [np.broadcast_to(each, x.shape[1]) for each in self._courses(*x, *signals.inputs)]
        result = np.zeros((self._model.dimension, self.width, x.shape[1]))
        result[self._model.states.index(self._surface.target)] = self._surface.values(np.stack(courses))
        return result

    def outputs(self, x: np.ndarray, values: np.ndarray) -> np.ndarray:
        """See `siq.estimation.linearisation.Columns`."""
        return np.zeros((len(self._model.outputs), self.width, x.shape[1]))


def response_with_surface(fit: Fit, data: Measurements, surface: Surface) -> Linearisation:
    """The linearisation of a fit with the columns of a surface's bumps behind those of its parameters.

    Parameters
    ----------
    fit, data
        The fit along whose trajectories everything is linear, and what it was made for.
    surface
        Its bumps.
    """
    grid = Grid(data, min(fit.substeps, SUBSTEPS))
    return probe_response(fit.model, grid, fit, SurfaceColumns(fit.model, grid, surface))


def needed(left: np.ndarray, columns: np.ndarray, *, count: float) -> tuple[list[int], float]:
    """Which columns are needed to explain what is left, and the logarithm of the odds for them.

    Each is added that explains most of what is left by then, and so many are taken that the odds are highest.
    A column has a price (Chen and Chen, Biometrika 95, 759 (2008): Schwarz's criterion, and the number of
    columns that it was chosen among). One alone may not be worth it where several are.

    Parameters
    ----------
    left
        Shape ``(n,)``.
    columns
        Shape ``(n, b)``.
    count
        How many errors count as independent.
    """
    size = np.sqrt((columns**2).sum(axis=0))
    rest = columns / np.where(size > 0, size, 1.0)
    left, price = left.copy(), np.log(count) + 2 * np.log(max(columns.shape[1], 1))
    chosen: list[int] = []
    odds = [0.0]
    while len(chosen) < MOST_BUMPS:
        norms = (rest**2).sum(axis=0)
        open_ = norms > DISTINCT**2
        open_[chosen] = False
        if not open_.any():
            break
        explained = np.where(open_, (rest.T @ left) ** 2 / np.where(open_, norms, 1.0), 0.0)
        best = int(np.argmax(explained))
        total = float(left @ left)
        gain = float(count * np.log(total / max(total - explained[best], 1e-300)))
        if gain <= 1:  # no more than a column of noise explains
            break
        along = rest[:, best] / np.sqrt(norms[best])
        left -= along * (along @ left)
        rest -= np.outer(along, along @ rest)
        chosen.append(best)
        odds.append(odds[-1] + (gain - price) / 2)
    most = int(np.argmax(odds))
    return chosen[:most], odds[most]


def with_surface(model: Dynamics, surface: Surface) -> MechanismCandidate:
    """The simulation with a surface; the heights of its bumps are the amplitudes."""
    names = fresh_names("b", len(surface.centres), model)
    coordinates = [symbol(name) for name in surface.words]

    def bump(centre: np.ndarray, width: np.ndarray) -> sympy.Expr:
        away = [
            ((z - sympy.Float(float(f"{at:.6g}"))) / sympy.Float(float(f"{wide:.6g}"))) ** 2
            for z, at, wide in zip(coordinates, centre, width, strict=True)
        ]
        return sympy.exp(-sympy.Add(*away) / 2)

    formula = sympy.Add(
        *(
            symbol(name) * bump(centre, width)
            for name, centre, width in zip(names, surface.centres, surface.widths, strict=True)
        )
    )
    units = [unit_in(surface.place, model, 0, 0)] * len(names)
    return built(model, surface.place, formula, names, units)
