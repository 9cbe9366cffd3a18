"""Integrals of ``exp(-U/ε)`` over a box, for a U that is a sum of terms with few states each.

States that occur in one term together form a *block*; the integrand is the product over the blocks. A state
by itself is integrated adaptively, two or three on a tensor product of Gauss–Legendre nodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.integrate
import scipy.optimize
import scipy.special
import sympy

from siq.dynamics.formulas import compile_formulas
from siq.errors import NumericalFailure

LARGEST_BLOCK = 3  # states; beyond, a tensor product of nodes is out of reach
SCAN_POINTS = 2001  # where the wells of a one-dimensional integral are looked for
MOST_WELLS = 50  # of them
TOLERANCE = 1e-6  # relative: what a quadrature's own estimate of its error may be


@dataclass(frozen=True)
class CoupledTerms:
    """The terms of U that couple some states, over these states' part of the box.

    Attributes
    ----------
    expression
        The terms, in the unit of ε.
    states, symbols
        Indices and symbols of the k states, in the order of the state vector.
    box
        Shape ``(k, 2)``, in the states' units.
    intensity
        ε.
    nodes
        Gauss–Legendre nodes along each state.
    """

    expression: sympy.Expr
    states: tuple[int, ...]
    symbols: tuple[sympy.Symbol, ...]
    box: np.ndarray
    intensity: float
    nodes: int

    @cached_property
    def exponent(self) -> Callable[[np.ndarray], np.ndarray]:
        """U/ε of the block, components ``(k, ...)`` to ``(...)``."""
        function = compile_formulas([self.expression / sympy.Float(self.intensity, 17)], self.symbols)

        def evaluate(components: np.ndarray) -> np.ndarray:
            with np.errstate(all="ignore"):
                values = function(components)[0]
            if not np.isfinite(values).all():
                raise NumericalFailure("the quasipotential is not finite everywhere in the box")
            return values

        return evaluate

    @cached_property
    def log_integral(self) -> float:
        """Log ∫ exp(-U/ε) over the block's part of the box."""
        if len(self.states) == 1:
            return self._log_integral_adaptive()
        fine, coarse = (self._log_integral_tensor(count) for count in (self.nodes, 3 * self.nodes // 4))
        _check_convergence(abs(fine - coarse))
        return fine

    def _log_integral_adaptive(self) -> float:
        def value(x: float) -> float:
            return float(self.exponent(np.array([[x]]))[0])

        lower, upper = self.box[0]
        grid = np.linspace(lower, upper, SCAN_POINTS)
        values = self.exponent(grid[None])
        lowest = _lowest_inside(values)
        # A narrow well between the nodes of the first rule would be overlooked: tell where the wells are.
        inside = np.flatnonzero((values[1:-1] <= values[:-2]) & (values[1:-1] < values[2:])) + 1
        wells = []
        for index in inside[np.argsort(values[inside])[:MOST_WELLS]]:
            between = (grid[index - 1], grid[index + 1])
            found = scipy.optimize.minimize_scalar(value, bounds=between, options={"xatol": 1e-12})
            wells.append(float(found.x))
            lowest = min(lowest, float(found.fun))
        total, error = scipy.integrate.quad(
            lambda x: math.exp(lowest - value(x)), lower, upper,
            points=wells or None, limit=500, epsabs=0.0, epsrel=1e-12, full_output=1,
        )[:2]  # fmt: skip
        _check_convergence(error / total if total > 0 else math.inf)
        return math.log(total) - lowest

    def _log_integral_tensor(self, count: int) -> float:
        rules = [_gauss_legendre(bounds, count) for bounds in self.box]
        values = self.exponent(np.stack(np.meshgrid(*(rule[0] for rule in rules), indexing="ij")))
        lowest = _lowest_inside(values)
        density = np.exp(lowest - values)
        for _, weights in reversed(rules):
            density = density @ weights
        return float(np.log(density) - lowest)

    def marginal(self, axes: dict[int, np.ndarray]) -> np.ndarray:
        """Density of some of the block's states on a grid, the other ones integrated out.

        The result has one axis for each state of `axes`, in the order given there.
        """
        if not axes:
            return np.ones(())
        rest = [state for state in self.states if state not in axes]
        rules = {state: _gauss_legendre(self.box[self.states.index(state)], self.nodes) for state in rest}
        coordinates = axes | {state: rule[0] for state, rule in rules.items()}
        mesh = dict(zip(coordinates, np.meshgrid(*coordinates.values(), indexing="ij"), strict=True))
        density = np.exp(-self.exponent(np.stack([mesh[state] for state in self.states])) - self.log_integral)
        for state in reversed(rest):
            density = density @ rules[state][1]
        return density


def split_into_blocks(
    quasipotential: sympy.Expr,
    symbols: Sequence[sympy.Symbol],
    *,
    intensity: float,
    box: np.ndarray,
    nodes: int,
) -> tuple[float, list[CoupledTerms]]:
    """Split U into a constant and blocks that have no state in common.

    Parameters
    ----------
    quasipotential
        U, any formula.
    symbols
        The d states.
    intensity
        ε, in the unit of U.
    box
        Shape ``(d, 2)``, in the states' units.
    nodes
        Gauss–Legendre nodes along each state of a block of two or three.

    Returns
    -------
    tuple of float and list of CoupledTerms
        The constant, in the unit of ε, and the blocks; a state that U does not hold is a block by itself.

    Raises
    ------
    NumericalFailure
        When a block has more than `LARGEST_BLOCK` states.
    """
    constant, groups = 0.0, [({symbol}, sympy.S.Zero) for symbol in symbols]
    for part in sympy.Add.make_args(sympy.expand(quasipotential)):
        if not part.free_symbols:
            constant += float(part)
            continue
        coupled = [group for group in groups if group[0] & part.free_symbols]
        groups = [group for group in groups if not group[0] & part.free_symbols]
        groups.append((set().union(*(group[0] for group in coupled)), part + sum(e for _, e in coupled)))
    blocks = []
    for members, expression in groups:
        states = tuple(index for index, symbol in enumerate(symbols) if symbol in members)
        if len(states) > LARGEST_BLOCK:
            names = ", ".join(str(symbols[state]) for state in states)
            raise NumericalFailure(
                f"the quasipotential couples {len(states)} states ({names}), of which at most"
                f" {LARGEST_BLOCK} can be integrated together"
            )
        blocks.append(
            CoupledTerms(
                expression=expression,
                states=states,
                symbols=tuple(symbols[state] for state in states),
                box=np.asarray(box, dtype=float)[list(states)],
                intensity=intensity,
                nodes=nodes,
            )
        )
    return constant, blocks


def _gauss_legendre(bounds: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    nodes, weights = scipy.special.roots_legendre(count)
    half = (bounds[1] - bounds[0]) / 2
    return bounds[0] + half * (nodes + 1), half * weights


def _lowest_inside(values: np.ndarray) -> float:
    """Smallest value; refused where it lies at the rim, as for a formula that falls towards -∞ there."""
    lowest = float(values.min())
    if values[(slice(1, -1),) * values.ndim].min() > lowest:
        raise NumericalFailure("the quasipotential is lowest at the rim of the box; exp(-U/ε) peaks there")
    return lowest


def _check_convergence(error: float) -> None:
    if not error <= TOLERANCE:
        raise NumericalFailure(
            f"the integral of exp(-U/ε) has not converged (relative error {error:.1e}); take more nodes or"
            " a smaller box"
        )
