"""Parts of long recordings that tell a noise as well as all of them, to begin with."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from siq.estimation.innovations import Noise
from siq.estimation.linearisation import Linearisation
from siq.estimation.noise_kernel import noise_likelihood

PIECE = 500  # samples in one stretch, so that its unknown first state hardly matters


@dataclass(frozen=True)
class Stretches:
    """Parts of recordings, or all of them, along which the likelihood of a noise is worked out.

    Attributes
    ----------
    first
        Row at which each part begins, and the number of rows.
    linearisation
        Along them.
    step
        Length of the interval after each sample, shape ``(n,)``.
    rows
        Which they are, of all samples; None where they are all.
    """

    first: np.ndarray
    linearisation: Linearisation
    step: np.ndarray
    rows: np.ndarray | None = None

    def some(self, most: int) -> Stretches:
        """Pieces spread over all recordings, about so many samples in all; itself where there are fewer."""
        count = len(self.step)
        if count <= 2 * most:
            return self
        keep = most / count
        rows, first = [], [0]
        for begin, end in zip(self.first[:-1], self.first[1:], strict=True):
            pieces = max(round((end - begin) * keep / PIECE), 1)
            length = max(int((end - begin) * keep / pieces), 1)
            for at in np.linspace(begin, end - length, pieces).astype(int):
                rows.append(np.arange(at, at + length))
                first.append(first[-1] + length)
        chosen = np.concatenate(rows)
        line = self.linearisation
        parts = {each.name: getattr(line, each.name)[chosen] for each in fields(line)}
        return Stretches(np.array(first), Linearisation(**parts), self.step[chosen], chosen)

    def sums(self, noise: Noise, *, weight: np.ndarray | float = 1.0) -> tuple[float, float, int]:
        """See `siq.estimation.noise_kernel.noise_likelihood`, whose results they are."""
        line, intensity = self.linearisation, noise.intensity
        if self.rows is not None and len(intensity) > 1:
            intensity = intensity[self.rows]
        return noise_likelihood(
            self.first,
            line.transition,
            line.response,
            line.gap,
            line.measured,
            line.measured_response,
            line.residual,
            weight * self.step,
            noise.measurement,
            intensity,
        )
