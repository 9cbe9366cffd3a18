"""What mechanisms leave of the excess over noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.estimation.fit import Fit
from siq.estimation.innovations import Noise
from siq.estimation.measurements import Measurements
from siq.mismatch.roles import Roles, roles_of
from siq.mismatch.structure import Structure, structure_of

STRUCTURED = 1e-4  # probability below which residuals are not called random
DOUBTFUL = 2e-3  # the same for what a mechanism leaves: the burden of proof is on a name
LEFT = 0.01  # probability that residuals are random, above which no further mechanism is sought


@dataclass(frozen=True)
class Remainder:
    """What a simulation leaves.

    Attributes
    ----------
    before, after
        Structure of what the recalibrated simulation, and the one with mechanisms, does not explain.
    share
        Of the excess that the mechanisms explain.
    """

    before: Structure
    after: Structure
    share: float

    @property
    def structured(self) -> bool:
        """Whether what is left is certainly no noise, which speaks of a mismatch by itself."""
        return self.after.p_value < STRUCTURED

    @property
    def doubtful(self) -> bool:
        """Whether what is left is hardly noise: a name has to leave less than that."""
        return self.after.p_value < DOUBTFUL


def what_is_left(
    model: Dynamics, data: Measurements, recalibrated: Fit, final: Fit, roles: Roles
) -> Remainder:
    """Structure before and after mechanisms were added, and the share of the excess that they explain.

    Parameters
    ----------
    model, data
        The simulation as its author believes it, and the recordings.
    recalibrated, final
        Its fit, and that with mechanisms.
    roles
        Of the simulation's states.
    """
    after = structure_of(final.model, data, final, roles)
    # Random forces that stand for missing physics take measurement noise with them; the final fit's is right.
    still = Noise(final.noise.measurement, np.zeros(model.dimension))
    before = structure_of(model, data, recalibrated, roles, noise=still)
    alone = after
    if final.has_process_noise:
        alone = structure_of(final.model, data, final, roles, noise=final.noise.without_process())
    return Remainder(before, after, explained_share(before, alone))


def explained_share(before: Structure, after: Structure) -> float:
    """Share of the excess over measurement noise that the final simulation explains, without process noise.

    What is left is the excess that remains, or what a function of one coordinate still finds: where a fit
    without process noise takes a misfit for noise, only the latter shows it.
    """
    if not before.total > before.freedom:
        return 1.0
    best = after.curves[0] if after.curves else None
    systematic = 0.0 if best is None else best.gain - 2 * len(best.direction.knots)
    left = max(after.total - after.freedom, systematic, 0.0)
    return float(np.clip(1 - left / (before.total - before.freedom), 0.0, 1.0))


def something_left(current: Fit, data: Measurements) -> bool:
    """Whether it is worth looking for something on top of a fit."""
    model = current.model
    if current.has_process_noise:
        return True
    try:
        return structure_of(model, data, current, roles_of(model)).p_value < LEFT
    except NumericalFailure:  # a simulation that runs away lacks something, whatever it is
        return True
