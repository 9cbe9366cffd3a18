"""V on a mesh of two states: at its nodes, and interpolated between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Stop = Literal["boundary", "level", "everywhere"]


@dataclass(frozen=True)
class MeshQuasipotential:
    """V on the nodes of a rectangular mesh.

    Attributes
    ----------
    axes
        The nodes along each state, shapes ``(nx,)`` and ``(ny,)``, in the states' units.
    values
        Shape ``(nx, ny)``: V, not U = 2V; NaN where it was not reached.
    attractor
        A, shape ``(2,)``, where V is zero.
    level
        The highest V reached. Unless a boundary was passed over, all states of lower V that hang together
        with A have been reached.
    stop
        Why the work ended: the boundary of the mesh was next, or a value above the level asked for, or
        no node was left.
    reach
        Longest segment, in mesh widths.
    """

    axes: tuple[np.ndarray, np.ndarray]
    values: np.ndarray
    attractor: np.ndarray
    level: float
    stop: Stop
    reach: int

    def evaluate(self, x: np.ndarray, *, degree: Literal[1, 3] = 3) -> np.ndarray:
        """V at points, interpolated: ``(n, 2)`` to ``(n,)``.

        Parameters
        ----------
        x
            In the states' units.
        degree
            Of the interpolating polynomial along each state. Where not all nodes are known that a cubic
            needs, it is 1; where not even those are, and outside the box, V is NaN.
        """
        where = np.stack([(x[:, k] - axis[0]) / (axis[1] - axis[0]) for k, axis in enumerate(self.axes)])
        last = np.array(self.values.shape)[:, None] - 1
        outside = ~((where > -1e-9) & (where < last + 1e-9)).all(axis=0)
        where = np.clip(np.where(outside, 0.0, where), 0, last)
        nearest = np.round(where)
        where = np.where(np.abs(where - nearest) < 1e-9, nearest, where)  # or rounding would ask a neighbour
        values = self._interpolated(where, 1)
        if degree == 3:
            cubic = self._interpolated(where, 3)
            values = np.where(np.isfinite(cubic), cubic, values)
        return np.where(outside, np.nan, values)

    def _interpolated(self, where: np.ndarray, degree: int) -> np.ndarray:
        """Lagrange's polynomial through the nodes about a place, which is given in mesh widths."""
        offsets = np.arange(degree + 1)
        nodes, shares = [], []
        for place, count in zip(where, self.values.shape, strict=True):
            first = np.clip(np.floor(place).astype(int) - degree // 2, 0, count - 1 - degree)
            distance = (place - first)[:, None] - offsets
            share = np.ones((len(place), degree + 1))
            for k in offsets:
                for other in offsets[offsets != k]:
                    share[:, k] *= distance[:, other] / (k - other)
            nodes.append(first[:, None] + offsets)
            shares.append(share)
        around = self.values[nodes[0][:, :, None], nodes[1][:, None, :]]
        share = shares[0][:, :, None] * shares[1][:, None, :]
        return np.where(share == 0, 0.0, share * around).sum(axis=(1, 2))
