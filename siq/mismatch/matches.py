"""Matches: how often mechanisms explain as much of an effect that has no name, by chance.

A mechanism that leaves something may be right and not alone, or wrong and alike. Effects without a name are
drawn as smooth functions in all places; along the trajectories of the recalibrated simulation everything is
linear, so that least squares tells how much of each the best mechanisms would explain.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from siq.errors import NumericalFailure
from siq.estimation.fit import Fit
from siq.estimation.innovations import Noise, whiten
from siq.estimation.linearisation import Grid
from siq.estimation.measurements import Measurements
from siq.mismatch.evidence import LENGTHS, orthonormal, smooth_prior
from siq.mismatch.function_places import linearised_with_places, places_in
from siq.mismatch.probes import Probe, ProbeColumns
from siq.mismatch.promises import PROBE_SUBSTEPS
from siq.mismatch.roles import Roles
from siq.mismatch.screening import probe_response

DRAWS = 300  # effects without a name, which tell a probability of 5 % to 1 %


def probability_of_a_match(
    recalibrated: Fit,
    data: Measurements,
    probes: Sequence[Probe],
    roles: Roles,
    *,
    share: float,
    mechanisms: int,
    measurement: np.ndarray,
    generator: np.random.Generator,
) -> float:
    """Probability that so many mechanisms explain as large a share of an effect that has no name.

    Parameters
    ----------
    recalibrated, data
        The simulation with nothing added, and the recordings.
    probes
        What could have been named.
    roles
        Of the simulation's states.
    share
        Of the excess that the mechanisms explain.
    mechanisms
        How many they are.
    measurement
        Variance of the sensors' noise, shape ``(m,)``.
    generator
        Draws the effects.

    Raises
    ------
    NumericalFailure
        When the simulation, as linearised, runs away.
    """
    noise = Noise(measurement, np.zeros(recalibrated.model.dimension))
    effects = drawn_effects(recalibrated, data, roles, noise, generator=generator)
    model = recalibrated.model
    grid = Grid(data, min(recalibrated.substeps, PROBE_SUBSTEPS))
    columns = ProbeColumns(model, grid, probes, recalibrated.x, model.values)
    white = whiten(probe_response(model, grid, recalibrated, columns), data, noise)
    own = orthonormal(white.columns[:, : len(model.free)])
    effects = effects - own @ (own.T @ effects)
    effects = effects[:, (effects**2).sum(axis=0) > 0]
    if not effects.shape[1]:
        raise NumericalFailure("no effect can be seen in the recordings")
    groups, begin = [], len(model.free)
    for probe in probes:
        group = white.columns[:, begin : begin + probe.width]
        begin += probe.width
        if np.isfinite(group).all():
            groups.append(orthonormal(group - own @ (own.T @ group)))
    best = best_shares(effects, groups, mechanisms)
    return float((np.sum(best >= share) + 1) / (len(best) + 1))


def drawn_effects(
    fit: Fit, data: Measurements, roles: Roles, noise: Noise, *, generator: np.random.Generator
) -> np.ndarray:
    """What smooth functions in places drawn at random do to the innovations, shape ``(n, DRAWS)``."""
    places = places_in(fit.model, roles, data, fit.x)
    if not places:
        return np.zeros((data.outputs.size, 0))
    counts = generator.multinomial(DRAWS, np.full(len(places), 1 / len(places)))
    drawn, place = [], 0
    for response, some in linearised_with_places(fit, data, places):
        white = whiten(response, data, noise)
        begin = len(fit.model.free)
        for each in some:
            columns = white.columns[:, begin : begin + len(each.knots)]
            begin += len(each.knots)
            if np.isfinite(columns).all():
                for _ in range(counts[place]):
                    root = np.linalg.cholesky(smooth_prior(each.knots, generator.choice(LENGTHS)))
                    drawn.append(columns @ (root @ generator.normal(size=len(each.knots))))
            place += 1
    return np.stack(drawn, axis=1) if drawn else np.zeros((data.outputs.size, 0))


def best_shares(effects: np.ndarray, groups: Sequence[np.ndarray], most: int) -> np.ndarray:
    """Share of each effect that the best so many groups explain, each chosen beside those before it.

    Parameters
    ----------
    effects
        Shape ``(n, e)``.
    groups
        Orthonormal columns of each group, shape ``(n, k)``.
    most
        How many groups.
    """
    size = (effects**2).sum(axis=0)
    left = effects.copy()
    chosen: list[list[np.ndarray]] = [[] for _ in size]
    for _ in range(most):
        explained = np.stack([((group.T @ left) ** 2).sum(axis=0) for group in groups])
        for place, best in enumerate(explained.argmax(axis=0)):
            chosen[place].append(groups[best])
            basis = orthonormal(np.concatenate(chosen[place], axis=1))
            left[:, place] = effects[:, place] - basis @ (basis.T @ effects[:, place])
    return 1 - (left**2).sum(axis=0) / size
