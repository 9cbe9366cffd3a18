"""Which label has a recording, and which has a copy of it?"""

from __future__ import annotations

import numpy as np


def distinct_labels(labels: tuple[str, ...], chosen: np.ndarray) -> tuple[str, ...]:
    """Give the labels of the chosen recordings; a copy is told apart by its label: ``r07``, ``r07#2``.

    Parameters
    ----------
    labels
        The labels of all recordings.
    chosen
        Shape ``(m,)``: indices into `labels`; one may stand more than once.
    """
    taken = set(labels)  # a label of the file may itself look like that of a copy
    copies: dict[int, int] = {}
    distinct = []
    for index in chosen.tolist():
        label, copy = labels[index], copies.get(index, 0) + 1
        while copy > 1 and f"{label}#{copy}" in taken:
            copy += 1
        copies[index] = copy
        distinct.append(label if copy == 1 else f"{label}#{copy}")
        taken.add(distinct[-1])
    return tuple(distinct)


def sources(labels: tuple[str, ...]) -> np.ndarray:
    """Index of the recording that each is, or is a copy of: ``r07#2`` is a copy where there is an ``r07``.

    Parameters
    ----------
    labels
        The labels of all recordings, k of them.

    Returns
    -------
    numpy.ndarray
        Shape ``(k,)``, indices into `labels`.
    """
    position = {label: index for index, label in enumerate(labels)}

    def source(label: str) -> int:
        original, _, copy = label.rpartition("#")
        return position[original if copy.isdigit() and original in position else label]

    return np.array([source(label) for label in labels], dtype=np.int64)
