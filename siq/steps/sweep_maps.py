"""Maps of two parameters: along which curves of the plane do equilibria fold, or begin to oscillate?

Along each row and each column of the map branches of equilibria are followed through those that its points
know. What folds or begins to oscillate there is a point of a curve, which is followed through the plane
(`siq.dynamics.bifurcation_curves`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from siq.dynamics.bifurcation_curves import BifurcationCurve, CurveSeed, follow_curves
from siq.dynamics.continuation import follow_branches
from siq.dynamics.dynamics import Dynamics
from siq.steps.sweep_points import SweptPoint
from siq.steps.sweep_wells import position_text


def curves_of_map(
    system: Dynamics, names: tuple[str, ...], points: Sequence[SweptPoint]
) -> list[BifurcationCurve]:
    """Curves of folds and of Hopf points within the ranges of a map.

    Parameters
    ----------
    system
        The system at any of the points.
    names
        Of the two parameters.
    points
        Of the map. A curve that none of its rows and columns crosses is not found.

    Returns
    -------
    list of BifurcationCurve
        Empty where one of the parameters has a single value, and the map is a line.
    """
    values = np.array([point.values for point in points])
    limits = list(zip(values.min(axis=0).tolist(), values.max(axis=0).tolist(), strict=True))
    if any(low == high for low, high in limits):
        return []
    seeds = [
        seed for along in range(len(names)) for seed in _seeds(system, names, points, limits[along], along)
    ]
    return follow_curves(system, dict(zip(names, limits, strict=True)), seeds)


def _seeds(
    system: Dynamics,
    names: tuple[str, ...],
    points: Sequence[SweptPoint],
    limits: tuple[float, float],
    along: int,
) -> Iterator[CurveSeed]:
    """Folds and Hopf points on all lines along one parameter."""
    other = 1 - along
    for value in sorted({point.values[other] for point in points}):
        known = [
            (point.values[along], np.array(one))
            for point in points
            if point.values[other] == value
            for one in point.equilibria
        ]
        changed = [value if each.name == names[other] else each.value for each in system.parameters]
        line = system.with_values(np.array(changed, dtype=float))
        for one in follow_branches(line, names[along], limits, known).bifurcations:
            if one.kind != "branch point":
                place = np.array([one.value, value] if along == 0 else [value, one.value])
                yield CurveSeed(one.kind, place, one.state)


def curve_rows(curves: Sequence[BifurcationCurve]) -> list[dict[str, object]]:
    """The table of curves, a row for each of their points."""
    return [
        {
            "curve": index,
            "kind": curve.kind,
            "value": value,
            "second_value": second,
            "position": position_text(state),
            "frequency": frequency,
        }
        for index, curve in enumerate(curves)
        for (value, second), state, frequency in zip(
            curve.values, curve.states, curve.frequencies, strict=True
        )
    ]


def curve_notes(names: Sequence[str], curves: Sequence[BifurcationCurve]) -> list[str]:
    """Which curves could not be followed to their ends, in words."""
    return [
        f"the curve of {curve_name(curve.kind)} through {names[0]} = {curve.values[0, 0]:g},"
        f" {names[1]} = {curve.values[0, 1]:g} {curve.fault}"
        for curve in curves
        if curve.fault
    ]


def curve_name(kind: str) -> str:
    """What lies along a curve."""
    return "folds" if kind == "fold" else "Hopf points"
