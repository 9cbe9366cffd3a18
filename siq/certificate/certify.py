"""Which tests has one formula for the whole region to pass, and on which points?

`siq.certificate.tests` has the tests themselves; one formula for each attractor is certified by
`siq.certificate.certify_wells`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from siq.certificate.certificates import Certificate
from siq.certificate.characteristics import Reference
from siq.certificate.common_tests import (
    ALONE,
    common_tests,
    concluded,
    error_of_well,
    explained_difference,
    sublevel_points,
)
from siq.certificate.existence import check_existence
from siq.certificate.held_out import HeldOut
from siq.certificate.tests import (
    STATED,
    Candidate,
    CertificateOptions,
    Verdict,
    check_agreement,
    check_error,
    check_identity,
    stated_error,
)
from siq.dynamics.formulas import compile_formulas
from siq.dynamics.phase_portrait import PhasePortrait
from siq.identify.identified_field import IdentifiedField
from siq.potential.symbolic import SymbolicDecomposition
from siq.potential.well import Well


def certify_formulas(
    formulas: SymbolicDecomposition,
    found: IdentifiedField,
    portrait: PhasePortrait,
    held_out: HeldOut,
    *,
    options: CertificateOptions,
    prediction: Verdict,
    references: Sequence[Reference],
    relative_error: float = 0.0,
    wells: Sequence[Well] = (),
    compared: bool = False,
    seed: int = 0,
) -> Certificate:
    """Certificate of one formula for the whole region.

    Parameters
    ----------
    formulas
        V and g.
    found, portrait
        F, identified without V, and the phase portrait that follows from it.
    held_out
        States and pairs of the region for which the formula claims to hold.
    options
        The limits.
    prediction
        The verdict on f.
    references
        V by characteristics about every attractor.
    relative_error
        Relative standard error of V from the uncertainty of f.
    wells
        By the local route, to be compared with.
    compared
        Whether both routes were asked for: then a formula that only one of them found is refused.
    seed
        Draws of f, and the points on which the error is estimated.
    """
    candidate = _of_formulas(formulas, held_out.points, portrait, relative_error)
    return _certify(
        candidate, found, portrait, held_out, options=options, prediction=prediction,
        references=references, wells=wells, compared=compared, seed=seed,
    )  # fmt: skip


def _certify(
    candidate: Candidate,
    found: IdentifiedField,
    portrait: PhasePortrait,
    held_out: HeldOut,
    *,
    options: CertificateOptions,
    prediction: Verdict,
    references: Sequence[Reference],
    wells: Sequence[Well],
    compared: bool,
    seed: int,
) -> Certificate:
    error, _ = stated_error(candidate, found, seed=seed)
    tests, error = common_tests(candidate, found, held_out, references, options, error, np.inf, seed)
    tests["identity"] = check_identity(candidate, found, limit=options.identity)
    from_field = STATED * candidate.relative_error
    tests["error"] = check_error(error - from_field, limit=options.error, from_field=from_field)
    if portrait.attractors:
        tests["existence"] = check_existence(found, portrait, seed=seed)
    if wells:
        # The local route shares the error of f, and has the rest of its own.
        own = [error_of_well(well, found, portrait, seed) for well in wells]
        tests["agreement"] = check_agreement(
            candidate.values, wells, sublevel_points(wells),
            limit=explained_difference(options, error, max(own)) + 6 * candidate.relative_error,
        )  # fmt: skip
    elif compared:
        tests["agreement"] = Verdict(np.inf, 0.0, False, ALONE)
    tests["prediction"] = prediction
    return concluded(tests, error, portrait, "region", held_out.described)


def _of_formulas(
    formulas: SymbolicDecomposition, points: np.ndarray, portrait: PhasePortrait, relative_error: float
) -> Candidate:
    symbols, d = formulas.symbols, len(formulas.symbols)
    second = [slope.diff(symbol) for slope in formulas.gradient for symbol in symbols]
    hessian = compile_formulas(second, symbols)
    together, gradient = formulas.evaluate, formulas.evaluate_gradient
    return Candidate(
        values=lambda x: together(np.ascontiguousarray(x.T))[0],
        gradients=lambda x: gradient(np.ascontiguousarray(x.T)).T,
        hessians=lambda x: hessian(np.ascontiguousarray(x.T)).T.reshape(-1, d, d),
        circulatory=lambda x: together(np.ascontiguousarray(x.T))[1 : d + 1].T,
        points=points,
        attractors=portrait.attractors,
        relative_error=relative_error,
    )
