"""In how many resampled recordings would each term of f have been chosen?

Evidence judges a term by the noise that the model has. Resampled recordings judge it by how much they differ
from each other, whatever made them differ: a term that one recording alone asks for is in few of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from siq.identify.selection import Equation, improved_support
from siq.numerics.triangle import triangle_of

DRAWS = 40  # numerical: a share of one half is known to 0.08
MOST_BLOCKS = 20  # numerical: what is drawn; more would be slower and tell nothing new
FEWEST_RECORDINGS = 4  # below that their parts are drawn instead
PARTS = 10  # of few recordings: each longer than what neighbouring samples remember, or nothing is learned


def blocks_of(recording: np.ndarray) -> np.ndarray:
    """The block of each row, shape ``(n,)``: whole recordings, or parts where there are few.

    Parameters
    ----------
    recording
        The place of the recording of each row, shape ``(n,)``; it never decreases.
    """
    _, place = np.unique(recording, return_inverse=True)
    if place.max(initial=0) + 1 < FEWEST_RECORDINGS:
        return np.arange(len(place)) * PARTS // max(len(place), 1)
    return np.asarray(place % MOST_BLOCKS)


def triangles(columns: np.ndarray, goals: np.ndarray, block: np.ndarray) -> tuple[np.ndarray, ...]:
    """R of the QR decomposition of each block of rows, on which every fit to it depends.

    Parameters
    ----------
    columns, goals
        What explains, shape ``(n, c)``, and what is to be explained, shape ``(n,)`` or ``(n, g)``.
    block
        Of each row, shape ``(n,)``.
    """
    return tuple(triangle_of(columns[block == one], goals[block == one]) for one in np.unique(block))


def stability(
    parts: Sequence[np.ndarray],
    equations_of: Callable[[np.ndarray], Sequence[Equation]],
    chosen: Sequence[Sequence[int]],
    *,
    generator: np.random.Generator,
) -> list[np.ndarray]:
    """Share of resampled recordings in which each chosen term is chosen again, by equation.

    Parameters
    ----------
    parts
        Triangles of the blocks, see `triangles`.
    equations_of
        The equations of a triangle of all of them.
    chosen
        The support of each equation, from which each search begins.
    generator
        Draws the blocks, with replacement.

    Returns
    -------
    list of numpy.ndarray
        For each equation an array like its support.
    """
    counts = [np.zeros(len(one)) for one in chosen]
    for _ in range(DRAWS):
        drawn = generator.integers(len(parts), size=len(parts))
        triangle = np.asarray(np.linalg.qr(np.concatenate([parts[place] for place in drawn]), mode="r"))
        for count, equation, support in zip(counts, equations_of(triangle), chosen, strict=True):
            count += np.isin(support, improved_support(equation, support))
    return [count / DRAWS for count in counts]
