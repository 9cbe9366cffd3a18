"""The page that sets every table, figure and number of a publication beside ours, and official tests."""

from __future__ import annotations

from pydantic.dataclasses import dataclass

from siq.networks.decomposition import TrainingOptions
from siq.networks.regression import RegressionOptions
from siq.systems.simulation import SimulationOptions
from siq.workflow.study import STRICT


@dataclass(frozen=True, config=STRICT)
class ReproductionSettings:
    """The parameters of a study that those of the publication are set beside."""

    runs: int
    simulation: SimulationOptions | None
    training: TrainingOptions | None
    regression: RegressionOptions
    domain: tuple[tuple[float, float], ...] | None
