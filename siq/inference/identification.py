"""Identification of the vector field by sparse regression, and the file of it.

All functions of a library are fitted first (`siq.inference.flow_regression`). Terms are dropped by their own
uncertainty, and under noise exchanged as long as that helps (`siq.inference.selection`). What remains is
fitted by generalised least squares with the covariance that the residuals show, which attains the Cramér–Rao
bound.

Not to be confused with the f of `siq.networks.regression`, which is that of the networks: here no network
takes part, and V and g are not known yet. That makes it the yardstick of the certificate.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import scipy.linalg
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as pydantic_dataclass

from siq.data.recordings import SnapshotPairs
from siq.errors import InputError, NumericalFailure
from siq.inference.field_estimate import NOISE_FREE, DiffusionSource, FlowMap, IdentifiedField, NoiseFormula
from siq.inference.flow_regression import FlowRegression, copies, fit_everything, fit_support, positive
from siq.inference.library import CandidateLibrary, candidate_library
from siq.inference.selection import (
    Equation,
    RivalTerms,
    best_support,
    blocks_of,
    critical_values,
    rivals_by_equation,
    stability,
    triangles,
    weakest_term,
)
from siq.numerics.files import whole_file
from siq.systems.diffusion import Diffusion


@pydantic_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
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


@dataclass(frozen=True)
class FieldRecord:
    """What is kept of an identification.

    Attributes
    ----------
    found
        The field.
    prediction
        The certificate's test of it, see `siq.quasipotential.certificate_tests.Verdict.as_data`.
    noise
        Kind, intensity and correlations of the residuals, see `siq.inference.residuals.NoiseDiagnosis`; and
        where D is from. Of recordings that remember also `lag`, in steps, and `lost_time`, see
        `siq.inference.instrumental_variables`.
    """

    found: IdentifiedField
    prediction: Mapping[str, Any]
    noise: Mapping[str, Any]

    @property
    def diffusion_source(self) -> DiffusionSource:
        """Where D is from."""
        return DiffusionSource(self.noise.get("diffusion", DiffusionSource.GIVEN))

    @property
    def memory(self) -> tuple[int, float] | None:
        """The lag from which on the recordings are Markovian, and the time lost; None of those that are."""
        lag = self.noise.get("lag")
        return None if lag is None else (int(lag), float(self.noise.get("lost_time", 0.0)))

    @property
    def sensor_variance(self) -> np.ndarray | None:
        """Variance of each state's sensor noise, shape ``(d,)``; None where f was found without any."""
        deviations = np.array(self.noise.get("measurement", []), dtype=float)
        if self.noise.get("kind") not in ("process", "sensor") or not (deviations > 0).any():
            return None
        return deviations**2

    @property
    def hidden_velocities(self) -> bool:
        """Whether half of the states are velocities that were not recorded."""
        return len(self.noise.get("measurement", ())) * 2 == self.found.library.dimension

    @property
    def exposure(self) -> float | None:
        """The step over which each sample was taken as a mean; None where as the state itself."""
        given = self.noise.get("exposure")
        return None if given is None else float(given)

    @property
    def noise_strength(self) -> tuple[float, float] | None:
        """ε and its standard error, None where the recordings show no white noise.

        The variance of n residuals of d states has the relative standard error ``√(2/nd)``. Beside sensor
        noise it is larger, and stands in the record.
        """
        intensity = float(self.noise.get("intensity", 0.0))
        if self.noise.get("kind") not in ("process", "sensor") or not intensity > 0:
            return None
        known = self.noise.get("intensity_error")
        if known is not None:
            return intensity, float(known)
        samples = int(self.noise.get("pairs", 0)) * self.found.library.dimension
        return intensity, intensity * (2 / samples) ** 0.5 if samples else 0.0


def field_library(states: Sequence[str], options: IdentificationOptions) -> CandidateLibrary:
    """The functions in which f is sought."""
    return candidate_library(states, degree=options.degree, further=options.functions)


def write_field(path: str | Path, record: FieldRecord, options: IdentificationOptions) -> None:
    """Write an identified field whole or not at all."""
    found = record.found
    data = {
        "states": list(found.library.states),
        "degree": options.degree,
        "functions": list(options.functions),
        "terms": [
            {
                "component": found.library.states[i],
                "term": found.library.names[k],
                "coefficient": float(found.coefficients[k, i]),
                "standard_error": float(found.standard_errors[k, i]),
                "stability": None if found.stability is None else float(found.stability[place]),
            }
            for place, (i, k) in enumerate(found.support)
        ],
        "covariance": found.covariance.tolist(),
        "rivals": None
        if found.rivals is None
        else {"mean_change": found.rivals.mean_change.tolist(), "spread": found.rivals.spread.tolist()},
        "noise_rate": found.noise_rate.tolist(),
        "residual_ratio": found.residual_ratio,
        "diffusion": found.diffusion.rows,
        "noise_formula": None if found.noise is None else found.noise.as_data(),
        "constant_noise": None if found.constant_noise is None else found.constant_noise.as_data(),
        "flow": {"steps": found.flow.steps, "euler": found.flow.euler},
        "noise": dict(record.noise),
        "prediction": dict(record.prediction),
    }
    with whole_file(path) as partial:
        partial.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _rivals(written: Mapping[str, Any] | None, library: CandidateLibrary) -> RivalTerms | None:
    if written is None:
        return None
    shape = (library.size, library.dimension)
    return RivalTerms(
        np.array(written["mean_change"]).reshape(shape), np.array(written["spread"]).reshape(-1, *shape)
    )


def _noise(written: Any, library: CandidateLibrary) -> NoiseFormula | None:
    return None if written is None else NoiseFormula.from_data(written, library.symbols)


def _stability(terms: Sequence[Mapping[str, Any]]) -> np.ndarray | None:
    shares = [row.get("stability") for row in terms]
    return None if None in shares else np.array(shares, dtype=float)


def read_field(path: str | Path) -> FieldRecord | None:
    """Read what `write_field` wrote; None where the file is empty since nothing was identified.

    Raises
    ------
    InputError
        When the file is no such record.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        if not text:
            return None
        data = json.loads(text)
        options = IdentificationOptions(degree=data["degree"], functions=tuple(data["functions"]))
        library = field_library(data["states"], options)
        component = {name: index for index, name in enumerate(library.states)}
        term = {name: index for index, name in enumerate(library.names)}
        support = np.array([[component[row["component"]], term[row["term"]]] for row in data["terms"]])
        coefficients = np.zeros((library.size, library.dimension))
        for (i, k), row in zip(support, data["terms"], strict=True):
            coefficients[k, i] = row["coefficient"]
        found = IdentifiedField(
            library, coefficients, support, np.array(data["covariance"]), np.array(data["noise_rate"]),
            float(data["residual_ratio"]), FlowMap(**data["flow"]),
            Diffusion.of_rows(library.symbols, data["diffusion"]),
            rivals=_rivals(data.get("rivals"), library), stability=_stability(data["terms"]),
            noise=_noise(data.get("noise_formula"), library),  # older files have neither
            constant_noise=_noise(data.get("constant_noise"), library),
        )  # fmt: skip
        p, d = len(support), library.dimension
        if found.covariance.shape != (p, p) or found.noise_rate.shape != (d, d):
            raise ValueError("covariances do not fit the terms")
        if found.diffusion.dimension != d:
            raise ValueError("D does not fit the states")
        return FieldRecord(found, data["prediction"], data["noise"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            path, "", f"it is no vector field ({type(error).__name__})", "make it again"
        ) from None
