"""Which terms does the likelihood of a filter ask for?

All functions of a library are fitted first. Along that fit everything is linear: the innovations are a
regression problem like any other (`siq.identify.selection`), all equations at once since a filter couples
them. What is chosen is fitted again, and terms leave as long as one is not significant after all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.data.labels import sources
from siq.estimation.fit import Fit
from siq.estimation.innovations import Noise, Whitened, solve, whiten
from siq.estimation.measurements import Measurements
from siq.identify.rival_terms import RivalTerms, rivals_of_all
from siq.identify.seen_states import View, settled
from siq.identify.selection import Equation, best_support, weakest_term
from siq.identify.stability import blocks_of, stability, triangles

LAGS = (1, 2, 3)  # steps over which innovations are compared: what remembers at all remembers so long


@dataclass(frozen=True)
class FilteredTerms:
    """The regression problem of a filter's innovations.

    Attributes
    ----------
    view
        How samples show the states.
    data
        The measurements.
    parts
        Triangles of blocks of the recordings, of which `equations` is the whole.
    equations
        In units of the innovations' errors.
    """

    view: View
    data: Measurements
    parts: tuple[np.ndarray, ...]
    equations: Equation

    @classmethod
    def along(cls, view: View, data: Measurements, whole: Fit, critical: np.ndarray) -> FilteredTerms:
        """That of a fit of all functions; `critical` says how significant each has to be, ``(p,)``."""
        white = whiten(whole.linearisation, data, whole.noise)
        goal = white.innovations + white.columns @ (whole.model.values - _last_change(whole, white))
        # Whitened values stand one behind the other, all outputs of a sample together.
        outputs = data.outputs.shape[1]
        blocks = blocks_of(sources(data.labels)[data.recording])
        parts = triangles(white.columns, goal, np.repeat(blocks, outputs))
        triangle = np.asarray(np.linalg.qr(np.concatenate(parts), mode="r"))
        return cls(view, data, parts, Equation(triangle[:, :-1], triangle[:, -1], 1.0, critical))

    def chosen(self) -> list[int]:
        """Places of the terms that the innovations ask for, among `View.everything`."""
        return list(best_support(self.equations))

    def settled(self, chosen: list[int], noise: Noise, *, x: np.ndarray) -> tuple[Fit, np.ndarray, list[int]]:
        """The fit of chosen terms, of which all are significant, with component and term of each.

        Raises
        ------
        NumericalFailure
            When it does not settle.
        """
        support = self.view.everything[chosen]
        while True:
            # Where functions are nearly alike, those that stay take over what the others did: all begin anew.
            values = self.equations.fitted(chosen)[chosen]
            fit = settled(self.view, support, self.data, noise, values=values, x=x)
            strength = np.abs(fit.model.values) / fit.standard_errors / self.equations.critical[chosen]
            weak = weakest_term(strength, support)
            if weak is None:
                return fit, support, chosen
            support, chosen = np.delete(support, weak, axis=0), np.delete(chosen, weak).tolist()
            noise, x = fit.noise, fit.linearised_at

    def stability(self, chosen: list[int], *, generator: np.random.Generator) -> np.ndarray:
        """The share of resampled recordings in which each chosen term would be chosen, shape ``(p,)``."""
        (shares,) = stability(
            self.parts,
            lambda drawn: [Equation(drawn[:, :-1], drawn[:, -1], 1.0, self.equations.critical)],
            [chosen],
            generator=generator,
        )
        return shares

    def rivals(self, chosen: list[int]) -> RivalTerms:
        """What other terms that do nearly as well make of f."""
        support, d = self.view.everything[chosen], self.view.library.dimension
        known = int(self.view.everything[0, 0])  # equations that hold by definition come first
        own = rivals_of_all(self.equations, support - [known, 0], dimension=d - known)
        return RivalTerms(
            np.pad(own.mean_change, ((0, 0), (known, 0))),
            np.pad(own.spread, ((0, 0), (0, 0), (known, 0))),
        )


def _last_change(fit: Fit, white: Whitened) -> np.ndarray:
    """What the estimates are beyond the values at which a fit was linearised."""
    change = solve(white.columns, white.innovations)[0]
    return change if fit.converged else 0 * change


def neighbours(white: Whitened, data: Measurements) -> tuple[float, float]:
    """Strongest correlation of near innovations over outputs and lags, and in standard errors."""
    measured = white.known.reshape(len(data.t), -1).any(axis=1)
    innovations, recording = white.innovations.reshape(len(data.t), -1)[measured], data.recording[measured]
    found: list[tuple[float, float, float]] = []
    for lag in LAGS:
        rows = np.flatnonzero(recording[lag:] == recording[:-lag])
        first, second = innovations[rows], innovations[rows + lag]
        product = first * second
        size = np.sqrt((first**2).mean(axis=0) * (second**2).mean(axis=0))
        scores = product.sum(axis=0) / np.sqrt((product**2).sum(axis=0))
        found += zip(np.abs(scores), product.mean(axis=0) / size, scores, strict=True)
    _, correlation, score = max(found)
    return float(correlation), float(score)
