"""Likely places: where a smooth function without a name is most likely to stand, and which powers it needs.

Smooth functions are compared in all places by their evidence (`siq.mismatch.evidence`), along the
trajectories of a fit and at several levels of random forces, as mechanisms are screened.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from siq.errors import NumericalFailure
from siq.estimation.fit import Fit
from siq.estimation.innovations import Whitened, profile_likelihood, whiten
from siq.estimation.linearisation import Grid
from siq.estimation.measurements import Measurements
from siq.mismatch.clusters import correlation_time_of
from siq.mismatch.evidence import evidence_of_function, orthonormal
from siq.mismatch.function_places import Place, linearised_with_places, places_in, products_in
from siq.mismatch.functions import Power, powers, with_formula
from siq.mismatch.probes import Probe, ProbeColumns
from siq.mismatch.promises import PROBE_SUBSTEPS
from siq.mismatch.roles import Roles
from siq.mismatch.screening import levels_of, probe_response, projected

FITTED = 3  # places in which functions are fitted, the most likely ones: a choice


@dataclass(frozen=True)
class LikelyPlace:
    """A place, the logarithm of its evidence, and the level of random forces at which it is best.

    The evidence is that of a smooth function there over that of none, each at its best level.
    """

    place: Place
    log_evidence: float
    level: float


def likely_places(fit: Fit, data: Measurements, roles: Roles) -> list[LikelyPlace]:
    """All places, the one in which a smooth function is likeliest first.

    Functions of one coordinate are tried everywhere, and as coefficients of other coordinates in the
    equations in which they do best.
    """
    single = places_in(fit.model, roles, data, fit.x)
    ranked = _compared(fit, data, single)
    if not ranked:
        return []
    equations = {each.place.targets for each in ranked[:FITTED] if each.place.equations}
    products = products_in([each for each in single if each.targets in equations], fit.model, data, fit.x)
    return sorted((*ranked, *_compared(fit, data, products)), key=lambda each: -each.log_evidence)


def _compared(fit: Fit, data: Measurements, places: Sequence[Place]) -> list[LikelyPlace]:
    parameters = len(fit.model.free)
    found: dict[int, LikelyPlace] = {}
    alone = -np.inf
    for response, some in linearised_with_places(fit, data, places):
        for level in levels_of(fit):
            try:
                white = whiten(response, data, fit.noise.scaled(level))
                left, columns = projected(white, parameters)
            except NumericalFailure:  # without random forces an unstable simulation does not follow
                continue
            freedom = white.degrees_of_freedom - parameters
            base = profile_likelihood(float(left @ left), freedom, white.log_determinant)
            alone = max(alone, base)
            begin = 0
            for place in some:
                own = columns[:, begin : begin + len(place.knots)]
                begin += len(place.knots)
                value = base + evidence_of_function(own, left, place.knots, freedom=freedom)
                known = found.get(id(place))
                if own.any() and (known is None or value > known.log_evidence):
                    found[id(place)] = LikelyPlace(place, value, level)
    ranked = sorted(found.values(), key=lambda each: -each.log_evidence)
    return [replace(each, log_evidence=each.log_evidence - alone) for each in ranked]


def few_powers(likely: LikelyPlace, fit: Fit, data: Measurements, *, degree: int) -> tuple[Power, ...]:
    """The powers that a formula needs: each added as long as it earns its place (Schwarz).

    Errors count as correlated as all of the powers leave them (`siq.mismatch.evidence`).
    """
    terms = powers(likely.place, degree=degree)
    probe = Probe(with_formula(fit.model, likely.place, terms), ())
    grid = Grid(data, min(fit.substeps, PROBE_SUBSTEPS))
    columns = ProbeColumns(fit.model, grid, [probe], fit.x, fit.model.values)
    white = whiten(probe_response(fit.model, grid, fit, columns), data, fit.noise.scaled(likely.level))
    left, own = projected(white, len(fit.model.free))
    count = independent(left, own, white, fit)
    chosen: list[int] = []
    total = float(left @ left)
    while len(chosen) < len(terms):
        sums = {}
        for place in range(len(terms)):
            if place not in chosen and own[:, place].any():
                some = own[:, [*chosen, place]]
                some = some / np.sqrt((some**2).sum(axis=0))
                sums[place] = float(((left - some @ np.linalg.lstsq(some, left, rcond=1e-9)[0]) ** 2).sum())
        if not sums:
            break
        best = min(sums, key=lambda place: sums[place])
        if count * np.log(total / max(sums[best], 1e-300)) < np.log(count):
            break
        chosen.append(best)
        total = sums[best]
    return tuple(terms[place] for place in sorted(chosen))


def independent(left: np.ndarray, columns: np.ndarray, white: Whitened, fit: Fit) -> float:
    """How many errors count as independent, if columns are fitted to what is left."""
    basis = orthonormal(columns)
    rest = left - basis @ (basis.T @ left)
    correlated = correlation_time_of(rest, white.recording, outputs=len(fit.model.outputs))
    return max(float(white.known.sum()) / correlated, 2.0)
