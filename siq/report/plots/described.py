"""A figure of the model of what has no name: its curves with their bands, its surfaces with their errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy.interpolate
from matplotlib.axes import Axes
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure

from siq.report.plots.reading import WIDTH, axis_unit, drawn_to_be_read
from siq.report.plots.style import BLUE, GREY, name_label

POINTS = 200
LEVELS = 20  # an even number of edges, so that zero lies within the white one
BAND = 1.96  # standard errors within which 95 % lie


@drawn_to_be_read
def plot_described(
    described: Sequence[Mapping[str, Any]], *, units: Mapping[str, str] | None = None, time_unit: str = "1"
) -> Figure | None:
    """Draw every curve and every surface of a model.

    Parameters
    ----------
    described
        As ``verdict.json`` has them; see `siq.mismatch.stated_parts.StatedFunction`.
    units
        Units of states and inputs.
    time_unit
        Of time.

    Returns
    -------
    matplotlib.figure.Figure or None
        A panel for each, with bands of 95 % between values at knots. None where there is no such function.
    """
    shown = [each for each in described if each.get("curve") or each.get("surface")]
    if not shown:
        return None
    figure = Figure(figsize=(WIDTH, 0.4 + 2.4 * len(shown)))
    for axes, each in zip(np.atleast_1d(figure.subplots(len(shown), 1)), shown, strict=True):

        def with_unit(name: str) -> str:
            unit = time_unit if name == "t" else (units or {}).get(name, "1")
            return f"{name if name == 'amplitude' else f'${name_label(name)}$'}{axis_unit(unit)}"

        targets = " and ".join(f"${name_label(name)}$" for name in (*each["equations"], *each["outputs"]))
        where = f"added {'in the equation of' if each['equations'] else 'in the measurement of'} {targets}"
        if each.get("curve"):
            _draw_curve(axes, each["curve"])
            axes.set_xlabel(with_unit(each["curve"]["coordinate"]))
            axes.set_ylabel(where)
            if len(each["coordinates"]) > 1:
                axes.set_title(f"the coefficient of ${name_label(each['coordinates'][1])}$", loc="left")
        else:
            drawn = _draw_surface(axes, each["surface"])
            figure.colorbar(drawn, ax=axes, label=where)
            first, second = each["surface"]["coordinates"]
            axes.set_xlabel(with_unit(first))
            axes.set_ylabel(with_unit(second))
    return figure


def _draw_curve(axes: Axes, curve: Mapping[str, Any]) -> None:
    """A function of one coordinate, its values at knots and its band."""
    at, value, error = (np.array(curve[name]) for name in ("at", "value", "standard_error"))
    fine = np.linspace(at[0], at[-1], POINTS)
    middle, wide = (
        scipy.interpolate.make_interp_spline(at, values, bc_type="natural")(fine)
        if len(at) > 3
        else np.interp(fine, at, values)
        for values in (value, error)
    )
    half = BAND * np.abs(wide)
    axes.fill_between(fine, middle - half, middle + half, color=BLUE, alpha=0.2, linewidth=0)
    axes.plot(fine, middle, color=BLUE)
    axes.plot(at, value, "o", color=BLUE, markersize=4)
    axes.axhline(0.0, color=GREY, linewidth=0.8)


def _draw_surface(axes: Axes, surface: Mapping[str, Any]) -> ContourSet:
    """A function of two coordinates in colours, white where it is zero; dotted where it may well be zero."""
    first, second = (np.array(each) for each in surface["at"])
    value, error = (np.array(surface[name]).T for name in ("value", "standard_error"))
    most = max(float(np.abs(value).max()), np.finfo(float).tiny)
    levels = np.linspace(-most, most, LEVELS)
    drawn = axes.contourf(first, second, value, levels=levels, cmap="PuOr")
    unclear = np.abs(value) <= BAND * error
    axes.contourf(first, second, unclear.astype(float), levels=[0.5, 1.5], colors="none", hatches=["..."])
    return drawn
