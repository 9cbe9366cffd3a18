"""Regression: from the networks to sparse formulas (paper, section 2.3 and Appendix A).

Constrained sparse relaxed regularised regression (SR3) of ``G = [f_θ, V_θ, g_θ]`` on the candidate
library, subject to ``f = -D∇V + g``, by PySINDy; then a least-squares refit on the terms that it found.
The thresholded copy that SR3 returns meets the constraints only approximately; the refit meets them to
rounding.

Everything is solved with scaled columns. Each library function is divided by its rms over the points and
each target by its own, which no change of units can alter; the coefficients are scaled back exactly.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass as plain_dataclass
from typing import Annotated, Any, Literal

import numpy as np
import scipy.linalg
from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from siq.errors import Fault, NumericalFailure, needs_extra
from siq.inference.library import CandidateLibrary
from siq.systems.diffusion import Diffusion

CHUNK = 1024  # points whose functions are made triangular together, in the processor's cache
LOWER_SHARE = 0.75
"""Of the points by V_θ, where no level is given, a choice: the highest are few, and networks worst there."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class RegressionOptions:
    """Options of the sparse regression."""

    #: Highest degree of the monomials of the library
    degree: Annotated[int, Field(ge=1, le=12)] = 5
    #: A lower limit for V, where wanted
    potential_degree: Annotated[int, Field(ge=1)] | None = None
    #: A lower limit for g, where wanted
    circulatory_degree: Annotated[int, Field(ge=0)] | None = None
    #: Highest power about each attractor, where networks come by well
    well_degree: Annotated[int, Field(ge=2, le=16)] = 10
    #: Further library functions, as formulas of the states
    functions: tuple[str, ...] = ()
    #: τ - min V: the regression uses the points where V_θ lies less than this above its minimum. By default
    #: it is where `LOWER_SHARE` of the points lie.
    level: Annotated[float, Field(gt=0)] | None = None
    #: Terms below it are dropped
    threshold: Annotated[float, Field(ge=0)] = 0.01
    #: Where the threshold acts. ``coefficient``: on the coefficients in the states' own units, as the paper
    #: does. ``contribution``, the default: on coefficient × rms of the term / rms of the target, which no
    #: choice of units can alter.
    threshold_on: Literal["coefficient", "contribution"] = "contribution"
    #: ``columns``: solve with scaled functions and targets, and with the mean instead of the sum over points.
    #: ``none``: the paper's problem to the letter, whose weights depend on units and on the number of points.
    scaling: Literal["columns", "none"] = "columns"
    #: ν, how far SR3 lets the sparse coefficients be from the constrained ones
    relaxation: Annotated[float, Field(gt=0)] = 100.0
    #: Most iterations of SR3
    iterations: Annotated[int, Field(ge=10)] = 100  # PySINDy reports on every tenth, and divides by it
    #: SR3 ends when its sparse coefficients change by less (sum of squares, divided by ν)
    tolerance: Annotated[float, Field(gt=0)] = 1e-8

    @model_validator(mode="after")
    def _consistent(self) -> RegressionOptions:
        if self.scaling == "none" and self.threshold_on == "contribution":
            raise Fault(
                "contributions can be judged in scaled columns only",
                "write 'scaling: columns', or 'threshold_on: coefficient'",
            )
        return self


@plain_dataclass(frozen=True)
class _RegressionResult:
    """Sparse coefficients of f, V and g over one library."""

    vector_field: np.ndarray  #: shape ``(q, d)``: column i holds the coefficients of f_i
    potential: np.ndarray  #: shape ``(q,)``; the constant of V means nothing
    circulatory: np.ndarray  #: shape ``(q, d)``: column i holds the coefficients of g_i
    converged: bool  #: whether SR3 met its tolerance within the iterations allowed
    iterations: int  #: of SR3 that were taken
    constraint_residual: float  #: largest violation of ``C Ξ = 0``, scaled; rounding after the refit
    sparse_constraint_residual: float  #: the same for the thresholded coefficients of SR3, before the refit
    #: Rms misfit of the formulas to the networks over rms of the target, which are f_1 … f_d, V, g_1 … g_d.
    misfit: np.ndarray
    points: int  #: so many were used


