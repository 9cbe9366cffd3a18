"""V about one attractor: a formula, the level up to which it was sought, and where to believe it.

No single formula can hold over several wells, since V has a kink between them; about one attractor it is
smooth, below its lowest saddle and often beyond. Away from recorded states that lead to the attractor, and
where the formula does not solve the Hamilton–Jacobi equation, nothing is claimed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import sympy
from scipy.spatial import cKDTree

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.exports import Formula, as_latex, as_sympy, as_text
from siq.dynamics.formulas import DIGITS
from siq.dynamics.reach import measure_at
from siq.dynamics.source_code import c_source, julia_source, numpy_source
from siq.potential.bases import PowerBasis

TOLERANCE = 0.05  # residual at a point up to which a formula is believed: V is then off by some per cent
ROUNDING = 1e-16  # of what is usual: |∇V| |f| so close to the attractor says nothing
NEGATIVE = 1e-9  # of the level: V so far below zero is rounding
NOTHING = 1e-14  # of the largest coefficient, or of the size of a well: rounding of the fit
NEAR = 2.5  # of the spacing of the points: further away there were no points


@dataclass(frozen=True)
class DegreeTrial:
    """One degree that was tried about an attractor.

    Attributes
    ----------
    degree, terms
        Highest power, and number of coefficients.
    residual
        Median relative Hamilton–Jacobi residual on points that took no part in the fit.
    covered
        Points among them below the lowest level of all degrees at which the formula is believed, as a share
        of those that the degree which reaches most of them has there.
    """

    degree: int
    terms: int
    residual: float
    covered: float


@dataclass(frozen=True, eq=False)
class Well:
    """V about an attractor. U is 2V.

    Main attributes
    ---------------
    dynamics
        f and D.
    attractor
        Shape ``(d,)``. V is zero there.
    basis, coefficients
        The powers about the attractor, and their coefficients, shape ``(m,)``.
    level
        V of the lowest saddle, or, where there is none, of the last point that recordings reach.
    saddle
        Position of that saddle, None where recordings end before one.

    Other attributes
    ----------------
    residual
        Relative Hamilton–Jacobi residual on the points of the fit.
    points
        Those, shape ``(n, d)``; none where only the formula was kept.
    reach
        V up to which the formula was sought, which may lie beyond the saddle; by default the level.
    tolerance
        Largest relative Hamilton–Jacobi residual at a point where the formula is believed.
    elsewhere
        Recorded states from which f leads to other attractors, shape ``(m, d)``; None for none.
    trials
        The degrees that were tried.
    """

    dynamics: Dynamics
    attractor: np.ndarray
    basis: PowerBasis
    coefficients: np.ndarray
    level: float
    saddle: np.ndarray | None
    residual: float
    points: np.ndarray
    reach: float = 0.0
    tolerance: float = TOLERANCE
    elsewhere: np.ndarray | None = None
    trials: tuple[DegreeTrial, ...] = ()

    def __post_init__(self) -> None:
        if not self.reach:
            object.__setattr__(self, "reach", self.level)

    @property
    def degree(self) -> int:
        """Highest power."""
        return int(self.basis.exponents.sum(axis=1).max())

    @property
    def inside(self) -> np.ndarray:
        """The points of the fit below the level, shape ``(m, d)``."""
        return np.asarray(self.points[self.values(self.points) < self.level])

    def values(self, x: np.ndarray) -> np.ndarray:
        """The formula at points ``(n, d)``, believed there or not: shape ``(n,)``."""
        return self.basis.values(x) @ self.coefficients

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """∇V at points, shape ``(n, d)``."""
        return self.basis.gradients(x) @ self.coefficients

    def hessians(self, x: np.ndarray) -> np.ndarray:
        """∇²V at points, shape ``(n, d, d)``."""
        return self.basis.hessians(x) @ self.coefficients

    def known_values(self, x: np.ndarray) -> np.ndarray:
        """V at points ``(n, d)``: shape ``(n,)``, NaN where the formula is not to be believed."""
        return np.where(self.believed(x), self.values(x), np.nan)

    def believed(self, x: np.ndarray) -> np.ndarray:
        """Mask of the points that the formula reaches, and where it solves the Hamilton–Jacobi equation.

        That has no meaning where a formula of D is no covariance.
        """
        believed = self.reaches(x) & self.dynamics.diffusion.positive_at(x)
        believed[believed] = self.residual_at(x[believed]) <= self.tolerance
        return believed

    def residual_at(self, x: np.ndarray) -> np.ndarray:
        """∣∇V·(f + D∇V)∣ / (∣∇V∣ ∣f∣) at points ``(n, d)``, in the metric of the noise: shape ``(n,)``.

        At the attractor, where both vanish, it is zero.
        """
        numerator, size = self._terms(x)
        # At the attractor both vanish, and what is left of them is rounding.
        return np.asarray(numerator / np.maximum(size, ROUNDING * self._size))

    def reaches(self, x: np.ndarray) -> np.ndarray:
        """Mask of the points below `reach`, and among recorded states that lead to the attractor.

        V is zero at the attractor and nowhere lower. Where a formula is, it runs away between two of its
        points. One state has nothing beside its points: what lies between two of them is reached, and so is
        the saddle, to which they lead as close as recordings do.
        """
        values = self.values(x)
        reached: np.ndarray = (values <= self.reach) & (values >= -NEGATIVE * self.reach)
        if not len(self.points):
            return reached
        if x.shape[1] == 1:
            known = self.points if self.saddle is None else np.append(self.points, self.saddle[None], axis=0)
            return reached & (x[:, 0] >= known.min()) & (x[:, 0] <= known.max())
        tree, spacing = self._places
        own, nearest = tree.query(x / self._width)
        reached &= own <= NEAR * spacing[nearest]
        if self._others is not None:  # behind the ridge the formula would go on down to the other attractor
            reached &= own < self._others.query(x / self._width)[0]
        return reached

    def _terms(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope, flow, noise = self.gradients(x), self.dynamics.drift(x), self.dynamics.diffusion
        numerator = np.abs((slope * (flow + noise.push(x, slope))).sum(axis=1))
        measure = self._measure
        return numerator, np.sqrt(measure.steepness(x, slope) * measure.squared_speed(x, flow))

    @cached_property
    def _measure(self) -> Diffusion:
        return measure_at(self.dynamics, self.attractor)

    @cached_property
    def _size(self) -> float:
        size = float(np.median(self._terms(self.points)[1])) if len(self.points) else 0.0
        return size if size > 0 else float(np.finfo(float).tiny) / ROUNDING

    @cached_property
    def _others(self) -> cKDTree | None:
        if self.elsewhere is None or not len(self.elsewhere):
            return None
        return cKDTree(self.elsewhere / self._width)

    @cached_property
    def _width(self) -> np.ndarray:
        width: np.ndarray = np.ptp(self.points, axis=0)
        return width

    @cached_property
    def _places(self) -> tuple[cKDTree, np.ndarray]:
        places = self.points / self._width
        tree = cKDTree(places)
        # Of the d-th neighbour: points on one descent lie closer to each other than descents do.
        spacing = tree.query(places, k=2 * places.shape[1] + 1)[0][:, -1]
        return tree, spacing

    # The formula for others.

    @property
    def expression(self) -> sympy.Expr:
        """V as a formula of the states, in powers of ``(x - center)/scale``."""
        return self.basis.expression(self.coefficients)

    @property
    def formula(self) -> Formula:
        """V in powers of the offsets from the attractor, in the units of the states, without rounding."""
        size, basis = np.abs(self.coefficients), self.basis
        return Formula.of_powers(
            "V", basis.symbols, scale=basis.scale, exponents=basis.exponents,
            center=np.where(np.abs(basis.center) > NOTHING * basis.scale, basis.center, 0.0),
            coefficients=np.where(size > NOTHING * size.max(), self.coefficients, 0.0),
            units=self.dynamics.units, title=f"U = 2V is the quasipotential, known up to V = {self.reach!r}",
        )  # fmt: skip

    def to_text(self) -> str:
        """The formula as text, a line for each definition."""
        return as_text(self.formula)

    def to_latex(self, *, digits: int = DIGITS) -> str:
        """The formula as LaTeX, with so many significant digits."""
        return as_latex(self.formula, digits=digits)

    def to_sympy(self) -> sympy.Expr:
        """The formula as a sympy expression of the states."""
        return as_sympy(self.formula)

    def to_numpy(self) -> str:
        """Source of the functions ``V`` and ``V_gradient`` in numpy."""
        return numpy_source(self.formula)

    def to_c(self) -> str:
        """Source of the functions ``V`` and ``V_gradient`` in C."""
        return c_source(self.formula)

    def to_julia(self) -> str:
        """Source of the functions ``V`` and ``V_gradient`` in Julia."""
        return julia_source(self.formula)
