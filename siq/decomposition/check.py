"""The check that ends a training: whether refinement would succeed from these networks.

It does, in small, what will be done in earnest afterwards: V_θ is written in powers, refined on the
Hamilton–Jacobi equation of the identified f, and held against the curvature that f demands at the attractors.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from siq.bases import affordable_degree, potential_basis
from siq.decomposition.networks import Networks, evaluate_points
from siq.decomposition.options import CheckOptions
from siq.equilibria import hessian_at
from siq.errors import NumericalFailure
from siq.global_route import fit_values, refine_globally
from siq.identification import IdentifiedField
from siq.library import CandidateLibrary, joint_library
from siq.local_route import fit_well
from siq.outline import Outline, evenly_spread, outline
from siq.refinement import over_library

logger = logging.getLogger(__name__)

WELL_STEPS = 15  # of Gauss–Newton: what does not converge quickly is not ready
SHARE = 0.75  # of the recorded points, the lowest in V, on which one formula is tried


@dataclass(frozen=True)
class TrainingCheck:
    """What the check of one run knows beforehand.

    Attributes
    ----------
    found
        The identified f.
    outline
        Attractors and regions.
    library
        Powers for V, with the functions of f.
    diffusion
        D.
    options
        When the check passes.
    """

    found: IdentifiedField
    outline: Outline
    library: CandidateLibrary
    diffusion: np.ndarray
    options: CheckOptions

    def passes(self, networks: Networks) -> bool:
        """Whether refinement will succeed from the networks of one run."""
        if self.outline.fault() is not None:
            return False

        def potential(x: np.ndarray) -> np.ndarray:
            return evaluate_points(networks, x).potential

        return self._single_formula(potential) or self._by_wells(potential)

    def _single_formula(self, potential: Callable[[np.ndarray], np.ndarray]) -> bool:
        points = self.outline.points
        values = potential(points)
        below = values <= np.quantile(values, SHARE)
        start = fit_values(self.library, points[below], values[below])
        result = refine_globally(
            start, self.library, self.found, points[below], diffusion=self.diffusion, sparse=False
        )
        basis = potential_basis(self.library)
        worst = 0.0
        for one in self.outline.attractors:
            curvature = basis.hessians(one.position[None])[0] @ result.coefficients[basis.chosen]
            worst = max(worst, self._curvature_error(one.position, curvature))
        logger.info("check of one formula: residual %.1e, curvature %.1e", result.residual, worst)
        return result.residual < self.options.residual / 10 and worst < self.options.branch

    def _by_wells(self, potential: Callable[[np.ndarray], np.ndarray]) -> bool:
        for index, one in enumerate(self.outline.attractors):
            try:
                well = fit_well(
                    self.found.field, one, self.outline.regions[index], self.outline.saddles[index],
                    potential, diffusion=self.diffusion,
                    degree=affordable_degree(len(one.position), max(self.options.degree, 6)),
                    generator=np.random.default_rng(0), steps=WELL_STEPS,
                )  # fmt: skip
            except NumericalFailure:
                return False
            worst = self._curvature_error(one.position, well.hessians(one.position[None])[0])
            logger.info("check of a well: residual %.1e, curvature %.1e", well.residual, worst)
            if well.residual > self.options.residual or worst > self.options.branch:
                return False
        return True

    def _curvature_error(self, attractor: np.ndarray, curvature: np.ndarray) -> float:
        expected = hessian_at(self.found.field, attractor, diffusion=self.diffusion)
        root = np.linalg.inv(np.linalg.cholesky(expected))
        return float(np.abs(np.linalg.eigvalsh(root @ (curvature - expected) @ root.T)).max())


def training_check(
    found: IdentifiedField, x: np.ndarray, *, diffusion: np.ndarray, options: CheckOptions, seed: int
) -> TrainingCheck:
    """Prepare the check of one run from its identified f and recorded states ``(n, d)``."""
    points = x[evenly_spread(x, generator=np.random.default_rng(seed))]
    library = joint_library(found.library, degree=options.degree, potential_degree=options.degree)
    return TrainingCheck(
        over_library(found, library),
        outline(found.field, points, diffusion=diffusion, seed=seed),
        library, diffusion, options,
    )  # fmt: skip
