"""What the figures and pages of a study depend on."""

from __future__ import annotations

from pydantic.dataclasses import dataclass

from siq.networks.regression import RegressionOptions
from siq.quasipotential.landscape import LandscapeOptions
from siq.systems.simulation import SimulationOptions
from siq.workflow.settings import STRICT, Sampling, StateSpace
from siq.workflow.study import Study


@dataclass(frozen=True, config=STRICT)
class FiguresSettings:
    """Of the figures; `simulation` is None of recordings."""

    seed: int
    space: StateSpace
    sampling: Sampling
    simulation: SimulationOptions | None
    regression: RegressionOptions


@dataclass(frozen=True, config=STRICT)
class LandscapeFiguresSettings:
    """Of the figures of a landscape."""

    space: StateSpace
    landscape: LandscapeOptions


@dataclass(frozen=True, config=STRICT)
class PageSettings:
    """Of the page: the whole study, which it prints."""

    study: Study
