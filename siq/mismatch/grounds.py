"""Where may a smooth function stand, and where have the recordings been there?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.parametric import symbol
from siq.estimation.measurements import Measurements
from siq.mismatch.function_places import Place, courses_of


@dataclass(frozen=True)
class Ground:
    """Where a smooth function may stand, and where the recordings have been there.

    Attributes
    ----------
    place
        In which equation, or output; what it is multiplied by there.
    coordinates
        What it is a function of: one formula, or two.
    words
        The same in words.
    courses
        Their values along the recordings, shape ``(c, n)``.
    """

    place: Place
    coordinates: tuple[sympy.Expr, ...]
    words: tuple[str, ...]
    courses: np.ndarray

    @property
    def ranges(self) -> np.ndarray:
        """Of each coordinate, shape ``(c,)``."""
        return np.ptp(self.courses, axis=1)

    @property
    def usable(self) -> bool:
        """Whether every coordinate takes several values, all of them finite."""
        return bool(np.isfinite(self.courses).all() and (self.ranges > 0).all())

    def along(self, model: Dynamics, data: Measurements, x: np.ndarray) -> Ground:
        """The same ground where the recordings have been by other states, shape ``(n, d)``."""
        return replace(self, courses=courses_of(self.coordinates, model, data, x))


def ground_of(place: Place, model: Dynamics, data: Measurements, x: np.ndarray) -> Ground:
    """The ground of a function of one coordinate, in a place.

    Parameters
    ----------
    place
        The coordinate's second word, if it has one, is a factor of the function.
    model, data, x
        The simulation, the recordings, and the states along them, shape ``(n, d)``.
    """
    courses = courses_of((place.coordinate,), model, data, x)
    return Ground(place, (place.coordinate,), place.words[:1], courses)


def ground_of_two(
    target: str, words: tuple[str, str], model: Dynamics, data: Measurements, x: np.ndarray
) -> Ground:
    """The ground of a function of two states or inputs, in the equation of a state."""
    coordinates = tuple(symbol(name) for name in words)
    place = Place(((target, sympy.Integer(1)),), (), coordinates[0], words, np.empty(0))
    return Ground(place, coordinates, words, courses_of(coordinates, model, data, x))
