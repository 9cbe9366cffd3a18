"""How well does a simulation follow recordings that it has not seen, before and after its mend?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from siq.report.plots.landscape_curves import scaled_label
from siq.report.plots.quasipotential import add_legend, new_axes
from siq.report.plots.style import BLACK, BLUE, GREY, ORANGE, VERMILLION, name_label

if TYPE_CHECKING:
    from siq.estimation.measurements import Measurements
    from siq.mismatch.diagnosis import Diagnosis

SAMPLES_SHOWN = 400  # of a long recording the end, where simulations are off the furthest
BEYOND = 0.6  # of the range of what was measured, by which the axis is longer
RECORDED: dict[str, Any] = {"color": ORANGE, "linewidth": 4.0, "alpha": 0.55}
BEFORE: dict[str, Any] = {"color": GREY, "linestyle": (0, (1, 1)), "linewidth": 1.8}
RECALIBRATED: dict[str, Any] = {"color": BLUE, "linestyle": (0, (4, 2)), "linewidth": 1.5}
AUGMENTED: dict[str, Any] = {"color": VERMILLION, "linestyle": "-", "linewidth": 1.5}


def plot_diagnosis(
    diagnosis: Diagnosis,
    *,
    output: str | None = None,
    recording: str | None = None,
    legend: bool = True,
    ax: Axes | None = None,
) -> Axes:
    """Draw a recording that was held out, and the simulation before and after.

    Main arguments
    --------------
    diagnosis
        What `siq.diagnose` gave.

    Other arguments
    ---------------
    output
        Which output is shown; by default the first.
    recording
        Which held-out recording; by default the one in which the simulation as it was is off the most.
    legend
        Whether to say below the axes which line is which.
    ax
        Where; by default new axes of pyplot.

    Returns
    -------
    matplotlib.axes.Axes
        Measured values as a broad line, and the simulation as given, with its own parameters refitted, and
        with what was found.

    Examples
    --------
    >>> import pandas as pd, sympy
    >>> import siq
    >>> from matplotlib.figure import Figure
    >>> from siq.dynamics.dynamics import Parameter
    >>> n, r = sympy.symbols("n r", real=True)
    >>> growth = siq.Dynamics(("n",), (r * n,), siq.Diffusion.identity(1), parameters=(Parameter("r", 1.0),))
    >>> t, noise = np.arange(0, 8, 0.4), np.random.default_rng(1)
    >>> recordings = pd.concat(
    ...     pd.DataFrame({"recording": f"r{k}", "t": t, "n": 2 / (1 + (2 / start - 1) * np.exp(-0.9 * t))})
    ...     for k, start in enumerate([0.05, 0.2, 1.0, 5.0])
    ... )
    >>> recordings["n"] += 0.005 * noise.normal(size=len(recordings))
    >>> axes = plot_diagnosis(siq.diagnose(growth, recordings), ax=Figure().add_subplot())
    >>> axes.get_ylabel()
    '$n$'
    """
    axes = new_axes() if ax is None else ax
    case, place, rows = _shown(diagnosis, output, recording)
    t, measured = case.t[rows], case.outputs[rows, place]
    axes.plot(t, measured, **RECORDED)
    handles = [Line2D([], [], label="recording", **RECORDED)]
    for values, look, name in _simulations(diagnosis):
        axes.plot(t, values[rows, place], **look)
        handles.append(Line2D([], [], label=name, **look))
    # A simulation that runs away would leave the others no room.
    low, high = np.nanmin(measured), np.nanmax(measured)
    room = BEYOND * ((high - low) or abs(high) or 1.0)
    axes.set_ylim(low - room, high + room)
    _name(axes, diagnosis, place, t, "")
    if legend:
        add_legend(axes, handles)
    return axes


def draw_errors(
    axes: Axes, diagnosis: Diagnosis, *, output: str | None = None, recording: str | None = None
) -> list[Any]:
    """Draw simulation minus recording, held out; what is returned belongs into the legend."""
    case, place, rows = _shown(diagnosis, output, recording)
    t, measured = case.t[rows], case.outputs[rows, place]
    handles, sizes = [], []
    for values, look, name in _simulations(diagnosis):
        error = values[rows, place] - measured
        axes.plot(t, error, **look)
        handles.append(Line2D([], [], label=name, **look))
        known = np.abs(error[np.isfinite(error)])
        sizes.append(float(known.max()) if len(known) else np.inf)
    axes.axhline(0.0, color=BLACK, linewidth=0.6, zorder=0)
    largest = min(sizes[0], (np.nanmax(measured) - np.nanmin(measured)) or np.inf)
    largest = max(largest, *(size for size in sizes[1:] if size <= 2 * largest), 0.0)
    if 0 < largest < np.inf:
        axes.set_ylim(-1.1 * largest, 1.1 * largest)
    _name(axes, diagnosis, place, t, "simulation − recording, ")
    return handles


def _simulations(diagnosis: Diagnosis) -> list[tuple[np.ndarray, dict[str, Any], str]]:
    runs = diagnosis.held_out
    found = [
        (runs.before.outputs, BEFORE, "simulation as given"),
        (runs.recalibrated.outputs, RECALIBRATED, "parameters refitted"),
    ]
    if diagnosis.mechanisms:
        found.append((runs.augmented.outputs, AUGMENTED, "with what was found"))
    return found


def _shown(
    diagnosis: Diagnosis, output: str | None, recording: str | None
) -> tuple[Measurements, int, np.ndarray]:
    """The held-out recordings, the place of the output, and the rows that are drawn."""
    case, runs = diagnosis.case.kept, diagnosis.held_out
    names = diagnosis.case.system.output_names
    if output is not None and output not in names:
        raise ValueError(f"there is no output {output}; name one of {', '.join(names)}")
    if recording is not None and recording not in case.labels:
        raise ValueError(f"no recording {recording} was held out; name one of {', '.join(case.labels)}")
    place = 0 if output is None else names.index(output)
    parts = [np.arange(*ends) for ends in zip(case.first[:-1], case.first[1:], strict=True)]
    parts = [part[runs.before.scored[part]] for part in parts]
    error = np.abs(runs.before.outputs[:, place] - case.outputs[:, place])
    error = np.nan_to_num(error, nan=np.inf)
    worst = max(
        range(len(parts)), key=lambda one: float(np.median(error[parts[one]])) if len(parts[one]) else -1.0
    )
    chosen = worst if recording is None else case.labels.index(recording)
    return case, place, parts[chosen][-SAMPLES_SHOWN:]


def _name(axes: Axes, diagnosis: Diagnosis, place: int, t: np.ndarray, what: str) -> None:
    system = diagnosis.case.system
    name, formula = system.outputs[place]
    units = dict(zip(system.states, system.units, strict=True))
    unit = units.get(str(formula), "1")
    largest = max(abs(limit) for limit in axes.get_ylim())
    axes.set_ylabel(scaled_label(axes.yaxis, f"{what}${name_label(name)}$", unit, largest))
    axes.set_xlabel(scaled_label(axes.xaxis, "$t$", system.time_unit, float(np.abs(t).max(initial=0.0))))
