"""One step of a fit: where do parameters and states go, and how far is the linearisation to be believed?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from siq.dynamics.dynamics import Dynamics
from siq.estimation.budget import Budget, evaluation
from siq.estimation.closure import ClosedFunctions
from siq.estimation.innovations import RANK, Noise, process_covariance, solve, with_parameters_changed
from siq.estimation.kernels import smoothed_states, whitened_innovations
from siq.estimation.linearisation import Grid, Linearisation, linearise
from siq.estimation.measurements import Measurements

SMALLEST_STEP = 1 / 64
INEXACT = 1e-4  # numerical: of effects carried along whole trajectories, where f may jump, the rest is error
NONLINEAR = 0.5  # share of a step's effect that may be unforeseen before the step is shortened
HARMLESS = 0.1  # of a filter's own corrections: what is unforeseen below that is corrected as they are


@dataclass(frozen=True)
class Iterate:
    """Where a fit stands.

    Attributes
    ----------
    values
        All parameters, shape ``(p,)``.
    x
        The states at which f is taken, shape ``(n, d)``.
    along
        The linearisation there.
    smoothed
        The states given all measurements, shape ``(n, d)``.
    spread
        Covariance of what a filter knows at each sample, shape ``(n, d, d)``; None where nothing drives the
        states.
    """

    values: np.ndarray
    x: np.ndarray
    along: Linearisation
    smoothed: np.ndarray
    spread: np.ndarray | None = None


@dataclass(frozen=True)
class StateChanges:
    """Most probable changes of all states, given those of the parameters.

    Attributes
    ----------
    smoothed, filtered
        By all measurements, and by those until then, shape ``(n, d)`` each.
    spread
        Covariance of what is filtered, shape ``(n, d, d)``.
    """

    smoothed: np.ndarray
    filtered: np.ndarray
    spread: np.ndarray


@dataclass(frozen=True)
class Shooting:
    """What is fitted.

    Attributes
    ----------
    model, grid
        The dynamics, on the grid of the measurements.
    scale
        The size of each state, shape ``(d,)``.
    filtered
        Whether f is taken at what a filter knows, rather than at smoothed states.
    closed
        F with the effect of the filter's spread on it, where that is wanted.
    budget
        Charged for every evaluation; None where nobody counts.
    """

    model: Dynamics
    grid: Grid
    scale: np.ndarray
    filtered: bool = False
    closed: ClosedFunctions | None = None
    budget: Budget | None = None

    @property
    def resolution(self) -> float:
        """How unlike the effects of parameters have to be for the data to tell them apart; see `solve`."""
        return RANK if self.filtered else INEXACT

    def charge(self, evaluations: float = 1.0) -> None:
        """Count evaluations of the likelihood.

        Raises
        ------
        BudgetSpent
            When nothing is left of what is allowed.
        """
        if self.budget is not None:
            self.budget.charge(evaluations * evaluation(self.model, self.grid.data))

    def linearised(
        self, values: np.ndarray, x: np.ndarray, spread: np.ndarray | None, noise: Noise
    ) -> Linearisation:
        """At parameters ``(p,)`` and states ``(n, d)``."""
        self.charge(self.grid.substeps)
        if self.closed is None or spread is None:
            return linearise(self.model, self.grid, values, x)
        rows, data = self.grid.rows, self.grid.data
        # The random forces of half an interval are what its middle adds to the spread at its begin.
        half = (data.t[rows + 1] - data.t[rows])[:, None, None] / 2
        intensity = noise.intensity if len(noise.intensity) == 1 else noise.intensity[rows]
        drift = self.closed.at(spread[rows] + intensity * half)
        return linearise(self.model, self.grid, values, x, drift=drift)

    def noise_at(self, now: Iterate, noise: Noise) -> Noise:
        """The noise where a fit stands: random forces may depend on the state."""
        if noise.field is None:
            return noise
        rows, data = self.grid.rows, self.grid.data
        middle, step = now.x.copy(), np.append(np.diff(data.t), 0.0)
        middle[rows] += (now.x[rows + 1] + now.along.gap[rows] - now.x[rows]) / 2
        return noise.along(middle, now.spread, step)

    def stepped(self, now: Iterate, change: np.ndarray, noise: Noise) -> tuple[Iterate, float] | None:
        """The step that the linearisation suggests, shortened until it does about what was foreseen.

        Parameters
        ----------
        now
            Where the fit stands.
        change
            Of the free parameters, shape ``(p,)``.
        noise
            Decides how the states follow.

        Returns
        -------
        Iterate, float
            Where it leads, and the share of it that was taken; None where not even a short one does as
            foreseen.
        """
        follow = state_changes(now.along, self.grid.data, noise, change)
        deviation = follow.filtered if self.filtered else follow.smoothed
        spread = follow.spread if noise.process.any() else None
        rows, scale = self.grid.rows, self.scale
        moved = np.einsum("kij,kj->ki", now.along.transition[rows], deviation[rows])
        moved += now.along.response[rows] @ change
        foreseen = now.along.gap[rows] + moved - deviation[rows + 1]
        effect = np.sqrt(np.mean(((np.abs(moved) + np.abs(deviation[rows + 1])) / scale) ** 2))
        # A filter's gaps are its corrections at each sample, which random forces and sensors ask for anyway.
        usual = np.sqrt(np.mean((now.along.gap[rows] / scale) ** 2)) if self.filtered else 0.0
        length = 1.0
        while length >= SMALLEST_STEP:
            values = changed(now.values, self.model.free, length * change)
            x = now.x + length * deviation
            along = self.linearised(values, x, spread, noise)
            if along.finite:
                expected = (1 - length) * now.along.gap[rows] + length * foreseen
                unforeseen = np.sqrt(np.mean(((along.gap[rows] - expected) / scale) ** 2))
                if unforeseen <= NONLINEAR * length * effect + HARMLESS * usual + 1e-9:
                    smoothed = now.x + length * follow.smoothed
                    return Iterate(values, x, along, smoothed, spread), length
            length /= 2
        return None


def state_changes(
    linearisation: Linearisation, data: Measurements, noise: Noise, change: np.ndarray
) -> StateChanges:
    """How the states follow a change of the free parameters, shape ``(p,)``."""
    step = np.append(np.diff(data.t), 0.0)
    process = process_covariance(linearisation.transition, step, noise.intensity)
    still = with_parameters_changed(linearisation, change)
    gap, residual = still.gap, still.residual
    innovations, _, initial, _ = whitened_innovations(
        data.first,
        still.transition,
        still.response,
        gap,
        process,
        still.measured,
        still.measured_response,
        residual,
        noise.measurement,
    )
    begin = np.empty((len(data.labels), gap.shape[1]))
    for place, (start, end) in enumerate(zip(data.first[:-1], data.first[1:], strict=True)):
        columns = initial[start:end].reshape(-1, gap.shape[1])
        begin[place] = solve(columns, innovations[start:end].ravel(), least=INEXACT)[0]
    return StateChanges(
        *smoothed_states(
            data.first,
            linearisation.transition,
            gap,
            process,
            linearisation.measured,
            residual,
            noise.measurement,
            begin,
        )
    )


def changed(values: np.ndarray, free: Sequence[int], change: np.ndarray) -> np.ndarray:
    """Parameters' values after a change of the free ones."""
    result = values.copy()
    result[np.array(free, dtype=int)] += change
    return result
