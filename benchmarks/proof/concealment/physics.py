"""Physics: what a system is here, whatever it describes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from benchmarks.proof.concealment.experiments import Experiment

Values = Mapping[str, Any]  # numbers, or arrays where a parameter depends on time or state


@dataclass(frozen=True)
class PhysicalSystem:
    """A system: its card, its equations, and its experiments.

    Attributes
    ----------
    card
        The system card as it is written to YAML, with the parameters' nominal values.
    equations
        Maps states ``(states, ...)``, inputs ``(inputs, ...)`` and parameters to the time derivatives.
    experiment
        Draws initial states and inputs.
    rate
        Angular frequency of its motion, or rate of its relaxation.
    sizes
        How large each state typically is.
    """

    card: Mapping[str, Any]
    equations: Callable[[np.ndarray, np.ndarray, Values], Sequence[np.ndarray]]
    experiment: Callable[[np.random.Generator], Experiment]
    rate: float
    sizes: Mapping[str, float]

    @cached_property
    def states(self) -> tuple[str, ...]:
        """Names of the states, in order."""
        return tuple(self.card["states"])

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs, in order."""
        return tuple(self.card.get("inputs", ()))

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        """Names of what a recording measures: in all five systems states as they are."""
        return tuple(self.card.get("outputs", self.card["states"]))

    @cached_property
    def held(self) -> bool:
        """Whether inputs keep their value until the next sample; else they go there in a straight line."""
        return any(entry["interpolation"] == "zero_order" for entry in self.card.get("inputs", {}).values())

    def nominal(self) -> dict[str, float]:
        """Nominal values of all parameters."""
        return {name: entry["value"] for name, entry in self.card["parameters"].items()}

    def free(self) -> tuple[str, ...]:
        """Names of the parameters that a recalibration may change."""
        return tuple(name for name, entry in self.card["parameters"].items() if not entry.get("fixed"))

    @cached_property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest states of a motion that counts as bounded, two columns ``(states, 1)``."""
        low, high = np.array([entry["domain"] for entry in self.card["states"].values()], dtype=float).T
        # Populations stay positive; everything else may leave its domain, but not go far.
        floor = np.where(low == 0, 0.0, low - (high - low))
        return floor[:, None], (high + (high - low))[:, None]
