"""What do the routes to V make of their starts, and which of their formulas carry the certificate?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from siq.certificate.caustics import caustic_notes
from siq.certificate.certificates import Certificate
from siq.certificate.tests import Function
from siq.potential.refined_formulas import refined_decomposition, relative_error_of
from siq.potential.refinement import Refined, RefinementOptions, formula_library, refine
from siq.potential.symbolic import SymbolicDecomposition, term_coefficients
from siq.steps.ground import Ground


def refine_and_certify(
    ground: Ground, regressed: SymbolicDecomposition | None
) -> tuple[SymbolicDecomposition, Certificate, tuple[str, ...]]:
    """Refined formulas of a run with their certificate, and what could not be done."""
    library = formula_library(ground.found, ground.options)
    formula = None
    if regressed is not None and regressed.potential is not None:
        named = term_coefficients(regressed.potential)
        formula = np.array([named.get(name, 0.0) for name in library.names])
    network = None if ground.networks is None else ground.network
    refined, formulas, certificate = refined_by_routes(ground, ground.options, network, formula)
    caustics = caustic_notes(refined, ground.portrait, certificate.error, seed=ground.number)
    return formulas, certificate, (*refined.notes, *caustics)


def refined_by_routes(
    ground: Ground, options: RefinementOptions, network: Function | None, formula: np.ndarray | None
) -> tuple[Refined, SymbolicDecomposition, Certificate]:
    """What the routes make of their starts, with its certificate."""
    compared = options.routes is not None and len(options.routes) == 2
    refined = refine(
        ground.found, ground.portrait, library=formula_library(ground.found, options), formula=formula,
        network=network, points=ground.points, options=options, seed=ground.number,
    )  # fmt: skip
    formulas = refined_decomposition(refined, ground.points)
    if formulas.potential is None:
        return refined, formulas, ground.certify_wells(refined, compared=compared)
    error = relative_error_of(refined, ground.points)
    certificate = ground.certify(
        formulas, wells=refined.wells, relative_error=error, compared=compared
    )  # fmt: skip
    if certificate.certified or not refined.wells:
        return refined, formulas, certificate
    # One formula for all wells is an extra. What refuses it is no word against the wells.
    alone = replace(
        refined, potential=None, circulatory=None, potential_covariance=None, circulatory_errors=None,
        joint=False, notes=(*refined.notes, f"no single formula holds over the wells: {certificate.reason}"),
    )  # fmt: skip
    of_wells = ground.certify_wells(alone, compared=compared)
    if not of_wells.certified:
        return refined, formulas, certificate
    return alone, refined_decomposition(alone, ground.points), of_wells
