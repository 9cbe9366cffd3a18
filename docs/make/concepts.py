"""Draw the pictures of the pages on concepts: `python docs/make/concepts.py`.

Each shows a system whose quasipotential is known exactly, so that nothing is fitted here: with
`f = (A - 1)∇Φ` and A antisymmetric, V is Φ, the way down follows f, and the likeliest
way up follows (A + 1)∇Φ.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import numpy as np
from matplotlib import pyplot
from matplotlib.axes import Axes
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_lyapunov

FOLDER = Path(__file__).parents[1] / "images" / "concepts"
TURN = np.array([[0.0, -1.5], [1.5, 0.0]])
UP, DOWN, BLUE = "#d1495b", "#f4a259", "#3d5a80"


def slope(x: np.ndarray) -> np.ndarray:
    """∇Φ of Φ = (x² - 1)²/4 + y²/2."""
    return np.array([x[0] ** 3 - x[0], x[1]])


def path(start: tuple[float, float], field: Callable[[np.ndarray], np.ndarray], time: float) -> np.ndarray:
    """States along a field from a start, shape ``(n, 2)``."""
    run = solve_ivp(lambda t, x: field(x), (0, time), start, rtol=1e-8, atol=1e-10, max_step=0.05)
    return run.y.T


def grid(x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
    """Points of a picture."""
    return np.meshgrid(np.linspace(-x, x, 241), np.linspace(-y, y, 181))


def quasipotential() -> pyplot.Figure:
    """The flow with its two parts, and U with the ways down and up."""
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(9.5, 4.1), layout="constrained", sharey=True)
    x, y = grid(1.7, 1.2)
    drift = np.einsum("ij,jab->iab", TURN - np.eye(2), slope(np.array([x, y])))
    left.streamplot(x, y, *drift, color="0.6", linewidth=0.7, density=1.1, arrowsize=0.8)
    rng = np.random.default_rng(4)
    for start in rng.uniform([-1.6, -1.1], [1.6, 1.1], size=(7, 2)):
        way = path(tuple(start), lambda at: (TURN - np.eye(2)) @ slope(at), 8.0)
        left.plot(*way.T, color=BLUE, linewidth=1.6)
        left.plot(*start, ".", color=BLUE)
    left.set_title("What you record")
    shown = right.contourf(
        x, y, (x**2 - 1) ** 2 / 2 + y**2, np.linspace(0, 1.2, 13), cmap="Blues_r", extend="max"
    )
    figure.colorbar(shown, ax=right, label="U")
    down = path((-1e-3, 0.0), lambda at: (TURN - np.eye(2)) @ slope(at), 14.0)
    climb = path((-1e-3, 0.0), lambda at: -(TURN + np.eye(2)) @ slope(at), 14.0)
    right.plot(*climb.T, color=UP, linewidth=2, label="likeliest way up")
    right.plot(*down.T, color=DOWN, linewidth=2, linestyle="--", label="way down")
    right.plot([-1, 1], [0, 0], "o", color="white", markeredgecolor="black")
    right.plot(0, 0, "X", color="white", markeredgecolor="black", markersize=9)
    right.annotate("well", (-1, 0), (-1.35, -0.32), color="white")
    right.annotate("saddle", (0, 0), (0.08, 0.1))
    right.legend(loc="lower right", fontsize="small")
    right.set_title("What you want to know")
    for axes in (left, right):
        axes.set(xlabel="x", xlim=(-1.7, 1.7), ylim=(-1.2, 1.2))
    left.set_ylabel("y")
    return figure


def certificate() -> pyplot.Figure:
    """Two functions that solve the same equation exactly; only one is the quasipotential."""
    figure, panels = pyplot.subplots(1, 2, figsize=(9.5, 3.9), layout="constrained", sharey=True)
    x, y = grid(1.5, 1.2)
    true, flat = x**2 + 2 * y**2, x**2
    for axes, u, title in (
        (panels[0], true, "Right: the recordings run down in every direction"),
        (panels[1], flat, "False: flat along y, and just as exact"),
    ):
        axes.contourf(x, y, u, np.linspace(0, 5, 16), cmap="Blues_r", extend="max")
        for angle in np.linspace(0.3, 2 * np.pi + 0.3, 9)[:-1]:
            way = path((1.35 * np.cos(angle), 1.05 * np.sin(angle)), lambda at: -at * np.array([1, 2]), 5.0)
            axes.plot(*way.T, color=UP, linewidth=1.3)
        axes.set(title=title, xlabel="x")
    panels[0].set_ylabel("y")
    return figure


def mismatch() -> pyplot.Figure:
    """A swing that a simulation without drag cannot follow, and what is left after each kind of fit."""

    def swing(parameters: tuple[float, float, float], t: np.ndarray) -> np.ndarray:
        rate, linear, square = parameters
        run = solve_ivp(
            lambda _, s: [s[1], -rate * np.sin(s[0]) - linear * s[1] - square * abs(s[1]) * s[1]],
            (0, t[-1]), [1.2, 0.0], t_eval=t, rtol=1e-8, atol=1e-10,
        )  # fmt: skip
        return run.y[0]

    from scipy.optimize import least_squares

    t = np.arange(0, 14, 0.05)
    measured = swing((16.0, 0.05, 0.08), t) + 0.004 * np.random.default_rng(0).normal(size=len(t))
    simulations = {
        "as it was": (16.4, 0.1, 0.0),
        "best parameters": (*least_squares(lambda p: swing((*p, 0), t) - measured, [16.0, 0.1]).x, 0.0),
        "with quadratic drag": tuple(
            least_squares(lambda p: swing(tuple(p), t) - measured, [16, 0.1, 0.05]).x
        ),
    }
    figure, panels = pyplot.subplots(
        2, 3, figsize=(9.5, 4.4), layout="constrained", sharex=True, sharey="row"
    )
    for (above, below), (name, parameters) in zip(panels.T, simulations.items(), strict=True):
        simulated = swing(parameters, t)
        above.plot(t, measured, ".", color="0.6", markersize=2, label="recorded")
        above.plot(t, simulated, color=BLUE, linewidth=1.2, label="simulated")
        below.plot(t, measured - simulated, color=UP, linewidth=0.8)
        above.set_title(name)
        below.set_xlabel("t [s]")
    panels[0, 0].legend(loc="upper right", fontsize="small")
    panels[0, 0].set_ylabel("angle [rad]")
    panels[1, 0].set_ylabel("difference [rad]")
    return figure


def noise_shape() -> pyplot.Figure:
    """One vector field, two shapes of noise, two landscapes."""
    figure, panels = pyplot.subplots(1, 2, figsize=(9.5, 3.9), layout="constrained", sharey=True)
    field = np.array([[-1.0, -1.2], [1.2, -0.6]])
    x, y = grid(2.4, 1.8)
    for axes, diffusion, title in zip(
        panels,
        (np.eye(2), np.diag([1.0, 0.15])),
        ("noise alike in both states", "little noise in y"),
        strict=True,
    ):
        _quadratic(axes, field, diffusion, x, y)
        axes.set(title=f"U, {title}", xlabel="x")
    panels[0].set_ylabel("y")
    return figure


def _quadratic(axes: Axes, field: np.ndarray, diffusion: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """U of a linear system: its Hessian is twice the inverse of W, where J W + W Jᵀ = -2D."""
    hessian = np.linalg.inv(solve_continuous_lyapunov(field, -2 * diffusion))
    u = np.einsum("iab,ij,jab->ab", np.array([x, y]), hessian, np.array([x, y]))
    shown = axes.contourf(x, y, u, np.linspace(0, 8, 17), cmap="Blues_r", extend="max")
    across, upwards = np.einsum("ij,jab->iab", field, np.array([x, y]))
    axes.streamplot(x, y, across, upwards, color="0.85", linewidth=0.6, density=0.8)
    axes.figure.colorbar(shown, ax=axes, label="U")


def main() -> None:
    """Write all pictures."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for draw in (quasipotential, certificate, mismatch, noise_shape):
        draw().savefig(FOLDER / f"{draw.__name__}.png", dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
