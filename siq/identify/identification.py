"""The vector field, identified first: sparse regression of the flow over the step of the pairs.

All functions of a library are fitted first (`siq.identify.flow_regression`). Terms are dropped by their own
uncertainty, and under noise exchanged as long as that helps (`siq.identify.selection`). What remains is
fitted by generalised least squares with the covariance that the residuals show, which attains the Cramér–Rao
bound.

Not to be confused with the f of `siq.networks.regression`, which is that of the networks: here no network
takes part, and V and g are not known yet. That makes it the yardstick of the certificate.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
import scipy.linalg
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from siq.data.recordings import SnapshotPairs
from siq.dynamics.diffusion import Diffusion
from siq.errors import NumericalFailure
from siq.identify.flow_regression import (
    FlowRegression,
    copies,
    fit_everything,
    fit_support,
    positive,
)
from siq.identify.identified_field import NOISE_FREE, IdentifiedField
from siq.identify.library import CandidateLibrary
from siq.identify.rival_terms import rivals_by_equation
from siq.identify.selection import (
    Equation,
    best_support,
    critical_values,
    weakest_term,
)
from siq.identify.stability import blocks_of, stability, triangles


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class IdentificationOptions:
    """In which functions the vector field is sought, and what makes a term significant.

    Attributes
    ----------
    degree
        Highest degree of the monomials.
    functions
        Further functions of the states, as formulas: roots, fractions and whatever else.
    false_terms
        Probability that noise alone brings any false term into f. Each candidate is judged by its own
        standard error, at its share of this probability, of which high degrees have less than low ones.
    precision
        A term that contributes less than this share of f is dropped also from data without noise, whose
        residuals are the integrator's error and not random.
    pairs
        Most pairs used where the data carry no noise; with noise all are.
    hidden_velocities
        Whether the recorded states are positions whose velocities were not recorded. These are states then,
        too, called ``v_x`` for a position x, and f says how forces change them.
    """

    degree: Annotated[int, Field(ge=1, le=12)] = 5
    functions: tuple[str, ...] = ()
    false_terms: Annotated[float, Field(gt=0, lt=0.5)] = 0.02
    precision: Annotated[float, Field(gt=0, lt=0.1)] = 1e-7
    pairs: Annotated[int, Field(ge=100)] = 8_000
    hidden_velocities: bool = False


def identify_vector_field(
    library: CandidateLibrary,
    pairs: SnapshotPairs,
    *,
    options: IdentificationOptions,
    diffusion: Diffusion | None = None,
    integrator_step: float | None = None,
) -> IdentifiedField:
    """Find f from pairs.

    Parameters
    ----------
    library
        The candidate functions.
    pairs
        X0, Xh and h.
    options
        What makes a term significant.
    diffusion
        D, by default the unit matrix; f does not depend on it.
    integrator_step
        Step of the Euler–Maruyama simulation that made the pairs, None for everything else. Then the
        increment of each step is h f exactly, and f is that of the continuous process.

    Raises
    ------
    NumericalFailure
        When there are fewer pairs than functions, or a function is not finite on them.

    Notes
    -----
    The residuals of noisy pairs are independent, so that the standard errors fall with the number of
    pairs. Those of noise-free pairs are the error of integrators, the same in neighbouring pairs: their
    standard errors are given without that gain, as a bound.
    """
    if not carries_noise(library, pairs, options=options, integrator_step=integrator_step):
        pairs = pairs.take(evenly(len(pairs.h), options.pairs))
    noise = Diffusion.identity(library.dimension) if diffusion is None else diffusion
    return _identify(library, pairs, options, noise, integrator_step)


def carries_noise(
    library: CandidateLibrary,
    pairs: SnapshotPairs,
    *,
    options: IdentificationOptions,
    integrator_step: float | None = None,
) -> bool:
    """Whether pairs are more than an integrator's error away from any f in the library.

    The arguments are those of `identify_vector_field`.
    """
    _check_count(library, pairs)
    some = pairs.take(evenly(len(pairs.h), max(options.pairs // 4, 4 * library.size)))
    return fit_everything(library, some, integrator_step=integrator_step).ratio >= NOISE_FREE


def evenly(count: int, most: int) -> np.ndarray:
    """At most so many of `count` rows, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))