def highest_used(potential: np.ndarray, *, level: float | None) -> float:
    """τ: `level` above the smallest of the known values of V; without one, above `LOWER_SHARE` of them."""
    return float(np.nanquantile(potential, LOWER_SHARE) if level is None else np.nanmin(potential) + level)


def points_below(potential: np.ndarray, *, level: float | None) -> np.ndarray:
    """Mask of the points where V lies below τ, see `highest_used`."""
    return np.asarray(potential < highest_used(potential, level=level))


def sparse_decomposition(
    library: CandidateLibrary, x: np.ndarray, potential: np.ndarray, circulatory: np.ndarray,
    vector_field: np.ndarray, *, diffusion: Diffusion, options: RegressionOptions,
) -> _RegressionResult:  # fmt: skip
    """Sparse formulas of V, g and f = -D∇V + g from their values at points.

    Parameters
    ----------
    library
        The candidate functions.
    x
        Points, shape ``(n, d)``, all of which are used; see `points_below`.
    potential, circulatory, vector_field
        V_θ at the points, shape ``(n,)``, and g_θ and f_θ, shape ``(n, d)``.
    diffusion
        D.
    options
        Threshold, relaxation and scaling. The limits of degree are the library's.

    Raises
    ------
    NumericalFailure
        When there are fewer points than candidate functions, or values that are not finite.
    """
    targets = np.column_stack([vector_field, potential - potential.min(), circulatory])
    values = library.evaluate(x)
    if not (np.isfinite(values).all() and np.isfinite(targets).all()):
        raise NumericalFailure("a library function or a network is not finite at some points")
    if len(x) < library.size:
        raise NumericalFailure(
            f"only {len(x)} points lie below the level, fewer than the {library.size} candidate functions;"
            " raise regression.level or lower regression.degree"
        )
    term_scale, target_scale = _scales(library, values, targets, options)
    # The problem depends on the points through a small triangular matrix only.
    triangle = np.zeros((0, values.shape[1] + targets.shape[1]))
    for begin in range(0, len(x), CHUNK):
        part = slice(begin, begin + CHUNK)
        rows = np.column_stack([values[part] / term_scale, targets[part] / target_scale])
        triangle = np.asarray(np.linalg.qr(np.concatenate([triangle, rows]), mode="r"))
    if options.scaling == "columns":
        triangle = triangle / np.sqrt(len(x))
    q = library.size
    matrix, goals, rest = triangle[:q, :q], triangle[:q, q:], triangle[q:, q:]

    ratio = term_scale[:, None] / target_scale[None, :]  # scaled coefficient = ratio × coefficient
    constraints = library.constraints(diffusion) / ratio.T.ravel()
    constraints /= np.linalg.norm(constraints, axis=1, keepdims=True)
    thresholds = options.threshold * (ratio if options.threshold_on == "coefficient" else np.ones_like(ratio))

    initial = _initial_coefficients(library, matrix, goals, diffusion, thresholds, ratio, options)
    sparse, converged, iterations = _relaxed_regression(
        matrix, goals, thresholds, options, constraints=constraints, initial=initial
    )
    support = sparse != 0
    support[library.constant, library.dimension] = True  # V is defined up to a constant
    support[~library.in_potential, library.dimension] = False
    support[~library.in_circulatory, library.dimension + 1 :] = False
    scaled = _constrained_least_squares(matrix, goals, support, constraints)

    residual = np.linalg.norm(matrix @ scaled - goals, axis=0) ** 2 + np.linalg.norm(rest, axis=0) ** 2
    size = np.sqrt(np.linalg.norm(goals, axis=0) ** 2 + np.linalg.norm(rest, axis=0) ** 2)
    coefficients, d = scaled / ratio, library.dimension
    return _RegressionResult(
        vector_field=coefficients[:, :d], potential=coefficients[:, d], circulatory=coefficients[:, d + 1 :],
        converged=converged, iterations=iterations,
        constraint_residual=float(np.abs(constraints @ scaled.T.ravel()).max()),
        sparse_constraint_residual=float(np.abs(constraints @ sparse.T.ravel()).max()),
        misfit=np.sqrt(residual) / np.where(size > 0, size, 1.0), points=len(x),
    )  # fmt: skip


