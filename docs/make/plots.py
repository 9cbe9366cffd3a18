"""One picture of each plot, for the gallery: python docs/make/plots.py writes docs/images/plots/.

The recordings are made here, and take seconds: a bead in a trap with two places to rest, as ring-downs; the
same with noise along one axis; and a simulation of free fall in which the drag was left out.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import sympy
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import siq
from siq.dynamics.dynamics import Parameter
from siq.report.plots import save_figure
from siq.report.plots.style import drawing_style

FOLDER = Path(__file__).parents[1] / "images" / "plots"
SIZE = (4.5, 4.2)  # inches: letters of ten points can be read on a phone
T = np.linspace(0, 3, 61)


def ring_downs() -> siq.Recordings:
    """A bead that is let go: dx/dt = -∂V/∂x - 0.6 ∂V/∂y, dy/dt = -∂V/∂y + 0.6 ∂V/∂x, in µm and s."""
    rng = np.random.default_rng(0)
    states = rng.uniform([-1.5, -1.0], [1.5, 1.0], (300, 2))
    path = [states]
    for step in np.repeat(np.diff(T), 20) / 20:
        middle = states + step / 2 * drift(states)
        states = states + step * drift(middle)
        path.append(states)
    values = np.stack(path[::20], axis=1)
    return siq.Recordings.from_arrays(T, values, names=["x", "y"], units=["um", "um"], time_unit="s")


def drift(states: np.ndarray) -> np.ndarray:
    """The equations of the bead, V = x⁴/4 - x²/2 - x/20 + y²: slopes, and a circulation that keeps V."""
    x, y = states.T
    along, across = x**3 - x - 0.05, 2 * y
    return np.column_stack([-along - 0.6 * across, -across + 0.6 * along])


def hopping() -> siq.Recordings:
    """A noisy bead in one direction: dx = (x - x³) dt + √0.25 dW, in nm and s."""
    rng = np.random.default_rng(1)
    x, step = rng.uniform(-1.3, 1.3, 40), 0.005
    path = [x]
    for number in range(1, 8000):
        x = x + step * (x - x**3) + np.sqrt(0.25 * step) * rng.normal(size=len(x))
        if number % 4 == 0:
            path.append(x)
    values = np.stack(path, axis=1)[:, :, None]
    times = 4 * step * np.arange(values.shape[1])
    return siq.Recordings.from_arrays(times, values, names=["x"], units=["nm"], time_unit="s")


def falling() -> siq.Diagnosis:
    """Free fall with drag, and a simulation without it."""
    v, g = sympy.symbols("v g", real=True)
    model = siq.Dynamics(
        ("v",), (g + 0 * v,), siq.Diffusion.identity(1), parameters=(Parameter("g", 9.81, "m/s^2"),),
        units=("m/s",), time_unit="s",
    )  # fmt: skip
    t, rng = np.arange(0, 5, 0.1), np.random.default_rng(2)
    last = 22.0
    runs = []
    for number, start in enumerate([0.0, 5.0, 10.0, 30.0, 2.0, 15.0, 26.0, 20.0]):
        ratio = (start - last) / (start + last)
        decay = ratio * np.exp(-2 * 9.81 / last * t)
        speed = last * (1 + decay) / (1 - decay)
        table = {"recording": f"fall {number}", "t": t, "v": speed + 0.05 * rng.normal(size=len(t))}
        runs.append(pd.DataFrame(table))
    return siq.diagnose(model, pd.concat(runs))


def picture(name: str, draw: Callable[[Axes], Axes]) -> None:
    """Draw on axes of their own and write them as PNG."""
    with drawing_style():
        figure = Figure(figsize=SIZE)
        draw(figure.add_subplot())
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
    svg, _ = save_figure(figure, FOLDER / name)
    svg.unlink()


def main() -> None:
    """Make every picture."""
    bead, noisy = ring_downs(), hopping()
    landscape, curve = siq.Landscape.from_recordings(bead), siq.Landscape.from_recordings(noisy)
    diagnosis = falling()
    picture("quasipotential", lambda ax: siq.plot_quasipotential(landscape, recordings=bead, ax=ax))
    picture("quasipotential-of-one-state", lambda ax: siq.plot_quasipotential(curve, recordings=noisy, ax=ax))
    picture("wells", lambda ax: siq.plot_wells(landscape, recordings=bead, ax=ax))
    picture("paths", lambda ax: siq.plot_paths(landscape, ax=ax))
    picture("barriers", lambda ax: siq.plot_barriers(curve, ax=ax))
    picture("residuals", lambda ax: siq.plot_residuals(curve, noisy, ax=ax))
    picture("diagnosis", lambda ax: siq.plot_diagnosis(diagnosis, ax=ax))
    picture("residuals-of-a-diagnosis", lambda ax: siq.plot_residuals(diagnosis, ax=ax))


if __name__ == "__main__":
    main()
