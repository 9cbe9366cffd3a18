"""Wells of a sweep: which attractors at different values of a parameter are one and the same well?

Those on one stable stretch of a branch of equilibria that does not turn back. A stretch ends at a fold, at a
Hopf point, and where branches meet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from siq.dynamics.continuation import Branch, Branches, place_on
from siq.dynamics.parameter_family import ParameterFamily
from siq.steps.sweep_points import SweptPoint

DIGITS = 10  # of positions in tables


@dataclass(frozen=True)
class Wells:
    """Wells as stable stretches of branches.

    Attributes
    ----------
    family
        f against the parameter.
    branches
        Its equilibria.
    number
        For each branch the well that each of its points belongs to, -1 where it is unstable.
    """

    family: ParameterFamily
    branches: Branches
    number: tuple[np.ndarray, ...]

    @classmethod
    def along(cls, family: ParameterFamily, branches: Branches) -> Wells:
        """Each stretch that is stable and does not turn back is a well, by the first states."""
        stretches = []
        for index, branch in enumerate(branches.branches):
            kind = np.where(branch.unstable == 0, np.where(branch.tangents[:, -1] > 0, 1, -1), 0)
            ends = [*(np.flatnonzero(np.diff(kind)) + 1), len(kind)]
            starts = [0, *ends[:-1]]
            stretches += [
                (index, first, last) for first, last in zip(starts, ends, strict=True) if kind[first] != 0
            ]

        def place(stretch: tuple[int, int, int]) -> tuple[float, ...]:
            index, first, last = stretch
            branch = branches.branches[index]
            at = np.argmin(branch.values[first:last]) + first
            return tuple(np.round(branch.states[at], 6))

        number = [np.full(len(branch.values), -1) for branch in branches.branches]
        for well, (index, first, last) in enumerate(sorted(stretches, key=place)):
            number[index][first:last] = well
        return cls(family, branches, tuple(number))

    def numbers(self, point: SweptPoint) -> tuple[int, ...]:
        """Which wells the attractors of a point are; -1 for one that is on no branch."""
        return tuple(self._number(np.array(well.state), point.values[0]) for well in point.wells)

    def _number(self, state: np.ndarray, value: float) -> int:
        z = self.family.shares(state[None], np.array([value]))[0]
        for branch, number in zip(self.branches.branches, self.number, strict=True):
            place = place_on(self.family, branch, z)
            if place is not None:
                return self._stable_beside(branch, number, place)
        return -1

    @staticmethod
    def _stable_beside(branch: Branch, number: np.ndarray, place: int) -> int:
        """Next to a fold the nearest point of the branch may lie behind it."""
        beside = number[max(place - 1, 0) : place + 2]
        return int(number[place]) if number[place] >= 0 else int(beside.max())

    def branch_rows(self) -> list[dict[str, object]]:
        """The table of branches."""
        return [
            {
                "branch": index,
                "well": int(number[k]),
                "value": branch.values[k],
                "position": position_text(branch.states[k]),
                "unstable": int(branch.unstable[k]),
                "growth": branch.eigenvalues[k, 0].real,
                "frequency": abs(branch.eigenvalues[k, 0].imag),
            }
            for index, (branch, number) in enumerate(zip(self.branches.branches, self.number, strict=True))
            for k in range(len(branch.values))
        ]


def bifurcation_rows(found: Branches) -> list[dict[str, object]]:
    """The table of bifurcations."""
    return [
        {
            "kind": one.kind,
            "value": one.value,
            "position": position_text(one.state),
            "branch": one.branch,
            "frequency": one.frequency,
            "residual": one.residual,
        }
        for one in found.bifurcations
    ]


def position_text(state: np.ndarray | Sequence[float]) -> str:
    """A state as tables have it."""
    return str([float(f"{one:.{DIGITS}g}") for one in state])
