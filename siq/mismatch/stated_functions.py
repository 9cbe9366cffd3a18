"""What is stated of the model of what has no name?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
import sympy

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.formulas import compile_values
from siq.dynamics.parametric import symbol
from siq.estimation.fit import Fit
from siq.mismatch.functions import FORMULA
from siq.mismatch.held_out import HeldOutRuns
from siq.mismatch.nameless_models import MECHANISM, Part
from siq.mismatch.smooth_functions import CURVE, SURFACE, Smooth
from siq.mismatch.stated_parts import DescribedCurve, DescribedSurface, Estimate, Evidence, StatedFunction

COORDINATE = sympy.Symbol("coordinate", positive=True)  # positive, so that the root of its square is itself
GRID = 25  # places along either coordinate of a surface, for its figure
_KINDS: Mapping[str, Literal["formula", "curve", "surface", "mechanism"]] = {
    FORMULA: "formula",
    CURVE: "curve",
    SURFACE: "surface",
    MECHANISM: "mechanism",
}


def stated_functions(shown: HeldOutRuns, *, beside: tuple[str, ...] = ()) -> tuple[StatedFunction, ...]:
    """The parts of the model that is in the new card; none where nothing that was added helped.

    Parameters
    ----------
    shown
        The free runs, with the model.
    beside
        Labels of mechanisms with a name, which were in place before.
    """
    if shown.described is None or shown.described_fit is None or not shown.adopted:
        return ()
    labels = [each.trial.candidate.label for each in shown.described.parts]
    return tuple(
        _stated(part, shown.described_fit, (*beside, *labels[:place]))
        for place, part in enumerate(shown.described.parts)
    )


def _stated(part: Part, fit: Fit, beside: tuple[str, ...]) -> StatedFunction:
    trial, candidate = part.trial, part.trial.candidate
    errors = dict(
        zip(
            (fit.model.parameters[place].name for place in fit.model.free),
            map(float, fit.standard_errors),
            strict=True,
        )
    )
    known = {entry.name: entry for entry in fit.model.parameters}
    changed = [name for name, _ in candidate.changes]
    return StatedFunction(
        name=candidate.name,
        label=candidate.label,
        kind=_KINDS[part.kind],
        terms={name: str(formula) for name, formula in candidate.changes},
        parameters={
            name: Estimate(known[name].value, errors.get(name), known[name].unit) for name in candidate.new
        },
        evidence=Evidence(trial.delta_chi2, trial.delta_bic, trial.p_white, trial.p_cluster),
        equations=candidate.equations,
        outputs=tuple(name for name in changed if name in fit.model.output_names)
        if not candidate.equations
        else (),
        coordinates=part.place.words if part.place is not None else tuple(candidate.coordinate.split(", ")),
        curve=curve_of(part, fit),
        surface=surface_of(part, fit),
        beside=beside,
    )


def curve_of(part: Part, fit: Fit) -> DescribedCurve | None:
    """A function of one coordinate at the knots of its place, with its standard errors.

    None for a formula in two coordinates, for a surface, and for a mechanism.
    """
    place, smooth = part.place, part.smooth
    if place is None or (part.kind != CURVE and len(place.words) > 1):
        return None
    if smooth is not None:
        lower, upper = smooth.limits[:, 0]
        knots = np.linspace(lower, upper, GRID)
        values, errors = _along(smooth, part, fit, knots[None])
    else:
        knots = place.knots
        weights = _terms(part, fit.model, knots)
        values, errors = weights @ _amplitudes(part, fit), _errors(weights, part, fit)
    return DescribedCurve(
        place.words[0], tuple(map(float, knots)), tuple(map(float, values)), tuple(map(float, errors))
    )


def surface_of(part: Part, fit: Fit) -> DescribedSurface | None:
    """A surface on a grid that covers the recordings, with its standard errors; None for anything else."""
    smooth = part.smooth
    if smooth is None or part.kind != SURFACE:
        return None
    at = [np.linspace(lower, upper, GRID) for lower, upper in smooth.limits.T]
    courses = np.stack([each.ravel() for each in np.meshgrid(*at, indexing="ij")])
    values, errors = _along(smooth, part, fit, courses)
    first, second = (tuple(map(float, each)) for each in at)

    def rows(flat: np.ndarray) -> tuple[tuple[float, ...], ...]:
        return tuple(tuple(map(float, row)) for row in flat.reshape(GRID, GRID))

    words = smooth.ground.words
    return DescribedSurface((words[0], words[1]), (first, second), rows(values), rows(errors))


def _along(smooth: Smooth, part: Part, fit: Fit, courses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A smooth function along courses ``(c, k)`` of its coordinates, and its standard errors, ``(k,)``."""
    values, derivatives = smooth.along(_amplitudes(part, fit), courses)
    return values, _errors(derivatives, part, fit)


def _amplitudes(part: Part, fit: Fit) -> np.ndarray:
    known = {each.name: each.value for each in fit.model.parameters}
    return np.array([known[name] for name in part.trial.candidate.amplitudes])


def _errors(weights: np.ndarray, part: Part, fit: Fit) -> np.ndarray:
    """Standard errors of weighted sums ``(k, c)`` of the amplitudes of a part, shape ``(k,)``."""
    free = [fit.model.parameters[each].name for each in fit.model.free]
    rows = [free.index(name) for name in part.trial.candidate.amplitudes]
    variances = np.einsum("kc,cd,kd->k", weights, fit.covariance[np.ix_(rows, rows)], weights)
    return np.sqrt(np.maximum(variances, 0.0))


def _terms(part: Part, model: Dynamics, knots: np.ndarray) -> np.ndarray:
    """What a unit of each coefficient of a formula is at the knots, shape ``(k, c)``."""
    assert part.place is not None
    candidate = part.trial.candidate
    name, formula = candidate.changes[0]
    factor = dict((*part.place.equations, *part.place.outputs))[name]
    columns = []
    for amplitude in candidate.amplitudes:
        term = in_coordinate(formula.diff(symbol(amplitude)) / factor, part.place.coordinate)
        value = compile_values([term], [COORDINATE], common=False)(knots)[0]
        columns.append(np.broadcast_to(np.asarray(value, dtype=float), knots.shape))
    return np.stack(columns, axis=1)


def in_coordinate(term: sympy.Expr, coordinate: sympy.Expr) -> sympy.Expr:
    """A formula in `COORDINATE`, in the place of the formula that the coordinate is.

    The square of ``sqrt(P**2 + Q**2)`` has no root in it, so that what stands under the root is replaced.
    """
    if isinstance(coordinate, sympy.Pow) and coordinate.exp == sympy.Rational(1, 2):
        return term.subs(coordinate.base, COORDINATE**2)
    return term.subs(coordinate, COORDINATE)
