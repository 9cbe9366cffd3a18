"""A figure of the model of what has no name: its functions with their bands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy.interpolate
from matplotlib.figure import Figure

from siq.report.plots.reading import WIDTH, axis_unit, drawn_to_be_read
from siq.report.plots.style import BLUE, GREY, name_label

POINTS = 200
BAND = 1.96  # standard errors within which 95 % lie


@drawn_to_be_read
def plot_described(
    described: Sequence[Mapping[str, Any]], *, units: Mapping[str, str] | None = None, time_unit: str = "1"
) -> Figure | None:
    """Draw every function of one coordinate of a model.

    Parameters
    ----------
    described
        As ``verdict.json`` has them; see `siq.mismatch.statement.StatedFunction`.
    units
        Units of states and inputs.
    time_unit
        Of time.

    Returns
    -------
    matplotlib.figure.Figure or None
        A panel for each, with bands of 95 % between values at knots. None where there is no such function.
    """
    shown = [each for each in described if each.get("curve")]
    if not shown:
        return None
    figure = Figure(figsize=(WIDTH, 0.4 + 2.4 * len(shown)))
    for axes, each in zip(np.atleast_1d(figure.subplots(len(shown), 1)), shown, strict=True):
        curve = each["curve"]
        at, value, error = (np.array(curve[name]) for name in ("at", "value", "standard_error"))
        fine = np.linspace(at[0], at[-1], POINTS)
        middle, wide = (
            scipy.interpolate.make_interp_spline(at, values, bc_type="natural")(fine)
            if len(at) > 3
            else np.interp(fine, at, values)
            for values in (value, error)
        )
        axes.fill_between(
            fine,
            middle - BAND * np.abs(wide),
            middle + BAND * np.abs(wide),
            color=BLUE,
            alpha=0.2,
            linewidth=0,
        )
        axes.plot(fine, middle, color=BLUE)
        axes.plot(at, value, "o", color=BLUE, markersize=4)
        axes.axhline(0.0, color=GREY, linewidth=0.8)
        name = curve["coordinate"]
        unit = time_unit if name == "t" else (units or {}).get(name, "1")
        axes.set_xlabel(f"{name if name == 'amplitude' else f'${name_label(name)}$'}{axis_unit(unit)}")
        targets = [*each["equations"], *each["outputs"]]
        where = " and ".join(f"${name_label(target)}$" for target in targets)
        of = "in the equation of" if each["equations"] else "in the measurement of"
        axes.set_ylabel(f"added {of} {where}")
        if len(each["coordinates"]) > 1:
            axes.set_title(f"the coefficient of ${name_label(each['coordinates'][1])}$", loc="left")
    return figure