def _identify(
    library: CandidateLibrary,
    pairs: SnapshotPairs,
    options: IdentificationOptions,
    diffusion: Diffusion,
    integrator_step: float | None,
) -> IdentifiedField:
    _check_count(library, pairs)
    q, d, n = library.size, library.dimension, len(pairs.h)
    dense = fit_everything(library, pairs, integrator_step=integrator_step)
    triangle, noise_free = dense.triangle, dense.ratio < NOISE_FREE
    repeated = 1.0 if noise_free else copies(pairs)
    critical = critical_values(library, false_terms=options.false_terms)
    equations = [Equation.of_triangle(triangle, i, samples=n / repeated, critical=critical) for i in range(d)]
    chosen, coefficients = [], np.zeros((q, d))
    for i, equation in enumerate(equations):
        kept = _contributing(triangle, q, i, options.precision) if noise_free else best_support(equation)
        chosen += [(i, k) for k in kept]
        coefficients[:, i] = equation.fitted(kept)
    if len({i for i, _ in chosen}) < d:
        missing = next(i for i in range(d) if i not in {j for j, _ in chosen})
        raise NumericalFailure(
            f"no term of the equation of {library.states[missing]} is significant; record longer"
        )
    support = np.array(chosen)
    found = IdentifiedField(
        library, coefficients, support, np.eye(len(support)), dense.rate, dense.ratio, dense.flow, diffusion
    )
    problem = FlowRegression(library, pairs, support)
    found = fit_support(found, problem)
    # With the final support and flow a term may turn out to be superfluous after all.
    while (weak := _weakest(found, problem, options, critical)) is not None:
        support = np.delete(found.support, weak, axis=0)
        left = [support[support[:, 0] == i, 1].tolist() for i in range(d)]
        coefficients = np.column_stack(
            [equation.fitted(own) for equation, own in zip(equations, left, strict=True)]
        )
        problem = FlowRegression(library, pairs, support)
        found = fit_support(replace(found, coefficients=coefficients, support=support), problem)
    return found if noise_free else replace(found, rivals=rivals_by_equation(equations, found.support))


def with_stability(
    found: IdentifiedField,
    pairs: SnapshotPairs,
    *,
    options: IdentificationOptions,
    generator: np.random.Generator,
) -> IdentifiedField:
    """The same field, with the share of resampled recordings in which each of its terms is chosen.

    Parameters
    ----------
    found
        f from noisy pairs.
    pairs
        Those that it was fitted to.
    options
        What makes a term significant.
    generator
        Draws the recordings.
    """
    library = found.library
    q, d = library.size, library.dimension
    everything = np.array([(i, k) for i in range(d) for k in range(q)])
    problem = FlowRegression(library, pairs, everything)
    velocity = problem.corrected(found.coefficients.T.ravel(), found.flow, found.noise_rate)
    weight = np.sqrt(pairs.h)[:, None]
    order = np.argsort(pairs.recording, kind="stable")
    rows = (problem.theta.T * weight)[order], (velocity * weight)[order]
    parts = triangles(*rows, blocks_of(pairs.recording[order]))
    critical = critical_values(library, false_terms=options.false_terms)
    samples = len(pairs.h) / copies(pairs)

    def equations(triangle: np.ndarray) -> list[Equation]:
        return [Equation.of_triangle(triangle, i, samples=samples, critical=critical) for i in range(d)]

    chosen = [found.support[found.support[:, 0] == i, 1].tolist() for i in range(d)]
    shares = stability(parts, equations, chosen, generator=generator)
    result = np.empty(len(found.support))
    for i, share in enumerate(shares):
        result[found.support[:, 0] == i] = share
    return replace(found, stability=result)


def _check_count(library: CandidateLibrary, pairs: SnapshotPairs) -> None:
    if len(pairs.h) < 2 * library.size:
        raise NumericalFailure(
            f"only {len(pairs.h)} pairs for {library.size} candidate functions of f;"
            " lower identification.degree or record more"
        )


def _contributing(triangle: np.ndarray, q: int, component: int, precision: float) -> tuple[int, ...]:
    """Backward elimination of one equation without noise: the least contribution leaves, until all count."""
    goal = triangle[:, q + component]
    size = np.linalg.norm(goal)
    active = np.arange(q)
    while len(active):
        orthogonal, upper = np.linalg.qr(triangle[:, active])
        coefficients = scipy.linalg.solve_triangular(upper, orthogonal.T @ goal)
        contribution = np.abs(coefficients) * np.linalg.norm(triangle[:, active], axis=0) / (size or 1.0)
        weakest = int(np.argmin(contribution))
        if contribution[weakest] >= precision:
            break
        active = np.delete(active, weakest)
    return tuple(active.tolist())


def _weakest(
    found: IdentifiedField, problem: FlowRegression, options: IdentificationOptions, critical: np.ndarray
) -> int | None:
    """The least significant term, if it is not significant, and not the last of its equation."""
    if found.noise_free:
        terms = np.sqrt(problem.theta**2 @ problem.h)[problem.position]
        sizes = np.sqrt(problem.h @ problem.predicted(found.values) ** 2)
        strength = np.abs(found.values) * terms / positive(sizes)[found.support[:, 0]] / options.precision
    else:
        standing = np.abs(found.values) / np.sqrt(np.diag(found.covariance))
        strength = standing / critical[found.support[:, 1]]
    return weakest_term(strength, found.support)
