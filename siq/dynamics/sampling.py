"""Sampling: how is a system simulated where nobody says it? By its own rates, in whatever units it has.

The step of a pair follows from the fastest rate of the Jacobian over the card's domain, the length of a
trajectory from the slowest relaxation to an attractor.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated

import numpy as np
import sympy
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import find_equilibria
from siq.dynamics.formulas import compile_formulas
from siq.dynamics.simulation import SimulationOptions, sampling_stride

TRAJECTORIES = 1000  # enough for every state of a box in three dimensions, and simulated in seconds
STATES = 400  # of the domain, at which rates are asked for
TURNED = 0.1  # of a time constant in the step of a pair: the flow differs from f by so much, and is known
FASTEST = 0.9  # quantile of the rates: the corners of a domain are left at once
RELAXED = 3.0  # slowest time constants that a trajectory lasts: then 95 % of the way is done
MOST_STEPS = 100  # of a pair, between pairs: beyond, a slow system would cost minutes


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class SimulationEntry:
    """What a study says of its simulation; what it leaves out follows from the system, see `complete`.

    The fields are those of `siq.dynamics.simulation.SimulationOptions`.

    Attributes
    ----------
    trajectories
        How many trajectories are simulated.
    pairs
        Pairs along each trajectory.
    pair_step
        h, the time between the two states of a pair, in the card's unit of time; by default a tenth of the
        fastest time constant, rounded down.
    interval
        Time between the starts of pairs; by default such that a trajectory lasts three of the slowest time
        constants at an attractor.
    substeps
        Runge–Kutta steps within h; with noise, steps of Euler and Maruyama.
    noise_intensity
        ε of ``√ε D^(1/2) dW``. The paper's ε = 0.01 in section 3.1.1 is 0.02 here.
    """

    trajectories: Annotated[int, Field(ge=2)] = TRAJECTORIES
    pairs: Annotated[int, Field(ge=1)] = 50
    pair_step: Annotated[float, Field(gt=0)] | None = None
    interval: Annotated[float, Field(gt=0)] | None = None
    substeps: Annotated[int, Field(ge=1)] = 5
    noise_intensity: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0

    def options(self) -> SimulationOptions:
        """The same, once nothing is left out.

        Raises
        ------
        ValueError
            When something is left out, or the interval does not fit the step.
        """
        if self.pair_step is None or self.interval is None:
            raise ValueError("the step and the interval of the pairs are not known without the system")
        options = SimulationOptions(
            self.trajectories, self.pairs, self.pair_step, self.interval, self.substeps, self.noise_intensity
        )
        sampling_stride(options)
        return options


def complete(entry: SimulationEntry, dynamics: Dynamics) -> SimulationEntry:
    """What a study says, and what follows from the system where the study says nothing.

    Parameters
    ----------
    entry
        What the study says.
    dynamics
        What is simulated, from its domain.
    """
    if entry.pair_step is not None and entry.interval is not None:
        return entry
    fastest, slowest = rates(dynamics)
    step = entry.pair_step
    if step is None:
        step = round_down(TURNED / fastest)
        if entry.interval is not None:
            step = entry.interval / max(math.ceil(entry.interval / step), 2)
    interval = entry.interval
    if interval is None:
        steps = RELAXED / slowest / entry.pairs / step
        interval = step * round(min(max(steps, 2.0), float(MOST_STEPS)))
    return replace(entry, pair_step=step, interval=interval)


def rates(dynamics: Dynamics) -> tuple[float, float]:
    """The fastest rate over the domain, and the slowest relaxation to an attractor, per unit of time.

    Eigenvalues of the Jacobian, which no choice of the states' units can alter. Where there is no attractor
    the slow rates of the domain stand in for its relaxation.
    """
    low, high = dynamics.box.T
    x = np.random.default_rng(0).uniform(low, high, size=(STATES, dynamics.dimension))
    sizes = np.abs(np.linalg.eigvals(dynamics.jacobian(x))).max(axis=1)
    fastest = float(np.quantile(sizes, FASTEST)) or 1.0
    relaxing = [
        -float(one.eigenvalues.real.max()) for one in find_equilibria(dynamics, x) if one.kind == "attractor"
    ]
    slowest = min(relaxing, default=float(np.quantile(sizes, 1 - FASTEST)))
    return fastest, max(slowest, 1e-6 * fastest)


def fault_over_domain(dynamics: Dynamics) -> tuple[str, str] | None:
    """A state whose equation has no value somewhere in the domain, with what is wrong; None for none.

    States at random and the corners tell what overflows; a divisor that changes its sign between them is zero
    somewhere, though no state of a sample meets it.
    """
    low, high = dynamics.box.T
    x = np.random.default_rng(0).uniform(low, high, size=(STATES, dynamics.dimension))
    x = np.concatenate([x, low[None], high[None]])
    with np.errstate(all="ignore"):
        flow, slopes = dynamics.drift(x), dynamics.jacobian(x)
        for index, (name, formula) in enumerate(zip(dynamics.states, dynamics.formulas, strict=True)):
            bases = [one.base for one in formula.atoms(sympy.Pow) if one.exp.is_negative]
            divisors = compile_formulas(bases, dynamics.symbols)(np.ascontiguousarray(x.T))
            if any(values.min() <= 0 <= values.max() for values in divisors):
                return name, "divides by zero within the domain"
            if not (np.isfinite(flow[:, index]).all() and np.isfinite(slopes[:, index]).all()):
                return name, "is too large for a number, or not defined, in a part of the domain"
    return None


def round_down(value: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above a value: numbers that people read."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(f"{max(one for one in (1, 2, 5) if one * power <= value * (1 + 1e-9)) * power:.1g}")
