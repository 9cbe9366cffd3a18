"""Recordings in short segments, for training through an integrator (multiple shooting)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.discrepancies.states import parts
from siq.inference.measurements import Measurements

LENGTH = 10  # intervals of a segment
INSIDE = 1e-9  # of an interval, by which an input is read within it: it may jump at its ends
STAGES = (INSIDE, 0.5, 1 - INSIDE)


@dataclass(frozen=True)
class Segments:
    """Stretches of recordings, of one length; what lies behind the end of a recording is unknown.

    Attributes
    ----------
    h
        Intervals between samples, shape ``(segments, length)``; zero behind the end.
    u, t
        Inputs ``(3, segments, length, i)`` and times ``(3, segments, length)`` at begin, middle and end of
        each interval.
    y
        What was measured at the ends of intervals, ``(segments, length, m)``; NaN where it is not known.
    first
        Row at which a segment begins, shape ``(segments,)``.
    next
        The segment that goes on where one ends; -1 where there is none, shape ``(segments,)``.
    left_out
        Which segments nothing is learned from, shape ``(segments,)``.
    """

    h: np.ndarray
    u: np.ndarray
    t: np.ndarray
    y: np.ndarray
    first: np.ndarray
    next: np.ndarray
    left_out: np.ndarray

    def only(self, chosen: np.ndarray) -> Segments:
        """Some of the segments, by their places; what does not go on within them ends."""
        place = np.full(len(self.h) + 1, -1)
        place[chosen] = np.arange(len(chosen))
        return Segments(
            self.h[chosen], self.u[:, chosen], self.t[:, chosen], self.y[chosen], self.first[chosen],
            place[self.next[chosen]], self.left_out[chosen],
        )  # fmt: skip


def segments_of(data: Measurements, length: int = LENGTH) -> Segments:
    """Cut recordings into segments, a quarter of which is left out (the first fold of `states.parts`)."""
    rows, following = [], []
    for begin, end in zip(data.first[:-1], data.first[1:], strict=True):
        starts = np.arange(begin, end - 1, length)
        for place, start in enumerate(starts):
            row = np.arange(start, start + length)
            rows.append(np.where(row < end - 1, row, -1))
            following.append(len(rows) if place + 1 < len(starts) else -1)
    row = np.array(rows)
    known = row >= 0
    begins = data.begins
    place = np.searchsorted(begins, np.maximum(row, 0))
    step = data.t[begins + 1] - data.t[begins]
    recording = data.recording[begins]
    u = np.empty((len(STAGES), *row.shape, len(data.courses[0]) if data.courses else 0))
    t = np.empty((len(STAGES), *row.shape))
    for stage, part in enumerate(STAGES):
        at = data.t[begins] + part * step
        t[stage] = at[place]
        u[stage] = data.signals(at, recording, delays=()).inputs.T[place]
    _, fold = parts(data)
    return Segments(
        h=np.where(known, step[place], 0.0),
        u=u,
        t=t,
        y=np.where(known[..., None], data.outputs[begins + 1][place], np.nan),
        first=row[:, 0],
        next=np.array(following),
        left_out=fold[row[:, 0]] == 0,
    )
