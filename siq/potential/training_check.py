"""The check that ends a training: whether refinement would succeed from these networks.

It does, in small, what will be done in earnest afterwards: V_θ is written in powers, refined on the
Hamilton–Jacobi equation of the identified f, and compared with the local route, which needs no network.
Whatever passes was thereby selected for agreement: that of a certificate is a test of consistency alone.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from siq.dynamics.phase_portrait import PhasePortrait, evenly_spread, phase_portrait
from siq.errors import NumericalFailure
from siq.identify.identified_field import IdentifiedField
from siq.identify.library import CandidateLibrary, joint_library
from siq.networks.options import CheckOptions
from siq.networks.trained import TrainedNetworks
from siq.potential.bases import potential_basis
from siq.potential.global_route import fit_values, refine_globally
from siq.potential.local_route import fit_well
from siq.potential.refinement import RefinementOptions, local_wells, over_library
from siq.potential.well import Well

Function = Callable[[np.ndarray], np.ndarray]

logger = logging.getLogger(__name__)

WELL_STEPS = 15  # of Gauss–Newton: what does not converge quickly is not ready
DEGREES = (
    4,
    6,
    8,
)  # of the wells with which networks are compared, to some per cent
SHARE = 0.75  # of the recorded points, the lowest in V, on which one formula is tried


@dataclass(frozen=True)
class TrainingCheck:
    """What the check of one run knows beforehand.

    Attributes
    ----------
    found
        The identified f.
    portrait
        Attractors and basins.
    wells
        V about each attractor by the local route, to be compared with.
    library
        Powers for V, with the functions of f.
    options
        When the check passes.
    """

    found: IdentifiedField
    portrait: PhasePortrait
    wells: tuple[Well, ...]
    library: CandidateLibrary
    options: CheckOptions

    def hopeless(self) -> str | None:
        """Why no training can pass, in words; None where one can."""
        fault = self.portrait.fault()
        if fault is None and len(self.wells) < len(self.portrait.attractors):
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
        points = self.portrait.points
        values = potential(points)
        below = values <= np.quantile(values, SHARE)
        start = fit_values(self.library, points[below], values[below])
        result = refine_globally(start, self.library, self.found, points[below], sparse=False)
        basis = potential_basis(self.library)
        coefficients = result.coefficients[basis.chosen]
        worst = max(self._difference(well, lambda x: basis.values(x) @ coefficients) for well in self.wells)
        logger.info("check of one formula: residual %.1e, difference %.1e", result.residual, worst)
        return result.residual < self.options.residual / 10 and worst < self.options.difference

    def _by_wells(self, potential: Function) -> bool:
        for index, (one, local) in enumerate(zip(self.portrait.attractors, self.wells, strict=True)):
            try:
                well = fit_well(
                    self.found.dynamics, one, self.portrait.basins[index], self.portrait.saddles[index],
                    potential, degree=local.degree,
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
    found: IdentifiedField, x: np.ndarray, *, options: CheckOptions, seed: int
) -> TrainingCheck:
    """Prepare the check of one run from its identified f and recorded states ``(n, d)``."""
    points = x[evenly_spread(x, generator=np.random.default_rng(seed))]
    setting = phase_portrait(found.dynamics, points, seed=seed)
    wells, _ = local_wells(found, setting, options=RefinementOptions(degrees=DEGREES), seed=seed)
    library = joint_library(found.library, degree=options.degree, potential_degree=options.degree)
    return TrainingCheck(over_library(found, library), setting, wells, library, options)
