"""U that a reader turns and cuts in the page: one piece of HTML with its own data and script.

The data are U on a coarse grid in steps of one part in 250, wells, saddles and paths: they are read, never
run. The script asks nothing of any other machine, and draws with what every browser has.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from siq.numerics.measured_text import unit_text
from siq.report.drawn_landscape import BLOCK_OF_POINTS, DrawnLandscape, chosen_states

NODES = 64_000  # of the grid: 85 kB in the page
MOST_NODES = 128  # along one state
MOST_STATES = 4  # a grid of more would be too coarse to show a well
ABOVE, UNKNOWN = 254, 255
PATH_POINTS = 80
ROOM = 0.3  # of the height of the highest saddle: shown above it, as in the picture
BANDS = 12  # of colours in a section
SURFACE = 0.9  # of the height of the lowest saddle: where the surface is at first, a bubble about each well


def interactive_view(landscape: DrawnLandscape) -> Markup | None:
    """A view of U that can be turned and cut; None of one state, and where U is known nowhere.

    Parameters
    ----------
    landscape
        What is drawn. Of more than four states those are shown along which the wells lie apart, with the
        others held at the lowest saddle.

    Returns
    -------
    markupsafe.Markup or None
        A ``<section>`` with its style, controls, data and script, to be put into a page once.
    """
    if len(landscape.names) < 2:
        return None
    shown = _shown(landscape)
    values = _on_a_grid(landscape, shown)
    known = values[np.isfinite(values)]
    if not len(known):
        return None
    low, top = float(known.min()), landscape.top
    high = float(known.max()) if top is None or not top > low else top + ROOM * (top - low)
    high = high if high > low else low + 1.0
    low = 0.0 if abs(low) < 1e-3 * (high - low) else low  # the bottom is zero, but for the grid
    data = _data(landscape, shown, values, (low, high))
    lowest = _lowest_pass(landscape)
    share = 0.5 if lowest is None or not low < lowest < high else SURFACE * (lowest - low) / (high - low)
    plane = [shown.index(state) for state in chosen_states(landscape, None)]
    environment = Environment(
        loader=PackageLoader("siq.report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    names = data["names"]
    return Markup(
        environment.get_template("interactive.html.j2").render(
            text=_text(landscape, shown),
            flat=len(shown) == 2,
            level=round(1000 * share),
            names=names,
            plane=plane,
            wells=[one.label for one in landscape.wells],
            ways=bool(landscape.ways),
            solid=f"U over {', '.join(names[:3])}, in three dimensions; the controls below turn it",
            section="A map of U over two of the states; the controls below choose them",
            data=Markup(_safe(data)),
            script=Markup(script()),
        )
    )


def script() -> str:
    """The script of the view."""
    return (files("siq.report") / "templates" / "interactive.js").read_text(encoding="utf-8")


def _safe(data: dict[str, Any]) -> str:
    """JSON that ends no element of a page, whatever a state is called."""
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _shown(landscape: DrawnLandscape) -> list[int]:
    """Places of the states that are shown, the two of the picture among them."""
    count = len(landscape.names)
    first = list(chosen_states(landscape, None))
    return sorted([*first, *(place for place in range(count) if place not in first)][:MOST_STATES])


def _on_a_grid(landscape: DrawnLandscape, shown: Sequence[int]) -> np.ndarray:
    """U on a grid of the states that are shown."""
    count = min(int(NODES ** (1 / len(shown)) + 1e-9), MOST_NODES)
    axes = [landscape.along(place, count) for place in shown]
    mesh = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(shown))
    values = []
    for start in range(0, len(mesh), BLOCK_OF_POINTS):
        part = mesh[start : start + BLOCK_OF_POINTS]
        points = np.tile(landscape.lowest_pass, (len(part), 1))
        points[:, list(shown)] = part
        values.append(landscape.potential(points))
    return np.concatenate(values).reshape((count,) * len(shown))


def _data(
    landscape: DrawnLandscape, shown: Sequence[int], values: np.ndarray, limits: tuple[float, float]
) -> dict[str, Any]:
    """What the script draws, as plain data."""
    low, high = limits
    steps = np.full(values.shape, UNKNOWN)
    known = np.isfinite(values)
    steps[known] = np.clip(np.round(253 * (values[known] - low) / (high - low)), 0, ABOVE)
    units = [unit_text(landscape.units[place]) for place in shown]
    names = [landscape.names[place] for place in shown]
    unit = unit_text(landscape.energy_unit)

    def thinned(path: np.ndarray) -> list[list[float]]:
        rows = np.unique(np.linspace(0, len(path) - 1, min(PATH_POINTS, len(path))).astype(int))
        return [[_short(value) for value in row] for row in path[rows][:, list(shown)]]

    def marks(points: Sequence[Any]) -> list[dict[str, Any]]:
        return [
            {"label": one.label, "position": [_short(value) for value in one.position[list(shown)]],
             "U": _short(one.height if np.isfinite(one.height) else low)}
            for one in points
        ]  # fmt: skip

    return {
        "names": names,
        "units": units,
        "labels": [f"{name} ({each})" if each else name for name, each in zip(names, units, strict=True)],
        "unit": unit,
        "energy": f"U ({unit})" if unit else "U (unit of ε)",
        "box": [[_short(value) for value in landscape.box[place]] for place in shown],
        "shape": list(values.shape),
        "grid": base64.b64encode(steps.astype(np.uint8).tobytes()).decode("ascii"),
        "low": _short(low),
        "high": _short(high),
        "bands": BANDS,
        "wells": marks(landscape.wells),
        "saddles": marks(landscape.saddles),
        "ways": [
            {"uphill": thinned(way.uphill), "downhill": thinned(way.downhill)} for way in landscape.ways
        ],
        "pass": [_short(value) for value in landscape.lowest_pass[list(shown)]],
    }


def _short(value: float) -> float:
    return float(f"{value:.6g}")


def _lowest_pass(landscape: DrawnLandscape) -> float | None:
    tops = [landscape.wells[way.start].height + way.barrier for way in landscape.ways]
    known = [top for top in tops if np.isfinite(top)]
    return min(known) if known else None


def _text(landscape: DrawnLandscape, shown: Sequence[int]) -> str:
    rest = [place for place in range(len(landscape.names)) if place not in shown]
    text = (
        "Circles are stable states, diamonds saddles. The solid line is the most probable way out of a well,"
    )
    text += " the dashed line the way on without noise. Where U is not known, nothing is drawn."
    if len(shown) == 2:
        return "Drag the first picture to turn it. " + text
    text = "The first picture is the surface on which U has one value: raise it until the wells join. " + text
    if rest:
        held = ", ".join(f"{landscape.names[k]} = {landscape.lowest_pass[k]:.3g}" for k in rest)
        text += f" The other states are held at the lowest saddle: {held}."
    return text
