"""Structure in residuals: what is left when a simulation has been fitted, and along which coordinate.

What may be missing is described without naming it: in every equation a piecewise linear function of every
coordinate - a state, an input, the amplitude of a rotating frame, time - is let in, and the data say how
large it would be. The same description tells where a mismatch sits, and whether one is left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.stats

from siq.dynamics.dynamics import Dynamics
from siq.estimation.fit import Fit
from siq.estimation.innovations import Noise, Whitened, solve, whiten
from siq.estimation.linearisation import Grid
from siq.estimation.measurements import Measurements
from siq.mismatch.roles import Roles
from siq.mismatch.screening import in_portions, probe_response, projected

KNOTS = 9  # of the functions that are tried: a choice
SUBSTEPS = 2  # between samples, for the response to these functions
LAGS = 12  # of autocorrelations


@dataclass(frozen=True)
class Direction:
    """In which equations a function of a coordinate may stand, and along which coordinate.

    Attributes
    ----------
    equations
        Names of the states; two of them for a force along or across the amplitude.
    coordinate
        Its name.
    knots
        Where the piecewise linear function bends, shape ``(k,)``.
    """

    equations: tuple[str, ...]
    coordinate: str
    across: bool
    knots: np.ndarray


@dataclass(frozen=True)
class Curve:
    """What is missing in an equation along a coordinate, as far as the data tell.

    Attributes
    ----------
    direction
        Where.
    values, standard_errors
        At the knots, less what the parameters can do, in the unit of the equation; shape ``(k,)``.
    gain
        Decrease of the sum of squared innovations.
    p_value
        Probability of as much by chance.
    """

    direction: Direction
    values: np.ndarray
    standard_errors: np.ndarray
    gain: float
    p_value: float


@dataclass(frozen=True)
class Structure:
    """What residuals show.

    Attributes
    ----------
    curves
        One for every direction, the one that explains most first.
    p_curves
        Probability that the best of them is chance, for as many as were tried.
    p_autocorrelation
        Probability that innovations are as correlated in time by chance.
    total, freedom
        Sum of squared innovations and its degrees of freedom, at the measurement noise of the fit.
    """

    curves: tuple[Curve, ...]
    p_curves: float
    p_autocorrelation: float
    total: float
    freedom: int

    @property
    def p_value(self) -> float:
        """Probability that nothing is left."""
        return min(1.0, 2 * min(self.p_curves, self.p_autocorrelation))


class HatColumns:
    """Piecewise linear functions of coordinates, as `siq.estimation.linearisation.linearise` wants them."""

    def __init__(self, model: Dynamics, grid: Grid, directions: tuple[Direction, ...]) -> None:
        self._model, self._grid, self._directions = model, grid, directions
        self.width = sum(len(each.knots) for each in directions)

    def rates(self, x: np.ndarray, values: np.ndarray, node: int) -> np.ndarray:
        """See `siq.estimation.linearisation.Columns`."""
        result = np.zeros((self._model.dimension, self.width, x.shape[1]))
        signals = self._grid.signals(node, ())
        place = 0
        for direction in self._directions:
            course = coordinate_values(self._model, direction, x, signals.inputs, signals.t)
            hats = _hats(direction.knots, course)
            columns = slice(place, place + len(direction.knots))
            rows = [self._model.states.index(name) for name in direction.equations]
            if len(rows) == 1:
                result[rows[0], columns] = hats
            else:
                a, b = rows
                size = np.hypot(x[a], x[b]) + 1e-300
                first, second = (x[b], -x[a]) if direction.across else (x[a], x[b])
                result[a, columns] = hats * first / size
                result[b, columns] = hats * second / size
            place += len(direction.knots)
        return result

    def outputs(self, x: np.ndarray, values: np.ndarray) -> np.ndarray:
        """See `siq.estimation.linearisation.Columns`."""
        return np.zeros((len(self._model.outputs), self.width, x.shape[1]))


def directions_of(model: Dynamics, roles: Roles, data: Measurements, x: np.ndarray) -> tuple[Direction, ...]:
    """Every equation that may lack something, with every coordinate."""
    signals = data.signals(data.t, data.recording, delays=())
    pairs = {name for pair in roles.amplitudes for name in pair}
    found: list[Direction] = []

    def add(equations: tuple[str, ...], coordinate: str, across: bool = False) -> None:
        draft = Direction(equations, coordinate, across, np.empty(0))
        course = coordinate_values(model, draft, x.T, signals.inputs, signals.t)
        if np.ptp(course) > 0:
            knots = np.unique(np.quantile(course, np.linspace(0, 1, KNOTS)))
            if len(knots) > 3:
                found.append(Direction(equations, coordinate, across, knots))

    for pair in roles.amplitudes:
        add(pair, "amplitude")
        add(pair, "amplitude", across=True)
    for name in roles.states:
        coordinates = [*model.states, *(entry.name for entry in model.inputs), "t"]
        for coordinate in coordinates:
            if not (name in pairs and coordinate in pairs):
                add((name,), coordinate)
    return tuple(found)


def coordinate_values(
    model: Dynamics, direction: Direction, x: np.ndarray, inputs: np.ndarray, t: np.ndarray
) -> np.ndarray:
    """The coordinate along trajectories, shape ``(n,)``."""
    if direction.coordinate == "t":
        return t
    if direction.coordinate == "amplitude":
        a, b = (model.states.index(name) for name in direction.equations)
        return np.hypot(x[a], x[b])
    if direction.coordinate in model.states:
        return x[model.states.index(direction.coordinate)]
    return inputs[[entry.name for entry in model.inputs].index(direction.coordinate)]


def structure_of(
    model: Dynamics,
    data: Measurements,
    fit: Fit,
    roles: Roles,
    *,
    noise: Noise | None = None,
) -> Structure:
    """Describe what a fit leaves.

    Parameters
    ----------
    model, data, fit
        The simulation, the recordings, and the fit of the one to the other.
    roles
        Of the simulation's states.
    noise
        At which the innovations are taken; by default the fit's, which shows what is not random. Without
        process noise they show all that the simulation does not explain.
    """
    directions = directions_of(model, roles, data, fit.x)
    grid = Grid(data, min(fit.substeps, SUBSTEPS))
    noise = fit.noise if noise is None else noise
    parameters = len(fit.model.free)

    def projected_with(some: tuple[Direction, ...]) -> tuple[Whitened, np.ndarray, np.ndarray]:
        white = whiten(probe_response(model, grid, fit, HatColumns(model, grid, some)), data, noise)
        return white, *projected(white, parameters)

    white, left, _ = projected_with(())
    freedom = white.degrees_of_freedom - parameters
    total = float(left @ left)
    # Below its measurement noise a fit has no scale of its own; above it errors are as large as they are.
    scale = 1.0 if noise.process.any() or not fit.has_process_noise else max(total / freedom, 1.0)
    curves = []
    for portion in in_portions([len(each.knots) for each in directions], model, data):
        _, left, columns = projected_with(directions[portion])
        place = 0
        for direction in directions[portion]:
            own = columns[:, place : place + len(direction.knots)]
            place += len(direction.knots)
            values, covariance = solve(own, left)
            gain = total - float(((left - own @ values) ** 2).sum())
            rank = int((np.linalg.svd(own, compute_uv=False) > 1e-9 * max(np.abs(own).max(), 1e-300)).sum())
            p_value = float(scipy.stats.chi2.sf(max(gain, 0.0) / scale, max(rank, 1)))
            errors = np.sqrt(np.diag(covariance) * scale)
            curves.append(Curve(direction, values, errors, gain, p_value))
    curves.sort(key=lambda each: -each.gain)
    best = min((each.p_value for each in curves), default=1.0)
    return Structure(
        curves=tuple(curves),
        p_curves=min(1.0, best * max(len(curves), 1)),
        p_autocorrelation=_autocorrelation(left, white.recording, white.known, len(model.outputs)),
        total=total,
        freedom=freedom,
    )


def _hats(knots: np.ndarray, course: np.ndarray) -> np.ndarray:
    """Piecewise linear functions that are one at one knot and zero at the others, shape ``(k, n)``."""
    result = np.empty((len(knots), len(course)))
    for place in range(len(knots)):
        result[place] = np.interp(course, knots, np.eye(len(knots))[place])
    return result


def _autocorrelation(left: np.ndarray, recording: np.ndarray, known: np.ndarray, outputs: int) -> float:
    """Ljung–Box test over all recordings, output by output."""
    statistic, count = 0.0, 0
    series = left.reshape(-1, outputs)
    whole = known.reshape(-1, outputs)
    owner = recording.reshape(-1, outputs)[:, 0]
    for output in range(outputs):
        y = np.where(whole[:, output], series[:, output], 0.0)
        power = float(y @ y)
        size = int(whole[:, output].sum())
        if power == 0 or size < 4 * LAGS:
            continue
        for lag in range(1, LAGS + 1):
            same = owner[lag:] == owner[:-lag]
            correlation = float((y[lag:] * y[:-lag])[same].sum()) / power
            pairs = int(same.sum())
            statistic += correlation**2 * size**2 / max(pairs, 1)
            count += 1
    return float(scipy.stats.chi2.sf(statistic, count)) if count else 1.0