def _scales(
    library: CandidateLibrary, values: np.ndarray, targets: np.ndarray, options: RegressionOptions
) -> tuple[np.ndarray, np.ndarray]:
    """Scale of every function, shape ``(q,)``, and of every target, shape ``(2d + 1,)``."""
    if options.scaling == "none":
        return np.ones(values.shape[1]), np.ones(targets.shape[1])
    d = library.dimension
    term_scale = np.sqrt((values**2).mean(axis=0))
    target_scale = np.sqrt((targets**2).mean(axis=0))
    target_scale[d] = targets[:, d].std()
    # f_i and g_i share a scale, for they are compared with each other; g may vanish (gradient systems).
    target_scale[d + 1 :] = target_scale[:d]
    return np.where(term_scale > 0, term_scale, 1.0), np.where(target_scale > 0, target_scale, 1.0)


def _initial_coefficients(
    library: CandidateLibrary, matrix: np.ndarray, goals: np.ndarray, diffusion: Diffusion,
    thresholds: np.ndarray, ratio: np.ndarray, options: RegressionOptions,
) -> np.ndarray:  # fmt: skip
    """Ξ⁰ of Appendix A: V and g regressed on their own, f from both."""
    d = library.dimension
    scaled, targets = np.zeros_like(goals), np.arange(goals.shape[1])
    for chosen, allowed in (
        (targets[d : d + 1], library.in_potential),
        (targets[d + 1 :], library.in_circulatory),
    ):
        rows = np.flatnonzero(allowed)
        block = (rows[:, None], chosen[None, :])
        scaled[block] = _relaxed_regression(matrix[:, rows], goals[:, chosen], thresholds[block], options)[0]
    coefficients = scaled / ratio
    downhill = np.einsum("ikj,j->ki", library.downhill(diffusion), coefficients[:, d])
    coefficients[:, :d] = coefficients[:, d + 1 :] - downhill
    return coefficients * ratio


def _relaxed_regression(
    matrix: np.ndarray, goals: np.ndarray, thresholds: np.ndarray, options: RegressionOptions, *,
    constraints: np.ndarray | None = None, initial: np.ndarray | None = None,
) -> tuple[np.ndarray, bool, int]:  # fmt: skip
    """SR3 by PySINDy: thresholded coefficients ``(q, targets)``, convergence, iterations."""
    with needs_extra("networks"):
        import pysindy  # takes seconds to import, and only regressions need it
        from sklearn.exceptions import ConvergenceWarning

    settings: dict[str, Any] = {
        # PySINDy keeps a coefficient where its square exceeds 2 λ ν, with its own λ for each.
        "reg_weight_lam": (thresholds**2 / (2 * options.relaxation)).T,
        "regularizer": "weighted_l0",
        "relax_coeff_nu": options.relaxation,
        "tol": options.tolerance,
        "max_iter": options.iterations,
        "initial_guess": None if initial is None else initial.T.copy(),
    }
    if constraints is None:
        optimizer = pysindy.SR3(**settings)
    else:
        optimizer = pysindy.ConstrainedSR3(
            **settings, constraint_lhs=constraints.copy(), constraint_rhs=np.zeros(len(constraints)),
            constraint_order="target", equality_constraints=True,
        )  # fmt: skip
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        optimizer.fit(matrix, goals)
    converged = not any(issubclass(warning.category, ConvergenceWarning) for warning in caught)
    return np.atleast_2d(optimizer.coef_).T.copy(), converged, len(optimizer.history_)


def _constrained_least_squares(
    matrix: np.ndarray, goals: np.ndarray, support: np.ndarray, constraints: np.ndarray
) -> np.ndarray:
    """Least squares on a support, ``(q, targets)``, within the null space of the constraints."""
    q, targets = goals.shape
    chosen = np.flatnonzero(support.T.ravel())
    basis = scipy.linalg.null_space(constraints[:, chosen], rcond=1e-10)
    solution = np.zeros(targets * q)
    if basis.shape[1]:
        design = np.zeros((targets, q, len(chosen)))
        for column, index in enumerate(chosen):
            target, term = divmod(index, q)
            design[target, :, column] = matrix[:, term]
        reduced = design.reshape(targets * q, len(chosen)) @ basis
        solution[chosen] = basis @ np.linalg.lstsq(reduced, goals.T.ravel(), rcond=None)[0]
    # A term of the support that the constraints force to vanish does so to rounding; it is no term.
    solution[np.abs(solution) < 1e-12 * np.abs(solution).max()] = 0.0
    return solution.reshape(targets, q).T
