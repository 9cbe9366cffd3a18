"""The check that ends a training: whether refinement would succeed from these networks.

It does, in small, what will be done in earnest afterwards: V_θ is written in powers, refined on the
Hamilton–Jacobi equation of the identified f, and compared with the local route, which needs no network.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from siq.bases import potential_basis
from siq.decomposition.options import CheckOptions
from siq.decomposition.trained import TrainedNetworks
from siq.errors import NumericalFailure
from siq.global_route import fit_values, refine_globally
from siq.identification import IdentifiedField
from siq.library import CandidateLibrary, joint_library
from siq.local_route import Well, fit_well
from siq.outline import Outline, evenly_spread, outline
from siq.refinement import RefinementOptions, local_wells, over_library

Function = Callable[[np.ndarray], np.ndarray]

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
    wells
        V about each attractor by the local route, to be compared with.
    library
        Powers for V, with the functions of f.
    diffusion
        D.
    options
        When the check passes.
    """

    found: IdentifiedField
    outline: Outline
    wells: tuple[Well, ...]
    library: CandidateLibrary
    diffusion: np.ndarray
    options: CheckOptions

    def hopeless(self) -> str | None:
        """Why no training can pass, in words; None where one can."""
        fault = self.outline.fault()
        if fault is None and len(self.wells) < len(self.outline.attractors):
            fault = "the local route found no formula about some attractor"
        return fault

    def passes(self, networks: TrainedNetworks) -> bool:
        """Whether refinement will succeed from the networks of one run."""
        if self.hopeless() is not None:
            return False

        def potential(x: np.ndarray) -> np.ndarray:
            return networks.evaluate(x).potential

        return self._single_formula(potential) or self._by_wells(potential)

    def _single_formula(self, potential: Function) -> bool:
        points = self.outline.points
        values = potential(points)
        below = values <= np.quantile(values, SHARE)
        start = fit_values(self.library, points[below], values[below])
        result = refine_globally(
            start, self.library, self.found, points[below], diffusion=self.diffusion, sparse=False
        )
        basis = potential_basis(self.library)
        coefficients = result.coefficients[basis.chosen]
        worst = max(self._difference(well, lambda x: basis.values(x) @ coefficients) for well in self.wells)
        logger.info("check of one formula: residual %.1e, difference %.1e", result.residual, worst)
        return result.residual < self.options.residual / 10 and worst < self.options.difference

    def _by_wells(self, potential: Function) -> bool:
        for index, (one, local) in enumerate(zip(self.outline.attractors, self.wells, strict=True)):
            degree = int(local.basis.exponents.sum(axis=1).max())
            try:
                well = fit_well(
                    self.found.field, one, self.outline.regions[index], self.outline.saddles[index],
                    potential, diffusion=self.diffusion, degree=degree,
                    generator=np.random.default_rng(0), steps=WELL_STEPS,
                )  # fmt: skip
            except NumericalFailure:
                return False
            difference = self._difference(local, well.values)
            logger.info("check of a well: residual %.1e, difference %.1e", well.residual, difference)
            allowed = self.options.difference + 2 * (local.residual + well.residual)
            if well.residual > self.options.residual or difference > allowed:
                return False
        return True

    def _difference(self, well: Well, values: Function) -> float:
        """Relative difference of V from that of the local route, in a well."""
        x = well.points[well.values(well.points) < 0.9 * well.level]
        other = values(x) - values(well.attractor[None])
        return float(np.linalg.norm(other - well.values(x)) / np.linalg.norm(well.values(x)))


def training_check(
    found: IdentifiedField, x: np.ndarray, *, diffusion: np.ndarray, options: CheckOptions, seed: int
) -> TrainingCheck:
    """Prepare the check of one run from its identified f and recorded states ``(n, d)``."""
    points = x[evenly_spread(x, generator=np.random.default_rng(seed))]
    setting = outline(found.field, points, diffusion=diffusion, seed=seed)
    wells, _ = local_wells(found, setting, diffusion=diffusion, options=RefinementOptions(), seed=seed)
    library = joint_library(found.library, degree=options.degree, potential_degree=options.degree)
    return TrainingCheck(over_library(found, library), setting, wells, library, diffusion, options)
