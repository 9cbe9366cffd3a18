"""Left out: which models hold on what they were not fitted to, where all that is held out are tests?

Every part of the recordings to learn from is left out in turn: whole recordings, or stretches of a single
one. All parameters are fitted to the others, so that what is left out had no part in them.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from siq.errors import NumericalFailure
from siq.estimation.fit import Fit
from siq.estimation.innovations import Noise
from siq.estimation.measurements import Measurements
from siq.estimation.process_noise import fit_with_process_noise_as_needed
from siq.mismatch.building import MechanismCandidate
from siq.mismatch.runs_alike import RunsAlike

LOGGER = logging.getLogger(__name__)
PARTS = 4  # of which one is left out at a time: a quarter, as is held out by default
FEWEST = 16  # samples of a stretch that an initial state and an error can be told from


@dataclass(frozen=True)
class LeftOut:
    """What is left out, the rest, and the rows of the rest in all of it."""

    out: Measurements
    rest: Measurements
    rows: np.ndarray


def parts_left_out(learned: Measurements) -> Iterator[LeftOut]:
    """The recordings divided into parts, each left out once.

    Of recordings, so many at equal distances are a part; a single one is cut into stretches, of which the
    rest has two recordings unless it is the first or the last that is left out.
    """
    count = len(learned.labels)
    if count > 1:
        pieces = list(zip(learned.first[:-1], learned.first[1:], strict=True))
        owner = np.arange(count)
        groups = [np.arange(part, count, min(PARTS, count)) for part in range(min(PARTS, count))]
    else:
        parts = max(min(PARTS, len(learned.t) // FEWEST), 2)
        edges = np.linspace(0, len(learned.t), parts + 1).round().astype(int)
        pieces, owner = list(itertools.pairwise(edges)), np.zeros(parts, dtype=int)
        groups = [np.array([part]) for part in range(parts)]
    for group in groups:
        others = np.setdiff1d(np.arange(len(pieces)), group)
        chosen = [pieces[place] for place in group]
        kept = [pieces[place] for place in others]
        if count == 1:  # what was not cut stays one recording
            kept = _joined(kept)
            others = np.zeros(len(kept), dtype=int)
        rest, rows = _stretches(learned, kept, owner[others] if count > 1 else others)
        out, _ = _stretches(learned, chosen, owner[group])
        yield LeftOut(out, rest, rows)


def errors_left_out(
    fit: Fit, learned: Measurements, *, noise: Noise, candidates: Iterable[MechanismCandidate] = ()
) -> np.ndarray | None:
    """Normalised squared errors of free runs of the parts left out.

    Parameters
    ----------
    fit
        Of a simulation to all of the recordings. It is made again without each part, from where it is.
    learned
        These recordings.
    noise
        See `siq.estimation.free_runs.free_run`.
    candidates
        The mechanisms in it, of which some amplitudes cannot be negative.

    Returns
    -------
    numpy.ndarray or None
        One part behind the other, shape ``(values,)``; None where a fit has no result, or a simulation runs
        away.
    """
    positive = {name for each in candidates for name in each.positive.intersection(each.amplitudes)}
    runs = RunsAlike(noise, fit.substeps)
    squares = []
    for part in parts_left_out(learned):
        try:
            again = _made_again(fit, part, positive)
            own = runs.errors(again, part.out)
        except NumericalFailure:
            return None
        # One that does not quite settle, as where a reading is cut off, is judged by what it foresees.
        if own is None or again.fault:
            return None
        squares.append(own)
    return np.concatenate(squares)


def _made_again(fit: Fit, part: LeftOut, positive: Collection[str]) -> Fit:
    """A fit to the rest alone. What the rest would have of a sign that cannot be is not there.

    The part left out may be the only one that tells of it: of vessels that overflow once, say.
    """
    model = fit.model
    while True:
        again = fit_with_process_noise_as_needed(model, part.rest, replace(fit, x=fit.x[part.rows]))
        wrong = [each.name for each in again.model.parameters if each.name in positive and each.value < 0]
        if not wrong:
            return again
        LOGGER.info("without rows of one part, %s would be negative", ", ".join(wrong))
        model = replace(
            model,
            parameters=tuple(
                replace(each, value=0.0, fixed=True) if each.name in wrong else each
                for each in model.parameters
            ),
        )


def _joined(stretches: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Stretches of rows, those that follow each other as one."""
    whole: list[tuple[int, int]] = []
    for begin, end in stretches:
        if whole and whole[-1][1] == begin:
            whole[-1] = (whole[-1][0], end)
        else:
            whole.append((begin, end))
    return whole


def _stretches(
    data: Measurements, stretches: list[tuple[int, int]], owner: np.ndarray
) -> tuple[Measurements, np.ndarray]:
    """Stretches of rows as recordings of their own, and their rows; the inputs stay whole."""
    rows = np.concatenate([np.arange(begin, end) for begin, end in stretches])
    return replace(
        data,
        labels=tuple(
            f"{data.labels[place]}, rows {a} to {b}" for place, (a, b) in zip(owner, stretches, strict=True)
        ),
        first=np.concatenate([[0], np.cumsum([end - begin for begin, end in stretches])]),
        t=data.t[rows],
        outputs=data.outputs[rows],
        courses=tuple(data.courses[place] for place in owner) if data.courses else data.courses,
    ), rows
